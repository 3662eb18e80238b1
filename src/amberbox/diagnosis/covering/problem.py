"""The question that a search answers: relevant modes in groups, and the factors they act on."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from amberbox.diagnosis.covering.joint import JointFactors
from amberbox.diagnosis.covering.model import (
    Floats,
    FunctionGates,
    Ints,
    Model,
    ModelTables,
    bits,
)
from amberbox.diagnosis.covering.observations import FoldedEvidence, LikelihoodFactor

NEVER = -math.inf

Hits = tuple[tuple[int, float], ...]  # factors with 1 - detects


class ModeGroup:
    """Failure modes with the same effect on every relevant factor and function.

    ``hits`` are (factor, 1 - detects), ``component`` what they take down (-1: nothing relevant),
    ``modes`` from the most to the least probable. At most ``most`` of them are present together.
    """

    __slots__ = ("_sums", "component", "hits", "log_best", "modes", "most", "weights")

    def __init__(
        self,
        modes: list[int],
        log_weights: Sequence[float],
        hits: Hits,
        component: int,
        most: int | None = None,
    ) -> None:
        self.most = len(modes) if most is None else most
        if len(modes) > 1:
            modes.sort()
            modes.sort(key=log_weights.__getitem__, reverse=True)
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
        """Return the logarithm of the summed weight of all sets of ``count`` members."""
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
        self._sums.append(log_or_never(sums[count]) + count * self.log_best)


@dataclass(frozen=True, slots=True, eq=False)
class CoveringProblem:
    """The relevant groups, and for each factor and function the groups that act on it.

    ``unknown`` is the group of the unknown mode, its only member; -1 if there is none.

    ``causes[k]`` are the groups that can act on factor k, as a mask.
    ``limits[k]`` is its likelihood when all modes are present. ``log_all`` is the logarithm of the
    product of 1 + weight over all modes, ``log_odd`` that of all weights above 1. ``excludes`` are
    per group, as a mask, those that are not present together with it, if any.
    """

    factors: tuple[LikelihoodFactor, ...]
    groups: tuple[ModeGroup, ...]
    causes: tuple[int, ...]
    is_graded: bool
    excludes: Mapping[int, int]
    joint: JointFactors | None
    relevant_modes: frozenset[int]
    limits: tuple[float, ...]
    log_limits: tuple[float, ...]
    gates: FunctionGates
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


def covering_problem(model: Model, evidence: FoldedEvidence) -> CoveringProblem:
    """Find the modes that are relevant for any factor, and group those with the same effect."""
    tables = model.tables
    function_hits = _function_hits(evidence.factors)
    matters = evidence.log_loss < 0
    matters[list(function_hits)] = True
    hits = _mode_hits(evidence, tables)
    supports = [tables.gates.support[place] for place in np.flatnonzero(matters).tolist()]
    joint = JointFactors(model, evidence.timed)
    weights = evidence.log_weight.tolist()
    effects = _effects(tables, weights, hits, _components(tables, hits, function_hits, supports))
    if joint.matter or tables.joint.excludes:
        while missing := _to_distinguish(tables, joint, weights, effects, supports):
            hits |= {mode: [] for mode in missing}
            components = _components(tables, hits, function_hits, supports)
            effects = _effects(tables, weights, hits, components)
        _sum_over_others(tables, weights, effects)
    groups = tuple(_groups(tables, weights, effects, joint))
    excludes = _excluded_groups(tables, groups) if tables.joint.excludes else {}
    own = np.array([weight for group in groups for weight in group.weights], np.float64)
    keep = matters[tables.pair_function]
    limits = tuple(_limits(groups, evidence.factors))
    loss = np.maximum(evidence.log_loss, -1e9)  # 0 * inf is no number
    return CoveringProblem(
        evidence.factors,
        groups,
        tuple(_causes(groups, evidence.factors, tables.gates)),
        evidence.is_graded,
        excludes,
        joint if joint.matter else None,
        frozenset(m for m, weight in enumerate(weights) if weight == NEVER or m in effects)
        if joint.matter
        else frozenset(),
        limits,
        tuple(map(log_or_never, limits)),
        tables.gates,
        as_mask(matters),
        evidence.log_loss.tolist(),
        function_hits,
        float(np.logaddexp(0.0, own).sum()),
        float(np.maximum(own, 0.0).sum()),
        np.array([g.component for g in groups], np.int64),
        np.array([g.log_sum(1) for g in groups], np.float64),
        np.array([g.log_best for g in groups], np.float64),
        tables.pair_component[keep],
        loss[tables.pair_function[keep]],
        tables.pair_function[keep],
        tables.component_count,
        next((n for n, g in enumerate(groups) if g.modes[0] == tables.unknown), -1),
    )


def log_or_never(value: float) -> float:
    """Return the natural logarithm, minus infinity for zero."""
    return math.log(value) if value > 0 else NEVER


def _function_hits(factors: Sequence[LikelihoodFactor]) -> dict[int, list[tuple[int, float]]]:
    hits: dict[int, list[tuple[int, float]]] = {}
    for place, factor in enumerate(factors):
        for function, detects in factor.functions:
            if detects > 0:
                hits.setdefault(function, []).append((place, 1.0 - detects))
    return hits


def _mode_hits(evidence: FoldedEvidence, tables: ModelTables) -> dict[int, list[tuple[int, float]]]:
    hits: dict[int, list[tuple[int, float]]] = {}
    for place, factor in enumerate(evidence.factors):
        for mode, detects in factor.modes:
            if detects > 0 and evidence.log_weight[mode] > NEVER:
                hits.setdefault(mode, []).append((place, 1.0 - detects))
    return hits


def _components(
    tables: ModelTables, hits: Iterable[int], function_hits: Iterable[int], supports: Sequence[int]
) -> int:
    """Return the components whose state is tied to some factor through functions that matter."""
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


ModeEffects = dict[int, tuple[int, Hits]]
"""Per relevant mode the component that it takes down (-1: none that matters), and its hits."""


def _effects(
    tables: ModelTables,
    weights: Sequence[float],
    hits: Mapping[int, Sequence[tuple[int, float]]],
    components: int,
) -> ModeEffects:
    """Return the modes that act on factors, then the others of components that matter."""
    found: ModeEffects = {}
    for mode, seen in hits.items():
        place = tables.component[mode]
        component = place if place >= 0 and components >> place & 1 else -1
        found[mode] = component, _merged(seen)
    for component in bits(components):
        for mode in tables.modes_of[component]:
            if mode not in hits and weights[mode] > NEVER:
                found[mode] = component, ()
    return found


def _sum_over_others(tables: ModelTables, weights: list[float], effects: ModeEffects) -> None:
    """Reduce the weights of modes by those that they exclude and that have no effect.

    These all exclude each other: so they are summed over instead of being distinguished.
    """
    for cluster in tables.joint.clusters_of(effects):
        others = sum([math.exp(weights[mode]) for mode in cluster.modes if mode not in effects])
        if others:
            for mode in effects.keys() & cluster.modes:
                weights[mode] -= math.log1p(others)


def _to_distinguish(
    tables: ModelTables,
    joint: JointFactors,
    weights: Sequence[float],
    found: Collection[int],
    supports: Sequence[int],
) -> list[int]:
    """Return modes that are not relevant by themselves, but on which relevant ones depend.

    These are causes of symptoms with a time, and modes that lead to relevant ones, that follow from
    them but lack a symptom, or that exclude them, if they are special or lose functions.
    """
    tied = tables.joint
    results = {
        mode
        for mode in tied.results(found)
        if weights[mode] != tables.log_odds[mode] or mode in tied.excludes
    }
    wanted = results | tied.origins({*found, *results}) | joint.timed_modes()
    costly = 0
    for support in supports:
        costly |= support
    for cluster in tied.clusters_of(found):
        wanted |= cluster.distinct
        for mode in cluster.modes:
            place = tables.component[mode]
            if place >= 0 and costly >> place & 1:
                wanted.add(mode)
    return sorted(mode for mode in wanted if mode not in found and weights[mode] > NEVER)


def _groups(
    tables: ModelTables, weights: Sequence[float], effects: ModeEffects, joint: JointFactors
) -> Iterator[ModeGroup]:
    """Yield the relevant modes, grouped by their effect."""
    found: dict[tuple[int, Hits, object], list[int]] = {}
    exclusive, unknown, is_joint = tables.joint.exclusive, tables.unknown, joint.matter
    for mode, (component, hits) in effects.items():
        kind: object = mode == unknown
        if is_joint:
            kind = (kind, joint.signature(mode), exclusive.get(mode))
        elif exclusive:
            kind = (kind, exclusive.get(mode))
        found.setdefault((component, hits, kind), []).append(mode)
    for (component, hits, _), modes in found.items():
        yield ModeGroup(modes, weights, hits, component, 1 if modes[0] in exclusive else None)


def _excluded_groups(tables: ModelTables, groups: Sequence[ModeGroup]) -> dict[int, int]:
    """Return per group the groups that exclude it, as a mask."""
    of = {mode: number for number, group in enumerate(groups) for mode in group.modes}
    found: dict[int, int] = {}
    for number, group in enumerate(groups):
        others = (of.get(mode) for mode in tables.joint.excludes.get(group.modes[0], ()))
        mask = 0
        for other in others:
            mask |= 0 if other is None or other == number else 1 << other
        if mask:
            found[number] = mask
    return found


def _merged(hits: Sequence[tuple[int, float]]) -> Hits:
    """Combine several hits on one factor, from repeated links, into one."""
    if len(hits) == 1:
        return (hits[0],)
    merged: dict[int, float] = {}
    for factor, miss in hits:
        merged[factor] = merged.get(factor, 1.0) * miss
    return tuple(merged.items())


def _causes(
    groups: Sequence[ModeGroup], factors: Sequence[LikelihoodFactor], gates: FunctionGates
) -> list[int]:
    causes = [0] * len(factors)
    of_component: dict[int, int] = {}
    for number, group in enumerate(groups):
        for place, _ in group.hits:
            causes[place] |= 1 << number
        if group.component >= 0:
            of_component[group.component] = of_component.get(group.component, 0) | 1 << number
    for place, factor in enumerate(factors):
        support = 0
        for function, detects in factor.functions:
            support |= gates.support[function] if detects > 0 else 0
        if support:
            for component, mask in of_component.items():
                if support >> component & 1:
                    causes[place] |= mask
    return causes


def _limits(groups: Sequence[ModeGroup], factors: Sequence[LikelihoodFactor]) -> Iterator[float]:
    least = [1.0] * len(factors)
    for group in groups:
        for place, miss in group.hits:
            least[place] *= miss**group.most
    for place, factor in enumerate(factors):
        for _, detects in factor.functions:
            least[place] *= 1.0 - detects
        yield factor.alpha + factor.beta * least[place] + factor.gain


class FaultCounts(NamedTuple):
    """A state of the search: the number of faulty members of each group, and no other faults.

    ``misses[k]`` is q of factor k. ``log_best`` is the weight of the most probable choice of
    members, ``log_sum`` that of all choices; both include the cost of the lost functions.
    """

    counts: tuple[tuple[int, int], ...]
    misses: tuple[float, ...]
    down: int
    lost: int
    log_best: float
    log_sum: float

    def members(self, group: int) -> int:
        """Return how many members of a group are faulty."""
        return next((count for number, count in self.counts if number == group), 0)


def no_faults(problem: CoveringProblem) -> FaultCounts:
    """Return the state without any fault."""
    return FaultCounts((), (1.0,) * len(problem.factors), 0, 0, 0.0, 0.0)


def with_one_more(problem: CoveringProblem, state: FaultCounts, number: int) -> FaultCounts:
    """Return the state with one more member of a group faulty."""
    group, count = problem.groups[number], state.members(number)
    others = tuple(pair for pair in state.counts if pair[0] != number)
    misses = list(state.misses)
    for factor, miss in group.hits:
        misses[factor] *= miss
    down, lost, cost = state.down, state.lost, 0.0
    if group.component >= 0 and not down >> group.component & 1:
        down |= 1 << group.component
        lost = problem.gates.lost(down) & problem.relevant
        for function in bits(lost & ~state.lost):
            cost += problem.log_loss[function]
            for factor, miss in problem.function_hits.get(function, ()):
                misses[factor] *= miss
    more = group.log_sum(count + 1) - (group.log_sum(count) if count else 0.0)
    return FaultCounts(
        (*others, (number, count + 1)),
        tuple(misses),
        down,
        lost,
        state.log_best + cost + group.weights[count],
        state.log_sum + cost + more,
    )


def log_likelihood(problem: CoveringProblem, state: FaultCounts) -> float:
    """Return the logarithm of the product of all factors' likelihoods."""
    total = 0.0
    for place, (factor, miss) in enumerate(zip(problem.factors, state.misses, strict=True)):
        value = factor.alpha + factor.beta * miss
        if factor.gain:
            value += factor.gain * state.misses[place + 1]
        total += log_or_never(value)
    return total


def log_joint(problem: CoveringProblem, state: FaultCounts) -> float:
    """Return the logarithm of the factor of faults that are not independent: at most 0.

    It is the same for all choices of members.
    """
    if problem.joint is None:
        return 0.0
    modes = [m for number, count in state.counts for m in problem.groups[number].modes[:count]]
    return problem.joint.log_factor(
        frozenset(modes), frozenset(bits(state.lost)), problem.relevant_modes
    )


def as_mask(chosen: NDArray[np.bool_]) -> int:
    """Return the mask whose bits are the chosen places."""
    return int.from_bytes(np.packbits(chosen, bitorder="little").tobytes(), "little")
