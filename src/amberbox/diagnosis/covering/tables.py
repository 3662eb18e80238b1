"""A model as arrays and masks: made once, used by every question."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amberbox.diagnosis.covering.gates import Gates, bits

if TYPE_CHECKING:
    from amberbox.diagnosis.covering.model import Model

LARGEST_PRIOR = 1 - 1e-12

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Links by place, as arrays; ``log_miss`` is the logarithm of 1 - detects."""

    cause: Ints
    sign: Ints
    log_miss: Floats
    by_sign: tuple[tuple[tuple[int, float], ...], ...]
    by_cause: tuple[tuple[tuple[int, float], ...], ...]

    @classmethod
    def of(cls, triples: Iterable[tuple[int, int, float]], causes: int, signs: int) -> Links:
        """Collect (cause, sign, detects)."""
        rows = [row for row in triples if row[2] > 0]
        by_sign: list[list[tuple[int, float]]] = [[] for _ in range(signs)]
        by_cause: list[list[tuple[int, float]]] = [[] for _ in range(causes)]
        for cause, sign, detects in rows:
            by_sign[sign].append((cause, detects))
            by_cause[cause].append((sign, detects))
        return cls(
            np.array([row[0] for row in rows], np.int64),
            np.array([row[1] for row in rows], np.int64),
            np.array([log_miss(row[2]) for row in rows], np.float64),
            tuple(map(tuple, by_sign)),
            tuple(map(tuple, by_cause)),
        )

    def folded(self, absent: NDArray[np.bool_], causes: int) -> Floats:
        """Return per cause the logarithm of the chance that no absent symptom shows."""
        chosen = absent[self.sign]
        weights = self.log_miss[chosen]
        sums: Floats = np.bincount(self.cause[chosen], weights, causes).astype(np.float64)
        return sums


@dataclass(frozen=True, slots=True, eq=False)
class Tables:
    """What a search needs of a model, by place; ``unknown`` is the unknown mode's, or -1.

    ``component`` is the place of the component that a mode takes down, -1 for none.
    ``pairs`` are (component, function) where the one alone loses the other.
    """

    log_odds: Floats
    component: tuple[int, ...]
    modes: Links
    functions: Links
    gates: Gates
    component_count: int
    modes_of: tuple[tuple[int, ...], ...]
    pair_component: Ints
    pair_function: Ints
    unknown: int

    @classmethod
    def of(cls, model: Model) -> Tables:
        """Compile a model."""
        names = list(dict.fromkeys(mode.component for mode in model.modes if mode.takes_down))
        places = {name: place for place, name in enumerate(names)}
        component = [places[m.component] if m.takes_down else -1 for m in model.modes]
        gates = Gates([(f.id, f.needs) for f in model.functions], names)
        pairs = [(c, f) for c, mask in enumerate(gates.alone) for f in bits(mask)]
        component += [-1] * (len(model.mode_ids) - len(model.modes))
        return cls(
            _log_odds(model),
            tuple(component),
            _links(model, model.mode_places),
            _links(model, model.function_places),
            gates,
            len(names),
            _modes_of(component, len(names)),
            np.array([pair[0] for pair in pairs], np.int64),
            np.array([pair[1] for pair in pairs], np.int64),
            -1 if model.unknown is None else len(model.modes),
        )


def log_miss(detects: float) -> float:
    """Return the logarithm of 1 - detects."""
    return math.log1p(-detects) if detects < 1 else -math.inf


def _log_odds(model: Model) -> Floats:
    priors = [mode.prior for mode in model.modes]
    if model.unknown is not None:
        priors.append(model.unknown.prior)
    chance = np.minimum(np.array(priors, np.float64), LARGEST_PRIOR)
    with np.errstate(divide="ignore"):
        odds: Floats = np.log(chance) - np.log1p(-chance)
    return odds


def _links(model: Model, causes: dict[str, int]) -> Links:
    triples = [
        (causes[link.cause], model.sign_places[link.symptom], link.detects)
        for link in model.links
        if link.cause in causes
    ]
    return Links.of(triples, len(causes), len(model.signs))


def _modes_of(component: Iterable[int], count: int) -> tuple[tuple[int, ...], ...]:
    modes: list[list[int]] = [[] for _ in range(count)]
    for mode, place in enumerate(component):
        if place >= 0:
            modes[place].append(mode)
    return tuple(map(tuple, modes))
