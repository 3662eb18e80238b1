"""Records of robots in the form in which they are shown, and the current statuses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import msgspec
from sqlalchemy import Connection, and_, select

from amberbox.core.clock import NS
from amberbox.core.robot_status import RANK, Contact, Monitoring
from amberbox.core.timestamps import format_time
from amberbox.core.types import Level
from amberbox.monitoring.current_state import WatcherHeartbeat, duration_text, overload_text
from amberbox.server.ingest.link_state import RobotPresence
from amberbox.server.schema import BOOT, ROBOT, STATUS

_RANKS: Mapping[str, int] = dict(RANK.items())
_FIRST_NS, _BEYOND_NS = 1, 2**63
# Largest size in bytes of a record that is shown, so that memory per robot is bounded
LONGEST = 256 << 10
Kind = TypeVar("Kind", bound=msgspec.Struct)


class OutputRecord(msgspec.Struct, frozen=True):
    """One output of a mode."""

    name: str
    type: str = "null"
    value: float | None = None
    text: str | None = None

    @property
    def shown(self) -> bool | int | float | str | None:
        """Return the value; NaN and infinity as text."""
        if self.value is None:
            return self.text
        if self.type == "bool":
            return bool(self.value)
        return int(self.value) if self.type == "int" else self.value


class StatusRecord(msgspec.Struct, frozen=True):
    """One status."""

    component: str
    mode: str = ""
    level: str = "unknown"
    state: str = ""
    outputs: list[OutputRecord] = []
    blocked_by: list[str] = []
    measured_ns: int = 0
    since_ns: int = 0
    reason: str = ""

    @property
    def rank(self) -> int:
        """Return the rank of the level; higher is worse."""
        return rank_of(self.level)

    @property
    def known_level(self) -> Level:
        """Return the level; ``unknown`` for any other text."""
        return self.level if self.level in RANK else "unknown"  # type: ignore[return-value]  # it is one of them


class MissionRecord(msgspec.Struct, frozen=True):
    """The beginning or the end of a mission."""

    id: str
    name: str = ""
    state: str = ""
    outcome: str = ""
    from_ns: int = 0
    to_ns: int | None = None


class HypothesisRecord(msgspec.Struct, frozen=True):
    """One answer of a diagnosis."""

    faults: list[str] = []
    probability: float = 0.0


class DiagnosisRecord(msgspec.Struct, frozen=True):
    """A diagnosis, as far as cards show it."""

    id: str
    revision: int = 0
    at_ns: int = 0
    state: str = ""
    hypotheses: list[HypothesisRecord] = []
    symptoms: list[str] = []


class SymptomRecord(msgspec.Struct, frozen=True):
    """A symptom, with the fields that state whether it is present."""

    id: str
    state: str = ""
    onset_ns: int | None = None
    confirmed_ns: int | None = None


class EventRecord(msgspec.Struct, frozen=True):
    """An event; ``details`` is JSON."""

    kind: str = ""
    text: str = ""
    source: str = ""
    details: str = ""


class ConditionRecord(msgspec.Struct, frozen=True):
    """Level and state."""

    level: str = "unknown"
    state: str = ""


class TransitionRecord(msgspec.Struct, frozen=True):
    """The details of an event of kind ``component_state``."""

    component: str
    mode: str = ""
    before: ConditionRecord = ConditionRecord()
    after: ConditionRecord = ConditionRecord()
    at_ns: int = 0
    reason: str = ""


def rank_of(level: str) -> int:
    """Return the rank of a level, higher is worse; unknown levels rank as ``unknown``."""
    return _RANKS.get(level, RANK["unknown"])


def decode_record(data: bytes | str, kind: type[Kind]) -> Kind | None:
    """Decode a record; None if it has another form or is too long."""
    if len(data) > LONGEST:
        return None
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None


def convert_record(values: Any, kind: type[Kind]) -> Kind | None:
    """Convert a decoded record; None if it has another form."""
    try:
        return msgspec.convert(values, kind, strict=False)
    except (msgspec.MsgspecError, ValueError):
        return None


def format_moment(time_ns: int | None) -> str | None:
    """Return a time as RFC 3339; None for None or a time out of range."""
    if time_ns is None or not _FIRST_NS <= time_ns < _BEYOND_NS:
        return None
    seconds, rest_ns = divmod(time_ns, NS)
    return f"{_second(seconds)}.{rest_ns:09}Z"


@lru_cache(maxsize=4096)
def _second(seconds: int) -> str:
    """Return a whole second as text; cached, since statuses share it."""
    return format_time(seconds * NS).partition(".")[0]


def status_data(record: StatusRecord) -> Mapping[str, Any]:
    """Return a status in the form of API and feed; times by the robot's clock."""
    return {
        "component": record.component,
        "mode": record.mode,
        "level": record.level,
        "state": record.state,
        "reason": record.reason,
        "blocked_by": record.blocked_by,
        "measured": format_moment(record.measured_ns),
        "since": format_moment(record.since_ns),
        "outputs": {output.name: output.shown for output in record.outputs},
    }


# The watcher sends all statuses each second; a bad network may delay them
SILENT_NS = 10 * NS
# A status this much older than the newest belongs to a component that is no longer watched
_ROUND_NS = 5 * NS


@dataclass(frozen=True, slots=True)
class RetainedStatus:
    """A status, and when it was written (robot's clock) and received (server's clock)."""

    record: StatusRecord
    log_ns: int
    received_ns: int


@dataclass(frozen=True, slots=True)
class ServerNow:
    """The server's present time, and how far its clock is ahead of the robot's, if known."""

    now_ns: int
    offset_ns: int | None

    def age_ns(self, status: RetainedStatus) -> int:
        """Return the age of a measurement in nanoseconds.

        Sum of differences on one clock each: since receipt, and from measurement to writing on the
        robot. Only the delay of the link compares two clocks, by their offset.
        """
        since_ns = max(self.now_ns - status.received_ns, 0)
        robot_ns = (
            max(status.log_ns - status.record.measured_ns, 0) if status.record.measured_ns else 0
        )
        way_ns = 0
        if self.offset_ns is not None:
            way_ns = max(status.received_ns - status.log_ns - self.offset_ns, 0)
        return since_ns + way_ns + robot_ns

    def at(self, robot_ns: int) -> str | None:
        """Return a time of the robot by the server's clock, as RFC 3339."""
        return format_moment(robot_ns + (self.offset_ns or 0)) if robot_ns else None


def retained_statuses(
    connection: Connection, robots: Sequence[str] | None = None
) -> dict[str, list[RetainedStatus]]:
    """Return the newest statuses by robot, of all robots or of some, ordered by name."""
    wanted = select(STATUS).order_by(*STATUS.primary_key.columns)
    if robots is not None:
        wanted = wanted.where(STATUS.c.robot.in_(robots))
    found: dict[str, list[RetainedStatus]] = {}
    for row in connection.execute(wanted):
        record = decode_record(row.data, StatusRecord)
        if record is not None:
            one = RetainedStatus(record, row.log_ns, row.received_ns)
            found.setdefault(row.robot, []).append(one)
    return {robot: _watched(statuses) for robot, statuses in found.items()}


def _watched(statuses: Sequence[RetainedStatus]) -> list[RetainedStatus]:
    newest_ns = max(status.log_ns for status in statuses)
    return [status for status in statuses if status.log_ns >= newest_ns - _ROUND_NS]


def clock_offsets_ns(connection: Connection, robots: Sequence[str] | None = None) -> dict[str, int]:
    """Return how far the server's clock is ahead of robots' in their present boots (ns)."""
    same = and_(BOOT.c.robot == ROBOT.c.robot, BOOT.c.boot_id == ROBOT.c.boot_id)
    wanted = select(BOOT.c.robot, BOOT.c.offset_ns).join(ROBOT, same)
    if robots is not None:
        wanted = wanted.where(BOOT.c.robot.in_(robots))
    return {row.robot: row.offset_ns for row in connection.execute(wanted)}


def monitoring_of(
    statuses: Sequence[RetainedStatus], when: ServerNow, pulse: WatcherHeartbeat | None = None
) -> Monitoring:
    """Return the state of a robot's monitoring from its statuses.

    ``pulse`` is the watcher's state from the link's heartbeat: an overloaded watcher is late, not
    silent.
    """
    if not statuses:
        return "absent"
    if pulse is not None and pulse.state == "overloaded":
        return "overloaded"
    return "running" if _newest_ns(statuses, when) <= SILENT_NS else "silent"


def silence(
    contact: Contact,
    presence: RobotPresence | None,
    monitoring: Monitoring,
    statuses: Sequence[RetainedStatus],
    when: ServerNow,
    delay_s: float = 0.0,
) -> str:
    """Return why the present state of a robot is unknown; empty where it is known.

    ``delay_s`` is how late an overloaded watcher evaluates.
    """
    if contact == "never" or presence is None:
        return "it has never connected"
    if contact != "online":
        seen = duration_text(when.now_ns - presence.last_seen_ns)
        return f"{'offline' if contact == 'offline' else 'silent'}, last seen {seen} ago"
    if monitoring == "absent":
        return "it has said nothing of its components yet"
    if monitoring == "overloaded":
        return overload_text(delay_s)
    if monitoring != "silent":
        return ""
    silent_ns = when.now_ns - max(status.received_ns for status in statuses)
    if silent_ns > SILENT_NS:
        return f"its watcher has said nothing for {duration_text(silent_ns)}"
    return f"what it says is {duration_text(_newest_ns(statuses, when))} old"


def _newest_ns(statuses: Sequence[RetainedStatus], when: ServerNow) -> int:
    """Return the time since the last status, or its age if that is more (ns)."""
    silent_ns = when.now_ns - max(status.received_ns for status in statuses)
    return max(silent_ns, min(when.age_ns(status) for status in statuses))
