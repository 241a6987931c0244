"""Projection of seeds onto a set of constraints: a batched augmented Lagrangian with damped Gauss-Newton steps.

Every constraint row asks for `low <= c(x) <= high`; an equality has `low == high`, an inequality `c <= 0` has
`low = -inf, high = 0`. With multipliers `y` and penalty `rho` the augmented Lagrangian of the feasibility problem is
`rho / 2 * |d(c + y / rho)|^2`, where `d(s) = s - clip(s, low, high)` is the distance vector to the interval. Its Gauss-Newton
model gives the step `-J^T (J J^T + mu I)^-1 d`: as many equations as rows, since a conditional problem of a pruned graph never
has more equality rows than unknowns. Without a cost all multipliers vanish at a feasible point and the quadratic penalty is
exact, so that the default never updates them (`multiplier_period = 0`); see `docs/performance.md` for what was measured.

A solver is three functions, `init`, `step` and `finished`; `project` and `project_queue` are the loops over them. Arrays
have their lanes (independent problems) last.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import optax
from jax import lax

PyTree = Any


class Rows(NamedTuple):
    """m constraint rows at one point: `low <= value <= high`, with n unknowns."""

    value: jax.Array  # (m, lanes)
    low: jax.Array  # (m, 1 or lanes)
    high: jax.Array  # (m, 1 or lanes)
    aim_low: jax.Array  # (m, 1 or lanes) a violated row is pulled to this point inside the interval, not onto its end
    aim_high: jax.Array  # (m, 1 or lanes)
    jacobian: jax.Array  # (m, n, lanes)


class System(Protocol):
    """What the solver must know of a problem; all methods are pure and batched over lanes."""

    def rows(self, x: PyTree, data: PyTree) -> Rows:
        """Linearises all constraints at x."""
        ...

    def room(self, x: PyTree, data: PyTree) -> tuple[jax.Array, jax.Array]:
        """Smallest and largest admissible step of each unknown, both `(n, lanes)`; infinite where unbounded."""
        ...

    def retract(self, x: PyTree, step: jax.Array) -> PyTree:
        """Moves x by a tangent step `(n, lanes)`."""
        ...


@dataclass(frozen=True)
class Settings:
    """How a projection runs."""

    tolerance: float = 2.5e-5
    """Largest violation of any row, in its own unit (m or rad), that counts as feasible."""
    max_iterations: int = 24
    """Iterations after which a lane is given up."""
    damping: float = 0.07
    """Levenberg-Marquardt damping mu = damping * |d|^2 + 1e-6."""
    max_step: float = 0.6
    """Largest change of one unknown in one iteration, rad or m."""
    stall_after: int = 6
    """From this iteration on, a lane whose squared residual fell by less than `stall_ratio` over a check period is given up."""
    stall_ratio: float = 0.5
    """See `stall_after`."""
    check_period: int = 2
    """Iterations between two looks at which lanes have finished."""
    multiplier_period: int = 0
    """Iterations between two updates of the multipliers; 0 leaves them at zero (no cost, so the penalty is exact)."""
    penalty: float = 1.0
    """Initial penalty rho."""
    penalty_growth: float = 4.0
    """Factor on rho after a multiplier update that did not halve the violation."""


class State(NamedTuple):
    """One projection in flight."""

    x: PyTree
    pressed: jax.Array  # (n, lanes) bool: the last step was cut at a bound, so the next one leaves this unknown alone
    multipliers: jax.Array  # (m, lanes)
    penalty: jax.Array  # (lanes,)
    iteration: jax.Array  # (lanes,) steps made
    violation: jax.Array  # (lanes,) largest row violation at x as it was when last looked at
    residual: jax.Array  # (lanes,) squared residual there
    checked: jax.Array  # (lanes,) squared residual at the last stall check
    updated: jax.Array  # (lanes,) violation at the last multiplier update


def distance_to_interval(value: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Signed distance vector `value - clip(value, low, high)`."""
    return value - jnp.clip(value, low, high)


def init(system: System, x: PyTree, data: PyTree, settings: Settings) -> State:
    """State before the first step; x has its lanes last."""
    shape = jax.eval_shape(system.rows, x, data)
    rows, unknowns, lanes = shape.jacobian.shape
    dtype = shape.value.dtype
    big = jnp.full((lanes,), jnp.inf, dtype)
    return State(
        x=x,
        pressed=jnp.zeros((unknowns, lanes), bool),
        multipliers=jnp.zeros((rows, lanes), dtype),
        penalty=jnp.full((lanes,), settings.penalty, dtype),
        iteration=jnp.zeros((lanes,), jnp.int32),
        violation=big,
        residual=big,
        checked=big,
        updated=big,
    )


def step(system: System, state: State, data: PyTree, settings: Settings) -> State:
    """One damped Gauss-Newton iteration; a lane that is already feasible or has finished does not move."""
    rows = system.rows(state.x, data)
    violation = jnp.max(jnp.abs(distance_to_interval(rows.value, rows.low, rows.high)), axis=0)
    violation = jnp.where(jnp.isfinite(violation), violation, jnp.inf)
    if settings.multiplier_period:
        state = _update_multipliers(state, rows, violation, settings)
    shifted = rows.value + state.multipliers / state.penalty
    outside = distance_to_interval(shifted, rows.low, rows.high) != 0
    active = outside | (rows.low == rows.high)
    residual = jnp.where(outside, distance_to_interval(shifted, rows.aim_low, rows.aim_high), 0.0)
    squared = jnp.sum(residual * residual, axis=0)

    jacobian = jnp.where(active[:, None], rows.jacobian, 0.0)
    jacobian = jnp.where(state.pressed[None], 0.0, jacobian)
    move = -_damped_least_norm(jacobian, residual, settings.damping * squared + 1e-6)
    largest = jnp.max(jnp.abs(move), axis=0)
    move = move * jnp.minimum(1.0, settings.max_step / jnp.maximum(largest, 1e-12))
    least, most = system.room(state.x, data)
    pressed = (move < least) | (move > most)
    move = jnp.clip(move, least, most)
    moving = (violation > settings.tolerance) & jnp.isfinite(squared)
    x = jax.tree.map(lambda new, old: jnp.where(moving, new, old), system.retract(state.x, move), state.x)
    return state._replace(
        x=x,
        pressed=pressed,
        # A lane that is not finite counts too: that it was looked at is what ends it.
        iteration=state.iteration + (violation > settings.tolerance),
        violation=violation,
        residual=jnp.where(jnp.isfinite(squared), squared, jnp.inf),
    )


def _update_multipliers(state: State, rows: Rows, violation: jax.Array, settings: Settings) -> State:
    """First-order update `y <- rho * d(c + y / rho)` at x; rho grows where the violation did not halve."""
    due = (state.iteration > 0) & (state.iteration % settings.multiplier_period == 0) & (violation > settings.tolerance)
    shifted = rows.value + state.multipliers / state.penalty
    multipliers = jnp.where(due, state.penalty * distance_to_interval(shifted, rows.low, rows.high), state.multipliers)
    penalty = jnp.where(due & (violation > 0.5 * state.updated), state.penalty * settings.penalty_growth, state.penalty)
    return state._replace(multipliers=multipliers, penalty=penalty, updated=jnp.where(due, violation, state.updated))


def finished(state: State, settings: Settings) -> jax.Array:
    """Lanes `(lanes,)` that need no further step: feasible, out of iterations, stalled, or not finite."""
    stalled = (state.iteration >= settings.stall_after) & (state.residual > settings.stall_ratio * state.checked)
    if settings.multiplier_period:
        stalled = jnp.zeros_like(stalled)
    broken = (state.iteration > 0) & ~jnp.isfinite(state.residual)
    return (state.violation <= settings.tolerance) | (state.iteration >= settings.max_iterations) | stalled | broken


def _weighted_rows(jacobian: jax.Array, weights: jax.Array) -> jax.Array:
    """`J^T w` per lane: `(m, n, lanes)`, `(m, lanes)` -> `(n, lanes)`."""
    return sum(jacobian[k] * weights[k] for k in range(1, jacobian.shape[0])) + jacobian[0] * weights[0]


def _damped_least_norm(jacobian: jax.Array, residual: jax.Array, damping: jax.Array) -> jax.Array:
    """`J^T (J J^T + mu I)^-1 d` per lane: `(m, n, lanes)`, residual `(m, lanes)`, damping `(lanes,)` -> `(n, lanes)`."""
    m, n, _ = jacobian.shape
    gram = damping * jnp.eye(m, dtype=jacobian.dtype)[..., None]
    for i in range(n):
        gram = gram + jacobian[:, None, i] * jacobian[None, :, i]
    return _weighted_rows(jacobian, cholesky_solve(gram, residual))


def cholesky_solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solves symmetric positive definite systems per lane: matrix `(m, m, lanes)`, right `(m, lanes)` -> `(m, lanes)`."""
    m = matrix.shape[0]
    if m > UNROLLED_ROWS:
        return _cholesky_solve_looped(matrix, right)
    lower: list[list[jax.Array]] = [[jnp.zeros(())] * m for _ in range(m)]
    inverse_diagonal = []
    for j in range(m):
        pivot = matrix[j, j]
        for k in range(j):
            pivot = pivot - lower[j][k] * lower[j][k]
        inverse_diagonal.append(lax.rsqrt(pivot))
        for i in range(j + 1, m):
            entry = matrix[i, j]
            for k in range(j):
                entry = entry - lower[i][k] * lower[j][k]
            lower[i][j] = entry * inverse_diagonal[j]
    y: list[jax.Array] = []
    for i in range(m):
        value = right[i]
        for k in range(i):
            value = value - lower[i][k] * y[k]
        y.append(value * inverse_diagonal[i])
    for i in reversed(range(m)):
        value = y[i]
        for k in range(i + 1, m):
            value = value - lower[k][i] * y[k]
        y[i] = value * inverse_diagonal[i]
    return jnp.stack(y)


UNROLLED_ROWS = 8
"""Above this many rows the factorisation runs in loops: unrolled it would compile for seconds."""


def _cholesky_solve_looped(matrix: jax.Array, right: jax.Array) -> jax.Array:
    m, _, lanes = matrix.shape
    rank = jnp.arange(m)[:, None]

    # Row j of `upper` is the j-th column of the factor L, so that every access is a whole row.
    def factor(j: jax.Array, upper: jax.Array) -> jax.Array:
        column = matrix[j] - jnp.sum(upper * upper[:, j][:, None], axis=0)
        column = column * lax.rsqrt(column[j])
        return lax.dynamic_update_index_in_dim(upper, jnp.where(rank >= j, column, 0.0), j, 0)

    upper = lax.fori_loop(0, m, factor, jnp.zeros_like(matrix))

    def forward(j: jax.Array, rest: jax.Array) -> jax.Array:
        solved = rest[j] / upper[j, j]
        rest = rest - jnp.where(rank > j, upper[j] * solved, 0.0)
        return lax.dynamic_update_index_in_dim(rest, solved, j, 0)

    y = lax.fori_loop(0, m, forward, right)

    def backward(i: jax.Array, solution: jax.Array) -> jax.Array:
        j = m - 1 - i
        rest = jnp.sum(jnp.where(rank > j, upper[j] * solution, 0.0), axis=0)
        return lax.dynamic_update_index_in_dim(solution, (solution[j] - rest) / upper[j, j], j, 0)

    return lax.fori_loop(0, m, backward, y)


class Projection(NamedTuple):
    """Outcome per lane or task."""

    x: PyTree
    feasible: jax.Array  # (lanes,) bool: every row within the tolerance
    violation: jax.Array  # (lanes,) largest row violation
    iterations: jax.Array  # (lanes,) int32
    executed: jax.Array  # () int32: iterations that all lanes together went through, those that were done included


def project(system: System, x: PyTree, data: PyTree, settings: Settings) -> Projection:
    """Projects every lane's seed; runs until all lanes have finished."""

    def body(carry: tuple[State, jax.Array]) -> tuple[State, jax.Array]:
        state, rounds = carry
        checked = state.residual
        state = lax.fori_loop(0, settings.check_period, lambda _, s: step(system, s, data, settings), state)
        return state._replace(checked=checked), rounds + 1

    start = init(system, x, data, settings), jnp.zeros((), jnp.int32)
    state, rounds = lax.while_loop(lambda carry: ~jnp.all(finished(carry[0], settings)), body, start)
    executed = rounds * settings.check_period * state.violation.shape[0]
    return Projection(state.x, state.violation <= settings.tolerance, state.violation, state.iteration, executed)


class _Packing:
    """Lays the leaves of a pytree with lanes last out as one array, and back."""

    def __init__(self, tree: PyTree) -> None:
        leaves, self._structure = jax.tree.flatten(tree)
        self._shapes = [leaf.shape[:-1] for leaf in leaves]
        self._sizes = [math.prod(shape) for shape in self._shapes]

    def pack(self, tree: PyTree) -> jax.Array:
        """`(size, lanes)`."""
        leaves = jax.tree.leaves(tree)
        lanes = leaves[0].shape[-1]
        return jnp.concatenate([leaf.reshape(size, lanes) for leaf, size in zip(leaves, self._sizes, strict=True)])

    def unpack(self, packed: jax.Array) -> PyTree:
        """The pytree again."""
        leaves, at = [], 0
        for shape, size in zip(self._shapes, self._sizes, strict=True):
            leaves.append(packed[at : at + size].reshape(*shape, packed.shape[-1]))
            at += size
        return jax.tree.unflatten(self._structure, leaves)


def project_queue(
    system: System, seeds: PyTree, tasks: PyTree, shared: PyTree, count: jax.Array, lanes: int, settings: Settings
) -> Projection:
    """Projects a queue of tasks with a fixed number of lanes, each refilled as soon as it has finished.

    `seeds` and `tasks` have the tasks on their last axis, `(..., N)`; `shared` is the same for all. Only the first `count`
    (traced) tasks run. The outcome has N entries; those from `count` on are infeasible and meaningless.

    A finished lane is copied out and refilled by slices: XLA's CPU gather and scatter go element by element and would cost
    more than the iterations.
    """
    points, packing = _Packing(seeds), _Packing(tasks)
    seed_rows, task_rows = points.pack(seeds).T, packing.pack(tasks).T  # (N, size): a task is one run of memory
    total, size = seed_rows.shape
    count = jnp.asarray(count, jnp.int32)
    first = jnp.arange(lanes, dtype=jnp.int32)
    start_x, start_tasks = seed_rows[:lanes].T, task_rows[:lanes].T
    blank = init(system, points.unpack(start_x), (packing.unpack(start_tasks), shared), settings)
    # Per task: the point, the violation, the iterations.
    results = jnp.concatenate([seed_rows, jnp.full((total, 1), jnp.inf), jnp.zeros((total, 1))], axis=1)
    Carry = tuple[State, jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]

    def busy(carry: Carry) -> jax.Array:
        return jnp.any(carry[2] < count)

    def body(carry: Carry) -> Carry:
        state, lane_tasks, ids, following, results, rounds = carry
        data = (packing.unpack(lane_tasks), shared)
        checked = state.residual
        state = lax.fori_loop(0, settings.check_period, lambda _, s: step(system, s, data, settings), state)
        state = state._replace(checked=checked)
        done = finished(state, settings) & (ids < count)
        (leaving,) = jnp.nonzero(done, size=lanes, fill_value=0)
        outcome = jnp.concatenate(
            [points.pack(state.x), state.violation[None], state.iteration[None].astype(state.violation.dtype)]
        )

        def exchange(i: jax.Array, held: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            x, lane_tasks, ids, results = held
            lane, task = leaving[i], following + i
            column = lax.dynamic_slice_in_dim(outcome, lane, 1, axis=1)
            results = lax.dynamic_update_slice_in_dim(results, column.T, ids[lane], axis=0)
            seed = lax.dynamic_slice_in_dim(seed_rows, jnp.minimum(task, total - 1), 1, axis=0)
            task_row = lax.dynamic_slice_in_dim(task_rows, jnp.minimum(task, total - 1), 1, axis=0)
            x = lax.dynamic_update_slice_in_dim(x, seed.T, lane, axis=1)
            lane_tasks = lax.dynamic_update_slice_in_dim(lane_tasks, task_row.T, lane, axis=1)
            return x, lane_tasks, lax.dynamic_update_index_in_dim(ids, task, lane, 0), results

        moved = jnp.sum(done, dtype=jnp.int32)
        x, lane_tasks, ids, results = lax.fori_loop(0, moved, exchange, (outcome[:size], lane_tasks, ids, results))
        fresh = {n: jnp.where(done, getattr(blank, n), getattr(state, n)) for n in State._fields if n != "x"}
        return State(x=points.unpack(x), **fresh), lane_tasks, ids, following + moved, results, rounds + 1

    carry = (blank, start_tasks, first, jnp.asarray(lanes, jnp.int32), results, jnp.zeros((), jnp.int32))
    *_, results, rounds = lax.while_loop(busy, body, carry)
    violation = results[:, size]
    return Projection(
        x=points.unpack(results[:, :size].T),
        feasible=violation <= settings.tolerance,
        violation=violation,
        iterations=results[:, size + 1].astype(jnp.int32),
        executed=rounds * settings.check_period * lanes,
    )


# ------------------------------------------------------------------ with a cost


@dataclass(frozen=True)
class CostSettings:
    """How a minimisation runs."""

    tolerance: float = 2.5e-5
    """Largest violation of any row that counts as feasible."""
    multiplier_tolerance: float = 1e-3
    """Largest change of a multiplier, relative to the largest, at which the outer loop ends."""
    outer_iterations: int = 20
    """Largest number of multiplier updates."""
    inner_iterations: int = 40
    """L-BFGS iterations between two updates."""
    gradient_tolerance: float = 1e-5
    """Norm of the gradient at which the inner loop ends."""
    penalty: float = 10.0
    """Initial penalty rho."""
    penalty_growth: float = 4.0
    """Factor on rho after an update that did not bring the violation to a quarter."""
    largest_penalty: float = 1e4
    """Single precision cannot tell the cost beside a larger one."""


class Minimum(NamedTuple):
    """Outcome of one minimisation."""

    x: jax.Array  # (n,)
    cost: jax.Array  # ()
    feasible: jax.Array  # () bool
    violation: jax.Array  # () largest row violation
    multipliers: jax.Array  # (m,) positive where a row presses on its upper end, negative on its lower end


def minimise(
    measure: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    low: jax.Array,
    high: jax.Array,
    x: jax.Array,
    settings: CostSettings | None = None,
) -> Minimum:
    """Minimises a smooth cost subject to `low <= rows <= high` from x, for one lane (`jax.vmap` it over lanes).

    measure: `(n,)` to the cost, a number, and the rows `(m,)`; low, high: `(m,)`, infinite where open. The augmented Lagrangian
    `f + rho / 2 * |d(c + y / rho)|^2` is minimised by L-BFGS between the updates `y <- rho * d(c + y / rho)`. Samples do not
    need it and are more diverse without; with a cost the multipliers do not vanish, so that a penalty alone would stop short.
    """
    settings = settings or CostSettings()
    solver = optax.lbfgs()
    low, high = jnp.asarray(low, x.dtype), jnp.asarray(high, x.dtype)

    def lagrangian(x: jax.Array, multipliers: jax.Array, penalty: jax.Array) -> jax.Array:
        cost, rows = measure(x)
        outside = distance_to_interval(rows + multipliers / penalty, low, high)
        return cost + 0.5 * penalty * jnp.sum(outside * outside)

    def descend(x: jax.Array, multipliers: jax.Array, penalty: jax.Array) -> jax.Array:
        def value(x: jax.Array) -> jax.Array:
            return lagrangian(x, multipliers, penalty)

        value_and_gradient = optax.value_and_grad_from_state(value)

        def advance(carry: tuple[jax.Array, Any, jax.Array, jax.Array]) -> tuple[jax.Array, Any, jax.Array, jax.Array]:
            x, state, count, _ = carry
            at, gradient = value_and_gradient(x, state=state)
            step, state = solver.update(gradient, state, x, value=at, grad=gradient, value_fn=value)
            return optax.apply_updates(x, step), state, count + 1, jnp.linalg.norm(gradient)

        def unfinished(carry: tuple[jax.Array, Any, jax.Array, jax.Array]) -> jax.Array:
            return (carry[2] < settings.inner_iterations) & (carry[3] > settings.gradient_tolerance)

        start = (x, solver.init(x), jnp.zeros((), jnp.int32), jnp.asarray(jnp.inf, x.dtype))
        return lax.while_loop(unfinished, advance, start)[0]

    def update(carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        x, multipliers, penalty, violation, count, _, _ = carry
        x = descend(x, multipliers, penalty)
        cost, value = measure(x)
        renewed = penalty * distance_to_interval(value + multipliers / penalty, low, high)
        now = jnp.max(jnp.abs(distance_to_interval(value, low, high)))
        change = jnp.max(jnp.abs(renewed - multipliers)) / (1.0 + jnp.max(jnp.abs(renewed)))
        grown = jnp.minimum(penalty * settings.penalty_growth, settings.largest_penalty)
        slow = (now > 0.25 * violation) & (now > settings.tolerance)
        return x, renewed, jnp.where(slow, grown, penalty), now, count + 1, change, cost

    def busy(carry: tuple[jax.Array, ...]) -> jax.Array:
        _, _, _, violation, count, change, _ = carry
        converged = (violation <= settings.tolerance) & (change <= settings.multiplier_tolerance)
        return (count < settings.outer_iterations) & ~converged & ((count == 0) | jnp.isfinite(violation))

    infinite = jnp.asarray(jnp.inf, x.dtype)
    penalty = jnp.asarray(settings.penalty, x.dtype)
    start = (x, jnp.zeros_like(low), penalty, infinite, jnp.zeros((), jnp.int32), infinite, infinite)
    x, multipliers, _, violation, _, _, value = lax.while_loop(busy, update, start)
    feasible = (violation <= settings.tolerance) & jnp.isfinite(value)
    return Minimum(x, value, feasible, violation, multipliers)
