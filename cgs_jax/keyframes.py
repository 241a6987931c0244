"""From variables to MuJoCo: the full configuration of the scene at each mode switch, in double precision."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cgs_jax.constraints import Product
from cgs_jax.kinematics import tool_poses_on_host
from cgs_jax.problems import Problem


class Keyframes:
    """Assembles `qpos` for one problem; holds no state between calls, so threads may share it."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        scene = problem.scene
        model, task = scene.model, scene.task
        self._home = scene.home_qpos
        self._switches = [switch.name for switch in task.switches]
        self._configurations: list[list[tuple[str, np.ndarray]]] = []
        self._poses: list[list[tuple[Product, int]]] = []
        for switch in task.switches:
            addresses = []
            for name, variable in switch.configurations.items():
                joints = task.robot(name).joints
                addresses.append((variable, np.array([model.jnt_qposadr[model.joint(j).id] for j in joints])))
            self._configurations.append(addresses)
            poses = [(problem.object_poses[o.name, switch.name], self._address(o.body)) for o in task.objects]
            for robot in task.robots:
                if robot.base is not None:
                    poses.append((problem.base_poses[robot.name, switch.name], self._address(robot.base)))
            self._poses.append(poses)

    def _address(self, body: str) -> int:
        model = self._problem.scene.model
        return int(model.jnt_qposadr[model.body_jntadr[model.body(body).id]])

    def qpos(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """`(N, K, nq)` float64 from all variables `(N, dim)`: joints, objects and floating bases at each mode switch."""
        values = {name: np.asarray(value, dtype=np.float64) for name, value in values.items()}
        count = len(next(iter(values.values())))
        result = np.tile(self._home, (count, len(self._switches), 1))
        known: dict[Product, np.ndarray] = {}  # an object rests at several switches
        for k in range(len(self._switches)):
            for variable, addresses in self._configurations[k]:
                result[:, k, addresses] = values[variable]
            for product, address in self._poses[k]:
                if product not in known:
                    known[product] = self._pose(product, values)
                result[:, k, address : address + 7] = known[product]
        return result

    def _pose(self, product: Product, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Value of a product, `(N, 7)` or `(7,)`."""
        if len(product) == 1 and product[0].kind in ("constant", "pose") and not product[0].inverted:
            name = product[0].name
            vector = self._problem.exact.constants[name] if product[0].kind == "constant" else values[name]
            return np.concatenate([vector[..., :3], _unit(vector[..., 3:])], axis=-1)
        # The batch last, so that products run along whole rows.
        rotation, position = np.eye(3)[..., None], np.zeros((3, 1))
        for term in product:
            if term.kind == "chain":
                assert term.variable is not None
                turns, moves = tool_poses_on_host(self._problem.exact.chains[term.name], values[term.variable])
                turn, move = np.moveaxis(turns, 0, 2), moves.T
            else:
                vector = self._problem.exact.constants[term.name] if term.kind == "constant" else values[term.name]
                vector = np.atleast_2d(vector)
                turn, move = _rotation(_unit(vector[:, 3:])), vector[:, :3].T
            if term.inverted:
                turn = np.swapaxes(turn, 0, 1)
                move = -np.einsum("ijb,jb->ib", turn, move)
            position = position + np.einsum("ijb,jb->ib", rotation, move)
            rotation = np.einsum("ijb,jkb->ikb", rotation, turn)
        return np.concatenate([position.T, _quaternion(rotation)], axis=1)


def _unit(quat: np.ndarray) -> np.ndarray:
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def _rotation(quat: np.ndarray) -> np.ndarray:
    """Rotations `(3, 3, N)` of unit quaternions `(N, 4)`."""
    w, x, y, z = quat.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows)


def _quaternion(r: np.ndarray) -> np.ndarray:
    """Unit quaternions `(N, 4)` of `(3, 3, N)`: the best conditioned row of `4 q q^T`."""
    rows = np.array(
        [
            [1 + r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], 1 + r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1 - r[0, 0] + r[1, 1] - r[2, 2], r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - r[0, 0] - r[1, 1] + r[2, 2]],
        ]
    )
    best = np.argmax(rows[np.arange(4), np.arange(4)], axis=0)
    return _unit(rows[best, :, np.arange(rows.shape[2])])
