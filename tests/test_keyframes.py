"""Keyframes against what the variables mean, measured by MuJoCo at the assembled configurations."""

import mujoco
import numpy as np
import pytest
from loaded import SCENES, matrices, problem, random_values

from cgs_jax.keyframes import Keyframes
from cgs_jax.scene import object_pose_sources

COUNT = 5


def pose_of(found):
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = found.xmat.reshape(3, 3), found.xpos
    return result


@pytest.mark.parametrize("name", SCENES)
def test_keyframes_say_what_the_variables_say(name):
    at = problem(name)
    scene, task, model = at.scene, at.scene.task, at.scene.model
    values = random_values(at, COUNT)
    qpos = Keyframes(at).qpos(values)
    assert qpos.shape == (COUNT, len(task.switches), model.nq) and qpos.dtype == np.float64
    sources = object_pose_sources(task)
    data = mujoco.MjData(model)
    for sample in range(COUNT):
        for k, switch in enumerate(task.switches):
            data.qpos[:] = qpos[sample, k]
            mujoco.mj_kinematics(model, data)
            for robot in task.robots:
                addresses = [model.jnt_qposadr[model.joint(j).id] for j in robot.joints]
                variable = switch.configurations.get(robot.name)
                expected = scene.home_qpos[addresses] if variable is None else values[variable][sample]
                np.testing.assert_array_equal(data.qpos[addresses], expected)
            for spec in task.objects:
                kind, *rest = sources[spec.name, switch.name]
                if kind == "held":
                    hold = task.hold(rest[0])
                    expected = pose_of_site(data, hold.frame) @ matrices(values[hold.variable][sample])[0]
                else:
                    vector = {
                        "start": lambda spec=spec, rest=rest: scene.object_pose(spec.name),
                        "goal": lambda spec=spec, rest=rest: scene.site_pose(rest[0]),
                        "variable": lambda spec=spec, rest=rest: values[rest[0]][sample],
                    }[kind]()
                    expected = matrices(vector)[0]
                np.testing.assert_allclose(pose_of(data.body(spec.body)), expected, atol=1e-9)
            for hold in task.holds:
                if hold.supports and task.span(hold)[0] < k <= task.span(hold)[1]:
                    hanging = pose_of_site(data, hold.frame) @ matrices(values[hold.variable][sample])[0]
                    np.testing.assert_allclose(pose_of(data.body(task.object(hold.object).body)), hanging, atol=1e-9)


def pose_of_site(data, name):
    return pose_of(data.site(name))


def test_quaternions_come_out_normalised():
    at = problem("handover")
    values = random_values(at, COUNT)
    scaled = values | {"p": values["p"] * np.r_[1, 1, 1, np.full(4, 1.0001)]}
    np.testing.assert_allclose(Keyframes(at).qpos(scaled), Keyframes(at).qpos(values), atol=1e-12)
