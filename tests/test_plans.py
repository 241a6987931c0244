"""Elimination: every conditional problem has a plan, few layouts serve them all, and nothing is lost by substituting."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loaded import SCENES, problem, product, random_values

from cgs_jax import api
from cgs_jax import augmented_lagrangian as al
from cgs_jax.constraints import PoseRows
from cgs_jax.operators import gather_given, operator_of, propose_program
from cgs_jax.plans import PlanSystem
from cgs_jax.poses import Pose, from_vector
from cgs_jax.problems import with_collisions
from cgs_jax.seeds import count_draws, draw, uniforms


def layouts(name):
    at = problem(name)
    operators = {id(o): o for o in (operator_of(at, transition) for transition in at.transitions.all())}
    assert len(operators) == len(at.transitions.problems())
    return {operator.plan.layout for operator in operators.values()}


@pytest.mark.parametrize(("name", "shapes"), [("pick_place", 3), ("handover", 7), ("banana", 13)])
def test_few_shapes_serve_all_conditional_problems(name, shapes):
    assert len({(layout.configurations, layout.free, layout.words) for layout in layouts(name)}) == shapes


@pytest.mark.parametrize(("name", "most"), [("pick_place", 3), ("handover", 7), ("banana", 16)])
def test_few_layouts_serve_all_conditional_problems(name, most):
    assert len(layouts(name)) <= most


@pytest.mark.parametrize("name", SCENES)
def test_every_plan_accounts_for_every_variable_and_every_row(name):
    at = problem(name)
    for transition in at.transitions.all():
        plan = operator_of(at, transition).plan
        assert {*plan.configurations, *plan.poses} == set(transition.new)
        measured = {n for n in transition.constraints if n in at.declarations}
        assert set(plan.rows) <= measured
        # What is not read as rows defines one pose each: poses are either defined or free.
        assert len(measured) - len(plan.rows) == len(plan.poses) - len(plan.free)
        defining = [at.declarations[n] for n in measured - set(plan.rows)]
        assert all(isinstance(d, PoseRows) and d.form == "closed" for d in defining)


@pytest.mark.parametrize("name", SCENES)
def test_words_have_no_factor_beside_its_inverse(name):
    at = problem(name)
    for transition in at.transitions.all():
        code = operator_of(at, transition).plan.code
        for words in (code.words, code.outputs):
            beside = (words.atom[:, 1:] == words.atom[:, :-1]) & (words.atom[:, 1:] > 0)
            assert not (beside & (words.inverted[:, 1:] != words.inverted[:, :-1])).any()


def test_the_place_of_the_box_cancels_where_the_chain_stands_on_it():
    # Kin(t_x, q_x, p) defines t_x = T(q_x)^-1 B^-1 p, so that p t_x^-1, the stand of the hanging chain, is without p.
    at = problem("banana")
    new = ("t_x", "t_b", "q_x", "q_b1")
    plan = operator_of(at, api.conditional(at, ("p",), new)).plan
    (index,) = [i for i, rows in enumerate(plan.rows) if rows.startswith("Kin") and "q_b1" in rows] or [None]
    if index is None:
        # The loop defines t_b, whose word then has no p.
        word = plan.code.outputs.atom[plan.poses.index("t_b")]
    else:
        word = plan.code.words.atom[index]
    given = [term.name for term in plan.given]
    assert 1 + given.index("p") not in word


def violations(at, values):
    """Largest violation per declared constraint, from the declared products themselves in double precision."""
    result = {}
    for name, declaration in at.declarations.items():
        if not set(declaration.scope) <= set(values):
            continue
        data = at.params.rows[name]
        offered = at.params.sites.get(name)
        best = np.inf
        for site in [None] if offered is None else offered:
            pose = product(at, declaration.product, values, {name: site})
            turn = pose[:, :3, :3]
            if data.as_vector > 0.5:
                error = turn @ np.asarray(data.wanted, float).T
                skew = 0.5 * (error - np.swapaxes(error, 1, 2))
                rotation = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
                rotation = np.where(np.trace(error, axis1=1, axis2=2)[:, None] < 2.9, np.pi, rotation)
            else:
                rotation = np.stack([(turn @ data.inner_axes[i]) @ data.outer_axes[i] for i in range(3)], axis=1)
            rows = np.concatenate([pose[:, :3, 3], rotation], axis=1)
            best = np.minimum(best, np.abs(rows - np.clip(rows, data.low, data.high)).max(axis=1))
        result[name] = best
    return result


@pytest.mark.parametrize(
    ("name", "new", "lanes"),
    [
        ("pick_place", ("q1", "q2", "t"), 64),
        ("handover", ("q_a2", "q_b2", "t_a", "t_b", "p"), 64),
        ("banana", ("q_a1", "q_a2", "t_a", "p"), 64),
    ],
)
def test_solutions_hold_in_the_constraints_that_were_eliminated(name, new, lanes):
    at = problem(name)
    operator = operator_of(at, api.conditional(at, (), new))
    given = jnp.asarray(gather_given(operator, at.params, {}, lanes))
    run = propose_program(operator.plan.layout, al.Settings(), lanes)
    result = run(jax.random.key(0), np.uint32(0), np.int32(lanes), given, (), operator.numbers(at.params))
    kept = np.asarray(result.feasible)
    assert kept.sum() >= 8
    values = {n: np.asarray(v, dtype=float)[kept] for n, v in operator.named(result).items()}
    found = violations(at, values)
    assert {n for n in operator.constraints if n in at.declarations} == set(found)
    for name, violation in found.items():
        assert violation.max() < 5e-5, name


def test_a_pose_that_the_given_ones_determine_is_computed_and_judged():
    at = problem("pick_place")
    lanes = 64
    sampled, feasible = jax.jit(lambda key, params: api.operator(at, (), ("q1", "t"))(key, {}, params, lanes))(
        jax.random.key(0), at.params
    )
    kept = np.asarray(feasible)
    assert kept.any()
    judge = jax.jit(lambda q1, params: api.operator(at, ("q1",), ("t",))(jax.random.key(1), {"q1": q1}, params))
    found, ok = judge(sampled["q1"], at.params)
    np.testing.assert_allclose(np.asarray(found["t"])[kept][:, :3], np.asarray(sampled["t"])[kept][:, :3], atol=1e-4)
    # Rounding may push a lane at the solver's tolerance over it; a different configuration grasps nothing.
    assert np.asarray(ok)[kept].mean() > 0.8
    _, other = judge(sampled["q1"] + 0.3, at.params)
    assert not other.any()


# ------------------------------------------------------------------ clearances inside the projection


def drawn_rows(at, given, new, lanes):
    """The system of a problem with clearances inside, seeds of its unknowns, and the other data of its rows."""
    operator = operator_of(at, api.conditional(at, given, new))
    layout = operator.plan.layout
    numbers = jax.tree.map(jnp.asarray, operator.numbers(at.params))
    values = {name: jnp.asarray(v, jnp.float32) for name, v in random_values(at, lanes).items()}
    pose = from_vector(jnp.transpose(gather_given(operator, at.params, values, lanes), (2, 1, 0)))
    pose = Pose(jnp.moveaxis(pose.rotation, 2, 0), jnp.moveaxis(pose.position, 1, 0))
    q = tuple(values[name].T for name in operator.plan.given_configurations)
    u = uniforms(jax.random.key(0), jnp.arange(lanes, dtype=jnp.uint32), count_draws(layout))
    x, tasks = draw(layout, pose, q, numbers.tables, numbers.seeds, numbers.choices, numbers.shared, u)
    return operator, PlanSystem(layout), x, (tasks, numbers.shared)


def test_rows_of_clearances_change_as_their_derivative_says():
    at = with_collisions(problem("handover"), "inside")
    inside = ("Position(p)", "Kin(q_b2,p,t_b)", "Collision(q_b2)", "Collision(q_a2,q_b2)")
    operator, system, x, data = drawn_rows(at, ("q_a2",), ("p", "q_b2", "t_b"), 64)
    # Away from the seed's upright box: its faces are parallel to the table's, where distances have kinks.
    x = system.retract(x, 0.3 * jax.random.normal(jax.random.key(1), (system.layout.unknowns, 64)))
    assert operator.inside == inside and not operator.clears
    count, step = len(inside), 5e-4

    def last_rows(x, move):
        rows = system.rows(system.retract(x, move), data)
        return al.Rows(*(part[-count:] for part in rows))

    last_rows = jax.jit(last_rows, compiler_options={"xla_backend_optimization_level": 0})
    at_x = last_rows(x, jnp.zeros((system.layout.unknowns, 64)))
    for i in range(system.layout.unknowns):
        move = np.zeros((system.layout.unknowns, 64), np.float32)
        move[i] = step
        ahead, behind = (np.asarray(last_rows(x, sign * move).value) for sign in (1.0, -1.0))
        error = np.abs((ahead - behind) / (2 * step) - at_x.jacobian[:, i])
        # Where another pair becomes the nearest the distance has a kink.
        assert np.median(error) < 1e-3 and (error < 5e-3).mean() > 0.9
    assert np.abs(at_x.jacobian).max() > 0.1
