"""One batch of one operator: the thin bridge between plain Python that decides and device programs that compute.

A `BatchRunner` has everything that runs a batch of one problem; it decides nothing and keeps no samples. The sampler has one
in its own process, and further ones in worker processes (`cgs_jax.worker`).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from cgs_jax import programs
from cgs_jax.audit import Auditor, Tolerances
from cgs_jax.augmented_lagrangian import Settings
from cgs_jax.keyframes import Keyframes
from cgs_jax.operators import (
    PENETRATION,
    Operator,
    aimed_at,
    clearance_program,
    gather_given,
    gather_poses,
    operator_of,
    propose_program,
)
from cgs_jax.own import own_checks
from cgs_jax.problems import Collisions, Problem, with_collisions
from cgs_jax.scene import attachments, goals, placements
from cgs_jax.tables import SeedTable
from cgs_jax.transitions import Transition

Values = dict[str, np.ndarray]

AimedTables = list[SeedTable | None]
"""For each new configuration of an operator."""


@dataclass(frozen=True)
class Batch:
    """What to run: plain data, so that it can be sent to another process."""

    transition: Transition
    conditions: Values
    """Assigned variables `(tasks, dim)`; those of the condition are read, the others travel along."""
    tasks: int
    first_task: int
    """Number of the first task in the operator's random stream."""


@dataclass(frozen=True)
class Audited:
    """What the audit says of full samples."""

    ok: np.ndarray  # (N,) bool
    qpos: np.ndarray  # (N, K, nq)
    violation: np.ndarray  # (N, C)
    seconds: float


@dataclass(frozen=True)
class Outcome:
    """What came of a batch."""

    values: Values
    """Conditions and new variables of the successes, in order."""
    success: np.ndarray  # (tasks,) bool
    proposed: int
    """Tasks whose rows were solved."""
    iterations: int
    executed: int
    """Iterations that all lanes together went through: idle ones and those of finished tasks included."""
    failures: Mapping[str, int]
    """Tasks stopped by each constraint; a task that violates several rows counts for the worst."""
    device_seconds: float
    host_seconds: float
    load_seconds: float
    """Until its programs were there."""


@dataclass(frozen=True)
class BatchSettings:
    """What programs are compiled for and samples are held to."""

    batch_size: int
    lanes: int
    solver: Settings
    counted_time: bool = False
    """Report counted work (`WORK_SECONDS`) in place of measured device time."""
    collisions: Collisions = "after"
    """Where clearances are seen to."""


WORK_SECONDS = 1e-7
"""Counted work: device seconds that one iteration of one unknown is taken for."""


class BatchRunner:
    """Runs batches of one problem; may be shared by threads."""

    def __init__(self, problem: Problem, seed: int, settings: BatchSettings, tolerances: Tolerances | None = None) -> None:
        self.problem, self.settings = with_collisions(problem, settings.collisions), settings
        task = problem.scene.task
        switches = [switch.name for switch in task.switches]
        self.auditor = Auditor(
            problem.scene.model, attachments(task), placements(task), goals(task), switches, tolerances, own_checks(problem)
        )
        self._keyframes = Keyframes(self.problem)
        self.seed = seed
        self._numbers: dict[Any, Any] = {}
        self._blanks: dict[int, np.ndarray] = {}
        self._requested: dict[int, list[Future]] = {}
        self._distinct: dict[int, Future] = {}  # operators share programs
        self._aimed: dict[int, AimedTables] = self.problem.aimed
        self._lock = threading.Lock()

    # -------------------------------------------------------------- programs

    def request(self, operator: Operator) -> list[Future]:
        """Programs of an operator: `propose`, then the clearances in order. Compiled in the background on first request."""
        with self._lock:
            if operator.identity not in self._requested:
                self._requested[operator.identity] = futures = self._programs(operator)
                self._distinct |= {id(future): future for future in futures}
            return self._requested[operator.identity]

    def is_aimed(self, operator: Operator) -> bool:
        """Whether the seed tables of an operator have been made."""
        return operator.identity in self._aimed

    def aimed(self, operator: Operator) -> AimedTables:
        """Seed tables of an operator, made on first request (see `tables`)."""
        if operator.identity not in self._aimed:
            self._aimed[operator.identity] = aimed_at(self.problem, operator)
        return self._aimed[operator.identity]

    def take_aimed(self, identity: int, aimed: AimedTables) -> None:
        """Gives an operator seed tables that were made elsewhere."""
        self._aimed[identity] = aimed

    def put_aside(self) -> None:
        """Gives back the memory of what a later run makes again in a millisecond: tables on the device."""
        self._numbers.clear()
        self._blanks.clear()

    def install(self, identity: int, ready: list[programs.Program]) -> None:
        """Gives an operator programs that were compiled elsewhere."""
        futures: list[Future] = []
        for program in ready:
            futures.append(Future())
            futures[-1].set_result(program)
        with self._lock:
            self._requested[identity] = futures
            self._distinct |= {id(future): future for future in futures}

    def ready(self, operator: Operator) -> bool:
        """Whether all programs of an operator have been requested and are there: compiled, or in the cache on disk."""
        futures = self._requested.get(operator.identity)
        return futures is not None and all(future.done() for future in futures)

    def requested(self) -> list[Future]:
        """All programs requested so far, each once."""
        return list(self._distinct.values())

    def _programs(self, operator: Operator) -> list[Future]:
        return [programs.request(*recipe) for recipe in self._recipes(operator)]

    def load(self, operator: Operator) -> None:
        """Waits for the programs of an operator and reads those that are in the cache; a damaged one is compiled here."""
        for position, future in enumerate(self.request(operator)):
            program = future.result()
            try:
                program.load()
            except Exception:  # noqa: BLE001 - whatever is wrong with it
                self._replace(operator, position)

    def _call(self, operator: Operator, position: int, *arguments: Any) -> Any:
        """Runs a program of an operator; one that was compiled elsewhere and fails is compiled here, once."""
        program = self.request(operator)[position].result()
        try:
            return program(*arguments)
        except Exception:
            if not program.foreign:
                raise
        return self._replace(operator, position)(*arguments)

    def _replace(self, operator: Operator, position: int) -> programs.Program:
        replaced = programs.request_anew(*self._recipes(operator)[position])
        with self._lock:
            self._requested[operator.identity] = list(self._requested[operator.identity])
            self._distinct.pop(id(self._requested[operator.identity][position]), None)
            self._requested[operator.identity][position] = replaced
            self._distinct[id(replaced)] = replaced
        return replaced.result()

    def _recipes(self, operator: Operator) -> list[tuple]:
        """Arguments of `programs.request` for each program of an operator."""
        s, batch = self.settings, self.settings.batch_size
        scalar = np.zeros((), np.int32)
        layout = operator.plan.layout
        given = np.zeros((batch, layout.given, 7), np.float32)
        of_function = self._blank_configurations(operator.plan.given_configurations)
        # Of the shapes of what `_numbers_of` makes later.
        numbers = operator.numbers(self.problem.params)
        arguments = (self._key_of(operator), np.uint32(0), scalar, given, of_function, numbers)
        name = f"solve {layout.configurations} configurations, {layout.free} free poses"
        if operator.inside:
            name += f", {', '.join(operator.inside)}"
        own = layout.functions or layout.samplers
        key = None if own else f"propose {layout} {s.solver} {s.lanes}"
        recipes: list[tuple] = [(name, propose_program(layout, s.solver, s.lanes), arguments, key)]
        for clear in operator.clears:
            poses = np.zeros((batch, len(clear.poses), 7), np.float32)
            arguments = (scalar, poses, self._blank_configurations(clear.configurations), self._numbers_of(clear))
            name, function = f"clearance {clear.constraint}", clearance_program(clear.layout)
            recipes.append((name, function, arguments, f"clearance {clear.layout}"))
        return recipes

    def _blank_configurations(self, names: tuple[str, ...]) -> tuple[np.ndarray, ...]:
        dofs = [self.problem.dofs[name] or 0 for name in names]
        return tuple(np.zeros((self.settings.batch_size, dof), np.float32) for dof in dofs)

    def _numbers_of(self, what: Any) -> Any:
        key = what.identity if isinstance(what, Operator) else what.constraint
        if key not in self._numbers:
            aimed = (self.aimed(what),) if isinstance(what, Operator) else ()
            self._numbers[key] = jax.device_put(what.numbers(self.problem.params, *aimed))
        return self._numbers[key]

    def _key_of(self, operator: Operator) -> np.ndarray:
        """Key data of an operator's random stream."""
        return np.array([self.seed % 2**32, operator.identity], np.uint32)

    # -------------------------------------------------------------- running

    def _given(self, operator: Operator, padded: Values) -> np.ndarray:
        """As `gather_given`: most of it is the same in all batches and only copied."""
        params, room = self.problem.params, self.settings.batch_size
        if any(term.kind == "chain" for term in operator.plan.given):
            return gather_given(operator, params, padded, room)
        if operator.identity not in self._blanks:
            self._blanks[operator.identity] = gather_given(operator, params, padded, room)
        given = self._blanks[operator.identity].copy()
        for at, term in enumerate(operator.plan.given):
            if term.kind == "pose":
                given[:, at] = padded[term.name]
        return given

    def run(self, batch: Batch) -> Outcome:
        """Runs one batch. Waits for its programs."""
        operator, problem = operator_of(self.problem, batch.transition), self.problem
        asked = time.perf_counter()
        self.load(operator)
        began = time.perf_counter()
        count, room = batch.tasks, self.settings.batch_size
        padded = {name: _fill(batch.conditions[name], room) for name in operator.condition}
        given = self._given(operator, padded)
        of_function = tuple(padded[name] for name in operator.plan.given_configurations)
        key, numbers = self._key_of(operator), self._numbers_of(operator)
        device = -time.perf_counter()
        first = np.uint32(batch.first_task % 2**32)
        result = self._call(operator, 0, key, first, np.int32(count), given, of_function, numbers)
        # Slices of device arrays would be device programs of their own.
        result = jax.tree.map(np.asarray, result)
        device += time.perf_counter()
        rows_hold = result.feasible[:count]
        iterations = int(result.iterations[:count].sum())
        named = {name: value[:count] for name, value in operator.named(result).items()}
        failures: dict[str, int] = {}
        # What a user's sampler drew outside the limits, or was no number, is not finite: no row stopped such a task.
        open_tasks = ~rows_hold
        for slot in operator.plan.layout.samplers:
            drawn = [~np.isfinite(named[name]).all(axis=1) for name in slot.sampler.variables]
            stopped = open_tasks & np.any(drawn, axis=0)
            if stopped.any():
                failures[slot.sampler.link] = int(stopped.sum())
                open_tasks &= ~stopped
        if operator.measured:
            violation = result.violation[: len(operator.measured), :count]
            worst = np.argmax(violation[:, open_tasks], axis=0)
            for at, times in zip(*np.unique(worst, return_counts=True), strict=True):
                failures[operator.measured[at]] = int(times)
        success = np.flatnonzero(rows_hold)
        proposed = len(success)
        values = _rows(batch.conditions, success) | _rows(named, success)
        for position, clear in enumerate(operator.clears, start=1):
            if not len(success):
                break
            padded = {name: _fill(values[name], room) for name in clear.reads}
            poses = gather_poses(clear, problem.params, padded, room)
            q = tuple(padded[name] for name in clear.configurations)
            device -= time.perf_counter()
            distance = self._call(operator, position, np.int32(len(success)), poses, q, self._numbers_of(clear))
            device += time.perf_counter()
            clears = np.asarray(distance)[: len(success)] >= -PENETRATION
            if not clears.all():
                failures[clear.constraint] = failures.get(clear.constraint, 0) + int((~clears).sum())
                kept = np.flatnonzero(clears)
                success, values = success[kept], _rows(values, kept)
        mask = np.zeros(count, bool)
        mask[success] = True
        host = max(time.perf_counter() - began - device, 0.0)
        if self.settings.counted_time:
            device = WORK_SECONDS * (count + iterations) * (1 + operator.plan.layout.unknowns)
        executed = int(result.executed)
        return Outcome(values, mask, proposed, iterations, executed, failures, device, host, began - asked)

    def audit(self, values: Values) -> Audited:
        """Keyframes and audit of full samples."""
        began = time.perf_counter()
        qpos = self._keyframes.qpos(values)
        result = self.auditor.check(qpos, values)
        return Audited(result.ok, qpos, result.violation, time.perf_counter() - began)


def _rows(values: Mapping[str, np.ndarray], rows: np.ndarray) -> Values:
    return {name: value.take(rows, axis=0) for name, value in values.items()}


def _fill(value: np.ndarray, rows: int) -> np.ndarray:
    """The value with zero rows appended."""
    if len(value) == rows:
        return value
    result = np.zeros((rows, *value.shape[1:]), value.dtype)
    result[: len(value)] = value
    return result
