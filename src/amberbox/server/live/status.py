"""The status of each robot: newest missions and diagnoses, open alarms, and the worst level."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import msgspec
from sqlalchemy import ColumnElement, Connection, Row, and_, select

from amberbox.blackbox.journal import channels
from amberbox.core.robot_status import (
    NOT_MONITORED,
    SEVERITIES,
    Contact,
    Observed,
    RobotStatus,
    Severity,
    components_level,
    highest,
    judge,
    severity_rank,
)
from amberbox.core.types import Level
from amberbox.link.frames import LinkRow as frames_Row
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.derived import RecordStores, derived_records
from amberbox.server.ingest.link_server import LinkServer, RobotConnection
from amberbox.server.ingest.link_state import RobotPresence, presences
from amberbox.server.knowledge.diagnoses import SymptomInterval, gone_since, next_interval
from amberbox.server.live.records import (
    DiagnosisRecord,
    MissionRecord,
    RetainedStatus,
    ServerNow,
    StatusRecord,
    SymptomRecord,
    clock_offsets_ns,
    decode_record,
    monitoring_of,
    retained_statuses,
    silence,
)
from amberbox.server.schema import ALARM, ALARM_ROBOT


def is_open() -> ColumnElement[bool]:
    """Return the condition for alarms that count as open: neither acknowledged nor merged.

    All pages use it for the number of open alarms and for the list behind that number.
    """
    return and_(ALARM.c.state == "open", ALARM.c.merged_into.is_(None))


@dataclass(frozen=True, slots=True)
class OpenAlarms:
    """Open alarms of a robot, not acknowledged by anybody; ``over`` of them are no longer active.

    ``severity`` is the highest of the active alarms, acknowledged or not; empty without any.
    ``lasting`` and ``reason`` are those of the worst active alarm from the robot's monitors, so
    that an alarm about the robot's absence does not count.
    """

    count: int = 0
    over: int = 0
    severity: Severity | Literal[""] = ""
    lasting: Severity | Literal[""] = ""
    reason: str = ""


def open_alarms(connection: Connection) -> dict[str, OpenAlarms]:
    """Return the alarms by robot; an alarm about several robots counts for each."""
    lasts = and_(ALARM.c.active, ALARM_ROBOT.c.to_ns.is_(None)).label("lasts")
    wanted = (
        select(ALARM_ROBOT.c.robot, ALARM.c.severity, ALARM.c.state, ALARM.c.kind,
               ALARM.c.origin, ALARM.c.reason, lasts)
        .join(ALARM, ALARM.c.number == ALARM_ROBOT.c.alarm)
        .where(is_open() | and_(ALARM.c.state == "acknowledged", ALARM.c.merged_into.is_(None)))
        .order_by(ALARM.c.number)
    )  # fmt: skip
    found: dict[str, OpenAlarms] = {}
    for row in connection.execute(wanted):
        found[row.robot] = _with(found.get(row.robot, OpenAlarms()), row)
    return found


def _with(known: OpenAlarms, row: Row[Any]) -> OpenAlarms:
    """Add an alarm to those of a robot."""
    is_new = row.state == "open"
    if not row.lasts:
        return replace(known, count=known.count + is_new, over=known.over + is_new)
    worst = highest((known.severity, row.severity))
    known = replace(known, count=known.count + is_new, severity=worst)
    if row.kind != "robot" or severity_rank(row.severity) <= severity_rank(known.lasting):
        return known
    return replace(known, lasting=row.severity, reason=f"{row.origin}: {row.reason}")


# Number of records of each channel that are read at the start
_LOOK_BACK = 200
# Number of missions and diagnoses that are remembered per robot
_KEPT = 200
_KINDS: Mapping[str, type[msgspec.Struct]] = {
    channels.MISSION: MissionRecord,
    channels.DIAGNOSIS: DiagnosisRecord,
    channels.SYMPTOM: SymptomRecord,
}


@dataclass(slots=True)
class RecentRecords:
    """The last records of each mission, diagnosis and symptom, the newest at the end."""

    records: dict[str, dict[str, Any]] = field(
        default_factory=lambda: {channel: {} for channel in _KINDS}
    )
    holds: dict[str, SymptomInterval] = field(default_factory=dict)
    """When each symptom last appeared, and when it was observed to be gone."""
    effects: dict[str, tuple[int, Severity | Literal[""]]] = field(default_factory=dict)
    """What diagnoses leave of the robot, as they were put into words last, with their revisions."""

    def take(self, channel: str, data: bytes) -> None:
        """Add a record."""
        found: Any = decode_record(data, _KINDS[channel])
        if found is not None:
            known = self.records[channel]
            known.pop(found.id, None)
            known[found.id] = found
            if len(known) > _KEPT:
                del known[next(iter(known))]
            if channel == channels.SYMPTOM:
                self._hold(found)

    def _hold(self, symptom: SymptomRecord) -> None:
        hold = next_interval(self.holds.pop(symptom.id, None), symptom)
        if hold is not None:
            self.holds[symptom.id] = hold
            if len(self.holds) > _KEPT:
                del self.holds[next(iter(self.holds))]

    def explain(self, diagnosis: str, revision: int, severity: str) -> None:
        """Store the severity of a diagnosis' effect; an older revision is ignored."""
        known: Severity | Literal[""] = severity if severity in SEVERITIES else ""
        before = self.effects.pop(diagnosis, (revision, known))
        self.effects[diagnosis] = (revision, known) if revision >= before[0] else before
        if len(self.effects) > _KEPT:
            del self.effects[next(iter(self.effects))]

    @property
    def mission(self) -> MissionRecord | None:
        """Return the mission that the robot is on, or None."""
        lasting = [m for m in self.records[channels.MISSION].values() if m.to_ns is None]
        return lasting[-1] if lasting else None

    @property
    def diagnosis(self) -> DiagnosisRecord | None:
        """Return the newest diagnosis of the robot if it is open, else None."""
        known: list[DiagnosisRecord] = list(self.records[channels.DIAGNOSIS].values())
        newest = min(known, key=lambda one: (-one.at_ns, one.id), default=None)
        return newest if newest is not None and newest.state == "open" else None

    @property
    def effect(self) -> Severity | Literal[""]:
        """Return the severity of the open diagnosis' effect; empty where it is not explained."""
        diagnosis = self.diagnosis
        return self.effects[diagnosis.id][1] if diagnosis and diagnosis.id in self.effects else ""

    def gone_ns(self, now_ns: int) -> int | None:
        """Return since when no symptom of the open diagnosis is present (ns, robot's clock), or
        None.
        """
        diagnosis = self.diagnosis
        return None if diagnosis is None else gone_since(diagnosis.symptoms, self.holds, now_ns)


class LatestRecords:
    """``RecentRecords`` of robots; only ``load`` blocks. Threads may share it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: dict[str, RecentRecords] = {}
        self._waiting: dict[str, list[frames_Row]] = {}
        self._early: dict[str, tuple[str, int, str]] = {}

    def of(self, robot: str) -> RecentRecords:
        """Return the recent records of a robot; empty before they were loaded."""
        return self._known.get(robot, RecentRecords())

    def explain(self, robot: str, diagnosis: str, revision: int, severity: str) -> None:
        """Store the severity of a diagnosis' effect."""
        with self._lock:
            if robot in self._known:
                self._known[robot].explain(diagnosis, revision, severity)
            else:
                self._early[robot] = (diagnosis, revision, severity)

    def take(self, robot: str, rows: Sequence[frames_Row]) -> None:
        """Add received rows; those of a robot that is being loaded are added after its past."""
        wanted = [row for row in rows if row.channel in _KINDS]
        if not wanted:
            return
        with self._lock:
            if robot in self._known:
                _add(self._known[robot], ((row.channel, row.data) for row in wanted))
            elif robot in self._waiting:
                self._waiting[robot] += wanted

    def load(self, stores: RecordStores, robot: str) -> None:
        """Load the past records of a robot, once."""
        with self._lock:
            if robot in self._known or robot in self._waiting:
                return
            self._waiting[robot] = []
        recent = RecentRecords()
        try:
            for channel in _KINDS:
                past = derived_records(stores, robot, channel, limit=_LOOK_BACK, newest=True)
                _add(recent, ((channel, msgspec.json.encode(entry.values)) for entry in past))
        except BaseException:
            with self._lock:
                del self._waiting[robot]
            raise
        with self._lock:
            _add(recent, ((row.channel, row.data) for row in self._waiting.pop(robot)))
            if robot in self._early:
                recent.explain(*self._early.pop(robot))
            self._known[robot] = recent


def _add(recent: RecentRecords, records: Iterable[tuple[str, bytes]]) -> None:
    for channel, data in records:
        recent.take(channel, data)


# Up to this number of robots, statuses are queried by name; for more, all are read
FEW = 50


@dataclass(frozen=True, slots=True)
class AssessedRobot:
    """The status of a robot and its inputs.

    ``silence`` is the reason why the present state is unknown, empty if it is known. ``gone_ns`` is
    since when no symptom of the open diagnosis has been present (robot's clock).
    """

    robot: KnownRobot
    status: RobotStatus
    silence: str
    presence: RobotPresence | None
    link: RobotConnection | None
    statuses: Sequence[RetainedStatus]
    when: ServerNow
    alarms: OpenAlarms
    recent: RecentRecords
    gone_ns: int | None


@dataclass(frozen=True, slots=True)
class RobotStatuses:
    """Assesses robots, in one transaction of the database."""

    links: LinkServer
    latest: LatestRecords

    def of(
        self,
        connection: Connection,
        robots: Sequence[KnownRobot],
        now_ns: int,
        statuses: Mapping[str, Sequence[RetainedStatus]] | None = None,
    ) -> list[AssessedRobot]:
        """Return the assessments of robots in order; ``statuses`` if they were read already."""
        names = [robot.id for robot in robots]
        if statuses is None:
            statuses = retained_statuses(connection, names if len(names) <= FEW else None)
        seen = {presence.robot: presence for presence in presences(connection)}
        alarms, offsets = open_alarms(connection), clock_offsets_ns(connection)
        return [
            self._known(
                robot, seen.get(robot.id), statuses.get(robot.id, ()),
                ServerNow(now_ns, offsets.get(robot.id)), alarms.get(robot.id, OpenAlarms()),
            )
            for robot in robots
        ]  # fmt: skip

    def _known(
        self,
        robot: KnownRobot,
        presence: RobotPresence | None,
        statuses: Sequence[RetainedStatus],
        when: ServerNow,
        alarms: OpenAlarms,
    ) -> AssessedRobot:
        link, recent = self.links.robots.get(robot.id), self.latest.of(robot.id)
        contact = _contact(presence, link)
        pulse = link.monitoring if link is not None else None
        monitoring = monitoring_of(statuses, when, pulse)
        delay_s = pulse.delay_s if pulse is not None else 0.0
        gone_ns = recent.gone_ns(when.now_ns - (when.offset_ns or 0))
        is_diagnosed = recent.diagnosis is not None and gone_ns is None
        status = judge(
            Observed(
                contact, monitoring, level_of(statuses), cause_of(worst_of(statuses)),
                alarms.lasting, alarms.reason, is_diagnosed,
                recent.effect if is_diagnosed else "", _as_of(statuses, when),
                delay_s,
            )
        )  # fmt: skip
        why = silence(contact, presence, monitoring, statuses, when, delay_s)
        return AssessedRobot(
            robot, status, why, presence, link, statuses, when, alarms, recent, gone_ns
        )


def level_of(statuses: Sequence[RetainedStatus]) -> Level:
    """Return the worst level of the components; any other text is ``unknown``."""
    return components_level(
        (one.record.known_level, one.record.state) for one in statuses if not one.record.mode
    )


def worst_of(statuses: Sequence[RetainedStatus]) -> StatusRecord | None:
    """Return the worst status of a component; of equally bad ones, one that is not blocked."""
    components = (
        one.record for one in statuses if not one.record.mode and one.record.state != NOT_MONITORED
    )
    return max(components, key=lambda record: (record.rank, not record.blocked_by), default=None)


def cause_of(bad: StatusRecord | None) -> str:
    """Return "component: reason" for a bad status; empty for a good one."""
    if bad is None or bad.level == "ok":
        return ""
    what = bad.reason or bad.state.replace("_", " ") or bad.level
    blocked = f" (blocked by {', '.join(bad.blocked_by)})" if bad.blocked_by else ""
    return f"{bad.component}: {what}{blocked}"


def counts(known: Sequence[AssessedRobot]) -> Mapping[Level, int]:
    """Return the number of robots by level, the worst first, zeros included."""
    levels: tuple[Level, ...] = ("error", "stale", "unknown", "warn", "ok")
    return {level: sum(one.status.level == level for one in known) for level in levels}


def _contact(presence: RobotPresence | None, link: RobotConnection | None) -> Contact:
    if link is not None:
        return "silent" if link.is_silent else "online"
    return "offline" if presence is not None else "never"


def _as_of(statuses: Sequence[RetainedStatus], when: ServerNow) -> str | None:
    newest_ns = max((one.record.measured_ns for one in statuses), default=0)
    return when.at(newest_ns)
