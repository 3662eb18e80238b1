"""The pipeline: from the queue through the filters into the journals; every message is counted.

``tick`` does one write interval's work and runs in one thread. The recorder calls it every
``write_s``; an import calls it whenever enough has been read.
"""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import msgspec

from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter, SyncMark
from amberbox.blackbox.recorder.disk_room import DISK_FULL, AdmissionControl, DiskRoom, GapLog
from amberbox.blackbox.recorder.queue import (
    DataItem,
    EmitEvent,
    MessageQueue,
    StreamMessage,
    TopicStream,
    change_filtered,
    rate_limited,
    report_bad_stamp,
)
from amberbox.blackbox.recorder.watermark import LateSource, RecordWatermark
from amberbox.blackbox.store.item_names import ItemNames
from amberbox.blackbox.store.journal_reader import previous_chain
from amberbox.blackbox.store.store import Store, WriterLock
from amberbox.blackbox.store.tail import RECORDED
from amberbox.core.clock import NS, LogClock, RunClock
from amberbox.core.errors import AmberboxError
from amberbox.core.source import Power, TopicOptions
from amberbox.core.types import Topic
from amberbox.core.version import __version__

JournalRow: TypeAlias = tuple[int, int, int, bytes]  # channel, log time, publish time, message

# returns the own records that a writer's file begins with at a log time
Preamble: TypeAlias = Callable[[str, int], Sequence[tuple[str, bytes]]]

# called when a writer's disk is full; returns False if no room could be made
MakeRoom: TypeAlias = Callable[[str], bool]

_FULL = (errno.ENOSPC, errno.EDQUOT)


class RunJournals:
    """The journals of a run, one per keeping class; rows wait here until they are written.

    All methods but ``use`` and ``repeat`` belong to the writing thread.
    """

    def __init__(
        self,
        make: Callable[[str], JournalWriter],
        preamble: Preamble,
        emit: EmitEvent,
        make_room: MakeRoom,
    ) -> None:
        self._make = make
        self._preamble_of = preamble
        self._emit = emit
        self._make_room = make_room
        self._writers: dict[str, JournalWriter] = {"main": make("main")}
        self._pending: dict[str, list[JournalRow]] = {}
        self._channels: dict[tuple[str, Topic, str], int] = {}
        self._items: dict[tuple[str, int], DataItem] = {}
        self._own_channels: dict[tuple[str, str], int] = {}
        self._repeats: dict[tuple[str, int], TopicStream] = {}
        self._latched: list[TopicStream] = []
        self._late_ns = 0
        # log time of each writer's newest row, and of the first of its present file
        self._reached: dict[str, int] = {}
        self._began: dict[str, int] = {}
        self._due: dict[str, int] = {}  # since when a rotation is due
        self._lags = False  # whether rows before the newest ones are still to come
        self.disk_error = ""  # text of the last write error; empty once a write has succeeded

    def use(self, writer: str) -> None:
        """Create the journal of a writer if there is none yet; from any thread."""
        if writer not in self._writers:
            made = self._make(writer)
            made.late_ns = self._late_ns
            self._writers[writer] = made

    def expect_late(self, late_ns: int) -> bool:
        """State in each new file how late rows may be; from any thread. True if it is news."""
        if late_ns <= self._late_ns:
            return False
        self._late_ns = late_ns
        for writer in list(self._writers.values()):
            writer.late_ns = late_ns
        return True

    def repeat(self, stream: TopicStream) -> None:
        """Repeat the last message of a latched stream in each file; from any thread."""
        self._latched.append(stream)

    def open_writers(self) -> list[str]:
        """Return the names of the journals that have a file open, and of the main one."""
        writers = list(self._writers.items())
        return [name for name, writer in writers if name == "main" or writer.path]

    def add(self, stream: TopicStream, received_ns: int, data: bytes) -> None:
        """Add a message to be written."""
        if stream.channel < 0:
            stream.channel = self._channel(stream)
        stamp_ns = stream.stamp_ns(data)
        if stamp_ns is None:
            report_bad_stamp(stream, data, self._emit)
        row = (stream.channel, received_ns, stamp_ns or received_ns, data)
        self._pending.setdefault(stream.item.writer, []).append(row)

    def add_own(self, writer: str, name: str, at_ns: int, data: bytes) -> None:
        """Add an own record to be written."""
        row = (self._own_channel(writer, name), at_ns, at_ns, data)
        self._pending.setdefault(writer, []).append(row)

    def flush(self, now_ns: int, watermark_ns: int | None = None) -> bool:
        """Write all pending rows; False on an error (they stay pending).

        Rows before ``now_ns`` may still come if the watermark is before it.
        """
        self._lags = watermark_ns is not None and now_ns - watermark_ns > LAG_NS
        errors = self._write_pending(now_ns)
        full = [name for name, error in errors.items() if error.errno in _FULL]
        made = [self._make_room(name) for name in full]
        if any(made):
            errors = self._write_pending(now_ns)
        for error in errors.values():
            text = error.strerror or str(error)
            if text != self.disk_error:
                self.disk_error = text
                self._emit("disk", f"the disk does not take data: {text}")
            return False
        if self.disk_error:
            self.disk_error = ""
            self._emit("disk", "the disk takes data again")
        return True

    def _write_pending(self, now_ns: int) -> dict[str, OSError]:
        """Write the pending messages as far as possible; return the errors by writer."""
        errors = {}
        for name, rows in self._pending.items():
            rows.sort(key=itemgetter(1))
            try:
                if rows:
                    self._write(name, rows, now_ns)
            except OSError as error:
                errors[name] = error
        return errors

    def take_back(self, writer: str, spared_bytes: int = 0) -> list[tuple[DataItem, int]]:
        """Drop the newest messages of sources that wait for a disk; return their items and times.

        The oldest ones, up to ``spared_bytes``, own records, and messages of files, which are read
        without loss, go on waiting.
        """
        rows = sorted(self._pending.get(writer, ()), key=itemgetter(1))
        stays, taken = [], []
        for row in rows:
            item = self._items.get((writer, row[0]))
            spared_bytes -= len(row[3]) if item else 0
            if item is None or item.waits or spared_bytes >= 0:
                stays.append(row)
                continue
            item.counters.kept -= 1
            item.counters.bytes -= len(row[3])
            taken.append((item, row[1]))
        self._pending[writer] = stays
        return taken

    def forget_own(self, writer: str) -> None:
        """Drop the waiting own records: another journal has them as well."""
        self._pending[writer] = []

    def _write(self, name: str, rows: list[JournalRow], now_ns: int) -> None:
        writer = self._writers[name]
        if self._rotates(name, writer, rows[0][1], now_ns):
            writer.rotate()
        preamble: list[JournalRow] = []
        if writer.path is None:  # the files of a writer follow each other in time
            self._began[name] = max(rows[0][1], self._reached.get(name, 0))
            preamble = self._preamble(name, self._began[name])
        if rows[0][1] < self._began[name]:
            rows[:] = [_not_before(self._began[name], row) for row in rows]
        rows[:0] = preamble
        before = writer.next_seq
        try:
            channels, log_ns, publish_ns, messages = zip(*rows, strict=True)
            writer.write(channels, log_ns, publish_ns, messages)
        finally:  # whole chunks written before an error are not written again
            written = writer.next_seq - before
            if written:
                self._reached[name] = max(self._reached.get(name, 0), rows[written - 1][1])
            if writer.path is None:  # no file was made: the next attempt has its own preamble
                del rows[: len(preamble)]
            del rows[:written]

    def _rotates(self, name: str, writer: JournalWriter, first_ns: int, now_ns: int) -> bool:
        """Return whether a new file begins: it waits a while for rows that come late."""
        if not writer.rotation_due(now_ns):
            self._due.pop(name, None)
            return False
        since_ns = self._due.setdefault(name, now_ns)
        is_late = self._lags or first_ns < self._reached.get(name, 0) - LAG_NS
        return not is_late or now_ns - since_ns > self._late_ns

    def _preamble(self, writer: str, at_ns: int) -> list[JournalRow]:
        """Return the rows that each file begins with: run, clock, last latched messages."""
        rows: list[JournalRow] = [
            (self._own_channel(writer, name), at_ns, at_ns, data)
            for name, data in self._preamble_of(writer, at_ns)
        ]
        for stream in list(self._latched):
            if stream.item.last_latched is not None:
                self._channel(stream)
        for (of_writer, channel), stream in self._repeats.items():
            data = stream.item.last_latched
            if of_writer == writer and data is not None:
                rows.append((channel, at_ns, at_ns, data))
        return rows

    def _channel(self, stream: TopicStream) -> int:
        """Register the channel of a stream, and the one that repeats its latched message."""
        item, topic = stream.item, stream.topic
        key = (item.writer, topic, item.name)
        if key not in self._channels:
            marks = {"item": item.name, "source": item.source}
            if item.options.stamp is not None:
                marks["stamp"] = item.options.stamp
            if topic.latched:
                marks["latched"] = "1"
            if stream.note:
                marks["converted"] = stream.note
            writer = self._writers[item.writer]
            number = self._channels[key] = writer.channel(topic, marks)
            self._items[item.writer, number] = item
            if topic.latched:
                self._repeat_on(writer.channel(topic, {**marks, "repeated": "1"}), stream)
        return self._channels[key]

    def _repeat_on(self, channel: int, stream: TopicStream) -> None:
        """Repeat an item's latched message on this channel, not on that of an old definition."""
        for key, other in list(self._repeats.items()):
            if other.item is stream.item:
                del self._repeats[key]
        self._repeats[stream.item.writer, channel] = stream

    def _own_channel(self, writer: str, name: str) -> int:
        key = (writer, name)
        if key not in self._own_channels:
            marks = {"item": name.replace("/", "_"), "source": channels.SOURCE}
            topic = channels.topic_of(name)
            self._own_channels[key] = self._writers[writer].channel(topic, marks)
        return self._own_channels[key]

    def publish_heads(self, watermark_ns: int) -> None:
        """Write the heads, by which followers see how far the journals reach."""
        with suppress(OSError):  # a hint only, and the flush has reported the disk
            for writer in list(self._writers.values()):
                writer.publish_head(0 if self.disk_error else watermark_ns)

    def rotate(self) -> None:
        """Begin new files with the next write."""
        for writer in list(self._writers.values()):
            writer.rotate()

    def new_epoch(self) -> None:
        """Begin new files, whose log time may be before that of the last ones."""
        self.rotate()
        self._reached.clear()

    def mark_sync(self) -> list[SyncMark]:
        """Return the marks whose ``wait`` makes everything written so far durable."""
        return [writer.mark_sync() for writer in list(self._writers.values())]

    def close(self) -> str:
        """Finish the files; return the text of the last write error, empty without one."""
        refused = self.disk_error
        for writer in list(self._writers.values()):
            try:
                writer.close()
            except OSError as error:  # without its end the file is read by walking it
                refused = error.strerror or str(error)
        return refused

    def unwritten(self) -> int:
        """Return the number of messages of sources that wait for the disk."""
        own = {(writer, number) for (writer, _), number in self._own_channels.items()}
        waiting = [(writer, row[0]) for writer, rows in self._pending.items() for row in rows]
        return sum(channel not in own for channel in waiting)

    @property
    def bytes_written(self) -> int:
        """Bytes this run has put into its journals."""
        return sum(writer.bytes_written for writer in list(self._writers.values()))

    @property
    def paths(self) -> list[Path]:
        """Files being written right now."""
        return [writer.path for writer in list(self._writers.values()) if writer.path]


def _not_before(began_ns: int, row: JournalRow) -> JournalRow:
    """Return a row moved to the start of its file, if it is before it."""
    channel, log_ns, publish_ns, data = row
    if log_ns >= began_ns:
        return row
    return channel, began_ns, began_ns if publish_ns == log_ns else publish_ns, data


@dataclass
class MessageClock:
    """A clock that shows the time of the newest message received; it never steps."""

    at_ns: int = 0

    def advance(self, received_ns: int) -> None:
        """Advance to the time of a received message."""
        self.at_ns = max(self.at_ns, received_ns)

    def now_ns(self) -> int:
        return self.at_ns

    def boot_ns(self, log_ns: int) -> None:
        """Return None: this time is not counted from the start of a computer."""

    def offset_ns(self) -> int:
        return 0

    def new_epoch(self) -> None:
        """Do nothing: this time does not step."""

    def synchronised(self) -> bool | None:
        return None


BEAT_S = 0.05
# a thread that wakes later than this was stalled, and so were those of the sources
LATE_NS = NS // 10

Stall = tuple[int, int]  # start and end, nanoseconds since the computer's start


class StallMeter:
    """Measures how late a thread of the recorder wakes because of load, a stop or a suspend.

    ``boot_ns`` is the time since the computer's start, suspend included.
    """

    def __init__(self, boot_ns: Callable[[], int]) -> None:
        self._boot_ns = boot_ns
        self._beat_ns = boot_ns()
        self._stall: Stall | None = None
        self._lock = threading.Lock()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stalls", daemon=True)

    def beat(self) -> None:
        """Record that the thread has woken."""
        with self._lock:
            self._note(self._boot_ns())

    def take(self) -> Stall | None:
        """Return the stall since the last call, a current one included; None without one."""
        with self._lock:
            now_ns = self._boot_ns()
            if now_ns - self._beat_ns > _LIMIT_NS:
                self._note(now_ns)
            stall, self._stall = self._stall, None
        return stall

    def start(self) -> None:
        """Start measuring."""
        self._beat_ns = self._boot_ns()
        self._thread.start()

    def close(self) -> None:
        """Stop measuring."""
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()

    def _note(self, now_ns: int) -> None:
        if now_ns - self._beat_ns > _LIMIT_NS:
            from_ns = self._beat_ns if self._stall is None else self._stall[0]
            self._stall = from_ns, now_ns
        self._beat_ns = now_ns

    def _run(self) -> None:
        while not self._end.wait(BEAT_S):
            self.beat()


_LIMIT_NS = round(BEAT_S * NS) + LATE_NS


LAG_NS = NS // 5  # a new file waits for messages that come later than this
CLOCK_PERIOD_NS = 10 * NS
SPARING_CLOCK_PERIOD_NS = 60 * NS  # period of clock records while only events are recorded
CLOCK_STEP_NS = 50_000_000
EPOCH_STEP_NS = NS
STALL_EVENT_NS = NS  # a stall of the recorder this long is an event
RAISED_PAUSE_NS = 60 * NS
# counters are written this often even without messages, so that replay's watermark advances
HEARTBEAT_NS = NS


class RecordingClock(LogClock, Protocol):
    """Stamps messages: a RunClock, or a MessageClock where messages bring their time."""

    def new_epoch(self) -> None:
        """Begin a new epoch: log time starts again at wall time."""


@dataclass(frozen=True)
class PipelineOptions:
    """Options of one run."""

    robot: str = ""
    config_hash: str = ""
    boot_id: str = "00000000"
    queue_bytes: int = 64_000_000
    rotate_bytes: int = 64_000_000
    rotate_ns: int = 600 * NS
    ring_rotate_ns: int = 60 * NS
    input: str = ""
    counts_silence: bool = True


@dataclass
class Pipeline:
    """One run of the recorder: its items, its queue, its journals."""

    store: Store
    clock: RecordingClock
    options: PipelineOptions
    # received time up to which an earlier run reaches; gaps of this run begin there
    start_gap_ns: int | None = None
    # room set aside for the last events of a full disk; an import has none
    room: DiskRoom | None = None
    items: dict[str, DataItem] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._locks = [WriterLock(self.store, writer) for writer in RECORDED]
        self.run = self.store.next_run()
        self.queue = MessageQueue(self.options.queue_bytes)
        self.names = ItemNames(self.store.path, is_new=self.run == 1)
        self._own: list[tuple[str, bytes, int]] = []
        self._own_lock = threading.Lock()
        self._items_lock = threading.Lock()
        self._journals = RunJournals(self._writer, self._preamble, self.event, self._make_room)
        self._last_tick_ns = 0
        self._clock_written_ns: int | None = None
        self._clock_offset_ns = 0
        self._clock_seen_ns = 0
        self._rotates = False
        self._counted_ns = 0
        self._filter_error = ""
        self.watermark = RecordWatermark()
        self._is_first_of_epoch = False
        # the power state that a source reported last; None if none has
        self.power: Power | None = None
        # measures stalls of the recorder; None where messages bring their time
        self.stalls: StallMeter | None = None
        self.on_event: Callable[[str, str], None] | None = None
        now_ns = self.clock.now_ns()  # the clock may have been set back since the last run
        start = now_ns if self.start_gap_ns is None else min(self.start_gap_ns, now_ns)
        self.gaps = GapLog(lambda values: self.own(channels.GAP, values), start)
        if start < now_ns:
            self.gaps.pause(now_ns)
        self._admission: AdmissionControl | None = None
        if self.names.restored:
            self.event("restored", self.names.restored)
        if self.room is not None:
            self._admission = AdmissionControl(self.room, self.queue, self.gaps, self.event)

    def _writer(self, writer: str) -> JournalWriter:
        options = self.options
        age = options.ring_rotate_ns if writer == "ring" else options.rotate_ns
        journal = JournalOptions(
            self.store.folder(writer), self.store.id, writer, self.run, options.boot_id,
            options.rotate_bytes, age,
        )  # fmt: skip
        # an import is staged elsewhere, but uses the names of the store
        chain = previous_chain(Store(self.store.path, self.store.id), writer)
        return JournalWriter(journal, chain=chain)

    # -- calls of sources and the recorder

    def item(self, source: str, topic: str, options: TopicOptions) -> DataItem:
        """Return the data item of a topic; created at its first mention."""
        name = self.names.name(source, topic)
        with self._items_lock:
            item = self.items.get(name)
            if item is None:
                item = self.items[name] = DataItem(name, source, topic, options)
                if options.keep != "none":
                    self._journals.use(item.writer)
            return item

    def latched(self, stream: TopicStream) -> None:
        """Repeat the last message of a stream in each file, also one of an earlier run."""
        if stream.item.options.keep != "none":
            self._journals.repeat(stream)

    def own(self, topic: str, values: Mapping[str, Any]) -> None:
        """Write an own record, stamped now."""
        with self._own_lock:
            self._own.append((topic, msgspec.json.encode(values), self.clock.now_ns()))

    def event(self, kind: str, text: str, source: str = "", **details: Any) -> None:
        """Emit an event and wake the writer."""
        if self.on_event is not None:
            self.on_event(kind, text)
        encoded = msgspec.json.encode(details, enc_hook=str).decode()
        self.own(channels.EVENT, {"kind": kind, "text": text, "source": source, "details": encoded})
        self.queue.wake.set()

    def late_source(self, late_ns: int) -> LateSource:
        """Let the watermark wait for a source whose messages may be so late."""
        if self._journals.expect_late(late_ns) and self.journal_paths:
            self.rotate()
        return self.watermark.add(late_ns)

    # -- one write interval

    def tick(self) -> None:
        """Write the messages queued since the last tick; after a write error they stay pending."""
        self.watermark.look()
        taken = self.queue.take()
        if self._admission is not None:
            taken = self._admission.requeue_files(taken, self.bytes_written)
        if taken and isinstance(self.clock, MessageClock):
            self.clock.advance(max(map(itemgetter(2), taken)))
        now_ns = max(self.clock.now_ns(), self._last_tick_ns)
        self._watch_clock(now_ns)
        kept = rate_limited(taken, self.watermark.at_ns, now_ns)
        complete_ns = self.watermark.advance(now_ns)
        if self._is_first_of_epoch:  # these had times of the epoch before
            self._is_first_of_epoch = False
            for item in list(self.items.values()):
                item.raised = 0
        if self._admission is not None:
            kept = self._admission.admit(kept, now_ns)
        self._sort_into_journals(self._filtered(kept), now_ns, complete_ns)
        if self._rotates:
            self._rotates = False
            self._journals.rotate()
        if self._journals.flush(now_ns, complete_ns):
            self.queue.release()
            # after a large step of the wall clock begin a new epoch in new files
            step = abs(self.clock.offset_ns() - self._clock_offset_ns)
            if step > EPOCH_STEP_NS:
                self._new_epoch(step)
        self._journals.publish_heads(complete_ns)

    def _filtered(self, messages: list[StreamMessage]) -> list[StreamMessage]:
        """Drop unchanged messages; if a filter fails, all are kept."""
        try:
            return change_filtered(messages, self.event)
        except Exception as error:  # any exception in a filter: the recorder goes on
            items = sorted({stream.item.name for stream, _, _ in messages})
            text = f"a change filter or schema inference failed: {error!r}; kept unfiltered"
            if text != self._filter_error:
                self._filter_error = text
                self.event("filter_failed", text, items=items)
            return messages

    def _make_room(self, writer: str) -> bool:
        """Release the reserve or drop messages for a writer on a full disk; False if impossible."""
        if self._admission is None or self.room is None:
            return False
        if writer in self._admission.elsewhere:
            self._admission.refuse(self._journals.take_back(writer), f"no room for the {writer}")
            self._journals.forget_own(writer)
            return True
        if not self.room.release():
            return False
        self._admission.report()
        for other in RECORDED:
            if other not in self._admission.elsewhere:
                late = self._journals.take_back(other, self.room.spared_bytes)
                self._admission.refuse(late, DISK_FULL)
        return True

    def keep_elsewhere(self, writers: Collection[str]) -> None:
        """Set which journals are on another disk than the store."""
        if self._admission is not None:
            self._admission.elsewhere = writers

    # -- into the journals

    def _sort_into_journals(
        self, kept: Iterable[StreamMessage], now_ns: int, complete_ns: int
    ) -> None:
        for stream, data, received_ns in kept:
            item = stream.item
            item.written_ns = received_ns
            item.counters.kept += 1
            item.counters.bytes += len(data)
            if stream.topic.latched:
                item.last_latched = data
            self._journals.add(stream, received_ns, data)
        # while the disk refuses data, the accounts of a long trouble would fill the memory
        if not self.disk_error and (self._admission is None or self._admission.account_due(now_ns)):
            for item in list(self.items.values()):
                for reason, drops in self.queue.take_drops(item).items():
                    self.gaps.dropped(item.name, drops, reason)
            self._count(now_ns, complete_ns)
            self._tell_raised(now_ns)
        with self._own_lock:
            taken, self._own = self._own, []
        for name, data, at_ns in taken:
            at_ns = min(max(at_ns, self._last_tick_ns), max(now_ns, self.clock.now_ns()))
            # own records go to the main journal, those of the clock to every file that is open
            for writer in self._journals.open_writers() if name == channels.CLOCK else ["main"]:
                self._journals.add_own(writer, name, at_ns, data)
        self._last_tick_ns = now_ns

    def _count(self, now_ns: int, complete_ns: int) -> None:
        """Write the counters of items that changed, or none as a heartbeat.

        They state up to when the record is complete, where messages may still come late.
        """
        changed = []
        for item in list(self.items.values()):
            if item.counters != item.reported:
                item.reported = copy(item.counters)
                changed.append({"item": item.name, **item.counters.record()})
        silent = self.options.counts_silence and now_ns - self._counted_ns >= HEARTBEAT_NS
        stalled = self._stalled(now_ns)
        if changed or silent or stalled:
            self._counted_ns = now_ns
            with self._own_lock:
                late = {"complete_ns": complete_ns} if complete_ns < now_ns else {}
                encoded = msgspec.json.encode({"items": changed, **stalled, **late})
                self._own.append((channels.COUNTERS, encoded, now_ns))

    def _tell_raised(self, now_ns: int, pause_ns: int = RAISED_PAUSE_NS) -> None:
        """Emit an event about messages whose time of receipt was moved, once a minute at most."""
        for item in list(self.items.values()):
            if not item.raised:
                continue
            if item.raised_ns is not None and now_ns - item.raised_ns < pause_ns:
                continue
            count, item.raised, item.raised_ns = item.raised, 0, now_ns
            many = f"{count} messages" if count > 1 else "a message"
            text = f"{many} of {item.name} came too late to be recorded with their time of receipt"
            self.event("late", text, item.source, item=item.name, count=count)

    def _stalled(self, now_ns: int) -> dict[str, int]:
        """Return the stall of the recorder since the last count; empty without one.

        It is part of the counters, which state up to when the record is complete, so that a
        follower gets the stall before it evaluates an instant of it.
        """
        stall = self.stalls.take() if self.stalls is not None else None
        if stall is None:
            return {}
        shift_ns = now_ns - self.clock.boot_ns(now_ns) if isinstance(self.clock, RunClock) else 0
        from_ns = max(stall[0] + shift_ns, self._counted_ns, self._last_tick_ns)
        to_ns = min(stall[1] + shift_ns, now_ns)
        if to_ns <= from_ns:
            return {}
        if to_ns - from_ns >= STALL_EVENT_NS:
            text = f"the recorder was held up for {(to_ns - from_ns) / NS:.1f} s"
            self.event("recorder_stalled", text, from_ns=from_ns, to_ns=to_ns)
        return {"stalled_from_ns": from_ns, "stalled_to_ns": to_ns}

    def _preamble(self, writer: str, at_ns: int) -> list[tuple[str, bytes]]:
        """Return the own records that each file begins with: run and clock."""
        clock = self._clock_record(at_ns, self._clock_seen_ns)
        return [(channels.RUN, self._run_record(writer)), (channels.CLOCK, clock)]

    def _run_record(self, writer: str) -> bytes:
        items = {name: item.describe() for name, item in list(self.items.items())}
        return msgspec.json.encode(
            {
                "writer": writer,
                "run": self.run,
                "store_id": self.store.id,
                "boot_id": self.options.boot_id,
                "robot": self.options.robot,
                "config_hash": self.options.config_hash,
                "version": __version__,
                "items": msgspec.json.encode(items).decode(),
                "input": self.options.input,
            }
        )

    def _clock_record(self, at_ns: int, offset_ns: int) -> bytes:
        values = {
            "offset_ns": offset_ns,
            "synchronised": self.clock.synchronised(),
            "boot_ns": self.clock.boot_ns(at_ns),
        }
        return msgspec.json.encode(values)

    # -- clock, sync, end

    def _watch_clock(self, now_ns: int) -> None:
        """Record wall minus log time periodically; at a step, also the value before."""
        offset, written_ns = self.clock.offset_ns(), self._clock_written_ns
        step = abs(offset - self._clock_offset_ns)
        if self.disk_error or step > EPOCH_STEP_NS:
            return
        if written_ns is not None and step > CLOCK_STEP_NS:
            self._own_clock(self._last_tick_ns, self._clock_seen_ns)
        period_ns = SPARING_CLOCK_PERIOD_NS if self.full else CLOCK_PERIOD_NS
        if written_ns is None or step > CLOCK_STEP_NS or now_ns - written_ns >= period_ns:
            self._own_clock(now_ns, offset)
            self._clock_offset_ns, self._clock_written_ns = offset, now_ns
        self._clock_seen_ns = offset

    def _own_clock(self, at_ns: int, offset_ns: int) -> None:
        with self._own_lock:
            self._own.append((channels.CLOCK, self._clock_record(at_ns, offset_ns), at_ns))

    def _new_epoch(self, step_ns: int) -> None:
        self._journals.new_epoch()
        before_ns = self.clock.now_ns()
        self.clock.new_epoch()
        now_ns = self.clock.now_ns()
        self.gaps.shift(now_ns - before_ns)
        self.queue.shift_drops(list(self.items.values()), now_ns - before_ns)
        self.watermark.begin(now_ns, now_ns - before_ns)
        self._is_first_of_epoch = True
        for item in list(self.items.values()):
            item.written_ns = 0
        self._clock_offset_ns, self._clock_written_ns = 0, now_ns
        self._clock_seen_ns = 0
        self._last_tick_ns = self._counted_ns = now_ns
        self.event("clock_step", f"the wall clock stepped by {step_ns / NS:.3f} s: new epoch")

    def rotate(self) -> None:
        """Begin new files with the next write; from any thread."""
        self._rotates = True

    def mark_sync(self) -> list[SyncMark]:
        """Return the marks whose ``wait`` makes everything written so far durable."""
        return self._journals.mark_sync()

    def close(self) -> None:
        """Write the remaining rows, finish the files, release the locks of the store.

        Raises AmberboxError when the rows cannot be written.
        """
        self.gaps.close(self.clock.now_ns())
        self.watermark.release()
        if self._admission is not None:
            self._admission.end()
        had_trouble = self.disk_error
        self.tick()
        if had_trouble:  # counts not recorded meanwhile
            self.tick()
        if self.room is not None:
            self.room.release_if_tight()
        lost, refused = self._journals.unwritten(), self._journals.close()
        for lock in self._locks:
            lock.release()
        if refused:
            raise AmberboxError(
                f"the disk does not take data: {refused}; {lost} messages are lost",
                f"make room at {self.store.path}",
            )

    @property
    def disk_error(self) -> str:
        """Return the text of the last write error; empty once a write has succeeded."""
        return self._journals.disk_error

    @property
    def full(self) -> str:
        """Return why only events are recorded; empty while everything is."""
        return self.room.reason if self.room is not None else ""

    @property
    def bytes_written(self) -> int:
        """Bytes this run has put into its journals."""
        return self._journals.bytes_written

    @property
    def journal_paths(self) -> list[Path]:
        """Files being written right now."""
        return self._journals.paths
