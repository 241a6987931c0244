"""Compiled device programs: built once per shape, in the background where asked, kept in a cache on disk.

JAX compiles on first call; here programs are compiled ahead of time, so that compile seconds are known, reported apart and
never counted as sampling, and so that a scheduler can ask whether a program is ready.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NoReturn

import jax
from filelock import FileLock, Timeout

CACHE_BYTES = 512 * 2**20
"""Size to which the cache on disk is kept; the programs used longest ago go first."""

_lock = threading.Lock()
_compiled: dict[Any, Future] = {}
_pool: ThreadPoolExecutor | None = None


def enable_disk_cache(folder: str | os.PathLike[str] | None = None) -> Path:
    """Keeps compiled programs in a folder, by default `cgs_jax` under `XDG_CACHE_HOME` (default `~/.cache`).

    JAX writes entries atomically, so several processes may share the folder. Returns the folder.
    """
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    path = Path(folder) if folder is not None else Path(base) / "cgs_jax"
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    jax.config.update("jax_compilation_cache_max_size", CACHE_BYTES)
    return path


def end_process(status: int) -> NoReturn:
    """Ends the process at once, where a normal exit would wait for every program that is still to be compiled.

    Waits for a write to the cache on disk to end: JAX cannot read an entry that was cut short, nor make room beside one.
    """
    folder = jax.config.values.get("jax_compilation_cache_dir")
    if folder and os.path.isdir(folder):
        # Held until the process is gone, so that no further write begins.
        lock = FileLock(os.path.join(folder, ".lockfile"), timeout=10)
        with contextlib.suppress(Timeout, OSError):
            lock.acquire()
    os._exit(status)


class Program:
    """One compiled program and what it took to make it."""

    def __init__(self, name: str, executable: Callable, seconds: float) -> None:
        self.name, self.seconds = name, seconds
        self._executable = executable

    def __call__(self, *arguments: Any) -> Any:
        """Runs it and waits for the result; releases the GIL meanwhile."""
        return jax.block_until_ready(self._executable(*arguments))


def _signature(arguments: Any) -> Any:
    leaves, structure = jax.tree.flatten(arguments)
    return structure, tuple((leaf.shape, str(leaf.dtype)) for leaf in leaves)


def request(name: str, function: Callable, arguments: tuple) -> Future[Program]:
    """The program of a jitted function for arguments of these shapes; compiled on a thread of its own unless known.

    `function` must be the same object for the same program (see `operators.propose_program`).
    """
    global _pool
    key = (function, _signature(arguments))
    with _lock:
        if key not in _compiled:
            if _pool is None:
                # One thread: two compilations at a time would double the memory and gain nothing beside sampling.
                _pool = ThreadPoolExecutor(1, thread_name_prefix="compile")
            shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), arguments)
            _compiled[key] = _pool.submit(_compile, name, function, shapes)
        return _compiled[key]


def all_requested() -> list[Future[Program]]:
    """Every program that was requested in this process so far, in that order."""
    with _lock:
        return list(_compiled.values())


def _compile(name: str, function: Any, shapes: tuple) -> Program:
    start = time.perf_counter()
    executable = function.lower(*shapes).compile()
    return Program(name, executable, time.perf_counter() - start)
