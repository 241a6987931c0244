"""Scenes and task files: geometry against public numbers and arithmetic, MuJoCo's own filter, all kinds of mistake."""

import itertools
import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path

import mujoco
import numpy as np
import pytest

from cgs_jax import scene as scenes
from cgs_jax.errors import InputError

NAMES = ("pick_place", "handover", "banana")
INSTANCES = [(name, instance) for name in NAMES for instance in range(8)]
CLEARANCE = 1e-3
PAD_TO_PAD = 0.1 + 3 * 0.45 + 0.1


@pytest.fixture(scope="module")
def loaded():
    return {(name, instance): scenes.load_scene(name, instance) for name, instance in INSTANCES}


def frames(scene, qpos):
    data = mujoco.MjData(scene.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.model, data)
    return data


def matrix(pose):
    result = np.eye(4)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, pose[3:])
    result[:3, :3], result[:3, 3] = rotation.reshape(3, 3), pose[:3]
    return result


# ---------------------------------------------------------------- geometry


def panda_pinch(q):
    """Pinch frame from the manufacturer's modified DH table (Craig), flange, hand turned by -45 degrees, 0.1034 m."""
    table = [
        (0, 0, 0.333),
        (0, -90, 0),
        (0, 90, 0.316),
        (0.0825, 90, 0),
        (-0.0825, -90, 0.384),
        (0, 90, 0),
        (0.088, 90, 0),
    ]
    rows = [(a, np.radians(alpha), d, angle) for (a, alpha, d), angle in zip(table, q, strict=True)]
    rows += [(0, 0, 0.107, -np.pi / 4), (0, 0, 0.1034, 0)]
    pose = np.eye(4)
    for a, alpha, d, theta in rows:
        ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        pose = pose @ np.array(
            [[ct, -st, 0, a], [st * ca, ct * ca, -sa, -d * sa], [st * sa, ct * sa, ca, d * ca], [0, 0, 0, 1]]
        )
    return pose


@pytest.mark.parametrize(("name", "prefix"), [("pick_place", "a_"), ("handover", "a_"), ("handover", "b_")])
def test_arm_has_the_pandas_kinematics_and_limits(loaded, name, prefix):
    scene = loaded[name, 0]
    joints = [scene.model.joint(f"{prefix}joint{i}") for i in range(1, 8)]
    low = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
    high = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    assert np.allclose([joint.range for joint in joints], np.transpose([low, high]))
    rng = np.random.default_rng(0)
    for _ in range(5):
        q, qpos = rng.uniform(low, high), scene.home_qpos.copy()
        qpos[[joint.qposadr[0] for joint in joints]] = q
        data = frames(scene, qpos)
        base = np.eye(4)
        base[:3, :3] = data.body(f"{prefix}link0").xmat.reshape(3, 3)
        base[:3, 3] = data.body(f"{prefix}link0").xpos
        expected, site = base @ panda_pinch(q), data.site(f"{prefix}pinch")
        # The resolved MJCF is text with six digits.
        assert np.allclose(site.xpos, expected[:3, 3], atol=5e-6)
        assert np.allclose(site.xmat.reshape(3, 3), expected[:3, :3], atol=5e-6)


@pytest.mark.parametrize("name", ["pick_place", "handover"])
def test_fingers_leave_one_millimetre_on_each_side_of_the_box(loaded, name):
    scene = loaded[name, 0]
    qpos = scene.home_qpos.copy()
    grasp = np.eye(4)  # T_site_object: the object's x along the closing axis y, its z across the palm
    grasp[:3, :3] = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    pose = matrix(scene.site_pose("a_pinch")) @ grasp
    address = scene.model.joint("box").qposadr[0]
    qpos[address : address + 3] = pose[:3, 3]
    mujoco.mju_mat2Quat(qpos[address + 3 : address + 7], pose[:3, :3].ravel())
    data = frames(scene, qpos)
    box = scene.model.geom("box").id
    for finger in ("a_finger_left", "a_finger_right"):
        distance = mujoco.mj_geomDistance(scene.model, data, scene.model.geom(finger).id, box, 1.0, None)
        assert distance == pytest.approx(CLEARANCE, abs=2e-6)
    assert mujoco.mj_geomDistance(scene.model, data, scene.model.geom("a_hand").id, box, 1.0, None) > CLEARANCE


def test_chain_is_one_and_a_half_metres_from_pad_to_pad(loaded):
    scene = loaded["banana", 0]
    qpos = scene.home_qpos.copy()
    qpos[[scene.model.joint(f"joint{i}").qposadr[0] for i in range(1, 9)]] = 0
    data = frames(scene, qpos)
    assert np.linalg.norm(data.site("hand").xpos - data.site("foot").xpos) == pytest.approx(PAD_TO_PAD, abs=1e-6)
    assert PAD_TO_PAD == pytest.approx(1.55)
    axes = "ZYZYYZYZ"
    assert all(scene.model.joint(f"joint{i + 1}").axis["XYZ".index(axis)] == 1 for i, axis in enumerate(axes))
    anchors = [data.joint(f"joint{i}").xanchor[2] for i in (2, 4, 5, 7)]
    assert np.allclose(anchors, 0.1 + 0.45 * np.arange(4), atol=1e-6)


@pytest.mark.parametrize("instance", range(8))
def test_banana_and_goal_are_out_of_reach_from_the_floor(loaded, instance):
    """A pad on the floor is at height 0, and the other one is at most the chain's length away from it."""
    scene = loaded["banana", instance]
    sites = scene.task.hold("t_b").grasp.sites
    assert len(sites) == 5
    start = matrix(scene.object_pose("banana"))
    local = [np.linalg.inv(start) @ matrix(scene.site_pose(site)) for site in sites]
    heights = [(pose @ site)[2, 3] for pose in (start, matrix(scene.site_pose("goal"))) for site in local]
    assert PAD_TO_PAD < min(heights)
    # From the box's top they are within the chain's length, or there would be no solution.
    assert max(heights) < 2 * scene.model.geom("box").size[2] + PAD_TO_PAD
    assert np.linalg.norm(scene.object_pose("banana")[:3] - scene.site_pose("goal")[:3]) <= 0.7


@pytest.mark.parametrize("instance", range(8))
def test_start_is_out_of_reach_of_b_and_goal_of_a(loaded, instance):
    """The pinch site is at most three links' length from the shoulder, the grasp at most `slide` from the middle."""
    scene = loaded["handover", instance]
    reach = np.hypot(0.316, 0.0825) + np.hypot(0.384, 0.0825) + np.hypot(0.088, 0.107 + 0.1034)
    slide = scene.task.hold("t_b").grasp.high[2]
    data = frames(scene, scene.home_qpos)
    for prefix, pose in (("b_", scene.object_pose("box")), ("a_", scene.site_pose("goal"))):
        shoulder = data.body(f"{prefix}link2").xpos
        assert np.linalg.norm(pose[:3] - shoulder) > reach + slide


def test_touch_sites_lie_on_the_surface_and_look_outwards(loaded):
    scene = loaded["banana", 0]
    data = frames(scene, scene.home_qpos)
    for hold in scene.task.holds:
        geom = scene.model.geom("banana" if hold.object == "banana" else "box").id
        for name in hold.grasp.sites:
            site = data.site(name)
            normal = site.xmat.reshape(3, 3)[:, 2]
            # A probe of 1 mm whose centre is 5 mm outside is 4 mm away, in the direction of the normal only.
            text = f'<mujoco><worldbody><geom size=".001" pos="{" ".join(map(str, site.xpos + 0.005 * normal))}"/>'
            kind = scenes.COLLISION_GEOMS[mujoco.mjtGeom(int(scene.model.geom_type[geom]))]
            quat = np.empty(4)
            mujoco.mju_mat2Quat(quat, data.geom_xmat[geom])
            size, pos = scene.model.geom_size[geom], data.geom_xpos[geom]
            text += f'<geom type="{kind}" size="{size[0]} {size[1]} {size[2]}" pos="{pos[0]} {pos[1]} {pos[2]}"'
            text += f' quat="{quat[0]} {quat[1]} {quat[2]} {quat[3]}"/></worldbody></mujoco>'
            probe = mujoco.MjModel.from_xml_string(text)
            probe_data = mujoco.MjData(probe)
            mujoco.mj_kinematics(probe, probe_data)
            assert mujoco.mj_geomDistance(probe, probe_data, 0, 1, 1.0, None) == pytest.approx(0.004, abs=1e-5), name


# ---------------------------------------------------------------- instances


@pytest.mark.parametrize("name", NAMES)
def test_eight_different_instances_of_the_same_structure(loaded, name):
    models = [loaded[name, instance].model for instance in range(8)]
    assert len(loaded[name, 0].task.instances) == 8
    pairs = loaded[name, 0].collision_pairs()
    for instance, model in enumerate(models):
        assert loaded[name, instance].collision_pairs() == pairs
        assert np.array_equal(model.geom_type, models[0].geom_type)
    for a, b in itertools.combinations(range(8), 2):
        first, second = loaded[name, a], loaded[name, b]
        assert not np.allclose(first.site_pose("goal"), second.site_pose("goal")) or not np.allclose(
            first.model.geom_pos, second.model.geom_pos
        )


@pytest.mark.parametrize(("name", "instance"), INSTANCES)
def test_home_is_free_and_resting_things_have_clearance(loaded, name, instance):
    scene = loaded[name, instance]
    data = frames(scene, scene.home_qpos)
    distances = [mujoco.mj_geomDistance(scene.model, data, a, b, 0.01, None) for a, b in scene.collision_pairs()]
    assert min(distances) > 0.9 * CLEARANCE
    # The objects at their goals touch nothing that is fixed either.
    for goal in scene.task.goals:
        body = scene.task.object(goal.object).body
        address = scene.model.joint(scene.model.body_jntadr[scene.model.body(body).id]).qposadr[0]
        qpos = scene.home_qpos.copy()
        qpos[address : address + 7] = scene.site_pose(goal.site)
        data = frames(scene, qpos)
        for a, b in scene.collision_pairs():
            bodies = {int(scene.model.geom_bodyid[a]), int(scene.model.geom_bodyid[b])}
            if bodies == {0, scene.model.body(body).id}:
                assert mujoco.mj_geomDistance(scene.model, data, a, b, 0.01, None) > 0.9 * CLEARANCE


@pytest.mark.parametrize(("name", "instance"), INSTANCES)
def test_resolved_text_is_the_model(loaded, name, instance):
    scene = loaded[name, instance]
    again = mujoco.MjModel.from_xml_string(scene.xml)
    assert np.array_equal(again.geom_pos, scene.model.geom_pos) and np.array_equal(again.qpos0, scene.model.qpos0)
    assert np.array_equal(again.key("home").qpos, scene.home_qpos)
    for spec in scene.task.objects:
        address = again.joint(again.body_jntadr[again.body(spec.body).id]).qposadr[0]
        assert np.allclose(scene.home_qpos[address : address + 7], scene.object_pose(spec.name))
    assert "file=" not in scene.xml


def test_edits_reach_the_model_and_the_placements(loaded):
    scene = loaded["handover", 5]
    assert np.allclose(scene.object_pose("box")[:3], [-0.72, 0.52, 0.301])
    assert np.allclose(scene.site_pose("goal")[:3], [0.40, -0.50, 0.221])
    assert np.allclose(scene.model.geom("stand_goal").size, [0.05, 0.05, 0.06])
    assert scenes.placements(scene.task)[0]["high"] == [0.30, 0.50, 0.85]
    assert scenes.placements(loaded["handover", 0].task)[0]["high"] == [0.30, 0.40, 0.85]
    assert np.allclose(scenes.placements(loaded["handover", 3].task)[0]["quat"], 0.5)


# ---------------------------------------------------------------- collisions


@pytest.mark.parametrize("name", NAMES)
def test_collision_pairs_are_those_that_mujoco_tests(loaded, name):
    """With every geom blown up to a sphere of 10 m, each pair that passes MuJoCo's own filter is a contact."""
    scene = loaded[name, 0]
    spec = mujoco.MjSpec.from_string(scene.xml)
    for geom in spec.geoms:
        geom.type, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, (10, 0, 0)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    tested = {tuple(sorted((int(contact.geom[0]), int(contact.geom[1])))) for contact in data.contact}
    assert tested == set(scene.collision_pairs())


@pytest.mark.parametrize("name", NAMES)
def test_excluded_pairs_are_at_most_two_joints_apart_and_each_has_its_reason(loaded, name):
    model = loaded[name, 0].model

    def joints_to_world(body):
        chain = []
        while body:
            address, count = model.body_jntadr[body], model.body_jntnum[body]
            chain += list(range(address, address + count))
            body = model.body_parentid[body]
        return set(chain)

    for signature in model.exclude_signature:
        first, second = int(signature) >> 16, int(signature) & 0xFFFF
        assert len(joints_to_world(first) ^ joints_to_world(second)) <= 2
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    contact = ElementTree.parse(scenes.scenes_folder() / name / f"{name}.xml", parser).getroot().find("contact")
    kinds = [child.tag is ElementTree.Comment for child in contact]
    assert kinds == [True, False] * (len(kinds) // 2)
    assert len(kinds) == 2 * model.nexclude


@pytest.mark.parametrize(
    ("name", "pairs"),
    [
        (
            "pick_place",
            ["a_hand box", "a_link5 a_hand", "a_link1 a_hand", "a_finger_left table", "box shelf", "box a_link5"],
        ),
        (
            "handover",
            ["a_hand b_hand", "a_link5 b_link5", "a_finger_left box", "b_finger_right box", "box wall", "table box"],
        ),
        ("banana", ["foot hand", "link2 link5", "box link5", "banana foot", "banana box", "box floor", "beam banana"]),
    ],
)
def test_grasping_and_carrying_need_no_exclusion(loaded, name, pairs):
    scene = loaded[name, 0]
    live = {frozenset((scene.model.geom(a).name, scene.model.geom(b).name)) for a, b in scene.collision_pairs()}
    for pair in pairs:
        assert frozenset(pair.split()) in live, pair


def test_explicit_pairs_are_live_and_masks_are_respected(tmp_path):
    xml = """<mujoco><worldbody>
      <geom name="a" size=".1" contype="0" conaffinity="0"/>
      <geom name="p" type="plane" size="1 1 .1" contype="0" conaffinity="0"/>
      <body pos="0 0 1"><freejoint/><geom name="b" size=".1"/></body>
      <body pos="0 0 2"><freejoint/><geom name="c" size=".1" contype="2" conaffinity="2"/></body>
      <body pos="0 0 3"><freejoint/><geom name="d" size=".1" contype="0" conaffinity="1"/></body>
    </worldbody><contact><pair geom1="c" geom2="a"/></contact></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    named = {tuple(sorted(model.geom(i).name for i in pair)) for pair in scenes._collision_pairs(model)}
    assert named == {("a", "c"), ("b", "d")}


# ---------------------------------------------------------------- what the task says


def test_pose_sources():
    handover = scenes.object_pose_sources(scenes.load_task("handover"))
    assert handover == {
        ("box", "pick"): ("start",),
        ("box", "handover"): ("variable", "p"),
        ("box", "place"): ("goal", "goal"),
    }
    banana = scenes.object_pose_sources(scenes.load_task("banana"))
    expected = dict.fromkeys(
        [("box", s) for s in ("place_box", "step_on", "pick_banana", "place_banana")], ("variable", "p")
    )
    expected |= dict.fromkeys([("banana", s) for s in ("pick_box", "place_box", "step_on", "pick_banana")], ("start",))
    assert banana == expected | {("box", "pick_box"): ("start",), ("banana", "place_banana"): ("goal", "goal")}


def test_attachments_of_banana_say_where_each_body_rests():
    entries = scenes.attachments(scenes.load_task("banana"))
    json.dumps(entries)
    where = Counter((e["object"], e["frame"], e["from"], e["to"]) for e in entries)
    a, b, x, c, d = "pick_box", "place_box", "step_on", "pick_banana", "place_banana"
    expected = [("box", "world", None, a), ("box", "hand", a, b), ("box", "world", b, x), ("box", "world", x, c)]
    expected += [("box", "world", c, d), ("box", "hand", x, c), ("box", "hand", c, d)]
    expected += [("banana", "world", f, t) for f, t in ((None, a), (a, b), (b, x), (x, c))] + [("banana", "foot", c, d)]
    expected += [("chain", "world", None, a), ("chain", "world", a, b), ("chain", "world", b, x)]
    assert where == Counter(expected)
    touch = next(e for e in entries if e["frame"] == "foot")
    assert (
        touch["variable"] == "t_b" and touch["grasp"]["kind"] == "touch" and "banana_under" in touch["grasp"]["sites"]
    )


def test_configurations_name_every_joint_of_every_switch_once(loaded):
    """The other arm stands at home, which the MJCF's keyframe has as text."""
    scene = loaded["handover", 2]
    entries = scene.configurations()
    a, b = ([f"{prefix}_joint{i}" for i in range(1, 8)] for prefix in "ab")
    qpos = scene.model.key("home").qpos
    home = {name: qpos[scene.model.joint(name).qposadr[0]] for name in (*a, *b)}
    assert entries == [
        {"at": "pick", "joints": a, "variable": "q_a1"},
        {"at": "pick", "joints": b, "values": [home[name] for name in b]},
        {"at": "handover", "joints": a, "variable": "q_a2"},
        {"at": "handover", "joints": b, "variable": "q_b2"},
        {"at": "place", "joints": b, "variable": "q_b1"},
        {"at": "place", "joints": a, "values": [home[name] for name in a]},
    ]


def test_attachments_of_handover_follow_the_hands():
    entries = scenes.attachments(scenes.load_task("handover"))
    where = [(e["object"], e["frame"], e["from"], e["to"]) for e in entries]
    assert where == [
        ("box", "world", None, "pick"),
        ("box", "a_pinch", "pick", "handover"),
        ("box", "b_pinch", "handover", "place"),
    ]
    assert entries[1]["grasp"]["rows"] == [[[0, 1, 0], [0, 1, 0], 0], [[0, 1, 0], [0, 0, 1], 0]]
    assert entries[1]["grasp"]["low"] == [0, 0, -0.085]


def test_goals_and_placements_are_as_the_contract_says():
    task = scenes.load_task("banana")
    assert scenes.goals(task) == [
        {"object": "banana", "site": "goal", "at": "place_banana", "position": True, "rotation": True}
    ]
    (placement,) = scenes.placements(task)
    assert placement["upright"] is True and placement["quat"] is None and placement["low"][2] == placement["high"][2]


def test_sequences_are_those_of_table_two():
    """Paper, Table II, with its outer brackets and commas as steps."""
    printed = {
        "handover": {
            "expert1": "(q_a1,q_a2,t_a,q_b1,q_b2,t_b,p)",
            "expert2": "p;t_a;t_b;q_a1;q_a2;q_b2;q_b1",
            "expert3": "(q_a1,t_a);(q_a2,p,q_b2,t_b);q_b1",
        },
        "banana": {
            "expert1": "(q_a1,q_a2,t_a,p,q_x,t_x,q_b1,q_b2,t_b)",
            "expert2": "p;t_a;t_b;t_x;q_a1;q_a2;q_x;q_b1;q_b2",
            "expert3": "(q_a1,t_a);(q_a2,p);(q_x,t_x);(q_b1,t_b);q_b2",
        },
    }
    for name, sequences in printed.items():
        given = scenes.load_task(name).sequences
        assert {key: text.replace(" ", "") for key, text in given.items()} == sequences


def test_variables_in_reading_order():
    assert scenes.load_task("pick_place").variables == ("q1", "t", "q2")
    assert scenes.load_task("handover").variables == ("q_a1", "t_a", "q_a2", "q_b2", "p", "t_b", "q_b1")
    assert scenes.load_task("banana").variables == ("q_a1", "t_a", "q_a2", "p", "q_x", "t_x", "q_b1", "t_b", "q_b2")


# ---------------------------------------------------------------- MJX


def test_mjx_takes_the_scenes_and_agrees_with_mujoco(loaded, capfd):
    for name in NAMES:
        assert loaded[name, 0].mjx_model.nq == loaded[name, 0].model.nq
    assert "warp" not in "".join(capfd.readouterr())
    import jax
    from mujoco import mjx

    scene = loaded["pick_place", 3]
    data = mjx.make_data(scene.mjx_model).replace(qpos=scene.home_qpos)
    result = jax.jit(mjx.kinematics)(scene.mjx_model, data)
    assert np.allclose(result.site_xpos, frames(scene, scene.home_qpos).site_xpos, atol=1e-5)


# ---------------------------------------------------------------- mistakes


@pytest.fixture
def edited(tmp_path):
    """A copy of a scene with one text replaced; returns the path of its task file."""

    def edit(name, old, new, suffix="toml"):
        folder = tmp_path / name
        shutil.copytree(scenes.scenes_folder() / name, folder, dirs_exist_ok=True)
        path = folder / f"{name}.{suffix}"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))
        return folder / f"{name}.toml"

    return edit


def assert_refused(path, *words, instance=0):
    with pytest.raises(InputError) as caught:
        scenes.load_scene(path, instance)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message


def test_unknown_scene_lists_the_available_ones():
    assert_refused("banan", "banan", "banana, handover, pick_place")
    assert_refused("nowhere/banana.toml", "nowhere/banana.toml", "handover")


@pytest.mark.parametrize("instance", [-1, 8, True, 1.0])
def test_instance_out_of_range(instance):
    assert_refused("banana", "banana", repr(instance), "0 to 7", instance=instance)


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("handover", 'home = "home"', "home = ", ["handover.toml", "broken TOML", "line"]),
        ("handover", 'home = "home"', 'home = "hom"', ["keyframe", "'hom'", "available: home"]),
        ("handover", 'home = "home"', "", ["'home' is missing"]),
        ("handover", 'model = "handover.xml"', 'model = "hand.xml"', ["hand.xml", "available: handover.xml"]),
        ("handover", "[robots.a]", "[robots.a]\nspeed = 3", ["robots.a", "unknown key 'speed'", "joints"]),
        ("handover", '"a_joint7"', '"a_joint8"', ["no joint 'a_joint8'", "a_joint7"]),
        ("handover", '"a_joint7"]', '"box"]', ["joint 'box'", "hinge or slide"]),
        ("handover", '"a_joint7"', '"a_joint6"', ["a_joint6", "more than once"]),
        ("handover", '"b_joint7"', '"a_joint7"', ["a_joint7", "more than one robot"]),
        ("handover", '"a_joint7"]', '"a_joint7"]\nbase = "box"', ["base", "support"]),
        ("handover", 'body = "box"', 'body = "bx"', ["no body 'bx'", "available"]),
        ("handover", 'body = "box"', 'body = "a_link3"', ["a_link3", "free joint", "bodies with one: box"]),
        ("handover", 'frame = "a_pinch"', 'frame = "a_pinsh"', ["no site 'a_pinsh'", "t_a", "a_pinch"]),
        ("handover", 'frame = "a_pinch"', 'frame = "b_pinch"', ["b_pinch", "does not move with robot 'a'"]),
        ("handover", 'site = "goal"', 'site = "gaol"', ["no site 'gaol'", "available: goal"]),
        ("handover", 'site = "goal"', 'site = "a_pinch"', ["a_pinch", "fixed in the world"]),
        ("handover", 'from = "pick"', 'from = "pik"', ["t_a", "unknown switch 'pik'", "pick, handover, place"]),
        ("handover", 'from = "pick"', 'from = "place"', ["must come before"]),
        ("handover", 'robot = "a"', 'robot = "c"', ["unknown robot 'c'", "a, b"]),
        ("handover", 'object = "box"', 'object = "bok"', ["unknown object 'bok'", "available: box"]),
        ("handover", 'configurations = { a = "q_a1" }', 'configurations = { c = "q" }', ["unknown robot 'c'"]),
        ("handover", 'configurations = { a = "q_a1" }', 'configurations = { b = "q_a1" }', ["t_a", "no configuration"]),
        ("handover", 'variable = "t_b"', 'variable = "t_a"', ["'t_a' is declared more than once"]),
        ("handover", 'at = "handover"', 'at = "now"', ["unknown switch 'now'"]),
        ("handover", 'at = "handover"', 'at = "place"', ["let go"]),
        ("handover", "low = [-0.30, -0.40, 0.35]", "low = [-0.30, 0.50, 0.35]", ["(p)", "low 0.5", "high 0.4", "y"]),
        ("handover", "low = [-0.30, -0.40, 0.35]", "low = [-0.30, -0.40]", ["'low'", "3 numbers"]),
        ("handover", "low = [-0.30, -0.40, 0.35]", "low = [-0.30, nan, 0.35]", ["'low'", "finite"]),
        ("handover", "quat = [0.7071067811865476, 0, 0.7071067811865476, 0]", "quat = [0, 0, 0, 0]", ["zero length"]),
        ("handover", "quat = [0.70", "upright = true\nquat = [0.70", ["exclude each other"]),
        ("handover", 'kind = "two_finger"', 'kind = "suction"', ["suction", "two_finger, touch"]),
        ("handover", "[[0, 1, 0], [0, 1, 0], 0.0]", "[[0, 1, 0], [0, 1, 0], 1.0]", ["rows[0]", "dot product 1"]),
        ("handover", "[[0, 1, 0], [0, 1, 0], 0.0]", "[[0, 1, 0], [0, 1, 0]]", ["rows[0]"]),
        ("handover", "rows = [", "rows = [[[0, 0, 1], [1, 0, 0], 0.0], [[0, 0, 1], [0, 1, 0], 0.0], ", ["4 rows", "at most 3"]),
        ("handover", "position = true", "position = 1", ["'position'", "true or false"]),
        ("handover", "position = true\nrotation = true", "", ["asks for nothing"]),
        ("handover", "q_a2,t_a,q_b1", "q_a2,t_c,q_b1", ["expert1", "unknown variable 't_c'"]),
        ("handover", "q_a2,t_a,q_b1", "q_a2,q_b1", ["expert1", "t_a"]),
        ("handover", "geom.wall = {", "geom.wal = {", ["instances[1]", "no geom 'wal'", "wall"]),
        ("handover", "geom.wall = {", "geom.a_hand = {", ["a_hand", "fromto"]),
        ("handover", "geom.wall = {", "joint.wall = {", ["unknown key 'joint'", "body, geom, site"]),
        ("handover", "geom.wall = { pos", "geom.wall = { mass", ["unknown key 'mass'", "pos, quat, size"]),
        ("handover", "size = [0.025, 0.50, 0.22]", "size = [0.025, 0, 0.22]", ["'size' must be positive"]),
        ("handover", "placement.p = {", "placement.x = {", ["placement.x", "available: p"]),
        ("banana", 'sites = ["box_top"]', 'sites = ["lid"]', ["no site 'lid'", "t_x", "box_top"]),
        ("banana", 'sites = ["box_top"]', 'sites = ["banana_tip"]', ["banana_tip", "not on object 'box'"]),
        ("banana", 'support = "foot"', 'support = "feet"', ["no site 'feet'"]),
        ("banana", 'support = "foot"', 'support = "box_top"', ["box_top", "not on robot"]),
        ("banana", 'base = "chain"', 'base = "link3"', ["link3", "free joint"]),
        ("banana", 'to = "place_banana"\nsupports', 'to = "pick_banana"\nsupports', ["hangs on 0 objects"]),
        ("banana", 'from = "step_on"', 'from = "pick_box"', ["also held"]),
        ("handover", 'to = "place"', 'to = "place"\nsupports = true', ["floating robot", "'b'"]),
    ],
)  # fmt: skip
def test_mistakes_in_the_task_file(edited, name, old, new, words):
    instance = 1 if "instances[1]" in words or "geom." in old else 0
    assert_refused(edited(name, old, new), *words, instance=instance)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<worldbody>", "<worldbod>", ["handover.xml", "Line number"]),
        ('type="box" size="1.3 .9 .10"', 'type="box"', ["handover.xml does not compile", "size"]),
        ('<geom name="table" type="box" size="1.3 .9 .10"', '<geom name="table" type="plane" size="1 1 .1"',
         ["'table'", "'plane'", "sphere, capsule, box"]),
        ('class="obstacle" name="wall"', 'name="wall" type="cylinder"', ["'wall'", "'cylinder'"]),
        ('<freejoint name="box"/>', "", ["handover.xml", "keyframe"]),
        ('<joint name="a_joint1" axis="0 0 1" range="-2.8973 2.8973"/>', '<joint name="a_joint1" axis="0 0 1"/>',
         ["a_joint1", "no range"]),
        ('name="a_pinch"', 'name="a_tip"', ["no site 'a_pinch'", "a_tip"]),
        ('<key name="home"', '<key name="rest"', ["no keyframe 'home'", "available: rest"]),
    ],
)  # fmt: skip
def test_mistakes_in_the_model(edited, old, new, words):
    assert_refused(edited("handover", old, new, suffix="xml"), *words)


def test_a_geom_that_never_collides_may_be_of_any_type(edited):
    old = '<geom name="table" type="box" size="1.3 .9 .10"'
    new = '<geom type="cylinder" size=".1 .1" contype="0" conaffinity="0"/>' + old
    scene = scenes.load_scene(edited("handover", old, new, suffix="xml"), 0)
    assert scene.model.ngeom == scenes.load_scene("handover", 0).model.ngeom + 1


def test_a_task_is_found_by_name_file_and_folder(edited):
    path = edited("banana", "[[instances]]", "[[instances]]")
    assert scenes.load_task(path).name == scenes.load_task(path.parent).name == scenes.load_task("banana").name
    assert scenes.available_scenes() == ("banana", "handover", "pick_place", "stack")


def test_a_partial_goal_leaves_the_object_in_the_hand(edited):
    task = scenes.load_task(edited("pick_place", "rotation = true", "rotation = false"))
    assert scenes.object_pose_sources(task)["box", "place"] == ("held", "t")
    assert not task.goals[0].full


def test_documented_keys_are_those_that_are_read():
    """Every key that a scene uses is explained in the format's description."""
    text = (scenes.scenes_folder() / "README.md").read_text()
    for name in NAMES:
        source = Path(scenes.load_task(name).path).read_text()
        for key in set(re.findall(r"^(\w+) =", source, flags=re.MULTILINE)) - {"expert1", "expert2"}:
            assert re.search(rf"\b{key}\b", text), key
