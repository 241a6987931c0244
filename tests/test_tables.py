"""Seed tables: what is aimed is near its targets, free, within the limits, and the same every time."""

import dataclasses

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cgs_jax import cache, tables
from cgs_jax.constraints import row_data
from cgs_jax.operators import aimed_at, operator_of
from cgs_jax.problems import load_problem
from cgs_jax.tables import NEAREST, TABLE_SIZE, Word


@pytest.fixture(scope="module")
def at():
    return load_problem("handover", 0)


def operator(at, text):
    return next(operator_of(at, t) for t in at.transitions.all() if str(t) == text)


def random_poses(rng, count):
    return Rotation.random(count, rng=rng).as_matrix(), rng.normal(size=(count, 3))


def product(*poses):
    rotation, position = np.eye(3), np.zeros(3)
    for turn, move in poses:
        rotation, position = rotation @ turn, position + rotation @ move
    return rotation, position


def back(pose):
    return pose[0].T, -pose[0].T @ pose[1]


@pytest.mark.parametrize("form", ["closed", "oriented", "two_finger", "upright", "located"])
@pytest.mark.parametrize("inverted", [False, True])
def test_misses_are_those_of_the_product_written_out(form, inverted):
    rng = np.random.default_rng(3)
    numbers = {
        "oriented": {"low": (-0.1, 0, 0), "high": (0.1, 0, 0), "wanted": Rotation.random(rng=rng).as_matrix()},
        "two_finger": {
            "low": (0, -0.1, -0.2),
            "high": (0, 0.1, 0.2),
            "axes": [([1, 0, 0], [0, 1, 0], 0.0), ([1, 0, 0], [0, 0, 1], 0.5)],
        },
        "located": {"low": (-0.3, -0.2, -np.inf), "high": (0.3, 0.2, 0.1)},
    }.get(form, {})
    rows = row_data(form, **numbers)
    tools, before, after = (random_poses(rng, n) for n in (5, 4, 4))
    found = tables._misses(Word("", inverted, before, after, rows), *(part.astype(np.float32) for part in tools))
    assert found.shape == (5, 4)
    for n in range(5):
        tool = tools[0][n], tools[1][n]
        for s in range(4):
            rotation, position = product((before[0][s], before[1][s]), back(tool) if inverted else tool,
                                         (after[0][s], after[1][s]))  # fmt: skip
            expected = np.sum(np.square(position - np.clip(position, rows.low[:3], rows.high[:3])))
            if rows.as_vector:
                angle = Rotation.from_matrix(rotation @ rows.wanted.T).magnitude()
                expected += 2 * (1 - np.cos(angle))
            else:
                dots = [outer @ rotation @ inner for outer, inner in zip(rows.outer_axes, rows.inner_axes, strict=True)]
                expected += np.sum(np.square(dots - np.clip(dots, rows.low[3:], rows.high[3:])))
            assert found[n, s] == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_most_entries_are_near_what_all_tasks_ask(at):
    aimed = aimed_at(at, operator(at, "(q_a1,t_a)"))[0]
    plain = at.params.tables["a"]
    box = at.scene.object_pose("box")[:3]
    chain = next(iter(aimed.tools))

    def away(table):
        return np.linalg.norm(table.tools[chain].position.T - box, axis=1)

    assert np.median(away(aimed)) < 0.3 < 0.5 < np.median(away(plain))
    # A part stays as it was, so that nothing is out of reach of all seeds.
    assert np.mean(away(aimed) > 0.4) > 0.1


def test_entries_keep_the_limits_and_collide_with_nothing_that_is_always_there(at):
    aimed = aimed_at(at, operator(at, "(q_a1,t_a)"))[0]
    low, high = at.params.limits["q_a1"]
    q = aimed.configurations.T
    assert q.shape == (TABLE_SIZE, 7) and (q >= low - 1e-6).all() and (q <= high + 1e-6).all()
    model = at.scene.model
    data = mujoco.MjData(model)
    data.qpos[:] = at.scene.home_qpos
    addresses = [model.joint(name).qposadr[0] for name in at.scene.task.robot("a").joints]
    mine = {model.body(i).name for i in range(model.nbody) if model.body(i).name.startswith("a_")}
    hits = 0
    for entry in q[:200]:
        data.qpos[addresses] = entry
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for contact in data.contact[: data.ncon]:
            bodies = [model.geom_bodyid[g] for g in contact.geom]
            own = [model.body(b).name in mine for b in bodies]
            fixed = [model.body_weldid[b] == 0 for b in bodies]
            hits += contact.dist < -1e-4 and any(own) and all(a or b for a, b in zip(own, fixed, strict=True))
    assert hits == 0


def test_tools_are_those_of_mujoco(at):
    table = aimed_at(at, operator(at, "q_a1"))[0]
    model = at.scene.model
    data = mujoco.MjData(model)
    data.qpos[:] = at.scene.home_qpos
    addresses = [model.joint(name).qposadr[0] for name in at.scene.task.robot("a").joints]
    for name, tool in table.tools.items():
        for n in (0, 17, TABLE_SIZE - 1):
            data.qpos[addresses] = table.configurations[:, n]
            mujoco.mj_kinematics(model, data)
            site = data.site(name.split("/")[1])
            np.testing.assert_allclose(tool.position[:, n], site.xpos, atol=1e-5)
            np.testing.assert_allclose(tool.rotation[..., n].ravel(), site.xmat, atol=1e-5)


def test_the_same_table_every_time(at):
    again = load_problem("handover", 0)
    for text in ("(q_a1,t_a)", "q_a1"):
        one, other = (aimed_at(p, operator(p, text))[0] for p in (at, again))
        np.testing.assert_array_equal(one.configurations, other.configurations)


def test_what_may_be_anywhere_is_not_aimed_at(at):
    # q_b2 is to meet what the other arm holds, wherever that is; of q_a2 the region is known.
    made = operator(at, "(q_a2,q_b2,p,t_b)")
    by_name = dict(zip(made.plan.configurations, aimed_at(at, made), strict=True))
    assert by_name["q_a2"] is not None and by_name["q_b2"] is None


def test_drawn_targets_satisfy_the_grasp(at):
    sources = tables.Sources(at.params.constants, at.params.rows, at.params.seeds, at.params.sites, {}, {})
    samples = tables._Samples(operator(at, "q_a1").plan, sources)
    rotation, position = samples._pose("Grasp(t_a)")
    rows = at.params.rows["Grasp(t_a)"]
    for turn, move in zip(rotation, position, strict=True):
        grip = back((turn, move))  # the gripper in the object
        assert (grip[1] >= rows.low[:3] - 1e-6).all() and (grip[1] <= rows.high[:3] + 1e-6).all()
        dots = [outer @ grip[0] @ inner for outer, inner in zip(rows.outer_axes, rows.inner_axes, strict=True)]
        assert (dots >= rows.low[3:] - 1e-6).all() and (dots <= rows.high[3:] + 1e-6).all()


def test_a_robot_that_always_collides_still_has_a_table(at):
    pool = at.pools["a"]
    stuck = tables.Pool(pool._low, pool._high, pool._chains, lambda q: False, b"stuck")
    made = operator(at, "(q_a1,t_a)")
    table = aimed_at(dataclasses.replace(at, pools={**at.pools, "a": stuck}), made)[0]
    assert table.configurations.shape == (7, TABLE_SIZE) and NEAREST < TABLE_SIZE


def test_tables_are_read_from_the_cache_and_made_again_when_damaged(at, monkeypatch, tmp_path):
    monkeypatch.setattr(cache, "_folder", tmp_path)
    pool = at.pools["a"]

    def fresh():
        return tables.Pool(pool._low, pool._high, pool._chains, pool._is_free, b"free")

    def unused(self, q):
        raise AssertionError("made instead of read")

    made = fresh().plain
    (entry,) = tmp_path.glob("*.table")
    with monkeypatch.context() as patch:
        patch.setattr(tables.Pool, "_table", unused)
        read = fresh().plain
    other = tables.Pool(pool._low, pool._high, pool._chains, lambda q: False, b"stuck").plain
    entry.write_bytes(entry.read_bytes()[:-100])
    again = fresh().plain
    for table in (read, again):
        np.testing.assert_array_equal(table.configurations, made.configurations)
        for name, pose in table.tools.items():
            np.testing.assert_array_equal(pose.rotation, made.tools[name].rotation)
            np.testing.assert_array_equal(pose.position, made.tools[name].position)
    assert not np.array_equal(other.configurations, made.configurations)


def test_tables_of_instances_do_not_meet_in_the_cache(at):
    """Their objects stand elsewhere."""
    keys = {load_problem("handover", instance).pools["a"]._key for instance in range(3)}
    assert len(keys) == 3 and at.pools["a"]._key in keys
    assert load_problem("handover", 0).pools["a"]._key == at.pools["a"]._key
