"""Simulated runs: the real scheduling and the real tree against a truth that is known.

How near the search comes to the best sequence cannot be told from a few runs: neighbouring ones differ by a tenth or two on a
busy machine, and what the best sequence would have made is not known. Here every history has a success and every operator a
time, taken from the trees of finished runs; numbers are drawn, nothing is compiled or solved.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgs_jax.batches import Outcome
from cgs_jax.errors import InputError
from cgs_jax.experiments.runs import merged_tree
from cgs_jax.histories import guessed_success, read_prefix
from cgs_jax.operators import operator_of
from cgs_jax.problems import Problem
from cgs_jax.sampler import BATCH_SECONDS, DRAIN, Job, Sampler, SamplerSettings, squared_unknowns
from cgs_jax.transitions import Path, State
from cgs_jax.transitions import Problem as Conditional
from cgs_jax.uct import Chooser

Floats = NDArray[np.float64]
History = tuple[Conditional, frozenset]
"""How a component came about: the conditional problem that made it, and the histories that it read."""

KNOWN_TRIES = 60
"""First tries after a history from which on it succeeds in the simulation as often as it did there."""

SPREAD = 0.35
"""Greatest standard deviation of the logarithm of an operator's success over histories that were hardly tried."""

FALLING_OFF = 0.8
"""Success of a further try over that of the one before, where few were made."""

LEAST_STEPS = 4.0
"""One and the iterations of a task, of the quickest operator of those that share a program."""

BETWEEN_BATCHES = 0.0035
"""Seconds of a worker from the end of a batch to the beginning of the next one."""

FIRST_BATCH = 0.015
"""Seconds more that a worker takes for its first batch of an operator."""

UNEVEN = 0.12
"""Standard deviation of the logarithm of a batch's time."""


class World:
    """What is true of an instance: the success of every try after every history, the seconds of every operator.

    trees: contents of tree files of finished runs on the instance. seed: histories of which they tell little get a success
    drawn about their operator's, operators that were never tried do as is guessed of them. tries: most tries of a condition.
    Raises InputError without any statistics.
    """

    def __init__(self, problem: Problem, trees: Sequence[Mapping[str, Any]], seed: int = 0, tries: int = 4) -> None:
        self.problem, self.tries = problem, tries
        merged = merged_tree(problem.transitions, trees).as_json()
        self._pooled = {(tuple(e["new"]), tuple(e["constraints"])): e for e in merged["operators"] if sum(e["attempts"])}
        self._pooled |= self._guesses()
        self._seen: dict[History, Mapping[str, Any]] = {}
        for entry in merged["sequences"]:
            if entry["attempts"] and entry["attempts"][0] >= KNOWN_TRIES:
                self._seen[history_of(read_prefix(problem.transitions, entry["sequence"]))] = entry
        self._spread = self._spreads()
        self._random = np.random.default_rng(seed)
        self._hazards: dict[History, Floats] = {}
        self._costs: dict[History, float] = {}
        self.best, self.best_rate = self._search()

    def seconds_per_task(self, conditional: Conditional) -> float:
        """Device seconds per task of a full batch."""
        entry = self._pooled[conditional]
        return entry["seconds"] / sum(entry["attempts"])

    def hazards(self, history: History) -> Floats:
        """Success of a first try, of a second one and so on, (tries,); of what reads nothing, (1,)."""
        if history not in self._hazards:
            conditional, reads = history
            pooled, seen = self._pooled[conditional], self._seen.get(history)
            if seen is not None:
                first = (seen["successes"][0] + 0.5) / (seen["attempts"][0] + 1.0)
            else:
                first = pooled["successes"][0] / pooled["attempts"][0]
                if 0.0 < first < 1.0:
                    first = min(first * math.exp(self._random.normal(0.0, self._spread.get(conditional, SPREAD / 2))), 0.97)
            hazards = [first]
            while reads and len(hazards) < self.tries:
                hazards.append(hazards[-1] * _falling_off(pooled, len(hazards)))
            self._hazards[history] = np.array(hazards)
        return self._hazards[history]

    def seconds_per_item(self, history: History) -> float:
        """Device seconds, with as many tries as make it cheapest, and with all that it is made of."""
        if history not in self._costs:
            conditional, reads = history
            read, per_task = sum(map(self.seconds_per_item, reads)), self.seconds_per_task(conditional)
            left, tries, cost = 1.0, 0.0, math.inf
            for hazard in self.hazards(history):
                tries, left = tries + left, left * (1.0 - hazard)
                cost = min(cost, (read + tries * per_task) / max(1.0 - left, 1e-12))
            self._costs[history] = cost
        return self._costs[history]

    def rate(self, path: Path) -> float:
        """Samples per device second when only this sequence is run."""
        return 1.0 / sum(map(self.seconds_per_item, components(path).values()))

    def _search(self) -> tuple[Path, float]:
        """The best sequence and its rate, by branch and bound: what is there only gets dearer."""
        transitions = self.problem.transitions
        best: tuple[float, Path] = (math.inf, ())

        def extend(path: Path, state: State) -> None:
            nonlocal best
            seconds = sum(map(self.seconds_per_item, components(path).values()))
            if seconds >= best[0]:
                return
            if state == transitions.full:
                best = seconds, path
            for child in transitions.children(state):
                extend((*path, child), child.target)

        extend((), frozenset())
        return best[1], 1.0 / best[0]

    def _guesses(self) -> dict[Conditional, dict[str, Any]]:
        """Of operators that were never tried: the success that their dof and rows let expect, and the usual time."""
        work = {t.problem: squared_unknowns(operator_of(self.problem, t)) for t in self.problem.transitions.iterate()}
        if not self._pooled:
            raise InputError(f"{self.problem.transitions.graph.name}: no operator was tried, expected trees of finished runs")
        unit = float(np.median([self.seconds_per_task(conditional) / work[conditional] for conditional in self._pooled]))
        guesses = {}
        for conditional in work.keys() - self._pooled.keys():
            loops, per_loop = guessed_success(self.problem.transitions.graph, conditional)
            success = per_loop ** max(loops, 1)
            guesses[conditional] = {"attempts": [1.0], "successes": [success], "seconds": unit * work[conditional]}
        return guesses

    def _spreads(self) -> dict[Conditional, float]:
        """By conditional problem, how much the logarithm of its success differs between histories, beyond the counts."""
        logs: dict[Conditional, list[tuple[float, float]]] = {}
        for (conditional, _), entry in self._seen.items():
            tries, success = entry["attempts"][0], (entry["successes"][0] + 0.5) / (entry["attempts"][0] + 1.0)
            logs.setdefault(conditional, []).append((math.log(success), (1.0 - success) / (success * tries)))
        return {
            conditional: float(np.sqrt(np.clip(np.var([a for a, _ in pairs]) - np.mean([b for _, b in pairs]), 0.0, SPREAD**2)))
            for conditional, pairs in logs.items()
            if len(pairs) > 1
        }


def components(path: Path) -> dict[frozenset[str], History]:
    """The components that a partial sequence ends with, by their variables."""
    made: dict[frozenset[str], History] = {}
    for transition in path:
        used = [variables for variables in made if variables & transition.condition]
        history = transition.problem, frozenset(made.pop(variables) for variables in used)
        made[frozenset(transition.new).union(*used)] = history
    return made


def history_of(path: Path) -> History:
    """The history that the last step of a partial sequence makes."""
    return next(history for variables, history in components(path).items() if path[-1].new[0] in variables)


def _falling_off(entry: Mapping[str, Any], k: int) -> float:
    """Success of an operator's try k over that of the one before, at most 1."""
    attempts, successes = entry["attempts"], entry["successes"]
    if len(attempts) <= k or attempts[k] < KNOWN_TRIES or not successes[k - 1]:
        return FALLING_OFF
    return min(successes[k] / attempts[k] * attempts[k - 1] / successes[k - 1], 1.0)


def simulate(
    world: World, chooser: Chooser, seed: int = 0, seconds: float = 10.0, settings: SamplerSettings | None = None
) -> Floats:
    """Seconds at which samples are finished (N,), ascending. All programs are there from the beginning; audits take no time.

    settings: of batches, lanes, workers, pools; conditions get as many tries as the world knows.
    """
    settings = replace(settings or SamplerSettings(), tries=world.tries)
    sampler = Sampler(world.problem, chooser, seed, settings)
    run = _batches(world, np.random.default_rng(seed), settings)
    free = [0.0] * settings.workers
    in_flight: list[tuple[float, Job, Outcome]] = []
    now, finished = 0.0, list[float]()
    while True:
        while len(in_flight) < settings.workers + 2:
            job = sampler.next_job()
            if job is None:
                break
            worker = free.index(min(free))
            outcome = run(worker, job)
            free[worker] = max(free[worker], now) + outcome.device_seconds + outcome.load_seconds + BETWEEN_BATCHES
            in_flight.append((free[worker], job, outcome))
        in_flight.sort(key=lambda entry: entry[0])
        now, job, outcome = in_flight.pop(0)
        if now > seconds:
            return np.array(finished)
        sampler.absorb(job, outcome)
        finished += [now] * sum(part.size for part in sampler.take_candidates())


def _batches(world: World, random: np.random.Generator, settings: SamplerSettings) -> Callable[[int, Job], Outcome]:
    """What comes of a job that a worker runs."""
    work = _work(world, settings)
    ran: set[tuple[int, int]] = set()  # worker and operator

    def run(worker: int, job: Job) -> Outcome:
        operator, tasks = job.step.operator, job.batch.tasks
        unit, steps = work[operator.identity]
        iterations = round(tasks * (steps - 1.0))
        hazards = world.hazards(history_of(job.path[: job.position + 1]))
        success = random.random(tasks) < hazards[np.minimum(job.tries, len(hazards) - 1)]
        values = {name: value[success] for name, value in job.batch.conditions.items()}
        values |= {name: np.zeros((int(success.sum()), 1)) for name in job.step.transition.new}
        load = 0.0 if (worker, operator.identity) in ran else FIRST_BATCH
        ran.add((worker, operator.identity))
        seconds = unit * (tasks + iterations + DRAIN * settings.lanes) * math.exp(random.normal(0.0, UNEVEN))
        return Outcome(values, success, tasks, iterations, iterations, {}, seconds, 0.0, load)

    return run


def _work(world: World, settings: SamplerSettings) -> dict[int, tuple[float, float]]:
    """By operator: seconds of a step of a task, and a task's steps (one and its iterations).

    Such that full batches take as long as they did, and operators that share a program differ in their steps only.
    """
    least: dict[Any, float] = {}  # by program
    tasks: dict[int, tuple[Any, float, float]] = {}  # by operator: program, seconds, steps that lanes stand empty
    for transition in {t.problem: t for t in world.problem.transitions.iterate()}.values():
        operator, seconds = operator_of(world.problem, transition), world.seconds_per_task(transition.problem)
        program = operator.plan.layout
        full = min(max(BATCH_SECONDS / seconds, settings.lanes), settings.batch_size)
        drained = DRAIN * settings.lanes / full
        least[program] = min(least.get(program, math.inf), seconds / (LEAST_STEPS + drained))
        tasks[operator.identity] = program, seconds, drained
    return {identity: (least[p], seconds / least[p] - drained) for identity, (p, seconds, drained) in tasks.items()}
