"""Checks of a problem before anything is sampled: seconds instead of a run that finds nothing and does not say why.

Faults of the input that leave no problem at all (unknown names, a model that does not compile) are `InputError`s when it is
loaded. What is looked at here can be loaded and is still wrong, or hopeless: an object out of reach, geoms that overlap where
everything starts, rows that depend on each other, a gradient that is none, a sequence that is no path.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial import cKDTree

from cgs_jax.audit import Tolerances
from cgs_jax.constraints import Function, PoseRows
from cgs_jax.errors import InputError
from cgs_jax.kinematics import Chain
from cgs_jax.operators import Operator, gather_given, operator_of
from cgs_jax.plans import PlanSystem, Point, Shared, Tasks, all_atoms, multiply_words, tools_at
from cgs_jax.poses import Pose, from_vector
from cgs_jax.problems import Problem
from cgs_jax.scene import Hold, TwoFingerGrasp, object_pose_sources
from cgs_jax.transitions import Transition, Transitions

POINTS = 8
"""Random points at which Jacobians are looked at."""

STEP = 3e-3
"""Step of the central differences, rad or m: rounding in single precision and curvature weigh about the same."""

SLOPE_TOLERANCE = 1e-2
"""Difference between a gradient and finite differences that passes, relative to the larger of 1 and the gradient."""

GAP_SHARE = 0.15
"""A pose is out of reach when every random configuration of the robot stays further away than this share of its reach."""

LISTED = 5000
"""Transitions that are enumerated at most; larger graphs are counted no further."""


@dataclass(frozen=True)
class ConstraintCheck:
    """One constraint: its size, and its Jacobian at random points that satisfy nothing in particular."""

    name: str
    scope: tuple[str, ...]
    dof: int
    """Degrees of freedom of all its variables."""
    equality_rows: int
    inequality_rows: int
    rank: int | None
    """Largest rank of the equality rows' Jacobian over the points; None for constraints without rows (Collision)."""
    slope_error: float | None
    """Second largest difference to finite differences over the points: one of them may sit on a kink."""
    slope_variable: str | None
    """The variable by which the gradient is worst."""
    wrong_points: int
    """Points at which the difference does not pass, or something is not finite."""


@dataclass(frozen=True)
class ReachCheck:
    """Whether a robot's frame can be where a hold begins or ends."""

    pose: str
    """What has to be reached: the start, goal or placement of an object at a switch."""
    robot: str
    frame: str
    distance: float
    """Least distance (m) from the robot's first joint (or from what it hangs on) to where the frame must be."""
    reach: float
    """Sum of the lengths in between (m), an upper bound of what any configuration reaches."""
    gap: float
    """Least distance (m) that a random configuration of the seed table leaves to it."""

    @property
    def reachable(self) -> bool:
        """False where the bound or every random configuration says no."""
        return self.distance <= self.reach + 1e-6 and self.gap <= GAP_SHARE * self.reach + 1e-6


@dataclass(frozen=True)
class Overlap:
    """Two geoms that penetrate each other where nothing has moved yet, or with an object at its goal."""

    where: str
    first: str
    second: str
    depth: float
    """m"""


@dataclass(frozen=True)
class ProblemCheck:
    """What was found; `faults` is empty when all is well."""

    scene: str
    instance: int
    robots: Mapping[str, int]
    """Joints by robot."""
    objects: tuple[str, ...]
    switches: tuple[str, ...]
    constraints: tuple[ConstraintCheck, ...]
    dof: int
    equality_rows: int
    rank: int
    """Largest rank of all equality rows together over the random points."""
    reaches: tuple[ReachCheck, ...]
    overlaps: tuple[Overlap, ...]
    complete: int
    """Transitions before pruning."""
    pruned: int
    """Transitions that are kept, counted up to `LISTED`; so are the problems and programs below."""
    problems: int
    """Distinct conditional problems among them."""
    programs: int
    """Device programs that would serve them all."""
    sequences: Mapping[str, str]
    """The task's sequences by name; "" where one is a path of the graph, else what is wrong with it (a fault, or a note)."""
    faults: tuple[str, ...]
    """One line each."""
    notes: tuple[str, ...] = ()
    """What is worth knowing and no fault, one line each: the task's sequences that variables or constraints added to it make
    no path."""

    @property
    def counted_all(self) -> bool:
        """False where the graph has more transitions than are enumerated."""
        return self.pruned < LISTED

    def as_json(self) -> dict[str, Any]:
        """Plain data."""
        return dataclasses.asdict(self)


def check_problem(problem: Problem, seed: int = 0) -> ProblemCheck:
    """Looks at a problem without sampling it.

    seed: of the random points. Imports no optional package, compiles a few small programs.
    """
    constraints, rank = _check_constraints(problem, seed)
    reaches, reach_faults = _check_reach(problem, seed)
    overlaps = _find_overlaps(problem)
    graph, task = problem.graph, problem.scene.task
    listed = list(itertools.islice(problem.transitions.iterate(), LISTED))
    operators = {transition.problem: operator_of(problem, transition) for transition in listed}
    sequences = {name: _wrong_with(problem.transitions, text) for name, text in task.sequences.items()}
    rows = sum(constraint.equality_rows for constraint in graph.constraints)
    faults = [fault for constraint in constraints for fault in _constraint_faults(constraint)]
    if rank < rows and not any("rank" in fault for fault in faults):
        faults.append(
            f"the constraints depend on each other: {rows} equality rows in all, "
            f"their Jacobian has rank {rank} at random points"
        )
    faults += reach_faults
    faults += [f"{o.where}: geoms '{o.first}' and '{o.second}' penetrate by {1e3 * o.depth:.1f} mm" for o in overlaps]
    if not listed:
        faults.append("no sequence assigns all variables: some have more equality rows than degrees of freedom")
    notes = []
    paths_of_task = _paths_of_task(problem) if any(sequences.values()) else ()
    for name, wrong in sequences.items():
        if wrong and name in paths_of_task:
            notes.append(f"sequence '{name}' of the task is no path with what was added to it: {wrong}")
        elif wrong and listed:
            faults.append(f"sequence '{name}' is no path of the pruned graph: {wrong}")
    return ProblemCheck(
        scene=problem.name,
        instance=problem.scene.instance,
        robots={robot.name: len(robot.joints) for robot in task.robots},
        objects=tuple(spec.name for spec in task.objects),
        switches=tuple(switch.name for switch in task.switches),
        constraints=tuple(constraints),
        dof=sum(variable.dof for variable in graph.variables),
        equality_rows=rows,
        rank=rank,
        reaches=tuple(reaches),
        overlaps=tuple(overlaps),
        complete=problem.transitions.complete_count,
        pruned=len(listed),
        problems=len(operators),
        programs=_count_programs(problem, operators.values()),
        sequences=sequences,
        faults=tuple(faults),
        notes=tuple(notes),
    )


def _paths_of_task(problem: Problem) -> list[str]:
    """Names of the task's sequences that are paths of its own graph; none where nothing was added to it."""
    graph = problem.graph
    variables = tuple(v for v in graph.variables if v.name not in problem.vectors)
    added = {name for name, declaration in problem.declarations.items() if isinstance(declaration, Function)}
    added |= {sampler.link for sampler in problem.samplers}
    constraints = tuple(c for c in graph.constraints if c.name not in added)
    if (variables, constraints) == (graph.variables, graph.constraints):
        return []
    transitions = Transitions(dataclasses.replace(graph, variables=variables, constraints=constraints))
    return [name for name, text in problem.scene.task.sequences.items() if not _wrong_with(transitions, text)]


def _wrong_with(transitions: Transitions, sequence: str) -> str:
    try:
        transitions.parse(sequence)
    except InputError as error:
        return str(error)
    return ""


def _count_programs(problem: Problem, operators: Iterable[Operator]) -> int:
    """Programs for solving by layout, for clearances by layout and the shapes of their numbers."""
    operators = tuple(operators)
    solves = {operator.plan.layout for operator in operators}
    clears = {clear.constraint: clear for operator in operators for clear in operator.clears}
    shapes = {(c.layout, str(jax.tree.map(np.shape, c.numbers(problem.params)))) for c in clears.values()}
    return len(solves) + len(shapes)


# ------------------------------------------------------------------ rows, ranks and gradients


def random_point(problem: Problem, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """A value for every variable: configurations `(dof,)` within the limits, poses `(7,)` within half a metre."""
    point = {}
    for variable in problem.graph.variables:
        if variable.kind == "configuration":
            value = rng.uniform(*problem.params.limits[variable.name])
        else:
            quat = rng.normal(size=4)
            value = np.concatenate([rng.uniform(-0.5, 0.5, size=3), quat / np.linalg.norm(quat)])
        point[variable.name] = value.astype(np.float32)
    return point


class _Measured:
    """One constraint as the solver sees it, with all its variables unknown and nothing eliminated."""

    def __init__(self, problem: Problem, whole: Problem, name: str, scope: tuple[str, ...]) -> None:
        self.problem, self.scope = problem, scope
        self.operator: Operator = operator_of(whole, Transition(frozenset(), scope, (name,), frozenset()))
        self.shared = self.operator.numbers(problem.params).shared
        layout, plan = self.operator.plan.layout, self.operator.plan
        self.columns: dict[str, slice] = {}
        for k, variable in enumerate(plan.configurations):
            self.columns[variable] = slice(k * layout.joints, k * layout.joints + (problem.dofs[variable] or 0))
        first = layout.joints * layout.configurations
        for f, (variable, _) in enumerate(plan.free):
            self.columns[variable] = slice(first + 6 * f, first + 6 * f + 6)

    def at(self, point: Mapping[str, np.ndarray], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Jacobian `(rows, n)`, central differences `(rows, n, 2)` with their rounding error, and which rows are equal."""
        plan, layout = self.operator.plan, self.operator.plan.layout
        configurations = np.zeros((layout.configurations, layout.joints, 1), np.float32)
        for k, variable in enumerate(plan.configurations):
            configurations[k, : len(point[variable]), 0] = point[variable]
        free = np.array([point[variable] for variable, _ in plan.free], np.float32).reshape(-1, 7)
        given = gather_given(self.operator, self.problem.params, {}, 1)[0]
        sites = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], np.float32), (layout.sites, 1))
        for i, name in enumerate(plan.sites):
            sites[i] = rng.choice(np.asarray(self.problem.params.sites[name]))
        atoms = np.concatenate([np.asarray(given), sites])
        value, jacobian, low, high = map(
            np.asarray, _measure_program(layout)(configurations, free, atoms.astype(np.float32), self.shared)
        )
        low, high = low[:, 0], high[:, 0]
        count = jacobian.shape[1]
        ahead, behind = value[:, 1 : 1 + count], value[:, 1 + count :]
        differences = (ahead - behind) / (2 * STEP)
        rounding = 4 * np.finfo(np.float32).eps * np.abs(value[:, :1]) / STEP
        active = np.isfinite(low) | np.isfinite(high)
        stacked = np.stack([differences, np.broadcast_to(rounding, differences.shape)], axis=-1)
        return jacobian[active], stacked[active], (low == high)[active]


@functools.cache
def _measure_program(layout: Any) -> Callable:
    """Rows at a point and at steps to either side of every unknown, and the solver's Jacobian at the point.

    Rotation vectors are measured from the rotation at the point itself: their derivative is taken at zero error.
    """
    system = PlanSystem(layout)

    def measure(configurations: jax.Array, free: jax.Array, atoms: jax.Array, shared: Shared) -> tuple:
        count = layout.unknowns
        lanes = 1 + 2 * count
        steps = jnp.concatenate([jnp.zeros((count, 1)), STEP * jnp.eye(count), -STEP * jnp.eye(count)], axis=1)

        def poses(vectors: jax.Array) -> Pose:
            pose = from_vector(vectors.T[..., None])  # (3, 3, poses, 1)
            turn, move = jnp.moveaxis(pose.rotation, 2, 0), jnp.moveaxis(pose.position, 1, 0)
            return Pose(jnp.broadcast_to(turn, (*turn.shape[:-1], lanes)), jnp.broadcast_to(move, (*move.shape[:-1], lanes)))

        blank = jnp.zeros((layout.configurations, layout.joints, lanes))
        start = Point(jnp.broadcast_to(configurations, blank.shape), poses(free))
        x = system.retract(start, steps)
        tasks = Tasks(poses(atoms), blank, blank, jnp.zeros((2, lanes)), ())
        tools, _ = tools_at(layout, shared.chains, x.configurations)
        words = multiply_words(shared.code.words, all_atoms(tasks.given, tools, x.free)).whole
        rows = system.rows(x, (tasks, shared._replace(rows=shared.rows._replace(wanted=words.rotation[..., 0]))))
        return rows.value, rows.jacobian[..., 0], rows.low, rows.high

    # Run a few dozen times, these programs are not worth an optimiser: a tenth of the time to compile.
    quick = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
    return jax.jit(measure, compiler_options=quick if jax.default_backend() == "cpu" else {})


def _check_constraints(problem: Problem, seed: int) -> tuple[list[ConstraintCheck], int]:
    """All constraints, and the rank of all equality rows together."""
    graph = problem.graph
    # As loops, products define poses instead of constraining them; the same rows on a product that is no loop stay rows.
    kept = {
        name: dataclasses.replace(declaration, form="oriented")
        if isinstance(declaration, PoseRows) and declaration.form == "closed"
        else declaration
        for name, declaration in problem.declarations.items()
    }
    whole = dataclasses.replace(problem, declarations=kept, operators={}, aimed={})
    measured = {c.name: _Measured(problem, whole, c.name, c.scope) for c in graph.constraints if c.name in kept}
    starts = dict(zip(graph.index, np.cumsum([0, *(v.dof for v in graph.variables)]), strict=False))
    ranks: dict[str, int] = dict.fromkeys(measured, 0)
    errors: dict[str, list[tuple[float, str]]] = {name: [] for name in measured}
    together = 0
    rng = np.random.default_rng(seed)
    for _ in range(POINTS):
        point = random_point(problem, rng)
        blocks = []
        for name, rows in measured.items():
            jacobian, differences, equal = rows.at(point, rng)
            errors[name].append(_slope_error(jacobian, differences, rows.columns))
            ranks[name] = max(ranks[name], _rank(jacobian[equal]))
            block = np.zeros((int(equal.sum()), sum(v.dof for v in graph.variables)))
            for variable, columns in rows.columns.items():
                width = columns.stop - columns.start
                block[:, starts[variable] : starts[variable] + width] = jacobian[equal][:, columns]
            blocks.append(block)
        together = max(together, _rank(np.concatenate(blocks)) if blocks else 0)
    checks = []
    for constraint in graph.constraints:
        found = sorted(errors.get(constraint.name, []), reverse=True)
        checks.append(
            ConstraintCheck(
                name=constraint.name,
                scope=constraint.scope,
                dof=sum(graph.variable(name).dof for name in constraint.scope),
                equality_rows=constraint.equality_rows,
                inequality_rows=constraint.inequality_rows,
                rank=ranks.get(constraint.name),
                slope_error=found[1][0] if found else None,
                slope_variable=found[1][1] if found else None,
                wrong_points=sum(error > SLOPE_TOLERANCE for error, _ in found),
            )
        )
    return checks, together


def _slope_error(jacobian: np.ndarray, differences: np.ndarray, columns: Mapping[str, slice]) -> tuple[float, str]:
    """Largest difference beyond rounding, relative to the larger of 1 and the row's gradient, and by which variable."""
    scale = np.maximum(1.0, np.abs(jacobian).max(axis=1, keepdims=True, initial=0.0))
    error = np.maximum(np.abs(jacobian - differences[..., 0]) - differences[..., 1], 0.0) / scale
    error = np.where(np.isfinite(error), error, np.inf)
    return max(((float(error[:, at].max(initial=0.0)), name) for name, at in columns.items()), key=lambda item: item[0])


def _rank(matrix: np.ndarray) -> int:
    if not matrix.size or not np.isfinite(matrix).all():
        return 0
    sizes = np.linalg.svd(matrix, compute_uv=False)
    return int((sizes > 1e-4 * sizes[0]).sum())


def _constraint_faults(constraint: ConstraintCheck) -> list[str]:
    faults = []
    if constraint.slope_error is not None and constraint.wrong_points > 1:
        faults.append(
            f"{constraint.name}: its gradient by {constraint.slope_variable} differs from finite differences by "
            f"{constraint.slope_error:.2g} at {constraint.wrong_points} of {POINTS} random points"
        )
    if constraint.rank is not None and constraint.rank < constraint.equality_rows:
        faults.append(
            f"{constraint.name}: {constraint.equality_rows} equality rows are declared, "
            f"its Jacobian has rank {constraint.rank} at random points"
        )
    return faults


# ------------------------------------------------------------------ reach


class _Place:
    """Where a frame must be: around an object's pose, or around a region of its position."""

    def __init__(self, problem: Problem, hold: Hold, switch: str) -> None:
        task, scene = problem.scene.task, problem.scene
        self.low: np.ndarray | None = None
        source = object_pose_sources(task)[hold.object, switch]
        if source[0] == "variable":
            placement = task.placement(source[1])
            self.name = f"placement {source[1]} of {hold.object} at {switch}"
            self.low, self.high = np.array(placement.low), np.array(placement.high)
        elif source[0] == "goal":
            self.name = f"goal of {hold.object} at {switch}"
            self.pose = _matrix(scene.site_pose(source[1]))
        elif source[0] == "start":
            self.name = f"start of {hold.object} at {switch}"
            self.pose = _matrix(scene.object_pose(hold.object))
        else:
            goal = next(g for g in task.goals if (g.object, g.at) == (hold.object, switch))
            self.name = f"goal of {hold.object} at {switch}"
            self.low = self.high = scene.site_pose(goal.site)[:3]
        if isinstance(hold.grasp, TwoFingerGrasp):
            self.grasp_low, self.grasp_high = (np.array([bound]) for bound in (hold.grasp.low, hold.grasp.high))
        else:
            self.grasp_low = self.grasp_high = np.asarray(problem.params.sites[f"Grasp({hold.variable})"], float)[:, :3]
        # The frame is no further from the object's origin than this.
        self.margin = float(np.linalg.norm(np.maximum(np.abs(self.grasp_low), np.abs(self.grasp_high)), axis=1).max())

    def distance(self, points: np.ndarray) -> np.ndarray:
        """From points (P, 3) to the nearest place of the frame, m; of a region a lower bound."""
        if self.low is not None:
            gap = np.linalg.norm(points - np.clip(points, self.low, self.high), axis=1)
            return np.maximum(gap - self.margin, 0.0)
        rotation, position = self.pose
        local = ((points - position) @ rotation)[:, None]
        return np.linalg.norm(local - np.clip(local, self.grasp_low, self.grasp_high), axis=2).min(axis=1)

    def inside(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Positions (count, 3) of the object that are allowed."""
        if self.low is None:
            return np.tile(self.pose[1], (count, 1))
        return rng.uniform(self.low, self.high, size=(count, 3))


def _check_reach(problem: Problem, seed: int) -> tuple[list[ReachCheck], list[str]]:
    """Every end of every hold, and where several robots meet at one placement, a point that all of them reach."""
    task = problem.scene.task
    rng = np.random.default_rng(seed)
    checks: list[ReachCheck] = []
    faults: list[str] = []
    meeting: dict[tuple[str, str], list[tuple[Hold, np.ndarray, float]]] = {}
    for hold in task.holds:
        for switch in [hold.start] if hold.supports else [hold.start, hold.end]:
            source = object_pose_sources(task)[hold.object, switch]
            located = any((g.object, g.at) == (hold.object, switch) and g.position for g in task.goals)
            if source[0] == "held" and not located:
                continue
            place = _Place(problem, hold, switch)
            support = _support(problem, hold, switch)
            if support is not None:
                check = _hanging_reach(problem, hold, place, support, switch, rng)
            else:
                centre, reach, tools = _standing(problem, hold, switch)
                gap = float(place.distance(tools).min())
                check = ReachCheck(place.name, hold.robot, hold.frame, float(place.distance(centre[None])[0]), reach, gap)
                if source[0] == "variable" and place.low is not None:
                    meeting.setdefault((hold.object, switch), []).append((hold, tools, place.margin + GAP_SHARE * reach))
            checks.append(check)
            if not check.reachable:
                faults.append(_reach_fault(check))
    for (name, switch), needs in meeting.items():
        positions = _Place(problem, needs[0][0], switch).inside(rng, 1024)
        near = [cKDTree(tools).query(positions)[0] <= slack for _, tools, slack in needs]
        if len(needs) > 1 and all(part.any() for part in near) and not np.logical_and.reduce(near).any():
            frames = " and ".join(f"{hold.robot}/{hold.frame}" for hold, _, _ in needs)
            faults.append(f"placement of {name} at {switch}: no point of it is within reach of {frames} together")
    return checks, faults


def _reach_fault(check: ReachCheck) -> str:
    who = f"robot {check.robot} cannot bring {check.frame} to the {check.pose}"
    if check.distance > check.reach:
        return f"{who}: it is {check.distance:.2f} m away, the links in between add up to {check.reach:.2f} m"
    return f"{who}: no random configuration comes nearer than {check.gap:.2f} m"


def _support(problem: Problem, hold: Hold, switch: str) -> Hold | None:
    """What the robot hangs on at a switch."""
    task = problem.scene.task
    at = task.switch_index(switch)
    for other in task.holds:
        first, last = task.span(other)
        if other.supports and other.robot == hold.robot and first < at <= last:
            return other
    return None


def _tool_offset(problem: Problem, robot: str, frame: str) -> np.ndarray:
    """Position (3,) of a frame on the root itself."""
    return problem.exact.constants[f"{robot}/{frame}"][:3]


def _length(problem: Problem, chain: Chain, robot: str, first: int) -> float:
    """Sum of the lengths (m) from joint `first` to the tool."""
    task, model = problem.scene.task, problem.scene.model
    ranges = np.array([model.joint(name).range for name in task.robot(robot).joints[: len(chain.offset)]])
    slides = np.abs(ranges - np.asarray(chain.reference)[:, None]).max(axis=1) * np.asarray(chain.slide)
    links = np.linalg.norm(chain.offset[first + 1 :], axis=1).sum() + np.linalg.norm(chain.tool_offset)
    return float(links + slides[first:].sum())


def _standing(problem: Problem, hold: Hold, switch: str) -> tuple[np.ndarray, float, np.ndarray]:
    """First joint (3,), reach, and the frame at the random configurations (T, 3), in the world."""
    robot = problem.scene.task.robot(hold.robot)
    rotation, position = np.eye(3), np.zeros(3)
    if robot.base is not None:
        rotation, position = _matrix(problem.scene.object_pose(robot.base))
    key = f"{hold.robot}/{hold.frame}"
    chain = problem.exact.chains.get(key)
    if chain is None:
        centre = position + rotation @ _tool_offset(problem, hold.robot, hold.frame)
        return centre, 0.0, centre[None]
    tools = np.asarray(problem.params.tables[hold.robot].tools[key].position, float).T
    return position + rotation @ chain.offset[0], _length(problem, chain, hold.robot, 0), position + tools @ rotation.T


def _hanging_reach(
    problem: Problem, hold: Hold, place: _Place, support: Hold, switch: str, rng: np.random.Generator
) -> ReachCheck:
    """A robot that hangs by one frame and reaches with another: only the distance of the two matters."""
    grip = _Place(problem, support, switch)
    keys = [f"{hold.robot}/{frame}" for frame in (support.frame, hold.frame)]
    chains = [problem.exact.chains.get(key) for key in keys]
    tools = problem.params.tables[f"{hold.robot}, hanging"].tools
    at = [
        np.asarray(tools[key].position, float).T if chain is not None else problem.exact.constants[key][None, :3]
        for key, chain in zip(keys, chains, strict=True)
    ]
    apart = np.linalg.norm(at[0] - at[1], axis=1)
    long, short = sorted(chains, key=lambda chain: 0 if chain is None else -len(chain.offset))
    if long is None:
        reach = float(apart.max())
    else:
        links = 0 if short is None else len(short.offset)
        end = at[chains.index(None)][0] if short is None else short.tool_offset
        begin = long.offset[links] if links < len(long.offset) else long.tool_offset
        reach = float(np.linalg.norm(begin - end))
        if links < len(long.offset):
            reach += _length(problem, long, hold.robot, links)
    points = grip.inside(rng, 1024)
    distance = max(float(place.distance(points).min()) - grip.margin, 0.0)
    gap = max(distance - float(apart.max()), 0.0)
    return ReachCheck(place.name, hold.robot, hold.frame, distance, reach, gap)


def _matrix(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and position (3,) of `[x y z qw qx qy qz]`."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(pose[3:], dtype=float))
    return rotation.reshape(3, 3), np.asarray(pose[:3], dtype=float)


# ------------------------------------------------------------------ penetrations


def _find_overlaps(problem: Problem) -> list[Overlap]:
    """Live pairs that penetrate at home, and those of an object at its goal with what is fixed in the world."""
    scene, task = problem.scene, problem.scene.task
    model = scene.model
    data = mujoco.MjData(model)
    data.qpos[:] = scene.home_qpos
    found = _penetrating(model, data, "home", None)
    for goal in task.goals:
        if not goal.full:
            continue
        body = model.body(task.object(goal.object).body).id
        address = model.jnt_qposadr[model.body_jntadr[body]]
        data.qpos[:] = scene.home_qpos
        data.qpos[address : address + 7] = scene.site_pose(goal.site)
        found += _penetrating(model, data, f"goal of {goal.object}", body)
    return found


def _penetrating(model: mujoco.MjModel, data: mujoco.MjData, where: str, body: int | None) -> list[Overlap]:
    """Penetrating pairs by C MuJoCo, the deepest contact of each; `body`: only its geoms with those fixed in the world."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    deepest: dict[tuple[int, int], float] = {}
    for pair, distance in zip(data.contact.geom[: data.ncon], data.contact.dist[: data.ncon], strict=True):
        welds = {int(model.body_weldid[model.geom_bodyid[geom]]) for geom in pair}
        if distance < -Tolerances().penetration and (body is None or welds == {0, int(model.body_weldid[body])}):
            key = (int(min(pair)), int(max(pair)))
            deepest[key] = max(deepest.get(key, 0.0), -float(distance))
    return [Overlap(where, _geom_name(model, a), _geom_name(model, b), depth) for (a, b), depth in deepest.items()]


def _geom_name(model: mujoco.MjModel, geom: int) -> str:
    own = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
    return own or f"number {geom} of body {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, model.geom_bodyid[geom])}"
