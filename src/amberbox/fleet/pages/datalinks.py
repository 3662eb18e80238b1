"""Where the data of a stretch of time, of a moment or of a mission are shown."""

from __future__ import annotations

from collections.abc import Iterable
from urllib.parse import quote, urlencode

from amberbox.core.timetext import NS, format_time

AROUND_NS = 60 * NS
"""So much before and behind a moment is shown."""


def data_href(robot: str, start: str, to: str, variables: Iterable[str] = ()) -> str:
    """Return the address of a window of data; ``start`` and ``to`` as RFC 3339."""
    return _href(robot, [*_chosen(variables), ("from", start), ("to", to)])


def moment_href(
    robot: str, variables: Iterable[str], at_ns: int | None, until_ns: int | None = None
) -> str:
    """Return the address of the data around a moment, up to ``until_ns`` if that is earlier.

    Outputs of monitors, named with slashes, are no variables that could be drawn.
    """
    drawn = [name for name in variables if "/" not in name]
    if at_ns is None:
        return _href(robot, _chosen(drawn))
    last_ns = at_ns + AROUND_NS
    to_ns = last_ns if until_ns is None else max(at_ns, min(until_ns, last_ns))
    return data_href(robot, _shortly(at_ns - AROUND_NS), _shortly(to_ns), drawn)


def mission_href(robot: str, mission: str) -> str:
    """Return the address of a mission's data."""
    return _href(robot, [("mission", mission)])


def _chosen(variables: Iterable[str]) -> list[tuple[str, str]]:
    return [("v", name) for name in dict.fromkeys(variables)]


def _shortly(at_ns: int) -> str:
    """Write a time to the millisecond: nobody looks closer, and the address is read."""
    return f"{format_time(at_ns)[:23]}Z"


def _href(robot: str, query: list[tuple[str, str]]) -> str:
    return f"/robots/{quote(robot, safe='')}/data?{urlencode(query)}"
