"""Coverage of a robot's recordings over time: journals, gaps with reasons, incidents."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

from sqlalchemy import func, select

from amberbox.core.api import Gap, GapKind, Gaps, Incident, Integrity, Mission
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.timestamps import format_time, maybe_time, ns_of
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.archive.reader import Span
from amberbox.server.archive.retention import rule_of
from amberbox.server.data.recordings import JournalListing, recordings
from amberbox.server.drawing.charts import CoverageInterval, Kind, TimeAxis
from amberbox.server.journals import Retention
from amberbox.server.schema import JOURNALS
from amberbox.server.services.context import Caller, Services
from amberbox.server.services.recordings import list_gaps, list_incidents, list_missions
from amberbox.server.settings import read

Window = Literal["1h", "6h", "24h", "7d", "30d", "all"]
WINDOWS: Mapping[Window, int | None] = {
    "1h": 3600 * NS, "6h": 6 * 3600 * NS, "24h": 24 * 3600 * NS, "7d": 7 * 24 * 3600 * NS,
    "30d": 30 * 24 * 3600 * NS, "all": None,
}  # fmt: skip
"""How far a bar reaches back from now, in ns; None is to the first recording."""

_MOST: Window = "7d"
"""The longest window that is shown as long as the user has chosen none."""
_STEPS = 800
"""Stretches nearer to each other than this part of the bar are drawn as one."""
_HOUR_NS = 3600 * NS
ASIDE = ("watch", "keep", "act", "experiment", "detect")
"""Journals of the box and its watcher, which are not coverage of the robot's data."""
_HELD = ("in_columns", "waiting")
_DRAWN: Mapping[GapKind, Kind] = {
    "deleted": "deleted", "filtered": "filtered", "lost": "lost", "refused": "lost"
}  # fmt: skip
"""Kinds of gaps that are drawn; if nothing was recorded, nothing is drawn."""


@dataclass(frozen=True, slots=True)
class CoveragePart:
    """An entry of the list beside a bar; times are RFC 3339."""

    kind: Kind
    start: str
    to: str
    text: str


def shortest(first_ns: int | None, now_ns: int) -> Window:
    """Return the shortest window that contains the first recording, at most 7 days."""
    if first_ns is None:
        return _MOST
    for name, back_ns in WINDOWS.items():
        if name == _MOST or (back_ns is not None and first_ns >= now_ns - back_ns):
            return name
    return _MOST


def axis_of(window: Window, journals: Sequence[JournalListing], now_ns: int) -> TimeAxis:
    """Return the time axis of a bar: up to now, at least an hour."""
    back = WINDOWS[window]
    if back is not None:
        return TimeAxis(now_ns - back, now_ns)
    starts = (one.from_ns for one in _data(journals) if one.from_ns is not None)
    first = min(starts, default=now_ns)
    return TimeAxis(min(first, now_ns - _HOUR_NS), now_ns)


def stretches(
    journals: Sequence[JournalListing],
    gaps: Sequence[Gap],
    incidents: Sequence[Incident],
    axis: TimeAxis,
) -> list[CoverageInterval]:
    """Return the intervals to draw, sorted by kind, text and time; close ones are joined."""
    every = [*_recorded(journals), *_missing(gaps), *_kept(incidents)]
    shown = [one for one in every if axis.covers(one.start, one.to)]
    return _joined(shown, (axis.to - axis.start) / _STEPS)


def parts(found: Iterable[CoverageInterval], most: int) -> list[CoveragePart]:
    """Return the newest intervals as entries of a list."""
    newest = sorted(found, key=lambda one: -one.start)[:most]
    return [CoveragePart(s.kind, format_time(s.start), format_time(s.to), s.text) for s in newest]


def spans(journals: Sequence[JournalListing]) -> list[tuple[int, int]]:
    """Return the intervals (ns) whose data are recorded and on the server, in order of time."""
    found: list[tuple[int, int]] = []
    for start, to in sorted((one.start, one.to) for one in _recorded(journals)
                            if one.kind == "recorded"):  # fmt: skip
        if found and start <= found[-1][1] + NS:
            found[-1] = found[-1][0], max(to, found[-1][1])
        else:
            found.append((start, to))
    return found


def share(recorded: Sequence[tuple[int, int]], from_ns: int, to_ns: int) -> float:
    """Return the part of an interval that is recorded and on the server, from 0 to 1."""
    if to_ns <= from_ns:
        return 0.0
    here = sum(max(0, min(to, to_ns) - max(start, from_ns)) for start, to in recorded)
    return min(1.0, here / (to_ns - from_ns))


def _data(journals: Iterable[JournalListing]) -> Iterator[JournalListing]:
    return (one for one in journals if one.keeping not in ASIDE)


def _recorded(journals: Iterable[JournalListing]) -> Iterator[CoverageInterval]:
    for one in _data(journals):
        if one.from_ns is None or one.to_ns is None:
            continue
        if one.integrity == "deleted":
            yield CoverageInterval(one.from_ns, one.to_ns, "deleted")
        elif one.state in _HELD and one.integrity != "missing":
            yield CoverageInterval(one.from_ns, one.to_ns, "recorded")


def _missing(gaps: Iterable[Gap]) -> Iterator[CoverageInterval]:
    for gap in gaps:
        kind = _DRAWN.get(gap.kind)
        if kind is not None:
            text = f"{gap.item}: {gap.reason}" if gap.item else gap.reason
            yield CoverageInterval(ns_of(gap.from_), ns_of(gap.to), kind, text)


def _kept(incidents: Iterable[Incident]) -> Iterator[CoverageInterval]:
    for one in incidents:
        if one.state != "released":
            yield CoverageInterval(ns_of(one.from_), ns_of(one.to), "incident", one.reason)


def _joined(found: Iterable[CoverageInterval], least: float) -> list[CoverageInterval]:
    """Join intervals of one kind and text whose distance is at most ``least``."""
    joined: list[CoverageInterval] = []
    for one in sorted(found, key=lambda s: (s.kind, s.text, s.start)):
        last = joined[-1] if joined else None
        same = last is not None and (last.kind, last.text) == (one.kind, one.text)
        if last is not None and same and one.start - last.to <= least:
            joined[-1] = CoverageInterval(last.start, max(last.to, one.to), one.kind, one.text)
        else:
            joined.append(one)
    return joined


INTEGRITIES: Sequence[Integrity] = (
    "intact", "unsigned", "altered", "missing", "deleted", "unknown"
)  # fmt: skip
_JOURNALS = 1_000_000
_LOOK_MOST = 10_000
"""Missions and incidents of a robot that pages count."""
_GAPS = 1000


@dataclass(frozen=True)
class RobotRecordings:
    """Missions, incidents and journals of a robot.

    ``trouble`` is the error if some could not be read.
    """

    robot: str
    now_ns: int
    journals: Sequence[JournalListing]
    missions: Sequence[Mission] = ()
    incidents: Sequence[Incident] = ()
    trouble: AmberboxError | None = None

    @property
    def integrity(self) -> Mapping[Integrity, int]:
        """Return the number of journals by integrity, intact first; only those that occur."""
        counted = Counter(one.integrity for one in self.journals)
        return {name: counted[name] for name in INTEGRITIES if counted[name]}

    @property
    def kept(self) -> Sequence[Incident]:
        """Return the incidents that are not released."""
        return [one for one in self.incidents if one.state != "released"]

    @cached_property
    def _spans(self) -> Sequence[tuple[int, int]]:
        return spans(self.journals)

    def share(self, mission: Mission) -> float:
        """Return the part of a mission that is recorded and on the server, from 0 to 1."""
        to_ns = self.now_ns if mission.to is None else ns_of(mission.to)
        return share(self._spans, ns_of(mission.from_), to_ns)


@dataclass(frozen=True, slots=True)
class CoverageBar:
    """The content of a bar; ``trouble``: gaps could not be read, ``more``: there are more gaps."""

    axis: TimeAxis
    stretches: Sequence[CoverageInterval]
    more: bool = False
    trouble: AmberboxError | None = None

    @property
    def start(self) -> str:
        """The time at which the bar begins, RFC 3339."""
        return format_time(int(self.axis.start))

    @property
    def to(self) -> str:
        """The time at which the bar ends, RFC 3339."""
        return format_time(int(self.axis.to))


def fitting(fleet: Services, robots: Sequence[str]) -> Window:
    """Return the shortest window that contains all recordings of some robots, at most 7 days."""
    j = JOURNALS.c
    chosen = select(func.min(j.start_ns)).where(
        j.robot.in_(robots), j.end_ns > 0, j.keeping.not_in(ASIDE)
    )
    with fleet.database.reading() as connection:
        return shortest(connection.execute(chosen).scalar(), fleet.clock.wall_ns())


def read_recordings(
    fleet: Services, who: Caller, robot: KnownRobot, *, missions: bool = True,
    incidents: bool = True,
) -> RobotRecordings:  # fmt: skip
    """Return missions and incidents of a robot, read by workers; without journals."""
    found = RobotRecordings(robot.id, fleet.clock.wall_ns(), ())
    try:
        return replace(
            found,
            missions=list_missions(fleet, who, robot, limit=_LOOK_MOST) if missions else (),
            incidents=list_incidents(fleet, who, robot, limit=_LOOK_MOST) if incidents else (),
        )
    except AmberboxError as error:  # workers are busy: show the rest
        return replace(found, trouble=error)


def with_journals(
    fleet: Services, robot: KnownRobot, found: RobotRecordings, window: Window
) -> RobotRecordings:
    """Return recordings with the journals in a window."""
    back = WINDOWS[window]
    span = None if back is None else found.now_ns - back, None
    return replace(found, journals=journals(fleet, robot, span))


def with_journals_of(
    fleet: Services, robot: KnownRobot, found: RobotRecordings, shown: Sequence[Mission]
) -> RobotRecordings:
    """Return recordings with the journals in the time of some missions."""
    if not shown:
        return found
    ends = [found.now_ns if one.to is None else ns_of(one.to) for one in shown]
    span = min(ns_of(one.from_) for one in shown), max(ends)
    return replace(found, journals=journals(fleet, robot, span))


def journals(
    fleet: Services, robot: KnownRobot, span: Span = (None, None)
) -> Sequence[JournalListing]:
    """Return the journals of a robot that overlap a span, newest first.

    A journal without known times counts from when it arrived.
    """
    with fleet.database.reading() as connection:
        found = recordings(connection, fleet.folder, robot.id, limit=_JOURNALS, span=span)
    return sorted(found, key=lambda one: (-_since(one), one.store_id, one.journal))


def _since(one: JournalListing) -> int:
    return one.came_ns or 0 if one.from_ns is None else one.from_ns


def cover(
    fleet: Services, who: Caller, robot: KnownRobot, found: RobotRecordings, window: Window
) -> CoverageBar:
    """Return the content of a robot's bar over a window; a worker reads the gaps."""
    axis = axis_of(window, found.journals, found.now_ns)
    from_, to = (format_time(int(at)) for at in (axis.start, axis.to))
    trouble, gaps = None, Gaps(gaps=[], more=False)
    try:
        gaps = list_gaps(fleet, who, robot, from_=from_, to=to, limit=_GAPS)
    except AmberboxError as error:
        trouble = error
    drawn = stretches(found.journals, gaps.gaps, found.incidents, axis)
    return CoverageBar(axis, drawn, gaps.more, trouble or found.trouble)


@dataclass(frozen=True, slots=True)
class RetentionDates:
    """Until when a journal and its rows are kept; None is for ever."""

    journal: str | None
    columns: str | None


class RetentionOfRobot:
    """How long the journals of a robot are kept, by the rules of the server."""

    def __init__(self, fleet: Services, robot: str) -> None:
        self._robot = robot
        with fleet.database.reading() as connection:
            self._rules = read(connection, "retention", tuple[Retention, ...])

    def until(self, one: JournalListing) -> RetentionDates:
        """Return when retention may delete a journal and its rows."""
        return RetentionDates(
            maybe_time(_after(one, self._seconds(one.keeping, "journals_s"))),
            maybe_time(_after(one, self._seconds(one.keeping, "columns_s"))),
        )

    @property
    def days(self) -> tuple[float | None, float | None]:
        """Return for how many days journals and rows of class ``main`` are kept."""
        found = [self._seconds("main", name) for name in ("journals_s", "columns_s")]
        first, second = (None if one is None else one / 86_400 for one in found)
        return first, second

    def _seconds(self, keeping: str, name: str) -> float | None:
        rule = rule_of(self._robot, keeping, self._rules)
        return None if rule is None else getattr(rule, name)


def _after(one: JournalListing, seconds: float | None) -> int | None:
    return None if seconds is None or one.came_ns is None else one.came_ns + int(seconds * NS)
