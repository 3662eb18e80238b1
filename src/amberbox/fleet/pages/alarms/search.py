"""Alarms as somebody looks for them on the page: which, how many of each state, in which order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias
from urllib.parse import urlencode

from sqlalchemy import ColumnElement, Connection, Select, case, func, or_, select

from amberbox.fleet.alarms.alarm import Alarm
from amberbox.fleet.alarms.tables import ALARM, ALARM_ROBOT
from amberbox.monitoring.engine.outputs import SEVERITIES
from amberbox.monitoring.plan import Severity

Tab: TypeAlias = Literal["open", "acknowledged", "shelved", "resolved", "all"]
Sort: TypeAlias = Literal["worst", "newest"]
TABS: Sequence[Tab] = ("open", "acknowledged", "shelved", "resolved", "all")
STEP = 50
"""So many alarms are listed at once, and so many more each time somebody asks for more."""


@dataclass(frozen=True, slots=True)
class Look:
    """What somebody looks for; it stands in the address. ``since`` and ``until`` are its period."""

    state: Tab = "open"
    q: str = ""
    robot: str = ""
    team: str = ""
    severity: Severity = "warning"
    since: str = ""
    until: str = ""
    sort: Sort = "worst"
    n: int = STEP

    def address(self, **changes: str | int) -> str:
        """Return the address of this look with some of it changed."""
        known = {name: getattr(self, name) for name in self.__slots__} | changes
        usual = Look()
        more = {name: value for name, value in known.items() if value != getattr(usual, name)}
        return "?" + urlencode({_NAMES.get(name, name): value for name, value in more.items()})

    @property
    def is_narrow(self) -> bool:
        """Tell whether anything but the state is chosen."""
        rest = (self.q, self.robot, self.team, self.since, self.until)
        return any(rest) or self.severity != "warning"


_NAMES = {"since": "from", "until": "to"}
"""What stands in the address where Python keeps the word for itself."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """A look, with what its words stand for.

    ``robots`` are those whose alarms are looked for, None for all; ``seen`` those that the caller
    may see, None for all. Times are ns of the server's clock.
    """

    look: Look
    robots: frozenset[str] | None
    seen: frozenset[str] | None
    since_ns: int | None = None
    until_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Found:
    """The alarms of the tab, and how many there are of each."""

    alarms: Sequence[Alarm]
    counts: Mapping[Tab, int]


def found(connection: Connection, wanted: Wanted) -> Found:
    """Return the alarms that fit; those that became part of another one are left out."""
    where = list(_where(wanted))
    counted = select(ALARM.c.state, func.count()).where(*where).group_by(ALARM.c.state)
    by_state: dict[str, int] = {str(state): number for state, number in connection.execute(counted)}
    counts: dict[Tab, int] = {tab: by_state.get(tab, 0) for tab in TABS}
    counts["all"] = sum(by_state.values())
    look = wanted.look
    if look.state != "all":
        where.append(ALARM.c.state == look.state)
    chosen = select(ALARM).where(*where).order_by(*_order(look.sort)).limit(look.n)
    alarms = [Alarm(**row) for row in connection.execute(chosen).mappings()]
    return Found(alarms, counts)


def _where(wanted: Wanted) -> Iterator[ColumnElement[bool]]:
    look = wanted.look
    yield ALARM.c.merged_into.is_(None)
    yield ALARM.c.severity.in_(SEVERITIES[SEVERITIES.index(look.severity) :])
    if wanted.robots is not None:
        yield ALARM.c.number.in_(_of(ALARM_ROBOT.c.robot.in_(sorted(wanted.robots))))
    yield from (_has(word, wanted.seen) for word in look.q.split())
    if wanted.since_ns is not None:  # what ended before is over; what lasts has no end
        ended = func.coalesce(ALARM.c.cleared_ns, ALARM.c.resolved_ns)
        yield or_(ended.is_(None), ended >= wanted.since_ns)
    if wanted.until_ns is not None:
        yield ALARM.c.opened_ns < wanted.until_ns


def _has(word: str, seen: frozenset[str] | None) -> ColumnElement[bool]:
    """Fit a word, in whatever of an alarm people read.

    The reason of an alarm of several robots names them all: it is no way to find out about those
    that somebody may not see.
    """
    named = ALARM_ROBOT.c.robot.icontains(word, autoescape=True)
    if seen is not None:
        named = named & ALARM_ROBOT.c.robot.in_(sorted(seen))
    texts = (ALARM.c.origin, ALARM.c.cause, ALARM.c.owner)
    reason = ALARM.c.reason.icontains(word, autoescape=True)
    return or_(
        *(text.icontains(word, autoescape=True) for text in texts),
        reason if seen is None else reason & (ALARM.c.robot != ""),
        ALARM.c.number.in_(_of(named)),
        *([ALARM.c.number == int(word)] if word.isdecimal() and len(word) < 18 else []),
    )


def _of(about: ColumnElement[bool]) -> Select[tuple[int]]:
    return select(ALARM_ROBOT.c.alarm).where(about)


def _order(sort: Sort) -> Iterator[ColumnElement[object]]:
    if sort == "worst":
        ranks = {severity: rank for rank, severity in enumerate(SEVERITIES)}
        yield ALARM.c.active.desc()
        yield case(ranks, value=ALARM.c.severity).desc()
    yield ALARM.c.opened_ns.desc()
    yield ALARM.c.number.desc()
