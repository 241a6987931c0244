import itertools
import random
import time

import pytest
from paper_graphs import banana, handover, pick_place, regrasps

from cgs_jax.errors import InputError
from cgs_jax.graph import Constraint, ConstraintGraph, Variable
from cgs_jax.transitions import Transitions

TABLE_II = {
    handover: [
        "(q_a1,q_a2,t_a,q_b1,q_b2,t_b,p)",
        "p; t_a; t_b; q_a1; q_a2; q_b2; q_b1",
        "(q_a1,t_a); (q_a2,p,q_b2,t_b); (q_b1)",
        "t_b; t_a; q_a1; q_b1; (q_a2,p); q_b2",
        "(q_b1,t_b); (q_b2,p); (q_a2,t_a); q_a1",
    ],
    banana: [
        "(q_a1,q_a2,t_a,p,q_x,t_x,q_b1,q_b2,t_b)",
        "p; t_a; t_b; t_x; q_a1; q_a2; q_x; q_b1; q_b2",
        "(q_a1,t_a); (q_a2,p); (q_x,t_x); (q_b1,t_b); q_b2",
        "(q_a1,t_a); (q_a2,p); (q_b1,q_b2,t_b,t_x); q_x",
        "(p,q_b2,t_b,t_x); q_x; (q_a1,t_a); q_a2; q_b1",
    ],
}


@pytest.mark.parametrize(
    ("graph", "complete", "pruned", "problems"),
    [(pick_place, 19, 8, 6), (handover, 2059, 163, 43), (banana, 19171, 534, 135)],
)
def test_table_one(graph, complete, pruned, problems):
    transitions = Transitions(graph())
    assert transitions.complete_count == complete
    assert transitions.pruned_count() == pruned == len(transitions.all()) == len(set(transitions.all()))
    assert len(transitions.problems()) == problems


@pytest.mark.parametrize(("graph", "sequence"), [(g, s) for g, sequences in TABLE_II.items() for s in sequences])
def test_table_two_sequences_are_paths(graph, sequence):
    transitions = Transitions(graph())
    path = transitions.parse(sequence)
    assert transitions.parse(transitions.format(path)) == path
    assert transitions.parse([list(step.new) for step in path]) == path
    assert set().union(*(step.new for step in path)) == transitions.full


def test_the_papers_two_examples_of_pruning():
    transitions = Transitions(pick_place())
    assert ("t",) not in [t.new for t in transitions.children({"q1"})]
    assert [t.new for t in transitions.children({"t"})] == [("q1",), ("q2",)]


def test_sequences():
    transitions = Transitions(handover())
    listed = list(transitions.sequences())
    assert len(listed) == transitions.count_sequences() == len(set(listed)) == 960
    assert all(path[-1].target == transitions.full for path in listed)


def test_fields_of_a_transition():
    transitions = Transitions(handover())
    path = transitions.parse("t_a; p; q_a2; t_b; q_b2; q_b1; q_a1")
    q_b2 = path[4]
    assert q_b2.constraints == ("Kin(t_b,q_b2,p)", "Collision(q_b2)", "Collision(q_a2,q_b2)")
    assert q_b2.condition == {"t_b", "p", "q_a2"}
    assert q_b2.given == {"t_a", "p", "q_a2", "t_b"}
    assert q_b2.problem == (("q_b2",), q_b2.constraints)
    sizes = [len(t.new) for t in transitions.children(())]
    assert sizes == sorted(sizes)


@pytest.mark.parametrize(
    ("sequence", "message"),
    [
        ("t_a; (q_a1,q_b1)", r"step 2 \(q_a1,q_b1\) is not possible after 't_a'; available: q_a1, t_b, p, "),
        ("t_a; t_a", r"step 2 \(t_a\)"),
        ("t_a; nonsense", r"step 2: unknown variable 'nonsense', available: q_a1, .*t_b, p$"),
        ("(q_a1,q_b1)", r"available: (\(?[a-z0-9_,]+\)?, ){11}\(?[a-z0-9_,]+\)? and \d+ more$"),
        ("", "unassigned; available next: t_a, t_b, p"),
        ("(q_a1,t_a)", "leaves q_a2, q_b1, q_b2, t_b, p unassigned"),
    ],
)
def test_wrong_sequences_are_refused_in_one_line(sequence, message):
    with pytest.raises(InputError, match=message) as caught:
        Transitions(handover()).parse(sequence)
    assert "\n" not in str(caught.value)


def brute_force(graph: ConstraintGraph) -> set[tuple[frozenset, frozenset]]:
    """Kept transitions by the letter of the three rules: all V inside new, all pairs of states, searches for rule 3."""
    names = [v.name for v in graph.variables]
    dof = {v.name: v.dof for v in graph.variables}
    states = [frozenset(s) for k in range(len(names) + 1) for s in itertools.combinations(names, k)]

    def passes(given: frozenset, target: frozenset) -> bool:
        new = target - given
        active = [c for c in graph.constraints if target.issuperset(c.scope) and new & set(c.scope)]
        for size in range(1, len(new) + 1):
            for subset in itertools.combinations(sorted(new), size):
                rows = sum(c.equality_rows for c in active if (new & set(c.scope)) <= set(subset))
                if rows > sum(dof[name] for name in subset):
                    return False
        group = {min(new)}
        for _ in new:
            group |= set().union(*(new & set(c.scope) for c in active if group & set(c.scope)))
        return group == new

    edges = {(s, t) for s in states for t in states if s < t and passes(s, t)}
    forward, backward = {frozenset()}, {frozenset(names)}
    for _ in names:
        forward |= {t for s, t in edges if s in forward}
        backward |= {s for s, t in edges if t in backward}
    return {(s, t) for s, t in edges if s in forward and t in backward}


@pytest.mark.parametrize("seed", range(40))
def test_pruning_against_brute_force_on_random_graphs(seed):
    generator = random.Random(seed)
    names = [f"x{i}" for i in range(generator.choice([3, 4, 5]))]
    variables = tuple(Variable(name, generator.randint(1, 4), "vector") for name in names)
    constraints = tuple(
        Constraint(f"c{i}", "c", tuple(generator.sample(names, generator.choice([1, 2, 2, 3]))), rows, 1)
        for i in range(generator.randint(2, 7))
        for rows in [generator.choice([0, 1, 1, 2, 3])]
    )
    graph = ConstraintGraph("random", variables, constraints)
    kept = brute_force(graph)
    transitions = Transitions(graph)
    assert {(t.given, t.target) for t in transitions.all()} == kept
    for size in range(len(names) + 1):
        for state in map(frozenset, itertools.combinations(names, size)):
            assert {t.target for t in transitions.children(state)} == {t for s, t in kept if s == state}


def test_thirty_variables_are_not_enumerated():
    graph = regrasps(8)
    assert len(graph.variables) == 31
    start = time.perf_counter()
    transitions = Transitions(graph)
    children = transitions.children(())
    path, state = [], frozenset()
    while state != transitions.full:
        path.append(transitions.children(state)[0])
        state = path[-1].target
    assert time.perf_counter() - start < 1.0
    assert 50 < len(children) < 500
    assert children[-1].target == transitions.full
    assert transitions.parse(transitions.format(path)) == tuple(path)
