"""Pages of alarms: the list, one alarm in detail, and the texts of both."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeAlias
from urllib.parse import parse_qs, quote, urlencode, urlsplit

from fastapi import Depends, HTTPException, Query, Request, Response
from sqlalchemy import ColumnElement, Connection, RowMapping, Select, case, func, or_, select

from amberbox.core.api import AlarmLine, Happening
from amberbox.core.clock import NS
from amberbox.core.robot_status import SEVERITIES, Severity
from amberbox.core.timestamps import format_time, maybe_time, ns_of
from amberbox.core.units import CONFIDENCE_WORDS, LIKELY, percent
from amberbox.diagnosis.report.wording import capitalize
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.robots import KnownRobot, list_robots
from amberbox.server.accounts.users import list_users
from amberbox.server.alarms import store
from amberbox.server.alarms.alarm import Alarm
from amberbox.server.alarms.offline import CONNECTION
from amberbox.server.http.auth import Fleet, Who
from amberbox.server.http.forms import AlarmNumber, TimeText
from amberbox.server.ingest.link_state import presences
from amberbox.server.schema import ALARM, ALARM_ROBOT, CONSEQUENCE, OUTBOX
from amberbox.server.services.alarms import Notification, alarm_line, list_notifications, show_alarm
from amberbox.server.services.context import Caller, Services, query_time_ns
from amberbox.server.services.robots import current_status
from amberbox.server.web.diagnosis_card import DiagnosisCard, card_now, look, view_diagnosis_at
from amberbox.server.web.page import PageRoutes, render
from amberbox.server.web.text import catalogue, checks_fail, data_href, readable, span

Tab: TypeAlias = Literal["open", "acknowledged", "shelved", "resolved", "all"]
Sort: TypeAlias = Literal["worst", "newest"]
TABS: Sequence[Tab] = ("open", "acknowledged", "shelved", "resolved", "all")
STEP = 50
"""Number of alarms that are listed at once, and added with each request for more."""


@dataclass(frozen=True, slots=True)
class AlarmListQuery:
    """Query of the list of alarms, as in the address; ``since`` and ``until`` are its period."""

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
        """Return the address of this query with some of it changed."""
        known = {name: getattr(self, name) for name in self.__slots__} | changes
        usual = AlarmListQuery()
        more = {name: value for name, value in known.items() if value != getattr(usual, name)}
        return "?" + urlencode({_NAMES.get(name, name): value for name, value in more.items()})

    @property
    def is_narrow(self) -> bool:
        """Return whether any filter but the state is set."""
        rest = (self.q, self.robot, self.team, self.since, self.until)
        return any(rest) or self.severity != "warning"


_NAMES = {"since": "from", "until": "to"}
"""Parameters of the address whose names are keywords of Python."""


@dataclass(frozen=True, slots=True)
class AlarmSearch:
    """A query, with its robots and times resolved.

    ``robots`` are those whose alarms are wanted, None for all; ``seen`` those that the caller may
    see, None for all. Times are ns of the server's clock.
    """

    look: AlarmListQuery
    robots: frozenset[str] | None
    seen: frozenset[str] | None
    since_ns: int | None = None
    until_ns: int | None = None


@dataclass(frozen=True, slots=True)
class AlarmSearchResult:
    """The alarms of the chosen tab, and the number of alarms in each tab."""

    alarms: Sequence[Alarm]
    counts: Mapping[Tab, int]


def found(connection: Connection, wanted: AlarmSearch) -> AlarmSearchResult:
    """Return the alarms that match; those merged into another are left out."""
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
    return AlarmSearchResult(alarms, counts)


def _where(wanted: AlarmSearch) -> Iterator[ColumnElement[bool]]:
    look = wanted.look
    yield ALARM.c.merged_into.is_(None)
    yield ALARM.c.severity.in_(SEVERITIES[SEVERITIES.index(look.severity) :])
    if wanted.robots is not None:
        yield ALARM.c.number.in_(_of(ALARM_ROBOT.c.robot.in_(sorted(wanted.robots))))
    yield from (_has(word, wanted.seen) for word in look.q.split())
    if wanted.since_ns is not None:  # active alarms have no end
        ended = func.coalesce(ALARM.c.cleared_ns, ALARM.c.resolved_ns)
        yield or_(ended.is_(None), ended >= wanted.since_ns)
    if wanted.until_ns is not None:
        yield ALARM.c.opened_ns < wanted.until_ns


def _has(word: str, seen: frozenset[str] | None) -> ColumnElement[bool]:
    """Return the condition that a word is in a text of the alarm.

    The reason of an alarm of several robots names them all, so it is not searched for callers who
    may not see all robots.
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


@dataclass(frozen=True, slots=True)
class AffectedComponent:
    """A component that suffers from the root of an alarm; ``lasted`` is empty until it ends."""

    part: str
    level: str
    reason: str
    since: str
    until: str | None
    lasted: str


@dataclass(frozen=True, slots=True)
class AlarmItem:
    """An alarm with its texts; ``lasted`` is empty while it is active.

    ``may``: whether the caller may change it.
    """

    line: AlarmLine
    what: str
    title: str
    cause: str
    lasted: str
    suffering: Sequence[AffectedComponent]
    may: bool

    @property
    def small(self) -> str:
        """Return the robot's reason, after the subject if the title is a cause; or empty."""
        reason = self.line.reason
        if self.is_cause and self.has_part:
            return f"{self.what}: {reason}" if reason else self.what
        return "" if reason in self.title else reason

    @property
    def is_cause(self) -> bool:
        """Return whether the title is the cause."""
        return bool(self.cause) and self.cause.startswith(self.title)

    @property
    def sure(self) -> str:
        """Return how certain the cause in the title is; empty if the title is no cause."""
        return self.cause.removeprefix(self.title).strip(" ()") if self.is_cause else ""

    @property
    def has_part(self) -> bool:
        """Return whether it has a subject: a component, or what offline robots have in common."""
        return self.line.kind == "robot" or self.line.origin != CONNECTION

    @property
    def is_choosable(self) -> bool:
        """Return whether the caller may acknowledge it."""
        return self.may and self.line.state == "open" and self.line.merged_into is None


@dataclass(frozen=True, slots=True)
class AlarmLinks:
    """Links from an alarm to its data and its timeline; empty for none."""

    data: str
    timeline: str


@dataclass(frozen=True, slots=True)
class AlarmDetails:
    """One alarm in detail. ``people`` are those it can be assigned to, if the caller may change it.

    ``notified`` counts the notifications. ``others``: the caller may not change it because it also
    concerns robots of others.
    """

    item: AlarmItem
    others: bool
    events: Sequence[AlarmHistoryLine]
    messages: Sequence[Notification]
    notified: int
    people: Sequence[str]
    me: str


def alarm_items(
    connection: Connection, fleet: Services, who: Caller, alarms: Sequence[Alarm]
) -> list[AlarmItem]:
    """Return alarms with their texts, restricted to the robots that the caller may see."""
    words = alarm_texts(connection, fleet)
    numbers = [alarm.number for alarm in alarms]
    about = store.robots_of(connection, numbers)
    suffering = _suffering(connection, numbers)
    seen = _names(connection, who, "alarms.read")
    mine = _names(connection, who, "alarms.write")
    return [
        _item(words, alarm, [row for row in about[alarm.number] if row["robot"] in seen],
              suffering.get(alarm.number, ()), may=_may(who, about[alarm.number], mine))
        for alarm in alarms
    ]  # fmt: skip


def alarm_details(fleet: Services, who: Caller, number: int) -> AlarmDetails:
    """Return one alarm in detail; raises 404 for an unknown one, or one the caller may not see."""
    page = show_alarm(fleet, who, number)
    with fleet.database.reading() as connection:
        words = alarm_texts(connection, fleet)
        rows = _suffering(connection, [number]).get(number, ())
        about = store.robots_of(connection, [number])[number]
        mine = _names(connection, who, "alarms.write")
        people = _people(connection, [row["robot"] for row in about])
        notified = notified_count(connection, number)
    may = _may(who, about, mine)
    others = not may and any(row["robot"] in mine for row in about)
    item = _of_line(words, page.alarm, rows, may=may)
    history = [one for one in page.history if notified or one.what != "notified"]
    lines = list(events(history, words, page.alarm))
    given_to = people if may else []
    return AlarmDetails(
        item, others, lines, _messages(fleet, who, number), notified, given_to, _me(who)
    )


@dataclass(frozen=True, slots=True)
class AlarmDiagnosis:
    """The diagnosis that explains an alarm: the present one, or the one when the alarm ended.

    ``revision`` is that at the end, 0 while the alarm is active. ``later`` is the present diagnosis
    if other hypotheses lead by now, since ``since``.
    """

    card: DiagnosisCard | None = None
    may: bool = False
    revision: int = 0
    later: DiagnosisCard | None = None
    since: str = ""


def diagnosis_of(fleet: Services, who: Caller, line: AlarmLine) -> AlarmDiagnosis:
    """Return the diagnosis that explains an alarm, and whether the caller may answer its tests."""
    robot = _robot(fleet, who, line.window.robot) if line.diagnosis else None
    if robot is None or not who.may("diagnoses.read", robot):
        return AlarmDiagnosis()
    try:
        if line.active:
            card = card_now(
                fleet, look(fleet, robot.id, line.diagnosis), current_status(fleet, robot)
            )
            return AlarmDiagnosis(card, who.may("diagnoses.write", robot))
        return _explained_then(fleet, robot.id, line)
    except HTTPException:  # the diagnosis may arrive later
        return AlarmDiagnosis()


def _explained_then(fleet: Services, robot: str, line: AlarmLine) -> AlarmDiagnosis:
    end_ns = ns_of(line.cleared or line.changed)
    then = view_diagnosis_at(fleet, robot, line.diagnosis, line.diagnosis_revision, end_ns)
    assert then.known is not None
    card, last = card_now(fleet, then), then.known.last
    now = look(fleet, robot, line.diagnosis)
    since_ns = now.known.differs_since(last) if now.known else None
    if since_ns is None:
        return AlarmDiagnosis(card, revision=last.revision)
    later = card_now(fleet, now)
    return AlarmDiagnosis(card, False, last.revision, later if later.state == "open" else None,
                     format_time(since_ns))  # fmt: skip


def links_of(line: AlarmLine, card: DiagnosisCard | None, now: str) -> AlarmLinks:
    """Return the links of an alarm; its data are the variables in the reasons of its diagnosis."""
    if not line.window.robot:
        return AlarmLinks("", "")
    hrefs = [reason.href for reason in card.why] if card else []
    names = [name for href in hrefs for name in parse_qs(urlsplit(href).query).get("v", ())]
    robot, to = line.window.robot, line.window.to or now
    timeline = f"/robots/{quote(robot, safe='')}#timeline"
    return AlarmLinks(data_href(robot, line.window.from_, to, names), timeline)


def _item(
    words: AlarmTexts, alarm: Alarm, about: list[RowMapping], suffering: Sequence[RowMapping],
    *, may: bool,
) -> AlarmItem:  # fmt: skip
    return _of_line(words, alarm_line(alarm, about), suffering, may=may)


def _of_line(
    words: AlarmTexts, line: AlarmLine, suffering: Sequence[RowMapping], *, may: bool
) -> AlarmItem:
    robot = line.window.robot
    parts = [
        AffectedComponent(
            words.part(robot, row["component"]), row["level"], row["reason"],
            format_time(row["from_ns"]), maybe_time(row["to_ns"]),
            "" if row["to_ns"] is None else lasted_ns(row["from_ns"], row["to_ns"]),
        )
        for row in suffering
    ]  # fmt: skip
    return AlarmItem(
        line, words.what(line), words.title(line), words.cause(line), _lasted(line), parts, may
    )


def _lasted(line: AlarmLine) -> str:
    if line.active:
        return ""
    ends = line.cleared or (line.resolved.at if line.resolved else None) or line.changed
    return lasted_ns(ns_of(line.opened), ns_of(ends))


def _suffering(
    connection: Connection, numbers: Sequence[int]
) -> Mapping[int, Sequence[RowMapping]]:
    chosen = select(CONSEQUENCE).where(CONSEQUENCE.c.alarm.in_(list(numbers)))
    found: dict[int, list[RowMapping]] = {}
    ordered = chosen.order_by(CONSEQUENCE.c.from_ns, CONSEQUENCE.c.component)
    for row in connection.execute(ordered).mappings():
        found.setdefault(row["alarm"], []).append(row)
    return found


def _names(connection: Connection, who: Caller, action: str) -> frozenset[str] | _All:
    """Return the robots on which the caller may do an action; all for an unrestricted caller."""
    if who.principal.groups is None:
        return _All(who.may(action))
    return frozenset(robot.id for robot in who.robots(connection, action))


@dataclass(frozen=True, slots=True)
class _All:
    """The set of all robots, removed ones too; or the empty set."""

    allowed: bool

    def __contains__(self, robot: object) -> bool:
        return self.allowed


def _may(who: Caller, about: Sequence[RowMapping], mine: frozenset[str] | _All) -> bool:
    """Return whether the caller may change an alarm: every robot in it, as the API requires."""
    return all(row["robot"] in mine for row in about)


def _people(connection: Connection, about: Sequence[str]) -> list[str]:
    """Return the names of those who may change an alarm about some robots."""
    robots = [one for one in list_robots(connection) if one.id in about]
    return [
        user.name for user in list_users(connection)
        if user.disabled_ns is None and user.role.covers(Role.OPERATOR)
        and all(user.groups is None or user.groups & frozenset(one.groups) for one in robots)
    ]  # fmt: skip


def notified_count(connection: Connection, number: int) -> int:
    """Count the messages about an alarm."""
    counted = select(func.count()).where(OUTBOX.c.alarm == number)
    return int(connection.execute(counted).scalar_one())


def _messages(fleet: Services, who: Caller, number: int) -> list[Notification]:
    return list_notifications(fleet, alarm=number) if who.may("settings.write") else []


def _robot(fleet: Services, who: Caller, name: str) -> KnownRobot | None:
    with fleet.database.reading() as connection:
        return next((one for one in who.robots(connection) if one.id == name), None)


def _me(who: Caller) -> str:
    """Return the caller's own name; empty for a program, which cannot own an alarm."""
    return who.principal.id if who.principal.kind == "user" else ""


routes = PageRoutes()

PERIODS = ("now-1h", "now-24h", "now-7d", "now-30d")
"""Periods to choose from; any other can be given in the address."""
_MOST = 1_000

Text = Annotated[str, Query(max_length=128)]
Name = Annotated[str, Query(max_length=64)]


def list_query(
    state: Tab = "open", q: Text = "", robot: Name = "", team: Name = "",
    severity: Severity = "warning",
    since: Annotated[TimeText, Query(alias="from")] = "",
    until: Annotated[TimeText, Query(alias="to")] = "",
    sort: Sort = "worst", n: Annotated[int, Query(ge=1, le=_MOST)] = STEP,
) -> AlarmListQuery:  # fmt: skip
    """Return the query of the list from the address."""
    return AlarmListQuery(state, q.strip(), robot, team, severity, since, until, sort, n)


Looked = Annotated[AlarmListQuery, Depends(list_query)]


@routes.get("/alarms", "alarms.read", each=True)
def show(request: Request, fleet: Fleet, who: Who, look: Looked) -> Response:
    """Show the list of alarms, by state."""
    return render(request, "alarms/alarms.html", **_listed(fleet, who, look))


@routes.get("/pieces/alarms", "alarms.read", each=True)
def show_list(request: Request, fleet: Fleet, who: Who, look: Looked) -> Response:
    """Return the fragment with the list of alarms."""
    return render(request, "alarms/list.html", **_listed(fleet, who, look))


@routes.get("/pieces/alarm-count", "alarms.read", each=True)
def show_count(request: Request) -> Response:
    """Return the fragment with the number of open alarms."""
    return render(request, "alarms/count.html")


@routes.get("/alarms/{id}", "alarms.read", each=True)
def show_one(request: Request, fleet: Fleet, who: Who, id: AlarmNumber) -> Response:
    """Show one alarm in detail, with the diagnosis that explains it."""
    more = ("alarms", "diagnosis")
    return render(request, "alarms/alarm.html", strings=more, **_all_of(fleet, who, id))


@routes.get("/pieces/alarms/{id}", "alarms.read", each=True)
def show_parts(request: Request, fleet: Fleet, who: Who, id: AlarmNumber) -> Response:
    """Return the fragment of an alarm's page that changes."""
    return render(request, "alarms/alarm_parts.html", **_all_of(fleet, who, id))


def _all_of(fleet: Services, who: Caller, number: int) -> Mapping[str, Any]:
    shown = alarm_details(fleet, who, number)
    explained = diagnosis_of(fleet, who, shown.item.line)
    links = links_of(shown.item.line, explained.card, format_time(fleet.clock.wall_ns()))
    return {"shown": shown, "explained": explained, "card": explained.card, "links": links}


def _listed(fleet: Services, who: Caller, look: AlarmListQuery) -> Mapping[str, Any]:
    since_ns, until_ns = (
        query_time_ns(look.since, fleet.clock),
        query_time_ns(look.until, fleet.clock),
    )
    with fleet.database.reading() as connection:
        known = who.robots(connection, "alarms.read")
        every = who.principal.groups is None
        seen = None if every else frozenset(robot.id for robot in known)
        wanted = AlarmSearch(look, _robots(connection, who, look, seen), seen, since_ns, until_ns)
        answer = found(connection, wanted)
        shown = alarm_items(connection, fleet, who, answer.alarms)
    return {
        "look": look, "items": shown, "counts": answer.counts, "tabs": TABS,
        "periods": PERIODS, "more": answer.counts[look.state] > len(shown) and look.n < _MOST,
        "robots": [robot.id for robot in known], "step": STEP,
        "teams": sorted({group for robot in known for group in robot.groups}),
        "may": any(item.may for item in shown),
    }  # fmt: skip


def _robots(
    connection: Connection, who: Caller, look: AlarmListQuery, seen: frozenset[str] | None
) -> frozenset[str] | None:
    """Return the robots whose alarms are wanted; None for all."""
    if not look.robot and not look.team:
        return seen
    return frozenset(
        robot.id for robot in who.robots(connection, "alarms.read")
        if look.robot in ("", robot.id) and (not look.team or look.team in robot.groups)
    )  # fmt: skip


_SHELVED = re.compile(r"until (\d{4}-\d\d-\d\dT[\d:]+Z): (.*)", re.DOTALL)
_WORSE = re.compile(r"(\w+) -> (\w+)")
_OVER = "over"
_UNDESCRIBED = "not in the FMEA"
_NAMED = 2
"""Maximum number of causes that are named if they cannot be distinguished."""
_NO_FAULTS = ("false_alarm", "other")
_LIKELY = tuple(word for least, word in CONFIDENCE_WORDS if least >= LIKELY)
_SURE = re.compile(rf" \(({'|'.join(word for _, word in CONFIDENCE_WORDS)})\)$")
_FAULT = re.compile(r"([^\s#()]+)#([^\s#()]+)")
"""A component and how it fails, as robots name a cause."""


@dataclass(frozen=True, slots=True)
class AlarmTexts:
    """The texts of alarms, with the names of components."""

    fleet: Services
    folders: Mapping[str, str] = field(default_factory=dict)
    _names: dict[str, Mapping[str, str]] = field(default_factory=dict)

    def part(self, robot: str, component: str) -> str:
        """Return the name of a component."""
        if robot not in self._names:
            self._names[robot] = self._names_of(robot)
        return self._names[robot].get(component) or readable(component)

    def _names_of(self, robot: str) -> Mapping[str, str]:
        """Return the names of the components of a robot that have one beside their id."""
        facts = self.fleet.feed.state.cards.facts.known(robot, self.folders.get(robot, ""))
        named = facts.components if facts else ()
        return {one.id: capitalize(one.name) for one in named if one.name not in ("", one.id)}

    def what(self, line: AlarmLine) -> str:
        """Return the subject of an alarm: a component, or what offline robots have in common."""
        if line.kind == "robot":
            return self.part(line.window.robot, line.origin)
        return readable(line.origin)

    def title(self, line: AlarmLine) -> str:
        """Return the title: the cause where it is known, else the checks that fail."""
        causes = line.explained.causes if line.explained else ()
        if causes and all(one.kind == "fault" for one in causes):
            return _either([capitalize(one.text) for one in causes])
        if line.kind == "robot":
            return checks_fail(self.what(line), line.reason)
        if not line.reason:
            return self.what(line)
        return line.reason if line.origin == CONNECTION else f"{self.what(line)}: {line.reason}"

    def cause(self, line: AlarmLine) -> str:
        """Return the cause by the diagnosis, in words; empty if it is not known."""
        if line.explained is None or not line.explained.causes:
            return self.plain(line, line.cause) if line.cause else ""
        explained = line.explained
        kinds = {kind: catalogue().text(f"diagnosis.card.{kind}") for kind in _NO_FAULTS}
        names = [kinds.get(one.kind) or capitalize(one.text) for one in explained.causes]
        word = sure_word(len(names), explained.probability)
        return catalogue().text("alarms.cause_sure", name=_either(names), word=word,
                                share=percent(explained.probability))  # fmt: skip

    def plain(self, line: AlarmLine, cause: str) -> str:
        """Return a cause as the robot reported it, with component and failure mode in words."""
        robot, known = line.window.robot, line.explained.names if line.explained else {}

        def named(found: re.Match[str]) -> str:
            text = known.get(found[0])
            return text or f"{self.part(robot, found[1])}: {found[2].replace('_', ' ')}"

        shown = _FAULT.sub(named, cause).replace(
            _UNDESCRIBED, catalogue().text("alarms.cause_other")
        )
        sure = _SURE.search(shown)
        if sure is None:
            return capitalize(shown)
        count = cause.count(" or ") + 1
        word = sure_word(count, 1.0 if sure[1] in _LIKELY else 0.0)
        return capitalize(f"{shown[: sure.start()]} ({word})")


def sure_word(count: int, probability: float) -> str:
    """Return the word for the certainty of a cause; one word for several causes."""
    if count > 1:
        return catalogue().text("alarms.sure.cannot_tell_apart")
    return catalogue().text(
        "alarms.sure.likely" if probability >= LIKELY else "alarms.sure.possible"
    )


def alarm_texts(connection: Connection, fleet: Services) -> AlarmTexts:
    """Return the texts of alarms by the present folders of all robots."""
    return AlarmTexts(fleet, {one.robot: one.config_hash for one in presences(connection)})


def _either(names: Sequence[str]) -> str:
    """Return alternative names as one text: all of them joined, or the first and how many more."""
    text = catalogue().text
    first, *more = names
    if len(names) > _NAMED:
        return text("alarms.or_others", name=first, n=len(names) - 1)
    return text("alarms.or").join([first, *(one[:1].lower() + one[1:] for one in more)])


@dataclass(frozen=True, slots=True)
class AlarmHistoryLine:
    """A line of the history: event, text and, if shelved, until when."""

    at: str
    who: str
    what: str
    text: str = ""
    until: str = ""


def events(
    history: list[Happening], words: AlarmTexts, line: AlarmLine
) -> Iterator[AlarmHistoryLine]:
    """Yield the history of an alarm in words, newest first."""
    for one in reversed(history):
        text, until = _happening_text(one, words, line)
        yield AlarmHistoryLine(one.at, one.who, _what(one), text, until)


def lasted_ns(from_ns: int, to_ns: int) -> str:
    """Return the time between two instants as text."""
    return span((to_ns - from_ns) / NS)


def _what(one: Happening) -> str:
    texts = catalogue().texts
    key = f"alarms.event.{one.what}"
    own = f"{key}_by_itself" if not one.who else ""
    return texts.get(own) or texts.get(key) or one.what


def _happening_text(one: Happening, words: AlarmTexts, line: AlarmLine) -> tuple[str, str]:
    """Return the text of a line of the history, and until when an alarm is shelved."""
    text = catalogue().text
    shelved, worse = _SHELVED.fullmatch(one.text), _WORSE.fullmatch(one.text)
    if one.what == "shelved" and shelved:
        return shelved[2], shelved[1]
    if one.what in ("worse", "effect") and worse and worse[2] in SEVERITIES:
        return text(f"words.severity_{worse[2]}.name"), ""
    if one.what == "cause":
        return words.plain(line, one.text) if one.text else "", ""
    if one.what == "notified":
        return text("alarms.event.notified_as", severity=one.text), ""
    if one.what == "resolved" and not one.who:
        return one.text.removeprefix(_OVER).removeprefix(", "), ""
    return one.text, ""
