"""The constraint graphs as drawn in the paper's figure, with the ranks that give Table I, and a long chain."""

from cgs_jax.graph import Constraint, ConstraintGraph, Variable


def manipulation_graph(name, order, q_dof, grasp_rows, kin, pairs=()) -> ConstraintGraph:
    """q*: configurations, t*: grasps, p*: placements; kin: scopes of Kin; pairs: scopes of binary Collision."""
    variables = tuple(
        Variable(n, q_dof, "configuration") if n.startswith("q") else Variable(n, 6, "pose") for n in order
    )
    constraints = [Constraint(f"Kin({','.join(scope)})", "Kin", scope, 6, 0) for scope in kin]
    constraints += [Constraint(f"Grasp({n})", "Grasp", (n,), grasp_rows, 2) for n in order if n.startswith("t")]
    constraints += [Constraint(f"Position({n})", "Position", (n,), 3, 4) for n in order if n.startswith("p")]
    scopes = [(n,) for n in order if n.startswith("q")] + list(pairs)
    constraints += [Constraint(f"Collision({','.join(scope)})", "Collision", scope, 0, 10) for scope in scopes]
    return ConstraintGraph(name, variables, tuple(constraints))


def pick_place() -> ConstraintGraph:
    return manipulation_graph("pick_place", ["q1", "q2", "t"], 7, 4, [("t", "q1"), ("t", "q2")])


def handover() -> ConstraintGraph:
    kin = [("t_a", "q_a1"), ("t_a", "q_a2", "p"), ("t_b", "q_b2", "p"), ("t_b", "q_b1")]
    order = ["q_a1", "q_a2", "t_a", "q_b1", "q_b2", "t_b", "p"]
    return manipulation_graph("handover", order, 7, 4, kin, [("q_a2", "q_b2")])


def banana() -> ConstraintGraph:
    kin = [("t_a", "q_a1"), ("t_a", "q_a2", "p"), ("t_x", "q_x", "p")]
    kin += [("t_b", "q_b1", "p", "t_x"), ("t_b", "q_b2", "t_x", "p")]
    order = ["q_a1", "q_a2", "t_a", "p", "q_x", "t_x", "q_b1", "q_b2", "t_b"]
    return manipulation_graph("banana", order, 8, 5, kin)


def regrasps(count: int) -> ConstraintGraph:
    """`count` grasps of one object with a free placement between any two: 4 * count - 1 variables."""
    order, kin, pairs = [], [], []
    for i in range(count):
        before, after = ([f"p{i}"] if i else []), ([f"p{i + 1}"] if i < count - 1 else [])
        order += [*before, f"t{i}", f"q{i}a", f"q{i}b"]
        kin += [(f"t{i}", f"q{i}a", *before), (f"t{i}", f"q{i}b", *after)]
        pairs += [(f"q{i - 1}b", f"q{i}a")] if i else []
    return manipulation_graph("regrasps", order, 7, 4, kin, pairs)
