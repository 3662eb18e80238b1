"""Fault trees that were solved, as JSON: their numbers, cut sets and what matters in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import islice
from typing import Any

from amberbox.diagnosis.faulttree import Analysis
from amberbox.diagnosis.fmea.model import Fmea

FACTORS = ("mif", "cif", "dif", "raw", "rrw")
"""Measures of how much an event matters."""


def analysis_json(
    analysis: Analysis, importance: bool = False, cut_sets: int = 0
) -> dict[str, Any]:
    """Return all numbers; importance and the smallest cut sets where they were asked for."""
    by_order = analysis.by_order
    answer: dict[str, Any] = {
        "top": analysis.tree.top,
        "gates": len(analysis.gates),
        "basic_events": len(analysis.events),
        "coherent": analysis.coherent,
        "minimal_cut_sets": analysis.minimal_cut_sets,
        "by_order": None if by_order is None else list(by_order),
        "truncated_at": analysis.truncated_at,
        "top_probability": analysis.top_probability,
        "rare_event_sum": analysis.rare_event_sum(),
        "min_cut_upper_bound": analysis.upper_bound(),
        "without_probability": list(analysis.without_probability),
        "importance": None,
        "incomplete": bool(analysis.incomplete),
        "incomplete_because": analysis.incomplete,
    }
    if importance and analysis.top_probability is not None:
        answer["importance"] = {
            event: {name: _finite(getattr(entry, name)) for name in FACTORS}
            for event, entry in analysis.importance.items()
        }
    if cut_sets:
        answer["cut_sets"] = [sorted(entry) for entry in listed(analysis, cut_sets)]
    return answer


def listed(analysis: Analysis, count: int) -> list[frozenset[str]]:
    """Return the smallest cut sets."""
    return list(islice(analysis.cut_sets or (), count))


def effects_json(
    fmea: Fmea,
    found: Sequence[Analysis],
    exposure_h: float | None = None,
    importance: bool = False,
    cut_sets: int = 0,
) -> dict[str, Any]:
    """Return the trees of several effects."""
    return {
        "exposure_h": fmea.exposure_h if exposure_h is None else exposure_h,
        "effects": [effect_json(fmea, analysis, importance, cut_sets) for analysis in found],
        "incomplete": any(analysis.incomplete for analysis in found),
    }


def effect_json(
    fmea: Fmea, analysis: Analysis, importance: bool = False, cut_sets: int = 0
) -> dict[str, Any]:
    """Return the tree of one effect, and what its loss means."""
    shown = analysis_json(analysis, importance, cut_sets)
    return {"effect": analysis.tree.top, **description(fmea, analysis), **shown}


def description(fmea: Fmea, analysis: Analysis) -> dict[str, str]:
    """Say what the top of a tree is, and how grave its loss."""
    function = fmea.functions.get(analysis.tree.top)
    if function is None:
        return {"description": fmea.components[analysis.tree.top].description}
    return {"description": function.description, "severity": function.severity}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
