"""The float64 check that every candidate sample passes before it counts.

Nothing here is shared with the solver. Poses are recomputed by a batched float64 forward kinematics that reads the
`mujoco.MjModel`; contacts are decided by C MuJoCo. Calling C MuJoCo from Python costs about 10 us per configuration, so
a configuration is first tried against a *proof* that it is free of contact: bounding spheres, then a separating
direction for each pair of geoms that the spheres leave open. The proofs are lower bounds of the distance, so they can
only err towards asking; what they leave open goes to `mujoco.mj_collision`, which says how deep a contact is. MuJoCo looks
for a capsule's contacts near its ends and the box's edges and so has none for one that passes right through a thin box:
of the pairs left open, those whose segment meets the box are found here. `scripts/verify.py` checks the same conditions
again, with C MuJoCo for everything.

Batched arrays have the batch last, so that every numpy call works on long contiguous rows: a rotation is (3, 3, B) with
the frame's axes as columns, a position (3, B), both of the frame in the world.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from cgs_jax.errors import InputError

Floats = NDArray[np.floating[Any]]

_CHUNK = 8192
"""Configurations per pass, 30 MB of memory for two arms: a pass costs 2 ms of calling numpy, however short its rows."""

_WORTH_PROVING = 200
"""Configurations from which on the proofs, whose calls to numpy cost over a millisecond, save time."""

_PROJECTIONS = 4
"""Rounds of projecting to and fro before a pair with a box is left to C MuJoCo."""

_TINY = np.float32(1e-12)
"""Guards divisions by the squared length of an edge that a sphere does not have."""

_CLEARANCE = 1e-5
"""Metres by which a float32 proof of separation must hold; its rounding is below 2e-6 m within 10 m of the origin."""


@dataclass(frozen=True)
class Tolerances:
    """Largest violations that pass: m, rad, m of penetration, rad or m beyond a limit, excess length of quaternions, rows of
    a user's own constraints in their own unit."""

    position: float = 1e-4
    rotation: float = 1e-4
    penetration: float = 1e-4
    limit: float = 1e-6
    quaternion: float = 1e-6
    own: float = 1e-4


@dataclass(frozen=True)
class AuditResult:
    """Outcome for N samples and C constraints.

    ok: (N,) true where every violation is within its tolerance.
    violation: (N, C) largest violation per constraint, m or rad; `inf` throughout where a sample is not finite.
    constraints: the C names; each column has one unit.
    tolerance: (C,) what each column may be.
    """

    ok: NDArray[np.bool_]
    violation: NDArray[np.float64]
    constraints: tuple[str, ...]
    tolerance: NDArray[np.float64]


@dataclass(frozen=True)
class OwnCheck:
    """A condition that a user brought along; its column is called `OWN + name`.

    kind: "rows" (held to `Tolerances.own`) or "limit" (`Tolerances.limit`). scope: the variables that it reads.
    violation: function of values (N, dim) by variable, float64, to (N,).
    """

    name: str
    kind: Literal["rows", "limit"]
    scope: tuple[str, ...]
    violation: Callable[[Mapping[str, Floats]], Floats]


OWN = "own: "
"""What names of columns begin with that only the maker of the samples can check."""


class Auditor:
    """Checks samples of one scene. Threads may share it: what a call writes to is its own.

    model: the compiled scene. Contact margins in it are ignored: only penetration counts.
    attachments, placements, goals: the lists of the schema `cgs_jax/1`. An attachment or a placement may also name its
        `"variable"`: a stored value of that name is then compared with `qpos`.
    mode_switches: names in time order; a sample has one configuration for each.
    own: what a user's constraints and variables demand of the values.

    Raises InputError for a name that the model or `mode_switches` does not have.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        attachments: Sequence[Mapping[str, Any]],
        placements: Sequence[Mapping[str, Any]],
        goals: Sequence[Mapping[str, Any]],
        mode_switches: Sequence[str],
        tolerances: Tolerances | None = None,
        own: Sequence[OwnCheck] = (),
    ) -> None:
        self.mode_switches = tuple(mode_switches)
        self._own = tuple(own)
        self.tolerances = tolerances or Tolerances()
        self._nq = int(model.nq)
        self._kinematics = _Kinematics(model)
        self._contacts = _Contacts(model, self._kinematics)
        self._joints = _Joints(model)
        self._initial = _Configuration(self._kinematics.frames(np.array(model.qpos0)[:, None]))
        self._conditions: list[_Condition] = []
        self._poses: set[str] = set()
        for entry in attachments:
            self._add_attachment(entry)
        for entry in placements:
            self._add_placement(entry)
        for entry in goals:
            self._add_goal(entry)
        t = self.tolerances
        columns = [column for condition in self._conditions for column in condition.columns]
        columns += [(f"penetration at {switch} (m)", t.penetration) for switch in self.mode_switches]
        columns += [("joint limits (rad or m)", t.limit), ("unit quaternions", t.quaternion)]
        columns += [(OWN + check.name, t.own if check.kind == "rows" else t.limit) for check in self._own]
        self.constraints: tuple[str, ...] = tuple(name for name, _ in columns)
        self.tolerance = np.array([bound for _, bound in columns])

    def check(self, qpos: Floats, values: Mapping[str, Floats] | None = None) -> AuditResult:
        """Check N candidate samples.

        qpos: (N, K, nq) full configurations at the K mode switches.
        values: variables (N, dim) by name. Poses `[x y z qw qx qy qz]` that an attachment or placement names as its
            `"variable"` must agree with `qpos`; a user's own conditions read those in their scope; the others need only be
            finite.

        Raises InputError when `qpos` is not (N, K, nq), a value does not have N rows, or one that `own` reads is missing.
        """
        qpos = np.asarray(qpos, dtype=np.float64)
        switches = len(self.mode_switches)
        if qpos.ndim != 3 or qpos.shape[1:] != (switches, self._nq):
            raise InputError(f"qpos has shape {qpos.shape}, expected (N, {switches}, {self._nq})")
        finite = _finite_rows(qpos.reshape(len(qpos), switches * self._nq))
        stored: dict[str, Floats] = {}
        for name, value in (values or {}).items():
            stored[name] = np.asarray(value, dtype=np.float64)
            columns = 7 if name in self._poses else stored[name].shape[-1]
            if stored[name].shape != (len(qpos), columns):
                raise InputError(f"variable {name!r} has shape {stored[name].shape}, expected ({len(qpos)}, {columns})")
            finite &= _finite_rows(stored[name])
        for name in (name for check in self._own for name in check.scope):
            if name not in stored:
                raise InputError(f"no values of {name!r}, which a condition reads; available: {', '.join(stored) or 'none'}")
        violation = np.full((len(qpos), len(self.constraints)), np.inf)
        rows = np.flatnonzero(finite)
        passes = -(-rows.size * switches // _CHUNK)
        per_pass = -(-rows.size // max(passes, 1))
        scratch = self._contacts.borrow(per_pass * switches)
        for start in range(0, rows.size, max(per_pass, 1)):
            chunk = rows[start : start + per_pass]
            part = {name: value[chunk] for name, value in stored.items()}
            violation[chunk] = self._check_chunk(qpos[chunk], part, scratch)
        self._contacts.give_back(scratch)
        # Numpy reduces over the first axis many times faster than over a short last one.
        within = (violation <= self.tolerance).T.copy()
        return AuditResult(within.all(axis=0), violation, self.constraints, self.tolerance)

    def _check_chunk(self, qpos: Floats, stored: Mapping[str, Floats], scratch: _Scratch) -> Floats:
        count, switches, nq = qpos.shape
        lanes = np.ascontiguousarray(qpos.T).reshape(nq, switches * count)
        links = self._kinematics.frames(lanes)
        penetration = self._contacts.penetration(lanes, links, scratch).reshape(switches, count)
        configurations: dict[str | None, _Configuration] = {None: self._initial}
        for k, switch in enumerate(self.mode_switches):
            at_switch = slice(k * count, (k + 1) * count)
            parts = [(rotation[..., at_switch], position[..., at_switch]) for rotation, position in links]
            configurations[switch] = _Configuration(parts)
        columns = [error for condition in self._conditions for error in condition.errors(configurations, stored)]
        columns += list(penetration)
        beyond, deviation = (error.reshape(switches, count).max(axis=0) for error in self._joints.errors(lanes))
        for name in self._poses & stored.keys():
            deviation = np.maximum(deviation, np.abs(np.linalg.norm(stored[name][:, 3:], axis=1) - 1.0))
        columns += [beyond, deviation, *(check.violation(stored) for check in self._own)]
        return np.stack(np.broadcast_arrays(*columns), axis=1)

    def _require_switch(self, name: str) -> None:
        if name not in self.mode_switches:
            raise InputError(f"unknown mode switch {name!r}, available: {', '.join(self.mode_switches)}")

    def _named_variable(self, entry: Mapping[str, Any]) -> str | None:
        variable = entry.get("variable")
        if variable is not None:
            self._poses.add(variable)
        return variable

    def _add_attachment(self, entry: Mapping[str, Any]) -> None:
        start, end = entry["from"], entry["to"]
        for switch in (start, end):
            if switch is not None:
                self._require_switch(switch)
        frame = self._kinematics.fixed(entry["frame"], prefer="site")
        thing = self._kinematics.fixed(entry["object"], prefer="body")
        label = f"({entry['object']} in {entry['frame']}, {start or 'start'} to {end})"
        t = self.tolerances
        columns = ((f"attachment position {label} (m)", t.position), (f"attachment rotation {label} (rad)", t.rotation))
        variable = self._named_variable(entry)

        def attached(at: _Configurations, stored: _Stored) -> list[Floats]:
            first, last = at[start].relative(frame, thing), at[end].relative(frame, thing)
            errors = _pose_error(first, last)
            if variable in stored:
                given = _pose_from_rows(stored[variable])
                errors = [
                    np.maximum.reduce(triple)
                    for triple in zip(errors, _pose_error(first, given), _pose_error(last, given), strict=True)
                ]
            return errors

        self._conditions.append(_Condition(columns, attached))
        if entry.get("grasp"):
            held_at = tuple(switch for switch in (start, end) if switch is not None)
            self._add_grasp(entry["grasp"], frame, thing, held_at, label)

    def _add_grasp(
        self, grasp: Mapping[str, Any], frame: _Fixed, thing: _Fixed, held_at: tuple[str, ...], label: str
    ) -> None:
        t = self.tolerances
        columns = ((f"grasp position {label} (m)", t.position), (f"grasp rotation {label} (rad)", t.rotation))
        if grasp["kind"] == "touch":
            sites = [self._kinematics.fixed(name, prefer="site") for name in grasp["sites"]]

            def errors_at(configuration: _Configuration) -> list[Floats]:
                rotation, position = configuration.pose(frame)
                distances, angles = [], []
                for site in sites:
                    site_rotation, site_position = configuration.pose(site)
                    distances.append(_norm(position - site_position))
                    angles.append(_angle_of_chord(_norm(rotation[:, 2] + site_rotation[:, 2])))
                distance, angle = np.stack(distances), np.stack(angles)
                nearest = np.maximum(distance / t.position, angle / t.rotation).argmin(axis=0)[None]
                return [np.take_along_axis(error, nearest, axis=0)[0] for error in (distance, angle)]

        elif grasp["kind"] == "two_finger":
            axes = [(np.array(a, float), np.array(b, float), float(dot)) for a, b, dot in grasp["rows"]]
            low, high = (np.array(grasp[key], dtype=float)[:, None] for key in ("low", "high"))

            def errors_at(configuration: _Configuration) -> list[Floats]:
                rotation, position = configuration.relative(thing, frame)
                angle = np.zeros(position.shape[1])
                for gripper_axis, object_axis, dot in axes:
                    in_object = np.tensordot(rotation, gripper_axis, axes=(1, 0))
                    angle = np.maximum(angle, np.abs(object_axis @ in_object - dot))
                return [_beyond(position, low, high), angle]

        else:
            raise InputError(f"unknown grasp kind {grasp['kind']!r}, available: touch, two_finger")

        def grasped(at: _Configurations, stored: _Stored) -> list[Floats]:
            return [np.maximum.reduce(errors) for errors in zip(*(errors_at(at[k]) for k in held_at), strict=True)]

        self._conditions.append(_Condition(columns, grasped))

    def _add_placement(self, entry: Mapping[str, Any]) -> None:
        switch, variable, t = entry["at"], self._named_variable(entry), self.tolerances
        self._require_switch(switch)
        thing = self._kinematics.fixed(entry["object"], prefer="body")
        low, high = (np.array(entry[key], dtype=float)[:, None] for key in ("low", "high"))
        quat = entry.get("quat")
        declared = None if quat is None else _rotation_from_quat(np.array(quat, dtype=float)[:, None])
        upright = bool(entry.get("upright"))
        label = f"({entry['object']} at {switch})"
        columns = ((f"placement position {label} (m)", t.position), (f"placement rotation {label} (rad)", t.rotation))

        def placed(at: _Configurations, stored: _Stored) -> list[Floats]:
            rotation, position = at[switch].pose(thing)
            distance, angle = _beyond(position, low, high), np.zeros(position.shape[1])
            if declared is not None:
                angle = _rotation_error(rotation, declared)
            elif upright:
                angle = _angle_of_chord(_norm(rotation[:, 2] - np.array([[0.0], [0.0], [1.0]])))
            if variable in stored:
                differs = _pose_error((rotation, position), _pose_from_rows(stored[variable]))
                distance, angle = np.maximum(distance, differs[0]), np.maximum(angle, differs[1])
            return [distance, angle]

        self._conditions.append(_Condition(columns, placed))

    def _add_goal(self, entry: Mapping[str, Any]) -> None:
        switch, t = entry["at"], self.tolerances
        self._require_switch(switch)
        thing = self._kinematics.fixed(entry["object"], prefer="body")
        site = self._kinematics.fixed(entry["site"], prefer="site")
        demanded = (bool(entry["position"]), bool(entry["rotation"]))
        label = f"({entry['object']} on {entry['site']} at {switch})"
        both = ((f"goal position {label} (m)", t.position), (f"goal rotation {label} (rad)", t.rotation))

        def reached(at: _Configurations, stored: _Stored) -> list[Floats]:
            errors = _pose_error(at[switch].pose(thing), at[switch].pose(site))
            return [error for error, wanted in zip(errors, demanded, strict=True) if wanted]

        columns = tuple(column for column, wanted in zip(both, demanded, strict=True) if wanted)
        self._conditions.append(_Condition(columns, reached))


# Poses --------------------------------------------------------------------------------------------------------------

_Pose = tuple[Floats, Floats]
_Stored = Mapping[str, Floats]


def _norm(vectors: Floats) -> Floats:
    """Lengths (B,) of vectors (3, B)."""
    return np.sqrt(np.einsum("ib,ib->b", vectors, vectors))


def _angle_of_chord(chord: Floats) -> Floats:
    """Angle between unit vectors whose difference has this length; exact also for tiny angles, unlike arccos."""
    return 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))


def _rotation_error(first: Floats, second: Floats) -> Floats:
    """Angle (B,) from one rotation (3, 3, B) to the other: their Frobenius distance is 2 sqrt(2) sin(angle / 2)."""
    difference = first - second
    return _angle_of_chord(np.sqrt(0.5 * np.einsum("ijb,ijb->b", difference, difference)))


def _pose_error(first: _Pose, second: _Pose) -> list[Floats]:
    """Distance in m and angle in rad, (B,) each, between two poses."""
    return [_norm(first[1] - second[1]), _rotation_error(first[0], second[0])]


def _beyond(position: Floats, low: Floats, high: Floats) -> Floats:
    """By how much (B,) the worst coordinate of positions (3, B) lies outside its bounds (3, 1)."""
    return np.maximum(np.maximum(low - position, position - high).max(axis=0), 0.0)


def _rotation_from_quat(quat: Floats) -> Floats:
    """Rotations (3, 3, B) of quaternions (4, B), w first, of any length but zero (zero counts as none)."""
    length = np.sqrt(np.einsum("ib,ib->b", quat, quat))
    w, x, y, z = np.where(length > 0.0, quat, np.array([[1.0], [0.0], [0.0], [0.0]])) / np.where(length > 0, length, 1)
    rotation = np.empty((3, 3, quat.shape[1]))
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return rotation


def _pose_from_rows(rows: Floats) -> _Pose:
    """Poses from rows (B, 7) `[x y z qw qx qy qz]`."""
    return _rotation_from_quat(rows[:, 3:].T), rows[:, :3].T


def _matrix(quat: Floats) -> Floats:
    return _rotation_from_quat(np.asarray(quat, dtype=float)[:, None])[:, :, 0]


# Kinematics ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Fixed:
    """A frame that moves with a link: its rotation (3, 3) and position (3,) in the frame of that link."""

    link: int
    rotation: Floats
    position: Floats

    def then(self, position: Floats, quat: Floats) -> _Fixed:
        rotation = self.rotation @ _matrix(quat)
        return _Fixed(self.link, rotation, self.position + self.rotation @ np.asarray(position, dtype=float))


@dataclass(frozen=True)
class _Link:
    """A frame that a joint moves against its parent link; hinges turn about z, slides move along z of this frame."""

    parent: int
    kind: int
    address: int
    zero: float
    combine: Floats
    """(4, 3): the resting frame's axes in the parent as rows, then its position there."""


class _Kinematics:
    """Batched float64 forward kinematics of a MuJoCo model: one link per joint, link 0 is the world."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.links: list[_Link] = []
        self.bodies: list[_Fixed] = [_Fixed(0, np.eye(3), np.zeros(3))]
        for body in range(1, model.nbody):
            frame = self.bodies[model.body_parentid[body]].then(model.body_pos[body], model.body_quat[body])
            first = model.body_jntadr[body]
            for joint in range(first, first + model.body_jntnum[body]):
                frame = self._moved(frame, joint)
            self.bodies.append(frame)
        self.sites = [
            self.bodies[model.site_bodyid[site]].then(model.site_pos[site], model.site_quat[site])
            for site in range(model.nsite)
        ]

    def _moved(self, frame: _Fixed, joint: int) -> _Fixed:
        model = self.model
        kind, address = int(model.jnt_type[joint]), int(model.jnt_qposadr[joint])
        index = len(self.links) + 1
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            self.links.append(_Link(0, kind, address, 0.0, np.zeros((4, 3))))
            return _Fixed(index, np.eye(3), np.zeros(3))
        align = np.eye(3)
        if kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            align = _frame_with_z(model.jnt_axis[joint])
        anchor = np.array(model.jnt_pos[joint])
        rotation, position = frame.rotation @ align, frame.position + frame.rotation @ anchor
        combine = np.concatenate([rotation.T, position[None]])
        self.links.append(_Link(frame.link, kind, address, float(model.qpos0[address]), combine))
        return _Fixed(index, align.T, -align.T @ anchor)

    def fixed(self, name: str, prefer: str) -> _Fixed:
        """The frame of a site, a body or "world" by name; `prefer` says which is meant where both exist."""
        model = self.model
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
        if site >= 0 and (prefer == "site" or body < 0):
            return self.sites[site]
        if body >= 0:
            return self.bodies[body]
        known = [model.body(i).name for i in range(model.nbody)] + [model.site(i).name for i in range(model.nsite)]
        raise InputError(f"unknown body or site {name!r}, available: {', '.join(filter(None, known))}")

    def frames(self, qpos: Floats) -> list[_Pose]:
        """Poses of all links at configurations (nq, B)."""
        batch = qpos.shape[1]
        angles = [link.address for link in self.links if link.kind == mujoco.mjtJoint.mjJNT_HINGE]
        zeros = np.array([link.zero for link in self.links if link.kind == mujoco.mjtJoint.mjJNT_HINGE])
        turned = qpos[angles] - zeros[:, None]
        cosines, sines = iter(np.cos(turned)), iter(np.sin(turned))
        poses: list[_Pose] = [(np.broadcast_to(np.eye(3)[:, :, None], (3, 3, batch)), np.zeros((3, batch)))]
        for link in self.links:
            if link.kind == mujoco.mjtJoint.mjJNT_FREE:
                row = qpos[link.address : link.address + 7]
                poses.append((_rotation_from_quat(row[3:]), row[:3]))
                continue
            parent_rotation, parent_position = poses[link.parent]
            if link.parent == 0:
                rows = np.repeat(link.combine.T[:, :, None], batch, axis=2)
            else:
                rows = np.matmul(link.combine, parent_rotation)
            position = parent_position + rows[:, 3]
            rotation = rows[:, :3]
            if link.kind == mujoco.mjtJoint.mjJNT_HINGE:
                cosine, sine, x, y = next(cosines), next(sines), rows[:, 0], rows[:, 1]
                kept = sine * x
                x *= cosine
                x += sine * y
                y *= cosine
                y -= kept
            elif link.kind == mujoco.mjtJoint.mjJNT_SLIDE:
                position += rotation[:, 2] * (qpos[link.address] - link.zero)
            else:
                turn = _rotation_from_quat(qpos[link.address : link.address + 4])
                rotation = np.einsum("ijb,jkb->ikb", rotation, turn)
            poses.append((rotation, position))
        return poses


def _frame_with_z(axis: Floats) -> Floats:
    """A rotation (3, 3) whose z axis is this one."""
    z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


class _Configuration:
    """Poses of frames at B configurations, computed once however many conditions ask for them."""

    def __init__(self, links: list[_Pose]) -> None:
        self._links = links
        self._poses: dict[int, _Pose] = {}

    def pose(self, frame: _Fixed) -> _Pose:
        """T_world_frame: (3, 3, B) and (3, B)."""
        key = id(frame)
        if key not in self._poses:
            rotation, position = self._links[frame.link]
            rows = np.matmul(np.concatenate([frame.rotation.T, frame.position[None]]), rotation)
            self._poses[key] = rows[:, :3], position + rows[:, 3]
        return self._poses[key]

    def relative(self, frame: _Fixed, thing: _Fixed) -> _Pose:
        """T_frame_thing: (3, 3, B) and (3, B)."""
        rotation, position = self.pose(thing)
        if frame.link == 0 and np.array_equal(frame.rotation, np.eye(3)):
            return rotation, position - frame.position[:, None]
        frame_rotation, frame_position = self.pose(frame)
        away = position - frame_position
        return np.einsum("jib,jkb->ikb", frame_rotation, rotation), np.einsum("jib,jb->ib", frame_rotation, away)


_Configurations = Mapping[str | None, _Configuration]


@dataclass(frozen=True)
class _Condition:
    """Names and tolerances of the columns, and the function that fills them with (B,) errors each."""

    columns: tuple[tuple[str, float], ...]
    errors: Callable[[_Configurations, _Stored], list[Floats]]


class _Joints:
    """Limits of hinges, slides and balls, and lengths of the quaternions in `qpos`."""

    def __init__(self, model: mujoco.MjModel) -> None:
        kind, address = np.array(model.jnt_type), np.array(model.jnt_qposadr)
        limited = np.array(model.jnt_limited, dtype=bool)
        ball, free = kind == int(mujoco.mjtJoint.mjJNT_BALL), kind == int(mujoco.mjtJoint.mjJNT_FREE)
        scalar = limited & ~ball & ~free
        self.scalars = address[scalar]
        self.low, self.high = np.array(model.jnt_range)[scalar].T
        self.balls = address[limited & ball]
        self.ball_limit = np.array(model.jnt_range)[limited & ball, 1]
        self.quaternions = np.concatenate([address[ball], address[free] + 3])

    def errors(self, qpos: Floats) -> list[Floats]:
        """Worst excess over a limit and worst deviation from unit length, (B,) each, at qpos (nq, B)."""
        beyond = np.zeros(qpos.shape[1])
        if self.scalars.size:
            q = qpos[self.scalars]
            beyond = np.maximum(beyond, np.maximum(self.low[:, None] - q, q - self.high[:, None]).max(axis=0))
        for address, limit in zip(self.balls, self.ball_limit, strict=True):
            quat = qpos[address : address + 4]
            angle = 2.0 * np.arctan2(_norm(quat[1:]), np.abs(quat[0]))
            beyond = np.maximum(beyond, angle - limit)
        length = np.zeros(qpos.shape[1])
        for address in self.quaternions:
            length = np.maximum(length, np.abs(_norm(qpos[address : address + 4]) - 1.0))
        return [beyond, length]


def _finite_rows(rows: Floats) -> NDArray[np.bool_]:
    """Which rows (N, M) have finite numbers only."""
    finite = np.isfinite(rows)
    return np.ones(len(rows), dtype=bool) if finite.all() else finite.all(axis=1)


# Contacts -----------------------------------------------------------------------------------------------------------


def live_pairs(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Pairs (P, 2) of geoms that MuJoCo's collision filter lets through, by the rules of its documentation.

    Bodies welded together never collide, nor a body with its parent (unless the parent is the world or the filter is
    off), nor excluded bodies; geoms must agree in contype and conaffinity. Predefined pairs are always live.
    """
    contype, conaffinity = model.geom_contype.tolist(), model.geom_conaffinity.tolist()
    body = np.array(model.geom_bodyid)
    weld = np.array(model.body_weldid)
    weld_parent = weld[np.array(model.body_parentid)[weld]]
    excluded = {(int(s) >> 16, int(s) & 0xFFFF) for s in model.exclude_signature}
    filter_parent = not int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    pairs = {(min(a, b), max(a, b)) for a, b in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)}
    for a in range(model.ngeom):
        for b in range(a + 1, model.ngeom):
            body_a, body_b = int(body[a]), int(body[b])
            weld_a, weld_b = weld[body_a], weld[body_b]
            if weld_a == weld_b or (min(body_a, body_b), max(body_a, body_b)) in excluded:
                continue
            if filter_parent and weld_a and weld_b and (weld_a == weld_parent[weld_b] or weld_b == weld_parent[weld_a]):
                continue
            if contype[a] & conaffinity[b] or contype[b] & conaffinity[a]:
                pairs.add((a, b))
    return np.array(sorted(pairs), dtype=np.intp).reshape(-1, 2)


@dataclass
class _Scratch:
    """Memory that one `check` call uses: float32 geom centres and half edges (3, rows, B), and MuJoCo's own data."""

    centre: Floats
    edge: Floats
    data: mujoco.MjData


@dataclass(frozen=True)
class _Partners:
    """A row, the rows it may meet (a slice where they are adjacent), and the squared sums of bounding radii (P, 1)."""

    row: int
    others: slice | NDArray[np.intp]
    indices: NDArray[np.intp]
    reach_squared: Floats


@dataclass(frozen=True)
class _FixedBox:
    """A box that does not move, with its pose and half sizes, and the rows whose spheres may meet it."""

    row: int
    rotation: Floats
    position: Floats
    half: Floats
    aligned: bool
    others: slice | NDArray[np.intp]
    indices: NDArray[np.intp]
    reach_squared: Floats


class _Contacts:
    """Deepest penetration of configurations, by proof of separation first and C MuJoCo for the rest.

    Every geom is a core and a radius: a sphere's core is a point, a capsule's a segment, a box's itself; ellipsoids,
    cylinders and meshes are enclosed by their bounding boxes. Of anything else nothing is proved. Rows are geoms sorted
    by the link that carries them; `edge` holds the half edges of the cores (one of a segment, three of a box).
    """

    def __init__(self, model: mujoco.MjModel, kinematics: _Kinematics) -> None:
        self.model = copy.copy(model)
        self.model.geom_margin[:] = 0.0
        self.model.pair_margin[:] = 0.0
        self.model.opt.o_margin = 0.0
        for flag in (mujoco.mjtDisableBit.mjDSBL_CONTACT, mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
            self.model.opt.disableflags &= ~int(flag)
        geoms = [_geom_core(model, kinematics, geom) for geom in range(model.ngeom)]
        order = sorted(range(model.ngeom), key=lambda geom: geoms[geom].link)
        self.cores = [geoms[geom] for geom in order]
        row_of = np.empty(model.ngeom, dtype=np.intp)
        row_of[order] = np.arange(model.ngeom)
        counts = [len(core.edges) for core in self.cores]
        self.first_edge = np.concatenate([[0], np.cumsum(counts)]).astype(np.intp)
        self.box = np.array([core.is_box for core in self.cores], dtype=bool)
        self.bound = np.array([core.bound for core in self.cores])
        self.reach = np.array([core.radius + 0.5 * _CLEARANCE for core in self.cores], dtype=np.float32)
        kinds = np.array(model.geom_type)[order]
        self.capsule_radius = np.where(
            kinds == int(mujoco.mjtGeom.mjGEOM_CAPSULE), [core.radius for core in self.cores], 0.0
        )
        self.solid = kinds == int(mujoco.mjtGeom.mjGEOM_BOX)
        self.groups = self._group_by_link()
        pairs = np.sort(row_of[live_pairs(model)], axis=1)
        provable = np.array([core.provable for core in self.cores], dtype=bool)
        self.never_proved = bool(model.nflex) or not provable[pairs].all()
        either = np.concatenate([pairs, pairs[:, ::-1]])
        self.capsule_box = either[(self.capsule_radius[either[:, 0]] > 0.0) & self.solid[either[:, 1]]]
        self._spare: list[_Scratch] = []
        self.fixed_boxes: list[_FixedBox] = []
        self.partners: list[_Partners] = []
        for row in np.unique(pairs[:, 0]).tolist():
            indices = pairs[pairs[:, 0] == row, 1]
            core = self.cores[row]
            if core.link == 0 and core.is_box:
                reach = _squared_reach(self.bound[indices])
                rotation, half = core.box_axes()
                aligned = np.array_equal(rotation, np.eye(3))
                position = core.centre.astype(np.float32)
                box = _FixedBox(row, rotation, position, half, aligned, _as_slice(indices), indices, reach)
                self.fixed_boxes.append(box)
            else:
                reach = _squared_reach(self.bound[indices] + core.bound)
                self.partners.append(_Partners(row, _as_slice(indices), indices, reach))

    def _group_by_link(self) -> list[tuple[int, slice, slice, Floats]]:
        """Per link: rows of centres, rows of edges and their vectors in the link, so that one product fills them."""
        groups = []
        links = np.array([core.link for core in self.cores])
        for link in np.unique(links).tolist():
            first, last = np.flatnonzero(links == link)[[0, -1]].tolist()
            cores = self.cores[first : last + 1]
            vectors = [core.centre for core in cores] + [edge for core in cores for edge in core.edges]
            edges = slice(int(self.first_edge[first]), int(self.first_edge[last + 1]))
            groups.append((link, slice(first, last + 1), edges, np.array(vectors)))
        return groups

    def borrow(self, batch: int) -> _Scratch:
        """Memory for so many configurations that no other thread uses; new memory costs more than filling it."""
        try:
            scratch = self._spare.pop()
        except IndexError:
            return self.scratch(batch)
        return scratch if scratch.centre.shape[2] >= batch else self.scratch(batch)

    def give_back(self, scratch: _Scratch) -> None:
        self._spare.append(scratch)

    def scratch(self, batch: int) -> _Scratch:
        centre = np.zeros((3, len(self.cores), batch), dtype=np.float32)
        edge = np.zeros((3, int(self.first_edge[-1]), batch), dtype=np.float32)
        for link, of_geoms, of_edges, vectors in self.groups:
            if link == 0:
                count = of_geoms.stop - of_geoms.start
                centre[:, of_geoms], edge[:, of_edges] = vectors[:count].T[..., None], vectors[count:].T[..., None]
        return _Scratch(centre, edge, mujoco.MjData(self.model))

    def penetration(self, qpos: Floats, links: list[_Pose], scratch: _Scratch) -> Floats:
        """Deepest penetration (B,) in m at qpos (nq, B), zero where nothing touches.

        A capsule whose segment meets a box counts for its radius at least.
        """
        batch = qpos.shape[1]
        depth = np.zeros(batch)
        model, data = self.model, scratch.data
        self._fill(links, scratch, batch)
        if self.never_proved or batch < _WORTH_PROVING:
            capsule, box, lane = self._near_boxes(scratch.centre[:, :, :batch])
            asked = np.arange(batch)
        else:
            capsule, box, lane = self.unproved(scratch, batch)
            asked = np.unique(lane)
        for index in asked:
            data.qpos[:] = qpos[:, index]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            if data.ncon:
                depth[index] = max(0.0, -data.contact.dist.min())
        pierced = self._pierced(capsule, box, lane, scratch)
        np.maximum.at(depth, lane[pierced], self.capsule_radius[capsule[pierced]])
        return depth

    def unproved(self, scratch: _Scratch, batch: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Pairs of rows, with the lane, for which no proof was found that they are apart; of two kinds, a box is second."""
        first, second, lane = self._near(scratch.centre[:, :, :batch])
        left: list[tuple[NDArray[np.intp], ...]] = [(np.zeros(0, dtype=np.intp),) * 3]
        boxes = self.box[first].astype(np.int8) + self.box[second]
        for count in range(3):
            chosen = np.flatnonzero(boxes == count)
            if not chosen.size:
                continue
            a, b, at_lane = first[chosen], second[chosen], lane[chosen]
            if count == 0:
                apart = self._segments_apart(a, b, at_lane, scratch)
            else:
                swap = self.box[a] & ~self.box[b]
                a, b = np.where(swap, b, a), np.where(swap, a, b)
                apart = self._boxes_apart(a, b, at_lane, scratch, edges=1 if count == 1 else 3)
            left.append((a[~apart], b[~apart], at_lane[~apart]))
        a, b, at_lane = (np.concatenate(parts) for parts in zip(*left, strict=True))
        return a, b, at_lane

    def _fill(self, links: list[_Pose], scratch: _Scratch, batch: int) -> None:
        for link, of_geoms, of_edges, vectors in self.groups:
            if link == 0:
                continue
            rotation, position = links[link]
            rows = np.matmul(vectors, rotation)
            count = of_geoms.stop - of_geoms.start
            np.add(rows[:, :count], position[:, None], out=scratch.centre[:, of_geoms, :batch], casting="same_kind")
            scratch.edge[:, of_edges, :batch] = rows[:, count:]

    def _near(self, centre: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Pairs of rows, with the lane, where bounding spheres touch, or one touches a box that stands still."""
        first, second, lanes = [], [], []

        def note(row: int, indices: NDArray[np.intp], touching: NDArray[np.bool_]) -> None:
            which, lane = divmod(np.flatnonzero(touching), touching.shape[1])
            first.append(np.full(which.size, row))
            second.append(indices[which])
            lanes.append(lane)

        for box in self.fixed_boxes:
            outside = centre[:, box.others] - box.position[:, None, None]
            if not box.aligned:
                outside = np.matmul(box.rotation.T, outside.reshape(3, -1)).reshape(outside.shape)
            np.abs(outside, out=outside)
            outside -= box.half[:, None, None]
            np.maximum(outside, 0.0, out=outside)
            note(box.row, box.indices, np.einsum("ijb,ijb->jb", outside, outside) < box.reach_squared)
        for partners in self.partners:
            away = centre[:, partners.others] - centre[:, partners.row : partners.row + 1]
            note(partners.row, partners.indices, np.einsum("ijb,ijb->jb", away, away) < partners.reach_squared)
        if not first:
            return (np.zeros(0, dtype=np.intp),) * 3
        return np.concatenate(first), np.concatenate(second), np.concatenate(lanes)

    def _near_boxes(self, centre: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Rows of capsules and of boxes, with the lane, where bounding spheres touch."""
        capsule, box = self.capsule_box.T
        away = centre[:, capsule] - centre[:, box]
        reach = _squared_reach(self.bound[capsule] + self.bound[box])
        which, lane = np.nonzero(np.einsum("ijb,ijb->jb", away, away) < reach)
        return capsule[which], box[which], lane

    def _pierced(
        self, a: NDArray[np.intp], b: NDArray[np.intp], lane: NDArray[np.intp], scratch: _Scratch
    ) -> NDArray[np.intp]:
        """Positions in these pairs of the capsules, first, whose segment c + s u, s in [-1, 1], meets a box, second.

        Between the box's two planes across each of its half edges e, |(c + s u) . e| <= e . e, s is in an interval; the
        segment meets the box when the three and [-1, 1] have a point in common. Single precision is enough: a segment that
        misses the box by its rounding is nearly a radius deep.
        """
        chosen = np.flatnonzero((self.capsule_radius[a] > 0.0) & self.solid[b])
        a, b, lane = a[chosen], b[chosen], lane[chosen]
        away = _gather(scratch.centre, a, lane) - _gather(scratch.centre, b, lane)
        u = _gather(scratch.edge, self.first_edge[a], lane)
        first, last = np.full(len(a), -1.0, dtype=np.float32), np.ones(len(a), dtype=np.float32)
        for j in range(3):
            edge = _gather(scratch.edge, self.first_edge[b] + j, lane)
            along, squared = _dot(u, edge), _dot(edge, edge)
            along = np.where(np.abs(along) < _TINY, _TINY, along)
            middle, half = -_dot(away, edge) / along, squared / np.abs(along)
            np.maximum(first, middle - half, out=first)
            np.minimum(last, middle + half, out=last)
        return chosen[first <= last]

    def _segments_apart(
        self, a: NDArray[np.intp], b: NDArray[np.intp], lane: NDArray[np.intp], scratch: _Scratch
    ) -> NDArray[np.bool_]:
        """Two segments c + s u and c' + t v, with s and t in [-1, 1]: the direction between their nearest points."""
        away = _gather(scratch.centre, a, lane) - _gather(scratch.centre, b, lane)
        u, v = _gather(scratch.edge, self.first_edge[a], lane), _gather(scratch.edge, self.first_edge[b], lane)
        uu, vv, uv = np.maximum(_dot(u, u), _TINY), np.maximum(_dot(v, v), _TINY), _dot(u, v)
        ua, va = _dot(u, away), _dot(v, away)
        s = np.clip((uv * va - vv * ua) / np.maximum(uu * vv - uv * uv, _TINY), -1.0, 1.0)
        t = np.clip((s * uv + va) / vv, -1.0, 1.0)
        s = np.clip((t * uv - ua) / uu, -1.0, 1.0)
        return _separates(away + s * u - t * v, away, (u, v), self.reach[a] + self.reach[b])

    def _boxes_apart(
        self, a: NDArray[np.intp], b: NDArray[np.intp], lane: NDArray[np.intp], scratch: _Scratch, edges: int
    ) -> NDArray[np.bool_]:
        """A box, second, and a core with so many half edges: the box's faces first, then directions between points.

        The points come from projecting to and fro between the two cores, which converges to the nearest points.
        """
        away = _gather(scratch.centre, a, lane) - _gather(scratch.centre, b, lane)
        ours = [_gather(scratch.edge, self.first_edge[a] + j, lane) for j in range(edges)]
        box = [_gather(scratch.edge, self.first_edge[b] + j, lane) for j in range(3)]
        reach = self.reach[a] + self.reach[b]
        box_squared = [np.maximum(_dot(edge, edge), _TINY) for edge in box]
        apart = np.zeros(len(a), dtype=bool)
        for normal, squared in zip(box, box_squared, strict=True):
            gap = np.abs(_dot(normal, away)) - squared
            for edge in ours:
                gap -= np.abs(_dot(normal, edge))
            apart |= (gap > 0.0) & (gap * gap > reach * reach * squared)
        left = np.flatnonzero(~apart)
        if not left.size:
            return apart
        away, reach = away[:, left], reach[left]
        ours, box = [edge[:, left] for edge in ours], [edge[:, left] for edge in box]
        ours_squared = [np.maximum(_dot(edge, edge), _TINY) for edge in ours]
        box_squared = [squared[left] for squared in box_squared]
        point = away
        proved = np.zeros(left.size, dtype=bool)
        for _ in range(_PROJECTIONS):
            nearest = np.zeros_like(point)
            for edge, squared in zip(box, box_squared, strict=True):
                nearest += np.clip(_dot(point, edge) / squared, -1.0, 1.0) * edge
            proved |= _separates(point - nearest, away, (*ours, *box), reach)
            if proved.all():
                break
            back = nearest - away
            point = away.copy()
            for edge, squared in zip(ours, ours_squared, strict=True):
                point += np.clip(_dot(back, edge) / squared, -1.0, 1.0) * edge
        apart[left] = proved
        return apart


@dataclass(frozen=True)
class _Core:
    """A geom as a core and a radius, in the frame of the link that carries it (m)."""

    link: int
    centre: Floats
    edges: tuple[Floats, ...]
    radius: float
    provable: bool

    @property
    def is_box(self) -> bool:
        return len(self.edges) == 3

    @property
    def bound(self) -> float:
        """Radius of the bounding sphere."""
        return float(np.sqrt(sum(edge @ edge for edge in self.edges)) + self.radius)

    def box_axes(self) -> tuple[Floats, Floats]:
        """Axes (3, 3) as columns and half sizes (3,), float32, of a box."""
        half = np.array([np.linalg.norm(edge) for edge in self.edges])
        return (np.array(self.edges) / half[:, None]).T.astype(np.float32), half.astype(np.float32)


def _geom_core(model: mujoco.MjModel, kinematics: _Kinematics, geom: int) -> _Core:
    frame = kinematics.bodies[model.geom_bodyid[geom]].then(model.geom_pos[geom], model.geom_quat[geom])
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), np.array(model.geom_size[geom])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return _Core(frame.link, frame.position, (np.zeros(3),), float(size[0]), True)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return _Core(frame.link, frame.position, (frame.rotation[:, 2] * size[1],), float(size[0]), True)
    centre, half = np.array(model.geom_aabb[geom, :3]), np.array(model.geom_aabb[geom, 3:])
    boxed = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_ELLIPSOID)
    provable = kind in (*boxed, mujoco.mjtGeom.mjGEOM_MESH) and bool((half > 0).all())
    edges = tuple(frame.rotation[:, axis] * half[axis] for axis in range(3))
    return _Core(frame.link, frame.position + frame.rotation @ centre, edges, 0.0, provable)


def _squared_reach(radii: Floats) -> Floats:
    """Squares (P, 1) of these radii, widened well beyond float32 rounding."""
    return ((radii + _CLEARANCE) ** 2 * (1.0 + 1e-5)).astype(np.float32)[:, None]


def _as_slice(indices: NDArray[np.intp]) -> slice | NDArray[np.intp]:
    """The same rows as a slice, which numpy reads without a copy, where they are adjacent."""
    adjacent = indices.size and int(indices[-1]) - int(indices[0]) + 1 == indices.size
    return slice(int(indices[0]), int(indices[-1]) + 1) if adjacent else indices


def _gather(table: Floats, rows: NDArray[np.intp], lane: NDArray[np.intp]) -> Floats:
    """Vectors (3, M) at the given rows and lanes of a table (3, rows, B)."""
    return table.reshape(3, -1).take(rows * table.shape[2] + lane, axis=1)


def _dot(a: Floats, b: Floats) -> Floats:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _separates(normal: Floats, away: Floats, edges: Sequence[Floats], reach: Floats) -> NDArray[np.bool_]:
    """Whether the slab across this direction (3, M), of any length, keeps two cores further apart than `reach` (M,)."""
    gap = np.abs(_dot(normal, away))
    for edge in edges:
        gap -= np.abs(_dot(normal, edge))
    return (gap > 0.0) & (gap * gap > reach * reach * _dot(normal, normal))
