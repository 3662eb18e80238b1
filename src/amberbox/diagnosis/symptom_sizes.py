"""How large symptoms are: the largest measure of each since it began, until it has settled."""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any

import msgspec
import numpy as np

from amberbox.core.clock import NS
from amberbox.core.types import IntArray, Symptom
from amberbox.diagnosis.fmea.model import Fmea, SizeScale

QUARTER_NS = NS // 4
"""Measures are taken at multiples of this, as conditions are."""

Measured = Callable[[str, IntArray], "list[float]"]
"""The values of a symptom's measure at instants; NaN where it is not known."""


@dataclass(slots=True)
class SymptomSize:
    """A present symptom with its size so far; ``measured_ns`` is up to when it was measured.

    ``level`` is the one that was reported last.
    """

    symptom: Symptom
    measured_ns: int
    until_ns: int
    level: int | None = None

    def grow(self, values: list[float]) -> None:
        """Take more values of the measure."""
        known = [value for value in values if isfinite(value)]
        if self.symptom.size is not None:
            known.append(self.symptom.size)
        if known:
            self.symptom = replace(self.symptom, size=max(known, key=abs))


class SymptomSizes:
    """Measures the symptoms of an analysis that have a scale."""

    def __init__(self, fmea: Fmea) -> None:
        self.scales: dict[str, SizeScale] = {
            name: symptom.scale for name, symptom in fmea.symptoms.items() if symptom.scale
        }
        self._open: dict[str, SymptomSize] = {}
        self._new: list[Symptom] = []

    def begin(self) -> None:
        """Begin an epoch, in which nothing is known yet."""
        self._open.clear()
        self._new.clear()

    def take(self, symptom: Symptom) -> None:
        """Take a finding, of the time after the last look."""
        if symptom.id in self.scales:
            insort(self._new, symptom, key=_confirmed_ns)

    def _apply(self, symptom: Symptom) -> None:
        """Begin a size anew where a symptom does."""
        scale = self.scales[symptom.id]
        began_ns = symptom.onset_ns
        if symptom.state != "present" or began_ns is None:
            self._open.pop(symptom.id, None)
            return
        known = self._open.get(symptom.id)
        if known is not None and known.symptom.onset_ns == began_ns:
            known.symptom = replace(symptom, size=known.symptom.size)
            return
        settled_ns = began_ns + round(scale.settle_s * NS)
        own = replace(symptom, size=None)
        self._open[symptom.id] = SymptomSize(own, began_ns - 1, settled_ns)

    def look(self, instants: IntArray, measured: Measured) -> Iterator[Symptom]:
        """Yield the symptoms whose level changes at instants, which are in order.

        A symptom is looked at from the first instant after its confirmation on, and then also at
        those before it, since it began.
        """
        for at_ns in instants.tolist():
            while self._new and _confirmed_ns(self._new[0]) <= at_ns:
                self._apply(self._new.pop(0))
            for name, size in self._open.items():
                if size.measured_ns < size.until_ns:
                    yield from self._measure(name, size, at_ns, measured)

    def _measure(
        self, name: str, size: SymptomSize, at_ns: int, measured: Measured
    ) -> Iterator[Symptom]:
        first_ns = -(-(size.measured_ns + 1) // QUARTER_NS) * QUARTER_NS
        last_ns = min(at_ns, max(size.until_ns, first_ns))
        size.grow(measured(name, np.arange(first_ns, last_ns + 1, QUARTER_NS)))
        size.measured_ns = at_ns
        level = self.scales[name].level(size.symptom.size)
        if level != size.level:
            size.level = level
            yield replace(size.symptom, confirmed_ns=at_ns)

    def snapshot(self) -> dict[str, Any]:
        """Return all of it as JSON."""
        return {"open": msgspec.to_builtins(self._open), "new": msgspec.to_builtins(self._new)}

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from what ``snapshot`` returned."""
        self._open = msgspec.convert(snapshot["open"], dict[str, SymptomSize])
        self._new = msgspec.convert(snapshot["new"], list[Symptom])


def _confirmed_ns(symptom: Symptom) -> int:
    return symptom.confirmed_ns or 0
