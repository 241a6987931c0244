"""Poses against jaxlie, in the plain and in the awkward places: no turn, nearly none, nearly a half turn, a half turn."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from cgs_jax import poses
from cgs_jax.poses import Pose

ANGLES = [0.0, 1e-9, 1e-6, 1e-4, 1.1e-4, 1e-2, 0.5, 1.5, 3.0, np.pi - 1e-2, np.pi - 1e-3]


def random_vectors(count, seed=0):
    """`(7, count)` poses with any rotation."""
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(4, count))
    return np.concatenate([rng.normal(size=(3, count)), quat / np.linalg.norm(quat, axis=0)]).astype(np.float32)


def as_jaxlie(vectors):
    return jaxlie.SE3(jnp.concatenate([vectors[3:], vectors[:3]]).T)


def matrices(pose):
    """`(lanes, 4, 4)`."""
    lanes = pose.position.shape[-1]
    result = np.tile(np.eye(4), (lanes, 1, 1))
    result[:, :3, :3] = np.moveaxis(np.asarray(pose.rotation), 2, 0)
    result[:, :3, 3] = np.asarray(pose.position).T
    return result


def axes(count=20):
    drawn = np.random.default_rng(3).normal(size=(3, count))
    drawn = np.concatenate([drawn, np.eye(3), -np.eye(3)], axis=1)
    return drawn / np.linalg.norm(drawn, axis=0)


def test_compose_and_inverse_agree_with_jaxlie():
    a, b = random_vectors(50, 1), random_vectors(50, 2)
    ours = poses.compose(poses.from_vector(a), poses.inverse(poses.from_vector(b)))
    theirs = as_jaxlie(a) @ as_jaxlie(b).inverse()
    np.testing.assert_allclose(matrices(ours), theirs.as_matrix(), atol=2e-6)


def test_constant_pose_broadcasts_over_lanes():
    a, b = random_vectors(1, 1), random_vectors(7, 2)
    ours = poses.compose(poses.from_vector(a), poses.from_vector(b))
    np.testing.assert_allclose(matrices(ours), (as_jaxlie(a) @ as_jaxlie(b)).as_matrix(), atol=2e-6)


def test_vectors_survive_the_way_to_matrices_and_back():
    vectors = random_vectors(200, 4)
    back = np.asarray(poses.to_vector(poses.from_vector(vectors)))
    sign = np.where(vectors[3] < 0, -1.0, 1.0)
    np.testing.assert_allclose(back[:3], vectors[:3])
    np.testing.assert_allclose(back[3:], vectors[3:] * sign, atol=1e-6)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, -1, 1]])
def test_quaternion_of_a_half_turn_keeps_its_accuracy(axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    quat = np.array([0.0, *axis])[:, None]
    back = np.asarray(poses.to_quaternion(poses.from_quaternion(quat)))[:, 0]
    assert min(np.abs(back - quat[:, 0]).max(), np.abs(back + quat[:, 0]).max()) < 1e-6


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_and_logarithm_agree_with_jaxlie(angle):
    vectors = angle * axes()
    with jax.enable_x64(True):
        ours = np.asarray(poses.rotation_exp(jnp.asarray(vectors)))
        theirs = np.asarray(jax.vmap(jaxlie.SO3.exp)(jnp.asarray(vectors.T)).as_matrix())
        np.testing.assert_allclose(np.moveaxis(ours, 2, 0), theirs, atol=1e-11)
        np.testing.assert_allclose(np.asarray(poses.rotation_log(jnp.asarray(ours))), vectors, atol=1e-10)
    single = np.asarray(poses.rotation_exp(vectors.astype(np.float32)))
    assert single.dtype == np.float32
    np.testing.assert_allclose(np.moveaxis(single, 2, 0), theirs, atol=6e-7)
    # Single precision reads the axis off the skew part, whose size is the sine.
    accuracy = 1e-6 if angle < 2 else 1e-6 / np.sin(angle)
    np.testing.assert_allclose(np.asarray(poses.rotation_log(single)), vectors, atol=accuracy)


def test_logarithm_of_a_half_turn_is_a_half_turn():
    rotation = np.stack([np.diag(d) for d in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1])], axis=2).astype(np.float32)
    size = np.linalg.norm(np.asarray(poses.rotation_log(rotation)), axis=0)
    np.testing.assert_allclose(size, np.pi, atol=1e-6)


def test_logarithm_has_finite_derivatives_everywhere():
    turned = [poses.rotation_exp(jnp.asarray(a * axes(2), jnp.float32)) for a in [*ANGLES, np.pi]]
    slope = jax.jit(jax.grad(lambda r: jnp.sum(poses.rotation_log(r))))
    for rotation in turned:
        gradient = slope(rotation)
        assert np.isfinite(np.asarray(gradient)).all()
    gradient = jax.jacfwd(poses.rotation_exp)(jnp.zeros(3))
    np.testing.assert_allclose(np.asarray(gradient)[2, 1], [1, 0, 0], atol=1e-7)


def test_retraction_moves_the_origin_and_turns_about_it():
    vectors = random_vectors(30, 5)
    step = np.random.default_rng(6).normal(size=(6, 30)).astype(np.float32)
    moved = poses.retract(poses.from_vector(vectors), step)
    turn = jax.vmap(jaxlie.SO3.exp)(jnp.asarray(step[3:].T)) @ as_jaxlie(vectors).rotation()
    np.testing.assert_allclose(matrices(moved)[:, :3, :3], turn.as_matrix(), atol=2e-6)
    np.testing.assert_allclose(np.asarray(moved.position), vectors[:3] + step[:3], atol=1e-6)


def test_products_take_any_lane_axes():
    rng = np.random.default_rng(7)
    rotation, vector = rng.normal(size=(3, 3, 4, 5)), rng.normal(size=(3, 4, 5))
    np.testing.assert_allclose(
        poses.matvec(rotation, vector), np.einsum("ij...,j...->i...", rotation, vector), atol=1e-5
    )
    np.testing.assert_allclose(
        poses.matmul(rotation, rotation), np.einsum("ij...,jk...->ik...", rotation, rotation), atol=1e-5
    )
    np.testing.assert_allclose(poses.cross(vector, rotation[0]), np.cross(vector, rotation[0], axis=0), atol=1e-5)
    identity = poses.compose(Pose(rotation, vector), Pose(np.eye(3)[..., None, None], np.zeros((3, 1, 1))))
    np.testing.assert_allclose(identity.position, vector)
