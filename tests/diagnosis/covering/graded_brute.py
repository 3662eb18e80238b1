"""The formula with sizes, times, exclusions and consequences, written out over all sets."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import chain, combinations, product

from amberbox.core.clock import NS
from amberbox.diagnosis.covering.model import UNKNOWN, Link, Model
from amberbox.diagnosis.covering.observations import Evidence, Observation, predict

Times = Mapping[str, float | None]


def posterior(model: Model, evidence: Evidence) -> dict[frozenset[str], float]:
    """Return P(S | e) of every set of failure modes; empty if nothing is possible."""
    ids = [mode.id for mode in model.modes] + ([UNKNOWN] if model.unknown else [])
    sets = [frozenset(s) for s in chain(*(combinations(ids, n) for n in range(len(ids) + 1)))]
    weights = {one: _weight(model, evidence, one) for one in sets}
    total = math.fsum(weights.values())
    return {one: weight / total for one, weight in weights.items()} if total > 0 else {}


def _weight(model: Model, evidence: Evidence, faults: frozenset[str]) -> float:
    if any(mode.excludes & (faults - {mode.id}) for mode in model.modes if mode.id in faults):
        return 0.0
    lost = {model.functions[place].id for place in predict(model, faults).lost}
    causes = faults | lost
    weight = 1.0
    for name, observation in evidence.observations.items():
        weight *= _likelihood(model, name, observation, causes)
    named = sorted(faults - {UNKNOWN})
    times: list[Sequence[float | None]] = [
        _instants(model, evidence, mode) or [None] for mode in named
    ]
    choices = [
        _prior(model, faults, at) * _timing(model, evidence, causes, at)
        for at in (dict(zip(named, choice, strict=True)) for choice in product(*times))
    ]
    return weight * math.fsum(choices) / len(choices)


def _prior(model: Model, faults: frozenset[str], at: Times) -> float:
    chance = 1.0
    for mode in model.modes:
        absent = 1.0 - mode.prior
        for one in model.leads_to:
            if one.effect != mode.id or one.cause not in faults:
                continue
            if mode.id not in faults or _fits(at.get(mode.id), at.get(one.cause), one.after_s):
                absent *= 1.0 - one.p
        chance *= 1.0 - absent if mode.id in faults else absent
    if model.unknown is not None:
        chance *= model.unknown.prior if UNKNOWN in faults else 1.0 - model.unknown.prior
    return chance


def _fits(ended: float | None, began: float | None, after_s: tuple[float, float] | None) -> bool:
    if began is None or ended is None or after_s is None:
        return True
    return after_s[0] <= ended - began <= after_s[1]


def _links(model: Model, name: str, causes: frozenset[str] | set[str]) -> list[Link]:
    return [link for link in model.links if link.symptom == name and link.cause in causes]


def _likelihood(
    model: Model, name: str, seen: Observation, causes: frozenset[str] | set[str]
) -> float:
    sign = next(sign for sign in model.signs if sign.id == name)
    links = _links(model, name, causes)
    is_graded = any(link.sizes and link.symptom == name for link in model.links)
    unknown = model.unknown if UNKNOWN in causes else None
    if seen.state == "unknown":
        return 1.0
    if seen.state == "absent" or seen.level is None or not is_graded:
        silent = (1.0 - sign.leak) * math.prod(1.0 - link.detects for link in links)
        if unknown is not None:
            silent *= 1 - (unknown.detects if seen.state == "present" else unknown.denies)
        right = silent if seen.state == "absent" else 1.0 - silent
        random = 1 / (sign.bins + 1) if is_graded and seen.state == "absent" else 0.5
        return seen.strength * right + (1 - seen.strength) * random

    def up_to(level: int) -> float:
        chance = 1.0 - sign.leak * (1.0 - level / sign.bins)
        for link in links:
            sizes = link.sizes or (1 / sign.bins,) * sign.bins
            chance *= 1.0 - link.detects * (1.0 - math.fsum(sizes[:level]))
        if unknown is not None:
            chance *= 1.0 - unknown.detects * (1.0 - level / sign.bins)
        return chance

    right = up_to(seen.level) - up_to(seen.level - 1)
    return seen.strength * right + (1 - seen.strength) / (sign.bins + 1)


def _timed(model: Model, evidence: Evidence) -> list[str]:
    return [
        name
        for name, seen in evidence.observations.items()
        if seen.state == "present"
        and name in evidence.onsets_ns
        and any(link.after_s for link in model.links if link.symptom == name)
    ]


def _instants(model: Model, evidence: Evidence, mode: str) -> list[float]:
    found = {
        evidence.onsets_ns[name] / NS - end
        for name in _timed(model, evidence)
        for link in _links(model, name, {mode})
        if link.after_s is not None and link.detects > 0
        for end in link.after_s
    }
    return sorted(found)


def _timing(
    model: Model, evidence: Evidence, causes: frozenset[str] | set[str], at: Times
) -> float:
    chance = 1.0
    for name in _timed(model, evidence):
        sign = next(sign for sign in model.signs if sign.id == name)
        strength = evidence.observations[name].strength
        fitting = most = 1.0 - sign.leak
        if model.unknown is not None and UNKNOWN in causes:
            fitting, most = (f * (1 - model.unknown.detects) for f in (fitting, most))
        for link in _links(model, name, causes):
            most *= 1.0 - link.detects
            onset = evidence.onsets_ns[name] / NS
            if _fits(onset, at.get(link.cause), link.after_s):
                fitting *= 1.0 - link.detects
        shows, at_most = (
            strength * (1 - misses) + (1 - strength) / 2 for misses in (fitting, most)
        )
        chance *= shows / at_most if at_most > 0 else 0.0
    return chance
