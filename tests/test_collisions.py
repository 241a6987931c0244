"""Clearances against C MuJoCo: every live pair of every switch, measured once, by the right constraint."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from loaded import SCENES, problem, product, random_values

from cgs_jax.collisions import FAR, Pairs, place_object, place_robot, smallest_distance
from cgs_jax.keyframes import Keyframes
from cgs_jax.poses import Pose

LANES = 12
SHALLOW = 1e-3
CASES = [(name, instance) for name in SCENES for instance in (0, 3)]


@jax.jit
def measure(placed, pairs):
    """Distance of each pair, by kind, `(pairs, lanes)`, and the smallest of all."""
    none = jnp.zeros((2, 0), jnp.int32)

    def alone(kind, pair):
        return smallest_distance(placed, Pairs(none, none, none)._replace(**{kind: pair[:, None]}))

    single = {k: jax.vmap(functools.partial(alone, k))(p.T) for k, p in pairs._asdict().items() if p.shape[1]}
    return single, smallest_distance(placed, pairs)


@functools.cache
def measured(name, instance):
    """Per constraint: distances of its pairs by kind, and the smallest, by the code under test."""
    at = problem(name, instance)
    values = random_values(at, LANES)
    result = {}
    for constraint, clearance in at.clearances.items():
        data = at.params.clearances[constraint]
        placed, robots = [], 0
        for body, shapes in zip(clearance.bodies, data.shapes, strict=True):
            pose = None
            if body.pose:
                matrix = product(at, body.pose, values)
                rotation = np.moveaxis(matrix[:, :3, :3], 0, 2).astype(np.float32)
                pose = Pose(jnp.asarray(rotation), jnp.asarray(matrix[:, :3, 3].T, jnp.float32))
            if body.kind == "robot":
                q = jnp.asarray(values[body.variable].T, jnp.float32)
                placed.append(jax.jit(place_robot)(shapes, data.chains[robots], q, pose))
                robots += 1
            else:
                placed.append(jax.jit(place_object)(shapes, pose))
        result[constraint] = jax.tree.map(np.asarray, measure(placed, jax.tree.map(jnp.asarray, data.pairs)))
    return result


@functools.cache
def truth(name, instance):
    """(switch, geoms) to the kind and the distances over the lanes, by MuJoCo, of the pairs of which one geom moves."""
    at = problem(name, instance)
    model, scene = at.scene.model, at.scene
    qpos = Keyframes(at).qpos(random_values(at, LANES))
    data, box = mujoco.MjData(model), mujoco.mjtGeom.mjGEOM_BOX
    result = {}
    for k, switch in enumerate(scene.task.switches):
        live = scene.collision_pairs()
        distances, places = np.empty((len(live), LANES)), []
        for lane in range(LANES):
            data.qpos[:] = qpos[lane, k]
            mujoco.mj_kinematics(model, data)
            places.append(np.concatenate([data.geom_xpos, data.geom_xmat], axis=1))
            for i, (a, b) in enumerate(live):
                distances[i, lane] = mujoco.mj_geomDistance(model, data, a, b, 20.0, None)
        moves = np.ptp(np.array(places), axis=0).max(axis=1) > 1e-9
        for i, (a, b) in enumerate(live):
            boxes = int(model.geom_type[a] == box) + int(model.geom_type[b] == box)
            kind = ("capsule_capsule", "capsule_box", "box_box")[boxes]
            if moves[a] or moves[b]:
                result[switch.name, a, b] = kind, distances[i]
    return result


@pytest.mark.parametrize(("name", "instance"), CASES)
def test_smallest_distance_agrees_with_mujoco(name, instance):
    ours = np.min([smallest for _, smallest in measured(name, instance).values()], axis=0)
    theirs = np.min([distances for _, distances in truth(name, instance).values()], axis=0)
    clear = np.abs(theirs) > 1e-6
    np.testing.assert_array_equal(np.sign(ours)[clear], np.sign(theirs)[clear])


def signature(kind, distances):
    """What two measurements of one pair share: the distance where it is exact, else only whether it is positive."""
    if kind == "box_box":
        return np.sign(distances)
    return np.maximum(distances, -SHALLOW)


@pytest.mark.parametrize(("name", "instance"), CASES)
@pytest.mark.parametrize("kind", ["capsule_capsule", "capsule_box"])
def test_every_live_pair_is_measured_once(name, instance, kind):
    ours = np.array([signature(kind, row) for single, _ in measured(name, instance).values() for row in single.get(kind, [])])
    wanted = [signature(kind, d) for k, d in truth(name, instance).values() if k == kind]
    theirs = np.array(wanted)
    assert len(ours) and len(theirs)
    missing = [row for row in theirs if np.abs(ours - row).max(axis=1).min() > 1e-5]
    assert not missing, "a live pair that no constraint measures"
    # Distances that never change cannot be told apart: neighbouring links, or a base that stands.
    ours, theirs = ours[np.ptp(ours, axis=1) > 1e-5], theirs[np.ptp(theirs, axis=1) > 1e-5]
    idle = [row for row in ours if np.abs(theirs - row).max(axis=1).min() > 1e-5]
    assert not idle, "a measured pair that is not live"
    # What repeats at another switch needs one measurement: the same pair, of robots at the same configurations, apart alike.
    distinct: dict[tuple, list[np.ndarray]] = {}
    for (switch, a, b), (k, distances) in truth(name, instance).items():
        row = signature(kind, distances)
        if k == kind and np.ptp(row) > 1e-5:
            seen = distinct.setdefault((a, b, configurations_of(name, switch, a, b)), [])
            if all(np.abs(row - other).max() > 1e-6 for other in seen):
                seen.append(row)
    assert len(ours) == sum(map(len, distinct.values()))


def configurations_of(name, switch, *geoms):
    """Configuration variables of the robots that the geoms belong to at a switch."""
    scene = problem(name).scene
    model, task = scene.model, scene.task
    found = set()
    for robot in task.robots:
        top = model.body(robot.base).id if robot.base else model.jnt_bodyid[model.joint(robot.joints[0]).id]
        for geom in geoms:
            body = model.geom_bodyid[geom]
            while body not in (0, top):
                body = model.body_parentid[body]
            if body == top:
                found.add(task.switches[task.switch_index(switch)].configurations.get(robot.name))
    return frozenset(found)


@pytest.mark.parametrize(("name", "instance"), CASES)
def test_pairs_of_boxes_are_as_many_and_have_the_right_signs(name, instance):
    ours = [
        tuple(signature("box_box", row)) for single, _ in measured(name, instance).values() for row in single.get("box_box", [])
    ]
    wanted = {}
    for (switch, a, b), (kind, distances) in truth(name, instance).items():
        if kind == "box_box":
            wanted[a, b, tuple(np.round(distances, 7))] = tuple(signature(kind, distances))
    assert sorted(ours) == sorted(wanted.values())


@pytest.mark.parametrize("name", SCENES)
def test_constraints_cover_the_variables_of_their_bodies(name):
    at = problem(name)
    scopes = {c.name: set(c.scope) for c in at.graph.constraints}
    for constraint, clearance in at.clearances.items():
        for body in clearance.bodies:
            mentioned = {v for term in body.pose for v in term.depends_on} | ({body.variable} - {None})
            assert mentioned <= scopes[constraint]


def test_no_pairs_are_far_apart():
    none = np.zeros((2, 0), np.int32)
    at = problem("pick_place")
    data = next(iter(at.params.clearances.values()))
    placed = place_object(data.shapes[-1], None)
    assert float(smallest_distance([placed], Pairs(none, none, none))[0]) == FAR
