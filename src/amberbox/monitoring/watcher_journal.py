"""The watcher's journal: findings, checkpoints and retained state, written and recovered.

Its log time follows the axis of the recorder that is watched; an epoch is one run of the
recorder without a step of its clock.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np

from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.scan import start_record
from amberbox.blackbox.store.derived_journal import (
    DerivedJournal,
    EncodedRecord,
    ItemMessage,
    ReaderProgress,
    event,
)
from amberbox.blackbox.store.journal_reader import (
    JournalFile,
    newest_first,
    previous_chain,
    sound_chunks,
)
from amberbox.blackbox.store.store import Store, run_and_number
from amberbox.core.clock import NS, Clock
from amberbox.core.given_answers import RecordedAnswer, answer_event
from amberbox.core.given_findings import RecordedFinding, finding_event
from amberbox.core.types import Cursor, Diagnosis, Status, WriterCursor
from amberbox.monitoring.findings import (
    SOURCE,
    AlarmChange,
    Finding,
    alarm_of,
    diagnosis_of,
    encoded,
    finding_of,
    is_live_only,
)

_TEXT = re.compile(r"main (\d+)/(-?\d+)")


class RecordEpoch(NamedTuple):
    """One run of the recorder without a step of its clock.

    ``base_ns`` is log time minus the time since the computer's start, constant throughout; in a
    record whose time does not count from there (an import) it counts how often time went back.
    """

    run: int
    base_ns: int

    @property
    def counts_from_boot(self) -> bool:
        """Return whether log time counts from the computer's start."""
        return self.base_ns >= NS

    def __str__(self) -> str:
        return f"main {self.run}/{self.base_ns}"


def epoch_of(text: str) -> RecordEpoch | None:
    """Return the epoch of a text made by ``str``; None for any other text."""
    found = _TEXT.fullmatch(text)
    return RecordEpoch(int(found[1]), int(found[2])) if found else None


EVALUATED = "evaluated"
CHECKPOINT = "checkpoint"
_FINDINGS = (
    *(channels.STATUS, channels.EVENT, channels.ALARM),
    *(channels.SYMPTOM, channels.DIAGNOSIS),
)


@dataclass(frozen=True, slots=True)
class EvaluatedPosition:
    """An instant of the record up to which everything is evaluated."""

    epoch: RecordEpoch
    until_ns: int

    def before(self) -> EvaluatedPosition:
        """Return the position before the first instant of the epoch."""
        return EvaluatedPosition(self.epoch, 0)

    def note(self, store_id: str) -> ReaderProgress:
        """Return the position record that is written with the findings up to here."""
        state = {"epoch": str(self.epoch), "until_ns": self.until_ns}
        return ReaderProgress(Cursor(store_id), EVALUATED, msgspec.json.encode(state).decode())


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A checkpoint: the engine's state at a position, and the positions of the reader.

    Relevant rows begin ``lookback_s`` before it. Without an ``engine`` state, evaluation has to
    start again at this position.
    """

    place: EvaluatedPosition
    positions: Mapping[str, WriterCursor]
    lookback_s: float
    engine: Mapping[str, Any]
    monitors: str = ""

    def note(self, store_id: str) -> ReaderProgress:
        """Return the note that is written."""
        state = {
            "epoch": str(self.place.epoch),
            "until_ns": self.place.until_ns,
            "lookback_s": self.lookback_s,
            "monitors": self.monitors,
            "engine": self.engine,
        }
        cursor = Cursor(store_id, self.positions)
        encoded = msgspec.json.encode(state, enc_hook=_plain)
        return ReaderProgress(cursor, CHECKPOINT, encoded.decode())


@dataclass(slots=True)
class RecoveredProgress:
    """The progress of an earlier watcher: its last checkpoint, and its position after it.

    ``more`` findings were written after those up to ``place``: it was killed meanwhile.
    """

    place: EvaluatedPosition | None = None
    checkpoint: Checkpoint | None = None
    more: int = 0
    is_ours: bool = True
    """Whether the engine's state was made with the same monitors."""


def _plain(value: Any) -> Any:
    """Return numpy values as plain Python."""
    return value.tolist()


def recover_progress(store: Store) -> RecoveredProgress:
    """Return the progress of the last watcher of a store, read from its journal's end back."""
    memory = RecoveredProgress()
    for chunk, topics in _chunks_from_end(store):
        for topic, values in reversed(_records(chunk, topics)):
            _take(memory, store.id, topic, values)
        if memory.checkpoint is not None:
            break
    return memory


def _chunks_from_end(store: Store) -> Iterator[tuple[Chunk, Mapping[int, str]]]:
    for journal in newest_first(store, "watch"):
        topics = {n: s.topic.name for n, s in journal.streams.items()}
        wanted = {n: t for n, t in topics.items() if t in (channels.CURSOR, *_FINDINGS)}
        for place in reversed(journal.places):
            for chunk in sound_chunks(journal, partial(operator.is_, place)):
                yield chunk, wanted


def _records(chunk: Chunk, topics: Mapping[int, str]) -> Sequence[tuple[str, Any]]:
    rows = np.flatnonzero(np.isin(chunk.channel, list(topics)))
    messages = map(msgspec.json.decode, chunk.messages(rows))
    return [
        (topics[number], values)
        for number, values in zip(chunk.channel[rows].tolist(), messages, strict=True)
    ]


def _take(memory: RecoveredProgress, store_id: str, topic: str, values: Mapping[str, Any]) -> None:
    """Take one record, newest first."""
    if topic != channels.CURSOR:
        if memory.place is None:
            finding = finding_of(topic, values)
            memory.more += finding is not None and not is_live_only(finding)
        return
    state = msgspec.json.decode(values["state"] or "{}")
    epoch = epoch_of(str(state.get("epoch", "")))
    cursor = Cursor.from_json(values["cursor"])
    if epoch is None or cursor.store_id != store_id:
        return
    place = EvaluatedPosition(epoch, int(state["until_ns"]))
    if memory.place is None:
        memory.place = place
    if values["reader"] == CHECKPOINT and memory.checkpoint is None:
        memory.checkpoint = Checkpoint(
            place, cursor.writers, float(state["lookback_s"]), state["engine"], state["monitors"]
        )


# reason of healing an alarm that new monitors no longer have
CHANGED = "the configuration or the version has changed"


class CurrentFindings(Protocol):
    """The findings that last now."""

    @property
    def diagnosis(self) -> Diagnosis | None:
        """The last revision of the diagnosis that is open."""

    def alarms(self) -> Sequence[AlarmChange]:
        """Return the active alarms in their present state."""


@dataclass(frozen=True, slots=True)
class RetainedFindings:
    """The lasting findings in the journal of the last watcher, by id."""

    alarms: Mapping[str, AlarmChange] = field(default_factory=dict)
    diagnoses: Mapping[str, Diagnosis] = field(default_factory=dict)


@dataclass(slots=True)
class RetainedState:
    """The lasting findings: by the journal, until the engine has caught up with it."""

    left: RetainedFindings
    engine: CurrentFindings
    settled: bool = False

    def again(self) -> list[Finding]:
        """Return the findings at the start of each journal file: older files may be deleted."""
        if not self.settled:
            lasting: Iterable[AlarmChange] = self.left.alarms.values()
            open_ones: Iterable[Diagnosis] = self.left.diagnoses.values()
        else:
            lasting, now = self.engine.alarms(), self.engine.diagnosis
            open_ones = () if now is None else (now,)
        return [
            *(replace(diagnosis, live_only=True) for diagnosis in open_ones),
            *(replace(alarm, live_only=True) for alarm in lasting),
        ]

    def settle(self, found: Sequence[Finding], at_ns: int, *, anew: bool) -> list[Finding]:
        """Switch to the engine's state; return the findings that differ from the journal.

        Only an engine that started ``anew`` differs; ``found`` is written in any case.
        """
        self.settled = True
        if not anew:
            return []
        return [*self._diagnoses(found, at_ns), *self._alarms(found, at_ns)]

    def _diagnoses(self, found: Sequence[Finding], at_ns: int) -> list[Diagnosis]:
        """Return the ends of diagnoses that are open in the journal, and the present one."""
        now = self.engine.diagnosis
        written = {finding.id for finding in found if isinstance(finding, Diagnosis)}
        own = written if now is None else {now.id, *written}
        gone = [
            closed_diagnosis(d, at_ns) for key, d in self.left.diagnoses.items() if key not in own
        ]
        if now is None or now.id in written:
            return gone
        return [*gone, replace(now, live_only=True)]

    def _alarms(self, found: Sequence[Finding], at_ns: int) -> list[AlarmChange]:
        written = {finding.id for finding in found if isinstance(finding, AlarmChange)}
        lasting = {alarm.id: replace(alarm, live_only=True) for alarm in self.engine.alarms()}
        gone = [
            a for key, a in self.left.alarms.items() if key not in lasting and key not in written
        ]
        other = [
            alarm
            for key, alarm in lasting.items()
            if key not in written and _shown_state(alarm) != _shown_state(self.left.alarms.get(key))
        ]
        return [*(_over(alarm, at_ns) for alarm in gone), *other]


def retained_findings(store: Store) -> RetainedFindings:
    """Return the lasting findings by the newest file of the watcher's journal."""
    journal = next((one for one in newest_first(store, "watch") if one.places), None)
    if journal is None:
        return RetainedFindings()
    alarms = {a.id: a for a in map(alarm_of, _retained_records(journal, channels.ALARM))}
    diagnoses = {d.id: d for d in map(diagnosis_of, _retained_records(journal, channels.DIAGNOSIS))}
    return RetainedFindings(
        {key: alarm for key, alarm in alarms.items() if alarm.state != "healed"},
        {key: diagnosis for key, diagnosis in diagnoses.items() if diagnosis.state == "open"},
    )


def _retained_records(journal: JournalFile, channel: str) -> Iterator[Any]:
    numbers = [n for n, s in journal.streams.items() if s.topic.name == channel]
    for chunk in sound_chunks(journal) if numbers else ():
        for message in chunk.messages(np.flatnonzero(np.isin(chunk.channel, numbers))):
            yield msgspec.json.decode(message)


def _shown_state(alarm: AlarmChange | None) -> object:
    """Return the fields of an alarm that readers see."""
    if alarm is None:
        return None
    return (
        alarm.state, alarm.severity, alarm.level, alarm.reason, alarm.count, alarm.who,
        alarm.until_ns, alarm.cause, alarm.diagnosis,
    )  # fmt: skip


def _over(alarm: AlarmChange, at_ns: int) -> AlarmChange:
    changed_ns = max(at_ns, alarm.changed_ns)
    return replace(
        alarm, state="healed", reason=CHANGED, changed_ns=changed_ns, who="", until_ns=None,
        live_only=True, note="", said_ns=None, command="",
    )  # fmt: skip


def closed_diagnosis(diagnosis: Diagnosis, at_ns: int) -> Diagnosis:
    """Return the last revision of a diagnosis that is not continued."""
    return replace(
        diagnosis, state="healed", revision=diagnosis.revision + 1,
        at_ns=max(at_ns, diagnosis.at_ns), live_only=True,
    )  # fmt: skip


@dataclass(slots=True)
class RecordAxis:
    """The clock of the watcher's records: on the epoch's axis, after all evaluated instants.

    In a record of another boot, or one whose time does not count from the computer's start, time
    does not pass by itself: the clock is directly after the last evaluated instant.
    """

    clock: Clock
    epoch: RecordEpoch
    same_boot: bool
    _passed_ns: int = field(default=0)

    def passed(self, until_ns: int) -> None:
        """Record that everything up to an instant is evaluated."""
        self._passed_ns = max(self._passed_ns, until_ns)

    def now_ns(self) -> int:
        """Return log time now (ns), always after the evaluated instants."""
        now_ns = self.epoch.base_ns + self.clock.boot_ns() if self._runs else 0
        return max(now_ns, self._passed_ns + 1)

    def boot_ns(self, log_ns: int) -> int | None:
        """Return nanoseconds since boot at a log time; None if that is not known."""
        return log_ns - self.epoch.base_ns if self._runs else None

    def offset_ns(self) -> int:
        """Return wall minus log time, nanoseconds."""
        return self.clock.wall_ns() - self.now_ns() if self._runs else 0

    def synchronised(self) -> bool | None:
        """Return whether the wall clock is disciplined; None if not known."""
        return self.clock.synchronised()

    @property
    def _runs(self) -> bool:
        return self.same_boot and self.epoch.counts_from_boot


class WatcherJournal:
    """Writes the watcher's findings on the time axis of the record that it follows."""

    def __init__(
        self,
        store: Store,
        robot: str,
        config_hash: str,
        clock: Clock,
        retained: Callable[[], Sequence[Finding]] = tuple,
    ) -> None:
        """Prepare to write; each file begins with the alarms that are ``standing`` then."""
        self._store = store
        self._clock = clock
        self._own = DerivedJournal(
            store, "watch", robot=robot, config_hash=config_hash, clock=clock,
            chain=lambda: previous_chain(store, "watch"),
            first=lambda: [EncodedRecord(*encoded(finding)) for finding in retained()],
        )  # fmt: skip
        self._axis: RecordAxis | None = None

    @property
    def epoch(self) -> RecordEpoch | None:
        """Return the epoch that is followed."""
        return None if self._axis is None else self._axis.epoch

    @property
    def is_live(self) -> bool:
        """Return whether a record of this boot is followed, so that its time runs."""
        return self._axis is not None and self._axis.same_boot

    def now_ns(self) -> int:
        """Return the log time of records written now, ns."""
        return self._own.now_ns()

    def follow(self, epoch: RecordEpoch) -> None:
        """Switch to the time axis of an epoch; later records belong to it."""
        if self.epoch != epoch:
            same_boot = _boot_of(self._store, epoch.run) == self._clock.boot_id()
            self._axis = RecordAxis(self._clock, epoch, same_boot)
            self._own.begin_run(self._axis, str(epoch))

    def passed(self, place: EvaluatedPosition) -> None:
        """Record that everything up to a position is evaluated; later records are after it."""
        self.follow(place.epoch)
        assert self._axis is not None
        self._axis.passed(place.until_ns)

    def measured(self, rows: Sequence[ItemMessage]) -> None:
        """Write rows of probes."""
        self._own.append(rows)

    def found(self, findings: Sequence[Finding], notes: Sequence[ReaderProgress]) -> None:
        """Write findings together with notes for recovery."""
        urgent = any(not isinstance(finding, Status) for finding in findings)
        self._own.append(
            [EncodedRecord(*encoded(finding)) for finding in findings], notes, urgent=urgent
        )

    def answered(self, given: RecordedAnswer) -> None:
        """Write a person's answer to a test: it is read with the rows of its time."""
        self._write_event(answer_event(given, SOURCE))

    def detected(self, given: RecordedFinding) -> None:
        """Write a detector's finding: it is read with the rows of its time."""
        self._write_event(finding_event(given, SOURCE))

    def _write_event(self, values: Mapping[str, Any]) -> None:
        self._own.append([EncodedRecord(channels.EVENT, msgspec.json.encode(values))], urgent=True)

    def log_event(self, kind: str, text: str) -> None:
        """Write an event about the watcher itself."""
        topic, values = event(kind, text, SOURCE, live_only=True)
        self._own.append([EncodedRecord(topic, msgspec.json.encode(values))], urgent=True)

    def close(self) -> None:
        """Finish the journal."""
        self._own.close()


def _boot_of(store: Store, run: int) -> str:
    """Return in which boot a run of the recorder was written; empty if its files are gone."""
    of_run = (path for path in store.journal_files("main") if run_and_number(path)[0] == run)
    path = next(of_run, None)
    try:
        return "" if path is None else str(start_record(path).get("boot_id", ""))
    except OSError:  # deleted meanwhile
        return ""
