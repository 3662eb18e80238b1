"""The journals of a run: rows wait here until their disk has taken them, each exactly once."""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence
from contextlib import suppress
from operator import itemgetter
from pathlib import Path
from typing import TypeAlias

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.syncmark import SyncMark
from amberbox.blackbox.journal.writer import JournalWriter
from amberbox.blackbox.recorder.streams import Item, Stream, Tell, tell_no_stamp
from amberbox.core.types import Topic

Row: TypeAlias = tuple[int, int, int, bytes]
"""Channel, log time, publish time, message."""

Preamble: TypeAlias = Callable[[str, int], Sequence[tuple[str, bytes]]]
"""What a writer's file begins with at a log time."""

MakeRoom: TypeAlias = Callable[[str], bool]
"""Asked when a writer's disk is full; False if nothing can be done about it."""

_FULL = (errno.ENOSPC, errno.EDQUOT)


class Journals:
    """One journal per keeping class in use; all but ``use`` belongs to the writing thread."""

    def __init__(
        self,
        make: Callable[[str], JournalWriter],
        preamble: Preamble,
        tell: Tell,
        make_room: MakeRoom,
    ) -> None:
        self._make = make
        self._preamble_of = preamble
        self._tell = tell
        self._make_room = make_room
        self._writers: dict[str, JournalWriter] = {"main": make("main")}
        self._pending: dict[str, list[Row]] = {}
        self._channels: dict[tuple[str, Topic, str], int] = {}
        self._items: dict[tuple[str, int], Item] = {}
        self._own_channels: dict[tuple[str, str], int] = {}
        self._repeats: dict[tuple[str, int], Stream] = {}
        self._latched: list[Stream] = []
        self.disk_error = ""
        """What the disk said when it last refused a write; empty when all is well."""

    def use(self, writer: str) -> None:
        """Begin a journal if there is none yet; from any thread."""
        if writer not in self._writers:
            self._writers[writer] = self._make(writer)

    def repeat(self, stream: Stream) -> None:
        """Repeat the last message of a latched stream in each file; from any thread."""
        self._latched.append(stream)

    def open_writers(self) -> list[str]:
        """Name the journals that have a file open, and the main one."""
        writers = list(self._writers.items())
        return [name for name, writer in writers if name == "main" or writer.path]

    def add(self, stream: Stream, received_ns: int, data: bytes) -> None:
        """Take a message to be written."""
        if stream.channel < 0:
            stream.channel = self._channel(stream)
        stamp_ns = stream.stamp_ns(data)
        if stamp_ns is None:
            tell_no_stamp(stream, data, self._tell)
        row = (stream.channel, received_ns, stamp_ns or received_ns, data)
        self._pending.setdefault(stream.item.writer, []).append(row)

    def add_own(self, writer: str, name: str, at_ns: int, data: bytes) -> None:
        """Take a record of the box's own to be written."""
        row = (self._own_channel(writer, name), at_ns, at_ns, data)
        self._pending.setdefault(writer, []).append(row)

    def flush(self, now_ns: int) -> bool:
        """Write all pending rows; False when a disk did not take them (they stay pending)."""
        errors = self._write_pending(now_ns)
        full = [name for name, error in errors.items() if error.errno in _FULL]
        made = [self._make_room(name) for name in full]
        if any(made):
            errors = self._write_pending(now_ns)
        for error in errors.values():
            self._note_disk_error(error)
            return False
        if self.disk_error:
            self.disk_error = ""
            self._tell("disk", "the disk takes data again")
        return True

    def _write_pending(self, now_ns: int) -> dict[str, OSError]:
        """Write what can be written; return what went wrong, by writer."""
        errors = {}
        for name, rows in self._pending.items():
            rows.sort(key=itemgetter(1))
            try:
                if rows:
                    self._write(name, rows, now_ns)
            except OSError as error:
                errors[name] = error
        return errors

    def take_back(self, writer: str, spared_bytes: int = 0) -> list[tuple[Item, int]]:
        """Take the newest messages of sources back that wait for a disk; return item and time.

        The oldest ones, up to ``spared_bytes``, the box's own records, and what files hold that
        are read without loss, go on waiting.
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
        """Drop what waits of the box's own: it stands in another journal as well."""
        self._pending[writer] = []

    def _write(self, name: str, rows: list[Row], now_ns: int) -> None:
        writer = self._writers[name]
        if writer.rotation_due(now_ns):
            writer.rotate()
        preamble = self._preamble(name, rows[0][1]) if writer.path is None else []
        rows[:0] = preamble
        before = writer.next_seq
        try:
            channels, log_ns, publish_ns, messages = zip(*rows, strict=True)
            writer.write(channels, log_ns, publish_ns, messages)
        finally:  # what was written in whole chunks before an error is not written again
            if writer.path is None:  # no file was made: the next attempt has its own preamble
                del rows[: len(preamble)]
            del rows[: writer.next_seq - before]

    def _preamble(self, writer: str, at_ns: int) -> list[Row]:
        """Return what each file begins with: the run, the clock, the last latched messages."""
        rows: list[Row] = [
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

    def _note_disk_error(self, error: OSError) -> None:
        text = error.strerror or str(error)
        if text != self.disk_error:
            self.disk_error = text
            self._tell("disk", f"the disk does not take data: {text}")

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
            number = self._channels[key] = writer.channel(topic, marks)
            self._items[item.writer, number] = item
            if topic.latched:
                self._repeat_on(writer.channel(topic, {**marks, "repeated": "1"}), stream)
        return self._channels[key]

    def _repeat_on(self, channel: int, stream: Stream) -> None:
        """Repeat an item's message on this channel, no longer on that of an older definition."""
        for key, other in list(self._repeats.items()):
            if other.item is stream.item:
                del self._repeats[key]
        self._repeats[stream.item.writer, channel] = stream

    def _own_channel(self, writer: str, name: str) -> int:
        key = (writer, name)
        if key not in self._own_channels:
            marks = {"item": name.replace("/", "_"), "source": reserved.SOURCE}
            topic = reserved.topic_of(name)
            self._own_channels[key] = self._writers[writer].channel(topic, marks)
        return self._own_channels[key]

    def publish_heads(self, watermark_ns: int) -> None:
        """Tell followers how far the journals reach."""
        with suppress(OSError):  # a hint for followers only, and the flush has told of the disk
            for writer in list(self._writers.values()):
                writer.publish_head(0 if self.disk_error else watermark_ns)

    def rotate(self) -> None:
        """Begin new files with the next write."""
        for writer in list(self._writers.values()):
            writer.rotate()

    def mark_sync(self) -> list[SyncMark]:
        """Return what makes everything written so far durable."""
        return [writer.mark_sync() for writer in list(self._writers.values())]

    def close(self) -> str:
        """Finish the files; return what the disk said if it refused anything, else nothing."""
        refused = self.disk_error
        for writer in list(self._writers.values()):
            try:
                writer.close()
            except OSError as error:  # without its end the file is read by walking it
                refused = error.strerror or str(error)
        return refused

    def unwritten(self) -> int:
        """Count the messages of sources that wait for the disk."""
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
