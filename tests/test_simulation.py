"""Simulated runs on pick_place, whose sequences are few: the truth against hand calculation, the rates against the truth."""

import numpy as np
import pytest
from loaded import problem

from cgs_jax.errors import InputError
from cgs_jax.experiments.simulation import World, components, history_of, simulate
from cgs_jax.uct import Fixed, Random, Tree

SUCCESS = {"t": 1.0, "q1": 0.4, "q2": 0.2, "q1,t": 0.5, "q2,t": 0.1, "q1,q2,t": 0.02}
MICROSECONDS = {"t": 1, "q1": 10, "q2": 10, "q1,t": 15, "q2,t": 15, "q1,q2,t": 60}
TRIES = 10**7


def learned():
    """A tree that has run every sequence so often that its counts are the truth; q1 and q2 read t alone."""
    transitions = problem("pick_place").transitions
    tree = Tree(transitions, discount=1.0)
    for path in transitions.sequences():
        for i, transition in enumerate(path):
            name = ",".join(sorted(transition.new))
            tree.record(path[:i], transition, TRIES, int(SUCCESS[name] * TRIES), 1e-6 * MICROSECONDS[name] * TRIES)
    return tree.as_json()


@pytest.fixture(scope="module")
def world():
    return World(problem("pick_place"), [learned()], tries=1)


def test_a_sequence_costs_what_its_steps_cost_over_what_succeeds(world):
    path = world.problem.transitions.parse("(q1,t); q2")
    assert world.hazards(history_of(path[:1])) == pytest.approx([0.5])
    assert 1e6 / world.rate(path) == pytest.approx((15 / 0.5 + 10) / 0.2, rel=1e-5)
    path = world.problem.transitions.parse("t; q1; q2")
    assert 1e6 / world.rate(path) == pytest.approx(((1 + 10) / 0.4 + 10) / 0.2, rel=1e-5)


def test_the_best_sequence_is_the_best_of_all(world):
    rates = {path: world.rate(path) for path in world.problem.transitions.sequences()}
    assert world.best_rate == pytest.approx(max(rates.values())) and rates[world.best] == max(rates.values())


def test_steps_that_read_nothing_of_each_other_make_two_components():
    transitions = problem("handover").transitions
    path = transitions.parse("(q_a1,t_a); (t_b,q_b1); (q_a2,p); q_b2")
    assert set(components(path[:2])) == {frozenset({"q_a1", "t_a"}), frozenset({"t_b", "q_b1"})}
    other = transitions.parse("(t_b,q_b1); (q_a1,t_a); (q_a2,p); q_b2")
    assert history_of(path) == history_of(other)


def test_a_further_try_succeeds_as_often_as_it_did():
    transitions = problem("pick_place").transitions
    tree, path = Tree(transitions, discount=1.0), transitions.parse("t; q1; q2")
    tree.record((), path[0], TRIES, TRIES, 10.0)
    for i in (1, 2):
        tree.record(path[:i], path[i], [TRIES, TRIES // 2], [TRIES // 2, TRIES // 8], 10.0)
    world = World(problem("pick_place"), [tree.as_json()])
    assert world.hazards(history_of(path[:2])) == pytest.approx([0.5, 0.25, 0.25 * 0.8, 0.25 * 0.8**2], rel=1e-5)
    with pytest.raises(InputError, match="no operator was tried"):
        World(problem("pick_place"), [])


def test_a_simulated_run_makes_what_the_truth_says_less_what_is_lost_between_batches(world):
    found = simulate(world, Fixed(world.problem.transitions, world.best), seconds=4.0)
    share = (found > 2.0).sum() / 2.0 / (2 * world.best_rate)
    assert 0.7 < share < 1.02
    assert (np.diff(found) >= 0).all()
    again = simulate(world, Fixed(world.problem.transitions, world.best), seconds=4.0)
    assert np.array_equal(found, again)


def test_the_tree_is_told_from_chance(world):
    transitions = world.problem.transitions
    late = [
        (simulate(world, chooser, seconds=4.0) > 2.0).sum()
        for chooser in (Fixed(transitions, world.best), Tree(transitions), Random(transitions))
    ]
    assert late[1] > 0.85 * late[0] and late[2] < 0.75 * late[0]
