import pytest

from cgs_jax.errors import InputError
from cgs_jax.graph import Constraint, ConstraintGraph, Variable


def small_graph() -> ConstraintGraph:
    return ConstraintGraph(
        "small",
        (Variable("q", 7, "configuration"), Variable("t", 6, "pose"), Variable("p", 6, "pose")),
        (
            Constraint("Grasp(t)", "Grasp", ("t",), 4, 2),
            Constraint("Kin(t,q,p)", "Kin", ("t", "q", "p"), 6, 0),
            Constraint("Near(q,p)", "Near", ("q", "p"), 0, 1),
        ),
    )


def test_components_join_only_through_scopes_inside():
    graph = small_graph()
    assert graph.components(()) == ()
    assert graph.components({"t", "p"}) == (frozenset("t"), frozenset("p"))
    assert graph.components({"p", "q"}) == (frozenset("qp"),)
    assert graph.components({"t", "q"}) == (frozenset("q"), frozenset("t"))
    assert graph.components({"q", "t", "p"}) == (frozenset("qtp"),)


def test_components_merge_whatever_the_order_of_constraints():
    variables = tuple(Variable(name, 1, "vector") for name in "abcd")
    links = [Constraint(f"L{a}{b}", "Link", (a, b), 0, 1) for a, b in ("ab", "cd", "bc")]
    graph = ConstraintGraph("path", variables, tuple(links))
    assert graph.components("abcd") == (frozenset("abcd"),)
    assert graph.components("abd") == (frozenset("ab"), frozenset("d"))


def test_lookups():
    graph = small_graph()
    assert graph.variable("t").dof == 6
    assert graph.neighbours("q") == ("t", "p")
    assert [constraint.name for constraint in graph.constraints_on("t")] == ["Grasp(t)", "Kin(t,q,p)"]
    assert graph.ordered(["p", "q", "p"]) == ("q", "p")
    with pytest.raises(InputError, match="unknown variable 'z'; available: q, t, p"):
        graph.variable("z")


def test_fingerprint_depends_on_content_not_on_title():
    graph = small_graph()
    renamed = ConstraintGraph("other title", graph.variables, graph.constraints)
    fewer = ConstraintGraph("small", graph.variables, graph.constraints[:-1])
    assert renamed.fingerprint == graph.fingerprint != fewer.fingerprint


@pytest.mark.parametrize(
    ("variables", "constraints", "message"),
    [
        ((), (), "no variables"),
        ((Variable("q", 7, "configuration"),) * 2, (), "repeated: q"),
        ((Variable("q", 0, "configuration"),), (), "dof 0"),
        ((Variable("q", 7, "configuration"),), (Constraint("C", "C", ("q", "x"), 0, 1),), "out of: q"),
        ((Variable("q", 7, "configuration"),), (Constraint("C", "C", (), 0, 1),), "out of: q"),
        ((Variable("q", 7, "configuration"),), (Constraint("C", "C", ("q",), -1, 1),), "negative"),
        ((Variable("q", 7, "configuration"),), (Constraint("C", "C", ("q",), 1, 1),) * 2, "repeated: C"),
    ],
)
def test_wrong_graphs_are_refused_in_one_line(variables, constraints, message):
    with pytest.raises(InputError, match=message) as caught:
        ConstraintGraph("wrong", variables, constraints)
    assert "\n" not in str(caught.value)
