"""Numbers from kept runs: rates over time, when a method is up to speed, coverage. Arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgs_jax.coverage import (
    FILL,
    Cell,
    bootstrap_interval,
    cover_radius,
    fit_cells,
    projected_coverage,
    ratio_of_means,
)

Floats = NDArray[np.float64]

WINDOW = 1.0
"""Seconds over which a momentary rate is taken."""


def time_grid(budget: float, step: float = 0.1) -> Floats:
    """Times (s) at which rates are read, from the first step to the budget."""
    return np.arange(1, round(budget / step) + 1) * step


def rate_over_time(elapsed: Floats, times: Floats, window: float = WINDOW) -> Floats:
    """Samples per second in the window before each time; the window is cut at the start."""
    elapsed = np.sort(np.asarray(elapsed))
    start = np.maximum(times - window, 0.0)
    counts = np.searchsorted(elapsed, times, "right") - np.searchsorted(elapsed, start, "right")
    return counts / (times - start)


def final_rate(elapsed: Floats, budget: float) -> float:
    """Samples per second over the last half of the budget."""
    elapsed = np.asarray(elapsed)
    return float(((elapsed > 0.5 * budget) & (elapsed <= budget)).sum() / (0.5 * budget))


def first_time_at(rates: Floats, times: Floats, wanted: float) -> float | None:
    """First time at which the rate is at least the wanted one; None where it never is."""
    reached = np.flatnonzero(rates >= wanted)
    return float(times[reached[0]]) if len(reached) else None


def time_of_overtaking(ours: Floats, theirs: Floats, times: Floats) -> float | None:
    """Time from which on our rate stays at least theirs; None where it does not at the end."""
    below = np.flatnonzero(ours < theirs)
    if not len(below):
        return float(times[0])
    return float(times[below[-1] + 1]) if below[-1] + 1 < len(times) else None


def side_by_side(ours: Sequence[float], theirs: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
    """Of two methods' numbers by seed, those of the seeds that both have: these ran one after the other. Where one has more, a
    change of the machine's speed would meet it alone."""
    both = min(len(ours), len(theirs))
    return ours[:both], theirs[:both]


def ratio_with_interval(ours: Sequence[float], theirs: Sequence[float]) -> dict[str, float | None]:
    """Mean over mean of runs side by side, with a bootstrap interval over seeds; all None where theirs is 0.

    The seeds of both are resampled together, since these met the same machine.
    """
    above, below = np.asarray(ours, float), np.asarray(theirs, float)
    if not below.mean() > 0:
        return {"ratio": None, "low": None, "high": None}
    ratio = float(above.mean() / below.mean())
    # A resample of what they did can be all zeros.
    known = (below > 0).all()
    low, high = bootstrap_interval(above, below, statistic=ratio_of_means, paired=True) if known else (ratio, ratio)
    return {"ratio": ratio, "low": low, "high": high}


def mean_with_interval(values: Sequence[float]) -> dict[str, float]:
    """Mean with a bootstrap interval."""
    low, high = bootstrap_interval(np.asarray(values, float))
    return {"mean": float(np.mean(values)), "low": low, "high": high}


def variation(values: Sequence[float]) -> float | None:
    """Spread over mean: how much a method depends on the instance. None where the mean is 0."""
    mean = float(np.mean(values))
    return float(np.std(values) / mean) if mean > 0 else None


def coverage_of_instance(
    values: Mapping[str, Sequence[Mapping[str, Floats]]],
    reference: Mapping[str, Floats],
    kinds: Mapping[str, str],
    least: int,
    radius_points: int = 500,
    radius_seeds: int = 2,
) -> dict[str, Any]:
    """Projected coverage and cover radius of several methods on one instance.

    values: by method, for each seed the samples by variable; "tree" is what the cells are fitted to. reference:
    held-out samples by variable. least: a method with fewer samples in some seed is left out of the comparison at equal
    count. Returns per variable the cell, how much of the reference's cells the tree fills, and per method one number for each
    seed of: cells at equal time, cells at equal count, 0.9 quantile of the cover distance at equal time and count.
    """
    fitted = fit_cells(values["tree"][0], reference, kinds=kinds)
    sizes = {method: [_count(samples) for samples in seeds] for method, seeds in values.items()}
    enough = [method for method, counts in sizes.items() if min(counts) >= least]
    count = min((min(sizes[method]) for method in enough), default=0)
    random = np.random.default_rng(0)
    some = random.permutation(_count(reference))[:radius_points]
    result: dict[str, Any] = {"count": count, "reference": _count(reference), "samples": sizes, "variables": {}}
    cells = {name: fit.cell for name, fit in fitted.items()}
    per_method: dict[str, dict[str, dict[str, list[float]]]] = {name: {} for name in reference}
    for method, seeds in values.items():
        for number, samples in enumerate(seeds):
            sets = [("time", samples)]
            if method in enough:
                chosen = np.sort(random.permutation(_count(samples))[:count])
                sets.append(("count", {name: value[chosen] for name, value in samples.items()}))
            for which, part in sets:
                occupied = projected_coverage(part, cells, kinds)
                for name in reference:
                    entry = per_method[name].setdefault(method, {})
                    entry.setdefault(f"cells_at_equal_{which}", []).append(occupied[name])
                    if number < radius_seeds and _count(part):
                        radius = cover_radius(part[name], reference[name][some], kinds[name], quantiles=(0.9,))
                        entry.setdefault(f"distance_at_equal_{which}", []).append(radius.quantiles[0.9])
                        entry.setdefault(f"radius_at_equal_{which}", []).append(radius.maximum)
    for name, fit in fitted.items():
        result["variables"][name] = {
            "cell": _cell_text(fit.cell, kinds[name]),
            "fill": fit.fill,
            "fill_as_wanted": FILL[0] <= fit.fill <= FILL[1],
            "methods": per_method[name],
        }
    return result


def relative_to_tree(instances: Sequence[Mapping[str, Any]], variable: str, method: str, what: str) -> list[float]:
    """A coverage number of a method over tree's mean on the same instance, for every instance and seed (`side_by_side`)."""
    ratios = []
    for instance in instances:
        methods = instance["variables"][variable]["methods"]
        ours, trees = methods.get(method, {}).get(what), methods["tree"].get(what)
        if ours and trees:
            ours, trees = side_by_side(ours, trees)
            ratios += [value / float(np.mean(trees)) for value in ours if np.mean(trees) > 0]
    return ratios


def _count(samples: Mapping[str, Any]) -> int:
    return len(next(iter(samples.values())))


def _cell_text(cell: Cell, kind: str) -> str:
    return f"{cell.position:.3g} m, {cell.rotation:.3g} rad" if kind == "pose" else f"{cell.joint:.3g} rad"
