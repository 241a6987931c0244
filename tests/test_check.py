"""Checks before sampling: nothing to say about the scenes, and each fault found by name."""

import contextlib
import importlib.util
import json
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from loaded import SCENES, problem, product, random_values

import cgs_jax
from cgs_jax import check, diagram, problems
from cgs_jax.scene import load_task

ROOT = Path(__file__).parents[1]
PICK_PLACE = ROOT / "scenes" / "pick_place"

_spec = importlib.util.spec_from_file_location("sample_command", ROOT / "scripts" / "sample.py")
assert _spec is not None and _spec.loader is not None
command = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(command)


def edited(folder, edit_task=lambda text: text, edit_model=lambda text: text):
    """pick_place in a folder of its own with its two files edited; the path of the task file."""
    for name, edit in (("pick_place.toml", edit_task), ("pick_place.xml", edit_model)):
        before = (PICK_PLACE / name).read_text()
        (folder / name).write_text(edit(before))
    return folder / "pick_place.toml"


def of_rows(monkeypatch, *names):
    """Leaves the Jacobians of other constraints out: their programs are compiled by other tests."""
    whole = check._check_constraints

    def some(at, seed):
        kept = {name: declaration for name, declaration in at.declarations.items() if name in names}
        found, _ = whole(problems.dataclasses.replace(at, declarations=kept), seed)
        return found, sum(c.equality_rows for c in at.graph.constraints)

    monkeypatch.setattr(check, "_check_constraints", some)


# ------------------------------------------------------------------ the scenes


@pytest.mark.parametrize("name", SCENES)
def test_the_scenes_have_no_fault(name):
    found = check.check_problem(problem(name))
    assert found.faults == ()
    graph = problem(name).graph
    assert [c.name for c in found.constraints] == [c.name for c in graph.constraints]
    assert found.dof == sum(v.dof for v in graph.variables)
    assert found.rank == found.equality_rows == sum(c.equality_rows for c in graph.constraints)
    counts = {"pick_place": (19, 8, 6), "handover": (2059, 163, 43), "banana": (19171, 534, 135)}
    assert (found.complete, found.pruned, found.problems) == counts[name]
    assert found.programs >= 3 and set(found.sequences) == set(load_task(name).sequences)
    measured = [c for c in found.constraints if c.rank is not None]
    assert {c.name for c in measured} == set(problem(name).declarations)
    assert all(c.rank == c.equality_rows and c.slope_error < 1e-3 for c in measured)
    json.dumps(found.as_json())


@pytest.mark.parametrize("name", SCENES)
def test_no_instance_is_out_of_reach_or_starts_in_penetration(name, monkeypatch):
    of_rows(monkeypatch)
    for instance in (1, 4, 7):
        assert check.check_problem(problems.load_problem(name, instance)).faults == (), instance


def test_ranks_agree_with_differences_of_the_products_in_double_precision():
    at = problem("handover")
    found = {c.name: c.rank for c in check.check_problem(at).constraints}
    for name in ("Kin(t_a,q_a2,p)", "Grasp(t_a)", "Position(p)"):
        declaration, data = at.declarations[name], at.params.rows[name]
        values = {v: random_values(at, 1, seed=3)[v] for v in declaration.scope}
        middle = product(at, declaration.product, values)[0]

        def rows(moved, middle=middle, declaration=declaration, data=data):
            pose = product(at, declaration.product, moved)[0]
            error = pose[:3, :3] @ middle[:3, :3].T
            skew = 0.5 * (error - error.T)
            vector = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
            dots = [(pose[:3, :3] @ data.inner_axes[i]) @ data.outer_axes[i] for i in range(3)]
            return np.concatenate([pose[:3, 3], vector if data.as_vector > 0.5 else dots])[data.low == data.high]

        columns = []
        for variable in declaration.scope:
            for i in range(values[variable].shape[1]):
                step = np.zeros_like(values[variable])
                step[0, i] = 1e-6
                ahead, behind = (rows(values | {variable: values[variable] + sign * step}) for sign in (1, -1))
                columns.append((ahead - behind) / 2e-6)
        assert np.linalg.matrix_rank(np.array(columns), tol=1e-5) == found[name]


# ------------------------------------------------------------------ faults


def fault_of(found, said):
    """The one fault."""
    (fault,) = found.faults
    assert re.search(said, fault) and "\n" not in fault
    return fault


@jax.custom_jvp
def _sine_with_a_wrong_slope(x):
    return jnp.sin(x)


@_sine_with_a_wrong_slope.defjvp
def _(primals, tangents):
    return jnp.sin(primals[0]), 0.3 * tangents[0]


def test_a_gradient_that_is_none_is_named(monkeypatch):
    of_rows(monkeypatch, "Bent(q1)", "Straight(q2)")
    at = cgs_jax.with_constraint(
        problem("pick_place"), "Bent(q1)", ["q1"], lambda q1: _sine_with_a_wrong_slope(q1[2:3]), "inequality", 1
    )
    at = cgs_jax.with_constraint(at, "Straight(q2)", ["q2"], lambda q2: jnp.sin(q2[2:3]), "inequality", 1)
    fault_of(check.check_problem(at), r"^Bent\(q1\): its gradient by q1 differs from finite differences by [\d.]+ at [78] of 8")


def test_a_gradient_cut_off_is_found_by_its_pose(monkeypatch):
    of_rows(monkeypatch, "Cut(t)")
    cut = lambda t, q1: jax.lax.stop_gradient(t[:1]) + q1[:1]  # noqa: E731
    at = cgs_jax.with_constraint(problem("pick_place"), "Cut(t)", ["t", "q1"], cut, "inequality", 1)
    fault_of(check.check_problem(at), r"^Cut\(t\): its gradient by t differs .* by 1 at 8 of 8")


def test_rows_that_depend_on_each_other_are_named(monkeypatch):
    of_rows(monkeypatch, "Twice(q1)")
    twice = lambda q1: jnp.stack([q1[0], 2 * q1[0]])  # noqa: E731
    at = cgs_jax.with_constraint(problem("pick_place"), "Twice(q1)", ["q1"], twice, "equality", 2)
    fault_of(check.check_problem(at), r"^Twice\(q1\): 2 equality rows are declared, its Jacobian has rank 1")


def test_constraints_that_depend_on_each_other_are_told_together():
    low = lambda q1: q1[:1] - 0.1  # noqa: E731
    at = cgs_jax.with_constraint(problem("pick_place"), "Low(q1)", ["q1"], low, "equality", 1)
    at = cgs_jax.with_constraint(at, "Again(q1)", ["q1"], low, "equality", 1)
    found = check.check_problem(at)
    fault_of(found, "depend on each other: 18 equality rows in all, their Jacobian has rank 17")


def test_a_pose_out_of_reach_is_named_with_its_robot(tmp_path, monkeypatch):
    of_rows(monkeypatch)
    far = edited(tmp_path, lambda text: text.replace("[[instances]]", '[[instances]]\nsite.goal = { pos = [2.5, 0, 0.5] }', 1))
    found = check.check_problem(problems.load_problem(far))
    fault = fault_of(found, "robot a cannot bring a_pinch to the goal of box at place: it is .* m away")
    model = problems.load_problem(far).scene.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    shoulder = data.xanchor[model.joint(load_task("pick_place").robots[0].joints[0]).id]
    away = float(re.search(r"it is ([\d.]+) m", fault)[1])
    # The grasp may be that much nearer than the middle of the box.
    middle = np.linalg.norm(np.array([2.5, 0, 0.5]) - shoulder)
    assert middle - 0.2 < away <= middle + 0.01


def test_a_placement_that_two_robots_cannot_share_is_named(tmp_path, monkeypatch):
    of_rows(monkeypatch)
    text = (ROOT / "scenes" / "handover" / "handover.toml").read_text()
    (tmp_path / "handover.xml").write_text((ROOT / "scenes" / "handover" / "handover.xml").read_text())
    high = text.replace("low = [-0.30, -0.40, 0.35]", "low = [-0.30, -0.40, 2.0]")
    (tmp_path / "handover.toml").write_text(high.replace("high = [0.30, 0.40, 0.85]", "high = [0.30, 0.40, 2.2]"))
    found = check.check_problem(problems.load_problem(tmp_path / "handover.toml"))
    assert len(found.faults) == 2
    for robot, fault in zip("ab", found.faults, strict=True):
        assert f"robot {robot} cannot bring {robot}_pinch to the placement p of box at handover" in fault


def test_no_point_that_two_robots_share_is_told(tmp_path, monkeypatch):
    of_rows(monkeypatch)
    text = (ROOT / "scenes" / "handover" / "handover.toml").read_text()
    model = (ROOT / "scenes" / "handover" / "handover.xml").read_text()
    (tmp_path / "handover.toml").write_text(text.replace("[-0.30, -0.40, 0.35]", "[-2.5, -0.40, 0.35]").replace(
        "[0.30, 0.40, 0.85]", "[2.5, 0.40, 0.85]"))  # fmt: skip
    (tmp_path / "handover.xml").write_text(model)
    assert check.check_problem(problems.load_problem(tmp_path / "handover.toml")).faults == ()
    apart = model.replace('pos="-.65 0 0"', 'pos="-1.85 0 0"').replace('pos=".65 0 0"', 'pos="1.85 0 0"')
    (tmp_path / "handover.xml").write_text(apart)
    faults = check.check_problem(problems.load_problem(tmp_path / "handover.toml")).faults
    assert any("no point of it is within reach of a/a_pinch and b/b_pinch together" in fault for fault in faults)


def test_geoms_that_overlap_at_the_start_are_named(tmp_path, monkeypatch):
    of_rows(monkeypatch)
    at = problem("pick_place")
    pos = at.scene.object_pose("box")[:3] + [0, 0, 0.03]
    wedge = f'<worldbody><geom name="wedge" type="sphere" size="0.05" pos="{pos[0]} {pos[1]} {pos[2]}"/>'
    task = edited(tmp_path, edit_model=lambda text: text.replace("<worldbody>", wedge, 1))
    found = check.check_problem(problems.load_problem(task))
    named = [(o.first, o.second) for o in found.overlaps if o.where == "home"]
    assert len(named) == 1 and "wedge" in named[0] and all(o.depth > 0.02 for o in found.overlaps)
    fault_of(found, r"^home: geoms '\w+' and '\w+' penetrate by \d+\.\d mm$")


def test_a_sequence_that_is_no_path_is_named(tmp_path, monkeypatch):
    of_rows(monkeypatch)
    text = edited(tmp_path, lambda text: re.sub(r'expert2 = ".*"', 'expert2 = "q1; t; q2"', text))
    found = check.check_problem(problems.load_problem(text))
    assert found.sequences["expert2"] and not found.sequences["expert1"]
    fault_of(found, r"sequence 'expert2' is no path of the pruned graph: step 1 \(q1\) is not possible")


def test_a_sequence_that_only_an_added_constraint_stops_is_a_note_and_a_wrong_one_still_a_fault(tmp_path, monkeypatch):
    of_rows(monkeypatch)
    text = edited(tmp_path, lambda text: re.sub(r'expert3 = ".*"', 'expert3 = "q1; t; q2"', text))
    low = lambda t, q1: q1[:2] - t[:2]  # noqa: E731
    at = problems.load_problem(text)
    assert check.check_problem(at).notes == ()
    # Given t, q1 has 7 degrees of freedom and 6 + 2 rows: it must come with t.
    found = check.check_problem(cgs_jax.with_constraint(at, "Low(t,q1)", ["t", "q1"], low, "equality", 2))
    fault_of(found, r"^sequence 'expert3' is no path of the pruned graph: step 1 \(q1\)")
    (note,) = found.notes
    assert note.startswith("sequence 'expert2' of the task is no path with what was added to it: step 1 (t)")


# ------------------------------------------------------------------ the command


def run(capsys, *arguments):
    with contextlib.suppress(SystemExit):
        status = command.main(["--scene", *map(str, arguments), "--check"])
    told = capsys.readouterr()
    return status, told.out, told.err


def test_the_command_prints_tables_and_draws_the_graph(capsys, tmp_path):
    out = tmp_path / "out"
    status, said, error = run(capsys, "pick_place", "--out", out)
    assert (status, error) == (0, "") and [path.name for path in out.iterdir()] == ["graph.svg"]
    for words in ("Kin(q1,t)", "start of box at pick", "a/a_pinch", "none", "19 -> 8", "6 conditional problems", "graph.svg"):
        assert words in said


def test_the_command_ends_with_status_2_and_a_line_per_fault(capsys, tmp_path, monkeypatch):
    of_rows(monkeypatch)
    both = lambda text: re.sub(r'expert2 = ".*"', 'expert2 = "q1; t; q2"', text).replace(  # noqa: E731
        "[[instances]]", "[[instances]]\nsite.goal = { pos = [2.5, 0, 0.5] }", 1
    )
    task = edited(tmp_path, both)
    status, said, error = run(capsys, task, "--out", tmp_path / "out", "--json")
    assert status == 2 and len(error.splitlines()) == 2
    assert all(line.startswith("sample.py: fault: ") for line in error.splitlines())
    assert [f"sample.py: fault: {fault}" for fault in json.loads(said)["faults"]] == error.splitlines()
    status, said, again = run(capsys, task, "--out", tmp_path / "out", "--quiet")
    assert (status, said, again) == (2, "", error)


@pytest.mark.parametrize("flag", ["--render", "--report", "--view", "--profile", "--diverse=3"])
def test_flags_that_need_samples_are_refused(flag, capsys, tmp_path):
    status, said, error = run(capsys, "pick_place", flag, "--out", tmp_path / "out")
    assert (status, said) == (2, "") and f"{flag.split('=')[0]} has no effect with --check" in error
    assert not (tmp_path / "out").exists()


def test_a_method_that_is_none_is_refused(capsys, tmp_path, monkeypatch):
    of_rows(monkeypatch)
    status, _, error = run(capsys, "pick_place", "--method", "greedy", "--out", tmp_path / "out")
    assert status == 2 and "unknown method 'greedy'" in error and not (tmp_path / "out").exists()


# ------------------------------------------------------------------ the drawing

SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize("name", SCENES)
def test_the_drawing_has_every_variable_constraint_and_edge_and_no_two_on_one_place(name):
    at = problem(name)
    root = ElementTree.fromstring(diagram.draw(diagram.describe(at.graph, at.scene.task)))
    groups = [group for group in root.iter(f"{SVG}g")]
    titles = [group.find(f"{SVG}title").text for group in groups]
    wanted = [c.name for c in at.graph.constraints] + [v.name for v in at.graph.variables]
    assert [title.rpartition(":")[0] for title in titles] == wanted
    edges = list(root.iter(f"{SVG}line"))
    assert len(edges) == sum(len(c.scope) for c in at.graph.constraints)
    centres, width = [], float(root.get("width"))
    for group in groups:
        circle, square = group.find(f"{SVG}circle"), group.find(f"{SVG}rect")
        if circle is not None:
            centres.append((float(circle.get("cx")), float(circle.get("cy"))))
        else:
            half = float(square.get("width")) / 2
            centres.append((float(square.get("x")) + half, float(square.get("y")) + half))
    centres = np.array(centres)
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2) + 1e3 * np.eye(len(centres))
    assert apart.min() > 40 and 20 < centres[:, 0].min() and centres[:, 0].max() < width - 20
    ends = {(round(float(e.get(f"x{i}")), 1), float(e.get(f"y{i}"))) for e in edges for i in (1, 2)}
    assert ends == {(round(x, 1), y) for x, y in centres}
    # A configuration stands in the column of its switch, a grasp between those of its hold.
    columns = [r for r in root.findall(f"{SVG}rect")[1:]]
    spans = [(float(c.get("x")), float(c.get("x")) + float(c.get("width"))) for c in columns]
    place = dict(zip(wanted, centres[:, 0], strict=True))
    for k, switch in enumerate(at.scene.task.switches):
        for variable in switch.configurations.values():
            assert spans[k][0] < place[variable] < spans[k][1]
    for hold in at.scene.task.holds:
        first, last = at.scene.task.span(hold)
        assert spans[first][0] < place[hold.variable] < spans[last][1]


def test_a_variable_of_ones_own_is_checked_and_drawn_beside_what_it_is_tied_to():
    at = cgs_jax.with_variable(problem("pick_place"), "f", 1, -40.0, 40.0)
    at = cgs_jax.with_constraint(at, "Push(q2,f)", ["q2", "f"], lambda q2, f: f - 20.0 * q2[:1], "equality", 1)
    found = check.check_problem(at)
    # The task's own sequences do not assign it, which is none of their faults.
    assert found.faults == () and len(found.notes) == len(found.sequences) == 3
    assert all(f"'{name}' of the task is no path" in note for name, note in zip(found.sequences, found.notes, strict=True))
    assert found.rank == found.equality_rows == 17
    (push,) = [c for c in found.constraints if c.name == "Push(q2,f)"]
    assert push.rank == 1 and push.slope_error < 1e-3 and push.dof == 8
    described = diagram.describe(at.graph, at.scene.task)
    (own,) = [v for v in described["variables"] if v["name"] == "f"]
    assert own["kind"] == "vector" and own["columns"] == [1, 1]
    root = ElementTree.fromstring(diagram.draw(described))
    places = {c.get("cx") for c in root.iter(f"{SVG}circle")}
    assert len(places) == len(at.graph.variables)
