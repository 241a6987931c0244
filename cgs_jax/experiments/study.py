"""The whole study: which runs there are, running those that are missing, and the numbers that come out.

Stages, in order, each for all scenes before the next. compile: all programs. main: tree, the experts, rand. warm: tree
with the statistics of the other instances; seed by seed beside main, so that an early look sees every scene. reference:
held-out samples for coverage. survey: every operator. screen: the sequences that the operators' statistics predict to be
best, shortly. printed: those that the paper found. turns: tree, the best expert and the best sequence found. operations:
single conditional operators. sweep: price of time and exploration constant. What is compared in turns and sweep runs side by
side.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path as File
from typing import Any

import numpy as np

from cgs_jax.api import make_chooser
from cgs_jax.errors import InputError
from cgs_jax.experiments import measures
from cgs_jax.experiments.runs import (
    Run,
    Store,
    Survey,
    execute,
    execute_in_turns,
    merged_tree,
    operation_name,
    prepare,
    priced_tree,
    ranked_sequences,
    signature,
)
from cgs_jax.problems import Problem, load_problem
from cgs_jax.record import operator_text, write_json
from cgs_jax.sampler import SamplerSettings
from cgs_jax.transitions import Path
from cgs_jax.uct import Chooser, Tree
from cgs_jax.worker import keep

RUN_OVERHEAD = 0.4
"""Seconds that a run takes beyond its sampling time (set-up, tree, files); for the estimate."""

COMPILE_PER_OPERATOR = 0.5
"""Seconds to make a scene ready on two cores, per conditional problem (they share programs); for the estimate."""

SIDE_BY_SIDE = "turns", "sweep"
"""Stages whose runs of a seed on an instance take turns."""

HELD_OUT = 1000
"""Seed of the runs that make the reference set; no other run has it."""


@dataclass(frozen=True)
class Budget:
    """How much is run. Times in seconds of sampling, per run."""

    seconds: float
    seeds: int
    instances: int | None = None  # None: all
    expert_seeds: int = 2  # of the experts, which learn nothing and differ little between seeds
    rand_seeds: int = 1  # of `rand`, which no claim compares closely
    reference_seconds: float = 4.0
    coverage_least: int = 200  # samples that a method needs for the comparison at equal count
    sweep_instances: int = 2
    sweep_seeds: int = 2
    prices: tuple[float, ...] = (0.1, 1.0, 10.0)
    exploration: tuple[float, ...] = (0.02, 0.1, 0.5)
    oracle_instances: int | None = None
    survey_seconds_per_operator: float = 0.1
    screened: int = 12
    screen_seconds: float = 1.5
    printed_seconds: float = 4.0
    settling_seconds: float = 15.0  # of tree, before the best sequences run beside it
    turns_seconds: float = 8.0  # of tree and the best sequences side by side
    turns_seeds: int = 3
    operation_seconds: float = 4.0


QUICK = Budget(
    seconds=2.0,
    seeds=1,
    instances=2,
    reference_seconds=2.0,
    coverage_least=50,
    sweep_instances=1,
    sweep_seeds=1,
    exploration=(0.02, 0.5),
    oracle_instances=1,
    screened=8,
    screen_seconds=1.0,
    printed_seconds=2.0,
    settling_seconds=2.0,
    turns_seconds=2.0,
    turns_seeds=1,
    operation_seconds=2.0,
)

FULL = Budget(seconds=10.0, seeds=5)


@dataclass(frozen=True)
class Progress:
    """Before each run: what comes next, and how many seconds of the estimate are behind us."""

    title: str
    done: float
    total: float


class Study:
    """One folder with all runs of some scenes. paper: what is printed there, by scene (`scripts/reproduce.toml`)."""

    def __init__(
        self,
        folder: File,
        scenes: Sequence[str],
        budget: Budget,
        paper: Mapping[str, Any],
        settings: SamplerSettings | None = None,
    ) -> None:
        self.folder, self.scenes, self.budget, self.paper = folder, tuple(scenes), budget, paper
        self.settings = settings or SamplerSettings()
        self.store = Store(folder / "runs")
        self._problems: dict[tuple[str, int], Problem] = {}
        self._rankings: dict[tuple[str, int], list[tuple[Path, float]]] = {}

    def problem(self, scene: str, instance: int = 0) -> Problem:
        """An instance of a scene, loaded once."""
        if (scene, instance) not in self._problems:
            self._problems[scene, instance] = load_problem(scene, instance)
        return self._problems[scene, instance]

    def claim_folder(self) -> None:
        """Makes the folder this study's. Raises InputError where it holds runs of another budget."""
        path = self.folder / "study.json"
        ours = json.loads(json.dumps({"budget": asdict(self.budget), "settings": asdict(self.settings)}))
        if path.exists():
            theirs = json.loads(path.read_text(encoding="utf-8"))
            if theirs != ours:
                raise InputError(f"{self.folder} holds runs of another budget or other settings, choose another folder")
        else:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_json(path, ours)

    # -------------------------------------------------------------- which runs there are

    def instances(self, scene: str) -> range:
        """The instances that are run."""
        available = len(self.problem(scene).scene.task.instances)
        return range(min(self.budget.instances or available, available))

    def methods(self, scene: str) -> tuple[str, ...]:
        """Methods of the main comparison, without tree-warm."""
        return ("tree", *self.problem(scene).scene.task.sequences, "rand")

    def main_runs(self, scene: str) -> list[Run]:
        """Methods side by side, so that a change of the machine's speed meets all of them."""
        return [
            Run("main", scene, instance, method, seed, self.budget.seconds)
            for seed in range(self.budget.seeds)
            for instance in self.instances(scene)
            for method in self.methods(scene)
            if seed < {"tree": self.budget.seeds, "rand": self.budget.rand_seeds}.get(method, self.budget.expert_seeds)
        ]

    def warm_runs(self, scene: str) -> list[Run]:
        return [
            Run("warm", scene, instance, "tree-warm", seed, self.budget.seconds)
            for seed in range(self.budget.seeds)
            for instance in self.instances(scene)
            if len(self.instances(scene)) > 1
        ]

    def reference_runs(self, scene: str) -> list[Run]:
        return [
            Run("reference", scene, instance, method, HELD_OUT, self.budget.reference_seconds)
            for instance in self.instances(scene)
            for method in self.methods(scene)
        ]

    def sweep_runs(self, scene: str) -> list[Run]:
        labels = [f"price={factor:g}" for factor in self.budget.prices]
        labels += ["rollout", *(f"c_uct={c:g}" for c in self.budget.exploration)]
        return [
            Run("sweep", scene, instance, label, seed, self.budget.seconds)
            for seed in range(self.budget.sweep_seeds)
            for instance in self.sweep_instances(scene)
            for label in labels
        ]

    def sweep_instances(self, scene: str) -> tuple[int, ...]:
        """Instances of the sweep: spread over all."""
        available = self.instances(scene)
        return tuple(available)[:: max(1, len(available) // self.budget.sweep_instances)][: self.budget.sweep_instances]

    def oracle_instances(self, scene: str) -> tuple[int, ...]:
        return tuple(self.instances(scene))[: self.budget.oracle_instances]

    def survey_runs(self, scene: str) -> list[Run]:
        seconds = round(self.budget.survey_seconds_per_operator * len(self.problem(scene).transitions.problems()), 1)
        return [Run("survey", scene, instance, "survey", 0, seconds) for instance in self.oracle_instances(scene)]

    def screen_runs(self, scene: str) -> list[Run]:
        return [
            Run("screen", scene, instance, f"predicted {i + 1}", 0, self.budget.screen_seconds)
            for instance in self.oracle_instances(scene)
            for i in range(self.budget.screened)
        ]

    def printed_runs(self, scene: str) -> list[Run]:
        return [
            Run("printed", scene, instance, f"paper {i + 1}", 0, self.budget.printed_seconds)
            for instance in self.oracle_instances(scene)
            for i in range(len(self._printed(scene).get("found", [])))
        ]

    def turns_runs(self, scene: str) -> list[Run]:
        """Tree, the best expert and, where there is an oracle, the best sequence found by any other means; those of a seed on
        an instance side by side, once tree has settled."""
        found = self.oracle_instances(scene)
        return [
            Run("turns", scene, instance, label, seed, self.budget.turns_seconds + self._ahead("turns", label))
            for seed in range(self.budget.turns_seeds)
            for instance in self.instances(scene)
            for label in ("tree", "best expert", *(["best found"] if instance in found else []))
        ]

    def operation_runs(self, scene: str) -> list[Run]:
        sequences = dict.fromkeys(entry["sequence"] for entry in self._printed(scene).get("operations", []))
        return [Run("operations", scene, 0, text, 0, self.budget.operation_seconds) for text in sequences]

    def runs(self) -> list[Run]:
        """All runs in the order in which they are made."""
        stages: tuple[Callable[[str], list[Run]], ...] = (
            self.reference_runs,
            self.survey_runs,
            self.screen_runs,
            self.printed_runs,
            self.turns_runs,
            self.operation_runs,
            self.sweep_runs,
        )
        compared = [run for kind in (self.main_runs, self.warm_runs) for scene in self.scenes for run in kind(scene)]
        compared.sort(key=lambda run: run.seed)  # stable: a seed's warm runs come after the main ones that they read
        return [*compared, *(run for kind in stages for scene in self.scenes for run in kind(scene))]

    def missing_runs(self) -> list[Run]:
        """Those that were not run to their end yet, with those that belong beside them."""
        runs = self.runs()
        missing = {_side_by_side(run) for run in runs if not self.store.has(run)}
        return [run for run in runs if _side_by_side(run) in missing]

    def _printed(self, scene: str) -> Mapping[str, Any]:
        return self.paper.get(scene, {})

    # -------------------------------------------------------------- running

    def estimate(self) -> float:
        """Seconds that the missing runs will take, compilation included."""
        missing = self.missing_runs()
        compiling = sum(self._compile_estimate(scene) for scene in self.scenes if any(r.scene == scene for r in missing))
        return compiling + sum(run.seconds + RUN_OVERHEAD for run in missing)

    def _compile_estimate(self, scene: str) -> float:
        return COMPILE_PER_OPERATOR * len(self.problem(scene).transitions.problems())

    def execute(self) -> Iterator[Progress]:
        """Makes the missing runs."""
        self.claim_folder()
        total, done = self.estimate(), 0.0
        missing = self.missing_runs()
        for scene in self.scenes:
            if any(run.scene == scene for run in missing):
                yield Progress(f"{scene}: compiling", done, total)
                self._compile(scene)
                done += self._compile_estimate(scene)
        for _, group in itertools.groupby(missing, _side_by_side):
            runs = list(group)
            methods = ", ".join(run.method for run in runs)
            yield Progress(f"{runs[0].scene} {runs[0].instance}: {runs[0].stage} {methods}, seed {runs[0].seed}", done, total)
            if runs[0].stage in SIDE_BY_SIDE:
                self._execute_in_turns(runs)
            else:
                self._execute(runs[0])
            done += sum(run.seconds + RUN_OVERHEAD for run in runs)
        yield Progress("done", total, total)

    def _compile(self, scene: str) -> None:
        """Makes ready all instances, so that no run loses time to it, whichever comes first. What it took the first process
        of a study is kept, later ones find most of it cached."""
        path = self.folder / f"compile_{scene}.json"
        known: set[str] = set()
        programs: list[dict[str, Any]] = []
        seconds: list[float] = []
        for instance in self.instances(scene):
            began = time.perf_counter()
            for event in prepare(self.problem(scene, instance), self.settings):
                # Programs are shared between instances; the same name and duration is the same program.
                key = f"{event.name} {event.seconds}"
                if key not in known:
                    known.add(key)
                    programs.append({"name": event.name, "seconds": event.seconds, "instance": instance})
            seconds.append(round(time.perf_counter() - began, 2))
        if not path.exists():
            write_json(path, {"programs": programs, "seconds": seconds})

    def _execute(self, run: Run) -> None:
        problem = self.problem(run.scene, run.instance)
        transitions, settings = problem.transitions, self.settings
        values = run.stage in ("main", "warm", "reference")
        tree = run.method == "tree" or run.stage in ("warm", "survey")
        chooser: Any
        if run.stage in ("main", "reference"):
            chooser = make_chooser(problem, run.method, run.seed)
        elif run.stage == "warm":
            chooser = make_chooser(problem, run.method, run.seed, self._prior(run))
        elif run.stage == "survey":
            chooser = Survey(transitions)
        elif run.stage in ("screen", "printed"):
            chooser = make_chooser(problem, self._sequence(run), run.seed)
        else:
            # Second tries tell conditions that cannot be met from failures of the solver; first tries are counted apart.
            settings = SamplerSettings(tries=2, workers=1)
            chooser = make_chooser(problem, run.method, run.seed)
        self.store.write(run, execute(problem, chooser, run, settings, values, tree))

    def _execute_in_turns(self, runs: Sequence[Run]) -> None:
        problem = self.problem(runs[0].scene, runs[0].instance)
        workers = len(runs) * self.settings.workers
        keep(workers)
        # Of all the workers: a run alone needs fewer, and only those have read the programs.
        for _ in prepare(problem, replace(self.settings, workers=workers)):
            pass
        choosers = [self._competitor(run) for run in runs]
        for run, kept in zip(runs, execute_in_turns(problem, choosers, runs, self.settings), strict=True):
            self.store.write(run, kept)

    def _competitor(self, run: Run) -> Chooser:
        if run.stage == "sweep":
            return self._swept(run)
        method = "tree" if run.method == "tree" else self._sequence(run)
        return make_chooser(self.problem(run.scene, run.instance), method, run.seed)

    def _prior(self, run: Run) -> list[Mapping[str, Any]]:
        """Trees of the other instances, same seed."""
        others = [i for i in self.instances(run.scene) if i != run.instance]
        runs = [Run("main", run.scene, i, "tree", run.seed, run.seconds) for i in others]
        return [self.store.read(other).data["tree"] for other in runs]

    def _swept(self, run: Run) -> Chooser:
        transitions = self.problem(run.scene, run.instance).transitions
        what, _, number = run.method.partition("=")
        if what == "rollout":
            return Tree(transitions, reward="rollout")
        if what == "price":
            return priced_tree(transitions, float(number))
        return Tree(transitions, c_uct=float(number))

    def _sequence(self, run: Run) -> str:
        what, number = run.method.split()
        if what == "paper":
            return self._printed(run.scene)["found"][int(number) - 1]
        if run.method == "best found":
            return self._best_found(run.scene, run.instance)
        if run.method == "best expert":
            return self.problem(run.scene).scene.task.sequences[self._best_expert(run.scene, run.instance)]
        ranked = self.ranking(run.scene, run.instance)
        return self.problem(run.scene).transitions.format(ranked[min(int(number), len(ranked)) - 1][0])

    def screened(self, scene: str, instance: int) -> list[tuple[str, float]]:
        """Screened sequences with their measured rates, best first."""
        runs = [run for run in self.screen_runs(scene) if run.instance == instance]
        rates = map(self._final_rate, runs)
        return sorted(zip(map(self._sequence, runs), rates, strict=True), key=lambda entry: -entry[1])

    def _best_found(self, scene: str, instance: int) -> str:
        """The sequence that did best in the short runs, of the best predicted ones and those that the paper prints."""
        printed = [run for run in self.printed_runs(scene) if run.instance == instance]
        tried = [*self.screened(scene, instance), *((self._sequence(run), self._final_rate(run)) for run in printed)]
        return max(tried, key=lambda entry: entry[1])[0]

    def _best_expert(self, scene: str, instance: int) -> str:
        """The named sequence of greatest mean final rate in the main runs."""
        rates: dict[str, list[float]] = {name: [] for name in self.problem(scene).scene.task.sequences}
        for run in self.main_runs(scene):
            if run.instance == instance and run.method in rates:
                rates[run.method].append(self._final_rate(run))
        return max(rates, key=lambda name: np.mean(rates[name]))

    def _ahead(self, stage: str, method: str) -> float:
        """Seconds that a run is ahead of those beside it."""
        return self.budget.settling_seconds if (stage, method) == ("turns", "tree") else 0.0

    def _final_rate(self, run: Run) -> float:
        """Over the last half of a run; of one that began ahead of those beside it, of the time that they share."""
        ahead = self._ahead(run.stage, run.method)
        return measures.final_rate(self.store.read(run).elapsed - ahead, run.seconds - ahead)

    def ranking(self, scene: str, instance: int) -> list[tuple[Path, float]]:
        """Sequences by the rate that the operators' statistics of tree and survey predict."""
        if (scene, instance) in self._rankings:
            return self._rankings[scene, instance]
        trees = [
            self.store.read(run).data["tree"]
            for run in [*self.main_runs(scene), *self.survey_runs(scene)]
            if run.instance == instance and run.method in ("tree", "survey")
        ]
        merged = merged_tree(self.problem(scene, instance).transitions, trees)
        ranked = self._rankings[scene, instance] = ranked_sequences(merged, self.settings.workers)
        return ranked

    # -------------------------------------------------------------- numbers

    def numbers(self, scene: str) -> dict[str, Any]:
        """Everything that tables and figures show of a scene, JSON-ready. All its runs must be there."""
        problem = self.problem(scene)
        task, transitions = problem.scene.task, problem.transitions
        compiled = self.folder / f"compile_{scene}.json"
        result: dict[str, Any] = {
            "scene": scene,
            "title": task.title,
            "paper": dict(self._printed(scene)),
            "budget": asdict(self.budget),
            "sequences": dict(task.sequences),
            "preparation": json.loads(compiled.read_text(encoding="utf-8")),
            "times": measures.time_grid(self.budget.seconds).tolist(),
            "instances": [self._instance(scene, instance) for instance in self.instances(scene)],
            "sweep": self._sweep(scene),
            "turns": [self._turns(scene, instance) for instance in self.instances(scene)],
            "oracle": [self._oracle(scene, instance) for instance in self.oracle_instances(scene)],
            "operations": self._operations(scene),
            "audited": self._audited(scene),
        }
        result["counts"] = self.counts(scene)
        result["variables"] = [variable.name for variable in transitions.graph.variables]
        return result

    def counts(self, scene: str) -> dict[str, Any]:
        """Table I and what lies behind it."""
        transitions = self.problem(scene).transitions
        return {
            "complete": transitions.complete_count,
            "pruned": transitions.pruned_count(),
            "problems": len(transitions.problems()),
            "sequences": transitions.count_sequences(),
            "paper": self._printed(scene).get("counts"),
        }

    def _instance(self, scene: str, instance: int) -> dict[str, Any]:
        budget = self.budget.seconds
        times = measures.time_grid(budget)
        problem = self.problem(scene, instance)
        workers = self.settings.workers
        methods: dict[str, dict[str, Any]] = {}
        values: dict[str, list] = {}
        for run in [*self.main_runs(scene), *self.warm_runs(scene)]:
            if run.instance != instance:
                continue
            kept = self.store.read(run, values=True)
            entry = methods.setdefault(
                run.method,
                {"final": [], "total": [], "rates": [], "first": [], "startup": [], "focus": [], "best": []},
            )
            entry["final"].append(measures.final_rate(kept.elapsed, budget))
            entry["total"].append(len(kept.elapsed))
            entry["rates"].append(measures.rate_over_time(kept.elapsed, times))
            entry["first"].append(float(kept.elapsed.min()) if len(kept.elapsed) else None)
            entry["startup"].append(kept.data["meta"]["startup_seconds"])
            entry["best"].append(kept.data["best_sequences"][:1])
            entry["focus"].append(_focus(problem, kept.data))
            values.setdefault(run.method, []).append(kept.values)
        for entry in methods.values():
            rates = np.array(entry.pop("rates"))
            entry["curve"] = np.round(rates.mean(axis=0), 2).tolist()
            entry["curve_beside"] = np.round(rates[: self.budget.expert_seeds].mean(axis=0), 2).tolist()
        reference: dict[str, list] = {}
        for run in self.reference_runs(scene):
            if run.instance == instance:
                for name, value in self.store.read(run, values=True).values.items():
                    reference.setdefault(name, []).append(value)
        kinds = {variable.name: variable.kind for variable in problem.graph.variables}
        pooled = {name: np.concatenate(parts) for name, parts in reference.items()}
        coverage = None
        if min(map(len, (next(iter(v.values())) for v in values["tree"]))) and len(next(iter(pooled.values()))):
            coverage = measures.coverage_of_instance(values, pooled, kinds, self.budget.coverage_least)
        return {
            "instance": instance,
            "title": problem.scene.task.instances[instance].title,
            "methods": methods,
            "coverage": coverage,
            "workers": workers,
        }

    def _sweep(self, scene: str) -> dict[str, Any]:
        """Final rates by label and instance."""
        rates: dict[str, dict[str, list[float]]] = {}
        for run in self.sweep_runs(scene):
            rates.setdefault(run.method, {}).setdefault(str(run.instance), []).append(self._final_rate(run))
        default = Tree(self.problem(scene).transitions).c_uct
        return {"default_c_uct": default, "rates": rates}

    def _turns(self, scene: str, instance: int) -> dict[str, Any]:
        """Final rates by seed of what ran side by side, and which sequences those were."""
        expert = self._best_expert(scene, instance)
        result: dict[str, Any] = {"instance": instance, "expert": expert, "final": {}, "sequences": {}}
        for run in self.turns_runs(scene):
            if run.instance == instance:
                result["final"].setdefault(run.method, []).append(self._final_rate(run))
                if run.method != "tree":
                    result["sequences"][run.method] = self._sequence(run)
        return result

    def _oracle(self, scene: str, instance: int) -> dict[str, Any]:
        transitions = self.problem(scene, instance).transitions
        ranked = self.ranking(scene, instance)
        predicted = {signature(path): rate for path, rate in ranked}

        def tried(text: str, rate: float) -> dict[str, Any]:
            return {"sequence": text, "predicted": predicted.get(signature(transitions.parse(text))), "rate": rate}

        named = self.problem(scene).scene.task.sequences
        main = [run for run in self.main_runs(scene) if run.instance == instance and run.method in named]
        experts: dict[str, list[float]] = {}
        for run in main:
            experts.setdefault(run.method, []).append(self._final_rate(run))
        turns = self._turns(scene, instance)
        return {
            "instance": instance,
            "sequences": transitions.count_sequences(),
            "distinct": len(ranked),
            "predicted": [round(rate, 3) for _, rate in ranked],
            "best_predicted": [[transitions.format(path), rate] for path, rate in ranked[:5]],
            "screened": [tried(text, rate) for text, rate in self.screened(scene, instance)],
            "printed": [
                tried(self._sequence(run), self._final_rate(run))
                for run in self.printed_runs(scene)
                if run.instance == instance
            ],
            "experts": [tried(named[name], float(np.mean(rates))) for name, rates in experts.items()],
            "found": tried(turns["sequences"]["best found"], float(np.mean(turns["final"]["best found"]))),
        }

    def _audited(self, scene: str) -> dict[str, Any]:
        """What the audit said of the samples of all runs."""
        total = {"samples": 0, "rejected": 0, "max_violation": 0.0}
        for run in self.runs():
            if run.scene == scene:
                kept = self.store.read(run)
                total["samples"] += len(kept.elapsed)
                total["rejected"] += kept.data["meta"]["rejected_by_audit"]
                total["max_violation"] = max(total["max_violation"], kept.data["max_violation"])
        return total

    def _operations(self, scene: str) -> list[dict[str, Any]]:
        transitions = self.problem(scene).transitions
        runs = {run.method: run for run in self.operation_runs(scene)}
        result = []
        for entry in self._printed(scene).get("operations", []):
            data = self.store.read(runs[entry["sequence"]]).data
            name = operation_name(transitions, entry["sequence"], entry["new"])
            operator = data["operators"].get(name)
            tries, successes = data["first_tries"].get(name, (0, 0))
            result.append(
                {
                    **entry,
                    "operator": name,
                    "lanes": tries,
                    "measured_microseconds": operator["microseconds_per_task"] if operator else None,
                    "measured_success": successes / tries if tries else None,
                    "condition_feasible": operator.get("condition_feasible") if operator else None,
                    "solver_success": operator.get("solver_success_if_feasible") if operator else None,
                }
            )
        return result

    @cached_property
    def all_numbers(self) -> dict[str, Any]:
        """Numbers of every scene of the study, and the counts of all scenes that the paper's Table I has."""
        return {
            "scenes": {scene: self.numbers(scene) for scene in self.scenes},
            "counts": {scene: self.counts(scene) for scene in self.paper},
            "settings": asdict(self.settings),
        }


def _focus(problem: Problem, data: Mapping[str, Any]) -> float | None:
    """Share of a run's device time that went into the operators of its best sequence; None without one."""
    best = data["best_sequences"]
    total = sum(operator["device_seconds"] for operator in data["operators"].values())
    if not best or not total:
        return None
    names = {operator_text(transition) for transition in problem.transitions.parse(best[0][0])}
    spent = sum(operator["device_seconds"] for name, operator in data["operators"].items() if name in names)
    return spent / total


def _side_by_side(run: Run) -> Run:
    """The same for all runs that take turns."""
    return replace(run, method="", seconds=0.0) if run.stage in SIDE_BY_SIDE else run
