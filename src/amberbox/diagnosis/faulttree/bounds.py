"""Bounds of the top event's probability from a sweep over the events, with the states that matter.

The events are decided one after the other. A state is what is then known of the gates; equal states
are merged. The states that can change the answer least are left out: what they may add lies between
bounds that one pass over the open gates gives (compare Herrmann 2010 on networks, where a state is
how the nodes of a frontier are connected).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.core.contracts import Budget
from amberbox.diagnosis.faulttree.decision_diagrams import check_budget
from amberbox.diagnosis.faulttree.graph import TRUE, FaultGraph, FaultTreeModule, is_plain

_FEWEST_ROWS = 1_024  # states are merged when they are more than this, and four times the size
_BLOCK = 8_192  # states that are bounded at a time
_MOST_CHOICES = 40  # k inputs out of n that are looked at one by one
_YES, _NO = -1, -2  # a gate that is decided; otherwise: how many of its inputs have happened
_SEED = 1

Chances: TypeAlias = NDArray[np.float64]  # by state, or one that holds for all
Flags: TypeAlias = NDArray[np.bool_]
Counts: TypeAlias = NDArray[np.int16]


@dataclass(frozen=True, slots=True)
class ProbabilityBounds:
    """The probability is not below ``lower`` and not above ``upper``; both are from 0 to 1."""

    lower: float
    upper: float

    @property
    def width(self) -> float:
        """Return how far the bounds are apart, as a share of the upper one."""
        return (self.upper - self.lower) / self.upper if self.upper else 0.0


def bounds_of_part(
    graph: FaultGraph,
    part: FaultTreeModule,
    order: Sequence[int],
    of_leaf: Mapping[int, ProbabilityBounds],
    size: int,
    budget: Budget,
    most_lost: float = math.inf,
) -> ProbabilityBounds:
    """Return bounds of the probability of one part, given those of its leaves.

    ``order`` are the leaves as they are decided, ``size`` the most states that are kept. When the
    bounds become further apart than ``most_lost``, the rest is left open. Raises ExhaustedError
    when the budget does not suffice.
    """
    if not part.inner:
        return _of_trivial(part, of_leaf)
    high = {leaf: ProbabilityBounds(of_leaf[leaf].upper, of_leaf[leaf].upper) for leaf in order}
    found = _Sweep(graph, part, order, high, size, budget).run(most_lost)
    if all(of_leaf[leaf].lower == of_leaf[leaf].upper for leaf in order):
        return found
    if all(is_plain(graph, number) for number in part.inner):
        low = {leaf: ProbabilityBounds(of_leaf[leaf].lower, of_leaf[leaf].lower) for leaf in order}
        lower = _Sweep(graph, part, order, low, size, budget).run().lower
        return ProbabilityBounds(lower, max(lower, found.upper))
    doubt = math.fsum(of_leaf[leaf].upper - of_leaf[leaf].lower for leaf in order)
    return ProbabilityBounds(max(0.0, found.lower - doubt), min(1.0, found.upper + doubt))


def rough_bounds(
    graph: FaultGraph, parts: Sequence[FaultTreeModule], of_event: Mapping[str, float]
) -> ProbabilityBounds:
    """Return bounds of the top event from one pass over the gates."""
    known: dict[int, ProbabilityBounds] = {}
    for part in parts:
        for leaf in part.leaves:
            if leaf not in known:
                chance = of_event[graph.vertices[leaf].event]
                known[leaf] = ProbabilityBounds(chance, chance)
        if part.inner:
            sweep = _Sweep(graph, part, part.leaves, known, 1, Budget())
            found = sweep.at_first()
            known[part.vertex] = ProbabilityBounds(float(found.low[0]), float(found.high[0]))
        else:
            known[part.vertex] = _of_trivial(part, known)
    return known[parts[-1].vertex]


def least_given(
    graph: FaultGraph,
    parts: Sequence[FaultTreeModule],
    of_event: Mapping[str, float],
    sets: Sequence[frozenset[str]],
) -> NDArray[np.float64]:
    """Return for each set of events the least probability of the top event when they happened."""
    known: dict[int, tuple[Chances, Chances]] = {}
    for part in parts:
        for leaf in part.leaves:
            if leaf not in known:
                event = graph.vertices[leaf].event
                chance = np.array([1.0 if event in entry else of_event[event] for entry in sets])
                known[leaf] = chance, chance
        if part.inner:
            whole = dict.fromkeys(part.leaves, ProbabilityBounds(0.0, 1.0))
            sweep = _Sweep(graph, part, part.leaves, whole, 1, Budget())
            for leaf, (low, high) in known.items():
                if leaf in sweep.leaves:
                    sweep.leaves[leaf] = sweep.leaves[leaf]._replace(low=low, high=high)
            found = sweep.at_first()
            known[part.vertex] = found.low, found.high
    constant = np.full(1, float(parts[-1].vertex == TRUE))
    return np.broadcast_to(known.get(parts[-1].vertex, (constant,))[0], len(sets))


def _of_trivial(
    part: FaultTreeModule, of_leaf: Mapping[int, ProbabilityBounds]
) -> ProbabilityBounds:
    """Return the bounds of a part that is an event or a constant."""
    constant = float(part.vertex == TRUE)
    return of_leaf.get(part.vertex, ProbabilityBounds(constant, constant))


class _Range(NamedTuple):
    """Bounds of a vertex by state, the open leaves below it as bits, and whether it is coherent."""

    low: Chances
    high: Chances
    below: int
    coherent: bool


@dataclass
class _Sweep:
    """The states after the leaves that are decided, with the probability (``mass``) of each.

    ``counts`` has for each gate that is begun how many of its inputs have happened (of an XOR,
    whether an odd number has); ``open`` are its inputs that are not decided yet. ``lower`` is the
    probability that the top event is known to have, ``lost`` how much more it may be. ``untouched``
    are the bounds of gates none of whose leaves is decided: they are the same in all states.
    """

    graph: FaultGraph
    part: FaultTreeModule
    order: Sequence[int]
    of_leaf: Mapping[int, ProbabilityBounds]
    size: int
    budget: Budget
    lower: float = 0.0
    lost: float = 0.0
    counts: dict[int, Counts] = field(default_factory=dict)
    untouched: dict[int, _Range] = field(default_factory=dict)

    def __post_init__(self) -> None:
        vertices = {number: self.graph.vertices[number] for number in self.part.inner}
        self.kinds = {number: vertex.kind for number, vertex in vertices.items()}
        self.needed = {
            number: {"and": len(vertex.inputs), "or": 1}.get(vertex.kind, vertex.count)
            for number, vertex in vertices.items()
        }
        self.open = {number: list(vertex.inputs) for number, vertex in vertices.items()}
        self.users: dict[int, list[int]] = {}
        for number, vertex in vertices.items():
            for entry in vertex.inputs:
                self.users.setdefault(entry, []).append(number)
        factors = np.random.default_rng(_SEED).integers(1, 2**63, len(vertices), dtype=np.uint64)
        self.factors = dict(zip(vertices, factors * np.uint64(2) + np.uint64(1), strict=True))
        self.leaves = {
            leaf: _Range(np.array([known.lower]), np.array([known.upper]), 1 << place, True)
            for place, leaf in enumerate(self.order)
            for known in (self.of_leaf[leaf],)
        }
        self.mass = np.ones(1)

    def run(self, most_lost: float = math.inf) -> ProbabilityBounds:
        """Decide all leaves and return bounds of the part; see ``bounds_of_part``."""
        most = max(4 * self.size, _FEWEST_ROWS)
        found = self._ranges(self._groups(), slice(None))
        self.untouched = {number: found[number] for number in self.open}
        for leaf in self.order:
            check_budget(self.budget, 0)
            self._touch(leaf)
            chance = self.of_leaf[leaf].upper
            self.mass = np.concatenate([self.mass * (1.0 - chance), self.mass * chance])
            self.counts = {n: np.concatenate([entry] * 2) for n, entry in self.counts.items()}
            self._decide(leaf, np.arange(len(self.mass)) >= len(self.mass) // 2)
            if self.part.vertex in self.open and len(self.mass) > most:
                self._reduce()
            if self.lost > most_lost:
                break
        lower = min(1.0, self.lower)
        upper = lower + self.lost + float(np.sum(self.mass))
        return ProbabilityBounds(lower, min(1.0, upper))

    def _touch(self, leaf: int) -> None:
        """Forget the bounds of all gates above a leaf."""
        waiting = [leaf]
        while waiting:
            for number in self.users.get(waiting.pop(), ()):
                if self.untouched.pop(number, None) is not None:
                    waiting.append(number)

    def at_first(self) -> _Range:
        """Return the bounds of the part while no leaf is decided."""
        return self._ranges(self._groups(), slice(None))[self.part.vertex]

    def _decide(self, vertex: int, happened: Flags) -> None:
        """Count a vertex in the gates that use it, and go on with those that are decided then."""
        waiting = [(vertex, happened)]
        while waiting:
            vertex, happened = waiting.pop()
            if vertex == self.part.vertex:
                self.lower += float(np.sum(self.mass[happened]))
                self.mass = self.mass[:0]
                self.counts = {number: entry[:0] for number, entry in self.counts.items()}
                return
            for number in self.users[vertex]:
                self.open[number].remove(vertex)
                counts = self._counted(number, happened)
                if self.open[number]:
                    self.counts[number] = counts
                    continue
                self.counts.pop(number, None)
                del self.open[number]
                odd = (counts == 1) | (counts == _YES)
                waiting.append((number, counts == _YES if self._counts(number) else odd))

    def _counts(self, number: int) -> bool:
        return self.kinds[number] in ("and", "or", "atleast")

    def _counted(self, number: int, happened: Flags) -> Counts:
        counts = self.counts.get(number)
        if counts is None:
            counts = np.zeros(len(self.mass), dtype=np.int16)
        if not self._counts(number):
            flips = ~happened if self.kinds[number] == "not" else happened
            return np.where(counts < 0, counts, counts ^ flips).astype(np.int16)
        counts = counts + (happened & (counts >= 0)).astype(np.int16)
        counts[counts >= self.needed[number]] = _YES
        counts[(counts >= 0) & (counts + len(self.open[number]) < self.needed[number])] = _NO
        return counts

    def _reduce(self) -> None:
        """Settle the states that are decided, merge equal ones and keep those that matter."""
        low, high = self._settle()
        self.lower += float(np.sum(self.mass[low >= 1.0]))
        open_rows = (low < 1.0) & (high > 0.0) & (self.mass > 0.0)
        rows, mass = self._merged(np.flatnonzero(open_rows))
        low, high = low[rows], high[rows]
        if len(rows) > self.size:
            weights = mass * (high - low)
            order = np.argpartition(-weights, self.size)
            stay, gone = np.sort(order[: self.size]), order[self.size :]
            self.lower += float(np.sum(mass[gone] * low[gone]))
            self.lost += float(np.sum(weights[gone]))
            rows, mass = rows[stay], mass[stay]
        self.mass = mass
        self.counts = {number: entry[rows] for number, entry in self.counts.items()}

    def _settle(self) -> tuple[Chances, Chances]:
        """Write down what is decided already, and what no longer matters; return bounds of the top.

        That way states become equal that differ only in what has no effect.
        """
        rows = len(self.mass)
        groups = self._groups()
        top = self.part.vertex
        low, high = np.zeros(rows), np.ones(rows)
        settled: dict[int, Counts] = {}
        for start in range(0, rows, _BLOCK):
            block = slice(start, min(rows, start + _BLOCK))
            ranges = self._ranges(groups, block)
            matters = self._matter(ranges)
            anyway = np.array([True])
            low[block], high[block] = ranges[top].low, ranges[top].high
            for number in self.open:
                known, counts = ranges[number], self.counts.get(number)
                sure, never = known.low >= 1.0, known.high <= 0.0
                if counts is None and not (sure.any() or never.any()):
                    continue
                if number not in settled:
                    begun = np.zeros(rows, dtype=np.int16)
                    settled[number] = begun if counts is None else counts.copy()
                values = settled[number][block]
                values[np.broadcast_to(sure, values.shape)] = _YES
                unneeded = ~matters.get(number, anyway)
                values[np.broadcast_to(never | unneeded, values.shape)] = _NO
        self.counts = settled
        return low, high

    def _matter(self, ranges: Mapping[int, _Range]) -> dict[int, Flags]:
        """Return by open gate in which states the top event may depend on it.

        Those that are untouched are left out.
        """
        found: dict[int, Flags] = {self.part.vertex: np.array([True])}
        undecided: dict[int, Flags] = {}
        for number in reversed(self.open):
            if number in self.untouched:
                continue
            if number not in found:
                found[number] = np.array([False])
                for user in self.users[number]:
                    if user in undecided:
                        found[number] = found[number] | undecided[user]
            known = ranges[number]
            undecided[number] = found[number] & (known.low < 1.0) & (known.high > 0.0)
        return found

    def _merged(self, rows: NDArray[np.intp]) -> tuple[NDArray[np.intp], Chances]:
        """Return one row of each group of equal states, with the probability of the group."""
        if not len(rows):
            return rows, np.zeros(0)
        key = np.zeros(len(rows), dtype=np.uint64)
        for number, counts in self.counts.items():
            key += counts[rows].astype(np.uint64) * self.factors[number]
        order = np.argsort(key, kind="stable")
        rows, key = rows[order], key[order]
        same = key[1:] == key[:-1]
        for counts in self.counts.values():
            entries = counts[rows]
            same &= entries[1:] == entries[:-1]
        first = np.flatnonzero(np.concatenate([[True], ~same]))
        return rows[first], np.add.reduceat(self.mass[rows], first)

    def _groups(self) -> dict[int, list[list[int]]]:
        """Return the open inputs of each touched gate, in groups that share no open leaf."""
        below = {leaf: known.below for leaf, known in self.leaves.items()}
        found: dict[int, list[list[int]]] = {}
        for number, inputs in self.open.items():
            if number in self.untouched:
                below[number] = self.untouched[number].below
                continue
            below[number] = 0
            groups: list[tuple[int, list[int]]] = []
            for entry in inputs:
                bits, members = below[entry], [entry]
                below[number] |= bits
                apart = [group for group in groups if not group[0] & bits]
                for group in groups:
                    if group[0] & bits:
                        bits, members = bits | group[0], group[1] + members
                groups = [*apart, (bits, members)]
            found[number] = [members for _, members in groups]
        return found

    def _ranges(self, groups: Mapping[int, list[list[int]]], block: slice) -> dict[int, _Range]:
        """Return the bounds of all open gates in the states of a block."""
        found: dict[int, _Range] = self.leaves | self.untouched
        for number in self.open:
            if number in self.untouched:
                continue
            inputs = [[found[entry] for entry in group] for group in groups[number]]
            counts = self.counts.get(number)
            counts = None if counts is None else counts[block]
            low, high = self._of_gate(number, inputs, counts)
            if counts is not None:
                yes, no = counts == _YES, counts == _NO
                low = np.where(yes, 1.0, np.where(no, 0.0, low))
                high = np.where(yes, 1.0, np.where(no, 0.0, high))
            flat = [entry for group in inputs for entry in group]
            below = 0
            for entry in flat:
                below |= entry.below
            plain = self._counts(number) and all(entry.coherent for entry in flat)
            found[number] = _Range(low, high, below, plain)
        return found

    def _of_gate(
        self, number: int, groups: Sequence[Sequence[_Range]], counts: Counts | None
    ) -> tuple[Chances, Chances]:
        kind, needed = self.kinds[number], self.needed[number]
        if kind == "not":
            return 1.0 - groups[0][0].high, 1.0 - groups[0][0].low
        if kind == "xor":
            low, high = _odd(groups)
            if counts is None:
                return low, high
            return np.where(counts == 1, 1.0 - high, low), np.where(counts == 1, 1.0 - low, high)
        if needed == 1:
            return _any(groups)
        if needed == len(self.graph.vertices[number].inputs):
            return _all(groups)
        if counts is None:
            return _at_least(needed, groups)
        low, high = np.zeros(len(counts)), np.ones(len(counts))
        for seen in range(needed):
            rows = counts == seen
            if rows.any():
                some = [[_of_rows(entry, rows) for entry in group] for group in groups]
                low[rows], high[rows] = _at_least(needed - seen, some)
        return low, high


def _of_rows(known: _Range, rows: Flags) -> _Range:
    low = known.low if len(known.low) == 1 else known.low[rows]
    high = known.high if len(known.high) == 1 else known.high[rows]
    return _Range(low, high, known.below, known.coherent)


def _or(left: Chances, right: Chances) -> Chances:
    """Return the probability of one or the other; exact for tiny ones, and where one is 1."""
    return left + right * (1.0 - left)


def _apart(entries: Sequence[_Range]) -> Iterator[tuple[_Range, bool]]:
    """Yield each entry and whether it shares no leaf with the earlier ones of which this holds."""
    taken = 0
    for entry in entries:
        alone = not entry.below & taken
        taken |= entry.below if alone else 0
        yield entry, alone


def _any(groups: Sequence[Sequence[_Range]]) -> tuple[Chances, Chances]:
    """Return bounds of an OR: exact for independent inputs.

    Coherent inputs are positively associated: independent ones would be at least as probable.
    """
    low = high = np.zeros(1)
    for group in groups:
        least, most = np.zeros(1), np.zeros(1)
        together = all(entry.coherent for entry in group)
        for entry in group:
            most = _or(most, entry.high) if together else np.minimum(1.0, most + entry.high)
        for entry, alone in _apart(group):
            least = _or(least, entry.low) if alone else np.maximum(least, entry.low)
        low, high = _or(low, least), _or(high, most)
    return low, high


def _all(groups: Sequence[Sequence[_Range]]) -> tuple[Chances, Chances]:
    """Return bounds of an AND: exact for independent inputs; see ``_any``."""
    low = high = np.ones(1)
    for group in groups:
        least, most = np.ones(1), np.ones(1)
        together = all(entry.coherent for entry in group)
        for entry in group:
            least = least * entry.low if together else np.maximum(0.0, least + entry.low - 1.0)
        for entry, alone in _apart(group):
            most = most * entry.high if alone else np.minimum(most, entry.high)
        low, high = low * least, high * most
    return low, high


def _odd(groups: Sequence[Sequence[_Range]]) -> tuple[Chances, Chances]:
    """Return bounds of the XOR of one or two inputs."""
    if len(groups) == 1 and len(groups[0]) == 1:
        return groups[0][0].low, groups[0][0].high
    if len(groups) == 1:
        left, right = groups[0]
        low = np.maximum(0.0, np.maximum(left.low - right.high, right.low - left.high))
        high = np.minimum(left.high + right.high, 2.0 - left.low - right.low)
        return low, np.minimum(1.0, high)
    left, right = groups[0][0], groups[1][0]
    corners = [
        a * (1.0 - b) + b * (1.0 - a)
        for a in (left.low, left.high)
        for b in (right.low, right.high)
    ]
    least, most = corners[0], corners[0]
    for corner in corners[1:]:
        least, most = np.minimum(least, corner), np.maximum(most, corner)
    return least, most


def _at_least(count: int, groups: Sequence[Sequence[_Range]]) -> tuple[Chances, Chances]:
    """Return bounds of ``count`` or more inputs: exact for independent inputs."""
    inputs = [entry for group in groups for entry in group]
    if count > len(inputs):
        return np.zeros(1), np.zeros(1)
    if count == 1:
        return _any(groups)
    if count == len(inputs):
        return _all(groups)
    if len(groups) == len(inputs):
        lows, highs = [entry.low for entry in inputs], [entry.high for entry in inputs]
        return _independent(count, lows), _independent(count, highs)
    total: Chances = np.zeros(1)
    for entry in inputs:
        total = total + entry.high
    low, high = np.zeros(1), np.minimum(1.0, total / count)  # Markov
    if math.comb(len(inputs), count) > _MOST_CHOICES:
        return low, high
    most: Chances = np.zeros(1)
    together = all(entry.coherent for entry in inputs)
    for chosen in combinations(inputs, count):
        least, all_high = _all(_grouped(chosen))
        most = _or(most, all_high) if together else np.minimum(1.0, most + all_high)
        low = np.maximum(low, least)
    return low, np.minimum(high, most)


def _grouped(entries: Sequence[_Range]) -> list[list[_Range]]:
    groups: list[list[_Range]] = []
    for entry in entries:
        together, apart = [entry], []
        for group in groups:
            if any(other.below & entry.below for other in group):
                together = [*group, *together]
            else:
                apart.append(group)
        groups = [*apart, together]
    return groups


def _independent(count: int, chances: Sequence[Chances]) -> Chances:
    """Return the probability that ``count`` or more of independent inputs happen."""
    reached: list[Chances] = [np.ones(1), *(np.zeros(1) for _ in range(count))]
    for chance in chances:
        for k in range(count, 0, -1):
            reached[k] = reached[k] + chance * (reached[k - 1] - reached[k])
    return reached[count]
