"""Robot files with meshes, read as trees of links whose collision geoms are spheres, capsules and boxes.

`read_robot` takes an MJCF or a URDF. Meshes become the box or the capsule that encloses them in MuJoCo's own frame for
them (a mesh's principal axes of inertia; the box is the one MuJoCo fits for `fitaabb`), cylinders and ellipsoids a box or a
capsule around them. So what is fitted is never smaller than what it stands for. The joints above the tool stay joints, in
order the robot's configuration; all others are fixed at the home configuration.

Lengths in metres, angles in radians, quaternions [w x y z]; poses of links are relative to their parents.
"""

from __future__ import annotations

import dataclasses
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from cgs_jax.errors import InputError

Floats = NDArray[np.float64]
Kind = Literal["sphere", "capsule", "box"]
Wish = Literal["sphere", "capsule", "box", "halves"]

KINDS: tuple[Kind, ...] = ("sphere", "capsule", "box")
WISHES: tuple[Wish, ...] = (*KINDS, "halves")
"""What can be asked for a geom: one primitive of a kind, or two primitives, one for each half of a mesh."""
AXES = {f"{sign}{name}": (-1 if sign else 1) * np.eye(3)[i] for i, name in enumerate("xyz") for sign in ("", "-")}
"""Directions by name: x, -x, y, ..."""

BOX_WORTH = 1.2
"""A capsule is taken when its volume is at most this multiple of the box's: it is rounder and quicker to check."""

THINNEST = 0.0005
"""Half thickness in metres of the box around a flat mesh."""

_TOOL_SITES = re.compile(r"pinch|grip|grasp|attach|tool|tcp|flange|eef|end_?effector|wrist", re.I)
_MESH_FILES = (".stl", ".obj", ".msh")
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)


@dataclasses.dataclass(frozen=True)
class Frame:
    """T_parent_child."""

    rotation: Floats  # (3, 3)
    position: Floats  # (3,) m

    def then(self, other: Frame) -> Frame:
        return Frame(self.rotation @ other.rotation, self.rotation @ other.position + self.position)

    def inverse(self) -> Frame:
        return Frame(self.rotation.T, -self.rotation.T @ self.position)

    @property
    def quat(self) -> Floats:
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, np.ascontiguousarray(self.rotation).ravel())
        return quat


IDENTITY = Frame(np.eye(3), np.zeros(3))


def frame_of(position: Floats, quat: Floats) -> Frame:
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quat, dtype=float))
    return Frame(rotation.reshape(3, 3), np.array(position, dtype=float))


@dataclasses.dataclass(frozen=True)
class Primitive:
    """A sphere (radius), capsule (radius, half the segment along z) or box (half lengths), in the frame of its link."""

    kind: Kind
    size: tuple[float, ...]
    frame: Frame
    rgba: tuple[float, float, float, float]
    source: str
    """What it stands for: the geom's name and type in the robot's file."""
    excess: float | None
    """Its volume over that of the convex hull of what it stands for (inf: flat); None where it is the very same primitive."""

    def contains(self, points: Floats, margin: float = 0.0) -> NDArray[np.bool_]:
        """Which points (P, 3) in the link's frame lie inside, or at most `margin` metres outside."""
        local = (points - self.frame.position) @ self.frame.rotation
        if self.kind == "box":
            return np.asarray(np.all(np.abs(local) <= np.array(self.size) + margin, axis=1))
        half = self.size[1] if self.kind == "capsule" else 0.0
        local[:, 2] -= np.clip(local[:, 2], -half, half)
        return np.asarray(np.linalg.norm(local, axis=1) <= self.size[0] + margin)

    def reach(self, direction: Floats) -> float:
        """The largest coordinate along a unit vector of the link's frame, metres."""
        local = self.frame.rotation.T @ direction
        half = float(np.abs(local) @ self.size) if self.kind == "box" else self.size[0]
        if self.kind == "capsule":
            half += abs(local[2]) * self.size[1]
        return float(self.frame.position @ direction) + half


@dataclasses.dataclass(frozen=True)
class Appearance:
    """A geom as the robot's file has it, for pictures."""

    frame: Frame
    rgba: tuple[float, float, float, float]
    kind: mujoco.mjtGeom
    size: tuple[float, float, float]
    vertices: Floats | None = None  # (V, 3) m
    faces: NDArray[np.int32] | None = None  # (F, 3)


@dataclasses.dataclass(frozen=True)
class RobotJoint:
    """A hinge or slide that is part of the robot's configuration."""

    name: str
    slide: bool
    axis: Floats  # (3,) in the link's frame
    position: Floats  # (3,) m, in the link's frame
    low: float
    high: float
    home: float
    reference: float
    """Coordinate at which the link stands where `Link.frame` says."""


@dataclasses.dataclass(frozen=True)
class Link:
    """A body: its place in its parent (-1: the world), the joints that move it, what it consists of."""

    name: str
    parent: int
    frame: Frame
    joints: tuple[RobotJoint, ...]
    primitives: tuple[Primitive, ...]
    looks: tuple[Appearance, ...]


@dataclasses.dataclass(frozen=True)
class FittedRobot:
    """A robot as a tree of links, parents first, with a tool frame: z along the approach."""

    name: str
    links: tuple[Link, ...]
    tool_link: int
    tool: Frame
    """T_link_tool."""
    excludes: tuple[tuple[str, str], ...]
    """Pairs of links that the robot's file excludes from contact."""
    notes: tuple[str, ...]
    """What was decided while reading, one line each."""

    @property
    def joints(self) -> tuple[RobotJoint, ...]:
        """The configuration, from the base to the tool."""
        return tuple(joint for link in self.links for joint in link.joints)

    def ancestors(self, link: int) -> list[int]:
        """The link itself and all links above it."""
        found = [link]
        while self.links[found[-1]].parent >= 0:
            found.append(self.links[found[-1]].parent)
        return found

    def rigid_frames(self) -> dict[int, Frame]:
        """T_toolLink_link of every link that is fixed to the tool's link."""
        frames = {self.tool_link: IDENTITY}
        changed = True
        while changed:
            changed = False
            for index, link in enumerate(self.links):
                if link.joints or link.parent < 0:
                    continue
                if link.parent in frames and index not in frames:
                    frames[index], changed = frames[link.parent].then(link.frame), True
                elif index in frames and link.parent not in frames:
                    frames[link.parent], changed = frames[index].then(link.frame.inverse()), True
        return frames

    def at_tool(self) -> list[Primitive]:
        """All primitives that are fixed to the tool, in the tool's frame."""
        found = []
        for index, frame in self.rigid_frames().items():
            local = self.tool.inverse().then(frame)
            found += [dataclasses.replace(p, frame=local.then(p.frame)) for p in self.links[index].primitives]
        return found


# ---------------------------------------------------------------------------------------------------------------------
# Reading


def read_robot(
    path: Path,
    tool: str | None = None,
    home: Mapping[str, float] | None = None,
    shapes: Mapping[str, Wish] | None = None,
    approach: str = "z",
    movable: bool = True,
    skip_missing: bool = False,
) -> FittedRobot:
    """Read an MJCF or a URDF file.

    tool: a site, or BODY:x,y,z (metres, in the body's frame); None takes the site whose name says that it is one.
    home: joint values that replace those of the keyframe (the one named home, else the first; without one, 0 or, where that
    is out of range, the middle). shapes: which primitive to fit, by name of a geom or of a body. approach, closing: axes of
    the tool site or body along which the gripper approaches and closes. movable: False fixes all joints. skip_missing: a URDF's
    geoms whose meshes are missing are left out, with a note, instead of an error.

    Raises InputError, one line that says what to do, for files that MuJoCo cannot read, missing meshes (all of them), unknown
    names, geoms that have no enclosing primitive, and joints that are no part of a serial chain of hinges and slides.
    """
    model, notes = _compile(path, skip_missing)
    reader = _Reader(path.name, model, notes, dict(home or {}), dict(shapes or {}))
    return reader.read(tool, _tool_axes(approach), movable)


def element_names(path: Path, skip_missing: bool = False) -> set[str]:
    """Names of the bodies, geoms and joints of a robot's file. Raises InputError like `read_robot`."""
    reader = _Reader(path.name, _compile(path, skip_missing)[0], [], {}, {})
    return {*reader.body_names, *reader.geom_names, *reader.joint_names}


def graft(arm: FittedRobot, gripper: FittedRobot) -> FittedRobot:
    """The arm with the gripper's links at its tool frame; the tool is then the gripper's. Names get the prefix gripper_."""
    offset = len(arm.links)
    links = []
    for link in gripper.links:
        top = link.parent < 0
        frame = arm.tool.then(link.frame) if top else link.frame
        parent = arm.tool_link if top else link.parent + offset
        links.append(dataclasses.replace(link, name=f"gripper_{link.name}", parent=parent, frame=frame))
    return FittedRobot(
        name=arm.name,
        links=(*arm.links, *links),
        tool_link=gripper.tool_link + offset,
        tool=gripper.tool,
        excludes=arm.excludes,
        notes=(*arm.notes, *(f"gripper: {note}" for note in gripper.notes)),
    )


def _tool_axes(approach: str) -> Floats:
    """A rotation whose z is that axis; the identity for z."""
    if approach not in AXES:
        raise InputError(f"approach '{approach}' is no axis of the tool, expected one of: {', '.join(AXES)}")
    z = AXES[approach]
    y = AXES["y"] if not z @ AXES["y"] else AXES["x"]
    return np.stack([np.cross(y, z), y, z], axis=1)


def _compile(path: Path, skip_missing: bool) -> tuple[mujoco.MjModel, list[str]]:
    notes: list[str] = []
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"cannot read robot file {path}: {error.strerror or error}") from None
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"{path.name} is no XML: {error}") from None
    try:
        if root.tag == "robot":
            xml, assets = _self_contained_urdf(path, root, notes, skip_missing)
            spec = mujoco.MjSpec.from_string(xml, assets=assets)
        elif root.tag == "mujoco":
            spec = mujoco.MjSpec.from_file(str(path))
        else:
            raise InputError(f"{path.name} is neither an MJCF (<mujoco>) nor a URDF (<robot>) but starts with <{root.tag}>")
        return spec.compile(), notes
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        remedy = "; its meshes must be where the file's meshdir says" if "opening file" in str(error) else ""
        said = " ".join(str(error).split()).removeprefix("Error: ")
        raise InputError(f"{path.name} does not compile: {said}{remedy}") from None


def _self_contained_urdf(
    path: Path, root: ElementTree.Element, notes: list[str], skip_missing: bool
) -> tuple[str, dict[str, bytes]]:
    """The URDF with mesh files replaced by unique names, and their contents: MuJoCo names a mesh after its file alone."""
    assets: dict[str, bytes] = {}
    missing: list[str] = []
    bare: list[str] = []
    skipped = 0
    for link in root.findall("link"):
        for part in ("collision", "visual"):
            for element in link.findall(part):
                mesh = element.find("geometry/mesh")
                if mesh is None:
                    continue
                wanted = mesh.get("filename", "")
                found = _mesh_file(path, wanted)
                if found is None or found.suffix.lower() not in _MESH_FILES:
                    # A picture can do without it, a collision check cannot.
                    if part == "visual" and link.find("collision") is not None:
                        skipped += 1
                    else:
                        missing.append(wanted if found is None else f"{wanted} (no STL, OBJ or MSH)")
                        bare.append(link.get("name", ""))
                    link.remove(element)
                    continue
                key = f"{len(assets)}_{found.name}"
                assets[key] = found.read_bytes()
                mesh.set("filename", key)
    if missing and not skip_missing:
        names = list(dict.fromkeys(missing))
        shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        raise InputError(
            f"{path.name}: {len(names)} mesh files not found or not readable: {shown}; put STL or OBJ files of these names "
            f"beside the URDF or, for package://NAME/..., into a folder NAME beside or above it, or --skip-missing"
        )
    if missing:
        links = ", ".join(dict.fromkeys(bare))
        notes.append(f"meshes of these links are missing and NOT part of the robot: {links}")
    if skipped:
        notes.append(f"{skipped} visual meshes are missing or of another format than STL, OBJ and MSH: not in the picture")
    for extension in root.findall("mujoco"):
        root.remove(extension)
    extension = ElementTree.SubElement(root, "mujoco")
    settings = {"fusestatic": "false", "discardvisual": "false", "strippath": "false", "balanceinertia": "true"}
    ElementTree.SubElement(extension, "compiler", settings | {"boundmass": "1e-6", "boundinertia": "1e-9"})
    return ElementTree.tostring(root, encoding="unicode"), assets


def _mesh_file(urdf: Path, wanted: str) -> Path | None:
    """Where a URDF's mesh lies: as it says, by its package's folder beside or above the URDF, or beside the URDF."""
    relative = re.sub(r"^(package|model|file)://", "", wanted)
    folder = urdf.resolve().parent
    candidates = [folder / relative]
    if wanted.startswith(("package://", "model://")):
        inside = Path(*Path(relative).parts[1:])
        for above in (folder, *folder.parents):
            candidates += [above / relative, above / inside]
    candidates.append(folder / Path(relative).name)
    return next((candidate for candidate in candidates if candidate.is_file()), None)


class _Reader:
    def __init__(
        self, file: str, model: mujoco.MjModel, notes: list[str], home: dict[str, float], shapes: dict[str, Wish]
    ) -> None:
        self.file, self.model, self.notes, self.shapes = file, model, notes, shapes
        self.body_names = self._unique(mujoco.mjtObj.mjOBJ_BODY, model.nbody, "link")
        self.joint_names = self._unique(mujoco.mjtObj.mjOBJ_JOINT, model.njnt, "joint")
        self.geom_names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, i) or "" for i in range(model.ngeom)]
        self.site_names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SITE, i) or "" for i in range(model.nsite)]
        self.data = mujoco.MjData(model)
        self.data.qpos[:] = self._home(home)
        mujoco.mj_kinematics(model, self.data)
        unknown = set(shapes) - set(self.body_names) - set(self.geom_names)
        if unknown:
            known = ", ".join(self.body_names[1:])
            raise InputError(f"{file}: no body or geom '{min(unknown)}' to choose a shape for; bodies: {known}")

    def _unique(self, kind: mujoco.mjtObj, count: int, noun: str) -> list[str]:
        return [mujoco.mj_id2name(self.model, kind, i) or f"{noun}{i}" for i in range(count)]

    def _home(self, wishes: dict[str, float]) -> Floats:
        model = self.model
        if model.nkey:
            names = [model.key(i).name for i in range(model.nkey)]
            qpos = np.array(model.key(names.index("home") if "home" in names else 0).qpos)
        else:
            qpos = np.array(model.qpos0)
            for joint in range(model.njnt):
                low, high = model.jnt_range[joint]
                address, margin = model.jnt_qposadr[joint], 0.05 * (high - low)
                if model.jnt_limited[joint] and not low + margin <= qpos[address] <= high - margin:
                    qpos[address] = (low + high) / 2
        for name, value in wishes.items():
            if name not in self.joint_names:
                raise InputError(f"{self.file}: no joint '{name}' to give a home value; joints: {', '.join(self.joint_names)}")
            joint = self.joint_names.index(name)
            low, high = model.jnt_range[joint]
            if model.jnt_limited[joint] and not low <= value <= high:
                raise InputError(f"{self.file}: home value {value:g} of joint '{name}' is outside {low:g} to {high:g}")
            qpos[model.jnt_qposadr[joint]] = value
        return qpos

    # -------------------------------------------------------------- the tree

    def read(self, tool: str | None, axes: Floats, movable: bool) -> FittedRobot:
        tool_body, tool_frame = self._tool(tool)
        tool_frame = tool_frame.then(Frame(axes, np.zeros(3)))
        chain = self._ancestors(tool_body)
        joints = self._joints(chain) if movable else {}
        root = chain[-1]
        loose = {b for b in range(1, self.model.nbody) if self._on_free_joint(b) and self.model.body_rootid[b] != root}
        if loose:
            dropped = sorted({self.body_names[self.model.body_rootid[b]] for b in loose})
            self.notes.append(f"free bodies are left out: {', '.join(dropped)}")
        frozen = [
            name
            for i, name in enumerate(self.joint_names)
            if i not in joints and self.model.jnt_bodyid[i] not in loose and self.model.jnt_type[i] != _FREE
        ]
        if frozen:
            self.notes.append(f"joints fixed at home: {', '.join(frozen)}")
        links: list[Link] = []
        index = {0: -1}
        world = self._shapes(0)
        if world:
            index[0] = 0
            links.append(Link("fixed", -1, IDENTITY, (), *world))
        for body in range(1, self.model.nbody):
            if body in loose:
                continue
            index[body] = len(links)
            mine = tuple(joints[j] for j in sorted(joints) if self.model.jnt_bodyid[j] == body)
            parent = int(self.model.body_parentid[body])
            frame = frame_of(self.model.body_pos[body], self.model.body_quat[body])
            if not mine:
                frame = self._pose(parent).inverse().then(self._pose(body))
            links.append(Link(self.body_names[body], index[parent], frame, mine, *(self._shapes(body) or ((), ()))))
        excludes = []
        for signature in self.model.exclude_signature:
            pair = int(signature) >> 16, int(signature) & 0xFFFF
            if all(index.get(body, -1) >= 0 for body in pair):
                excludes.append((links[index[pair[0]]].name, links[index[pair[1]]].name))
        name = re.sub(r"\W+", "_", str(self.model.names[: self.model.names.index(b"\0")].decode())) or "robot"
        return FittedRobot(name, tuple(links), index[tool_body], tool_frame, tuple(excludes), tuple(self.notes))

    def _pose(self, body: int) -> Frame:
        return Frame(self.data.xmat[body].reshape(3, 3).copy(), self.data.xpos[body].copy())

    def _ancestors(self, body: int) -> list[int]:
        found = [body]
        while self.model.body_parentid[found[-1]] != 0:
            found.append(int(self.model.body_parentid[found[-1]]))
        return found

    def _on_free_joint(self, body: int) -> bool:
        address = self.model.body_jntadr[self.model.body_rootid[body]]
        return bool(address >= 0 and self.model.jnt_type[address] == _FREE)

    def _tool(self, wish: str | None) -> tuple[int, Frame]:
        sites = [name for name in self.site_names if name]
        bodies = ", ".join(self.body_names[1:])
        if wish is None:
            found = [name for name in sites if _TOOL_SITES.search(name)]
            if len(found) != 1:
                raise InputError(
                    f"{self.file}: say where the tool is, as a site or as BODY:x,y,z; sites: {', '.join(sites) or 'none'}; "
                    f"bodies: {bodies}"
                )
            wish = found[0]
            self.notes.append(f"tool at site '{wish}'")
        if wish in sites:
            site = self.site_names.index(wish)
            body = int(self.model.site_bodyid[site])
            return body, frame_of(self.model.site_pos[site], self.model.site_quat[site])
        name, colon, text = wish.rpartition(":")
        try:
            x, y, z = (float(part) for part in text.split(",")) if colon else (0.0, 0.0, 0.0)
        except ValueError:
            raise InputError(f"tool '{wish}' is not understood, expected a site or BODY:x,y,z") from None
        name = name if colon else wish
        if name not in self.body_names[1:]:
            raise InputError(
                f"{self.file}: tool '{wish}': no site or body '{name}'; sites: {', '.join(sites) or 'none'}; bodies: {bodies}"
            )
        return self.body_names.index(name), Frame(np.eye(3), np.array([x, y, z]))

    def _joints(self, chain: Sequence[int]) -> dict[int, RobotJoint]:
        """Joints above the tool, by number."""
        found = {}
        unlimited = []
        for joint in range(self.model.njnt):
            if self.model.jnt_bodyid[joint] not in chain:
                continue
            name, kind = self.joint_names[joint], int(self.model.jnt_type[joint])
            if kind == _FREE:
                self.notes.append(f"the base is fixed where it stands: free joint '{name}' is left out")
                continue
            if kind not in (_HINGE, _SLIDE):
                raise InputError(f"{self.file}: joint '{name}' above the tool is a ball joint; expected hinges and slides")
            low, high = (float(value) for value in self.model.jnt_range[joint])
            home = float(self.data.qpos[self.model.jnt_qposadr[joint]])
            if not self.model.jnt_limited[joint]:
                if kind == _SLIDE:
                    raise InputError(f"{self.file}: slide joint '{name}' above the tool has no range; give it one in the file")
                low, high = home - math.pi, home + math.pi
                unlimited.append(name)
            address = int(self.model.jnt_qposadr[joint])
            found[joint] = RobotJoint(
                name=name,
                slide=kind == _SLIDE,
                axis=np.array(self.model.jnt_axis[joint]),
                position=np.array(self.model.jnt_pos[joint]),
                low=low,
                high=high,
                home=float(np.clip(home, low, high)),
                reference=float(self.model.qpos0[address]),
            )
        if not found:
            raise InputError(f"{self.file}: no joint moves the tool; joints: {', '.join(self.joint_names) or 'none'}")
        if unlimited:
            self.notes.append(f"no range in the file, one turn about home given: {', '.join(unlimited)}")
        return found

    # -------------------------------------------------------------- the shapes

    def _shapes(self, body: int) -> tuple[tuple[Primitive, ...], tuple[Appearance, ...]] | None:
        model = self.model
        geoms = [int(g) for g in np.flatnonzero(np.asarray(model.geom_bodyid) == body)]
        planes = [g for g in geoms if model.geom_type[g] == int(mujoco.mjtGeom.mjGEOM_PLANE)]
        if planes:
            self.notes.append(f"{len(planes)} plane(s) of body '{self.body_names[body]}' are left out")
        geoms = [g for g in geoms if g not in planes]
        if not geoms:
            return None
        solid = [g for g in geoms if model.geom_contype[g] | model.geom_conaffinity[g]]
        if not solid and body:
            self.notes.append(f"body '{self.body_names[body]}' has no geom that can collide: its visual geoms are fitted")
            solid = geoms
        shown = [g for g in geoms if model.geom_group[g] < 3] or geoms
        # Files often have each link twice, once to be seen and once to collide.
        shown = [g for g in shown if g not in solid] or shown
        return tuple(p for g in solid for p in self._primitives(g)), tuple(self._look(g) for g in shown)

    def _vertices(self, geom: int) -> Floats:
        mesh = int(self.model.geom_dataid[geom])
        start = int(self.model.mesh_vertadr[mesh])
        return np.array(self.model.mesh_vert[start : start + int(self.model.mesh_vertnum[mesh])], dtype=float)

    def _rgba(self, geom: int) -> tuple[float, float, float, float]:
        own, material = self.model.geom_rgba[geom], int(self.model.geom_matid[geom])
        colour = self.model.mat_rgba[material] if material >= 0 and np.allclose(own, (0.5, 0.5, 0.5, 1)) else own
        r, g, b, a = (float(value) for value in colour)
        return r, g, b, a

    def _frame(self, geom: int) -> Frame:
        return frame_of(self.model.geom_pos[geom], self.model.geom_quat[geom])

    def _faces(self, geom: int) -> NDArray[np.int32]:
        mesh = int(self.model.geom_dataid[geom])
        start, count = int(self.model.mesh_faceadr[mesh]), int(self.model.mesh_facenum[mesh])
        return np.array(self.model.mesh_face[start : start + count], dtype=np.int32)

    def _look(self, geom: int) -> Appearance:
        kind = mujoco.mjtGeom(int(self.model.geom_type[geom]))
        x, y, z = (float(value) for value in self.model.geom_size[geom])
        look = Appearance(self._frame(geom), self._rgba(geom), kind, (x, y, z))
        if kind != mujoco.mjtGeom.mjGEOM_MESH:
            return look
        return dataclasses.replace(look, vertices=self._vertices(geom), faces=self._faces(geom))

    def _primitives(self, geom: int) -> list[Primitive]:
        kind = mujoco.mjtGeom(int(self.model.geom_type[geom]))
        body = self.body_names[self.model.geom_bodyid[geom]]
        mesh = int(self.model.geom_dataid[geom])
        noun = kind.name.removeprefix("mjGEOM_").lower()
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            noun += f" {self.model.mesh(mesh).name}"
        source = f"{body}: {self.geom_names[geom]} ({noun})" if self.geom_names[geom] else f"{body}: {noun}"
        wish = self.shapes.get(self.geom_names[geom]) or self.shapes.get(body)
        size = np.array(self.model.geom_size[geom])
        frame, rgba = self._frame(geom), self._rgba(geom)
        if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX) and not wish:
            same = next(k for k in KINDS if k == noun)
            count = {"sphere": 1, "capsule": 2, "box": 3}[same]
            return [Primitive(same, tuple(float(v) for v in size[:count]), frame, rgba, source, None)]
        if wish == "halves":
            if kind != mujoco.mjtGeom.mjGEOM_MESH:
                raise InputError(f"{self.file}: {source} is no mesh, so it has no halves to fit; expected: {', '.join(KINDS)}")
            parts = halves(self._vertices(geom), self._faces(geom))
        else:
            parts = [self._solid(geom, kind, size, source)]
        found = []
        for number, points in enumerate(parts):
            shape, numbers, place = snug(points) if wish == "halves" else enclose(points, wish)
            try:
                excess = _volume(shape, numbers) / float(ConvexHull(points).volume)
            except (QhullError, ValueError):
                excess = math.inf
            name = f"{source}, half {number + 1}" if len(parts) > 1 else source
            found.append(Primitive(shape, numbers, frame.then(place), rgba, name, excess))
        return found

    def _solid(self, geom: int, kind: mujoco.mjtGeom, size: Floats, source: str) -> Floats:
        """Points (P, 3) in the geom's frame whose convex hull holds the geom."""
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            return self._vertices(geom)
        names = {
            mujoco.mjtGeom.mjGEOM_CYLINDER: (size[0], size[0], size[1]),
            mujoco.mjtGeom.mjGEOM_ELLIPSOID: (size[0], size[1], size[2]),
            mujoco.mjtGeom.mjGEOM_SPHERE: (size[0], size[0], size[0]),
            mujoco.mjtGeom.mjGEOM_CAPSULE: (size[0], size[0], size[1]),
            mujoco.mjtGeom.mjGEOM_BOX: (size[0], size[1], size[2]),
        }
        if kind not in names:
            raise InputError(
                f"{self.file}: {source} can collide and has no enclosing primitive; expected meshes, cylinders, ellipsoids or "
                f"{', '.join(KINDS)}: replace it by one of these in the file or give it contype=\"0\" conaffinity=\"0\""
            )
        return _surface(kind, np.array(names[kind]))


def _surface(kind: mujoco.mjtGeom, half: Floats) -> Floats:
    """Points (P, 3) of a polytope around a curved geom, or the corners of a box. half: (3,) m, a capsule's without its caps."""
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T * half
    around = np.linspace(0, 2 * math.pi, 48, endpoint=False)
    # A regular polygon with 48 sides around a circle of radius 1.
    circle = np.stack([np.cos(around), np.sin(around)], axis=1) / math.cos(math.pi / 48)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return np.concatenate([np.column_stack([circle * half[:2], np.full(48, z)]) for z in (-half[2], half[2])])
    polar = np.linspace(-math.pi / 2, math.pi / 2, 25)
    rings = [np.column_stack([circle * math.cos(t), np.full(48, math.sin(t) / math.cos(math.pi / 48))]) for t in polar]
    ball = np.concatenate(rings)
    # Faces between rings cut inwards by at most this.
    ball /= math.cos(math.pi / 48)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        caps = ball * half[0]
        return np.concatenate([caps[caps[:, 2] >= 0] + [0, 0, half[2]], caps[caps[:, 2] <= 0] - [0, 0, half[2]]])
    return ball * half


def enclose(points: Floats, wish: Kind | None = None) -> tuple[Kind, tuple[float, ...], Frame]:
    """The sphere, capsule or box around points (P, 3) in their own axes; without a wish, capsule or box by volume.

    Returns kind, size and T_points_primitive. The box is the bounding box; the capsules run along one of the three axes
    through the box's centre, as slim or as short as needs the least volume.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    centre = (low + high) / 2
    centred = points - centre
    half = np.maximum((high - low) / 2, THINNEST)
    box: tuple[Kind, tuple[float, ...], Frame] = ("box", tuple(map(float, half)), Frame(np.eye(3), centre))
    if wish == "box":
        return box
    if wish == "sphere":
        return "sphere", (float(np.linalg.norm(centred, axis=1).max()),), Frame(np.eye(3), centre)
    capsules = [_capsule(centred, axis) for axis in range(3)]
    radius, below, above, axis = min(capsules, key=lambda c: _volume("capsule", (c[0], (c[2] - c[1]) / 2)))
    size = (radius, max((above - below) / 2, 1e-6))
    # z of the capsule along the axis.
    rotation = np.roll(np.eye(3), axis - 2, axis=0)
    offset = np.eye(3)[axis] * (below + above) / 2
    capsule: tuple[Kind, tuple[float, ...], Frame] = ("capsule", size, Frame(rotation, centre + offset))
    roomy = _volume("capsule", size) > BOX_WORTH * _volume("box", box[1])
    return box if wish is None and roomy else capsule


def halves(vertices: Floats, faces: NDArray[np.int32]) -> list[Floats]:
    """A mesh cut in two by a plane across one of its axes, where the two primitives around its parts are smallest.

    vertices: (V, 3), faces: (F, 3). Returns the points of both parts, the rim of the cut in both, so that the convex hulls of
    the parts hold all of a closed mesh.
    """
    best: tuple[float, list[Floats]] = (math.inf, [vertices])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    edges = vertices[np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)]
    for axis in range(3):
        for share in (0.3, 0.4, 0.5, 0.6, 0.7):
            cut = low[axis] + share * (high[axis] - low[axis])
            start, end = edges[:, 0], edges[:, 1]
            crossing = (start[:, axis] - cut) * (end[:, axis] - cut) < 0
            start, end = start[crossing], end[crossing]
            rim = start + (end - start) * ((cut - start[:, axis]) / (end - start)[:, axis])[:, None]
            parts = [np.concatenate([vertices[side], rim]) for side in (vertices[:, axis] <= cut, vertices[:, axis] >= cut)]
            if min(map(len, parts)) < 4:
                continue
            volume = sum(_volume(*snug(part)[:2]) for part in parts)
            if volume < best[0]:
                best = volume, parts
    return best[1]


def snug(points: Floats) -> tuple[Kind, tuple[float, ...], Frame]:
    """Like `enclose`, in the points' own axes or in the directions in which they spread, whichever needs less volume."""
    *_, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    rotation = axes.T * [1, 1, np.linalg.det(axes)]
    kind, size, place = enclose(points @ rotation)
    turned = kind, size, Frame(rotation, np.zeros(3)).then(place)
    return min(enclose(points), turned, key=lambda found: _volume(*found[:2]))


def _capsule(points: Floats, axis: int) -> tuple[float, float, float, int]:
    """Radius and ends of the segment on that axis of the smallest capsule around points, and the axis."""
    along = points[:, axis]
    across = np.linalg.norm(np.delete(points, axis, axis=1), axis=1)
    best = (math.inf, 0.0, 0.0, 0.0)
    for radius in np.linspace(1.0, 1.5, 26) * max(float(across.max()), THINNEST):
        cap = np.sqrt(np.maximum(radius**2 - across**2, 0))
        below, above = float((along + cap).min()), float((along - cap).max())
        if below > above:
            below = above = (below + above) / 2
            radius = float(np.sqrt(across**2 + (along - above) ** 2).max())
        best = min(best, (_volume("capsule", (radius, (above - below) / 2)), float(radius), below, above))
    return (*best[1:], axis)


def _volume(kind: Kind, size: Sequence[float]) -> float:
    if kind == "box":
        return 8 * size[0] * size[1] * size[2]
    return 4 / 3 * math.pi * size[0] ** 3 + (2 * math.pi * size[0] ** 2 * size[1] if kind == "capsule" else 0.0)


def loosest(robot: FittedRobot) -> Iterator[tuple[Link, Primitive]]:
    """Fitted primitives with their links, those with the largest excess volume first."""
    fitted = [(link, p) for link in robot.links for p in link.primitives if p.excess is not None]
    return iter(sorted(fitted, key=lambda entry: -(entry[1].excess or 0)))
