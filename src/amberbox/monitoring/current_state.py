"""The state of a robot, now or at an instant, as written by its watcher.

Statuses, open alarms, symptoms and diagnoses come from the watcher's journal. State files beside it
show that the watcher runs, how late it evaluates, and which configuration files it has read; they
do not wait for statuses, so that a late watcher can be distinguished from one that hangs.
"""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.scan import ChunkPlace
from amberbox.blackbox.robot_folder.folder import RobotFolder, configuration_files, hash_files
from amberbox.blackbox.store.journal_reader import newest_first, sound_chunks
from amberbox.blackbox.store.own_records import (
    OwnRecords,
    WrittenRecord,
    newest_records,
    records_of,
)
from amberbox.blackbox.store.store import Store, is_locked
from amberbox.core.clock import NS, Clock, SystemClock
from amberbox.core.given_answers import RecordedAnswer, answer_of
from amberbox.core.robot_status import (
    Monitoring,
    Observed,
    RobotStatus,
    components_level,
    judge,
    severity_rank,
)
from amberbox.core.timestamps import format_time
from amberbox.core.types import Diagnosis, Status, Symptom
from amberbox.monitoring.findings import AlarmChange, alarm_of, finding_of, status_of

WRITER = "watch"  # the watcher's journal and its lock
STATE_FILE = "watch-state.json"
OVERLOADED_S = 3.0  # delay of the evaluation from which monitoring is overloaded
SILENT_S = 5.0  # age of a heartbeat (one per second) from which the watcher is silent


class WatcherHeartbeat(NamedTuple):
    """The condition of a robot's watcher.

    ``delay_s`` is how late rows are evaluated; of a silent watcher, the age of its heartbeat.
    """

    state: Monitoring = "absent"
    delay_s: float = 0.0


def write_heartbeat(store: Store, clock: Clock, delay_s: float) -> None:
    """Write the heartbeat of this watcher, with its delay; the file need not survive a crash."""
    values = {
        "pid": os.getpid(), "boot_id": clock.boot_id(), "boot_ns": clock.boot_ns(),
        "delay_s": round(delay_s, 3),
    }  # fmt: skip
    part = store.path / f"{STATE_FILE}.part"
    with suppress(OSError):  # a full disk: the age of the heartbeat is shown
        part.write_text(json.dumps(values))
        part.replace(store.path / STATE_FILE)


def read_heartbeat(store: Store, clock: Clock | None = None) -> WatcherHeartbeat:
    """Return the condition of a store's watcher.

    A watcher without a heartbeat (an older version, or one that has just begun) is running.
    """
    if not is_locked(store, WRITER):
        return WatcherHeartbeat()
    clock = clock or SystemClock()
    try:
        values = json.loads((store.path / STATE_FILE).read_text())
        is_of_now = values["boot_id"] == clock.boot_id() and _is_alive(int(values["pid"]))
        age_s = (clock.boot_ns() - int(values["boot_ns"])) / NS
        delay_s = float(values["delay_s"])
    except (OSError, ValueError, KeyError, TypeError):
        return WatcherHeartbeat("running")
    if not is_of_now:
        return WatcherHeartbeat("running")
    if age_s > SILENT_S:
        return WatcherHeartbeat("silent", age_s)
    return WatcherHeartbeat("overloaded" if delay_s > OVERLOADED_S else "running", delay_s)


def _is_alive(pid: int) -> bool:
    """Return whether the process exists; if not, an earlier watcher wrote the file."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


FILE = "watch-folder.json"


def write_watched_files(store: Store, folder: RobotFolder) -> None:
    """Write down the files as the watcher that begins now has read them, for ``changed_files``."""
    part = store.path / f"{FILE}.part"
    with suppress(OSError):  # a full disk: the names of changed files are then not known
        part.write_text(json.dumps({"config_hash": folder.config_hash, "files": _files(folder)}))
        part.replace(store.path / FILE)


def changed_files(store: Store, folder: RobotFolder) -> list[str]:
    """Return the names of the files that differ from those the present watcher has read.

    Empty where nothing differs, or no watcher runs.
    """
    if not is_locked(store, WRITER):
        return []
    try:
        values = json.loads((store.path / FILE).read_text())
        before, config_hash = dict(values["files"]), values["config_hash"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    if config_hash == folder.config_hash:
        return []
    now = _files(folder)
    return [
        f"{name} ({_what(before.get(name), now.get(name))})"
        for name in sorted({*before, *now})
        if before.get(name) != now.get(name)
    ]


def _files(folder: RobotFolder) -> dict[str, str]:
    files = configuration_files(folder)
    return {name: hash_files({name: path}) for name, path in files.items()}


def _what(before: str | None, now: str | None) -> str:
    return "new" if before is None else "gone" if now is None else "changed"


PERIOD_S = 1.0
STARTING_NS = 60 * NS  # time for a new watcher to catch up with the record


class EvaluationLateness:
    """Measures the time from the writing of rows to the end of their evaluation.

    Everything recorded before a poll ``began`` is evaluated once it ``ended``. Time
    is that since the computer's start: a stop of this process counts, so does a suspend.
    """

    def __init__(self, store: Store, clock: Clock) -> None:
        self._store, self._clock = store, clock
        self._begun_ns = self._done_ns = clock.boot_ns()
        self._is_starting = True
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sign of life", daemon=True)
        self.is_overloaded = False

    def began(self) -> None:
        """Mark the start of a poll of the record."""
        self._begun_ns = self._clock.boot_ns()

    def ended(self) -> float | None:
        """Mark that everything the poll found is evaluated.

        Returns how late that was, in seconds, when monitoring has become overloaded, 0.0 when it
        is no more; None if neither.
        """
        late_s, was_overloaded = self.delay_s(), self.is_overloaded
        self._done_ns, self._is_starting = self._begun_ns, False
        self.is_overloaded = late_s > OVERLOADED_S
        if self.is_overloaded == was_overloaded:
            return None
        return late_s if self.is_overloaded else 0.0

    def delay_s(self) -> float:
        """Return how old the oldest rows may be that are not evaluated yet, in seconds."""
        late_ns = self._clock.boot_ns() - self._done_ns
        return 0.0 if self._is_starting and late_ns < STARTING_NS else late_ns / NS

    def start(self) -> None:
        """Start to write heartbeats."""
        self._thread.start()

    def close(self) -> None:
        """Stop writing heartbeats."""
        self._end.set()
        if self._thread.is_alive():
            self._thread.join(PERIOD_S)

    def _run(self) -> None:
        while not self._end.is_set():
            write_heartbeat(self._store, self._clock, self.delay_s())
            self._end.wait(PERIOD_S)


SILENT_NS = 3 * NS  # statuses are written every second; older ones are not current
# a status this much older than the newest belongs to a component no longer watched
_ROUND_NS = 5 * NS // 2
_LOOKBACK_S = 4.0


@dataclass(frozen=True, slots=True)
class CurrentState:
    """The newest of each status and alarm; ``silence`` is why nothing is known, else empty.

    ``monitoring`` is the condition of the watcher; None where it is not known.
    """

    statuses: Sequence[Status] = ()
    alarms: Sequence[AlarmChange] = ()
    measured_ns: int = 0
    silence: str = ""
    monitoring: WatcherHeartbeat | None = None

    @property
    def status(self) -> RobotStatus:
        """Return the status of the robot as a whole, computed as on the server."""
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
        """Return the robot's id; empty without any status."""
        return self.statuses[0].robot if self.statuses else ""

    @property
    def components(self) -> dict[str, Status]:
        """Return the statuses of components, by id."""
        return {status.component: status for status in self.statuses if not status.mode}

    def modes_of(self, component: str) -> list[Status]:
        """Return the statuses of a component's modes."""
        return [s for s in self.statuses if s.mode and s.component == component]


def is_usable(status: Status) -> bool:
    """Return whether dependents can use a component; without a monitor, if its needs are met."""
    if status.state == "not_monitored":
        return not status.blocked_by
    return status.level in ("ok", "warn") and status.state != "not_initialised"


class CurrentStateReader:
    """Reads the present state of a store; further calls read only new records."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._alarm_records = OwnRecords(store, WRITER, {channels.ALARM})
        self._alarms: dict[str, AlarmChange] = {}

    def read(self, now_ns: int) -> CurrentState:
        """Return the state at a time of the wall clock."""
        written = newest_records(self._store, WRITER, {channels.STATUS}, _LOOKBACK_S)
        alarms = self._open_alarms()
        monitoring = read_heartbeat(self._store)
        if not written:
            return CurrentState((), alarms, 0, self._silence("yet"), monitoring)
        statuses = [status_of(record.values) for record in written]
        silence = self._judge(statuses[-1], written[-1].wall_ns, now_ns, monitoring)
        newest = _newest(statuses)
        known = [_unknown(status, silence) for status in newest] if silence else newest
        return CurrentState(known, alarms, statuses[-1].measured_ns, silence, monitoring)

    def _judge(
        self, last: Status, written_ns: int, now_ns: int, monitoring: WatcherHeartbeat
    ) -> str:
        if written_ns > now_ns + SILENT_NS:
            return "the watcher's last word is from the future: was a clock set?"
        if monitoring.state == "overloaded":
            return overload_text(monitoring.delay_s)
        if now_ns - written_ns > SILENT_NS:
            return self._silence(f"for {duration_text(now_ns - written_ns)}")
        late_ns = written_ns - last.measured_ns
        if late_ns > SILENT_NS and not last.live_only:
            return f"the watcher is {duration_text(late_ns)} behind"
        return ""

    def _silence(self, since: str) -> str:
        hangs = is_locked(self._store, WRITER)
        return f"the watcher has said nothing {since}{', though it runs' if hangs else ''}"

    def _open_alarms(self) -> list[AlarmChange]:
        """Return the newest record of each alarm that has not healed."""
        for record in self._alarm_records.step():
            alarm = alarm_of(record.values)
            self._alarms[alarm.id] = alarm
            if alarm.state == "healed":
                del self._alarms[alarm.id]
        return list(self._alarms.values())


def overload_text(delay_s: float) -> str:
    """Return a sentence that monitoring is late, and by how much."""
    return f"monitoring overloaded: the watcher is {duration_text(round(delay_s * NS))} behind"


def _newest(statuses: Sequence[Status]) -> list[Status]:
    """Return the newest status of each mode and component that is still monitored.

    Their order is that of the last complete second, when all are written in the plan's order. The
    last record written counts as the newest: a watcher that was held up first writes that the
    present is unknown, then continues with the past.
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


def duration_text(duration_ns: int) -> str:
    """Write a duration as ``12 s``, ``5 min``, ``3 h`` or ``2 days``."""
    seconds = max(round(duration_ns / NS), 0)
    for size, unit in ((86_400, "days"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds // size} {unit}"
    return f"{seconds} s"


CHANNELS = (channels.SYMPTOM, channels.DIAGNOSIS)
_STATUS = (channels.STATUS,)
_END_S = 2 * SILENT_NS / NS
_LATE_NS = 5 * NS  # statuses of an instant are written within this, unless the watcher was behind


@dataclass(frozen=True, slots=True)
class RecordedFindings:
    """The findings of a watcher up to an instant, in the order of writing."""

    symptoms: Sequence[Symptom] = ()
    diagnoses: Sequence[Diagnosis] = ()
    """Revisions by id; the last one is that at the instant."""
    answers: Sequence[RecordedAnswer] = ()
    """What people answered to tests."""


def record_end_ns(store: Store) -> int | None:
    """Return up to when a recorder has written, log time, by the end of its journal alone."""
    written = newest_records(store, "main", {channels.COUNTERS}, 0.0)
    return written[-1].log_ns if written else None


def was_watched(store: Store, config_hash: str, at_ns: int) -> bool:
    """Return whether a watcher with these monitors evaluated the record at an instant."""
    from_ns = at_ns - SILENT_NS
    return any(
        record.values["config_hash"] == config_hash
        and not record.values["live_only"]
        and from_ns <= record.values["measured_ns"] <= at_ns
        for record in _statuses(store, from_ns, at_ns + _LATE_NS)
    )


def findings_until(store: Store, at_ns: int) -> RecordedFindings:
    """Return what is recorded up to an instant, of all that is kept of the journal."""
    symptoms: list[Symptom] = []
    diagnoses: list[Diagnosis] = []
    answers: list[RecordedAnswer] = []
    for record in OwnRecords(store, WRITER, (*CHANNELS, channels.EVENT)).step():
        if record.channel == channels.EVENT:
            given = answer_of(record.values) if record.log_ns <= at_ns else None
            answers += [] if given is None else [given]
            continue
        finding = finding_of(record.channel, record.values)
        if isinstance(finding, Symptom) and (finding.confirmed_ns or 0) <= at_ns:
            symptoms.append(finding)
        elif isinstance(finding, Diagnosis) and finding.at_ns <= at_ns:
            diagnoses.append(finding)
    return RecordedFindings(symptoms, diagnoses, answers)


def symptoms_and_diagnoses(records: Iterable[WrittenRecord]) -> Iterable[Symptom | Diagnosis]:
    """Yield the symptoms and diagnoses among records."""
    for record in records:
        finding = finding_of(record.channel, record.values)
        if isinstance(finding, Symptom | Diagnosis):
            yield finding


def _statuses(store: Store, from_ns: int, to_ns: int) -> Iterable[WrittenRecord]:
    """Yield the statuses that were written in a span of log time."""
    newest = newest_records(store, WRITER, _STATUS, _END_S)
    if not newest or newest[0].log_ns <= from_ns:
        yield from newest
        return

    def overlaps(place: ChunkPlace) -> bool:
        return place.end_ns >= from_ns and place.start_ns <= to_ns

    for journal in newest_first(store, WRITER):
        if journal.start_ns <= to_ns:
            yield from records_of(sound_chunks(journal, overlaps), _STATUS)
        if journal.start_ns < from_ns:
            return
