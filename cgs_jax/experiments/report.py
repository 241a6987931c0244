"""report.md, figures and results.json of a study."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cgs_jax.experiments import claims, figures, measures
from cgs_jax.experiments.study import Study
from cgs_jax.record import write_json

FIGURES = ("rates", "instances", "coverage", "sweep", "oracle")


def write_report(study: Study, command: str) -> Path:
    """Writes results.json, the figures and report.md into the study's folder; returns the report's path."""
    numbers = study.all_numbers
    confronted = claims.confront(numbers)
    write_json(study.folder / "results.json", numbers | {"claims": [vars(claim) for claim in confronted]})
    for name, scene in numbers["scenes"].items():
        for figure in FIGURES:
            if has_figure(scene, figure):
                getattr(figures, figure)(scene, study.folder / f"{name}_{figure}.png")
    path = study.folder / "report.md"
    path.write_text(text(numbers, confronted, command), encoding="utf-8")
    return path


def has_figure(scene: Mapping[str, Any], figure: str) -> bool:
    """Whether there is anything to draw."""
    if figure == "coverage":
        return any(instance["coverage"] for instance in scene["instances"])
    return bool(scene["sweep"]["rates"]) if figure == "sweep" else bool(scene["oracle"]) or figure != "oracle"


def text(numbers: Mapping[str, Any], confronted: Sequence[claims.Claim], command: str) -> str:
    """The report in Markdown."""
    scenes = list(numbers["scenes"].values())
    parts = [
        "# The paper's experiments on this implementation",
        f"Made by `{command}` on {_machine()}. Rates are samples per second of sampling time with all programs "
        "compiled and read; what that takes is listed apart. *Final rate*: over the last half of a run. Every sample counted "
        "passed the audit in double precision. Brackets are 95 % bootstrap intervals over seeds. The machine's speed "
        "changes: where tree is measured against single sequences they ran *side by side*, a second each in turn, once tree "
        "has settled, and final rates are those of the last half of that time; other methods are compared over the seeds that "
        "both have, whose runs were made one after the other. "
        "The paper's numbers were measured on an Intel i5-4200U at 1.6 GHz; ratios between machines say little.",
        "## Claims",
        _claims(confronted),
        "## Table I: transitions",
        _counts(numbers["counts"]),
        "## Table II: sequences",
        *(_sequences(scene) for scene in scenes),
    ]
    operations = [scene for scene in scenes if scene["operations"]]
    if operations:
        parts += ["## Operations", *(_operations(scene) for scene in operations)]
    for scene in scenes:
        parts += [f"## {scene['title']} ({scene['scene']})", *_scene(scene)]
    return "\n\n".join(parts) + "\n"


def table(head: Sequence[str], rows: Iterable[Sequence[Any]], texts: int = 1) -> str:
    """A Markdown table; the first `texts` columns are left aligned, the others right."""
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * texts + " ---: |" * (len(head) - texts)]
    lines += ["| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def listed(numbers: Sequence[int], what: str) -> str:
    """For instance "instances 0, 2"."""
    return f"{what}{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"


def number(value: float | None) -> str:
    """Three digits that mean something; a dash for nothing."""
    if value is None:
        return "–"
    if abs(value) >= 100:
        return f"{value:.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def ratio(entry: Mapping[str, float | None]) -> str:
    if entry["ratio"] is None:
        return "–"
    return f"{entry['ratio']:.2f} [{entry['low']:.2f}, {entry['high']:.2f}]"


def _claims(confronted: Sequence[claims.Claim]) -> str:
    words = {True: "yes", False: "**no**", None: "not told"}
    rows = [[claim.text, claim.source, words[claim.passed], claim.reason] for claim in confronted]
    return table(["Claim", "From", "Holds", "Measured"], rows, texts=4)


def _counts(counts: Mapping[str, Any]) -> str:
    head = ["", "complete", "paper", "pruned", "paper", "ratio", "conditional problems", "complete sequences"]
    rows = []
    for name, entry in counts.items():
        printed = entry["paper"] or ("–", "–")
        share = f"{100 * entry['pruned'] / entry['complete']:.1f} %"
        ours = entry["complete"], printed[0], entry["pruned"], printed[1]
        rows.append([name, *ours, share, entry["problems"], entry["sequences"]])
    return table(head, rows)


def _sequences(scene: Mapping[str, Any]) -> str:
    """Final rates averaged over instances; of sequences run on some instances only, over those."""
    rows = []

    def row(name: str, sequence: str, rates: Sequence[float], where: str) -> None:
        value = number(float(np.mean(rates))) if rates else "–"
        rows.append([f"{scene['scene']}: {name}", f"`{sequence}`" if sequence else "", value, where])

    everywhere = f"all {len(scene['instances'])} instances run"
    for name, sequence in scene["sequences"].items():
        row(name, sequence, [r for i in scene["instances"] for r in claims.finals(i, name)], everywhere)
    row("rand", "", [r for i in scene["instances"] for r in claims.finals(i, "rand")], everywhere)
    row("tree", "", [r for i in scene["instances"] for r in claims.finals(i, "tree")], everywhere)
    for position, sequence in enumerate(scene["paper"].get("found", ())):
        rates = [oracle["printed"][position]["rate"] for oracle in scene["oracle"]]
        row("found by the paper's tree", sequence, rates, listed([o["instance"] for o in scene["oracle"]], "instance"))
    fixed: dict[str, list[tuple[int, float]]] = {}
    for entry in claims.oracle_ratios(scene):
        fixed.setdefault(entry["sequence"], []).append((entry["instance"], entry["rate"]))
    for sequence, found in fixed.items():
        where = listed([instance for instance, _ in found], "instance")
        row("best of all fixed sequences, beside tree", sequence, [rate for _, rate in found], where)
    by_tree: dict[str, list[tuple[int, float]]] = {}
    for instance in scene["instances"]:
        best = [seed[0] for seed in instance["methods"]["tree"]["best"] if seed]
        if best:
            sequence, _ = max(best, key=lambda pair: pair[1])
            rate = float(np.mean(claims.finals(instance, "tree")))
            by_tree.setdefault(sequence, []).append((instance["instance"], rate))
    for sequence, found in by_tree.items():
        where = listed([instance for instance, _ in found], "instance")
        row("best found by tree (rate: tree's)", sequence, [rate for _, rate in found], where)
    return table(["", "sequence", "final samples/s", "mean over"], rows, texts=2)


def _operations(scene: Mapping[str, Any]) -> str:
    rows = [
        [
            entry["title"],
            f"`{entry['operator']}`",
            number(entry["measured_microseconds"]),
            number(1e3 * entry["milliseconds"]),
            "–" if entry["measured_success"] is None else f"{100 * entry['measured_success']:.0f} %",
            f"{100 * entry['success']:.0f} %",
            "–" if entry["condition_feasible"] is None else f"{100 * entry['condition_feasible']:.0f} %",
            "–" if entry["solver_success"] is None else f"{100 * entry['solver_success']:.0f} %",
            entry["lanes"],
        ]
        for entry in scene["operations"]
    ]
    head = ["Operation", "operator", "µs per lane", "paper, µs", "success", "paper"]
    head += ["condition feasible", "success where feasible", "lanes"]
    note = (
        f"{scene['scene']}, first instance; one worker, clearance included; success of each lane's first try. Conditions "
        "are those that the sequence makes, some of which admit no solution: second tries of failed conditions tell "
        "the two factors of the paper's Eq. 2 apart. Which variables the paper's pick and place has is not printed."
    )
    return table(head, rows, texts=2) + "\n\n" + note


def _scene(scene: Mapping[str, Any]) -> list[str]:
    name = scene["scene"]
    parts = [
        "### Sample rates",
        f"![rate over time]({name}_rates.png)",
        f"![final rate by instance]({name}_instances.png)",
        _rates(scene),
        _experts(scene),
        "### Compile time",
        _compile(scene),
        "### Warm start",
        "Leave one out: tree-warm starts from the trees of the other instances, same seed.",
        _warm(scene),
    ]
    if has_figure(scene, "coverage"):
        parts += ["### Coverage", f"![coverage]({name}_coverage.png)", *_coverage(scene)]
    if has_figure(scene, "sweep"):
        parts += ["### Reward and exploration", f"![sweep]({name}_sweep.png)", _sweep(scene)]
    if has_figure(scene, "oracle"):
        parts += ["### Oracle", f"![oracle]({name}_oracle.png)", _oracle(scene)]
    return parts


def _rates(scene: Mapping[str, Any]) -> str:
    methods = figures.methods_of(scene)
    rows = []
    for instance in scene["instances"]:
        cells = []
        for method in methods:
            rates = claims.finals(instance, method)
            cells.append(f"{number(float(np.mean(rates)))} ± {number(float(np.std(rates)))}" if rates else "–")
        rows.append([f"{instance['instance']}: {instance['title']}", *cells])
    return "Final samples/s, mean ± standard deviation over seeds:\n\n" + table(["Instance", *methods], rows)


def _experts(scene: Mapping[str, Any]) -> str:
    rows = []
    for entry, instance in zip(claims.expert_ratios(scene), scene["instances"], strict=True):
        focus = [share for share in instance["methods"]["tree"]["focus"] if share is not None]
        share = f"{100 * np.mean(focus):.0f} %" if focus else "–"
        rows.append([f"{entry['instance']}: {instance['title']}", entry["expert"], ratio(entry), share])
    head = ["Instance", "best expert", "tree over it", "tree's device time in its best sequence's operators"]
    budget = scene["budget"]
    note = (
        f"Side by side with the best expert of the runs above, {budget['turns_seconds']:g} s each, after "
        f"{budget['settling_seconds']:g} s in which tree settled alone; {budget['turns_seeds']} seeds:\n\n"
    )
    return note + table(head, rows)


def _compile(scene: Mapping[str, Any]) -> str:
    programs, seconds = scene["preparation"]["programs"], scene["preparation"]["seconds"]
    first = programs[0]["instance"] if programs else 0
    later = [program for program in programs if program["instance"] != first]
    rows = [[program["name"], number(program["seconds"]), program["instance"]] for program in programs]
    total = sum(program["seconds"] for program in programs)
    startup = [s for i in scene["instances"] for s in i["methods"]["tree"]["startup"]]
    note = (
        f"{len(programs)} programs, {total:.0f} s on one thread, once per machine (they are kept on disk); "
        f"{'none' if not later else len(later)} for instances after the first. "
        "All of it is done before any run: with programs compiled and read by this process and its workers, and seed tables "
        f"made, the first instance was ready after {seconds[0]:.1f} s"
    )
    if seconds[1:]:
        note += f" and every further one after {np.mean(seconds[1:]):.1f} s more"
    note += f". A run of tree then starts sampling after {np.mean(startup):.2f} s."
    return table(["Program", "seconds", "first needed by instance"], rows) + "\n\n" + note


def _warm(scene: Mapping[str, Any]) -> str:
    rows = []
    early = np.array(scene["times"]) <= claims.EARLY_SECONDS
    for instance in scene["instances"]:
        cells = []
        for method in ("tree", "tree-warm"):
            if method not in instance["methods"]:
                cells += ["–"] * 3
                continue
            curve = np.array(instance["methods"][method]["curve"])
            at = claims.up_to_speed(instance, scene["times"], method)
            cells += [
                number(float(curve[early].mean())),
                number(float(np.mean(claims.finals(instance, method)))),
                "–" if at is None else f"{at:.1f} s",
            ]
        rows.append([f"{instance['instance']}: {instance['title']}", *cells])
    seconds = f"{claims.EARLY_SECONDS:.0f}"
    head = ["Instance"]
    for method in ("tree", "warm"):
        head += [f"{method}: first {seconds} s", f"{method}: final", f"{method}: {claims.UP_TO_SPEED} of final at"]
    return table(head, rows)


def _coverage(scene: Mapping[str, Any]) -> list[str]:
    covered = [instance["coverage"] for instance in scene["instances"] if instance["coverage"]]
    methods = figures.methods_of(scene)
    parts = []
    titles = {
        "cells_at_equal_time": "Occupied cells at equal time, over tree's",
        "cells_at_equal_count": "Occupied cells at equal count, over tree's",
        "distance_at_equal_time": "Distance from held-out samples to the nearest sample (0.9 quantile), over tree's",
        "radius_at_equal_time": "Cover radius (greatest such distance), over tree's",
        "radius_at_equal_count": "Cover radius at equal count, over tree's",
    }
    for what, title in titles.items():
        rows = []
        for variable in scene["variables"]:
            cells = []
            for method in methods:
                ratios = measures.relative_to_tree(covered, variable, method, what)
                if not ratios:
                    cells.append("–")
                    continue
                value = measures.mean_with_interval(ratios)
                cells.append(f"{value['mean']:.2f} [{value['low']:.2f}, {value['high']:.2f}]")
            rows.append([variable, *cells])
        parts.append(f"{title}:\n\n" + table(["Variable", *methods], rows))
    first = covered[0]
    rows = [
        [
            variable,
            first["variables"][variable]["cell"],
            ", ".join(f"{100 * instance['variables'][variable]['fill']:.0f}" for instance in covered),
        ]
        for variable in scene["variables"]
    ]
    at = next(instance["instance"] for instance in scene["instances"] if instance["coverage"])
    head = ["Variable", f"cell on instance {at}", "% of the reference's cells filled by tree"]
    sizes = ", ".join(str(instance["reference"]) for instance in covered)
    counts = ", ".join(str(instance["count"]) for instance in covered)
    parts.append(table(head, rows))
    parts.append(
        "Cells are fitted for each instance and variable so that tree fills 20 to 60 % of the cells of the reference: "
        f"held-out runs of all methods together ({sizes} samples). Equal count: {counts} samples; methods with fewer "
        f"than {scene['budget']['coverage_least']} take no part in it. Distances of poses count 0.2 m per radian."
    )
    return parts


def _sweep(scene: Mapping[str, Any]) -> str:
    rates = scene["sweep"]["rates"]
    instances = list(next(iter(rates.values())))
    names = {"price=1": f"default: ratio rule, c_uct {scene['sweep']['default_c_uct']:g}"}
    names["rollout"] = "c = seconds per rollout"
    rows = [
        [
            names.get(label) or label.replace("price=", "price of time × ").replace("c_uct=", "c_uct "),
            *(number(float(np.mean(rates[label][i]))) for i in instances),
        ]
        for label in rates
    ]
    budget = scene["budget"]
    how = f"Side by side, {budget['seconds']:g} s each, mean over seeds ({budget['sweep_seeds']}), samples/s:\n\n"
    return how + table(["Setting", *(f"instance {i}" for i in instances)], rows)


def _oracle(scene: Mapping[str, Any]) -> str:
    rows = []
    for entry, oracle in zip(claims.oracle_ratios(scene), scene["oracle"], strict=True):
        rows.append(
            [
                entry["instance"],
                f"{oracle['distinct']} of {oracle['sequences']}",
                f"`{entry['sequence']}`",
                entry["label"],
                number(entry["rate"]),
                _trust(oracle["screened"]),
                ratio(entry),
            ]
        )
    head = ["Instance", "distinct of all", "best fixed sequence run", "chosen as"]
    head += ["measured", "trust", "tree over it"]
    note = (
        "Rates of all complete sequences are predicted from the operators' statistics (tree and survey); of sequences "
        "that differ only in the order of independent operators one is kept. The best predicted ones are screened shortly, "
        "and so are the sequences that the paper found; the best of all these (*best found*) and the best expert are run "
        "side by side with the tree once it has settled, with the same pools and retries: the last column is its regret. "
        "*Trust*: measured over predicted rate of the screened ones, median."
    )
    return table(head, rows) + "\n\n" + note


def _trust(screened: Sequence[Mapping[str, Any]]) -> str:
    shares = [entry["rate"] / entry["predicted"] for entry in screened if entry["predicted"]]
    return number(float(np.median(shares))) if shares else "–"


def _machine() -> str:
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return f"{os.cpu_count()} cores of {model}, {platform.system()}, Python {platform.python_version()}"
