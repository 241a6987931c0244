"""Which conditional operator to run next: upper confidence trees over assignment sequences (paper, Section V-A).

What differs from plain UCT, and why:

* The value Q is formed from successes and time (`histories`) when it is needed, at the price of time of that moment.
* Q is a model-based backup: an edge's success times the best value behind it. Sampled returns need far more rollouts.
* The *incumbent*, the best sequence that was run to the end, is run unless another promises clearly more or it is time to
  explore: near ties cost more than they are worth, since what was made for one waits in pools while another is run.
* Visits are counted in batches. Q is normalised among siblings by what the best of them could gain, so that `c_uct`
  depends neither on the unit of time nor on how rare samples are.

The reward is the paper's lambda * r_t + (1 - lambda) * r_g with lambda = 1/(c + 1), divided by (1 - lambda): success
minus time * price, price = 1/c. With c the cost per *finished sample* this is Dinkelbach's rule, whose maximum is the
most samples per second. The realised rate lags behind what was learned, and at too low a price of time what succeeds
often seems better than what is quick: the price is the best predicted rate of any sequence (Dinkelbach's fixed point on
the model), on large graphs that of the sequence of greatest Q once it has been run to the end. With c the cost per
rollout time is priced too dear and what fails fast is preferred.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from operator import attrgetter
from typing import Any, Literal, Protocol

from cgs_jax.errors import InputError
from cgs_jax.histories import (
    SUCCESS_BOUNDS,
    VISIT_TRIES,
    Counts,
    Edge,
    History,
    Node,
    PooledOperator,
    Records,
    Step,
    operators_in,
)
from cgs_jax.transitions import Path, State, Transition, Transitions

Ready = Callable[[Transition], bool]

UNTRIED_VISITS = 1.0
"""What was never tried counts as visited this often, instead of never: it is tried when it promises something, not first.
Its bonus still grows without bound."""

PRICE_STEPS = 2
"""Steps of Dinkelbach's iteration at a refresh; the first one or two make most of the difference."""

CURIOSITY = 0.025
"""First trials of operators may take this share of the time in the beginning (`CURIOUS_SECONDS`)."""

CURIOUS_SECONDS = 16.0
"""Time of the workers after which that share thins out as the logarithm does: what promises nothing mostly goes on doing so."""

KEEN_CURIOSITY = 0.15
"""Those of operators that may make the best sequence may take so much after `KEEN_AFTER`, unless the start was warm."""

KEEN_AFTER = 4.0
"""Seconds that workers spend on batches before that, and before a warm start explores: the first samples come first."""

UNTRIED_HOPE = 2.5
"""What never ran may do better than guessed by so many times what is usual."""

TRIAL_SECONDS = 0.1
"""What a first trial takes a worker, with the reading of programs: after a warm start so much must have been saved for it."""

CURIOUS_EVERY = 4
"""Only one choice in so many asks for a first trial: what it reads may have to be made before, and that takes time too."""

EXPLORATION = 20.0
"""Batches that may go into sequences which promise hardly more than the incumbent, the best one that was run to the end, for
every factor e of batches beyond so many: near ties cost more than they are worth, since what was made for one waits while
another is run. Exploration thins out as the logarithm does in UCB."""

SLIGHT_PROMISE = 1.03
"""What promises more than the incumbent by this factor is looked at, however much was explored, in small batches: it becomes
the incumbent, or soon promises no more."""

PROMISE = 1.1
"""What promises so much more is run at once in full batches, however much was explored."""

FIRST_PROMISE = 2.0
"""After a warm start what was not run here yet must promise so much more until `KEEN_AFTER`, and `PROMISE` times as much from
then on: what other instances promise often does not hold, and it takes half a second each to tell."""

LOOK_EVERY = 2
"""One choice in so many looks at those of the earlier instances' portfolio that were not run here yet."""

LOOK_SUCCESSES = 4.0
"""And goes on until so many finished samples tell what they make, or that is hopeless."""

UNLIKE = 0.5
"""But where the incumbent makes less than this share of what it made of the earlier instances on average, this instance is
unlike them, and `PROMISE` is enough from the beginning."""

DISAPPOINTED = 12
"""Records after which another best sequence is looked for when that of the last refresh is none any more."""

REFRESH_SHARE = 16.0
"""All predictions are renewed when so many times as many batches as since the last time were run before it."""

SETTLING = 256.0
"""Batches until then. Later the time between grows with their square: by then little changes, and renewing takes time from the
workers where these have all cores."""

MOST_UNREFRESHED = 128.0
"""And at the latest after so many records, though a large tree may take longer."""

HARDLY_MORE = 1.01
"""Half of the exploration goes into the sequence that would be the best, by this factor, if its first looks are believed."""

BELIEVED_LABELS = 3
"""Partial sequences that are kept in every state in the search for that one: the best one need not begin with the cheapest."""

HOPELESS = 0.3
"""A sequence that would make less than this share of the incumbent's rate, if its first looks are believed, is not looked at
further: often one step succeeds once in fifty times."""

CLEARLY_MORE = 1.02
"""By what factor another sequence must be predicted to be better before it takes the incumbent's place."""


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
        attempts: Counts,
        successes: Counts,
        seconds: float,
        visits: float = 1.0,
        spent: float | None = None,
    ) -> None: ...

    def tries(self, prefix: Path, transition: Transition) -> int: ...


class Tree(Records):
    """UCT over sequences with a model-based backup.

    c_uct: weight of the exploration bonus, on values normalised among siblings. reward: "rate" (time costs the
    discounted realised rate, or the best predicted rate where that is more) or "rollout" (time
    costs one over the mean seconds per rollout).
    equivalent_visits: an operator's visits after other histories count on an edge like up to so many visits of its own,
    so that not every child of every node is tried anew. retain: on failure the components which the failed transition
    does not touch are kept and combined again; without it the whole partial sample is dropped. discount: factor on old
    evidence per visit. initial_cost: guessed seconds per try of an operator that makes one configuration and never ran.

    Every kept transition is tried again and again: its bonus grows with the logarithm of its siblings' visits, while
    what its operator does elsewhere counts at most `equivalent_visits`.
    """

    kind = "tree"

    def __init__(
        self,
        transitions: Transitions,
        c_uct: float = 0.005,
        reward: Literal["rate", "rollout"] = "rate",
        retain: bool = True,
        equivalent_visits: float = 4.0,
        discount: float = 0.998,
        initial_cost: float = 2.5e-5,
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
        self._below: dict[State, tuple[float, float] | None] = {}  # value and reach by state, from operators alone
        self._per_variable: dict[str, tuple[float, float]] = {}  # of a large graph
        self._attainable = 0.0  # samples per second
        self._choices = 0
        self._untried_at = -1  # epoch
        self._untried: tuple[float, Path] = (-math.inf, ())
        self._earlier_batches = 0.0  # of an earlier instance
        self._expected = 0.0  # rate of the first sequence of the portfolio on earlier instances, samples per second
        self._incumbent: Path = ()
        self._promised: Path = ()
        self._believed: Path = ()  # would be better than the incumbent if its first looks told the truth
        self._advantage = 0.0  # greatest predicted rate over the incumbent's, at the last refresh of a small graph
        self._of_incumbent: frozenset[History] = frozenset()
        self._prefixes: dict[State, list[Path]] = {}  # to every state of a small graph the cheapest one
        self._epoch = 0  # of the values: they change with the price too
        self._edges_evaluated = 0
        self._records_since_refresh = 0
        self._stale = True

    @property
    def price(self) -> float:
        """Finished samples that a second of device time is worth."""
        if self.reward == "rate":
            return max(self.rate, self._attainable)
        seconds = self.seconds_per_rollout
        return 1.0 / seconds if seconds else 0.0

    @property
    def incumbent(self) -> Path:
        """The sequence that is run unless another promises more; () until there is one."""
        return self._incumbent

    @property
    def promised(self) -> Path:
        """The sequence that was last run because it promised clearly more than the incumbent (`PROMISE`)."""
        return self._promised

    @property
    def c_hat(self) -> float | None:
        """The cost c that makes lambda = 1/(c + 1): seconds per finished sample, or per rollout; None if unknown."""
        return 1.0 / self.price if self.price else None

    def select(self, ready: Ready | None = None) -> Path:
        """The sequence to run next, from the empty to the full set.

        ready: tells whether a transition's operator can run; asked of one transition per conditional problem. Without
        a complete sequence of ready transitions the answer is (). That is the incumbent, unless there is none, another one
        is predicted to be better (`SLIGHT_PROMISE`), or it is time to explore (`EXPLORATION`) or to try an operator that never
        ran (`CURIOSITY`).
        """
        self._ask_readiness(ready)
        if self._stale:
            self._refresh()
        price = self.price
        self._choices += 1
        if self._portfolio and (path := self._unseen_of_portfolio()):
            return path
        untried = self._path_to_untried() if self._curious else ()
        if untried:
            return untried
        incumbent = self._incumbent
        if not incumbent or self._any_unready and not all(self._is_ready(self._step(t)) for t in incumbent):
            return self._promising(price)
        exploring = self._total.explored < self._allowed_to_explore
        if exploring and self._believed and self._choices % 2:
            # Half of the exploration tells whether what did well at its first looks goes on to.
            return self._believed
        if exploring or self._states is None:
            path = self._promising(price)
            if exploring and path != incumbent:
                return path
        else:
            path = ()
        # The greatest of all predicted rates, whether it was run to the end or not.
        path = next(iter(self._prefixes.get(self.transitions.full, ())), path)
        if not path or path == incumbent:
            return incumbent
        more = CLEARLY_MORE if exploring else SLIGHT_PROMISE
        # What was not run here promises what others made of it, or what its operators did on average.
        if self._portfolio and not all(history.statistics.visits for history in self._made_along(path)[1]):
            as_expected = self._rate_now(incumbent) >= UNLIKE * self._expected
            more = FIRST_PROMISE if self._total.spent < KEEN_AFTER and as_expected else PROMISE
        if self._states is not None and self._advantage <= more:
            return incumbent
        # By what is known now, not at the last refresh: what disappoints at its first steps is not followed to the end.
        promise = self._rate_now(path) / self._rate_now(incumbent)
        if promise > more:
            if promise > PROMISE:
                self._promised = path
            return path
        self._stale |= self._records_since_refresh > DISAPPOINTED
        return incumbent

    def hopeless(self, path: Path) -> bool:
        """Whether what is known of a sequence tells that it is far below the incumbent, whatever its other steps do."""
        if not self._incumbent:
            return False
        components, _ = self._made_along(path)
        cost = sum(self._renewed(history).believed_cost for history in components)
        return cost * HOPELESS * self._rate_now(self._incumbent) > 1.0

    def _unseen_of_portfolio(self) -> Path:
        """A sequence of the portfolio that is to be looked at here; () where all were or that must wait."""
        if self._choices % LOOK_EVERY or self._total.spent >= KEEN_AFTER:
            return ()
        for path in self._portfolio[1:]:
            last = self._made_along(path)[1][-1]
            is_known = sum(last.statistics.successes) >= LOOK_SUCCESSES or self.hopeless(path)
            if not is_known and all(self._is_ready(self._step(transition)) for transition in path):
                return path
        return ()

    def _promising(self, price: float) -> Path:
        """The sequence that the tree chooses by Q and bonus, step by step; () where none is ready."""
        node = self._root
        path: list[Transition] = []
        while node.state != self.transitions.full:
            edges = self._expand(node)
            if not node.visited:
                for edge in edges:
                    self._evaluate_edge(edge, price)
            if self._any_unready:
                edges = [edge for edge in edges if self._may_go(edge.step)]
            chosen = None
            while edges and chosen is None:
                chosen = self._most_promising(edges)
                # On a large graph only the chosen one is asked whether it leads to the end.
                if self._any_unready and not self._state_can_finish(chosen.step.target):
                    edges.remove(chosen)
                    chosen = None
            if chosen is None:
                return ()
            path.append(chosen.step.transition)
            node = self._behind(chosen)
        return tuple(path)

    @property
    def _allowed_to_explore(self) -> float:
        """Batches that may have gone by now into other sequences than the incumbent."""
        if self._portfolio and self._total.spent < KEEN_AFTER:
            return 0.0
        # After a warm start as little from the beginning as at the end of the earlier runs.
        return EXPLORATION * math.log1p(self._total.batches / (self._earlier_batches + EXPLORATION))

    def _spend(self, history: History, seconds: float, is_first_trial: bool) -> None:
        if self._incumbent:
            self._total.batches += 1.0
            self._total.spent += seconds
            self._total.first_trials += seconds * is_first_trial
            self._total.explored += history not in self._of_incumbent

    def _renew_incumbent(self) -> None:
        """The sequence of greatest predicted rate of those that were run to the end, if that is clearly more; after a warm
        start the first one of the portfolio, until another was."""
        if self.reward != "rate":
            return
        if not self._incumbent and self._portfolio:
            self._incumbent = self._portfolio[0]
            self._of_incumbent = frozenset(self._made_along(self._incumbent)[1])
        rates = [(self._rate_of(path), path) for path in self._finished_paths(self._made_here)]
        rate, path = max(rates, default=(0.0, ()), key=lambda pair: pair[0])
        if path and (not self._incumbent or rate > CLEARLY_MORE * self._rate_of(self._incumbent)):
            self._incumbent, self._of_incumbent = path, frozenset(self._made_along(path)[1])

    @property
    def _curious(self) -> bool:
        """Is it time to ask for a first trial?"""
        return self._states is not None and not self._choices % CURIOUS_EVERY and self._may_try(keen=True)

    def _may_try(self, keen: bool = False) -> bool:
        """Did first trials take less than their share of the time? keen: of what may make the best sequence."""
        allowed = CURIOSITY * CURIOUS_SECONDS * math.log1p(self._total.spent / CURIOUS_SECONDS)
        if self._earlier_batches:
            return self._total.first_trials + TRIAL_SECONDS <= allowed
        if keen:
            allowed = max(allowed, KEEN_CURIOSITY * (self._total.spent - KEEN_AFTER))
        return self._total.first_trials <= allowed

    def _path_to_untried(self) -> Path:
        """A sequence with the operator that never ran and promises most; () where all have run or it is too early.

        What it promises is the rate of the best sequence with it, if it does better than guessed as those do that do so
        (`UNTRIED_HOPE`), and everything else as is expected.
        """
        if self._untried_at != self._epoch:
            self._untried_at, self._untried = self._epoch, self._most_promising_untried()
        promise, path = self._untried
        return path if promise > 0.0 or self._may_try() else ()

    def _most_promising_untried(self) -> tuple[float, Path]:
        """1 - price * seconds per sample of that sequence, below 0 where it is worse than the best one; and the sequence."""
        price = self.price
        below = self._values_of_states(price, attrgetter("within"))
        hope = math.exp(UNTRIED_HOPE * self._outlook.surprise)
        best: tuple[float, Path] = (-math.inf, ())
        for state, steps in self._backwards:
            untried = [(s, kept) for s, kept in steps if s.operator.ready and not s.operator.statistics.visits]
            for path in self._prefixes.get(state, []) if untried else ():
                components, _ = self._made_along(path)
                cost_of = {component.made: self._predicted(component).item_cost for component in components}
                for step, kept in untried:
                    operator, beyond = step.operator, below[step.target]
                    if beyond is None:
                        continue
                    success = min(hope * operator.hazards[0], SUCCESS_BOUNDS[1])
                    at_stake = (1.0 - success) * sum(cost_of[component] for component in kept)
                    cost = sum(cost_of.values()) + operator.seconds_per_try - at_stake
                    promise = (success * beyond[0] - price * cost) / max(success * beyond[1], 1e-12)
                    if promise > best[0]:
                        best = promise, (*path, step.transition)
        return (best[0], self._completed(best[1])) if best[1] else best

    def _completed(self, path: Path) -> Path:
        """The sequence with the steps of greatest value behind, by operators alone."""
        while path[-1].target != self.transitions.full:
            best = None
            for step in self._steps_from(path[-1].target).values():
                beyond = self._below.get(step.target)
                if step.operator.ready and beyond is not None:
                    success = step.operator.hopeful[-1][0]
                    value = success * beyond[0] - self.price * step.operator.hopeful[-1][1] * step.operator.seconds_per_try
                    if best is None or value > best[0]:
                        best = value, step.transition
            if best is None:
                return ()
            path = (*path, best[1])
        return path

    def _most_promising(self, edges: list[Edge]) -> Edge:
        """Paper, Eq. 3, with Q normalised among siblings; ties go to the first.

        From the best one's Q down by its probability to finish, that is, by all that could be gained: between the
        least and the greatest, one hopeless sibling would make all others look alike.
        """
        counts = []
        for edge in edges:
            pooled = edge.step.operator.statistics.visits
            own = edge.history.statistics.visits + edge.history.borrowed.visits
            count = own + min(max(pooled - own, 0.0), self.equivalent_visits)
            counts.append(count or UNTRIED_VISITS)
        greatest = max(edges, key=lambda edge: edge.quality)
        # Fractions of a batch would make the logarithm negative, hence 1 +.
        log_n = math.log(1.0 + sum(counts))
        best, best_score = edges[0], -math.inf
        for edge, count in zip(edges, counts):
            deficit = (greatest.quality - edge.quality) / max(greatest.reach, 1e-12)
            score = self.c_uct * _bonus(log_n / count) - min(deficit, 1.0)
            if score > best_score:
                best, best_score = edge, score
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
    def _representatives(self) -> list[tuple[PooledOperator, Transition]]:
        """Every operator of a small graph with one of its transitions."""
        first: dict[int, tuple[PooledOperator, Transition]] = {}
        for step, _ in self._by_made:
            first.setdefault(id(step.operator), (step.operator, step.transition))
        return list(first.values())

    def _is_ready(self, step: Step) -> bool:
        if self._states is not None or self._ready is None:
            return step.operator.ready
        key = id(step.operator)
        if key not in self._asked:
            self._asked[key] = step.operator.ready = bool(self._ready(step.transition))
        return self._asked[key]

    def _may_go(self, step: Step) -> bool:
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

    def _recorded(self, lineage: list[Edge]) -> None:
        """Back up along the sequence at once; everything else follows at the next refresh."""
        self._records_since_refresh += 1
        made = lineage[-1].history
        first_time = made.statistics.visits <= 1.0 and (
            made.operator.statistics.visits <= made.statistics.visits or made.made == self.transitions.full
        )
        # A refresh visits every edge of the tree: its cost is spread over a proportional number of records. Early ones change
        # more than late ones.
        visits = self._total.visits
        share = min(visits / REFRESH_SHARE * max(visits / SETTLING, 1.0), MOST_UNREFRESHED)
        if first_time or self._records_since_refresh > max(DISAPPOINTED, share, self._edges_evaluated // 16):
            self._stale = True
        if self._stale:
            return
        made.operator.predict(self._outlook)
        made.predict()
        price = self.price
        for edge, node in zip(reversed(lineage), reversed([self._root, *map(self._behind, lineage[:-1])])):
            self._evaluate_edge(edge, price)
            self._back_up(node)

    def _back_up(self, node: Node) -> None:
        """Value of a node: that of its best edge; nothing is worth waiting for what is not ready."""
        best = max(self._allowed(node.edges.values()), key=lambda edge: edge.quality, default=None)
        node.value, node.reach = (best.quality, best.reach) if best else (0.0, 0.0)

    def _allowed(self, edges: Iterable[Edge]) -> Iterable[Edge]:
        return [edge for edge in edges if self._may_go(edge.step)] if self._any_unready else edges

    def _refresh(self) -> None:
        """Recompute all predictions: operators, values by state, and the tree."""
        self._predict_operators()
        self._attainable = 0.0
        if self._states is not None:
            greatest = self._greatest_rate()
            if self.reward == "rate":
                self._attainable = greatest
            self._value_at(self.price)
        else:
            self._per_variable = self._share_among_variables()
            self._value_at(self.price)
            for _ in range(PRICE_STEPS if self.reward == "rate" else 0):
                attainable = self._rate_of_the_best()
                if attainable <= 1.1 * self.price:
                    break
                self._attainable = attainable
                self._value_at(self.price)
        self._renew_incumbent()
        self._compare_with_incumbent()
        self._records_since_refresh = 0
        self._stale = False

    def _compare_with_incumbent(self) -> None:
        """What others promise over the incumbent, by all predictions and if first looks are believed. For small graphs."""
        full = self.transitions.full
        if not self._incumbent or not self._prefixes.get(full):
            return
        rate = self._rate_of(self._incumbent)
        self._advantage = self._rate_of(self._prefixes[full][0]) / rate
        path = self._cheapest_paths(
            BELIEVED_LABELS, lambda step: step.operator.ready, cost_of=attrgetter("believed_cost")
        )[full][0]
        components, _ = self._made_along(path)
        believed_cost = sum(history.believed_cost for history in components)
        self._believed = path if believed_cost * HARDLY_MORE * rate < 1.0 else ()

    def _greatest_rate(self) -> float:
        """Predicted rate of the best of all sequences that are ready; 0 without one. For small graphs."""
        self._prefixes = self._cheapest_paths(1, lambda step: step.operator.ready)
        return max(map(self._rate_of, self._prefixes[self.transitions.full]), default=0.0)

    def _value_at(self, price: float) -> None:
        """Values of all states and nodes at a price of time."""
        self._epoch += 1
        self._edges_evaluated = 0
        if self._states is not None:
            self._below = self._values_of_states(price, attrgetter("hopeful"))
        else:
            self._below = {self.transitions.full: (1.0, 1.0)}
        self._evaluate(self._root, price)

    def _rate_of_the_best(self) -> float:
        """Predicted rate of the sequence of greatest Q; 0 where it was not run yet to the end. For large graphs."""
        node = self._root
        while node.state != self.transitions.full:
            edges = node.edges.values() if node.visited else ()
            best = max(self._allowed(edges), key=lambda edge: edge.quality, default=None)
            if best is None or best.history.statistics.tries < VISIT_TRIES:
                return 0.0
            node = self._behind(best)
        return 1.0 / max(sum(self._predicted(history).item_cost for history in node.components), 1e-300)

    def _evaluate(self, node: Node, price: float) -> None:
        """Values of the visited part of the tree, by its histories; of its leaves, by their states."""
        node.epoch = self._epoch
        edges = self._expand(node)
        for edge in edges:
            self._evaluate_edge(edge, price)
        self._edges_evaluated += len(edges)
        self._back_up(node)

    def _evaluate_edge(self, edge: Edge, price: float) -> None:
        if edge.node is None:
            edge.node = self._nodes.get(frozenset((*edge.kept, edge.history)))
        node = edge.node
        if node is not None and node.visited and node.state != self.transitions.full:
            if node.epoch != self._epoch:
                self._evaluate(node, price)
            edge.value, reach = node.value, node.reach
        else:
            edge.value, reach = self._value_below(edge.step.target)
        history = self._predicted(edge.history)
        success, cost = history.hopeful_success, history.hopeful_cost
        for component in edge.kept:
            cost -= (1.0 - success) * self._predicted(component).item_cost
        edge.quality = success * edge.value - price * cost
        edge.reach = success * reach

    def _values_of_states(
        self, price: float, outcomes: Callable[[PooledOperator], list[tuple[float, float]]]
    ) -> dict[State, tuple[float, float] | None]:
        """Value and reach by state, from operators alone: dynamic programming on a small graph. None where nothing is ready.

        First the least cost per item of every component that can be made, then the values backwards. outcomes: success of an
        operator and mean number of tries, within one try, two tries and so on.
        """
        costs: dict[State, float] = {}
        for step, _ in self._by_made:
            if step.operator.ready:
                cost = step.operator.seconds_per_item(sum(costs.get(component, math.inf) for component in step.used))
                if cost < costs.get(step.made, math.inf):
                    costs[step.made] = cost
        values: dict[State, tuple[float, float] | None] = {self.transitions.full: (1.0, 1.0)}
        for state, steps in self._backwards:
            best = None
            for step, kept in steps:
                operator, beyond = step.operator, values[step.target]
                if beyond is None or not operator.ready:
                    continue
                at_stake = sum(costs.get(component, 0.0) for component in kept)
                for success, tries in outcomes(operator):
                    cost = tries * operator.seconds_per_try - (1.0 - success) * at_stake
                    quality = success * beyond[0] - price * cost
                    if best is None or quality > best[0]:
                        best = quality, success * beyond[1]
            values[state] = best
        return values

    def _with_kept(self, state: State) -> list[tuple[Step, tuple[State, ...]]]:
        """The steps out of a state with the components that their failure leaves."""
        components = self.transitions.graph.components(state) if self.retain else ()
        steps = self._steps_from(state).values()
        return [(step, tuple(c for c in components if c not in step.used)) for step in steps]

    @cached_property
    def _by_made(self) -> list[tuple[Step, tuple[State, ...]]]:
        """All steps of a small graph, those that make small components first."""
        steps = [pair for _, pairs in self._backwards for pair in pairs]
        return sorted(reversed(steps), key=lambda pair: len(pair[0].made))

    @cached_property
    def _backwards(self) -> list[tuple[State, list[tuple[Step, tuple[State, ...]]]]]:
        """The states of a small graph with their steps, from just before the full set to the empty one."""
        return [(state, self._with_kept(state)) for state in reversed(self._states[:-1])]

    def _value_below(self, state: State) -> tuple[float, float]:
        """Value and reach of a state by the operators' statistics alone: the best ones on a small graph.

        On a large graph an optimistic guess that needs no enumeration: every variable is assigned at the success per
        variable of the best operator that ever assigned it. The plain bound of one would send the search through all
        children of all nodes before it compared any two.
        """
        known = self._below.get(state)
        if known is None:
            known = 0.0, 0.0
            if self._states is None:
                success, cost = 1.0, 0.0
                for name in self.transitions.full.difference(state):
                    share = self._per_variable.get(name)
                    if share is not None:
                        success, cost = success * share[0], cost + share[1]
                known = self._below[state] = success - self.price * cost, success
        return known

    def _share_among_variables(self) -> dict[str, tuple[float, float]]:
        """Greatest success per variable, and that operator's seconds per variable, of the variables ever assigned."""
        shares: dict[str, tuple[float, float]] = {}
        for (new, _), operator in self._operators.items():
            if operator.statistics.attempts and operator.ready:
                within, tries = operator.within[-1]
                success, cost = within ** (1.0 / len(new)), tries * operator.seconds_per_try / len(new)
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

    def _value_of(self, history: History) -> dict[str, float]:
        return {"q": self._follow(history.prefixes[0])[-1].quality}

    def add(self, data: dict[str, Any]) -> None:
        super().add(data)
        self._stale = True

    def warm_start(self, earlier: Sequence[dict[str, Any]], n_equiv: float) -> None:
        super().warm_start(earlier, n_equiv)
        self._earlier_batches = sum(data["totals"].get("batches", 0.0) for data in earlier) / max(len(earlier), 1)
        if self._portfolio:
            self._expected = self._rate_of(self._portfolio[0])
        self._stale = True

    @classmethod
    def from_json(cls, transitions: Transitions, data: dict[str, Any]) -> Tree:
        """The tree that as_json() described. Raises InputError for another schema or another graph."""
        operators_in(transitions, data)
        settings = data["settings"]
        fields = ("c_uct", "reward", "retain", "equivalent_visits", "discount", "initial_cost")
        tree = cls(transitions, **{name: settings[name] for name in fields if name in settings})
        tree.add(data)
        return tree


class Fixed(Records):
    """Always the same sequence (the paper's experts). settings: retain, discount, initial_cost as for Tree."""

    kind = "fixed"

    def __init__(self, transitions: Transitions, path: Sequence[Transition], **settings: Any) -> None:
        super().__init__(transitions, **settings)
        self.path = tuple(path)
        self._follow(self.path)
        if not self.path or self.path[-1].target != transitions.full:
            raise InputError(f"sequence {transitions.format(self.path)!r} does not assign all variables")

    def select(self, ready: Ready | None = None) -> Path:
        """The sequence, or () while one of its operators is not ready."""
        return self.path if ready is None or all(map(ready, self.path)) else ()


class Random(Records):
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

    A model-based Q wants a small c_uct (near ties are told apart by few batches). With the square root alone the
    worst child would then come back when ln N = n_i / c_uct^2. With the square it comes back when ln N = 2 n_i / sqrt(c_uct),
    much sooner, for a bonus that only hardly tried children have.
    """
    return max(math.sqrt(x), 0.25 * x * x)
