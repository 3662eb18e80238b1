"""All that is known of one robot's recordings, asked of the rooms of the API."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from sqlalchemy import func, select

from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.timetext import format_time, ns_of
from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.api.access import Caller
from amberbox.fleet.api.forms import shown
from amberbox.fleet.api.incidents import Incident, list_incidents
from amberbox.fleet.api.missions import Mission, list_missions
from amberbox.fleet.api.query import Gaps, list_gaps
from amberbox.fleet.archive.retaining import rule_of
from amberbox.fleet.archive.store import Retention
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.data.journals import Integrity, Recording, Span, recordings
from amberbox.fleet.drawing.axis import Axis
from amberbox.fleet.drawing.coverage import Stretch
from amberbox.fleet.options.options import read
from amberbox.fleet.pages.recordings.cover import (
    ASIDE,
    WINDOWS,
    Window,
    axis_of,
    share,
    shortest,
    spans,
    stretches,
)
from amberbox.fleet.services import Services

INTEGRITIES: Sequence[Integrity] = (
    "intact", "unsigned", "altered", "missing", "deleted", "unknown"
)  # fmt: skip
_JOURNALS = 1_000_000
_MOST = 10_000
"""Missions and incidents of a robot that pages count."""
_GAPS = 1000


@dataclass(frozen=True)
class Record:
    """Missions and incidents of a robot, and journals of the time that is looked at.

    ``trouble`` says why some could not be had.
    """

    robot: str
    now_ns: int
    journals: Sequence[Recording]
    missions: Sequence[Mission] = ()
    incidents: Sequence[Incident] = ()
    trouble: AmberboxError | None = None

    @property
    def integrity(self) -> Mapping[Integrity, int]:
        """Count journals by whether they hold, the good ones first; those of which there are."""
        counted = Counter(one.integrity for one in self.journals)
        return {name: counted[name] for name in INTEGRITIES if counted[name]}

    @property
    def kept(self) -> Sequence[Incident]:
        """Return the incidents that nobody has released."""
        return [one for one in self.incidents if one.state != "released"]

    @cached_property
    def _spans(self) -> Sequence[tuple[int, int]]:
        return spans(self.journals)

    def share(self, mission: Mission) -> float:
        """Return how much of a mission was recorded and is here."""
        to_ns = self.now_ns if mission.to is None else ns_of(mission.to)
        return share(self._spans, ns_of(mission.from_), to_ns)


@dataclass(frozen=True, slots=True)
class Cover:
    """What a bar shows; ``trouble`` says why gaps are not on it, ``more`` that some are not."""

    axis: Axis
    stretches: Sequence[Stretch]
    more: bool = False
    trouble: AmberboxError | None = None

    @property
    def start(self) -> str:
        """Where the bar begins."""
        return format_time(int(self.axis.start))

    @property
    def to(self) -> str:
        """Where the bar ends."""
        return format_time(int(self.axis.to))


def fitting(fleet: Services, robots: Sequence[str]) -> Window:
    """Return the shortest window that holds what there is of some robots, at most 7 days."""
    j = JOURNALS.c
    chosen = select(func.min(j.start_ns)).where(
        j.robot.in_(robots), j.end_ns > 0, j.keeping.not_in(ASIDE)
    )
    with fleet.database.reading() as connection:
        return shortest(connection.execute(chosen).scalar(), fleet.clock.wall_ns())


def record(
    fleet: Services, who: Caller, robot: KnownRobot, *, missions: bool = True,
    incidents: bool = True,
) -> Record:  # fmt: skip
    """Return missions and incidents of a robot, of which workers are asked; no journals."""
    found = Record(robot.id, fleet.clock.wall_ns(), ())
    try:
        return replace(
            found,
            missions=list_missions(fleet, who, robot, limit=_MOST) if missions else (),
            incidents=list_incidents(fleet, who, robot, limit=_MOST) if incidents else (),
        )
    except AmberboxError as error:  # too much is asked at the moment: the rest can be shown
        return replace(found, trouble=error)


def with_journals(fleet: Services, robot: KnownRobot, found: Record, window: Window) -> Record:
    """Return a record with the journals that a bar over a window shows."""
    back = WINDOWS[window]
    span = None if back is None else found.now_ns - back, None
    return replace(found, journals=journals(fleet, robot, span))


def with_journals_of(
    fleet: Services, robot: KnownRobot, found: Record, shown: Sequence[Mission]
) -> Record:
    """Return a record with the journals of the time of some missions."""
    if not shown:
        return found
    ends = [found.now_ns if one.to is None else ns_of(one.to) for one in shown]
    span = min(ns_of(one.from_) for one in shown), max(ends)
    return replace(found, journals=journals(fleet, robot, span))


def journals(fleet: Services, robot: KnownRobot, span: Span = (None, None)) -> Sequence[Recording]:
    """Return the journals of a robot that meet a span, the newest first.

    Where it is not known what one covers, it counts from when it came.
    """
    with fleet.database.reading() as connection:
        found = recordings(connection, fleet.folder, robot.id, limit=_JOURNALS, span=span)
    return sorted(found, key=lambda one: (-_since(one), one.store_id, one.journal))


def _since(one: Recording) -> int:
    return one.came_ns or 0 if one.from_ns is None else one.from_ns


def cover(fleet: Services, who: Caller, robot: KnownRobot, found: Record, window: Window) -> Cover:
    """Return what a robot's bar shows of a window; a worker is asked for what is missing."""
    axis = axis_of(window, found.journals, found.now_ns)
    from_, to = (format_time(int(at)) for at in (axis.start, axis.to))
    trouble, gaps = None, Gaps(gaps=[], more=False)
    try:
        gaps = list_gaps(fleet, who, robot, from_=from_, to=to, limit=_GAPS)
    except AmberboxError as error:
        trouble = error
    drawn = stretches(found.journals, gaps.gaps, found.incidents, axis)
    return Cover(axis, drawn, gaps.more, trouble or found.trouble)


@dataclass(frozen=True, slots=True)
class Kept:
    """Until when a journal and its rows stay; None is for ever."""

    journal: str | None
    columns: str | None


class Retaining:
    """Tells how long journals of a robot stay, by the rules of the server."""

    def __init__(self, fleet: Services, robot: str) -> None:
        self._robot = robot
        with fleet.database.reading() as connection:
            self._rules = read(connection, "retention", tuple[Retention, ...])

    def until(self, one: Recording) -> Kept:
        """Return when retention may take a journal."""
        return Kept(
            shown(_after(one, self._seconds(one.keeping, "journals_s"))),
            shown(_after(one, self._seconds(one.keeping, "columns_s"))),
        )

    @property
    def days(self) -> tuple[float | None, float | None]:
        """Return for how many days journals and rows of most data stay."""
        found = [self._seconds("main", name) for name in ("journals_s", "columns_s")]
        first, second = (None if one is None else one / 86_400 for one in found)
        return first, second

    def _seconds(self, keeping: str, name: str) -> float | None:
        rule = rule_of(self._robot, keeping, self._rules)
        return None if rule is None else getattr(rule, name)


def _after(one: Recording, seconds: float | None) -> int | None:
    return None if seconds is None or one.came_ns is None else one.came_ns + int(seconds * NS)
