"""Figures of the report, drawn from a scene's numbers (`Study.numbers`)."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # files only; no display needed

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from cgs_jax.experiments import measures
from cgs_jax.experiments.claims import finals, mean_curve

COLOURS = {"tree": "#0b5394", "tree-warm": "#d1495b", "rand": "#8d8d8d"}
EXPERT_COLOURS = ("#e39b2d", "#2a9d8f", "#7b5ea7", "#7f5539", "#bc5090")
STYLE = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "axes.axisbelow": True,
    "axes.titlesize": 10,
    "legend.frameon": False,
}


def methods_of(scene: Mapping[str, Any]) -> list[str]:
    """Methods in the order of all figures and tables."""
    ran = set().union(*(instance["methods"] for instance in scene["instances"]))
    return [name for name in ("tree", "tree-warm", *scene["sequences"], "rand") if name in ran]


def colours_of(scene: Mapping[str, Any]) -> dict[str, str]:
    experts = dict(zip(scene["sequences"], EXPERT_COLOURS * 3, strict=False))
    return {name: COLOURS.get(name) or experts[name] for name in methods_of(scene)}


def rates(scene: Mapping[str, Any], path: Path) -> None:
    """Rate over time: mean over instances with the spread between them, and each instance over tree's final rate. Of the seeds
    that ran beside the experts."""
    times = np.array(scene["times"])
    colours = colours_of(scene)
    with plt.rc_context(STYLE):
        figure, (absolute, relative, compile_axis) = plt.subplots(
            1, 3, figsize=(12.5, 3.9), gridspec_kw={"width_ratios": [4, 4, 1.7]}, constrained_layout=True
        )
        for method, colour in colours.items():
            curve = mean_curve(scene, method)
            if curve is None:
                continue
            each = np.array([instance["methods"][method]["curve_beside"] for instance in scene["instances"]])
            low, high = np.quantile(each, [0.25, 0.75], axis=0)
            width = 2.2 if method.startswith("tree") else 1.4
            absolute.plot(times, curve, color=colour, lw=width, label=method)
            absolute.fill_between(times, low, high, color=colour, alpha=0.10, lw=0)
            beside = scene["budget"]["expert_seeds"]
            trees = np.array([np.mean(finals(instance, "tree")[:beside]) for instance in scene["instances"]])
            if (trees > 0).any():
                shares = each[trees > 0] / trees[trees > 0, None]
                low, high = np.quantile(shares, [0.25, 0.75], axis=0)
                relative.plot(times, shares.mean(axis=0), color=colour, lw=width)
                relative.fill_between(times, low, high, color=colour, alpha=0.10, lw=0)
        absolute.set(
            title="Samples per second, mean over instances",
            xlabel="sampling time (s), programs ready",
            ylabel=f"samples/s in the last {measures.WINDOW:.0f} s",
        )
        relative.set(
            title="The same over tree's final rate on each instance",
            xlabel="sampling time (s), programs ready",
            ylabel="share of tree's final rate",
        )
        relative.axhline(1.0, color="#0b5394", lw=0.8, ls=":")
        absolute.legend(loc="upper left", ncols=2)
        for axis in (absolute, relative):
            axis.set_ylim(bottom=0.0)
            axis.set_xlim(0.0, times[-1])
        absolute.set_ylim(top=1.28 * absolute.get_ylim()[1])
        programs = scene["preparation"]["programs"]
        kinds = {kind: [p["seconds"] for p in programs if p["name"].startswith(kind)] for kind in ("solve", "clearance")}
        bars = [f"{_number(len(seconds), 'program')}\n{kind}" for kind, seconds in kinds.items()]
        compile_axis.barh(bars, [sum(seconds) for seconds in kinds.values()], color="0.55", height=0.5)
        compile_axis.invert_yaxis()
        compile_axis.grid(axis="y", visible=False)
        compile_axis.set(title="Compile time before", xlabel="s, once per machine;\na sequence needs some")
        count = len(scene["instances"])
        seeds = scene["budget"]["seeds"]
        figure.suptitle(f"{scene['title']}: {_number(count, 'instance')}, {_number(seeds, 'seed')}; bands: middle half")
        _save(figure, path)


def instances(scene: Mapping[str, Any], path: Path) -> None:
    """Final rate of every method on every instance; a dot per seed."""
    colours = colours_of(scene)
    with plt.rc_context(STYLE):
        figure, axis = plt.subplots(figsize=(max(7.0, 1.3 * len(scene["instances"])), 3.6), constrained_layout=True)
        width = 0.8 / len(colours)
        least = min(
            (rate for i in scene["instances"] for m in colours for rate in finals(i, m) if rate > 0), default=1.0
        )
        floor = 10.0 ** np.floor(np.log10(least))
        for number, (method, colour) in enumerate(colours.items()):
            for at, instance in enumerate(scene["instances"]):
                rates = finals(instance, method)
                x = at - 0.4 + (number + 0.5) * width
                mean = float(np.mean(rates)) if rates else 0.0
                label = method if at == 0 else None
                axis.bar(x, max(mean, floor) - floor, width * 0.92, bottom=floor, color=colour, alpha=0.85, label=label)
                axis.plot([x] * len(rates), np.maximum(rates, floor), ".", color="black", ms=2.5)
                if not mean:
                    axis.text(x, floor * 1.05, "0", ha="center", va="bottom", color=colour)
        axis.set_yscale("log")
        axis.set_ylim(bottom=floor)
        axis.grid(axis="x", visible=False)
        names = [textwrap.fill(f"{instance['instance']}: {instance['title']}", 16) for instance in scene["instances"]]
        axis.set_xticks(range(len(names)), names)
        if len(scene["instances"]) > 5:
            axis.tick_params(axis="x", labelsize=8)
        axis.set(ylabel="final samples/s (log)", title=f"{scene['title']}: final rate by instance; a dot is a seed")
        axis.legend(ncols=len(colours), loc="upper center", bbox_to_anchor=(0.5, -0.12))
        _save(figure, path)


def coverage(scene: Mapping[str, Any], path: Path) -> None:
    """Projected coverage by variable over tree's, at equal time and at equal count, and the cover distance."""
    covered = [instance["coverage"] for instance in scene["instances"] if instance["coverage"]]
    colours = colours_of(scene)
    counts = [instance["count"] for instance in covered]
    panels = (
        ("cells_at_equal_time", "Occupied cells at equal time"),
        ("cells_at_equal_count", f"Occupied cells at equal count ({min(counts)} to {max(counts)} samples)"),
        ("distance_at_equal_time", "Distance from held-out samples at equal time (0.9 quantile; less is better)"),
    )
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(3, 1, figsize=(9.5, 8.2), sharex=True, constrained_layout=True)
        width = 0.8 / len(colours)
        for axis, (what, title) in zip(axes, panels, strict=True):
            for number, (method, colour) in enumerate(colours.items()):
                for at, variable in enumerate(scene["variables"]):
                    ratios = measures.relative_to_tree(covered, variable, method, what)
                    if not ratios:
                        continue
                    value = measures.mean_with_interval(ratios)
                    x = at - 0.4 + (number + 0.5) * width
                    axis.bar(x, value["mean"], width * 0.92, color=colour, alpha=0.9)
                    axis.plot([x, x], [value["low"], value["high"]], color="black", lw=0.9)
            if not axis.patches:
                axis.text(0.5, 0.5, "tree has too few samples", transform=axis.transAxes, ha="center", color="#555555")
            axis.axhline(1.0, color=COLOURS["tree"], lw=0.9, ls=":")
            axis.grid(axis="x", visible=False)
            axis.set(title=title, ylabel="over tree's")
            if what == "distance_at_equal_time":  # from half of tree's to hundreds of times
                axis.set_yscale("log")
        names = []
        for variable in scene["variables"]:
            fill = np.mean([instance["variables"][variable]["fill"] for instance in covered])
            names.append(f"{variable}\n{100 * fill:.0f} % filled")
        axes[-1].set_xticks(range(len(names)), names)
        handles = [plt.Rectangle((0, 0), 1, 1, color=colour, alpha=0.9) for colour in colours.values()]
        figure.legend(handles, list(colours), ncols=len(colours), loc="outside lower center")
        figure.suptitle(f"{scene['title']}: coverage\nwhiskers: 95 % bootstrap over instances and seeds")
        _save(figure, path)


def sweep(scene: Mapping[str, Any], path: Path) -> None:
    """Final rate against the price of time and against the exploration constant."""
    rates = scene["sweep"]["rates"]
    best = {
        instance: max(float(np.mean(by_instance[instance])) for by_instance in rates.values())
        for instance in next(iter(rates.values()))
    }
    used = [instance for instance, rate in best.items() if rate > 0]

    def share(label: str) -> tuple[float, float, float]:
        """Mean, least and greatest share of the best setting's rate."""
        shares = [float(np.mean(rates[label][i])) / best[i] for i in used] or [0.0]
        return float(np.mean(shares)), min(shares), max(shares)

    prices = sorted((float(label.split("=")[1]), label) for label in rates if label.startswith("price="))
    constants = [(float(label.split("=")[1]), label) for label in rates if label.startswith("c_uct=")]
    default = (scene["sweep"]["default_c_uct"], "price=1")
    if default[1] in rates:
        constants.append(default)
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.5), sharey=True, constrained_layout=True)
        for axis, entries in ((left, prices), (right, sorted(constants))):
            x = [number for number, _ in entries]
            middle, low, high = np.array([share(label) for _, label in entries]).T
            axis.plot(x, middle, "o-", color=COLOURS["tree"])
            axis.vlines(x, low, high, color=COLOURS["tree"], lw=1)
            axis.set_xscale("log")
        if "rollout" in rates:
            middle, _, _ = share("rollout")
            left.axhline(middle, color=COLOURS["tree-warm"], ls="--")
            left.annotate(
                "c = time per rollout", (0.03, middle), xycoords=("axes fraction", "data"), xytext=(0, 4),
                textcoords="offset points", color=COLOURS["tree-warm"],
            )  # fmt: skip
        left.axvline(1.0, color="#555555", lw=0.9, ls=":")
        left.annotate(
            "c = time per sample\n(ratio rule)", (1.0, 0.03), xycoords=("data", "axes fraction"), xytext=(5, 0),
            textcoords="offset points", fontsize=8,
        )  # fmt: skip
        right.axvline(default[0], color="#555555", lw=0.9, ls=":")
        right.annotate(
            "default", (default[0], 0.03), xycoords=("data", "axes fraction"), xytext=(5, 0),
            textcoords="offset points", fontsize=8,
        )  # fmt: skip
        left.set(
            xlabel="price of time over the realised rate: $(1-\\lambda)/\\lambda = c\\,/$factor",
            ylabel="final rate, share of the best setting",
            title="Reward: what a second costs",
        )
        right.set(xlabel="exploration constant c_uct", title="Exploration")
        left.set_ylim(0.0, 1.08)
        count = len(used)
        seeds = _number(scene["budget"]["sweep_seeds"], "seed")
        figure.suptitle(f"{scene['title']}: {_number(count, 'instance')}, {seeds}; bars: spread over instances")
        _save(figure, path)


TRIED = {
    "screened": (".", 4, "screened shortly"),
    "printed": ("s", 5, "found in the paper"),
    "experts": ("^", 5, "experts"),
    "found": ("o", 5, "best found, beside tree"),
}
"""Marker, its size and a title of the fixed sequences that were run."""


def oracle(scene: Mapping[str, Any], path: Path) -> None:
    """All sequences by predicted rate, and predicted against measured rates."""
    colours = plt.get_cmap("viridis")(np.linspace(0.0, 0.9, len(scene["oracle"])))
    by_number = {instance["instance"]: instance for instance in scene["instances"]}
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(10.5, 4.0), constrained_layout=True)
        points = []
        for entry, colour in zip(scene["oracle"], colours, strict=True):
            predicted = [rate for rate in entry["predicted"] if rate > 0]
            if not predicted:
                continue
            label = f"{entry['instance']}: {by_number[entry['instance']]['title']}"
            left.plot(np.arange(1, len(predicted) + 1), predicted, color=colour, lw=1.5, label=label)
            tree = float(np.mean(finals(by_number[entry["instance"]], "tree")))
            left.plot([0.85], [tree], ">", color=colour, ms=6, clip_on=False)
            for kind, (marker, size, _) in TRIED.items():
                for tried in [entry[kind]] if kind == "found" else entry[kind]:
                    if tried["predicted"] and tried["rate"] > 0:
                        points.append((tried["predicted"], tried["rate"]))
                        right.plot(tried["predicted"], tried["rate"], marker, color=colour, ms=size, alpha=0.7)
        left.set_xscale("log")
        left.set_yscale("log")
        left.set_xlim(left=0.85)
        left.set(
            xlabel="sequences, one of each that differ only in order; best first",
            ylabel="predicted samples/s",
            title="Predicted rates; arrow: tree's measured final rate",
        )
        left.legend(fontsize=8, loc="lower left")
        if points:
            low, high = np.min(points), np.max(points)
            right.plot([low, high], [low, high], color="#999999", lw=0.9, ls=":")
        for marker, _, label in TRIED.values():
            right.plot([], [], marker, color="#555555", label=label)
        right.set_xscale("log")
        right.set_yscale("log")
        right.set(xlabel="predicted samples/s", ylabel="measured samples/s", title="Predicted against measured")
        right.legend(fontsize=8)
        figure.suptitle(f"{scene['title']}: fixed sequences")
        _save(figure, path)


def _number(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=150)
    plt.close(figure)
