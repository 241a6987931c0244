"""Measure how fast the samplers are on this machine, and compare results.

    python scripts/benchmark.py                                   all but `options`, `variants` and the peer; about 25 minutes
    python scripts/benchmark.py throughput --scenes handover --instances 0-3 --window 4,8
    python scripts/benchmark.py --peer komo [--python PATH]       both programs in turn on the peer's scenes
    python scripts/benchmark.py search --study runs/reproduce --seconds 10    how near the tree comes to the best sequence
    python scripts/benchmark.py throughput --against old.json     measure, then compare: exit status 1 if slower
    python scripts/benchmark.py --results new.json --against old.json        compare only

Parts: throughput, operators, start, scaling, utilisation, options, variants, search. Prints tables and writes one JSON file
with the machine, versions, date and the load average before and after each part. `docs/performance.md` says what each number
means.

Exit status: 0; 1 when a ratio to `--against` is below the threshold; 2 for bad input.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import datetime
import importlib.util
import json
import os
import platform
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import wait
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from cgs_jax.errors import InputError

if TYPE_CHECKING:
    from cgs_jax.audit import Tolerances
    from cgs_jax.problems import Problem
    from cgs_jax.record import Recorder
    from cgs_jax.sampler import SamplerSettings

ROOT = Path(__file__).resolve().parents[1]

SCHEMA = "cgs_jax.benchmark/1"

TARGETS = {
    "pick_place": (2_000.0, 6_000.0, 15_000.0),
    "handover": (600.0, 1_500.0, 4_000.0),
    "banana": (250.0, 600.0, 2_000.0),
}
"""Verified samples per second: floor, goal and what lies beyond. No instance may be below a tenth of its goal."""

TARGET_NAMES = ("floor", "goal", "beyond")

PEER_RATIOS = {"pp": 75.0, "ho": 40.0, "ho2": 40.0}
"""How many times the peer's rate is asked for, at strict tolerance and with as many cores."""

STRICT = 1e-3
"""m and rad: KOMO's strict tolerance, to which our solver and audit are loosened for a second row."""

STRICT_AIM = 2.5e-4
"""Tolerance of our solver for it: in the proportion to the audit's that the default has (errors add up over attachments)."""

CHECKED_BY_PEER = 400
"""How many of our solutions the peer judges per scene."""

# A pipe has no width of its own.
console = Console(width=None if sys.stdout.isatty() else 160, highlight=False)


# ------------------------------------------------------------------ one measurement


@dataclasses.dataclass(frozen=True)
class Measured:
    """One run: what it found in a window of its sampling time, and its record."""

    rate: float
    """Verified samples per second of sampling time inside the window."""
    rate_from_start: float
    """The same from the moment the first operators were ready; the tree still knows nothing then."""
    startup_seconds: float
    cpu_share: float
    """Processor time of this process and its workers from the window's begin to the run's end, over that time and cores."""
    record: Recorder


def measure(
    problem: Problem,
    window: tuple[float, float],
    method: str = "tree",
    seed: int = 0,
    settings: SamplerSettings | None = None,
    tolerances: Tolerances | None = None,
) -> Measured:
    """Runs a method until the end of the window (s of sampling time) and counts what passed the audit inside it."""
    from cgs_jax.api import make_chooser
    from cgs_jax.record import Recorder
    from cgs_jax.sampler import Found, Sampler, SamplerSettings, Started

    settings = settings or SamplerSettings()
    chooser = make_chooser(problem, method, seed, pools=settings.pools)
    sampler = Sampler(problem, chooser, seed, settings, tolerances)
    record = Recorder(problem, chooser, method, seed, settings, sampler.auditor)
    low, high = window
    found_inside, began, cpu = 0, 0.0, (0.0, 0.0)
    for event in sampler.events(high):
        record.listen(event)
        if isinstance(event, Started):
            began = time.perf_counter()
        elif isinstance(event, Found) and low <= event.elapsed < high:
            found_inside += len(event.qpos)
        if began and not cpu[0] and time.perf_counter() - began >= low:
            cpu = (time.perf_counter(), processor_seconds())
    wall, busy = time.perf_counter() - cpu[0], processor_seconds() - cpu[1]
    return Measured(
        rate=found_inside / (high - low),
        rate_from_start=record.count / high,
        startup_seconds=record.startup_seconds,
        cpu_share=busy / max(wall * len(os.sched_getaffinity(0)), 1e-9) if cpu[0] else 0.0,
        record=record,
    )


def processor_seconds() -> float:
    """Processor time so far of this process and of those that it started (those still alive: Linux only)."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    total = time.process_time() + ended.ru_utime + ended.ru_stime
    for thread in Path("/proc/self/task").glob("*"):
        with contextlib.suppress(OSError, ValueError):
            for child in (thread / "children").read_text().split():
                fields = Path("/proc", child, "stat").read_text().rpartition(")")[2].split()
                total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


def warm_up(problem: Problem, method: str = "tree", settings: SamplerSettings | None = None) -> dict[str, float]:
    """Makes every program that the method may choose; seconds until the first operators were ready, and until all were."""
    from cgs_jax.programs import all_requested

    began = time.perf_counter()
    measured = measure(problem, (0.0, 0.05), method, settings=settings)
    wait(all_requested())
    return {"first_operators": measured.startup_seconds, "all": time.perf_counter() - began}


def best_sequence(problem: Problem, seconds: float, seed: int = 0) -> str:
    """The sequence that made the most samples in a run of the tree search. Raises InputError when nothing was found."""
    from collections import Counter

    warm_up(problem)
    samples = measure(problem, (0.0, seconds), seed=seed).record.samples()
    if not len(samples):
        raise InputError(f"no sample of {problem.name} in {seconds:g} s, expected at least one: give more --seconds")
    return Counter(samples.sequences[i] for i in samples.sequence).most_common(1)[0][0]


@contextlib.contextmanager
def on_cores(count: int) -> Iterator[None]:
    """Keeps every thread of this process, and of the workers that wait in it, on the first `count` of its cores (Linux)."""
    allowed = sorted(os.sched_getaffinity(0))
    if count > len(allowed):
        raise InputError(f"{count} cores asked for, {len(allowed)} available")

    def place(cores: Sequence[int]) -> None:
        own = Path("/proc/self/task")
        children: set[str] = set()
        for task in own.iterdir():
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                children.update((task / "children").read_text().split())
        for process in (own, *(Path("/proc", child, "task") for child in children)):
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it ended meanwhile
                for thread in os.listdir(process):
                    os.sched_setaffinity(int(thread), cores)

    place(allowed[:count])
    try:
        yield
    finally:
        place(allowed)


def fitting_window(seconds: float) -> tuple[float, float]:
    """The window of a short measurement: without its first fifth, in which the pools fill."""
    return 0.2 * seconds, seconds


# ------------------------------------------------------------------ throughput


def throughput(given: argparse.Namespace) -> dict[str, Any]:
    """Samples per second inside the window, per scene and instance."""
    from cgs_jax import load_problem

    report: dict[str, Any] = {"window": list(given.window), "method": given.method, "scenes": {}}
    for scene in given.scenes:
        rows = {}
        for instance in given.instances:
            problem = load_problem(scene, instance)
            made = warm_up(problem, given.method)
            measured = measure(problem, given.window, given.method, given.seed)
            record, profile = measured.record, measured.record.profile()
            rows[str(instance)] = {
                "title": problem.scene.task.instances[instance].title,
                "rate": measured.rate,
                "rate_from_start": measured.rate_from_start,
                "startup_seconds": made["first_operators"],
                "all_programs_seconds": made["all"],
                "rejected_by_audit": record.rejected,
                "best_sequence": record.samples().best_sequence,
                "shares_of_worker_time": profile["shares_of_worker_time"],
                "cpu_share": measured.cpu_share,
            }
            console.print(f"[dim]{scene} {instance}: {measured.rate:.0f}/s[/]")
        rates = [row["rate"] for row in rows.values()]
        report["scenes"][scene] = {"mean": statistics.mean(rates), "minimum": min(rates), "instances": rows}
    report["peak_memory_bytes"] = peak_memory()
    return report


def reached(scene: str, mean: float) -> str:
    """The best target that a rate reaches, or how much of the floor it is."""
    targets = TARGETS.get(scene)
    if targets is None:
        return ""
    names = [name for name, target in zip(TARGET_NAMES, targets, strict=True) if mean >= target]
    return names[-1] if names else f"{mean / targets[0]:.2f} of floor"


def throughput_tables(report: Mapping[str, Any]) -> list[Table]:
    """Per scene against its targets, and per instance."""
    low, high = report["window"]
    title = f"Verified samples per second, seconds {low:g} to {high:g}"
    scenes = new_table(title, ["scene", "mean", "minimum", *TARGET_NAMES, "reached", "worst over goal"])
    instances = new_table(
        "By instance", ["scene", "instance", "samples/s", "from start", "startup s", "device", "host", "audit", "sequence"]
    )
    for scene, entry in report["scenes"].items():
        targets = TARGETS.get(scene, (None,) * 3)
        worst = f"{entry['minimum'] / targets[1]:.2f}" if targets[1] else ""
        scenes.add_row(scene, *map(number, (entry["mean"], entry["minimum"], *targets)), reached(scene, entry["mean"]), worst)
        for instance, row in entry["instances"].items():
            shares = [f"{row['shares_of_worker_time'][name]:.2f}" for name in ("device", "host", "audit")]
            numbers = map(number, (row["rate"], row["rate_from_start"], row["startup_seconds"]))
            instances.add_row(scene, f"{instance} {row['title']}", *numbers, *shares, row["best_sequence"] or "none")
    return [scenes, instances]


# ------------------------------------------------------------------ operators


def operators(given: argparse.Namespace) -> dict[str, Any]:
    """What each operator costs and how often it succeeds, in a run of the first instance."""
    from cgs_jax import load_problem

    report: dict[str, Any] = {"seconds": given.window[1], "instance": given.instances[0], "scenes": {}}
    for scene in given.scenes:
        problem = load_problem(scene, given.instances[0])
        warm_up(problem, given.method)
        record = measure(problem, given.window, given.method, given.seed).record
        report["scenes"][scene] = record.profile() | {"elapsed": record.elapsed, "samples": record.count}
    return report


def operators_tables(report: Mapping[str, Any]) -> list[Table]:
    """One table per scene, operators by time."""
    tables = []
    for scene, profile in report["scenes"].items():
        columns = ["operator", "calls", "tasks", "success", "iterations", "us per task", "device time", "mostly fails at"]
        table = new_table(f"Operators of {scene}", columns)
        total = sum(entry["device_seconds"] for entry in profile["operators"].values()) or 1.0
        for name, entry in profile["operators"].items():
            table.add_row(
                name,
                number(entry["calls"]),
                number(entry["tasks"]),
                f"{entry['success_rate']:.3f}",
                f"{entry['iterations_per_task']:.1f}",
                f"{entry['microseconds_per_task']:.1f}",
                f"{entry['device_seconds'] / total:.2f}",
                next(iter(entry["failures"]), ""),
            )
        tables.append(table)
    return tables


# ------------------------------------------------------------------ start


def start(given: argparse.Namespace) -> dict[str, Any]:
    """Fresh processes to their first verified sample, with an empty and with a full cache, and all compilation."""
    report: dict[str, Any] = {"rounds": given.rounds, "instance": given.instances[0], "scenes": {}}
    for scene in given.scenes:
        empty, full = Path(tempfile.mkdtemp(prefix="cold")), Path(tempfile.mkdtemp(prefix="warm"))
        try:
            cold = first_sample(scene, given.instances[0], empty)
            compiled = compile_all(scene, given.instances[0], full)
            first_sample(scene, given.instances[0], full)  # whatever the script compiles beside the programs
            warm = [first_sample(scene, given.instances[0], full) for _ in range(given.rounds)]
            again = compile_all(scene, given.instances[0], full)
            size = sum(file.stat().st_size for file in full.rglob("*") if file.is_file())
        finally:
            shutil.rmtree(empty, ignore_errors=True)
            shutil.rmtree(full, ignore_errors=True)
        report["scenes"][scene] = {
            "cold": cold,
            "warm": warm,
            "cold_seconds": cold["seconds"],
            "warm_seconds": statistics.median(run["seconds"] for run in warm),
            "compile_all_cold": compiled,
            "compile_all_warm": again,
            "cache_bytes": size,
        }
    return report


def first_sample(scene: str, instance: int, cache: Path) -> dict[str, Any]:
    """Seconds from the start of `scripts/sample.py` until it has reported one verified sample, and until it has ended."""
    script = ROOT / "scripts" / "sample.py"
    command = [sys.executable, str(script), "--scene", scene, "--instance", str(instance), "--num-samples", "1"]
    with tempfile.TemporaryDirectory(prefix="sample") as folder:
        began = time.perf_counter()
        process = subprocess.Popen(
            [*command, "--time-budget", "120", "--json", "--out", folder],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=os.environ | {"XDG_CACHE_HOME": str(cache)},
        )
        assert process.stdout is not None and process.stderr is not None
        text, told, reported = b"", {}, 0.0
        while part := os.read(process.stdout.fileno(), 65536):
            text += part
            with contextlib.suppress(ValueError):
                told = json.loads(text)
                reported = time.perf_counter() - began
        errors = process.stderr.read().decode(errors="replace").strip().splitlines()
        status = process.wait()
        ended = time.perf_counter() - began
    if status or not reported:
        raise InputError(f"{' '.join(command[1:])} ended with status {status}: {errors[-1] if errors else 'no message'}")
    inside = {name: told[name] for name in ("startup_seconds", "elapsed", "compile_seconds") if name in told}
    return {"seconds": reported, "until_exit": ended} | inside


def compile_all(scene: str, instance: int, cache: Path) -> dict[str, Any]:
    """A fresh process that samples while everything the tree may choose is compiled beside it."""
    command = [sys.executable, str(Path(__file__).resolve()), "--worker", f"{scene},{instance}"]
    finished = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"XDG_CACHE_HOME": str(cache)})
    if finished.returncode:
        lines = finished.stderr.strip().splitlines()
        raise InputError(f"compiling {scene} failed with status {finished.returncode}: {lines[-1] if lines else 'no message'}")
    return json.loads(finished.stdout)


def compile_while_sampling(scene: str, instance: int) -> dict[str, Any]:
    """The work of `compile_all`, in this process."""
    from cgs_jax import enable_disk_cache, load_problem
    from cgs_jax.programs import all_requested
    from cgs_jax.sampler import Found, Sampler, Started

    began = time.perf_counter()
    enable_disk_cache()
    from cgs_jax.api import make_chooser

    problem = load_problem(scene, instance)
    sampler = Sampler(problem, make_chooser(problem))
    loaded = time.perf_counter() - began
    first, samples, ready = 0.0, 0, 0.0
    for event in sampler.events(600.0):
        if isinstance(event, Started):
            ready = time.perf_counter() - began
        elif isinstance(event, Found):
            samples += len(event.qpos)
            first = first or time.perf_counter() - began
        if ready and all(future.done() for future in all_requested()):
            break
    seconds = time.perf_counter() - began
    programs = [(program.name, program.seconds) for program in (future.result() for future in all_requested())]
    return {
        "seconds": seconds,
        "loaded": loaded,
        "first_operators": ready,
        "first_sample": first or None,
        "samples_meanwhile": samples,
        "compile_seconds": sum(seconds for _, seconds in programs),
        "programs": [{"name": name, "seconds": seconds} for name, seconds in programs],
        "peak_memory_bytes": peak_memory(),
    }


def start_tables(report: Mapping[str, Any]) -> list[Table]:
    """One row per scene."""
    columns = ["scene", "first sample, cold s", "warm s", "all compiled, cold s", "warm s", "programs", "cache MB"]
    table = new_table("Seconds from the start of a fresh process", columns)
    for scene, entry in report["scenes"].items():
        cold, warm = entry["compile_all_cold"], entry["compile_all_warm"]
        numbers = (entry["cold_seconds"], entry["warm_seconds"], cold["seconds"], warm["seconds"])
        rest = (str(len(cold["programs"])), number(entry["cache_bytes"] / 1e6))
        table.add_row(scene, *(f"{value:.1f}" for value in numbers), *rest)
    return [table]


# ------------------------------------------------------------------ scaling


def scaling(given: argparse.Namespace) -> dict[str, Any]:
    """The best sequence's rate over batch size, lanes, workers and cores, one varied at a time."""
    from cgs_jax import load_problem
    from cgs_jax.sampler import SamplerSettings

    default = SamplerSettings()
    cores = len(os.sched_getaffinity(0))
    places = dict.fromkeys([(1, 1), (1, cores), (2, cores), (cores, cores)])
    variants = [("batch", {"batch_size": size}, cores) for size in given.batches]
    variants += [("lanes", {"lanes": lanes}, cores) for lanes in given.lanes]
    variants += [("workers", {"workers": workers}, on) for workers, on in places]
    report: dict[str, Any] = {"seconds": given.seconds, "instance": given.instances[0], "scenes": {}}
    for scene in given.scenes:
        problem = load_problem(scene, given.instances[0])
        sequence = best_sequence(problem, given.seconds, given.seed)
        rows = []
        for axis, changes, on in variants:
            settings = dataclasses.replace(default, **changes)
            warm_up(problem, sequence, settings)
            with on_cores(on):
                measured = measure(problem, fitting_window(given.seconds), sequence, given.seed, settings)
            share = measured.record.profile()["shares_of_worker_time"]
            rows.append(
                {"axis": axis, "value": next(iter(changes.values())), "cores": on, "rate": measured.rate}
                | {"cpu_share": measured.cpu_share, "device": share["device"], "host": share["host"], "audit": share["audit"]}
            )
        report["scenes"][scene] = {"sequence": sequence, "rows": rows}
    return report


def scaling_tables(report: Mapping[str, Any]) -> list[Table]:
    """One table per scene."""
    tables = []
    for scene, entry in report["scenes"].items():
        columns = ["varied", "value", "cores", "samples/s", "processor", "device", "host", "audit"]
        table = new_table(f"Scaling of {scene}: {entry['sequence']}", columns)
        for row in entry["rows"]:
            shares = [f"{row[name]:.2f}" for name in ("cpu_share", "device", "host", "audit")]
            table.add_row(row["axis"], str(row["value"]), str(row["cores"]), number(row["rate"]), *shares)
        tables.append(table)
    return tables


# ------------------------------------------------------------------ utilisation


def utilisation(given: argparse.Namespace) -> dict[str, Any]:
    """Useful lane-iterations over all, and the solver's arithmetic over the machine's peak."""
    from cgs_jax import load_problem
    from cgs_jax.sampler import SamplerSettings
    from cgs_jax.utilisation import seconds_per_lane_step
    from cgs_jax.utilisation import utilisation as utilisation_of

    settings = SamplerSettings()
    report: dict[str, Any] = {
        "flop_count": (
            "float operations of the solver's step as written, counted by evaluating its jaxpr with loops followed; "
            "seeds, clearance and audit are not counted"
        ),
        "peak_from": "float32 matrix products 2048 x 2048, all cores, the faster of jax and numpy, in the same run",
        "instance": given.instances[0],
        "scenes": {},
    }
    for scene in given.scenes:
        problem = load_problem(scene, given.instances[0])
        warm_up(problem, given.method)
        measured = measure(problem, given.window, given.method, given.seed)
        record = measured.record
        entry = utilisation_of(record)
        for name, row in entry["operators"].items():
            seconds = seconds_per_lane_step(problem, record.transitions[name], settings)
            row["microseconds_per_lane_step_alone"] = 1e6 * seconds
            row["share_of_steps_in_device_time"] = row["iterations"] / row["useful_share"] * seconds / row["device_seconds"]
        report["scenes"][scene] = entry | {
            "cpu_share": measured.cpu_share,
            "rate": measured.rate,
            "shares_of_worker_time": record.profile()["shares_of_worker_time"],
            "peak_memory_bytes": peak_memory(),
        }
    report["peak_flops"] = max(entry["peak_flops"] for entry in report["scenes"].values())
    return report


def peak_memory() -> dict[str, int]:
    """Largest resident size so far, bytes: of this process, and of the largest worker, for which they are all ended."""
    from cgs_jax.worker import end_idle

    end_idle()
    unit = 1 if sys.platform == "darwin" else 1024
    who = {"process": resource.RUSAGE_SELF, "largest_worker": resource.RUSAGE_CHILDREN}
    return {name: unit * resource.getrusage(whose).ru_maxrss for name, whose in who.items()}


def utilisation_tables(report: Mapping[str, Any]) -> list[Table]:
    """One row per scene, then per operator."""
    title = f"Utilisation; peak {report['peak_flops'] / 1e9:.0f} GFLOP/s"
    columns = ["scene", "samples/s", "useful lane-iterations", "GFLOP/s", "of peak", "MFLOP/sample", "processor", "memory MB"]
    scenes = new_table(title, columns)
    operators = new_table(
        "By operator (lane-it.: one solver iteration of one lane)",
        ["scene", "operator", "FLOP/lane-it.", "us/lane-it.", "useful", "iterations/task", "GFLOP/s", "steps in device time"],
    )
    for scene, entry in report["scenes"].items():
        per_sample = entry["flops_per_sample"]
        scenes.add_row(
            scene,
            number(entry["rate"]),
            f"{entry['useful_share']:.2f}",
            f"{entry['flops'] / 1e9:.1f}",
            f"{entry['share_of_peak']:.3f}",
            "none" if per_sample is None else f"{per_sample / 1e6:.2f}",
            f"{entry['cpu_share']:.2f}",
            " + ".join(number(size / 1e6) for size in entry["peak_memory_bytes"].values()),
        )
        for name, row in entry["operators"].items():
            operators.add_row(
                scene,
                name,
                number(row["flops_per_lane_step"]),
                f"{row['microseconds_per_lane_step_alone']:.2f}",
                f"{row['useful_share']:.2f}",
                f"{row['iterations_per_task']:.1f}",
                f"{row['achieved_flops'] / 1e9:.1f}",
                f"{row['share_of_steps_in_device_time']:.2f}",
            )
    return [scenes, operators]


# ------------------------------------------------------------------ options


def options(given: argparse.Namespace) -> dict[str, Any]:
    """Effect of the sampler's options on rate and on coverage at equal count, against the paper's semantics.

    All variants run the same sequence. The reference is a run of the paper's semantics (one try, no pools) with another
    seed; cells are fitted to the baseline's samples, then the same for all. Of every variant the same number of samples,
    drawn at random from all that it found, is compared; coverage is over the variables, the mean and the worst ratio.
    """
    from cgs_jax import load_problem
    from cgs_jax.coverage import fit_cells, projected_coverage
    from cgs_jax.sampler import SamplerSettings

    paper = {"tries": 1, "pools": False}
    variants: dict[str, dict[str, Any]] = {"one try, no pools (paper)": paper, "one try, pools": {"tries": 1, "pools": True}}
    variants |= {f"{tries} tries, no pools": {"tries": tries, "pools": False} for tries in (4,)}
    variants |= {f"{tries} tries, pools": {"tries": tries, "pools": True} for tries in (2, 4, 8)}
    variants |= {f"{SamplerSettings().tries} tries, pools, batch {size}": {"batch_size": size} for size in given.batches}
    report: dict[str, Any] = {"seconds": given.seconds, "rounds": given.rounds, "instance": given.instances[0], "scenes": {}}
    for scene in given.scenes:
        problem = load_problem(scene, given.instances[0])
        sequence = best_sequence(problem, given.seconds, given.seed)
        settings = {name: dataclasses.replace(SamplerSettings(), **changes) for name, changes in variants.items()}
        for chosen in settings.values():
            warm_up(problem, sequence, chosen)
        runs: dict[str, list[Any]] = {name: [] for name in variants}
        rates: dict[str, list[float]] = {name: [] for name in variants}
        for i in range(given.rounds):
            for name, chosen in settings.items():
                measured = measure(problem, fitting_window(given.seconds), sequence, given.seed + i, chosen)
                runs[name].append(measured.record.samples())
                rates[name].append(measured.rate)
        baseline = next(iter(variants))
        seed = given.seed + 1000
        reference = measure(problem, (0.0, 2.0 * given.seconds), sequence, seed, settings[baseline]).record.samples()
        count = min(len(samples) for of_variant in runs.values() for samples in of_variant)
        if not count or not len(reference):
            raise InputError(f"no sample of {scene} in {given.seconds:g} s, expected some of every variant: more --seconds")
        drawn = {name: [some(samples, count, i) for i, samples in enumerate(found)] for name, found in runs.items()}
        cells = {name: fitted.cell for name, fitted in fit_cells(drawn[baseline][0], reference).items()}
        counts = {
            name: {
                variable: statistics.mean(projected_coverage(samples, cells)[variable] for samples in found)
                for variable in cells
            }
            for name, found in drawn.items()
        }
        rows = {}
        for name in variants:
            ratios = {variable: counts[name][variable] / counts[baseline][variable] for variable in cells}
            rows[name] = {
                "settings": variants[name],
                "rate": statistics.median(rates[name]),
                "rates": rates[name],
                "coverage_by_variable": ratios,
                "coverage": statistics.mean(ratios.values()),
                "worst_coverage": min(ratios.values()),
            }
        report["scenes"][scene] = {"sequence": sequence, "count": count, "reference": len(reference), "variants": rows}
    return report


VARIANT_INSTANCES = {"pick_place": (0, 6), "handover": (0, 6)}
"""Instances of `variants`: the open one and a cluttered one."""


def variants(given: argparse.Namespace) -> dict[str, Any]:
    """Clearances checked after the solver or kept inside it, in turn, on one fixed sequence of each scene."""
    from cgs_jax import SamplerSettings, load_problem

    settings = {name: SamplerSettings(collisions=name) for name in ("after", "inside")}
    report: dict[str, Any] = {"seconds": given.seconds, "rounds": given.rounds, "sequence": "expert3", "scenes": {}}
    for scene in (name for name in given.scenes if name in VARIANT_INSTANCES):
        instances = {}
        for instance in VARIANT_INSTANCES[scene]:
            problem = load_problem(scene, instance)
            compiled = {name: warm_up(problem, "expert3", chosen)["all"] for name, chosen in settings.items()}
            runs: dict[str, list[Measured]] = {name: [] for name in settings}
            for i in range(given.rounds):
                for name, chosen in settings.items():
                    runs[name].append(measure(problem, fitting_window(given.seconds), "expert3", given.seed + i, chosen))
            rows = {name: variant_row(measured) | {"warm_up_seconds": compiled[name]} for name, measured in runs.items()}
            instances[str(instance)] = {
                "title": problem.scene.task.instances[instance].title,
                "variants": rows,
                "inside_over_after": rows["inside"]["rate"] / rows["after"]["rate"] if rows["after"]["rate"] else None,
            }
        report["scenes"][scene] = instances
    return report


def variant_row(runs: Sequence[Measured]) -> dict[str, Any]:
    """Medians over the rounds of the rate and, per operator, of success per try, iterations and time per attempt."""

    def median(name: str, entry: str) -> float:
        return statistics.median(getattr(run.record.operators[name], entry) for run in runs)

    operators = {}
    for name in runs[0].record.operators:
        tasks = median(name, "tasks")
        operators[name] = {
            "success_per_try": statistics.median(run.record.operators[name].success_rate for run in runs),
            "rows_solved_per_try": median(name, "proposed") / max(tasks, 1),
            "iterations_per_try": median(name, "iterations") / max(tasks, 1),
            "microseconds_per_try": 1e6 * median(name, "device_seconds") / max(tasks, 1),
        }
    rates = [run.rate for run in runs]
    return {"rate": statistics.median(rates), "rates": rates, "operators": operators}


def variants_tables(report: Mapping[str, Any]) -> list[Table]:
    """Rates and their ratio; what each operator costs and yields in either variant."""
    rates = new_table("Collision rows: samples per second", ["scene", "instance", "after", "inside", "inside / after"])
    columns = ["operator", "scene", "variant", "success", "iterations", "us per try", "us per success"]
    operators = new_table("Collision rows: operators", columns)
    for scene, instances in report["scenes"].items():
        for instance, entry in instances.items():
            rows = entry["variants"]
            numbers = (rows["after"]["rate"], rows["inside"]["rate"], entry["inside_over_after"])
            rates.add_row(scene, f"{instance} {entry['title']}", *map(number, numbers))
            for variant, row in rows.items():
                for name, told in row["operators"].items():
                    success, each = told["success_per_try"], told["microseconds_per_try"]
                    numbers = (f"{success:.3f}", f"{told['iterations_per_try']:.1f}", f"{each:.1f}")
                    per_success = number(each / success if success else None)
                    operators.add_row(name, f"{scene} {instance}", variant, *numbers, per_success)
    return [rates, operators]


def some(samples: Any, count: int, seed: int) -> Any:
    """That many of the samples, at random."""
    return samples.select(np.random.default_rng(seed).permutation(len(samples))[:count])


def options_tables(report: Mapping[str, Any]) -> list[Table]:
    """One table per scene."""
    tables = []
    for scene, entry in report["scenes"].items():
        title = f"Options on {scene}: {entry['sequence']}; coverage of {entry['count']} samples over the paper's semantics'"
        table = new_table(title, ["variant", "samples/s", "coverage, mean", "worst variable"])
        for name, row in entry["variants"].items():
            worst = min(row["coverage_by_variable"], key=row["coverage_by_variable"].get)
            table.add_row(name, number(row["rate"]), f"{row['coverage']:.3f}", f"{row['worst_coverage']:.3f} ({worst})")
        tables.append(table)
    return tables


# ------------------------------------------------------------------ search


def search(given: argparse.Namespace) -> dict[str, Any]:
    """How near a method comes to the best sequence in simulated runs, in every instance that a study has run.

    Each round draws another world; its best sequence is known and is simulated too, so that both have the same overheads.
    tree-warm starts from a tree of every other instance.
    """
    from cgs_jax import load_problem
    from cgs_jax.api import make_chooser
    from cgs_jax.experiments.measures import final_rate
    from cgs_jax.experiments.runs import Store
    from cgs_jax.experiments.simulation import World, simulate

    if given.study is None:
        raise InputError("search reads what the runs of a study learned, expected --study DIR")
    store, seconds = Store(given.study / "runs"), given.seconds
    report: dict[str, Any] = {"seconds": seconds, "rounds": given.rounds, "method": given.method, "scenes": {}}
    for scene in given.scenes:
        rows = {}
        known = {instance: trees for instance in given.instances if (trees := store.trees(scene, instance))}
        for instance, trees in known.items():
            problem = load_problem(scene, instance)
            others = [of_other[0] for other, of_other in known.items() if other != instance]
            prior = others if given.method == "tree-warm" else []
            shares = []
            for seed in range(given.seed, given.seed + given.rounds):
                world = World(problem, trees, seed)
                named = problem.transitions.format(world.best)
                best = simulate(world, make_chooser(problem, named, seed), seed, seconds)
                attainable = final_rate(best, seconds)
                if not attainable:
                    raise InputError(f"the best sequence of {scene} makes nothing in {seconds:g} s, expected more --seconds")
                chooser = make_chooser(problem, given.method, seed, prior)
                found = simulate(world, chooser, seed, seconds)
                ended = chooser.best_sequences(1)
                early = 0.2 * seconds
                shares.append(
                    {
                        "early": (found <= early).sum() / early / attainable,
                        "final": final_rate(found, seconds) / attainable,
                        "end": world.rate(ended[0][0]) / world.best_rate if ended else 0.0,
                        "best": named,
                    }
                )
            rows[str(instance)] = {name: [share[name] for share in shares] for name in ("early", "final", "end", "best")}
        if rows:
            report["scenes"][scene] = rows
    if not report["scenes"]:
        raise InputError(f"no runs of tree on {', '.join(given.scenes)} in {given.study}, expected the folder of a study")
    return report


def search_tables(report: Mapping[str, Any]) -> list[Table]:
    """One table: shares of the best sequence's rate, means over rounds."""
    seconds = report["seconds"]
    title = f"Simulated runs of {report['method']}, share of the best sequence's rate, means of {report['rounds']}"
    columns = ["instance", f"first {0.2 * seconds:g} s", f"{0.5 * seconds:g} to {seconds:g} s", "best found"]
    table = new_table(title, columns)
    names = ("early", "final", "end")
    for scene, rows in report["scenes"].items():
        means = {instance: [statistics.mean(row[name]) for name in names] for instance, row in rows.items()}
        for instance, values in means.items():
            table.add_row(f"{scene} {instance}", *(f"{value:.2f}" for value in values))
        table.add_row(f"{scene}, mean", *(f"{statistics.mean(column):.3f}" for column in zip(*means.values(), strict=True)))
    return [table]


# ------------------------------------------------------------------ the peer


def load_peer() -> ModuleType:
    """The script beside this one that runs KOMO."""
    path = ROOT / "scripts" / "peer_komo.py"
    spec = importlib.util.spec_from_file_location("peer_komo", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["peer_komo"] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    return module


def komo(given: argparse.Namespace) -> dict[str, Any]:
    """Both programs in turn on the peer's scenes, and each one's solutions judged by the other."""
    from cgs_jax import Tolerances, load_problem
    from cgs_jax.sampler import SamplerSettings

    peer = load_peer()
    cores = [n for n in (1, 2) if n <= len(os.sched_getaffinity(0))]
    default = SamplerSettings()
    loosened = dataclasses.replace(default, solver=dataclasses.replace(default.solver, tolerance=STRICT_AIM))
    ours: dict[str, tuple[SamplerSettings, Tolerances]] = {
        "ours": (default, Tolerances()),
        "ours loosened": (loosened, Tolerances(STRICT, STRICT, STRICT)),
    }
    report: dict[str, Any] = {
        "peer": "komo",
        "tolerances": {"strict": peer.TOLERANCES["strict"], "ours": peer.TOLERANCES["ours"]},
        "options": peer.TUNED,
        "seconds": given.seconds,
        "window": list(given.window),
        "rounds": given.rounds,
        "method": given.method,
        "scenes": {},
    }
    for scene in given.peer_scenes:
        problem = load_problem(ROOT / "scenes" / "peers" / scene / f"{scene}.toml")
        for settings, _ in ours.values():
            warm_up(problem, given.method, settings)
        rates: dict[str, list[float]] = {}
        from_start: dict[str, list[float]] = {}
        solutions: dict[str, np.ndarray] = {}
        for i in range(given.rounds):
            for n in cores:
                told, found = peer.run_komo(
                    scene, seconds=given.seconds, processes=n, seed=given.seed + 100 * i, python=given.python
                )
                solutions["komo"] = found["qpos"]
                report["robotic"] = told["robotic"]
                for tolerance in peer.TOLERANCES:
                    rates.setdefault(f"komo, {tolerance}, {n}", []).append(told[tolerance]["per_second"])
                for name, (settings, tolerances) in ours.items():
                    placed = dataclasses.replace(settings, workers=n)
                    with on_cores(n):
                        run = measure(problem, given.window, given.method, given.seed + i, placed, tolerances)
                    rates.setdefault(f"{name}, {n}", []).append(run.rate)
                    from_start.setdefault(f"{name}, {n}", []).append(run.rate_from_start)
                    solutions[name] = run.record.samples().qpos
                console.print(f"[dim]{scene}, round {i + 1}, {n} cores: {last_of(rates)}[/]")
        medians = {name: statistics.median(values) for name, values in rates.items()}
        report["scenes"][scene] = {
            "order": peer.BEST_ORDER[scene],
            "sequence": peer.ORDERS[scene][peer.BEST_ORDER[scene]],
            "wanted_ratio": PEER_RATIOS[scene],
            "rates": rates,
            "rates_from_start": from_start,
            "medians": medians,
            "ratios": peer_ratios(medians, cores),
            "ratios_from_start": peer_ratios(
                medians | {name: statistics.median(values) for name, values in from_start.items()}, cores
            ),
            "checks": cross_check(peer, scene, problem, solutions, given.python),
        }
    return report


def last_of(rates: Mapping[str, Sequence[float]]) -> str:
    """The newest rate of each row, for the log."""
    return "; ".join(f"{name}: {values[-1]:.0f}" for name, values in rates.items())


def peer_ratios(medians: Mapping[str, float], cores: Sequence[int]) -> dict[str, float | None]:
    """Our rate over the peer's at each tolerance and number of cores; None where the peer found nothing.

    At strict tolerance there are two: our samples as they are, which are all within it, and our solver and audit loosened.
    """
    pairs = {}
    for n in cores:
        pairs[f"strict, {n}"] = (f"ours loosened, {n}", f"komo, strict, {n}")
        pairs[f"strict with our tolerance, {n}"] = (f"ours, {n}", f"komo, strict, {n}")
        pairs[f"ours, {n}"] = (f"ours, {n}", f"komo, ours, {n}")
    return {name: medians[a] / medians[b] if medians[b] else None for name, (a, b) in pairs.items()}


def cross_check(
    peer: ModuleType, scene: str, problem: Problem, solutions: Mapping[str, np.ndarray], python: str
) -> dict[str, Any]:
    """Our solutions by the peer's residuals, the peer's by our audit."""
    from cgs_jax import Tolerances
    from cgs_jax.audit import Auditor
    from cgs_jax.scene import attachments, goals, placements

    checks: dict[str, Any] = {}
    for name in ("ours", "ours loosened"):
        if len(solutions[name]):
            checks[f"{name}, judged by komo"], _ = peer.check_samples(scene, solutions[name][:CHECKED_BY_PEER], python)
    task = problem.scene.task
    switches = [switch.name for switch in task.switches]
    theirs = solutions["komo"]
    for tolerance, bounds in (("strict", Tolerances(STRICT, STRICT, STRICT)), ("ours", Tolerances())):
        if not len(theirs):
            continue
        auditor = Auditor(problem.scene.model, attachments(task), placements(task), goals(task), switches, bounds)
        result = auditor.check(theirs)
        worst = np.nanmax(result.violation, axis=0)
        checks[f"komo, judged by our audit, {tolerance}"] = {
            "samples": len(theirs),
            "feasible": float(result.ok.mean()),
            "worst": {n: float(w) for n, w in sorted(zip(result.constraints, worst, strict=True), key=lambda e: -e[1])[:5]},
        }
    return checks


def komo_tables(report: Mapping[str, Any]) -> list[Table]:
    """Rates, ratios and the checks."""
    rates = new_table("Verified samples per second, medians", ["scene", "program, tolerance, cores", "samples/s", "all rounds"])
    ratios = new_table("Times the peer", ["scene", "tolerance, cores", "ratio", "from start", "wanted"])
    checks = new_table("Solutions judged by the other program", ["scene", "whose", "samples", "feasible"])
    for scene, entry in report["scenes"].items():
        for name, values in entry["rates"].items():
            rates.add_row(scene, name, number(entry["medians"][name]), " ".join(map(number, values)))
        for name, ratio in entry["ratios"].items():
            wanted = number(entry["wanted_ratio"]) if name.startswith("strict") else ""
            ratios.add_row(scene, name, number(ratio), number(entry["ratios_from_start"][name]), wanted)
        for name, check in entry["checks"].items():
            shares = {key: check[key] for key in ("feasible", "feasible_strict", "feasible_ours") if key in check}
            text = ", ".join(f"{key.removeprefix('feasible_')} {share:.3f}" for key, share in shares.items())
            checks.add_row(scene, name, number(check["samples"]), text)
    return [rates, ratios, checks]


# ------------------------------------------------------------------ comparison


def metrics(result: Mapping[str, Any]) -> dict[str, tuple[float, bool]]:
    """What is compared between two result files: name to value, and whether more is better."""
    parts = result.get("parts", {})
    found: dict[str, tuple[float, bool]] = {}
    for scene, entry in parts.get("throughput", {}).get("scenes", {}).items():
        found[f"throughput {scene} mean"] = (entry["mean"], True)
        for instance, row in entry["instances"].items():
            found[f"throughput {scene} {instance}"] = (row["rate"], True)
    for scene, entry in parts.get("start", {}).get("scenes", {}).items():
        for name in ("cold_seconds", "warm_seconds"):
            found[f"start {scene} {name}"] = (entry[name], False)
        found[f"start {scene} compile_all_seconds"] = (entry["compile_all_cold"]["seconds"], False)
    for scene, entry in parts.get("scaling", {}).get("scenes", {}).items():
        for row in entry["rows"]:
            found[f"scaling {scene} {row['axis']} {row['value']} on {row['cores']}"] = (row["rate"], True)
    for scene, entry in parts.get("options", {}).get("scenes", {}).items():
        for name, row in entry["variants"].items():
            found[f"options {scene} {name} coverage"] = (row["coverage"], True)
    for scene, entry in parts.get("komo", {}).get("scenes", {}).items():
        for name, ratio in entry["ratios"].items():
            if ratio is not None:
                found[f"komo {scene} {name}"] = (ratio, True)
    return found


def compare(new: Mapping[str, Any], old: Mapping[str, Any], threshold: float, only: str = "") -> list[tuple[str, float, bool]]:
    """Name, ratio and whether it holds, for what both files have; a ratio above 1 is an improvement.

    only: the beginning of the names to compare. Raises InputError when the files have nothing in common.
    """
    ours, theirs = metrics(new), metrics(old)
    shared = [name for name in ours if name in theirs and name.startswith(only)]
    if not shared:
        there = ", ".join(sorted({name.partition(" ")[0] for name in theirs})) or "nothing"
        raise InputError(f"nothing to compare{f' under {only!r}' if only else ''}: the older file has {there}")
    rows = []
    for name in shared:
        (value, more), (before, _) = ours[name], theirs[name]
        better, worse = (value, before) if more else (before, value)
        ratio = better / worse if worse > 0 else (1.0 if better <= 0 else float("inf"))
        rows.append((name, ratio, ratio >= threshold))
    return rows


def gate(new: Mapping[str, Any], given: argparse.Namespace) -> int:
    """Prints every ratio; exit status 1 when one is below the threshold."""
    old = read_result(given.against)
    rows = compare(new, old, given.threshold, given.only)
    table = new_table(f"Against {given.against} (at least {given.threshold:g})", ["metric", "ratio", ""])
    for name, ratio, holds in rows:
        table.add_row(name, f"{ratio:.3f}", "" if holds else "[red]slower[/]")
    console.print(table)
    if new["machine"]["cpu"] != old["machine"]["cpu"] or new["machine"]["cores"] != old["machine"]["cores"]:
        console.print(f"The machines differ: {new['machine']['cpu']} here, {old['machine']['cpu']} there.")
    return 0 if all(holds for _, _, holds in rows) else 1


def read_result(path: Path) -> dict[str, Any]:
    """A result file. Raises InputError when it is none."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read results {path}: {error}") from None
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise InputError(f"{path} is no result of this script, expected the schema {SCHEMA}")
    return data


# ------------------------------------------------------------------ command line


PARTS: dict[str, tuple[Callable[[argparse.Namespace], dict[str, Any]], Callable[[Mapping[str, Any]], list[Table]]]] = {
    "throughput": (throughput, throughput_tables),
    "operators": (operators, operators_tables),
    "start": (start, start_tables),
    "scaling": (scaling, scaling_tables),
    "utilisation": (utilisation, utilisation_tables),
    "options": (options, options_tables),
    "variants": (variants, variants_tables),
    "search": (search, search_tables),
    "komo": (komo, komo_tables),
}

WITHOUT_BEING_ASKED = ("throughput", "operators", "start", "scaling", "utilisation")


def new_table(title: str, columns: Sequence[str]) -> Table:
    """A table whose first column is text to the left and the others to the right."""
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 or column in ("sequence", "operator", "variant") else "right")
    return table


def number(value: float | None) -> str:
    """A number with three digits or, above a thousand, none behind the point."""
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def machine() -> dict[str, Any]:
    """Processor, cores that this process may use, memory and system."""
    model = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return {
        "cpu": model,
        "cores": len(os.sched_getaffinity(0)),
        "memory_bytes": memory,
        "system": f"{platform.system()} {platform.machine()}",
    }


def versions() -> dict[str, str]:
    """Of what the numbers depend on."""
    found = {"python": platform.python_version()}
    for name in ("cgs-jax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy"):
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    with contextlib.suppress(OSError):
        told = subprocess.run(["git", "-C", str(ROOT), "describe", "--always", "--dirty"], capture_output=True, text=True)
        if told.returncode == 0:
            found["commit"] = told.stdout.strip()
    return found


def numbers_in(text: str) -> list[int]:
    """`0-3,7` as [0, 1, 2, 3, 7]."""
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        try:
            found += range(int(first), int(last if dash else first) + 1)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not understood, expected for example 0-3,7") from None
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} is empty, expected for example 0-3,7")
    return found


def window_in(text: str) -> tuple[float, float]:
    """`10,20` as (10.0, 20.0)."""
    try:
        low, high = map(float, text.split(","))
    except ValueError:
        low, high = 1.0, 0.0
    if not 0 <= low < high:
        raise argparse.ArgumentTypeError(f"{text!r} is not understood, expected two rising seconds such as 10,20")
    return low, high


def names_in(text: str) -> list[str]:
    """`a,b` as ["a", "b"]."""
    return [name for name in text.split(",") if name]


def parse() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").partition("\n\n")[0],
        epilog=f"Without a part and without --peer: {', '.join(WITHOUT_BEING_ASKED)}.",
    )
    known = [name for name in PARTS if name != "komo"]
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(known))
    parser.add_argument("--peer", choices=["komo"], help="both programs in turn on scenes/peers")
    parser.add_argument("--python", default=sys.executable, help="interpreter that has the peer's package robotic")
    parser.add_argument("--scenes", type=names_in, default=list(TARGETS), help="default: pick_place,handover,banana")
    parser.add_argument("--peer-scenes", type=names_in, default=list(PEER_RATIOS), help="default: pp,ho,ho2")
    parser.add_argument(
        "--instances", type=numbers_in, default=list(range(8)), help="of throughput, search; else the first (default 0-7)"
    )
    parser.add_argument(
        "--window", type=window_in, default=(10.0, 20.0), metavar="A,B", help="seconds of sampling that count (default 10,20)"
    )
    parser.add_argument(
        "--seconds", type=float, default=6.0, help="of one run in scaling, options, variants, search, the peer (default 6)"
    )
    parser.add_argument(
        "--rounds", type=int, default=3, help="warm starts, turns with the peer, seeds of the others (default 3)"
    )
    parser.add_argument("--method", default="tree", help="of throughput, operators, utilisation, search, peer (default tree)")
    parser.add_argument("--study", type=Path, metavar="DIR", help="folder of scripts/reproduce.py, for search")
    sizes = [256, 512, 1024, 2048, 4096]
    parser.add_argument("--batches", type=numbers_in, default=sizes, help="batch sizes of scaling, options")
    parser.add_argument("--lanes", type=numbers_in, default=[16, 32, 64, 128, 256], help="lanes of scaling")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache", type=Path, metavar="DIR", help="folder of compiled programs (default: the user's)")
    parser.add_argument("--out", type=Path, default=Path("benchmark.json"), help="result file (default benchmark.json)")
    parser.add_argument("--against", type=Path, metavar="FILE", help="compare with this older result")
    parser.add_argument("--results", type=Path, metavar="FILE", help="compare this result instead of measuring")
    parser.add_argument("--threshold", type=float, default=0.85, help="smallest ratio that passes (default 0.85)")
    parser.add_argument("--only", default="", metavar="NAME", help="compare metrics whose names begin so")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    return parser


def check(given: argparse.Namespace) -> list[str]:
    """The parts to run. Raises InputError for what makes no sense."""
    known = [name for name in PARTS if name != "komo"]
    for part in given.parts:
        if part not in known:
            raise InputError(f"unknown part '{part}', available: {', '.join(known)}; and --peer komo")
    for scene in given.peer_scenes:
        if scene not in PEER_RATIOS:
            raise InputError(f"unknown scene of the peer '{scene}', available: {', '.join(PEER_RATIOS)}")
    if not given.seconds > 0 or given.rounds < 1:
        raise InputError(f"expected --seconds above 0 and --rounds of at least 1, got {given.seconds:g} and {given.rounds}")
    if given.results and not given.against:
        raise InputError("--results is only compared, expected --against FILE beside it")
    if "search" in given.parts and given.method == "tree-warm" and len(given.instances) < 2:
        raise InputError("tree-warm starts from runs on other instances, expected at least two in --instances")
    parts = [*given.parts, *([given.peer] if given.peer else [])]
    return parts or list(WITHOUT_BEING_ASKED)


def run_parts(given: argparse.Namespace, parts: Sequence[str]) -> dict[str, Any]:
    """Measures part by part; the file is written after each, so that nothing is lost to an interruption."""
    from cgs_jax import enable_disk_cache
    from cgs_jax.record import write_json

    enable_disk_cache(given.cache)
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": ["scripts/benchmark.py", *sys.argv[1:]],
        "machine": machine(),
        "versions": versions(),
        "parts": {},
    }
    given.out.parent.mkdir(parents=True, exist_ok=True)
    for part in parts:
        work, tables = PARTS[part]
        before, began = os.getloadavg()[0], time.perf_counter()
        report = work(given)
        seconds = time.perf_counter() - began
        report["load_average"] = {"before": before, "after": os.getloadavg()[0]}
        report["took_seconds"] = seconds
        result["parts"][part] = report
        write_json(given.out, result)
        for table in tables(report):
            console.print(table)
    load = [max(report["load_average"].values()) for report in result["parts"].values()]
    console.print(f"{result['machine']['cpu']}, {result['machine']['cores']} cores, load up to {max(load):.1f}; {given.out}")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0, 1 when slower than `--against`, or 2 for bad input (one line)."""
    given = parse().parse_args(arguments)
    try:
        if given.worker:
            scene, _, instance = given.worker.rpartition(",")
            print(json.dumps(compile_while_sampling(scene, int(instance))))
            return 0
        parts = check(given)
        if given.against:
            read_result(given.against)  # a wrong file is told before the measurement, not after it
        result = read_result(given.results) if given.results else run_parts(given, parts)
        return gate(result, given) if given.against else 0
    except Exception as error:
        if not isinstance(error, InputError) and type(error).__name__ != "PeerError":
            raise
        print(f"benchmark.py: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
