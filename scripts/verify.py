"""Check every sample of a samples.npz in float64 with C MuJoCo and numpy alone.

    python scripts/verify.py samples.npz [--json] [--limit N]

It shares no code with the package that made the file. Exit status: 0 when every sample passes (also when there are
none), 1 when one fails, 2 for bad input.
"""

from __future__ import annotations

import argparse
import glob
import json
import os
import sys
import zipfile
from collections import defaultdict
from typing import NoReturn

import mujoco
import numpy as np

SCHEMA = "cgs_jax/1"
KEYS = (
    "schema mjcf variables mode_switches qpos attachments placements goals sequences sequence elapsed violation"
    " constraints meta"
).split()

METRES = 1e-4
RADIANS = 1e-4
PENETRATION = 1e-4
LIMIT = 1e-6
QUATERNION = 1e-6

# Keys that a file may have beside these.
FURTHER = "configurations"

# Columns of `violation` that begin so are of constraints and variables that the maker of the file added as code.
OWN = "own: "

# What each line of the report may be at most.
ALLOWED = {
    "finite numbers": 0.0,
    "attachment position (m)": METRES,
    "attachment rotation (rad)": RADIANS,
    "grasp position (m)": METRES,
    "grasp rotation (rad)": RADIANS,
    "placement position (m)": METRES,
    "placement rotation (rad)": RADIANS,
    "goal position (m)": METRES,
    "goal rotation (rad)": RADIANS,
    "penetration (m)": PENETRATION,
    "joint limits (rad or m)": LIMIT,
    "configurations (rad or m)": LIMIT,
    "unit quaternions": QUATERNION,
}


class BadInput(Exception):
    """One line for the user."""


def read(path: str) -> dict:
    """All arrays of the file, checked for keys, types and shapes.

    A folder stands for its samples.npz or, where a run was killed before it wrote that, for the parts that it had written.
    """
    if os.path.isdir(path):
        path = os.path.join(path, "samples.npz")
    if not os.path.exists(path):
        folder, name = os.path.split(path)
        parts = sorted(glob.glob(os.path.join(glob.escape(folder), "samples.parts", "[0-9]*.npz")))
        if parts and name == "samples.npz":
            return joined([read(part) for part in parts])
        raise BadInput(f"no such file: {path}")
    try:
        with np.load(path, allow_pickle=False) as archive:
            data = {key: archive[key] for key in archive.files}
    except Exception as error:
        # NumPy takes whatever is no archive for a pickle, and says how to load it unsafely.
        other = isinstance(error, ValueError) and not zipfile.is_zipfile(path)
        raise BadInput(f"{path} is no readable .npz: {'it is no archive' if other else first_line(error)}") from None
    if str(data.get("schema")) != SCHEMA:
        raise BadInput(f"{path} has schema {data.get('schema')}, expected {SCHEMA}")
    missing = [key for key in KEYS if key not in data]
    if missing:
        raise BadInput(f"{path} lacks the keys {', '.join(missing)}")
    for key in ("variables", "mode_switches", "sequences", "constraints"):
        if data[key].ndim != 1:
            raise BadInput(f"{key} has shape {data[key].shape}, expected one row of names")
        data[key] = [str(name) for name in data[key]]
    data.setdefault(FURTHER, np.array("[]"))
    for key in ("attachments", "placements", "goals", FURTHER, "meta"):
        try:
            data[key] = json.loads(str(data[key]))
        except json.JSONDecodeError as error:
            raise BadInput(f"{key} is no JSON: {first_line(error)}") from None
        if not isinstance(data[key], dict if key == "meta" else list):
            expected = "an object" if key == "meta" else "a list"
            raise BadInput(f"{key} is a {type(data[key]).__name__}, expected {expected} in JSON")
    qpos = data["qpos"]
    if qpos.ndim != 3 or qpos.dtype != np.float64:
        raise BadInput(f"qpos is {qpos.dtype} of shape {qpos.shape}, expected float64 of shape (N, K, nq)")
    count = len(qpos)
    switches = len(data["mode_switches"])
    if qpos.shape[1] != switches:
        raise BadInput(f"qpos has {qpos.shape[1]} mode switches, expected the {switches} of mode_switches")
    for name in data["variables"]:
        if f"x_{name}" not in data:
            raise BadInput(f"{path} lacks the key x_{name}")
        require_shape(f"x_{name}", data[f"x_{name}"], (count, None))
    require_shape("sequence", data["sequence"], (count,))
    require_shape("elapsed", data["elapsed"], (count,))
    require_shape("violation", data["violation"], (count, len(data["constraints"])))
    sequences = len(data["sequences"])
    if not np.isin(data["sequence"], np.arange(sequences)).all():
        raise BadInput(f"sequence holds a value that is no index into the {sequences} sequences")
    return data


def joined(parts: list[dict]) -> dict:
    """The samples of several files of one run in one; their `sequence` loses its meaning, which nothing here asks for."""
    first = parts[0]
    rows = ["qpos", "sequence", "elapsed", "violation", *(f"x_{name}" for name in first["variables"])]
    for part in parts[1:]:
        if any(str(part[key]) != str(first[key]) for key in ("mjcf", "variables", "attachments", "placements", "goals")):
            raise BadInput("the parts are not of one run: remove those of the other")
    return first | {key: np.concatenate([part[key] for part in parts]) for key in rows}


def require_shape(key: str, array: np.ndarray, expected: tuple) -> None:
    """`None` in the expected shape leaves that length open."""
    same = array.ndim == len(expected)
    same = same and all(want in (None, got) for got, want in zip(array.shape, expected, strict=True))
    if not same or not np.issubdtype(array.dtype, np.number):
        raise BadInput(f"{key} is {array.dtype} of shape {array.shape}, expected numbers of shape {expected}")


def first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


# Rotations as unit quaternions (..., 4), w first.


def conjugate(quat: np.ndarray) -> np.ndarray:
    return quat * np.array([1.0, -1.0, -1.0, -1.0])


def multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    return np.concatenate([pw * qw - (pv * qv).sum(-1, keepdims=True), pw * qv + qw * pv + np.cross(pv, qv)], axis=-1)


def rotate(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    across = 2.0 * np.cross(quat[..., 1:], vector)
    return vector + quat[..., :1] * across + np.cross(quat[..., 1:], across)


def normalised(quat: np.ndarray) -> np.ndarray:
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def angle_of(quat: np.ndarray) -> np.ndarray:
    return 2.0 * np.arctan2(np.linalg.norm(quat[..., 1:], axis=-1), np.abs(quat[..., 0]))


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))


def relative(frame: tuple, thing: tuple) -> tuple:
    """Pose of the thing in the frame: inverse(T_world_frame) * T_world_thing."""
    inverse = conjugate(frame[1])
    return rotate(inverse, thing[0] - frame[0]), multiply(inverse, thing[1])


def difference(a: tuple, b: tuple) -> tuple:
    """Metres and radians between two poses."""
    return np.linalg.norm(a[0] - b[0], axis=-1), angle_of(multiply(conjugate(a[1]), b[1]))


def outside(position: np.ndarray, low: list, high: list) -> np.ndarray:
    return np.maximum(np.maximum(np.array(low) - position, position - np.array(high)).max(-1), 0.0)


def segments_meet_box(centre: np.ndarray, axis: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Whether (P,) the segments (P, 3) from centre - axis to centre + axis, given in the box's frame, meet the box."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort(np.stack([(-half - centre) / axis, (half - centre) / axis]), axis=0)
    # Parallel to two faces: between them all along, or nowhere.
    always = np.array([-np.inf, np.inf])[:, None, None]
    ends = np.where(axis == 0.0, np.where(np.abs(centre) <= half, always, -always), ends)
    return np.maximum(ends[0].max(axis=1), -1.0) <= np.minimum(ends[1].min(axis=1), 1.0)


def capsule_box_pairs(model: mujoco.MjModel) -> np.ndarray:
    """Geoms (P, 2) that MuJoCo's filters let collide, a capsule and a box each."""
    excluded = {(int(both) >> 16, int(both) & 0xFFFF) for both in model.exclude_signature}
    explicit = {frozenset(map(int, both)) for both in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    filter_parent = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)

    def collide(a: int, b: int) -> bool:
        if frozenset((a, b)) in explicit:
            return True
        bodies = sorted(int(model.geom_bodyid[geom]) for geom in (a, b))
        # Bodies welded together count as one; so do all that are fixed in the world, whose parents do not matter.
        one, other = (int(model.body_weldid[body]) for body in bodies)
        parents = [int(model.body_weldid[model.body_parentid[weld]]) for weld in (one, other)]
        related = filter_parent and one and other and (one == parents[1] or other == parents[0])
        bits = model.geom_contype[a] & model.geom_conaffinity[b] or model.geom_contype[b] & model.geom_conaffinity[a]
        return bool(bits) and one != other and not related and tuple(bodies) not in excluded

    kinds = (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX)
    capsules, boxes = (np.flatnonzero(model.geom_type == int(kind)).tolist() for kind in kinds)
    return np.array([(a, b) for a in capsules for b in boxes if collide(a, b)], dtype=int).reshape(-1, 2)


class Scene:
    """Poses of named frames, and contacts, by C MuJoCo."""

    def __init__(self, mjcf: str) -> None:
        try:
            self.model = mujoco.MjModel.from_xml_string(mjcf)
        except ValueError as error:
            raise BadInput(f"mjcf does not compile: {first_line(error)}") from None
        model = self.model
        model.geom_margin[:] = 0.0
        model.pair_margin[:] = 0.0
        model.opt.o_margin = 0.0
        for flag in (mujoco.mjtDisableBit.mjDSBL_CONTACT, mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
            model.opt.disableflags &= ~int(flag)
        self.data = mujoco.MjData(model)
        self.capsule_box = capsule_box_pairs(model)

    def find(self, name: str, kinds: str) -> tuple[str, int]:
        """Where a name is: kinds "body site" prefers a body."""
        for kind in kinds.split():
            found = mujoco.mj_name2id(self.model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), str(name))
            if found >= 0:
                return kind, found
        raise BadInput(f"mjcf has no {kinds.replace(' ', ' or ')} named {name!r}")

    def evaluate(self, qpos: np.ndarray, wanted: list[tuple[str, int]]) -> tuple[dict, np.ndarray]:
        """Poses ((B, 3), (B, 4)) of the wanted frames and the deepest penetration (B,) at qpos (B, nq).

        MuJoCo has no contact for a capsule that passes right through a box with both ends far outside: one whose axis meets a
        box counts for its radius at least.
        """
        model, data = self.model, self.data
        bodies = [index for kind, index in wanted if kind == "body"]
        sites = [index for kind, index in wanted if kind == "site"]
        position = np.empty((len(qpos), len(wanted), 3))
        quat = np.empty((len(qpos), len(wanted), 4))
        penetration = np.zeros(len(qpos))
        site_quat = np.empty(4)
        geom_position = np.empty((len(qpos), model.ngeom, 3))
        geom_frame = np.empty((len(qpos), model.ngeom, 9))
        for row, configuration in enumerate(qpos):
            data.qpos[:] = configuration
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            position[row, : len(bodies)], quat[row, : len(bodies)] = data.xpos[bodies], data.xquat[bodies]
            for column, site in enumerate(sites, start=len(bodies)):
                mujoco.mju_mat2Quat(site_quat, data.site_xmat[site])
                position[row, column], quat[row, column] = data.site_xpos[site], site_quat
            if data.ncon:
                penetration[row] = max(0.0, -data.contact.dist.min())
            geom_position[row], geom_frame[row] = data.geom_xpos, data.geom_xmat
        for capsule, box in self.capsule_box:
            away = geom_position[:, capsule] - geom_position[:, box]
            near = np.flatnonzero(np.linalg.norm(away, axis=1) < model.geom_rbound[capsule] + model.geom_rbound[box])
            radius, length = model.geom_size[capsule, :2]
            frame = geom_frame[near, box].reshape(-1, 3, 3)
            axis = length * geom_frame[near, capsule, 2::3]
            centre, axis = (np.einsum("pji,pj->pi", frame, vector) for vector in (away[near], axis))
            pierced = near[segments_meet_box(centre, axis, model.geom_size[box])]
            penetration[pierced] = np.maximum(penetration[pierced], radius)
        ordered = [("body", index) for index in bodies] + [("site", index) for index in sites]
        return {frame: (position[:, i], quat[:, i]) for i, frame in enumerate(ordered)}, penetration


class Verification:
    """Collects, per line of the report, the worst violation of each sample."""

    def __init__(self, data: dict, limit: int | None) -> None:
        self.data = data
        self.count = len(data["qpos"]) if limit is None else min(limit, len(data["qpos"]))
        self.switches = data["mode_switches"]
        self.scene = Scene(str(data["mjcf"]))
        if data["qpos"].shape[2] != self.scene.model.nq:
            raise BadInput(f"qpos has {data['qpos'].shape[2]} columns, expected the {self.scene.model.nq} of the mjcf")
        self.errors: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(self.count))
        self.notes: list[str] = []

    def note(self, check: str, error: np.ndarray) -> None:
        self.errors[check] = np.maximum(self.errors[check], error)

    def switch(self, name: str) -> str:
        if name not in self.switches:
            raise BadInput(f"unknown mode switch {name!r}, expected one of {', '.join(self.switches)}")
        return name

    def run(self) -> None:
        self.qpos = self.data["qpos"][: self.count]
        finite = np.isfinite(self.qpos).all(axis=(1, 2)) & np.isfinite(self.data["elapsed"][: self.count])
        finite &= np.isfinite(self.data["violation"][: self.count]).all(axis=1)
        for name in self.data["variables"]:
            finite &= np.isfinite(self.data[f"x_{name}"][: self.count]).all(axis=1)
        self.note("finite numbers", (~finite).astype(float))
        # A configuration that is not finite already failed; the other checks see the initial one in its place.
        self.qpos = np.where(finite[:, None, None], self.qpos, self.scene.model.qpos0)
        self.finite = finite
        wanted = self.collect_frames()
        self.poses, penetration = {}, np.zeros(self.count)
        for k, name in enumerate(self.switches):
            self.poses[name], depth = self.scene.evaluate(self.qpos[:, k], wanted)
            penetration = np.maximum(penetration, depth)
        self.poses[None], _ = self.scene.evaluate(self.scene.model.qpos0[None], wanted)
        self.note("penetration (m)", penetration)
        self.check_joints()
        for entry in self.data[FURTHER]:
            self.check_configuration(entry)
        for entry in self.data["attachments"]:
            self.check_attachment(entry)
        for entry in self.data["placements"]:
            self.check_placement(entry)
        for entry in self.data["goals"]:
            self.check_goal(entry)

    def collect_frames(self) -> list[tuple[str, int]]:
        """Every frame that an entry names; also finds what is missing before any work is done."""
        wanted = set()
        try:
            for entry in self.data["attachments"]:
                for switch in (entry["from"], entry["to"]):
                    if switch is not None:
                        self.switch(switch)
                if entry["to"] is None:
                    raise BadInput("an attachment ends at null, expected a mode switch")
                wanted |= {self.scene.find(entry["frame"], "site body"), self.scene.find(entry["object"], "body site")}
                grasp = entry.get("grasp")
                if grasp and grasp["kind"] == "touch":
                    if not grasp["sites"]:
                        raise BadInput("a touch grasp names no site, expected at least one")
                    wanted |= {self.scene.find(site, "site") for site in grasp["sites"]}
                elif grasp and grasp["kind"] == "two_finger":
                    (grasp["rows"], grasp["low"], grasp["high"])
                elif grasp:
                    raise BadInput(f"unknown grasp kind {grasp['kind']!r}, expected touch or two_finger")
            for entry in self.data[FURTHER]:
                self.switch(entry["at"])
                for joint in entry["joints"]:
                    self.scene.find(joint, "joint")
                if "variable" not in entry:
                    entry["values"]
            for entry in self.data["placements"]:
                self.switch(entry["at"])
                (entry["low"], entry["high"])
                wanted.add(self.scene.find(entry["object"], "body site"))
            for entry in self.data["goals"]:
                self.switch(entry["at"])
                (entry["position"], entry["rotation"])
                wanted |= {self.scene.find(entry["object"], "body site"), self.scene.find(entry["site"], "site")}
        except (KeyError, TypeError) as error:
            what = "an attachment, placement, goal or configuration"
            raise BadInput(f"{what} is incomplete: {type(error).__name__} {error}") from None
        return sorted(wanted)

    def at(self, switch: str | None, name: str, kinds: str) -> tuple:
        return self.poses[switch][self.scene.find(name, kinds)]

    def check_joints(self) -> None:
        model, qpos = self.scene.model, self.qpos
        beyond, deviation = np.zeros(self.count), np.zeros(self.count)
        for joint in range(model.njnt):
            kind, address = int(model.jnt_type[joint]), int(model.jnt_qposadr[joint])
            low, high = model.jnt_range[joint]
            if kind == int(mujoco.mjtJoint.mjJNT_FREE):
                address += 3
            if kind in (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)):
                quat = qpos[:, :, address : address + 4]
                deviation = np.maximum(deviation, np.abs(np.linalg.norm(quat, axis=-1) - 1.0).max(axis=1))
                if kind == int(mujoco.mjtJoint.mjJNT_BALL) and model.jnt_limited[joint]:
                    beyond = np.maximum(beyond, (angle_of(quat) - high).max(axis=1))
            elif model.jnt_limited[joint]:
                value = qpos[:, :, address]
                beyond = np.maximum(beyond, np.maximum(low - value, value - high).max(axis=1))
        self.note("joint limits (rad or m)", beyond)
        self.note("unit quaternions", deviation)

    def check_configuration(self, entry: dict) -> None:
        """The joints stand where the stored variable says, or where they rest."""
        joints = [self.scene.find(joint, "joint")[1] for joint in entry["joints"]]
        shown = self.qpos[:, self.switches.index(entry["at"]), self.scene.model.jnt_qposadr[joints]]
        if "variable" in entry:
            variable, names = entry["variable"], self.data["variables"]
            if variable not in names or self.data[f"x_{variable}"].shape[1] != len(joints):
                raise BadInput(
                    f"a configuration names the variable {variable!r}, expected one of {len(joints)} columns among "
                    f"{', '.join(names)}"
                )
            stored = self.data[f"x_{variable}"][: self.count].astype(float)
        else:
            stored = np.array(entry["values"], dtype=float)
            if stored.shape != (len(joints),):
                raise BadInput(f"a configuration has values of shape {stored.shape}, expected {(len(joints),)}")
        self.note("configurations (rad or m)", np.where(self.finite, np.abs(shown - stored).max(axis=1, initial=0.0), 0.0))

    def check_stored(self, check: str, variable: str | None, pose: tuple) -> None:
        """Where an entry names its variable, the stored pose is what `qpos` shows."""
        if variable is None:
            return
        names = self.data["variables"]
        if variable not in names or self.data[f"x_{variable}"].shape[1] != 7:
            raise BadInput(f"{check} names the variable {variable!r}, expected a pose among {', '.join(names)}")
        stored = np.where(self.finite[:, None], self.data[f"x_{variable}"][: self.count], [0, 0, 0, 1, 0, 0, 0])
        stored = stored.astype(float)
        length = np.abs(np.linalg.norm(stored[:, 3:], axis=1) - 1.0)
        # Poses may be stored in float32, whose unit quaternions are exact to 1e-7 only.
        self.note("unit quaternions", length)
        metres, radians = difference(pose, (stored[:, :3], normalised(stored[:, 3:])))
        self.note(f"{check} position (m)", np.where(self.finite, metres, 0.0))
        self.note(f"{check} rotation (rad)", np.where(self.finite, radians, 0.0))

    def check_attachment(self, entry: dict) -> None:
        ends = [entry["from"], entry["to"]]
        frames = [self.at(switch, entry["frame"], "site body") for switch in ends]
        things = [self.at(switch, entry["object"], "body site") for switch in ends]
        held = [relative(frame, thing) for frame, thing in zip(frames, things, strict=True)]
        metres, radians = difference(*held)
        self.note("attachment position (m)", metres)
        self.note("attachment rotation (rad)", radians)
        grasp = entry.get("grasp")
        for switch, frame, thing, pose in zip(ends, frames, things, held, strict=True):
            self.check_stored("attachment", entry.get("variable"), pose)
            if not grasp or switch is None:
                continue
            if grasp["kind"] == "touch":
                self.check_touch(frame, [self.at(switch, site, "site") for site in grasp["sites"]])
            else:
                self.check_two_finger(frame, thing, grasp)

    def check_touch(self, frame: tuple, sites: list[tuple]) -> None:
        """The gripper's origin on one of the sites, z axes opposed: the best of the sites counts."""
        up = np.array([0.0, 0.0, 1.0])
        metres = np.stack([np.linalg.norm(frame[0] - site[0], axis=-1) for site in sites])
        radians = np.stack([angle_between(rotate(frame[1], up), -rotate(site[1], up)) for site in sites])
        best = np.maximum(metres / METRES, radians / RADIANS).argmin(axis=0)
        lanes = np.arange(self.count)
        self.note("grasp position (m)", metres[best, lanes])
        self.note("grasp rotation (rad)", radians[best, lanes])

    def check_two_finger(self, frame: tuple, thing: tuple, grasp: dict) -> None:
        position, _ = relative(thing, frame)
        self.note("grasp position (m)", outside(position, grasp["low"], grasp["high"]))
        for gripper_axis, object_axis, dot in grasp["rows"]:
            ours = rotate(frame[1], np.array(gripper_axis, dtype=float))
            theirs = rotate(thing[1], np.array(object_axis, dtype=float))
            self.note("grasp rotation (rad)", np.abs((ours * theirs).sum(-1) - dot))

    def check_placement(self, entry: dict) -> None:
        pose = self.at(entry["at"], entry["object"], "body site")
        self.note("placement position (m)", outside(pose[0], entry["low"], entry["high"]))
        if entry.get("quat") is not None:
            declared = normalised(np.array(entry["quat"], dtype=float))
            radians = angle_of(multiply(conjugate(pose[1]), declared[None]))
        elif entry.get("upright"):
            up = np.array([0.0, 0.0, 1.0])
            radians = angle_between(rotate(pose[1], up), np.broadcast_to(up, pose[0].shape))
        else:
            radians = np.zeros(self.count)
        self.note("placement rotation (rad)", radians)
        self.check_stored("placement", entry.get("variable"), pose)

    def check_goal(self, entry: dict) -> None:
        metres, radians = difference(
            self.at(entry["at"], entry["object"], "body site"), self.at(entry["at"], entry["site"], "site")
        )
        if entry["position"]:
            self.note("goal position (m)", metres)
        if entry["rotation"]:
            self.note("goal rotation (rad)", radians)

    def report(self) -> dict:
        checks, bad = {}, np.zeros(self.count, dtype=bool)
        for name, allowed in ALLOWED.items():
            if name not in self.errors:
                continue
            failing = ~(self.errors[name] <= allowed)
            bad |= failing
            worst = float(self.errors[name].max()) if self.count else 0.0
            checks[name] = {"worst": worst, "allowed": allowed, "bad": int(failing.sum())}
        first = np.flatnonzero(bad)[:10].tolist()
        not_checked = [name.removeprefix(OWN) for name in self.data["constraints"] if name.startswith(OWN)]
        report = {"samples": self.count, "bad": int(bad.sum()), "first_bad": first, "checks": checks}
        return report | {"not_checked": not_checked}


class Parser(argparse.ArgumentParser):
    """A parser whose complaints are one line."""

    def error(self, message: str) -> NoReturn:
        raise BadInput(message)


def main(arguments: list[str] | None = None) -> int:
    parser = Parser(description="Check samples in float64 with C MuJoCo and numpy alone.")
    parser.add_argument("file", help="samples.npz, or the directory that holds it")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    parser.add_argument("--limit", type=int, metavar="N", help="check the first N samples only")
    try:
        options = parser.parse_args(arguments)
        if options.limit is not None and options.limit < 1:
            raise BadInput(f"--limit is {options.limit}, expected at least 1")
        verification = Verification(read(options.file), options.limit)
        verification.run()
    except BadInput as error:
        print(f"verify.py: {error}", file=sys.stderr)
        return 2
    report = verification.report()
    if options.json:
        print(json.dumps({"file": options.file, **report}, indent=2))
    else:
        print(f"{options.file}: {report['samples']} samples")
        if not report["samples"]:
            print("no samples in this file, nothing to check")
        for name, check in report["checks"].items():
            verdict = "ok" if not check["bad"] else f"{check['bad']} bad"
            print(f"  {name:28s} worst {check['worst']:.3e}  allowed {check['allowed']:.0e}  {verdict}")
        if report["not_checked"]:
            print(f"  not checked here, the file's maker's own: {', '.join(report['not_checked'])}")
        if report["bad"]:
            print(f"{report['bad']} of {report['samples']} samples fail, the first at {report['first_bad']}")
        elif report["samples"]:
            print("every sample passes")
    return 1 if report["bad"] else 0


if __name__ == "__main__":
    sys.exit(main())
