"""Files that outlast a process: compiled programs and seed tables, in one bounded folder that several processes may share."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import threading
from collections.abc import Iterable
from pathlib import Path

CACHE_BYTES = 512 * 2**20
"""Size to which the folder is kept; the entries used longest ago go first."""

SUFFIXES = (".program", ".table")
"""Kinds of entries; other files in the folder are left alone."""

_folder: Path | None = None
_writing = threading.Lock()


def enable_disk_cache(folder: str | os.PathLike[str] | None = None) -> Path:
    """Keeps compiled programs and seed tables in a folder, by default `cgs_jax` under `XDG_CACHE_HOME` (default `~/.cache`).

    An entry is written under another name and renamed, so that several processes may share the folder. Returns the folder.
    """
    global _folder
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    _folder = Path(folder) if folder is not None else Path(base) / "cgs_jax"
    return _folder


def cache_folder() -> Path | None:
    """The folder; None while nothing is kept."""
    return _folder


def entry(suffix: str, *parts: str | bytes) -> Path | None:
    """File of what these parts determine, whether it is there or not; None while nothing is kept."""
    if _folder is None:
        return None
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little") + data)
    return _folder / f"{digest.hexdigest()}{suffix}"


def read(path: Path) -> bytes:
    """What an entry holds; it counts as used now. Raises OSError where it is not there."""
    data = path.read_bytes()
    with contextlib.suppress(OSError):
        os.utime(path)
    return data


def store(path: Path, data: bytes) -> None:
    """Writes an entry, and removes others while all together are too large. What cannot be written is not kept."""
    with _writing, contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f"{path.name}.{os.getpid()}.part")
        part.write_bytes(data)
        part.replace(path)
        entries = []
        for suffix in SUFFIXES:
            entries += [(file.stat().st_mtime, file.stat().st_size, file) for file in path.parent.glob(f"*{suffix}")]
        excess = sum(size for _, size, _ in entries) - CACHE_BYTES
        for _, size, file in sorted(entries):
            if excess <= 0:
                break
            file.unlink(missing_ok=True)
            excess -= size


def finish_writing(timeout: float) -> None:
    """Waits until no entry is being written, at most so many seconds; none is written in this process afterwards."""
    _writing.acquire(timeout=timeout)


def _digest(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(path.read_bytes())
    return digest.hexdigest()


IMPORT = re.compile(r"^\s*from cgs_jax(?:\.(\w+))? import (.*)$", flags=re.M)


def imported_by(module: str) -> set[Path]:
    """Files of this package that a module of it is made of: its own, and those that it imports, directly or not."""
    found: set[Path] = set()
    wanted = {module}
    while wanted:
        path = Path(__file__).parent / f"{wanted.pop()}.py"
        if path in found or not path.exists():
            continue
        found.add(path)
        for name, names in IMPORT.findall(path.read_text(encoding="utf-8")):
            wanted.update([name] if name else map(str.strip, names.split(",")))
    return found


SOURCES = _digest(Path(__file__).parent.glob("*.py"))
"""Digest of this package's text as it was when this process imported it."""

DEVICE_SOURCES = _digest(imported_by("operators"))
"""Digest of what device programs and seed tables are made from."""
