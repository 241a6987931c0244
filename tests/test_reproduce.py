"""Experiments: measures against numbers known beforehand, and a whole study with made-up runs."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import made_up
import numpy as np
import pytest
from loaded import problem
from made_up import PAPER
from paper_graphs import handover

from cgs_jax.api import make_chooser
from cgs_jax.errors import InputError
from cgs_jax.experiments import Budget, Study, claims, measures, runs, study, write_report
from cgs_jax.sampler import SamplerSettings
from cgs_jax.transitions import Transitions
from cgs_jax.uct import Tree

ROOT = Path(__file__).parents[1]


# ------------------------------------------------------------------ measures


def test_rates_of_a_steady_stream_are_its_rate():
    elapsed = (np.arange(1000) + 0.5) / 100  # 100 per second for 10 s
    times = measures.time_grid(10.0)
    assert len(times) == 100 and times[-1] == 10.0
    np.testing.assert_allclose(measures.rate_over_time(elapsed, times), 100.0, atol=1.01)
    assert measures.final_rate(elapsed, 10.0) == 100.0


def test_final_rate_counts_the_last_half_and_nothing_after_the_budget():
    assert measures.final_rate(np.array([0.1, 4.9, 5.1, 9.9, 10.3]), 10.0) == pytest.approx(2 / 5)
    assert measures.final_rate(np.zeros(0), 10.0) == 0.0


def test_when_a_curve_gets_there():
    times = np.array([1.0, 2.0, 3.0, 4.0])
    assert measures.first_time_at(np.array([0.0, 5.0, 4.0, 5.0]), times, 5.0) == 2.0
    assert measures.first_time_at(np.array([0.0, 5.0, 4.0, 5.0]), times, 6.0) is None
    theirs = np.full(4, 3.0)
    assert measures.time_of_overtaking(np.array([0.0, 5.0, 2.0, 5.0]), theirs, times) == 4.0
    assert measures.time_of_overtaking(np.array([4.0, 5.0, 3.0, 5.0]), theirs, times) == 1.0
    assert measures.time_of_overtaking(np.array([4.0, 5.0, 4.0, 2.0]), theirs, times) is None


def test_ratio_with_nothing_below_is_no_ratio():
    assert measures.ratio_with_interval([1.0, 2.0], [0.0, 0.0])["ratio"] is None
    ratio = measures.ratio_with_interval([3.0, 3.2, 2.8], [1.0, 1.1, 0.9])
    assert ratio["ratio"] == pytest.approx(3.0) and ratio["low"] < 3.0 < ratio["high"]


def test_what_both_gain_on_a_quick_machine_does_not_widen_the_interval_of_their_ratio():
    ratio = measures.ratio_with_interval([1.0, 2.0, 4.2], [1.0, 2.0, 4.0])
    assert ratio["ratio"] == pytest.approx(7.2 / 7.0) and 1.0 <= ratio["low"] and ratio["high"] <= 1.05


def test_half_the_space_is_half_the_coverage():
    random = np.random.default_rng(0)

    def square(count, width):
        return {"x": random.uniform([0, 0], [width, 1], (count, 2))}

    values = {"tree": [square(3000, 1.0), square(3000, 1.0)], "half": [square(3000, 0.5)], "few": [square(10, 1.0)]}
    result = measures.coverage_of_instance(values, square(6000, 1.0), {"x": "vector"}, least=50)
    variable = result["variables"]["x"]
    assert variable["fill_as_wanted"] and result["count"] == 3000
    share = np.mean(variable["methods"]["half"]["cells_at_equal_time"])
    share /= np.mean(variable["methods"]["tree"]["cells_at_equal_time"])
    # Cells hold a few samples each: twice the density in half the space is more than half the cells, but not all.
    assert 0.5 < share < 0.8
    assert "cells_at_equal_count" not in variable["methods"]["few"]
    (distance,) = variable["methods"]["half"]["radius_at_equal_time"]
    assert distance == pytest.approx(0.5, abs=0.05)
    ratios = measures.relative_to_tree([result], "x", "tree", "cells_at_equal_time")
    assert np.mean(ratios) == pytest.approx(1.0) and len(ratios) == 2


def test_methods_are_compared_over_the_seeds_that_both_have():
    """The machine was slow when tree's third seed ran."""
    assert measures.side_by_side([4.0, 6.0, 1.0], [2.0, 2.0]) == ([4.0, 6.0], [2.0, 2.0])
    cells = {"tree": {"cells": [40, 60, 10]}, "expert": {"cells": [20, 30]}}
    assert measures.relative_to_tree([{"variables": {"x": {"methods": cells}}}], "x", "expert", "cells") == [0.4, 0.6]


def test_the_best_sequence_beside_tree_is_the_oracle():
    sequences = {"best expert": "a; b", "best found": "(a,b)"}
    final = {"tree": [4.0, 6.0], "best expert": [2.0, 2.0], "best found": [3.0, 5.0]}
    alone = {"tree": [4.0], "best expert": [5.0]}
    scene = {
        "turns": [
            {"instance": 0, "expert": "expert2", "final": final, "sequences": sequences},
            {"instance": 1, "expert": "expert1", "final": alone, "sequences": {"best expert": "a; b"}},
        ]
    }
    experts = claims.expert_ratios(scene)
    assert [(e["expert"], e["ratio"]) for e in experts] == [("expert2", pytest.approx(2.5)), ("expert1", pytest.approx(0.8))]
    (oracle,) = claims.oracle_ratios(scene)
    assert (oracle["label"], oracle["sequence"], oracle["rate"]) == ("best found", "(a,b)", 4.0)
    assert oracle["ratio"] == pytest.approx(1.25)


# ------------------------------------------------------------------ sequences


def test_covering_sequences_use_every_operator():
    transitions = Transitions(handover())
    paths = runs.covering_sequences(transitions)
    assert {t.problem for path in paths for t in path} == set(transitions.problems())
    assert all(path[0].given == frozenset() and path[-1].target == transitions.full for path in paths)


def test_survey_runs_all_its_sequences_and_skips_those_that_are_not_ready():
    transitions = Transitions(handover())
    survey = runs.Survey(transitions)
    chosen = {survey.select() for _ in runs.covering_sequences(transitions)}
    assert {t.problem for path in chosen for t in path} == set(transitions.problems())
    assert survey.select(lambda transition: len(transition.new) == 7)[0].target == transitions.full
    assert survey.select(lambda transition: False) == ()


def test_ranking_finds_the_sequence_whose_operators_are_cheap():
    transitions = Transitions(handover())
    wanted = transitions.parse("t_a; q_a1; (q_a2,q_b2,p,t_b); q_b1")
    cheap = runs.signature(wanted)
    trees = []
    for half in (0, 1):  # what two runs know together
        tree = Tree(transitions)
        for number, path in enumerate(runs.covering_sequences(transitions)):
            for position, transition in enumerate(path):
                if number % 2 == half:
                    seconds = 0.001 if transition.problem in cheap else 1.0
                    tree.record(path[:position], transition, 100, 80, seconds)
        trees.append(tree.as_json())
    merged = runs.merged_tree(transitions, trees)
    ranked = runs.ranked_sequences(merged, workers=2)
    assert runs.signature(ranked[0][0]) == cheap
    assert ranked[0][1] == pytest.approx(2 * merged.predict_rate(wanted), rel=1e-6)
    signatures = [runs.signature(path) for path, _ in ranked]
    assert len(set(signatures)) == len(signatures) < transitions.count_sequences()
    first = merged.operator_statistics()[wanted[0].problem]
    assert first.visits == sum(
        entry["visits"] for tree in trees for entry in tree["operators"] if tuple(entry["new"]) == ("t_a",)
    )


def test_operation_is_named_as_in_the_record():
    transitions = Transitions(handover())
    for entry in PAPER["handover"]["operations"]:
        name = runs.operation_name(transitions, entry["sequence"], entry["new"])
        assert name.split(" |")[0].strip("()").split(",") == list(
            transitions.graph.ordered(entry["new"])
        ) or set(name.split(" |")[0].strip("()").split(",")) == set(entry["new"])


# ------------------------------------------------------------------ a whole study with made-up runs

BUDGET = Budget(
    seconds=2.0, seeds=2, instances=2, coverage_least=20, sweep_instances=1, sweep_seeds=1, prices=(0.1, 1.0),
    exploration=(0.3,), oracle_instances=1, survey_seconds_per_operator=0.01, screened=3, screen_seconds=0.5,
    printed_seconds=0.5, settling_seconds=2.0, turns_seconds=1.0, turns_seeds=2, operation_seconds=0.5,
)  # fmt: skip


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished study, and the runs that it made."""
    made = []

    def record(problem, chooser, run, *arguments, **named):
        made.append(run)
        return made_up.run(problem, chooser, run, *arguments, **named)

    def record_in_turns(problem, choosers, runs, settings):
        return [record(problem, chooser, run, settings) for chooser, run in zip(choosers, runs, strict=True)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "execute", record)
        patch.setattr(study, "execute_in_turns", record_in_turns)
        patch.setattr(study, "prepare", lambda problem, settings: iter(()))
        patch.setattr(study, "keep", lambda count: None)
        whole = Study(tmp_path_factory.mktemp("study"), ["handover"], BUDGET, PAPER)
        progress = list(whole.execute())
        yield whole, made, progress


def test_study_makes_every_run_once_and_goes_on_where_it_stopped(finished):
    whole, made, progress = finished
    assert made == whole.runs() and len(set(made)) == len(made)
    assert progress[-1].done == progress[-1].total and [p.done for p in progress] == sorted(p.done for p in progress)
    lost = next(run for run in made if run.stage == "screen")
    (whole.store.folder / f"{lost.key}.json").unlink()
    count = len(made)
    list(Study(whole.folder, ["handover"], BUDGET, PAPER).execute())
    assert made[count:] == [lost]
    del made[count:]
    assert whole.estimate() == 0.0


def test_what_ran_side_by_side_is_run_again_together(finished):
    whole, made, _ = finished
    lost = next(run for run in made if (run.stage, run.method, run.seed) == ("turns", "best expert", 1))
    (whole.store.folder / f"{lost.key}.json").unlink()
    count = len(made)
    list(Study(whole.folder, ["handover"], BUDGET, PAPER).execute())
    assert [(run.method, run.seed) for run in made[count:]] == [("tree", 1), ("best expert", 1), ("best found", 1)]
    assert [(run.instance, run.seconds) for run in made[count:]] == [(0, 3.0), (0, 1.0), (0, 1.0)]
    del made[count:]


def test_settings_of_a_sweep_run_side_by_side_on_every_instance(finished):
    whole, made, _ = finished
    swept = [run for run in made if run.stage == "sweep"]
    (whole.store.folder / f"{swept[0].key}.json").unlink()
    count = len(made)
    list(Study(whole.folder, ["handover"], BUDGET, PAPER).execute())
    assert made[count:] == swept
    del made[count:]


def test_side_by_side_everyone_has_its_own_time_and_waits_for_the_others(monkeypatch):
    at = problem("pick_place")
    turns = []
    go_on = runs._Competitor.go_on

    def spy(self, seconds):
        turns.append(self)
        go_on(self, seconds)

    monkeypatch.setattr(runs, "TURN", 0.2)
    monkeypatch.setattr(runs._Competitor, "go_on", spy)
    settings = SamplerSettings(batch_size=128, lanes=32, workers=1)
    sequences = at.scene.task.sequences
    both = [runs.Run("turns", "pick_place", 0, name, 0, 0.6) for name in list(sequences)[1:3]]
    for run in both:  # programs
        runs.execute(at, make_chooser(at, run.method, 0), run, settings)
    turns.clear()
    began = time.perf_counter()
    first, second = runs.execute_in_turns(at, [make_chooser(at, run.method, 0) for run in both], both, settings)
    passed = time.perf_counter() - began
    assert turns[0] is not turns[1] and turns[2:4] == turns[:2]
    for kept, run in ((first, both[0]), (second, both[1])):
        assert kept.data["meta"]["ended_by"] == "time" and list(kept.data["sequences"]) == [sequences[run.method]]
        assert 0.6 <= kept.data["meta"]["elapsed"] < 0.6 + 0.5 * passed
        assert len(kept.elapsed) and kept.elapsed.max() > 0.3
    assert passed > first.data["meta"]["elapsed"] + second.data["meta"]["elapsed"] - 0.01


def test_a_longer_run_begins_alone_and_ends_with_those_beside_it(monkeypatch):
    at = problem("pick_place")
    order = []
    go_on = runs._Competitor.go_on

    def spy(self, seconds):
        order.append((self, seconds))
        go_on(self, seconds)

    monkeypatch.setattr(runs, "TURN", 0.2)
    monkeypatch.setattr(runs._Competitor, "go_on", spy)
    settings = SamplerSettings(batch_size=128, lanes=32, workers=1)
    names = list(at.scene.task.sequences)[1:3]
    both = [runs.Run("turns", "pick_place", 0, name, 0, seconds) for name, seconds in zip(names, (1.0, 0.4), strict=True)]
    kept = runs.execute_in_turns(at, [make_chooser(at, run.method, 0) for run in both], both, settings)
    (first, alone), (second, turn), (third, _) = order[:3]
    assert alone == pytest.approx(0.6) and turn == 0.2 and first is second and third is not first
    for one, run in zip(kept, both, strict=True):
        assert run.seconds <= one.data["meta"]["elapsed"] < run.seconds + 0.5


def test_final_rate_beside_others_is_of_the_time_that_they_share(tmp_path):
    """Tree has 2 s alone and 1 s beside the others: what it made in the last half of that second counts."""
    study_ = Study(tmp_path, ["handover"], BUDGET, PAPER)
    made = {"tree": [0.5, 1.6, 1.9, 2.4, 2.6, 2.9], "best expert": [0.4, 0.6, 0.7, 0.9]}
    rates = {}
    for run in study_.turns_runs("handover"):
        if (run.instance, run.seed) == (0, 0) and run.method in made:
            study_.store.write(run, runs.Kept({}, np.array(made[run.method]), {}))
            rates[run.method] = study_._final_rate(run)
    assert rates == {"tree": pytest.approx(2 / 0.5), "best expert": pytest.approx(3 / 0.5)}


def test_folder_of_another_budget_is_refused(finished):
    whole, _, _ = finished
    other = Study(whole.folder, ["handover"], Budget(seconds=3.0, seeds=1), PAPER)
    with pytest.raises(InputError, match="another folder"):
        other.claim_folder()


def test_warm_start_leaves_the_own_instance_out(finished):
    whole, made, _ = finished
    run = next(run for run in made if run.stage == "warm" and run.instance == 1)
    (prior,) = whole._prior(run)
    (other,) = [r for r in made if r.stage == "main" and r.method == "tree" and (r.instance, r.seed) == (0, run.seed)]
    assert prior == whole.store.read(other).data["tree"]


def test_report_has_every_table_and_figure(finished):
    whole, _, _ = finished
    path = write_report(whole, "python scripts/reproduce.py")
    text = path.read_text()
    for title in ("Claims", "Table I", "Table II", "Operations", "Sample rates", "Compile time", "Warm start", "Coverage"):
        assert title in text
    assert "| handover | 2059 | 2059 | 163 | 163 |" in text
    assert "| banana | 19171 | 19171 | 534 | 534 |" in text
    for line in text.splitlines():
        if line.startswith("!["):
            figure = whole.folder / line.split("(")[1].rstrip(")")
            assert figure.read_bytes().startswith(b"\x89PNG") and figure.stat().st_size > 10_000
    assert text.count("![") == 5
    results = json.loads((whole.folder / "results.json").read_text())
    assert results["scenes"]["handover"]["instances"][1]["methods"]["tree"]["final"] == [800.0, 800.0]


def test_claims_are_confronted_with_the_numbers(finished):
    whole, _, _ = finished
    numbers = json.loads(json.dumps(whole.all_numbers))
    by_text = {claim.text: claim for claim in claims.confront(numbers)}

    def claim(words):
        (found,) = [claim for text, claim in by_text.items() if words in text]
        return found

    assert claim("Table I").passed
    assert claim("0.95 of the best expert").passed and claim("1.3 of the best expert").passed  # 400 over 300
    assert claim("Tree beats rand").passed and claim("passed the audit").passed
    assert claim("within 2 s").passed
    assert not claim("starts below").passed  # made-up trees are fast from the start
    assert not claim("more sensitive").passed  # all rates double on the second instance
    for instance in numbers["scenes"]["handover"]["instances"]:
        instance["methods"]["tree"]["final"] = [90.0, 80.0]
    for turns in numbers["scenes"]["handover"]["turns"]:
        turns["final"]["tree"] = [90.0, 80.0]
    numbers["scenes"]["handover"]["audited"]["max_violation"] = 2e-4
    by_text = {claim.text: claim for claim in claims.confront(numbers)}
    assert claim("0.95 of the best expert").passed is False and "handover 1" in claim("0.95 of the best expert").reason
    assert claim("fixed sequence's, found by any means").passed is False
    assert claim("passed the audit").passed is False


@pytest.mark.parametrize(("elsewhere", "holds"), [(150, True), (170, False)])
def test_coverage_is_judged_for_each_scene_and_for_all_together(finished, elsewhere, holds):
    """Of tree's 100 cells of every variable an expert has 40 in one scene, 150 or 170 in the other: 95 or 105 on average."""
    one = json.loads(json.dumps(finished[0].numbers("handover")))
    other = json.loads(json.dumps(one)) | {"scene": "banana"}
    for scene, cells in ((one, 40), (other, elsewhere)):
        for instance in scene["instances"]:
            for variable in instance["coverage"]["variables"].values():
                for method, entry in variable["methods"].items():
                    count = 100 if method == "tree" else cells
                    entry["cells_at_equal_time"] = [count for _ in entry["cells_at_equal_time"]]
    found = claims.confront({"scenes": {"handover": one, "banana": other}, "counts": {}})
    held = {claim.text.split(":")[0]: claim.passed for claim in found if "at least every expert's" in claim.text}
    assert held == {"handover": True, "banana": False, "all scenes": holds}
    alone = claims.confront({"scenes": {"handover": one}, "counts": {}})
    assert not any("all scenes" in claim.text for claim in alone)


def test_an_operation_out_of_order_is_named_with_what_its_conditions_allow(finished):
    scene = finished[0].numbers("handover")
    operations = [entry for entry in scene["operations"] if entry["measured_microseconds"]]
    operations[0] |= {"measured_success": 0.1, "condition_feasible": 0.25}
    first, second = operations[0]["title"], operations[1]["title"]
    claim = next(c for c in claims.confront({"scenes": {"handover": scene}, "counts": {}}) if "larger operations" in c.text)
    assert not claim.passed
    assert f"{first} 10% below {second} " in claim.reason and "25% of its conditions" in claim.reason


def test_command_refuses_bad_numbers_in_one_line(tmp_path):
    command = [sys.executable, str(ROOT / "scripts" / "reproduce.py"), "--seeds", "0", "--out", str(tmp_path / "out")]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "--seeds" in done.stderr
    assert not (tmp_path / "out").exists()
