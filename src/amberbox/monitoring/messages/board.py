"""What is known of a robot now: the newest statuses and the open alarms, as its watcher wrote them.

When the watcher is dead or silent nothing is known: every level is then ``unknown``, whatever was
said last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from amberbox.blackbox.follow.newest import newest_records
from amberbox.blackbox.follow.records import OwnRecords
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.store import Store, is_locked
from amberbox.core.clock import NS
from amberbox.core.robotstatus import (
    Monitoring,
    Observed,
    RobotStatus,
    components_level,
    judge,
    severity_rank,
)
from amberbox.core.timetext import format_time
from amberbox.core.types import Status
from amberbox.monitoring.engine.findings import AlarmChange
from amberbox.monitoring.messages.pulse import Pulse, monitoring_of
from amberbox.monitoring.messages.records import alarm_of, status_of

WRITER = "watch"
SILENT_NS = 3 * NS
"""The watcher writes all statuses every second; nothing is believed that is older than this."""
_ROUND_NS = 5 * NS // 2
"""A status that is this much older than the newest is of something that is watched no more."""
_LOOKBACK_S = 4.0


@dataclass(frozen=True, slots=True)
class Board:
    """The newest of each status and alarm; ``silence`` says why nothing is known, if so.

    ``monitoring`` is how the watcher is doing; None where nobody can tell.
    """

    statuses: Sequence[Status] = ()
    alarms: Sequence[AlarmChange] = ()
    measured_ns: int = 0
    silence: str = ""
    monitoring: Pulse | None = None

    @property
    def status(self) -> RobotStatus:
        """The status of the robot as a whole, as the server makes it of the same."""
        alarms = [alarm for alarm in self.alarms if alarm.state in ("open", "acknowledged")]
        worst_alarm = max(alarms, key=lambda one: severity_rank(one.severity), default=None)
        return judge(
            Observed(
                monitoring=self._monitoring,
                level=components_level(
                    (status.level, status.state) for status in self.components.values()
                ),
                alarm=worst_alarm.severity if worst_alarm else "",
                alarm_reason=f"{worst_alarm.component}: {worst_alarm.reason}"
                if worst_alarm
                else "",
                as_of=format_time(self.measured_ns) if self.measured_ns else None,
                delay_s=self.monitoring.delay_s if self.monitoring else 0.0,
            )
        )

    @property
    def _monitoring(self) -> Monitoring:
        if not self.statuses:
            return "absent"
        if self.monitoring is not None and self.monitoring.state == "overloaded":
            return "overloaded"
        return "silent" if self.silence else "running"

    @property
    def robot(self) -> str:
        """The robot that it is about; empty if nothing was ever said."""
        return self.statuses[0].robot if self.statuses else ""

    @property
    def components(self) -> dict[str, Status]:
        """The statuses of components, by id."""
        return {status.component: status for status in self.statuses if not status.mode}

    def modes_of(self, component: str) -> list[Status]:
        """Return the statuses of a component's modes."""
        return [s for s in self.statuses if s.mode and s.component == component]


def works(status: Status) -> bool:
    """Tell whether a component can be built on: one without a monitor if all that it needs can."""
    if status.state == "not_monitored":
        return not status.blocked_by
    return status.level in ("ok", "warn") and status.state != "not_initialised"


class BoardReader:
    """Reads the board of a store, again and again if need be; only what is new is read."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._alarm_records = OwnRecords(store, WRITER, {reserved.ALARM})
        self._alarms: dict[str, AlarmChange] = {}

    def read(self, now_ns: int) -> Board:
        """Return what is known at a time of the wall clock."""
        written = newest_records(self._store, WRITER, {reserved.STATUS}, _LOOKBACK_S)
        alarms = self._standing_alarms()
        monitoring = monitoring_of(self._store)
        if not written:
            return Board((), alarms, 0, self._silence("yet"), monitoring)
        statuses = [status_of(record.values) for record in written]
        silence = self._judge(statuses[-1], written[-1].wall_ns, now_ns, monitoring)
        newest = _newest(statuses)
        known = [_unknown(status, silence) for status in newest] if silence else newest
        return Board(known, alarms, statuses[-1].measured_ns, silence, monitoring)

    def _judge(self, last: Status, written_ns: int, now_ns: int, monitoring: Pulse) -> str:
        if written_ns > now_ns + SILENT_NS:
            return "the watcher's last word is from the future: was a clock set?"
        if monitoring.state == "overloaded":
            return overloaded(monitoring.delay_s)
        if now_ns - written_ns > SILENT_NS:
            return self._silence(f"for {duration(now_ns - written_ns)}")
        late_ns = written_ns - last.measured_ns
        if late_ns > SILENT_NS and not last.live_only:
            return f"the watcher is {duration(late_ns)} behind"
        return ""

    def _silence(self, since: str) -> str:
        hangs = is_locked(self._store, WRITER)
        return f"the watcher has said nothing {since}{', though it runs' if hangs else ''}"

    def _standing_alarms(self) -> list[AlarmChange]:
        """Keep the newest record of each alarm, until it has healed."""
        for record in self._alarm_records.step():
            alarm = alarm_of(record.values)
            self._alarms[alarm.id] = alarm
            if alarm.state == "healed":
                del self._alarms[alarm.id]
        return list(self._alarms.values())


def overloaded(delay_s: float) -> str:
    """Say that monitoring is late, and how much."""
    return f"monitoring overloaded: the watcher is {duration(round(delay_s * NS))} behind"


def _newest(statuses: Sequence[Status]) -> list[Status]:
    """Return the newest status of each mode and component that is still watched.

    Their order is that of the last whole second, when all are said in the plan's order. What was
    written last counts as the newest: a watcher that was held up says of the present that nothing
    is known, then goes on with the past.
    """
    last: dict[tuple[str, str], Status] = {}
    for status in statuses:
        key = status.component, status.mode
        if status.measured_ns % NS == 0:
            last.pop(key, None)
        last[key] = status
    start_ns = statuses[-1].measured_ns - _ROUND_NS
    return [status for status in last.values() if status.measured_ns >= start_ns]


def _unknown(status: Status, why: str) -> Status:
    outputs = dict.fromkeys(status.outputs)
    return replace(
        status, level="unknown", state="unknown", outputs=outputs, blocked_by=(), reason=why
    )


def duration(duration_ns: int) -> str:
    """Say a duration as people do: ``12 s``, ``5 min``, ``3 h``, ``2 days``."""
    seconds = max(round(duration_ns / NS), 0)
    for size, unit in ((86_400, "days"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds // size} {unit}"
    return f"{seconds} s"
