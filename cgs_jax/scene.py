"""Scenes: an MJCF model and a declarative task file, resolved to one instance.

A task file (TOML, format in `scenes/README.md`) names the robots, objects, mode switches, holds, placements and goals
of a sequential manipulation problem and lists its instances: edits of the MJCF and of the placements. `load_task` reads
and checks the text alone, `load_scene` applies one instance's edits, compiles the model and checks every name there.

Poses are [x y z qw qx qy qz] in metres, frames named as T_world_object. Everything that is wrong in the input raises
`InputError` with one line that says what, what was expected and what is available.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import math
import re
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from cgs_jax.errors import InputError

if TYPE_CHECKING:
    from mujoco import mjx

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
PoseSource = tuple[Literal["start"]] | tuple[Literal["goal", "variable", "held"], str]

COLLISION_GEOMS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
}
"""Geom types that may collide, and their MJCF names."""

MOVING_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
"""Joint types that a robot's configuration may consist of."""

EDITABLE = {"body": ("pos", "quat"), "geom": ("pos", "quat", "size"), "site": ("pos", "quat")}
"""What an instance may change in the MJCF, by kind of element."""

IMPORT = "python scripts/import_robot.py"
"""The command that makes a scene of primitives from a robot with other geoms."""


# ---------------------------------------------------------------------------------------------------------------------
# The task


@dataclasses.dataclass(frozen=True)
class Robot:
    """A robot: the joints that make up its configuration q, in order."""

    name: str
    joints: tuple[str, ...]
    base: str | None = None
    """Floating robots only: the body with a free joint that carries the chain."""
    support: str | None = None
    """Floating robots only: the site it stands on initially; its base then stands where the MJCF puts it."""


@dataclasses.dataclass(frozen=True)
class ObjectSpec:
    """A movable object: a body with a free joint."""

    name: str
    body: str


@dataclasses.dataclass(frozen=True)
class Switch:
    """A mode switch (paper, Section I): a snapshot of the scene at which contacts change."""

    name: str
    configurations: Mapping[str, str]
    """Robot name to configuration variable; robots not named stand at the home keyframe."""


@dataclasses.dataclass(frozen=True)
class TwoFingerGrasp:
    """A valid grasp with two fingers: rows of T_frame_object, and where the gripper sits on the object."""

    rows: tuple[tuple[Vector3, Vector3, float], ...]
    """(axis of the gripper site, axis of the object, their dot product), unit axes; one equality each."""
    low: Vector3
    high: Vector3
    """Bounds (m) of the gripper site's origin in the object's frame; low == high in a coordinate is an equality."""

    def as_json(self) -> dict[str, Any]:
        """The form of `attachments` in the sample file (schema cgs_jax/1)."""
        rows = [[list(gripper), list(held), dot] for gripper, held, dot in self.rows]
        return {"kind": "two_finger", "rows": rows, "low": list(self.low), "high": list(self.high)}


@dataclasses.dataclass(frozen=True)
class TouchGrasp:
    """A valid grasp by touch: the frame's origin on one of these sites of the object, z axes opposed."""

    sites: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """The form of `attachments` in the sample file (schema cgs_jax/1)."""
        return {"kind": "touch", "sites": list(self.sites)}


@dataclasses.dataclass(frozen=True)
class Hold:
    """Between two switches the object's pose t in `frame` is constant: T_world_frame * t = T_world_object."""

    variable: str
    robot: str
    frame: str
    """A site of the robot, z outwards (along the approach)."""
    object: str
    start: str
    """Switch at which it begins (`from` in the task file)."""
    end: str
    """Switch at which it ends (`to` in the task file)."""
    grasp: TwoFingerGrasp | TouchGrasp
    supports: bool = False
    """Floating robots only: the object stays in the world and the robot hangs on it by `frame`; its base follows."""


@dataclasses.dataclass(frozen=True)
class Placement:
    """At a switch the object is put down or handed over at the pose variable p, T_world_object."""

    variable: str
    object: str
    at: str
    low: Vector3
    high: Vector3
    """Bounds (m) of the position in the world; low == high in a coordinate is an equality."""
    quat: Quaternion | None
    """The full orientation (3 rows), unit length."""
    upright: bool
    """Only the object's z axis is up (2 rows). Without `quat` and `upright` the orientation is free."""


@dataclasses.dataclass(frozen=True)
class Goal:
    """At a switch the object's body frame coincides with a fixed site, in what is true."""

    object: str
    site: str
    at: str
    position: bool
    rotation: bool

    @property
    def full(self) -> bool:
        """Whether the goal fixes the whole pose."""
        return self.position and self.rotation


@dataclasses.dataclass(frozen=True)
class Instance:
    """Edits of the MJCF (kind -> name -> attribute -> values) and of placements (variable -> attribute -> value)."""

    title: str
    edits: Mapping[str, Mapping[str, Mapping[str, tuple[float, ...]]]]
    placements: Mapping[str, Mapping[str, Any]]


@dataclasses.dataclass(frozen=True)
class Task:
    """A task file: what is asked, apart from the geometry. Mode switches are in time order."""

    name: str
    title: str
    path: Path
    model_path: Path
    home: str
    """Keyframe at which robots that do not move stand."""
    robots: tuple[Robot, ...]
    objects: tuple[ObjectSpec, ...]
    switches: tuple[Switch, ...]
    holds: tuple[Hold, ...]
    placements: tuple[Placement, ...]
    goals: tuple[Goal, ...]
    sequences: Mapping[str, str]
    """Named sampling sequences, as text: "(q1,t); q2"."""
    instances: tuple[Instance, ...]

    def robot(self, name: str) -> Robot:
        """The robot of that name."""
        return next(robot for robot in self.robots if robot.name == name)

    def object(self, name: str) -> ObjectSpec:
        """The object of that name."""
        return next(spec for spec in self.objects if spec.name == name)

    def switch_index(self, name: str | None) -> int:
        """Position of a switch in time order; -1 for None, the initial configuration."""
        return -1 if name is None else next(i for i, switch in enumerate(self.switches) if switch.name == name)

    def span(self, hold: Hold) -> tuple[int, int]:
        """Positions of a hold's first and last switch in time order."""
        return self.switch_index(hold.start), self.switch_index(hold.end)

    def hold(self, variable: str) -> Hold:
        """The hold of that variable."""
        return next(hold for hold in self.holds if hold.variable == variable)

    def placement(self, variable: str) -> Placement:
        """The placement of that variable."""
        return next(placement for placement in self.placements if placement.variable == variable)

    @property
    def variables(self) -> tuple[str, ...]:
        """All variables by switch: its configurations, its placements, the holds that begin there."""
        names: list[str] = []
        for switch in self.switches:
            names += switch.configurations.values()
            names += [placement.variable for placement in self.placements if placement.at == switch.name]
            names += [hold.variable for hold in self.holds if hold.start == switch.name]
        return tuple(names)


# ---------------------------------------------------------------------------------------------------------------------
# Finding and reading task files


def scenes_folder() -> Path:
    """The folder of the scenes that come with the package: beside the package in a checkout, inside it when installed.

    Raises InputError when neither exists.
    """
    package = Path(__file__).resolve().parent
    for folder in (package.parent / "scenes", package / "scenes"):
        if any(folder.glob("*/*.toml")):
            return folder
    raise InputError(f"no scenes found, expected folders with a task file in {package.parent / 'scenes'}")


def available_scenes() -> tuple[str, ...]:
    """Names that `load_task` accepts besides paths."""
    return tuple(sorted(path.stem for path in scenes_folder().glob("*/*.toml") if path.stem == path.parent.name))


def load_task(name_or_path: str | Path) -> Task:
    """Read and check a task file.

    name_or_path: the name of a scene that comes with the package, or the path of a task file or of its folder.

    Raises InputError for a missing or unreadable file, broken TOML, unknown or missing keys, wrong types, and names
    that do not fit together. Names in the MJCF are checked by `load_scene`.
    """
    path = _find(name_or_path)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read task file {path}: {_one_line(error)}") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: broken TOML: {_one_line(error)}") from None
    return _read_task(path, document)


def _find(name_or_path: str | Path) -> Path:
    text = str(name_or_path)
    path = Path(text)
    looks_like_path = isinstance(name_or_path, Path) or path.suffix == ".toml" or "/" in text or "\\" in text
    if not looks_like_path:
        if text in available_scenes():
            return scenes_folder() / text / f"{text}.toml"
        known = _listed(available_scenes())
        raise InputError(f"unknown scene '{text}', expected a name or the path of a task file; available: {known}")
    if path.is_dir():
        path = path / f"{path.resolve().name}.toml"
    if not path.is_file():
        raise InputError(f"no task file at {path}; scenes available by name: {_listed(available_scenes())}")
    return path.resolve()


def _one_line(error: object) -> str:
    return " ".join(str(error).split())


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"


class _Table:
    """A TOML table under inspection: every read is typed, and `close` reports keys that nobody read."""

    def __init__(self, values: Any, where: str) -> None:
        if not isinstance(values, dict):
            raise InputError(f"{where}: expected a table, got {_shown(values)}")
        self.values: dict[str, Any] = values
        self.where = where
        self._asked: list[str] = []

    def fail(self, message: str) -> InputError:
        return InputError(f"{self.where}: {message}")

    def get(self, key: str, default: Any = None) -> Any:
        self._asked.append(key)
        return self.values.get(key, default)

    def require(self, key: str) -> Any:
        self._asked.append(key)
        if key not in self.values:
            raise self.fail(f"key '{key}' is missing; given: {_listed(self.values)}")
        return self.values[key]

    def text(self, key: str, default: str | None = None) -> str:
        value = self.require(key) if default is None else self.get(key, default)
        if not isinstance(value, str) or (not value and default is None):
            raise self.fail(f"'{key}' must be a non-empty text, got {_shown(value)}")
        return value

    def optional_text(self, key: str) -> str | None:
        return self.text(key) if key in self.values else self.get(key)

    def texts(self, key: str) -> tuple[str, ...]:
        value = self.require(key)
        if not isinstance(value, list) or not value or not all(isinstance(item, str) for item in value):
            raise self.fail(f"'{key}' must be a list of one or more texts, got {_shown(value)}")
        if len(set(value)) < len(value):
            raise self.fail(f"'{key}' names {_listed(sorted({n for n in value if value.count(n) > 1}))} more than once")
        return tuple(value)

    def flag(self, key: str) -> bool:
        value = self.get(key, False)
        if not isinstance(value, bool):
            raise self.fail(f"'{key}' must be true or false, got {_shown(value)}")
        return value

    def one_of(self, key: str, kind: str, available: Iterable[str]) -> str:
        """A text that must be a known name of that kind."""
        value, names = self.text(key), tuple(available)
        if value not in names:
            raise self.fail(f"'{key}' names unknown {kind} '{value}'; available: {_listed(names)}")
        return value

    def numbers(self, key: str, count: int | None) -> tuple[float, ...]:
        return _numbers(self.require(key), count, f"{self.where}: '{key}'")

    def vector(self, key: str) -> Vector3:
        x, y, z = self.numbers(key, 3)
        return x, y, z

    def tables(self, key: str, required: bool) -> list[_Table]:
        """A list of tables, such as [[holds]]."""
        value = self.require(key) if required else self.get(key, [])
        if not isinstance(value, list) or (required and not value):
            raise self.fail(f"'{key}' must be a list of one or more tables ([[{key}]]), got {_shown(value)}")
        return [_Table(item, f"{self.where}: {key}[{i}]") for i, item in enumerate(value)]

    def named_tables(self, key: str, required: bool) -> dict[str, _Table]:
        """Tables by name, such as [robots.a]."""
        value = self.require(key) if required else self.get(key, {})
        if not isinstance(value, dict) or (required and not value):
            raise self.fail(f"'{key}' must hold one or more tables ([{key}.NAME]), got {_shown(value)}")
        return {name: _Table(item, f"{self.where}: {key}.{name}") for name, item in value.items()}

    def close(self) -> None:
        unknown = [key for key in self.values if key not in self._asked]
        if unknown:
            raise self.fail(f"unknown key '{unknown[0]}'; allowed: {_listed(dict.fromkeys(self._asked))}")


def _shown(value: Any) -> str:
    text = _one_line(repr(value))
    return text if len(text) <= 60 else text[:57] + "..."


def _numbers(value: Any, count: int | None, where: str) -> tuple[float, ...]:
    good = isinstance(value, list) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    if not good or not value or (count is not None and len(value) != count):
        raise InputError(f"{where} must be a list of {count or 'one or more'} numbers, got {_shown(value)}")
    if not all(math.isfinite(v) for v in value):
        raise InputError(f"{where} must be finite, got {_shown(value)}")
    return tuple(float(v) for v in value)


def _unit(values: tuple[float, ...], where: str) -> tuple[float, ...]:
    norm = math.sqrt(sum(v * v for v in values))
    if norm < 1e-6:
        raise InputError(f"{where} has zero length, expected a unit vector or quaternion")
    return tuple(v / norm for v in values)


def _bounds(table: _Table) -> tuple[Vector3, Vector3]:
    low, high = table.vector("low"), table.vector("high")
    for axis, below, above in zip("xyz", low, high, strict=True):
        if below > above:
            raise table.fail(f"low {below:g} is above high {above:g} in {axis}; expected low <= high")
    return low, high


def _read_task(path: Path, document: dict[str, Any]) -> Task:
    top = _Table(document, path.name)
    model = top.text("model")
    model_path = path.parent / model
    if not model_path.is_file():
        beside = sorted(file.name for file in path.parent.glob("*.xml"))
        raise InputError(f"{path.name}: no model file '{model}' in {path.parent}; available: {_listed(beside)}")
    robots = tuple(_read_robot(name, table) for name, table in top.named_tables("robots", required=True).items())
    objects = []
    for name, table in top.named_tables("objects", required=True).items():
        objects.append(ObjectSpec(name, table.text("body")))
        table.close()
    switches = _read_switches(top, robots)
    order = [switch.name for switch in switches]
    names = [spec.name for spec in objects]
    holds = tuple(_read_hold(table, robots, names, order) for table in top.tables("holds", required=True))
    placements = tuple(_read_placement(table, names, order) for table in top.tables("placements", required=False))
    goals = tuple(_read_goal(table, names, order) for table in top.tables("goals", required=False))
    sequences_table = top.get("sequences", {})
    sequences = _Table(sequences_table, f"{path.name}: sequences")
    texts = {name: sequences.text(name) for name in sequences.values}
    instances = tuple(_read_instance(table, placements) for table in top.tables("instances", required=True))
    task = Task(
        name=top.text("name"),
        title=top.text("title", default=path.stem),
        path=path,
        model_path=model_path,
        home=top.text("home"),
        robots=robots,
        objects=tuple(objects),
        switches=switches,
        holds=holds,
        placements=placements,
        goals=goals,
        sequences=texts,
        instances=instances,
    )
    top.close()
    _check_task(task)
    return task


def _read_robot(name: str, table: _Table) -> Robot:
    robot = Robot(name, table.texts("joints"), table.optional_text("base"), table.optional_text("support"))
    table.close()
    if (robot.base is None) != (robot.support is None):
        raise table.fail("a floating robot needs both 'base' (its free body) and 'support' (the site it stands on)")
    return robot


def _read_switches(top: _Table, robots: tuple[Robot, ...]) -> tuple[Switch, ...]:
    switches: list[Switch] = []
    for table in top.tables("switches", required=True):
        name = table.text("name")
        if any(switch.name == name for switch in switches):
            raise table.fail(f"switch '{name}' is named twice")
        given = _Table(table.require("configurations"), f"{table.where} ({name}): configurations")
        available = [robot.name for robot in robots]
        for robot in given.values:
            if robot not in available:
                raise given.fail(f"unknown robot '{robot}'; available: {_listed(available)}")
        switches.append(Switch(name, {robot: given.text(robot) for robot in available if robot in given.values}))
        if not switches[-1].configurations:
            raise given.fail(f"at least one robot must have a configuration; available: {_listed(available)}")
        table.close()
    return tuple(switches)


def _read_grasp(table: _Table) -> TwoFingerGrasp | TouchGrasp:
    kind = table.one_of("kind", "kind of grasp", ("two_finger", "touch"))
    grasp: TwoFingerGrasp | TouchGrasp
    if kind == "touch":
        grasp = TouchGrasp(table.texts("sites"))
    else:
        rows = table.require("rows")
        if not isinstance(rows, list):
            raise table.fail(f"'rows' must be a list of [gripper axis, object axis, dot product], got {_shown(rows)}")
        if len(rows) > 3:
            raise table.fail(f"'rows' has {len(rows)} rows, expected at most 3: a rotation has three degrees of freedom")
        low, high = _bounds(table)
        checked = tuple(_read_row(row, f"{table.where}: rows[{i}]") for i, row in enumerate(rows))
        grasp = TwoFingerGrasp(checked, low, high)
    table.close()
    return grasp


def _read_row(row: Any, where: str) -> tuple[Vector3, Vector3, float]:
    if not isinstance(row, list) or len(row) != 3:
        raise InputError(f"{where} must be [gripper axis, object axis, dot product], got {_shown(row)}")
    axes = []
    for value, owner in ((row[0], "gripper"), (row[1], "object")):
        x, y, z = _unit(_numbers(value, 3, f"{where}: {owner} axis"), f"{where}: {owner} axis")
        axes.append((x, y, z))
    (dot,) = _numbers([row[2]], 1, f"{where}: dot product")
    if abs(dot) >= 1:
        # At +-1 the row has no gradient (the cosine is at its extremum) and fixes two freedoms, not one.
        raise InputError(f"{where}: dot product {dot:g} must lie strictly between -1 and 1; use two rows of 0 instead")
    return axes[0], axes[1], dot


def _read_hold(table: _Table, robots: tuple[Robot, ...], objects: list[str], order: list[str]) -> Hold:
    variable = table.text("variable")
    table.where += f" ({variable})"
    hold = Hold(
        variable=variable,
        robot=table.one_of("robot", "robot", [robot.name for robot in robots]),
        frame=table.text("frame"),
        object=table.one_of("object", "object", objects),
        start=table.one_of("from", "switch", order),
        end=table.one_of("to", "switch", order),
        grasp=_read_grasp(_Table(table.require("grasp"), f"{table.where}: grasp")),
        supports=table.flag("supports"),
    )
    table.close()
    if order.index(hold.start) >= order.index(hold.end):
        raise table.fail(f"'from' ({hold.start}) must come before 'to' ({hold.end}); order: {_listed(order)}")
    return hold


def _read_placement(table: _Table, objects: list[str], order: list[str]) -> Placement:
    variable = table.text("variable")
    table.where += f" ({variable})"
    target = table.one_of("object", "object", objects), table.one_of("at", "switch", order)
    placement = Placement(variable, *target, **_read_region(table))
    table.close()
    return placement


def _read_region(table: _Table) -> dict[str, Any]:
    """Bounds and orientation of a placement; checked together because an instance may replace any of them."""
    low, high = _bounds(table)
    upright = table.flag("upright")
    quat = None
    if table.get("quat") is not None:
        w, x, y, z = _unit(table.numbers("quat", 4), f"{table.where}: 'quat'")
        quat = (w, x, y, z)
    if upright and quat is not None:
        raise table.fail("'quat' (full orientation) and 'upright' (z axis only) exclude each other")
    return {"low": low, "high": high, "quat": quat, "upright": upright}


def _read_goal(table: _Table, objects: list[str], order: list[str]) -> Goal:
    goal = Goal(
        object=table.one_of("object", "object", objects),
        site=table.text("site"),
        at=table.one_of("at", "switch", order),
        position=table.flag("position"),
        rotation=table.flag("rotation"),
    )
    table.close()
    if not (goal.position or goal.rotation):
        raise table.fail("neither 'position' nor 'rotation' is true, so the goal asks for nothing")
    return goal


def _read_instance(table: _Table, placements: tuple[Placement, ...]) -> Instance:
    title = table.text("title", default="")
    edits: dict[str, dict[str, dict[str, tuple[float, ...]]]] = {}
    for kind, attributes in EDITABLE.items():
        for name, edit in table.named_tables(kind, required=False).items():
            values: dict[str, tuple[float, ...]] = {}
            for attribute in attributes:
                if edit.get(attribute) is not None:
                    values[attribute] = edit.numbers(attribute, {"pos": 3, "quat": 4}.get(attribute))
            edit.close()
            if "quat" in values:
                values["quat"] = _unit(values["quat"], f"{edit.where}: 'quat'")
            if any(size <= 0 for size in values.get("size", ())):
                raise edit.fail(f"'size' must be positive, got {_shown(list(values['size']))}")
            edits.setdefault(kind, {})[name] = values
    regions: dict[str, dict[str, Any]] = {}
    for variable, edit in table.named_tables("placement", required=False).items():
        original = next((p for p in placements if p.variable == variable), None)
        if original is None:
            raise edit.fail(f"no placement of that variable; available: {_listed(p.variable for p in placements)}")
        allowed = ("low", "high", "quat", "upright")
        for key in edit.values:
            if key not in allowed:
                raise edit.fail(f"unknown key '{key}'; allowed: {_listed(allowed)}")
        base: dict[str, Any] = {"low": list(original.low), "high": list(original.high)}
        if not ({"quat", "upright"} & edit.values.keys()):
            base |= {"upright": original.upright} | ({"quat": list(original.quat)} if original.quat else {})
        regions[variable] = _read_region(_Table(base | edit.values, edit.where))
    table.close()
    return Instance(title, edits, regions)


def _check_task(task: Task) -> None:
    """Check what only shows when the parts of a task are seen together."""
    where = task.path.name
    variables = task.variables
    for name in variables:
        if not re.fullmatch(r"[A-Za-z_]\w*", name):
            raise InputError(f"{where}: variable '{name}' is no identifier (letters, digits, underscores)")
        if variables.count(name) > 1:
            raise InputError(f"{where}: variable '{name}' is declared more than once; names must be unique")
    bodies = [spec.body for spec in task.objects] + [robot.base for robot in task.robots if robot.base]
    for body in bodies:
        if bodies.count(body) > 1:
            raise InputError(f"{where}: body '{body}' is declared more than once among objects and floating bases")
    joints = [joint for robot in task.robots for joint in robot.joints]
    for joint in joints:
        if joints.count(joint) > 1:
            raise InputError(f"{where}: joint '{joint}' belongs to more than one robot")
    for hold in task.holds:
        _check_hold(task, hold)
    for robot in task.robots:
        if robot.base is not None:
            _check_support(task, robot)
    for parts, kind in ((task.placements, "placements"), (task.goals, "goals")):
        seen: set[tuple[str, str]] = set()
        for part in parts:
            if (part.object, part.at) in seen:
                raise InputError(f"{where}: two {kind} of object '{part.object}' at switch '{part.at}'")
            seen.add((part.object, part.at))
    for placement in task.placements:
        if any(g.full and (g.object, g.at) == (placement.object, placement.at) for g in task.goals):
            raise InputError(
                f"{where}: object '{placement.object}' has both a goal pose and placement '{placement.variable}' at "
                f"switch '{placement.at}'; expected one of them"
            )
    for name, text in task.sequences.items():
        words = re.findall(r"\w+", text)
        unknown = [word for word in words if word not in variables]
        if unknown:
            known = _listed(variables)
            raise InputError(f"{where}: sequence '{name}' names unknown variable '{unknown[0]}'; available: {known}")
        if sorted(words) != sorted(variables):
            wrong = [v for v in variables if words.count(v) != 1]
            raise InputError(f"{where}: sequence '{name}' must name each variable once; not so: {_listed(wrong)}")


def _check_hold(task: Task, hold: Hold) -> None:
    where = f"{task.path.name}: hold '{hold.variable}'"
    first, last = task.span(hold)
    for switch in task.switches[first : last + 1]:
        if hold.robot not in switch.configurations:
            raise InputError(f"{where}: robot '{hold.robot}' has no configuration at '{switch.name}', where it holds")
    if hold.supports and task.robot(hold.robot).base is None:
        raise InputError(f"{where}: 'supports' needs a floating robot, but robot '{hold.robot}' has no 'base'")
    for other in task.holds:
        # Two robots may hang on one object, but nothing may move it meanwhile, and one frame at a time moves it.
        if other is hold or other.object != hold.object or (hold.supports and other.supports):
            continue
        if task.switch_index(other.start) < last and first < task.switch_index(other.end):
            raise InputError(f"{where}: object '{hold.object}' is also held by '{other.variable}' at that time")
    placed = any((p.object, p.at) == (hold.object, hold.end) for p in task.placements)
    placed |= any((g.object, g.at) == (hold.object, hold.end) and g.full for g in task.goals)
    if not (placed or hold.supports) and last < len(task.switches) - 1:
        raise InputError(
            f"{where}: object '{hold.object}' is let go at '{hold.end}' with neither a placement nor a goal pose there"
        )


def _check_support(task: Task, robot: Robot) -> None:
    """A floating robot that has lifted off must hang on exactly one object from each switch to the next."""
    spans = [task.span(hold) for hold in task.holds if hold.supports and hold.robot == robot.name]
    lift_off = min((start for start, _ in spans), default=len(task.switches))
    for before in range(lift_off, len(task.switches) - 1):
        count = sum(start <= before < end for start, end in spans)
        if count != 1:
            raise InputError(
                f"{task.path.name}: floating robot '{robot.name}' hangs on {count} objects from switch "
                f"'{task.switches[before].name}' to '{task.switches[before + 1].name}', expected one ('supports')"
            )


# ---------------------------------------------------------------------------------------------------------------------
# What the task says about object poses


def object_pose_sources(task: Task) -> dict[tuple[str, str], PoseSource]:
    """Where the pose of each object at each mode switch comes from: (object, switch) to one of

    ("start",)            as the MJCF has it
    ("goal", site)        the pose of the goal site
    ("variable", p)       the placement variable, T_world_object
    ("held", t)           T_world_frame(q) * t of that hold, with q at this switch

    A goal pose comes first, then a placement, then a hold that is under way (or that ends here without either, at the
    last switch), else the object rests and the source is that of the previous switch. A goal of position or rotation
    alone does not determine the pose: it is rows on the pose that the other rules give.
    """
    sources: dict[tuple[str, str], PoseSource] = {}
    for spec in task.objects:
        source: PoseSource = ("start",)
        for index, switch in enumerate(task.switches):
            goal = next((g for g in task.goals if (g.object, g.at) == (spec.name, switch.name) and g.full), None)
            place = next((p for p in task.placements if (p.object, p.at) == (spec.name, switch.name)), None)
            holds = [h for h in task.holds if h.object == spec.name and not h.supports]
            held = next((h for h in holds if task.span(h)[0] < index <= task.span(h)[1]), None)
            if goal:
                source = ("goal", goal.site)
            elif place:
                source = ("variable", place.variable)
            elif held:
                source = ("held", held.variable)
            sources[spec.name, switch.name] = source
    return sources


def attachments(task: Task) -> list[dict[str, Any]]:
    """Which body is at rest in which frame from each mode switch to the next, JSON-ready (schema cgs_jax/1).

    One entry per interval: {"object": body, "frame": site or "world", "from": switch or None (initial configuration),
    "to": switch}, for holds also "variable" and "grasp". A floating base rests in the world until it first hangs on an
    object; from then on the supporting hold says where it is.
    """
    entries: list[dict[str, Any]] = []
    spans = list(zip([None, *(switch.name for switch in task.switches)], task.switches, strict=False))
    for spec in task.objects:
        holds = [hold for hold in task.holds if hold.object == spec.name]
        for before, switch in spans:
            after = task.switch_index(switch.name)
            active = [hold for hold in holds if task.span(hold)[0] < after <= task.span(hold)[1]]
            interval = {"from": before, "to": switch.name}
            if all(hold.supports for hold in active):
                entries.append({"object": spec.body, "frame": "world"} | interval)
            for hold in active:
                grasp = {"variable": hold.variable, "grasp": hold.grasp.as_json()}
                entries.append({"object": spec.body, "frame": hold.frame} | interval | grasp)
    for robot in task.robots:
        if robot.base is None:
            continue
        lifts = [task.switch_index(hold.start) for hold in task.holds if hold.robot == robot.name and hold.supports]
        for before, switch in spans[: min(lifts, default=len(spans)) + 1]:
            entries.append({"object": robot.base, "frame": "world", "from": before, "to": switch.name})
    return entries


def placements(task: Task) -> list[dict[str, Any]]:
    """What Position demands of each placement variable, JSON-ready (schema cgs_jax/1). Use a scene's own task."""
    return [
        {
            "variable": placement.variable,
            "object": task.object(placement.object).body,
            "at": placement.at,
            "low": list(placement.low),
            "high": list(placement.high),
            "quat": None if placement.quat is None else list(placement.quat),
            "upright": placement.upright,
        }
        for placement in task.placements
    ]


def goals(task: Task) -> list[dict[str, Any]]:
    """Which body coincides with which site at which switch, JSON-ready (schema cgs_jax/1)."""
    return [
        {
            "object": task.object(goal.object).body,
            "site": goal.site,
            "at": goal.at,
            "position": goal.position,
            "rotation": goal.rotation,
        }
        for goal in task.goals
    ]


# ---------------------------------------------------------------------------------------------------------------------
# One instance


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """One instance of a task: the compiled model and the task with the instance's placements."""

    task: Task
    instance: int
    model: mujoco.MjModel
    xml: str
    """The resolved instance as one self-contained MJCF text; `model` is compiled from exactly this text."""
    home_qpos: NDArray[np.float64]
    """(nq,) the home keyframe; free bodies stand at their MJCF poses."""

    @functools.cached_property
    def mjx_model(self) -> mjx.Model:
        """The model on the default JAX device (`mjx.put_model`)."""
        # mjx tells on import that its optional second backend is missing, which is of no use to our users.
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            from mujoco import mjx
        return mjx.put_model(self.model)

    @functools.cached_property
    def _home(self) -> mujoco.MjData:
        data = mujoco.MjData(self.model)
        data.qpos[:] = self.home_qpos
        mujoco.mj_kinematics(self.model, data)
        return data

    def object_pose(self, name: str) -> NDArray[np.float64]:
        """T_world_object (7,) of an object, or of a body, where the MJCF puts it.

        Raises InputError for a name that is neither.
        """
        body = next((spec.body for spec in self.task.objects if spec.name == name), name)
        index = _identify(self.model, mujoco.mjtObj.mjOBJ_BODY, body, "object or body", self.task.name)
        return np.concatenate([self._home.xpos[index], self._home.xquat[index]])

    def site_pose(self, name: str) -> NDArray[np.float64]:
        """T_world_site (7,) with robots and objects at home. Raises InputError for an unknown site."""
        index = _identify(self.model, mujoco.mjtObj.mjOBJ_SITE, name, "site", self.task.name)
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, self._home.site_xmat[index])
        return np.concatenate([self._home.site_xpos[index], quat])

    def configurations(self) -> list[dict[str, Any]]:
        """Where the joints stand at each mode switch, JSON-ready (schema cgs_jax/1).

        Entries are {"at": switch, "joints": names} with "variable" for a robot that acts, and with "values" (rad or m) for all
        hinges and slides that stay at home.
        """
        hinges_and_slides = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
        named = [joint for joint in map(self.model.joint, range(self.model.njnt)) if joint.name]
        home = {j.name: float(self.home_qpos[j.qposadr[0]]) for j in named if j.type[0] in hinges_and_slides}
        entries: list[dict[str, Any]] = []
        for switch in self.task.switches:
            resting = dict(home)
            for robot, variable in switch.configurations.items():
                joints = list(self.task.robot(robot).joints)
                entries.append({"at": switch.name, "joints": joints, "variable": variable})
                for joint in joints:
                    del resting[joint]
            if resting:
                entries.append({"at": switch.name, "joints": list(resting), "values": list(resting.values())})
        return entries

    def collision_pairs(self) -> list[tuple[int, int]]:
        """Pairs of geom ids that MuJoCo would test for contact, by its own filter, each pair once and in order.

        Filter: contype and conaffinity, bodies welded together, parent and child, <exclude>; an explicit <pair> is
        always live.
        """
        return _collision_pairs(self.model)


def load_scene(task: Task | str | Path, instance: int = 0) -> Scene:
    """Apply the edits of one instance to the MJCF, compile it and check it against the task.

    task: a task, or what `load_task` accepts. instance: 0-based.

    Raises InputError when the instance does not exist, the MJCF does not compile, an edit or the task names what the
    MJCF lacks, an object or a floating base has no free joint, a geom that can collide is no sphere, capsule or box, or a
    geom is a mesh from a file.
    """
    if not isinstance(task, Task):
        task = load_task(task)
    if isinstance(instance, bool) or not isinstance(instance, int) or not 0 <= instance < len(task.instances):
        raise InputError(
            f"instance {instance!r} of scene '{task.name}' does not exist, expected 0 to {len(task.instances) - 1}"
        )
    chosen = task.instances[instance]
    replaced = tuple(
        dataclasses.replace(placement, **chosen.placements.get(placement.variable, {})) for placement in task.placements
    )
    task = dataclasses.replace(task, placements=replaced)
    if task.model_path.suffix.lower() == ".urdf":
        raise InputError(f"{task.model_path.name} is a URDF, expected an MJCF with objects and goals; make one with: {IMPORT}")
    try:
        spec = mujoco.MjSpec.from_file(str(task.model_path))
    except ValueError as error:
        raise InputError(f"{task.model_path.name}: not a valid MJCF: {_one_line(error)}") from None
    _apply(spec, chosen, f"{task.path.name}: instances[{instance}]")
    model, xml = _resolve(spec, task)
    _check_model(model, task)
    home = np.array(model.key(task.home).qpos, dtype=np.float64)
    return Scene(task=task, instance=instance, model=model, xml=xml, home_qpos=home)


def _apply(spec: mujoco.MjSpec, instance: Instance, where: str) -> None:
    available = {"body": spec.bodies, "geom": spec.geoms, "site": spec.sites}
    for kind, elements in instance.edits.items():
        by_name = {element.name: element for element in available[kind] if element.name}
        for name, values in elements.items():
            if name not in by_name:
                raise InputError(f"{where}: no {kind} '{name}' in the MJCF; available: {_listed(by_name)}")
            element = by_name[name]
            if kind != "body" and np.isfinite(element.fromto[0]):
                raise InputError(
                    f"{where}: {kind} '{name}' has 'fromto' in the MJCF; give it pos, quat and size to edit it"
                )
            if "pos" in values:
                element.pos = values["pos"]
            if "quat" in values:
                # An orientation given as euler angles or axes would take precedence over the quaternion.
                element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
                element.quat = values["quat"]
            if "size" in values:
                if len(values["size"]) > 3:
                    raise InputError(
                        f"{where}: geom '{name}': 'size' takes at most 3 numbers, got {len(values['size'])}"
                    )
                element.size = (*values["size"], *element.size[len(values["size"]) :])


def _resolve(spec: mujoco.MjSpec, task: Task) -> tuple[mujoco.MjModel, str]:
    """Compile, put the free bodies of the home keyframe where the MJCF has them, and compile again from the text."""
    name = task.model_path.name
    try:
        model = spec.compile()
        key = next((key for key in spec.keys if key.name == task.home), None)
        if key is None:
            known = _listed(k.name for k in spec.keys if k.name)
            raise InputError(f"{name}: no keyframe '{task.home}'; available: {known}")
        qpos = np.array(model.key(task.home).qpos)
        for joint in np.flatnonzero(np.asarray(model.jnt_type) == int(mujoco.mjtJoint.mjJNT_FREE)):
            address = model.jnt_qposadr[joint]
            qpos[address : address + 7] = model.qpos0[address : address + 7]
        key.qpos = qpos
        _refuse_mesh_files(spec, name)
        xml = _without_unused_meshes(spec.to_xml())
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{name} does not compile: {_one_line(error)}") from None
    try:
        return mujoco.MjModel.from_xml_string(xml), xml
    except ValueError as error:
        raise InputError(f"{name} is not self-contained, expected primitives only: {_one_line(error)}") from None


def _refuse_mesh_files(spec: mujoco.MjSpec, where: str) -> None:
    files = {mesh.name: mesh.file for mesh in spec.meshes if mesh.file}
    found = [
        f"'{geom.name or geom.meshname}' of body '{geom.parent.name}'"
        for geom in spec.geoms
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH and geom.meshname in files
    ]
    if found:
        more = f" and {len(found) - 4} more" if len(found) > 5 else ""
        shown = _listed(found if not more else found[:4])
        raise InputError(
            f"{where}: geoms are meshes from files: {shown}{more}; expected primitives: give each type=\"capsule\" or \"box\" "
            f"beside its mesh, which MuJoCo then fits, or use: {IMPORT}"
        )


def _without_unused_meshes(xml: str) -> str:
    """The MJCF text without meshes that no geom uses: MuJoCo writes a fitted geom as a primitive and keeps its mesh's file."""
    root = ElementTree.fromstring(xml)
    used = {element.get("mesh") for element in root.iter() if element.tag != "mesh"}
    dropped = False
    for asset in root.iter("asset"):
        for mesh in [mesh for mesh in asset.findall("mesh") if mesh.get("name") not in used]:
            asset.remove(mesh)
            dropped = True
    return ElementTree.tostring(root, encoding="unicode") + "\n" if dropped else xml


def _names(model: mujoco.MjModel, kind: mujoco.mjtObj) -> list[str]:
    count = {
        mujoco.mjtObj.mjOBJ_BODY: model.nbody,
        mujoco.mjtObj.mjOBJ_JOINT: model.njnt,
        mujoco.mjtObj.mjOBJ_SITE: model.nsite,
        mujoco.mjtObj.mjOBJ_GEOM: model.ngeom,
    }[kind]
    return [name for i in range(count) if (name := mujoco.mj_id2name(model, kind, i))]


def _identify(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str, noun: str, where: str) -> int:
    index = mujoco.mj_name2id(model, kind, name)
    if index < 0:
        raise InputError(f"{where}: no {noun} '{name}' in the MJCF; available: {_listed(_names(model, kind))}")
    return index


def _free_joint(model: mujoco.MjModel, body: int) -> bool:
    address = model.body_jntadr[body]
    return bool(address >= 0 and model.jnt_type[address] == int(mujoco.mjtJoint.mjJNT_FREE))


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """The body itself and all bodies above it, the world last."""
    chain = [body]
    while chain[-1] != 0:
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain


def _check_model(model: mujoco.MjModel, task: Task) -> None:
    where = f"{task.path.name} with {task.model_path.name}"
    body_kind, joint_kind, site_kind = mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_JOINT, mujoco.mjtObj.mjOBJ_SITE
    free = [name for name in _names(model, body_kind) if _free_joint(model, model.body(name).id)]

    def free_body(name: str, noun: str) -> int:
        index = _identify(model, body_kind, name, "body", where)
        if not _free_joint(model, index):
            raise InputError(f"{where}: {noun} needs a free joint on body '{name}'; bodies with one: {_listed(free)}")
        return index

    objects = {spec.name: free_body(spec.body, f"object '{spec.name}'") for spec in task.objects}
    for robot in task.robots:
        moved = set()
        for name in robot.joints:
            joint = _identify(model, joint_kind, name, "joint", f"{where}: robot '{robot.name}'")
            if mujoco.mjtJoint(int(model.jnt_type[joint])) not in MOVING_JOINTS:
                raise InputError(f"{where}: joint '{name}' of robot '{robot.name}' is no hinge or slide joint")
            if not model.jnt_limited[joint]:
                raise InputError(f"{where}: joint '{name}' of robot '{robot.name}' has no range to sample in")
            moved.add(int(model.jnt_bodyid[joint]))
        if robot.base is not None and robot.support is not None:
            base = free_body(robot.base, f"floating robot '{robot.name}'")
            stand = _identify(model, site_kind, robot.support, "site", f"{where}: support of robot '{robot.name}'")
            if base not in _ancestors(model, int(model.site_bodyid[stand])):
                raise InputError(f"{where}: support site '{robot.support}' is not on robot '{robot.name}'")
            moved.add(base)
        for hold in (hold for hold in task.holds if hold.robot == robot.name):
            frame = _identify(model, site_kind, hold.frame, "site", f"{where}: frame of hold '{hold.variable}'")
            if not moved & set(_ancestors(model, int(model.site_bodyid[frame]))):
                raise InputError(
                    f"{where}: site '{hold.frame}' of hold '{hold.variable}' does not move with robot '{robot.name}'"
                )
    for hold in task.holds:
        for name in hold.grasp.sites if isinstance(hold.grasp, TouchGrasp) else ():
            site = _identify(model, site_kind, name, "site", f"{where}: grasp of hold '{hold.variable}'")
            if objects[hold.object] not in _ancestors(model, int(model.site_bodyid[site])):
                raise InputError(f"{where}: site '{name}' of hold '{hold.variable}' is not on object '{hold.object}'")
    for goal in task.goals:
        site = _identify(model, site_kind, goal.site, "site", f"{where}: goal of object '{goal.object}'")
        if model.body_weldid[model.site_bodyid[site]] != 0:
            raise InputError(f"{where}: goal site '{goal.site}' is on a moving body, expected one fixed in the world")
    for geom in sorted({geom for pair in _collision_pairs(model) for geom in pair}):
        kind = mujoco.mjtGeom(int(model.geom_type[geom]))
        if kind not in COLLISION_GEOMS:
            body = mujoco.mj_id2name(model, body_kind, model.geom_bodyid[geom])
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"number {geom}"
            raise InputError(
                f"{where}: geom '{name}' of body '{body}' can collide and is of unsupported type "
                f"'{kind.name.removeprefix('mjGEOM_').lower()}'; supported: {_listed(COLLISION_GEOMS.values())} "
                f"({IMPORT} encloses others in one of these)"
            )


def _collision_pairs(model: mujoco.MjModel) -> list[tuple[int, int]]:
    body = np.asarray(model.geom_bodyid)
    weld = np.asarray(model.body_weldid)[body]
    # The parent of a weld group is the weld group of the parent of its topmost body.
    parent = np.asarray(model.body_weldid)[np.asarray(model.body_parentid)[weld]]
    contype, conaffinity = np.asarray(model.geom_contype), np.asarray(model.geom_conaffinity)
    excluded = {(int(s) >> 16, int(s) & 0xFFFF) for s in model.exclude_signature}
    skip_parent = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    live = {(min(int(a), int(b)), max(int(a), int(b))) for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    for a in range(model.ngeom):
        for b in range(a + 1, model.ngeom):
            if weld[a] == weld[b]:
                continue
            if not (contype[a] & conaffinity[b] or contype[b] & conaffinity[a]):
                continue
            if skip_parent and weld[a] and weld[b] and (weld[a] == parent[b] or weld[b] == parent[a]):
                continue
            bodies = (int(body[a]), int(body[b]))
            if bodies in excluded or bodies[::-1] in excluded:
                continue
            live.add((a, b))
    return sorted(live)
