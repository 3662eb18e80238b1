"""What is lost when failure modes are there: through components and functions, over needs."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from amberbox.diagnosis.fmea.model import Fmea, Link


def lost(fmea: Fmea, modes: Iterable[str]) -> frozenset[str]:
    """Return the components and functions that no longer serve while these modes are there."""
    down = {fmea.modes[mode].component for mode in modes if fmea.modes[mode].takes_down}
    needs = fmea.needs()
    up: dict[str, bool] = {}

    def is_up(name: str) -> bool:
        if name not in up:
            up[name] = name not in down and (name not in needs or needs[name].met(is_up))
        return up[name]

    return frozenset(name for name in needs if not is_up(name))


def links_of(fmea: Fmea, mode: str) -> tuple[Link, ...]:
    """Return what shows when this mode alone is there: its own symptoms and of what it loses."""
    own = fmea.modes[mode].symptoms
    gone = lost(fmea, [mode])
    of_functions = [
        link for name in fmea.functions if name in gone for link in fmea.functions[name].symptoms
    ]
    return (*own, *of_functions)


def dependents(fmea: Fmea, names: Collection[str]) -> frozenset[str]:
    """Return all that needs one of the names, directly or not, whatever else serves instead."""
    needs = fmea.needs()
    found: set[str] = set()
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        more = [user for user, of in needs.items() if name in of.names() and user not in found]
        found.update(more)
        waiting += more
    return frozenset(found)
