"""The record of a run: listens to a sampler's events and turns them into samples, statistics and files."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from cgs_jax import diagram
from cgs_jax.audit import Auditor
from cgs_jax.coverage import duplicate_share, limit_share
from cgs_jax.problems import Problem
from cgs_jax.sampler import Compiled, Event, Finished, Found, Ran, SamplerSettings, Started
from cgs_jax.samples import PARTS, SampleSet, remove_parts
from cgs_jax.scene import attachments, goals, placements
from cgs_jax.transitions import Transition
from cgs_jax.uct import Chooser


@dataclass
class OperatorRecord:
    """What one conditional problem did in a run."""

    calls: int = 0
    tasks: int = 0
    proposed: int = 0
    cleared: int = 0
    iterations: int = 0
    executed: int = 0
    device_seconds: float = 0.0
    first_tries: int = 0
    first_successes: int = 0
    second_tries: int = 0
    second_successes: int = 0
    failures: dict[str, int] = field(default_factory=dict)

    @property
    def success_rate(self) -> float:
        """Share of tasks that succeeded."""
        return self.cleared / max(self.tasks, 1)

    @property
    def causes(self) -> tuple[float, float] | None:
        """The two factors of the paper's Eq. 2: how often the condition is feasible, and the solver's success on those.

        With f feasible and s solved of them, a first try succeeds with f s, a second one of a failed condition with
        f (1 - s) s / (1 - f s). None without enough second tries to tell.
        """
        if self.second_tries < 30 or not self.first_successes:
            return None
        first = self.first_successes / self.first_tries
        second = self.second_successes / self.second_tries
        solved = min(max(1.0 - second * (1.0 - first) / first, first), 1.0)
        return min(first / solved, 1.0), solved

    def as_json(self) -> dict[str, Any]:
        """Plain numbers."""
        causes = self.causes
        return {
            "calls": self.calls,
            "tasks": self.tasks,
            "rows_solved": self.proposed,
            "successes": self.cleared,
            "success_rate": self.success_rate,
            "iterations_per_task": self.iterations / max(self.tasks, 1),
            "useful_share": self.iterations / self.executed if self.executed else None,
            "device_seconds": self.device_seconds,
            "microseconds_per_task": 1e6 * self.device_seconds / max(self.tasks, 1),
            "condition_feasible": None if causes is None else causes[0],
            "solver_success_if_feasible": None if causes is None else causes[1],
            "failures": dict(sorted(self.failures.items(), key=lambda item: -item[1])),
        }


class Recorder:
    """Aggregates the events of one run."""

    reason: str | None = None
    """What ended the run; None while it is under way."""

    def __init__(
        self,
        problem: Problem,
        chooser: Chooser,
        method: str,
        seed: int,
        settings: SamplerSettings,
        auditor: Auditor,
    ) -> None:
        self.problem, self.chooser, self.method, self.seed = problem, chooser, method, seed
        self.settings, self.tolerances, self._columns = settings, auditor.tolerances, auditor.constraints
        self.operators: dict[str, OperatorRecord] = {}
        self.transitions: dict[str, Transition] = {}  # one of each operator
        self.startup_seconds = self.compile_seconds = self.device_seconds = 0.0
        self.host_seconds = self.audit_seconds = self.elapsed = 0.0
        self.programs: list[tuple[str, float]] = []
        self.count = self.rejected = 0
        self._found: list[Found] = []
        self._appended = self._parts = 0
        self._final: dict[str, Any] | None = None

    def listen(self, event: Event) -> None:
        """Takes one event in."""
        if isinstance(event, Compiled):
            self.compile_seconds += event.seconds
            self.programs.append((event.name, event.seconds))
        elif isinstance(event, Started):
            self.startup_seconds = event.startup_seconds
        elif isinstance(event, Ran):
            self._ran(event)
        elif isinstance(event, Found):
            self._found.append(event)
            self.count += len(event.qpos)
            self.rejected += event.rejected
            self.audit_seconds += event.audit_seconds
            self.elapsed = event.elapsed
        elif isinstance(event, Finished):
            self.reason, self.elapsed = event.reason, event.elapsed
            # Asking the chooser for its best sequences moves its price: all files of a run tell one.
            self._final = self.meta()

    def _ran(self, event: Ran) -> None:
        transition = event.path[event.position]
        name = operator_text(transition)
        self.transitions.setdefault(name, transition)
        record = self.operators.setdefault(name, OperatorRecord())
        record.calls += 1
        for counted in (
            "tasks",
            "proposed",
            "cleared",
            "iterations",
            "executed",
            "device_seconds",
            "first_tries",
            "first_successes",
            "second_tries",
            "second_successes",
        ):
            setattr(record, counted, getattr(record, counted) + getattr(event, counted))
        for name, times in event.failures.items():
            record.failures[name] = record.failures.get(name, 0) + times
        self.device_seconds += event.device_seconds
        self.host_seconds += event.host_seconds

    @property
    def rate(self) -> float:
        """Samples per second of sampling time so far."""
        return self.count / self.elapsed if self.elapsed else 0.0

    def best_sequences(self, count: int) -> list[tuple[str, float]]:
        """Sequences with the highest predicted rates (samples per second of the whole machine), best first."""
        # The chooser knows device seconds of single batches; several run side by side.
        return [
            (self.problem.transitions.format(path), rate * self.settings.workers)
            for path, rate in self.chooser.best_sequences(count)
        ]

    def samples(self, found: list[Found] | None = None) -> SampleSet:
        """The samples found so far, or those of some events."""
        return sample_set(self.problem, self._found if found is None else found, self.meta(), self._columns)

    def meta(self) -> dict[str, Any]:
        """Description of the run, JSON-ready (`meta` of schema cgs_jax/1); the same from the end of the run on."""
        if self._final is not None:
            return dict(self._final)
        chooser: Any = self.chooser
        price = getattr(chooser, "price", chooser.rate)
        transitions = self.problem.transitions
        return {
            "scene": self.problem.name,
            "instance": self.problem.scene.instance,
            "seed": self.seed,
            "method": self.method,
            "tolerances": vars(self.tolerances),
            "versions": {name: _version(name) for name in ("cgs-jax", "jax", "mujoco", "mujoco-mjx", "numpy")}
            | {"python": platform.python_version()},
            "startup_seconds": self.startup_seconds,
            "elapsed": self.elapsed,
            "wall_seconds": self.startup_seconds + self.elapsed,
            "compile_seconds": self.compile_seconds,
            "device_seconds": self.device_seconds,
            "host_seconds": self.host_seconds,
            "audit_seconds": self.audit_seconds,
            "samples": self.count,
            "rejected_by_audit": self.rejected,
            "rate": self.rate,
            "ended_by": self.reason,
            # The paper's weight for costs in seconds: lambda = 1 / (c + 1), c the seconds per finished sample.
            "lambda": price / (1.0 + price),
            "c_uct": getattr(chooser, "c_uct", None),
            "reward": getattr(chooser, "reward", None),
            "batch_size": self.settings.batch_size,
            "tries": self.settings.tries,
            "pools": self.settings.pools,
            "workers": self.settings.workers,
            "deterministic": self.settings.deterministic,
            "collisions": self.settings.collisions,
            "transitions": {"complete": transitions.complete_count, "pruned": transitions.pruned_count()},
        }

    def profile(self) -> dict[str, Any]:
        """Where the time went: per operator, compilation, host, audit."""
        total = self.settings.workers * self.elapsed
        return {
            "operators": {name: record.as_json() for name, record in self._by_time()},
            "programs": [{"name": name, "seconds": seconds} for name, seconds in self.programs],
            "shares_of_worker_time": {
                "device": self.device_seconds / total if total else 0.0,
                "host": self.host_seconds / total if total else 0.0,
                "audit": self.audit_seconds / total if total else 0.0,
            },
        }

    def _by_time(self) -> list[tuple[str, OperatorRecord]]:
        return sorted(self.operators.items(), key=lambda item: -item[1].device_seconds)

    def diagnosis(self) -> str:
        """Which operator and constraint stopped the run, in one line; for runs without a sample."""
        tried = [(name, record) for name, record in self.operators.items() if record.tasks]
        if not tried and self.reason == "interrupt":
            return "the run was interrupted before an operator had run"
        if not tried:
            return "no operator ran before the budget ended; give more time with --time-budget"
        name, record = min(tried, key=lambda item: (item[1].success_rate, -item[1].tasks))
        if not record.failures:
            return f"operator {name} succeeded {record.cleared} of {record.tasks} times; give more time with --time-budget"
        constraint, times = max(record.failures.items(), key=lambda item: item[1])
        share = 100.0 * times / max(sum(record.failures.values()), 1)
        return (
            f"operator {name} succeeded {record.cleared} of {record.tasks} times; "
            f"{constraint} stopped {share:.0f} % of its failures"
        )

    def progress(self, points: int = 200) -> dict[str, list[float]]:
        """How many samples had been found after how many seconds of sampling, at up to so many moments."""
        counts = np.cumsum([0, *(len(event.qpos) for event in self._found)])
        seconds = np.array([0.0, *(event.elapsed for event in self._found)])
        chosen = np.unique(np.linspace(0, len(counts) - 1, points).round().astype(int))
        return {"seconds": seconds[chosen].tolist(), "samples": counts[chosen].tolist()}

    def spread(self, samples: SampleSet) -> dict[str, dict[str, float]]:
        """Per configuration variable: share of samples with a joint at a limit, and share with a near-duplicate."""
        task, model = self.problem.scene.task, self.problem.scene.model
        robots = {variable: robot for switch in task.switches for robot, variable in switch.configurations.items()}
        shares = {}
        for name, robot in robots.items():
            low, high = np.array([model.joint(joint).range for joint in task.robot(robot).joints]).T
            values = samples[name]
            shares[name] = {"limit_share": limit_share(values, low, high), "duplicate_share": duplicate_share(values)}
        return shares

    def save(self, folder: str | os.PathLike[str], samples: SampleSet | None = None) -> Path:
        """Writes samples.npz (if there is a sample), tree.json and run.json into a folder; returns the folder.

        samples: what is to be written in place of all that were found. Parts that were appended before are removed.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        samples = self.samples() if samples is None else samples
        if len(samples):
            samples.save(folder / "samples.npz")
        remove_parts(folder)
        self.save_tree(folder / "tree.json")
        results = {
            "samples_written": len(samples),
            "diagnosis": None if self.count else self.diagnosis(),
            "best_sequences": self.best_sequences(3),
            "spread": self.spread(samples),
            "progress": self.progress(),
            "graph": diagram.describe(self.problem.graph, self.problem.scene.task),
        }
        write_json(folder / "run.json", self.meta() | results | self.profile())
        return folder

    def append(self, folder: str | os.PathLike[str]) -> None:
        """Writes the samples found since the last call as one more part, which `SampleSet.load` reads if the run is killed.

        Raises InputError when it cannot be written.
        """
        found = self._found[self._appended :]
        self._appended = len(self._found)
        if any(len(event.qpos) for event in found):
            self.samples(found).save(Path(folder) / PARTS / f"{self._parts:06d}.npz")
            self._parts += 1

    def save_tree(self, path: str | os.PathLike[str]) -> None:
        """Writes the statistics that the chooser gathered, for `load_tree`."""
        write_json(Path(path), self.chooser.as_json())

    def save_profile(self, path: str | os.PathLike[str], utilisation: Mapping[str, Any]) -> None:
        """Writes `profile` as JSON, with what `utilisation.utilisation` says of the run."""
        write_json(Path(path), {**self.profile(), "utilisation": utilisation})


def operator_text(transition: Transition) -> str:
    """An operator by its conditional problem: new variables, then what they are conditioned on."""
    new = ",".join(transition.new)
    new = f"({new})" if len(transition.new) > 1 else new
    return f"{new} | {','.join(sorted(transition.condition))}" if transition.condition else new


def sample_set(problem: Problem, found: list[Found], meta: Mapping[str, Any], constraints: tuple[str, ...]) -> SampleSet:
    """Samples of several events as one set."""
    task, model = problem.scene.task, problem.scene.model
    names = [variable.name for variable in problem.graph.variables]
    kinds = {variable.name: variable.kind for variable in problem.graph.variables}
    texts = tuple(dict.fromkeys(event.sequence for event in found))
    empty = np.zeros((0, len(task.switches), model.nq))
    values = {}
    for name in names:
        size = 7 if problem.dofs[name] is None else problem.dofs[name]
        parts = [event.values[name] for event in found]
        values[name] = np.concatenate([np.zeros((0, size)), *parts]).astype(np.float64)
    return SampleSet(
        mjcf=problem.scene.xml,
        variables=values,
        mode_switches=tuple(switch.name for switch in task.switches),
        qpos=np.concatenate([empty, *(event.qpos for event in found)]),
        attachments=attachments(task),
        placements=placements(task),
        goals=goals(task),
        configurations=problem.scene.configurations(),
        sequences=texts,
        sequence=np.repeat([texts.index(e.sequence) for e in found], [len(e.qpos) for e in found]).astype(np.intp),
        elapsed=np.repeat([e.elapsed for e in found], [len(e.qpos) for e in found]),
        violation=np.concatenate([np.zeros((0, len(constraints))), *(event.violation for event in found)]),
        constraints=constraints,
        meta=meta,
        kinds=kinds,
    )


def write_json(path: Path, data: Any) -> None:
    """Writes JSON so that the file is either whole or not there."""
    temporary = path.with_name(path.name + f".{os.getpid()}.part")
    temporary.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    temporary.replace(path)


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
