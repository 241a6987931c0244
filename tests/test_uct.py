import json
import math
import time

import loaded
import numpy as np
import pytest
from paper_graphs import banana, handover, pick_place, regrasps

from cgs_jax import histories
from cgs_jax.errors import InputError
from cgs_jax.graph import Constraint, ConstraintGraph, Variable
from cgs_jax.histories import DRAWN, FALLING_OFF, Statistics, _surprise, guessed_success, guessed_work
from cgs_jax.operators import operator_of
from cgs_jax.transitions import Transitions
from cgs_jax.uct import (
    CURIOSITY,
    CURIOUS_EVERY,
    DISAPPOINTED,
    KEEN_AFTER,
    KEEN_CURIOSITY,
    PROMISE,
    SLIGHT_PROMISE,
    Fixed,
    Random,
    Tree,
)


def pair_graph() -> Transitions:
    """Two variables, one row between them: a then b, b then a, or both."""
    variables = (Variable("a", 2, "vector"), Variable("b", 2, "vector"))
    return Transitions(ConstraintGraph("pair", variables, (Constraint("L", "Link", ("a", "b"), 1, 0),)))


def settle_on(tree, path, advantage):
    """Makes a sequence the incumbent, whatever was recorded; advantage: of the best other one, in rate over its."""
    tree._incumbent, tree._of_incumbent = path, frozenset(tree._made_along(path)[1])
    tree._advantage = advantage


def join_graph() -> Transitions:
    """a and b are independent until c joins them."""
    variables = tuple(Variable(name, 2, "vector") for name in "abc")
    return Transitions(ConstraintGraph("join", variables, (Constraint("L", "Link", ("a", "b", "c"), 1, 0),)))


class World:
    """Known success and seconds per condition of every conditional problem, one seed one world."""

    def __init__(self, transitions, seed):
        generator = np.random.default_rng(seed)
        self.success, self.cost = {}, {}
        for problem in transitions.problems():
            size = len(problem[0])
            self.success[problem] = float(np.clip(0.75**size * generator.uniform(0.3, 1.3), 0.02, 0.98))
            self.cost[problem] = float(2e-4 * size**1.5 * np.exp(generator.normal(0, 0.6)))

    def seconds_per_sample(self, path, retain):
        """Exact production cost of a finished sample when only this sequence runs."""
        costs = {}
        for step in path:
            used = [c for c in costs if not retain or c & step.condition]
            total = sum(costs.pop(c) for c in used) + self.cost[step.problem]
            costs[frozenset(step.new).union(*used)] = total / self.success[step.problem]
        return sum(costs.values())

    def rollout(self, chooser, generator, batch=256):
        """Survivors only: what fails is dropped. One visit per call."""
        count, prefix = batch, ()
        path = chooser.select()
        for step in path:
            successes = int(generator.binomial(count, self.success[step.problem]))
            chooser.record(prefix, step, count, successes, count * self.cost[step.problem])
            count, prefix = successes, (*prefix, step)
            if not count:
                break
        return path

    def pooled_rollout(self, chooser, generator, pools, batch=256):
        """Pools per component and history: a failure consumes only what the transition touches."""
        prefix, histories = (), {}
        path = chooser.select()
        for step in path:
            used = [histories.pop(c) for c in list(histories) if c & step.condition]
            made = (prefix, step)
            inputs = frozenset(step.new).union(*(component for component, _ in used))
            histories[inputs] = (inputs, made)
            count = min([batch] + [pools.get(history, 0) for _, history in used])
            if count and (step is path[-1] or pools.get(made, 0) < batch):
                successes = int(generator.binomial(count, self.success[step.problem]))
                chooser.record(prefix, step, count, successes, count * self.cost[step.problem])
                for _, history in used:
                    pools[history] -= count
                pools[made] = pools.get(made, 0) + successes
            prefix = (*prefix, step)
        return path


def test_golden_tree_by_hand():
    transitions = pair_graph()
    a_first = transitions.parse("a; b")
    tree = Tree(transitions, c_uct=1.0, retain=False, equivalent_visits=2.0, discount=1.0)
    tree.record((), a_first[0], attempts=100, successes=50, seconds=1.0)
    tree.record(a_first[:1], a_first[1], attempts=50, successes=10, seconds=0.5)
    assert tree.rate == pytest.approx(10 / 1.5)
    # Operators: the guess with the weight of two tries; histories: their operator's mean by the guessed correlation, since
    # no operator has two of them. a closes no loop; b after a has one degree of freedom left for its loop, and loops
    # succeeded more often than guessed: the mean over this one and three as guessed.
    weight = 1 / histories.CORRELATION - 1
    ease = (10.5 / 51 / 0.1) ** (1 / 4)
    p_a = (50 + weight * (50 + 2 * 0.8) / 102) / (100 + weight)
    p_b = (10 + weight * (10 + 2 * 0.1 * ease) / 52) / (50 + weight)

    def hopeful(p, tries):
        """The mean and a share of the standard deviation of the beta distribution that is known so far."""
        return p + histories.HOPE * math.sqrt(p * (1 - p) / (tries + weight + 1))

    assert tree.predict_rate(a_first) == pytest.approx(p_a * p_b / (0.01 + p_a * 0.01))
    # (a,b) never ran: three degrees of freedom are left for its loop, and it has twice the unknowns of b after a, the one that
    # was solved so far; a is drawn.
    guessed = 2**2 * 0.01
    p_both = 0.3 * ease
    assert tree.predict_rate(transitions.parse("(a,b)")) == pytest.approx(p_both / guessed)
    entries = {entry["sequence"]: entry for entry in tree.as_json()["sequences"]}
    assert tree.price == pytest.approx(max(tree.predict_rate(path) for path in transitions.sequences()))
    value_a = hopeful(p_b, 50) - tree.price * 0.01
    assert entries["a; b"]["q"] == pytest.approx(value_a)
    assert entries["a"]["q"] == pytest.approx(hopeful(p_a, 100) * value_a - tree.price * 0.01)
    # b is drawn, for a tenth of what a solve takes.
    b_first = transitions.parse("b; a")
    assert tree.select() == b_first
    tree.record((), b_first[0], 100, 50, 1.0)
    tree.record(b_first[:1], b_first[1], 50, 1, 0.5)
    assert transitions.format(tree.select()) == "a; b"


def test_guessed_success_by_hand():
    """Dof and rows of the handover: an arm has 7, a pose 6; Kin has 6 rows, Grasp 4, Position 3."""
    transitions = Transitions(handover())
    graph = transitions.graph
    at = {(t.new, t.condition): t.problem for t in transitions.iterate()}

    def guess(new, given=()):
        return guessed_success(graph, at[graph.ordered(new), frozenset(given)])

    assert guess(["t_a"]) == (0, 0.8)  # drawn
    assert guess(["q_a1"], ["t_a"]) == (1, pytest.approx(0.1))  # 7 - 6
    assert guess(["q_a1", "t_a"]) == (1, pytest.approx(0.3))  # 13 - 10
    assert guess(["q_a2", "p"], ["t_a"]) == (1, pytest.approx(0.4))  # 13 - 9
    loops, share = guess(["q_a2", "q_b2", "p", "t_b"], ["t_a"])
    assert (loops, share) == (2, pytest.approx(0.35))  # (26 - 19) / 2


@pytest.mark.parametrize("scene", loaded.SCENES)
def test_guessed_work_follows_the_unknowns_of_the_plans(scene):
    """Those are what the solver is left with when all that can be computed is eliminated: not known to the tree."""
    problem = loaded.problem(scene)
    transitions = problem.transitions
    of_arm, over = None, []
    for transition in {t.problem: t for t in transitions.iterate()}.values():
        unknowns = operator_of(problem, transition).plan.layout.unknowns
        guess = guessed_work(transitions.graph, transition.problem)
        if guess == DRAWN:
            assert unknowns < 7  # a pose or transform that is drawn
            continue
        of_arm = of_arm or unknowns  # the first one: they come by size
        over.append(guess / (unknowns / of_arm) ** 2)
    assert np.std(np.log(over)) < 0.25 and 0.4 < min(over) and max(over) < 1.6, (min(over), max(over))


def test_tries_that_pay():
    """An input that cost ten tries, success 0.5 then 0.1 then 0.001: two tries make an item cheapest."""
    transitions = pair_graph()
    path = transitions.parse("a; b")
    chooser = Fixed(transitions, path, discount=1.0)
    assert chooser.tries(path[:1], path[1]) == 1
    chooser.record((), path[0], 10**6, 10**6, 10.0 * 10**6)
    chooser.record(path[:1], path[1], [10**6, 10**6, 10**6], [5 * 10**5, 10**5, 10**3], 3.0 * 10**6)
    costs = [(10 + 1) / 0.5, (10 + 1.5) / 0.55, (10 + 1.95) / 0.55045]
    assert costs.index(min(costs)) + 1 == chooser.tries(path[:1], path[1]) == 2


def test_predicted_rate_with_and_without_pools():
    transitions = join_graph()
    path = transitions.parse("a; b; c")
    for retain, seconds in ((True, (1 / 0.5 + 2 / 0.25 + 3) / 0.1), (False, ((1 / 0.5 + 2) / 0.25 + 3) / 0.1)):
        chooser = Fixed(transitions, path, retain=retain, discount=1.0)
        for i, (success, cost) in enumerate([(0.5, 1.0), (0.25, 2.0), (0.1, 3.0)]):
            chooser.record(path[:i], path[i], 10**9, int(success * 10**9), cost * 10**9)
        assert chooser.predict_rate(path) == pytest.approx(1 / seconds, rel=1e-5)
        # With pools b; a; c is the same but for the order. Without, an a is dropped with a failing b: it was not made.
        assert chooser.best_sequences(2) == [(path, pytest.approx(1 / seconds, rel=1e-5))]
        other = seconds if retain else ((2 / 0.25 + 1) / 0.5 + 3) / 0.1
        assert chooser.predict_rate(transitions.parse("b; a; c")) == pytest.approx(1 / other, rel=1e-5)


def test_what_is_kept_lowers_the_price_of_failure():
    transitions = join_graph()
    path = transitions.parse("a; b; c")
    quality = {}
    for retain in (True, False):
        tree = Tree(transitions, retain=retain, discount=1.0)
        for i, (success, cost) in enumerate([(0.5, 1.0), (0.25, 2.0), (0.1, 3.0)]):
            tree.record(path[:i], path[i], 10**9, int(success * 10**9), cost * 10**9)
        # The other children of a are hopeless and dear, so that its value is that of b.
        for step in transitions.children("a")[1:]:
            tree.record(path[:1], step, 10**6, 0, 10.0 * 10**6)
        quality[retain] = {e["sequence"]: e["q"] for e in tree.as_json()["sequences"]}
        spent = 6 + 10 * 1e-3 * len(transitions.children("a")[1:])
        assert tree.rate == pytest.approx(0.1 / spent)
        price = tree.price
        assert price == pytest.approx(max(tree.rate, *(tree.predict_rate(path) for path in transitions.sequences())))
        third = 0.1 - price * 3
        returned = 2.0 if retain else 0.0  # an a costs 1 s / 0.5
        second = 0.25 * third + price * (0.75 * returned - 2)
        assert quality[retain]["a; b"] == pytest.approx(second, rel=1e-3)
        assert quality[retain]["a"] == pytest.approx(0.5 * second - price, rel=1e-3)


ROLLOUTS = 2000


@pytest.mark.parametrize("retain", [False, True])
def test_choice_converges_to_the_best_sequence(retain):
    """2000 rollouts of 256 conditions: the best of 960 sequences, or one nearly as good where large operators, which are dear
    to try, do better than anything lets expect."""
    reached = []
    transitions = Transitions(handover())
    sequences = list(transitions.sequences())
    for seed in range(10):
        world = World(transitions, seed)
        least = min(world.seconds_per_sample(path, retain) for path in sequences)
        tree = Tree(transitions, retain=retain)
        generator, pools = np.random.default_rng(100 + seed), {}
        chosen = []
        for _ in range(ROLLOUTS):
            chosen.append(
                world.pooled_rollout(tree, generator, pools) if retain else world.rollout(tree, generator)
            )
        path, predicted = tree.best_sequences(1)[0]
        reached.append(least / world.seconds_per_sample(path, retain))
        assert predicted == pytest.approx(1 / world.seconds_per_sample(path, retain), rel=0.25)
        late = [least / world.seconds_per_sample(path, retain) for path in chosen[-ROLLOUTS // 4 :]]
        assert np.mean(late) > 0.75, seed
    assert min(reached) > 0.75 and np.mean(reached) > 0.95, reached


def test_rollout_reading_prefers_what_fails_fast():
    """(a,b): 5 samples/s. a then b: 2 samples/s but a hundred times cheaper per rollout, since nearly all fail at a."""
    transitions = pair_graph()
    success = {"(a,b)": 0.05, "a": 0.02, "b": 0.02, "b|a": 0.1, "a|b": 0.1}
    share = {}
    for reward in ("rate", "rollout"):
        tree = Tree(transitions, reward=reward, retain=False, c_uct=0.02)
        generator, joint = np.random.default_rng(0), 0
        for rollout in range(800):
            path = tree.select()
            joint += len(path) == 1 and rollout >= 500
            count, prefix = 2000, ()
            for step in path:
                name = f"{step}|{min(step.condition)}" if step.condition else str(step)
                successes = int(generator.binomial(count, success[name]))
                tree.record(prefix, step, count, successes, count * (0.01 if len(step.new) == 2 else 1e-3))
                count, prefix = successes, (*prefix, step)
                if not count:
                    break
        share[reward] = joint / 300
        assert tree.c_hat == pytest.approx(1 / tree.price)
    assert share["rate"] > 0.85
    assert share["rollout"] < 0.15


def test_no_transition_is_given_up():
    """One sequence never fails, all others never succeed: they are tried again nevertheless."""
    transitions = Transitions(pick_place())
    good = transitions.parse("t; q1; q2")
    tree = Tree(transitions, c_uct=0.2, equivalent_visits=1.0)

    def visits():
        return {e["sequence"]: e["visits"] for e in tree.as_json()["sequences"]}

    def run(count):
        for _ in range(count):
            prefix = ()
            for step in tree.select():
                passes = step in good or len(prefix) > 0
                tree.record(prefix, step, 100, 100 if passes else 0, 1e-4)
                prefix = (*prefix, step)
                if not passes:
                    break

    run(500)
    early = visits()
    run(9500)
    late = visits()
    root = [transitions.format([t]) for t in transitions.children(())]
    assert all(late[text] >= early[text] + 1 for text in root)
    assert late["t; q2"] > early["t; q2"]
    assert late["t"] > 9900


def test_bonus_grows_without_bound_at_the_default_exploration():
    transitions = pair_graph()
    a, b, both = transitions.children(())
    tree = Tree(transitions, discount=1.0)
    for step in (b, both):
        tree.record((), step, 1000, 0, 1.0)
    tree.record((), a, 1000, 1000, 1e-3)
    tree.record((a,), transitions.parse("a; b")[1], 1000, 1000, 1e-3)
    assert tree.select()[0] == a
    tree.record((), a, 1000, 1000, 1e-3, visits=1e13)
    assert tree.select()[0] in (b, both)


def test_ready_transitions_only():
    transitions = Transitions(handover())
    tree = Tree(transitions)
    path = transitions.parse("p; t_a; t_b; q_a1; q_a2; q_b2; q_b1")
    problems = {step.problem for step in path}
    choosers = [tree, Random(transitions, seed=1), Fixed(transitions, path)]
    for chooser in choosers:
        assert chooser.select(lambda t: False) == ()
        assert chooser.select(lambda t: t.problem in problems - {path[4].problem}) == ()
        chosen = chooser.select(lambda t: t.problem in problems)
        assert {step.problem for step in chosen} <= problems and chosen[-1].target == transitions.full
        assert chooser.select()[-1].target == transitions.full
    # What is not ready has no value: with the single-variable operators known to be hopeless they are still chosen.
    for i, step in enumerate(path):
        tree.record(path[:i], step, 100, 1, 1.0)
    assert {step.problem for step in tree.select(lambda t: t.problem in problems)} <= problems
    assert not {step.problem for step in tree.select()} <= problems


def test_unknown_sequences_and_impossible_records_are_refused():
    transitions = pair_graph()
    tree = Tree(transitions)
    path = transitions.parse("a; b")
    with pytest.raises(InputError, match="does not follow"):
        tree.record((), path[1], 1, 1, 0.0)
    with pytest.raises(InputError, match="0 <= successes <= attempts"):
        tree.record((), path[0], 1, 2, 0.0)
    with pytest.raises(InputError, match="leaves b unassigned"):
        tree.predict_rate(path[:1])
    with pytest.raises(InputError, match="reward is 'speed'; available: rate, rollout"):
        Tree(transitions, reward="speed")
    with pytest.raises(InputError, match="c_uct is 0"):
        Tree(transitions, c_uct=0)


def trained(transitions, seed, rollouts=100):
    tree, world, generator = Tree(transitions), World(transitions, seed), np.random.default_rng(seed)
    for _ in range(rollouts):
        world.rollout(tree, generator)
    return tree, world


def test_save_and_load():
    transitions = Transitions(handover())
    tree, world = trained(transitions, 3)
    text = json.dumps(tree.as_json(), allow_nan=False)
    again = Tree.from_json(Transitions(handover()), json.loads(text))
    assert json.dumps(again.as_json()) == text
    assert again.best_sequences(3) == tree.best_sequences(3)
    generators = np.random.default_rng(7), np.random.default_rng(7)
    for _ in range(20):
        assert world.rollout(tree, generators[0]) == world.rollout(again, generators[1])


def test_tree_of_another_graph_is_refused_in_one_line():
    data = trained(Transitions(pick_place()), 0, 5)[0].as_json()
    for load in (lambda t: Tree.from_json(t, data), lambda t: Tree(t).warm_start([data], 5)):
        with pytest.raises(InputError, match="for graph 'pick_place' .*expected 'handover'") as caught:
            load(Transitions(handover()))
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="schema 'other'; expected 'cgs_jax.tree/2'"):
        Tree.from_json(Transitions(pick_place()), {**data, "schema": "other"})


@pytest.mark.parametrize(("counts", "weight"), [((50, 50), 300.0), ((40, 60), 0.25 / (0.02 - 0.00025) - 1.0)])
def test_warm_start_averages_success_and_time(counts, weight):
    """Where earlier instances agree the weight is n_equiv visits of 100 tries, else that of the beta distribution with the
    variance between them: (0.1^2 + 0.1^2) / 1 less the binomial 0.25 / 1000."""
    transitions = pair_graph()
    path = transitions.parse("a; b")
    earlier = []
    for successes, seconds in zip(counts, (1.0, 3.0), strict=True):
        tree = Tree(transitions, discount=1.0)
        for _ in range(10):
            tree.record((), path[0], 100, successes, seconds)
            tree.record(path[:1], path[1], successes, successes, 1.0)
        earlier.append(tree.as_json())
    warm = Tree(transitions)
    warm.warm_start(earlier, n_equiv=3)
    statistics = warm.operator_statistics()[path[0].problem]
    assert statistics.visits == pytest.approx(weight / 100)
    assert statistics.attempts == pytest.approx([weight])
    assert statistics.success_rate == pytest.approx(0.5)
    assert statistics.seconds_per_condition == pytest.approx(0.02)
    assert warm.rate == pytest.approx((counts[0] / 2 + counts[1] / 4) / 2)
    entries = {entry["sequence"]: entry for entry in warm.as_json()["sequences"]}
    assert entries["a"]["visits"] == pytest.approx(weight / 100) and entries["a"]["success_rate"] == pytest.approx(0.5)
    warm.record((), path[0], 100, 50, 1.0)
    with pytest.raises(InputError, match="before the first record"):
        warm.warm_start(earlier, n_equiv=3)


def test_warm_start_saves_the_learning():
    """The first twenty rollouts: sequences chosen after a warm start on the same world are better than cold ones."""
    transitions, gained = Transitions(handover()), []
    for seed in range(5):
        earlier, world = trained(transitions, seed, 200)
        least = min(world.seconds_per_sample(path, True) for path in transitions.sequences())
        mean = {}
        for warm in (True, False):
            tree, generator = Tree(transitions), np.random.default_rng(seed)
            if warm:
                tree.warm_start([earlier.as_json()], n_equiv=10)
            rates = [least / world.seconds_per_sample(world.rollout(tree, generator), True) for _ in range(20)]
            mean[warm] = np.mean(rates)
        gained.append(mean[True] - mean[False])
    assert min(gained) > 0.0 and np.mean(gained) > 0.1, gained


def test_a_warm_start_carries_over_how_histories_compare():
    """q2 succeeded after t alone twice as often as after (q1,t). Here it hardly ever does after (q1,t): so after t too, which
    was not tried yet, the expectation falls in proportion."""
    transitions = Transitions(pick_place())
    alone, joint = transitions.parse("t; q2; q1"), transitions.parse("(q1,t); q2")
    earlier = Tree(transitions, discount=1.0)
    for path, successes in ((alone, 400), (joint, 200)):
        for _ in range(20):
            earlier.record((), path[0], 1000, 800, 0.1)
            earlier.record(path[:1], path[1], 1000, successes, 0.1)
    warm = Tree(transitions, discount=1.0)
    warm.warm_start([earlier.as_json()], n_equiv=5)

    def expected():
        warm._predict_operators()
        return warm._renewed(warm._follow(alone[:2])[-1].history).success

    assert expected() == pytest.approx(0.4, rel=0.02)
    warm.record(joint[:1], joint[1], 100_000, 5_000, 1.0)
    pooled = (5_000 + 5 * 300) / (100_000 + 5 * 1000)
    assert expected() == pytest.approx(pooled * 400 / 300, rel=0.02)


def test_a_warm_start_runs_the_best_sequence_of_earlier_instances_until_it_fails_here():
    """a then b: 25 samples/s there, others a tenth. Run from the first choice on, and left once it makes nothing here."""
    transitions = pair_graph()
    best, rest = transitions.parse("a; b"), [transitions.parse(text) for text in ("b; a", "(a,b)")]
    earlier = Tree(transitions)
    for _ in range(200):
        earlier.record((), best[0], 100, 50, 1.0)
        earlier.record(best[:1], best[1], 50, 50, 1.0)
        earlier.record((), rest[0][0], 100, 5, 1.0)
        earlier.record(rest[0][:1], rest[0][1], 5, 5, 1.0)
        earlier.record((), rest[1][0], 100, 3, 1.0)
    warm = Tree(transitions)
    warm.warm_start([earlier.as_json()], n_equiv=5)
    assert [warm.select() for _ in range(10)] == [best] * 10
    assert warm.incumbent == best
    for _ in range(20):
        warm.record((), best[0], 100, 50, 1.0)
        warm.record(best[:1], best[1], 50, 0, 1.0)
    assert best not in [warm.select() for _ in range(10)]
    old = earlier.as_json()
    del old["totals"]["batches"]  # as files of an earlier version
    Tree(transitions).warm_start([old], n_equiv=5)


def test_a_warm_start_explores_after_the_first_samples():
    """a then b: 25 samples/s, the others hardly less. Nothing else runs in the first four seconds of the workers."""
    transitions = pair_graph()
    best, *others = (transitions.parse(text) for text in ("a; b", "b; a", "(a,b)"))
    firsts = {best: 50, others[0]: 48, others[1]: 24}

    def roll(tree, path):
        for i, transition in enumerate(path):
            tried = firsts[path] if i else 100
            tree.record(path[:i], transition, tried, firsts[path], 1.0, spent=0.02)

    earlier = Tree(transitions)
    for _ in range(200):
        for path in firsts:
            roll(earlier, path)
    warm = Tree(transitions)
    warm.warm_start([earlier.as_json()], n_equiv=5)
    chosen = []
    for _ in range(1000):
        chosen.append(warm.select())
        roll(warm, chosen[-1])
    assert set(chosen[:100]) == {best} and set(chosen[100:]) > {best}


def warm_from_three(common, rare, successes, batches=200):
    """Starts from three instances: the common sequence makes 25 samples/s on all, the rare one ran on the last of them."""
    transitions = pair_graph()
    earlier = []
    for instance in range(3):
        tree = Tree(transitions)
        for _ in range(200):
            tree.record((), common[0], 100, 50, 1.0)
            tree.record(common[:1], common[1], 50, 50, 1.0)
            if instance == 2 and tree.operator_statistics()[common[0].problem].visits <= batches:
                tree.record((), rare[0], 100, successes, 1.0)
        earlier.append(tree.as_json())
    warm = Tree(transitions)
    warm.warm_start(earlier, n_equiv=5)
    return warm


def choices(warm, common, count, successes, elsewhere):
    """What is chosen where the second step of the common sequence succeeds so often in 50 tries, all else in 100."""
    chosen = []
    for _ in range(count):
        chosen.append(warm.select())
        if chosen[-1] == common:
            warm.record((), common[0], 100, 50, 1.0, spent=0.02)
            warm.record(common[:1], common[1], 50, successes, 1.0, spent=0.02)
        else:
            warm.record((), chosen[-1][0], 100, elsewhere, 1.0, spent=0.02)
    return chosen


def test_a_warm_start_begins_with_what_did_well_on_most_instances():
    """a then b: 25 samples/s on three instances. (a,b): 50 on the only one where it was run, and so by the average."""
    transitions = pair_graph()
    common, rare = transitions.parse("a; b"), transitions.parse("(a,b)")
    warm = warm_from_three(common, rare, 50)
    warm.select()
    assert warm.incumbent == common


@pytest.mark.parametrize(("promised", "left_at_once"), [(40, False), (60, True)])
def test_a_warm_start_leaves_what_is_proven_at_first_for_twice_as_much_only(promised, left_at_once):
    """a then b: 25 samples/s on three instances and here. (a,b): 40 or 60 in its only batch there, and none here."""
    transitions = pair_graph()
    common, rare = transitions.parse("a; b"), transitions.parse("(a,b)")
    warm = warm_from_three(common, rare, promised, batches=1)
    chosen = choices(warm, common, 200, 50, 0)
    assert (rare in chosen[:90]) == left_at_once
    assert rare in chosen


def test_a_warm_start_leaves_what_is_proven_sooner_where_that_makes_much_less_than_elsewhere():
    """a then b: 25 samples/s on three instances, 8 here. (a,b): 12 on the one where it was run, which is less than twice 8."""
    transitions = pair_graph()
    common, rare = transitions.parse("a; b"), transitions.parse("(a,b)")
    warm = warm_from_three(common, rare, 12)
    chosen = choices(warm, common, 60, 16, 12)
    assert chosen[0] == common and rare in chosen


@pytest.mark.parametrize("here", [30, 15, 0])
def test_a_warm_start_looks_at_what_did_better_on_some_instances(here):
    """a then b: 25 samples/s on three instances and here. (a,b): 40 on one of them; 30, 15 or none of a batch of 100 here."""
    transitions = pair_graph()
    common, rare = transitions.parse("a; b"), transitions.parse("(a,b)")
    chosen = choices(warm_from_three(common, rare, 40), common, 40, 50, here)
    assert chosen[:2] == [common, rare]
    better, worse = (rare, common) if here > 25 else (common, rare)
    assert chosen[-10:].count(better) > 5 and worse not in chosen[-10:]


def test_a_warm_start_begins_with_the_few_sequences_of_which_one_did_well_everywhere():
    """Rates there on paper, a then b, b then a, (a,b): 25, 20, 5 on two instances; 25, 24, 50 on the third."""
    transitions = pair_graph()
    rates = [(25, 20, 5), (25, 20, 5), (25, 24, 50)]
    common, second, rare = (transitions.parse(text) for text in ("a; b", "b; a", "(a,b)"))
    earlier = []
    for of_common, of_second, of_rare in rates:
        tree = Tree(transitions)
        for _ in range(200):
            for path, rate in ((common, of_common), (second, of_second)):
                tree.record((), path[0], 100, 2 * rate, 1.0)
                tree.record(path[:1], path[1], 2 * rate, 2 * rate, 1.0)
            tree.record((), rare[0], 100, of_rare, 1.0)
        earlier.append(tree.as_json())
    warm = Tree(transitions)
    warm.warm_start(earlier, n_equiv=5)
    assert warm._portfolio == [common, rare]


def test_the_best_sequences_after_a_warm_start_are_those_that_were_run_here():
    """(a,b) made twice as much on an earlier instance: that tells nothing of this one's samples."""
    transitions = pair_graph()
    common, rare = transitions.parse("a; b"), transitions.parse("(a,b)")
    warm = warm_from_three(common, rare, 50)
    assert [path for path, _ in warm.best_sequences(3)] == [rare, common]  # nothing was run yet
    warm.record((), common[0], 100, 50, 1.0)
    warm.record(common[:1], common[1], 50, 50, 1.0)
    assert [path for path, _ in warm.best_sequences(3)] == [common]


def test_a_warm_start_keeps_how_further_tries_fall_off_where_instances_differ():
    transitions = pair_graph()
    (step,) = transitions.parse("(a,b)")
    earlier = []
    for first in (10, 90):
        tree = Tree(transitions)
        for _ in range(50):
            tree.record((), step, [100, 100 - first], [first, (100 - first) // 10], 1.0)
        earlier.append(tree.as_json())
    warm = Tree(transitions)
    warm.warm_start(earlier, n_equiv=5)
    assert warm._operator(step.problem).hazards[1] == pytest.approx(0.1, abs=0.05)


def test_further_tries_that_were_not_made_fall_off_as_those_of_other_operators_do():
    """a and then b given a, whose second tries succeed half as often; of (a,b) only first tries are known."""
    transitions = pair_graph()
    one, other = transitions.parse("a; b"), transitions.parse("(a,b)")
    tree = Tree(transitions, discount=1.0)
    for _ in range(50):
        tree.record((), one[0], 100, 100, 0.1)
        tree.record(one[:1], one[1], [100, 60, 40], [40, 12, 4], 0.1)
    tree.record((), other[0], [1000, 0, 0], [500, 0, 0], 0.1)
    tree.select()
    hazards = tree._operator(other[0].problem).hazards
    assert hazards[0] == pytest.approx(0.5, abs=0.01)
    assert hazards[1] / hazards[0] == pytest.approx(0.5, abs=0.1) and hazards[2] / hazards[1] == pytest.approx(0.5, abs=0.1)
    fresh = Tree(transitions, discount=1.0)
    fresh.record((), other[0], [1000, 0], [500, 0], 0.1)
    fresh.select()
    assert fresh._operator(other[0].problem).hazards[1] == pytest.approx(FALLING_OFF * 0.5, abs=0.01)


def test_a_sequence_that_is_far_below_the_incumbent_is_hopeless():
    """a; b makes 25 samples/s. b; a cannot make one, as b succeeds twice in 128 tries; (a,b) makes half of the best."""
    transitions = pair_graph()
    best, poor, half = (transitions.parse(text) for text in ("a; b", "b; a", "(a,b)"))
    tree = Tree(transitions)
    assert not tree.hopeless(poor)
    for _ in range(20):
        tree.record((), best[0], 100, 50, 1.0)
        tree.record(best[:1], best[1], 50, 50, 1.0)
    tree.select()
    assert tree.incumbent == best
    tree.record((), poor[0], 128, 2, 2.56)
    tree.record((), half[0], 128, 32, 2.56)
    assert tree.hopeless(poor) and not tree.hopeless(half) and not tree.hopeless(best)


def test_the_incumbent_is_run_while_others_promise_little_more():
    """Two sequences of nearly equal rates, after many batches: one of them is run nearly always, and each has been run."""
    transitions = pair_graph()
    tree = Tree(transitions)
    generator, chosen = np.random.default_rng(0), []
    success = {("a",): 0.50, ("b",): 0.49, ("a", "b"): 0.02}
    for _ in range(3000):
        path = tree.select()
        chosen.append(transitions.format(path))
        prefix = ()
        for step in path:
            p = success[step.new] if not step.condition else 0.5
            tree.record(prefix, step, 500, int(generator.binomial(500, p)), 0.01)
            prefix = (*prefix, step)
    late = chosen[1000:]
    favourite = max(set(late), key=late.count)
    assert set(chosen) == {"a; b", "b; a", "(a,b)"}
    assert late.count(favourite) > 0.95 * len(late)


def test_what_disappoints_at_its_first_steps_is_given_up_before_its_last():
    """(a,b) makes 5 samples/s. b after a promises 50, until a begins to fail: known at once, not at the next refresh."""
    transitions = pair_graph()
    joint, alone = transitions.parse("(a,b)"), transitions.parse("a; b")
    tree = Tree(transitions)
    for _ in range(3):
        tree.record((), alone[0], 100, 100, 1.0)
        tree.record(alone[:1], alone[1], 100, 100, 1.0)
    for _ in range(100):
        tree.record((), joint[0], 100, 5, 1.0)
    tree._refresh()
    settle_on(tree, joint, advantage=10.0)
    tree._total.explored = 1e9  # no time to explore
    tree._choices = 0
    assert tree.select() == alone
    tree._stale = False
    for _ in range(10):
        tree.record((), alone[0], 1000, 1, 10.0)
    assert not tree._stale and tree.select() == joint


def settled_on_fifty_a_second(seconds):
    """A tree that runs (a,b), which makes 50 samples/s, and has no time to explore; a takes 10 ms a sample, b after it a
    thousandth of `seconds`. With both sequences."""
    transitions = pair_graph()
    joint, alone = transitions.parse("(a,b)"), transitions.parse("a; b")
    tree = Tree(transitions)
    for _ in range(100):
        tree.record((), joint[0], 1000, 500, 10.0)
        tree.record((), alone[0], 1000, 1000, 10.0)
        tree.record(alone[:1], alone[1], 1000, 1000, seconds)
    tree._refresh()
    settle_on(tree, joint, advantage=tree._rate_of(alone) / tree._rate_of(joint))
    tree._total.explored = 1e9
    return tree, joint, alone


def test_what_promises_hardly_more_than_the_incumbent_is_not_looked_for_again_soon():
    """(a,b) makes 50 samples/s, b after a 51: a refresh for every few records would take time and change nothing."""
    tree, joint, _ = settled_on_fifty_a_second(9.6)
    assert 1.01 < tree._advantage < SLIGHT_PROMISE
    for _ in range(DISAPPOINTED + 8):
        tree._choices = 0
        assert tree.select() == joint and not tree._stale
        tree.record((), joint[0], 1000, 500, 10.0)


@pytest.mark.parametrize(("seconds", "ratio"), [(8.9, 1.06), (6.0, 1.25)])
def test_full_batches_are_for_what_promises_much_more_than_the_incumbent(seconds, ratio):
    """(a,b) makes 50 samples/s, b after a a little more, which is looked at in small batches, or much more."""
    tree, _, alone = settled_on_fifty_a_second(seconds)
    assert tree._advantage == pytest.approx(ratio, abs=0.01)
    tree._choices = 0
    assert tree.select() == alone and tree.promised == (alone if ratio > PROMISE else ())


def test_the_best_sequence_is_one_that_was_run_to_the_end_though_a_cheaper_way_was_not_gone_on():
    transitions = Transitions(pick_place())
    finished, begun = transitions.parse("t; q1; q2"), transitions.parse("(t,q1); q2")
    tree = Tree(transitions)
    for position, step in enumerate(finished):
        tree.record(finished[:position], step, 100, 20, 1.0)
    tree.record((), begun[0], 100, 100, 0.01)
    assert [path for path, _ in tree.best_sequences(1)] == [finished]


def test_of_the_operators_that_never_ran_the_one_that_may_make_the_best_sequence_is_tried_first():
    """q1 succeeds in 20 of 1000 tries. (q1,q2,t) may do without, (q2,t) is smaller but needs q1 all the same."""
    transitions = Transitions(pick_place())
    usual, other, joint = (transitions.parse(text) for text in ("t; q1; q2", "(q1,t); q2", "(q1,q2,t)"))
    tree = Tree(transitions)
    tree.record((), usual[0], 1000, 1000, 0.1)
    tree.record(usual[:1], usual[1], 1000, 20, 0.1)
    tree.record(usual[:2], usual[2], 40, 36, 0.004)
    tree.record((), other[0], 1000, 15, 0.1)
    tree._refresh()
    settle_on(tree, usual, advantage=0.0)
    tree._total.spent, tree._choices = 2.0 * KEEN_AFTER, CURIOUS_EVERY - 1
    tree._total.first_trials = 0.9 * KEEN_CURIOSITY * KEEN_AFTER
    assert tree.select() == joint
    tree.record((), joint[0], 1000, 0, 0.1)
    tree._refresh()
    settle_on(tree, usual, advantage=0.0)
    # What promises less than the best sequence has to wait for its share of the time.
    tree._total.explored = 1e9
    tree._total.spent, tree._choices = 2.0 * KEEN_AFTER, CURIOUS_EVERY - 1
    tree._total.first_trials = 0.9 * KEEN_CURIOSITY * KEEN_AFTER
    assert tree.select() == usual
    tree._total.first_trials, tree._choices = 0.5 * CURIOSITY * tree._total.spent, CURIOUS_EVERY - 1
    assert tree.select()[0].new == ("q2", "t")


def test_hope_for_what_never_ran_grows_with_how_far_the_others_exceed_the_guess():
    """Four operators' weight of 0.5, and one of a logarithm of 2; one that does worse than guessed says nothing."""
    transitions = Transitions(pick_place())
    tree = Tree(transitions)
    assert _surprise([], 1.0) == 0.5
    (q1, _), (q2, _) = transitions.parse("(q1,t); q2"), transitions.parse("(q2,t); q1")
    tree.record((), q1, 10**6, round(10**6 * 0.05 * math.exp(2.0)), 1.0)
    tree.record((), q2, 10**6, 10, 1.0)
    ease = 0.05 / guessed_success(transitions.graph, q1.problem)[1]
    known = [operator for operator in tree._operators.values() if operator.statistics.tries]
    assert _surprise(known, ease) == pytest.approx(math.sqrt((4 * 0.25 + 4.0) / 5), rel=1e-4)


def test_random_is_uniform_over_children_and_repeatable():
    transitions = Transitions(pick_place())
    chooser, again = Random(transitions, seed=4), Random(transitions, seed=4)
    first = [chooser.select()[0].new for _ in range(2000)]
    assert first == [again.select()[0].new for _ in range(2000)]
    children = [t.new for t in transitions.children(())]
    for new in children:
        assert first.count(new) / 2000 == pytest.approx(1 / len(children), abs=0.05)


def test_same_inputs_same_choices():
    chosen = []
    for _ in range(2):
        transitions = Transitions(handover())
        tree, world, generator = Tree(transitions), World(transitions, 1), np.random.default_rng(1)
        chosen.append([transitions.format(world.rollout(tree, generator)) for _ in range(60)])
    assert chosen[0] == chosen[1]


def test_cost_of_a_choice():
    """Measured 3 ms for the choices of a rollout of six batches on banana; the bound leaves room for a busy machine."""
    transitions = Transitions(banana())
    tree, world, generator = Tree(transitions), World(transitions, 0), np.random.default_rng(0)
    spent, select = 0.0, tree.select

    def timed(ready=None):
        nonlocal spent
        start = time.process_time()
        path = select(ready)
        spent += time.process_time() - start
        return path

    tree.select = timed
    for _ in range(200):
        world.rollout(tree, generator)
    assert spent / 200 < 8e-3


def test_thirty_variables():
    transitions = Transitions(regrasps(8))
    tree = Tree(transitions)
    for _ in range(10):
        path = tree.select()
        assert path[-1].target == transitions.full
        for i, step in enumerate(path):
            tree.record(path[:i], step, 100, 60, 0.01 * len(step.new))
    assert tree.best_sequences(1)[0][1] > 0
    assert tree.select(lambda t: len(t.new) < 3)[-1].target == transitions.full
    assert tree.select(lambda t: False) == ()
    assert tree.select()[-1].target == transitions.full
    assert all(math.isfinite(entry["q"]) for entry in tree.as_json()["sequences"])


def test_orders_of_independent_steps_share_what_they_learn():
    transitions = Transitions(handover())
    tree = Tree(transitions, discount=1.0)
    one = transitions.parse("t_a; t_b; q_a1; (q_a2,p); q_b2; q_b1")
    other = transitions.parse("t_b; t_a; (q_a2,p); q_a1; q_b2; q_b1")
    for i, step in enumerate(one):
        tree.record(one[:i], step, 1000, 300 + 50 * i, 0.1)
    # The grasps, and q_a1 and (q_a2,p) after t_a alone, came about in the same way; q_a1 after q_a2 did not.
    assert tree.predict_rate(transitions.parse("t_b; t_a; q_a1; (q_a2,p); q_b2; q_b1")) == pytest.approx(tree.predict_rate(one))
    assert tree.predict_rate(other) != pytest.approx(tree.predict_rate(one))
    before = {e["sequence"]: e["visits"] for e in tree.as_json()["sequences"]}
    tree.record(other[:1], other[1], 1000, 300, 0.1)
    after = {e["sequence"]: e["visits"] for e in tree.as_json()["sequences"]}
    assert after == before | {"t_a": 2.0}


def test_conditions_that_wait_for_another_try_are_no_failures():
    """Success within four tries, seen when most conditions have had only one or two: 1 - 0.8 * 0.9 * 0.9 * 0.95."""
    statistics = Statistics()
    statistics.add(1.0, [1000, 500, 20, 20], [200, 50, 2, 1], 3.08)
    assert statistics.success_rate == pytest.approx(1 - 0.8 * 0.9 * 0.9 * 0.95)
    tries = 1 + 0.8 + 0.8 * 0.9 + 0.8 * 0.9 * 0.9
    assert statistics.seconds_per_condition == pytest.approx(tries * 3.08 / 1540)
    # Tries that were never made are believed to succeed like the one before.
    again = Statistics()
    again.add(1.0, [1000, 0], [200, 0], 1.0)
    assert again.hazards([0.5], 0.0) == pytest.approx([0.2, 0.2])


@pytest.mark.parametrize("spread", [0.0, 0.15])
def test_weight_of_pooled_statistics_is_learned(spread):
    """Success of an operator after 200 histories: a mean with and without a known spread about it."""
    transitions = Transitions(regrasps(3))
    tree = Fixed(transitions, next(transitions.sequences()), discount=1.0)
    generator = np.random.default_rng(0)
    seen = set()
    for path, _ in zip(transitions.sequences(), range(4000)):
        for i, step in enumerate(path):
            history = tree._follow(path[: i + 1])[-1].history
            if history not in seen and len(seen) < 400:
                seen.add(history)
                success = 0.5 + spread * generator.choice([-1, 1])
                tree.record(path[:i], step, 2000, int(generator.binomial(2000, success)), 0.1)
    # Two points at +-d about 1/2: the share of the variance between histories is d^2 / (1/4).
    expected = spread**2 / 0.25
    assert tree._correlations()[0] == pytest.approx(expected, abs=0.02)


def test_one_history_with_nearly_all_tries_does_not_hide_that_histories_matter():
    """Half of the histories succeed in 0.65, half in 0.35 of the tries, the one with nearly all tries in 0.65."""
    transitions = Transitions(regrasps(3))
    tree = Fixed(transitions, next(transitions.sequences()), discount=1.0)
    generator = np.random.default_rng(0)
    seen: dict = {}
    for path, _ in zip(transitions.sequences(), range(4000)):
        for i, step in enumerate(path):
            history = tree._follow(path[: i + 1])[-1].history
            if history not in seen and len(seen) < 400:
                dominates = history.operator not in {other.operator for other in seen}
                seen[history] = 0.65 if dominates else 0.5 + 0.15 * generator.choice([-1, 1])
                tries = 200_000 if dominates else 30
                tree.record(path[:i], step, tries, int(generator.binomial(tries, seen[history])), 0.1)
    assert tree._correlations()[0] == pytest.approx(0.15**2 / 0.25, abs=0.015)


def test_half_of_the_exploration_goes_into_what_did_well_at_its_first_looks():
    """q2 succeeds in a tenth after t; q1, and in a quarter of the first 40 tries after (t,q1)."""
    transitions = Transitions(pick_place())
    usual, lucky = transitions.parse("t; q1; q2"), transitions.parse("(t,q1); q2")
    tree = Tree(transitions, discount=1.0)
    for _ in range(20):
        tree.record((), usual[0], 1000, 1000, 0.01)
        tree.record(usual[:1], usual[1], 1000, 100, 1.0)
        tree.record(usual[:2], usual[2], 1000, 100, 1.0)
    tree.record((), lucky[0], 100_000, 5_000, 100.0)
    for text in ("(q2,t); q1", "(q1,q2,t)"):
        tree.record((), transitions.parse(text)[0], 100_000, 100, 100.0)
    tree.record(lucky[:1], lucky[1], 40, 10, 0.04)
    tree._refresh()
    (history,), _ = tree._made_along(lucky)
    average = (20 * 100 + 10) / (20 * 1000 + 40)
    believed = (10 + 8 * average) / (40 + 8)
    assert history.believed_cost == pytest.approx((20e-3 + 1e-3) / believed, rel=1e-5)
    assert history.item_cost > 1.05 * history.believed_cost
    # It begins with a dearer (t,q1) than t; q1 makes.
    settle_on(tree, usual, advantage=0.0)
    tree._compare_with_incumbent()
    assert tree._believed == lucky and not tree._stale
    tree._total.batches, tree._total.first_trials = 100.0, 1e9  # time to explore, none for operators that never ran
    tree._total.explored = 0.0
    assert [tree.select() for _ in range(20)].count(lucky) >= 10
    tree._total.explored = 1e9
    assert [tree.select() for _ in range(20)].count(usual) == 20


class HistoryWorld:
    """Success belongs to histories: about the operator's, with the scatter seen on real scenes. Pools as the sampler has."""

    def __init__(self, transitions, seed, scatter=0.35):
        self.world = World(transitions, seed)
        self.scatter, self.generator, self.known, self.pools = scatter, np.random.default_rng(200 + seed), {}, {}

    def histories(self, path):
        """Per step what it reads and what it makes."""
        came_about, result = {}, []
        for step in path:
            reads = [came_about.pop(c) for c in list(came_about) if c & step.condition]
            made = (step.problem, frozenset(reads))
            came_about[frozenset(step.new).union(*(self.members(read) for read in reads))] = made
            result.append((reads, made))
        return result

    def members(self, history):
        return frozenset(history[0][0]).union(*map(self.members, history[1]))

    def success(self, history):
        if history not in self.known:
            noise = self.generator.normal(0, self.scatter) if history[1] else 0.0
            self.known[history] = float(np.clip(self.world.success[history[0]] * np.exp(noise), 0.01, 0.95))
        return self.known[history]

    def seconds_per_sample(self, path):
        costs = {}
        for step, (reads, made) in zip(path, self.histories(path)):
            costs[made] = (sum(costs.pop(read) for read in reads) + self.world.cost[step.problem]) / self.success(made)
        return sum(costs.values())

    def run(self, tree, batch=256):
        """One batch: of the chosen sequence's last step or, where that lacks inputs, of what makes the scarcest."""
        path = tree.select()
        ways = self.histories(path)
        makers = {made: i for i, (_, made) in enumerate(ways)}
        i = len(path) - 1
        while True:
            reads, made = ways[i]
            scarcest = min(reads, key=lambda read: self.pools.get(read, 0), default=None)
            if scarcest is None or self.pools.get(scarcest, 0) >= batch // 4:
                break
            i = makers[scarcest]
        count = min([batch, *(self.pools[read] for read in reads)])
        for read in reads:
            self.pools[read] -= count
        passed = int(self.generator.binomial(count, self.success(made)))
        tree.record(path[:i], path[i], count, passed, count * self.world.cost[path[i].problem])
        self.pools[made] = self.pools.get(made, 0) + passed
        return path


def test_choice_converges_where_histories_matter():
    """3,000 batches, about as many as a run of 30 s has. Over these worlds 0.92 to 1.0 of the best of 960 sequences' rate:
    operators succeed far more often here than their rows and dof let expect, and some are tried late."""
    transitions, reached = Transitions(handover()), []
    for seed in range(5):
        world, tree = HistoryWorld(transitions, seed), Tree(transitions)
        for _ in range(3000):
            world.run(tree)
        least = min(map(world.seconds_per_sample, transitions.sequences()))
        reached.append(least * tree.rate)
    assert min(reached) > 0.6 and np.mean(reached) > 0.85
