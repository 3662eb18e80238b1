"""From the queue to the journals: filter, infer schemas, write, account for everything.

``tick`` does one write interval's work and runs in one thread. The recorder calls it every
``write_s``; an import calls it whenever enough has been read.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np
from msgspec import structs

from amberbox import __version__
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter, SyncMark
from amberbox.blackbox.recorder.gaplog import GapLog
from amberbox.blackbox.recorder.intake import Intake
from amberbox.blackbox.recorder.messageclock import MessageClock
from amberbox.blackbox.recorder.names import ItemNames
from amberbox.blackbox.recorder.streams import Item, Stream
from amberbox.blackbox.store import Store, WriterLock
from amberbox.blackbox.unroll import UnrollError
from amberbox.blackbox.unroll.infer import widen
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.source import TopicOptions
from amberbox.core.types import Topic

CLOCK_PERIOD_NS = 10 * NS
CLOCK_STEP_NS = 50_000_000
EPOCH_STEP_NS = NS
HEARTBEAT_NS = NS
"""In silence the counters are still written this often, so that replay's watermark advances."""

Message = tuple[Stream, bytes, int]


class LogClock(Protocol):
    """What stamps messages: a RunClock, or a MessageClock where messages bring their time."""

    def now_ns(self) -> int:
        """Log time."""

    def offset_ns(self) -> int:
        """Wall minus log time."""

    def new_epoch(self) -> None:
        """Take wall time for the start of log time."""

    def synchronised(self) -> bool | None:
        """Tell whether the wall clock is disciplined."""


@dataclass(frozen=True)
class PipelineOptions:
    """How a run writes."""

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
    clock: LogClock
    options: PipelineOptions
    start_gap_ns: int | None = None
    """Received time up to which an earlier run reaches; gaps of this run begin there."""
    items: dict[str, Item] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._locks = [WriterLock(self.store, writer) for writer in ("main", "ring")]
        self.run = self.store.next_run()
        self.intake = Intake(self.options.queue_bytes)
        self.names = ItemNames(self.store.path)
        self._own: list[tuple[str, bytes, int]] = []
        self._own_lock = threading.Lock()
        self._items_lock = threading.Lock()
        self._writers: dict[str, JournalWriter] = {"main": self._writer("main")}
        self._own_channels: dict[tuple[str, str], int] = {}
        self._channels: dict[tuple[str, Topic, str], int] = {}
        self._repeats: dict[tuple[str, str], int] = {}
        self._latched: list[Stream] = []
        self._pending: dict[str, list[Any]] = {}
        self._floor_ns = self._last_tick_ns = 0
        self._clock_written_ns: int | None = None
        self._clock_offset_ns = 0
        self._counted_ns = 0
        self._disk_error = ""
        now_ns = self.clock.now_ns()  # the clock may have been set back since the last run
        start = now_ns if self.start_gap_ns is None else min(self.start_gap_ns, now_ns)
        self.gaps = GapLog(lambda values: self.own(reserved.GAP, values), start)

    def _writer(self, writer: str) -> JournalWriter:
        options = self.options
        age = options.rotate_ns if writer == "main" else options.ring_rotate_ns
        return JournalWriter(
            JournalOptions(
                self.store.folder(writer), self.store.id, writer, self.run, options.boot_id,
                options.rotate_bytes, age,
            )
        )  # fmt: skip

    # -- what sources and the recorder put in

    def item(self, source: str, topic: str, options: TopicOptions) -> Item:
        """Return the data item of a topic, making it at its first mention."""
        name = self.names.name(source, topic)
        with self._items_lock:
            item = self.items.get(name)
            if item is None:
                item = self.items[name] = Item(name, source, topic, options)
                if options.keep in ("ring", "incident") and "ring" not in self._writers:
                    self._writers["ring"] = self._writer("ring")
            return item

    def latched(self, stream: Stream) -> None:
        """Have the last message of a stream repeated in each file, also one of an earlier run."""
        if stream.item.options.keep != "none":
            self._latched.append(stream)

    def own(self, topic: str, values: Mapping[str, Any]) -> None:
        """Write a record of the box's own, stamped now."""
        with self._own_lock:
            self._own.append((topic, msgspec.json.encode(values), self.clock.now_ns()))

    def event(self, kind: str, text: str, source: str = "", **details: Any) -> None:
        """Write an event, at once."""
        encoded = msgspec.json.encode(details, enc_hook=str).decode()
        self.own(reserved.EVENT, {"kind": kind, "text": text, "source": source, "details": encoded})
        self.intake.wake.set()

    # -- one write interval

    def tick(self) -> None:
        """Write what has come since the last tick; when the disk refuses, keep it and say so."""
        taken = self.intake.take()
        now_ns = self._advance(taken)
        kept = self._change_filtered(self._rate_limited(taken, now_ns))
        self._note_drops()
        self._sort_into_journals(kept, now_ns)
        if self._flush(now_ns):
            self.intake.release()
            self._follow_wall_clock()
        with suppress(OSError):  # a hint for followers only, and the flush has told of the disk
            for writer in list(self._writers.values()):
                writer.publish_head(now_ns if not self._disk_error else 0)

    def _advance(self, taken: Sequence[Message]) -> int:
        """Return the time of this tick; never before the one of the last tick."""
        if taken and isinstance(self.clock, MessageClock):
            self.clock.heard(max(map(itemgetter(2), taken)))
        return max(self.clock.now_ns(), self._floor_ns)

    def _rate_limited(self, taken: Iterable[Message], now_ns: int) -> list[Message]:
        floor, kept = self._floor_ns, []
        for message in taken:
            stream, _, received_ns = message
            item = stream.item
            if item.options.keep == "none":
                continue
            if not floor <= received_ns <= now_ns:  # stamped before a tick or a new epoch
                message = (stream, message[1], min(max(received_ns, floor), now_ns))
            if item.rate is not None and not item.rate.accept(message[2]):
                item.counters.rate_limited += 1
                continue
            kept.append(message)
        kept.sort(key=itemgetter(2))
        self._floor_ns = max(now_ns, kept[-1][2]) if kept else now_ns
        return kept

    def _change_filtered(self, kept: list[Message]) -> list[Message]:
        """Infer schemas, then drop what did not change for items that ask for it."""
        places: dict[int, list[int]] = {}
        for place, (stream, _, _) in enumerate(kept):
            if stream.infers or stream.item.options.change is not None:
                places.setdefault(id(stream), []).append(place)
        unchanged: set[int] = set()
        for found in places.values():
            stream = kept[found[0]][0]
            if stream.infers:
                stream = self._inferred(stream, [kept[place][1] for place in found])
                for place in found:
                    kept[place] = (stream, *kept[place][1:])
            if stream.item.options.change is not None:
                unchanged.update(self._unchanged(stream, kept, found))
        if not unchanged:
            return kept
        return [message for place, message in enumerate(kept) if place not in unchanged]

    def _inferred(self, stream: Stream, messages: Sequence[bytes]) -> Stream:
        """Return the stream whose schema holds all these messages; a wider one is an event."""
        topic = stream.topic
        schema, bad = widen(topic.schema, messages, topic.message_encoding, stream.item.name)
        if bad:
            self._note_malformed(stream, len(bad))
        if schema is topic.schema:
            return stream
        if topic.schema is not None:
            self.event("schema_widened", f"{stream.item.name} has new or wider variables",
                       stream.item.source, item=stream.item.name)  # fmt: skip
        stream.topic = Topic(topic.name, topic.message_encoding, schema, topic.latched)
        stream.channel = -1
        stream.compile()
        return stream

    def _note_malformed(self, stream: Stream, count: int) -> None:
        item = stream.item
        if not item.malformed:
            self.event("malformed", f"{item.name}: a message is no valid "
                       f"{stream.topic.message_encoding}; it is kept as it came",
                       item.source, item=item.name)  # fmt: skip
        item.malformed += count

    def _unchanged(self, stream: Stream, kept: list[Message], places: list[int]) -> list[int]:
        if stream.stamps is None or stream.change is None:
            return []
        try:
            rows = stream.stamps.rows([kept[place][1] for place in places])
        except UnrollError as error:
            bad = {places[row] for row in error.bad}
            rest = [place for place in places if place not in bad]
            return self._unchanged(stream, kept, rest) if rest else []
        times = np.fromiter((kept[place][2] for place in places), np.int64, len(places))
        mask = stream.change.mask(rows, times)
        dropped = [place for place, keep in zip(places, mask.tolist(), strict=True) if not keep]
        stream.counters.unchanged += len(dropped)
        return dropped

    def _note_drops(self) -> None:
        for item in list(self.items.values()):
            drops = self.intake.take_drops(item)
            if drops is not None:
                self.gaps.dropped(item.name, drops[0], drops[1] + 1, drops[2])

    # -- into the journals

    def _sort_into_journals(self, kept: Iterable[Message], now_ns: int) -> None:
        for stream, data, received_ns in kept:
            item = stream.item
            item.counters.kept += 1
            item.counters.bytes += len(data)
            if stream.topic.latched:
                item.last_latched = data
            if stream.channel < 0:
                stream.channel = self._channel(stream)
            row = (stream.channel, received_ns, stream.stamp_ns(data, received_ns), data)
            self._pending.setdefault(item.writer, []).append(row)
        self._count(now_ns)
        for name, data, at_ns in self._take_own():
            at_ns = min(max(at_ns, self._last_tick_ns), max(now_ns, self.clock.now_ns()))
            for writer in self._writers_of(name):
                row = (self._own_channel(writer, name), at_ns, at_ns, data)
                self._pending.setdefault(writer, []).append(row)
        for rows in self._pending.values():
            rows.sort(key=itemgetter(1))
        self._last_tick_ns = now_ns

    def _writers_of(self, name: str) -> list[str]:
        """Own records go to the main journal, those of the clock to every file that is open."""
        if name != reserved.CLOCK:
            return ["main"]
        writers = list(self._writers.items())
        return [name for name, writer in writers if name == "main" or writer.path]

    def _take_own(self) -> list[tuple[str, bytes, int]]:
        with self._own_lock:
            taken, self._own = self._own, []
        return taken

    def _count(self, now_ns: int) -> None:
        """Write the counters of items that something happened to, or a heartbeat in silence."""
        changed = []
        for item in list(self.items.values()):
            if item.counters != item.reported:
                item.reported = copy(item.counters)
                changed.append({"item": item.name, **structs.asdict(item.counters)})
        silent = self.options.counts_silence and now_ns - self._counted_ns >= HEARTBEAT_NS
        if changed or silent:
            self._counted_ns = now_ns
            with self._own_lock:
                encoded = msgspec.json.encode({"items": changed})
                self._own.append((reserved.COUNTERS, encoded, now_ns))

    def _flush(self, now_ns: int) -> bool:
        """Write all pending rows; False when a disk did not take them (they stay pending)."""
        try:
            for name, rows in self._pending.items():
                if rows:
                    self._write(name, rows, now_ns)
        except OSError as error:
            self._note_disk_error(error)
            return False
        if self._disk_error:
            self._disk_error = ""
            self.event("disk", "the disk takes data again")
        return True

    def _write(self, name: str, rows: list[Any], now_ns: int) -> None:
        writer = self._writers[name]
        if writer.rotation_due(now_ns):
            writer.rotate()
        preamble = self._preamble(name, rows[0][1]) if writer.path is None else []
        rows[:0] = preamble
        before = writer.next_seq
        try:
            writer.write(*_columns(rows))
        finally:  # what was written in whole chunks before an error is not written again
            if writer.path is None:  # no file was made: the next attempt has its own preamble
                del rows[: len(preamble)]
            del rows[: writer.next_seq - before]

    def _note_disk_error(self, error: OSError) -> None:
        text = error.strerror or str(error)
        if text != self._disk_error:
            self._disk_error = text
            self.event("disk", f"the disk does not take data: {text}")

    @property
    def disk_error(self) -> str:
        """What the disk said when it last refused a write; empty when all is well."""
        return self._disk_error

    def _preamble(self, writer: str, at_ns: int) -> list[Any]:
        """Return what each file begins with: the run, the clock, the last latched messages."""
        rows = [
            (self._own_channel(writer, reserved.RUN), at_ns, at_ns, self._run_record(writer)),
            (self._own_channel(writer, reserved.CLOCK), at_ns, at_ns, self._clock_record()),
        ]
        for stream in list(self._latched):
            if stream.item.last_latched is not None:
                self._channel(stream)
        for (item_name, of_writer), channel in self._repeats.items():
            data = self.items[item_name].last_latched
            if of_writer == writer and data is not None:
                rows.append((channel, at_ns, at_ns, data))
        return rows

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

    def _clock_record(self) -> bytes:
        values = {
            "offset_ns": self._clock_offset_ns,
            "synchronised": self.clock.synchronised(),
        }
        return msgspec.json.encode(values)

    def _channel(self, stream: Stream) -> int:
        """Register the channel of a stream, and the one that repeats its latched message."""
        item, topic = stream.item, stream.topic
        key = (item.writer, topic, item.name)
        if key not in self._channels:
            marks = {"item": item.name, "source": item.source}
            if item.options.stamp is not None:
                marks["stamp"] = item.options.stamp
            if topic.latched:
                marks["latched"] = "1"
            writer = self._writers[item.writer]
            self._channels[key] = writer.channel(topic, marks)
            if topic.latched:
                repeat = writer.channel(topic, {**marks, "repeated": "1"})
                self._repeats[item.name, item.writer] = repeat
        return self._channels[key]

    def _own_channel(self, writer: str, name: str) -> int:
        key = (writer, name)
        if key not in self._own_channels:
            item = name.replace("/", "_")
            self._own_channels[key] = self._writers[writer].channel(
                reserved.topic_of(name), {"item": item, "source": reserved.SOURCE}
            )
        return self._own_channels[key]

    # -- clock, sync, end

    def _follow_wall_clock(self) -> None:
        """Record wall minus log time; after a large step begin a new epoch in new files."""
        now_ns, offset = self.clock.now_ns(), self.clock.offset_ns()
        step = abs(offset - self._clock_offset_ns)
        if step > EPOCH_STEP_NS:
            self._new_epoch(step)
            return
        due = self._clock_written_ns is None or now_ns - self._clock_written_ns >= CLOCK_PERIOD_NS
        if due or step > CLOCK_STEP_NS:
            self._clock_offset_ns, self._clock_written_ns = offset, now_ns
            values = {"offset_ns": offset, "synchronised": self.clock.synchronised()}
            self.own(reserved.CLOCK, values)

    def _new_epoch(self, step_ns: int) -> None:
        for writer in list(self._writers.values()):
            with suppress(OSError):  # on a full disk the file stays without its end
                writer.rotate()
        before_ns = self.clock.now_ns()
        self.clock.new_epoch()
        now_ns = self.clock.now_ns()
        self.gaps.shift(now_ns - before_ns)
        self._clock_offset_ns, self._clock_written_ns = 0, now_ns
        self._floor_ns = self._last_tick_ns = self._counted_ns = now_ns
        self.event("clock_step", f"the wall clock stepped by {step_ns / NS:.3f} s: new epoch")

    def mark_sync(self) -> list[SyncMark]:
        """Return what makes everything written so far durable."""
        return [writer.mark_sync() for writer in list(self._writers.values())]

    def close(self) -> None:
        """Write the rest, finish the files, give the store free.

        Raises AmberboxError when the disk does not take the rest.
        """
        self.gaps.close(self.clock.now_ns())
        self.tick()
        lost, refused = self._unwritten(), self._disk_error
        for writer in self._writers.values():
            try:
                writer.close()
            except OSError as error:  # without its end the file is read by walking it
                refused = error.strerror or str(error)
        for lock in self._locks:
            lock.release()
        if refused:
            raise AmberboxError(
                f"the disk does not take data: {refused}; {lost} messages are lost",
                f"make room at {self.store.path}",
            )

    def _unwritten(self) -> int:
        """Count the messages of sources that wait for the disk."""
        own = {(writer, number) for (writer, _), number in self._own_channels.items()}
        waiting = [(writer, row[0]) for writer, rows in self._pending.items() for row in rows]
        return sum(channel not in own for channel in waiting)

    @property
    def bytes_written(self) -> int:
        """Bytes this run has put into its journals."""
        return sum(writer.bytes_written for writer in list(self._writers.values()))

    @property
    def journal_paths(self) -> list[Path]:
        """Files being written right now."""
        return [writer.path for writer in list(self._writers.values()) if writer.path]


def _columns(rows: Sequence[Any]) -> tuple[Any, Any, Any, Any]:
    channels, log_ns, publish_ns, messages = zip(*rows, strict=True)
    return channels, log_ns, publish_ns, messages
