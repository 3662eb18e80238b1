"""How faults come to show symptoms: directly, or by what is lost while they are there."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.explanation.explanation import Way
from amberbox.diagnosis.explanation.names import Names, in_order
from amberbox.diagnosis.fmea.findings import causes_of
from amberbox.diagnosis.fmea.model import Fmea, Link
from amberbox.diagnosis.fmea.propagation import Structure


@dataclass(frozen=True, slots=True)
class Losses:
    """What a set of faults costs, and by which way."""

    structure: Structure
    down: frozenset[str]
    lost: frozenset[str]

    @classmethod
    def of(cls, fmea: Fmea, structure: Structure, faults: Collection[str]) -> Losses:
        """Take the components down that the faults take down, and all that falls with them."""
        modes = [fmea.modes[fault] for fault in faults if fault in fmea.modes]
        down = frozenset(mode.component for mode in modes if mode.takes_down)
        return cls(structure, down, structure.lost(down))

    def origins(self, name: str) -> tuple[str, ...]:
        """Return the components without whose failure this would still serve.

        If each of several would do alone, all of them that lead there are named.
        """
        leading = [start for start in sorted(self.down) if self.path(start, name)]
        decisive = [
            start for start in leading if name not in self.structure.lost(self.down - {start})
        ]
        return tuple(decisive or leading)

    def path(self, start: str, end: str) -> tuple[str, ...]:
        """Return the shortest way from a component to what is lost, both included, else ()."""
        came_from = {start: ""}
        waiting = deque([start])
        while waiting and end not in came_from:
            name = waiting.popleft()
            for user in self.structure.users.get(name, ()):
                if user in self.lost and user not in came_from:
                    came_from[user] = name
                    waiting.append(user)
        return _back(came_from, end) if end in came_from else ()


def _back(came_from: dict[str, str], end: str) -> tuple[str, ...]:
    way = [end]
    while came_from[way[-1]]:
        way.append(came_from[way[-1]])
    return tuple(reversed(way))


@dataclass(frozen=True, slots=True)
class Ways:
    """Finds how a set of faults shows a symptom."""

    names: Names
    structure: Structure

    @classmethod
    def of(cls, names: Names) -> Ways:
        """Turn the needs of an FMEA round, once."""
        return cls(names, Structure.of(names.fmea.needs()))

    def losses(self, faults: Collection[str]) -> Losses:
        """Return what the faults cost."""
        return Losses.of(self.names.fmea, self.structure, faults)

    def to(self, symptom: str, faults: Collection[str]) -> tuple[Way, ...]:
        """Return every way, direct ones first."""
        return (*self._direct(symptom, faults), *self._by_loss(symptom, faults))

    def _direct(self, symptom: str, faults: Collection[str]) -> Iterator[Way]:
        found = causes_of(self.names.fmea, symptom)
        for fault in in_order(faults):
            if fault == UNKNOWN:
                other = self.names.fmea.other.detects
                yield Way(fault, (), f"{self.names.mode(fault)} can show anywhere", other)
            mode = self.names.fmea.modes.get(fault)
            link = _link(mode.symptoms if mode else (), symptom)
            if link is not None:
                yield Way(fault, (), self.names.mode(fault), link.detects)
            elif fault in found:
                yield Way(fault, (), self.names.mode(fault), found[fault])

    def _by_loss(self, symptom: str, faults: Collection[str]) -> Iterator[Way]:
        losses = self.losses(faults)
        functions = self.names.fmea.functions
        for name in sorted(losses.lost & functions.keys()):
            link = _link(functions[name].symptoms, symptom)
            if link is None:
                continue
            for origin in losses.origins(name):
                yield from self._along(losses.path(origin, name), faults, link.detects)

    def _along(
        self, path: tuple[str, ...], faults: Collection[str], detects: float
    ) -> Iterator[Way]:
        text = " -> ".join(self.names.part(name) for name in path)
        for fault in in_order(faults):
            mode = self.names.fmea.modes.get(fault)
            if mode is not None and mode.takes_down and mode.component == path[0]:
                yield Way(fault, path, text, detects)


def _link(links: Collection[Link], symptom: str) -> Link | None:
    return next((link for link in links if link.symptom == symptom), None)
