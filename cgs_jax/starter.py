"""A first scene around a robot: a table, a box, a goal, and the task file that picks the box and places it.

What is written is text that people go on editing: an MJCF of spheres, capsules and boxes without files beside it, and a
task file in the format of `scenes/README.md`. Metres and radians; the table's top is level with the robot's base.
"""

from __future__ import annotations

import dataclasses
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from cgs_jax import render
from cgs_jax.errors import InputError
from cgs_jax.fitting import Appearance, FittedRobot, Frame, Primitive

Floats = NDArray[np.float64]
Grasp = Literal["two_finger", "touch"]

TRIES = 2000
"""Random configurations that are looked at, for self-collisions and for where the arm reaches the table."""

ALWAYS = 0.95
"""Links that overlap in this share of random configurations are taken to overlap always."""

CLEARANCE = 0.001
"""Metres between what rests or touches, so that samples within their tolerance are not in contact."""

WIDEST = 0.12
"""Metres up to which a finger is looked for on each side of the tool."""

POSE_JOINTS = 6
"""Joints from which on an arm reaches full poses, so that the box can have one as its goal."""

PLACE_SPREAD = 0.04
"""Metres along x and y around the goal at which an arm of fewer joints may put the box."""

OURS = ("table", "box")
"""Names of the scene's own bodies and joints."""

QUARTER_TURN = Frame(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))


@dataclasses.dataclass(frozen=True)
class Overlap:
    """Two bodies that are excluded from contact, and why."""

    first: str
    second: str
    joints: int | None
    """Joints between them; None where one is the table."""
    depth: float
    """Metres that they overlap at home; 0 where they do not."""
    share: float
    """Of random configurations in which they overlap."""

    @property
    def reason(self) -> str:
        apart = "table" if self.joints is None else f"{self.joints} joint{'s' * (self.joints != 1)} apart"
        where = f"overlap by {1000 * self.depth:.0f} mm at home" if self.depth > 0 else "do not overlap at home"
        return f"{apart}: the primitives {where}, and in {100 * self.share:.0f} % of random configurations"


@dataclasses.dataclass(frozen=True)
class Starter:
    """The two texts, and what was decided while writing them."""

    mjcf: str
    task: str
    grasp: Grasp
    box: tuple[float, float, float]
    """Half lengths of the box (m)."""
    overlaps: tuple[Overlap, ...]
    free: float
    """Share of random configurations without a collision of the arm with itself or the table."""
    busiest: tuple[Overlap, ...]
    """Pairs that are checked and overlap most often in random configurations, the first one most."""
    notes: tuple[str, ...]


def start_scene(robot: FittedRobot, name: str, grasp: Grasp | None = None) -> Starter:
    """Texts of a scene of that name. grasp: None takes two_finger where the tool is between fingers, else touch.

    Raises InputError when two fingers are asked for and none are found, or when random configurations do not reach the table.
    """
    notes: list[str] = []
    robot = _without_our_names(robot)
    near = robot.at_tool()
    gap = finger_gap(near)
    if gap is None:
        # The file may have the closing axis along x.
        turned = dataclasses.replace(robot, tool=robot.tool.then(QUARTER_TURN))
        gap = finger_gap(turned.at_tool())
        if gap is not None:
            robot, near = turned, turned.at_tool()
            notes.append("fingers close along the tool's x axis: the tool is turned so that this is y")
    if grasp == "two_finger" and gap is None:
        raise InputError(
            "no two fingers found on both sides of the tool along its x or y axis; check the tool, its approach and the home "
            "values of the finger joints (open), or take the touch grasp"
        )
    chosen: Grasp = grasp or ("touch" if gap is None else "two_finger")
    if gap is None and grasp is None:
        notes.append("nothing on both sides of the tool: touch grasp (fingers that are closed at home are opened with --home)")
    if chosen == "touch":
        # Everything that is fixed to the tool must end behind it, or each touch would be a collision.
        front = max((p.reach(np.array([0.0, 0.0, 1.0])) for p in near), default=-1.0) + CLEARANCE
        if front > 0:
            moved = robot.tool.then(Frame(np.eye(3), np.array([0.0, 0.0, front])))
            robot = dataclasses.replace(robot, tool=moved)
            notes.append(f"the tool is moved {1000 * front:.0f} mm along the approach, 1 mm in front of all primitives there")
        box = (0.03, 0.03, 0.04)
    else:
        assert gap is not None
        # A gripper may get narrower towards the palm: a box a little narrower than the gap is then held deeper.
        widths = [width for width in (gap - 1.5 * CLEARANCE) * np.array([1.0, 0.85, 0.7, 0.55]) if width > 0]
        depths = [palm_depth(near, width) for width in widths]
        chosen_width = next((i for i, depth in enumerate(depths) if depth >= 0.03), int(np.argmax(depths)))
        width, depth = widths[chosen_width], depths[chosen_width]
        box = (round(min(width, 0.04), 4), round(float(np.clip(depth - 0.005, 0.015, 0.025)), 4), 0.06)
        notes.append(f"fingers: {2000 * gap:.0f} mm apart, {1000 * depth:.0f} mm deep for a box {2000 * box[0]:.0f} mm wide")
    table = base_height(robot)
    plain = robot_mjcf(robot, name, table)
    overlaps, free, busiest, reached = explore(robot, plain, table)
    overlaps = tuple(o for o in overlaps if (o.first, o.second) not in robot.excludes)
    centre, radius, front_angle = _reachable(robot, reached, table)
    places = []
    for turn in (-0.6, 0.6):
        angle = front_angle + turn
        x, y = centre + radius * np.array([math.cos(angle), math.sin(angle)])
        places.append((x, y, table + box[2] + CLEARANCE))
    mjcf = robot_mjcf(robot, name, table, overlaps, box, (places[0], places[1]), chosen)
    if len(robot.joints) < POSE_JOINTS:
        notes.append(f"{len(robot.joints)} joints reach few full poses: it puts the box near the goal, turned as it comes")
    task = _task_text(robot, name, chosen, box, places[1])
    return Starter(mjcf, task, chosen, box, overlaps, free, busiest, tuple(notes))


def _without_our_names(robot: FittedRobot) -> FittedRobot:
    """The robot with links and joints renamed where the scene around it needs the name."""
    links = []
    for link in robot.links:
        joints = tuple(dataclasses.replace(j, name=f"robot_{j.name}") if j.name in OURS else j for j in link.joints)
        links.append(dataclasses.replace(link, name=f"robot_{link.name}" if link.name in OURS else link.name, joints=joints))
    return dataclasses.replace(robot, links=tuple(links))


# ---------------------------------------------------------------------------------------------------------------------
# What the gripper leaves room for


def _blocked(primitives: Sequence[Primitive], points: Floats) -> NDArray[np.bool_]:
    inside = np.zeros(len(points), bool)
    for primitive in primitives:
        inside |= primitive.contains(points)
    return inside


def finger_gap(primitives: Sequence[Primitive]) -> float | None:
    """Free half width in metres around the tool along its closing axis y; None without something on both sides.

    primitives: in the tool's frame.
    """
    steps = np.arange(0.0, WIDEST, 0.0005)
    patch = np.array([(x, 0.0, z) for x in (-0.006, 0.0, 0.006) for z in (-0.006, 0.0, 0.006)])
    free = []
    for side in (-1.0, 1.0):
        points = patch[:, None] + steps[None, :, None] * np.array([0.0, side, 0.0])
        hit = _blocked(primitives, points.reshape(-1, 3)).reshape(len(patch), -1).any(axis=0)
        if not hit.any():
            return None
        free.append(float(steps[np.argmax(hit)]))
    return min(free) if min(free) > 0.004 else None


def palm_depth(primitives: Sequence[Primitive], width: float) -> float:
    """Free depth in metres behind the tool for something of that half width between the fingers (at most 0.15)."""
    depths = np.arange(0.0, 0.15, 0.0005)
    patch = np.array([(x, y, 0.0) for x in (-0.015, 0.0, 0.015) for y in np.linspace(-1, 1, 5) * width])
    points = patch[:, None] - depths[None, :, None] * np.array([0.0, 0.0, 1.0])
    hit = _blocked(primitives, points.reshape(-1, 3)).reshape(len(patch), -1).any(axis=0)
    return float(depths[np.argmax(hit)]) if hit.any() else 0.15


# ---------------------------------------------------------------------------------------------------------------------
# What random configurations show


def base_height(robot: FittedRobot) -> float:
    """Height of the body that carries the first joint's link: where the table's top goes."""
    first = next(i for i, link in enumerate(robot.links) if link.joints)
    frame = Frame(np.eye(3), np.zeros(3))
    for index in reversed(robot.ancestors(first)[1:]):
        frame = frame.then(robot.links[index].frame)
    return round(float(frame.position[2]), 4)


def explore(
    robot: FittedRobot, mjcf: str, table: float
) -> tuple[tuple[Overlap, ...], float, tuple[Overlap, ...], Floats]:
    """Looks at home and at random configurations.

    Returns the pairs to exclude, the share of configurations without a collision of all other pairs, those of the other pairs
    that overlap most often, and the free ones' tool poses (M, 4): position and z component of the approach.
    """
    try:
        model = mujoco.MjModel.from_xml_string(mjcf)
    except ValueError as error:
        raise InputError(f"the robot's links give no model: {' '.join(str(error).split())}") from None
    data = mujoco.MjData(model)
    names = [model.body(i).name for i in range(model.nbody)]

    def overlapping() -> dict[tuple[int, int], float]:
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        found: dict[tuple[int, int], float] = {}
        for (a, b), distance in zip(data.contact.geom[: data.ncon], data.contact.dist[: data.ncon], strict=True):
            if distance < 0:
                bodies = sorted((int(model.geom_bodyid[a]), int(model.geom_bodyid[b])))
                pair = bodies[0], bodies[1]
                found[pair] = max(found.get(pair, 0.0), -float(distance))
        return found

    data.qpos[:] = [joint.home for joint in robot.joints]
    home = overlapping()
    low, high = np.array([(joint.low, joint.high) for joint in robot.joints]).T
    rng = np.random.default_rng(0)
    counts: dict[tuple[int, int], int] = {}
    tries, poses = [], []
    site = model.site("tool").id
    for _ in range(TRIES):
        data.qpos[:] = rng.uniform(low, high)
        found = overlapping()
        for pair in found:
            counts[pair] = counts.get(pair, 0) + 1
        tries.append(set(found))
        poses.append([*data.site_xpos[site], data.site_xmat[site][8]])

    def overlap(pair: tuple[int, int]) -> Overlap:
        first, second = names[pair[0]], names[pair[1]]
        return Overlap(first, second, _joints_between(robot, first, second), home.get(pair, 0.0), counts.get(pair, 0) / TRIES)

    excluded = {pair for pair in {*home, *counts} if pair in home or counts.get(pair, 0) >= ALWAYS * TRIES}
    free = [not found - excluded for found in tries]
    busiest = sorted(counts.keys() - excluded, key=lambda pair: -counts[pair])
    return (
        tuple(overlap(pair) for pair in sorted(excluded)),
        float(np.mean(free)),
        tuple(overlap(pair) for pair in busiest[:3]),
        np.array(poses)[free].reshape(-1, 4),
    )


def _joints_between(robot: FittedRobot, first: str, second: str) -> int | None:
    names = [link.name for link in robot.links]
    if first not in names or second not in names:
        return None
    above = [set(robot.ancestors(names.index(name))) for name in (first, second)]
    return sum(len(robot.links[i].joints) for i in above[0] ^ above[1])


def _reachable(robot: FittedRobot, poses: Floats, table: float) -> tuple[Floats, float, float]:
    """Centre (2,), radius and direction of an arc on the table that the tool reaches, approaching from above if it can."""
    base = Frame(np.eye(3), np.zeros(3))
    for index in reversed(robot.ancestors(robot.tool_link)):
        base = base.then(robot.links[index].frame)
        if robot.links[index].joints:
            break
    centre = base.position[:2]
    height = poses[:, 2] - table
    low = (height > 0.02) & (height < 0.35)
    down = low & (poses[:, 3] < -0.5)
    chosen = poses[down] if down.sum() >= 20 else poses[low]
    if len(chosen) < 5:
        raise InputError(
            f"only {len(chosen)} of {TRIES} random configurations bring the tool near the table without a collision; check the "
            "tool, its approach, the joints' ranges and which geoms are fitted"
        )
    distances = np.linalg.norm(chosen[:, :2] - centre, axis=1)
    radius = float(np.quantile(distances, 0.6))
    model = mujoco.MjModel.from_xml_string(robot_mjcf(robot, "robot", table))
    data = mujoco.MjData(model)
    data.qpos[:] = [joint.home for joint in robot.joints]
    mujoco.mj_kinematics(model, data)
    ahead = data.site("tool").xpos[:2] - centre
    angle = math.atan2(ahead[1], ahead[0]) if np.linalg.norm(ahead) > 0.1 else 0.0
    return centre, radius, angle


# ---------------------------------------------------------------------------------------------------------------------
# The texts


def _numbers(values: Sequence[float] | Floats) -> str:
    return " ".join(f"{0.0 if abs(v) < 5e-7 else float(v):.6g}" for v in values)


def _unit_quat(frame: Frame) -> str:
    return " ".join(f"{0.0 if abs(v) < 1e-10 else float(v):.10g}" for v in frame.quat)


def _place(frame: Frame) -> dict[str, str]:
    place = {}
    if np.any(np.abs(frame.position) > 5e-7):
        place["pos"] = _numbers(frame.position)
    if np.any(np.abs(frame.rotation - np.eye(3)) > 1e-9):
        place["quat"] = _unit_quat(frame)
    return place


def robot_mjcf(
    robot: FittedRobot,
    name: str,
    table: float,
    overlaps: Sequence[Overlap] = (),
    box: tuple[float, float, float] | None = None,
    places: tuple[Sequence[float], Sequence[float]] | None = None,
    grasp: Grasp = "touch",
    looks: bool = False,
) -> str:
    """The MJCF text of a robot at a table; with a box, also the box and its goal at those two positions.

    looks: instead of the table, the geoms of the robot's own file, in group 1 and without collisions.
    """
    root = ElementTree.Element("mujoco", model=name)
    root.append(ElementTree.Comment(f" {robot.name}, fitted primitives; joints that are not listed are fixed at home. "))
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    ElementTree.SubElement(root, "statistic", center="0 0 .4", extent="1.5")
    visual = ElementTree.SubElement(root, "visual")
    ElementTree.SubElement(visual, "headlight", ambient=".4 .4 .4", diffuse=".6 .6 .6", specular=".1 .1 .1")
    asset = ElementTree.SubElement(root, "asset")
    sky = {"name": "sky", "type": "skybox", "builtin": "gradient", "width": "64", "height": "384"}
    ElementTree.SubElement(asset, "texture", sky | {"rgb1": ".85 .90 .95", "rgb2": ".60 .68 .78"})
    world = ElementTree.SubElement(root, "worldbody")
    if not looks:
        reach = 2.0
        body = ElementTree.SubElement(world, "body", name="table", pos=_numbers([0, 0, table - 0.1]))
        size = _numbers([reach, reach, 0.1])
        ElementTree.SubElement(body, "geom", name="table", type="box", size=size, rgba=".62 .60 .56 1")
    elements: list[ElementTree.Element] = []
    for index, link in enumerate(robot.links):
        parent = world if link.parent < 0 else elements[link.parent]
        element = ElementTree.SubElement(parent, "body", {"name": link.name} | _place(link.frame))
        elements.append(element)
        for joint in link.joints:
            attributes = {"name": joint.name, "type": "slide"} if joint.slide else {"name": joint.name}
            attributes |= {"axis": _unit_axis(joint.axis), "range": _numbers([joint.low, joint.high])}
            if np.any(joint.position):
                attributes["pos"] = _numbers(joint.position)
            if joint.reference:
                attributes["ref"] = _numbers([joint.reference])
            ElementTree.SubElement(element, "joint", attributes)
        for i, primitive in enumerate(link.primitives):
            geom = {"name": f"{link.name}_{i}", "type": primitive.kind, "size": _numbers(primitive.size)}
            geom |= _place(primitive.frame) | {"rgba": _numbers(primitive.rgba)}
            ElementTree.SubElement(element, "geom", geom)
        for i, look in enumerate(link.looks if looks else ()):
            _add_look(element, asset, f"{link.name}_{i}", look)
        if link.joints and not link.primitives:
            # MuJoCo wants a mass where a joint moves, though nothing here depends on it.
            ElementTree.SubElement(element, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
        if index == robot.tool_link:
            tool = {"name": "tool", "size": ".006", "rgba": ".9 .2 .2 1"}
            ElementTree.SubElement(element, "site", tool | _place(robot.tool))
    if box is not None and places is not None:
        _add_box(world, box, places, grasp)
    if robot.excludes or overlaps:
        contact = ElementTree.SubElement(root, "contact")
        for first, second in robot.excludes:
            contact.append(ElementTree.Comment(" excluded in the robot's own file "))
            ElementTree.SubElement(contact, "exclude", body1=first, body2=second)
        for overlap in overlaps:
            contact.append(ElementTree.Comment(f" {overlap.reason} "))
            ElementTree.SubElement(contact, "exclude", body1=overlap.first, body2=overlap.second)
    if box is not None and places is not None:
        keyframe = ElementTree.SubElement(root, "keyframe")
        keyframe.append(ElementTree.Comment(" the arm's joints, then the box "))
        qpos = _numbers([*(joint.home for joint in robot.joints), *places[0], 1, 0, 0, 0])
        ElementTree.SubElement(keyframe, "key", name="home", qpos=qpos)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def fit_picture(robot: FittedRobot, size: tuple[int, int] = (480, 480)) -> NDArray[np.uint8]:
    """Three views of the robot at home: as its file has it, with the primitives over it, and the primitives alone.

    Returns (H, W, 3). Raises InputError without OpenGL.
    """
    model = mujoco.MjModel.from_xml_string(robot_mjcf(robot, "fit", 0.0, looks=True))
    own = np.asarray(model.geom_group) == 1
    plain, both, fitted = (np.array(model.geom_rgba) for _ in range(3))
    plain[~own, 3] = 0
    both[~own] = (0.95, 0.45, 0.10, 0.40)
    fitted[own, 3] = 0
    views = {"as in the file": plain, "primitives over it": both, "primitives": fitted}
    return render.recoloured(model, np.array([joint.home for joint in robot.joints]), views, size)


def _unit_axis(axis: Floats) -> str:
    return " ".join(f"{0.0 if abs(v) < 1e-10 else float(v):.10g}" for v in axis)


def _add_box(
    world: ElementTree.Element, box: tuple[float, float, float], places: tuple[Sequence[float], Sequence[float]], grasp: Grasp
) -> None:
    goal = {"name": "goal", "type": "box", "size": _numbers(box), "pos": _numbers(places[1]), "rgba": ".85 .15 .15 .35"}
    ElementTree.SubElement(world, "site", goal)
    body = ElementTree.SubElement(world, "body", name="box", pos=_numbers(places[0]))
    ElementTree.SubElement(body, "freejoint", name="box")
    shape = {"name": "box", "type": "box", "size": _numbers(box), "density": "300", "rgba": ".20 .60 .30 1"}
    ElementTree.SubElement(body, "geom", shape)
    if grasp == "touch":
        x, y, z = box
        sides = {
            "top": ((0, 0, z), (1, 0, 0, 0)),
            "front": ((x, 0, 0), (math.sqrt(0.5), 0, math.sqrt(0.5), 0)),
            "back": ((-x, 0, 0), (math.sqrt(0.5), 0, -math.sqrt(0.5), 0)),
            "left": ((0, y, 0), (math.sqrt(0.5), -math.sqrt(0.5), 0, 0)),
            "right": ((0, -y, 0), (math.sqrt(0.5), math.sqrt(0.5), 0, 0)),
        }
        for side, (pos, quat) in sides.items():
            text = " ".join(f"{v:.10g}" for v in quat)
            ElementTree.SubElement(body, "site", name=f"box_{side}", size=".005", pos=_numbers(pos), quat=text)


def _add_look(element: ElementTree.Element, asset: ElementTree.Element, name: str, look: Appearance) -> None:
    kind = look.kind.name.removeprefix("mjGEOM_").lower()
    geom = {"type": kind, "contype": "0", "conaffinity": "0", "group": "1", "rgba": _numbers(look.rgba)}
    if look.vertices is None or look.faces is None:
        geom["size"] = _numbers(look.size)
    else:
        vertices, faces = look.vertices.ravel(), look.faces.ravel()
        mesh = {"name": name, "vertex": _numbers(vertices), "face": " ".join(map(str, faces)), "inertia": "shell"}
        ElementTree.SubElement(asset, "mesh", mesh)
        geom["mesh"] = name
    ElementTree.SubElement(element, "geom", geom | _place(look.frame))


def _task_text(
    robot: FittedRobot, name: str, grasp: Grasp, box: tuple[float, float, float], goal: Sequence[float]
) -> str:
    joints = ", ".join(f'"{joint.name}"' for joint in robot.joints)
    if grasp == "two_finger":
        slide = round(box[2] - 0.015, 4)
        comment = (
            "# The closing axis (y) of the tool is along the box's x axis: perpendicular to its y and z. The tool is\n"
            "# centred in x and y and may slide along z; the turn about the closing axis is free."
        )
        rows = "[[[0, 1, 0], [0, 1, 0], 0.0], [[0, 1, 0], [0, 0, 1], 0.0]]"
        text = f'{{ kind = "two_finger", rows = {rows}, low = [0, 0, {-slide}], high = [0, 0, {slide}] }}'
    else:
        comment = "# The tool's origin is on one of these sites of the box, its approach (z) points into it; the spin is free."
        sides = ", ".join(f'"box_{side}"' for side in ("top", "front", "back", "left", "right"))
        text = f'{{ kind = "touch", sites = [{sides}] }}'
    if len(robot.joints) < POSE_JOINTS:
        corners = []
        for part in (1.0, 0.5):
            spread = part * np.array([PLACE_SPREAD, PLACE_SPREAD, 0.0])
            corners += [", ".join(f"{v:.4f}" for v in np.array(goal) + sign * spread) for sign in (-1, 1)]
        where = f"""# An arm of fewer than six joints reaches few full poses: it puts the box near the goal, turned as it comes.
[[placements]]
variable = "p"
object = "box"
at = "place"
low = [{corners[0]}]
high = [{corners[1]}]
upright = true

[sequences]
together = "(q1,q2,t,p)"
pick_first = "(q1,t); (q2,p)"

[[instances]]
title = "as written"

[[instances]]
title = "nearer to the goal"
placement.p = {{ low = [{corners[2]}], high = [{corners[3]}] }}
"""
    else:
        turned = ", ".join(f"{v:.4f}" for v in goal)
        where = f"""[[goals]]
object = "box"
site = "goal"
at = "place"
position = true
rotation = true

[sequences]
together = "(q1,q2,t)"
grasp_first = "t; q1; q2"

[[instances]]
title = "as written"

[[instances]]
title = "goal turned by 90 degrees"
site.goal = {{ pos = [{turned}], quat = [0.7071067812, 0, 0, 0.7071067812] }}
"""
    return f"""# A first task for this robot. All keys: scenes/README.md.
name = "{name}"
title = "{robot.name} picks a box and places it"
model = "{name}.xml"
home = "home"

[robots.arm]
joints = [{joints}]

[objects.box]
body = "box"

[[switches]]
name = "pick"
configurations = {{ arm = "q1" }}

[[switches]]
name = "place"
configurations = {{ arm = "q2" }}

[[holds]]
variable = "t"
robot = "arm"
frame = "tool"
object = "box"
from = "pick"
to = "place"
{comment}
grasp = {text}

{where}"""
