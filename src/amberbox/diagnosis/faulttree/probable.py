"""The most probable minimal cut sets of trees whose cut sets are too many to find all of them.

Each gate keeps only those of its cut sets from which a probable one of the top event can come. The
most probable set that may have come from a dropped one is remembered.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.core.contracts import Budget
from amberbox.diagnosis.faulttree.decision_diagrams import check_budget
from amberbox.diagnosis.faulttree.graph import FALSE, TRUE, FaultGraph

_LEAST = 1e-300  # the logarithm of less is not finite
_ROUNDED = 1e-5  # more than the error of logarithms in single precision
_BLOCK = 4_000_000  # pairs of sets that are compared at a time
Rows: TypeAlias = NDArray[np.bool_]
Family: TypeAlias = NDArray[np.uint8]
Numbers: TypeAlias = NDArray[np.float32]
Literal: TypeAlias = tuple[int, bool]
"""A vertex and whether it is meant (True) or its opposite."""


@dataclass(frozen=True, slots=True)
class ProbableCutSets:
    """Minimal cut sets with their probabilities, the most probable first.

    No other minimal cut set is more probable than ``floor``; so those listed above it are the most
    probable ones of all. ``repairing`` are the events whose absence may be needed (NOT and XOR).
    """

    sets: tuple[frozenset[str], ...]
    probabilities: tuple[float, ...]
    floor: float
    repairing: frozenset[str] = frozenset()

    @property
    def certain(self) -> int:
        """Return how many of the first sets are surely the most probable ones of all."""
        return sum(chance > self.floor for chance in self.probabilities)

    def joined(self, other: ProbableCutSets) -> ProbableCutSets:
        """Return what both searches in the same tree found."""
        chances = dict(zip(self.sets, self.probabilities, strict=True))
        chances |= zip(other.sets, other.probabilities, strict=True)
        best = sorted(chances.items(), key=lambda entry: -entry[1])
        sets, probabilities = tuple(s for s, _ in best), tuple(chance for _, chance in best)
        floor = min(self.floor, other.floor)
        return ProbableCutSets(sets, probabilities, floor, self.repairing)


def probable_cut_sets(
    graph: FaultGraph, top: int, of_event: Mapping[str, float], size: int, cutoff: float,
    budget: Budget,
) -> ProbableCutSets:  # fmt: skip
    """Return minimal cut sets of a probability of ``cutoff`` or more, up to ``size`` of them.

    A gate keeps up to ``size`` sets, too: if that is not enough, ``floor`` is above the cutoff.
    ``of_event`` are the probabilities of all events. For trees with NOT and XOR a cut set is the
    positive part of a minimal solution. Raises ExhaustedError when the time is up.
    """
    search = _Search(graph, top, of_event, size, _logarithm(cutoff), budget)
    return search.result()


def _logarithm(chance: float) -> float:
    return math.log(max(_LEAST, chance))


def union_bounds(
    found: ProbableCutSets, of_event: Mapping[str, float], given: NDArray[np.float64] | None = None
) -> tuple[float, float]:
    """Return bounds of the probability that the top event happens by one of the sets.

    Increasing events of independent ones are positively associated: given one set, the chance that
    no earlier one has happened is at least the product over those. ``given`` is how probable the
    top event is at least when a set is complete; without it, that no event happens that may undo
    the top event (``repairing``) is asked for.
    """
    sets = found.sets
    if not sets:
        return 0.0, 0.0
    chances = np.array(found.probabilities)
    total = float(np.sum(chances))
    with np.errstate(divide="ignore"):
        joint = float(-np.expm1(np.sum(np.log1p(-np.minimum(chances, 1.0)))))
    events = list(dict.fromkeys(event for entry in sets for event in entry))
    column = {event: place for place, event in enumerate(events)}
    rows = np.zeros((len(sets), len(events)))
    for place, entry in enumerate(sets):
        rows[place, [column[event] for event in entry]] = 1.0
    alone = np.array([found.repairing.isdisjoint(entry) for entry in sets])
    spared = math.prod(1.0 - of_event[event] for event in found.repairing)
    if given is not None:
        alone[:] = True
        spared = 1.0
    certain = np.ones(len(sets)) if given is None else given
    logs = np.array([_logarithm(of_event[event]) for event in events])
    weights = rows @ logs
    lower = 0.0
    for place in np.flatnonzero(alone).tolist():
        before = np.flatnonzero(alone[:place])
        rest = np.minimum(weights[before] - rows[before] @ (rows[place] * logs), 0.0)
        missing = np.where(rest > -1e-12, 0.0, -np.expm1(rest))
        lower += float(chances[place] * max(0.0, np.prod(missing) + certain[place] - 1.0))
    return min(1.0, lower * spared), min(total, joint)


def repairing_events(graph: FaultGraph, top: int) -> frozenset[str]:
    """Return the events whose absence may be needed for the top event."""
    literals = _literals(graph, (top, True))
    return frozenset(graph.vertices[n].event for n, meant in literals if not meant) - {""}


@dataclass
class _Search:
    """One pass over the gates. A family is an array with a row of bits for each of its sets."""

    graph: FaultGraph
    top: int
    of_event: Mapping[str, float]
    size: int
    cutoff: float
    budget: Budget
    dropped: float = -math.inf
    reach: float = 0.0

    def __post_init__(self) -> None:
        self.events = list(self.of_event)
        self.logs = np.array([_logarithm(chance) for chance in self.of_event.values()])
        self.column = {event: place for place, event in enumerate(self.events)}
        nothing = np.zeros((1, len(self.events)), dtype=bool)
        self.always = np.packbits(nothing, axis=1)
        self.never = self.always[:0]

    def result(self) -> ProbableCutSets:
        """Return the sets of the top event."""
        rows = self._rows(self._family(_literals(self.graph, (self.top, True))))
        return self._checked(rows, repairing_events(self.graph, self.top))

    def _family(self, order: Sequence[Literal]) -> Family:
        """Return the family of the last literal; each comes after its inputs."""
        reaches = self._reaches(order)
        uses: dict[Literal, int] = {}
        for literal in order:
            for entry in inputs_of(self.graph, literal):
                uses[entry] = uses.get(entry, 0) + 1
        made: dict[Literal, Family] = {}
        for literal in order:
            check_budget(self.budget, 0)
            self.reach = reaches[literal]
            made[literal] = self._of(literal, made)
            for entry in inputs_of(self.graph, literal):
                uses[entry] -= 1
                if not uses[entry]:
                    del made[entry]
        return made[order[-1]]

    def _reaches(self, order: Sequence[Literal]) -> dict[Literal, float]:
        """Return by literal the logarithm of what its sets are multiplied by, at most.

        On the way to the top each AND adds a set of its other inputs. The best set of an input that
        shares no event with the way below is a factor.
        """
        best: dict[Literal, float] = {}
        below: dict[Literal, int] = {}
        for literal in order:
            best[literal], below[literal] = self._best(literal, best, below)
        reaches = dict.fromkeys(order, -math.inf)
        reaches[order[-1]] = 0.0
        for literal in reversed(order):
            inputs = inputs_of(self.graph, literal)
            for entry in inputs:
                others = [other for other in inputs if not below[other] & below[entry]]
                asked = _together(others, best, below) if self._is_all(literal) else 0.0
                reaches[entry] = max(reaches[entry], reaches[literal] + asked)
        return reaches

    def _best(
        self, literal: Literal, best: Mapping[Literal, float], below: Mapping[Literal, int]
    ) -> tuple[float, int]:
        """Return at most what the best set of a literal has, and the events below it as bits."""
        vertex = self.graph.vertices[literal[0]]
        if vertex.kind == "constant":
            return (0.0 if (literal[0] == TRUE) == literal[1] else -math.inf), 0
        if vertex.kind == "event":
            place = self.column[vertex.event]
            return (float(self.logs[place]), 1 << place) if literal[1] else (0.0, 0)
        inputs = inputs_of(self.graph, literal)
        bits = 0
        for entry in inputs:
            bits |= below[entry]
        if self._is_all(literal):
            return _together(inputs, best, below), bits
        needed = self._needed(literal) if vertex.kind not in ("not", "xor") else 1
        return sorted((best[entry] for entry in inputs), reverse=True)[needed - 1], bits

    def _needed(self, literal: Literal) -> int:
        """Return how many inputs of an AND, OR or k-of-n a literal needs."""
        vertex, size = self.graph.vertices[literal[0]], len(self.graph.vertices[literal[0]].inputs)
        count = {"and": size, "or": 1}.get(vertex.kind, vertex.count)
        return count if literal[1] else size - count + 1

    def _is_all(self, literal: Literal) -> bool:
        vertex = self.graph.vertices[literal[0]]
        plain = vertex.kind in ("and", "or", "atleast")
        return plain and self._needed(literal) == len(vertex.inputs)

    def _of(self, literal: Literal, made: Mapping[Literal, Family]) -> Family:
        number, meant = literal
        vertex = self.graph.vertices[number]
        if vertex.kind == "constant":
            return self.always if (number == TRUE) == meant else self.never
        if vertex.kind == "event":
            row = np.zeros((1, len(self.events)), dtype=bool)
            row[0, self.column[vertex.event]] = meant
            return self._kept(row)
        inputs = [made[entry] for entry in inputs_of(self.graph, literal)]
        if vertex.kind == "not":
            return inputs[0]
        if vertex.kind == "xor":
            return self._any([self._all(inputs[0:4:3]), self._all(inputs[1:3])])
        return self._at_least(self._needed(literal), inputs)

    def _at_least(self, count: int, inputs: Sequence[Family]) -> Family:
        if count == 1:
            return self._any(inputs)
        if count == len(inputs):
            return self._all(inputs)
        reached = [self.always] + [self.never] * count
        for left, entry in zip(reversed(range(len(inputs))), inputs, strict=True):
            for k in range(count, max(0, count - left - 1), -1):
                reached[k] = self._any([self._both(entry, reached[k - 1]), reached[k]])
        return reached[count]

    def _all(self, inputs: Iterable[Family]) -> Family:
        result = self.always
        for entry in sorted(inputs, key=len):
            result = self._both(result, entry)
        return result

    def _any(self, inputs: Sequence[Family]) -> Family:
        return self._kept(self._rows(np.concatenate(inputs)))

    def _both(self, left: Family, right: Family) -> Family:
        """Return the sets that contain one of each family."""
        if left is self.always or not len(right):
            return right
        rows, others = self._rows(left), self._rows(right)
        columns = np.flatnonzero(rows.any(axis=0) | others.any(axis=0))
        a, b = rows[:, columns].astype(np.float32), others[:, columns].astype(np.float32)
        holds_b, holds_a = _holding(a, b), _holding(b, a)  # these absorb their other unions
        found = [rows[holds_b], others[holds_a]]
        rows, others = rows[~holds_b], others[~holds_a]
        if len(rows) and len(others):
            first, second = self._best_pairs(a[~holds_b], b[~holds_a], self.logs[columns])
            found.append(rows[first] | others[second])
        return self._kept(np.concatenate(found))

    def _best_pairs(
        self, a: Numbers, b: Numbers, logs: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the places of the pairs with the most probable unions."""
        logs = logs.astype(np.float32)
        weights = (a @ logs)[:, None] + (b @ logs)[None, :] - (a * logs) @ b.T
        flat = weights.ravel()
        good = np.flatnonzero(flat >= self.cutoff - self.reach - 2 * _ROUNDED)
        if len(good) < len(flat):
            self._drop(self.cutoff - self.reach)
        if len(good) > 2 * self.size:
            chosen = np.argpartition(-flat[good], 2 * self.size)
            least = float(flat[good[chosen[2 * self.size]]])
            self._drop(least + _ROUNDED * (1.0 - least))
            good = good[chosen[: 2 * self.size]]
        first, second = np.divmod(good, len(b))
        return first, second

    def _drop(self, weight: float) -> None:
        self.dropped = max(self.dropped, weight + self.reach)

    def _rows(self, family: Family) -> Rows:
        return np.unpackbits(family, axis=1, count=len(self.events)).astype(bool)

    def _kept(self, rows: Rows) -> Family:
        """Return the minimal ones of sets, of these the most probable."""
        rows = _minimal(self._best_of(rows, 4 * self.size))
        return np.packbits(self._best_of(rows, self.size), axis=1)

    def _best_of(self, rows: Rows, most: int) -> Rows:
        """Return the sets above the cutoff, the most probable first, and drop the others."""
        weights = rows @ self.logs
        order = np.argsort(-weights, kind="stable")
        count = int(np.sum(weights >= self.cutoff - self.reach))
        count = min(count, most)
        if count < len(order):
            self._drop(float(weights[order[count]]))
        return rows[order[:count]]

    def _checked(self, rows: Rows, repairing: frozenset[str]) -> ProbableCutSets:
        """Keep the sets that lead to the top event, and do not without one of their events."""
        order = [number for number, _ in _literals(self.graph, (self.top, True), both=True)]
        owner, missing = np.nonzero(rows)
        fewer = rows[owner]
        fewer[np.arange(len(owner)), missing] = False
        leads = self._truth(order, rows)
        floor = max(self.dropped, *(rows[~leads] @ self.logs), -math.inf)
        leads[owner[self._truth(order, fewer)]] = False
        sets = [frozenset(self.events[n] for n in np.flatnonzero(row)) for row in rows[leads]]
        chances = [math.prod(self.of_event[event] for event in sorted(entry)) for entry in sets]
        return ProbableCutSets(tuple(sets), tuple(chances), math.exp(min(0.0, floor)), repairing)

    def _truth(self, order: Sequence[int], states: Rows) -> NDArray[np.bool_]:
        """Return, by state, whether the top event happens."""
        known: dict[int, NDArray[np.bool_]] = {
            FALSE: np.zeros(len(states), dtype=bool), TRUE: np.ones(len(states), dtype=bool)
        }  # fmt: skip
        for number in order:
            vertex = self.graph.vertices[number]
            if vertex.kind == "event":
                known[number] = states[:, self.column[vertex.event]]
            elif vertex.kind != "constant":
                inputs = [known[entry] for entry in vertex.inputs]
                count = np.sum(inputs, axis=0)
                needed = {"and": len(inputs), "or": 1}.get(vertex.kind, vertex.count)
                plain = count == 1 if vertex.kind == "xor" else count >= needed
                known[number] = ~inputs[0] if vertex.kind == "not" else plain
        return known[self.top]


def _together(
    inputs: Sequence[Literal], best: Mapping[Literal, float], below: Mapping[Literal, int]
) -> float:
    """Return at most what the best set of all inputs has: independent ones add up."""
    total, taken = 0.0, 0
    for entry in sorted(inputs, key=lambda entry: best[entry]):
        if not below[entry] & taken:
            total += best[entry]
            taken |= below[entry]
    return total


def _holding(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which rows of ``a`` contain a row of ``b``."""
    sizes = b.sum(axis=1)
    found = np.zeros(len(a), dtype=bool)
    step = max(1, _BLOCK // max(1, len(b)))
    for start in range(0, len(a), step):
        found[start : start + step] = (a[start : start + step] @ b.T >= sizes).any(axis=1)
    return found


def _minimal(rows: Rows) -> Rows:
    """Return the rows that contain no other one, of equal ones the first."""
    if len(rows) < 2:
        return rows
    packed = np.packbits(rows, axis=1)
    _, first = np.unique(packed.view(f"S{packed.shape[1]}"), return_index=True)
    rows = rows[np.sort(first)]
    used = rows[:, rows.any(axis=0)].astype(np.float32)
    sizes = used.sum(axis=1)
    keep = np.ones(len(rows), dtype=bool)
    step = max(1, _BLOCK // len(rows))
    for start in range(0, len(rows), step):
        block = slice(start, start + step)
        inside = used[block] @ used.T >= sizes
        inside &= sizes < sizes[block, None]
        keep[block] = ~inside.any(axis=1)
    return rows[keep]


def inputs_of(graph: FaultGraph, literal: Literal) -> list[Literal]:
    """Return the literals that one is made of: NOT is moved down to the events."""
    number, meant = literal
    vertex = graph.vertices[number]
    if vertex.kind == "not":
        return [(vertex.inputs[0], not meant)]
    if vertex.kind == "xor":
        left, right = vertex.inputs
        return [(left, True), (left, False), (right, meant), (right, not meant)]
    return [(entry, meant) for entry in vertex.inputs]


def _literals(graph: FaultGraph, top: Literal, both: bool = False) -> list[Literal]:
    """Return the literals below one, each after its inputs; ``both``: and their opposites."""
    order: dict[Literal, None] = {}
    waiting: list[tuple[Literal, bool]] = [(top, False)]
    while waiting:
        literal, ready = waiting.pop()
        if literal in order:
            continue
        if ready:
            order[literal] = None
            continue
        waiting.append((literal, True))
        below = inputs_of(graph, literal)
        if both:
            below = [(entry, True) for entry in graph.vertices[literal[0]].inputs]
        waiting += [(entry, False) for entry in below if entry not in order]
    return list(order)
