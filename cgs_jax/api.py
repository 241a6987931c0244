"""What a caller uses: sample a problem, or take its operators as pure functions."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

import chex
import jax
import jax.numpy as jnp

from cgs_jax import augmented_lagrangian as al
from cgs_jax.audit import Tolerances
from cgs_jax.costs import descend
from cgs_jax.coverage import CoverageGain
from cgs_jax.errors import InputError
from cgs_jax.operators import PENETRATION, clearance, gather_given, gather_poses, operator_of, propose
from cgs_jax.plans import Point, Shared, Tasks
from cgs_jax.poses import Array
from cgs_jax.problems import Params, Problem
from cgs_jax.record import Recorder
from cgs_jax.sampler import Event, Finished, Found, Sampler, SamplerSettings
from cgs_jax.samples import SampleSet
from cgs_jax.transitions import Transition
from cgs_jax.uct import Chooser, Fixed, Random, Tree

WARM_VISITS = 8.0
"""Equivalent visits (batches) that statistics of earlier runs count for."""

COST_SETTINGS = al.CostSettings(penalty=100.0)
"""How operators descend a cost: from the start the rows weigh more than costs of the order of one, so that a point moves along
them and seldom over to another branch of solutions."""

MAX_LANES = 64
"""Lanes of the pure operators' solver."""


def make_chooser(
    problem: Problem,
    method: str = "tree",
    seed: int = 0,
    prior: Sequence[Mapping[str, Any]] = (),
    c_uct: float | None = None,
    reward: Literal["rate", "rollout"] = "rate",
    pools: bool = True,
) -> Chooser:
    """The chooser of a method.

    method: "tree" (UCT), "tree-warm" (UCT that starts from `prior`), "rand", the name of a sequence of the task file, or a
    sequence as text. prior: trees of earlier runs (`tree.json`). c_uct, reward: weight of exploration, and whether the
    paper's cost c in lambda = 1/(c + 1) is per finished sample ("rate") or per rollout. Raises InputError for anything else,
    naming what there is, and where no sequence assigns all variables. Paper, Section V, Eq. 3.
    """
    transitions = problem.transitions
    if not transitions.children(frozenset()):
        raise InputError(
            f"no sequence assigns all variables of '{problem.name}': some have more equality rows than degrees of freedom, as "
            "--check lists; fewer are those of a looser grasp, or of a placement with bounds in place of a goal"
        )
    sequences = problem.scene.task.sequences
    if method == "tree-warm" and not prior:
        raise InputError("method 'tree-warm' needs statistics of earlier runs: give at least one tree (--warm-start FILE)")
    if method in ("tree", "tree-warm"):
        options: dict[str, Any] = {} if c_uct is None else {"c_uct": c_uct}
        tree = Tree(transitions, reward=reward, retain=pools, **options)
        if prior:
            tree.warm_start([dict(earlier) for earlier in prior], WARM_VISITS)
        return tree
    if method == "rand":
        return Random(transitions, seed, retain=pools)
    if method in sequences:
        return Fixed(transitions, transitions.parse(sequences[method]), retain=pools)
    if not any(mark in method for mark in ";,()") and method not in [v.name for v in problem.graph.variables]:
        known = ", ".join(["tree", "tree-warm", "rand", *sequences])
        raise InputError(f"unknown method '{method}', expected one of: {known}; or a sequence such as \"t_b; (q_a1,t_a); ...\"")
    return Fixed(transitions, transitions.parse(method), retain=pools)


def load_tree(path: str | Path) -> dict[str, Any]:
    """A tree saved by an earlier run (`tree.json`). Raises InputError when it cannot be read."""
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise InputError(f"cannot read tree {path}: {reason}") from None
    if not isinstance(data, dict):
        raise InputError(f"{path} is no saved tree, expected a tree.json of an earlier run")
    return data


def check_budget(time_budget: float, num_samples: int | None, coverage_gain: float | None, batch_size: int) -> None:
    """Raises InputError for budgets and sizes that make no sense."""
    if not time_budget > 0:
        raise InputError(f"time budget is {time_budget} s, expected more than 0")
    if num_samples is not None and num_samples < 1:
        raise InputError(f"number of samples is {num_samples}, expected at least 1")
    if coverage_gain is not None and not 0 < coverage_gain < 1:
        raise InputError(f"coverage gain is {coverage_gain}, expected a share between 0 and 1")
    if batch_size < 1:
        raise InputError(f"batch size is {batch_size}, expected at least 1")


class RunOptions(TypedDict, total=False):
    """What a run can be told beside its problem and its budget.

    method: see `make_chooser`; "tree" where left out.
    seed: of all random numbers; 0 where left out.
    settings: how the run is scheduled.
    prior: trees of earlier runs, for the method "tree-warm".
    c_uct, reward: weight of exploration and reading of the paper's cost, see `make_chooser`.
    tolerances: what the audit accepts in place of its default; the solver's own tolerance is in `settings`.
    """

    method: str
    seed: int
    settings: SamplerSettings | None
    prior: Sequence[Mapping[str, Any]]
    c_uct: float | None
    reward: Literal["rate", "rollout"]
    tolerances: Tolerances | None


class Run:
    """One run with its record; iterate `events` to drive it. Raises InputError for a wrong method. Paper, Algorithm 1."""

    def __init__(
        self,
        problem: Problem,
        method: str = "tree",
        seed: int = 0,
        settings: SamplerSettings | None = None,
        prior: Sequence[Mapping[str, Any]] = (),
        c_uct: float | None = None,
        reward: Literal["rate", "rollout"] = "rate",
        tolerances: Tolerances | None = None,
    ) -> None:
        """The options are told at `RunOptions`."""
        settings = settings or SamplerSettings()
        chooser = make_chooser(problem, method, seed, prior, c_uct, reward, settings.pools)
        self.problem = problem
        self.sampler = Sampler(problem, chooser, seed, settings, tolerances)
        self.record = Recorder(problem, chooser, method, seed, settings, self.sampler.auditor)

    def events(
        self, time_budget: float = 10.0, num_samples: int | None = None, coverage_gain: float | None = None
    ) -> Iterator[Event]:
        """Drives the run until the first of its budgets is used up; every event has been recorded when it is yielded.

        time_budget: seconds of sampling, from the moment the first operators are ready.
        num_samples: samples.
        coverage_gain: share of the latest samples (`coverage.GAIN_WINDOW`) that were the first in their cell; the run ends
            once it is below this for every variable (`coverage.CoverageGain`).
        """
        check_budget(time_budget, num_samples, coverage_gain, self.sampler.settings.batch_size)
        gain = CoverageGain({variable.name: variable.kind for variable in self.problem.graph.variables})
        covered = False
        for event in self.sampler.events(time_budget, num_samples):
            if coverage_gain is not None and isinstance(event, Found):
                gain.add(event.values)
                if gain.share < coverage_gain:
                    covered = True
                    self.stop()
            if covered and isinstance(event, Finished):
                event = replace(event, reason="coverage")
            self.record.listen(event)
            yield event

    def stop(self) -> None:
        """Ends the run after the batches in flight; may be called from a signal handler."""
        self.sampler.stop()


def sample(
    problem: Problem,
    time_budget: float = 10.0,
    num_samples: int | None = None,
    coverage_gain: float | None = None,
    **options: Unpack[RunOptions],
) -> SampleSet:
    """Samples a problem until the first of its budgets is used up (`Run.events`).

    Every sample passed the double-precision audit at `tolerances`. The result may be empty. Raises InputError for a wrong
    method or budget. Paper, Algorithm 1.
    """
    run = Run(problem, **options)
    for _ in run.events(time_budget, num_samples, coverage_gain):
        pass
    return run.record.samples()


def stream(
    problem: Problem,
    time_budget: float = 10.0,
    num_samples: int | None = None,
    coverage_gain: float | None = None,
    **options: Unpack[RunOptions],
) -> Iterator[SampleSet]:
    """Like `sample`, but yields verified samples in batches as they come. Raises what `sample` raises, when first asked."""
    run = Run(problem, **options)
    for event in run.events(time_budget, num_samples, coverage_gain):
        if isinstance(event, Found) and len(event.qpos):
            yield run.record.samples([event])


# ------------------------------------------------------------------ pure functions

PureOperator = Callable[..., tuple[dict[str, jax.Array], jax.Array]]


def operator(
    problem: Problem,
    given: Iterable[str],
    new: Iterable[str],
    settings: al.Settings | None = None,
    cost: Callable[..., jax.Array] | None = None,
    cost_settings: al.CostSettings | None = None,
) -> PureOperator:
    """A conditional operator as a pure function `op(key, values, params, lanes=None) -> (new values, feasible)`.

    values: `(lanes, dim)` of the given variables that the operator reads; `lanes` is needed only where it reads none.
    params: `problem.params`, or other numbers of the same shapes. Returns `(lanes, dim)` per new variable and a mask: rows
    within the solver's tolerance and clearance within `PENETRATION`. Composes with `jax.jit`, `jax.vmap` (over params or
    keys) and `jax.shard_map` (with `check_vma=False`). Raises InputError for unknown variables, or when given and new overlap;
    when called, for missing values or lanes. Paper, Section IV: the operation x_s' = o_{s,s'}(x_s).

    cost: a smooth JAX function of some new (and given) variables, its parameters called like them, one lane at a time:
    configurations `(dof,)` in rad or m, poses `(7,)` `[x y z qw qx qy qz]`; returns a number. Every lane then goes on from its
    projected seed to a local minimum under the rows and the joint limits; clearance is still checked afterwards. That narrows
    what the samples cover, and costs tens of times the work.
    """
    given, new = tuple(given), tuple(new)
    transition = conditional(problem, given, new)
    bound = operator_of(problem, transition)
    settings = settings or al.Settings()
    of_cost = () if cost is None else _variables_of_cost(problem, cost, (*given, *new))
    reads = tuple(dict.fromkeys((*bound.condition, *(name for name in of_cost if name not in new))))

    def apply(
        key: jax.Array, values: Mapping[str, Array], params: Params, lanes: int | None = None
    ) -> tuple[dict[str, jax.Array], jax.Array]:
        missing = [name for name in reads if name not in values]
        if missing:
            raise InputError(f"operator for {', '.join(bound.new)} needs values of {', '.join(missing)}")
        read = {name: jnp.asarray(values[name]) for name in reads}
        count = lanes if lanes is not None else next((len(value) for value in read.values()), None)
        if count is None:
            raise InputError(f"operator for {', '.join(bound.new)} reads no variable: say how many lanes")
        for name, value in read.items():
            chex.assert_shape(value, (count, problem.dofs[name] or 7))
        arguments = gather_given(bound, params, read, count)
        of_function = tuple(read[name] for name in bound.plan.given_configurations)
        numbers = bound.numbers(params)

        def refine(x: Point, tasks: Tasks, shared: Shared) -> Point:
            return descend(
                bound.plan.layout,
                lambda q, poses, others: cost(**{n: others[n] if n in others else bound.of_one(n, q, poses) for n in of_cost}),
                x,
                tasks,
                shared,
                {name: read[name].T for name in of_cost if name in read},
                (numbers.tables.low, numbers.tables.high),
                settings,
                cost_settings or COST_SETTINGS,
            )

        proposals = propose(
            bound.plan.layout,
            settings,
            MAX_LANES,
            key,
            0,
            count,
            arguments,
            of_function,
            numbers,
            None if cost is None else refine,
        )
        found = bound.named(proposals)
        feasible = proposals.feasible
        everything = read | found
        for clear in bound.clears:
            poses = gather_poses(clear, params, everything, count)
            q = tuple(everything[name] for name in clear.configurations)
            feasible &= clearance(clear.layout, count, poses, q, clear.numbers(params)) >= -PENETRATION
        return found, feasible

    return apply


def _variables_of_cost(problem: Problem, cost: Callable[..., jax.Array], offered: tuple[str, ...]) -> tuple[str, ...]:
    """Variables that a cost reads: its parameters' names. Raises InputError for others, and where it gives no number."""
    names = tuple(inspect.signature(cost).parameters)
    for name in names:
        if name not in offered:
            raise InputError(f"cost reads '{name}', available: {', '.join(offered)}")
    point = {name: jax.ShapeDtypeStruct((problem.dofs[name] or 7,), jnp.float32) for name in names}
    try:
        value = jax.eval_shape(cost, **point)
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0]
        raise InputError(
            f"cost failed with {type(error).__name__}: {reason}; expected a JAX function of {', '.join(names)}"
        ) from error
    if getattr(value, "shape", None) != () or not jnp.issubdtype(value.dtype, jnp.floating):
        raise InputError(f"cost returns {value}, expected one floating-point number")
    return names


def conditional(problem: Problem, given: Iterable[str], new: Iterable[str]) -> Transition:
    """The transition that assigns `new` where `given` are assigned, whether or not pruning keeps it."""
    graph = problem.graph
    known = [variable.name for variable in graph.variables]
    given, new = frozenset(given), frozenset(new)
    for name in [*given, *new]:
        if name not in known:
            raise InputError(f"unknown variable '{name}', available: {', '.join(known)}")
    if not new or given & new:
        raise InputError(f"new variables must be some that are not given; given {sorted(given)}, new {sorted(new)}")
    active = [c for c in graph.constraints if set(c.scope) <= given | new and set(c.scope) & new]
    condition = frozenset(name for c in active for name in c.scope) & given
    return Transition(given, graph.ordered(new), tuple(c.name for c in active), condition)


def rollout(problem: Problem, sequence: str | Iterable, settings: al.Settings | None = None) -> Callable:
    """A whole sequence as one pure function `draw(key, params, lanes) -> (values, feasible)`.

    key: a JAX key; params: `problem.params` or other numbers of the same shapes. Returns `(lanes, dim)` by variable
    (configurations in rad or m, poses `[x y z qw qx qy qz]`) and a mask `(lanes,)`. Lanes that failed stay masked; nothing is
    refilled. Raises InputError for a text that is no sequence of the graph. Paper, Section IV: a sequence of operations.
    """
    path = problem.transitions.parse(sequence)
    operators = [operator(problem, t.given, t.new, settings) for t in path]

    def draw(key: jax.Array, params: Params, lanes: int) -> tuple[dict[str, jax.Array], jax.Array]:
        values: dict[str, jax.Array] = {}
        feasible = jnp.ones((lanes,), bool)
        for i, apply in enumerate(operators):
            found, ok = apply(jax.random.fold_in(key, i), values, params, lanes)
            values |= found
            feasible &= ok
        return values, feasible

    return draw

