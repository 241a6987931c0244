"""What happened in a run, by history, and what follows from it for every sequence.

* What an operator meets depends on how the variables that it reads came about, and on nothing else. Statistics belong to
  that *history*: an operator with the histories of the components that it reads. Sequences that differ only in the order
  of independent steps share their histories and meet in one node (a transposition).
* A history of which little is known borrows from its operator's pooled statistics. With what weight is learned too: where
  histories do not matter a lot, where the operator succeeds four times as often after one as after another very little.
* A condition may be tried several times. Those that still wait for another try are censored observations: success is
  counted per try, and success within all tries follows by the product of Kaplan and Meier (1958).
* What never ran is judged by its dof and rows (`guessed_success`) and by its unknowns (`guessed_work`), corrected by how the
  instance's operators that ran did in comparison; how many tries of a condition pay follows from what it cost.
* On another instance an operator may do worse than on those of a warm start: a history borrows how it did in comparison
  with its operator there, so that none has to be refuted one by one.

Successes and time are counted apart and kept in files apart: a mixture of both made at yesterday's price of time would go
stale. The rules that choose are in `uct`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from operator import attrgetter, itemgetter
from typing import Any

from cgs_jax.errors import InputError
from cgs_jax.graph import ConstraintGraph
from cgs_jax.transitions import Path, Problem, State, Transition, Transitions

SCHEMA = "cgs_jax.tree/2"

Counts = int | Sequence[int]

PRIOR_TRIES = 2.0
"""Weight of the prior of an operator without statistics, in tries."""

SUCCESS_PER_FREEDOM = 0.1
"""Guessed success of a loop that an operator which never ran has to close, per degree of freedom that is left for it."""

SUCCESS_BOUNDS = 0.03, 0.8
"""Bounds of that guess."""

DRAWN = 0.1
"""Work of a try that solves nothing over that of one that solves for a configuration."""

HARDNESS_LOOPS = 3.0
"""Weight, in loops, of the belief that an instance is as hard as guessed."""

CORRELATION = 0.03
"""Guess of how much of the variance of success lies between the histories of an operator (`Records._correlations`)."""

CORRELATION_TRIES = 1000.0
"""Weight of that guess, in tries."""

OWN_CORRELATION_TRIES = 300.0
"""Weight of what all operators say of it where it is estimated for one of them, in tries."""

OPERATOR_TIME_TRIES = 3000.0
"""A history believes its operator's pooled time of a try as if it had seen so many: it varies less than success."""

VISIT_TRIES = 32
"""Smaller batches count as visits in proportion."""

NEXT_TRY = 30.0
"""Weight, in tries, of the belief that an operator's further try falls off as those of the others do."""

FALLING_OFF = 0.8
"""Guess of the success of a further try over that of the one before (`_falling_off`)."""

FALLING_OFF_TRIES = 300.0
"""Weight of that guess, and the greatest one of what an operator says of it, in tries."""

RETRIES = 300.0
"""Weight, in tries, of what earlier instances say of each further try, as far as they made so many."""

ENUMERABLE = 3000
"""Up to this many transitions the values below the tree come from dynamic programming over all states."""

HOPE = 0.5
"""In the search success is taken for its mean plus this many standard deviations, by what is known of the history."""

SURPRISE = 0.5
"""Guess by how much, in logarithms, operators do better than guessed (`_surprise`)."""

SURPRISE_OPERATORS = 4.0
"""Weight of that guess, in operators."""

PROVEN_VISITS = 2.0
"""Batches of its last operator from which on an earlier instance tells what rate a sequence had there."""

UNPROVEN = 0.5
"""Share of the greatest rate of an earlier instance that a sequence is believed to have had there where one of its operators
was not run."""

PORTFOLIO = 3
"""Sequences at most that a warm start looks at first."""

WORTH_A_LOOK = 0.03
"""Share of the greatest rate that another of these must add to the best of the others, on average over earlier instances."""

BELIEVED_TRIES = 8.0
"""Weight, in tries, of what an operator does on average where the first looks after a history are believed."""

SETTLED = 4.0
"""What was tried so many times as often as the average weighs is known: its own evidence is believed anyway."""


@dataclass
class Statistics:
    """What happened after a history, or pooled over the histories of an operator.

    visits: batches. attempts, successes: of first tries, of second ones, and so on. seconds: device time. All but visits
    are discounted: they are weights of evidence, not counts.
    """

    visits: float = 0.0
    attempts: list[float] = field(default_factory=list)
    successes: list[float] = field(default_factory=list)
    seconds: float = 0.0

    def add(
        self, visits: float, attempts: Sequence[float], successes: Sequence[float], seconds: float, keep: float = 1.0
    ) -> None:
        """Discount what is known by the factor `keep` and add a batch."""
        more = len(attempts) - len(self.attempts)
        if more > 0:
            self.attempts += [0.0] * more
            self.successes += [0.0] * more
        if keep != 1.0:
            self.attempts = [keep * value for value in self.attempts]
            self.successes = [keep * value for value in self.successes]
        for k, value in enumerate(attempts):
            self.attempts[k] += value
        for k, value in enumerate(successes):
            self.successes[k] += value
        self.visits += visits
        self.seconds = keep * self.seconds + seconds

    @property
    def tries(self) -> float:
        """Attempts, whichever try they were."""
        return sum(self.attempts)

    def hazards(self, prior: Sequence[float], weight: float, falling_off: float = 1.0) -> list[float]:
        """Success of each try: the counts, and a guess with a weight in tries.

        Of the first try that is `prior`; of a later one what came out for the try before, which it goes below as in `prior`,
        beyond its end by the factor `falling_off`.
        """
        result: list[float] = []
        for k in range(max(len(self.attempts), len(prior))):
            if k == 0:
                guess, trust = prior[0], weight
            elif k < len(prior):
                guess, trust = result[-1] * min(prior[k] / max(prior[k - 1], 1e-12), 1.0), weight
            else:
                guess, trust = falling_off * result[-1], NEXT_TRY
            if k < len(self.attempts):
                guess = (self.successes[k] + trust * guess) / (self.attempts[k] + trust)
            result.append(guess)
        return result

    @property
    def success_rate(self) -> float | None:
        """Success per condition within its tries; None without evidence."""
        return _within(self.observed)[-1][0] if self.observed else None

    @property
    def seconds_per_condition(self) -> float | None:
        return _within(self.observed)[-1][1] * self.seconds / self.tries if self.observed else None

    @property
    def seconds_per_try(self) -> float | None:
        return self.seconds / self.tries if self.tries else None

    @property
    def observed(self) -> list[float]:
        """Success of each try that was made."""
        return [s / a for a, s in zip(self.attempts, self.successes, strict=True) if a > 0]


@dataclass
class Totals:
    """Of a whole run: batches, rollouts (attempts at the root), finished samples and the device seconds that were charged for
    them, all but batches discounted.

    From the first incumbent on, not discounted: batches, of these the explored ones, for other histories than the incumbent's;
    spent, the seconds that batches took as they passed for a worker, of these those of the first trials of operators.
    """

    visits: float = 0.0
    rollouts: float = 0.0
    samples: float = 0.0
    seconds: float = 0.0
    batches: float = 0.0
    spent: float = 0.0
    first_trials: float = 0.0
    explored: float = 0.0


@dataclass(frozen=True)
class Outlook:
    """What all operators of a run say of those that have not run.

    trust: weight of an operator's pooled success in what is expected after a history, in tries. slowness: device seconds over
    guessed ones. ease: success over the guessed one, per loop. surprise: by how much those that do better than guessed do so.
    falling_off: success of a further try over that of the one before.
    """

    trust: float = 1.0 / CORRELATION - 1.0
    slowness: float = 1.0
    ease: float = 1.0
    surprise: float = SURPRISE
    falling_off: float = FALLING_OFF


class PooledOperator:
    """Pooled statistics of one conditional problem, and what they predict."""

    __slots__ = (
        "guess", "hazards", "hopeful", "hopeful_within", "loops", "per_loop", "ready", "seconds_per_try", "statistics",
        "trust", "within",
    )  # fmt: skip

    def __init__(self, loops: int, per_loop: float, guess: float, outlook: Outlook) -> None:
        self.statistics = Statistics()
        self.ready = True
        self.loops, self.per_loop = loops, per_loop  # guess of success
        self.guess = guess  # seconds per try
        self.trust = outlook.trust
        self.predict(outlook)

    def predict(self, outlook: Outlook) -> None:
        known = self.statistics
        prior = self.guessed(outlook.ease)
        self.hazards = known.hazards([prior], PRIOR_TRIES, outlook.falling_off)
        # The guessed cost counts only until a cost was seen: it may be wrong by orders of magnitude.
        self.seconds_per_try = known.seconds / known.tries if known.tries else outlook.slowness * self.guess
        self.within = _within(self.hazards)
        self.hopeful_within = _within(_hopeful(self.hazards, self.trust))
        # After a history that was never tried: it may do as well as was guessed, whatever others did.
        self.hopeful = _within([max(h, prior) for h in _hopeful(self.hazards, self.trust)])

    def guessed(self, ease: float) -> float:
        """Success by dof and rows and by how the others do."""
        return min(ease * self.per_loop, SUCCESS_BOUNDS[1]) ** self.loops if self.loops else self.per_loop

    def seconds_per_item(self, item_cost: float) -> float:
        """With as many tries as are worth making, when what is read costs so many seconds."""
        return _seconds_per_item(item_cost, self.seconds_per_try, self.within)


class Step:
    """A transition together with what it does to the independent components of the assigned variables.

    used: components that are consumed. made: the component of the result. All others survive its failure.
    """

    __slots__ = ("made", "operator", "target", "transition", "used")

    def __init__(self, transition: Transition, operator: PooledOperator, used: tuple[State, ...]) -> None:
        self.transition = transition
        self.operator = operator
        self.target = transition.target
        self.used = used
        self.made = frozenset(transition.new).union(*used)


class History:
    """How a component came about: the operator that completed it and the histories that it read.

    tries: of a condition that are worth making. success, cost: expected, per condition. item_cost: expected device seconds
    per item of the component, with all that it was made of. prefixes: sequences by which it was made, none before.
    believed_cost: the same if what was seen after the history itself is believed, however little it was. borrowed: evidence of
    earlier instances. lean: what the success of each try was there, over the operator's: where an
    operator does worse on this instance, all its histories are expected to, without being tried one by one.
    """

    __slots__ = (
        "believed_cost", "borrowed", "cost", "hopeful_cost", "hopeful_success", "item_cost", "lean", "made", "operator",
        "prefixes", "reads", "statistics", "success", "tries", "version",
    )  # fmt: skip

    def __init__(self, operator: PooledOperator, reads: tuple[History, ...], made: State) -> None:
        self.operator = operator
        self.reads = reads
        self.made = made
        self.statistics = Statistics()
        self.borrowed = Statistics()
        self.lean: list[float] = []
        self.prefixes: list[Path] = []
        self.tries = 1
        self.success = self.cost = self.item_cost = self.hopeful_success = self.hopeful_cost = 0.0
        self.believed_cost = 0.0
        self.version = -1

    def predict(self) -> None:
        operator, own = self.operator, self.statistics
        if not own.attempts and not self.lean:
            self._predict_as_operator()
            return
        expected, trust = operator.hazards, operator.trust
        if self.lean:
            expected = [min(h * self.lean[min(k, len(self.lean) - 1)], 1.0) for k, h in enumerate(expected)]
            trust += self.borrowed.attempts[0]
        if own.attempts:
            hazards = own.hazards(expected, trust)
            known = trust + own.attempts[0]
            per_try = (own.seconds + OPERATOR_TIME_TRIES * operator.seconds_per_try) / (own.tries + OPERATOR_TIME_TRIES)
        else:
            hazards, known, per_try = expected, trust, operator.seconds_per_try
        read_cost = sum(read.item_cost for read in self.reads)
        self._try_as_pays(read_cost, per_try, _within(hazards))
        self.believed_cost = self.item_cost
        if own.attempts and own.attempts[0] < SETTLED * trust:
            hazards_believed = own.hazards(expected, min(trust, BELIEVED_TRIES))
        else:
            hazards_believed = hazards
        if hazards_believed is not hazards or any(read.believed_cost != read.item_cost for read in self.reads):
            read_cost = sum(read.believed_cost for read in self.reads)
            self.believed_cost = _seconds_per_item(read_cost, per_try, _within(hazards_believed))
        self.hopeful_success, tries = _within(_hopeful(hazards, known))[self.tries - 1]
        if own.tries + self.borrowed.tries < VISIT_TRIES and operator.hopeful[self.tries - 1][0] > self.hopeful_success:
            self.hopeful_success, tries = operator.hopeful[self.tries - 1]
        self.hopeful_cost = tries * per_try

    def _try_as_pays(self, read_cost: float, per_try: float, within: Sequence[tuple[float, float]]) -> None:
        """As many tries as make an item cheapest."""
        self.item_cost = math.inf
        for k, (success, tries) in enumerate(within, start=1):
            item_cost = (read_cost + tries * per_try) / max(success, 1e-12)
            if item_cost < self.item_cost:
                self.tries, self.success, self.cost, self.item_cost = k, success, tries * per_try, item_cost

    def _predict_as_operator(self) -> None:
        """Where nothing is known of the history itself: what is expected of its operator, which most histories share."""
        operator = self.operator
        per_try = operator.seconds_per_try
        read_cost = sum(read.item_cost for read in self.reads)
        self._try_as_pays(read_cost, per_try, operator.within)
        self.believed_cost = self.item_cost
        believed = sum(read.believed_cost for read in self.reads)
        if believed != read_cost:
            self.believed_cost = operator.seconds_per_item(believed)
        self.hopeful_success, tries = operator.hopeful_within[self.tries - 1]
        if self.borrowed.tries < VISIT_TRIES and operator.hopeful[self.tries - 1][0] > self.hopeful_success:
            self.hopeful_success, tries = operator.hopeful[self.tries - 1]
        self.hopeful_cost = tries * per_try


class Edge:
    """A step out of a node, and the history that it makes there."""

    __slots__ = ("history", "kept", "node", "quality", "reach", "recorded", "step", "value")

    def __init__(self, step: Step, history: History, kept: tuple[History, ...]) -> None:
        self.step = step
        self.history = history
        self.kept = kept
        self.node: Node | None = None
        self.recorded = False
        self.value = 0.0  # of what lies behind
        self.quality = 0.0  # the paper's Q
        self.reach = 0.0  # probability to finish from before the step on


class Node:
    """Assigned variables and how their components came about: all sequences that lead there."""

    __slots__ = ("components", "edges", "epoch", "reach", "state", "value", "visited")

    def __init__(self, state: State, components: tuple[History, ...]) -> None:
        self.state = state
        self.components = components
        self.edges: dict[tuple[str, ...], Edge] = {}  # all of them, or none yet
        self.visited = False  # a recorded sequence passed through
        self.value = 0.0
        self.reach = 0.0
        self.epoch = -1


class _Earlier:
    """What is known of an earlier instance alone."""

    def __init__(self, operators: dict[PooledOperator, Statistics], histories: dict[History, Statistics]) -> None:
        self.operators = operators
        self.histories = histories
        self._seconds: dict[History, float] = {}

    def ended(self, history: History, full: State) -> bool:
        """Was the sequence that makes this run there to the end?"""
        return history.made == full and history in self.histories and self.histories[history].visits >= PROVEN_VISITS

    def seconds_per_item(self, history: History) -> float:
        """Device seconds per item of a history there, with all that it is made of; infinite where an operator was not run."""
        if history not in self._seconds:
            self._seconds[history] = math.inf
            pooled, own = self.operators.get(history.operator), self.histories.get(history, Statistics())
            if pooled is not None and pooled.observed:
                borrowed = OPERATOR_TIME_TRIES * pooled.seconds / pooled.tries
                per_try = (own.seconds + borrowed) / (own.tries + OPERATOR_TIME_TRIES)
                reads = sum(map(self.seconds_per_item, history.reads))
                within = _within(own.hazards(pooled.observed, 1.0 / CORRELATION - 1.0))
                self._seconds[history] = max(_seconds_per_item(reads, per_try, within), 1e-300)
        return self._seconds[history]


class Records:
    """Statistics of a run whatever the rule of choice, and the predictions that follow from them (see Tree)."""

    kind = ""

    def __init__(
        self,
        transitions: Transitions,
        retain: bool = True,
        discount: float = 0.998,
        initial_cost: float = 2.5e-5,
    ) -> None:
        if not 0.0 < discount <= 1.0:
            raise InputError(f"discount is {discount}; expected above 0 and at most 1")
        if initial_cost < 0.0:
            raise InputError(f"initial_cost is {initial_cost} s; expected 0 or more")
        self.transitions = transitions
        self.retain = retain
        self.discount = discount
        self.initial_cost = initial_cost
        self._operators: dict[Problem, PooledOperator] = {}
        self._steps: dict[State, dict[tuple[str, ...], Step]] = {}
        self._histories: dict[tuple, History] = {}
        self._remembered: dict[tuple[Step, tuple[History, ...]], tuple[History, tuple[History, ...]]] = {}
        self._known: list[History] = []  # with statistics of their own
        self._nodes: dict[frozenset[History], Node] = {}
        self._outlook = Outlook()
        self._root = self._node_of(frozenset(), ())
        self._total = Totals()
        self._portfolio: list[Path] = []  # of earlier instances
        self._version = 0  # of the predictions

    # What happened

    def record(
        self,
        prefix: Path,
        transition: Transition,
        attempts: Counts,
        successes: Counts,
        seconds: float,
        visits: float = 1.0,
        spent: float | None = None,
    ) -> None:
        """One batch of `transition` after the sequence `prefix`.

        attempts, successes: how many first tries of a condition there were and how many of them succeeded, how many
        second ones, and so on; a number stands for first tries alone. Their length tells how often a condition may be
        tried. seconds: device time; visits: batches; spent: seconds as they passed, None where they are the same. Raises
        InputError for impossible numbers and for a sequence that is none.
        """
        attempts = [attempts] if isinstance(attempts, int) else list(attempts)
        successes = [successes] if isinstance(successes, int) else list(successes)
        possible = len(attempts) == len(successes) and all(0 <= s <= a for a, s in zip(attempts, successes))
        if not possible or seconds < 0 or visits < 0:
            raise InputError(
                f"record of {transition}: {successes} successes of {attempts} attempts in {seconds} s, {visits} "
                "visits; expected 0 <= successes <= attempts and no negative number"
            )
        lineage = self._follow((*prefix, transition))
        history = lineage[-1].history
        is_first_trial = not history.operator.statistics.visits
        self._name(lineage[-1], (*prefix, transition))
        # A batch that hardly tells anything hardly counts as a visit.
        visits *= min(1.0, sum(attempts) / VISIT_TRIES)
        keep = self.discount**visits
        for statistics in (history.statistics, history.operator.statistics):
            statistics.add(visits, attempts, successes, seconds, keep)
        total = self._total
        total.visits += visits
        total.rollouts = keep * total.rollouts + (0 if prefix else sum(attempts))
        total.samples = keep * total.samples + (sum(successes) if transition.target == self.transitions.full else 0)
        total.seconds = keep * total.seconds + seconds
        self._spend(history, seconds if spent is None else spent, is_first_trial)
        self._recorded(lineage)

    def _recorded(self, lineage: list[Edge]) -> None:
        """Called after every record with the edges from the root."""

    def _spend(self, history: History, seconds: float, is_first_trial: bool) -> None:
        """Accounts for the time that a batch took."""

    @property
    def rate(self) -> float:
        """Finished samples per second of device time, both discounted."""
        return self._total.samples / self._total.seconds if self._total.seconds else 0.0

    @property
    def seconds_per_rollout(self) -> float | None:
        """Device seconds per attempt at the root, discounted; None before the first."""
        return self._total.seconds / self._total.rollouts if self._total.rollouts else None

    def operator_statistics(self) -> dict[Problem, Statistics]:
        """Pooled statistics of every operator that ran or was warm started."""
        return {p: o.statistics for p, o in self._operators.items() if o.statistics.visits > 0}

    # What is expected

    def predict_rate(self, path: Sequence[Transition]) -> float:
        """Predicted finished samples per second of device time when only this sequence is run.

        Uses the statistics of its own histories where there are some, those of its operators otherwise, and a guess
        (`guessed_success`, `guessed_work`) for an operator that never ran. Raises InputError for an incomplete sequence.
        """
        path = tuple(path)
        state: State = path[-1].target if path else frozenset()
        if state != self.transitions.full:
            missing = ", ".join(self.transitions.graph.ordered(self.transitions.full - state))
            raise InputError(f"sequence {self.transitions.format(path)!r} leaves {missing} unassigned")
        self._predict_operators()
        return self._rate_of(path)

    def tries(self, prefix: Path, transition: Transition) -> int:
        """How many tries of a condition of `transition` after `prefix` are worth making: the later ones succeed less often.

        More than one try makes sense where a condition costs much to replace: as many as make the least device seconds per
        success, with all that the condition is made of.
        """
        return self._renewed(self._follow((*prefix, transition))[-1].history).tries

    def _rate_now(self, path: Path) -> float:
        """Like `_rate_of`, by all that was recorded so far."""
        components, _ = self._made_along(path)
        return 1.0 / max(sum(self._renewed(history).item_cost for history in components), 1e-300)

    def _renewed(self, history: History) -> History:
        """With predictions by what is known now."""
        for read in history.reads:
            self._renewed(read)
        history.operator.predict(self._outlook)
        history.predict()
        return history

    def best_sequences(self, k: int = 1) -> list[tuple[Path, float]]:
        """The k sequences of greatest predicted rate, with that rate, out of those that were run to the end; on earlier
        instances only where none was here. Of those that differ only in the order of independent steps one."""
        self._predict_operators()
        made = self._made_here
        if not self._finished_paths(made):
            made = self._known
        paths = self._finished_paths(made)
        if self._states is not None:
            # The cheapest way to a state may be one that was not gone on, and then takes the place of one that was.
            paths = [*self._cheapest_paths(k, made=set(made))[self.transitions.full], *paths]
        distinct: dict[frozenset[History], Path] = {}
        for path in paths:
            distinct.setdefault(frozenset(self._made_along(path)[0]), path)
        ranked = sorted(((path, self._rate_of(path)) for path in distinct.values()), key=lambda pair: -pair[1])
        return ranked[:k]

    def _rate_of(self, path: Path) -> float:
        components, _ = self._made_along(path)
        return 1.0 / max(sum(self._predicted(history).item_cost for history in components), 1e-300)

    def _made_along(self, path: Path) -> tuple[tuple[History, ...], tuple[History, ...]]:
        """The components that a sequence ends with, and all histories on the way."""
        components: tuple[History, ...] = ()
        histories: tuple[History, ...] = ()
        for transition in path:
            history, kept = self._made_by(self._step(transition), components)
            components = (*kept, history)
            histories = (*histories, history)
        return components, histories

    @property
    def _made_here(self) -> list[History]:
        """The histories that were made in this run, not on earlier instances alone."""
        return [history for history in self._known if history.statistics.visits]

    def _finished_paths(self, histories: Iterable[History]) -> list[Path]:
        full = self.transitions.full
        return [history.prefixes[0] for history in histories if history.prefixes[0][-1].target == full]

    def _cheapest_paths(
        self,
        k: int,
        among: Callable[[Step], bool] = lambda step: True,
        made: Container[History] | None = None,
        cost_of: Callable[[History], float] = attrgetter("item_cost"),
    ) -> dict[State, list[Path]]:
        """In every state the k partial sequences of least production cost, out of some steps, by a forward search.

        made: the histories that they may consist of; None for all.
        """
        # Cost, components, and the last transition with the label before it. Sequences that differ only in the order of
        # independent steps end with the same components: of these the first of the cheapest.
        partial: dict[State, dict[frozenset[History], tuple[float, tuple[History, ...], Any]]]
        partial = {state: {} for state in self._states}
        partial[frozenset()] = {frozenset(): (0.0, (), None)}
        best: dict[State, list[tuple[float, tuple[History, ...], Any]]] = {}
        version = self._version
        for state in self._states:
            labels = best[state] = sorted(partial.pop(state).values(), key=itemgetter(0))[:k]
            for step in self._steps_from(state).values():
                if not among(step):
                    continue
                others = partial[step.target]
                for label in labels:
                    history, kept = self._made_again(step, label[1])
                    if made is not None and history not in made:
                        continue
                    if history.version != version:
                        self._predicted(history)
                    cost = cost_of(history)
                    for component in kept:
                        cost += cost_of(component)
                    components = (*kept, history)
                    known = others.get(same := frozenset(components))
                    if known is None or cost < known[0]:
                        others[same] = (cost, components, (step.transition, label))

        def path_to(label: Any) -> Path:
            path: list[Transition] = []
            while label[2] is not None:
                transition, label = label[2]
                path.append(transition)
            return tuple(reversed(path))

        return {state: [path_to(label) for label in labels] for state, labels in best.items()}

    def _predict_operators(self) -> None:
        """Renew what operators predict; histories follow when they are asked."""
        known = [operator for operator in self._operators.values() if operator.statistics.tries]
        general, of_operator = self._correlations()
        ease = _ease(known)
        self._outlook = Outlook(
            _weight_of_mean(general), _slowness(known), ease, _surprise(known, ease), _falling_off(known)
        )
        for operator in self._operators.values():
            operator.trust = _weight_of_mean(of_operator.get(operator, general))
            operator.predict(self._outlook)
        self._version += 1

    def _correlations(self) -> tuple[float, dict[PooledOperator, float]]:
        """Share of the variance of a first try's success that lies between the histories of one operator: over all operators,
        and of each one.

        With success distributed over histories as a beta distribution. Estimated by moments: the squared differences between a
        history and the others of its operator, beyond the binomial ones. Not from the operator's mean: where nearly all tries
        were after one history that is its own. What is seen of one operator is added to what all say.
        """
        tried = [h for h in self._known if h.statistics.attempts and h.statistics.attempts[0] > 1.0]
        squares: dict[PooledOperator, float] = {}
        for history in tried:
            squares[history.operator] = squares.get(history.operator, 0.0) + history.statistics.attempts[0] ** 2
        moments: dict[PooledOperator, tuple[float, float]] = {}  # weighted sum and weight, in tries
        for history in tried:
            own, pooled = history.statistics, history.operator.statistics
            tries = own.attempts[0]
            others, mean = pooled.attempts[0] - tries, pooled.successes[0] / pooled.attempts[0]
            variance = mean * (1.0 - mean)
            if others > 1.0 and variance > 0.0:
                difference = own.successes[0] / tries - (pooled.successes[0] - own.successes[0]) / others
                # The others' mean varies between histories too, the less the more of them there are.
                parts = 1.0 + max(squares[history.operator] - tries**2, 0.0) / others**2
                # No history counts for more than the guess.
                weight = min(tries, others, CORRELATION_TRIES)
                between = (difference**2 / variance - 1.0 / tries - 1.0 / others) / min(parts, 2.0)
                so_far = moments.get(history.operator, (0.0, 0.0))
                moments[history.operator] = so_far[0] + weight * between, so_far[1] + weight
        between, total = (sum(values) for values in zip((0.0, 0.0), *moments.values()))
        general = (CORRELATION * CORRELATION_TRIES + between) / (CORRELATION_TRIES + total)
        of_operator = {
            operator: (general * OWN_CORRELATION_TRIES + between) / (OWN_CORRELATION_TRIES + total)
            for operator, (between, total) in moments.items()
        }
        return general, of_operator

    def _predicted(self, history: History) -> History:
        if history.version != self._version:
            for read in history.reads:
                self._predicted(read)
            history.predict()
            history.version = self._version
        return history

    # Nodes, histories and steps

    @cached_property
    def _states(self) -> list[State] | None:
        """All states by size, or None where there are more than ENUMERABLE transitions."""
        states: dict[State, None] = {frozenset(): None}
        for number, transition in enumerate(self.transitions.iterate()):
            if number >= ENUMERABLE:
                return None
            states[transition.target] = None
        return sorted(states, key=lambda state: (len(state), self.transitions.graph.ordered(state)))

    def _operator(self, problem: Problem) -> PooledOperator:
        operator = self._operators.get(problem)
        if operator is None:
            loops, per_loop = guessed_success(self.transitions.graph, problem)
            guess = self.initial_cost * guessed_work(self.transitions.graph, problem)
            operator = self._operators[problem] = PooledOperator(loops, per_loop, guess, self._outlook)
        return operator

    def _steps_from(self, state: State) -> dict[tuple[str, ...], Step]:
        """The kept transitions out of a state, by their new variables, in the order of children()."""
        steps = self._steps.get(state)
        if steps is None:
            components = self.transitions.graph.components(state) if self.retain else ((state,) if state else ())
            steps = self._steps[state] = {}
            for transition in self.transitions.children(state):
                operator = self._operator(transition.problem)
                # Without pools there is one component, lost as a whole.
                used = tuple(c for c in components if c & transition.condition) if self.retain else components
                steps[transition.new] = Step(transition, operator, used)
        return steps

    def _step(self, transition: Transition) -> Step:
        steps = self._steps_from(transition.given)
        if transition.new not in steps:
            available = ", ".join(str(step.transition) for step in steps.values()) or "nothing"
            raise InputError(f"{transition} is no kept transition at its state; available: {available}")
        return steps[transition.new]

    def _made_again(self, step: Step, components: tuple[History, ...]) -> tuple[History, tuple[History, ...]]:
        """Like `_made_by`, remembered: for what is asked at every refresh."""
        made = self._remembered.get((step, components))
        if made is None:
            made = self._remembered[step, components] = self._made_by(step, components)
        return made

    def _made_by(self, step: Step, components: tuple[History, ...]) -> tuple[History, tuple[History, ...]]:
        """The history that a step makes out of components, and those that it leaves alone."""
        reads = tuple(component for component in components if component.made in step.used)
        kept = tuple(component for component in components if component.made not in step.used)
        key = (step.operator, frozenset(reads))
        history = self._histories.get(key)
        if history is None:
            history = self._histories[key] = History(step.operator, reads, step.made)
        return history, kept

    def _node_of(self, state: State, components: tuple[History, ...]) -> Node:
        key = frozenset(components)
        node = self._nodes.get(key)
        if node is None:
            ordered = self.transitions.graph.ordered
            components = tuple(sorted(components, key=lambda history: ordered(history.made)))
            node = self._nodes[key] = Node(state, components)
        return node

    def _expand(self, node: Node) -> list[Edge]:
        """All edges of a node in the order of the transitions."""
        if not node.edges:
            steps = self._steps_from(node.state)
            node.edges = {new: Edge(step, *self._made_by(step, node.components)) for new, step in steps.items()}
        return list(node.edges.values())

    def _behind(self, edge: Edge) -> Node:
        if edge.node is None:
            edge.node = self._node_of(edge.step.target, (*edge.kept, edge.history))
        return edge.node

    def _follow(self, path: Iterable[Transition]) -> list[Edge]:
        """The edges of a sequence from the root, made when they are new; nodes on the way count as visited."""
        node = self._root
        edges: list[Edge] = []
        for transition in path:
            if transition.given != node.state:
                so_far = self.transitions.format([edge.step.transition for edge in edges]) or "the start"
                raise InputError(f"{transition} does not follow {so_far!r}")
            self._step(transition)
            self._expand(node)
            node.visited = True
            edges.append(node.edges[transition.new])
            node = self._behind(edges[-1])
        return edges

    def _name(self, edge: Edge, prefix: Path) -> None:
        """Remembers by which sequence a history was made, one for each node where that happened."""
        if not edge.recorded:
            edge.recorded = True
            if not edge.history.prefixes:
                self._known.append(edge.history)
            edge.history.prefixes.append(prefix)

    # Files

    def _settings(self) -> dict[str, Any]:
        return {"retain": self.retain, "discount": self.discount, "initial_cost": self.initial_cost}

    def as_json(self) -> dict[str, Any]:
        """Everything that was learned, readable, ready for json.dump. Schema "cgs_jax.tree/2".

        "sequences" has one entry per history, under the sequence by which it was first made; "also": others that made it.
        """
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
                {
                    "sequence": self.transitions.format(history.prefixes[0]),
                    "also": [self.transitions.format(prefix) for prefix in history.prefixes[1:]],
                    **_described(_sum(history.statistics, history.borrowed)),
                    **self._value_of(history),
                }
                for history in self._known
            ],
        }

    def _value_of(self, history: History) -> dict[str, float]:
        return {}

    def add(self, data: dict[str, Any]) -> None:
        """Adds the statistics of a tree file. Raises InputError for another schema or another graph."""
        for problem, entry in operators_in(self.transitions, data).items():
            operator = self._operator(problem)
            _add(operator.statistics, _read_statistics(entry))
        for entry in data["sequences"]:
            history = self._history_at(entry["sequence"])
            _add(history.statistics, _read_statistics(entry))
            for text in entry["also"]:
                self._history_at(text)
        for name, value in data["totals"].items():
            setattr(self._total, name, getattr(self._total, name) + value)
        self._predict_operators()

    def _history_at(self, text: str) -> History:
        """The history that a partial sequence makes."""
        prefix = read_prefix(self.transitions, text)
        edge = self._follow(prefix)[-1]
        self._name(edge, prefix)
        return edge.history

    def warm_start(self, earlier: Sequence[dict[str, Any]], n_equiv: float) -> None:
        """Start from earlier instances of the same graph (paper, Section V-C).

        Per history and per operator the average over the earlier instances of success and of seconds per try, not of Q:
        the price of time may be another one here. Weight: `n_equiv` visits, in batches of the mean size there, but no
        more visits than there were. Raises InputError for another graph, and if something was recorded already.
        """
        if self._total.visits:
            raise InputError("warm start comes before the first record; this chooser has records already")
        if not n_equiv > 0:
            raise InputError(f"n_equiv is {n_equiv} batches; expected more than 0")
        of_operator: dict[PooledOperator, list[Statistics]] = {}
        of_history: dict[History, list[Statistics]] = {}
        instances: list[_Earlier] = []
        totals = []
        for data in earlier:
            entries = operators_in(self.transitions, data).items()
            there = _Earlier(
                {self._operator(problem): _read_statistics(entry) for problem, entry in entries},
                {self._history_at(entry["sequence"]): _read_statistics(entry) for entry in data["sequences"]},
            )
            for operator, known in there.operators.items():
                of_operator.setdefault(operator, []).append(known)
            for history, known in there.histories.items():
                of_history.setdefault(history, []).append(known)
            instances.append(there)
            totals.append(Totals(**data["totals"]))
        for operator, statistics in of_operator.items():
            operator.statistics = _averaged(statistics, n_equiv)
        self._portfolio = self._portfolio_of(instances)
        for history, statistics in of_history.items():
            history.borrowed = _averaged(statistics, n_equiv)
            ours, pooled = history.borrowed.observed, history.operator.statistics.observed
            history.lean = [our / max(all_, 1e-12) for our, all_ in zip(ours, pooled)]
        totals = [total for total in totals if total.visits and total.seconds]
        if totals:
            # Samples per second are averaged as they are; the weight is n_equiv visits of the mean length.
            seconds = sum(n_equiv / total.visits * total.seconds for total in totals) / len(totals)
            rate = sum(total.samples / total.seconds for total in totals) / len(totals)
            roots = sum(total.rollouts / total.seconds for total in totals) / len(totals)
            self._total = Totals(rollouts=roots * seconds, samples=rate * seconds, seconds=seconds)
        self._predict_operators()

    def _portfolio_of(self, instances: list[_Earlier]) -> list[Path]:
        """A few sequences of which on every instance one did well, the best one on its own first; none without any.

        By the rate that each made there, or what its operators let expect, over the greatest one. Averages of predictions would
        favour what was run on few instances, those where it is good, and promises much elsewhere.
        """
        full = self.transitions.full
        shares: dict[History, list[float]] = {h: [] for there in instances for h in there.histories if there.ended(h, full)}
        for there in instances:
            rates = {history: 1.0 / there.seconds_per_item(history) for history in shares}
            greatest = max((rate for history, rate in rates.items() if there.ended(history, full)), default=0.0)
            for history, rate in rates.items():
                shares[history].append(min(rate / greatest, 1.0) if rate and greatest else UNPROVEN)
        chosen: list[History] = []
        so_far = [0.0] * len(instances)
        while len(chosen) < PORTFOLIO:
            gain = {h: sum(max(s - f, 0.0) for s, f in zip(of, so_far)) / len(instances) for h, of in shares.items()}
            best = max(gain, key=lambda history: gain[history], default=None)
            if best is None or gain[best] <= WORTH_A_LOOK:
                break
            chosen.append(best)
            so_far = [max(s, f) for s, f in zip(shares[best], so_far)]
        return [history.prefixes[0] for history in chosen]


def _weight_of_mean(correlation: float) -> float:
    """Weight, in tries, of an operator's mean success in what is expected after a history (`Records._correlations`)."""
    return 1.0 / min(max(correlation, 1e-3), 0.5) - 1.0


def _slowness(operators: Iterable[PooledOperator]) -> float:
    """Device seconds over guessed ones, of operators that close loops: what is only drawn says nothing of them."""
    solved = [operator for operator in operators if operator.loops and operator.statistics.tries]
    guessed = sum(operator.statistics.tries * operator.guess for operator in solved)
    return sum(operator.statistics.seconds for operator in solved) / guessed if guessed else 1.0


def _ease(operators: Iterable[PooledOperator]) -> float:
    """Geometric mean of the success of first tries over the guessed one, per loop: how an instance differs from others."""
    total, loops = 0.0, HARDNESS_LOOPS
    for operator in operators:
        known = operator.statistics
        if operator.loops and known.attempts[0] >= VISIT_TRIES:
            success = (known.successes[0] + 0.5) / (known.attempts[0] + 1.0)
            total += math.log(success) - operator.loops * math.log(operator.per_loop)
            loops += operator.loops
    return math.exp(total / loops)


def _surprise(operators: Iterable[PooledOperator], ease: float) -> float:
    """Root mean square of the logarithm of success over the guessed one, of operators that did better than guessed."""
    total, count = SURPRISE_OPERATORS * SURPRISE**2, SURPRISE_OPERATORS
    for operator in operators:
        known = operator.statistics
        if operator.loops and known.attempts[0] >= VISIT_TRIES:
            more = math.log((known.successes[0] + 0.5) / (known.attempts[0] + 1.0) / operator.guessed(ease))
            if more > 0.0:
                total, count = total + more**2, count + 1.0
    return math.sqrt(total / count)


def _falling_off(operators: Iterable[PooledOperator]) -> float:
    """Geometric mean of the success of further tries over that of the try before, at most 1: how easy conditions that failed
    are on an instance differs from others more than between operators."""
    total, weight = FALLING_OFF_TRIES * math.log(FALLING_OFF), FALLING_OFF_TRIES
    for operator in operators:
        attempts, successes = operator.statistics.attempts, operator.statistics.successes
        for k in range(1, len(attempts)):
            if attempts[k] >= VISIT_TRIES and successes[k - 1] > 0.0:
                ratio = (successes[k] + 0.5) / (attempts[k] + 1.0) * attempts[k - 1] / successes[k - 1]
                trust = min(attempts[k], FALLING_OFF_TRIES)
                total, weight = total + trust * math.log(ratio), weight + trust
    return min(math.exp(total / weight), 1.0)


def guessed_success(graph: ConstraintGraph, problem: Problem) -> tuple[int, float]:
    """Number of loops that an operator has to close, and guessed success of each, from dof and rows alone.

    Each new configuration, and each equality that ties poses alone to what is given, is a loop that has to close. What is
    left of the degrees of freedom after all rows is shared among them: on the scenes here an arm reaches a fixed pose in
    about one try in ten, a grasp that may be chosen along with it in one of four, and operators with several
    configurations succeed as the product of such shares.
    """
    new, names = frozenset(problem[0]), set(problem[1])
    active = [constraint for constraint in graph.constraints if constraint.name in names]
    free = sum(graph.variable(name).dof for name in new) - sum(constraint.equality_rows for constraint in active)
    configurations = [name for name in new if graph.variable(name).kind == "configuration"]
    ties = [c for c in active if c.equality_rows and len(c.scope) > 1 and not new.intersection(configurations, c.scope)]
    loops = len(configurations) + len(ties)
    least, most = SUCCESS_BOUNDS
    return loops, min(max(SUCCESS_PER_FREEDOM * free / loops, least), most) if loops else most


def guessed_work(graph: ConstraintGraph, problem: Problem) -> float:
    """Work of a try over that of one for a single configuration, from the kinds of the new variables alone.

    The work of a solve grows with the square of its unknowns. Those are the joints of every new configuration, which leaves one
    pose or transform known with it; where there are more of these, every other one has nearly as many unknowns. What has no
    loop to close (`guessed_success`) is drawn, not solved.
    """
    kinds = [graph.variable(name).kind for name in problem[0]]
    configurations = kinds.count("configuration")
    loops, _ = guessed_success(graph, problem)
    return float(max(configurations, len(kinds) - configurations)) ** 2 if loops else DRAWN


def _hopeful(hazards: Sequence[float], tries: float) -> list[float]:
    """Hazards above their means by HOPE standard deviations of a beta distribution of that weight."""
    return [min(h + HOPE * math.sqrt(h * (1.0 - h) / (tries + 1.0)), 1.0) for h in hazards]


def _within(hazards: Sequence[float]) -> list[tuple[float, float]]:
    """For one try, two tries and so on: success within them and their mean number, try k succeeding with hazards[k]."""
    failed, tries, result = 1.0, 0.0, []
    for hazard in hazards:
        tries += failed
        failed *= 1.0 - hazard
        result.append((1.0 - failed, tries))
    return result


def _seconds_per_item(read_cost: float, per_try: float, within: Iterable[tuple[float, float]]) -> float:
    """With as many tries as are worth making. read_cost: seconds per condition; within: as of `_within`."""
    return min((read_cost + tries * per_try) / max(success, 1e-12) for success, tries in within)


def _add(to: Statistics, other: Statistics) -> None:
    to.add(other.visits, other.attempts, other.successes, other.seconds)


def _sum(first: Statistics, second: Statistics) -> Statistics:
    total = Statistics()
    _add(total, first)
    _add(total, second)
    return total


def _described(statistics: Statistics) -> dict[str, Any]:
    return {
        **asdict(statistics),
        "success_rate": statistics.success_rate,
        "seconds_per_condition": statistics.seconds_per_condition,
    }


def _read_statistics(entry: dict[str, Any]) -> Statistics:
    attempts, successes = (list(map(float, entry[name])) for name in ("attempts", "successes"))
    return Statistics(float(entry["visits"]), attempts, successes, float(entry["seconds"]))


def read_prefix(transitions: Transitions, text: str) -> Path:
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


def operators_in(transitions: Transitions, data: dict[str, Any]) -> dict[Problem, dict[str, Any]]:
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
    """Mean success of each try and mean seconds per try over instances, with the weight of n_equiv batches.

    Where instances differ much in the success of first tries the weight is less: that of the beta distribution with the
    variance between them, beyond that of the counts.
    """
    earlier = [statistics for statistics in earlier if statistics.tries]
    if not earlier:
        return Statistics()
    visits = min(n_equiv, sum(statistics.visits for statistics in earlier))
    per_visit = sum(s.tries / max(s.visits, 1e-9) for s in earlier) / len(earlier)
    seconds = sum(s.seconds_per_try for s in earlier) / len(earlier)
    visits *= min(1.0, _agreement(earlier) / max(visits * per_visit, 1e-9))
    attempts, successes = [], []
    for k in range(max(len(s.attempts) for s in earlier)):
        reached = [s for s in earlier if k < len(s.attempts) and s.attempts[k]]
        share = sum(s.attempts[k] / s.tries for s in reached) / len(earlier)
        hazard = sum(s.successes[k] / s.attempts[k] for s in reached) / len(reached) if reached else 0.0
        tries = visits * per_visit * share
        if k:
            # How much less a further try succeeds is alike on all instances, however much the first ones differ.
            tries = max(tries, min(RETRIES, sum(s.attempts[k] for s in reached)))
        attempts.append(tries)
        successes.append(attempts[-1] * hazard)
    return Statistics(visits, attempts, successes, sum(attempts) * seconds)


def _agreement(earlier: list[Statistics]) -> float:
    """Weight in tries that the mean success of first tries has for another instance: by moments, at least one try."""
    tried = [s for s in earlier if s.attempts and s.attempts[0]]
    hazards = [s.successes[0] / s.attempts[0] for s in tried]
    if len(tried) < 2:
        return math.inf
    mean = sum(hazards) / len(hazards)
    of_counts = sum(mean * (1.0 - mean) / s.attempts[0] for s in tried) / len(tried)
    between = sum((h - mean) ** 2 for h in hazards) / (len(hazards) - 1) - of_counts
    return max(mean * (1.0 - mean) / between - 1.0, 1.0) if between > 0.0 else math.inf
