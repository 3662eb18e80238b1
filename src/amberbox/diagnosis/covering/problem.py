"""One question to the engine: the failure modes that matter for it, in groups that are alike.

Failure modes that touch no clue, neither directly nor through functions shared with others, are
independent of the rest given the evidence: they are summed out exactly and appear nowhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amberbox.diagnosis.covering.clues import Clue, Folded
from amberbox.diagnosis.covering.gates import Gates, bits
from amberbox.diagnosis.covering.tables import Floats, Ints, Tables

NEVER = -math.inf

Hits = tuple[tuple[int, float], ...]
"""Clues with 1 - detects."""


class Group:
    """Failure modes that act alike on every clue and function that matters.

    ``hits`` are (clue, 1 - detects), ``component`` what they take down (-1: nothing that
    matters), ``modes`` from the most to the least probable.
    """

    __slots__ = ("_sums", "component", "hits", "log_best", "modes", "weights")

    def __init__(
        self, modes: list[int], log_weights: Sequence[float], hits: Hits, component: int
    ) -> None:
        if len(modes) > 1:
            modes.sort(key=lambda mode: (-log_weights[mode], mode))
        self.modes = modes
        self.weights = [log_weights[mode] for mode in modes]
        self.hits = hits
        self.component = component
        self.log_best = best = self.weights[0]
        first = best
        if len(modes) > 1:
            first += math.log(sum([math.exp(weight - best) for weight in self.weights]))
        self._sums = [0.0, first]

    def __len__(self) -> int:
        return len(self.modes)

    def log_sum(self, count: int) -> float:
        """Return the logarithm of the summed weight of all sets of so many members."""
        while len(self._sums) <= count:
            self._extend()
        return self._sums[count]

    def _extend(self) -> None:
        """Add the next elementary symmetric polynomial of the weights, scaled by the best."""
        count = len(self._sums)
        sums = [1.0] + [0.0] * count
        for weight in self.weights:
            ratio = math.exp(weight - self.log_best)
            for k in range(count, 0, -1):
                sums[k] += sums[k - 1] * ratio
        self._sums.append(log(sums[count]) + count * self.log_best)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """The groups that matter, with what each clue and function needs of them.

    ``unknown`` is the group of the unknown mode, which is alone in it; -1 if there is none.

    ``causes[k]`` are the groups that can act on clue k, ``cause_masks`` the same as masks;
    ``limits[k]`` is its likelihood when everything is there. ``log_all`` is the logarithm of the
    product of 1 + weight over all modes, ``log_odd`` that of all weights above 1.
    """

    clues: tuple[Clue, ...]
    groups: tuple[Group, ...]
    causes: tuple[tuple[int, ...], ...]
    cause_masks: tuple[int, ...]
    limits: tuple[float, ...]
    log_limits: tuple[float, ...]
    gates: Gates
    relevant: int
    log_loss: Sequence[float]
    function_hits: Mapping[int, Sequence[tuple[int, float]]]
    log_all: float
    log_odd: float
    group_component: Ints
    log_sums: Floats
    log_bests: Floats
    pair_component: Ints
    pair_loss: Floats
    pair_function: Ints
    component_count: int
    unknown: int

    def log_losses(self, lost: int) -> Floats:
        """Return per group the logarithm of what its newly lost functions cost."""
        loss = self.pair_loss
        if lost:
            gone = np.zeros(len(self.log_loss), np.bool_)
            gone[list(bits(lost))] = True
            loss = np.where(gone[self.pair_function], 0.0, loss)
        per = np.bincount(self.pair_component, weights=loss, minlength=self.component_count + 1)
        losses: Floats = per[self.group_component].astype(np.float64)
        return losses


def problem_of(tables: Tables, evidence: Folded) -> Problem:
    """Find the modes that matter for some clue and group those that are alike."""
    function_hits = _function_hits(evidence.clues)
    matters = evidence.log_loss < 0
    matters[list(function_hits)] = True
    hits = _mode_hits(evidence, tables)
    components = _components(tables, hits, function_hits, np.flatnonzero(matters).tolist())
    groups = tuple(_groups(tables, evidence.log_weight, hits, components))
    causes = tuple(_causes(groups, evidence.clues, tables.gates))
    weights = np.array([weight for group in groups for weight in group.weights], np.float64)
    keep = matters[tables.pair_function]
    limits = tuple(_limits(groups, evidence.clues))
    loss = np.maximum(evidence.log_loss, -1e9)  # 0 * inf is no number
    return Problem(
        evidence.clues,
        groups,
        causes,
        tuple(sum(1 << group for group in of) for of in causes),
        limits,
        tuple(map(log, limits)),
        tables.gates,
        _mask(matters),
        evidence.log_loss.tolist(),
        function_hits,
        float(np.logaddexp(0.0, weights).sum()),
        float(np.maximum(weights, 0.0).sum()),
        np.array([g.component for g in groups], np.int64),
        np.array([g.log_sum(1) for g in groups], np.float64),
        np.array([g.log_best for g in groups], np.float64),
        tables.pair_component[keep],
        loss[tables.pair_function[keep]],
        tables.pair_function[keep],
        tables.component_count,
        next((n for n, g in enumerate(groups) if g.modes[0] == tables.unknown), -1),
    )


def log(value: float) -> float:
    """Return the natural logarithm, minus infinity for zero."""
    return math.log(value) if value > 0 else NEVER


def _function_hits(clues: Sequence[Clue]) -> dict[int, list[tuple[int, float]]]:
    hits: dict[int, list[tuple[int, float]]] = {}
    for place, clue in enumerate(clues):
        for function, detects in clue.functions:
            if detects > 0:
                hits.setdefault(function, []).append((place, 1.0 - detects))
    return hits


def _mask(chosen: NDArray[np.bool_]) -> int:
    return int.from_bytes(np.packbits(chosen, bitorder="little").tobytes(), "little")


def _mode_hits(evidence: Folded, tables: Tables) -> dict[int, list[tuple[int, float]]]:
    hits: dict[int, list[tuple[int, float]]] = {}
    for place, clue in enumerate(evidence.clues):
        for mode, detects in clue.modes:
            if detects > 0 and evidence.log_weight[mode] > NEVER:
                hits.setdefault(mode, []).append((place, 1.0 - detects))
    return hits


def _components(
    tables: Tables, hits: Iterable[int], function_hits: Iterable[int], matter: Sequence[int]
) -> int:
    """Return the components whose state is tied to some clue through functions that matter."""
    supports = [tables.gates.support[place] for place in matter]
    tied = 0
    for mode in hits:
        place = tables.component[mode]
        tied |= 1 << place if place >= 0 else 0
    for function in function_hits:
        tied |= tables.gates.support[function]
    all_supports = 0
    for support in supports:
        all_supports |= support
    apart = supports
    while reached := [support for support in apart if support & tied]:
        apart = [support for support in apart if not support & tied]
        for support in reached:
            tied |= support
    return tied & all_supports


def _groups(
    tables: Tables,
    log_weight: Floats,
    hits: Mapping[int, Sequence[tuple[int, float]]],
    components: int,
) -> Iterator[Group]:
    """Yield the modes that clues see by what they do, and the others by their component."""
    weights = log_weight.tolist()
    found: dict[tuple[int, Hits, bool], list[int]] = {}
    for mode, seen in hits.items():
        place = tables.component[mode]
        component = place if place >= 0 and components >> place & 1 else -1
        found.setdefault((component, _merged(seen), mode == tables.unknown), []).append(mode)
    for (component, hit, _), modes in found.items():
        yield Group(modes, weights, hit, component)
    for component in bits(components):
        of = tables.modes_of[component]
        modes = [mode for mode in of if mode not in hits and weights[mode] > NEVER]
        if modes:
            yield Group(modes, weights, (), component)


def _merged(hits: Sequence[tuple[int, float]]) -> Hits:
    """Make one hit of several on one clue: links that are there twice."""
    if len(hits) == 1:
        return (hits[0],)
    merged: dict[int, float] = {}
    for clue, miss in hits:
        merged[clue] = merged.get(clue, 1.0) * miss
    return tuple(merged.items())


def _causes(
    groups: Sequence[Group], clues: Sequence[Clue], gates: Gates
) -> Iterator[tuple[int, ...]]:
    supports = [0] * len(clues)
    for place, clue in enumerate(clues):
        for function, detects in clue.functions:
            supports[place] |= gates.support[function] if detects > 0 else 0
    through = [(place, support) for place, support in enumerate(supports) if support]
    direct: list[dict[int, None]] = [{} for _ in clues]
    for number, group in enumerate(groups):
        for place, _ in group.hits:
            direct[place][number] = None
        if group.component >= 0:
            for place, support in through:
                if support >> group.component & 1:
                    direct[place][number] = None
    return (tuple(of) for of in direct)


def _limits(groups: Sequence[Group], clues: Sequence[Clue]) -> Iterator[float]:
    least = [1.0] * len(clues)
    for group in groups:
        for place, miss in group.hits:
            least[place] *= miss ** len(group)
    for place, clue in enumerate(clues):
        for _, detects in clue.functions:
            least[place] *= 1.0 - detects
        yield clue.alpha + clue.beta * least[place]
