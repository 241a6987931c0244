"""Worker processes: batches run on a core of their own.

XLA's CPU client shares one thread pool among all programs of a process and splits every program over it, which costs up to
half of the machine for programs as small as ours. A process with a pool of one thread each (`NPROC=1`) does not pay that. A
worker is a process that runs `main`; it reads pickled messages from its standard input and answers on its standard output. It
loads the scene by name, so only problems that `load_problem` made can be sent (see `Problem.source`).
"""

from __future__ import annotations

import contextlib
import functools
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from cgs_jax import cache
from cgs_jax.audit import Tolerances
from cgs_jax.batches import AimedTables, Audited, Batch, BatchRunner, BatchSettings, Outcome, Values
from cgs_jax.errors import InputError
from cgs_jax.operators import operator_of
from cgs_jax.problems import Source, load_problem
from cgs_jax.programs import Program, load_portable
from cgs_jax.transitions import Transition

ONE_THREAD = {"NPROC": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
"""Environment of a process whose programs run on one thread."""


KEPT_PROBLEMS = 32
"""Problems that all workers together keep with the seed tables that they were given for them, up to 80 MB each: a run on one of
those begins at once."""

Kept = TypeVar("Kept")


@dataclass(frozen=True)
class Setup:
    """What the worker needs to make its runner: the second message, after the digest of the sources, and before another run."""

    source: Source
    seed: int
    settings: BatchSettings
    tolerances: Tolerances | None
    cache_folder: Path | None
    """Where it keeps the seed tables that it makes (`cache`)."""
    kept: int = 1
    """Problems that it keeps, this one among them."""

    @property
    def of_runner(self) -> Setup:
        """The same for all runs that one runner can make."""
        return replace(self, seed=0, kept=1)


@dataclass(frozen=True)
class Aim:
    """Asks for the seed tables of a transition's operator."""

    transition: Transition


@dataclass(frozen=True)
class Audit:
    """Asks whether full samples pass the audit."""

    values: Values


@dataclass(frozen=True)
class Install:
    """Programs of an operator, as `Program.portable`, those that were sent before by their number alone; its seed tables."""

    identity: int
    numbers: tuple[int, ...]
    programs: Mapping[int, bytes]
    aimed: AimedTables


class Worker:
    """A batch runner in another process. Made by `hire`.

    Threads may ask at the same time: a batch that is sent while another one runs is there when that ends. Answers come in the
    order of the questions.
    """

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            # Not -m: the messages' classes must be those of the imported module.
            [sys.executable, "-c", "from cgs_jax.worker import main; main()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | ONE_THREAD | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        )
        self._sending = threading.Lock()
        self._answering = threading.Condition()
        self._asked = self._answered = 0
        self._send(cache.SOURCES)
        self._failed = False
        self._installed: set[int] = set()  # operators of the present runner
        self._installed_in: dict[Setup, set[int]] = {}
        self._sent: set[int] = set()

    @property
    def usable(self) -> bool:
        """Whether it runs and no answer of it may be on its way: after a failure its next one may belong to anything."""
        return not self._failed and self._process.poll() is None

    def begin(self, setup: Setup) -> None:
        """Starts on a problem; `await_ready` tells when it can take batches. Programs that were sent before stay, and the last
        problems with what they were given."""
        self._installed = _lately(self._installed_in, setup, set)
        self._send(setup)

    def install(self, identity: int, programs: Sequence[Program], aimed: AimedTables) -> None:
        """Makes sure that the worker has the programs and seed tables of an operator; they are made in one process only."""
        with self._sending:
            if identity in self._installed:
                return
            self._installed.add(identity)
            if any(program.portable is None for program in programs):
                return  # it makes its own, from JAX's cache
            numbers = tuple(program.number for program in programs)
            missing = {n: p.portable for n, p in zip(numbers, programs, strict=True) if n not in self._sent}
            self._sent.update(missing)
            self._send(Install(identity, numbers, missing, aimed))

    def has(self, program: Program) -> bool:
        """Whether a program was sent to it."""
        return program.number in self._sent

    def await_ready(self) -> bool:
        """Waits until it can take batches; False when it ended before. Raises InputError when it runs other sources,
        and what stopped it from loading the problem."""
        try:
            answer = pickle.load(self._pipe_from())
        except (EOFError, OSError, ValueError, pickle.UnpicklingError):
            return False
        if isinstance(answer, BaseException):
            raise answer
        return True

    def aim(self, transition: Transition) -> AimedTables:
        """Makes seed tables there: work of the interpreter, which the other threads of this process would slow down."""
        return self._ask(Aim(transition))

    def _pipe_from(self) -> BinaryIO:
        assert self._process.stdout is not None
        return self._process.stdout  # type: ignore[return-value]

    def _send(self, message: Any) -> None:
        assert self._process.stdin is not None
        pickle.dump(message, self._process.stdin, protocol=pickle.HIGHEST_PROTOCOL)
        self._process.stdin.flush()

    def run(self, batch: Batch) -> Outcome:
        """Runs one batch there. Raises what the worker raised, or RuntimeError when it is gone."""
        return self._ask(batch)

    def audit(self, values: Values) -> Audited:
        """Audits full samples there. Raises as `run` does."""
        return self._ask(Audit(values))

    def _ask(self, message: Batch | Aim | Audit) -> Any:
        try:
            with self._sending:
                self._send(message)
                turn, self._asked = self._asked, self._asked + 1
            with self._answering:
                self._answering.wait_for(lambda: self._answered == turn)
            try:
                answer = pickle.load(self._pipe_from())
            finally:
                with self._answering:
                    self._answered += 1
                    self._answering.notify_all()
        except (EOFError, OSError) as error:
            raise RuntimeError(f"a worker process ended: {error}") from error
        if isinstance(answer, BaseException):
            self._failed = True
            raise answer
        return answer

    def stand_back(self, niceness: int) -> None:
        """Sets the priority of the process, 0 the usual one. Does nothing where that is not allowed or not known."""
        if hasattr(os, "setpriority"):
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, self._process.pid, niceness)

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.wait()
        # Its pipes are closed here so that no file is left to the garbage collector.
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                try:
                    pipe.close()
                except OSError:
                    pass


_idle: list[Worker] = []
_most_idle = os.cpu_count() or 1


def keep(count: int) -> None:
    """How many workers may wait for another run: one for each core unless this says otherwise."""
    global _most_idle
    _most_idle = count


def hire(setup: Setup) -> Worker:
    """A worker for a run: one that an earlier run of this process left, or a new one."""
    setup = replace(setup, kept=max(KEPT_PROBLEMS // max(_most_idle, 1), 1))
    while _idle:
        worker = _idle.pop()
        if worker.usable:
            worker.begin(setup)
            return worker
        worker.close()
    worker = Worker()
    worker.begin(setup)
    return worker


def dismiss(worker: Worker) -> None:
    """Keeps a worker that waits for work until the next run (`keep`); it ends with this process."""
    if worker.usable and len(_idle) < _most_idle:
        _idle.append(worker)
    else:
        worker.close()


def end_idle() -> None:
    """Ends the workers that wait for another run."""
    while _idle:
        _idle.pop().close()


def serve(source: BinaryIO, sink: BinaryIO) -> None:
    """Answers messages until the source ends."""

    def answer(message: Any) -> None:
        pickle.dump(message, sink, protocol=pickle.HIGHEST_PROTOCOL)
        sink.flush()

    # Plain text comes first: messages of other sources may have other fields.
    if pickle.load(source) != cache.SOURCES:
        answer(
            InputError(
                "a worker process found other sources of cgs_jax than this process had loaded, expected the same: "
                "the files were edited meanwhile; start again"
            )
        )
        return
    loaded: dict[int, Program | None] = {}
    runners: dict[Setup, BatchRunner] = {}
    runner: Any = None  # until the first setup
    while True:
        try:
            message: Setup | Aim | Audit | Install | Batch = pickle.load(source)
        except EOFError:
            return
        try:
            if isinstance(message, Setup):
                if message.cache_folder is not None:
                    cache.enable_disk_cache(message.cache_folder)
                if runner is not None:
                    runner.put_aside()
                runner = _lately(runners, message, functools.partial(_runner_of, message))
                runner.seed = message.seed
                answer("ready")
            elif isinstance(message, Install):
                loaded |= {number: _loaded(data) for number, data in message.programs.items()}
                received = [loaded[number] for number in message.numbers]
                if all(received):  # else the runner compiles its own
                    runner.install(message.identity, [program for program in received if program])
                runner.take_aimed(message.identity, message.aimed)
            elif isinstance(message, Aim):
                answer(runner.aimed(operator_of(runner.problem, message.transition)))
            elif isinstance(message, Audit):
                answer(runner.audit(message.values))
            else:
                answer(runner.run(message))
        except Exception as error:  # noqa: BLE001 - sent to the process that asked
            answer(error)


def _runner_of(setup: Setup) -> BatchRunner:
    problem = load_problem(setup.source.scene, setup.source.instance)
    return BatchRunner(problem, setup.seed, setup.settings, setup.tolerances)


def _lately(kept: dict[Setup, Kept], setup: Setup, make: Callable[[], Kept]) -> Kept:
    """What is kept for a setup, or made now; only the last ones are kept. Both ends of the pipe do so alike."""
    key = setup.of_runner
    kept[key] = kept.pop(key) if key in kept else make()
    while len(kept) > setup.kept:
        del kept[next(iter(kept))]
    return kept[key]


def _loaded(data: bytes) -> Program | None:
    """A received program; None where it cannot be loaded here."""
    try:
        return load_portable(data)
    except Exception:  # noqa: BLE001 - whatever is wrong with it, it can be compiled here
        return None


def main() -> None:
    """Serves standard input until it ends, or until nobody reads the answers."""
    # Ctrl-C reaches the whole group; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sink = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    # Whatever else is printed must not end up among the answers.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    with contextlib.suppress(BrokenPipeError):
        serve(sys.stdin.buffer, sink)
    os._exit(0)
