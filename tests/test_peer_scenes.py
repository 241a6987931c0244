"""The peer's scenes against numbers printed by the peer (package robotic 0.4.2) itself."""

import functools
import itertools
from pathlib import Path

import mujoco
import numpy as np
import pytest

from cgs_jax.problems import build_problem
from cgs_jax.scene import load_scene, load_task
from cgs_jax.transitions import Transitions

FOLDER = Path(__file__).parents[1] / "scenes" / "peers"
SCENES = ("pp", "ho", "ho2")
SHAPES = [*(f"coll{i}" for i in range(8)), "palm", "finger1", "finger2"]

# Full edge lengths and centre (m) of every box in the world.
BOXES = {
    "pp": {
        "table": ((2.0, 2.0, 0.1), (0, 0, -0.05)),
        "wall": ((0.30, 0.04, 0.20), (0.45, -0.42, 0.10)),
        "shelf": ((0.30, 0.30, 0.02), (0.50, 0.30, 0.40)),
        "box": ((0.06, 0.06, 0.14), (0.45, -0.30, 0.071)),
    },
    "ho": {
        "table": ((2.6, 1.6, 0.1), (0, 0, -0.05)),
        "wall": ((0.04, 0.80, 0.30), (0, 0, 0.15)),
        "shelf": ((0.30, 0.30, 0.02), (0.50, -0.45, 0.46)),
        "box": ((0.06, 0.06, 0.20), (-0.50, 0.45, 0.101)),
    },
    "ho2": {
        "table": ((2.6, 1.6, 0.1), (0, 0, -0.05)),
        "wall": ((0.04, 0.80, 0.30), (0, 0, 0.15)),
        "post1": ((0.06, 0.06, 0.30), (-0.50, 0.45, 0.15)),
        "post2": ((0.06, 0.06, 0.30), (0.50, -0.45, 0.15)),
        "box": ((0.06, 0.06, 0.20), (-0.50, 0.45, 0.401)),
    },
}
GOALS = {
    "pp": (0.50, 0.30, 0.071, np.sqrt(0.5), 0, 0, np.sqrt(0.5)),
    "ho": (0.50, -0.45, 0.101, 1, 0, 0, 0),
    "ho2": (0.50, -0.45, 0.401, 1, 0, 0, 0),
}
LIMITS = [
    (-2.8973, 2.8973),
    (-1.7628, 1.7628),
    (-2.8973, 2.8973),
    (-3.0718, -0.0698),
    (-2.8973, 2.8973),
    (0.5, 3.0),
    (-2.8973, 2.8973),
]
# (Segment length, radius) of the capsules, m.
CAPSULES = {
    "coll0": (0.1, 0.11),
    "coll1": (0.2, 0.08),
    "coll2": (0.12, 0.12),
    "coll3": (0.2, 0.08),
    "coll4": (0.12, 0.08),
    "coll5": (0.22, 0.09),
    "coll6": (0.1, 0.07),
    "coll7": (0.1, 0.07),
    "palm": (0.14, 0.07),
}
# Shapes of one arm that the peer does not test against each other. It does test the two finger pads of a hand, which
# are fixed 80 mm apart here.
NEIGHBOURS = {
    "coll0": {"coll1", "coll2", "coll3"},
    "coll1": {"coll2", "coll3"},
    "coll2": {"coll3", "coll4"},
    "coll3": {"coll4", "coll5"},
    "coll4": {"coll5", "coll6", "palm"},
    "coll5": {"coll6", "coll7", "palm"},
    "coll6": {"coll7", "palm", "finger1", "finger2"},
    "coll7": {"palm", "finger1", "finger2"},
    "palm": {"finger1", "finger2"},
    "finger1": {"finger2"},
}
# The peer's kinematics and distances (m) in scene ho, arms a and b at Q and the box at BOX_POSE.
Q = [0.3, -0.4, 0.5, -1.7, 0.6, 1.9, -0.7, -0.8, 0.6, -0.2, -2.1, 0.9, 2.4, 1.1]
BOX_POSE = [0.1, -0.2, 0.6, 0.5, 0.5, -0.5, 0.5]
GRIPPERS = {
    "a_gripper": (
        [-0.404025629819487, 0.46868588611697715, 0.6962064732456822],
        [-0.8851695914828752, -0.2974087207266975, 0.152937582860419, -0.3234701576630533],
    ),
    "b_gripper": (
        [0.3237606674973686, 0.42658151721119114, 0.020862587940399913],
        [-0.9468206828804834, 0.18456536607675939, -0.12488541827740648, 0.2320987988257686],
    ),
}
DISTANCES = {
    ("a_coll1", "a_palm"): 0.469866971,
    ("a_coll2", "a_coll5"): 0.214576879,
    ("a_coll4", "b_coll6"): 0.991353046,
    ("a_palm", "b_palm"): 0.810070944,
    ("table", "a_coll7"): 0.743042076,
    ("wall", "b_coll5"): 0.269165426,
    ("box", "a_coll0"): 0.788112340,
    ("a_coll3", "b_coll3"): 1.075592707,
}


@functools.cache
def scene(name):
    return load_scene(FOLDER / name / f"{name}.toml")


def arms(name):
    return "a" if name == "pp" else "ab"


def geom_name(model, geom):
    return mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom)


@pytest.mark.parametrize("name", SCENES)
def test_shapes_limits_and_home(name):
    model = scene(name).model
    data = mujoco.MjData(model)
    data.qpos[:] = scene(name).home_qpos
    mujoco.mj_kinematics(model, data)
    boxes = BOXES[name]
    shapes = {f"{arm}_{shape}" for arm in arms(name) for shape in SHAPES}
    assert {geom_name(model, i) for i in range(model.ngeom)} == {*boxes} | shapes
    for geom, (edges, centre) in boxes.items():
        np.testing.assert_allclose(2 * model.geom(geom).size, edges, atol=1e-12)
        np.testing.assert_allclose(data.geom(geom).xpos, centre, atol=1e-12)
        np.testing.assert_allclose(data.geom(geom).xmat.reshape(3, 3), np.eye(3), atol=1e-12)
    for arm in arms(name):
        for shape, (length, radius) in CAPSULES.items():
            np.testing.assert_allclose(model.geom(f"{arm}_{shape}").size[:2], (radius, length / 2), atol=1e-12)
        for shape in ("finger1", "finger2"):
            np.testing.assert_allclose(2 * model.geom(f"{arm}_{shape}").size, (0.02, 0.016, 0.02), atol=1e-12)
        for i, (limits, home) in enumerate(zip(LIMITS, (0, -0.5, 0, -2, 0, 2, -0.5), strict=True), start=1):
            joint = model.joint(f"{arm}_joint{i}")
            np.testing.assert_allclose(joint.range, limits)
            assert scene(name).home_qpos[joint.qposadr[0]] == pytest.approx(home)
    np.testing.assert_allclose(scene(name).site_pose("goal"), GOALS[name], atol=1e-12)


@pytest.mark.parametrize(("name", "count"), [("pp", 66), ("ho", 243), ("ho2", 258)])
def test_the_same_pairs_can_collide(name, count):
    model = scene(name).model
    obstacles = set(BOXES[name]) - {"box"}
    shapes = {f"{arm}_{shape}" for arm in arms(name) for shape in SHAPES}
    near_base = {f"{arm}_coll{i}" for arm in arms(name) for i in range(4)}
    fixed = obstacles | {f"{arm}_coll0" for arm in arms(name)}
    expected = set()
    for first, second in itertools.combinations(sorted({"box"} | obstacles | shapes), 2):
        if {first, second} <= fixed | near_base and {first, second} & fixed:
            continue
        if first[:2] == second[:2] and {first, second} <= shapes:
            a, b = first[2:], second[2:]
            if b in NEIGHBOURS.get(a, ()) or a in NEIGHBOURS.get(b, ()):
                continue
        expected.add((first, second))
    live = {tuple(sorted(geom_name(model, g) for g in pair)) for pair in scene(name).collision_pairs()}
    assert live == expected
    assert len(live) + len(arms(name)) == count  # the peer's own number, its finger pads included


def test_grippers_and_distances_are_the_peers():
    model = scene("ho").model
    data = mujoco.MjData(model)
    data.qpos[:] = [*Q, *BOX_POSE]
    mujoco.mj_kinematics(model, data)
    for site, (position, quat) in GRIPPERS.items():
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, np.array(quat))
        np.testing.assert_allclose(data.site(site).xpos, position, atol=1e-6)
        np.testing.assert_allclose(data.site(site).xmat, rotation, atol=1e-6)
    for (first, second), distance in DISTANCES.items():
        ours = mujoco.mj_geomDistance(model, data, model.geom(first).id, model.geom(second).id, 5.0, None)
        # Only rounded edges set them apart, by at most (sqrt(3) - 1) mm.
        assert -0.74e-3 <= ours - distance <= 1e-6


@pytest.mark.parametrize("name", SCENES)
def test_nothing_touches_at_home(name):
    model = scene(name).model
    data = mujoco.MjData(model)
    pairs = scene(name).collision_pairs()
    for pose in (scene(name).object_pose("box"), scene(name).site_pose("goal")):
        data.qpos[:] = scene(name).home_qpos
        data.qpos[model.joint("box").qposadr[0] :][:7] = pose
        mujoco.mj_kinematics(model, data)
        distances = [mujoco.mj_geomDistance(model, data, *pair, 5.0, None) for pair in pairs]
        assert min(distances) == pytest.approx(1e-3, abs=1e-9)  # the box stands 1 mm above what carries it


@pytest.mark.parametrize("name", SCENES)
def test_grasps_and_region(name):
    task = load_task(FOLDER / name)
    half = np.array(BOXES[name]["box"][0]) / 2 - 0.015
    for hold in task.holds:
        assert hold.grasp.rows == (((1, 0, 0), (0, 1, 0), 0.0), ((1, 0, 0), (0, 0, 1), 0.0))
        np.testing.assert_allclose(hold.grasp.high, (0, *half[1:]))
        np.testing.assert_allclose(hold.grasp.low, (0, *-half[1:]))
    assert len(task.instances) == 1
    if name == "pp":
        assert task.placements == ()
    else:
        (placement,) = task.placements
        assert (placement.low, placement.high) == ((-0.30, -0.40, 0.25), (0.30, 0.40, 0.90))
        assert placement.quat is None and not placement.upright


@pytest.mark.parametrize("name", SCENES)
def test_sequences_are_paths(name):
    problem = build_problem(scene(name))
    transitions = Transitions(problem.graph)
    rows = {c.name: c.equality_rows for c in problem.graph.constraints if c.factor == "Grasp"}
    assert set(rows.values()) == {3}
    for text in problem.scene.task.sequences.values():
        assert transitions.parse(text)[-1].target == transitions.full
