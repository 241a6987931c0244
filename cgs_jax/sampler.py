"""Algorithm 1 of the paper, in batches.

A *component* is a set of assigned variables that are statistically linked so far, with the way they came about: the operator
that completed it and the components that it read. Partial samples wait in one pool per component history, so that sequences
which differ only in the order of independent operators share their work, every operator runs full batches, and a failure costs
only the components that its operator read. A prefix may be tried a few times and leaves at its first success, so that no two
finished samples share a value.

The chooser (UCT tree, fixed sequence, random) picks a sequence; what runs is its last operator if that has a batch waiting,
else, by the same rule, the operator that makes what it lacks most. One batch runs in this process and one in each worker
process; all decisions are made by the one scheduling thread.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cgs_jax.audit import Tolerances
from cgs_jax.augmented_lagrangian import Settings
from cgs_jax.batches import Audited, Batch, BatchRunner, BatchSettings, Outcome, Values
from cgs_jax.cache import cache_folder
from cgs_jax.operators import Operator, operator_of
from cgs_jax.problems import Collisions, Problem, with_collisions
from cgs_jax.transitions import Path, Transition
from cgs_jax.uct import Chooser
from cgs_jax.worker import Setup, Worker, dismiss, hire

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
    executed: int
    """Iterations that all lanes together went through."""
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
    """The run ended: by "time", "samples" or "interrupt"; `Run` tells an interrupt of its own as "coverage"."""

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


History = int
"""Number of a component's history: an operator's problem and the histories of the components it read."""


@dataclass(frozen=True)
class _Step:
    """One operator of a sequence with the histories it reads and makes."""

    transition: Transition
    operator: Operator
    reads: tuple[History, ...]
    makes: History


@dataclass(frozen=True)
class Job:
    """A batch to run, the last step of a partial sequence."""

    path: Path
    position: int
    step: _Step
    batch: Batch
    tries: np.ndarray  # (n,) earlier tries of each condition
    look: bool
    """Whether it is one of the first batches in its place."""


@dataclass(frozen=True)
class Candidates:
    """Full samples of one batch, to be audited."""

    path: Path
    makes: History
    """Of the last step of the path."""
    values: Values

    @property
    def size(self) -> int:
        return len(next(iter(self.values.values())))


BATCH_SECONDS = 0.04
"""Device time that a batch should take."""

LOOKS = 8
"""Batches in one place grow over so many to their full size: what is only looked at must not cost much."""

EXPLORED = 1
"""Once there is a sequence to be run, those of other sequences stop at so many of these parts: they tell nearly as much, and
what they read may have cost ten times what they take themselves."""

PARTS_OF_KNOWN = 3
"""Batches of the sequence that is run whatever comes out of it grow by so many of these parts: until something has come through
all steps there is no sample, and full batches take long for that."""

PATIENCE = 4
"""Batches that may be spent until the step after one that was looked at for the first time is looked at too."""

FIRST_PURSUIT = 24
"""Choices for which the first sequences are kept, until one was run to its end: samples are wanted soon, and from then on what
others promise has something to be compared with."""

FEW_HISTORIES = 3
"""Only while that step's operator ran after fewer histories than this: the tree judges it by those alone."""

FIRST_LOOK = 16
"""Conditions that are enough for the first batch in a place: they tell a half from a tenth, and at once."""

FIRST_GUESS = 2e-8
"""Device seconds per task or iteration and squared unknown, before anything has run: rather too few, so that what was looked at
first is not given up for it."""

DRAIN = 24
"""Iterations of all lanes that a batch takes beside those of its tasks: until the last one has ended, lanes stand empty."""

LEAST_UNKNOWNS = 7
"""Programs with fewer unknowns than an arm has joints take as long as if they had so many: copies and clearances remain."""

REPRESENTATIVE = 128
"""Tasks from which on a batch tells how fast its program is: the time of smaller ones is mostly fixed."""

REMEMBERED = 12
"""Batches of a program that its pace is taken from."""

BEFORE_COMPILER = 10.0
"""Seconds of sampling for which workers and compiler share the cores as equals: samples are wanted soon, most of all."""

NICENESS = 10
"""Of the workers from then on, while programs are missing."""

AUDIT_SAMPLES = 4096
"""Full samples that are audited at once: the calls to numpy cost as much as auditing several hundred of them."""

AUDIT_BATCHES = 8
"""Batches after which full samples are audited, however few there are. In the beginning as soon as half as many wait as were
found: whoever watches, or stops at a number of samples, should not wait for the first ones."""

TRIES = 0
"""Name under which the number of earlier tries travels with a waiting condition (no variable can be called that)."""


@dataclass(frozen=True)
class SamplerSettings:
    """How a run is scheduled."""

    batch_size: int = 2048
    """Tasks of one batch."""
    lanes: int = 128
    """Tasks solved side by side."""
    tries: int = 4
    """Most tries of a condition, of which as many are made as pay; it leaves at its first success. 1: the paper's semantics."""
    pools: bool = True
    """Whether a failure keeps the components that the operator did not read. False: the paper's semantics."""
    workers: int = 2
    """Batches in flight."""
    deterministic: bool = False
    """Same seed, same stream of samples: decisions use counted work in place of measured time."""
    solver: Settings = Settings()
    """Settings of the projection."""
    collisions: Collisions = "after"
    """Where clearances are seen to: "after" the solver, where they reject, or "inside" it, as a row for the nearest pair."""


class _Pace:
    """What counted work costs: device seconds per task or iteration of each program, as its larger batches showed.

    The measured time of a small batch says little of what the operator would cost if it were chosen: lanes stand empty, and
    on a busy machine one wait weighs more than the work. So what is charged is what the work would cost in a full batch. A
    program that only ran small batches is judged by what others cost, in proportion to its squared number of unknowns. Of the
    last batches the quicker ones are believed: a program's first ones, or those that others disturbed, take several times as
    long, and would make the sequence that a run starts with look worse than those that it has not run.
    """

    def __init__(self, lanes: int, batch_size: int) -> None:
        self._lanes, self._batch_size = lanes, batch_size
        # Seconds per unit of work (tasks and iterations times squared unknowns) of the last larger batches.
        self._programs: defaultdict[Any, deque[float]] = defaultdict(lambda: deque(maxlen=REMEMBERED))
        self._all: deque[float] = deque(maxlen=4 * REMEMBERED)
        self._steps: dict[int, float] = {}  # by operator: one and the iterations of a task

    def seconds(self, operator: Operator, tasks: int, iterations: int, measured: float, look: bool) -> float:
        """Device seconds to charge for a batch, whose measured time is taken into account unless it is a first look.

        Looks may run in the scheduling process, beside workers that start.
        """
        if tasks >= REPRESENTATIVE and not look:
            unit = measured / ((tasks + iterations + DRAIN * self._lanes) * squared_unknowns(operator))
            self._programs[operator.plan.layout].append(unit)
            self._all.append(unit)
        steps = 1.0 + iterations / tasks
        self._steps[operator.identity] = 0.7 * self._steps.get(operator.identity, steps) + 0.3 * steps
        return tasks * self._per_task(operator, steps)[0]

    def affordable(self, operator: Operator) -> int:
        """Tasks of a batch that takes about `BATCH_SECONDS`: a look at a slow operator must not cost more than at others."""
        # Before its first batch: about seven iterations.
        return self._per_task(operator, self._steps.get(operator.identity, 8.0))[1]

    def _per_task(self, operator: Operator, steps: float) -> tuple[float, int]:
        """Device seconds per task of a full batch, and how many tasks that has."""
        units = sorted(self._programs[operator.plan.layout] or self._all)
        unit = squared_unknowns(operator) * (units[len(units) // 4] if units else FIRST_GUESS)
        # Fewer tasks than lanes take as long, and would make the operator look slower still.
        full = int(min(self._batch_size, max(BATCH_SECONDS / (unit * steps), self._lanes)))
        return unit * (steps + DRAIN * self._lanes / full), full


def squared_unknowns(operator: Operator) -> int:
    """What the work of an iteration grows with."""
    return max(operator.plan.layout.unknowns, LEAST_UNKNOWNS) ** 2


@dataclass(frozen=True, eq=False)
class _Request:
    """Somebody waits for a member of the crew, if possible one that has the programs of an operator."""

    operator: Operator | None


class _Crew:
    """Who runs batches: worker processes where the problem can be loaded there, and this process until they have arrived."""

    def __init__(self, runner: BatchRunner, workers: int, setup: Setup | None) -> None:
        self._free: list[BatchRunner | Worker] = []  # a worker as often as it may be asked
        self._line: list[_Request] = []
        self._changed = threading.Condition()
        self._wanted = workers
        self._arrived: list[Worker] = []
        self._local = runner
        self._refusal: Exception | None = None
        self.size = 0
        """Batches that can run at once now."""
        self.niceness = 0
        self._workers: list[Worker] = []
        self._arrivals: list[threading.Thread] = []
        if setup is None:
            for _ in range(workers):
                self._seat(runner)
            return
        self._seat(runner)
        for _ in range(workers):
            self._hire(setup)

    def _seat(self, member: BatchRunner | Worker) -> None:
        with self._changed:
            self.size = min(self.size + 1, self._wanted)
        self._release(member)

    def _take(self, operator: Operator | None = None) -> BatchRunner | Worker:
        """Whoever is free next; if some worker has the programs of an operator, one of those. First come, first served."""
        request = _Request(operator)
        with self._changed:
            self._line.append(request)
            while True:
                # With all workers there, this process has its core for compiling and deciding.
                if self._complete() and self._local in self._free:
                    self._free.remove(self._local)
                for member in sorted(self._free, key=self._free.count, reverse=True):
                    if next((r for r in self._line if self._suits(r, member)), None) is request:
                        self._line.remove(request)
                        self._free.remove(member)
                        self._changed.notify_all()
                        return member
                self._changed.wait()

    def _suits(self, request: _Request, member: BatchRunner | Worker) -> bool:
        if request.operator is None:
            return True
        able = [worker for worker in self._arrived if self._has(worker, request.operator)]
        return not able or member in able

    def _release(self, member: BatchRunner | Worker) -> None:
        with self._changed:
            self._free.append(member)
            self._changed.notify_all()

    def _has(self, worker: Worker, operator: Operator) -> bool:
        futures = self._local.request(operator)
        return all(future.done() and worker.has(future.result()) for future in futures)

    def _hire(self, setup: Setup) -> None:
        worker = hire(setup)
        self._workers.append(worker)

        def arrive() -> None:
            try:
                if worker.await_ready():
                    self._arrived.append(worker)
                    self._seat(worker)
                    # What it runs next is there when a batch ends.
                    self._release(worker)
            except Exception as error:  # noqa: BLE001 - raised by the next batch
                self._refusal = error

        self._arrivals.append(threading.Thread(target=arrive, daemon=True))
        self._arrivals[-1].start()

    def run(self, batch: Batch, look: bool) -> Outcome:
        """Runs a batch on whoever is free; a first look at an operator, until the workers have arrived, here."""
        if self._refusal is not None:
            raise self._refusal
        operator = operator_of(self._local.problem, batch.transition)
        if look and not self._complete():
            if not self._local.is_aimed(operator):
                member = self._take()
                try:
                    self._aim(member, operator, batch.transition)
                finally:
                    self._release(member)
            return self._local.run(batch)
        # To read a program takes longer than to look: not more than one worker does it for that.
        member = self._take(operator if look else None)
        try:
            if isinstance(member, Worker):
                self._equip(member, operator, batch.transition)
            return member.run(batch)
        finally:
            self._release(member)

    def _equip(self, worker: Worker, operator: Operator, transition: Transition) -> None:
        """Gives a worker the programs and seed tables of an operator."""
        self._aim(worker, operator, transition)
        ready = [future.result() for future in self._local.request(operator)]
        worker.install(operator.identity, ready, self._local.aimed(operator))

    def prepare(self, transitions: list[Transition]) -> None:
        """Has this process and all workers read the programs of transitions, and makes their seed tables."""
        for thread in self._arrivals:
            thread.join()
        if self._refusal is not None:
            raise self._refusal
        for transition in transitions:
            operator = operator_of(self._local.problem, transition)
            for worker in self._arrived:
                self._equip(worker, operator, transition)
            self._local.load(operator)
            self._local.aimed(operator)
        for worker in self._arrived:
            worker.aim(transitions[0])  # which it answers when it has read everything

    def audit(self, values: Values) -> Audited:
        """Audits full samples on whoever is free."""
        member = self._take()
        try:
            return member.audit(values)
        finally:
            self._release(member)

    def _complete(self) -> bool:
        return bool(self._workers) and len(self._arrived) == self._wanted

    def _aim(self, member: BatchRunner | Worker, operator: Operator, transition: Transition) -> None:
        """Sees to it that the operator's seed tables are made; once, since whoever runs a batch gets them from here."""
        if isinstance(member, Worker) and not self._local.is_aimed(operator):
            self._local.take_aimed(operator.identity, member.aim(transition))

    def stand_back(self, niceness: int) -> None:
        """Sets the priority of the workers, 0 the usual one, which it may not be allowed to go back to."""
        self.niceness = niceness
        for worker in self._workers:
            worker.stand_back(niceness)

    def close(self) -> None:
        """Ends the worker processes, but for those that have arrived and wait: the next run takes them. No batch may run."""
        if self.niceness:
            self.stand_back(0)
        for worker in self._workers:
            if worker in self._arrived:
                dismiss(worker)
            else:
                worker.close()


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
        self.chooser, self.settings = chooser, settings or SamplerSettings()
        s = self.settings
        self.problem = with_collisions(problem, s.collisions)
        self._batch_settings = BatchSettings(s.batch_size, s.lanes, s.solver, s.deterministic, s.collisions)
        self._seed, self._tolerances = seed, tolerances
        self._runner = BatchRunner(self.problem, seed, self._batch_settings, tolerances)
        self.auditor = self._runner.auditor
        self._histories: dict[tuple, History] = {}
        self._pools: dict[History, Pool] = {}
        self._waiting: dict[History, Pool] = {}
        self._tasks: dict[int, int] = {}
        self._steps: dict[Path, tuple[_Step, ...]] = {}
        self._visits: dict[History, int] = {}
        self._candidates: list[Candidates] = []
        self._batches_waited = 0  # by the first of them
        self._refused: defaultdict[History, int] = defaultdict(int)  # by the audit, and not yet taken off the successes
        self._pace = _Pace(s.lanes, s.batch_size)
        self._made: defaultdict[int, set[History]] = defaultdict(set)  # by operator
        self._pursued: Path = ()
        self._chosen_for = 0  # choices since then
        self._ended = False  # whether some sequence was run to its end
        self._steady: Path = ()  # the last one that was no look
        self._looked_at: set[History] = set()  # now, in a first batch
        self._patience = 0
        self._announced: set[int] = set()
        self._waited_for: list[Operator] = []  # whose programs are not all there yet
        self._full = problem.transitions.full
        self._stop = threading.Event()

    def stop(self) -> None:
        """Ends the run after the batches in flight."""
        self._stop.set()

    # -------------------------------------------------------------- programs

    def _ready(self, transition: Transition) -> bool:
        return self._runner.ready(operator_of(self.problem, transition))

    def _all_ready(self) -> bool:
        """Whether everything that may be chosen can run: soon nothing has to be asked any more."""
        while self._waited_for and self._runner.ready(self._waited_for[-1]):
            self._waited_for.pop()
        return not self._waited_for

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
                came_about = transition.problem, tuple(sorted(reads)), position if not self.settings.pools else None
                makes = self._histories.setdefault(came_about, len(self._histories))
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

    def prepare(self) -> Iterator[Event]:
        """Makes all that runs on the problem may need, so that later ones of this process lose no time to it: programs,
        compiled and read here and by the workers, and seed tables. Yields programs as they come."""
        order = self.compile_order()
        operators = [operator_of(self.problem, transition) for transition in order]
        for operator in operators:
            self._runner.request(operator)
        crew = self._crew()
        try:
            yield from self._await_first(operators)
            if not self._stop.is_set():
                crew.prepare(order)
        finally:
            crew.close()

    def events(
        self, time_budget: float, num_samples: int | None = None, clock: Callable[[], float] = time.perf_counter
    ) -> Iterator[Event]:
        """Runs until the budget (s of sampling time) or the number of samples is reached; yields events as they happen."""
        begun = clock()
        order = self._initial_requests()
        crew = self._crew()
        try:
            yield from self._await_first(order)
        except BaseException:
            crew.close()
            raise
        start = clock()
        yield Started(start - begun)
        found = 0
        reason = "time"
        threads = ThreadPoolExecutor(2 * self.settings.workers, thread_name_prefix="sample")
        in_flight: list[tuple[Job | list[Candidates], Future[Any]]] = []
        done: queue.SimpleQueue[None] = queue.SimpleQueue()

        def wanted(candidates: list[Candidates], audited: Audited) -> Iterator[Found]:
            """What passed, cut to the number of samples."""
            nonlocal found
            for event in self._found(candidates, audited, clock() - start):
                if num_samples is not None:
                    event = _first(event, num_samples - found)
                found += len(event.qpos)
                yield event

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
                # What is decided must not depend on when the workers arrive.
                # More than run at once wait, so that no worker does.
                most = self.settings.workers if self.settings.deterministic else crew.size + 2
                self._stand_back(crew, elapsed)
                while len(in_flight) < most:
                    work: Job | list[Candidates] | None
                    if self._audit_due(found, num_samples):
                        work = self.take_candidates()
                        future: Future[Any] = threads.submit(crew.audit, _together(work))
                    else:
                        work = self.next_job()
                        if work is None:
                            break
                        future = threads.submit(crew.run, work.batch, work.look)
                    future.add_done_callback(lambda _: done.put(None))
                    in_flight.append((work, future))
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
                work, future = in_flight.pop(at)
                if isinstance(work, Job):
                    yield self.absorb(work, future.result())
                    continue
                yield from wanted(work, future.result())
            # What was finished in time is not thrown away.
            for work, future in in_flight:
                if not isinstance(work, Job) and reason != "samples":
                    yield from wanted(work, future.result())
            if self._candidates and reason != "samples":
                rest = self.take_candidates()
                yield from wanted(rest, self._runner.audit(_together(rest)))
        finally:
            threads.shutdown(wait=True, cancel_futures=True)
            crew.close()
        yield Finished(reason, clock() - start)

    def _stand_back(self, crew: _Crew, elapsed: float) -> None:
        """Lets the compiler go before the workers where it takes long: what the search may choose must become complete."""
        niceness = NICENESS if elapsed > BEFORE_COMPILER and not self._all_ready() else 0
        if niceness != crew.niceness:
            crew.stand_back(niceness)

    def _crew(self) -> _Crew:
        source, workers = self.problem.source, self.settings.workers
        if source is None or workers == 1:
            return _Crew(self._runner, workers, None)
        setup = Setup(source, self._seed, self._batch_settings, self._tolerances, cache_folder())
        return _Crew(self._runner, workers, setup)

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
            self._runner.request(operator)
        if not path:
            for transition in order:
                self._runner.request(operator_of(self.problem, transition))
                self._waited_for.append(operator_of(self.problem, transition))
        return operators

    def _cheapest_path(self, order: list[Transition]) -> Path:
        """A complete sequence that few and small solver programs allow: one if there is such, else the smallest ones."""
        transitions = self.problem.transitions
        of_program: dict[Any, set] = {}
        for transition in order:
            of_program.setdefault(operator_of(self.problem, transition).plan.layout, set()).add(transition.problem)
        smallest: set = set()
        prefixes = [smallest := smallest | problems for problems in of_program.values()]
        for allowed in [*of_program.values(), *prefixes]:
            path = _greedy_path(transitions, allowed)
            if path:
                return path
        raise AssertionError("the graph has no complete sequence")

    def _await_first(self, operators: list[Operator]) -> Iterator[Event]:
        for operator in operators:
            for future in self._runner.request(operator):
                while not future.done():
                    if self._stop.is_set():
                        return
                    time.sleep(0.002)
                    yield from self._announcements()
                future.result()
        yield from self._announcements()

    def _announcements(self) -> Iterator[Event]:
        for future in self._runner.requested():
            if id(future) not in self._announced and future.done():
                self._announced.add(id(future))
                program = future.result()
                # Programs made for an earlier run in this process cost this one nothing.
                if not program.reported:
                    program.reported = True
                    yield Compiled(program.name, program.seconds)

    def _choose(self) -> Path:
        """The sequence to work on; () while none is ready. After a first look at a step the next one is looked at too.

        What that is worth may depend on how its inputs came about as much as tenfold, and nothing else would show it.
        """
        if self._patience > 0 and not self._hopeless(self._pursued):
            return self._pursued
        self._patience = 0
        if not self._ended and self._pursued and self._chosen_for < FIRST_PURSUIT:
            self._chosen_for += 1
            return self._pursued
        self._chosen_for = 0
        if self.settings.deterministic:
            path = self.chooser.select(None)
            for step in self._steps_of(path):
                for future in self._runner.request(step.operator):
                    future.result()
        else:
            path = self.chooser.select(None if self._all_ready() else self._ready)
        self._pursued = path
        return path

    @property
    def _known(self) -> Path:
        """The sequence that is run whatever comes out of it: the incumbent of a tree, a fixed one; () without one."""
        return getattr(self.chooser, "incumbent", getattr(self.chooser, "path", ()))

    def _hopeless(self, path: Path) -> bool:
        """Whether the chooser, if it is a tree, has given up a sequence."""
        asked = getattr(self.chooser, "hopeless", None)
        return asked is not None and asked(path)

    def next_job(self) -> Job | None:
        """What to run next; None while nothing is ready."""
        path = self._choose()
        if not path:
            return None
        job = self._job_of(path)
        # Before the first look at a step is over, a second one would tell the same.
        if job is None:
            known = self._steady or self._known
            job = self._job_of(known) if known else None
        return job or self._job_of(path, again=True)

    def _job_of(self, path: Path, again: bool = False) -> Job | None:
        """The batch that the sequence needs most; None where that is being looked at for the first time, unless `again`."""
        steps = self._steps_of(path)
        makers = {step.makes: position for position, step in enumerate(steps)}
        ends = (steps[-1].makes, *self._final_histories(path))
        position = makers[min(ends, key=lambda history: self._pool(history).size)]
        batch = self.settings.batch_size
        known = self._known
        while True:
            step = steps[position]
            slot = step.makes
            waiting = self._waiting.setdefault(slot, Pool())
            # A sequence that is new is followed down with small batches: what it is worth shows only at its end.
            visits = self._visits.get(slot, 0)
            young = visits < 2
            most = self._pace.affordable(step.operator)
            explored = known and path != getattr(self.chooser, "promised", ())
            if path == known:
                grown = PARTS_OF_KNOWN * (visits + 1)
            else:
                grown = min(visits + 1, EXPLORED if explored else LOOKS)
            if grown < LOOKS:
                most = max(most * grown // LOOKS, min(self.settings.lanes, batch))
            # A first look takes what there is: while it waits for more, the search may turn to something else for good.
            enough = max(most // 2, 1) if visits else min(FIRST_LOOK, max(most // 8, 1))
            scarcest = min(step.reads, key=lambda read: self._pool(read).size, default=None)
            if scarcest is None or waiting.size + self._pool(scarcest).size >= enough:
                count = most
                if visits and slot in self._looked_at and not again:
                    return None
                if not visits:
                    self._looked_at.add(slot)
                if all(self._visits.get(step.makes, 0) > 1 for step in steps):
                    self._steady = path
                self._ended |= step.transition.target == self._full
                self._made[step.operator.identity].add(slot)
                if path is self._pursued:
                    self._pursue(steps, position, visits)
                self._visits[slot] = self._visits.get(slot, 0) + 1
                return self._job(path, position, step, waiting, count, young)
            position = makers[scarcest]

    def _pursue(self, steps: tuple[_Step, ...], position: int, visits: int) -> None:
        """Notes how long the chosen sequence is kept, a batch of a step after so many being made now."""
        if visits == 0:
            following = steps[position + 1 : position + 2]
            known = len(self._made[following[0].operator.identity]) if following else FEW_HISTORIES
            self._patience = PATIENCE if known < FEW_HISTORIES else 0
        else:
            self._patience = max(self._patience - 1, 0)

    def _pool(self, history: History) -> Pool:
        return self._pools.setdefault(history, Pool())

    def _job(self, path: Path, position: int, step: _Step, waiting: Pool, most: int, look: bool) -> Job:
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
        return Job(path, position, step, Batch(step.transition, conditions, count, first), tries, look)

    # -------------------------------------------------------------- results

    def absorb(self, job: Job, outcome: Outcome) -> Ran:
        """Takes in what came of a job: statistics, pools, full samples."""
        success = outcome.success
        self._looked_at.discard(job.step.makes)
        given_up = ~success
        if job.step.reads:
            worthwhile = self.chooser.tries(job.path[: job.position], job.step.transition)
            given_up &= job.tries + 1 >= min(self.settings.tries, worthwhile)
            again = ~success & ~given_up
            if again.any():
                rows = np.flatnonzero(again)
                part = {name: value.take(rows, axis=0) for name, value in job.batch.conditions.items()}
                waiting = self._waiting[job.step.makes]
                waiting.put(part | {TRIES: job.tries[rows] + 1})
        operator = job.step.operator
        seconds = self._pace.seconds(operator, len(success), outcome.iterations, outcome.device_seconds, job.look)
        allowed = self.settings.tries if job.step.reads else 1
        attempts = np.bincount(job.tries, minlength=allowed)
        successes = np.bincount(job.tries[success], minlength=allowed)
        # The audit speaks later: what it refused is taken off the successes that come next.
        refused = min(self._refused[job.step.makes], int(successes.max()))
        self._refused[job.step.makes] -= refused
        successes[successes.argmax()] -= refused
        self.chooser.record(
            job.path[: job.position],
            job.step.transition,
            attempts=attempts.tolist(),
            successes=successes.tolist(),
            seconds=seconds,
            spent=outcome.device_seconds if self.settings.deterministic else _passed(outcome),
        )
        self._batches_waited += bool(self._candidates)
        if success.any():
            self._keep(job, outcome.values)
        first, second = job.tries == 0, job.tries == 1
        return Ran(
            path=job.path,
            position=job.position,
            tasks=len(success),
            proposed=outcome.proposed,
            cleared=int(success.sum()),
            iterations=outcome.iterations,
            executed=outcome.executed,
            failures=outcome.failures,
            first_tries=int(first.sum()),
            first_successes=int((first & success).sum()),
            second_tries=int(second.sum()),
            second_successes=int((second & success).sum()),
            device_seconds=outcome.device_seconds,
            host_seconds=outcome.host_seconds,
        )

    def _keep(self, job: Job, values: Values) -> None:
        """Puts what a batch made into the pool of its component; full samples wait for the audit."""
        step = job.step
        if step.transition.target != self._full:
            self._pool(step.makes).put(values)
            return
        others = self._final_histories(job.path)
        if others:  # components that no constraint links
            self._pool(step.makes).put(values)
            pools = [self._pool(history) for history in (step.makes, *others)]
            count = min(pool.size for pool in pools)
            if not count:
                return
            values = {}
            for pool in pools:
                values |= pool.take(count)
        self._candidates.append(Candidates(job.path, step.makes, values))

    # -------------------------------------------------------------- the audit

    def _audit_due(self, found: int, wanted: int | None) -> bool:
        """Whether to audit what waits: the first samples, enough to finish, many, or some that have waited."""
        if not self._candidates:
            return False
        waiting = sum(candidates.size for candidates in self._candidates)
        many = min(AUDIT_SAMPLES, found // 2)
        if wanted is not None:
            many = min(many, wanted - found)
        return waiting >= many or self._batches_waited >= AUDIT_BATCHES

    def take_candidates(self) -> list[Candidates]:
        """The full samples that wait for the audit, which are no longer kept."""
        taken, self._candidates, self._batches_waited = self._candidates, [], 0
        return taken

    def _found(self, candidates: list[Candidates], audited: Audited, elapsed: float) -> Iterator[Found]:
        """What passed, one event for each sequence, with its share of the time."""
        values = _together(candidates)
        made_by = np.repeat(np.arange(len(candidates)), [part.size for part in candidates])
        by_path: dict[Path, list[int]] = {}
        for number, part in enumerate(candidates):
            by_path.setdefault(part.path, []).append(number)
            self._refused[part.makes] += int((~audited.ok[made_by == number]).sum())
        for path, numbers in by_path.items():
            theirs = np.isin(made_by, numbers)
            passed = theirs & audited.ok
            yield Found(
                values={name: value[passed] for name, value in values.items()},
                qpos=audited.qpos[passed],
                violation=audited.violation[passed],
                sequence=self.problem.transitions.format(path),
                elapsed=elapsed,
                rejected=int((theirs & ~audited.ok).sum()),
                audit_seconds=audited.seconds * float(theirs.mean()),
            )


def _together(candidates: list[Candidates]) -> Values:
    names = candidates[0].values
    return {name: np.concatenate([part.values[name] for part in candidates]) for name in names}


def _passed(outcome: Outcome) -> float:
    return outcome.device_seconds + outcome.host_seconds + outcome.load_seconds


def _first(event: Found, count: int) -> Found:
    values = {name: value[:count] for name, value in event.values.items()}
    return replace(event, values=values, qpos=event.qpos[:count], violation=event.violation[:count])


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
