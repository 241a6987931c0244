"""The sample set: what a run found, in memory and as `samples.npz` (schema `cgs_jax/1`).

Poses are `[x y z qw qx qy qz]`, metres, quaternion w first. N samples, K mode switches, C constraints.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgs_jax.errors import InputError

SCHEMA = "cgs_jax/1"

PARTS = "samples.parts"
"""Folder beside samples.npz where a run puts what it has found, as numbered sample files, until it ends."""

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

_KEYS = (
    "mjcf variables mode_switches qpos attachments placements goals sequences sequence elapsed violation constraints"
    " meta"
).split()

_LISTS = ("attachments", "placements", "goals", "configurations")
"""Keys whose values are JSON lists."""


@dataclass(frozen=True, eq=False)
class SampleSet:
    """N full assignments of one scene instance, each with the MuJoCo configuration of every mode switch.

    mjcf: the resolved instance as one self-contained MJCF text.
    variables: values (N, dim) by name; `result["q_a2"]` reads one.
    mode_switches: K names in time order.
    qpos: (N, K, nq) full MuJoCo configurations.
    attachments, placements, goals: what must hold, as lists of plain dicts (schema `cgs_jax/1`).
    configurations: which joints each variable sets and where the others rest, by mode switch (`Scene.configurations`).
    sequences, sequence: texts, and for each sample the index (N,) of the one that made it.
    elapsed: (N,) seconds of sampling time when the sample passed the audit.
    violation, constraints: (N, C) largest violation of each of C named constraints, m or rad.
    meta: scene, instance, seed, method, tolerances, versions and times of the run.
    kinds: "configuration", "pose" or "vector" by variable; where left out, a variable of 7 columns whose last four are
        unit quaternions is a pose and any other a configuration.

    Raises InputError when shapes disagree.
    """

    mjcf: str
    variables: Mapping[str, Floats]
    mode_switches: tuple[str, ...]
    qpos: Floats
    attachments: Sequence[Mapping[str, Any]] = ()
    placements: Sequence[Mapping[str, Any]] = ()
    goals: Sequence[Mapping[str, Any]] = ()
    sequences: tuple[str, ...] = ()
    sequence: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    elapsed: Floats = field(default_factory=lambda: np.zeros(0))
    violation: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    constraints: tuple[str, ...] = ()
    meta: Mapping[str, Any] = field(default_factory=dict)
    kinds: Mapping[str, str] = field(default_factory=dict)
    configurations: Sequence[Mapping[str, Any]] = ()

    def __post_init__(self) -> None:
        def keep(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        for name in ("mode_switches", "sequences", "constraints"):
            keep(name, tuple(str(text) for text in getattr(self, name)))
        keep("variables", {str(name): np.asarray(value) for name, value in self.variables.items()})
        keep("qpos", np.asarray(self.qpos, dtype=np.float64))
        keep("sequence", np.asarray(self.sequence, dtype=np.intp))
        keep("elapsed", np.asarray(self.elapsed, dtype=np.float64))
        keep("violation", np.asarray(self.violation, dtype=np.float64))
        if self.qpos.ndim != 3 or self.qpos.shape[1] != len(self.mode_switches):
            raise InputError(f"qpos has shape {self.qpos.shape}, expected (N, {len(self.mode_switches)}, nq)")
        count = len(self.qpos)
        for name, value in self.variables.items():
            if value.ndim != 2 or len(value) != count:
                raise InputError(f"variable {name!r} has shape {value.shape}, expected ({count}, dim)")
        for name, expected in (
            ("sequence", (count,)),
            ("elapsed", (count,)),
            ("violation", (count, len(self.constraints))),
        ):
            if getattr(self, name).shape != expected:
                raise InputError(f"{name} has shape {getattr(self, name).shape}, expected {expected}")
        if count and not (0 <= self.sequence.min() and self.sequence.max() < len(self.sequences)):
            raise InputError(f"sequence holds an index outside the {len(self.sequences)} sequences")
        keep("kinds", {name: self.kinds.get(name) or kind_of(value) for name, value in self.variables.items()})

    def __len__(self) -> int:
        return len(self.qpos)

    def __getitem__(self, variable: str) -> Floats:
        """Values (N, dim) of a variable. Raises InputError for an unknown name."""
        if variable not in self.variables:
            raise InputError(f"unknown variable {variable!r}, available: {', '.join(self.variables)}")
        return self.variables[variable]

    @property
    def best_sequence(self) -> str | None:
        """The sequence that made the most samples (the first such), or None without samples."""
        if not len(self):
            return None
        return self.sequences[int(np.bincount(self.sequence, minlength=len(self.sequences)).argmax())]

    def select(self, indices: Any) -> SampleSet:
        """The samples at these positions, in this order; a slice or a boolean mask (N,) works too."""
        positions = np.arange(len(self))[indices].reshape(-1)
        return replace(
            self,
            variables={name: value[positions] for name, value in self.variables.items()},
            qpos=self.qpos[positions],
            sequence=self.sequence[positions],
            elapsed=self.elapsed[positions],
            violation=self.violation[positions],
        )

    @classmethod
    def concatenate(cls, parts: Sequence[SampleSet]) -> SampleSet:
        """All samples of several sets of the same instance, in order; `meta` is the first set's.

        Raises InputError without a part, or when the parts differ in anything but their samples and `meta`.
        """
        if not parts:
            raise InputError("no sample set to concatenate, expected at least one")
        first = parts[0]
        for part in parts[1:]:
            for name in ("mjcf", "mode_switches", "constraints", *_LISTS):
                ours, theirs = getattr(first, name), getattr(part, name)
                if ours != theirs and list(ours) != list(theirs):
                    raise InputError(f"sample sets differ in {name}, expected sets of one instance")
            if list(part.variables) != list(first.variables):
                names = ", ".join(first.variables)
                raise InputError(f"sample sets differ in variables: {', '.join(part.variables)}, expected {names}")
        sequences = tuple(dict.fromkeys(text for part in parts for text in part.sequences))
        index = {text: i for i, text in enumerate(sequences)}
        renumbered = [np.array([index[text] for text in part.sequences], dtype=np.intp) for part in parts]
        return replace(
            first,
            variables={name: np.concatenate([part.variables[name] for part in parts]) for name in first.variables},
            qpos=np.concatenate([part.qpos for part in parts]),
            sequences=sequences,
            sequence=np.concatenate([new[part.sequence] for new, part in zip(renumbered, parts, strict=True)]),
            elapsed=np.concatenate([part.elapsed for part in parts]),
            violation=np.concatenate([part.violation for part in parts]),
        )

    def diverse(self, count: int) -> Indices:
        """Positions of `count` samples that differ most: farthest-point order, from the first sample on.

        The distance of two samples is Euclidean over the variables: joint angles (rad), positions (m) and rotations
        (angle of the relative rotation, rad), each divided by its own spread (root mean square about its mean), so that
        every variable weighs the same. Every prefix of the result is itself such a choice. Time is O(count * N).

        Raises InputError for a negative count.
        """
        if count < 0:
            raise InputError(f"cannot choose {count} samples, expected 0 or more")
        count = min(count, len(self))
        flat, quaternions = self._scaled_for_distance()
        squared = np.einsum("nd,nd->n", flat, flat)
        nearest = np.full(len(self), np.inf, dtype=np.float32)
        chosen = np.zeros(count, dtype=np.intp)
        for i in range(count):
            current = int(nearest.argmax()) if i else 0
            chosen[i] = current
            distance = squared + squared[current] - 2.0 * (flat @ flat[current])
            for quaternion, weight in quaternions:
                half = np.arccos(np.minimum(np.abs(quaternion @ quaternion[current]), np.float32(1.0)))
                distance += weight * half * half
            np.minimum(nearest, distance, out=nearest)
            nearest[current] = -np.inf
        return chosen

    def _scaled_for_distance(self) -> tuple[NDArray[np.float32], list[tuple[NDArray[np.float32], np.float32]]]:
        """Columns (N, D) over their spread; per pose its quaternions (N, 4) and the weight of a half angle's square."""
        columns, quaternions = [np.zeros((len(self), 0))], []
        for name, value in self.variables.items():
            vector = value[:, :3] if self.kinds[name] == "pose" else value
            centred = vector - vector.mean(axis=0) if len(self) else vector
            spread = np.sqrt((centred**2).sum(axis=1).mean()) if len(self) else 0.0
            if spread > 1e-9:
                columns.append(centred / spread)
            if self.kinds[name] == "pose" and len(self):
                quaternion = value[:, 3:] / np.linalg.norm(value[:, 3:], axis=1, keepdims=True)
                mean = np.linalg.eigh(quaternion.T @ quaternion)[1][:, -1]
                angle = 2.0 * np.arccos(np.minimum(np.abs(quaternion @ mean), 1.0))
                variance = (angle**2).mean()
                if variance > 1e-12:
                    quaternions.append((quaternion.astype(np.float32), np.float32(4.0 / variance)))
        return np.concatenate(columns, axis=1).astype(np.float32), quaternions

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write `path`, or `path/samples.npz` when it does not end in `.npz`; the file appears whole or not at all.

        Returns the path of the file. Raises InputError when it cannot be written.
        """
        target = Path(path)
        if target.suffix != ".npz":
            target = target / "samples.npz"
        arrays: dict[str, Any] = {
            "schema": np.array(SCHEMA),
            "mjcf": np.array(self.mjcf),
            "variables": _texts(self.variables),
            "kinds": _texts(self.kinds[name] for name in self.variables),
            "mode_switches": _texts(self.mode_switches),
            "qpos": self.qpos,
            "sequences": _texts(self.sequences),
            "sequence": self.sequence,
            "elapsed": self.elapsed,
            "violation": self.violation,
            "constraints": _texts(self.constraints),
            "meta": np.array(json.dumps(self.meta, default=_plain)),
        }
        for name in _LISTS:
            arrays[name] = np.array(json.dumps([dict(entry) for entry in getattr(self, name)], default=_plain))
        arrays.update({f"x_{name}": value for name, value in self.variables.items()})
        temporary = None
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            handle, temporary = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
            with os.fdopen(handle, "wb") as file:
                np.savez(file, allow_pickle=False, **arrays)
            os.chmod(temporary, 0o666 & ~_umask())
            os.replace(temporary, target)
        except OSError as error:
            raise InputError(f"cannot write {target}: {error.strerror or error}") from None
        finally:
            if temporary is not None:
                Path(temporary).unlink(missing_ok=True)
        return target

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SampleSet:
        """Read a file that `save` wrote, or the `samples.npz` of a directory.

        Where a run was killed, or is still under way, the parts beside are put together in its place; `meta["ended_by"]` is
        then None. Raises InputError when it is missing, no such file, damaged, or of another schema.
        """
        source = Path(path)
        if source.is_dir():
            source = source / "samples.npz"
        if source.name == "samples.npz" and not source.exists() and part_files(source.parent):
            parts = [cls.load(part) for part in part_files(source.parent)]
            return replace(cls.concatenate(parts), meta=parts[-1].meta)
        try:
            with np.load(source, allow_pickle=False) as archive:
                if not isinstance(archive, np.lib.npyio.NpzFile):
                    raise InputError(f"{source} is no sample file, expected an .npz with schema {SCHEMA}")
                stored = {name: archive[name] for name in archive.files}
        except FileNotFoundError:
            raise InputError(f"no sample file {source}, expected a samples.npz or a directory with one") from None
        except InputError:
            raise
        except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            if isinstance(error, ValueError) and not zipfile.is_zipfile(source):
                # NumPy takes whatever is no archive for a pickle, and says how to load it unsafely.
                reason = "it is no archive"
            raise InputError(f"cannot read {source}: {reason}, expected an .npz with schema {SCHEMA}") from None
        schema = str(stored.get("schema", "none"))
        if schema != SCHEMA:
            raise InputError(f"{source} has schema {schema}, expected {SCHEMA}")
        names = [str(name) for name in stored.get("variables", ())]
        missing = [key for key in (*_KEYS, *(f"x_{name}" for name in names)) if key not in stored]
        if missing:
            raise InputError(f"{source} lacks {', '.join(missing)}, expected every key of schema {SCHEMA}")
        try:
            # Files of earlier versions have no configurations.
            stored.setdefault("configurations", np.array("[]"))
            declared = {name: json.loads(str(stored[name])) for name in (*_LISTS, "meta")}
            kinds = [str(kind) for kind in stored.get("kinds", ())]
            return cls(
                mjcf=str(stored["mjcf"]),
                variables={name: stored[f"x_{name}"] for name in names},
                mode_switches=tuple(stored["mode_switches"]),
                qpos=stored["qpos"],
                sequences=tuple(stored["sequences"]),
                sequence=stored["sequence"],
                elapsed=stored["elapsed"],
                violation=stored["violation"],
                constraints=tuple(stored["constraints"]),
                kinds=dict(zip(names, kinds, strict=True)) if kinds else {},
                **declared,
            )
        except (ValueError, TypeError) as error:
            raise InputError(f"{source} is damaged: {str(error).splitlines()[0]}") from None


def part_files(folder: str | os.PathLike[str]) -> list[Path]:
    """Sample files of a run that has not ended, in order."""
    return sorted((Path(folder) / PARTS).glob("[0-9]*.npz"))


def remove_parts(folder: str | os.PathLike[str]) -> None:
    """Removes them, also one that was being written when the run was killed, and their folder when nothing else is in it."""
    place = Path(folder) / PARTS
    for path in (*part_files(folder), *place.glob(".[0-9]*.npz.*")):
        path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        place.rmdir()


def kind_of(values: NDArray[Any]) -> str:
    """What kind of variable values (N, dim) look like: a "pose" where seven columns end in unit quaternions."""
    if values.shape[1] != 7 or not len(values):
        return "configuration"
    lengths = np.linalg.norm(values[:, 3:], axis=1)
    return "pose" if bool((np.abs(lengths - 1.0) < 1e-5).all()) else "configuration"


def _texts(names: Any) -> NDArray[np.str_]:
    return np.array(list(names), dtype=np.str_).reshape(-1)


def _plain(value: Any) -> Any:
    """What JSON needs for numpy's scalars and arrays, and for paths."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"cannot write a {type(value).__name__} as JSON")


def _umask() -> int:
    """The process's file mode mask, which can only be read by setting it."""
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
