"""A cost beside the constraints: minima on paper, and those of another solver in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loaded import matrices, problem
from scipy.optimize import minimize

import cgs_jax
from cgs_jax.errors import InputError
from cgs_jax.kinematics import tool_poses_on_host

LANES = 12


def compiled(function):
    """Jitted with little optimisation: the programs run once."""
    return jax.jit(function, compiler_options={"xla_backend_optimization_level": 0})


def test_the_nearest_place_of_a_region_is_the_clipped_point():
    at = problem("handover")
    task = at.scene.task
    (placement,) = task.placements
    wanted = np.array(placement.high) + [0.3, -0.05, 0.2]
    draw = cgs_jax.operator(at, (), ("p",), cost=lambda p: jnp.sum((p[:3] - wanted) ** 2))
    found, feasible = compiled(lambda key, params: draw(key, {}, params, LANES))(jax.random.key(0), at.params)
    assert feasible.any()
    expected = np.clip(wanted, placement.low, placement.high)
    np.testing.assert_allclose(found["p"][:, :3], np.tile(expected, (LANES, 1)), atol=2e-4)
    quat = np.abs(np.asarray(found["p"][:, 3:]) @ np.asarray(placement.quat))
    np.testing.assert_allclose(quat, 1.0, atol=1e-6)


@pytest.fixture(scope="module")
def nearest():
    """q1 given t, as near as possible to given wishes: grasps, wishes, found configurations, their mask."""
    at = problem("pick_place")
    t, held = cgs_jax.operator(at, (), ("t",))(jax.random.key(0), {}, at.params, LANES)
    assert held.all()
    home = at.scene.home_qpos[:7].astype(np.float32)

    def cost(q1):
        return jnp.sum((q1 - home) ** 2)

    plain = compiled(lambda t, params: cgs_jax.operator(at, ("t",), ("q1",))(jax.random.key(1), {"t": t}, params))
    apply = compiled(lambda t, params: cgs_jax.operator(at, ("t",), ("q1",), cost=cost)(jax.random.key(1), {"t": t}, params))
    before, _ = plain(t["t"], at.params)
    found, feasible = apply(t["t"], at.params)
    return at, np.asarray(t["t"], float), home, np.asarray(before["q1"], float), np.asarray(found["q1"], float)


def gap(at, q, t):
    """Six rows in double precision: position of the box and rotation between held and lying box."""
    rotation, position = tool_poses_on_host(at.exact.chains["a/a_pinch"], q[None])
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = rotation[0], position[0]
    held, lying = tool @ matrices(t)[0], matrices(at.scene.object_pose("box"))[0]
    turn = held[:3, :3] @ lying[:3, :3].T
    skew = turn - turn.T
    return np.concatenate([held[:3, 3] - lying[:3, 3], [skew[2, 1], skew[0, 2], skew[1, 0]]])


def slsqp(at, start, t, home):
    low, high = at.params.limits["q1"]
    return minimize(
        lambda q: np.sum((q - home) ** 2),
        np.clip(start, low, high),
        jac=lambda q: 2 * (q - home),
        constraints={"type": "eq", "fun": lambda q: gap(at, q, t)},
        bounds=list(zip(low, high, strict=True)),
        method="SLSQP",
        options={"maxiter": 200, "ftol": 1e-10},
    )


def test_the_nearest_configuration_is_that_of_another_solver(nearest):
    at, grasps, home, _, found = nearest
    compared = 0
    for t, q in zip(grasps, found, strict=True):
        if np.abs(gap(at, q, t)).max() > 1e-4:
            continue
        # Two solvers may end in different valleys from the same start; from beside our minimum both must stay.
        other = slsqp(at, q + 0.02 * np.sin(np.arange(7.0)), t, home)
        if not other.success:
            continue
        compared += 1
        assert np.sum((q - home) ** 2) == pytest.approx(other.fun, rel=2e-3)
        np.testing.assert_allclose(q, other.x, atol=2e-2)
    assert compared >= 4


def test_the_cost_falls(nearest):
    at, grasps, home, before, found = nearest
    both = [max(np.abs(gap(at, q, t)).max() for q in pair) < 1e-4 for t, *pair in zip(grasps, before, found, strict=True)]
    first, last = (np.sum((q[both] - home) ** 2, axis=1) for q in (before, found))
    assert sum(both) >= 4 and np.median(last - first) < -0.1


def test_a_cost_may_read_what_the_operator_does_not(nearest):
    at, grasps, *_ = nearest
    apply = cgs_jax.operator(at, ("t", "q2"), ("q1",), cost=lambda q1, q2: jnp.sum((q1 - q2) ** 2))
    with pytest.raises(InputError, match="needs values of q2"):
        apply(jax.random.key(0), {"t": grasps}, at.params)


def test_costs_that_are_none_are_refused():
    at = problem("pick_place")
    with pytest.raises(InputError, match="cost reads 'q9', available: t, q1"):
        cgs_jax.operator(at, ("t",), ("q1",), cost=lambda q9: 0.0)
    with pytest.raises(InputError, match="expected one floating-point number"):
        cgs_jax.operator(at, ("t",), ("q1",), cost=lambda q1: q1)
    with pytest.raises(InputError, match="cost failed with TypeError"):
        cgs_jax.operator(at, ("t",), ("q1",), cost=lambda q1: "far" + q1)
