"""The benchmark's own arithmetic against counts made by hand; one short run of the real sampler."""

import importlib.util
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
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


def queue_by_hand(iterations, solved, lanes, period):
    """The solver's queue, iteration by iteration."""
    waiting = list(zip(iterations, solved, strict=True))
    held = [None] * lanes
    steps = 0
    while True:
        held = [lane or (list(waiting.pop(0)) if waiting else None) for lane in held]
        if not any(held):
            return steps
        for _ in range(period):
            steps += lanes
            held = [lane and [lane[0] - 1, lane[1]] for lane in held]
        # Solved tasks are seen as such by an evaluation after their last move.
        held = [None if lane and lane[0] < 0 or lane and lane[0] <= 0 and not lane[1] else lane for lane in held]


@pytest.mark.parametrize(("lanes", "period"), [(1, 1), (3, 2), (8, 2), (64, 3)])
def test_lane_steps_are_those_of_the_queue(benchmark, lanes, period):
    rng = np.random.default_rng(lanes)
    iterations, solved = rng.integers(1, 24, 100), rng.random(100) < 0.5
    assert benchmark.lane_steps(iterations, solved, lanes, period) == queue_by_hand(iterations, solved, lanes, period)


def test_flops_of_a_matrix_product_and_of_loops(benchmark):
    import jax
    import jax.numpy as jnp

    a, b = jnp.ones((5, 7)), jnp.ones((7, 3))
    assert benchmark.count_flops(lambda a, b: a @ b, a, b) == 2 * 5 * 7 * 3
    assert benchmark.count_flops(lambda a: jnp.sum(jnp.sqrt(a) * 2.0 + a), a) == 4 * 35
    assert benchmark.count_flops(lambda a: a[1:, ::-1].T.reshape(-1), a) == 0

    def looped(a, turns):
        a = jax.lax.fori_loop(0, turns, lambda _, x: x + 1.0, a)  # traced length: a while loop
        a, sums = jax.lax.scan(lambda x, y: (x * y, x), a, jnp.ones(4))
        return jax.lax.cond(turns > 2, lambda x: x * x, lambda x: x, a), sums

    assert benchmark.count_flops(jax.jit(looped), a, jnp.int32(3)) == 35 * (3 + 4 + 1)
    assert benchmark.count_flops(jax.jit(looped), a, jnp.int32(1)) == 35 * (1 + 4)


def test_lengths_of_loops_may_be_computed(benchmark):
    import jax
    import jax.numpy as jnp

    def function(a, lengths):
        _, sums = jax.lax.scan(lambda x, y: (x + y, x), 0, lengths, reverse=True)  # 6, 5, 3, 0
        return jax.lax.fori_loop(0, sums[1], lambda i, x: x.at[i].add(1.0) * 2.0, a)

    assert benchmark.count_flops(function, jnp.ones(7), jnp.arange(4)) == 5 * 7
    with pytest.raises(TypeError, match="loop"):
        benchmark.count_flops(lambda a: jax.lax.while_loop(lambda x: x < 1.0, lambda x: x + 1.0, a), 0.0)


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
    assert set(measured.transitions) == set(measured.record.operators)


def test_utilisation_of_an_operator(benchmark, pick_place):
    from cgs_jax.sampler import SamplerSettings

    settings = SamplerSettings(batch_size=128, lanes=16)
    transition = pick_place.transitions.parse("(q1,t); q2")[0]
    useful, executed = benchmark.replay(pick_place, transition, {}, settings)
    assert 128 < useful < executed <= 128 * (settings.solver.max_iterations + settings.solver.check_period)
    flops, seconds = benchmark.lane_step(pick_place, transition, settings)
    # A 7-joint chain, its Jacobian and six to twelve rows: thousands of operations, not hundreds and not millions.
    assert 1e3 < flops < 1e5
    assert 0.0 < seconds < 1e-3
