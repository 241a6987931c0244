"""What several test files share: the scenes' problems, loaded once, and products of poses in double precision."""

import functools

import mujoco
import numpy as np

from cgs_jax import problems
from cgs_jax.kinematics import tool_poses_on_host

SCENES = ("pick_place", "handover", "banana")


@functools.cache
def problem(name, instance=0):
    return problems.load_problem(name, instance)


def matrices(vectors):
    """`(N, 4, 4)` of poses `(N, 7)`, by MuJoCo."""
    vectors = np.atleast_2d(np.asarray(vectors, dtype=float))
    result = np.tile(np.eye(4), (len(vectors), 1, 1))
    for i, vector in enumerate(vectors):
        flat = np.empty(9)
        mujoco.mju_quat2Mat(flat, vector[3:] / np.linalg.norm(vector[3:]))
        result[i, :3, :3], result[i, :3, 3] = flat.reshape(3, 3), vector[:3]
    return result


def product(at, terms, values, sites=None):
    """The value `(N, 4, 4)` of a product of poses; `sites` gives poses `(N, 7)` of touch sites by constraint."""
    result = np.eye(4)[None]
    for term in terms:
        if term.kind == "chain":
            rotation, position = tool_poses_on_host(
                at.exact.chains[term.name], np.asarray(values[term.variable], float)
            )
            factor = np.tile(np.eye(4), (len(rotation), 1, 1))
            factor[:, :3, :3], factor[:, :3, 3] = rotation, position
        else:
            source = {"pose": values, "constant": at.exact.constants, "site": sites or {}}[term.kind]
            factor = matrices(source[term.name])
        result = result @ (np.linalg.inv(factor) if term.inverted else factor)
    return result


def random_values(at, count, seed=0):
    """Any values of all variables, not feasible: configurations within the limits, poses within half a metre."""
    rng = np.random.default_rng(seed)
    values = {}
    for variable in at.graph.variables:
        if variable.kind == "configuration":
            values[variable.name] = rng.uniform(*at.params.limits[variable.name], size=(count, variable.dof))
        else:
            quat = rng.normal(size=(count, 4))
            quat /= np.linalg.norm(quat, axis=1, keepdims=True)
            values[variable.name] = np.concatenate([rng.uniform(-0.5, 0.5, size=(count, 3)), quat], axis=1)
    return values
