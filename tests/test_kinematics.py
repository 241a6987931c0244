"""Chains against C MuJoCo and `mjx.kinematics`, Jacobians against finite differences."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from loaded import SCENES, problem
from mujoco import mjx

from cgs_jax.errors import InputError
from cgs_jax.kinematics import ChainReader, joint_frames, padded, tool_jacobian, tool_pose, tool_poses_on_host

# Slides and hinges, several in one body and off its centre, reference angles, turned bodies, a joint between them that
# belongs to nobody and stands at the keyframe.
ODD = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="mount" pos="0.1 0.2 0.3" quat="0.8 0.2 0.4 0.4">
      <site name="on_mount" pos="0.1 0 0" quat="1 2 3 4"/>
      <body name="a" pos="0.2 0 0.1" quat="0.5 0.5 -0.5 0.5">
        <joint name="h1" axis="1 2 3" pos="0.1 0.2 -0.1" ref="0.4"/>
        <joint name="s1" type="slide" axis="-1 0 2" ref="0.2"/>
        <joint name="h2" axis="0 -1 0" pos="0 0.3 0"/>
        <geom size="0.05"/>
        <site name="half_way" pos="0 0.1 0.3" quat="4 3 2 1"/>
        <body pos="0.3 0 0" quat="1 1 0 0">
          <joint name="idle" axis="0 1 1" pos="0.02 0 0" ref="-0.3"/>
          <geom size="0.05"/>
          <body name="b" pos="0 0.2 0">
            <joint name="h3" axis="1 1 0" pos="0.05 0 0.02" ref="-1.1"/>
            <joint name="s2" type="slide" axis="0 0 1"/>
            <geom size="0.05"/>
            <site name="tip" pos="0.1 0.2 0.3" quat="4 3 2 1"/>
          </body>
        </body>
      </body>
    </body>
    <body name="aside"><joint name="other" type="ball"/><geom size="0.1"/></body>
  </worldbody>
</mujoco>
"""
JOINTS = ["h1", "s1", "h2", "h3", "s2"]


@pytest.fixture(scope="module")
def odd():
    model = mujoco.MjModel.from_xml_string(ODD)
    home = model.qpos0.copy()
    home[model.joint("idle").qposadr] = 0.7
    return model, home, ChainReader(model, JOINTS, home)


def site_poses(model, home, joints, base, site, q):
    """Rotations and positions of a site in the world or in a base body's frame, by C MuJoCo."""
    data = mujoco.MjData(model)
    addresses = [model.jnt_qposadr[model.joint(j).id] for j in joints]
    rotations, positions = [], []
    for row in q:
        data.qpos[:] = home
        data.qpos[addresses] = row
        mujoco.mj_kinematics(model, data)
        turn, place = data.site(site).xmat.reshape(3, 3), data.site(site).xpos
        if base is not None:
            body = data.body(base)
            turn, place = body.xmat.reshape(3, 3).T @ turn, body.xmat.reshape(3, 3).T @ (place - body.xpos)
        rotations.append(turn.copy())
        positions.append(place.copy())
    return np.array(rotations), np.array(positions)


TOOL = jax.jit(lambda chain, q: tool_pose(chain, joint_frames(chain, q)))


def evaluate(chain, q):
    """Tools of `(lanes, n)` as `(lanes, 3, 3)`, `(lanes, 3)`."""
    tool = TOOL(chain, jnp.asarray(q[:, : len(chain.hinge)].T, jnp.float32))
    lanes = len(q)
    return np.moveaxis(np.broadcast_to(tool.rotation, (3, 3, lanes)), 2, 0), np.broadcast_to(
        tool.position, (3, lanes)
    ).T


CHAINS = [(name, key) for name in SCENES for key in problem(name).exact.chains]


@pytest.mark.parametrize(("name", "key"), CHAINS)
def test_chains_of_the_scenes_agree_with_mujoco(name, key):
    at = problem(name)
    robot = at.scene.task.robot(key.split("/")[0])
    frame = key.split("/")[1]
    chain = at.exact.chains[key]
    limits = next(
        at.params.limits[v] for s in at.scene.task.switches for r, v in s.configurations.items() if r == robot.name
    )
    q = np.random.default_rng(0).uniform(*limits, size=(20, len(robot.joints)))
    rotation, position = site_poses(at.scene.model, at.scene.home_qpos, robot.joints, robot.base, frame, q)
    on_host = tool_poses_on_host(chain, q)
    np.testing.assert_allclose(on_host[0], rotation, atol=1e-12)
    np.testing.assert_allclose(on_host[1], position, atol=1e-12)
    single = evaluate(at.params.chains[key], q)
    np.testing.assert_allclose(single[0], rotation, atol=2e-6)
    np.testing.assert_allclose(single[1], position, atol=2e-6)


def test_chain_agrees_with_mjx():
    at = problem("pick_place")
    model, joints = at.scene.model, at.scene.task.robot("a").joints
    addresses = np.array([model.jnt_qposadr[model.joint(j).id] for j in joints])
    q = np.random.default_rng(1).uniform(*at.params.limits["q1"], size=(4, 7)).astype(np.float32)
    data = mjx.make_data(model)

    def place(row):
        moved = data.replace(qpos=jnp.asarray(at.scene.home_qpos, jnp.float32).at[addresses].set(row))
        moved = mjx.kinematics(at.scene.mjx_model, moved)
        site = model.site("a_pinch").id
        return moved.site_xmat[site], moved.site_xpos[site]

    # Without XLA's fusion the program compiles and runs in a fraction of the time.
    run = jax.jit(jax.vmap(place), compiler_options={"xla_disable_hlo_passes": "fusion"})
    rotation, position = run(q)
    ours = evaluate(at.params.chains["a/a_pinch"], q)
    np.testing.assert_allclose(ours[0], rotation, atol=2e-6)
    np.testing.assert_allclose(ours[1], position, atol=2e-6)


@pytest.mark.parametrize(("site", "moving"), [("tip", 5), ("half_way", 3), ("on_mount", 0)])
def test_odd_chain_agrees_with_mujoco(odd, site, moving):
    model, home, reader = odd
    chain = reader.chain(site)
    assert len(chain.hinge) == moving
    q = np.random.default_rng(2).uniform(-2, 2, size=(20, 5))
    rotation, position = site_poses(model, home, JOINTS, None, site, q)
    on_host = tool_poses_on_host(chain, q)
    np.testing.assert_allclose(on_host[0], rotation, atol=1e-12)
    np.testing.assert_allclose(on_host[1], position, atol=1e-12)
    single = evaluate(chain, q)
    np.testing.assert_allclose(single[0], rotation, atol=2e-6)
    np.testing.assert_allclose(single[1], position, atol=3e-6)


def test_joint_frames_stand_on_the_joints(odd):
    model, home, reader = odd
    q = np.random.default_rng(3).uniform(-2, 2, size=5)
    data = mujoco.MjData(model)
    data.qpos[:] = home
    data.qpos[reader.qpos_addresses] = q
    mujoco.mj_kinematics(model, data)
    frames = joint_frames(reader.links, jnp.asarray(q[:, None], jnp.float32))
    ids = [model.joint(j).id for j in JOINTS]
    np.testing.assert_allclose(frames.rotation[:, :, 2, 0], data.xaxis[ids], atol=2e-6)
    # A slide's anchor is its body's origin wherever the slide stands; the frame moves with it, along its axis.
    hinges = [0, 2, 3]
    anchors = np.asarray(frames.position[:, :, 0])
    off = anchors - data.xanchor[ids]
    np.testing.assert_allclose(off[hinges], 0, atol=3e-6)


def test_a_site_on_a_link_is_found_from_the_links_frame(odd):
    model, home, reader = odd
    q = np.random.default_rng(4).uniform(-2, 2, size=5)
    data = mujoco.MjData(model)
    data.qpos[:] = home
    data.qpos[reader.qpos_addresses] = q
    mujoco.mj_kinematics(model, data)
    frames = joint_frames(reader.links, jnp.asarray(q[:, None], jnp.float32))
    for body, link in (("a", 3), ("b", 5)):
        assert reader.link_of_body(model.body(body).id) == link
        at_home = reader.data.body(body)
        turn, place = reader.in_link(link, at_home.xmat.reshape(3, 3), at_home.xpos)
        frame = np.asarray(frames.rotation[link - 1, :, :, 0]), np.asarray(frames.position[link - 1, :, 0])
        np.testing.assert_allclose(frame[0] @ turn, data.body(body).xmat.reshape(3, 3), atol=2e-6)
        np.testing.assert_allclose(frame[1] + frame[0] @ place, data.body(body).xpos, atol=3e-6)
    assert reader.link_of_body(model.body("mount").id) is None
    assert reader.link_of_body(model.body("aside").id) is None


def numeric_jacobian(chain, q, h=1e-6):
    """`(6, n)`: velocity of the tool's origin and its angular velocity, by central differences in double precision."""
    columns = []
    for i in range(len(q)):
        step = np.zeros(len(q))
        step[i] = h
        (after, to), (before, at) = ([a[0] for a in tool_poses_on_host(chain, (q + s)[None])] for s in (step, -step))
        spin = (after - before) @ tool_poses_on_host(chain, q[None])[0][0].T / (2 * h)
        columns.append([*((to - at) / (2 * h)), spin[2, 1], spin[0, 2], spin[1, 0]])
    return np.array(columns).T


@jax.jit
def jacobian_at(chain, q):
    frames = joint_frames(chain, q)
    return tool_jacobian(chain, frames, tool_pose(chain, frames))


def test_jacobians_agree_with_finite_differences(odd):
    chains = [odd[2].chain("tip")] + [problem(name).exact.chains[key] for name, key in CHAINS]
    for chain in chains:
        q = np.random.default_rng(5).uniform(-2, 2, size=(3, len(chain.hinge)))
        ours = np.asarray(jacobian_at(chain, jnp.asarray(q.T, jnp.float32)))
        for lane in range(3):
            np.testing.assert_allclose(ours[:, :, lane], numeric_jacobian(chain, q[lane]), atol=5e-6)


def test_padding_changes_nothing(odd):
    chain = odd[2].chain("half_way")
    q = np.random.default_rng(6).uniform(-2, 2, size=(5, 3))
    longer = np.concatenate([q, np.full((5, 2), 0.3)], axis=1)
    for ours, theirs in zip(evaluate(padded(chain, 5), longer), evaluate(chain, q), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)
    jacobian = jacobian_at(padded(chain, 5), jnp.asarray(longer.T, jnp.float32))
    np.testing.assert_array_equal(jacobian[:, 3:], 0)


def test_wrong_chains_are_refused(odd):
    model, home, _ = odd
    with pytest.raises(InputError, match="'h1' of robot 'arm' is not below 'h3'"):
        ChainReader(model, ["h3", "h1"], home, name="arm")
    with pytest.raises(InputError, match="'other' of robot 'arm' is a ball joint"):
        ChainReader(model, ["other"], home, name="arm")
