"""Transitions between sets of assigned variables, pruned exactly (paper, Section V-B and Table I).

A transition s -> s' assigns the variables new = s' \\ s jointly, given those of s. Its active constraints are those
whose scope lies inside s' and touches new. It is kept if and only if

1. structural rank: the equality rows of the active constraints can each be matched to a degree of freedom of their own
   among the new variables of their scope (Hall's condition over all subsets of new; "zero probability of success"),
2. one component: new is connected through active constraints, assigned variables being cut out ("conditional
   independence"),
3. no dead end: s can be reached from the empty set and s' can reach the full set by kept transitions.

Rule 3 needs no search. A chain of matchings along a path is one matching of all its rows, and a matching of all rows
of the rest splits into its connected components, each of which is a kept transition. So s' can reach the full set if
and only if the rows of all constraints that touch the rest can be matched to the rest, and likewise for reaching s.
Children of a state are grown through constraints and can be listed for graphs whose 3^n transitions cannot.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

from cgs_jax.errors import InputError
from cgs_jax.graph import ConstraintGraph

Problem = tuple[tuple[str, ...], tuple[str, ...]]
"""A conditional problem: (new variables, active constraints). Transitions of one problem share an operator."""

State = frozenset[str]

LISTED = 12
"""Transitions that a message lists at most, the smallest ones."""


@dataclass(frozen=True)
class Transition:
    """Assign `new` jointly, given the variables of `given`.

    new and constraints are in graph order. condition: the variables of `given` that the active constraints touch; the
    others do not matter for the outcome.
    """

    given: State
    new: tuple[str, ...]
    constraints: tuple[str, ...]
    condition: State

    # They are asked for, as keys too, many times in every choice: what follows from the fields is kept.

    @cached_property
    def problem(self) -> Problem:
        return self.new, self.constraints

    @cached_property
    def target(self) -> State:
        return self.given.union(self.new)

    @cached_property
    def _hash(self) -> int:
        return hash((self.given, self.new, self.constraints, self.condition))

    def __hash__(self) -> int:
        return self._hash

    def __reduce__(self) -> tuple:
        # Hashes of strings differ between processes.
        return Transition, (self.given, self.new, self.constraints, self.condition)

    def __str__(self) -> str:
        return self.new[0] if len(self.new) == 1 else f"({','.join(self.new)})"


Path = tuple[Transition, ...]
"""Transitions in turn, from the empty set on; a complete sequence ends with the full one."""


class Transitions:
    """The kept transitions of a constraint graph, listed lazily and remembered."""

    def __init__(self, graph: ConstraintGraph) -> None:
        self.graph = graph
        self.full: State = frozenset(graph.index)
        self._scopes = [self._mask(constraint.scope) for constraint in graph.constraints]
        self._everything = (1 << len(graph.variables)) - 1
        self._children: dict[State, tuple[Transition, ...]] = {}
        self._matchable: dict[tuple[int, tuple[int, ...]], bool] = {}

    @property
    def complete_count(self) -> int:
        """Number of pairs s < s' of subsets before pruning (Table I, "complete")."""
        n = len(self.graph.variables)
        return 3**n - 2**n

    def pruned_count(self) -> int:
        """Number of kept transitions (Table I, "after pruning"). Enumerates them all."""
        return sum(1 for _ in self.iterate())

    def all(self) -> tuple[Transition, ...]:
        """All kept transitions, by number of assigned variables."""
        return tuple(self.iterate())

    def iterate(self) -> Iterator[Transition]:
        """Kept transitions one by one, states in order of their size; stop early where the graph is large."""
        layers: list[dict[State, None]] = [{} for _ in range(len(self.graph.variables) + 1)]
        layers[0][frozenset()] = None
        for layer in layers:
            for state in layer:
                for transition in self.children(state):
                    layers[len(state) + len(transition.new)][transition.target] = None
                    yield transition

    def problems(self) -> tuple[Problem, ...]:
        """The distinct conditional problems, in order of first appearance."""
        return tuple(dict.fromkeys(transition.problem for transition in self.iterate()))

    def children(self, state: Iterable[str]) -> tuple[Transition, ...]:
        """Kept transitions out of `state`, by (number of new variables, graph order).

        A state that no sequence passes through has none. Raises InputError for unknown variables.
        """
        key = frozenset(state)
        found = self._children.get(key)
        if found is None:
            found = self._children[key] = self._list_children(self._mask(self.graph.ordered(key)), key)
        return found

    def sequences(self) -> Iterator[Path]:
        """All complete sequences, depth first in the order of children()."""

        def extend(path: Path, state: State) -> Iterator[Path]:
            if state == self.full:
                yield path
            for transition in self.children(state):
                yield from extend((*path, transition), transition.target)

        return extend((), frozenset())

    def count_sequences(self) -> int:
        """Number of complete sequences, without listing them."""
        count: Counter[State] = Counter({frozenset(): 1})
        for transition in self.iterate():
            count[transition.target] += count[transition.given]
        return count[self.full]

    def parse(self, sequence: str | Iterable[str | Iterable[str]]) -> Path:
        """The path written as "t_b; t_a; (q_a2,p); ..." or as a list of lists of names.

        Raises InputError naming the first step that is no kept transition and what is available there.
        """
        steps = [part for part in sequence.split(";") if part.strip()] if isinstance(sequence, str) else list(sequence)
        path: list[Transition] = []
        state: State = frozenset()
        for number, step in enumerate(steps, start=1):
            names = self._read_step(step, number) if isinstance(step, str) else list(step)
            unknown = [name for name in names if name not in self.graph.index]
            if unknown:
                raise InputError(f"step {number}: unknown variable '{unknown[0]}', available: {', '.join(self.graph.index)}")
            match = next((t for t in self.children(state) if Counter(t.new) == Counter(names)), None)
            if match is None:
                children = self.children(state)
                more = f" and {len(children) - LISTED} more" if len(children) > LISTED else ""
                available = (", ".join(map(str, children[:LISTED])) or "nothing") + more
                raise InputError(
                    f"step {number} ({','.join(names)}) is not possible after "
                    f"{self.format(path) or 'the start'!r}; available: {available}"
                )
            path.append(match)
            state = match.target
        if state != self.full:
            missing = ", ".join(self.graph.ordered(self.full - state))
            available = ", ".join(map(str, self.children(state)))
            raise InputError(f"sequence {self.format(path)!r} leaves {missing} unassigned; available next: {available}")
        return tuple(path)

    @staticmethod
    def _read_step(step: str, number: int) -> list[str]:
        text = step.strip()
        inner = text[1:-1] if text.startswith("(") and text.endswith(")") else text
        if "(" in inner or ")" in inner:
            raise InputError(f"step {number} ({text!r}) is not understood, expected a name such as t or names such as (q1,t)")
        return [name.strip() for name in inner.split(",")]

    def format(self, path: Iterable[Transition]) -> str:
        """The text that parse() reads."""
        return "; ".join(map(str, path))

    # States are bit masks below: subsets are compared millions of times.

    def _mask(self, names: Iterable[str]) -> int:
        return sum(1 << self.graph.index[name] for name in names)

    def _names(self, mask: int) -> tuple[str, ...]:
        return tuple(variable.name for i, variable in enumerate(self.graph.variables) if mask >> i & 1)

    @cached_property
    def _with_rows(self) -> list[int]:
        return [i for i, constraint in enumerate(self.graph.constraints) if constraint.equality_rows]

    def _has_rank(self, state: int, new: int) -> bool:
        """Rule 1 for the transition state -> state | new."""
        target = state | new
        scopes = self._scopes
        active = tuple(i for i in self._with_rows if scopes[i] & new and not scopes[i] & ~target)
        known = self._matchable.get((new, active))
        if known is None:
            rows = [(self.graph.constraints[i].equality_rows, scopes[i] & new) for i in active]
            known = self._matchable[new, active] = _rows_can_be_matched(
                rows, [variable.dof if new >> i & 1 else 0 for i, variable in enumerate(self.graph.variables)]
            )
        return known

    def _is_live(self, state: int) -> bool:
        """Rule 3, for both ends: reachable from the empty set and able to reach the full set (see module text)."""
        return self._splits_with_rank(0, state) and self._splits_with_rank(state, self._everything & ~state)

    def _splits_with_rank(self, state: int, new: int) -> bool:
        """Rule 1 for `new`, component by component: the same few components come back in many states."""
        target = state | new
        while new:
            part = new & -new
            grown = True
            while grown:
                grown = False
                for scope in self._scopes:
                    if scope & part and scope & new & ~part and not scope & ~target:
                        part |= scope & new
                        grown = True
            if not self._has_rank(target & ~part, part):
                return False
            new &= ~part
        return True

    def _list_children(self, state: int, given: State) -> tuple[Transition, ...]:
        if not self._is_live(state):
            return ()
        rest = self._everything & ~state
        links = {scope & rest for scope in self._scopes}
        links = {link for link in links if link & (link - 1)}
        kept = []
        # Breadth first from single variables. A set without rank has no superset with rank, so it is not grown.
        seen = {1 << i for i in range(len(self.graph.variables)) if rest >> i & 1}
        queue = list(seen)
        for new in queue:
            if not self._has_rank(state, new):
                continue
            if self._splits_with_rank(state | new, rest & ~new):
                kept.append(new)
            for link in links:
                if link & new and link & ~new:
                    larger = new | link
                    if larger not in seen:
                        seen.add(larger)
                        queue.append(larger)
        transitions = [self._transition(state, given, new) for new in kept]
        index = self.graph.index
        return tuple(sorted(transitions, key=lambda t: (len(t.new), [index[name] for name in t.new])))

    def _transition(self, state: int, given: State, new: int) -> Transition:
        target = state | new
        active = [i for i, scope in enumerate(self._scopes) if scope & new and not scope & ~target]
        touched = 0
        for i in active:
            touched |= self._scopes[i]
        return Transition(
            given=given,
            new=self._names(new),
            constraints=tuple(self.graph.constraints[i].name for i in active),
            condition=frozenset(self._names(touched & state)),
        )


def _rows_can_be_matched(rows: list[tuple[int, int]], dof: list[int]) -> bool:
    """Can every row have a degree of freedom of its own? Maximum flow from constraints to variables.

    rows: (number of rows, mask of variables that may take them) per constraint; dof: capacity per variable.
    """
    if sum(count for count, _ in rows) > sum(dof):
        return False
    spare = list(dof)
    variables = [[i for i in range(len(dof)) if mask >> i & 1] for _, mask in rows]
    placed = [dict.fromkeys(scope, 0) for scope in variables]
    for start, (count, _) in enumerate(rows):
        while count:
            # Shortest augmenting path: constraint -> variable -> constraint that gives way -> its other variable ...
            came_from: dict[int, int] = {}  # variable -> constraint that reached it
            gave_way: dict[int, int] = {start: -1}  # constraint -> variable it gives up
            queue, end = [start], -1
            while queue and end < 0:
                constraint = queue.pop(0)
                for variable in variables[constraint]:
                    if variable in came_from:
                        continue
                    came_from[variable] = constraint
                    if spare[variable]:
                        end = variable
                        break
                    for other in range(start + 1):
                        if other not in gave_way and placed[other].get(variable):
                            gave_way[other] = variable
                            queue.append(other)
            if end < 0:
                return False
            amount, variable = min(count, spare[end]), end
            while came_from[variable] != start:
                constraint = came_from[variable]
                variable = gave_way[constraint]
                amount = min(amount, placed[constraint][variable])
            spare[end] -= amount
            count -= amount
            variable = end
            while True:
                constraint = came_from[variable]
                placed[constraint][variable] += amount
                if constraint == start:
                    break
                variable = gave_way[constraint]
                placed[constraint][variable] -= amount
    return True
