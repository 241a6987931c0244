import ast
import json
import subprocess
import sys
from pathlib import Path

import gantry
import mujoco
import numpy as np
import pytest
from test_audit import load_verify

SCRIPT = Path(__file__).parents[1] / "scripts" / "verify.py"


@pytest.fixture(scope="module")
def verify():
    return load_verify()


def write(folder, qpos, t, /, **changed):
    """A file of these samples with some keys replaced, or taken out where the new value is None."""
    path = gantry.sample_set(qpos, t).save(folder)
    if changed:
        with np.load(path, allow_pickle=False) as archive:
            stored = {**archive, **changed}
        np.savez(path, **{key: value for key, value in stored.items() if value is not None})
    return path


def test_imports_mujoco_numpy_and_the_standard_library_only():
    roots = set()
    for node in ast.walk(ast.parse(SCRIPT.read_text())):
        if isinstance(node, ast.Import):
            roots |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            roots.add(node.module.split(".")[0])
    assert roots - set(sys.stdlib_module_names) == {"mujoco", "numpy"}


def test_valid_samples_pass_as_a_command(tmp_path):
    qpos, t, _ = gantry.valid(40)
    path = write(tmp_path, qpos, t)
    done = subprocess.run([sys.executable, SCRIPT, path], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "40 samples" in done.stdout and "every sample passes" in done.stdout
    done = subprocess.run([sys.executable, SCRIPT, tmp_path / "no.npz"], capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == ""
    assert len(done.stderr.splitlines()) == 1 and "no.npz" in done.stderr


@pytest.mark.parametrize("name", gantry.faults())
def test_every_fault_is_caught_by_its_line(name, verify, tmp_path, capsys):
    broken, t_broken, check = gantry.faults()[name]
    qpos, t, _ = gantry.valid(4)
    qpos[2], t[2] = broken, t_broken
    path = write(tmp_path, qpos, t)
    assert verify.main([str(path), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["samples"] == 4 and report["bad"] == 1 and report["first_bad"] == [2]
    assert any(check in line and entry["bad"] == 1 for line, entry in report["checks"].items())
    assert verify.main([str(path), "--limit", "2"]) == 0
    assert "2 samples" in capsys.readouterr().out


def test_contacts_and_poses_are_those_of_a_full_forward_pass(verify):
    """`mj_kinematics` and `mj_collision` alone give what `mj_forward` gives."""
    scene = verify.Scene(gantry.MJCF)
    qpos = np.concatenate([q for q, _, check in gantry.faults().values() if check != "finite numbers"])
    wanted = [("site", scene.model.site("pinch").id), ("body", scene.model.body("box").id)]
    poses, penetration = scene.evaluate(qpos, wanted)
    model = mujoco.MjModel.from_xml_string(gantry.MJCF)
    data = mujoco.MjData(model)
    for row, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(poses[wanted[0]][0][row], data.site("pinch").xpos, atol=1e-14)
        np.testing.assert_allclose(poses[wanted[1]][0][row], data.body("box").xpos, atol=1e-14)
        assert penetration[row] == (max(0.0, -data.contact.dist.min()) if data.ncon else 0.0)
    assert (penetration > 0).any()


def test_no_samples_is_no_failure(verify, tmp_path, capsys):
    qpos, t, _ = gantry.valid(0)
    assert verify.main([str(write(tmp_path, qpos, t))]) == 0
    assert "no samples in this file" in capsys.readouterr().out


def test_values_of_configurations_and_resting_joints_are_those_of_qpos(verify, tmp_path, capsys):
    qpos, t, _ = gantry.valid(3)
    wrong = qpos[:, 1, :5].copy()
    wrong[1, 3] += 2e-6
    resting = {"at": "place", "joints": ["tilt"], "values": [2e-6]}
    rested = {**resting, "values": [0.0]}
    for changed, bad in (
        ({"x_q_2": wrong}, [1]),
        ({"configurations": np.array(json.dumps([resting]))}, [0, 1, 2]),
        ({"configurations": np.array(json.dumps([*gantry.CONFIGURATIONS, rested]))}, []),
        ({"configurations": None}, []),
    ):
        assert verify.main([str(write(tmp_path, qpos, t, **changed)), "--json"]) == bool(bad)
        report = json.loads(capsys.readouterr().out)
        assert report["first_bad"] == bad
        assert report["checks"].get("configurations (rad or m)", {"bad": 0})["bad"] == len(bad)


def test_a_violation_that_is_no_number_is_caught(verify, tmp_path, capsys):
    qpos, t, _ = gantry.valid(3)
    assert verify.main([str(write(tmp_path, qpos, t, violation=np.array([[0.0], [np.nan], [0.0]]))), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["first_bad"] == [1] and report["checks"]["finite numbers"]["bad"] == 1


def test_goals_count_in_what_they_demand(verify, tmp_path):
    pick = [*gantry.START[:2], 0.2, 0.0, 0.0]
    at_goal, t = gantry.sample(pick, [0.6, 0.2, 0.2, 0.0, 0.0])
    turned, t_turned = gantry.sample(pick, [0.6, 0.2, 0.2, 2e-3, 0.0])
    for qpos, given, rotation, expected in (
        (at_goal, t, True, 0),
        (turned, t_turned, True, 1),
        (turned, t_turned, False, 0),
    ):
        goal = {**gantry.GOAL, "rotation": rotation}
        path = write(tmp_path, qpos[None], given[None], goals=np.array(json.dumps([goal])))
        assert verify.main([str(path)]) == expected


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"schema": np.array("other")}, "has schema other, expected cgs_jax/1"),
        ({"elapsed": None}, "lacks the keys elapsed"),
        ({"x_t": None}, "lacks the key x_t"),
        ({"x_t": np.zeros((2, 7))}, "x_t is float64 of shape (2, 7)"),
        ({"qpos": np.zeros((3, 2, 12), np.float32)}, "expected float64"),
        ({"qpos": np.zeros((3, 2, 11))}, "qpos has 11 columns, expected the 12 of the mjcf"),
        ({"mode_switches": np.array(["pick"])}, "qpos has 2 mode switches, expected the 1"),
        ({"violation": np.zeros((3, 4))}, "violation is float64 of shape (3, 4)"),
        ({"sequence": np.full(3, 9)}, "sequence holds a value"),
        ({"mjcf": np.array("<mujoco><worldbody>")}, "mjcf does not compile"),
        ({"goals": np.array("[")}, "goals is no JSON"),
        ({"goals": np.array("{}")}, "goals is a dict"),
        ({"goals": np.array('[{"object": "box"}]')}, "incomplete"),
        ({"goals": np.array(json.dumps([{**gantry.GOAL, "site": "star"}]))}, "mjcf has no site named 'star'"),
        ({"goals": np.array(json.dumps([{**gantry.GOAL, "at": "later"}]))}, "unknown mode switch 'later'"),
        ({"configurations": np.array('[{"at": "pick"}]')}, "incomplete"),
        ({"configurations": np.array('[{"at": "pick", "joints": ["x"]}]')}, "incomplete"),
        ({"configurations": np.array('[{"at": "pick", "joints": ["w"], "values": [0]}]')}, "mjcf has no joint named 'w'"),
        ({"configurations": np.array('[{"at": "pick", "joints": ["x"], "values": [0, 0]}]')}, "expected (1,)"),
        ({"configurations": np.array('[{"at": "pick", "joints": ["x"], "variable": "q_1"}]')}, "1 columns among q_1, q_2"),
    ],
)
def test_bad_input_is_one_line_and_status_two(changed, message, verify, tmp_path, capsys):
    qpos, t, _ = gantry.valid(3)
    assert verify.main([str(write(tmp_path, qpos, t, **changed))]) == 2
    written = capsys.readouterr()
    assert written.out == "" and len(written.err.splitlines()) == 1
    assert message in written.err


def test_damaged_file_and_wrong_limit(verify, tmp_path, capsys):
    qpos, t, _ = gantry.valid(3)
    path = write(tmp_path, qpos, t)
    assert verify.main([str(path), "--limit", "0"]) == 2
    path.write_bytes(path.read_bytes()[:500])
    assert verify.main([str(path)]) == 2
    path.write_bytes(b"PK")
    assert verify.main([str(path)]) == 2
    path.write_text("a text")
    assert verify.main([str(path)]) == 2
    assert verify.main([]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 5 and "--limit is 0" in errors[0]
    # Not NumPy's advice to load it as a pickle.
    assert "it is no archive" in errors[3] and "required: file" in errors[4]
