"""Operators as pure functions: one trace for all instances, streams that depend on seed and task alone, vmap over scenes."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loaded import problem

import cgs_jax
from cgs_jax import augmented_lagrangian as al
from cgs_jax.api import conditional
from cgs_jax.errors import InputError
from cgs_jax.kinematics import tool_poses_on_host
from cgs_jax.operators import gather_given, operator_of, propose_program

LANES = 64


@pytest.fixture(scope="module")
def grasp():
    """t drawn from its grasp alone: `(lanes, 7)`."""
    draw = cgs_jax.operator(problem("pick_place"), (), ("t",))
    values, feasible = draw(jax.random.key(0), {}, problem("pick_place").params, LANES)
    assert feasible.all()
    return values["t"]


@pytest.fixture(scope="module")
def reach():
    """q1 given t: the pure function, jitted, counting its traces."""
    chex.clear_trace_counter()
    apply = cgs_jax.operator(problem("pick_place"), given=("t",), new=("q1",))
    return jax.jit(chex.assert_max_traces(lambda key, t, params: apply(key, {"t": t}, params), n=1))


def test_another_instance_needs_no_new_trace(grasp, reach):
    shares = []
    for instance in (0, 1, 4):
        found, feasible = reach(jax.random.key(1), grasp, problem("pick_place", instance).params)
        assert found["q1"].shape == (LANES, 7)
        shares.append(float(feasible.mean()))
        assert np.isfinite(found["q1"][feasible]).all()
    assert shares[0] > 0.02


def test_solutions_reach_the_box_of_their_own_instance(grasp, reach):
    for instance in (0, 4):
        at = problem("pick_place", instance)
        found, feasible = reach(jax.random.key(2), grasp, at.params)
        rotation, position = tool_poses_on_host(at.exact.chains["a/a_pinch"], np.asarray(found["q1"], float))
        box = position + (rotation @ np.asarray(grasp)[:, :3, None])[..., 0]
        assert feasible.any()
        np.testing.assert_allclose(box[feasible], np.tile(at.scene.object_pose("box")[:3], (int(feasible.sum()), 1)), atol=5e-5)


def test_operators_compose_with_vmap_over_scenes(grasp, reach):
    both = [problem("pick_place", instance).params for instance in (0, 4)]
    stacked = jax.tree.map(lambda *a: jnp.stack([jnp.asarray(x) for x in a]), *both)
    apply = cgs_jax.operator(problem("pick_place"), given=("t",), new=("q1",))
    run = jax.jit(jax.vmap(lambda params: apply(jax.random.key(1), {"t": grasp}, params)))
    found, feasible = run(stacked)
    assert found["q1"].shape == (2, LANES, 7)
    for i, params in enumerate(both):
        _, expected = reach(jax.random.key(1), grasp, params)
        # Rounding differs between the programs; lanes at the edge of the tolerance may fall either way.
        assert (np.asarray(feasible[i]) == np.asarray(expected)).mean() > 0.9


def test_operators_compose_with_shard_map(grasp, reach):
    at = problem("pick_place")
    apply = cgs_jax.operator(at, given=("t",), new=("q1",))
    mesh = jax.make_mesh((len(jax.devices()),), ("lanes",), axis_types=(jax.sharding.AxisType.Auto,))
    split, whole = jax.sharding.PartitionSpec("lanes"), jax.sharding.PartitionSpec()
    run = jax.shard_map(
        lambda key, t, params: apply(key, {"t": t}, params),
        mesh=mesh, in_specs=(whole, split, whole), out_specs=split, check_vma=False,
    )  # fmt: skip
    found, feasible = jax.jit(run)(jax.random.key(1), grasp, at.params)
    _, expected = reach(jax.random.key(1), grasp, at.params)
    assert found["q1"].shape == (LANES, 7)
    assert (np.asarray(feasible) == np.asarray(expected)).mean() > 0.9


def solve(at, tasks, lanes, first, count, seed=0):
    operator = operator_of(at, conditional(at, (), ("q1", "t")))
    given = jnp.asarray(gather_given(operator, at.params, {}, tasks))
    run = propose_program(operator.plan.layout, al.Settings(), lanes)
    result = run(jax.random.key(seed), np.uint32(first), np.int32(count), given, (), operator.numbers(at.params))
    return {name: np.asarray(v)[:count] for name, v in operator.named(result).items()}, np.asarray(result.feasible)


def test_a_task_is_the_same_in_every_batch_and_with_any_lanes():
    at = problem("pick_place")
    whole, feasible = solve(at, 96, 32, 0, 96)
    part, also = solve(at, 40, 8, 48, 40)
    again, _ = solve(at, 96, 32, 0, 96)
    np.testing.assert_array_equal(whole["q1"], again["q1"])
    same = feasible[48:88] == also
    assert same.mean() > 0.95
    both = feasible[48:88] & also
    assert both.sum() > 10
    for name in ("q1", "t"):
        np.testing.assert_allclose(whole[name][48:88][both], part[name][both], atol=2e-3)
    other, _ = solve(at, 96, 32, 0, 96, seed=1)
    assert np.abs(other["q1"] - whole["q1"]).max(axis=1).min() > 1e-3


def test_tasks_beyond_the_count_are_not_feasible():
    _, feasible = solve(problem("pick_place"), 96, 32, 0, 20)
    assert feasible[:20].any() and not feasible[20:].any()


def test_conditions_that_are_not_numbers_fail(grasp, reach):
    found, feasible = reach(jax.random.key(1), grasp.at[::2].set(jnp.nan), problem("pick_place").params)
    assert not feasible[::2].any() and feasible[1::2].any()


def test_configurations_alone_can_be_drawn():
    draw = cgs_jax.operator(problem("pick_place"), (), ("q1",))
    found, feasible = draw(jax.random.key(0), {}, problem("pick_place").params, 32)
    low, high = problem("pick_place").params.limits["q1"]
    assert feasible.mean() > 0.3 and (found["q1"] >= low).all() and (found["q1"] <= high).all()


def test_wrong_calls_are_refused():
    at = problem("pick_place")
    apply = cgs_jax.operator(at, ("t",), ("q1",))
    with pytest.raises(InputError, match="needs values of t"):
        apply(jax.random.key(0), {}, at.params)
    with pytest.raises(InputError, match="say how many lanes"):
        cgs_jax.operator(at, (), ("t",))(jax.random.key(0), {}, at.params)
    with pytest.raises(InputError, match="unknown variable 'q9', available: "):
        cgs_jax.operator(at, ("q9",), ("t",))
    with pytest.raises(AssertionError, match="shape"):
        apply(jax.random.key(0), {"t": np.zeros((4, 6), np.float32)}, at.params)
