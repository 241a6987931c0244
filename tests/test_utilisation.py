"""Arithmetic counted on paper, and the queue's iterations by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cgs_jax
from cgs_jax import augmented_lagrangian as al
from cgs_jax.batches import Batch, BatchRunner, BatchSettings
from cgs_jax.sampler import SamplerSettings
from cgs_jax.utilisation import count_flops, flops_per_lane_step, seconds_per_lane_step


def queue_by_hand(iterations, solved, lanes, period):
    """The solver's queue, iteration by iteration."""
    waiting = list(zip(iterations, solved, strict=True))
    held = [None] * lanes
    steps = 0
    while True:
        held = [lane or (list(waiting.pop(0)) if waiting else None) for lane in held]
        if not any(held):
            return steps
        for _ in range(period):
            steps += lanes
            held = [lane and [lane[0] - 1, lane[1]] for lane in held]
        # Solved tasks are seen as such by an evaluation after their last move.
        held = [None if lane and lane[0] < 0 or lane and lane[0] <= 0 and not lane[1] else lane for lane in held]


@pytest.mark.parametrize(("count", "lanes"), [(100, 16), (128, 64)])
def test_iterations_of_all_lanes_are_those_of_the_queue(pick_place, count, lanes):
    settings = al.Settings()
    runner = BatchRunner(pick_place, 3, BatchSettings(128, lanes, settings))
    transition = pick_place.transitions.parse("(q1,t); q2")[0]
    found = []
    call = runner._call
    runner._call = lambda *arguments: found.append(call(*arguments)) or found[-1]
    outcome = runner.run(Batch(transition, {}, count, 0))
    iterations, solved = (np.asarray(a)[:count] for a in (found[0].iterations, found[0].feasible))
    assert outcome.iterations == iterations.sum() < outcome.executed
    assert outcome.executed == queue_by_hand(iterations, solved, lanes, settings.check_period)


@pytest.fixture(scope="module")
def pick_place():
    return cgs_jax.load_problem("pick_place")


def test_a_step_of_an_operator(pick_place):
    settings = SamplerSettings(batch_size=128, lanes=16)
    transition = pick_place.transitions.parse("(q1,t); q2")[0]
    # A 7-joint chain, its Jacobian and six to twelve rows: thousands of operations, not hundreds and not millions.
    assert 1e3 < flops_per_lane_step(pick_place, transition, settings) < 1e5
    assert 0.0 < seconds_per_lane_step(pick_place, transition, settings) < 1e-3


def test_flops_of_a_matrix_product_and_of_loops():
    a, b = jnp.ones((5, 7)), jnp.ones((7, 3))
    assert count_flops(lambda a, b: a @ b, a, b) == 2 * 5 * 7 * 3
    assert count_flops(lambda a: jnp.sum(jnp.sqrt(a) * 2.0 + a), a) == 4 * 35
    assert count_flops(lambda a: a[1:, ::-1].T.reshape(-1), a) == 0

    def looped(a, turns):
        a = jax.lax.fori_loop(0, turns, lambda _, x: x + 1.0, a)  # traced length: a while loop
        a, sums = jax.lax.scan(lambda x, y: (x * y, x), a, jnp.ones(4))
        return jax.lax.cond(turns > 2, lambda x: x * x, lambda x: x, a), sums

    assert count_flops(jax.jit(looped), a, jnp.int32(3)) == 35 * (3 + 4 + 1)
    assert count_flops(jax.jit(looped), a, jnp.int32(1)) == 35 * (1 + 4)


def test_lengths_of_loops_may_be_computed():
    def function(a, lengths):
        _, sums = jax.lax.scan(lambda x, y: (x + y, x), 0, lengths, reverse=True)  # 6, 5, 3, 0
        return jax.lax.fori_loop(0, sums[1], lambda i, x: x.at[i].add(1.0) * 2.0, a)

    assert count_flops(function, jnp.ones(7), jnp.arange(4)) == 5 * 7
    with pytest.raises(TypeError, match="loop"):
        count_flops(lambda a: jax.lax.while_loop(lambda x: x < 1.0, lambda x: x + 1.0, a), 0.0)
