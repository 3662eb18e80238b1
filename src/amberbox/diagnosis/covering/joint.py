"""Modes that are not independent: their times, and those that follow from others.

The weight of a set of faults is the product of what each of them counts alone, times a factor of
this module, which is at most 1. So the product alone bounds the search.

The time of a mode is not known: it is one of the instants that the onsets of its symptoms state (an
onset less either end of its ``after_s``), each equally probable. At each choice of times a symptom
that began at another time than a cause allows is not explained by that cause.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from amberbox.core.clock import NS
from amberbox.diagnosis.covering.model import (
    UNKNOWN,
    Model,
    ModelTables,
    TimedLinks,
    log_odds_with,
)
from amberbox.diagnosis.covering.observations import TimedSymptom

MOST_CHOICES = 20_000
"""Of times. A set of faults with more is taken to have begun whenever its symptoms want it."""

_SLACK_S = 1e-6  # times are differences of nanoseconds, as floating-point seconds


@dataclass(frozen=True, slots=True)
class OtherCauses:
    """The chance that no other cause of a symptom shows it: neither leak, unknown nor losses."""

    leaks: Mapping[int, float]
    functions: Mapping[int, tuple[tuple[int, float], ...]]
    unknown_place: int
    unknown_misses: float

    @classmethod
    def of(cls, model: Model, signs: Iterable[int]) -> OtherCauses:
        """Collect the causes of some symptoms."""
        signs = tuple(signs)
        unknown = model.unknown
        return cls(
            {sign: model.signs[sign].leak for sign in signs},
            {sign: model.tables.functions.by_sign[sign] for sign in signs},
            -1 if unknown is None else model.mode_places[UNKNOWN],
            1.0 if unknown is None else 1.0 - unknown.detects,
        )

    def silent(self, sign: int, modes: frozenset[int], lost: frozenset[int]) -> float:
        """Return the chance for a symptom."""
        chance = 1.0 - self.leaks[sign]
        for function, detects in self.functions[sign]:
            chance *= 1.0 - detects if function in lost else 1.0
        return chance * (self.unknown_misses if self.unknown_place in modes else 1.0)


class JointFactors:
    """The factors of sets of modes, for one model and its evidence."""

    def __init__(self, model: Model, timed: Sequence[TimedSymptom]) -> None:
        self._tables: ModelTables = model.tables
        self._joint = model.tables.joint
        start_ns = min((symptom.onset_ns for symptom in timed), default=0)
        self._onsets_s = {one.sign: (one.onset_ns - start_ns) / NS for one in timed}
        self._strength = {one.sign: one.strength for one in timed}
        self._others = OtherCauses.of(model, self._onsets_s)
        self._instants: dict[int, tuple[float, ...]] = {}
        self._known: dict[tuple[frozenset[int], frozenset[int]], float] = {}

    @property
    def matter(self) -> bool:
        """Return whether any set has a factor other than 1."""
        return bool(self._onsets_s or self._joint.effects)

    def timed_modes(self) -> set[int]:
        """Return the modes that may show a symptom with a time."""
        return {mode for sign in self._onsets_s for mode in self._tables.timed[sign]}

    def signature(self, mode: int) -> object:
        """Return what modes must have in common to be equal to this module."""
        joint = self._joint
        if mode in joint.effects or mode in joint.causes:
            return mode
        return tuple((sign, self._tables.timed[sign].get(mode)) for sign in self._onsets_s)

    def log_factor(
        self, modes: frozenset[int], lost: frozenset[int], relevant: frozenset[int]
    ) -> float:
        """Return the logarithm of the factor of exactly these modes, with what is lost by them.

        ``relevant`` are the modes that are distinguished; whether others followed is summed over.
        """
        key = (modes, lost)
        if key not in self._known:
            total = self._absences(modes, relevant)
            for part in self._parts(modes):
                total += _log(self._chance(part, modes, lost))
            self._known[key] = total
        return self._known[key]

    def _absences(self, modes: frozenset[int], relevant: frozenset[int]) -> float:
        """Return the logarithm of the chance that nothing else followed from these modes."""
        return sum(
            math.log1p(-one.p) if one.p < 1 else -math.inf
            for mode in modes
            for one in self._joint.effects.get(mode, ())
            if one.effect in relevant and one.effect not in modes
        )

    def _parts(self, modes: frozenset[int]) -> Iterator[tuple[int, ...]]:
        """Yield the modes with a factor, in sets whose times do not depend on each other."""
        left = {mode: self._touches(mode) for mode in sorted(modes)}
        left = {mode: touched for mode, touched in left.items() if touched}
        while left:
            first, reached = left.popitem()
            part = [first]
            while near := [mode for mode, touched in left.items() if touched & reached]:
                for mode in near:
                    reached = reached | left.pop(mode)
                part += near
            yield tuple(sorted(part))

    def _touches(self, mode: int) -> frozenset[tuple[str, int]]:
        """Return the symptoms and consequences on which the factor of a mode depends."""
        signs = [("sign", s) for s in self._onsets_s if mode in self._tables.timed[s]]
        joint = self._joint
        ends = (*joint.effects.get(mode, ()), *joint.causes.get(mode, ()))
        return frozenset((*signs, *(("effect", one.effect) for one in ends)))

    def _chance(self, part: Sequence[int], modes: frozenset[int], lost: frozenset[int]) -> float:
        """Return the mean over all choices of times of a part."""
        times = [self.instants(mode) or (math.nan,) for mode in part]
        if math.prod(map(len, times)) > MOST_CHOICES:
            return 1.0
        signs = [s for s in self._onsets_s if any(m in self._tables.timed[s] for m in part)]
        explained = [self._explanation(sign, part, modes, lost) for sign in signs]
        follows = [self._following(mode, part) for mode in part if mode in self._joint.causes]
        total = 0.0
        for choice in product(*times):
            at = dict(zip(part, choice, strict=True))
            chance = 1.0
            for one in explained:
                chance *= one.share(at)
            for follow in follows:
                chance *= follow.share(at)
            total += chance
        return total / math.prod(map(len, times))

    def instants(self, mode: int) -> tuple[float, ...]:
        """Return the instants at which a mode may have begun, seconds; none if nothing says."""
        if mode not in self._instants:
            found = {
                onset_s - end
                for sign, onset_s in self._onsets_s.items()
                for _, after_s in self._tables.timed[sign].get(mode, ())
                if after_s is not None
                for end in after_s
            }
            self._instants[mode] = tuple(sorted(found))
        return self._instants[mode]

    def _explanation(
        self, sign: int, part: Sequence[int], modes: frozenset[int], lost: frozenset[int]
    ) -> _Explanation:
        links = {m: of for m in part if (of := self._tables.timed[sign].get(m))}
        silent = self._others.silent(sign, modes, lost)
        return _Explanation(self._onsets_s[sign], self._strength[sign], silent, links)

    def _following(self, mode: int, part: Sequence[int]) -> _Following:
        causes = [one for one in self._joint.causes[mode] if one.cause in part]
        highest = self._tables.log_odds[mode]
        ends = [(one.cause, one.p, one.after_s) for one in causes]
        return _Following(mode, self._joint.priors[mode], float(highest), ends)


@dataclass(frozen=True, slots=True)
class _Explanation:
    """A timed symptom; ``silent`` is the chance that no cause outside the part shows it."""

    onset_s: float
    strength: float
    silent: float
    links: Mapping[int, TimedLinks]

    def share(self, at: Mapping[int, float]) -> float:
        """Return how probable the symptom is at these times, against at any times."""
        fitting = most = self.silent
        for mode, links in self.links.items():
            for miss, after_s in links:
                most *= miss
                fitting *= miss if _fits(self.onset_s - at[mode], after_s) else 1.0
        shows, at_most = self._observed(fitting), self._observed(most)
        return shows / at_most if at_most > 0 else 0.0

    def _observed(self, misses: float) -> float:
        return self.strength * (1 - misses) + (1 - self.strength) / 2


@dataclass(frozen=True, slots=True)
class _Following:
    """A mode that may follow from others: (cause, p, after_s)."""

    mode: int
    prior: float
    log_highest: float
    causes: Sequence[tuple[int, float, tuple[float, float] | None]]

    def share(self, at: Mapping[int, float]) -> float:
        """Return its weight at these times, against the highest that it can have."""
        chances = [
            p for cause, p, after_s in self.causes if _fits(at[self.mode] - at[cause], after_s)
        ]
        log_odds = log_odds_with(self.prior, chances)
        return math.exp(log_odds - self.log_highest) if log_odds > -math.inf else 0.0


def _fits(delay_s: float, after_s: tuple[float, float] | None) -> bool:
    """Return whether a delay is within its interval; an unknown one (NaN) is."""
    if after_s is None or math.isnan(delay_s):
        return True
    return after_s[0] - _SLACK_S <= delay_s <= after_s[1] + _SLACK_S


def _log(value: float) -> float:
    return math.log(value) if value > 0 else -math.inf
