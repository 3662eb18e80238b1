"""How much a failure mode matters: C_m and C_r, S x O x D, priorities, the matrix.

C_m = beta x alpha x lambda_p x t, C_r = the sum of a component's C_m (MIL-STD-1629A, task 102).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from amberbox.diagnosis.fmea.model import SEVERITIES, FailureMode, Fmea

LEVELS: tuple[tuple[str, float], ...] = (
    ("A frequent", 0.2),
    ("B probable", 0.1),
    ("C occasional", 0.01),
    ("D remote", 0.001),
    ("E unlikely", 0.0),
)
"""Levels of occurrence and the share of all failures that they begin at (MIL-STD-1629A)."""


def expected(mode: FailureMode, exposure_h: float | None = None) -> float:
    """Return how often a mode comes about within the exposure: alpha x lambda_p x t."""
    if mode.rate is not None:
        return mode.rate * (mode.exposure_h if exposure_h is None else exposure_h)
    chance = mode.probability or 0.0
    return -math.log1p(-chance) if chance < 1 else math.inf


def mode_criticality(mode: FailureMode, exposure_h: float | None = None) -> float:
    """Return C_m of a failure mode."""
    return mode.beta * expected(mode, exposure_h) if mode.beta else 0.0


def criticalities(fmea: Fmea, exposure_h: float | None = None) -> dict[str, float]:
    """Return C_r of each component, from high to low."""
    sums = {
        name: math.fsum(mode_criticality(fmea.modes[mode], exposure_h) for mode in component.modes)
        for name, component in fmea.components.items()
    }
    return dict(sorted(sums.items(), key=lambda entry: -entry[1]))


@dataclass(frozen=True, slots=True)
class Matrix:
    """Which failure modes are of what severity (column) and level of occurrence (row)."""

    cells: Mapping[tuple[str, str], tuple[str, ...]]

    @property
    def rows(self) -> tuple[str, ...]:
        """Return the levels of occurrence from high to low."""
        return tuple(level for level, _ in LEVELS)

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the severities from low to high."""
        return SEVERITIES


def matrix(fmea: Fmea, exposure_h: float | None = None) -> Matrix:
    """Return the criticality matrix: a mode's level is its share of all expected failures."""
    counts = {mode.id: expected(mode, exposure_h) for mode in fmea.modes.values()}
    total = math.fsum(counts.values())
    cells: dict[tuple[str, str], list[str]] = {}
    for mode in fmea.modes.values():
        share = counts[mode.id] / total if total else 0.0
        level = next(level for level, bound in LEVELS if share >= bound)
        cells.setdefault((level, mode.severity), []).append(mode.id)
    return Matrix({place: tuple(modes) for place, modes in cells.items()})


def by_number(modes: Iterable[FailureMode]) -> list[FailureMode]:
    """Return the modes by S x O x D from high to low; those without a number come last."""
    return sorted(modes, key=lambda mode: -(mode.ranks.number or 0))
