"""Forward kinematics of serial chains, batched over lanes, with the geometric Jacobian.

A chain is read once from a compiled MuJoCo model into plain arrays (host half, numpy, float64) and evaluated by pure
functions (device half, JAX). The joints run in a `fori_loop`: XLA's CPU fusion otherwise recomputes the chain for every
consumer, and the loop also compiles about three times faster than the unrolled chain.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax

from cgs_jax.errors import InputError
from cgs_jax.poses import Array, Pose, compose, cross, matmul, matvec


class Chain(NamedTuple):
    """A serial chain of n hinge or slide joints, from a root frame to a tool frame.

    Joint frames have their z axis along the joint axis and their origin at the joint's anchor. Entry i of `rotation` and
    `offset` is the constant transform from joint frame i-1 (the root for i = 0) to joint frame i at the reference angle.
    """

    rotation: Array  # (n, 3, 3)
    offset: Array  # (n, 3) m
    hinge: Array  # (n,) 1 for a hinge, else 0
    slide: Array  # (n,) 1 for a slide, else 0
    reference: Array  # (n,) joint coordinate at which the constant transforms hold, rad or m
    tool_rotation: Array  # (3, 3) last joint frame to tool
    tool_offset: Array  # (3,) m


class JointFrames(NamedTuple):
    """Frames of the joints of a chain after their own motion, in the root frame, lanes last."""

    rotation: jax.Array  # (n, 3, 3, *lanes)
    position: jax.Array  # (n, 3, *lanes)


# ------------------------------------------------------------------ host: reading chains from a model


def _axis_frame(axis: np.ndarray) -> np.ndarray:
    """A rotation whose z axis is `axis` (unit)."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def _relative(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return a[0].T @ b[0], a[0].T @ (b[1] - a[1])


class ChainReader:
    """Reads the chains of one robot from a model whose other joints stand at a home configuration.

    The root frame is the world for a robot with a fixed base and the base body's frame for a floating one.
    """

    def __init__(
        self, model: mujoco.MjModel, joints: Sequence[str], home: np.ndarray, base: str | None = None, name: str = "robot"
    ) -> None:
        """`joints` in order from the base; `home` (nq,). Raises InputError unless the joints form one serial chain."""
        self._ids = [model.joint(joint).id for joint in joints]
        self.qpos_addresses = np.array([model.jnt_qposadr[i] for i in self._ids])
        kinds = [mujoco.mjtJoint(int(model.jnt_type[i])) for i in self._ids]
        for joint, kind in zip(joints, kinds, strict=True):
            if kind not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
                raise InputError(
                    f"joint '{joint}' of robot '{name}' is a {kind.name[6:].lower()} joint; expected a hinge or a slide"
                )
        self._model = model
        self._hinge = np.array([kind == mujoco.mjtJoint.mjJNT_HINGE for kind in kinds], dtype=float)
        self._reference = model.qpos0[self.qpos_addresses].copy()
        self._bodies = [int(model.jnt_bodyid[i]) for i in self._ids]
        for i, (joint, above) in enumerate(zip(joints[1:], joints[:-1], strict=True)):
            if self._bodies[i] not in self._ancestors(self._bodies[i + 1]):
                raise InputError(f"joint '{joint}' of robot '{name}' is not below '{above}'; expected one serial chain")
        qpos = home.copy()
        qpos[self.qpos_addresses] = self._reference
        self._data = mujoco.MjData(model)
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(model, self._data)
        self._root = (np.eye(3), np.zeros(3))
        if base is not None:
            body = model.body(base).id
            self._root = (self._data.xmat[body].reshape(3, 3).copy(), self._data.xpos[body].copy())
        self._base_body = None if base is None else model.body(base).id
        self._frames = [
            (_axis_frame(self._data.xaxis[i].copy()), self._data.xanchor[i].copy()) for i in self._ids
        ]

    def _ancestors(self, body: int) -> list[int]:
        found = [body]
        while found[-1] != 0:
            found.append(int(self._model.body_parentid[found[-1]]))
        return found

    def link_of_body(self, body: int) -> int | None:
        """Number of this robot's joints above a body, or None where the body does not belong to the robot.

        With a fixed base, bodies before the first joint are fixed to the world and belong to no robot.
        """
        above = self._ancestors(body)
        moving = [i for i, joint_body in enumerate(self._bodies) if joint_body in above]
        if moving:
            return moving[-1] + 1
        if self._base_body is not None and self._base_body in above:
            return 0
        return None

    def chain(self, site: str) -> Chain:
        """The chain from the root to a site: its joints are those above the site (none for a site on the base)."""
        index = self._model.site(site).id
        link = self.link_of_body(int(self._model.site_bodyid[index])) or 0
        tool = (self._data.site_xmat[index].reshape(3, 3).copy(), self._data.site_xpos[index].copy())
        frames = [self._root, *self._frames[:link]]
        steps = [_relative(a, b) for a, b in zip(frames[:-1], frames[1:], strict=True)]
        tool_step = _relative(frames[-1], tool)
        return Chain(
            rotation=np.array([r for r, _ in steps]).reshape(link, 3, 3),
            offset=np.array([p for _, p in steps]).reshape(link, 3),
            hinge=self._hinge[:link],
            slide=1.0 - self._hinge[:link],
            reference=self._reference[:link],
            tool_rotation=tool_step[0],
            tool_offset=tool_step[1],
        )

    @property
    def links(self) -> Chain:
        """The chain of all joints, with the last joint's frame as its tool."""
        frames = [self._root, *self._frames]
        steps = [_relative(a, b) for a, b in zip(frames[:-1], frames[1:], strict=True)]
        return Chain(
            rotation=np.array([r for r, _ in steps]),
            offset=np.array([p for _, p in steps]),
            hinge=self._hinge,
            slide=1.0 - self._hinge,
            reference=self._reference,
            tool_rotation=np.eye(3),
            tool_offset=np.zeros(3),
        )

    def in_link(self, link: int, rotation: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A world pose at the reference configuration, expressed in the joint frame `link` (0: the root)."""
        return _relative([self._root, *self._frames][link], (rotation, position))

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's state at the reference configuration."""
        return self._data


def tool_poses_on_host(chain: Chain, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tools in the root frame in numpy and the precision of the input: q `(lanes, n)` -> `(lanes, 3, 3)`, `(lanes, 3)`."""
    joints = chain.offset.shape[0]
    move = q[:, :joints].T - np.asarray(chain.reference)[:, None]
    kind = np.result_type(move, np.float32)
    # Lanes last, as on the device: products of whole rows.
    rotation = np.zeros((3, 3, len(q)), kind)
    rotation[[0, 1, 2], [0, 1, 2]] = 1.0
    position = np.zeros((3, len(q)), kind)
    for i in range(joints):
        position, rotation = _moved(rotation, position, chain.rotation[i], chain.offset[i])
        c, s = np.cos(move[i] * chain.hinge[i]), np.sin(move[i] * chain.hinge[i])
        position = position + rotation[:, 2] * (move[i] * chain.slide[i])
        x, y = rotation[:, 0], rotation[:, 1]
        rotation = np.stack([x * c + y * s, y * c - x * s, rotation[:, 2]], axis=1)
    position, rotation = _moved(rotation, position, chain.tool_rotation, chain.tool_offset)
    return np.moveaxis(rotation, 2, 0), position.T


def _moved(
    rotation: np.ndarray, position: np.ndarray, by_rotation: Array, by_offset: Array
) -> tuple[np.ndarray, np.ndarray]:
    """Position and rotation of frames `(3, 3, lanes)`, `(3, lanes)` after a constant transform in them."""
    turn, offset = np.asarray(by_rotation, rotation.dtype), np.asarray(by_offset, rotation.dtype)
    return position + np.einsum("ij...,j->i...", rotation, offset), np.matmul(turn.T, rotation)


# ------------------------------------------------------------------ device: evaluating them


def _with_lanes(array: Array, core: int, lanes: int) -> jax.Array:
    """Appends axes of length one until `core` axes are followed by `lanes` axes."""
    array = jnp.asarray(array)
    return array.reshape(array.shape + (1,) * (core + lanes - array.ndim))


def joint_frames(chain: Chain, q: Array) -> JointFrames:
    """Frames of all joints in the root frame.

    `q` is `(n, *lanes)` in rad (hinges) or m (slides). Each frame is the joint's own after its motion: z is the joint axis.
    The chain's arrays may carry lane axes of their own after those stated (several chains beside each other).
    """
    n, lanes = q.shape[0], q.shape[1:]
    axes = len(lanes)
    if not n:
        return JointFrames(jnp.zeros((0, 3, 3, *lanes)), jnp.zeros((0, 3, *lanes)))
    move = jnp.asarray(q) - _with_lanes(chain.reference, 1, axes)
    angle = move * _with_lanes(chain.hinge, 1, axes)
    shift = move * _with_lanes(chain.slide, 1, axes)
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    rotations, offsets = _with_lanes(chain.rotation, 3, axes), _with_lanes(chain.offset, 2, axes)
    start = (
        jnp.broadcast_to(_with_lanes(jnp.eye(3, dtype=move.dtype), 2, axes), (3, 3, *lanes)),
        jnp.zeros((3, *lanes), move.dtype),
        jnp.zeros((n, 3, 3, *lanes), move.dtype),
        jnp.zeros((n, 3, *lanes), move.dtype),
    )

    def advance(i: jax.Array, state: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        rotation, position, all_rotations, all_positions = state
        position = position + matvec(rotation, offsets[i])
        fixed = matmul(rotation, rotations[i])
        c, s = cosine[i], sine[i]
        rotation = jnp.stack([fixed[:, 0] * c + fixed[:, 1] * s, fixed[:, 1] * c - fixed[:, 0] * s, fixed[:, 2]], axis=1)
        position = position + fixed[:, 2] * shift[i]
        return (
            rotation,
            position,
            lax.dynamic_update_index_in_dim(all_rotations, rotation, i, 0),
            lax.dynamic_update_index_in_dim(all_positions, position, i, 0),
        )

    _, _, all_rotations, all_positions = lax.fori_loop(0, n, advance, start)
    return JointFrames(all_rotations, all_positions)


def tool_pose(chain: Chain, frames: JointFrames) -> Pose:
    """Pose of the tool in the root frame, lanes last; `frames` as `joint_frames` gives them."""
    axes = frames.position.ndim - 2
    tool = Pose(_with_lanes(chain.tool_rotation, 2, axes), _with_lanes(chain.tool_offset, 1, axes))
    if frames.position.shape[0] == 0:
        return tool
    return compose(Pose(frames.rotation[-1], frames.position[-1]), tool)


def tool_jacobian(chain: Chain, frames: JointFrames, tool: Pose) -> jax.Array:
    """Geometric Jacobian `(6, n, *lanes)`: rows 0-2 the velocity of the tool's origin, rows 3-5 its angular velocity.

    Column i is `[z_i x (p - o_i); z_i]` for a hinge, `[z_i; 0]` for a slide, in the root frame.
    """
    axes = frames.position.ndim - 2
    axis = jnp.swapaxes(frames.rotation[:, :, 2], 0, 1)  # (3, n, *lanes)
    lever = tool.position[:, None] - jnp.swapaxes(frames.position, 0, 1)
    hinge, slide = _with_lanes(chain.hinge, 1, axes), _with_lanes(chain.slide, 1, axes)
    return jnp.concatenate([cross(axis, lever) * hinge + axis * slide, axis * hinge])


def padded(chain: Chain, joints: int) -> Chain:
    """The same chain with joints that do not move appended, so that chains of different lengths can be stacked."""
    more = joints - chain.offset.shape[0]
    if not more:
        return chain
    module = np if isinstance(chain.rotation, np.ndarray) else jnp
    still = (np.tile(np.eye(3, dtype=np.float32), (more, 1, 1)), *(np.zeros(s, np.float32) for s in ((more, 3), more)))
    return chain._replace(
        rotation=module.concatenate([chain.rotation, still[0]]),
        offset=module.concatenate([chain.offset, still[1]]),
        hinge=module.concatenate([chain.hinge, still[2]]),
        slide=module.concatenate([chain.slide, still[2]]),
        reference=module.concatenate([chain.reference, still[2]]),
    )
