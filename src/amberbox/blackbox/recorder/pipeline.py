"""From the queue through the filters into the journals: everything is accounted for.

``tick`` does one write interval's work and runs in one thread. The recorder calls it every
``write_s``; an import calls it whenever enough has been read.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any, Protocol

import msgspec

from amberbox import __version__
from amberbox.blackbox.follow.chain import previous_chain
from amberbox.blackbox.follow.follow import RECORDED
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.syncmark import SyncMark
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.recorder.admission import Admission
from amberbox.blackbox.recorder.filtering import Message, change_filtered, rate_limited
from amberbox.blackbox.recorder.gaplog import GapLog
from amberbox.blackbox.recorder.intake import Intake
from amberbox.blackbox.recorder.journals import Journals
from amberbox.blackbox.recorder.messageclock import MessageClock
from amberbox.blackbox.recorder.names import ItemNames
from amberbox.blackbox.recorder.room import DISK_FULL, Room
from amberbox.blackbox.recorder.stalls import StallMeter
from amberbox.blackbox.recorder.streams import Item, Stream
from amberbox.blackbox.store import Store, WriterLock
from amberbox.core.clock import NS, RunClock
from amberbox.core.errors import AmberboxError
from amberbox.core.source import Power, TopicOptions

CLOCK_PERIOD_NS = 10 * NS
SPARING_CLOCK_PERIOD_NS = 60 * NS
"""The same while only events are recorded, so that their room lasts."""
CLOCK_STEP_NS = 50_000_000
EPOCH_STEP_NS = NS
STALL_EVENT_NS = NS
"""A stall of the recorder is an event of its own if it was that long."""
HEARTBEAT_NS = NS
"""In silence the counters are still written this often, so that replay's watermark advances."""


class LogClock(Protocol):
    """What stamps messages: a RunClock, or a MessageClock where messages bring their time."""

    def now_ns(self) -> int:
        """Log time."""

    def boot_ns(self, log_ns: int) -> int | None:
        """Time since the computer's start at a log time; None if it does not count from there."""

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
    room: Room | None = None
    """Room set aside for the last events of a full disk; an import has none."""
    items: dict[str, Item] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._locks = [WriterLock(self.store, writer) for writer in RECORDED]
        self.run = self.store.next_run()
        self.intake = Intake(self.options.queue_bytes)
        self.names = ItemNames(self.store.path, is_new=self.run == 1)
        self._own: list[tuple[str, bytes, int]] = []
        self._own_lock = threading.Lock()
        self._items_lock = threading.Lock()
        self._journals = Journals(self._writer, self._preamble, self.event, self._make_room)
        self._last_tick_ns = 0
        self._clock_written_ns: int | None = None
        self._clock_offset_ns = 0
        self._clock_seen_ns = 0
        self._rotates = False
        self._counted_ns = 0
        self._filter_error = ""
        self.power: Power | None = None
        """How the box is powered, as a source has said last; None if none has."""
        self.stalls: StallMeter | None = None
        """Measures when the recorder is held up; None where messages bring their time."""
        self.on_event: Callable[[str, str], None] | None = None
        now_ns = self.clock.now_ns()  # the clock may have been set back since the last run
        start = now_ns if self.start_gap_ns is None else min(self.start_gap_ns, now_ns)
        self.gaps = GapLog(lambda values: self.own(reserved.GAP, values), start)
        if start < now_ns:
            self.gaps.pause(now_ns)
        self._admission: Admission | None = None
        if self.names.restored:
            self.event("restored", self.names.restored)
        if self.room is not None:
            self._admission = Admission(self.room, self.intake, self.gaps, self.event)

    def _writer(self, writer: str) -> JournalWriter:
        options = self.options
        age = options.ring_rotate_ns if writer == "ring" else options.rotate_ns
        journal = JournalOptions(
            self.store.folder(writer), self.store.id, writer, self.run, options.boot_id,
            options.rotate_bytes, age,
        )  # fmt: skip
        # an import is staged elsewhere, but follows what the store has
        chain = previous_chain(Store(self.store.path, self.store.id), writer)
        return JournalWriter(journal, chain=chain)

    # -- what sources and the recorder put in

    def item(self, source: str, topic: str, options: TopicOptions) -> Item:
        """Return the data item of a topic, making it at its first mention."""
        name = self.names.name(source, topic)
        with self._items_lock:
            item = self.items.get(name)
            if item is None:
                item = self.items[name] = Item(name, source, topic, options)
                if options.keep != "none":
                    self._journals.use(item.writer)
            return item

    def latched(self, stream: Stream) -> None:
        """Have the last message of a stream repeated in each file, also one of an earlier run."""
        if stream.item.options.keep != "none":
            self._journals.repeat(stream)

    def own(self, topic: str, values: Mapping[str, Any]) -> None:
        """Write a record of the box's own, stamped now."""
        with self._own_lock:
            self._own.append((topic, msgspec.json.encode(values), self.clock.now_ns()))

    def event(self, kind: str, text: str, source: str = "", **details: Any) -> None:
        """Write an event, at once."""
        if self.on_event is not None:
            self.on_event(kind, text)
        encoded = msgspec.json.encode(details, enc_hook=str).decode()
        self.own(reserved.EVENT, {"kind": kind, "text": text, "source": source, "details": encoded})
        self.intake.wake.set()

    # -- one write interval

    def tick(self) -> None:
        """Write what has come since the last tick; when the disk refuses, keep it and say so."""
        taken = self.intake.take()
        if self._admission is not None:
            taken = self._admission.put_off(taken, self.bytes_written)
        now_ns = self._advance(taken)
        self._watch_clock(now_ns)
        kept = rate_limited(taken, self._last_tick_ns, now_ns)
        if self._admission is not None:
            kept = self._admission.admit(kept, now_ns)
        self._sort_into_journals(self._filtered(kept), now_ns)
        if self._rotates:
            self._rotates = False
            self._journals.rotate()
        if self._journals.flush(now_ns):
            self.intake.release()
            self._follow_steps()
        self._journals.publish_heads(now_ns)

    def _filtered(self, messages: list[Message]) -> list[Message]:
        """Drop what did not change; a filter that fails keeps everything rather than nothing."""
        try:
            return change_filtered(messages, self.event)
        except Exception as error:  # whatever a message does to it, the recorder goes on
            items = sorted({stream.item.name for stream, _, _ in messages})
            text = f"a change filter or schema inference failed: {error!r}; kept unfiltered"
            if text != self._filter_error:
                self._filter_error = text
                self.event("filter_failed", text, items=items)
            return messages

    def _advance(self, taken: Sequence[Message]) -> int:
        """Return the time of this tick; never before the one of the last tick."""
        if taken and isinstance(self.clock, MessageClock):
            self.clock.heard(max(map(itemgetter(2), taken)))
        return max(self.clock.now_ns(), self._last_tick_ns)

    def _make_room(self, writer: str) -> bool:
        """Give up what there is to give, so that a full disk takes the rest; False if nothing."""
        if self._admission is None or self.room is None:
            return False
        if writer in self._admission.elsewhere:
            self._admission.refuse(self._journals.take_back(writer), f"no room for the {writer}")
            self._journals.forget_own(writer)
            return True
        if not self.room.release():
            return False
        self._admission.say()
        for other in RECORDED:
            if other not in self._admission.elsewhere:
                late = self._journals.take_back(other, self.room.spared_bytes)
                self._admission.refuse(late, DISK_FULL)
        return True

    def keep_elsewhere(self, writers: Collection[str]) -> None:
        """Say which journals lie on another disk than the store."""
        if self._admission is not None:
            self._admission.elsewhere = writers

    def _account_due(self, now_ns: int) -> bool:
        if self.disk_error:  # accounts of a long trouble would fill the memory
            return False
        return self._admission is None or self._admission.account_due(now_ns)

    def _note_drops(self) -> None:
        for item in list(self.items.values()):
            for reason, drops in self.intake.take_drops(item).items():
                self.gaps.dropped(item.name, drops, reason)

    # -- into the journals

    def _sort_into_journals(self, kept: Iterable[Message], now_ns: int) -> None:
        for stream, data, received_ns in kept:
            item = stream.item
            item.counters.kept += 1
            item.counters.bytes += len(data)
            if stream.topic.latched:
                item.last_latched = data
            self._journals.add(stream, received_ns, data)
        if self._account_due(now_ns):
            self._note_drops()
            self._count(now_ns)
        for name, data, at_ns in self._take_own():
            at_ns = min(max(at_ns, self._last_tick_ns), max(now_ns, self.clock.now_ns()))
            for writer in self._writers_of(name):
                self._journals.add_own(writer, name, at_ns, data)
        self._last_tick_ns = now_ns

    def _writers_of(self, name: str) -> list[str]:
        """Own records go to the main journal, those of the clock to every file that is open."""
        return self._journals.open_writers() if name == reserved.CLOCK else ["main"]

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
                changed.append({"item": item.name, **item.counters.record()})
        silent = self.options.counts_silence and now_ns - self._counted_ns >= HEARTBEAT_NS
        stalled = self._stalled(now_ns)
        if changed or silent or stalled:
            self._counted_ns = now_ns
            with self._own_lock:
                encoded = msgspec.json.encode({"items": changed, **stalled})
                self._own.append((reserved.COUNTERS, encoded, now_ns))

    def _stalled(self, now_ns: int) -> dict[str, int]:
        """Return when the recorder was held up since the last count; empty if it was not.

        It is part of the counts, which say up to when the record is complete: whoever goes by
        these knows of it before evaluating an instant of it.
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
        """Return the own records that each file begins with: the run and the clock."""
        clock = self._clock_record(at_ns, self._clock_seen_ns)
        return [(reserved.RUN, self._run_record(writer)), (reserved.CLOCK, clock)]

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
        """Record wall minus log time now and then; at a step, what it was before as well."""
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
            self._own.append((reserved.CLOCK, self._clock_record(at_ns, offset_ns), at_ns))

    def _follow_steps(self) -> None:
        """After a large step of the wall clock begin a new epoch in new files."""
        step = abs(self.clock.offset_ns() - self._clock_offset_ns)
        if step > EPOCH_STEP_NS:
            self._new_epoch(step)

    def _new_epoch(self, step_ns: int) -> None:
        self._journals.rotate()
        before_ns = self.clock.now_ns()
        self.clock.new_epoch()
        now_ns = self.clock.now_ns()
        self.gaps.shift(now_ns - before_ns)
        self.intake.shift_drops(list(self.items.values()), now_ns - before_ns)
        self._clock_offset_ns, self._clock_written_ns = 0, now_ns
        self._clock_seen_ns = 0
        self._last_tick_ns = self._counted_ns = now_ns
        self.event("clock_step", f"the wall clock stepped by {step_ns / NS:.3f} s: new epoch")

    def rotate(self) -> None:
        """Begin new files with the next write; from any thread."""
        self._rotates = True

    def mark_sync(self) -> list[SyncMark]:
        """Return what makes everything written so far durable."""
        return self._journals.mark_sync()

    def close(self) -> None:
        """Write the rest, finish the files, give the store free.

        Raises AmberboxError when the disk does not take the rest.
        """
        self.gaps.close(self.clock.now_ns())
        if self._admission is not None:
            self._admission.end()
        had_trouble = self.disk_error
        self.tick()
        if had_trouble:  # what was not accounted for meanwhile
            self.tick()
        if self.room is not None:
            self.room.relieve()
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
        """What the disk said when it last refused a write; empty when all is well."""
        return self._journals.disk_error

    @property
    def full(self) -> str:
        """Why only events are recorded; empty while everything is."""
        return self.room.reason if self.room is not None else ""

    @property
    def bytes_written(self) -> int:
        """Bytes this run has put into its journals."""
        return self._journals.bytes_written

    @property
    def journal_paths(self) -> list[Path]:
        """Files being written right now."""
        return self._journals.paths
