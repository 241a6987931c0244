"""docs/errors.md against the messages themselves: mistakes are made here, and each must be answered by a row of the page."""

import importlib.util
import re
import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from loaded import problem

import cgs_jax
from cgs_jax import api, render
from cgs_jax.errors import InputError
from cgs_jax.record import Recorder
from cgs_jax.samples import SampleSet

ROOT = Path(__file__).parents[1]
SCENES = ROOT / "scenes"
ROWS = re.findall(r"^\| `(.+?)` \|", (ROOT / "docs" / "errors.md").read_text(encoding="utf-8"), flags=re.M)

# Rows that no mistake below leads to, and why.
UNTRIED = {
    "pictures need OpenGL without a display, and neither EGL (…) nor OSMesa (…) works…": "a machine without libraries",
    '--view needs the package viser, install it with: pip install -e ".[viewer]"': "the tests install it",
    "no sample: operator … succeeded … of … times; … stopped … % of its failures": "a run, in test_sample_command.py",
    "no sample: operator … succeeded … of … times; give more time with --time-budget": "a run that succeeds too late",
    "… lacks …, expected every key of schema …": "in test_samples.py",
}


def load_script(name):
    spec = importlib.util.spec_from_file_location(f"{name}_command", ROOT / "scripts" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pattern(row):
    return re.compile(".*?".join(re.escape(part) for part in row.split("…")), flags=re.S)


def command_lines(folder):
    """Mistakes in calls of the command."""
    (folder / "file").write_text("in the way")
    (folder / "list.json").write_text("[]")
    yield "--scene bananna"
    yield "--scene nowhere/task.toml"
    for options in (
        "--instance 8", "--time-budget 0", "--coverage-gain 2", "--batch-size many", "--seed -1", "--speed 9",
        "--method greedy", "--method tree-warm", "--method rand --warm-start x.json", "--warm-start nowhere.json",
        "--method tree-warm --warm-start list.json", "--method t;q1", "--method (t,q1;q2", "--method q1;t;q2",
        "--out file/out",
    ):  # fmt: skip
        yield f"--scene pick_place {options}"


def edited_scenes():
    """Mistakes in the files of a scene: the file and what to replace with what."""
    task, model = "pick_place/pick_place.toml", "pick_place/pick_place.xml"
    yield task, "[robots.a]", "[robots.a"
    yield task, "title =", "titel ="
    yield task, 'site = "goal"', 'site = "gaol"'
    yield task, 'home = "home"', 'home = "away"'
    yield task, 'model = "pick_place.xml"', 'model = "other.xml"'
    yield task, 'configurations = { a = "q2" }', "configurations = { }"
    yield task, "expert1 =", 'twice = "t; t; q1"\nexpert1 ='
    goal = re.search(r"\[\[goals\]\]\n(?:.+\n)+", (SCENES / task).read_text()).group()
    yield task, goal, goal + "\n" + goal
    yield model, "</worldbody>", ""
    yield model, "<worldbody>", '<worldbody><geom name="can" type="ellipsoid" size=".1 .1 .1" pos="9 9 9"/>'
    joint = re.search(r'<joint name="a_joint1"[^>]*>', (SCENES / model).read_text()).group()
    yield model, joint, re.sub(r' range="[^"]*"', "", joint)
    task = "handover/handover.toml"
    handover = re.search(r'name = "handover"\nconfigurations = .*', (SCENES / task).read_text()).group()
    yield task, handover, re.sub(r"{.*}", '{ a = "q_a2" }', handover)
    # Without its placement, and without all that names it.
    rest = (SCENES / task).read_text()
    rest = rest[rest.index("[[placements]]") :]
    yield task, rest, rest[rest.index("[[goals]]") : rest.index("[sequences]")] + "[[instances]]\n"


def calls(folder):
    """Mistakes in calls from Python."""
    at = problem("pick_place")
    nothing = lambda **_: jnp.zeros(1)  # noqa: E731
    yield lambda: list(cgs_jax.stream(at, time_budget=-1))
    yield lambda: cgs_jax.with_constraint(at, "Grasp(t)", ("t",), nothing, "equality", 1)
    yield lambda: cgs_jax.with_constraint(at, "Low", ("t",), nothing, "about", 1)
    yield lambda: cgs_jax.with_constraint(at, "Low", ("t",), nothing, "equality", 0)
    yield lambda: cgs_jax.with_constraint(at, "Low", ("t9",), nothing, "equality", 1)
    yield lambda: cgs_jax.with_constraint(at, "Low", ("t",), lambda t: t[:2], "equality", 1)
    yield lambda: cgs_jax.with_constraint(at, "Low", ("t",), lambda q: q, "equality", 1)
    yield lambda: cgs_jax.with_constraint(at, "Low", ("t",), lambda t: jnp.log(-jnp.abs(t[:1])), "equality", 1)
    yield lambda: cgs_jax.with_constraint(at, "Low", ("t",), lambda t: t[:3], "equality", 3)
    yield lambda: cgs_jax.with_variable(at, "t", 1, 0.0, 1.0)
    yield lambda: cgs_jax.with_variable(at, "one two", 1, 0.0, 1.0)
    yield lambda: cgs_jax.with_variable(at, "force", 1, 2.0, 1.0)
    drawn = cgs_jax.with_sampler(at, "q1", lambda key: jnp.zeros(7) + jnp.array([0, 0, 0, -1.5, 0, 1.5, 0]))
    yield lambda: cgs_jax.with_sampler(drawn, "q1", lambda key: jnp.zeros(7))
    yield lambda: cgs_jax.with_sampler(at, "q1", lambda: jnp.zeros(7))
    yield lambda: cgs_jax.with_sampler(at, "q1", lambda key: jnp.zeros(6))
    yield lambda: cgs_jax.operator(at, given=("t9",), new=("q1",))
    yield lambda: cgs_jax.operator(at, given=("t",), new=("t",))
    yield lambda: cgs_jax.operator(at, given=("t",), new=("q1",))(None, {}, at.params)
    yield lambda: cgs_jax.operator(at, given=(), new=("t",))(None, {}, at.params)
    tree = api.make_chooser(problem("handover")).as_json()
    yield lambda: cgs_jax.make_chooser(at, "tree-warm", prior=[tree])
    yield lambda: cgs_jax.make_chooser(at, "tree-warm", prior=[{"schema": "older"}])
    one = {"sequences": ("q",), "sequence": [0], "elapsed": [0.0], "violation": [[]]}
    samples = SampleSet("<mujoco/>", {"q": np.zeros((1, 2))}, ("pick",), np.zeros((1, 1, 2)), **one)
    yield lambda: samples["t"]
    yield lambda: samples.save(folder / "file" / "samples.npz")
    yield lambda: SampleSet.load(folder / "nowhere")
    yield lambda: SampleSet.load(folder / "file")
    np.savez(folder / "other.npz", schema=np.array("other"))
    yield lambda: SampleSet.load(folder / "other.npz")
    yield lambda: render.switch_index(samples, "place")
    yield lambda: render.check_indices(samples, [3])
    show = load_script("show")
    yield lambda: show.choose(samples, "some")
    yield lambda: show.parse_size("big")
    samples.save(folder / "good.npz")
    yield lambda: show.show(show.parse().parse_args([str(folder / "good.npz"), "--sheet", str(folder / "sheet.gif")]))

    def no_operator_ran():
        record = Recorder.__new__(Recorder)
        record.operators = {}
        raise InputError(f"no sample: {record.diagnosis()}")

    yield no_operator_ran


@pytest.fixture(scope="module")
def messages(tmp_path_factory):
    """Every message that the mistakes lead to."""
    folder = tmp_path_factory.mktemp("mistakes")
    sample = load_script("sample")
    found = []

    def note(make):
        with pytest.raises(InputError) as error:
            make()
        found.append(str(error.value))

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line in command_lines(folder):
            note(lambda line=line: sample.run(sample.parser().parse_args([*line.split(" "), "--quiet"])))
        for i, (path, before, after) in enumerate(edited_scenes()):
            name = path.split("/")[0]
            scene = folder / f"scene{i}"
            shutil.copytree(SCENES / name, scene)
            text = (SCENES / path).read_text()
            assert before in text
            (scene / path.split("/")[1]).write_text(text.replace(before, after))
            note(lambda scene=scene, name=name: cgs_jax.load_problem(scene / f"{name}.toml"))
        for call in calls(folder):
            note(call)
    return found


def test_every_mistake_is_one_line_that_the_page_explains(messages):
    for message in messages:
        assert len(message.splitlines()) == 1
        assert any(pattern(row).fullmatch(message) for row in ROWS), message


def test_every_row_of_the_page_is_a_message(messages):
    assert len(ROWS) == len(re.findall(r"^\| `", (ROOT / "docs" / "errors.md").read_text(encoding="utf-8"), flags=re.M))
    unmet = {row for row in ROWS if not any(pattern(row).fullmatch(message) for message in messages)}
    assert unmet == set(UNTRIED), unmet ^ set(UNTRIED)
