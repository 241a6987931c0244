"""A user's own parts: constraints, variables and samplers, added to a problem.

Each function returns the same problem with one more part and leaves the old one as it is. What is given is tried out at once,
so that a mistake is one line here and not a failure inside a run.
"""

from __future__ import annotations

import dataclasses
import keyword
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import jax
import numpy as np

from cgs_jax.audit import OwnCheck
from cgs_jax.constraints import Function, OwnSampler
from cgs_jax.errors import InputError
from cgs_jax.graph import Constraint, Variable
from cgs_jax.problems import Problem
from cgs_jax.tables import TABLE_SIZE, SeedTable

TRIALS = 64
"""Draws by which a sampler is tried out."""

CHECKED_AT_ONCE = 256
"""Samples that a user's function is evaluated at together in the audit, so that it is compiled for one shape."""


def with_constraint(
    problem: Problem,
    name: str,
    scope: Sequence[str],
    function: Callable[..., jax.Array],
    kind: Literal["equality", "inequality"],
    rows: int,
) -> Problem:
    """The same problem with one more constraint: a plain JAX function of some of its variables.

    function: called for one lane with the variables of `scope` by keyword, configurations as `(dof,)` in rad or m, vectors as
    `(dof,)` in their own unit, poses as `(7,)` `[x y z qw qx qy qz]`; returns `(rows,)` numbers that must be zero (kind
    "equality") or at most zero (kind "inequality"). The solver aims at 2.5e-5, the audit evaluates the function anew in double
    precision and allows `Tolerances.own` (1e-4), both in the rows' own unit: scale rows so that this is small. `rows` of an
    equality count as linearly independent (paper, Eq. 1); the transitions are pruned anew. Numbers that the function closes
    over are part of its compiled programs.

    Raises InputError (one line) when the name is taken, the scope unknown, kind or rows wrong, when at a random point the
    function fails, returns another shape, or a value or derivative that is not finite, and when with the new rows no
    sequence can assign all variables.
    """
    ordered = problem.graph.ordered(scope)
    _check_free(problem, name)
    if kind not in ("equality", "inequality"):
        raise InputError(f"constraint '{name}' is of kind {kind!r}, expected one of: equality, inequality")
    if isinstance(rows, bool) or not isinstance(rows, int) or rows < 1:
        raise InputError(f"constraint '{name}' has {rows!r} rows, expected a whole number of at least 1")
    if not ordered:
        raise InputError(f"constraint '{name}' has an empty scope, expected some of: {', '.join(problem.graph.index)}")
    declaration = Function(function, ordered, kind, rows)
    _check_function(problem, name, declaration)
    counts = (rows, 0) if kind == "equality" else (0, rows)
    extended = _linked(problem, Constraint(name, name.split("(")[0], ordered, *counts))
    extended = dataclasses.replace(extended, declarations={**problem.declarations, name: declaration})
    if not extended.transitions.children(frozenset()):
        raise InputError(
            f"constraint '{name}' with {rows} {kind} rows leaves no sequence that assigns all variables; "
            "expected no more equality rows than the degrees of freedom that the other constraints leave"
        )
    return extended


def with_variable(
    problem: Problem, name: str, dof: int, low: float | Sequence[float], high: float | Sequence[float]
) -> Problem:
    """The same problem with one more variable: a vector of `dof` numbers (forces, times, widths) for own constraints to couple.

    low, high: limits, one number for all or `dof` of them, in whatever unit; kept in single precision. Seeds are uniform
    between them unless a sampler draws the variable, and the solver, which takes the vector in units of this range, stays
    inside. In samples it is `result[name]`, `(N, dof)`.

    Raises InputError (one line) when the name is taken or no Python name, or limits are not finite or not low < high.
    """
    taken = list(problem.graph.index)
    if name in taken:
        raise InputError(f"variable '{name}' exists already, expected a name other than: {', '.join(taken)}")
    if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name):
        raise InputError(f"variable name {name!r} is not usable, expected a Python name such as force or gap_1")
    if isinstance(dof, bool) or not isinstance(dof, int) or dof < 1:
        raise InputError(f"variable '{name}' has dof {dof!r}, expected a whole number of at least 1")
    limits = _limits(name, "low", low, dof), _limits(name, "high", high, dof)
    if not (limits[0] < limits[1]).all():
        raise InputError(f"variable '{name}' has limits {low} to {high}, expected low < high in single precision")
    graph = dataclasses.replace(problem.graph, variables=(*problem.graph.variables, Variable(name, dof, "vector")))
    table = f"vector {name}"
    params = problem.params._replace(
        limits={**problem.params.limits, name: limits},
        # Seeds of vectors are uniform; the table only has to have everyone's shape.
        tables={**problem.params.tables, table: SeedTable(np.zeros((dof, TABLE_SIZE), np.float32), {})},
    )
    table_of = {**problem.table_of, name: table}
    return dataclasses.replace(problem, graph=graph, params=params, table_of=table_of, operators={}, aimed={}, source=None)


def with_sampler(
    problem: Problem,
    variables: str | Sequence[str],
    function: Callable[..., jax.Array | tuple[jax.Array, ...]],
    given: Sequence[str] = (),
) -> Problem:
    """The same problem with a direct sampler of some of its variables: a pure JAX function of a key and given values.

    function: called for one lane as `function(key, **given values)`; returns the value of `variables`, a tuple of values where
    `variables` is a sequence. Configurations and vectors are `(dof,)`, poses `(7,)` `[x y z qw qx qy qz]`. It returns finite
    numbers; where it has none for what it is given, NaN, and that attempt fails. So does one with a configuration or vector
    outside its limits.

    What it draws is the seed of these variables in every operator that assigns all of them, where `given` are assigned already
    or drawn by another sampler there. From there the solver projects as always: an operator that assigns nothing else and
    whose constraints the values satisfy returns them as they are; one that assigns other variables with them may move them a
    little, and only as far as the others cannot do the rest (`plans.SAMPLED_UNIT`).
    Elsewhere seeds are the usual ones. Constraints are checked in any case, so that what a sampler gets wrong costs attempts
    and never correctness. Given variables that no constraint ties to the drawn ones are tied by one without rows.

    Raises InputError (one line) for names that are unknown, repeated or drawn by another sampler already, and when in
    `TRIALS` draws the function fails, returns other shapes, numbers that are not finite (where nothing is given) or nothing
    but configurations and vectors outside their limits.
    """
    single = isinstance(variables, str)
    names = (variables,) if isinstance(variables, str) else tuple(variables)
    label = f"sampler of '{', '.join(names)}'"
    if not names:
        raise InputError(f"sampler of no variables, expected some of: {', '.join(problem.graph.index)}")
    for name in (*names, *given):
        problem.graph.variable(name)
    if len({*names, *given}) < len(names) + len(given):
        raise InputError(f"{label} given ({', '.join(given)}) names a variable twice, expected each once")
    for other in problem.samplers:
        if shared := set(names) & set(other.variables):
            raise InputError(f"{label}: '{min(shared)}' has a sampler already, expected one sampler for a variable")
    sampler = OwnSampler(function, names, tuple(given), single)
    _check_sampler(problem, label, sampler)
    scope = {*names, *given}
    tied = {v for c in problem.graph.constraints if set(c.scope) <= scope and set(c.scope) & set(names) for v in c.scope}
    if not set(given) <= tied:
        # Values depend on what they were drawn from; the graph must know.
        _check_free(problem, sampler.link)
        problem = _linked(problem, Constraint(sampler.link, "Sampler", problem.graph.ordered(scope), 0, 0))
    return dataclasses.replace(problem, samplers=(*problem.samplers, sampler), operators={}, aimed={}, source=None)


def own_checks(problem: Problem) -> list[OwnCheck]:
    """What the audit has to check of a user's parts: rows in double precision, and limits of vectors."""
    checks = [
        OwnCheck(name, "rows", declaration.scope, _rows_in_double(declaration))
        for name, declaration in problem.declarations.items()
        if isinstance(declaration, Function)
    ]
    for name in problem.vectors:
        checks.append(OwnCheck(f"limits of {name}", "limit", (name,), _beyond_limits(name, *problem.params.limits[name])))
    return checks


# ------------------------------------------------------------------ evaluation in double precision


def _rows_in_double(declaration: Function) -> Callable[[Mapping[str, np.ndarray]], np.ndarray]:
    """Largest violation `(N,)` of a user's rows at values `(N, dim)`; not a number counts as infinite."""
    run = jax.jit(jax.vmap(lambda point: declaration.function(**point)))

    def violation(values: Mapping[str, np.ndarray]) -> np.ndarray:
        point = {name: np.asarray(values[name], np.float64) for name in declaration.scope}
        count = len(point[declaration.scope[0]])
        worst = np.zeros(count)
        with jax.enable_x64(True):
            for start in range(0, count, CHECKED_AT_ONCE):
                rows = np.minimum(np.arange(start, start + CHECKED_AT_ONCE), count - 1)
                value = np.asarray(run({name: value[rows] for name, value in point.items()}), np.float64)
                gap = np.abs(value) if declaration.kind == "equality" else np.maximum(value, 0.0)
                part = worst[start : start + CHECKED_AT_ONCE]
                part[:] = gap.max(axis=1)[: len(part)]
        return np.where(np.isfinite(worst), worst, np.inf)

    return violation


def _beyond_limits(name: str, low: Any, high: Any) -> Callable[[Mapping[str, np.ndarray]], np.ndarray]:
    """Excess `(N,)` over the limits of a vector, relative to their size where that is above one."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    # Values are single precision: their rounding grows with them.
    unit = np.maximum(1.0, np.maximum(np.abs(low), np.abs(high)))

    def violation(values: Mapping[str, np.ndarray]) -> np.ndarray:
        value = values[name]
        return np.maximum(np.maximum(low - value, value - high) / unit, 0.0).max(axis=1)

    return violation


# ------------------------------------------------------------------ what is tried out when a part is added


def _check_free(problem: Problem, name: str) -> None:
    taken = [c.name for c in problem.graph.constraints]
    if name in taken:
        raise InputError(f"constraint '{name}' exists already, expected a name other than: {', '.join(taken)}")


def _linked(problem: Problem, constraint: Constraint) -> Problem:
    graph = dataclasses.replace(problem.graph, constraints=(*problem.graph.constraints, constraint))
    return dataclasses.replace(problem, graph=graph, operators={}, aimed={}, source=None)


def _limits(name: str, which: str, value: float | Sequence[float], dof: int) -> np.ndarray:
    try:
        numbers = np.asarray(value, np.float64)
        limits = np.broadcast_to(numbers, (dof,)).astype(np.float32)
    except (TypeError, ValueError):
        raise InputError(f"variable '{name}' has {which} = {value}, expected one number or {dof}") from None
    if not np.isfinite(limits).all():
        raise InputError(f"variable '{name}' has {which} = {value}, expected finite numbers")
    return limits


def _random_value(problem: Problem, name: str, rng: np.random.Generator) -> np.ndarray:
    """Any value of a variable: within its limits, or a pose within a metre."""
    if problem.dofs[name] is not None:
        return rng.uniform(*problem.params.limits[name]).astype(np.float32)
    quat = rng.normal(size=4)
    return np.concatenate([rng.uniform(-1.0, 1.0, size=3), quat / np.linalg.norm(quat)]).astype(np.float32)


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"


def _check_function(problem: Problem, name: str, declaration: Function) -> None:
    """Evaluates a user's function and its derivatives at a random point, in single and in double precision."""
    rng = np.random.default_rng(0)
    point = {variable: _random_value(problem, variable, rng) for variable in declaration.scope}

    def value(at: Mapping[str, Any]) -> jax.Array:
        return declaration.function(**at)

    try:
        found = jax.jit(value)(point)
        slopes = jax.jit(jax.jacfwd(value))(point)
    except Exception as error:
        raise InputError(
            f"function of constraint '{name}' failed with {_reason(error)}; expected a JAX function of "
            f"the keywords {', '.join(declaration.scope)}"
        ) from error
    if np.shape(found) != (declaration.rows,):
        raise InputError(
            f"function of constraint '{name}' returns shape {np.shape(found)}, expected ({declaration.rows},)"
        )
    for what, numbers in (("value", [found]), ("derivative", jax.tree.leaves(slopes))):
        if not all(np.isfinite(np.asarray(part)).all() for part in numbers):
            raise InputError(
                f"function of constraint '{name}' has a {what} that is not finite at a random point, "
                "expected finite numbers everywhere within the limits"
            )
    try:
        _rows_in_double(declaration)({variable: part[None] for variable, part in point.items()})
    except Exception as error:
        raise InputError(
            f"function of constraint '{name}' failed in double precision with {_reason(error)}; the audit evaluates it there, "
            "expected no fixed float32 types"
        ) from error


def _check_sampler(problem: Problem, label: str, sampler: OwnSampler) -> None:
    """Draws with a user's sampler, compiled, at random values of what it is given."""
    rng = np.random.default_rng(0)
    point = {name: np.stack([_random_value(problem, name, rng) for _ in range(TRIALS)]) for name in sampler.given}
    keys = jax.random.split(jax.random.key(0), TRIALS)
    try:
        result = jax.jit(jax.vmap(lambda key, at: sampler.function(key, **at)))(keys, point)
    except Exception as error:
        words = ", ".join(["a key", *(f"the keyword {name}" for name in sampler.given)])
        raise InputError(f"function of the {label} failed with {_reason(error)}; expected a JAX function of {words}") from error
    expected = [(problem.dofs[name] or 7,) for name in sampler.variables]
    parts = [result] if sampler.single else result
    arrays = isinstance(parts, list | tuple) and all(hasattr(part, "shape") for part in parts)
    found = [part.shape[1:] for part in parts] if arrays else None
    if found != expected:
        what = f"shapes {', '.join(map(str, found))}" if found is not None else f"a {type(result).__name__}"
        wanted = ", ".join(f"{shape} for {name}" for name, shape in zip(sampler.variables, expected, strict=True))
        raise InputError(f"function of the {label} returns {what}, expected {'' if sampler.single else 'a tuple of '}{wanted}")
    for name, part in zip(sampler.variables, parts, strict=True):
        values = np.asarray(part, np.float64)
        finite = np.isfinite(values).all(axis=1)
        if not finite.all() and not sampler.given:
            raise InputError(
                f"function of the {label} returns numbers for '{name}' that are not finite in {int((~finite).sum())} of "
                f"{TRIALS} draws, expected finite numbers"
            )
        values = values[finite]
        if not len(values):
            continue
        if problem.dofs[name] is None:
            if np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1.0).max() > 1e-3:
                raise InputError(
                    f"function of the {label} returns '{name}' with quaternions that are not unit, expected unit ones"
                )
        else:
            low, high = (np.asarray(bound) for bound in problem.params.limits[name])
            if not ((values >= low) & (values <= high)).all(axis=1).any():
                raise InputError(
                    f"function of the {label} returns no '{name}' within its limits in {TRIALS} draws, expected "
                    f"values from {low.tolist()} to {high.tolist()}"
                )
