import importlib.util
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "scripts" / "peer_komo.py"
needs_robotic = pytest.mark.skipif(importlib.util.find_spec("robotic") is None, reason="needs the extra 'peers'")


@pytest.fixture(scope="module")
def peer():
    spec = importlib.util.spec_from_file_location("peer_komo", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["peer_komo"] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    return module


def scene_file(name, suffix):
    return ROOT / "scenes" / "peers" / name / f"{name}.{suffix}"


def run(*arguments, **environment):
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment or None, timeout=60)


@pytest.mark.parametrize("name", ["pp", "ho", "ho2"])
def test_scenes_are_those_of_the_mjcf(peer, name):
    scene = peer.SCENES[name]
    model = mujoco.MjModel.from_xml_path(str(scene_file(name, "xml")))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for geom, block in {**scene.fixed, "box": scene.box}.items():
        np.testing.assert_allclose(2 * model.geom(geom).size, block.size)
        np.testing.assert_allclose(data.geom(geom).xpos, block.position, atol=1e-12)
    for arm, (position, yaw) in scene.arms.items():
        np.testing.assert_allclose(data.body(f"{arm}_link0").xpos, position, atol=1e-12)
        np.testing.assert_allclose(data.body(f"{arm}_link0").xmat[:2], (np.cos(yaw), -np.sin(yaw)), atol=1e-12)
    np.testing.assert_allclose(data.site("goal").xpos, scene.goal.position)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.array(scene.goal.quat))
    np.testing.assert_allclose(data.site("goal").xmat, rotation, atol=1e-12)
    assert model.nq == 7 * len(scene.arms) + 7


@pytest.mark.parametrize("name", ["pp", "ho", "ho2"])
def test_orders_and_switches_are_those_of_the_task(peer, name):
    task = tomllib.loads(scene_file(name, "toml").read_text())
    assert tuple(switch["name"] for switch in task["switches"]) == peer.SWITCHES[name]
    orders = {"expert1" if order == "joint" else order: text for order, text in peer.ORDERS[name].items()}
    assert orders == task["sequences"]
    assert peer.BEST_ORDER[name] in peer.ORDERS[name]
    if name != "pp":
        (placement,) = task["placements"]
        assert (tuple(placement["low"]), tuple(placement["high"])) == peer.SCENES[name].region


def test_poses_compose_as_in_mujoco(peer):
    rng = np.random.default_rng(0)
    for first, second in rng.normal(size=(5, 2, 7)):
        first[3:], second[3:] = first[3:] / np.linalg.norm(first[3:]), second[3:] / np.linalg.norm(second[3:])
        position, quat = np.empty(3), np.empty(4)
        mujoco.mju_mulPose(position, quat, first[:3], first[3:], second[:3], second[3:])
        np.testing.assert_allclose(peer.compose(first, second), [*position, *quat], atol=1e-12)
        mujoco.mju_negPose(position, quat, first[:3], first[3:])
        np.testing.assert_allclose(peer.inverted(first), [*position, *quat], atol=1e-12)


def test_shares_keep_the_tolerances_apart(peer):
    equality, inequality = np.array([5e-5, 5e-4, 5e-3, 5e-5]), np.array([5e-5, 5e-3, 0, 2e-2])
    assert peer.shares(equality, inequality)["strict"].tolist() == [True, True, False, False]
    assert peer.shares(equality, inequality)["ours"].tolist() == [True, False, False, False]
    assert not peer.shares(equality, inequality, np.full(4, 1e-5))["strict"].any()


def test_one_line_without_the_package(tmp_path):
    (tmp_path / "robotic.py").write_text("raise ImportError('liblapack.so.3:\\n no such file')")
    result = run("--scene", "pp", "--seconds", "1", PYTHONPATH=str(tmp_path))
    assert result.returncode == 2 and result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert "pip install robotic" in line and "liblapack.so.3: no such file" in line


def test_one_line_for_bad_input(tmp_path, peer):
    np.savez(tmp_path / "short.npz", qpos=np.zeros((2, 3, 14)))
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    cases = {
        ("--scene", "pp", "--order", "tree1"): "expert3, place_first",
        ("--scene", "ho", "--seconds", "0"): "seconds > 0",
        ("--scene", "pp", "--check", tmp_path / "short.npz"): "shape (N, 2, 14), got (2, 3, 14)",
        ("--scene", "pp", "--check", tmp_path / "other.npz"): "no key 'qpos', available: x",
        ("--scene", "pp", "--check", tmp_path / "none.npz"): "none.npz",
        ("--scene", "pp", "--python", tmp_path / "none"): "cannot run the peer",
    }
    for arguments, expected in cases.items():
        result = run(*arguments)
        assert result.returncode == 2, arguments
        (line,) = result.stderr.splitlines()
        assert expected in line


@needs_robotic
@pytest.mark.parametrize(("name", "order"), [("pp", "expert3"), ("ho2", "expert3"), ("ho2", "joint")])
def test_solutions_pass_their_own_check(peer, tmp_path, name, order):
    result = run("--scene", name, "--order", order, "--seconds", "1", "--out", tmp_path / "solutions.npz")
    report = json.loads(result.stdout)
    assert report["strict"]["samples"] >= report["ours"]["samples"] > 0
    qpos = peer.read_qpos(tmp_path / "solutions.npz")
    checked, arrays = peer.check_samples(name, qpos)
    assert checked["samples"] == report["strict"]["samples"]
    assert checked["feasible_strict"] >= 0.9  # t is read from another switch than the solver's, within its residual
    with np.load(tmp_path / "solutions.npz") as solutions:
        np.testing.assert_allclose(arrays["equality"], solutions["equality"], atol=1e-3)
    # A box that slips by 1 cm at the last switch, and an arm beyond its limit, do not.
    slipped, beyond = qpos.copy(), qpos.copy()
    slipped[:, -1, -7] += 0.01
    beyond[:, 0, 5] = 0.4
    for spoiled in (slipped, beyond):
        assert peer.check_samples(name, spoiled)[0]["feasible_strict"] == 0
    slipped_equality = peer.check_samples(name, slipped)[1]["equality"]
    np.testing.assert_allclose(slipped_equality.max(), 0.01, atol=2e-3)


@needs_robotic
def test_two_processes_share_the_work(peer):
    report, arrays = peer.run_komo("pp", "joint", seconds=1.0, processes=2, seed=3)
    assert len(arrays["qpos"]) == report["strict"]["samples"] > 0
    assert len(np.unique(arrays["qpos"], axis=0)) == len(arrays["qpos"])  # different seeds
    assert arrays["elapsed"].max() < 1.5
