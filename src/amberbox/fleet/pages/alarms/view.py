"""What the pages of alarms show: lines of the list, and all of one alarm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from urllib.parse import parse_qs, quote, urlsplit

from fastapi import HTTPException
from sqlalchemy import Connection, RowMapping, func, select

from amberbox.core.timetext import format_time, ns_of
from amberbox.fleet.accounts.actions import Role
from amberbox.fleet.accounts.robots import KnownRobot, list_robots
from amberbox.fleet.accounts.users import list_users
from amberbox.fleet.alarms import listing
from amberbox.fleet.alarms.alarm import Alarm
from amberbox.fleet.alarms.offline import CONNECTION
from amberbox.fleet.alarms.tables import CONSEQUENCE
from amberbox.fleet.api.access import Caller
from amberbox.fleet.api.alarmlines import AlarmLine, line_of
from amberbox.fleet.api.alarms import show_alarm
from amberbox.fleet.api.forms import shown
from amberbox.fleet.api.notifications import Notification, list_notifications
from amberbox.fleet.api.robots import known_now
from amberbox.fleet.notifying.tables import OUTBOX
from amberbox.fleet.pages.alarms.wording import Event, Words, events, lasted_ns, words_of
from amberbox.fleet.pages.datalinks import data_href
from amberbox.fleet.pages.diagnosis.card import DiagnosisCard
from amberbox.fleet.pages.diagnosis.look import card_now, look, look_then
from amberbox.fleet.services import Services


@dataclass(frozen=True, slots=True)
class Suffering:
    """A part that suffers from the root of an alarm; ``lasted`` is empty while it does."""

    part: str
    level: str
    reason: str
    since: str
    until: str | None
    lasted: str


@dataclass(frozen=True, slots=True)
class Item:
    """An alarm as people read it; ``lasted`` is empty while it lasts.

    ``may``: whether the caller may change it.
    """

    line: AlarmLine
    what: str
    title: str
    cause: str
    lasted: str
    suffering: Sequence[Suffering]
    may: bool

    @property
    def small(self) -> str:
        """Return the robot's own words, where the title does not say them already."""
        reason = self.line.reason
        if self.is_cause and self.has_part:
            return f"{self.what}: {reason}" if reason else self.what
        return "" if reason in self.title else reason

    @property
    def is_cause(self) -> bool:
        """Tell whether the title says the cause, as far as one is known."""
        return bool(self.cause) and self.cause.startswith(self.title)

    @property
    def sure(self) -> str:
        """Return how sure the cause is that the title says; empty for another title."""
        return self.cause.removeprefix(self.title).strip(" ()") if self.is_cause else ""

    @property
    def has_part(self) -> bool:
        """Tell whether it is about a part, or something that robots which are away share."""
        return self.line.kind == "robot" or self.line.origin != CONNECTION

    @property
    def is_choosable(self) -> bool:
        """Tell whether the caller could acknowledge it."""
        return self.may and self.line.state == "open" and self.line.merged_into is None


@dataclass(frozen=True, slots=True)
class Links:
    """Where one goes on from an alarm; empty is nowhere."""

    data: str
    timeline: str


@dataclass(frozen=True, slots=True)
class Whole:
    """All of one alarm. ``people`` are those it can be given to, by whoever may change it.

    ``told`` counts the messages. ``others``: the caller may not change it because it is about
    robots of others, too.
    """

    item: Item
    others: bool
    events: Sequence[Event]
    messages: Sequence[Notification]
    told: int
    people: Sequence[str]
    me: str


def items(
    connection: Connection, fleet: Services, who: Caller, alarms: Sequence[Alarm]
) -> list[Item]:
    """Return alarms as people read them, of their robots those that the caller may see."""
    words = words_of(connection, fleet)
    numbers = [alarm.number for alarm in alarms]
    about = listing.robots_of(connection, numbers)
    suffering = _suffering(connection, numbers)
    seen = _names(connection, who, "alarms.read")
    mine = _names(connection, who, "alarms.write")
    return [
        _item(words, alarm, [row for row in about[alarm.number] if row["robot"] in seen],
              suffering.get(alarm.number, ()), may=_may(who, about[alarm.number], mine))
        for alarm in alarms
    ]  # fmt: skip


def whole(fleet: Services, who: Caller, number: int) -> Whole:
    """Return all of one alarm; raises 404 for one that is not there, or not for the caller."""
    page = show_alarm(fleet, who, number)
    with fleet.database.reading() as connection:
        words = words_of(connection, fleet)
        rows = _suffering(connection, [number]).get(number, ())
        about = listing.robots_of(connection, [number])[number]
        mine = _names(connection, who, "alarms.write")
        people = _people(connection, [row["robot"] for row in about])
        told = _told(connection, number)
    may = _may(who, about, mine)
    others = not may and any(row["robot"] in mine for row in about)
    item = _of_line(words, page.alarm, rows, may=may)
    history = [one for one in page.history if told or one.what != "notified"]
    said = list(events(history, words, page.alarm))
    given_to = people if may else []
    return Whole(item, others, said, _messages(fleet, who, number), told, given_to, _me(who))


@dataclass(frozen=True, slots=True)
class Explained:
    """The diagnosis that explains an alarm: as it stands, or as it was when the alarm ended.

    ``revision`` is that of then, 0 while it lasts. ``later`` is what the robot says is broken by
    now, since ``since``, if that is something else.
    """

    card: DiagnosisCard | None = None
    may: bool = False
    revision: int = 0
    later: DiagnosisCard | None = None
    since: str = ""


def diagnosis_of(fleet: Services, who: Caller, line: AlarmLine) -> Explained:
    """Return the diagnosis that explains an alarm, and whether one may answer its tests."""
    robot = _robot(fleet, who, line.window.robot) if line.diagnosis else None
    if robot is None or not who.may("diagnoses.read", robot):
        return Explained()
    try:
        if line.active:
            card = card_now(fleet, look(fleet, robot.id, line.diagnosis), known_now(fleet, robot))
            return Explained(card, who.may("diagnoses.write", robot))
        return _explained_then(fleet, robot.id, line)
    except HTTPException:  # what the robot found may come after its alarm
        return Explained()


def _explained_then(fleet: Services, robot: str, line: AlarmLine) -> Explained:
    end_ns = ns_of(line.cleared or line.changed)
    then = look_then(fleet, robot, line.diagnosis, line.diagnosis_revision, end_ns)
    assert then.known is not None
    card, last = card_now(fleet, then), then.known.last
    now = look(fleet, robot, line.diagnosis)
    since_ns = now.known.differs_since(last) if now.known else None
    if since_ns is None:
        return Explained(card, revision=last.revision)
    later = card_now(fleet, now)
    return Explained(card, False, last.revision, later if later.state == "open" else None,
                     format_time(since_ns))  # fmt: skip


def links_of(line: AlarmLine, card: DiagnosisCard | None, now: str) -> Links:
    """Return the links of an alarm; its data show what its diagnosis looked at."""
    if not line.window.robot:
        return Links("", "")
    hrefs = [reason.href for reason in card.why] if card else []
    names = [name for href in hrefs for name in parse_qs(urlsplit(href).query).get("v", ())]
    robot, to = line.window.robot, line.window.to or now
    timeline = f"/robots/{quote(robot, safe='')}#timeline"
    return Links(data_href(robot, line.window.from_, to, names), timeline)


def _item(
    words: Words, alarm: Alarm, about: list[RowMapping], suffering: Sequence[RowMapping],
    *, may: bool,
) -> Item:  # fmt: skip
    return _of_line(words, line_of(alarm, about), suffering, may=may)


def _of_line(words: Words, line: AlarmLine, suffering: Sequence[RowMapping], *, may: bool) -> Item:
    robot = line.window.robot
    parts = [
        Suffering(
            words.part(robot, row["component"]), row["level"], row["reason"],
            format_time(row["from_ns"]), shown(row["to_ns"]),
            "" if row["to_ns"] is None else lasted_ns(row["from_ns"], row["to_ns"]),
        )
        for row in suffering
    ]  # fmt: skip
    return Item(line, words.what(line), words.title(line), words.cause(line), _lasted(line), parts,
                may)  # fmt: skip


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
    """Return the robots to which an action is allowed; of who is not restricted all there were."""
    if who.principal.groups is None:
        return _All(who.may(action))
    return frozenset(robot.id for robot in who.robots(connection, action))


@dataclass(frozen=True, slots=True)
class _All:
    """All robots, those that are removed too; or none."""

    allowed: bool

    def __contains__(self, robot: object) -> bool:
        return self.allowed


def _may(who: Caller, about: Sequence[RowMapping], mine: frozenset[str] | _All) -> bool:
    """Tell whether the caller may change alarms of every robot in it, as the API asks for."""
    return all(row["robot"] in mine for row in about)


def _people(connection: Connection, about: Sequence[str]) -> list[str]:
    """Return whom an alarm about some robots can be given to: who may change it."""
    robots = [one for one in list_robots(connection) if one.id in about]
    return [
        user.name for user in list_users(connection)
        if user.disabled_ns is None and user.role.covers(Role.OPERATOR)
        and all(user.groups is None or user.groups & frozenset(one.groups) for one in robots)
    ]  # fmt: skip


def _told(connection: Connection, number: int) -> int:
    """Count the messages about an alarm; without destinations there are none."""
    counted = select(func.count()).where(OUTBOX.c.alarm == number)
    return int(connection.execute(counted).scalar_one())


def _messages(fleet: Services, who: Caller, number: int) -> list[Notification]:
    return list_notifications(fleet, alarm=number) if who.may("settings.write") else []


def _robot(fleet: Services, who: Caller, name: str) -> KnownRobot | None:
    with fleet.database.reading() as connection:
        return next((one for one in who.robots(connection) if one.id == name), None)


def _me(who: Caller) -> str:
    """Return one's own name; a program has none that an alarm could be given to."""
    return who.principal.id if who.principal.kind == "user" else ""
