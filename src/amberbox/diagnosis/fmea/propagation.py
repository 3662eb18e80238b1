"""What is lost when failure modes are there: through components and functions, over needs."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from amberbox.core.needs import Needs
from amberbox.diagnosis.fmea.model import Fmea, Link


@dataclass(frozen=True, slots=True)
class Structure:
    """Who needs whom: ``users`` are the components and functions that name one directly."""

    needs: Mapping[str, Needs]
    users: Mapping[str, tuple[str, ...]]

    @classmethod
    def of(cls, needs: Mapping[str, Needs]) -> Structure:
        """Turn needs round."""
        users: dict[str, list[str]] = {}
        for user, of in needs.items():
            for name in of.names():
                users.setdefault(name, []).append(user)
        return cls(needs, {name: tuple(found) for name, found in users.items()})

    def dependents(self, names: Iterable[str]) -> frozenset[str]:
        """Return all that needs one of the names, directly or not, whatever else serves."""
        found: set[str] = set()
        waiting = list(names)
        while waiting:
            more = [user for user in self.users.get(waiting.pop(), ()) if user not in found]
            found.update(more)
            waiting += more
        return frozenset(found)

    def lost(self, down: Collection[str]) -> frozenset[str]:
        """Return what no longer serves when these components are down, they included."""
        gone = set(down)
        waiting = list(gone)
        while waiting:
            for user in self.users.get(waiting.pop(), ()):
                if user not in gone and not self.needs[user].met(lambda name: name not in gone):
                    gone.add(user)
                    waiting.append(user)
        return frozenset(gone)


def lost(fmea: Fmea, modes: Iterable[str]) -> frozenset[str]:
    """Return the components and functions that no longer serve while these modes are there."""
    down = {fmea.modes[mode].component for mode in modes if fmea.modes[mode].takes_down}
    return Structure.of(fmea.needs()).lost(down)


def links_by_mode(fmea: Fmea) -> dict[str, tuple[Link, ...]]:
    """Return what shows when a mode alone is there: its own symptoms and of what it loses."""
    structure = Structure.of(fmea.needs())
    of_loss = {
        name: tuple(
            link
            for gone in sorted(structure.lost([name]))
            if gone in fmea.functions
            for link in fmea.functions[gone].symptoms
        )
        for name in fmea.components
    }
    return {
        mode.id: (*mode.symptoms, *(of_loss[mode.component] if mode.takes_down else ()))
        for mode in fmea.modes.values()
    }
