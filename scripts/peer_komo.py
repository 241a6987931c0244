"""Run the peer, KOMO (package robotic), on one of the scenes in scenes/peers, or let it judge our samples.

    python scripts/peer_komo.py --scene ho --order joint --seconds 10 [--processes 2] [--out solutions.npz]
    python scripts/peer_komo.py --scene ho --check samples.npz

Both print one JSON object. Needs the extra `peers` (pip install robotic==0.4.2; on Debian also the system package
liblapack3) and numpy, nothing of cgs_jax: the scenes are stated here once more, by the peer's own means.

KOMO runs in its tuned setting (`TUNED`, dense Jacobians) in worker processes of one thread each, from starts that are
uniform over the whole space. A try is one solve of the joint problem, or one pass through an order of smaller problems
that ends at the first step that fails. Every full sample is judged on the joint problem, outside the clock. Residuals
are the largest absolute ones, in metres, dot products of unit vectors or differences of unit quaternions; penetration
is summed over all pairs of one mode switch.

Poses are [x y z qw qx qy qz]; `qpos` is that of the MJCF: the joints of arm a, of arm b, the pose of the box. t is the
box's pose in the gripper's frame: T_world_gripper * t = T_world_box.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.metadata
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector3 = tuple[float, float, float]

SCALE = 10.0
"""Weight of every residual inside KOMO, as its own examples have it; residuals are reported without it."""

MARGIN = 0.015
"""m that the gripper's centre stays inside the faces of the box, along the box's y and z."""

TUNED = {"damping": 0.3, "stopTolerance": 1e-3, "stepMax": 1.0, "stopEvals": 35}
"""Options of robotic's NLP_Solver, the best of about 40 sets tried on the joint problems. Its defaults have no test for
feasibility and small steps: 2 to 4 times slower at the same success."""

TOLERANCES = {"strict": (1e-3, 1e-2), "ours": (1e-4, 1e-4)}
"""Bounds of (equalities, inequalities): KOMO's strict judgement, and the tolerance of cgs_jax."""

LIMIT_TOLERANCE = 1e-6
"""rad beyond a joint limit at which a sample is infeasible at either tolerance."""

ENOUGH_EQUALITY, ENOUGH_INEQUALITY = 1e-2, 1e-1
"""Sums of weighted residuals, which the solver reports for free, with which a step of an order is taken to have
succeeded."""


class PeerError(Exception):
    """A user's mistake or a missing package, in one line."""


# ---------------------------------------------------------------------------------------------------------------------
# The scenes


@dataclasses.dataclass(frozen=True)
class Block:
    """A box: full edge lengths (m), centre in the world, orientation."""

    size: Vector3
    position: Vector3
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    @property
    def pose(self) -> Array:
        """T_world_block (7,)."""
        return np.array([*self.position, *self.quat])


@dataclasses.dataclass(frozen=True)
class PeerScene:
    """A scene: the arms' bases as (position, yaw), the box at its start and at its goal, and what stands around."""

    arms: Mapping[str, tuple[Vector3, float]]
    box: Block
    goal: Block
    fixed: Mapping[str, Block]
    region: tuple[Vector3, Vector3] | None = None
    """Bounds of the box's position at the handover."""


def _handover(height: float, others: Mapping[str, Block]) -> PeerScene:
    size = (0.06, 0.06, 0.20)
    return PeerScene(
        arms={"a": ((-0.65, 0.0, 0.0), 0.0), "b": ((0.65, 0.0, 0.0), math.pi)},
        box=Block(size, (-0.50, 0.45, height)),
        goal=Block(size, (0.50, -0.45, height)),
        fixed={
            "table": Block((2.6, 1.6, 0.1), (0.0, 0.0, -0.05)),
            "wall": Block((0.04, 0.80, 0.30), (0.0, 0.0, 0.15)),
            **others,
        },
        region=((-0.30, -0.40, 0.25), (0.30, 0.40, 0.90)),
    )


SCENES = {
    "pp": PeerScene(
        arms={"a": ((0.0, 0.0, 0.0), 0.0)},
        box=Block((0.06, 0.06, 0.14), (0.45, -0.30, 0.071)),
        goal=Block((0.06, 0.06, 0.14), (0.50, 0.30, 0.071), (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))),
        fixed={
            "table": Block((2.0, 2.0, 0.1), (0.0, 0.0, -0.05)),
            "wall": Block((0.30, 0.04, 0.20), (0.45, -0.42, 0.10)),
            "shelf": Block((0.30, 0.30, 0.02), (0.50, 0.30, 0.40)),
        },
    ),
    "ho": _handover(0.101, {"shelf": Block((0.30, 0.30, 0.02), (0.50, -0.45, 0.46))}),
    "ho2": _handover(
        0.401,
        {
            "post1": Block((0.06, 0.06, 0.30), (-0.50, 0.45, 0.15)),
            "post2": Block((0.06, 0.06, 0.30), (0.50, -0.45, 0.15)),
        },
    ),
}

ORDERS = {
    "pp": {
        "joint": "(q1,q2,t)",
        "expert3": "(q1,t); q2",
        "place_first": "(q2,t); q1",
        "expert2": "t; q1; q2",
    },
    "ho": {
        "joint": "(q_a1,q_a2,t_a,q_b1,q_b2,t_b,p)",
        "expert3": "(q_a1,t_a); (q_a2,p,q_b2,t_b); q_b1",
        "expert2": "p; t_a; t_b; q_a1; q_a2; q_b2; q_b1",
        "tree1": "t_b; t_a; q_a1; q_b1; (q_a2,p); q_b2",
        "tree2": "(q_b1,t_b); (q_b2,p); (q_a2,t_a); q_a1",
    },
}
ORDERS["ho2"] = ORDERS["ho"]
"""Orders by scene, and the same in the notation of the task files."""

BEST_ORDER = {"pp": "place_first", "ho": "joint", "ho2": "expert3"}
"""The order that made the most strict samples per second."""

SWITCHES = {"pp": ("pick", "place"), "ho": ("pick", "handover", "place"), "ho2": ("pick", "handover", "place")}
"""Mode switches in time order."""


def load_robotic() -> Any:
    """The package `robotic`, set to dense Jacobians (2.6 times faster than its sparse default at these sizes).

    Raises PeerError when it is not installed or does not load.
    """
    try:
        import robotic
    except ImportError as error:
        reason = " ".join(str(error).split())
        raise PeerError(
            f"the peer needs the package robotic ({reason}); expected: pip install robotic==0.4.2, and on Debian "
            "apt-get install liblapack3"
        ) from None
    robotic.params_add({"KOMO/sparse": False})
    return robotic


def build_config(ry: Any, scene: PeerScene, arms: Sequence[str], moving: Sequence[str]) -> Any:
    """The scene as a robotic.Config with these arms, of which the `moving` ones have degrees of freedom."""
    config = ry.Config()
    config.addFrame("world")
    for name, block in scene.fixed.items():
        _add_block(ry, config, name, block).setContact(1)
    for arm in arms:
        position, yaw = scene.arms[arm]
        config.addFile(ry.raiPath("panda/panda.g"), f"{arm}_")
        base = config.getFrame(f"{arm}_panda_base")
        base.setParent(config.getFrame("world"))
        base.setRelativePosition(position).setRelativeQuaternion([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)])
    box = _add_block(ry, config, "box", scene.box).setContact(1)
    # Without a joint of its own the box is part of the world's link, and a mode switch would carry the world along.
    box.setJoint(ry.JT.rigid)
    _add_block(ry, config, "goal", scene.goal)
    config.selectJoints([joint for arm in moving for joint in _joints(arm)])
    return config


def _add_block(ry: Any, config: Any, name: str, block: Block) -> Any:
    edge_radius = 1e-3
    frame = config.addFrame(name, "world").setShape(ry.ST.ssBox, [*block.size, edge_radius])
    return frame.setRelativePosition(block.position).setRelativeQuaternion(block.quat)


def _joints(arm: str) -> list[str]:
    return [f"{arm}_panda_joint{i}" for i in range(1, 8)]


# ---------------------------------------------------------------------------------------------------------------------
# Problems


class Problem:
    """One nonlinear program over a KOMO object that is built once and solved from many starts.

    slots: where in the decision vector each variable stands; a variable of 7 joints begins with 'q', else it is a pose.
    """

    def __init__(self, ry: Any, komo: Any, slots: Mapping[str, slice]) -> None:
        self.ry, self.komo, self.slots = ry, komo, slots
        self.nlp = komo.nlp()
        self.low, self.high = self.nlp.getBounds()
        self.dimension = self.nlp.getDimension()
        covered = sorted(i for slot in slots.values() for i in range(slot.start, slot.stop))
        if covered != list(range(self.dimension)):
            raise AssertionError(f"the slots {slots} do not cover {self.dimension} unknowns")
        types = [str(kind).rpartition(".")[2] for kind in self.nlp.getTypes()]
        self.is_equality = np.array([kind == "eq" for kind in types])
        self.row_names = [name.partition("[#")[0] for name in komo.getFeatureNames()]

    def start(self, rng: np.random.Generator) -> Array:
        """A start over the whole space: joints uniform in their limits, positions in their bounds, any rotation."""
        x = rng.uniform(self.low, self.high)
        for name, slot in self.slots.items():
            if not name.startswith("q"):
                x[slot][3:] = random_quaternion(rng)
        return x

    def solve(self, rng: np.random.Generator, options: Mapping[str, float]) -> Any:
        """One run of the solver from a new start; robotic's SolverReturn."""
        solver = self.ry.NLP_Solver(self.nlp, 0)
        solver.setOptions(verbose=0, **options)
        solver.setInitialization(self.start(rng))
        return solver.solve()

    def values(self, x: Array) -> dict[str, Array]:
        """The variables in a decision vector, quaternions of unit length."""
        found = {name: np.array(x[slot]) for name, slot in self.slots.items()}
        return {name: value if name.startswith("q") else _normalised(value) for name, value in found.items()}

    def vector(self, values: Mapping[str, Array]) -> Array:
        """The decision vector of these variables."""
        x = np.empty(self.dimension)
        for name, slot in self.slots.items():
            x[slot] = values[name]
        return x

    def rows(self, x: Array) -> Array:
        """(rows,) violations without the weight: absolute for equalities, at least 0 for inequalities."""
        phi = np.asarray(self.nlp.evaluate(x)[0]) / SCALE
        return np.where(self.is_equality, np.abs(phi), np.maximum(phi, 0.0))

    def residuals(self, x: Array) -> tuple[float, float]:
        """The largest equality residual and the largest inequality violation."""
        rows = self.rows(x)
        equality, inequality = rows[self.is_equality], rows[~self.is_equality]
        return float(equality.max(initial=0.0)), float(inequality.max(initial=0.0))


def random_quaternion(rng: np.random.Generator) -> Array:
    """A rotation uniform over SO(3)."""
    quat = rng.normal(size=4)
    return quat / np.linalg.norm(quat)


def _normalised(pose: Array) -> Array:
    return np.concatenate([pose[:3], pose[3:] / np.linalg.norm(pose[3:])])


def _demand_grasp(ry: Any, komo: Any, times: Sequence[float], gripper: str, held: str, size: Vector3) -> None:
    """Fingers close along the box's x: centred in x, within the faces in y and z, closing axis across y and z."""
    reach = np.array(size) / 2 - MARGIN
    in_y_and_z = SCALE * np.array([[0.0, 1, 0], [0, 0, 1]])
    pair = [gripper, held]
    komo.addObjective(times, ry.FS.positionRel, pair, ry.OT.eq, SCALE * np.array([[1.0, 0, 0]]))
    komo.addObjective(times, ry.FS.positionRel, pair, ry.OT.ineq, in_y_and_z, reach)
    komo.addObjective(times, ry.FS.positionRel, pair, ry.OT.ineq, -in_y_and_z, -reach)
    for product in (ry.FS.scalarProductXY, ry.FS.scalarProductXZ):
        komo.addObjective(times, product, pair, ry.OT.eq, [SCALE])


def _demand_region(ry: Any, komo: Any, times: Sequence[float], scene: PeerScene) -> None:
    assert scene.region is not None
    low, high = scene.region
    komo.addObjective(times, ry.FS.position, ["box"], ry.OT.ineq, SCALE * np.eye(3), high)
    komo.addObjective(times, ry.FS.position, ["box"], ry.OT.ineq, -SCALE * np.eye(3), low)


def _slots(*names: str) -> dict[str, slice]:
    return {name: slice(7 * i, 7 * i + 7) for i, name in enumerate(names)}


def joint_problem(ry: Any, name: str) -> Problem:
    """All variables of a scene at once, one slice per mode switch, by KOMO's own mode switches."""
    scene = SCENES[name]
    arms = list(scene.arms)
    config = build_config(ry, scene, arms, arms)
    last = float(len(SWITCHES[name]))
    komo = ry.KOMO(config, last, 1, 1, True)
    komo.addObjective([], ry.FS.accumulatedCollisions, [], ry.OT.eq, [SCALE])
    komo.addQuaternionNorms([], SCALE)
    if name == "pp":
        komo.addModeSwitch([1.0, -1.0], ry.SY.stable, ["a_gripper", "box"], True)
        order = ("q1", "t", "q2")
    else:
        komo.addModeSwitch([1.0, 2.0], ry.SY.stable, ["a_gripper", "box"], True)
        komo.addModeSwitch([2.0, -1.0], ry.SY.stable, ["b_gripper", "box"], False)
        _demand_grasp(ry, komo, [2.0], "b_gripper", "box", scene.box.size)
        _demand_region(ry, komo, [2.0], scene)
        for arm, idle in (("b", 1.0), ("a", last)):  # it takes no part in this switch and stands at home
            for joint in _joints(arm):
                komo.getFrame(joint, idle).setJoint(ry.JT.rigid)
        order = ("q_a1", "t_a", "q_a2", "q_b2", "t_b", "q_b1")
    _demand_grasp(ry, komo, [1.0], "a_gripper", "box", scene.box.size)
    komo.addObjective([last], ry.FS.poseDiff, ["box", "goal"], ry.OT.eq, [SCALE])
    return Problem(ry, komo, _slots(*order))


class StepProblem:
    """One mode switch with the box on the gripper of one arm: a step of an order.

    Parameters, set by `given`: the relative transform of the box on `arm` unless it is unknown, the pose which the box
    shall have unless it is free within the region, and the joints of the arm that stands beside.
    """

    def __init__(
        self,
        ry: Any,
        scene: PeerScene,
        arm: str,
        *,
        joints: bool = True,
        grasp: bool = False,
        to_region: bool = False,
        beside: str | None = None,
        hand_to: str | None = None,
    ) -> None:
        """joints: `arm` moves. grasp: t is unknown. to_region: the box's pose is free within the region. beside: an
        arm that stands still. hand_to: a second moving arm, whose grasp is unknown and shall meet the same box."""
        arms = [arm] + [other for other in (beside, hand_to) if other]
        moving = [a for a in (arm if joints else None, hand_to) if a]
        config = build_config(ry, scene, arms, moving)
        reach = 0.9 * max(scene.box.size)
        bounds = [-reach] * 3 + [-1.1] * 4 + [reach] * 3 + [1.1] * 4
        box = config.getFrame("box")
        box.setParent(config.getFrame(f"{arm}_gripper"))
        box.setRelativePosition([0, 0, 0]).setRelativeQuaternion([1, 0, 0, 0])
        if grasp:
            box.setJoint(ry.JT.free, bounds)
        if hand_to:
            config.addFrame("second_box", f"{hand_to}_gripper").setJoint(ry.JT.free, bounds)
        aim = config.addFrame("aim", "world")
        aim.setRelativePosition(scene.box.position).setRelativeQuaternion(scene.box.quat)

        komo = ry.KOMO(config, 1.0, 1, 0, True)
        now = [1.0]
        komo.addObjective(now, ry.FS.accumulatedCollisions, [], ry.OT.eq, [SCALE])
        if grasp or hand_to:
            komo.addQuaternionNorms([], SCALE)
        if grasp:
            _demand_grasp(ry, komo, now, f"{arm}_gripper", "box", scene.box.size)
        if hand_to:
            _demand_grasp(ry, komo, now, f"{hand_to}_gripper", "second_box", scene.box.size)
            komo.addObjective(now, ry.FS.poseDiff, ["box", "second_box"], ry.OT.eq, [SCALE])
        if to_region:
            _demand_region(ry, komo, now, scene)
        elif joints:
            komo.addObjective(now, ry.FS.poseDiff, ["box", "aim"], ry.OT.eq, [SCALE])

        self.problem = Problem(ry, komo, self._find_slots(ry, config, arm, hand_to))
        self._box, self._aim = komo.getFrame("box", 1.0), komo.getFrame("aim", 1.0)
        self._beside = [komo.getFrame(joint, 1.0) for joint in _joints(beside)] if beside else []

    @staticmethod
    def _find_slots(ry: Any, config: Any, arm: str, hand_to: str | None) -> dict[str, slice]:
        """Unknowns as q, t (of `arm`) and q_other, t_other (of `hand_to`), in the order of the config's joints."""
        names = {"box": "t", "second_box": "t_other", f"{arm}_panda_joint1": "q", f"{hand_to}_panda_joint1": "q_other"}
        slots: dict[str, slice] = {}
        position = 0
        for frame in config.getJoints():
            size = {ry.JT.free: 7, ry.JT.hingeZ: 1}.get(frame.getJointType(), 0)
            if size and frame.name in names:
                slots[names[frame.name]] = slice(position, position + 7)
            position += size
        return slots

    def given(self, t: Array | None = None, p: Array | None = None, q_beside: Array | None = None) -> None:
        """Set the parameters of the next solves."""
        if t is not None:
            self._box.setRelativePose(t)
        if p is not None:
            self._aim.setPose(p)
        if q_beside is not None:
            for frame, value in zip(self._beside, q_beside, strict=True):
                frame.setJointState([value])

    def box_pose(self, x: Array) -> Array:
        """T_world_box (7,) at a solution."""
        self.problem.nlp.evaluate(x)  # the last point that the solver tried need not be its solution
        return np.array(self._box.getPose())


# ---------------------------------------------------------------------------------------------------------------------
# Orders


@dataclasses.dataclass(frozen=True)
class Step:
    """Solve one problem given earlier variables.

    given: parameter of `StepProblem.given` -> variable, or a fixed pose. new: variable -> unknown of the problem, or
    'pose' for the pose at which the box ends.
    """

    program: StepProblem
    given: Mapping[str, str | Array]
    new: Mapping[str, str]

    def run(self, values: dict[str, Array], rng: np.random.Generator, options: Mapping[str, float]) -> tuple[bool, int]:
        """Add the new variables to `values`; whether that succeeded, and the evaluations it took."""
        if self.given:
            self.program.given(**{k: values[v] if isinstance(v, str) else v for k, v in self.given.items()})
        result = self.program.problem.solve(rng, options)
        if not (result.feasible and result.eq < ENOUGH_EQUALITY and result.ineq < ENOUGH_INEQUALITY):
            return False, result.evals
        x = np.array(result.x)
        found = self.program.problem.values(x)
        for variable, unknown in self.new.items():
            values[variable] = self.program.box_pose(x) if unknown == "pose" else found[unknown]
        return True, result.evals


@dataclasses.dataclass(frozen=True)
class DrawPose:
    """Draw the box's pose at the handover: position uniform in the region, any rotation."""

    scene: PeerScene

    def run(self, values: dict[str, Array], rng: np.random.Generator, options: Mapping[str, float]) -> tuple[bool, int]:
        """Add p to `values`; never fails."""
        assert self.scene.region is not None
        values["p"] = np.concatenate([rng.uniform(*self.scene.region), random_quaternion(rng)])
        return True, 0


@dataclasses.dataclass(frozen=True)
class Solved:
    """The joint problem in one solve."""

    problem: Problem

    def run(self, values: dict[str, Array], rng: np.random.Generator, options: Mapping[str, float]) -> tuple[bool, int]:
        """Add all variables to `values`; success is for the judge to say."""
        result = self.problem.solve(rng, options)
        values.update({name: np.array(result.x)[slot] for name, slot in self.problem.slots.items()})
        return True, result.evals


AnyStep = Step | DrawPose | Solved


def build_steps(ry: Any, name: str, order: str, joint: Problem) -> list[AnyStep]:
    """The steps of an order of `ORDERS[name]`.

    Raises PeerError for an unknown scene or order.
    """
    _check_names(name, order)
    scene = SCENES[name]
    start, goal = scene.box.pose, scene.goal.pose
    problems: dict[tuple[Any, ...], StepProblem] = {}

    def problem(arm: str, **options: Any) -> StepProblem:
        key = (arm, *sorted(options.items()))
        if key not in problems:
            problems[key] = StepProblem(ry, scene, arm, **options)
        return problems[key]

    def transform(t: str) -> Step:
        """A grasp alone, hand and box in empty space."""
        return Step(problem("a", joints=False, grasp=True), {}, {t: "t"})

    def beside_of(known: tuple[str, str] | None) -> tuple[dict[str, str], dict[str, str]]:
        """Options of the problem and its parameter, for an (arm, configuration) that stands beside."""
        return ({"beside": known[0]}, {"q_beside": known[1]}) if known else ({}, {})

    def reach(arm: str, q: str, t: str, p: str | Array, beside: tuple[str, str] | None = None) -> Step:
        """Bring the held box to a pose."""
        options, more = beside_of(beside)
        return Step(problem(arm, **options), {"t": t, "p": p} | more, {q: "q"})

    def grasp(arm: str, q: str, t: str, p: str | Array, beside: tuple[str, str] | None = None) -> Step:
        """Take the box where it is."""
        options, more = beside_of(beside)
        return Step(problem(arm, grasp=True, **options), {"p": p} | more, {q: "q", t: "t"})

    def carry(arm: str, q: str, t: str) -> Step:
        """Bring the held box somewhere in the region."""
        return Step(problem(arm, to_region=True), {"t": t}, {q: "q", "p": "pose"})

    if order == "joint":
        return [Solved(joint)]
    if name == "pp":
        return {
            "expert3": lambda: [grasp("a", "q1", "t", start), reach("a", "q2", "t", goal)],
            "place_first": lambda: [grasp("a", "q2", "t", goal), reach("a", "q1", "t", start)],
            "expert2": lambda: [transform("t"), reach("a", "q1", "t", start), reach("a", "q2", "t", goal)],
        }[order]()

    def take_over() -> Step:
        """Both arms meet somewhere in the region; the grasp of the giving arm is known."""
        switch = problem("a", to_region=True, hand_to="b")
        return Step(switch, {"t": "t_a"}, {"q_a2": "q", "q_b2": "q_other", "t_b": "t_other"})

    def meet() -> Step:
        return reach("b", "q_b2", "t_b", "p", beside=("a", "q_a2"))

    pick, place = lambda: reach("a", "q_a1", "t_a", start), lambda: reach("b", "q_b1", "t_b", goal)
    orders: dict[str, Callable[[], list[AnyStep]]] = {
        "expert3": lambda: [grasp("a", "q_a1", "t_a", start), take_over(), place()],
        "expert2": lambda: [
            DrawPose(scene),
            transform("t_a"),
            transform("t_b"),
            pick(),
            reach("a", "q_a2", "t_a", "p"),
            meet(),
            place(),
        ],
        "tree1": lambda: [transform("t_b"), transform("t_a"), pick(), place(), carry("a", "q_a2", "t_a"), meet()],
        "tree2": lambda: [
            grasp("b", "q_b1", "t_b", goal),
            carry("b", "q_b2", "t_b"),
            grasp("a", "q_a2", "t_a", "p", beside=("b", "q_b2")),
            pick(),
        ],
    }
    return orders[order]()


def _check_names(name: str, order: str | None = None) -> None:
    if name not in SCENES:
        raise PeerError(f"unknown scene '{name}' of the peer, expected one of: {', '.join(SCENES)}")
    if order is not None and order not in ORDERS[name]:
        raise PeerError(f"unknown order '{order}' of scene '{name}', expected one of: {', '.join(ORDERS[name])}")


# ---------------------------------------------------------------------------------------------------------------------
# Samples as qpos


class Kinematics:
    """Gripper poses by robotic, and the way from a sample to `qpos` and back."""

    def __init__(self, ry: Any, name: str) -> None:
        self.scene, self.switches = SCENES[name], SWITCHES[name]
        self.arms = list(self.scene.arms)
        self._config = build_config(ry, self.scene, self.arms, self.arms)
        self.home = np.array(self._config.getJointState())
        self.limits = np.array(self._config.getJointLimits())
        self.transports = {
            2: [("a", "q1", "t"), ("a", "q2", "t")],
            3: [("a", "q_a1", "t_a"), ("a", "q_a2", "t_a"), ("b", "q_b1", "t_b")],
        }[len(self.switches)]
        """By switch: the arm that holds the box, its configuration, the box's pose in its gripper."""

    @property
    def width(self) -> int:
        """Number of coordinates of qpos."""
        return len(self.home) + 7

    def gripper(self, arm: str, joints: Array) -> Array:
        """T_world_gripper (7,) with the joints of all arms (7 * arms,)."""
        self._config.setJointState(joints)
        return np.array(self._config.getFrame(f"{arm}_gripper").getPose())

    def qpos(self, values: Mapping[str, Array]) -> Array:
        """(switches, nq): the box is where the arm that brought it holds it."""
        rows = []
        for switch, (arm, q, t) in enumerate(self.transports):
            joints = self.home.copy()
            joints[self._of(arm)] = values[q]
            if self.switches[switch] == "handover":
                joints[self._of("b")] = values["q_b2"]
            rows.append(np.concatenate([joints, compose(self.gripper(arm, joints), _normalised(values[t]))]))
        return np.array(rows)

    def values(self, qpos: Array) -> dict[str, Array]:
        """The variables of one sample (switches, nq); each t as it is when its arm takes the box."""
        found: dict[str, Array] = {}
        for switch, (arm, q, t) in enumerate(self.transports):
            joints, box = qpos[switch, :-7], qpos[switch, -7:]
            found[q] = joints[self._of(arm)]
            if t not in found and self.switches[switch] != "place":
                found[t] = compose(inverted(self.gripper(arm, joints)), box)
            if self.switches[switch] == "handover":
                found["q_b2"] = joints[self._of("b")]
                found["t_b"] = compose(inverted(self.gripper("b", joints)), box)
        return found

    def beyond_limits(self, qpos: Array) -> float:
        """Largest excess (rad) of a joint over its limits."""
        joints = qpos[:, :-7]
        return float(max(0.0, (self.limits[0] - joints).max(), (joints - self.limits[1]).max()))

    def off_home(self, qpos: Array) -> float:
        """Largest deviation (rad) from home of an arm at a switch in which it takes no part."""
        idle = {2: [], 3: [(0, "b"), (2, "a")]}[len(self.switches)]
        return max((float(np.abs(qpos[k, :-7] - self.home)[self._of(arm)].max()) for k, arm in idle), default=0.0)

    def off_grasp(self, qpos: Array) -> float:
        """Largest difference (m, or of unit quaternions) between the box's pose in `qpos` and where the arm that
        brought it holds it."""
        held = self.qpos(self.values(qpos))[:, -7:]
        same_sign = np.where((held[:, 3:] * qpos[:, -4:]).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
        held[:, 3:] *= same_sign
        return float(np.abs(held - qpos[:, -7:]).max())

    def _of(self, arm: str) -> slice:
        first = 7 * self.arms.index(arm)
        return slice(first, first + 7)


def compose(first: Array, second: Array) -> Array:
    """The pose first * second."""
    w, v = first[3], first[4:]
    turned = second[:3] + 2 * np.cross(v, np.cross(v, second[:3]) + w * second[:3])
    scalar = w * second[3] - v @ second[4:]
    vector = w * second[4:] + second[3] * v + np.cross(v, second[4:])
    return np.concatenate([first[:3] + turned, [scalar], vector])


def inverted(pose: Array) -> Array:
    """The inverse pose."""
    back = np.concatenate([np.zeros(3), pose[3:] * [1, -1, -1, -1]])
    back[:3] = compose(back, np.concatenate([-pose[:3], [1.0, 0, 0, 0]]))[:3]
    return back


def shares(equality: Array, inequality: Array, limits: Array | None = None) -> dict[str, NDArray[np.bool_]]:
    """Which samples are feasible at each of `TOLERANCES`; limits: (N,) rad beyond the joint limits."""
    within = np.ones(len(equality), bool) if limits is None else limits <= LIMIT_TOLERANCE
    return {name: (equality < e) & (inequality < i) & within for name, (e, i) in TOLERANCES.items()}


# ---------------------------------------------------------------------------------------------------------------------
# Measuring


def measure(
    name: str,
    order: str,
    seconds: float,
    seed: int = 0,
    options: Mapping[str, float] = TUNED,
    ready: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Run KOMO in this process until `seconds` of its own time are used up.

    ready: called once after everything is built. Returns tries, evaluations, failures per step, the clock (wall and
    cpu seconds), and arrays of all full samples that are feasible at strict tolerance: qpos (N, switches, nq), equality
    and inequality (N,) on the joint problem, and elapsed (N,), the clock when it was found. Judging is off the clock.
    """
    _check_names(name, order)
    ry = load_robotic()
    joint = joint_problem(ry, name)
    steps = build_steps(ry, name, order, joint)
    kinematics = Kinematics(ry, name)
    rng = np.random.default_rng(seed)
    failed = [0] * len(steps)
    tries = evaluations = 0
    clock = cpu = 0.0
    qpos, residuals, elapsed = [], [], []
    ready()
    while clock < seconds:
        began, cpu_began = time.perf_counter(), time.process_time()
        values: dict[str, Array] = {}
        for i, step in enumerate(steps):
            success, cost = step.run(values, rng, options)
            evaluations += cost
            if not success:
                failed[i] += 1
                break
        clock += time.perf_counter() - began
        cpu += time.process_time() - cpu_began
        tries += 1
        if not success:
            continue
        judged = joint.residuals(joint.vector(values))
        if judged[0] < TOLERANCES["strict"][0] and judged[1] < TOLERANCES["strict"][1]:
            qpos.append(kinematics.qpos(values))
            residuals.append(judged)
            elapsed.append(clock)
    table = np.array(residuals).reshape(-1, 2)
    return {
        "tries": tries,
        "evaluations": evaluations,
        "failed_at_step": failed,
        "clock": clock,
        "cpu": cpu,
        "qpos": np.array(qpos).reshape(-1, len(kinematics.switches), kinematics.width),
        "equality": table[:, 0],
        "inequality": table[:, 1],
        "elapsed": np.array(elapsed),
    }


def run_komo(
    name: str,
    order: str | None = None,
    seconds: float = 10.0,
    processes: int = 1,
    seed: int = 0,
    options: Mapping[str, float] | None = None,
    python: str = sys.executable,
) -> tuple[dict[str, Any], dict[str, Array]]:
    """KOMO on one scene in `processes` worker processes that start their clocks together.

    order: one of `ORDERS[name]`, by default its best. options: changes to `TUNED`. python: the interpreter that has
    the package robotic.

    Returns a report, ready for JSON, and the arrays `qpos` (N, switches, nq), `equality`, `inequality`, `elapsed`
    (N,) of all samples that are feasible at strict tolerance. Rates are samples per second of each worker's own clock,
    summed over the workers; those per second of processor time are per core and do not suffer from other programs.
    Raises PeerError.
    """
    order = BEST_ORDER.get(name, "joint") if order is None else order
    _check_names(name, order)
    if not (seconds > 0 and processes >= 1):
        raise PeerError(f"expected seconds > 0 and processes >= 1, got {seconds:g} and {processes}")
    chosen = TUNED | dict(options or {})
    jobs = [
        {"name": name, "order": order, "seconds": seconds, "seed": seed + i, "options": chosen}
        for i in range(processes)
    ]
    began = time.perf_counter()
    results = _in_workers("measure", jobs, python)
    wall = time.perf_counter() - began
    metas = [json.loads(str(result.pop("meta"))) for result in results]
    arrays = {key: np.concatenate([result[key] for result in results]) for key in results[0]}
    tries, clock, cpu = (sum(meta[key] for meta in metas) for key in ("tries", "clock", "cpu"))
    report: dict[str, Any] = {
        "peer": "komo",
        "robotic": metas[0]["robotic"],
        "scene": name,
        "order": order,
        "sequence": ORDERS[name][order],
        "processes": processes,
        "seconds": seconds,
        "seed": seed,
        "options": chosen,
        "tries": tries,
        "milliseconds_per_try": 1e3 * clock / tries,
        "cpu_milliseconds_per_try": 1e3 * cpu / tries,
        "evaluations_per_try": sum(meta["evaluations"] for meta in metas) / tries,
        "failed_at_step": np.sum([meta["failed_at_step"] for meta in metas], axis=0).tolist(),
        "wall_seconds_with_start": wall,
    }
    for tolerance in TOLERANCES:
        counts = [int(shares(result["equality"], result["inequality"])[tolerance].sum()) for result in results]
        report[tolerance] = {
            "samples": sum(counts),
            "share_of_tries": sum(counts) / tries,
            "per_second": sum(count / meta["clock"] for count, meta in zip(counts, metas, strict=True)),
            "per_second_of_cpu": sum(counts) / cpu,
        }
    return report, arrays


def check_samples(name: str, qpos: Array, python: str = sys.executable) -> tuple[dict[str, Any], dict[str, Array]]:
    """KOMO's residuals on the joint problem for samples of another program, computed in a worker process.

    qpos: (N, switches, nq) in the order of the MJCF. t is taken as it is when the arm takes the box. Two equalities
    that KOMO's own unknowns cannot violate are added: the box is where its holder has it, an idle arm is at home.

    Returns a report, ready for JSON, with the worst residuals and the share that is feasible at each tolerance, and
    the arrays `equality`, `inequality`, `limits` (N,). Raises PeerError.
    """
    _check_names(name)
    qpos = np.asarray(qpos, dtype=np.float64)
    expected = (len(SWITCHES[name]), 7 * len(SCENES[name].arms) + 7)
    if qpos.ndim != 3 or qpos.shape[1:] != expected:
        raise PeerError(f"qpos of scene '{name}' must have shape (N, {expected[0]}, {expected[1]}), got {qpos.shape}")
    if not len(qpos):
        raise PeerError("no samples to check")
    (result,) = _in_workers("check", [{"name": name, "qpos": qpos}], python)
    meta = json.loads(str(result.pop("meta")))
    feasible = shares(result["equality"], result["inequality"], result["limits"])
    report = {
        "peer": "komo",
        "robotic": meta["robotic"],
        "scene": name,
        "samples": len(qpos),
        "worst_equality": float(result["equality"].max()),
        "worst_inequality": float(result["inequality"].max()),
        "worst_beyond_limits": float(result["limits"].max()),
        "worst_by_feature": meta["worst_by_feature"],
        "feasible_strict": float(feasible["strict"].mean()),
        "feasible_ours": float(feasible["ours"].mean()),
    }
    return report, result


def evaluate(name: str, qpos: Array) -> dict[str, Any]:
    """The work of `check_samples`, in this process."""
    ry = load_robotic()
    joint, kinematics = joint_problem(ry, name), Kinematics(ry, name)
    rows, limits, idle, grasps = [], [], [], []
    for sample in qpos:
        rows.append(joint.rows(joint.vector(kinematics.values(sample))))
        limits.append(kinematics.beyond_limits(sample))
        idle.append(kinematics.off_home(sample))
        grasps.append(kinematics.off_grasp(sample))
    table = np.array(rows)
    by_feature = {"idle arm off home": max(idle), "box off the gripper that holds it": max(grasps)}
    for feature, worst in zip(joint.row_names, table.max(axis=0), strict=True):
        by_feature[feature] = max(by_feature.get(feature, 0.0), float(worst))
    return {
        "equality": np.maximum.reduce([table[:, joint.is_equality].max(axis=1), idle, grasps]),
        "inequality": table[:, ~joint.is_equality].max(axis=1),
        "limits": np.array(limits),
        "worst_by_feature": by_feature,
    }


def _in_workers(task: str, jobs: Sequence[Mapping[str, Any]], python: str) -> list[dict[str, Array]]:
    """Run one job per process, all at once; what each of them saved.

    The peer writes a log file into its working directory and prints at will, so it works in a temporary folder and
    talks to us by a pipe of its own.
    """
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    script = Path(__file__).resolve()
    with tempfile.TemporaryDirectory(prefix="peer_komo") as folder:
        workers = []
        try:
            for i, job in enumerate(jobs):
                place = Path(folder, str(i))
                place.mkdir()
                plain = {key: value for key, value in job.items() if not isinstance(value, np.ndarray)}
                arrays = {key: value for key, value in job.items() if isinstance(value, np.ndarray)}
                np.savez(place / "job.npz", job=json.dumps(plain), task=task, **arrays)
                with open(place / "errors.txt", "wb") as errors:
                    worker = subprocess.Popen(
                        [python, str(script), "--worker", str(place)],
                        cwd=place,
                        env=environment,
                        stdin=subprocess.PIPE,
                        stdout=subprocess.PIPE,
                        stderr=errors,
                        text=True,
                    )
                workers.append((worker, place))
            for worker, place in workers:
                if worker.stdout.readline().strip() != "ready":
                    raise _failure(worker, place)
            for worker, _ in workers:
                worker.stdin.write("go\n")
                worker.stdin.flush()
            results = []
            for worker, place in workers:
                if worker.stdout.readline().strip() != "done":
                    raise _failure(worker, place)
                with np.load(place / "result.npz", allow_pickle=False) as archive:
                    results.append(dict(archive))
            return results
        except OSError as error:
            raise PeerError(f"cannot run the peer with {python}: {error}") from None
        finally:
            for worker, _ in workers:
                worker.kill()
                worker.wait()
                worker.stdin.close()
                worker.stdout.close()


def _failure(worker: subprocess.Popen[str], place: Path) -> PeerError:
    status = worker.wait()
    told = (place / "failure.txt").read_text() if (place / "failure.txt").exists() else None
    if told is None:
        lines = (place / "errors.txt").read_text(errors="replace").split("\n")
        told = next((line.strip() for line in reversed(lines) if line.strip()), "no message")
        told = f"the peer's process ended with status {status}: {told}"
    return PeerError(told)


def _work(place: Path) -> int:
    """The worker's side of `_in_workers`."""
    pipe = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the peer prints goes to the error log

    def say(word: str) -> None:
        pipe.write(f"{word}\n")
        pipe.flush()

    def ready() -> None:
        say("ready")
        sys.stdin.readline()

    with np.load(place / "job.npz", allow_pickle=False) as archive:
        job = json.loads(str(archive["job"])) | ({"qpos": archive["qpos"]} if "qpos" in archive else {})
        task = str(archive["task"])
    try:
        if task == "check":
            load_robotic()
            ready()
            result = evaluate(**job)
        else:
            result = measure(**job, ready=ready)
    except PeerError as error:
        (place / "failure.txt").write_text(str(error))
        return 2
    meta = {key: value for key, value in result.items() if not isinstance(value, np.ndarray)}
    meta["robotic"] = importlib.metadata.version("robotic")
    arrays = {key: value for key, value in result.items() if isinstance(value, np.ndarray)}
    np.savez(place / "result.npz", meta=json.dumps(meta), **arrays)
    say("done")
    return 0


# ---------------------------------------------------------------------------------------------------------------------
# Command line


def save(path: Path, report: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
    """Write solutions with what `--check` and other programs need: qpos, mode_switches and the report."""
    switches = np.array(SWITCHES[report["scene"]])
    np.savez(path, mode_switches=switches, scene=report["scene"], meta=json.dumps(report), **arrays)


def read_qpos(path: Path) -> Array:
    """qpos (N, switches, nq) of a file of samples. Raises PeerError."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            if "qpos" not in archive:
                raise PeerError(f"{path}: no key 'qpos', available: {', '.join(archive)}")
            return np.asarray(archive["qpos"], dtype=np.float64)
    except (OSError, ValueError) as error:
        raise PeerError(f"cannot read {path}: {' '.join(str(error).split())}") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0, or 2 for bad input or a missing package (one line)."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--scene", choices=SCENES, help="one of the peer's scenes")
    orders = dict.fromkeys(order for known in ORDERS.values() for order in known)
    parser.add_argument("--order", help=f"{', '.join(orders)}; default: the scene's best")
    parser.add_argument("--seconds", type=float, default=10.0, help="time for KOMO (default 10)")
    parser.add_argument("--processes", type=int, default=1, help="worker processes of one thread each (default 1)")
    parser.add_argument("--seed", type=int, default=0)
    for name, value in (("stopTolerance", TUNED["stopTolerance"]), ("stopEvals", TUNED["stopEvals"])):
        flag = "--stop-tolerance" if name == "stopTolerance" else "--stop-evals"
        parser.add_argument(flag, dest=name, type=type(value), default=value, help=f"KOMO's (default {value:g})")
    parser.add_argument("--out", type=Path, help="file for the solutions (npz)")
    parser.add_argument("--check", type=Path, metavar="SAMPLES", help="judge these samples (npz with qpos) instead")
    parser.add_argument("--python", default=sys.executable, help="interpreter that has the package robotic")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.worker:
        return _work(given.worker)
    if not given.scene:
        parser.error(f"--scene is missing, expected one of: {', '.join(SCENES)}")
    try:
        if given.check:
            report, arrays = check_samples(given.scene, read_qpos(given.check), given.python)
        else:
            options = {"stopTolerance": given.stopTolerance, "stopEvals": given.stopEvals}
            report, arrays = run_komo(
                given.scene, given.order, given.seconds, given.processes, given.seed, options, given.python
            )
        if given.out:
            save(given.out, report, arrays)
    except (PeerError, OSError) as error:
        print(f"peer_komo.py: {error}", file=sys.stderr)
        return 2
    print(json.dumps(report, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
