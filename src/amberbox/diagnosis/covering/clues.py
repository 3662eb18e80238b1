"""Evidence as factors: what each piece multiplies the probability of a set of faults with.

A piece of evidence has the likelihood ``alpha + beta * q``, where q is the product of 1 - detects
over its active causes. Pieces with alpha 0 (a symptom that is surely absent) are products, so
they fold into the priors of the failure modes and cost the search nothing; the others are clues.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from amberbox.diagnosis.covering.check import Check
from amberbox.diagnosis.covering.evidence import Answered, Evidence, Observation
from amberbox.diagnosis.covering.model import UNKNOWN, Model
from amberbox.diagnosis.covering.tables import Floats, log_miss

Causes = Sequence[tuple[int, float]]


@dataclass(frozen=True, slots=True)
class Clue:
    """The likelihood ``alpha + beta * q`` over causes (place, detects)."""

    alpha: float
    beta: float
    modes: Causes
    functions: Causes = ()


@dataclass(frozen=True, slots=True, eq=False)
class Folded:
    """The evidence for one model.

    ``log_weight`` is per mode the logarithm of its prior odds times the chance that what is
    surely absent does not show; ``log_loss`` that chance per lost function.
    """

    clues: tuple[Clue, ...]
    log_weight: Floats
    log_loss: Floats


def folded(model: Model, evidence: Evidence) -> Folded:
    """Turn evidence into weights and clues; symptoms that the model lacks are left out."""
    tables = model.tables
    places, gone, clues = model.sign_places, [], []
    for name, observation in evidence.observations.items():
        place = places.get(name)
        if place is None or observation.state == "unknown":
            continue
        if observation.state == "absent" and observation.strength == 1.0:
            gone.append(place)
        else:
            clues.append(_clue(model, place, observation))
    absent = np.zeros(len(model.signs), np.bool_)
    absent[gone] = True
    log_weight = tables.log_odds + tables.modes.folded(absent, len(model.mode_ids))
    log_loss = tables.functions.folded(absent, len(model.functions))
    if model.unknown is not None:
        log_weight[-1] += int(absent.sum()) and absent.sum() * log_miss(model.unknown.denies)
    clues += [_conflict(model, names) for names in evidence.conflicts]
    for answered in evidence.answers:
        clues += _answer(model, answered, log_weight, log_loss)
    return Folded(tuple(clues), log_weight, log_loss)


def _clue(model: Model, place: int, observation: Observation) -> Clue:
    trust, silent = observation.strength, 1.0 - model.signs[place].leak
    modes = list(model.tables.modes.by_sign[place])
    functions = model.tables.functions.by_sign[place]
    present = observation.state == "present"
    if model.unknown is not None:
        shows = model.unknown.detects if present else model.unknown.denies
        modes += [(model.mode_places[UNKNOWN], shows)] if shows else []
    if present:
        return Clue((1 + trust) / 2, -trust * silent, modes, functions)
    return Clue((1 - trust) / 2, trust * silent, modes, functions)


def _conflict(model: Model, names: frozenset[str]) -> Clue:
    return Clue(1.0, -1.0, [(model.mode_place(name), 1.0) for name in sorted(names)])


def _answer(
    model: Model, answered: Answered, log_weight: Floats, log_loss: Floats
) -> Iterator[Clue]:
    """Fold what graver outcomes would have shown, and yield the clue of the one that was seen."""
    check, level = answered.check, answered.check.level(answered.outcome)
    modes, functions = seers(model, check)
    for place, (at, detects) in modes:
        if at > level:
            log_weight[place] += log_miss(detects)
    for place, (at, detects) in functions:
        if at > level:
            log_loss[place] += log_miss(detects)
    if level == 0:
        return
    yield Clue(
        1.0,
        -check.at_most(level - 1) / check.at_most(level),
        [(place, detects) for place, (at, detects) in modes if at == level],
        [(place, detects) for place, (at, detects) in functions if at == level],
    )


Seers = list[tuple[int, tuple[int, float]]]


def seers(model: Model, check: Check) -> tuple[Seers, Seers]:
    """Return the modes and the functions that a check sees, each with (level, detects)."""
    modes: Seers = []
    functions: Seers = []
    for sight in check.sights:
        seen = (check.level(sight.outcome), sight.detects)
        if sight.cause in model.function_places:
            functions.append((model.function_places[sight.cause], seen))
        else:
            modes.append((model.mode_place(sight.cause), seen))
    return modes, functions
