"""Single runs of an experiment: choosers that only experiments need, and a folder that keeps what was run."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as File
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgs_jax.problems import Problem
from cgs_jax.record import Recorder, operator_text, write_json
from cgs_jax.sampler import Compiled, Event, Sampler, SamplerSettings, Started
from cgs_jax.transitions import Path, Transition, Transitions
from cgs_jax.uct import Chooser, Ready, Tree

TURN = 1.0
"""Seconds of sampling between two changes of turn: the machine's speed changes more slowly than that."""


@dataclass(frozen=True)
class Run:
    """What is run once: everything that tells it from other runs of the same study."""

    stage: str
    scene: str
    instance: int
    method: str
    seed: int
    seconds: float

    @property
    def key(self) -> str:
        """Name of its files, relative to the folder of runs."""
        method = "".join(c if c.isalnum() or c in "._-" else "_" for c in self.method)
        return f"{self.scene}/{self.stage}/i{self.instance}_{method}_s{self.seed}"


@dataclass(frozen=True)
class Kept:
    """What is kept of a run.

    data: JSON-ready. elapsed: (N,) seconds of sampling time of each sample, ascending. values: (N, dim) by variable,
    empty where they were not kept.
    """

    data: Mapping[str, Any]
    elapsed: NDArray[np.float64]
    values: Mapping[str, NDArray[np.float32]]


class Store:
    """Finished runs in a folder: one JSON file each, with an .npz beside it."""

    def __init__(self, folder: File) -> None:
        self.folder = folder

    def has(self, run: Run) -> bool:
        """Was it run to its end?"""
        return self._file(run, "json").exists()

    def write(self, run: Run, kept: Kept) -> None:
        """Keeps a run; the JSON file appears last and whole."""
        target = self._file(run, "json")
        target.parent.mkdir(parents=True, exist_ok=True)
        arrays = {f"x_{name}": value for name, value in kept.values.items()}
        np.savez_compressed(self._file(run, "npz"), elapsed=kept.elapsed, **arrays)
        write_json(target, {"run": vars(run), **kept.data})

    def read(self, run: Run, values: bool = False) -> Kept:
        """A finished run; values are read only when they are asked for."""
        with np.load(self._file(run, "npz"), allow_pickle=False) as arrays:
            names = [name for name in arrays.files if name.startswith("x_")] if values else []
            return Kept(
                json.loads(self._file(run, "json").read_text(encoding="utf-8")),
                arrays["elapsed"],
                {name[2:]: arrays[name] for name in names},
            )

    def trees(self, scene: str, instance: int) -> list[Mapping[str, Any]]:
        """What the runs on an instance learned that began with nothing, in the order of the files' names."""
        kinds = f"main/i{instance}_tree_s*.json", f"survey/i{instance}_survey_s*.json"
        files = sorted(file for kind in kinds for file in (self.folder / scene).glob(kind))
        return [json.loads(file.read_text(encoding="utf-8"))["tree"] for file in files]

    def _file(self, run: Run, suffix: str) -> File:
        return self.folder / f"{run.key}.{suffix}"


def execute(
    problem: Problem,
    chooser: Any,
    run: Run,
    settings: SamplerSettings | None = None,
    keep_values: bool = False,
    keep_tree: bool = False,
) -> Kept:
    """Runs a chooser for the run's time; every sample counted has passed the audit."""
    one = _Competitor(problem, chooser, run, settings or SamplerSettings())
    one.go_on(math.inf)
    return one.kept(keep_values, keep_tree)


def execute_in_turns(
    problem: Problem, choosers: Sequence[Any], runs: Sequence[Run], settings: SamplerSettings | None = None
) -> list[Kept]:
    """Runs choosers side by side: each goes on for `TURN` seconds of its own time, then it waits for the others. A run that is
    longer than others begins sooner, alone, so that all end together.

    Runs one after the other meet a machine whose speed differs by a fifth from one minute to the next; these meet the same one.
    The batches that are on their way when a turn ends are finished in the next one's: every method gives and takes that alike.
    """
    all_ = [_Competitor(problem, c, run, settings or SamplerSettings()) for c, run in zip(choosers, runs, strict=True)]
    for one in all_:
        one.begin()
    shortest = min(run.seconds for run in runs)
    for one, run in zip(all_, runs, strict=True):
        if run.seconds > shortest:
            one.go_on(run.seconds - shortest)
    while unfinished := [one for one in all_ if not one.finished]:
        for one in unfinished:
            one.go_on(TURN)
    return [one.kept() for one in all_]


class _Competitor:
    """A run whose clock stands still while others have their turn."""

    def __init__(self, problem: Problem, chooser: Any, run: Run, settings: SamplerSettings) -> None:
        sampler = Sampler(problem, chooser, run.seed, settings)
        self._chooser = chooser
        self._recorder = Recorder(problem, chooser, run.method, run.seed, settings, sampler.auditor)
        self._events = sampler.events(run.seconds, clock=self._clock)
        self._passed = 0.0  # seconds
        self._since: float | None = None  # when the turn began
        self.finished = False

    def _clock(self) -> float:
        return self._passed + (0.0 if self._since is None else time.perf_counter() - self._since)

    def begin(self) -> None:
        """Up to the moment when sampling starts."""
        self._go_on_until(lambda event: isinstance(event, Started))

    def go_on(self, seconds: float) -> None:
        """For so many seconds, or to the end of the run."""
        end = self._clock() + seconds
        self._go_on_until(lambda event: self._clock() >= end)

    def _go_on_until(self, enough: Callable[[Event], bool]) -> None:
        self._since = time.perf_counter()
        for event in self._events:
            self._recorder.listen(event)
            if enough(event):
                break
        else:
            self.finished = True
        self._passed, self._since = self._clock(), None

    def kept(self, keep_values: bool = False, keep_tree: bool = False) -> Kept:
        return _kept(self._recorder, self._chooser, keep_values, keep_tree)


def _kept(recorder: Recorder, chooser: Any, keep_values: bool, keep_tree: bool) -> Kept:
    samples = recorder.samples()
    counts = np.bincount(samples.sequence, minlength=len(samples.sequences))
    data = {
        "meta": recorder.meta(),
        "max_violation": float(samples.violation.max()) if samples.violation.size else 0.0,
        "sequences": dict(zip(samples.sequences, counts.tolist(), strict=True)),
        "best_sequences": recorder.best_sequences(3),
        "operators": recorder.profile()["operators"],
        "first_tries": {
            name: [record.first_tries, record.first_successes] for name, record in recorder.operators.items()
        },
    }
    if keep_tree:
        data["tree"] = chooser.as_json()
    values = {name: value.astype(np.float32) for name, value in samples.variables.items()} if keep_values else {}
    return Kept(data, samples.elapsed, values)


# ------------------------------------------------------------------ choosers


def prepare(problem: Problem, settings: SamplerSettings | None = None) -> Iterator[Compiled]:
    """Makes ready what runs on a problem may need (`Sampler.prepare`); yields programs as they come, also those that were
    ready before."""
    for event in Sampler(problem, Tree(problem.transitions), settings=settings).prepare():
        if isinstance(event, Compiled):
            yield event


class Survey:
    """Runs sequences in turn that together use every operator, whatever they are worth; a tree keeps the statistics."""

    def __init__(self, transitions: Transitions) -> None:
        self.tree = Tree(transitions)
        self._paths = covering_sequences(transitions)
        self._turn = 0

    @property
    def rate(self) -> float:
        return self.tree.rate

    def select(self, ready: Ready | None = None) -> Path:
        """The next sequence whose operators are all ready, or ()."""
        for _ in self._paths:
            path = self._paths[self._turn % len(self._paths)]
            self._turn += 1
            if ready is None or all(map(ready, path)):
                return path
        return ()

    def record(self, *arguments: Any, **named: Any) -> None:
        self.tree.record(*arguments, **named)

    def tries(self, prefix: Path, transition: Transition) -> int:
        return self.tree.tries(prefix, transition)

    def best_sequences(self, k: int = 1) -> list[tuple[Path, float]]:
        return self.tree.best_sequences(k)

    def as_json(self) -> dict[str, Any]:
        return self.tree.as_json()


def covering_sequences(transitions: Transitions) -> list[Path]:
    """Complete sequences that together contain every conditional problem; each adds as many new ones as possible."""
    states: dict[frozenset, None] = {frozenset(): None}
    for transition in transitions.iterate():
        states[transition.target] = None
    ordered = sorted(states, key=len, reverse=True)
    seen: set = set()
    paths: list = []
    while True:
        best: dict[frozenset, tuple[int, Path]] = {transitions.full: (0, ())}
        for state in ordered:
            for transition in transitions.children(state):
                count, rest = best[transition.target]
                count += transition.problem not in seen
                if state not in best or count > best[state][0]:
                    best[state] = count, (transition, *rest)
        count, path = best[frozenset()]
        if not count:
            return paths
        seen.update(transition.problem for transition in path)
        paths.append(path)


class PricedTree(Tree):
    """A tree that multiplies the price of time by a factor: for the sweep over the paper's lambda."""

    price_factor = 1.0

    @property
    def price(self) -> float:
        return self.price_factor * super().price


def priced_tree(transitions: Transitions, factor: float, **options: Any) -> Chooser:
    """A tree whose price of time is `factor` times the usual one."""
    tree = PricedTree(transitions, **options)
    tree.price_factor = factor
    return tree


# ------------------------------------------------------------------ statistics of several runs


def merged_tree(transitions: Transitions, trees: Sequence[Mapping[str, Any]]) -> Tree:
    """A tree that knows the statistics of several runs on one instance."""
    merged = Tree(transitions)
    for tree in trees:
        merged.add(tree)
    return merged


def signature(path: Path) -> frozenset:
    """What makes sequences equal in effect: those with the same conditional problems differ only in order."""
    return frozenset(transition.problem for transition in path)


def ranked_sequences(tree: Tree, workers: int, unknown_too: bool = False) -> list[tuple[Path, float]]:
    """All complete sequences with predicted samples per second, best first, one of each that are equal in effect.

    unknown_too: also those with operators that never ran, whose success and time would be guesses.
    """
    known = set(tree.operator_statistics())
    best: dict[frozenset, tuple[Path, float]] = {}
    for path in tree.transitions.sequences():
        problems = signature(path)
        if problems in best or not (unknown_too or problems <= known):
            continue
        best[problems] = path, workers * tree.predict_rate(path)
    return sorted(best.values(), key=lambda entry: -entry[1])


def operation_name(transitions: Transitions, sequence: str, new: Sequence[str]) -> str:
    """Under which name a run's record lists the operator that assigns `new` in a sequence."""
    for transition in transitions.parse(sequence):
        if set(transition.new) == set(new):
            return operator_text(transition)
    raise AssertionError(f"{sequence} has no step ({','.join(new)})")
