"""Rows by hand, and all Jacobians against finite differences in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loaded import problem

import cgs_jax
from cgs_jax.api import conditional
from cgs_jax.constraints import Function, FunctionArgument, count_rows, function_rows, pose_rows, row_data
from cgs_jax.operators import operator_of
from cgs_jax.plans import PlanSystem, Point, Tasks, all_atoms, multiply_words, tools_at
from cgs_jax.poses import Pose, from_vector, rotation_exp

ROWS = jax.jit(pose_rows)


def turned(axis, angle, position=(0.0, 0.0, 0.0)):
    """One lane."""
    vector = np.asarray(axis, dtype=float) * angle
    return Pose(rotation_exp(jnp.asarray(vector)[:, None]), jnp.asarray(position, jnp.float32)[:, None])


def values(pose, data):
    return np.asarray(ROWS(pose, jax.tree.map(lambda a: jnp.asarray(a)[..., None], data)).value)[:, 0]


def outside(pose, data):
    value = values(pose, data)
    return value - np.clip(value, data.low, data.high)


HALF = np.pi / 2
PERPENDICULAR = [([0, 1, 0], [0, 1, 0], 0.0), ([0, 1, 0], [0, 0, 1], 0.0)]


def test_closed_rows_are_position_and_rotation_vector():
    data = row_data("closed")
    np.testing.assert_allclose(values(turned([0, 0, 1], 0.3, [1, 2, 3]), data), [1, 2, 3, 0, 0, 0.3], atol=1e-6)
    assert count_rows(data) == (6, 0)


def test_oriented_rows_measure_the_turn_from_the_wanted_rotation():
    wanted = np.asarray(turned([0, 0, 1], HALF).rotation)[..., 0]
    data = row_data("oriented", low=(-1, -1, 0), high=(1, 1, 0), wanted=wanted)
    np.testing.assert_allclose(outside(turned([0, 0, 1], HALF - 0.2, [2, 0, 0.5]), data), [1, 0, 0.5, 0, 0, -0.2], atol=1e-6)
    assert count_rows(data) == (4, 4)


def test_upright_rows_vanish_for_any_turn_about_the_vertical():
    data = row_data("upright", low=(-1, -1, 0.3), high=(1, 1, 0.3))
    np.testing.assert_allclose(outside(turned([0, 0, 1], 2.0, [0, 0, 0.3]), data), 0, atol=1e-6)
    # Tilted by 0.2 about x the z axis points to (0, -sin, cos); upside down only the sign row is left.
    np.testing.assert_allclose(outside(turned([1, 0, 0], 0.2, [0, 0, 0.3]), data)[3:], [0, -np.sin(0.2), 0], atol=1e-6)
    np.testing.assert_allclose(outside(turned([1, 0, 0], np.pi, [0, 0, 0.3]), data)[3:], [0, 0, -1], atol=1e-6)
    assert count_rows(data) == (3, 5)


def test_touch_rows_want_opposed_axes():
    data = row_data("touch")
    np.testing.assert_allclose(outside(turned([1, 0, 0], np.pi), data), 0, atol=1e-6)
    np.testing.assert_allclose(outside(turned([0, 0, 1], 1.0), data)[3:], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(
        outside(turned([1, 0, 0], np.pi - 0.1, [0, 0, 0.01]), data)[[2, 4]], [0.01, -np.sin(0.1)], atol=1e-6
    )
    assert count_rows(data) == (5, 1)


def test_two_finger_rows_are_dot_products_of_gripper_and_object_axes():
    data = row_data("two_finger", low=(0, 0, -0.05), high=(0, 0, 0.05), axes=PERPENDICULAR)
    # A quarter turn about z brings the gripper's y axis along the box's -x axis: perpendicular to its y and z.
    np.testing.assert_allclose(outside(turned([0, 0, 1], HALF, [0, 0, 0.04]), data), 0, atol=1e-6)
    np.testing.assert_allclose(
        outside(turned([0, 0, 1], HALF - 0.1, [0, 0.02, 0.06]), data)[:4], [0, 0.02, 0.01, np.sin(0.1)], atol=1e-6
    )
    assert count_rows(data) == (4, 2)


def test_located_rows_say_nothing_about_rotation():
    data = row_data("located", low=(0, 0, 0), high=(1, 1, 1))
    np.testing.assert_allclose(outside(turned([1, 0, 0], 2.0, [2, 0.5, -1]), data), [1, 0, -1, 0, 0, 0], atol=1e-6)
    assert count_rows(data) == (0, 6)


@pytest.mark.parametrize("form", ["two_finger", "touch", "upright"])
def test_turn_of_dot_products_is_their_derivative(form):
    with jax.enable_x64(True):
        data = jax.tree.map(lambda a: jnp.asarray(a)[..., None], row_data(form, axes=PERPENDICULAR))
        rotation = rotation_exp(jnp.array([[0.4], [-1.1], [0.7]]))
        analytic = jax.jit(pose_rows)(Pose(rotation, jnp.zeros((3, 1))), data).turn

        def rows(spin):
            moved = jnp.einsum("ijl,jkl->ikl", rotation_exp(spin[:, None]), rotation)
            return pose_rows(Pose(moved, jnp.zeros((3, 1))), data).value[3:, 0]

        np.testing.assert_allclose(analytic[..., 0], jax.jit(jax.jacfwd(rows))(jnp.zeros(3)), atol=1e-9)


# ---------------------------------------------------------------- whole plans


def with_functions(at):
    def mixed(q1, t):
        return jnp.stack([q1[6] * q1[0], t[0] * t[1] + t[3] * t[6], jnp.sin(t[5])])

    at = cgs_jax.with_constraint(at, "mixed", ["q1", "t"], mixed, "inequality", 3)
    return cgs_jax.with_constraint(at, "bent", ["q2"], lambda q2: q2[3:4] + 1.5, "inequality", 1)


PLANS = [
    ("pick_place", (), ("t", "q1", "q2")),
    ("pick_place", ("q1", "t"), ("q2",)),
    ("handover", (), ("q_a1", "q_a2", "q_b1", "q_b2", "t_a", "t_b", "p")),
    ("banana", (), ("q_a1", "q_a2", "q_x", "q_b1", "q_b2", "t_a", "t_x", "t_b", "p")),
    ("banana", ("p", "t_x"), ("t_b", "q_b1")),
    ("functions", (), ("t", "q1", "q2")),
    ("functions", ("q1",), ("t", "q2")),
]


@pytest.mark.parametrize(("name", "given", "new"), PLANS, ids=lambda v: ",".join(v) if isinstance(v, tuple) else v)
def test_jacobians_of_plans_agree_with_finite_differences(name, given, new):
    at = with_functions(problem("pick_place")) if name == "functions" else problem(name)
    operator = operator_of(at, conditional(at, given, new))
    layout = operator.plan.layout
    n, rng, h = layout.unknowns, np.random.default_rng(8), 1e-5
    with jax.enable_x64(True):
        numbers = jax.tree.map(lambda a: jnp.asarray(a, a.dtype if a.dtype == np.int32 or a.dtype == bool else np.float64),
                               operator.numbers(at.params))  # fmt: skip

        def poses(count):
            quat = rng.normal(size=(4, count))
            vectors = np.concatenate([rng.uniform(-0.5, 0.5, (3, count)), quat / np.linalg.norm(quat, axis=0)])
            pose = from_vector(jnp.asarray(vectors))
            # One lane per perturbation of the same point.
            lanes = 2 * n + 1
            rotation = jnp.broadcast_to(jnp.moveaxis(pose.rotation, 2, 0)[..., None], (count, 3, 3, lanes))
            return Pose(rotation, jnp.broadcast_to(pose.position.T[..., None], (count, 3, lanes)))

        lanes = 2 * n + 1
        q = jnp.asarray(rng.uniform(-1.5, 1.5, (layout.configurations, layout.joints, 1)))
        x = Point(jnp.broadcast_to(q, (*q.shape[:2], lanes)), poses(layout.free))
        read = tuple(jnp.asarray(np.tile(rng.uniform(-1, 1, (7, 1)), lanes)) for _ in operator.plan.given_configurations)
        data = Tasks(poses(layout.given + layout.sites), x.configurations, x.configurations, jnp.zeros((2, lanes)), read)
        system = PlanSystem(layout)
        # The derivative of a rotation vector is stated at zero error: the wanted rotations are those at the point.
        tools, _ = tools_at(layout, numbers.shared.chains, x.configurations)
        whole = multiply_words(numbers.shared.code.words, all_atoms(data.given, tools, x.free)).whole
        shared = numbers.shared._replace(rows=numbers.shared.rows._replace(wanted=whole.rotation[..., 0]))
        steps = np.concatenate([np.zeros((n, 1)), h * np.eye(n), -h * np.eye(n)], axis=1)
        rows = jax.jit(lambda x, data, shared: system.rows(x, (data, shared)))(
            system.retract(x, jnp.asarray(steps)), data, shared
        )
        numeric = (np.asarray(rows.value[:, 1 : n + 1]) - np.asarray(rows.value[:, n + 1 :])) / (2 * h)
        np.testing.assert_allclose(rows.jacobian[..., 0], numeric, atol=2e-7)
        assert np.abs(numeric).max() > 0.1


def test_function_rows_follow_the_chain_rule():
    function = Function(lambda q, p: jnp.stack([q[0] * p[0], p[3] ** 2 + q[1]]), ("q", "p"), "equality", 2)
    q, p = jnp.array([[0.3], [0.7]]), turned([0, 0, 1], 0.8, [0.5, 0.1, 0.2])
    arguments = {
        "q": FunctionArgument(q, jnp.eye(2, 8)[..., None]),
        "p": FunctionArgument(p, jnp.eye(6, 8, 2)[..., None]),
    }
    value, jacobian = jax.jit(lambda arguments: function_rows(function, arguments, 8))(arguments)
    np.testing.assert_allclose(value[:, 0], [0.15, np.cos(0.4) ** 2 + 0.7], atol=1e-6)
    expected = np.zeros((2, 8))
    # cos^2(a / 2) = (1 + cos a) / 2, whose derivative by the turn about z is -sin(a) / 2.
    expected[0, [0, 2]], expected[1, [1, 7]] = [0.5, 0.3], [1.0, -0.5 * np.sin(0.8)]
    np.testing.assert_allclose(jacobian[..., 0], expected, atol=1e-6)


def test_a_function_of_the_wrong_shape_is_refused():
    function = Function(lambda q: q, ("q",), "equality", 1)
    with pytest.raises(AssertionError, match="shape"):
        function_rows(function, {"q": FunctionArgument(jnp.zeros((2, 1)), None)}, 2)
