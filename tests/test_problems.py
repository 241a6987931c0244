"""A user's own constraints: satisfied by the samples, and checked when they are made."""

import jax
import jax.numpy as jnp
import numpy as np
import paper_graphs
import pytest
from loaded import problem

import cgs_jax
from cgs_jax.errors import InputError
from cgs_jax.sampler import SamplerSettings

SMALL = SamplerSettings(batch_size=128, lanes=32)


@pytest.fixture(scope="module")
def samples():
    """pick_place with the last joint straight at the pick, and the box gripped above its middle."""
    at = cgs_jax.with_constraint(problem("pick_place"), "straight", ["q1"], lambda q1: q1[6:], "equality", 1)
    at = cgs_jax.with_constraint(
        at, "high", ["t", "q2"], lambda t, q2: jnp.stack([t[2] - 0.02, q2[0] - 1.0]), "inequality", 2
    )
    return cgs_jax.sample(at, 20.0, 60, method="expert3", settings=SMALL)


def test_a_users_equality_holds_in_every_sample(samples):
    assert len(samples["q1"]) == 60
    assert np.abs(samples["q1"][:, 6]).max() < 5e-5
    assert np.ptp(samples["q2"][:, 6]) > 0.5


def test_a_users_inequality_holds_in_every_sample(samples):
    assert samples["t"][:, 2].max() < 0.02 + 5e-5 and samples["q2"][:, 0].max() < 1.0 + 5e-5


def test_the_graph_has_the_new_constraint_and_the_old_problem_does_not():
    before = problem("pick_place")
    after = cgs_jax.with_constraint(before, "straight", ["q1"], lambda q1: q1[6:], "equality", 1)
    added = set(after.graph.constraints) - set(before.graph.constraints)
    assert [(c.name, c.scope, c.equality_rows, c.inequality_rows) for c in added] == [("straight", ("q1",), 1, 0)]
    assert "straight" not in before.declarations and after.operators is not before.operators
    active = {name for t in after.transitions.all() for name in t.constraints if "q1" in t.new}
    assert "straight" in active


FINE = dict(name="mine", scope=["q1"], function=lambda q1: q1[:2], kind="equality", rows=2)
WRONG = {
    "taken name": ({"name": "Collision(q1)"}, "'Collision(q1)' exists already"),
    "unknown variable": ({"scope": ["q9"]}, "unknown variable 'q9'; available: q1"),
    "no variable": ({"scope": []}, "'mine' has an empty scope"),
    "kind": ({"kind": "soft"}, "expected one of: equality, inequality"),
    "no rows": ({"rows": 0}, "expected a whole number of at least 1"),
    "shape": ({"rows": 3}, r"returns shape \(2,\), expected \(3,\)"),
    "value": ({"function": lambda q1: jnp.log(-jnp.abs(q1[:2]))}, "a value that is not finite"),
    "derivative": ({"function": lambda q1: jnp.sqrt(0.0 * q1[:2])}, "a derivative that is not finite"),
    "keyword": ({"function": lambda q: q[:2]}, "failed with TypeError: .*unexpected keyword"),
    "rank": ({"function": lambda q1: q1, "rows": 7}, "leaves no sequence"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_constraints_are_refused_in_one_line(case):
    change, message = WRONG[case]
    with pytest.raises(InputError, match=message.replace("(q1)", r"\(q1\)")) as caught:
        cgs_jax.with_constraint(problem("pick_place"), **(FINE | change))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["pick_place", "handover", "banana"])
def test_graphs_of_the_scenes_are_those_of_the_papers_figure(name):
    """Variables with their dof; factors with their scopes and equality rows."""

    def factors(graph):
        return sorted((c.factor, sorted(c.scope), c.equality_rows) for c in graph.constraints)

    ours, drawn = problem(name).graph, getattr(paper_graphs, name)()
    assert {v.name: (v.dof, v.kind) for v in ours.variables} == {v.name: (v.dof, v.kind) for v in drawn.variables}
    assert factors(ours) == factors(drawn)


@pytest.mark.parametrize("name", ["pick_place", "handover", "banana"])
def test_instances_differ_in_numbers_only(name):
    """Same structure, shapes and types, and hence no new trace."""

    def shapes(instance):
        return jax.tree.map(lambda a: (a.shape, a.dtype), problem(name, instance).params)

    for instance in range(1, 8):
        assert shapes(instance) == shapes(0), instance
        assert problem(name, instance).graph == problem(name, 0).graph


def test_two_instances_are_clearly_harder_for_a_joint_solve():
    """At most a fifth of instance 0's success where all variables are solved at once."""
    settings = SamplerSettings(batch_size=256, lanes=32, tries=1, workers=1, deterministic=True)

    def success(instance):
        tasks = cleared = 0
        for event in cgs_jax.Run(problem("pick_place", instance), "expert1", settings=settings).events(60.0):
            if type(event).__name__ == "Ran":
                tasks, cleared = tasks + event.tasks, cleared + event.cleared
                if tasks >= 1024:
                    break
        return cleared / tasks

    roomy = success(0)
    assert roomy > 0.05
    assert max(success(6), success(7)) <= roomy / 5


def test_every_problem_of_the_scenes_has_the_papers_counts():
    for name, kept, distinct in (("pick_place", 8, 6), ("handover", 163, 43), ("banana", 534, 135)):
        transitions = problem(name).transitions
        assert (transitions.pruned_count(), len(transitions.problems())) == (kept, distinct)
