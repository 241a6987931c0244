"""Compiled device programs: built once per shape, in the background where asked, kept in a cache on disk.

JAX compiles on first call; here programs are compiled ahead of time, so that compile seconds are known, reported apart and
never counted as sampling, and so that a scheduler can ask whether a program is ready.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import pickle
import platform
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NoReturn

import jax
import jaxlib
from jax.experimental import serialize_executable

from cgs_jax import cache

THREADS = 2
"""Programs that are compiled at once: tracing holds the interpreter, generating code does not, and two threads overlap them."""

_numbers = itertools.count()
_lock = threading.Lock()
_compiled: dict[Any, Future] = {}
_pool: ThreadPoolExecutor | None = None


def end_process(status: int) -> NoReturn:
    """Ends the process at once, where a normal exit would wait for every program that is still to be compiled."""
    cache.finish_writing(timeout=10)
    os._exit(status)


VARIABLES = ("XLA_FLAGS", "NPROC", "JAX_PLATFORMS")
"""Variables of the environment that change what XLA generates."""

OPTIONS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_disable_most_optimizations",
    "jax_debug_nans",
)
"""Settings of JAX that change what is traced or generated."""


@functools.cache
def _machine() -> str:
    cpu = Path("/proc/cpuinfo")
    features = cpu.read_text().split("\n\n")[0] if cpu.exists() else platform.processor()
    lines = [line for line in features.splitlines() if line.startswith(("flags", "model name"))]
    return "\n".join([*lines, platform.machine()])


def _environment() -> str:
    """What a compiled program depends on besides its key: the text it is made from, jax and its settings, and the machine."""
    versions = [jax.__version__, jaxlib.__version__, jax.default_backend(), platform.python_version()]
    parts = [cache.DEVICE_SOURCES, _machine(), *versions]
    parts += [f"{name}={os.environ.get(name)}" for name in VARIABLES]
    parts += [f"{name}={jax.config.values.get(name)}" for name in OPTIONS]
    return "\n".join(parts)


def _jax_caches() -> bool:
    return bool(jax.config.values.get("jax_compilation_cache_dir"))


def _entry(key: str | None, shapes: tuple) -> Path | None:
    """File of a program in the cache; None where it is not to be cached.

    Entries are whole executables: what is found is neither traced nor compiled. (JAX's own cache still traces, and what comes
    out of it cannot be handed to another process.)
    """
    if key is None or _jax_caches():
        return None
    return cache.entry(".program", _environment(), key, str(_signature(shapes)))


class Program:
    """One program and what it took to compile it."""

    def __init__(
        self, name: str, executable: Any, seconds: float, portable: bytes | None = None, entry: Path | None = None
    ) -> None:
        """entry: file of the cache that has it, in place of the executable: it is read when it is first needed."""
        self.name, self.seconds = name, seconds
        self.number = next(_numbers)
        """Tells the programs of this process apart."""
        self.reported = False
        """Whether a run has counted its compile seconds."""
        self.foreign = portable is not None or entry is not None
        """Whether it was compiled by another process: it may be damaged, or not fit this one."""
        self._executable = executable
        self._portable = portable
        self._entry = entry
        self._loading = threading.Lock()

    def load(self) -> None:
        """Reads it from the cache where that has not been done. Raises whatever is wrong with the entry."""
        with self._loading:
            if self._executable is None:
                self._executable = _deserialize(self.portable)[1]

    def __call__(self, *arguments: Any) -> Any:
        """Runs it and waits for the result; releases the GIL meanwhile."""
        self.load()
        return jax.block_until_ready(self._executable(*arguments))

    @property
    def portable(self) -> bytes | None:
        """The compiled program, to be loaded by another process on this machine (`load_portable`).

        None where JAX keeps a cache of its own, since what comes out of that cannot be serialised again, and where its entry
        has gone from the cache since.
        """
        if self._portable is None and self._entry is not None:
            with contextlib.suppress(OSError):
                self._portable = cache.read(self._entry)
        elif self._portable is None and not _jax_caches():
            self._portable = pickle.dumps((self.name, serialize_executable.serialize(self._executable)))
        return self._portable


def _deserialize(data: bytes) -> tuple[str, Any]:
    name, parts = pickle.loads(data)
    return name, serialize_executable.deserialize_and_load(*parts)


def load_portable(data: bytes) -> Program:
    """The program of `Program.portable`: no tracing, no compiling."""
    name, executable = _deserialize(data)
    return Program(name, executable, 0.0, data)


def _signature(arguments: Any) -> Any:
    leaves, structure = jax.tree.flatten(arguments)
    return structure, tuple((leaf.shape, str(leaf.dtype)) for leaf in leaves)


def request(name: str, function: Callable, arguments: tuple, key: str | None = None) -> Future[Program]:
    """The program of a jitted function for arguments of these shapes; compiled on a thread of its own unless known.

    `function` must be the same object for the same program (see `operators.propose_program`). `key` says all that the
    function depends on; without one the program is not cached on disk.
    """
    global _pool
    known = (function, _signature(arguments))
    with _lock:
        if known not in _compiled:
            if _pool is None:
                _pool = ThreadPoolExecutor(THREADS, thread_name_prefix="compile")
            shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), arguments)
            _compiled[known] = _pool.submit(_make, name, function, shapes, key)
        return _compiled[known]


def request_anew(name: str, function: Callable, arguments: tuple, key: str | None = None) -> Future[Program]:
    """Like `request`, but the program is compiled here, in place of one that was loaded and failed."""
    path = _entry(key, arguments)
    if path is not None:
        path.unlink(missing_ok=True)
    with _lock:
        known = _compiled.get((function, _signature(arguments)))
        if known is not None and not (known.done() and (known.exception() or known.result().foreign)):
            return known
        _compiled.pop((function, _signature(arguments)), None)
    return request(name, function, arguments, key)


def all_requested() -> list[Future[Program]]:
    """Every program that was requested in this process so far, in that order."""
    with _lock:
        return list(_compiled.values())


def _make(name: str, function: Any, shapes: tuple, key: str | None) -> Program:
    path = _entry(key, shapes)
    if path is not None and path.exists():
        return Program(name, None, 0.0, entry=path)
    start = time.perf_counter()
    executable = function.lower(*shapes).compile()
    program = Program(name, executable, time.perf_counter() - start)
    if path is not None and program.portable is not None:
        cache.store(path, program.portable)
    return program
