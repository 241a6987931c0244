"""The benchmark's own arithmetic against counts made by hand; one short run of the real sampler."""

import importlib.util
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "scripts" / "benchmark.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("benchmark", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["benchmark"] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    return module


def run(*arguments):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)


def result(benchmark, rate, cold=10.0):
    return {
        "schema": benchmark.SCHEMA,
        "machine": {"cpu": "any", "cores": 2},
        "parts": {
            "throughput": {"scenes": {"handover": {"mean": rate, "instances": {"0": {"rate": rate}}}}},
            "start": {
                "scenes": {
                    "handover": {"cold_seconds": cold, "warm_seconds": 2.0, "compile_all_cold": {"seconds": 30.0}},
                }
            },
        },
    }


# ------------------------------------------------------------------ comparison


def test_ratios_above_one_are_improvements(benchmark):
    rows = {name: ratio for name, ratio, _ in benchmark.compare(result(benchmark, 300.0, 5.0), result(benchmark, 200.0), 0.9)}
    assert rows["throughput handover mean"] == pytest.approx(1.5)
    assert rows["start handover cold_seconds"] == pytest.approx(2.0)
    assert rows["start handover warm_seconds"] == pytest.approx(1.0)


def test_rates_that_were_zero_compare(benchmark):
    def first(new, old):
        return benchmark.compare(result(benchmark, new), result(benchmark, old), 0.9)[0][1:]

    assert first(5.0, 0.0) == (float("inf"), True)
    assert first(0.0, 0.0) == (1.0, True)
    assert first(0.0, 5.0) == (0.0, False)


@pytest.mark.parametrize(("rate", "only", "status"), [(100.0, "", 0), (70.0, "", 1), (70.0, "start", 0)])
def test_gate_tells_by_its_exit_status(benchmark, tmp_path, rate, only, status):
    old, new = tmp_path / "old.json", tmp_path / "new.json"
    old.write_text(json.dumps(result(benchmark, 100.0)))
    new.write_text(json.dumps(result(benchmark, rate)))
    ended = run("--results", new, "--against", old, "--only", only)
    assert ended.returncode == status, ended.stderr
    assert "start handover cold_seconds" in ended.stdout


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["speed"], "available: throughput"),
        (["--results", "x.json"], "--against"),
        (["--against", "missing.json"], "missing.json"),
        (["--window", "20,10"], "rising"),
        (["--instances", "a-b"], "0-3,7"),
        (["--peer", "komo", "--peer-scenes", "pq"], "pp, ho, ho2"),
        (["throughput", "--scenes", "kitchen"], "kitchen"),
        (["throughput", "--scenes", "pick_place", "--instances", "8"], "8"),
        (["throughput", "--seconds", "0"], "--seconds"),
        (["search", "--method", "tree-warm", "--instances", "0"], "at least two in --instances"),
    ],
)
def test_wrong_input_is_told_in_one_line(tmp_path, arguments, told):
    ended = run(*arguments, "--out", tmp_path / "result.json")
    assert ended.returncode == 2
    lines = [line for line in ended.stderr.splitlines() if not line.startswith(("usage:", " "))]
    assert len(lines) == 1 and told in lines[0]


def test_files_that_share_nothing_are_refused(benchmark):
    empty = {"schema": benchmark.SCHEMA, "parts": {}}
    with pytest.raises(benchmark.InputError, match="nothing to compare"):
        benchmark.compare(result(benchmark, 1.0), empty, 0.9)


# ------------------------------------------------------------------ what is counted


def test_lists_of_numbers(benchmark):
    assert benchmark.numbers_in("0-3,7") == [0, 1, 2, 3, 7]
    assert benchmark.window_in("4,8") == (4.0, 8.0)


def test_reached_names_the_best_target(benchmark):
    assert benchmark.reached("handover", 5000.0) == "beyond"
    assert benchmark.reached("handover", 1500.0) == "goal"
    assert benchmark.reached("handover", 60.0) == "0.10 of floor"


def test_threads_are_put_back_on_all_cores(benchmark):
    before = os.sched_getaffinity(0)
    held = threading.Event()
    thread = threading.Thread(target=held.wait)
    thread.start()
    with benchmark.on_cores(1):
        assert len(os.sched_getaffinity(0)) == len(os.sched_getaffinity(thread.native_id)) == 1
    assert os.sched_getaffinity(0) == os.sched_getaffinity(thread.native_id) == before
    held.set()
    thread.join()
    with pytest.raises(benchmark.InputError, match="available"), benchmark.on_cores(1 + os.cpu_count()):
        pass


def test_ratios_to_the_peer(benchmark):
    medians = {"ours, 2": 300.0, "ours loosened, 2": 400.0, "komo, strict, 2": 10.0, "komo, ours, 2": 0.0}
    assert benchmark.peer_ratios(medians, [2]) == {"strict, 2": 40.0, "strict with our tolerance, 2": 30.0, "ours, 2": None}


# ------------------------------------------------------------------ the real thing


@pytest.fixture(scope="module")
def pick_place():
    import cgs_jax

    return cgs_jax.load_problem("pick_place")


def test_samples_inside_the_window_are_counted(benchmark, pick_place):
    benchmark.warm_up(pick_place, "expert3")
    began = time.perf_counter()
    measured = benchmark.measure(pick_place, (0.3, 1.0), "expert3")
    assert time.perf_counter() - began < 5.0
    samples = measured.record.samples()
    inside = (samples.elapsed >= 0.3) & (samples.elapsed < 1.0)
    assert measured.rate == pytest.approx(inside.sum() / 0.7)
    assert len(samples) and measured.rate_from_start == pytest.approx(len(samples))
    assert set(measured.record.transitions) == set(measured.record.operators)
