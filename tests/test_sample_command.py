"""The command `scripts/sample.py`: what it writes, how it ends, and what it says to wrong input."""

import contextlib
import importlib.util
import json
import os
import pty
import re
import select
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from cgs_jax import render
from cgs_jax.coverage import Cell, cell_indices
from cgs_jax.errors import InputError
from cgs_jax.samples import SampleSet

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "scripts" / "sample.py"
VERIFY = ROOT / "scripts" / "verify.py"
PICK_PLACE = ROOT / "scenes" / "pick_place"
PROMISED = (
    "schema mjcf variables mode_switches qpos attachments placements goals sequences sequence elapsed violation"
    " constraints meta"
).split()

_spec = importlib.util.spec_from_file_location("sample_command", SCRIPT)
assert _spec is not None and _spec.loader is not None
command = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(command)


def start(*arguments):
    return subprocess.run(
        [sys.executable, SCRIPT, *map(str, arguments)], capture_output=True, text=True, timeout=280, cwd=ROOT
    )


def verified(folder):
    done = subprocess.run([sys.executable, VERIFY, folder], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return SampleSet.load(folder)


def copied(folder, edit_task=lambda text: text, edit_model=lambda text: text):
    """pick_place in a folder of its own, its two files edited; the path of the task file."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, edit in (("pick_place.toml", edit_task), ("pick_place.xml", edit_model)):
        before = (PICK_PLACE / name).read_text()
        after = edit(before)
        (folder / name).write_text(after)
    return folder / "pick_place.toml"


# ------------------------------------------------------------------ runs that find samples


@pytest.fixture(scope="module", params=["pick_place", "handover", "banana"])
def finished(request, tmp_path_factory):
    out = tmp_path_factory.mktemp(request.param) / "out"
    done = start("--scene", request.param, "--num-samples", 20, "--time-budget", 120, "--out", out)
    assert done.returncode == 0, done.stderr
    return request.param, out, done


def test_a_scene_gives_samples_that_pass_the_independent_check(finished):
    scene, out, done = finished
    samples = verified(out)
    assert len(samples) == 20
    assert samples.meta["scene"] == scene and samples.meta["ended_by"] == "samples"
    assert (np.diff(samples.elapsed) >= 0).all()
    with np.load(out / "samples.npz", allow_pickle=False) as archive:
        assert set(PROMISED) <= set(archive.files)
        assert {f"x_{name}" for name in samples.variables} <= set(archive.files)


def test_no_two_samples_share_a_value(finished):
    samples = SampleSet.load(finished[1])
    for name, values in samples.variables.items():
        assert len(np.unique(values, axis=0)) == len(samples), name


def test_the_files_beside_tell_the_run(finished):
    scene, out, _ = finished
    told = json.loads((out / "run.json").read_text())
    counts = {"pick_place": (19, 8), "handover": (2059, 163), "banana": (19171, 534)}
    assert (told["transitions"]["complete"], told["transitions"]["pruned"]) == counts[scene]
    assert told["samples"] == 20 and told["rate"] > 0 and told["startup_seconds"] > 0
    assert told["diagnosis"] is None and told["best_sequences"]
    meta = SampleSet.load(out).meta
    assert {key: told[key] for key in meta} == meta
    assert 0 < meta["lambda"] < 1 and meta["ended_by"] == "samples"
    assert all(0 <= share <= 1 for shares in told["spread"].values() for share in shares.values())
    assert json.loads((out / "tree.json").read_text())["schema"] == "cgs_jax.tree/2"
    assert sorted(path.name for path in out.iterdir()) == ["run.json", "samples.npz", "tree.json"]


def test_the_closing_table_names_rate_operators_and_folder(finished):
    scene, out, done = finished
    assert done.stderr == ""
    first = done.stdout.splitlines()[0]
    assert first.startswith(f"{scene} instance 0") and re.search(r"20 samples in [\d.]+ s, [\d.]+/s", first)
    for wanted in ("condition feasible", "solver on those", "best sequences", "at a joint limit", str(out)):
        assert wanted in done.stdout


def test_one_json_object_and_nothing_else_on_stdout(tmp_path):
    out = tmp_path / "out"
    tree = tmp_path / "deeper" / "tree.json"
    options = ["--num-samples", 60, "--time-budget", 60, "--out", out, "--profile", "--diverse", 7, "--save-tree", tree]
    done = start("--scene", "pick_place", "--instance", 2, "--method", "t; q1; q2", "--json", *options)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told == json.loads((out / "run.json").read_text())
    assert (told["samples"], told["samples_written"], told["instance"]) == (60, 7, 2)
    samples = verified(out)
    assert len(samples) == 7 and samples.sequences == ("t; q1; q2",)
    profile = json.loads((out / "profile.json").read_text())
    assert set(profile["operators"]) == {"t", "q1 | t", "q2 | t"}
    assert all(entry["calls"] > 0 and entry["microseconds_per_task"] > 0 for entry in profile["operators"].values())
    used = profile["utilisation"]
    assert 0.0 < used["useful_share"] < 1.0 and 0.0 < used["share_of_peak"] < 0.5 and used["peak_flops"] > 1e9

    warm = start(
        "--scene", "pick_place", "--method", "tree-warm", "--warm-start", tree, "--warm-start", out / "tree.json",
        "--num-samples", 5, "--time-budget", 60, "--out", tmp_path / "warm", "--quiet",
    )  # fmt: skip
    assert (warm.returncode, warm.stdout, warm.stderr) == (0, "", "")
    assert len(SampleSet.load(tmp_path / "warm")) == 5


def test_diverse_samples_are_the_most_different_ones_in_their_order(tmp_path):
    options = ["--scene", "pick_place", "--deterministic", "--num-samples", "50", "--time-budget", "60", "--quiet"]
    assert command.main([*options, "--out", str(tmp_path / "all")]) == 0
    assert command.main([*options, "--out", str(tmp_path / "some"), "--diverse", "5"]) == 0
    everything, some = SampleSet.load(tmp_path / "all"), SampleSet.load(tmp_path / "some")
    np.testing.assert_array_equal(everything.qpos[everything.diverse(5)], some.qpos)


def test_deterministic_repeats_a_run_whatever_the_process(tmp_path):
    options = ["--scene", "pick_place", "--deterministic", "--seed", "3", "--time-budget", "60"]
    assert command.main([*options, "--num-samples", "300", "--out", str(tmp_path / "a"), "--quiet"]) == 0
    assert start(*options, "--num-samples", 200, "--out", tmp_path / "b").returncode == 0
    a, b = SampleSet.load(tmp_path / "a"), SampleSet.load(tmp_path / "b")
    assert a.meta["workers"] == b.meta["workers"] == 2
    np.testing.assert_array_equal(a.qpos[:200], b.qpos)
    for name, values in b.variables.items():
        assert a[name][:200].tobytes() == values.tobytes(), name
    assert [a.sequences[i] for i in a.sequence[:200]] == [b.sequences[i] for i in b.sequence]

    options[options.index("3")] = "4"
    assert command.main([*options, "--num-samples", "50", "--out", str(tmp_path / "c"), "--quiet"]) == 0
    assert not np.array_equal(SampleSet.load(tmp_path / "c").qpos, a.qpos[:50])


@pytest.mark.parametrize("method", ["rand", "expert3"])
def test_other_methods_and_the_papers_semantics(method, tmp_path):
    options = ["--num-samples", "10", "--time-budget", "60", "--tries", "1", "--no-pools", "--batch-size", "100", "--quiet"]
    assert command.main(["--scene", "pick_place", "--method", method, "--out", str(tmp_path / "out"), *options]) == 0
    meta = verified(tmp_path / "out").meta
    assert (meta["method"], meta["tries"], meta["pools"], meta["batch_size"]) == (method, 1, False, 100)


def test_pictures_lie_beside_the_samples(tmp_path):
    try:
        render.backend()
    except InputError as error:
        pytest.skip(str(error))
    options = ["--num-samples", "5", "--time-budget", "60", "--render", "--quiet"]
    assert command.main(["--scene", "pick_place", "--out", str(tmp_path), *options]) == 0
    for name in ("samples_sheet.png", "samples.gif"):
        assert (tmp_path / name).stat().st_size > 1000


# ------------------------------------------------------------------ runs that are stopped, or find nothing


def until(terminal, pattern, seconds):
    """What a terminal shows, up to where the pattern matches."""
    shown, deadline = "", time.monotonic() + seconds
    while not re.search(pattern, shown):
        assert time.monotonic() < deadline, shown[-2000:]
        if select.select([terminal], [], [], 0.5)[0]:
            shown += os.read(terminal, 4096).decode(errors="replace")
    return shown


@contextlib.contextmanager
def on_a_terminal(*arguments):
    """The command with its error stream on a terminal of its own: (process, terminal)."""
    ours, theirs = pty.openpty()
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "120"}
    process = subprocess.Popen(
        [sys.executable, SCRIPT, *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=theirs, text=True, cwd=ROOT, env=environment,
    )  # fmt: skip
    os.close(theirs)
    try:
        yield process, ours
    finally:
        process.kill()
        process.communicate()
        os.close(ours)


def test_a_live_line_and_ctrl_c_keeps_what_was_found(tmp_path):
    out = tmp_path / "out"
    with on_a_terminal("--scene", "pick_place", "--time-budget", 100, "--out", out) as (process, terminal):
        shown = until(terminal, r"sampling +[\d.]+ s · [1-9]\d* samples · [1-9]\d*/s · best: ", 120)
        assert "loading" in shown
        process.send_signal(signal.SIGINT)
        sent = time.monotonic()
        stdout, _ = process.communicate(timeout=20)
        assert time.monotonic() - sent < 15
    assert process.returncode == 0
    assert "ended by interrupt" in stdout
    assert len(verified(out)) > 0
    assert json.loads((out / "run.json").read_text())["ended_by"] == "interrupt"


def test_a_killed_run_leaves_what_it_had_found(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "samples.npz").write_text("of an earlier run")
    process = subprocess.Popen(
        [sys.executable, SCRIPT, "--scene", "pick_place", "--time-budget", "100", "--quiet", "--out", out], cwd=ROOT
    )
    deadline = time.monotonic() + 100
    while len(list(out.glob("samples.parts/0*.npz"))) < 2:
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.05)
    process.kill()
    process.wait()
    # What was being written when the process ended.
    (out / "samples.parts" / ".000007.npz.unfinished").write_bytes(b"PK")
    assert [path.name for path in out.iterdir()] == ["samples.parts"]
    samples = verified(out)
    assert len(samples) > 0 and samples.meta["ended_by"] is None and (np.diff(samples.elapsed) >= 0).all()
    pieces = [SampleSet.load(path) for path in sorted((out / "samples.parts").glob("0*.npz"))]
    np.testing.assert_array_equal(samples.qpos, np.concatenate([piece.qpos for piece in pieces]))
    np.testing.assert_array_equal(verified(out / "samples.npz").qpos, samples.qpos)
    (out / "samples.parts" / "000000.npz").write_bytes(b"PK")
    done = subprocess.run([sys.executable, VERIFY, out], capture_output=True, text=True)
    assert done.returncode == 2 and "000000.npz is no readable" in done.stderr
    with pytest.raises(InputError, match="000000.npz"):
        SampleSet.load(out)

    # The next run in this folder has nothing of it.
    options = ["--num-samples", "5", "--time-budget", "60", "--quiet"]
    assert command.main(["--scene", "pick_place", "--out", str(out), *options]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["run.json", "samples.npz", "tree.json"]


def test_a_run_ends_where_samples_show_little_new(tmp_path):
    options = ["--time-budget", "60", "--coverage-gain", "0.5", "--deterministic", "--method", "expert2", "--quiet"]
    assert command.main(["--scene", "pick_place", "--out", str(tmp_path), *options]) == 0
    samples = SampleSet.load(tmp_path)
    assert samples.meta["ended_by"] == "coverage" and samples.meta["elapsed"] < 60
    # Of the last 1000, by counting: fewer than half are in a cell of any variable that none was in before.
    for name, values in samples.variables.items():
        cells = [tuple(cell) for cell in cell_indices(values, Cell(), samples.kinds[name])]
        seen = set(cells[:-1000])
        first = [cell not in seen and not seen.add(cell) for cell in cells[-1000:]]
        assert np.mean(first) < 0.5, name


def test_ctrl_c_before_the_first_sample_ends_with_status_3(tmp_path):
    out = tmp_path / "out"
    task = copied(tmp_path / "scene", edit_task=goal_in_the_wall)
    with on_a_terminal("--scene", task, "--instance", 8, "--time-budget", 100, "--out", out) as (process, terminal):
        until(terminal, r"sampling", 120)
        process.send_signal(signal.SIGINT)
        shown = until(terminal, r"no sample", 20)
        process.communicate(timeout=20)
    assert process.returncode == 3 and "Traceback" not in shown
    assert sorted(path.name for path in out.iterdir()) == ["run.json", "tree.json"]


def test_ctrl_c_while_compiling_says_so(tmp_path):
    out = tmp_path / "out"
    with on_a_terminal("--scene", "pick_place", "--no-cache", "--out", out) as (process, terminal):
        until(terminal, r"compiling", 60)
        process.send_signal(signal.SIGINT)
        shown = until(terminal, r"no sample: the run was interrupted before an operator had run", 60)
        process.communicate(timeout=20)
    assert process.returncode == 3 and "Traceback" not in shown
    assert json.loads((out / "run.json").read_text())["ended_by"] == "interrupt"


@pytest.mark.parametrize("library", ["numpy", "mujoco", "jax"])
def test_ctrl_c_while_a_library_is_imported_ends_with_status_3(library, tmp_path):
    """An exception in there would be a traceback of the library's, or be swallowed."""
    code = (
        "import builtins, runpy, signal, sys\n"
        f"sys.argv = [{str(SCRIPT)!r}, '--scene', 'pick_place', '--num-samples', '1', '--out', {str(tmp_path / 'out')!r}]\n"
        "plain = builtins.__import__\n"
        "def interrupted(name, *rest):\n"
        f"    if name == {library!r}:\n"
        "        try: signal.raise_signal(signal.SIGINT)\n"
        "        except KeyboardInterrupt: pass\n"
        "    return plain(name, *rest)\n"
        "builtins.__import__ = interrupted\n"
        f"runpy.run_path({str(SCRIPT)!r}, run_name='__main__')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.splitlines() == ["sample.py: interrupted before the samples were written"]
    assert not (tmp_path / "out").exists()


def test_ctrl_c_while_writing_or_drawing_keeps_the_samples(tmp_path, monkeypatch, capsys):
    """The budget is over: what was found is written whole, and the drawing is done without."""
    save = SampleSet.save

    def interrupted(*_):
        signal.raise_signal(signal.SIGINT)

    def slow(self, path):
        # Parts are written before, while an interrupt still ends the run.
        if path.name == "samples.npz":
            interrupted()
        return save(self, path)

    monkeypatch.setattr(SampleSet, "save", slow)
    monkeypatch.setattr(render, "save_pictures", interrupted)
    monkeypatch.setattr(render, "backend", lambda: None)
    options = ["--num-samples", "5", "--time-budget", "60", "--render", "--quiet"]
    assert command.main(["--scene", "pick_place", "--out", str(tmp_path), *options]) == 0
    assert len(verified(tmp_path)) == 5 and capsys.readouterr().err == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.json", "samples.npz", "tree.json"]


def goal_in_the_wall(text):
    return text + (
        '\n[[instances]]\ntitle = "goal inside the wall"\n'
        "site.goal = { pos = [0.50, 0.30, 0.10] }\n"
        "geom.wall = { pos = [0.50, 0.30, 0.20], size = [0.15, 0.15, 0.20] }\n"
    )


def test_a_task_of_more_rows_than_degrees_of_freedom_is_told_before_sampling(tmp_path, capsys):
    # An arm of 5 joints and a grasp without slide: 5 + 5 + 6 degrees of freedom, 6 rows of each Kin and 5 of the grasp.
    def without_two_joints(model):
        model = re.sub(r'.*name="a_joint[37]" axis.*\n', "", model)
        return model.replace("0 -.785 0 -2.356 0 1.571 .785 ", "0 -.785 -2.356 0 1.571 ")

    task = copied(
        tmp_path / "scene",
        lambda text: re.sub(r'"a_joint3", |, "a_joint7"', "", text).replace("0.055]", "0.0]").replace("-0.0]", "0.0]"),
        without_two_joints,
    )
    out = tmp_path / "out"
    assert command.main(["--scene", str(task), "--out", str(out)]) == 2
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1 and "no sequence assigns all variables of 'pick_place'" in told[0]
    assert not out.exists()
    # The check says the same as a fault among what it lists.
    assert command.main(["--scene", str(task), "--check", "--out", str(out)]) == 2
    told = capsys.readouterr()
    assert "Kin(q1,t)" in told.out and "no sequence assigns all variables" in told.err


def test_an_infeasible_scene_names_operator_and_constraint(tmp_path):
    task, out = copied(tmp_path / "scene", edit_task=goal_in_the_wall), tmp_path / "out"
    out.mkdir()
    (out / "samples.npz").write_text("of an earlier run")
    done = start("--scene", task, "--instance", 8, "--time-budget", 8, "--out", out)
    assert done.returncode == 3, done.stderr
    told = done.stderr.splitlines()
    assert len(told) == 1, done.stderr
    assert re.search(r"no sample: operator .*q2.* 0 of \d+ times; .*q2\) stopped \d+ % of its failures", told[0])
    assert sorted(path.name for path in out.iterdir()) == ["run.json", "tree.json"]
    run = json.loads((out / "run.json").read_text())
    assert run["samples"] == 0 and run["ended_by"] == "time" and run["diagnosis"] in told[0]


# ------------------------------------------------------------------ wrong input


def refused(capsys, out, *arguments):
    """The one line with which the command refuses; nothing may be left in `out`."""
    assert command.main([*map(str, arguments), "--out", str(out)]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and len(captured.err.splitlines()) == 1, captured.err
    assert captured.err.startswith("sample.py: error: ")
    assert not out.exists()
    return captured.err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("", "the following arguments are required: --scene"),
        ("--scene bananna", "unknown scene 'bananna'.*available: banana, handover, pick_place"),
        ("--scene nowhere/task.toml", "no task file at nowhere/task.toml.*available"),
        ("--scene pick_place --instance 8", "instance 8 of scene 'pick_place' does not exist, expected 0 to 7"),
        ("--scene pick_place --instance -1", "instance -1 .* expected 0 to 7"),
        ("--scene pick_place --instance one", "--instance: invalid int value: 'one'"),
        ("--scene pick_place --time-budget 0", "--time-budget is 0, expected more than 0"),
        ("--scene pick_place --time-budget -3", "--time-budget is -3"),
        ("--scene pick_place --time-budget nan", "--time-budget is nan"),
        ("--scene pick_place --batch-size 0", "--batch-size is 0, expected at least 1"),
        ("--scene pick_place --batch-size -5", "--batch-size is -5"),
        ("--scene pick_place --batch-size 99999999999", "--batch-size is 99999999999, expected at most 1048576"),
        ("--scene pick_place --batch-size many", "--batch-size is 'many', expected a whole number or auto"),
        ("--scene pick_place --num-samples 0", "--num-samples is 0, expected at least 1"),
        ("--scene pick_place --coverage-gain 0", "--coverage-gain is 0, expected a share between 0 and 1"),
        ("--scene pick_place --coverage-gain 1.5", "--coverage-gain is 1.5"),
        ("--scene pick_place --diverse 0", "--diverse is 0"),
        ("--scene pick_place --tries 0", "--tries is 0"),
        ("--scene pick_place --seed -1", "--seed is -1"),
        ("--scene pick_place --c-uct 0", "--c-uct is 0"),
        ("--scene pick_place --reward money", "--reward: invalid choice: 'money'.*rate.*rollout"),
        ("--scene pick_place --speed 9", "unrecognized arguments: --speed 9"),
        ("--scene pick_place --method greedy", "unknown method 'greedy', expected one of: tree, tree-warm, rand, expert1"),
        ("--scene pick_place --method tree-warm", "'tree-warm' needs .*--warm-start FILE"),
        ("--scene pick_place --method rand --warm-start x.json", "no effect on method 'rand', expected one of: tree"),
        ("--scene pick_place --warm-start nowhere.json", "cannot read tree nowhere.json: No such file or directory$"),
    ],
)
def test_wrong_arguments_end_with_status_2_and_one_line(arguments, said, capsys, tmp_path):
    assert re.search(said, refused(capsys, tmp_path / "out", *arguments.split()))


@pytest.mark.parametrize(
    ("sequence", "said"),
    [
        ("q1; t; q2", r"step 1 \(q1\) is not possible .*available: t, \(q1,t\)"),
        ("t; q1", "leaves q2 unassigned"),
        ("t; q9; q2", "q9"),
        ("(t,q1; q2", r"step 1 \('\(t,q1'\) is not understood"),
        ("t; t; q1; q2", r"step 2 \(t\) is not possible after 't'; available: "),
    ],
)
def test_a_sequence_that_is_no_path_names_the_step(sequence, said, capsys, tmp_path):
    assert re.search(said, refused(capsys, tmp_path / "out", "--scene", "pick_place", "--method", sequence))


@pytest.mark.parametrize(
    ("edit_task", "edit_model", "said"),
    [
        (lambda text: text.replace("[robots.a]", "[robots.a"), None, "pick_place.toml: broken TOML"),
        (lambda text: text.replace("title =", "titel =", 1), None, "titel"),
        (lambda text: text.replace('site = "goal"', 'site = "gaol"'), None, "no site 'gaol' in the MJCF; available: .*goal"),
        (lambda text: text.replace('frame = "a_pinch"', 'frame = "a_punch"'), None, "no site 'a_punch'.*a_pinch"),
        (lambda text: text.replace('model = "pick_place.xml"', 'model = "other.xml"'), None, "no model file 'other.xml'"),
        (None, lambda text: text.replace("</worldbody>", ""), "pick_place.xml: not a valid MJCF"),
        (None, lambda text: text.replace("<worldbody>", '<worldbody><geom type="box" size="-1 1 1"/>'), "pick_place.xml"),
        (
            None,
            lambda text: text.replace("<worldbody>", '<worldbody><geom name="can" type="cylinder" size=".1 .1" pos="9 9 9"/>'),
            "geom 'can' .* unsupported type 'cylinder'; supported: sphere, capsule, box",
        ),
    ],
)  # fmt: skip
def test_a_wrong_scene_ends_with_status_2_and_one_line(edit_task, edit_model, said, capsys, tmp_path):
    same = lambda text: text  # noqa: E731
    task = copied(tmp_path / "scene", edit_task or same, edit_model or same)
    before = [(PICK_PLACE / task.with_suffix(suffix).name).read_text() for suffix in (".toml", ".xml")]
    assert before != [task.with_suffix(suffix).read_text() for suffix in (".toml", ".xml")], "the edit changed nothing"
    assert re.search(said, refused(capsys, tmp_path / "out", "--scene", task))


def test_an_output_that_cannot_be_written_is_found_before_sampling(capsys, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    message = refused(capsys, blocked / "out", "--scene", "pick_place")
    assert f"cannot write to {blocked / 'out'}" in message
    # Folders that were made for one output go again when the other cannot be written.
    message = refused(capsys, tmp_path / "a" / "b", "--scene", "pick_place", "--save-tree", blocked / "tree.json")
    assert f"cannot write to {blocked}" in message and not (tmp_path / "a").exists()
    (tmp_path / "taken" / "samples.npz").mkdir(parents=True)
    assert command.main(["--scene", "pick_place", "--out", str(tmp_path / "taken")]) == 2
    message = capsys.readouterr().err
    assert len(message.splitlines()) == 1 and f"cannot write to {tmp_path / 'taken' / 'samples.npz'}: it is a folder" in message
    assert f"cannot write to {tmp_path}" in refused(capsys, tmp_path / "out", "--scene", "pick_place", "--save-tree", tmp_path)


def test_a_process_with_wrong_input_prints_no_traceback_and_loads_no_jax():
    code = f"import runpy, sys; sys.argv = [{str(SCRIPT)!r}, '--scene', 'bananna']\n" + (
        f"try: runpy.run_path({str(SCRIPT)!r}, run_name='__main__')\n"
        "except SystemExit as end: print(end.code, 'jax' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["2", "False"] and len(done.stderr.splitlines()) == 1


def test_help_tells_every_option(capsys):
    with pytest.raises(SystemExit) as end:
        command.main(["--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    for action in command.parser()._actions:
        assert action.option_strings[0] in text


# ------------------------------------------------------------------ the cache


def test_programs_are_kept_on_disk_unless_switched_off(tmp_path):
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    for off, kept in ((["--no-cache"], False), ([], True)):
        done = subprocess.run(
            [sys.executable, SCRIPT, "--scene", "pick_place", "--num-samples", "1", "--out", tmp_path / "out", *off],
            env=environment | {"XDG_CACHE_HOME": str(tmp_path / "cache")}, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert (tmp_path / "cache" / "cgs_jax").exists() == kept
    shutil.rmtree(tmp_path / "cache")
