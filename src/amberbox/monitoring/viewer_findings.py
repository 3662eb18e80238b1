"""What a watcher finds, as two topics for Foxglove and other viewers.

For panels of diagnostics, ``/amberbox/diagnostics`` has the statuses as
``diagnostic_msgs/DiagnosticArray``; for the log panel, ``/amberbox/log`` has transitions, alarms,
diagnoses and events as ``foxglove.Log``.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.journal import channels
from amberbox.blackbox.query.export_job import Window
from amberbox.blackbox.query.foxglove import MessageFrames, Server, ViewerMessage
from amberbox.blackbox.query.foxglove_layout import DIAGNOSTICS, LOG
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.sources.ros1.message_type import message_type
from amberbox.blackbox.store.own_records import OwnRecords
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Level, Schema, Status, Topic
from amberbox.monitoring.current_state import WRITER, CurrentStateReader
from amberbox.monitoring.finding_lines import FindingLines
from amberbox.monitoring.findings import AlarmChange, Finding, Transition, finding_of, valid_text
from amberbox.monitoring.plan import Naming
from amberbox.monitoring.publishers import diagnostics

ARRAY = "diagnostic_msgs/DiagnosticArray"
PERIOD_S = 0.5

_CHANNELS = (channels.STATUS, channels.ALARM, channels.DIAGNOSIS, channels.EVENT)
_LOGGED = frozenset({channels.ALARM, channels.DIAGNOSIS, channels.EVENT})
_LOOKBACK_NS = 3 * NS  # statuses are written every second

# levels of foxglove.Log, by those of a status and those of an alarm
_INFO = "Info"
_LEVELS: Mapping[Level, str] = {"ok": _INFO, "warn": "Warning", "error": "Error"}
_SEVERITIES = {"warning": "Warning", "urgent": "Error", "critical": "Error", "fatal": "Fatal"}


@dataclass
class FindingMessages:
    """Makes messages for viewers of statuses, other findings and events."""

    lines: FindingLines = field(default_factory=FindingLines)
    diagnosis: Diagnosis | None = None

    def __post_init__(self) -> None:
        from foxglove.messages import Log

        self._array = message_type(ARRAY)
        log = Log.get_schema()
        definition = self._array.definition.encode()
        self.diagnostics = Topic(DIAGNOSTICS, "ros1", Schema(ARRAY, "ros1msg", definition))
        self.log = Topic(LOG, log.encoding, Schema(log.name, log.encoding, log.data))

    @property
    def topics(self) -> list[Topic]:
        """Return both topics."""
        return [self.diagnostics, self.log]

    def statuses(self, statuses: Sequence[Status], at_ns: int) -> Iterator[ViewerMessage]:
        """Yield the message with statuses at a time of the record."""
        for array in diagnostics.messages(statuses, Naming(), self.diagnosis):
            secs, nsecs = divmod(at_ns, NS)
            header = {**array["header"], "stamp": {"secs": secs, "nsecs": nsecs}}
            yield ViewerMessage(
                self.diagnostics, at_ns, self._array.encode({**array, "header": header})
            )

    def record(
        self, channel: str, values: Mapping[str, Any], at_ns: int
    ) -> Iterator[ViewerMessage | Status]:
        """Yield the message of a record, or the status that it is; nothing of others."""
        try:
            finding = finding_of(channel, values)
        except (LookupError, TypeError, ValueError):  # of another version, or damaged
            return
        if isinstance(finding, Diagnosis):
            self.diagnosis = finding if finding.state == "open" else None
        if isinstance(finding, Status):
            yield finding
        if isinstance(finding, AlarmChange):  # repeated at the start of each file, as live_only
            finding = replace(finding, live_only=False)
        text = str(values.get("text", "")) if finding is None else self.lines.text(finding)
        if text:
            source = str(values.get("source", "")) if finding is None else _component(finding)
            yield self._entry(text, _log_level(finding), source, at_ns)

    def _entry(self, text: str, level: str, name: str, at_ns: int) -> ViewerMessage:
        from foxglove.messages import Log, LogLevel, Timestamp

        log = Log(
            timestamp=Timestamp(*divmod(at_ns, NS)), level=getattr(LogLevel, level),
            message=valid_text(text), name=valid_text(name), file="", line=0,
        )  # fmt: skip
        return ViewerMessage(self.log, at_ns, log.encode())


def _component(finding: Finding) -> str:
    return finding.component if isinstance(finding, Transition | AlarmChange) else "watch"


def _log_level(finding: Finding | None) -> str:
    if isinstance(finding, Transition):
        return _LEVELS.get(finding.after.level, "Warning")
    if isinstance(finding, AlarmChange):
        return _SEVERITIES.get(finding.severity, "Error") if finding.state == "open" else _INFO
    if isinstance(finding, Diagnosis):
        return "Warning" if finding.state == "open" else _INFO
    return "Warning" if isinstance(finding, Status) and finding.live_only else _INFO


@dataclass
class FindingFrames:
    """The findings in a window of a record; no topics where nothing was found."""

    record: Record
    window: Window

    def __post_init__(self) -> None:
        items = [item for item in map(_item, _CHANNELS) if self.record.has_item(item)]
        self._records = MessageFrames(self.record, items, self.window) if items else None

    @cached_property
    def topics(self) -> list[Topic]:
        """Return the topics."""
        return [] if self._records is None else FindingMessages().topics

    def latched(self, at_ns: int) -> list[ViewerMessage]:
        """Return the statuses as of a moment."""
        messages = FindingMessages(diagnosis=self._diagnosis(at_ns))
        last = {
            (found.component, found.mode): found
            for _, found in self._read(messages, at_ns - _LOOKBACK_NS, at_ns)
            if isinstance(found, Status)
        }
        return list(messages.statuses(list(last.values()), at_ns))

    def _diagnosis(self, at_ns: int) -> Diagnosis | None:
        """Return the diagnosis that is open at a moment: files begin with those that are open."""
        if self._records is None:
            return None
        starts = self._records.current.ask(
            lambda catalogue: [
                journal.received_range_ns[0]
                for journal in catalogue.journals(skip=())
                if journal.writer == WRITER and journal.places
            ]
        )
        messages = FindingMessages()
        start_ns = max((start for start in starts if start < at_ns), default=at_ns)
        for _ in self._read(messages, start_ns, at_ns):
            pass
        return messages.diagnosis

    def _read(
        self, messages: FindingMessages, from_ns: int, to_ns: int | None = None
    ) -> Iterator[tuple[int, ViewerMessage | Status]]:
        if self._records is not None:
            for record in self._records.read(from_ns, to_ns):
                values = msgspec.json.decode(record.data)
                for found in messages.record(record.topic.name, values, record.received_ns):
                    yield record.received_ns, found

    def read(self, from_ns: int) -> Iterator[ViewerMessage]:
        """Yield the messages from a moment on: one array for the statuses of an instant."""
        messages = FindingMessages(diagnosis=self._diagnosis(from_ns))
        waiting: list[Status] = []
        instant = 0, 0
        for at_ns, found in self._read(messages, from_ns):
            now = at_ns, found.measured_ns if isinstance(found, Status) else instant[1]
            if now != instant:
                yield from messages.statuses(waiting, instant[0])
                waiting, instant = [], now
            if isinstance(found, Status):
                waiting.append(found)
            else:
                yield found
        yield from messages.statuses(waiting, instant[0])


def _item(channel: str) -> str:
    return channel.replace("/", "_")


@dataclass
class LiveFindings:
    """What the watcher of a store finds, sent as it is written; its silence makes all stale."""

    store: Path

    def prepare(self, server: Server) -> None:
        """Advertise the topics; what was found before is read, not sent."""
        store = open_store(self.store)
        self._state = CurrentStateReader(store)
        self._records = OwnRecords(store, WRITER, _LOGGED)
        self._messages = FindingMessages()
        list(self._new_messages())
        for topic in self._messages.topics:
            server.advertise(topic)

    def _new_messages(self) -> Iterator[ViewerMessage]:
        for record in self._records.step():
            for found in self._messages.record(record.channel, record.values, record.wall_ns):
                if isinstance(found, ViewerMessage):
                    yield found

    def run(self, server: Server, stop: threading.Event) -> None:
        """Send until stopped: all statuses every second, and at once when one changes."""
        sent: Sequence[tuple[Any, ...]] = ()
        sent_s = 0.0
        while not stop.wait(PERIOD_S):
            for message in self._new_messages():
                server.send(message)
            state = self._state.read(time.time_ns())
            now = [(s.component, s.mode, s.level, s.state, s.reason) for s in state.statuses]
            if now != sent or time.monotonic() - sent_s >= 1.0:
                sent, sent_s = now, time.monotonic()
                for message in self._messages.statuses(state.statuses, time.time_ns()):
                    server.send(message)
