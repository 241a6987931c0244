"""docs/errors.md against the messages themselves: mistakes are made here, and each must be answered by a row of the page."""

import importlib.util
import io
import pickle
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loaded import problem

import cgs_jax
from cgs_jax import api, problems, render, report, worker
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
    'a report needs the package matplotlib, install it with: pip install -e ".[report]"': "the tests install it",
    "the libraries for pictures cannot be imported: …": "a machine without libraries",
    "…; or do without the picture: --no-picture": "a machine without libraries",
    "…: … can collide and has no enclosing primitive; expected meshes, cylinders, ellipsoids or …": "needs a height field",
    "only … of … random configurations bring the tool near the table without a collision; …": "a search, too slow here",
    "the robot's links give no model: …": "no file that compiles is known to lead there",
    "no sample of … in … s, expected …": "a measurement",
    "no sample: the run was interrupted before an operator had run": "in test_sample_command.py",
    "no sequence assigns all variables of '…': some have more equality rows than degrees of freedom, as --check lists; "
    "fewer are those of a looser grasp, or of a placement with bounds in place of a goal": "needs an arm of five joints",
    "… failed with status …: …": "a measurement",
    "… ended with status …: …": "a measurement",
    "… holds runs of another budget or other settings, choose another folder": "in test_reproduce.py",
    "MUJOCO_GL=… switches pictures off; unset it, or set it to egl or osmesa": "in test_render.py",
    "…: floating robot '…' hangs at switch '…'; expected a configuration of it there": "needs a second robot, in no scene",
    "OpenGL by … does not work here: …": "a machine without libraries",
    "OpenGL by … cannot draw: …": "a machine without memory",
    "port … does not exist, expected 1 to 65535": "in test_viewer.py, where viser is installed",
    "cannot serve on …: …": "in test_viewer.py, where viser is installed",
    "no free port on … from … to …": "a machine with a hundred ports in use",
    "no body '…' in the sample set's MJCF": "in test_viewer.py, where viser is installed",
    "MuJoCo's own viewer needs a display and DISPLAY is not set; --view works without one": "in test_viewer.py",
    "MuJoCo's own viewer …; --view works without …": "in test_viewer.py",
}


def load_script(name):
    spec = importlib.util.spec_from_file_location(f"{name}_command", ROOT / "scripts" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
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
        "--instance 8", "--time-budget 0", "--c-uct 0", "--collisions during", "--check --report", "--coverage-gain 2",
        "--batch-size many", "--batch-size 99999999", "--seed -1", "--speed 9",
        "--method greedy", "--method tree-warm", "--method rand --warm-start x.json", "--warm-start nowhere.json",
        "--method tree-warm --warm-start list.json", "--method t;q1", "--method (t,q1;q2", "--method q1;t;q2", "--method t;q9",
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
    (rows,) = re.findall(r"rows = (\[\[.*\]\])", (SCENES / task).read_text())
    yield task, rows, rows[:-1] + 2 * (", " + rows[1:-1]) + "]"
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
    yield lambda: list(cgs_jax.stream(at, num_samples=0))
    yield lambda: list(cgs_jax.stream(at, coverage_gain=1.0))
    yield lambda: problems.with_collisions(at, "during")
    yield lambda: cgs_jax.with_constraint(at, "Low", (), nothing, "equality", 1)
    in_single = lambda t: jax.lax.add(t[:1], jnp.ones(1, jnp.float32))  # noqa: E731
    yield lambda: cgs_jax.with_constraint(at, "Low", ("t",), in_single, "equality", 1)
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
    yield lambda: cgs_jax.with_variable(at, "force", 0, 0.0, 1.0)
    yield lambda: cgs_jax.with_variable(at, "force", 2, [0.0, 0.0, 0.0], 1.0)
    yield lambda: cgs_jax.with_variable(at, "force", 1, 0.0, float("inf"))
    yield lambda: cgs_jax.with_sampler(at, (), lambda key: ())
    yield lambda: cgs_jax.with_sampler(at, "q1", lambda key, q1: q1, given=("q1",))
    yield lambda: cgs_jax.with_sampler(at, "q1", lambda key: jnp.full(7, jnp.nan))
    yield lambda: cgs_jax.with_sampler(at, "q1", lambda key: jnp.full(7, 99.0))
    yield lambda: cgs_jax.with_sampler(at, "t", lambda key: jnp.ones(7))
    for cost in (lambda q9: q9[0], lambda q1: q1[0] + jnp.ones(3) @ q1, lambda q1: q1):
        yield lambda cost=cost: cgs_jax.operator(at, given=("t",), new=("q1",), cost=cost)
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
    yield lambda: render.check_indices(samples, [])
    for camera in ("above", "90,-91", "90,-25,0"):
        yield lambda camera=camera: render.Camera.parse(camera)
    yield lambda: render.contact_sheet(samples, [0], size=(1, 1))
    yield lambda: render.contact_sheet(samples, [0] * 1000, size=(4000, 4000))
    yield lambda: render.animation(samples, [0], hold=0.0)
    yield lambda: render.compile_model(replace(samples, mjcf="<mujoco"))
    yield lambda: render.compile_model(samples)
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


def reports(folder):
    """Mistakes in the folder of a run."""
    for name, run in (("none", None), ("list", "[]"), ("short", "{}")):
        (folder / name).mkdir()
        if run is not None:
            for file in ("run.json", "tree.json"):
                (folder / name / file).write_text(run)
        yield lambda name=name: report.save_report(folder / name)
    show = load_script("show")
    one = {"sequences": ("q",), "sequence": np.zeros(0, int), "elapsed": np.zeros(0), "violation": np.zeros((0, 0))}
    SampleSet("<mujoco/>", {"q": np.zeros((0, 2))}, ("pick",), np.zeros((0, 1, 1)), **one).save(folder / "empty.npz")
    yield lambda: show.show(show.parse().parse_args([str(folder / "empty.npz")]))


def other_sources():
    """What a worker answers to a process that loaded other sources."""
    answer = io.BytesIO()
    worker.serve(io.BytesIO(pickle.dumps("other")), answer)
    raise pickle.loads(answer.getvalue())


def robots(folder):
    """Mistakes in calls of import_robot.py and in the robot's file."""
    command = load_script("import_robot")
    arm = "<geom name='rod' type='capsule' size='.05 .1'/><site name='tip'/>"
    turning = f"<body name='arm'><joint name='turn' axis='0 0 1' range='-1 1'/>{arm}</body>"
    toy = lambda body: f"<mujoco><compiler angle='radian'/><worldbody>{body}</worldbody></mujoco>"  # noqa: E731
    files = {
        "good": toy(turning),
        "broken": "<mujoco",
        "other": "<sdf/>",
        "wrong": toy("<geom type='spere'/>"),
        "fixed": toy(f"<body name='arm'>{arm}</body>"),
        "ball": toy(turning.replace("axis='0 0 1' range='-1 1'", "type='ball'")),
        "slide": toy(turning.replace("range='-1 1'", "type='slide'")),
        "meshes": "<robot name='r'><link name='arm'><collision><geometry><mesh filename='no.stl'/></geometry></collision>"
        "</link></robot>",
    }
    for name, text in files.items():
        (folder / f"{name}.xml").write_text(text)
    (folder / "taken").mkdir()
    (folder / "taken" / "taken.xml").write_text("")
    for name, options in (
        ("good", "--home turn"), ("good", "--home turn=far"), ("good", "--shape rod=round"), ("good", "--flange tip"),
        ("good", "--out 7up"), ("good", "--out taken"), ("nowhere", ""), ("broken", ""), ("other", ""), ("wrong", ""),
        ("meshes", ""), ("good", "--approach w"), ("good", ""), ("good", "--tool arm:1,2"), ("good", "--tool hand"),
        ("fixed", "--tool tip"), ("ball", "--tool tip"), ("slide", "--tool tip"), ("good", "--home twist=1"),
        ("good", "--tool tip --home turn=9"), ("good", "--shape hand=box"), ("good", "--tool tip --shape rod=halves"),
        ("good", "--tool tip --grasp two_finger"),
    ):  # fmt: skip
        line = f"{name}.xml --out fresh --no-picture {options}".split()
        yield lambda line=line: command.write(command.parser().parse_args(line))


def measurements(folder):
    """Mistakes in calls of benchmark.py."""
    command = load_script("benchmark")
    alone = "search --method tree-warm --instances 0"
    for line in ("speed", "--peer-scenes mars", "--seconds 0", "--results x.json", alone):
        yield lambda line=line: command.check(command.parse().parse_args(line.split()))
    yield lambda: command.read_result(folder / "nowhere.json")
    yield lambda: command.read_result(folder / "list.json")
    nothing = {"schema": command.SCHEMA, "parts": {}}
    yield lambda: command.compare(nothing, nothing, 0.85)

    def more_cores_than_there_are():
        with command.on_cores(10**6):
            pass

    yield more_cores_than_there_are


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
        for call in (*calls(folder), *reports(folder), other_sources, *robots(folder), *measurements(folder)):
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
