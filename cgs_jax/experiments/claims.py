"""The paper's claims and the project's own marks, each confronted with the numbers: passed or not, and why."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgs_jax.experiments import measures

UP_TO_SPEED = 0.9
EARLY_SECONDS = 2.0


@dataclass(frozen=True)
class Claim:
    """One claim. passed: None where the runs do not tell. reason: what was measured, in words."""

    text: str
    source: str
    passed: bool | None
    reason: str


def confront(numbers: Mapping[str, Any]) -> list[Claim]:
    """All claims about the scenes that were run."""
    scenes = list(numbers["scenes"].values())
    claims = [_counts(numbers["counts"])]
    claims += [_operations(scene) for scene in scenes if scene["operations"]]
    claims += [_absolute_rate(scene) for scene in scenes]
    claims += [_against_expert(scenes), _average_over_expert(scenes), _against_random(scenes), _against_oracle(scenes)]
    claims += [_starts_below(scene) for scene in scenes]
    claims += [_warm(scenes), _warm_starts_higher(scenes)]
    claims += [_sensitive(scene) for scene in scenes]
    claims += [_orders_differ(scene) for scene in scenes]
    for scene in scenes:
        claims += _coverage(scene)
    claims += _coverage_of_all(scenes) if len(scenes) > 1 else []
    claims.append(_audited(scenes))
    return claims


def finals(instance: Mapping[str, Any], method: str) -> list[float]:
    """Final rates of a method on an instance, by seed; empty where it was not run."""
    return instance["methods"].get(method, {}).get("final", [])


def expert_ratios(scene: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Per instance: the best expert and tree's final rate over its, side by side, with interval."""
    return [
        {
            "instance": turns["instance"],
            "expert": turns["expert"],
            **measures.ratio_with_interval(turns["final"]["tree"], turns["final"]["best expert"]),
        }
        for turns in scene["turns"]
    ]


def oracle_ratios(scene: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Per instance with an oracle: the best fixed sequence of those that ran beside tree, and tree's rate over its, with
    interval."""
    result = []
    for turns in scene["turns"]:
        final = {label: rates for label, rates in turns["final"].items() if label != "tree"}
        if "best found" not in final:
            continue
        best = max(final, key=lambda label: np.mean(final[label]))
        result.append(
            {
                "instance": turns["instance"],
                "label": best,
                "sequence": turns["sequences"][best],
                "rate": float(np.mean(final[best])),
                **measures.ratio_with_interval(turns["final"]["tree"], final[best]),
            }
        )
    return result


def up_to_speed(instance: Mapping[str, Any], times: Sequence[float], method: str) -> float | None:
    """First time at which the mean rate over seeds is `UP_TO_SPEED` of the method's final rate."""
    final = float(np.mean(finals(instance, method))) if finals(instance, method) else 0.0
    if not final:
        return None
    curve = np.array(instance["methods"][method]["curve"])
    return measures.first_time_at(curve, np.array(times), UP_TO_SPEED * final)


def mean_curve(scene: Mapping[str, Any], method: str) -> np.ndarray | None:
    """Rate over time, mean over instances and the seeds that ran beside the experts; None where it was not run on all."""
    curves = [i["methods"][method]["curve_beside"] for i in scene["instances"] if method in i["methods"]]
    return np.mean(curves, axis=0) if len(curves) == len(scene["instances"]) else None


def _counts(counts: Mapping[str, Any]) -> Claim:
    ours = {name: [entry["complete"], entry["pruned"]] for name, entry in counts.items() if entry["paper"]}
    same = all(ours[name] == list(counts[name]["paper"]) for name in ours)
    text = "; ".join(f"{name} {complete} to {pruned}" for name, (complete, pruned) in ours.items())
    return Claim("Pruning leaves the number of transitions of Table I", "paper, Table I", same, text)


def _operations(scene: Mapping[str, Any]) -> Claim:
    known = [entry for entry in scene["operations"] if entry["measured_microseconds"]]
    times = [entry["measured_microseconds"] for entry in known]
    successes = [entry["measured_success"] for entry in known]
    printed = [entry["milliseconds"] for entry in known]
    in_order = bool((np.argsort(printed) == np.argsort(times)).all())
    falling = all(a >= b for a, b in zip(successes, successes[1:], strict=False))
    speedups = [1e3 * ms / us for ms, us in zip(printed, times, strict=True)]
    return Claim(
        f"{scene['scene']}: larger operations are slower and succeed less often",
        "paper, Computation operations",
        in_order and falling if known else None,
        f"times in the paper's order: {_yes(in_order)}; success falling: {_yes(falling)}"
        + "".join(map(_out_of_order, known, known[1:]))
        + (f"; {min(speedups):.0f} to {max(speedups):.0f} times the paper's speed per lane" if speedups else ""),
    )


def _out_of_order(smaller: Mapping[str, Any], larger: Mapping[str, Any]) -> str:
    """Why an operation succeeds less often than the next larger one, as far as the runs tell; nothing where it does not."""
    if smaller["measured_success"] >= larger["measured_success"]:
        return ""
    text = f", {smaller['title']} {smaller['measured_success']:.0%} below {larger['title']} {larger['measured_success']:.0%}"
    if smaller["condition_feasible"] is not None:
        text += f" ({smaller['condition_feasible']:.0%} of its conditions admit a solution)"
    return text


def _absolute_rate(scene: Mapping[str, Any]) -> Claim:
    printed = scene["paper"].get("tree_warm_rate")
    method = "tree-warm" if any(finals(i, "tree-warm") for i in scene["instances"]) else "tree"
    rates = [float(np.mean(finals(i, method))) for i in scene["instances"]]
    low, high = min(rates), max(rates)
    return Claim(
        f"{scene['scene']}: final rate of tree-warm at least the paper's",
        "paper, Number of samples",
        low >= printed[0] if printed else None,
        f"{method} {low:.0f} to {high:.0f} samples/s over the instances"
        + (f", paper {printed[0]} to {printed[1]} (another machine)" if printed else ""),
    )


def _against_expert(scenes: Sequence[Mapping[str, Any]]) -> Claim:
    entries = [(scene["scene"], entry) for scene in scenes for entry in expert_ratios(scene)]
    failed = [(name, e) for name, e in entries if e["ratio"] is not None and e["ratio"] < 0.95]
    unsure = [e for _, e in entries if e["ratio"] is not None and e["ratio"] >= 0.95 > e["low"]]
    reason = f"{len(entries) - len(failed)} of {len(entries)} instances"
    if failed:
        reason += "; below on "
        reason += ", ".join(f"{name} {e['instance']} ({e['ratio']:.2f} of {e['expert']})" for name, e in failed)
    if unsure:
        reason += f"; on {len(unsure)} more the interval reaches below 0.95"
    claim = "Tree's final rate at least 0.95 of the best expert's on every instance"
    return Claim(claim, "project", not failed, reason)


def _average_over_expert(scenes: Sequence[Mapping[str, Any]]) -> Claim:
    ratios = [e["ratio"] for scene in scenes for e in expert_ratios(scene) if e["ratio"] is not None]
    claim = "Tree's final rate 1.3 of the best expert's on average (asymptotically tree outperforms all experts)"
    if not ratios:
        return Claim(claim, "paper and project", None, "no expert found a sample")
    mean = measures.mean_with_interval(ratios)
    return Claim(
        claim,
        "paper and project",
        mean["mean"] >= 1.3,
        f"{mean['mean']:.2f} [{mean['low']:.2f}, {mean['high']:.2f}] over {len(ratios)} instances",
    )


def _against_random(scenes: Sequence[Mapping[str, Any]]) -> Claim:
    pairs = [(np.mean(finals(i, "tree")), np.mean(finals(i, "rand"))) for s in scenes for i in s["instances"]]
    won = int(sum(tree > rand for tree, rand in pairs))
    return Claim("Tree beats rand on every instance", "paper", won == len(pairs), f"{won} of {len(pairs)} instances")


def _against_oracle(scenes: Sequence[Mapping[str, Any]]) -> Claim:
    entries = [(scene["scene"], e) for scene in scenes for e in oracle_ratios(scene) if e["ratio"] is not None]
    claim = "Tree's final rate at least 0.9 of the best fixed sequence's, found by any means, on average over the instances"
    if not entries:
        return Claim(claim, "project", None, "no fixed sequence found a sample")
    mean = measures.mean_with_interval([e["ratio"] for _, e in entries])
    below = ", ".join(f"{name} {e['instance']} ({e['ratio']:.2f})" for name, e in entries if e["ratio"] < 0.9)
    return Claim(
        claim,
        "project",
        mean["mean"] >= 0.9,
        f"mean {mean['mean']:.2f} [{mean['low']:.2f}, {mean['high']:.2f}] over {len(entries)} instances"
        + (f"; below on {below}" if below else ""),
    )


def _starts_below(scene: Mapping[str, Any]) -> Claim:
    times = np.array(scene["times"])
    tree = mean_curve(scene, "tree")
    experts = {name: mean_curve(scene, name) for name in scene["sequences"]}
    best = max(experts, key=lambda name: experts[name][len(times) // 2 :].mean())
    at = min(9, len(times) - 1)
    early = max(experts, key=lambda name: experts[name][at])
    below = bool(tree[at] < experts[early][at])
    when = measures.time_of_overtaking(tree, experts[best], times)
    overtakes = "never for good within the budget" if when is None else f"for good at {when:.1f} s"
    return Claim(
        f"{scene['scene']}: tree starts below the best expert and overtakes it",
        "paper, Number of samples",
        below and when is not None,
        f"over the first {times[at]:.0f} s tree {tree[at]:.0f}, {early} {experts[early][at]:.0f} samples/s; "
        f"tree overtakes {best} {overtakes}",
    )


def _warm(scenes: Sequence[Mapping[str, Any]]) -> Claim:
    reached = [
        (scene["scene"], instance["instance"], up_to_speed(instance, scene["times"], "tree-warm"))
        for scene in scenes
        for instance in scene["instances"]
        if "tree-warm" in instance["methods"]
    ]
    late = [(name, i, t) for name, i, t in reached if t is None or t > EARLY_SECONDS]
    text = f"{len(reached) - len(late)} of {len(reached)} instances"
    if late:
        text += "; later on " + ", ".join(f"{n} {i} ({'never' if t is None else f'{t:.1f} s'})" for n, i, t in late)
    return Claim(
        f"Tree-warm reaches {UP_TO_SPEED} of its final rate within {EARLY_SECONDS:.0f} s on 14 of 16 instances",
        "project",
        len(late) <= len(reached) / 8 if reached else None,
        text,
    )


def _warm_starts_higher(scenes: Sequence[Mapping[str, Any]]) -> Claim:
    pairs = []
    for scene in scenes:
        early = np.array(scene["times"]) <= EARLY_SECONDS
        for instance in scene["instances"]:
            if "tree-warm" in instance["methods"]:
                curves = [np.array(instance["methods"][m]["curve"])[early].mean() for m in ("tree-warm", "tree")]
                pairs.append(curves)
    won = sum(warm > cold for warm, cold in pairs)
    warm, cold = np.mean(pairs, axis=0).tolist() if pairs else (0.0, 0.0)
    return Claim(
        "Warm start lifts the rate at the beginning",
        "paper, Number of samples",
        warm > cold if pairs else None,
        f"over the first {EARLY_SECONDS:.0f} s {warm:.0f} against {cold:.0f} samples/s; "
        f"higher on {won} of {len(pairs)} instances",
    )


def _sensitive(scene: Mapping[str, Any]) -> Claim:
    spread = {}
    for method in ("tree", *scene["sequences"]):
        spread[method] = measures.variation([float(np.mean(finals(i, method))) for i in scene["instances"]])
    others = [value for method, value in spread.items() if method != "tree" and value is not None]
    if len(scene["instances"]) < 2 or spread["tree"] is None or not others:
        passed = None
    else:
        passed = spread["tree"] < min(others)
    text = ", ".join(f"{method} {'no samples' if v is None else f'{v:.2f}'}" for method, v in spread.items())
    return Claim(
        f"{scene['scene']}: experts are more sensitive to the instance than tree",
        "paper, Number of samples",
        passed,
        f"standard deviation over mean of the final rate over instances: {text}",
    )


def _orders_differ(scene: Mapping[str, Any]) -> Claim:
    best = [i["methods"]["tree"]["best"] for i in scene["instances"]]
    first = {seeds[0][0][0] for seeds in best if seeds and seeds[0]}
    experts = {entry["expert"] for entry in expert_ratios(scene)}
    return Claim(
        f"{scene['scene']}: the best sequence differs by instance",
        "paper, Scenarios",
        len(first) > 1 if len(scene["instances"]) > 1 else None,
        f"{len(first)} different best sequences of tree over {len(scene['instances'])} instances; "
        f"best expert: {', '.join(sorted(experts))}",
    )


def _coverage(scene: Mapping[str, Any]) -> list[Claim]:
    instances = [i["coverage"] for i in scene["instances"] if i["coverage"]]
    if not instances:
        claim = f"{scene['scene']}: tree's projected coverage is at least every expert's on average"
        return [Claim(claim, "paper, Approximate Coverage", None, "a run of tree has no samples")]
    joint = next(iter(scene["sequences"]))
    ratios = _covered(scene, joint)
    unsaturated = [v for v in ratios if all(i["variables"][v]["fill_as_wanted"] for i in instances) and ratios[v]]
    value = float(np.mean([np.mean(ratios[v]) for v in unsaturated])) if unsaturated else None
    one = _covers_as_much(scene["scene"], "paper, Approximate Coverage", [scene], scene["sequences"])
    two = Claim(
        f"{scene['scene']}: tree covers 1.5 times the cells of the joint expert where cells are not saturated",
        "project",
        None if value is None else value <= 1 / 1.5,
        "no variable has cells that tree fills to 20-60 % everywhere"
        if value is None
        else f"{joint} covers {value:.2f} of tree's cells on those variables",
    )
    return [one, two]


def _coverage_of_all(scenes: Sequence[Mapping[str, Any]]) -> list[Claim]:
    """Over the instances of all scenes, for the experts that all scenes have (Table II: the same three kinds)."""
    covered = [scene for scene in scenes if any(instance["coverage"] for instance in scene["instances"])]
    common = [method for method in scenes[0]["sequences"] if all(method in scene["sequences"] for scene in scenes)]
    return [_covers_as_much("all scenes", "project", covered, common)] if covered == list(scenes) and common else []


def _covers_as_much(where: str, source: str, scenes: Sequence[Mapping[str, Any]], methods: Iterable[str]) -> Claim:
    means, texts = [], []
    for method in methods:
        # Instances and seeds in the same order for all variables: a run counts once.
        runs = [np.mean([r for r in _covered(scene, method).values() if r] or [[0.0]], axis=0) for scene in scenes]
        mean = measures.mean_with_interval(np.concatenate(runs))
        means.append(mean["mean"])
        texts.append(f"{method} {mean['mean']:.2f} [{mean['low']:.2f}, {mean['high']:.2f}]")
    return Claim(
        f"{where}: at equal time, tree's projected coverage is at least every expert's on average",
        source,
        max(means) <= 1.0,
        f"over tree's, mean over variables, instances and seeds: {', '.join(texts)}",
    )


def _covered(scene: Mapping[str, Any], method: str) -> dict[str, list[float]]:
    """By variable, the cells that a method's runs occupy at equal time over tree's."""
    instances = [instance["coverage"] for instance in scene["instances"] if instance["coverage"]]
    return {v: measures.relative_to_tree(instances, v, method, "cells_at_equal_time") for v in scene["variables"]}


def _audited(scenes: Sequence[Mapping[str, Any]]) -> Claim:
    total = sum(scene["audited"]["samples"] for scene in scenes)
    rejected = sum(scene["audited"]["rejected"] for scene in scenes)
    worst = max((scene["audited"]["max_violation"] for scene in scenes), default=0.0)
    return Claim(
        "Every sample behind a figure passed the audit in double precision",
        "project",
        worst <= 1e-4,
        f"{total} samples, greatest violation {worst:.1e} m or rad; {rejected} more were rejected and count nowhere",
    )


def _yes(value: bool) -> str:
    return "yes" if value else "no"
