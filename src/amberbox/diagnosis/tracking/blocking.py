"""Whether what comes while its component is blocked counts, by the analysis."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from amberbox.core.types import Symptom
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.fmea.propagation import Structure
from amberbox.diagnosis.tracking.showing import showing


class Blocking:
    """What the analysis says of components that block others.

    ``shown_by`` are per symptom the components whose failures may show it, ``down`` per symptom
    of a component whether something that takes the component down may show it.
    """

    def __init__(self, fmea: Fmea) -> None:
        self._by_itself = {name for name, symptom in fmea.symptoms.items() if symptom.by_itself}
        self._shown_by = showing(fmea)
        self._down = _down(fmea)

    def lets_count(self, told: Symptom, present: Collection[str]) -> bool:
        """Tell whether a symptom counts that comes while these others are present.

        It does if nothing blocks it, or something that may show it, or only components that
        still serve: all that is seen of them has causes that do not take them down. So does what
        the analysis says to show its component by itself.
        """
        blocking = {label.partition("/")[0] for label in told.blocked_by}
        if (
            not blocking
            or told.id in self._by_itself
            or not blocking.isdisjoint(self._shown_by.get(told.id, frozenset()))
        ):
            return True
        return all(self._serves(component, present) for component in blocking)

    def _serves(self, component: str, present: Collection[str]) -> bool:
        own = self._down.get(component, {})
        seen = [down for symptom, down in own.items() if symptom in present]
        return bool(seen) and not any(seen)


def _down(fmea: Fmea) -> Mapping[str, Mapping[str, bool]]:
    """Return per component its symptoms, and whether what takes it down may show them."""
    structure = Structure.of(fmea.needs())
    found: dict[str, dict[str, bool]] = {}
    for mode in fmea.modes.values():
        lost = {mode.component, *structure.dependents([mode.component])} if mode.takes_down else ()
        for link in mode.symptoms:
            owner = link.symptom.replace(".", "/").partition("/")[0]
            own = found.setdefault(owner, {})
            own[link.symptom] = own.get(link.symptom, False) or owner in lost
    return found
