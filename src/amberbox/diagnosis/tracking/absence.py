"""From when on the absence of a symptom counts: when whatever may have begun has had its time."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

from amberbox.core.clock import NS
from amberbox.diagnosis.fmea.model import Fmea, Link
from amberbox.diagnosis.fmea.propagation import Structure


class Waits:
    """The causes of each symptom, and how long each may take to show it.

    Causes are failure modes and lost functions. What needs a component that a mode takes down,
    directly or not, whatever else serves, shows its symptoms for the mode.
    """

    def __init__(self, fmea: Fmea) -> None:
        self._links = {cause: _slowest(links) for cause, links in _causes(fmea)}
        self._causes: dict[str, list[str]] = {}
        for cause, links in self._links.items():
            for symptom in links:
                self._causes.setdefault(symptom, []).append(cause)

    @property
    def shows(self) -> Mapping[str, Collection[str]]:
        """Return the symptoms of each cause."""
        return {cause: links.keys() for cause, links in self._links.items()}

    def until_ns(self, onsets_ns: Mapping[str, int]) -> dict[str, int]:
        """Return until when absent symptoms are to be waited for, given what is present.

        Each cause of something present may have begun with the newest of what it shows: what
        is older may have had another cause. It has ``within_s`` of each link from then on.
        """
        began_ns: dict[str, int] = {}
        for symptom, onset_ns in onsets_ns.items():
            for cause in self._causes.get(symptom, ()):
                began_ns[cause] = max(began_ns.get(cause, onset_ns), onset_ns)
        until_ns: dict[str, int] = {}
        for cause, at_ns in began_ns.items():
            for symptom, within_ns in self._links[cause].items():
                until_ns[symptom] = max(until_ns.get(symptom, 0), at_ns + within_ns)
        return until_ns


def _causes(fmea: Fmea) -> Iterator[tuple[str, list[Link]]]:
    structure = Structure.of(fmea.needs())
    for mode in fmea.modes.values():
        below = _shown_below(fmea, structure, mode.component) if mode.takes_down else []
        yield mode.id, [*mode.symptoms, *below]
    for function in fmea.functions.values():
        if function.symptoms:
            yield function.id, _shown_below(fmea, structure, function.id)


def _shown_below(fmea: Fmea, structure: Structure, name: str) -> list[Link]:
    """Return what shows when something is lost, and what may be lost with it."""
    lost = sorted({name} | structure.dependents([name]))
    return [link for one in lost if one in fmea.functions for link in fmea.functions[one].symptoms]


def _slowest(links: list[Link]) -> dict[str, int]:
    slowest: dict[str, int] = {}
    for link in links:
        within_ns = round(link.within_s * NS)
        slowest[link.symptom] = max(slowest.get(link.symptom, 0), within_ns)
    return slowest
