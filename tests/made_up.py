"""Runs of a study that were never made."""

import tomllib
from pathlib import Path

import numpy as np

from cgs_jax.experiments import runs
from cgs_jax.uct import Tree

PAPER = tomllib.loads((Path(__file__).parents[1] / "scripts" / "reproduce.toml").read_text())["scenes"]
RATES = {"tree": 400.0, "tree-warm": 420.0, "expert1": 40.0, "expert2": 100.0, "expert3": 300.0, "rand": 20.0}
RATES["best expert"] = RATES["expert3"]


def run(problem, chooser, run, settings=None, keep_values=False, keep_tree=False, scale=1.0):
    """A run that finds samples steadily, at the rate of its method and instance."""
    random = np.random.default_rng([run.seed, run.instance, len(run.method)])
    rate = scale * RATES.get(run.method, 200.0) * (1.0 + run.instance)
    elapsed = np.arange(1, int(rate * run.seconds) + 1) / rate
    path = next(problem.transitions.sequences())
    text = problem.transitions.format(path)
    tree = Tree(problem.transitions)
    for sequence in runs.covering_sequences(problem.transitions):
        for position, transition in enumerate(sequence):
            tree.record(sequence[:position], transition, 100, 50, 0.01 * len(transition.new))
    operators, tries = {}, {}
    for entry in PAPER[run.scene].get("operations", []):
        if entry["sequence"] == run.method:
            name = runs.operation_name(problem.transitions, entry["sequence"], entry["new"])
            operators[name] = {"microseconds_per_task": 3.0 * len(entry["new"]), "device_seconds": 1.0}
            tries[name] = [1000, 1000 - 100 * len(entry["new"])]
    data = {
        "meta": {"startup_seconds": 0.4, "compile_seconds": 7.0, "rejected_by_audit": 0},
        "max_violation": 3e-5,
        "sequences": {text: len(elapsed)},
        "best_sequences": [[text, rate]],
        "operators": operators,
        "first_tries": tries,
    }
    if keep_tree:
        data["tree"] = tree.as_json()
    values = {}
    for variable in problem.graph.variables if keep_values else ():
        value = random.uniform(-1.0, 1.0, (len(elapsed), 7)).astype(np.float32)
        if variable.kind == "pose":
            value[:, 3:] /= np.linalg.norm(value[:, 3:], axis=1, keepdims=True)
        values[variable.name] = value
    return runs.Kept(data, elapsed, values)


def run_in_turns(problem, choosers, runs, settings=None, scale=1.0):
    """Runs side by side that were never made."""
    return [run(problem, chooser, one, settings, scale=scale) for chooser, one in zip(choosers, runs, strict=True)]
