"""The solver on problems with answers on paper."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cgs_jax import augmented_lagrangian as al

SETTINGS = al.Settings()
WITH_MULTIPLIERS = replace(SETTINGS, multiplier_period=2, max_iterations=60)


class Rows:
    """A system from a function `(x, data) -> value` of one lane and its interval; x is boxed."""

    def __init__(self, function, low, high, box=np.inf):
        self.function, self.box = function, box
        self.low, self.high = (jnp.asarray(np.reshape(b, (-1, 1)), jnp.float32) for b in (low, high))

    def rows(self, x, data):
        of_lane = (lambda v, d: self.function(v)) if data is None else self.function
        value = jax.vmap(of_lane, in_axes=-1, out_axes=-1)(x, data)
        jacobian = jax.vmap(jax.jacfwd(of_lane), in_axes=-1, out_axes=-1)(x, data)
        return al.Rows(value, self.low, self.high, self.low, self.high, jacobian)

    def room(self, x, data):
        return -self.box - x, self.box - x

    def retract(self, x, step):
        return x + step


def seeds(n, lanes, seed=0, width=2.0):
    return jnp.asarray(np.random.default_rng(seed).uniform(-width, width, size=(n, lanes)), jnp.float32)


@pytest.mark.parametrize("settings", [SETTINGS, WITH_MULTIPLIERS], ids=["plain", "multipliers"])
def test_projection_on_a_plane_is_orthogonal(settings):
    normal = np.array([1.0, 2.0, -2.0]) / 3.0
    x = seeds(3, 16)
    # Little damping: undamped, one step is the orthogonal projection.
    result = al.project(
        Rows(lambda v: (normal @ v)[None], 0.5, 0.5), x, None, replace(settings, damping=0.0, max_step=9.0)
    )
    expected = np.asarray(x) - np.outer(normal, normal @ np.asarray(x) - 0.5)
    assert result.feasible.all()
    np.testing.assert_allclose(result.x, expected, atol=1e-4)


@pytest.mark.parametrize("settings", [SETTINGS, WITH_MULTIPLIERS], ids=["plain", "multipliers"])
def test_projection_on_a_sphere_stays_on_the_ray(settings):
    x = seeds(3, 64, 1)
    result = al.project(Rows(lambda v: (v @ v - 1.0)[None], 0.0, 0.0), x, None, settings)
    assert result.feasible.all()
    if not settings.multiplier_period:
        np.testing.assert_allclose(result.x, np.asarray(x) / np.linalg.norm(x, axis=0), atol=2e-5)


def test_box_cuts_the_step_and_the_others_take_over():
    # x + y = 1.5 in the box [-1, 1]^2 from the corner (1, -1): x is at its bound, so y alone moves.
    result = al.project(
        Rows(lambda v: (v[0] + v[1])[None], 1.5, 1.5, box=1.0), jnp.array([[1.0], [-1.0]]), None, SETTINGS
    )
    assert result.feasible.all()
    np.testing.assert_allclose(result.x[:, 0], [1.0, 0.5], atol=1e-4)


def test_what_the_box_forbids_is_reported():
    result = al.project(Rows(lambda v: (v[0] + v[1])[None], 2.5, 2.5, box=1.0), seeds(2, 8, 2, 1.0), None, SETTINGS)
    assert not result.feasible.any()
    np.testing.assert_allclose(result.violation, 0.5, atol=1e-3)
    assert (np.abs(result.x) <= 1.0).all()


@pytest.mark.parametrize("settings", [SETTINGS, WITH_MULTIPLIERS], ids=["plain", "multipliers"])
def test_interval_rows_leave_inner_points_alone(settings):
    x = jnp.array([[-2.0, -0.3, 0.0, 0.4, 3.0]])
    result = al.project(Rows(lambda v: v, -0.5, 0.5), x, None, settings)
    assert result.feasible.all()
    np.testing.assert_array_equal(result.x[0, 1:4], x[0, 1:4])
    if not settings.multiplier_period:
        np.testing.assert_allclose(result.x[0], [-0.5, -0.3, 0.0, 0.4, 0.5], atol=3e-5)
    np.testing.assert_array_equal(result.iterations[1:4], 0)


@pytest.mark.parametrize("settings", [SETTINGS, WITH_MULTIPLIERS], ids=["plain", "multipliers"])
def test_inequalities_beside_an_equality(settings):
    # On the unit circle with y >= 0.8: active for seeds on the right, inactive for seeds above.
    system = Rows(lambda v: jnp.array([v @ v - 1.0, 0.8 - v[1]]), [0.0, -np.inf], [0.0, 0.0])
    right, above = jnp.array([[1.5], [0.1]]), jnp.array([[0.3], [1.4]])
    on_edge = al.project(system, right, None, settings)
    assert on_edge.feasible.all()
    if not settings.multiplier_period:
        np.testing.assert_allclose(on_edge.x[:, 0], [0.6, 0.8], atol=1e-3)
    free = al.project(system, above, None, settings)
    assert free.feasible.all()
    np.testing.assert_allclose(free.x[:, 0], above[:, 0] / np.linalg.norm(above), atol=1e-4)


def test_multipliers_converge_with_inequalities_in_the_loop():
    # The lens of two discs and a half plane in five dimensions, from far away.
    rng = np.random.default_rng(3)
    a, b = np.zeros(5), np.r_[1.0, np.zeros(4)]

    def rows(v):
        return jnp.array([(v - a) @ (v - a) - 1.0, (v - b) @ (v - b) - 1.0, v[1] - 0.3, v[0] + v[2] - 0.6])

    system = Rows(rows, [-np.inf, -np.inf, 0.0, -np.inf], [0.0, 0.0, 0.0, 0.0])
    x = jnp.asarray(rng.uniform(-3, 3, size=(5, 128)), jnp.float32)
    result = al.project(system, x, None, WITH_MULTIPLIERS)
    assert result.feasible.mean() > 0.98
    inside = np.asarray(result.x)[:, np.asarray(result.feasible)]
    values = np.array([rows(column) for column in inside.T[:20]])
    assert (values[:, [0, 1, 3]] <= 2.6e-5).all() and (np.abs(values[:, 2]) <= 2.6e-5).all()


def test_redundant_rows_do_no_harm():
    def rows(v):
        once = v[0] - 2.0 * v[1] + v[2] - 0.7
        return jnp.stack([once, 2.0 * once, -once, v[1]])

    result = al.project(Rows(rows, np.zeros(4), np.zeros(4)), seeds(3, 32, 4), None, SETTINGS)
    assert result.feasible.all()
    assert np.abs(jax.vmap(rows, in_axes=-1)(result.x)).max() < 5e-5


@pytest.mark.parametrize("settings", [SETTINGS, WITH_MULTIPLIERS], ids=["plain", "multipliers"])
def test_contradictions_are_reported_and_end(settings):
    system = Rows(lambda v: jnp.array([v[0], v[0] - 1.0]), np.zeros(2), np.zeros(2))
    result = al.project(system, seeds(2, 8, 5), None, settings)
    assert not result.feasible.any()
    assert (result.violation > 0.4).all() and (result.iterations <= settings.max_iterations).all()


def test_violated_intervals_are_pulled_inside_by_the_aim():
    class Aimed(Rows):
        def rows(self, x, data):
            return super().rows(x, data)._replace(aim_low=jnp.full((1, 1), 0.2), aim_high=jnp.full((1, 1), 0.8))

    x = jnp.array([[-1.0, 0.1, 2.0]])
    result = al.project(Aimed(lambda v: v, 0.0, 1.0), x, None, replace(SETTINGS, damping=0.0, max_step=9.0))
    np.testing.assert_allclose(result.x[0], [0.2, 0.1, 0.8], atol=1e-4)


@pytest.mark.parametrize("m", range(1, 25))
def test_cholesky_agrees_with_numpy(m):
    rng = np.random.default_rng(m)
    root = rng.normal(size=(5, m, m))
    matrix = root @ np.swapaxes(root, 1, 2) + 0.5 * np.eye(m)
    right = rng.normal(size=(5, m))
    expected = np.linalg.solve(matrix, right[..., None])[..., 0].T
    arrays = jnp.asarray(np.moveaxis(matrix, 0, 2), jnp.float32), jnp.asarray(right.T, jnp.float32)
    ours = jax.jit(al.cholesky_solve, compiler_options={"xla_backend_optimization_level": 0})(*arrays)
    condition = np.linalg.cond(matrix).max()
    np.testing.assert_allclose(ours, expected, atol=2e-6 * condition * np.abs(expected).max())


# ---------------------------------------------------------------- the queue


def circle(v, radius):
    return (v @ v - radius * radius)[None]


class Shared(Rows):
    """Tasks are `(radius, shared)` with the shared part unused."""

    def rows(self, x, data):
        return super().rows(x, data[0])

    def room(self, x, data):
        return super().room(x, data[0])


def queue(lanes, count, x, radii):
    system = Shared(circle, 0.0, 0.0)
    run = jax.jit(lambda x, r, c: al.project_queue(system, x, r, None, c, lanes, SETTINGS))
    return jax.tree.map(np.asarray, run(x, radii, np.int32(count)))


@pytest.fixture(scope="module")
def tasks():
    x = np.array(seeds(2, 100, 6))
    x[:, 17] = np.nan
    x[:, 40] = 0.0  # no gradient: infeasible
    radii = jnp.asarray(np.random.default_rng(7).uniform(0.3, 1.5, 100), jnp.float32)
    return jnp.asarray(x), radii


@pytest.mark.parametrize("lanes", [1, 7, 64])
def test_the_queue_gives_what_one_call_gives(tasks, lanes):
    x, radii = tasks
    direct = al.project(Shared(circle, 0.0, 0.0), x, (radii, None), SETTINGS)
    queued = queue(lanes, 100, x, radii)
    np.testing.assert_array_equal(queued.feasible, direct.feasible)
    kept = queued.feasible
    assert kept.sum() == 98 and not kept[17] and not kept[40]
    np.testing.assert_allclose(queued.x[:, kept], np.asarray(direct.x)[:, kept], atol=1e-6)
    np.testing.assert_array_equal(queued.iterations[kept], np.asarray(direct.iterations)[kept])
    np.testing.assert_allclose(np.linalg.norm(queued.x[:, kept], axis=0), np.asarray(radii)[kept], atol=1e-4)


def test_the_queue_stops_at_its_count(tasks):
    x, radii = tasks
    whole, part = queue(8, 100, x, radii), queue(8, 33, x, radii)
    np.testing.assert_array_equal(part.feasible[:33], whole.feasible[:33])
    np.testing.assert_array_equal(part.x[:, :33], whole.x[:, :33])
    assert not part.feasible[33:].any()
    assert not queue(8, 0, x, radii).feasible.any()


def test_lanes_that_are_not_numbers_fail(tasks):
    system = Rows(lambda v: jnp.array([jnp.sqrt(v[0])]), 0.5, 0.5)
    result = al.project(system, jnp.array([[-1.0, 1.0, np.nan, np.inf]]), None, SETTINGS)
    np.testing.assert_array_equal(result.feasible, [False, True, False, False])
    assert not np.isfinite(np.asarray(result.violation)[[0, 2]]).any()


# ---------------------------------------------------------------- with a cost


def rosenbrock(v):
    return (1 - v[0]) ** 2 + 100 * (v[1] - v[0] ** 2) ** 2


def nearest_to(point):
    return lambda v: jnp.sum((v - jnp.asarray(point)) ** 2)


INF = np.inf
MINIMA = {
    # cost, rows, low, high, start, minimum, multipliers
    "point on a circle": (
        nearest_to([3.0, 4.0]),
        lambda v: (v @ v)[None],
        [1.0],
        [1.0],
        [0.4, -0.2],
        [0.6, 0.8],
        [4.0],
    ),
    "half space, active": (
        nearest_to([2.0, 2.0]),
        lambda v: v[:1] + v[1:],
        [-INF],
        [2.0],
        [0.0, -3.0],
        [1.0, 1.0],
        [2.0],
    ),
    "half space, idle": (nearest_to([0.5, 0.5]), lambda v: v[:1] + v[1:], [-INF], [2.0], [3.0, 3.0], [0.5, 0.5], [0.0]),
    "lower end of an interval": (
        nearest_to([-3.0, 1.0]),
        lambda v: v[:1],
        [-1.0],
        [1.0],
        [0.0, 0.0],
        [-1.0, 1.0],
        [-4.0],
    ),
    # min x'x + y'y with x + 2y = 5 and x - y = -1.
    "quadratic with equalities": (
        lambda v: v @ v,
        lambda v: jnp.stack([v[0] + 2 * v[1], v[0] - v[1]]),
        [5.0, -1.0],
        [5.0, -1.0],
        [0.0, 0.0],
        [1.0, 2.0],
        [-2.0, 0.0],
    ),
    # The known minimum of Rosenbrock's function on the disc of radius 1.
    "Rosenbrock on a disc": (
        rosenbrock,
        lambda v: (v @ v)[None],
        [-INF],
        [1.0],
        [-0.5, 0.2],
        [0.786415, 0.617698],
        None,
    ),
}


@pytest.mark.parametrize("name", MINIMA)
def test_minimum_under_constraints(name):
    cost, rows, low, high, start, expected, multipliers = MINIMA[name]
    low, high = jnp.asarray(low), jnp.asarray(high)
    # Lanes beside each other, one at the given start and one elsewhere.
    starts = jnp.asarray([start, np.array(start) + 0.1])
    result = jax.jit(jax.vmap(lambda x: al.minimise(lambda v: (cost(v), rows(v)), low, high, x)))(starts)
    assert result.feasible.all()
    np.testing.assert_allclose(result.x, np.tile(expected, (2, 1)), atol=1e-3)
    np.testing.assert_allclose(result.cost, cost(jnp.asarray(expected)), atol=2e-3)
    if multipliers is not None:
        np.testing.assert_allclose(result.multipliers, np.tile(multipliers, (2, 1)), atol=2e-2)


def test_minimum_under_contradictions_is_infeasible():
    result = al.minimise(
        lambda v: (v @ v, jnp.stack([v[0], v[0]])), jnp.array([0.0, 1.0]), jnp.array([0.0, 1.0]), jnp.zeros(1)
    )
    assert not result.feasible and result.violation > 0.4
    assert not al.minimise(
        lambda v: (jnp.sqrt(v[0]), v), jnp.array([-1.0]), jnp.array([-1.0]), jnp.ones(1)
    ).feasible
