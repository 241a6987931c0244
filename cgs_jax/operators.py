"""Conditional operators: new variables given assigned ones, as batched programs.

An operator (the paper's `o_{s,s'}`) solves one conditional problem. It is keyed by the problem (new variables and active
constraints), not by the pair of states, and its device programs are keyed by the layout, which many problems share. It works
in two programs: `propose` draws seeds and projects them on the constraint rows; `clearance` measures the signed distances that
its constraints answer for, on the survivors. Failure is data: a mask, and the violation per constraint.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.spatial.transform import Rotation

from cgs_jax import augmented_lagrangian as al
from cgs_jax.collisions import Body, ClearanceData, place_object, place_robot, smallest_distance
from cgs_jax.constraints import OwnSampler, PoseRows, Term, row_data
from cgs_jax.kinematics import Chain, joint_frames, padded, tool_pose, tool_poses_on_host
from cgs_jax.plans import Layout, Plan, PlanSystem, Point, Shared, Tasks, make_plan
from cgs_jax.poses import Array, Pose, compose, from_vector, inverse, to_vector
from cgs_jax.problems import Params, Problem
from cgs_jax.seeds import PoseSeed, SiteChoices, Tables, count_draws, draw, draw_own, pose_seed, uniforms
from cgs_jax.tables import SeedTable, Sources, aimed_tables
from cgs_jax.transitions import Transition

PENETRATION = 5e-5
"""Largest penetration (m) that an operator accepts; half the tolerance of the audit."""

CHUNK = 128
"""Lanes evaluated at once outside the solver; a few hundred keep all arrays in the cache."""

SEED_CHUNK = 32
"""Lanes whose seeds are chosen at once; each has many candidates."""

PyTree = Any

Refine = Callable[[Point, Tasks, Shared], Point]
"""Moves projected points, tasks last; gets the tasks' data and what they share."""


class Numbers(NamedTuple):
    """Arguments of `propose` that do not change from call to call."""

    shared: Shared
    tables: Tables
    seeds: PoseSeed  # of the free poses, stacked on the last axis
    choices: SiteChoices


class Proposals(NamedTuple):
    """What `propose` returns; tasks first."""

    configurations: jax.Array  # (K, tasks, joints)
    poses: jax.Array  # (outputs, tasks, 7) new poses in order, then padding
    feasible: jax.Array  # (tasks,) all rows within the tolerance, evaluated anew after the solver
    violation: jax.Array  # (constraints, tasks) largest row violation, m or rad; 0 for constraints without rows
    iterations: jax.Array  # (tasks,)
    executed: jax.Array  # () iterations that all lanes together went through


def _chunked(function: Callable, count: jax.Array | int, total: int, size: int, inputs: PyTree, blank: PyTree) -> PyTree:
    """Runs `function` over chunks of the last axis as far as `count` reaches, writing into `blank`."""
    size = min(size, total)

    def body(index: jax.Array, state: PyTree) -> PyTree:
        start = jnp.minimum(index * size, total - size)
        part = jax.tree.map(lambda a: lax.dynamic_slice_in_dim(a, start, size, axis=-1), inputs)
        result = function(part)
        return jax.tree.map(lambda whole, new: lax.dynamic_update_slice_in_dim(whole, new, start, -1), state, result)

    return lax.fori_loop(0, (jnp.asarray(count, jnp.int32) + size - 1) // size, body, blank)


def _blank(function: Callable, total: int, size: int, inputs: PyTree) -> PyTree:
    """Zeros in the shape of the outputs of `function`, with `total` lanes."""
    part = jax.tree.map(lambda a: a[..., : min(size, total)], inputs)
    shapes = jax.eval_shape(function, part)
    return jax.tree.map(lambda s: jnp.zeros(s.shape[:-1] + (total,), s.dtype), shapes)


def propose(
    layout: Layout,
    settings: al.Settings,
    lanes: int,
    key: jax.Array,
    first_task: Array,
    count: Array,
    given: Array,
    given_configurations: tuple[Array, ...],
    numbers: Numbers,
    refine: Refine | None = None,
) -> Proposals:
    """Draws a seed for each task and projects it; pure.

    `given` is `(tasks, given, 7)`, `given_configurations` `(tasks, dof)` each. `count` (traced) of the tasks are in use. The
    random stream of a task is a function of `key` (a key or its data) and `first_task + position`. `refine` moves the
    projected points before they are judged.
    """
    tasks = given.shape[0]
    numbers = jax.tree.map(jnp.asarray, numbers)
    key = jax.random.wrap_key_data(key) if key.dtype == jnp.uint32 else key
    numbers_of = jnp.asarray(first_task, jnp.uint32) + jnp.arange(tasks, dtype=jnp.uint32)
    vectors = jnp.transpose(jnp.asarray(given), (2, 1, 0))  # (7, given, tasks)
    configurations = tuple(jnp.asarray(q).T for q in given_configurations)
    shared = numbers.shared

    def draw_chunk(part: PyTree) -> PyTree:
        number, vector, q = part
        u = uniforms(key, number, count_draws(layout))
        pose = from_vector(vector)
        pose = Pose(jnp.moveaxis(pose.rotation, 2, 0), jnp.moveaxis(pose.position, 1, 0))
        own = draw_own(layout, key, number, vector, q)
        return draw(layout, pose, q, numbers.tables, numbers.seeds, numbers.choices, shared, u, own)

    inputs = (numbers_of, vectors, configurations)
    blank = _blank(draw_chunk, tasks, SEED_CHUNK, inputs)
    seeds, task_data = _chunked(draw_chunk, count, tasks, SEED_CHUNK, inputs, blank)

    system = PlanSystem(layout)
    if layout.solves:
        projection = al.project_queue(system, seeds, task_data, shared, count, min(lanes, tasks), settings)
        x, iterations, executed = projection.x, projection.iterations, projection.executed
    else:
        x, iterations, executed = seeds, jnp.zeros((tasks,), jnp.int32), jnp.zeros((), jnp.int32)
    if refine is not None:
        x = refine(x, task_data, shared)

    def judge(part: PyTree) -> tuple[jax.Array, jax.Array]:
        point, data = part
        violation, poses = system.violations(point, (data, shared))
        return violation, to_vector(poses)

    blank = _blank(judge, tasks, CHUNK, (x, task_data))
    violation, poses = _chunked(judge, count, tasks, CHUNK, (x, task_data), blank)
    feasible = jnp.all(violation <= settings.tolerance, axis=0) & (jnp.arange(tasks) < count)
    feasible &= jnp.all(jnp.isfinite(poses), axis=(0, 1)) & jnp.all(jnp.isfinite(x.configurations), axis=(0, 1))
    return Proposals(
        configurations=jnp.swapaxes(x.configurations, 1, 2),
        poses=jnp.transpose(poses, (1, 2, 0)),
        feasible=feasible,
        violation=violation,
        iterations=iterations,
        executed=executed,
    )


# ------------------------------------------------------------------ clearance


class Factor(NamedTuple):
    """A factor of a body's pose by position: a given pose, or the tool of a configuration's chain."""

    is_chain: bool
    index: int
    inverted: bool


class BodyLayout(NamedTuple):
    """A body of a clearance by position."""

    kind: str  # "robot", "object", "still"
    configuration: int
    pose: tuple[Factor, ...]


class ClearanceLayout(NamedTuple):
    """What a clearance program is compiled for, apart from array shapes."""

    bodies: tuple[BodyLayout, ...]
    chain_configurations: tuple[int, ...]


class ClearanceNumbers(NamedTuple):
    """Arguments of `clearance` that do not change from call to call."""

    chains: tuple[Chain, ...]  # those that base poses go through
    data: ClearanceData


def clearance(
    layout: ClearanceLayout,
    count: Array,
    poses: Array,
    configurations: tuple[Array, ...],
    numbers: ClearanceNumbers,
) -> jax.Array:
    """Smallest signed distance (m) per task over the live pairs, `(tasks,)`; pure.

    `poses` is `(tasks, poses, 7)`, `configurations` `(tasks, dof)` each; `count` (traced) of the tasks are in use.
    """
    tasks = poses.shape[0]
    numbers = jax.tree.map(jnp.asarray, numbers)

    def pose_of(factors: tuple[Factor, ...], given: Array, q: tuple[Array, ...]) -> Pose | None:
        result: Pose | None = None
        for factor in factors:
            if factor.is_chain:
                chain = numbers.chains[factor.index]
                at = q[layout.chain_configurations[factor.index]][: chain.offset.shape[0]]
                value = tool_pose(chain, joint_frames(chain, at))
            else:
                value = from_vector(given[:, factor.index])
            value = inverse(value) if factor.inverted else value
            result = value if result is None else compose(result, value)
        return result

    def measure(part: PyTree) -> jax.Array:
        given, q = part
        placed, robots = [], 0
        for body, shapes in zip(layout.bodies, numbers.data.shapes, strict=True):
            pose = pose_of(body.pose, given, q)
            if body.kind == "robot":
                placed.append(place_robot(shapes, numbers.data.chains[robots], q[body.configuration], pose))
                robots += 1
            else:
                placed.append(place_object(shapes, pose))
        distance = smallest_distance(placed, numbers.data.pairs)
        return jnp.broadcast_to(jnp.where(jnp.isfinite(distance), distance, -jnp.inf), (given.shape[-1],))

    arrays = (jnp.transpose(jnp.asarray(poses), (2, 1, 0)), tuple(jnp.asarray(q).T for q in configurations))
    return _chunked(measure, count, tasks, CHUNK, arrays, jnp.full((tasks,), -jnp.inf))


@dataclass(frozen=True)
class Clear:
    """A constraint's clearance bound to names."""

    constraint: str
    layout: ClearanceLayout
    poses: tuple[Term, ...]
    configurations: tuple[str, ...]
    chains: tuple[str, ...]

    @property
    def reads(self) -> tuple[str, ...]:
        """Variables that it mentions."""
        return (*self.configurations, *(term.name for term in self.poses if term.kind == "pose"))

    def numbers(self, params: Params) -> ClearanceNumbers:
        """The unchanging arguments of `clearance`."""
        return ClearanceNumbers(tuple(params.chains[name] for name in self.chains), params.clearances[self.constraint])


def bind_clearance(constraint: str, bodies: Sequence[Body]) -> Clear:
    """Numbers the configurations, poses and chains that the bodies of a clearance mention."""
    configurations: list[str] = []
    poses: list[Term] = []
    chains: list[tuple[str, str]] = []

    def position(names: list, name: Any) -> int:
        if name not in names:
            names.append(name)
        return names.index(name)

    def factor(term: Term) -> Factor:
        if term.kind == "chain":
            return Factor(True, position(chains, (term.name, term.variable)), term.inverted)
        return Factor(False, position(poses, Term(term.kind, term.name)), term.inverted)

    layouts = []
    for body in bodies:
        at = position(configurations, body.variable) if body.variable else -1
        layouts.append(BodyLayout(body.kind, at, tuple(map(factor, body.pose))))
    of_chain = tuple(position(configurations, variable) for _, variable in chains)
    return Clear(
        constraint=constraint,
        layout=ClearanceLayout(tuple(layouts), of_chain),
        poses=tuple(poses),
        configurations=tuple(configurations),
        chains=tuple(name for name, _ in chains),
    )


# ------------------------------------------------------------------ operators of a problem


@dataclass(frozen=True)
class Operator:
    """A conditional problem bound to names: what to pass to the pure programs, and how to read what comes back."""

    new: tuple[str, ...]
    condition: tuple[str, ...]
    """Assigned variables that it reads."""
    constraints: tuple[str, ...]
    """Active constraints; those with rows come first in `Proposals.violation`, in the order of `measured`."""
    measured: tuple[str, ...]
    plan: Plan
    clears: tuple[Clear, ...]
    """Clearances that are checked after the solver."""
    inside: tuple[str, ...]
    """Constraints whose clearance the solver keeps by a row."""
    tables: tuple[str, ...]
    """Seed table of each new configuration."""
    dofs: tuple[int, ...]
    """Joints of each new configuration."""
    identity: int
    """Number that separates its random streams from other operators'."""

    def numbers(self, params: Params, aimed: Sequence[SeedTable | None] = ()) -> Numbers:
        """The unchanging arguments of `propose`; `aimed` has seed tables that take the place of the robots' plain ones."""
        layout, plan = self.plan.layout, self.plan
        chains = [
            padded(params.chains[name] if name else _NO_CHAIN, layout.joints)
            for names in plan.tools
            for name in self._filled(names)
        ]
        limits = [params.limits[name] for name in plan.configurations]
        tables = [params.tables[name] for name in self.tables]
        if aimed:
            tables = [own or plain for own, plain in zip(aimed, tables, strict=True)]
        size = tables[0].configurations.shape[-1] if tables else 1
        tools = [
            table.tools[name] if name else _still_tool(size)
            for table, names in zip(tables, plan.tools, strict=True)
            for name in self._filled(names)
        ]
        silent = row_data("located", low=[-np.inf] * 3, high=[np.inf] * 3)
        rows = [params.rows[name] if name else silent for name in plan.rows]
        rows += [silent] * (layout.words - layout.bare - len(rows))
        seeds = []
        for _, name in plan.free:
            seed = params.seeds[name] if name else pose_seed(None)
            site = layout.first_site + plan.sites.index(name) if name in plan.sites else 0
            seeds.append(seed._replace(site=np.asarray(site, np.int32)))
        return Numbers(
            shared=Shared(
                code=plan.code,
                chains=_stack(chains),
                rows=_stack(rows),
                clearances=tuple(params.clearances[name] for name in self.inside),
            ),
            tables=Tables(
                configurations=_pad([t.configurations for t in tables], (layout.joints, size)),
                low=_pad([low for low, _ in limits], (layout.joints,)),
                high=_pad([high for _, high in limits], (layout.joints,)),
                rotation=_pad([tool.rotation for tool in tools], (3, 3, size)),
                position=_pad([tool.position for tool in tools], (3, size)),
            ),
            seeds=_stack(seeds),
            choices=self._choices(params),
        )

    def _filled(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Each configuration has the layout's number of tools; spare ones ("") do not move."""
        return names + ("",) * (self.plan.layout.chains - len(names))

    def _choices(self, params: Params) -> SiteChoices:
        """Sites per site register, padded to the most that any constraint of the problem offers."""
        room = self.plan.layout.sites
        most = max([sites.shape[0] for sites in params.sites.values()], default=1)
        identity = np.array([0, 0, 0, 1, 0, 0, 0], np.float32)
        poses, count = np.tile(identity, (room, most, 1)), np.ones(room, np.int32)
        offered = [params.sites[name] for name in self.plan.sites]
        if all(isinstance(sites, np.ndarray) for sites in offered):
            for i, sites in enumerate(offered):
                poses[i, : len(sites)], count[i] = sites, len(sites)
            return SiteChoices(poses, count)
        traced = jnp.asarray(poses)
        for i, sites in enumerate(offered):
            traced = traced.at[i, : sites.shape[0]].set(sites)
            count[i] = sites.shape[0]
        return SiteChoices(traced, count)

    def named(self, proposals: Proposals) -> dict[str, Array]:
        """New variables by name, `(tasks, dim)`."""
        values = {
            name: proposals.configurations[k][:, :dof]
            for k, (name, dof) in enumerate(zip(self.plan.configurations, self.dofs, strict=True))
        }
        return values | {name: proposals.poses[i] for i, name in enumerate(self.plan.poses)}

    def of_one(self, name: str, configurations: Array, poses: Array) -> Array:
        """A new variable `(dim,)` of one task, out of its configurations `(K, joints)` and poses `(outputs, 7)`."""
        if name in self.plan.poses:
            return poses[self.plan.poses.index(name)]
        at = self.plan.configurations.index(name)
        return configurations[at, : self.dofs[at]]


_NO_CHAIN = Chain(
    np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0), np.eye(3), np.zeros(3)
)
"""A tool that does not move, for a configuration that no product mentions."""


def _still_tool(size: int) -> Pose:
    return Pose(np.tile(np.eye(3, dtype=np.float32)[..., None], size), np.zeros((3, size), np.float32))


def _stack(parts: list) -> Any:
    """Stacks pytrees of arrays on a new last axis; numpy stays numpy."""
    if not parts:
        return ()

    def stack(*arrays: Array) -> Array:
        if any(isinstance(a, jax.Array) for a in arrays):
            return jnp.stack([jnp.asarray(a, jnp.int32 if a.dtype == np.int32 else jnp.float32) for a in arrays], axis=-1)
        kind = np.int32 if arrays[0].dtype == np.int32 else np.float32
        return np.stack([np.asarray(a, kind) for a in arrays], axis=-1)

    return jax.tree.map(stack, *parts)


def _pad(parts: list[Array], shape: tuple[int, ...]) -> Array:
    """Stacks arrays on a new first axis, the first axis of each padded with zeros to `shape`."""
    if not parts:
        return np.zeros((0, *shape), np.float32)
    numpy = all(isinstance(part, np.ndarray) for part in parts)
    module: Any = np if numpy else jnp
    grown = [module.pad(p, [(0, want - have) for have, want in zip(p.shape, shape, strict=True)]) for p in parts]
    return module.stack(grown).astype(np.float32)


def operator_of(problem: Problem, transition: Transition) -> Operator:
    """The operator of a transition's conditional problem; the same object for the same problem."""
    known = problem.operators
    if transition.problem not in known:
        known[transition.problem] = _bind(problem, transition)
    return known[transition.problem]


def _bind(problem: Problem, transition: Transition) -> Operator:
    active = transition.constraints
    declarations = {name: problem.declarations[name] for name in active if name in problem.declarations}
    clearances = {name: problem.clearances[name].bodies for name in active if name in problem.clearances}
    inside = clearances if problem.collisions == "inside" else {}
    touches = sum(isinstance(d, PoseRows) and d.form == "touch" for d in problem.declarations.values())
    plan = make_plan(
        transition.new,
        declarations,
        problem.dofs,
        {name: chain.offset.shape[0] for name, chain in problem.params.chains.items()},
        max([dof for dof in problem.dofs.values() if dof is not None], default=0),
        touches,
        {name: _widths(*problem.params.limits[name]) for name in problem.vectors},
        _samplers(problem, transition),
        inside,
    )
    return Operator(
        new=transition.new,
        condition=problem.graph.ordered(transition.condition),
        constraints=active,
        measured=tuple(dict.fromkeys([*declarations, *inside])),
        plan=plan,
        clears=tuple(bind_clearance(name, bodies) for name, bodies in clearances.items() if name not in inside),
        inside=tuple(inside),
        tables=tuple(problem.table_of[name] for name in plan.configurations),
        dofs=tuple(problem.dofs[name] or 0 for name in plan.configurations),
        identity=zlib.crc32(repr(transition.problem).encode()),
    )


def aimed_at(problem: Problem, operator: Operator) -> list[SeedTable | None]:
    """Seed tables for the operator's new configurations, made for the problem's own numbers (host work)."""
    params = problem.params
    seed_of: dict[str, str] = {}
    for name, declaration in problem.declarations.items():
        if name in params.seeds:
            seed_of.setdefault(declaration.scope[0], name)
    pools = {name: problem.pools[table] for name, table in problem.table_of.items() if table in problem.pools}
    return aimed_tables(operator.plan, Sources(params.constants, params.rows, params.seeds, params.sites, seed_of, pools))


def _widths(low: Array, high: Array) -> tuple[float, ...]:
    return tuple(float(b - a) for a, b in zip(low, high, strict=True))


def _samplers(problem: Problem, transition: Transition) -> list[OwnSampler]:
    """A user's samplers that draw here: all their variables are new, and what they are given is assigned or drawn before."""
    chosen: list[OwnSampler] = []
    known = set(transition.condition)
    left = list(problem.samplers)
    while True:
        able = [s for s in left if set(s.variables) <= set(transition.new) and set(s.given) <= known]
        if not able:
            return chosen
        chosen += able
        left = [s for s in left if s not in able]
        known |= {name for s in able for name in s.variables}


def gather_given(operator: Operator, params: Params, values: Mapping[str, Array], tasks: int) -> Array:
    """`(tasks, given, 7)`: what the given registers hold; `values` has `(tasks, dim)` of assigned variables."""
    module: Any = np if all(isinstance(v, np.ndarray) for v in (*values.values(), *params.constants.values())) else jnp
    identity = np.array([0, 0, 0, 1, 0, 0, 0], np.float32)
    columns = []
    for term in operator.plan.given:
        if term.kind == "pose":
            columns.append(values[term.name])
        elif term.kind == "constant":
            columns.append(module.broadcast_to(params.constants[term.name], (tasks, 7)))
        else:
            assert term.variable is not None
            columns.append(_tool_vector(params.chains[term.name], values[term.variable]))
    columns += [module.broadcast_to(identity, (tasks, 7))] * (operator.plan.layout.given - len(columns))
    return module.stack(columns, axis=1)


def _tool_vector(chain: Chain, q: Array) -> Array:
    """Tool poses `(lanes, 7)` of a chain at given configurations `(lanes, dof)`."""
    if isinstance(q, np.ndarray):
        rotation, position = tool_poses_on_host(chain, q)
        quat = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
        return np.concatenate([position, quat], axis=1).astype(np.float32)
    return to_vector(tool_pose(chain, joint_frames(chain, q.T[: chain.offset.shape[0]]))).T


COMPILER_OPTIONS: dict[str, Any] = {"xla_cpu_prefer_vector_width": 512, "xla_cpu_use_fusion_emitters": False}
"""Measured on `propose`: a quarter less time to run and to compile than XLA's defaults; other backends do not read them."""


@functools.cache
def propose_program(layout: Layout, settings: al.Settings, lanes: int) -> Callable:
    """The jitted `propose` of a layout; the same object for the same arguments, so that it compiles once."""
    return jax.jit(functools.partial(propose, layout, settings, lanes), compiler_options=_compiler_options())


def _compiler_options() -> dict[str, Any]:
    return COMPILER_OPTIONS if jax.default_backend() == "cpu" else {}


@functools.cache
def clearance_program(layout: ClearanceLayout) -> Callable:
    """The jitted `clearance` of a layout."""
    return jax.jit(functools.partial(clearance, layout), compiler_options=_compiler_options())


def gather_poses(clear: Clear, params: Params, values: Mapping[str, Array], tasks: int) -> Array:
    """`(tasks, poses, 7)` for `clearance`; `values` has assigned and new variables."""
    module: Any = np if all(isinstance(v, np.ndarray) for v in (*values.values(), *params.constants.values())) else jnp
    columns = [
        values[t.name] if t.kind == "pose" else module.broadcast_to(params.constants[t.name], (tasks, 7)) for t in clear.poses
    ]
    return module.stack(columns, axis=1) if columns else module.zeros((tasks, 0, 7), np.float32)

