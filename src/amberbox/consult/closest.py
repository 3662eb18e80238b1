"""Which cut sets are closest to complete, by the diagnosis that stands."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from amberbox.consult.faulttrees import description
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.faulttree import Analysis
from amberbox.diagnosis.faulttree.nearest import Near, nearest
from amberbox.diagnosis.fmea.model import Fmea


@dataclass(frozen=True, slots=True)
class Outlook:
    """An effect on the system and the cut sets that are closest to bringing it about."""

    analysis: Analysis
    near: list[Near]

    @property
    def rank(self) -> tuple[bool, float]:
        """Sort effects: first those that something that has happened leads to."""
        has_begun = any(near.happened for near in self.near)
        return not has_begun, -self.near[0].probability if self.near else 0.0


def outlooks(solved: Iterable[Analysis], diagnosis: Diagnosis | None, count: int) -> list[Outlook]:
    """Return the closest cut sets of each effect, the effect that is closest first."""
    found = [Outlook(analysis, nearest(analysis, diagnosis, count)) for analysis in solved]
    return sorted(found, key=lambda outlook: outlook.rank)


def closest_json(
    fmea: Fmea, at_ns: int | None, diagnosis: Diagnosis | None, found: Iterable[Outlook]
) -> dict[str, Any]:
    """Return outlooks as JSON has them."""
    return {
        "at_ns": at_ns,
        "diagnosis": diagnosis.id if diagnosis else None,
        "effects": [
            {
                "effect": outlook.analysis.tree.top,
                **description(fmea, outlook.analysis),
                "truncated_at": outlook.analysis.truncated_at,
                "closest": [_near(near) for near in outlook.near],
            }
            for outlook in found
        ],
    }


def _near(near: Near) -> dict[str, Any]:
    return {
        "probability": near.probability,
        "happened": list(near.happened),
        "missing": list(near.missing),
        "events": dict(near.events),
    }
