"""Which components' failures may show a symptom, by the analysis."""

from __future__ import annotations

from collections.abc import Mapping

from amberbox.core.needs import Needs
from amberbox.diagnosis.fmea.model import Fmea


def showing(fmea: Fmea) -> dict[str, frozenset[str]]:
    """Return per symptom the components whose failure modes, or whose loss, may show it."""
    found: dict[str, set[str]] = {}
    for mode in fmea.modes.values():
        for link in mode.symptoms:
            found.setdefault(link.symptom, set()).add(mode.component)
    needs = fmea.needs()
    for function in fmea.functions.values():
        below = _needed(needs, function.id) if function.symptoms else frozenset()
        for link in function.symptoms:
            found.setdefault(link.symptom, set()).update(below)
    return {symptom: frozenset(names) for symptom, names in found.items()}


def _needed(needs: Mapping[str, Needs], name: str) -> frozenset[str]:
    """Return all that something needs, directly or not."""
    found: set[str] = set()
    waiting = [name]
    while waiting:
        of = needs.get(waiting.pop())
        more = [other for other in (of.names() if of else ()) if other not in found]
        found.update(more)
        waiting += more
    return frozenset(found)
