"""The covering engine's formula, written out over every set of failure modes."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.diagnosis.covering.model import UNKNOWN, Model
from amberbox.diagnosis.covering.observations import Evidence, outcomes, predict

Floats = NDArray[np.float64]


def posterior(model: Model, evidence: Evidence) -> dict[frozenset[str], float]:
    """Return P(S | e) of every set S of failure modes; empty if nothing is possible."""
    ids = [mode.id for mode in model.modes] + ([UNKNOWN] if model.unknown else [])
    active = _subsets(len(ids))
    weight = _priors(model, active)
    lost = _lost(model, active)
    columns = {name: active[:, place] for place, name in enumerate(ids)} | lost
    for name, observation in evidence.observations.items():
        sign = next((s for s in model.signs if s.id == name), None)
        if sign is None or observation.state == "unknown":
            continue
        silent = np.full(len(active), 1.0 - sign.leak)
        for link in model.links:
            if link.symptom == name:
                silent[columns[link.cause]] *= 1.0 - link.detects
        if model.unknown is not None:
            present = observation.state == "present"
            shows = model.unknown.detects if present else model.unknown.denies
            silent[columns[UNKNOWN]] *= 1.0 - shows
        right = silent if observation.state == "absent" else 1.0 - silent
        weight *= observation.strength * right + (1 - observation.strength) / 2
    for conflict in evidence.conflicts:
        weight *= np.any([columns[name] for name in conflict], axis=0)
    sets = [frozenset(n for n, there in zip(ids, row, strict=True) if there) for row in active]
    for answered in evidence.answers:
        level = answered.check.level(answered.outcome)
        seen = [outcomes(model, answered.check, predict(model, s))[level] for s in sets]
        weight *= np.array(seen)
    total = weight.sum()
    return dict(zip(sets, (weight / total).tolist(), strict=True)) if total > 0 else {}


def with_common_cause(
    model: Model, evidence: Evidence, exact: dict[frozenset[str], float]
) -> dict[frozenset[str], float]:
    """Let the unknown mode look like every set of three or more modes that began together."""
    other = model.unknown
    if other is None or any(UNKNOWN not in conflict for conflict in evidence.conflicts):
        return exact
    priors = {mode.id: mode.prior for mode in model.modes}
    grown = dict(exact)
    for faults, share in exact.items():
        known = sorted(faults - {UNKNOWN})
        if share == 0 or len(known) < 3 or _spread_s(model, evidence, known) > other.together_s:
            continue
        for fault in known:
            share *= other.looks_like / priors[fault]
        share *= 1.0 if UNKNOWN in faults else other.prior
        grown[frozenset({UNKNOWN})] = grown.get(frozenset({UNKNOWN}), 0.0) + share
    total = sum(grown.values())
    return {faults: share / total for faults, share in grown.items()}


def _spread_s(model: Model, evidence: Evidence, faults: Sequence[str]) -> float:
    """Return how long after the first fault the last one began to show."""
    first: dict[str, int] = {}
    for name, onset_ns in evidence.onsets_ns.items():
        place = model.sign_places[name]
        shows = {fault: 1 - predict(model, [fault]).misses.get(place, 1.0) for fault in faults}
        surest = max(faults, key=lambda fault: shows[fault])
        if shows[surest] > 0:
            first[surest] = min(onset_ns, first.get(surest, onset_ns))
    return (max(first.values()) - min(first.values())) / NS if first else 0.0


def restricted(
    exact: dict[frozenset[str], float], names: Collection[str]
) -> dict[frozenset[str], float]:
    """Sum out all failure modes but these."""
    summed: dict[frozenset[str], float] = {}
    for faults, share in exact.items():
        key = faults & frozenset(names)
        summed[key] = summed.get(key, 0.0) + share
    return summed


def named(sets: Iterable[frozenset[str]]) -> frozenset[str]:
    """Return every failure mode that some set has."""
    return frozenset().union(*sets)


def _subsets(count: int) -> NDArray[np.bool_]:
    numbers = np.arange(2**count)
    return (numbers[:, None] >> np.arange(count) & 1).astype(np.bool_)


def _priors(model: Model, active: NDArray[np.bool_]) -> Floats:
    priors = [mode.prior for mode in model.modes]
    chance = np.array(priors + ([model.unknown.prior] if model.unknown else []))
    product: Floats = np.where(active, chance, 1.0 - chance).prod(axis=1)
    return product


def _lost(model: Model, active: NDArray[np.bool_]) -> dict[str, NDArray[np.bool_]]:
    """Return per function in which sets it is lost, computed from the definition."""
    needs = {function.id: function.needs for function in model.functions}
    takers = [(n, mode.component) for n, mode in enumerate(model.modes) if mode.takes_down]
    memory: dict[frozenset[str], list[bool]] = {}
    rows = []
    for row in active:
        down = frozenset(component for place, component in takers if row[place])

        def is_up(name: str, down: frozenset[str] = down) -> bool:
            return name not in down and (name not in needs or needs[name].met(is_up))

        if down not in memory:
            memory[down] = [not is_up(name) for name in needs]
        rows.append(memory[down])
    table = np.array(rows, np.bool_).reshape(len(active), len(needs))
    return {name: table[:, place] for place, name in enumerate(needs)}
