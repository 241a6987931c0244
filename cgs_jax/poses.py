"""Rigid poses over a batch of lanes.

Layout: the component axes come first, the lanes last. A rotation is `(3, 3, *lanes)`, a position `(3, *lanes)`; an axis of
length one broadcasts, so a constant pose is `(3, 3, 1)` and `(3, 1)`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array | np.ndarray


class Pose(NamedTuple):
    """A rigid transform `T_a_b`: maps coordinates in b to coordinates in a."""

    rotation: Array  # (3, 3, *lanes)
    position: Array  # (3, *lanes)


def matvec(rotation: Array, vector: Array) -> jax.Array:
    """`rotation @ vector` per lane; `(3, 3, *lanes)`, `(3, *any, *lanes)` with matching rank after the first axis."""
    return rotation[:, 0] * vector[0] + rotation[:, 1] * vector[1] + rotation[:, 2] * vector[2]


def matmul(a: Array, b: Array) -> jax.Array:
    """`a @ b` per lane, both `(3, 3, *lanes)`."""
    return a[:, 0, None] * b[None, 0] + a[:, 1, None] * b[None, 1] + a[:, 2, None] * b[None, 2]


def transpose(rotation: Array) -> jax.Array:
    """The inverse rotation, `(3, 3, *lanes)`."""
    return jnp.swapaxes(jnp.asarray(rotation), 0, 1)


def cross(a: Array, b: Array) -> jax.Array:
    """`a x b` along the first axis, which has length 3; the others broadcast."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def compose(a: Pose, b: Pose) -> Pose:
    """`T_a_c` from `T_a_b` and `T_b_c`."""
    return Pose(matmul(a.rotation, b.rotation), a.position + matvec(a.rotation, b.position))


def inverse(a: Pose) -> Pose:
    """`T_b_a` from `T_a_b`."""
    back = transpose(a.rotation)
    return Pose(back, -matvec(back, a.position))


def retract(pose: Pose, step: Array) -> Pose:
    """Moves a pose by `step` `(6, *lanes)`: its origin by rows 0-2, its axes by the rotation vector of rows 3-5."""
    return Pose(matmul(rotation_exp(step[3:]), pose.rotation), pose.position + step[:3])


def rotation_exp(vector: Array) -> jax.Array:
    """Rotation `(3, 3, *lanes)` of a rotation vector `(3, *lanes)` in rad (Rodrigues); safe at zero."""
    square = jnp.sum(vector * vector, axis=0)
    tiny = square < 1e-8
    angle = jnp.sqrt(jnp.where(tiny, 1.0, square))
    a = jnp.where(tiny, 1.0 - square / 6.0, jnp.sin(angle) / angle)
    b = jnp.where(tiny, 0.5 - square / 24.0, (1.0 - jnp.cos(angle)) / (angle * angle))
    x, y, z = vector
    return jnp.stack(
        [
            jnp.stack([1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y]),
            jnp.stack([b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x]),
            jnp.stack([b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)]),
        ]
    )


def rotation_log(rotation: Array) -> jax.Array:
    """Rotation vector `(3, *lanes)` in rad of a rotation `(3, 3, *lanes)`.

    Finite everywhere. At an exact half turn the axis cannot be read off the skew part: x is returned, so that a half turn
    is never mistaken for no turn.
    """
    vee = 0.5 * jnp.stack(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    cosine = 0.5 * (rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - 1.0)
    square = jnp.sum(vee * vee, axis=0)
    tiny = square < 1e-16
    sine = jnp.sqrt(jnp.where(tiny, 1.0, square))
    vector = vee * jnp.where(tiny, 1.0, jnp.arctan2(sine, cosine) / sine)
    half_turn = jnp.stack([jnp.full_like(sine, jnp.pi), jnp.zeros_like(sine), jnp.zeros_like(sine)])
    return jnp.where(tiny & (cosine < 0), half_turn, vector)


def from_quaternion(quat: Array) -> jax.Array:
    """Rotation `(3, 3, *lanes)` of a unit quaternion `(4, *lanes)` as w, x, y, z."""
    w, x, y, z = quat
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def to_quaternion(rotation: Array) -> jax.Array:
    """Unit quaternion `(4, *lanes)` as w, x, y, z of a rotation `(3, 3, *lanes)`.

    The row of `4 q q^T` with the largest diagonal is scaled to length one: no branch loses accuracy near a half turn.
    """
    r = rotation
    rows = jnp.stack(
        [
            jnp.stack([1 + r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]),
            jnp.stack([r[2, 1] - r[1, 2], 1 + r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]]),
            jnp.stack([r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1 - r[0, 0] + r[1, 1] - r[2, 2], r[1, 2] + r[2, 1]]),
            jnp.stack([r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - r[0, 0] - r[1, 1] + r[2, 2]]),
        ]
    )
    diagonal = jnp.stack([rows[i, i] for i in range(4)])
    best = jnp.argmax(diagonal, axis=0)
    row = jnp.take_along_axis(rows, best[None, None], axis=0)[0]
    row = row / jnp.sqrt(jnp.sum(row * row, axis=0))
    return jnp.where(row[:1] < 0, -row, row)


def from_vector(pose: Array) -> Pose:
    """A pose of `(7, *lanes)` as `[x y z qw qx qy qz]`."""
    return Pose(from_quaternion(pose[3:]), jnp.asarray(pose[:3]))


def to_vector(pose: Pose) -> jax.Array:
    """`(7, *lanes)` as `[x y z qw qx qy qz]`."""
    return jnp.concatenate([pose.position, to_quaternion(pose.rotation)])
