"""Which conditional operator to run next: upper confidence trees over assignment sequences (paper, Section IV-A).

Nodes are sequences of transitions, as in the paper. What differs from plain UCT, and why:

* Successes and time are counted apart, per edge of the tree and pooled per conditional problem, and the value Q is
  formed from them when it is needed. A mixture of both made at yesterday's price of time would go stale.
* Q is a model-based backup: an edge's success times the best value behind it. Sampled returns need far more rollouts.
* Visits are counted in batches. Q is normalised between the least and the greatest among siblings, so that `c_uct`
  does not depend on the unit of time.

The reward is the paper's lambda * r_t + (1 - lambda) * r_g with lambda = 1/(c + 1), divided by (1 - lambda): success
minus time * price, price = 1/c. With c the cost per *finished sample* this is Dinkelbach's rule, whose maximum is the
most samples per second. With c the cost per rollout time is priced too dear and what fails fast is preferred.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Literal, Protocol

from cgs_jax.errors import InputError
from cgs_jax.transitions import Problem, State, Transition, Transitions

SCHEMA = "cgs_jax.tree/1"

Path = tuple[Transition, ...]
Ready = Callable[[Transition], bool]

PRIOR_CONDITIONS = 2.0
"""Weight of the prior of an operator without statistics, in conditions."""

PRIOR_SUCCESS = 0.7
"""Guessed success of an operator that never ran, per new variable."""

OPERATOR_WEIGHT = 300.0
"""An edge believes its operator's pooled statistics as if they were at most this many conditions of its own."""

ENUMERABLE = 3000
"""Up to this many transitions the values below the tree come from dynamic programming over all states."""

UNTRIED_VISITS = 1.0
"""Where there are more, an operator that was never tried counts as visited this often instead of never: trying
thousands of them first would leave no time to use any. Its bonus still grows without bound."""


@dataclass
class Statistics:
    """What happened on an edge, or pooled on an operator.

    visits: batches. conditions: distinct conditioning prefixes that were consumed, each having succeeded or been given
    up. successes: those that succeeded. attempts: tries in total. seconds: device time. All but visits are discounted:
    they are weights of evidence, not counts.
    """

    visits: float = 0.0
    conditions: float = 0.0
    successes: float = 0.0
    attempts: float = 0.0
    seconds: float = 0.0

    def add(self, conditions: float, successes: float, attempts: float, seconds: float, visits: float, keep: float):
        """Discount what is known by the factor `keep` and add a batch."""
        self.visits += visits
        self.conditions = keep * self.conditions + conditions
        self.successes = keep * self.successes + successes
        self.attempts = keep * self.attempts + attempts
        self.seconds = keep * self.seconds + seconds

    @property
    def success_rate(self) -> float | None:
        """Successes per condition; None without evidence."""
        return self.successes / self.conditions if self.conditions else None

    @property
    def seconds_per_condition(self) -> float | None:
        return self.seconds / self.conditions if self.conditions else None


class Chooser(Protocol):
    """What the sampler needs: Tree, Fixed and Random have it."""

    @property
    def rate(self) -> float: ...

    def best_sequences(self, k: int = 1) -> list[tuple[Path, float]]: ...

    def as_json(self) -> dict[str, Any]: ...

    def select(self, ready: Ready | None = None) -> Path: ...

    def record(
        self,
        prefix: Path,
        transition: Transition,
        conditions: int,
        successes: int,
        seconds: float,
        visits: float = 1.0,
        attempts: int | None = None,
    ) -> None: ...


class _Operator:
    """Pooled statistics of one conditional problem, and what they predict."""

    __slots__ = ("cost", "prior", "ready", "statistics", "success")

    def __init__(self, problem: Problem) -> None:
        self.statistics = Statistics()
        self.ready = True
        self.prior = self.success = PRIOR_SUCCESS ** len(problem[0])
        self.cost = 0.0

    def predict(self, initial_cost: float) -> None:
        known = self.statistics
        weight = known.conditions + PRIOR_CONDITIONS
        self.success = (known.successes + PRIOR_CONDITIONS * self.prior) / weight
        # The guessed cost counts only until a cost was seen: it may be wrong by orders of magnitude.
        self.cost = known.seconds / known.conditions if known.conditions else initial_cost


class _Step:
    """A transition together with what it does to the independent components of the assigned variables.

    kept: components that survive its failure. used: components that are consumed. made: the component of the result.
    """

    __slots__ = ("kept", "made", "operator", "target", "transition", "used")

    def __init__(self, transition: Transition, operator: _Operator, components: tuple[State, ...]) -> None:
        self.transition = transition
        self.operator = operator
        self.target = transition.target
        self.used = tuple(c for c in components if c & transition.condition)
        self.kept = tuple(c for c in components if not c & transition.condition)
        self.made = frozenset(transition.new).union(*self.used)


class _Node:
    """A sequence of transitions: the last of them is `step` (None at the root).

    costs: expected device seconds per item of every component, produced the way this sequence does.
    """

    __slots__ = ("children", "costs", "expanded", "interior", "parent", "quality", "statistics", "step", "value")

    def __init__(self, parent: _Node | None, step: _Step | None) -> None:
        self.parent = parent
        self.step = step
        self.statistics = Statistics()
        self.children: dict[tuple[str, ...], _Node] = {}
        self.expanded = False  # all children are there
        self.interior = False  # something was recorded on a child
        self.costs: dict[State, float] = {}
        self.value = 0.0
        self.quality = 0.0

    @property
    def path(self) -> Path:
        path, node = [], self
        while node.parent is not None:
            path.append(node.step.transition)
            node = node.parent
        return tuple(reversed(path))


class _Records:
    """Statistics of a run whatever the rule of choice, and the predictions that follow from them (see Tree)."""

    kind = ""

    def __init__(
        self,
        transitions: Transitions,
        retain: bool = True,
        discount: float = 0.998,
        initial_cost: float = 1e-4,
    ) -> None:
        if not 0.0 < discount <= 1.0:
            raise InputError(f"discount is {discount}; expected above 0 and at most 1")
        if initial_cost < 0.0:
            raise InputError(f"initial_cost is {initial_cost} s; expected 0 or more")
        self.transitions = transitions
        self.retain = retain
        self.discount = discount
        self.initial_cost = initial_cost
        self._root = _Node(None, None)
        self._operators: dict[Problem, _Operator] = {}
        self._steps: dict[State, dict[tuple[str, ...], _Step]] = {}
        self._total = Statistics()  # of the whole run: conditions at the root, successes = finished samples

    # What happened

    def record(
        self,
        prefix: Path,
        transition: Transition,
        conditions: int,
        successes: int,
        seconds: float,
        visits: float = 1.0,
        attempts: int | None = None,
    ) -> None:
        """One batch of `transition` after the sequence `prefix`.

        conditions: distinct conditioning prefixes consumed, each succeeded or finally given up; successes: how many
        succeeded; attempts: tries in total (default: one per condition); seconds: device time; visits: batches.
        Raises InputError for impossible numbers and for a sequence that is none.
        """
        if not 0 <= successes <= conditions or seconds < 0 or visits < 0:
            raise InputError(
                f"record of {transition}: {successes} successes of {conditions} conditions in {seconds} s, {visits} "
                "visits; expected 0 <= successes <= conditions and no negative number"
            )
        node = self._node((*prefix, transition))
        keep = self.discount**visits
        attempts = conditions if attempts is None else attempts
        for statistics in (node.statistics, node.step.operator.statistics):
            statistics.add(conditions, successes, attempts, seconds, visits, keep)
        finished = successes if node.step.target == self.transitions.full else 0
        self._total.add(0 if prefix else conditions, finished, 0, seconds, visits, keep)
        self._recorded(node)

    def _recorded(self, node: _Node) -> None:
        """Called after every record."""

    @property
    def rate(self) -> float:
        """Finished samples per second of device time, both discounted."""
        return self._total.successes / self._total.seconds if self._total.seconds else 0.0

    @property
    def seconds_per_rollout(self) -> float | None:
        """Device seconds per condition at the root, discounted; None before the first."""
        return self._total.seconds / self._total.conditions if self._total.conditions else None

    def operator_statistics(self) -> dict[Problem, Statistics]:
        """Pooled statistics of every operator that ran or was warm started."""
        return {p: o.statistics for p, o in self._operators.items() if o.statistics.visits > 0}

    # What is expected

    def predict_rate(self, path: Sequence[Transition]) -> float:
        """Predicted finished samples per second of device time when only this sequence is run.

        Uses the statistics of its own prefixes where there are some, those of its operators otherwise, and a guess
        (PRIOR_SUCCESS at `initial_cost`) for an operator that never ran. Raises InputError for an incomplete sequence.
        """
        path = tuple(path)
        state: State = path[-1].target if path else frozenset()
        if state != self.transitions.full:
            missing = ", ".join(self.transitions.graph.ordered(self.transitions.full - state))
            raise InputError(f"sequence {self.transitions.format(path)!r} leaves {missing} unassigned")
        node: _Node | None = self._root
        costs: dict[State, float] = {}
        for transition in path:
            step = self._step(transition)
            node = node.children.get(transition.new) if node else None
            success, cost = self._posterior(step, node)
            costs = _advance(costs, step, success, cost)
        return 1.0 / max(sum(costs.values()), 1e-300)

    def best_sequences(self, k: int = 1) -> list[tuple[Path, float]]:
        """The k sequences of greatest predicted rate, with that rate, out of operators that have run.

        On a small graph out of all sequences, on a large one out of those that were run to the end. The best ones may
        differ only in the order of independent steps, and then have equal rates.
        """
        paths = self._cheapest_paths(k) if self._states is not None else self._finished_paths()
        ranked = sorted(((path, self.predict_rate(path)) for path in paths), key=lambda pair: -pair[1])
        return ranked[:k]

    def _finished_paths(self) -> list[Path]:
        full = self.transitions.full
        return [node.path for node in self._visited() if node.step.target == full]

    def _cheapest_paths(self, k: int) -> list[Path]:
        """Forward search that keeps in every state the k partial sequences of least production cost."""
        partial: dict[State, list[tuple[float, dict[State, float], _Node | None, Path]]]
        partial = {state: [] for state in self._states}
        partial[frozenset()] = [(0.0, {}, self._root, ())]
        for state in self._states:
            labels = sorted(partial[state], key=lambda label: label[0])[:k]
            partial[state] = labels
            for step in self._steps_from(state).values():
                if step.operator.statistics.visits <= 0:
                    continue
                for _, costs, node, path in labels:
                    child = node.children.get(step.transition.new) if node else None
                    after = _advance(costs, step, *self._posterior(step, child))
                    partial[step.target].append((sum(after.values()), after, child, (*path, step.transition)))
        return [path for _, _, _, path in partial[self.transitions.full]]

    def _posterior(self, step: _Step, node: _Node | None) -> tuple[float, float]:
        """Expected success and seconds per condition of an edge; its operator's statistics are the prior."""
        operator = step.operator
        operator.predict(self.initial_cost)
        return self._blend(operator, node)

    def _blend(self, operator: _Operator, node: _Node | None) -> tuple[float, float]:
        if node is None or not node.statistics.conditions:
            return operator.success, operator.cost
        own, weight = node.statistics, min(operator.statistics.conditions, OPERATOR_WEIGHT)
        total = own.conditions + weight
        return (own.successes + weight * operator.success) / total, (own.seconds + weight * operator.cost) / total

    # Nodes and steps

    @cached_property
    def _states(self) -> list[State] | None:
        """All states by size, or None where there are more than ENUMERABLE transitions."""
        states: dict[State, None] = {frozenset(): None}
        for number, transition in enumerate(self.transitions.iterate()):
            if number >= ENUMERABLE:
                return None
            states[transition.target] = None
        return sorted(states, key=lambda state: (len(state), self.transitions.graph.ordered(state)))

    def _steps_from(self, state: State) -> dict[tuple[str, ...], _Step]:
        """The kept transitions out of a state, by their new variables, in the order of children()."""
        steps = self._steps.get(state)
        if steps is None:
            if self.retain:
                components = self.transitions.graph.components(state)
            else:
                components = (state,) if state else ()  # one item: lost as a whole
            steps = self._steps[state] = {}
            for transition in self.transitions.children(state):
                operator = self._operators.setdefault(transition.problem, _Operator(transition.problem))
                step = _Step(transition, operator, components)
                if not self.retain:
                    step.used, step.kept, step.made = components, (), step.target
                steps[transition.new] = step
        return steps

    def _step(self, transition: Transition) -> _Step:
        steps = self._steps_from(transition.given)
        if transition.new not in steps:
            available = ", ".join(str(step.transition) for step in steps.values()) or "nothing"
            raise InputError(f"{transition} is no kept transition at its state; available: {available}")
        return steps[transition.new]

    def _node(self, path: Iterable[Transition]) -> _Node:
        """The node of a sequence, made when it is new."""
        node: _Node = self._root
        state: State = frozenset()
        for transition in path:
            if transition.given != state:
                raise InputError(f"{transition} does not follow {self.transitions.format(node.path) or 'the start'!r}")
            child = node.children.get(transition.new)
            if child is None:
                child = node.children[transition.new] = _Node(node, self._step(transition))
            node.interior = True
            node, state = child, child.step.target
        return node

    def _visited(self) -> Iterator[_Node]:
        """Nodes with statistics of their own, parents first."""
        stack = [self._root]
        while stack:
            node = stack.pop()
            if node.statistics.visits > 0:
                yield node
            stack.extend(reversed(node.children.values()))

    # Files

    def _settings(self) -> dict[str, Any]:
        return {"retain": self.retain, "discount": self.discount, "initial_cost": self.initial_cost}

    def as_json(self) -> dict[str, Any]:
        """Everything that was learned, readable, ready for json.dump. Schema "cgs_jax.tree/1"."""
        graph = self.transitions.graph
        return {
            "schema": SCHEMA,
            "graph": graph.name,
            "fingerprint": graph.fingerprint,
            "kind": self.kind,
            "settings": self._settings(),
            "rate": self.rate,
            "totals": asdict(self._total),
            "operators": [
                {"new": list(new), "constraints": list(constraints), **_described(statistics)}
                for (new, constraints), statistics in self.operator_statistics().items()
            ],
            "sequences": [
                {"sequence": self.transitions.format(node.path), **_described(node.statistics), **self._value_of(node)}
                for node in self._visited()
            ],
        }

    def _value_of(self, node: _Node) -> dict[str, float]:
        return {}

    def _load(self, data: dict[str, Any]) -> None:
        operators = _operators_in(self.transitions, data)
        self._total = Statistics(**data["totals"])
        for problem, entry in operators.items():
            self._operators.setdefault(problem, _Operator(problem)).statistics = _read_statistics(entry)
        for entry in data["sequences"]:
            self._node(_read_prefix(self.transitions, entry["sequence"])).statistics = _read_statistics(entry)

    def warm_start(self, earlier: Sequence[dict[str, Any]], n_equiv: float) -> None:
        """Start from earlier instances of the same graph (paper, Section IV-C).

        Per edge and per operator the average over the earlier instances of success and of seconds per condition, not
        of Q: the price of time may be another one here. Weight: `n_equiv` visits, in batches of the mean size there,
        but no more visits than there were. Raises InputError for another graph, and if something was recorded already.
        """
        if self._total.visits:
            raise InputError("warm start comes before the first record; this chooser has records already")
        if not n_equiv > 0:
            raise InputError(f"n_equiv is {n_equiv} batches; expected more than 0")
        by_problem: dict[Problem, list[Statistics]] = {}
        by_path: dict[str, list[Statistics]] = {}
        totals = []
        for data in earlier:
            for problem, entry in _operators_in(self.transitions, data).items():
                by_problem.setdefault(problem, []).append(_read_statistics(entry))
            for entry in data["sequences"]:
                by_path.setdefault(entry["sequence"], []).append(_read_statistics(entry))
            totals.append(Statistics(**data["totals"]))
        for problem, statistics in by_problem.items():
            self._operators.setdefault(problem, _Operator(problem)).statistics = _averaged(statistics, n_equiv)
        for text, statistics in by_path.items():
            self._node(_read_prefix(self.transitions, text)).statistics = _averaged(statistics, n_equiv)
        totals = [total for total in totals if total.visits and total.seconds]
        if totals:
            # Samples per second are averaged as they are; the weight is n_equiv visits of the mean length.
            scale = [n_equiv / total.visits for total in totals]
            seconds = sum(s * t.seconds for s, t in zip(scale, totals)) / len(totals)
            rate = sum(t.successes / t.seconds for t in totals) / len(totals)
            roots = sum(t.conditions / t.seconds for t in totals) / len(totals)
            self._total = Statistics(conditions=roots * seconds, successes=rate * seconds, seconds=seconds)


class Tree(_Records):
    """UCT over sequences with a model-based backup.

    c_uct: weight of the exploration bonus, on values normalised to [0, 1] among siblings. reward: "rate" (time costs
    the discounted realised rate) or "rollout" (time costs one over the mean seconds per rollout).
    equivalent_visits: an operator's visits elsewhere count on an edge like up to so many visits of its own, so that
    not every child of every node is tried anew. retain: on failure the components which the failed transition does not
    touch are kept and combined again; without it the whole partial sample is dropped. discount: factor on old evidence
    per visit. initial_cost: guessed seconds per condition of an operator that never ran.

    Every kept transition is tried again and again: its bonus grows with the logarithm of its siblings' visits, while
    what its operator does elsewhere counts at most `equivalent_visits`.
    """

    kind = "tree"

    def __init__(
        self,
        transitions: Transitions,
        c_uct: float = 0.03,
        reward: Literal["rate", "rollout"] = "rate",
        retain: bool = True,
        equivalent_visits: float = 4.0,
        discount: float = 0.998,
        initial_cost: float = 1e-4,
    ) -> None:
        super().__init__(transitions, retain, discount, initial_cost)
        if reward not in ("rate", "rollout"):
            raise InputError(f"reward is {reward!r}; available: rate, rollout")
        if not c_uct > 0 or not equivalent_visits > 0:
            raise InputError(
                f"c_uct is {c_uct}, equivalent_visits is {equivalent_visits}; expected both above 0, so that no "
                "transition is given up for ever"
            )
        self.c_uct = c_uct
        self.reward = reward
        self.equivalent_visits = equivalent_visits
        self._below: dict[State, float | None] = {}  # values by state, from operators alone
        self._per_variable: dict[str, tuple[float, float]] = {}  # of a large graph
        self._nodes_evaluated = 0
        self._records_since_refresh = 0
        self._stale = True

    @property
    def price(self) -> float:
        """Finished samples that a second of device time is worth."""
        if self.reward == "rate":
            return self.rate
        seconds = self.seconds_per_rollout
        return 1.0 / seconds if seconds else 0.0

    @property
    def c_hat(self) -> float | None:
        """The cost c that makes lambda = 1/(c + 1): seconds per finished sample, or per rollout; None if unknown."""
        return 1.0 / self.price if self.price else None

    def select(self, ready: Ready | None = None) -> Path:
        """The sequence to run next, from the empty to the full set.

        ready: tells whether a transition's operator can run; asked of one transition per conditional problem. Without
        a complete sequence of ready transitions the answer is ().
        """
        self._ask_readiness(ready)
        if self._stale:
            self._refresh()
        price = self.price
        node: _Node = self._root
        state: State = frozenset()
        while state != self.transitions.full:
            children = self._expand(node, state)
            if not node.interior:
                self._guess(node, children, price)
            if self._any_unready:
                children = [child for child in children if self._may_go(child.step)]
            chosen = None
            while children and chosen is None:
                chosen = self._most_promising(children)
                # On a large graph only the chosen one is asked whether it leads to the end.
                if self._any_unready and not self._state_can_finish(chosen.step.target):
                    children.remove(chosen)
                    chosen = None
            if chosen is None:
                return ()
            node, state = chosen, chosen.step.target
        return node.path

    def _most_promising(self, children: list[_Node]) -> _Node:
        """Paper, Eq. 3, with Q normalised among siblings; ties go to the first."""
        counts, least, greatest = [], math.inf, -math.inf
        for child in children:
            pooled = child.step.operator.statistics.visits
            own = child.statistics.visits
            count = own + min(max(pooled - own, 0.0), self.equivalent_visits)
            if count <= 0.0:
                if self._states is not None:
                    return child  # never tried anywhere: infinite bonus, smallest first
                count = UNTRIED_VISITS
            counts.append(count)
            least, greatest = min(least, child.quality), max(greatest, child.quality)
        scale = 1.0 / (greatest - least) if greatest > least else 0.0
        # Fractions of a batch would make the logarithm negative, hence 1 +.
        log_n = math.log(1.0 + sum(counts))
        best, best_score = children[0], -math.inf
        for child, count in zip(children, counts):
            score = (child.quality - least) * scale + self.c_uct * _bonus(log_n / count)
            if score > best_score:
                best, best_score = child, score
        return best

    # Readiness

    _any_unready = False

    def _ask_readiness(self, ready: Ready | None) -> None:
        if ready is None and not self._any_unready:
            return
        self._finishes: dict[State, bool] = {self.transitions.full: True}
        self._ready = ready
        self._asked: dict[int, bool] = {}
        any_unready = False
        if self._states is not None:
            for operator, transition in self._representatives:
                now = ready is None or bool(ready(transition))
                self._stale |= now != operator.ready
                operator.ready = now
                any_unready |= not now
        else:
            # Not all operators are known: ask as they come.
            any_unready = ready is not None
            if ready is None:
                for operator in self._operators.values():
                    operator.ready = True
        self._any_unready = any_unready

    @cached_property
    def _representatives(self) -> list[tuple[_Operator, Transition]]:
        """Every operator of a small graph with one of its transitions."""
        first: dict[int, tuple[_Operator, Transition]] = {}
        for step in self._by_made:
            first.setdefault(id(step.operator), (step.operator, step.transition))
        return list(first.values())

    def _is_ready(self, step: _Step) -> bool:
        if self._states is not None or self._ready is None:
            return step.operator.ready
        key = id(step.operator)
        if key not in self._asked:
            self._asked[key] = step.operator.ready = bool(self._ready(step.transition))
        return self._asked[key]

    def _may_go(self, step: _Step) -> bool:
        """Is the step ready and, where that is cheap to tell, does it lead to the full set by ready ones?"""
        return self._is_ready(step) and (self._states is None or self._state_can_finish(step.target))

    def _state_can_finish(self, state: State) -> bool:
        known = self._finishes.get(state)
        if known is None:
            steps = self._steps_from(state).values()
            known = any(self._is_ready(step) and self._state_can_finish(step.target) for step in steps)
            self._finishes[state] = known
        return known

    # Values

    def _recorded(self, node: _Node) -> None:
        """Back up along the sequence at once; everything else follows at the next refresh."""
        self._records_since_refresh += 1
        operator = node.step.operator
        first_time = operator.statistics.visits <= node.statistics.visits <= 1.0
        # A refresh visits every edge of the tree: its cost is spread over a proportional number of records.
        if first_time or self._records_since_refresh > max(12, self._nodes_evaluated // 16):
            self._stale = True
        if self._stale:
            return
        operator.predict(self.initial_cost)
        price = self.price
        child, lineage = node, []
        while child.parent is not None:
            lineage.append(child)
            child = child.parent
        for child in reversed(lineage):
            self._produce(child.parent, child)
        for child in lineage:
            child.quality = self._quality(child.parent, child, child.value, price)
            parent = child.parent
            if not parent.expanded:
                self._stale = True
                return
            parent.value = max(self._allowed(parent.children.values()), default=parent.value)

    def _allowed(self, children: Iterable[_Node]) -> list[float]:
        """Qualities of the children that may be chosen; nothing is worth waiting for what is not ready."""
        if not self._any_unready:
            return [child.quality for child in children]
        return [child.quality for child in children if self._may_go(child.step)]

    def _produce(self, parent: _Node, child: _Node) -> None:
        success, cost = self._blend(child.step.operator, child)
        child.costs = _advance(parent.costs, child.step, success, cost)

    def _quality(self, parent: _Node, child: _Node, value: float, price: float) -> float:
        success, cost = self._blend(child.step.operator, child)
        for component in child.step.kept:
            cost -= (1.0 - success) * parent.costs[component]
        return success * value - price * cost

    def _expand(self, node: _Node, state: State) -> list[_Node]:
        """All children of a node in the order of the transitions."""
        if not node.expanded:
            steps = self._steps_from(state)
            known = node.children
            node.children = {new: known.get(new) or _Node(node, step) for new, step in steps.items()}
            node.expanded = True
        return list(node.children.values())

    def _guess(self, node: _Node, children: list[_Node], price: float) -> None:
        """Qualities of children on which nothing was recorded; a refresh leaves them out."""
        if node.parent is not None:
            self._produce(node.parent, node)
        for child in children:
            child.value = self._value_below(child.step.target)
            child.quality = self._quality(node, child, child.value, price)

    def _refresh(self) -> None:
        """Recompute all predictions: operators, values by state, and the tree."""
        for operator in self._operators.values():
            operator.predict(self.initial_cost)
        self._below = {self.transitions.full: 1.0}
        if self._states is not None:
            self._solve_states(self.price)
        else:
            self._per_variable = self._share_among_variables()
        self._nodes_evaluated = 0
        self._evaluate(self._root, self.price)
        self._records_since_refresh = 0
        self._stale = False

    def _evaluate(self, node: _Node, price: float) -> None:
        """Values of the recorded part of the tree, by what was recorded; of its leaves, by their states."""
        children = self._expand(node, node.step.target if node.step else frozenset())
        for child in children:
            if child.interior:
                self._produce(node, child)
                self._evaluate(child, price)
            else:
                child.value = self._value_below(child.step.target)
            child.quality = self._quality(node, child, child.value, price)
        self._nodes_evaluated += len(children)
        node.value = max(self._allowed(children), default=0.0)

    def _solve_states(self, price: float) -> None:
        """Dynamic programming over states with the operators' statistics, for what lies below the tree.

        First the least cost per item of every component that can be made, then the values backwards.
        """
        costs: dict[State, float] = {}
        for step in self._by_made:
            operator = step.operator
            if operator.ready:
                cost = operator.cost
                for component in step.used:
                    cost += costs.get(component, math.inf)
                cost /= operator.success
                if cost < costs.get(step.made, math.inf):
                    costs[step.made] = cost
        below = self._below
        for state, steps in self._backwards:
            best = None
            for step in steps:
                operator, beyond = step.operator, below[step.target]
                if beyond is None or not operator.ready:
                    continue
                success, cost = operator.success, operator.cost
                for component in step.kept:
                    cost -= (1.0 - success) * costs.get(component, 0.0)
                quality = success * beyond - price * cost
                if best is None or quality > best:
                    best = quality
            below[state] = best

    @cached_property
    def _by_made(self) -> list[_Step]:
        """All steps of a small graph, those that make small components first."""
        steps = [step for state in self._states for step in self._steps_from(state).values()]
        return sorted(steps, key=lambda step: len(step.made))

    @cached_property
    def _backwards(self) -> list[tuple[State, list[_Step]]]:
        """The states of a small graph with their steps, from just before the full set to the empty one."""
        return [(state, list(self._steps_from(state).values())) for state in reversed(self._states[:-1])]

    def _value_below(self, state: State) -> float:
        """Value of a state by the operators' statistics alone: the best one on a small graph.

        On a large graph an optimistic guess that needs no enumeration: every variable is assigned at the success per
        variable of the best operator that ever assigned it. The plain bound of one would send the search through all
        children of all nodes before it compared any two.
        """
        value = self._below.get(state)
        if value is None:
            value = 0.0
            if self._states is None:
                success, cost = 1.0, 0.0
                for name in self.transitions.full.difference(state):
                    share = self._per_variable.get(name)
                    if share is not None:
                        success, cost = success * share[0], cost + share[1]
                value = self._below[state] = success - self.price * cost
        return value

    def _share_among_variables(self) -> dict[str, tuple[float, float]]:
        """Greatest success per variable, and that operator's seconds per variable, of the variables ever assigned."""
        shares: dict[str, tuple[float, float]] = {}
        for (new, _), operator in self._operators.items():
            if operator.statistics.conditions and operator.ready:
                success, cost = operator.success ** (1.0 / len(new)), operator.cost / len(new)
                for name in new:
                    if name not in shares or shares[name][0] < success:
                        shares[name] = success, cost
        return shares

    # Files

    def _settings(self) -> dict[str, Any]:
        own = {"c_uct": self.c_uct, "reward": self.reward, "equivalent_visits": self.equivalent_visits}
        return {**own, **super()._settings()}

    def as_json(self) -> dict[str, Any]:
        self._refresh()
        return super().as_json()

    def _value_of(self, node: _Node) -> dict[str, float]:
        return {"q": self._quality(node.parent, node, node.value, self.price)}

    def warm_start(self, earlier: Sequence[dict[str, Any]], n_equiv: float) -> None:
        super().warm_start(earlier, n_equiv)
        self._stale = True

    @classmethod
    def from_json(cls, transitions: Transitions, data: dict[str, Any]) -> Tree:
        """The tree that as_json() described. Raises InputError for another schema or another graph."""
        _operators_in(transitions, data)
        settings = data["settings"]
        fields = ("c_uct", "reward", "retain", "equivalent_visits", "discount", "initial_cost")
        tree = cls(transitions, **{name: settings[name] for name in fields if name in settings})
        tree._load(data)
        return tree


class Fixed(_Records):
    """Always the same sequence (the paper's experts). settings: retain, discount, initial_cost as for Tree."""

    kind = "fixed"

    def __init__(self, transitions: Transitions, path: Sequence[Transition], **settings: Any) -> None:
        super().__init__(transitions, **settings)
        self.path = tuple(path)
        self._node(self.path)
        if not self.path or self.path[-1].target != transitions.full:
            raise InputError(f"sequence {transitions.format(self.path)!r} does not assign all variables")

    def select(self, ready: Ready | None = None) -> Path:
        """The sequence, or () while one of its operators is not ready."""
        return self.path if ready is None or all(map(ready, self.path)) else ()


class Random(_Records):
    """In every state any kept transition with equal probability (the paper's Rand): no learning."""

    kind = "random"

    def __init__(self, transitions: Transitions, seed: int = 0, **settings: Any) -> None:
        super().__init__(transitions, **settings)
        self._generator = random.Random(seed)

    def select(self, ready: Ready | None = None) -> Path:
        """A random sequence of ready transitions; () if there is none."""
        finishes: dict[State, bool] = {self.transitions.full: True}

        def options(state: State) -> list[Transition]:
            children = self.transitions.children(state)
            return [t for t in children if ready is None or (ready(t) and can_finish(t.target))]

        def can_finish(state: State) -> bool:
            if state not in finishes:
                finishes[state] = any(ready(t) and can_finish(t.target) for t in self.transitions.children(state))
            return finishes[state]

        path: list[Transition] = []
        state: State = frozenset()
        while state != self.transitions.full:
            available = options(state)
            if not available:
                return ()
            path.append(self._generator.choice(available))
            state = path[-1].target
        return tuple(path)


def _bonus(x: float) -> float:
    """sqrt(x) with x = ln N / n_i as in the paper, but x^2 / 4 where that is more: for n_i below 0.4 ln N.

    A model-based Q wants a small c_uct (0.03: near ties are told apart by few batches). With the square root alone the
    worst child would then come back when ln N = n_i / c_uct^2, that is never. With the square it comes back when
    ln N = 2 n_i / sqrt(c_uct), for the first time at N = 10^5, for a bonus that only hardly tried children have.
    """
    return max(math.sqrt(x), 0.25 * x * x)


def _advance(costs: dict[State, float], step: _Step, success: float, cost: float) -> dict[State, float]:
    """Production cost per item of every component after a step, in device seconds."""
    after = {component: costs[component] for component in step.kept}
    after[step.made] = (sum(costs[component] for component in step.used) + cost) / max(success, 1e-12)
    return after


def _described(statistics: Statistics) -> dict[str, float | None]:
    return {
        **asdict(statistics),
        "success_rate": statistics.success_rate,
        "seconds_per_condition": statistics.seconds_per_condition,
    }


def _read_statistics(entry: dict[str, Any]) -> Statistics:
    return Statistics(**{name: float(entry[name]) for name in Statistics.__dataclass_fields__})


def _read_prefix(transitions: Transitions, text: str) -> Path:
    """The transitions of a partial sequence."""
    path: list[Transition] = []
    state: State = frozenset()
    for part in text.split(";"):
        new = tuple(name.strip() for name in part.strip().strip("()").split(","))
        transition = next((t for t in transitions.children(state) if t.new == new), None)
        if transition is None:
            raise InputError(f"tree file: {part.strip()} is no kept transition in {text!r}")
        path.append(transition)
        state = transition.target
    return tuple(path)


def _operators_in(transitions: Transitions, data: dict[str, Any]) -> dict[Problem, dict[str, Any]]:
    """The operator entries of a tree file. Raises InputError for another schema or another graph."""
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        found = data.get("schema") if isinstance(data, dict) else type(data).__name__
        raise InputError(f"tree file has schema {found!r}; expected {SCHEMA!r}")
    graph = transitions.graph
    if data.get("fingerprint") != graph.fingerprint:
        raise InputError(
            f"tree file is for graph {data.get('graph')!r} ({data.get('fingerprint')}); "
            f"expected {graph.name!r} ({graph.fingerprint})"
        )
    return {(tuple(entry["new"]), tuple(entry["constraints"])): entry for entry in data["operators"]}


def _averaged(earlier: list[Statistics], n_equiv: float) -> Statistics:
    """Mean success and mean seconds per condition over instances, with the weight of n_equiv batches."""
    earlier = [statistics for statistics in earlier if statistics.conditions]
    if not earlier:
        return Statistics()
    visits = min(n_equiv, sum(statistics.visits for statistics in earlier))
    per_visit = sum(s.conditions / max(s.visits, 1e-9) for s in earlier) / len(earlier)
    conditions = visits * per_visit
    tries = sum(s.attempts / s.conditions for s in earlier) / len(earlier)
    success = sum(s.success_rate for s in earlier) / len(earlier)
    seconds = sum(s.seconds_per_condition for s in earlier) / len(earlier)
    return Statistics(visits, conditions, conditions * success, conditions * tries, conditions * seconds)
