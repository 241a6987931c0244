"""Seeds: draws satisfy what they were drawn from, streams do not depend on the batch, every point stays possible."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loaded import problem

from cgs_jax import seeds
from cgs_jax.api import conditional
from cgs_jax.constraints import pose_rows, row_data
from cgs_jax.operators import operator_of
from cgs_jax.poses import Pose, compose, from_vector, inverse, rotation_exp

LANES = 256
IDENTITY = Pose(jnp.eye(3)[..., None], jnp.zeros((3, 1)))
WANTED = np.asarray(rotation_exp(jnp.array([0.3, -0.8, 1.2])))
AXES = [([0, 1, 0], [0, 1, 0], 0.0), ([0, 1, 0], [0, 0, 1], 0.0)]
ODD_AXES = [([1, 0, 0], [0, 1, 0], 0.0), ([1, 0, 0], [1, 0, 0], 0.0)]
FORMS = {
    "two_finger": dict(low=(0, 0, -0.05), high=(0, 0, 0.05), axes=AXES),
    "two_finger, other axes": dict(low=(0, -0.1, 0), high=(0, 0.1, 0), axes=ODD_AXES),
    "touch": {},
    "oriented": dict(low=(-1, 0, 0.3), high=(1, 2, 0.3), wanted=WANTED),
    "upright": dict(low=(-1, 0, 0.3), high=(1, 2, 0.3)),
    "located": dict(low=(-1, 0, 0.3), high=(1, 2, 0.3)),
}


def drawn(seed, site=IDENTITY):
    u = jax.random.uniform(jax.random.key(0), (7, LANES))
    return seeds.draw_pose(seed, site, u)


@pytest.mark.parametrize("case", FORMS)
def test_draws_satisfy_their_rows(case):
    form, numbers = case.split(",")[0], FORMS[case]
    site = from_vector(jnp.array([0.1, 0.2, 0.3, 0.5, -0.5, 0.5, 0.5])[:, None]) if form == "touch" else IDENTITY
    pose = drawn(seeds.pose_seed(form, **numbers), site)
    # A grasp constrains the gripper in the object's frame (or the site's), a placement the object in the world.
    measured = compose(inverse(site), inverse(pose)) if form in ("touch", "two_finger") else pose
    data = jax.tree.map(lambda a: jnp.asarray(a)[..., None], row_data(form, **numbers))
    value = np.asarray(pose_rows(measured, data).value)
    np.testing.assert_allclose(value - np.clip(value, data.low, data.high), 0, atol=2e-6)
    np.testing.assert_allclose(np.linalg.det(np.moveaxis(np.asarray(pose.rotation), 2, 0)), 1, atol=1e-5)


@pytest.mark.parametrize("case", ["two_finger", "upright", "located", "touch"])
def test_draws_use_all_the_freedom_left(case):
    pose = drawn(seeds.pose_seed(case, **FORMS[case]))
    measured = inverse(pose) if case in ("touch", "two_finger") else pose
    spread = np.ptp(np.asarray(measured.rotation), axis=2)
    free = {
        "two_finger": spread[:, [0, 2]].max(axis=0),
        "upright": spread[:2, :2],
        "located": spread,
        "touch": spread[:2, :2],
    }
    assert (free[case] > 1.8).all()


def test_any_rotation_is_uniform():
    rotation = np.asarray(drawn(seeds.pose_seed(None)).rotation)
    # Entries of a uniform rotation have mean 0 and variance 1/3.
    assert np.abs(rotation.mean(axis=2)).max() < 5 * np.sqrt(1 / 3 / LANES)
    assert np.abs(rotation.var(axis=2) - 1 / 3).max() < 0.1


def test_streams_do_not_depend_on_the_batch():
    key = jax.random.key(3)
    whole = seeds.uniforms(key, jnp.arange(40, dtype=jnp.uint32), 5)
    part = seeds.uniforms(key, jnp.arange(17, 30, dtype=jnp.uint32), 5)
    np.testing.assert_array_equal(whole[:, 17:30], part)
    assert len(np.unique(np.asarray(whole))) == 200


@pytest.fixture(scope="module")
def start():
    """Starts of q1 given t, with a table whose entries are all the same configuration."""
    at = problem("pick_place")
    operator = operator_of(at, conditional(at, ("t",), ("q1",)))
    layout, numbers = operator.plan.layout, jax.tree.map(jnp.asarray, operator.numbers(at.params))
    entry = numbers.tables.configurations[:, :, :1]
    tables = numbers.tables._replace(configurations=jnp.broadcast_to(entry, numbers.tables.configurations.shape))
    lanes = 4096
    u = seeds.uniforms(jax.random.key(1), jnp.arange(lanes, dtype=jnp.uint32), seeds.count_draws(layout))
    given = Pose(
        jnp.broadcast_to(jnp.eye(3)[None, ..., None], (layout.given, 3, 3, lanes)), jnp.zeros((layout.given, 3, lanes))
    )
    draw = jax.jit(lambda u: seeds.draw(layout, given, (), tables, numbers.seeds, numbers.choices, numbers.shared, u))
    point, tasks = draw(u)
    low, high = (np.asarray(limit)[0] for limit in (numbers.tables.low, numbers.tables.high))
    return np.asarray(point.configurations[0]), np.asarray(entry[0]), low, high, tasks


def test_a_share_of_the_lanes_starts_anywhere(start):
    q, entry, low, high, _ = start
    distance = np.abs(q - entry) / (high - low)[:, None]
    near = (distance <= seeds.JITTER + seeds.LIMIT_SLACK).all(axis=0)
    share = 1.0 - near.mean()
    # A start anywhere is near by chance with probability below (2 * 0.14)^7.
    assert abs(share - seeds.ANYWHERE) < 4 * np.sqrt(seeds.ANYWHERE * (1 - seeds.ANYWHERE) / q.shape[1])
    anywhere = (q[:, ~near] - low[:, None]) / (high - low)[:, None]
    cells = np.floor(anywhere * 8).astype(int).clip(0, 7)
    assert all(set(row) == set(range(8)) for row in cells), "a part of a joint's range that no lane starts in"


def test_starts_keep_to_limits_that_differ_from_lane_to_lane(start):
    q, _, low, high, tasks = start
    lower, upper = np.asarray(tasks.low[0]), np.asarray(tasks.high[0])
    assert (q >= lower).all() and (q <= upper).all()
    assert (lower >= low[:, None]).all() and (upper <= high[:, None]).all()
    assert ((upper - lower) > 0.9 * (high - low)[:, None]).all()
    assert len(np.unique(lower[0])) > 0.9 * q.shape[1]
