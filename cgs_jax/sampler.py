"""Algorithm 1 of the paper, in batches.

A *component* is a set of assigned variables that are statistically linked so far, with the way they came about: the operator
that completed it and the components that it read. Partial samples wait in one pool per component history, so that sequences
which differ only in the order of independent operators share their work, every operator runs full batches, and a failure costs
only the components that its operator read. A prefix may be tried a few times and leaves at its first success, so that no two
finished samples share a value.

The chooser (UCT tree, fixed sequence, random) picks a sequence; what runs is its last operator if that has a batch waiting,
else, by the same rule, the operator that makes what it lacks most. Two workers keep the device busy; all decisions are made by the one scheduling thread.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
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
    clearance_program,
    gather_given,
    gather_poses,
    operator_of,
    propose_program,
)
from cgs_jax.problems import Problem
from cgs_jax.scene import attachments, goals, placements
from cgs_jax.transitions import Transition
from cgs_jax.uct import Chooser

Values = dict[str, np.ndarray]
Path = tuple[Transition, ...]


# ------------------------------------------------------------------ events: the one record of a run


@dataclass(frozen=True)
class Compiled:
    """A program became ready."""

    name: str
    seconds: float


@dataclass(frozen=True)
class Started:
    """The first operators are ready; sampling time counts from here."""

    startup_seconds: float


@dataclass(frozen=True)
class Ran:
    """An operator finished a batch."""

    path: Path
    position: int
    tasks: int
    proposed: int
    """Tasks whose rows were solved."""
    cleared: int
    """Of these, tasks whose clearance held too."""
    iterations: int
    failures: Mapping[str, int]
    """Tasks stopped by each constraint; a task that violates several rows counts for the worst."""
    first_tries: int
    first_successes: int
    second_tries: int
    """Second tries of conditions whose first try failed."""
    second_successes: int
    device_seconds: float
    host_seconds: float


@dataclass(frozen=True)
class Found:
    """Samples that passed the audit."""

    values: Values
    qpos: np.ndarray  # (N, K, nq)
    violation: np.ndarray  # (N, C)
    sequence: str
    elapsed: float
    rejected: int
    audit_seconds: float


@dataclass(frozen=True)
class Finished:
    """The run ended: by "time", "samples" or "interrupt"."""

    reason: str
    elapsed: float


Event = Compiled | Started | Ran | Found | Finished


# ------------------------------------------------------------------ pools


class Pool:
    """Partial samples in arrival order."""

    def __init__(self) -> None:
        self._chunks: list[Values] = []
        self.size = 0

    def put(self, values: Values) -> None:
        """Appends partial samples `(n, dim)` by variable."""
        count = len(next(iter(values.values())))
        if count:
            self._chunks.append(values)
            self.size += count

    def take(self, count: int) -> Values:
        """Removes and returns the first `count`."""
        taken, missing = [], count
        while missing:
            chunk = self._chunks[0]
            have = len(next(iter(chunk.values())))
            if have <= missing:
                taken.append(self._chunks.pop(0))
                missing -= have
            else:
                taken.append({name: value[:missing] for name, value in chunk.items()})
                self._chunks[0] = {name: value[missing:] for name, value in chunk.items()}
                missing = 0
        self.size -= count
        return {name: np.concatenate([chunk[name] for chunk in taken]) for name in taken[0]}


History = tuple
"""A component's history: (operator's problem, histories of the components it read)."""


@dataclass(frozen=True)
class _Step:
    """One operator of a sequence with the histories it reads and makes."""

    transition: Transition
    operator: Operator
    reads: tuple[History, ...]
    makes: History


@dataclass(frozen=True)
class _Job:
    path: Path
    position: int
    step: _Step
    conditions: Values
    tries: np.ndarray  # (n,) earlier tries of each condition
    first_task: int


@dataclass(frozen=True)
class _Outcome:
    values: Values  # conditions and new variables of the successes
    success: np.ndarray  # (n,) bool
    proposed: int
    iterations: int
    failures: Mapping[str, int]
    device_seconds: float
    host_seconds: float
    finished: Found | None


TRIES = 0
"""Name under which the number of earlier tries travels with a waiting condition (no variable can be called that)."""


@dataclass(frozen=True)
class SamplerSettings:
    """How a run is scheduled."""

    batch_size: int = 1024
    """Tasks of one batch."""
    lanes: int = 128
    """Tasks solved side by side."""
    tries: int = 4
    """Tries of a condition; it leaves at its first success. 1: the paper's semantics."""
    pools: bool = True
    """Whether a failure keeps the components that the operator did not read. False: the paper's semantics."""
    workers: int = 2
    """Batches in flight."""
    deterministic: bool = False
    """Same seed, same stream of samples: decisions use counted work in place of measured time."""
    solver: Settings = Settings()
    """Settings of the projection."""


WORK_SECONDS = 1e-7
"""Deterministic runs: device seconds that one iteration of one unknown is taken for."""


class Sampler:
    """One run over one problem; `events` yields what happens."""

    def __init__(
        self,
        problem: Problem,
        chooser: Chooser,
        seed: int = 0,
        settings: SamplerSettings | None = None,
        tolerances: Tolerances | None = None,
    ) -> None:
        self.problem, self.chooser, self.settings = problem, chooser, settings or SamplerSettings()
        task = problem.scene.task
        self.auditor = Auditor(
            problem.scene.model,
            attachments(task),
            placements(task),
            goals(task),
            [switch.name for switch in task.switches],
            tolerances,
        )
        self._keyframes = Keyframes(problem)
        self._key = jax.random.key(seed)
        self._pools: dict[History, Pool] = {}
        self._waiting: dict[History, Pool] = {}
        self._tasks: dict[int, int] = {}
        self._steps: dict[Path, tuple[_Step, ...]] = {}
        self._visits: dict[History, int] = {}
        self._numbers: dict[Any, Any] = {}
        self._keys: dict[int, jax.Array] = {}
        self._requested: dict[int, list[Future]] = {}
        self._announced: set[int] = set()
        self._full = problem.transitions.full
        self._stop = threading.Event()

    def stop(self) -> None:
        """Ends the run after the batches in flight."""
        self._stop.set()

    # -------------------------------------------------------------- programs

    def _arguments(self, operator: Operator) -> tuple[tuple, list[tuple]]:
        """Arguments of the shapes that `propose` and each clearance of an operator are called with."""
        batch = self.settings.batch_size
        scalar = np.zeros((), np.int32)
        given = np.zeros((batch, operator.plan.layout.given, 7), np.float32)
        of_function = tuple(
            np.zeros((batch, self.problem.dofs[name]), np.float32) for name in operator.plan.given_configurations
        )
        propose = (self._key_of(operator), np.uint32(0), scalar, given, of_function, self._numbers_of(operator))
        clears = []
        for clear in operator.clears:
            poses = np.zeros((batch, len(clear.poses), 7), np.float32)
            q = tuple(np.zeros((batch, self.problem.dofs[name]), np.float32) for name in clear.configurations)
            clears.append((scalar, poses, q, self._numbers_of(clear)))
        return propose, clears

    def _numbers_of(self, what: Any) -> Any:
        key = (type(what).__name__, what.constraint if hasattr(what, "constraint") else what.identity)
        if key not in self._numbers:
            numbers = what.numbers(self.problem.params)
            self._numbers[key] = jax.device_put(numbers)
        return self._numbers[key]

    def _key_of(self, operator: Operator) -> jax.Array:
        if operator.identity not in self._keys:
            self._keys[operator.identity] = jax.random.fold_in(self._key, operator.identity)
        return self._keys[operator.identity]

    def _request(self, operator: Operator) -> list[Future]:
        if operator.identity not in self._requested:
            propose, clears = self._arguments(operator)
            s = self.settings
            futures = [
                programs.request(
                    f"solve {_shape_text(operator)}", propose_program(operator.plan.layout, s.solver, s.lanes), propose
                )
            ]
            for clear, arguments in zip(operator.clears, clears, strict=True):
                futures.append(
                    programs.request(f"clearance {clear.constraint}", clearance_program(clear.layout), arguments)
                )
            self._requested[operator.identity] = futures
        return self._requested[operator.identity]

    def _ready(self, transition: Transition) -> bool:
        futures = self._requested.get(operator_of(self.problem, transition).identity)
        return futures is not None and all(future.done() for future in futures)

    def compile_order(self) -> list[Transition]:
        """One transition per conditional problem: first those of the sequence that is cheapest to compile, then by size."""
        transitions = self.problem.transitions
        first: dict[Any, Transition] = {}
        for transition in transitions.all():
            first.setdefault(transition.problem, transition)

        def size(transition: Transition) -> int:
            return operator_of(self.problem, transition).plan.layout.unknowns

        return sorted(first.values(), key=size)

    # -------------------------------------------------------------- sequences as steps

    def _steps_of(self, path: Path) -> tuple[_Step, ...]:
        if path not in self._steps:
            component: dict[str, History] = {}
            members: dict[History, list[str]] = {}
            steps = []
            for position, transition in enumerate(path):
                if self.settings.pools:
                    reads = tuple(dict.fromkeys(component[name] for name in sorted(transition.condition)))
                else:
                    reads = tuple(dict.fromkeys(component.values()))
                makes: History = (transition.problem, tuple(sorted(reads, key=repr)))
                if not self.settings.pools:
                    makes = (*makes, position)
                names = [*transition.new, *(name for read in reads for name in members[read])]
                members[makes] = names
                component |= dict.fromkeys(names, makes)
                steps.append(_Step(transition, operator_of(self.problem, transition), reads, makes))
            self._steps[path] = tuple(steps)
        return self._steps[path]

    def _final_histories(self, path: Path) -> tuple[History, ...]:
        """Components of the full set that the last step does not make: sets without a constraint between them."""
        steps = self._steps_of(path)
        read = {history for step in steps for history in step.reads}
        return tuple(dict.fromkeys(s.makes for s in steps if s.makes not in read and s is not steps[-1]))

    # -------------------------------------------------------------- the loop

    def events(
        self, time_budget: float, num_samples: int | None = None, clock: Callable[[], float] = time.perf_counter
    ) -> Iterator[Event]:
        """Runs until the budget (s of sampling time) or the number of samples is reached; yields events as they happen."""
        begun = clock()
        order = self._initial_requests()
        yield from self._await_first(order)
        start = clock()
        yield Started(start - begun)
        found = 0
        reason = "time"
        workers = ThreadPoolExecutor(self.settings.workers, thread_name_prefix="sample")
        in_flight: list[tuple[_Job, Future[_Outcome]]] = []
        done: queue.SimpleQueue[None] = queue.SimpleQueue()
        try:
            while True:
                elapsed = clock() - start
                if self._stop.is_set():
                    reason = "interrupt"
                    break
                if elapsed >= time_budget:
                    break
                if num_samples is not None and found >= num_samples:
                    reason = "samples"
                    break
                while len(in_flight) < self.settings.workers:
                    job = self._next_job()
                    if job is None:
                        break
                    future = workers.submit(self._run, job)
                    future.add_done_callback(lambda _: done.put(None))
                    in_flight.append((job, future))
                yield from self._announcements()
                if not in_flight:
                    time.sleep(0.002)
                    continue
                try:
                    done.get(timeout=min(0.1, max(time_budget - elapsed, 0.001)))
                except queue.Empty:
                    continue
                at = 0
                if not self.settings.deterministic:
                    at = next(i for i, (_, future) in enumerate(in_flight) if future.done())
                job, future = in_flight.pop(at)
                for event in self._absorb(job, future.result(), clock() - start):
                    if isinstance(event, Found):
                        if num_samples is not None and found + len(event.qpos) > num_samples:
                            event = _first(event, num_samples - found)
                        found += len(event.qpos)
                    yield event
        finally:
            workers.shutdown(wait=True, cancel_futures=True)
        yield Finished(reason, clock() - start)

    def _initial_requests(self) -> list[Operator]:
        """Requests the programs in the order in which they are useful; returns the operators to wait for."""
        path = getattr(self.chooser, "path", None)
        if path:
            operators = [operator_of(self.problem, transition) for transition in path]
        else:
            order = self.compile_order()
            first = self._cheapest_path(order)
            operators = [operator_of(self.problem, transition) for transition in first]
        for operator in operators:
            self._request(operator)
        if not path:
            for transition in order:
                self._request(operator_of(self.problem, transition))
        return operators

    def _cheapest_path(self, order: list[Transition]) -> Path:
        """A complete sequence over the smallest operators that allow one."""
        transitions = self.problem.transitions
        allowed: set = set()
        for transition in order:
            allowed.add(transition.problem)
            path = _greedy_path(transitions, allowed)
            if path:
                return path
        raise AssertionError("the graph has no complete sequence")

    def _await_first(self, operators: list[Operator]) -> Iterator[Event]:
        for operator in operators:
            for future in self._request(operator):
                while not future.done():
                    if self._stop.is_set():
                        return
                    time.sleep(0.002)
                    yield from self._announcements()
                future.result()
        yield from self._announcements()

    def _announcements(self) -> Iterator[Event]:
        for futures in self._requested.values():
            for future in futures:
                if id(future) not in self._announced and future.done():
                    self._announced.add(id(future))
                    program = future.result()
                    yield Compiled(program.name, program.seconds)

    def _next_job(self) -> _Job | None:
        if self.settings.deterministic:
            path = self.chooser.select(None)
            for step in self._steps_of(path):
                for future in self._request(step.operator):
                    future.result()
        else:
            path = self.chooser.select(self._ready)
            if not path:
                return None
        steps = self._steps_of(path)
        makers = {step.makes: position for position, step in enumerate(steps)}
        ends = (steps[-1].makes, *self._final_histories(path))
        position = makers[min(ends, key=lambda history: self._pool(history).size)]
        batch = self.settings.batch_size
        while True:
            step = steps[position]
            slot = step.makes
            waiting = self._waiting.setdefault(slot, Pool())
            # A sequence that is new is followed down with small batches: what it is worth shows only at its end.
            young = self._visits.get(slot, 0) < 2
            enough = batch // 16 if young else batch // 4
            scarcest = min(step.reads, key=lambda read: self._pool(read).size, default=None)
            if scarcest is None or waiting.size + self._pool(scarcest).size >= enough:
                count = batch if step.reads or not young else batch // 4
                self._visits[slot] = self._visits.get(slot, 0) + 1
                return self._job(path, position, step, waiting, count)
            position = makers[scarcest]

    def _pool(self, history: History) -> Pool:
        return self._pools.setdefault(history, Pool())

    def _job(self, path: Path, position: int, step: _Step, waiting: Pool, most: int) -> _Job:
        if not step.reads:
            conditions: Values = {}
            count, tries = most, np.zeros(most, np.int32)
        else:
            again = min(waiting.size, most)
            fresh = min([most - again, *(self._pool(read).size for read in step.reads)])
            parts = []
            if again:
                parts.append(waiting.take(again))
            if fresh:
                part: Values = {}
                for read in step.reads:
                    part |= self._pool(read).take(fresh)
                parts.append(part | {TRIES: np.zeros(fresh, np.int32)})
            conditions = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
            tries = conditions.pop(TRIES)
            count = len(tries)
        first = self._tasks.get(step.operator.identity, 0)
        self._tasks[step.operator.identity] = first + count
        return _Job(path, position, step, conditions, tries, first)

    # -------------------------------------------------------------- worker side

    def _run(self, job: _Job) -> _Outcome:
        """Runs one batch; called on a worker thread, changes nothing shared."""
        began = time.perf_counter()
        operator, problem = job.step.operator, self.problem
        count, batch = len(job.tries), self.settings.batch_size
        padded = {name: _fill(value, batch) for name, value in job.conditions.items()}
        given = gather_given(operator, problem.params, padded, batch)
        of_function = tuple(padded[name] for name in operator.plan.given_configurations)
        futures = self._request(operator)
        propose = futures[0].result()
        key, numbers = self._key_of(operator), self._numbers_of(operator)
        device = -time.perf_counter()
        result = propose(key, np.uint32(job.first_task % 2**32), np.int32(count), given, of_function, numbers)
        device += time.perf_counter()
        rows_hold = np.asarray(result.feasible)[:count]
        violation = np.asarray(result.violation)[: len(operator.measured), :count]
        iterations = int(np.asarray(result.iterations)[:count].sum())
        new = {name: np.asarray(value)[:count] for name, value in operator.named(result).items()}
        failures: dict[str, int] = {}
        if len(operator.measured):
            worst = np.argmax(violation[:, ~rows_hold], axis=0)
            for at, times in zip(*np.unique(worst, return_counts=True), strict=True):
                failures[operator.measured[at]] = int(times)
        success = np.flatnonzero(rows_hold)
        proposed = len(success)
        values = {name: value[success] for name, value in (job.conditions | new).items()}
        for clear, future in zip(operator.clears, futures[1:], strict=True):
            if not len(success):
                break
            padded = {name: _fill(value, batch) for name, value in values.items()}
            poses = gather_poses(clear, problem.params, padded, batch)
            q = tuple(padded[name] for name in clear.configurations)
            device -= time.perf_counter()
            distance = future.result()(np.int32(len(success)), poses, q, self._numbers_of(clear))
            device += time.perf_counter()
            clears = np.asarray(distance)[: len(success)] >= -PENETRATION
            if not clears.all():
                failures[clear.constraint] = failures.get(clear.constraint, 0) + int((~clears).sum())
                success = success[clears]
                values = {name: value[clears] for name, value in values.items()}
        mask = np.zeros(count, bool)
        mask[success] = True
        finished, audit_seconds = None, 0.0
        if job.step.transition.target == self._full and len(success) and not self._final_histories(job.path):
            finished = self._finish(values, job.path)
            audit_seconds = finished.audit_seconds
        if self.settings.deterministic:
            device = WORK_SECONDS * (count + iterations) * (1 + operator.plan.layout.unknowns)
        host = time.perf_counter() - began - device - audit_seconds
        return _Outcome(values, mask, proposed, iterations, failures, device, max(host, 0.0), finished)

    def _finish(self, values: Values, path: Path) -> Found:
        """Keyframes and audit of full samples."""
        began = time.perf_counter()
        qpos = self._keyframes.qpos(values)
        result = self.auditor.check(qpos, values)
        kept = np.flatnonzero(result.ok)
        return Found(
            values={name: value[kept] for name, value in values.items()},
            qpos=qpos[kept],
            violation=result.violation[kept],
            sequence=self.problem.transitions.format(path),
            elapsed=0.0,
            rejected=len(qpos) - len(kept),
            audit_seconds=time.perf_counter() - began,
        )

    # -------------------------------------------------------------- results

    def _absorb(self, job: _Job, outcome: _Outcome, elapsed: float) -> Iterator[Event]:
        success = outcome.success
        given_up = ~success
        if job.step.reads:
            given_up &= job.tries + 1 >= self.settings.tries
            again = ~success & ~given_up
            if again.any():
                part = {name: value[again] for name, value in job.conditions.items()}
                waiting = self._waiting[job.step.makes]
                waiting.put(part | {TRIES: job.tries[again] + 1})
        first, second = job.tries == 0, job.tries == 1
        yield Ran(
            path=job.path,
            position=job.position,
            tasks=len(success),
            proposed=outcome.proposed,
            cleared=int(success.sum()),
            iterations=outcome.iterations,
            failures=outcome.failures,
            first_tries=int(first.sum()),
            first_successes=int((first & success).sum()),
            second_tries=int(second.sum()),
            second_successes=int((second & success).sum()),
            device_seconds=outcome.device_seconds,
            host_seconds=outcome.host_seconds,
        )
        counted = int(success.sum())
        if outcome.finished is not None:
            counted = len(outcome.finished.qpos)
        self.chooser.record(
            job.path[: job.position],
            job.step.transition,
            conditions=int((success | given_up).sum()),
            successes=counted,
            seconds=outcome.device_seconds,
            visits=max(len(success) / self.settings.batch_size, 0.1),
            attempts=len(success),
        )
        if outcome.finished is not None:
            yield _at(outcome.finished, elapsed)
        elif job.step.transition.target == self._full and self._final_histories(job.path):
            self._pool(job.step.makes).put(outcome.values)
            yield from self._join(job, elapsed)
        else:
            self._pool(job.step.makes).put(outcome.values)

    def _join(self, job: _Job, elapsed: float) -> Iterator[Event]:
        """Full samples from components that no constraint links."""
        pools = [self._pool(history) for history in (job.step.makes, *self._final_histories(job.path))]
        count = min(pool.size for pool in pools)
        if count:
            values: Values = {}
            for pool in pools:
                values |= pool.take(count)
            yield _at(self._finish(values, job.path), elapsed)


def _fill(value: np.ndarray, rows: int) -> np.ndarray:
    """The value with zero rows appended."""
    if len(value) == rows:
        return value
    result = np.zeros((rows, *value.shape[1:]), value.dtype)
    result[: len(value)] = value
    return result


def _first(event: Found, count: int) -> Found:
    return Found(
        {name: value[:count] for name, value in event.values.items()},
        event.qpos[:count],
        event.violation[:count],
        event.sequence,
        event.elapsed,
        event.rejected,
        event.audit_seconds,
    )


def _at(event: Found, elapsed: float) -> Found:
    return Found(
        event.values, event.qpos, event.violation, event.sequence, elapsed, event.rejected, event.audit_seconds
    )


def _shape_text(operator: Operator) -> str:
    layout = operator.plan.layout
    return f"{layout.configurations} configurations, {layout.free} free poses"


def _greedy_path(transitions: Any, allowed: set) -> Path:
    """A complete sequence over allowed conditional problems, or ()."""
    dead: set = set()

    def search(state: frozenset) -> Path | None:
        if state == transitions.full:
            return ()
        if state in dead:
            return None
        for transition in transitions.children(state):
            if transition.problem in allowed:
                rest = search(transition.target)
                if rest is not None:
                    return (transition, *rest)
        dead.add(state)
        return None

    return search(frozenset()) or ()
