"""The covering engine's formula, written out over every set of failure modes."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np
from numpy.typing import NDArray

from amberbox.diagnosis.covering.evidence import Evidence
from amberbox.diagnosis.covering.model import UNKNOWN, Model
from amberbox.diagnosis.covering.prediction import outcomes, predict

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
    """Return per function in which sets it is lost, as the definition says, set by set."""
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
