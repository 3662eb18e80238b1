"""What a set of faults makes us expect: lost functions, symptoms, outcomes of tests."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

from amberbox.diagnosis.covering.check import Check
from amberbox.diagnosis.covering.clues import Seers, seers
from amberbox.diagnosis.covering.gates import bits
from amberbox.diagnosis.covering.model import UNKNOWN, Model


@dataclass(frozen=True, slots=True)
class Prediction:
    """The modes that are there, the functions that are lost, and what they do to symptoms.

    ``misses`` is per symptom with an active cause the chance that none of them shows it; the
    unknown mode is left to ``unknown``, as it can show anything.
    """

    modes: frozenset[int]
    lost: frozenset[int]
    misses: Mapping[int, float]
    unknown: bool

    def present(self, model: Model, sign: int) -> float:
        """Return how probable it is that a symptom shows."""
        unknown = model.unknown.detects if self.unknown and model.unknown else 0.0
        return self._shows(model, sign, unknown)

    def expected(self, model: Model, sign: int) -> float:
        """Return how far the absence of a symptom speaks against the faults, 0 to 1."""
        unknown = model.unknown.denies if self.unknown and model.unknown else 0.0
        return self._shows(model, sign, unknown)

    def _shows(self, model: Model, sign: int, unknown: float) -> float:
        silent = (1.0 - model.signs[sign].leak) * self.misses.get(sign, 1.0)
        return 1.0 - silent * (1.0 - unknown)


def predict(model: Model, faults: Collection[str]) -> Prediction:
    """Return what is expected while exactly these failure modes are there."""
    tables = model.tables
    modes = [model.mode_place(name) for name in faults if name != UNKNOWN]
    down = 0
    for mode in modes:
        place = tables.component[mode]
        down |= 1 << place if place >= 0 else 0
    lost = frozenset(bits(tables.gates.lost(down)))
    misses: dict[int, float] = {}
    for links, causes in ((tables.modes, modes), (tables.functions, lost)):
        for cause in causes:
            for sign, detects in links.by_cause[cause]:
                misses[sign] = misses.get(sign, 1.0) * (1.0 - detects)
    return Prediction(frozenset(modes), lost, misses, UNKNOWN in faults)


def outcomes(model: Model, check: Check, prediction: Prediction) -> tuple[float, ...]:
    """Return how probable each outcome of a check is while these faults are there."""
    if check.reads:
        present = prediction.present(model, model.sign_places[check.reads])
        return (1.0 - present, present)
    return outcomes_seen(check, *seers(model, check), prediction)


def outcomes_seen(
    check: Check, modes: Seers, functions: Seers, prediction: Prediction
) -> tuple[float, ...]:
    """Return the outcomes' probabilities, given which causes the check sees."""
    misses = [1.0] * len(check.outcomes)
    for level, detects in _active(modes, functions, prediction):
        misses[level] *= 1.0 - detects
    graver = 1.0
    up_to = [0.0] * len(misses)
    for level in range(len(misses) - 1, -1, -1):
        up_to[level] = check.at_most(level) * graver
        graver *= misses[level]
    below = [0.0, *up_to[:-1]]
    return tuple(most - less for most, less in zip(up_to, below, strict=True))


def _active(modes: Seers, functions: Seers, prediction: Prediction) -> Iterator[tuple[int, float]]:
    for place, seen in modes:
        if place in prediction.modes:
            yield seen
    for place, seen in functions:
        if place in prediction.lost:
            yield seen
