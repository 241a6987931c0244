"""Descending a user's cost along the constraints of a conditional problem.

Samples need no cost, and are more diverse without one (paper, Section III). Where one is given, each projected seed goes on to
the minimum of the cost in whose valley it lies, by the augmented Lagrangian with L-BFGS, and is then projected once more, since
single precision leaves the last digits of the rows to the penalty.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cgs_jax import augmented_lagrangian as al
from cgs_jax.plans import Layout, PlanSystem, Point, Shared, Tasks
from cgs_jax.poses import Array, to_vector

PlanCost = Callable[[jax.Array, jax.Array, Any], jax.Array]
"""Of one task: new configurations `(K, joints)`, new poses `(outputs, 7)` and what else it reads -> number."""


def descend(
    layout: Layout,
    cost: PlanCost,
    x: Point,
    tasks: Tasks,
    shared: Shared,
    reads: Any,
    limits: tuple[Array, Array],
    solver: al.Settings,
    settings: al.CostSettings,
) -> Point:
    """Local minima of a cost from projected points; pure.

    `reads` is a pytree of what the cost reads beside the new variables, tasks last. `limits` are the robots' own,
    `(K, joints)` each: the solver's differ from lane to lane, so that samples do not pile up on them, and would hold a minimum
    away from its limit.
    """
    if not layout.unknowns:
        return x
    system = PlanSystem(layout)
    lanes = tasks.slack.shape[-1]
    low, high = (jnp.broadcast_to(jnp.asarray(limit)[..., None], x.configurations.shape) for limit in limits)
    # A minimum at a limit is held by a row, within the tolerance of rows; limits of samples are stricter.
    margin = jnp.minimum(settings.tolerance, 0.5 * (high - low))
    tasks = tasks._replace(low=low + margin, high=high - margin)

    first = system.rows(x, (tasks, shared))
    bounds = system.room(x, (tasks, shared))
    low, high = (
        jnp.concatenate([jnp.broadcast_to(end, first.value.shape), bound])
        for end, bound in zip((first.low, first.high), bounds, strict=True)
    )

    def measured(step: jax.Array, x: Point, tasks: Tasks, shared: Shared) -> Measured:
        moved = system.retract(x, step)
        value, poses = system.values(moved, (tasks, shared))
        return Measured(value, jnp.asarray(moved.configurations), jnp.swapaxes(to_vector(poses), 0, 1))

    def of_one(x: Point, task: Tasks, low: jax.Array, high: jax.Array, read: Any) -> jax.Array:
        known = _beside_each_other(measured, (x, task), shared)

        def measure(step: jax.Array) -> tuple[jax.Array, jax.Array]:
            at = known(step)
            return cost(at.configurations, at.poses, read), jnp.concatenate([at.rows, step])

        found = al.minimise(measure, low, high, jnp.zeros(layout.unknowns), settings)
        return jnp.where(jnp.isfinite(found.x), found.x, 0.0)

    reads = jax.tree.map(lambda a: jnp.broadcast_to(a, (*jnp.shape(a)[:-1], lanes)), reads)
    steps = jax.vmap(of_one, in_axes=-1, out_axes=-1)(x, tasks, low, high, reads)
    return al.project(system, system.retract(x, steps), (tasks, shared), solver).x


class Measured(NamedTuple):
    """What depends on the step, lanes last."""

    rows: jax.Array  # (m, lanes)
    configurations: jax.Array  # (K, joints, lanes)
    poses: jax.Array  # (outputs, 7, lanes)


def _beside_each_other(function: Callable[..., Measured], data: tuple, shared: Any) -> Callable[[jax.Array], Measured]:
    """A function of lanes as one of a single lane `(n,)` that under `vmap` is evaluated for all lanes at once, lanes last.

    `function(steps, *data, shared)` has the lanes last in all but `shared`; `data` here is that of one lane. Its reverse
    derivative is made of forward ones: loops of traced length have no other.
    """

    def slopes(step: jax.Array, *rest: Any) -> tuple[Measured, Measured]:
        def along(direction: jax.Array) -> tuple[Measured, Measured]:
            tangent = jnp.broadcast_to(direction[:, None], step.shape)
            return jax.jvp(lambda s: function(s, *rest), (step,), (tangent,))

        return jax.vmap(along, out_axes=(None, 0))(jnp.eye(step.shape[0]))

    def over_lanes(of_lanes: Callable[..., Any]) -> Callable[[jax.Array], Any]:
        of_lanes = jax.jit(of_lanes)

        # It must close over nothing: a `cond` whose predicate is batched batches what its branches close over.
        @jax.custom_batching.custom_vmap
        def single(lane: Any, shared: Any) -> Any:
            return jax.tree.map(lambda a: a[..., 0], of_lanes(*jax.tree.map(lambda a: a[..., None], lane), shared))

        @single.def_vmap
        def _(size: int, batched: Any, lane: Any, shared: Any) -> tuple[Any, Any]:
            def last(a: jax.Array, is_batched: bool) -> jax.Array:
                return jnp.moveaxis(a, 0, -1) if is_batched else jnp.broadcast_to(a[..., None], (*a.shape, size))

            shared = jax.tree.map(lambda a, is_batched: a[0] if is_batched else a, shared, batched[1])
            result = of_lanes(*jax.tree.map(last, lane, batched[0]), shared)
            return jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), result), jax.tree.map(lambda _: True, result)

        return lambda step: single((step, *data), shared)

    value_of, slopes_of = over_lanes(function), over_lanes(slopes)
    value = jax.custom_vjp(value_of)

    def backward(slope: Measured, weights: Measured) -> tuple[jax.Array]:
        parts = [jnp.tensordot(s, w, axes=w.ndim) for s, w in zip(slope, weights, strict=True)]
        return (parts[0] + parts[1] + parts[2],)

    value.defvjp(slopes_of, backward)
    return value
