"""What recordings cover over time: journals, what is missing and why, incidents; for one bar."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from amberbox.core.clock import NS
from amberbox.core.timetext import format_time, ns_of
from amberbox.fleet.api.incidents import Incident
from amberbox.fleet.api.query import Gap
from amberbox.fleet.data.journals import Recording
from amberbox.fleet.data.missing import GapKind
from amberbox.fleet.drawing.axis import Axis
from amberbox.fleet.drawing.coverage import Kind, Stretch

Window = Literal["1h", "6h", "24h", "7d", "30d", "all"]
WINDOWS: Mapping[Window, int | None] = {
    "1h": 3600 * NS, "6h": 6 * 3600 * NS, "24h": 24 * 3600 * NS, "7d": 7 * 24 * 3600 * NS,
    "30d": 30 * 24 * 3600 * NS, "all": None,
}  # fmt: skip
"""How far a bar goes back from now, in ns; None is to the first recording."""

_MOST: Window = "7d"
"""The longest window that is shown where nobody chose one."""
_STEPS = 800
"""Stretches nearer to each other than this part of the bar are drawn as one."""
_HOUR_NS = 3600 * NS
ASIDE = ("watch", "keep")
"""Journals of what the box and its watcher say themselves: not what the robot's data cover."""
_HELD = ("in_columns", "waiting")
_DRAWN: Mapping[GapKind, Kind] = {
    "deleted": "deleted", "filtered": "filtered", "lost": "lost", "refused": "lost"
}  # fmt: skip
"""What of gaps has a look of its own; where nothing was recorded, nothing is drawn."""


@dataclass(frozen=True, slots=True)
class Part:
    """A line of the list beside a bar; times are RFC 3339."""

    kind: Kind
    start: str
    to: str
    text: str


def shortest(first_ns: int | None, now_ns: int) -> Window:
    """Return the shortest window that holds all since the first recording, at most 7 days."""
    if first_ns is None:
        return _MOST
    for name, back_ns in WINDOWS.items():
        if name == _MOST or (back_ns is not None and first_ns >= now_ns - back_ns):
            return name
    return _MOST


def axis_of(window: Window, journals: Sequence[Recording], now_ns: int) -> Axis:
    """Return what a bar covers: at least an hour, up to now."""
    back = WINDOWS[window]
    if back is not None:
        return Axis(now_ns - back, now_ns)
    starts = (one.from_ns for one in _data(journals) if one.from_ns is not None)
    first = min(starts, default=now_ns)
    return Axis(min(first, now_ns - _HOUR_NS), now_ns)


def stretches(
    journals: Sequence[Recording], gaps: Sequence[Gap], incidents: Sequence[Incident], axis: Axis
) -> list[Stretch]:
    """Return what is to be drawn, in order of time; what lies close together is one."""
    every = [*_recorded(journals), *_missing(gaps), *_kept(incidents)]
    shown = [one for one in every if axis.covers(one.start, one.to)]
    return list(_joined(shown, (axis.to - axis.start) / _STEPS))


def parts(found: Iterable[Stretch], most: int) -> list[Part]:
    """Return the newest stretches as a list."""
    newest = sorted(found, key=lambda one: -one.start)[:most]
    return [Part(s.kind, format_time(s.start), format_time(s.to), s.text) for s in newest]


def spans(journals: Sequence[Recording]) -> list[tuple[int, int]]:
    """Return when something of the robot's data was recorded that is here, in order of time."""
    found: list[tuple[int, int]] = []
    for start, to in sorted((one.start, one.to) for one in _recorded(journals)
                            if one.kind == "recorded"):  # fmt: skip
        if found and start <= found[-1][1] + NS:
            found[-1] = found[-1][0], max(to, found[-1][1])
        else:
            found.append((start, to))
    return found


def share(recorded: Sequence[tuple[int, int]], from_ns: int, to_ns: int) -> float:
    """Return how much of a time was recorded and is here, from 0 to 1."""
    if to_ns <= from_ns:
        return 0.0
    here = sum(max(0, min(to, to_ns) - max(start, from_ns)) for start, to in recorded)
    return min(1.0, here / (to_ns - from_ns))


def _data(journals: Iterable[Recording]) -> Iterator[Recording]:
    return (one for one in journals if one.keeping not in ASIDE)


def _recorded(journals: Iterable[Recording]) -> Iterator[Stretch]:
    for one in _data(journals):
        if one.from_ns is None or one.to_ns is None:
            continue
        if one.integrity == "deleted":
            yield Stretch(one.from_ns, one.to_ns, "deleted")
        elif one.state in _HELD and one.integrity != "missing":
            yield Stretch(one.from_ns, one.to_ns, "recorded")


def _missing(gaps: Iterable[Gap]) -> Iterator[Stretch]:
    for gap in gaps:
        kind = _DRAWN.get(gap.kind)
        if kind is not None:
            text = f"{gap.item}: {gap.reason}" if gap.item else gap.reason
            yield Stretch(ns_of(gap.from_), ns_of(gap.to), kind, text)


def _kept(incidents: Iterable[Incident]) -> Iterator[Stretch]:
    for one in incidents:
        if one.state != "released":
            yield Stretch(ns_of(one.from_), ns_of(one.to), "incident", one.reason)


def _joined(found: Iterable[Stretch], least: float) -> Iterator[Stretch]:
    last: Stretch | None = None
    for one in sorted(found, key=lambda s: (s.kind, s.text, s.start)):
        if last is not None and _meet(last, one, least):
            last = Stretch(last.start, max(last.to, one.to), last.kind, last.text)
            continue
        if last is not None:
            yield last
        last = one
    if last is not None:
        yield last


def _meet(one: Stretch, other: Stretch, least: float) -> bool:
    alike = (one.kind, one.text) == (other.kind, other.text)
    return alike and other.start - one.to <= least
