"""Tracking over time: the minimal diagnoses after each step, from a history of bounded length.

While the diagnoses explain what is observed, only their states are moved on; when one no longer
does, the steps of the history are searched again. What lies further back is remembered as at most
``candidates`` states. Diagnoses that are less probable than 10^-6 of the best are not tracked.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from math import prod

from amberbox.core.contracts import Budget
from amberbox.diagnosis.consistency.components import Components, Step
from amberbox.diagnosis.consistency.diagnoses import minimal_diagnoses
from amberbox.diagnosis.consistency.encoding import (
    Encoded,
    Instant,
    Start,
    State,
    encode_steps,
    starts_of,
)
from amberbox.diagnosis.consistency.integers import IntegerSolver
from amberbox.diagnosis.consistency.trajectories import NOTHING_SEEN, Moves, read_state, true_modes

MARGIN = 6
"""Diagnoses whose rank exceeds the least one by more are not tracked."""
_MOST_LOOKS = 30  # at other states of the diagnoses when steps are forgotten


@dataclass(frozen=True, slots=True)
class Explanation:
    """A minimal diagnosis after a step.

    ``states`` are those of one trajectory, the one before the history first; ``happened`` are its
    faults since, with their steps.
    """

    names: tuple[str, ...]
    rank: int
    states: tuple[State, ...]
    start: Start
    happened: tuple[tuple[str, int], ...]


class Tracker:
    """The minimal diagnoses of a model over time, the least rank first."""

    def __init__(self, model: Components, budget: Budget | None = None) -> None:
        self._model = model
        self._budget = Budget() if budget is None else budget
        self._moves = Moves(model, self._budget)
        self.starts: Sequence[Start] = starts_of(model)
        """States before the steps of the history."""
        self.before = NOTHING_SEEN
        """The last step before the history."""
        self.steps: list[Step] = []
        self.forgotten = 0
        """How many steps lie before the history."""
        self.pruned = 0.0
        """Share of the probability of the states that were not remembered; with ``is_cut`` at
        least this."""
        self.is_cut = False
        self.explanations: Sequence[Explanation] | None = None
        """None before the first step; empty once nothing explains what was observed."""
        self._more: Sequence[Explanation] = ()

    def take(self, step: Step) -> None:
        """Take the commands and observations of a step; raises OutOfTimeError."""
        if self.explanations is not None and not self.explanations:
            return
        before = self.steps[-1] if self.steps else self.before
        self.steps.append(step)
        if self.explanations is None:
            self._search()
        else:
            moved = list(self._moved(before, step))
            if len(moved) == len(self.explanations):
                self.explanations = moved
            else:
                self._search()
        history = self._model.history
        if history and self.explanations and len(self.steps) >= 2 * history:
            self._forget(len(self.steps) - history)

    def _moved(self, before: Step, step: Step) -> Iterator[Explanation]:
        """Yield the explanations with the next state, until one has none without a fault."""
        for one in self.explanations or ():
            after = self._moves.after(one.states[-1], frozenset(), before, step, 1)
            if not after:
                return
            yield replace(one, states=(*one.states, after[0]))

    def _encoded(self) -> tuple[IntegerSolver, Encoded]:
        solver = IntegerSolver(self._budget)
        seen = self.before.observe
        return solver, encode_steps(self._model, solver, self.starts, self.steps, seen=seen)

    def _search(self) -> None:
        most = self._model.candidates
        found = self._found(most + 1)
        self._more = found[most:]
        self.explanations = found[:most]

    @property
    def has_more(self) -> bool:
        """Return whether there are more diagnoses than ``candidates``."""
        return bool(self._more)

    def _found(self, most: int) -> list[Explanation]:
        """Return the minimal diagnoses of the history, at most so many."""
        solver, encoded = self._encoded()
        ranks = {fault: self._model.mode(fault).rank for fault in encoded.faults}
        found: list[Explanation] = []
        by_rank = minimal_diagnoses(solver, encoded.faults, ranks, within=MARGIN)
        for _, names in islice(by_rank, most):
            found.append(self._explanation(solver, encoded, sum(ranks[name] for name in names)))
        return found

    def _explanation(self, solver: IntegerSolver, encoded: Encoded, rank: int) -> Explanation:
        """Return the trajectory in the model of a solver."""
        names = [name for name, literal in encoded.faults.items() if solver.holds(literal)]
        states = tuple(read_state(solver, at) for at in encoded.instants)
        chosen = zip(encoded.starts, self.starts, strict=True)
        start = next(start for literal, start in chosen if solver.holds(literal))
        happened = tuple(
            (name, self.forgotten + number)
            for (name, number), literal in encoded.occurrences.items()
            if solver.holds(literal)
        )
        return Explanation(tuple(sorted(names)), rank, states, start, happened)

    def _forget(self, count: int) -> None:
        """Keep the states after so many steps of the history in place of the steps."""
        reached = [(one, self._start(one, count)) for one in self.explanations or ()]
        found = sorted(self._states_after(count), key=lambda start: start.rank)
        kept = found[: self._model.candidates]
        weights = [self._weight(start) for start in found]
        weights += [prod(map(self._probability, one.names)) for one in self._more]
        dropped = sum(weights[len(kept) :]) / sum(weights)
        self.pruned = 1.0 - (1.0 - self.pruned) * (1.0 - dropped)
        self.is_cut |= self.has_more
        self.before = self.steps[count - 1]
        self.starts, self.steps = kept, self.steps[count:]
        self.forgotten += count
        known = {_key(start): start for start in kept}
        left = [
            replace(
                one, states=one.states[count:], start=known[_key(start)],
                happened=tuple(each for each in one.happened if each[1] > self.forgotten),
            )
            for one, start in reached if _key(start) in known
        ]  # fmt: skip
        if len(left) == len(reached) and not self.has_more:
            self.explanations = left
        else:
            self._search()

    def _weight(self, start: Start) -> float:
        return prod(self._probability(name) ** len(steps) for name, steps in start.faults.items())

    def _probability(self, name: str) -> float:
        return self._model.mode(name).probability or 0.001

    def _states_after(self, count: int) -> list[Start]:
        """Return the states of the diagnoses after some steps, each with the faults before it.

        Those of their trajectories come first, then others that the same faults may lead to.
        """
        known = self.explanations or ()
        own = [self._start(one, count) for one in known]
        found = {_key(start): start for start in reversed(own)}
        solver, encoded = self._encoded()
        at, looks = encoded.instants[count], 0
        for one in known:
            blocking = solver.variable()
            solver.add(
                [-blocking, *(-lit for lit in _literals(self._model, at, one.states[count]))]
            )
            absent = [-lit for name, lit in encoded.faults.items() if name not in one.names]
            while looks < _MOST_LOOKS and solver.solve([blocking, *absent]):
                start = self._start(self._explanation(solver, encoded, one.rank), count)
                found.setdefault(_key(start), start)
                solver.add([-blocking, *(-literal for literal in true_modes(solver, at))])
                looks += 1
            solver.add([-blocking])
        self.is_cut |= looks == _MOST_LOOKS
        return list(found.values())

    def _start(self, one: Explanation, count: int) -> Start:
        """Return the state of an explanation after some steps of the history."""
        faults, rank = dict(one.start.faults), one.start.rank
        for name, step in one.happened:
            if step <= self.forgotten + count:
                faults[name] = (*faults.get(name, ()), step)
                rank += self._model.mode(name).rank
        modes = dict(zip(self._model.components, one.states[count], strict=True))
        return Start(modes, faults, rank)


def _key(start: Start) -> tuple[State, frozenset[str]]:
    return tuple(start.modes.values()), frozenset(start.faults)


def _literals(model: Components, at: Instant, state: State) -> Iterator[int]:
    """Yield the literals of the modes of a state at an instant."""
    for name, mode in zip(model.components, state, strict=True):
        yield at.modes[name][mode]
