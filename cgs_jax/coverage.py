"""How much of the solution manifold a set of samples covers.

Two measures. *Projected coverage* (paper, section "Number of Samples and Approximate Coverage"): project the samples on
each variable, cut its space into cells, count the occupied ones. *Cover radius*: the epsilon of the paper's
epsilon-cover, estimated by the distance from points of a held-out reference set to their nearest sample.

Cells are boxes of equal size over joint angles and positions. Rotations are cut on the cube around the sphere of unit
quaternions: the component of largest magnitude chooses one of four faces, the other three divided by it become angles
2 atan(q_j / q_max), each in [-pi/2, pi/2] and cut evenly. A quaternion and its negative fall into one cell, no cell is
torn apart at half a turn, and near the middle of a face the angles are those of the rotation vector. Cells at the
corners hold down to 0.44 times the volume of one in the middle.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgs_jax.errors import InputError
from cgs_jax.samples import SampleSet, kind_of

Values = NDArray[np.floating[Any]]
Samples = SampleSet | Mapping[str, Values] | Values

FILL = (0.2, 0.6)
"""Share of a reference's cells to occupy: below it, cells only count samples; above it, every method looks the same."""


GAIN_WINDOW = 1000
"""Latest samples over which `CoverageGain` is taken."""


@dataclass(frozen=True)
class Cell:
    """Edge lengths of a cell. Raises InputError unless all are positive.

    joint: of configurations and plain vectors, in their own unit (rad for joints).
    position: of a pose's position, m.
    rotation: of a pose's rotation, rad; rounded so that an odd number of cells fills half a turn.

    A cell is around zero, not beside it: what constraints hold at zero is so within a tolerance, and would be spread over
    several cells.
    """

    joint: float = 0.5
    position: float = 0.1
    rotation: float = 0.5

    def __post_init__(self) -> None:
        for name in ("joint", "position", "rotation"):
            size = getattr(self, name)
            if not (size > 0 and math.isfinite(size)):
                raise InputError(f"cell size {name} is {size}, expected a positive number")

    def scaled(self, factor: float) -> Cell:
        """All three edges times a factor."""
        return Cell(self.joint * factor, self.position * factor, self.rotation * factor)


@dataclass(frozen=True)
class FittedCell:
    """A cell size, and the share of the reference's cells that the samples occupy with it."""

    cell: Cell
    fill: float


@dataclass(frozen=True)
class CoverRadius:
    """Distances from reference points to their nearest sample, in the unit of the metric.

    maximum: the estimate of epsilon; it can only grow with more reference points.
    quantiles: by probability.
    distances: one per reference point.
    """

    maximum: float
    quantiles: Mapping[float, float]
    distances: NDArray[np.float64] = field(repr=False)


def cell_indices(values: Values, cell: Cell, kind: str | None = None) -> NDArray[np.int64]:
    """The cell (N, columns) of each value (N, dim); equal rows are one cell.

    kind: "configuration", "vector" or "pose"; by default what the values look like (`samples.kind_of`).
    Raises InputError for values that are not (N, dim), not finite, or not 7 wide for a pose.
    """
    values, kind = _checked(values, kind)
    if kind != "pose":
        return np.rint(values / cell.joint).astype(np.int64)
    position = np.rint(values[:, :3] / cell.position).astype(np.int64)
    return np.concatenate([position, _rotation_cells(values[:, 3:], cell.rotation)], axis=1)


class CoverageGain:
    """Whether more samples still show anything new: follows the samples of a run in batches, as they come.

    `share` is, of the latest `window` samples, the share that was the first of the run in its cell, for the variable for which
    it is largest; 1 while there are fewer samples than that. Where samples are drawn alike it is the chance, over that window,
    that a sample reaches a cell that none has reached before.
    """

    def __init__(self, kinds: Mapping[str, str], cell: Cell | None = None, window: int = GAIN_WINDOW) -> None:
        """kinds: "configuration", "vector" or "pose" by variable."""
        self._kinds, self._cell, self._window = dict(kinds), cell or Cell(), window
        self._known: dict[str, set[Any]] = {name: set() for name in kinds}
        self._first: dict[str, NDArray[np.bool_]] = {name: np.ones(window, dtype=bool) for name in kinds}

    def add(self, values: Mapping[str, Values]) -> None:
        """Takes a batch (N, dim) by variable in."""
        for name, known in self._known.items():
            cells, at = np.unique(_opaque(cell_indices(values[name], self._cell, self._kinds[name])), return_index=True)
            fresh = [cell not in known for cell in cells.tolist()]
            first = np.zeros(len(values[name]), dtype=bool)
            first[at[fresh]] = True
            known.update(cells.tolist())
            self._first[name] = np.concatenate([self._first[name], first])[-self._window :]

    @property
    def share(self) -> float:
        """Between 0 and 1."""
        return max(float(first.mean()) for first in self._first.values())


def _rotation_cells(quaternions: Values, size: float) -> NDArray[np.int64]:
    """Face and three indices (N, 4) on the cube around the unit quaternions (N, 4)."""
    per_face = 1 + 2 * max(0, round((math.pi / size - 1.0) / 2.0))
    face = np.abs(quaternions).argmax(axis=1)
    largest = np.take_along_axis(quaternions, face[:, None], axis=1)
    others = np.stack([np.delete(np.arange(4), i) for i in range(4)])[face]
    angles = 2.0 * np.arctan(np.take_along_axis(quaternions, others, axis=1) / largest)
    indices = np.floor((angles / math.pi + 0.5) * per_face).astype(np.int64)
    return np.concatenate([face[:, None], np.clip(indices, 0, per_face - 1)], axis=1)


def projected_coverage(
    samples: Samples, cell: Cell | Mapping[str, Cell], kinds: Mapping[str, str] | None = None
) -> dict[str, int] | int:
    """Number of occupied cells: by variable, or one number for a single array (N, dim).

    cell: one for all variables, or one by variable.
    kinds: "configuration", "vector" or "pose" by variable, where they are not to be taken from the samples.
    Raises InputError when a variable has no cell size.
    """
    if isinstance(samples, np.ndarray):
        if not isinstance(cell, Cell):
            raise InputError("cell sizes by variable for a single array, expected one Cell")
        return len(_cells(samples, cell, None))
    counts = {}
    for name, (values, kind) in _variables(samples, kinds).items():
        counts[name] = len(_cells(values, _cell_of(name, cell), kind))
    return counts


def reference_fill(
    samples: Samples, reference: Samples, cell: Cell | Mapping[str, Cell], kinds: Mapping[str, str] | None = None
) -> dict[str, float] | float:
    """Share of the reference's occupied cells that the samples occupy too; shaped as `projected_coverage`."""
    if isinstance(samples, np.ndarray) and isinstance(reference, np.ndarray):
        if not isinstance(cell, Cell):
            raise InputError("cell sizes by variable for a single array, expected one Cell")
        return _fill(samples, reference, cell, None)
    ours, theirs = _variables(samples, kinds), _variables(reference, kinds)
    _require_same(ours, theirs)
    return {
        name: _fill(ours[name][0], theirs[name][0], _cell_of(name, cell), kind) for name, (_, kind) in theirs.items()
    }


def fit_cells(
    samples: Samples,
    reference: Samples,
    base: Cell | None = None,
    fill: tuple[float, float] = FILL,
    kinds: Mapping[str, str] | None = None,
) -> dict[str, FittedCell]:
    """A cell size for each variable with which the samples fill the wanted share of the reference's cells.

    The base cell is scaled by a factor between 1/256 and 256, found by bisection towards the middle of `fill`; compare
    every method with the cells fitted to one of them. Where no size reaches the share (fewer samples than that share of
    the reference, or a variable with one value) the closest is returned: look at its `fill`. A single array is the
    variable named "".

    Raises InputError when `fill` is no interval inside [0, 1] or the two sets differ in variables.
    """
    low, high = fill
    if not 0.0 <= low < high <= 1.0:
        raise InputError(f"fill is {fill}, expected 0 <= low < high <= 1")
    base = base or Cell()
    wanted = 0.5 * (low + high)
    ours, theirs = _variables(samples, kinds), _variables(reference, kinds)
    _require_same(ours, theirs)
    fitted = {}
    for name, (values, kind) in theirs.items():
        small, large = -8.0, 8.0
        best: FittedCell | None = None
        for _ in range(12):
            middle = 0.5 * (small + large)
            cell = base.scaled(2.0**middle)
            found = FittedCell(cell, _fill(ours[name][0], values, cell, kind))
            if best is None or abs(found.fill - wanted) < abs(best.fill - wanted):
                best = found
            # Larger cells are fuller, but for small steps where the grid shifts against the samples.
            small, large = (middle, large) if found.fill < wanted else (small, middle)
        assert best is not None
        fitted[name] = best
    return fitted


def cover_radius(
    samples: Values,
    reference: Values,
    kind: str | None = None,
    rotation_length: float = 0.2,
    quantiles: Sequence[float] = (0.5, 0.9, 0.99),
) -> CoverRadius:
    """Estimated epsilon with which the samples (N, dim) cover the manifold that the reference (M, dim) was drawn from.

    Distances are Euclidean in joint angles; of poses they are sqrt(|dx|^2 + (rotation_length * 4 sin(angle / 4))^2) in
    metres, where 4 sin(angle / 4) is the angle up to 10 % at half a turn: a rotation counts as the way of a point that
    far from the axis. The reference should be held out and large: its maximum underestimates the true radius by about
    the reference's own.

    kind: as in `cell_indices`. Raises InputError without samples or without reference, or when widths differ.
    """
    from scipy.spatial import cKDTree

    reference, kind = _checked(reference, kind)
    samples, _ = _checked(samples, kind)
    if not len(samples) or not len(reference):
        raise InputError(f"{len(samples)} samples and {len(reference)} reference points, expected at least one of each")
    if samples.shape[1] != reference.shape[1]:
        raise InputError(f"samples have {samples.shape[1]} columns, expected the reference's {reference.shape[1]}")
    if kind == "pose":
        # Chords between unit quaternions are 2 sin(angle / 4); a tree with both signs finds the shorter of the two.
        samples = np.concatenate([_pose_points(samples, rotation_length, sign) for sign in (1.0, -1.0)])
        reference = _pose_points(reference, rotation_length, 1.0)
    distances, _ = cKDTree(samples).query(reference)
    return CoverRadius(
        maximum=float(distances.max()),
        quantiles={q: float(np.quantile(distances, q)) for q in quantiles},
        distances=distances,
    )


def _pose_points(poses: Values, rotation_length: float, sign: float) -> Values:
    quaternions = poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return np.concatenate([poses[:, :3], 2.0 * rotation_length * sign * quaternions], axis=1)


def bootstrap_interval(
    *data: Sequence[float] | Values,
    statistic: Callable[..., Any] = np.mean,
    paired: bool = False,
    level: float = 0.95,
    resamples: int = 9999,
    seed: int = 0,
) -> tuple[float, float]:
    """Bootstrap confidence interval of a statistic of one or more samples, for instance of the rates of several seeds.

    statistic: of one array per sample, with an `axis` argument; `ratio_of_means` compares two.
    paired: whether the samples are resampled together (the same seeds in both).
    Bias-corrected and accelerated where that is defined, by percentiles where it is not (constant data); a single value
    has no spread to resample and gives an interval without length.

    Raises InputError for empty or non-finite data, or paired data of different lengths.
    """
    from scipy import stats

    arrays = tuple(np.asarray(values, dtype=np.float64).reshape(-1) for values in data)
    if not arrays or any(not values.size or not np.isfinite(values).all() for values in arrays):
        raise InputError("bootstrap over empty or non-finite data, expected at least one finite number in each sample")
    if paired and len({values.size for values in arrays}) > 1:
        sizes = ", ".join(str(values.size) for values in arrays)
        raise InputError(f"paired samples of {sizes} values, expected the same number in each")
    if all(np.ptp(values) == 0.0 for values in arrays):
        value = float(statistic(*arrays, axis=-1))
        return value, value

    def interval(method: str) -> tuple[float, float]:
        result = stats.bootstrap(
            arrays,
            statistic,
            paired=paired,
            vectorized=True,
            axis=-1,
            confidence_level=level,
            n_resamples=resamples,
            method=method,
            rng=np.random.default_rng(seed),
        ).confidence_interval
        return float(result.low), float(result.high)

    if min(values.size for values in arrays) > 1:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            low, high = interval("BCa")
        if math.isfinite(low) and math.isfinite(high):
            return low, high
    return interval("percentile")


def ratio_of_means(numerator: Values, denominator: Values, axis: int = -1) -> Values:
    """Mean over mean, a statistic for `bootstrap_interval`."""
    return np.mean(numerator, axis=axis) / np.mean(denominator, axis=axis)


def limit_share(q: Values, low: Values, high: Values, tol: float = 1e-3) -> float:
    """Share of configurations (N, dof) with at least one joint within `tol` of a limit (dof,); 0 without samples.

    An infinite limit is none.
    """
    q = np.asarray(q)
    if not len(q):
        return 0.0
    return float(((q - np.asarray(low) <= tol) | (np.asarray(high) - q <= tol)).any(axis=1).mean())


def duplicate_share(q: Values, tol: float = 1e-3) -> float:
    """Share of values (N, dim) that have another within `tol` in every column; 0 for fewer than two."""
    from scipy.spatial import cKDTree

    q = np.asarray(q, dtype=np.float64)
    if len(q) < 2:
        return 0.0
    distances, _ = cKDTree(q).query(q, k=2, p=np.inf, distance_upper_bound=np.nextafter(tol, np.inf))
    return float(np.isfinite(distances[:, 1]).mean())


def _checked(values: Values, kind: str | None) -> tuple[Values, str]:
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 2:
        raise InputError(f"values have shape {values.shape}, expected (N, dim)")
    if not np.isfinite(values).all():
        raise InputError("values are not all finite")
    kind = kind or kind_of(values)
    if kind not in ("configuration", "vector", "pose"):
        raise InputError(f"unknown kind {kind!r}, available: configuration, vector, pose")
    if kind == "pose" and values.shape[1] != 7:
        raise InputError(f"poses have {values.shape[1]} columns, expected 7: x y z qw qx qy qz")
    return values, kind


def _variables(samples: Samples, kinds: Mapping[str, str] | None) -> dict[str, tuple[Values, str | None]]:
    kinds = kinds or {}
    if isinstance(samples, SampleSet):
        kinds = {**samples.kinds, **kinds}
        return {name: (values, kinds[name]) for name, values in samples.variables.items()}
    if isinstance(samples, np.ndarray):
        return {"": (samples, kinds.get(""))}
    return {name: (np.asarray(values), kinds.get(name)) for name, values in samples.items()}


def _require_same(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> None:
    if set(ours) != set(theirs):
        raise InputError(f"samples have the variables {', '.join(ours)}, expected the reference's {', '.join(theirs)}")


def _cell_of(name: str, cell: Cell | Mapping[str, Cell]) -> Cell:
    if isinstance(cell, Cell):
        return cell
    if name not in cell:
        raise InputError(f"no cell size for the variable {name!r}, available: {', '.join(cell)}")
    return cell[name]


def _cells(values: Values, cell: Cell, kind: str | None) -> NDArray[np.void]:
    """Occupied cells, each once, as one opaque item per cell: sorting bytes is faster than sorting rows."""
    return np.unique(_opaque(cell_indices(values, cell, kind)))


def _opaque(indices: NDArray[np.int64]) -> NDArray[np.void]:
    """Rows (N, columns) as N opaque items; a variable without columns has one cell."""
    if not indices.shape[1]:
        return np.zeros(len(indices), dtype="V1")
    indices = np.ascontiguousarray(indices)
    return indices.view(np.dtype((np.void, indices.itemsize * indices.shape[1]))).reshape(-1)


def _fill(samples: Values, reference: Values, cell: Cell, kind: str | None) -> float:
    kind = kind or kind_of(np.asarray(reference))
    theirs = _cells(reference, cell, kind)
    shared = set(theirs.tolist()) & set(_cells(samples, cell, kind).tolist())
    return len(shared) / len(theirs) if len(theirs) else 0.0
