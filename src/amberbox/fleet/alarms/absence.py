"""Robots that are away: who is missed, and who was lost together; no clock, no database."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from amberbox.fleet.alarms.settings import Excuse, Shared

Statuses = Sequence[Mapping[str, Any]]
"""The last statuses of a robot, as its journal has them."""


@dataclass(slots=True)
class Absence:
    """Who is away since when, in ns since boot, which never step; who is missed already."""

    away: dict[str, int] = field(default_factory=dict)
    settled: set[str] = field(default_factory=set)
    """Of these it is decided: there is an alarm, or they are excused."""

    def gone(self, robot: str, at_ns: int) -> None:
        """Note that a robot is away, from now on or from the moment that is known already."""
        self.away.setdefault(robot, at_ns)

    def back(self, robot: str) -> bool:
        """Note that a robot is there; tell whether something had been decided about it."""
        self.away.pop(robot, None)
        decided = robot in self.settled
        self.settled.discard(robot)
        return decided

    def missed(
        self, now_ns: int, after_ns: Callable[[str], int], together_ns: int
    ) -> list[list[str]]:
        """Return who is to be missed now, those lost together in one list.

        As soon as the first of them has been away for too long, all of them count.
        """
        open_ones = sorted(
            (at_ns, robot) for robot, at_ns in self.away.items() if robot not in self.settled
        )
        found: list[list[str]] = []
        while open_ones:
            first_ns = open_ones[0][0]
            together = [(at, name) for at, name in open_ones if at - first_ns <= together_ns]
            open_ones = open_ones[len(together) :]
            watched = [(at, name) for at, name in together if after_ns(name) > 0]
            if any(now_ns - at_ns >= after_ns(name) for at_ns, name in watched):
                found.append([name for _, name in watched])
        return found


def is_excused(statuses: Statuses, excuses: Iterable[Excuse]) -> bool:
    """Tell whether a robot said last that it may be away: docked, outside coverage."""
    return any(excuse.value in _values(statuses, excuse.output) for excuse in excuses)


def shared_by(robots: Mapping[str, Statuses], shared: Iterable[Shared]) -> str:
    """Return what all robots have in common, in words: ``access point ap-3``; empty for nothing."""
    for one in shared:
        values = [set(map(str, _values(statuses, one.output))) for statuses in robots.values()]
        common = set.intersection(*values) - {"", "None"} if values else set()
        if common:
            return f"{one.word} {min(common)}"
    return ""


def _values(statuses: Statuses, output: str) -> list[bool | float | str]:
    """Return the values of an output; those of a status that nobody could measure do not count."""
    component, mode, name = output.split("/")
    return [
        value
        for status in statuses
        if component in ("*", status.get("component")) and mode in ("*", status.get("mode"))
        for entry in _outputs(status)
        if name in ("*", entry.get("name")) and (value := _value(entry)) is not None
    ]


def _outputs(status: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Give the outputs of a status; a robot may say anything in their place."""
    found = status.get("outputs")
    if isinstance(found, list):
        yield from (entry for entry in found if isinstance(entry, dict))


def _value(entry: Mapping[str, Any]) -> bool | float | str | None:
    kind, value = entry.get("type"), entry.get("value")
    if kind == "string":
        return None if entry.get("text") is None else str(entry["text"])
    if not isinstance(value, bool | int | float):
        return None
    return bool(value) if kind == "bool" else float(value)
