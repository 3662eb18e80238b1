"""Trajectories: which states follow each other, and when the faults of a diagnosis happened."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TypeAlias

from amberbox.core.contracts import Budget
from amberbox.core.errors import UsageError
from amberbox.diagnosis.consistency.components import Components, Step, Value
from amberbox.diagnosis.consistency.encoding import (
    Instant,
    Start,
    State,
    add_instant,
    add_modes,
    add_transitions,
    command_literals,
)
from amberbox.diagnosis.consistency.integers import IntegerSolver

NOTHING_SEEN = Step()
_MOST_STATES = 1_000
_MOST_KNOWN = 10_000


class Moves:
    """Which states agree with a step and the one before it."""

    def __init__(self, model: Components, budget: Budget) -> None:
        self._model = model
        self._budget = budget
        self._is_finite = all(domain is not None for domain in model.domains.values())
        self._encoded: _Move | None = None
        self._known: dict[tuple[State, frozenset[str], object, int], list[State]] = {}

    def after(
        self, state: State, faults: frozenset[str], before: Step, step: Step, most: int = 0
    ) -> list[State]:
        """Return the states that follow when exactly these faults happen; at most so many, or all.

        ``before`` is the step that ``state`` was reached in. Raises OutOfTimeError.
        """
        key = state, faults, _content(before, step), most
        if key not in self._known:
            if len(self._known) >= _MOST_KNOWN:
                self._known.clear()
            self._known[key] = list(self._move(before, step).states(*key[:2], before, step, most))
        return self._known[key]

    def _move(self, before: Step, step: Step) -> _Move:
        if not self._is_finite:  # observed integers are no assumptions
            return _Move(self._model, self._budget, before, step)
        if self._encoded is None:
            self._encoded = _Move(self._model, self._budget)
        return self._encoded


def _content(before: Step, step: Step) -> tuple[frozenset[tuple[str, Value]], ...]:
    return tuple(
        frozenset(given.items()) for given in (before.observe, step.commands, step.observe)
    )


class _Move:
    """Two instants as clauses; what was observed and commanded is assumed."""

    def __init__(
        self, model: Components, budget: Budget, before: Step | None = None,
        step: Step | None = None,
    ) -> None:  # fmt: skip
        self._model = model
        self._solver = solver = IntegerSolver(budget)
        seen, now = (before or NOTHING_SEEN).observe, (step or NOTHING_SEEN).observe
        self._first = add_instant(solver, model, add_modes(solver, model), seen, None)
        modes = add_modes(solver, model)
        self._faults = add_transitions(solver, model, self._first, modes)
        self._quiet = solver.variable()
        for literal in self._faults.values():
            solver.add([-self._quiet, -literal])
        self._last = add_instant(solver, model, modes, now, None)

    def states(
        self, state: State, faults: Collection[str], before: Step, step: Step, most: int
    ) -> Iterator[State]:
        """Yield the states that follow when exactly these faults happen."""
        model, solver = self._model, self._solver
        assumed = [self._first.modes[n][m] for n, m in zip(model.components, state, strict=True)]
        assumed += self._seen(self._first, before, step)
        assumed += self._seen(self._last, step, NOTHING_SEEN)
        if faults:
            assumed += [self._faults[name] for name in faults]
            assumed += [-lit for name, lit in self._faults.items() if name not in faults]
        else:
            assumed.append(self._quiet)
        blocking = 0
        count = 0
        while solver.solve([*assumed, blocking] if blocking else assumed):
            yield read_state(solver, self._last)
            count += 1
            if count == most:
                break
            blocking = blocking or solver.variable()
            solver.add([-blocking, *(-lit for lit in true_modes(solver, self._last))])
        if blocking:
            solver.add([-blocking])

    def _seen(self, at: Instant, step: Step, following: Step) -> Iterator[int]:
        model = self._model
        for name, value in step.observe.items():
            if model.nets[name] in at.values:
                yield at.values[model.nets[name]][value]
        yield from command_literals(model, at.values, step.observe, following.commands)


def read_state(solver: IntegerSolver, at: Instant) -> State:
    """Return the modes of an instant in the model of a solver."""
    return tuple(
        next(mode for mode, literal in modes.items() if solver.holds(literal))
        for modes in at.modes.values()
    )


def true_modes(solver: IntegerSolver, at: Instant) -> Iterator[int]:
    """Yield the literals of the modes of an instant in the model of a solver."""
    for modes in at.modes.values():
        yield from (literal for literal in modes.values() if solver.holds(literal))


@dataclass(frozen=True, slots=True)
class Times:
    """When the faults of a diagnosis may have happened: steps, counted from 1.

    ``variants`` are the ways in which they may be spread over the steps, each with the least rank;
    ``states`` those that components may be in after the last step.
    """

    variants: int
    first: Mapping[str, int]
    last: Mapping[str, int]
    states: frozenset[State] = frozenset()


# Possible states, and the steps of faults so far: how often each has happened, and their rank
_Node: TypeAlias = "tuple[frozenset[State], frozenset[str], int]"


def times_of(
    model: Components,
    moves: Moves,
    starts: Sequence[Start],
    steps: Sequence[Step],
    names: Collection[str],
    rank: int,
    before: Step = NOTHING_SEEN,
    forgotten: int = 0,
) -> Times:
    """Return when the faults of a diagnosis of this rank may have happened; raises OutOfTimeError.

    ``before`` is the step before the first one, ``forgotten`` how many there were. Faults that led
    to a start count with the steps that it remembers.
    """
    counted = _Counted(model, moves, frozenset(names), rank, before, forgotten)
    variants = 0
    first: dict[str, int] = {}
    last: dict[str, int] = {}
    states: frozenset[State] = frozenset()
    for start in starts:
        if not start.faults.keys() <= counted.names or start.rank > rank:
            continue
        found = counted.spread(start, steps)
        variants += found.variants
        states |= found.states
        if found.variants:
            for name, at in found.first.items():
                first[name] = min(at, first.get(name, at))
            for name, at in found.last.items():
                last[name] = max(at, last.get(name, at))
    return Times(variants, first, last, states)


class _Counted:
    """Counts the ways over time, step by step: what comes later depends only on the states."""

    def __init__(
        self, model: Components, moves: Moves, names: frozenset[str], rank: int, before: Step,
        forgotten: int,
    ) -> None:  # fmt: skip
        self.names = names
        self._before, self._forgotten = before, forgotten
        self._model, self._moves, self._rank = model, moves, rank
        self._ranks = {name: model.mode(name).rank for name in names}
        self._sets = [
            frozenset(chosen)
            for size in range(len(names) + 1)
            for chosen in combinations(sorted(names), size)
            if len({model.faults[name][0] for name in chosen}) == size
        ]

    def spread(self, start: Start, steps: Sequence[Step]) -> Times:
        """Return the ways from one start."""
        states = frozenset(begin_states(self._model, start))
        root: _Node = states, frozenset(start.faults), start.rank
        layers: list[dict[_Node, int]] = [{root: 1}]
        edges: list[list[tuple[_Node, frozenset[str], _Node]]] = []
        before = self._before
        for step in steps:
            edges.append([])
            layer: dict[_Node, int] = {}
            for node, count in layers[-1].items():
                for chosen, after in self._next(node, before, step):
                    edges[-1].append((node, chosen, after))
                    layer[after] = layer.get(after, 0) + count
            layers.append(layer)
            before = step
        ends = {node for node in layers[-1] if node[1] == self.names and node[2] == self._rank}
        variants = sum(layers[-1][node] for node in ends)
        reached = frozenset(state for node in ends for state in node[0])
        first = {name: min(at) for name, at in start.faults.items()} if variants else {}
        last = {name: max(at) for name, at in start.faults.items()} if variants else {}
        for number in range(len(steps), 0, -1):
            kept = [edge for edge in edges[number - 1] if edge[2] in ends]
            for _, chosen, _ in kept:
                at = self._forgotten + number
                for name in chosen:
                    first[name] = min(at, first.get(name, at))
                    last[name] = max(at, last.get(name, at))
            ends = {node for node, _, _ in kept}
        return Times(variants, first, last, reached)

    def _next(
        self, node: _Node, before: Step, step: Step
    ) -> Iterator[tuple[frozenset[str], _Node]]:
        states, had, spent = node
        for chosen in self._sets:
            rank = spent + sum(self._ranks[name] for name in chosen)
            missing = self.names - had - chosen
            if rank + sum(self._ranks[name] for name in missing) > self._rank:
                continue
            after = frozenset(
                one for state in states for one in self._moves.after(state, chosen, before, step)
            )
            if after:
                yield chosen, (after, had | chosen, rank)


def begin_states(model: Components, start: Start) -> list[State]:
    """Return the states that a start stands for: components without a mode are in a nominal one."""
    states: list[State] = [()]
    for name, kind in model.components.items():
        nominal = [mode for mode, what in model.types[kind].modes.items() if what.nominal]
        modes = [start.modes[name]] if name in start.modes else nominal
        states = [(*state, mode) for state in states for mode in modes]
        if len(states) > _MOST_STATES:
            raise UsageError(
                f"the model may begin in more than {_MOST_STATES:,} states",
                "name the modes of its components under initial:",
            )
    return states
