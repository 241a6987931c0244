import importlib.util
import threading
from pathlib import Path

import gantry
import mujoco
import numpy as np
import pytest

from cgs_jax import audit
from cgs_jax.audit import Auditor, Tolerances, live_pairs
from cgs_jax.errors import InputError

SWITCHES = ("pick", "place")


def load_verify():
    path = Path(__file__).parents[1] / "scripts" / "verify.py"
    spec = importlib.util.spec_from_file_location("verify", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def auditor(grasp=gantry.TOUCH, placements=(gantry.PLACEMENT,), goals=(), **kwargs):
    model = mujoco.MjModel.from_xml_string(gantry.MJCF)
    return Auditor(model, gantry.attachments(grasp), placements, goals, SWITCHES, **kwargs)


# A tree with every kind of joint, several in one body, off-centre, with reference angles, under turned fixed bodies.
TREE = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="fixed" pos="0.1 0.2 0.3" quat="0.8 0.2 0.4 0.4">
      <site name="fixed_site" pos="0.1 0 0" quat="1 2 3 4"/>
      <body name="a" pos="0.2 0 0.1" quat="0.5 0.5 -0.5 0.5">
        <joint name="h1" axis="1 2 3" pos="0.1 0.2 -0.1" ref="0.4"/>
        <joint name="s1" type="slide" axis="-1 0 2" ref="0.2"/>
        <joint name="h2" axis="0 -1 0" pos="0 0.3 0"/>
        <geom size="0.05"/>
        <body pos="0.3 0 0" quat="1 1 0 0"><geom size="0.05"/>
          <body name="b" pos="0 0.2 0">
            <joint name="ball" type="ball" pos="0.05 0 0.02"/>
            <geom size="0.05"/><site name="tip" pos="0.1 0.2 0.3" quat="4 3 2 1"/>
          </body>
        </body>
      </body>
    </body>
    <body name="free" pos="1 0 0" quat="0.6 0.8 0 0"><freejoint/><geom size="0.05"/>
      <body name="on_free" pos="0 0 0.2">
        <joint axis="1 1 0" pos="0 0 0.1"/>
        <geom size="0.05"/><site name="rider"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def test_poses_agree_with_c_mujoco_for_every_joint_type():
    model = mujoco.MjModel.from_xml_string(TREE)
    data = mujoco.MjData(model)
    kinematics = audit._Kinematics(model)
    rng = np.random.default_rng(0)
    qpos = rng.normal(size=(40, model.nq))  # quaternions of any length: MuJoCo normalises them too
    at = audit._Configuration(kinematics.frames(qpos.T.copy()))
    for row, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        frames = [(kinematics.bodies[i], data.xmat[i], data.xpos[i]) for i in range(model.nbody)]
        frames += [(kinematics.sites[i], data.site_xmat[i], data.site_xpos[i]) for i in range(model.nsite)]
        for frame, rotation, position in frames:
            ours = at.pose(frame)
            np.testing.assert_allclose(ours[0][..., row], rotation.reshape(3, 3), atol=1e-12)
            np.testing.assert_allclose(ours[1][..., row], position, atol=1e-12)


def crowd(seed, kinds, extra=""):
    """A crowd of free and jointed bodies with random geoms among fixed ones, filters of every kind on."""
    rng = np.random.default_rng(seed)

    def geom(i):
        kind = kinds[i % len(kinds)]
        size = " ".join(f"{s:.3f}" for s in rng.uniform(0.05, 0.2, 3))
        place = " ".join(f"{x:.3f}" for x in rng.uniform(-0.1, 0.1, 3))
        quat = " ".join(f"{x:.3f}" for x in rng.normal(size=4))
        types = f'contype="{rng.choice([1, 2, 3])}" conaffinity="{rng.choice([1, 2, 3])}"'
        return f'<geom type="{kind}" size="{size}" pos="{place}" quat="{quat}" margin="0.02" {types}/>'

    bodies = []
    for i in range(6):
        pos = " ".join(f"{x:.3f}" for x in rng.uniform(-1, 1, 3))
        welded = f'<body name="w{i}" pos="0.5 0 0">{geom(i)}</body>'
        child = f'<body name="c{i}" pos="0.7 0 0"><joint axis="0 1 1"/>{geom(i + 1)}{welded}</body>'
        bodies.append(f'<body name="b{i}" pos="{pos}"><freejoint/>{geom(i)}{child}</body>')
    fixed = "".join(geom(i) for i in range(3)) + f'<body name="shelf" pos="0 0.5 0">{geom(1)}</body>'
    hinged = f'<body name="door" pos="0.5 0.5 0"><joint axis="0 0 1"/>{geom(2)}</body>'
    return f"""<mujoco><worldbody>{fixed}{hinged}{"".join(bodies)}</worldbody>
      <contact><exclude body1="b0" body2="c1"/><exclude body1="w2" body2="b3"/></contact>{extra}</mujoco>"""


def axis_to_box(model, data, capsule, box):
    """Distance of a capsule's axis from a box: it is convex along the axis, so halving an interval finds it."""
    frame = data.geom_xmat[box].reshape(3, 3)
    centre = frame.T @ (data.geom_xpos[capsule] - data.geom_xpos[box])
    axis = frame.T @ data.geom_xmat[capsule].reshape(3, 3)[:, 2] * model.geom_size[capsule, 1]

    def distance(s):
        return np.linalg.norm(np.maximum(np.abs(centre + s * axis) - model.geom_size[box], 0.0))

    low, high = -1.0, 1.0
    for _ in range(40):
        third = (high - low) / 3.0
        low, high = (low + third, high) if distance(low + third) > distance(high - third) else (low, high - third)
    return distance(0.5 * (low + high))


def deepest(model, data, pairs):
    """Depth that C MuJoCo reports; a capsule whose axis meets a box is at least its radius deep."""
    depth = max(0.0, -data.contact.dist.min()) if data.ncon else 0.0
    kinds = (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX)
    for a, b in pairs:
        capsule, box = (a, b) if model.geom_type[a] == kinds[0] else (b, a)
        if (model.geom_type[capsule], model.geom_type[box]) == kinds and model.geom_size[capsule, 0] > depth:
            away = np.linalg.norm(data.geom_xpos[a] - data.geom_xpos[b])
            if away < model.geom_rbound[a] + model.geom_rbound[b] and axis_to_box(model, data, capsule, box) < 1e-7:
                depth = model.geom_size[capsule, 0]
    return depth


@pytest.mark.parametrize(
    ("kinds", "extra"),
    [
        (("sphere", "capsule", "box"), ""),
        (("box", "capsule"), '<option><flag filterparent="disable"/></option>'),
        (("ellipsoid", "cylinder", "box"), ""),
        (("plane", "sphere"), ""),
    ],
)
def test_penetration_is_that_of_c_mujoco_and_of_pierced_boxes(kinds, extra):
    xml = crowd(3, kinds, extra)
    if "plane" in kinds:  # planes may stand on fixed bodies only
        xml = """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
          <body pos="0 0 0.2"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    bare = mujoco.MjModel.from_xml_string(xml)
    bare.geom_margin[:] = 0.0  # MuJoCo's box and convex routines may answer differently where a margin is set
    data = mujoco.MjData(bare)
    rng = np.random.default_rng(1)
    count = 1500
    qpos = np.tile(model.qpos0, (count, 1)) + rng.normal(scale=0.8, size=(count, model.nq)) * rng.random((count, 1))
    for joint in range(model.njnt):
        if model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_FREE):
            quat = slice(model.jnt_qposadr[joint] + 3, model.jnt_qposadr[joint] + 7)
            qpos[:, quat] /= np.linalg.norm(qpos[:, quat], axis=1, keepdims=True)
    expected = np.zeros(count)
    pairs = {tuple(pair) for pair in live_pairs(model).tolist()}
    for row, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_kinematics(bare, data)
        mujoco.mj_collision(bare, data)
        expected[row] = deepest(bare, data, pairs)
        if data.ncon:
            assert {tuple(sorted(pair)) for pair in data.contact.geom.tolist()} <= pairs
    result = Auditor(model, [], [], [], ["now"]).check(qpos[:, None])
    assert 0.02 < (expected > 0).mean() < 0.99
    np.testing.assert_array_equal(result.violation[:, 0], expected)
    scene = load_verify().Scene(xml)
    assert {tuple(sorted(pair)) for pair in scene.capsule_box.tolist()} <= pairs
    np.testing.assert_array_equal(scene.evaluate(qpos[:400], [])[1], expected[:400])


THIN = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 0.1" pos="0 0 -5" contype="{plane}" conaffinity="{plane}"/>
    <geom name="wall" type="box" size="0.005 0.6 0.6"/>
    <body name="link" pos="1 0 0"><freejoint/><geom name="link" type="capsule" size="0.03 0.25"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("plane", [0, 1])
@pytest.mark.parametrize("count", [1, 60, 500])
def test_a_capsule_through_a_thin_wall_is_found(plane, count):
    """Of one configuration, of few, of many; where something may be proved apart, and where a plane forbids it."""
    model = mujoco.MjModel.from_xml_string(THIN.format(plane=plane))
    rng = np.random.default_rng(count)
    qpos = np.zeros((count, 7))
    # Near the wall's middle, the axis within 30 degrees of its normal, off along it: some pierce, some end before it.
    qpos[:, :3] = rng.uniform([-0.5, -0.3, -0.3], [0.5, 0.3, 0.3], (count, 3))
    qpos[0, 0] = 0.02
    lean, turn = rng.uniform(0, np.pi / 6, count), rng.uniform(0, 2 * np.pi, count)
    x, side = np.array([1.0, 0, 0]), np.stack([np.zeros(count), np.cos(turn), np.sin(turn)], axis=1)
    axis = np.cos(lean)[:, None] * x + np.sin(lean)[:, None] * side
    qpos[:, 3] = 1.0 + axis[:, 2]  # the rotation that takes z to the axis
    qpos[:, 4:] = np.cross([0.0, 0, 1], axis)
    qpos[:, 3:] /= np.linalg.norm(qpos[:, 3:], axis=1, keepdims=True)
    reach = 0.25 * axis[:, 0]
    pierced = np.abs(qpos[:, 0]) < reach + 0.005
    apart = np.abs(qpos[:, 0]) > reach + 0.005 + 0.03
    depth = Auditor(model, [], [], [], ["now"]).check(qpos[:, None]).violation[:, 0]
    assert (depth[pierced] >= 0.03).all() and (depth[apart] == 0).all() and pierced[0]
    np.testing.assert_array_equal(load_verify().Scene(THIN.format(plane=plane)).evaluate(qpos, [])[1], depth)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos[0]
    mujoco.mj_forward(model, data)
    assert not data.ncon, "MuJoCo finds it by itself now: the test of pierced boxes can go"


def test_most_free_configurations_are_proved_free():
    """The proofs carry the speed: where they rarely succeed, C MuJoCo would be asked for nearly everything."""
    model = mujoco.MjModel.from_xml_string(crowd(3, ("sphere", "capsule", "box")))
    rng = np.random.default_rng(2)
    qpos = np.tile(model.qpos0, (800, 1))
    for joint in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
        address = model.jnt_qposadr[joint]
        qpos[:, address : address + 3] = rng.uniform(-2, 2, (800, 3))
    checker = Auditor(model, [], [], [], ["now"])
    free = checker.check(qpos[:, None]).violation[:, 0] == 0
    links = checker._kinematics.frames(qpos.T.copy())
    scratch = checker._contacts.scratch(800)
    checker._contacts._fill(links, scratch, 800)
    _, _, lanes = checker._contacts.unproved(scratch, 800)
    assert free.sum() > 100
    assert np.isin(np.flatnonzero(free), lanes).mean() < 0.1


def test_disabled_contacts_and_margins_do_not_hide_or_add_anything():
    flags = '<option><flag contact="disable" constraint="disable"/></option>'
    xml = gantry.MJCF.replace("<worldbody>", flags + '<default><geom margin="0.5"/></default><worldbody>')
    model = mujoco.MjModel.from_xml_string(xml)
    qpos, t, _ = gantry.valid(3)
    qpos[1], _, _ = gantry.faults()["palm in the box"]
    result = Auditor(model, [], [], [], SWITCHES).check(qpos)
    assert result.ok.tolist() == [True, False, True]


def test_valid_samples_pass():
    qpos, t, p = gantry.valid(3000)
    placement = {**gantry.PLACEMENT, "variable": "p"}
    result = auditor(placements=[placement]).check(qpos, {"t": t, "p": p})
    assert result.ok.all()
    assert result.violation.max() < 1e-9
    assert result.violation.shape == (3000, len(result.constraints))
    assert len(result.tolerance) == len(result.constraints)


@pytest.mark.parametrize("name", gantry.faults())
def test_every_fault_is_caught_by_the_column_that_names_it(name):
    broken, t_broken, check = gantry.faults()[name]
    qpos, t, _ = gantry.valid(4)
    qpos[2], t[2] = broken, t_broken
    result = auditor().check(qpos, {"t": t})
    assert result.ok.tolist() == [True, True, False, True]
    failing = result.violation[2] > result.tolerance
    if check == "finite numbers":
        assert np.isinf(result.violation[2]).all()
    else:
        assert any(check in column for column, bad in zip(result.constraints, failing, strict=True) if bad)


def test_goal_parts_and_declared_orientation():
    pick = [*gantry.START[:2], 0.2, 0.0, 0.0]
    at_goal = gantry.sample(pick, [0.6, 0.2, 0.2, 0.0, 0.0])[0]
    turned = gantry.sample(pick, [0.6, 0.2, 0.2, 2e-3, 0.0])[0]
    beside = gantry.sample(pick, [0.598, 0.2, 0.2, 0.0, 0.0])[0]
    qpos = np.array([at_goal, turned, beside])
    both, only_position = gantry.GOAL, {**gantry.GOAL, "rotation": False}
    assert auditor(goals=[both]).check(qpos).ok.tolist() == [True, False, False]
    assert auditor(goals=[only_position]).check(qpos).ok.tolist() == [True, True, False]
    declared = {**gantry.PLACEMENT, "quat": [-2.0, 0, 0, 0]}  # neither sign nor length matters
    result = auditor(placements=[declared]).check(qpos)
    assert result.ok.tolist() == [True, False, True]
    column = next(i for i, name in enumerate(result.constraints) if "placement rotation" in name)
    assert result.violation[1, column] == pytest.approx(2e-3, rel=1e-9)


def test_two_finger_grasp():
    qpos, t, _ = gantry.valid(5)
    assert auditor(gantry.TWO_FINGER).check(qpos).ok.all()
    leaning, _, _ = gantry.faults()["gripper leaning on the site"]
    result = auditor(gantry.TWO_FINGER).check(leaning[None])
    column = next(i for i, name in enumerate(result.constraints) if "grasp rotation" in name)
    assert result.violation[0, column] == pytest.approx(np.sin(3e-4) * np.cos(0.3), rel=1e-6)  # the pick's yaw is 0.3
    narrow = {**gantry.TWO_FINGER, "low": [0, 0, 0.11], "high": [0, 0, 0.12]}
    result = auditor(narrow).check(qpos)
    column = next(i for i, name in enumerate(result.constraints) if "grasp position" in name)
    np.testing.assert_allclose(result.violation[:, column], 0.01, atol=1e-12)


def test_tolerances_decide():
    broken, _, _ = gantry.faults()["box slipped in the gripper"]
    assert not auditor().check(broken[None]).ok[0]
    assert auditor(tolerances=Tolerances(position=1e-3)).check(broken[None]).ok[0]


def shaken(count):
    """Valid samples and every fault, each shaken by amounts around the tolerances."""
    qpos, t, _ = gantry.valid(count)
    for row, (broken, t_broken, _) in enumerate(gantry.faults().values()):
        qpos[row], t[row] = broken, t_broken
    rng = np.random.default_rng(7)
    size = 10.0 ** rng.uniform(-6.5, -3, (count, 1, 1))
    qpos += size * rng.normal(size=qpos.shape) * (rng.random(qpos.shape) < 0.3)
    quat = qpos[:, :, 8:]
    keep = rng.random((count, 1, 1)) < 0.9
    quat /= np.where(keep, np.linalg.norm(quat, axis=2, keepdims=True), 1.0)
    return qpos, t


@pytest.mark.parametrize("grasp", [gantry.TOUCH, gantry.TWO_FINGER])
def test_agrees_with_the_stand_alone_check(grasp, tmp_path):
    verify = load_verify()
    qpos, t = shaken(1200)
    goals = [{**gantry.GOAL, "at": "pick"}] if grasp is gantry.TWO_FINGER else []
    samples = gantry.sample_set(qpos, t, grasp, goals=goals)
    data = verify.read(str(samples.save(tmp_path)))
    verification = verify.Verification(data, None)
    verification.run()
    result = auditor(grasp, goals=goals).check(qpos, {"t": t})
    finite = np.isfinite(qpos).all(axis=(1, 2))
    worst_ok = np.ones(len(qpos), dtype=bool)
    for line, errors in verification.errors.items():
        worst_ok &= errors <= verify.ALLOWED[line]
        columns = [i for i, name in enumerate(result.constraints) if name.startswith(line.split(" (")[0])]
        if columns:
            ours = result.violation[finite][:, columns].max(axis=1)
            np.testing.assert_allclose(ours, errors[finite], atol=1e-9, err_msg=line)
        else:
            # Where the audit is asked, configurations are made of the variables (tests/test_keyframes.py).
            assert line in ("finite numbers", "configurations (rad or m)")
    np.testing.assert_array_equal(result.ok, worst_ok)
    if not goals:
        assert 0.05 < result.ok.mean() < 0.95


def test_threads_may_share_one_auditor():
    qpos, t = shaken(3000)
    checker = auditor()
    expected = checker.check(qpos, {"t": t})
    outcomes = [None] * 4

    def work(i):
        outcomes[i] = checker.check(qpos, {"t": t})

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for outcome in outcomes:
        np.testing.assert_array_equal(outcome.violation, expected.violation)
    few = checker.check(qpos[1500:1507], {"t": t[1500:1507]})
    np.testing.assert_allclose(few.violation, expected.violation[1500:1507], atol=1e-12)


def test_no_samples_and_wrong_input():
    assert auditor().check(np.zeros((0, 2, 12))).ok.shape == (0,)
    with pytest.raises(InputError, match=r"shape \(3, 12\), expected \(N, 2, 12\)"):
        auditor().check(np.zeros((3, 12)))
    with pytest.raises(InputError, match=r"'t' has shape \(1, 6\), expected \(1, 7\)"):
        auditor().check(np.zeros((1, 2, 12)), {"t": np.zeros((1, 6))})
    with pytest.raises(InputError, match="unknown body or site 'claw', available: .*pinch"):
        Auditor(auditor()._contacts.model, [{**gantry.attachments()[1], "frame": "claw"}], [], [], SWITCHES)
    with pytest.raises(InputError, match="unknown mode switch 'drop', available: pick, place"):
        auditor(placements=[{**gantry.PLACEMENT, "at": "drop"}])
    with pytest.raises(InputError, match="unknown grasp kind 'suction'"):
        auditor({"kind": "suction"})
