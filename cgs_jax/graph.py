"""The constraint graph (paper, Section III-B): variables, constraints and which constraint touches which variable.

Only sizes and scopes are here. What a constraint computes is elsewhere, so that counting and pruning need no numbers.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from cgs_jax.errors import InputError


@dataclass(frozen=True)
class Variable:
    """A block of unknowns that is always assigned as a whole.

    dof: dimension of its manifold (7 for seven hinges, 6 for a pose although it is stored as 7 numbers).
    """

    name: str
    dof: int
    kind: Literal["configuration", "pose", "vector"]


@dataclass(frozen=True)
class Constraint:
    """One factor of the nonlinear program (paper, Eq. 1).

    equality_rows: number of linearly independent equality rows at a generic feasible point (not the number of
    residuals: a cross product has 3 residuals of rank 2). inequality_rows: number of inequality residuals.
    """

    name: str
    factor: str
    scope: tuple[str, ...]
    equality_rows: int
    inequality_rows: int


@dataclass(frozen=True)
class ConstraintGraph:
    """Variables in their canonical order and the constraints over them.

    Raises InputError for an empty graph, repeated names, negative sizes, and scopes that are empty or unknown.
    """

    name: str
    variables: tuple[Variable, ...]
    constraints: tuple[Constraint, ...]

    def __post_init__(self) -> None:
        if not self.variables:
            raise InputError(f"graph {self.name!r} has no variables; expected at least one")
        for what, names in (
            ("variable", [variable.name for variable in self.variables]),
            ("constraint", [constraint.name for constraint in self.constraints]),
        ):
            repeated = sorted({name for name in names if names.count(name) > 1})
            if repeated:
                raise InputError(f"graph {self.name!r}: {what} names must be unique, repeated: {', '.join(repeated)}")
        known = {variable.name for variable in self.variables}
        for variable in self.variables:
            if variable.dof < 1:
                raise InputError(f"variable {variable.name!r} has dof {variable.dof}; expected at least 1")
        for constraint in self.constraints:
            unknown = [name for name in constraint.scope if name not in known]
            if unknown or not constraint.scope or len(set(constraint.scope)) < len(constraint.scope):
                raise InputError(
                    f"constraint {constraint.name!r} has scope ({', '.join(constraint.scope)}); expected distinct "
                    f"variables out of: {', '.join(variable.name for variable in self.variables)}"
                )
            if constraint.equality_rows < 0 or constraint.inequality_rows < 0:
                raise InputError(f"constraint {constraint.name!r} has a negative number of rows; expected 0 or more")

    @cached_property
    def index(self) -> dict[str, int]:
        """Position of every variable in the canonical order."""
        return {variable.name: i for i, variable in enumerate(self.variables)}

    @cached_property
    def fingerprint(self) -> str:
        """Hash of variables and constraints (not of the graph's name): equal graphs have equal transitions."""
        content = [
            [[v.name, v.dof, v.kind] for v in self.variables],
            [[c.name, c.factor, list(c.scope), c.equality_rows, c.inequality_rows] for c in self.constraints],
        ]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]

    def variable(self, name: str) -> Variable:
        """The variable of that name. Raises InputError naming those that exist."""
        if name not in self.index:
            raise InputError(f"unknown variable {name!r}; available: {', '.join(self.index)}")
        return self.variables[self.index[name]]

    def ordered(self, names: Iterable[str]) -> tuple[str, ...]:
        """The given names in the canonical order, each once. Raises InputError for an unknown name."""
        return tuple(sorted({self.variable(name).name for name in names}, key=self.index.__getitem__))

    def constraints_on(self, name: str) -> tuple[Constraint, ...]:
        """The constraints whose scope contains the variable."""
        self.variable(name)
        return tuple(constraint for constraint in self.constraints if name in constraint.scope)

    def neighbours(self, name: str) -> tuple[str, ...]:
        """The other variables that share a constraint with this one, in canonical order."""
        touched = {other for constraint in self.constraints_on(name) for other in constraint.scope}
        return self.ordered(touched - {name})

    def components(self, assigned: Iterable[str]) -> tuple[frozenset[str], ...]:
        """Connected components of `assigned` through constraints whose scope lies inside `assigned`.

        These are the groups of assigned variables whose values depend on each other so far: values of different
        components may be combined freely. Ordered by each component's first variable.
        """
        inside = frozenset(assigned)
        group = {name: {name} for name in self.ordered(inside)}
        for constraint in self.constraints:
            if inside.issuperset(constraint.scope):
                merged = set().union(*(group[name] for name in constraint.scope))
                for name in merged:
                    group[name] = merged
        components: list[frozenset[str]] = []
        for name, members in group.items():
            if not any(name in component for component in components):
                components.append(frozenset(members))
        return tuple(components)
