"""What an analysis of failure modes says, as JSON: its sheet, what matters, what nobody sees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from amberbox.core.redaction import as_plain
from amberbox.diagnosis.fmea.coverage import Coverage
from amberbox.diagnosis.fmea.criticality import (
    by_number,
    criticalities,
    expected,
    matrix,
    mode_criticality,
)
from amberbox.diagnosis.fmea.model import FailureMode, Fmea
from amberbox.diagnosis.fmea.priorities import Rule, priority
from amberbox.diagnosis.fmea.sheet import row_of


def table_json(fmea: Fmea, rules: Sequence[Rule] = ()) -> list[dict[str, str]]:
    """Return the rows of the sheet, the highest S x O x D first."""
    return [row_of(fmea, mode, list(rules)) for mode in by_number(fmea.modes.values())]


def criticality_json(
    fmea: Fmea, exposure_h: float | None = None, rules: Sequence[Rule] = ()
) -> dict[str, Any]:
    """Return C_m of modes, C_r of components and the matrix."""
    modes = sorted(fmea.modes.values(), key=lambda mode: -mode_criticality(mode, exposure_h))
    sums, cells = criticalities(fmea, exposure_h), matrix(fmea, exposure_h)
    return {
        "exposure_h": fmea.exposure_h if exposure_h is None else exposure_h,
        "modes": [_mode(mode, exposure_h, rules) for mode in modes],
        "components": [{"component": name, "C_r": value} for name, value in sums.items()],
        "matrix": [
            {"occurrence": level, "severity": word, "modes": list(ids)}
            for (level, word), ids in cells.cells.items()
        ],
    }


def coverage_json(found: Coverage) -> dict[str, Any]:
    """Return what nobody sees, what nothing explains and what looks the same."""
    return {
        "modes": found.modes,
        "distinct": found.distinct,
        "unseen": found.unseen,
        "unexplained": list(found.unexplained),
        "alike": [as_plain(group) for group in found.alike],
        "weak": found.weak,
    }


def _mode(mode: FailureMode, exposure_h: float | None, rules: Sequence[Rule]) -> dict[str, Any]:
    return {
        "mode": mode.id,
        "severity": mode.severity,
        "expected": expected(mode, exposure_h),
        "beta": mode.beta,
        "C_m": mode_criticality(mode, exposure_h),
        "RPN": mode.ranks.number,
        "priority": priority(mode.ranks, list(rules)),
    }
