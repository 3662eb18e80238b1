"""The journal writer: MCAP files that survive power cuts.

One ``write`` puts complete chunks with their indices into the file, visible to readers and safe
from ``kill -9``. ``mark_sync`` closes a link of the hash chain and returns the object whose
``wait`` makes it durable.
"""

from __future__ import annotations

import errno
import hashlib
import os
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import zstandard
from numpy.typing import NDArray

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.chunk import overlapping_numbers
from amberbox.blackbox.journal.mcap import (
    CHAIN_METADATA,
    MESSAGE_HEAD,
    START_METADATA,
    IndexedChunk,
    McapChannel,
    McapSummary,
)
from amberbox.blackbox.journal.tail import HeadFile, JournalHead
from amberbox.core.clock import NS
from amberbox.core.files import sync_folder, write_all
from amberbox.core.types import IntArray, Schema, Topic

# larger writes are split into chunks of about this size; a larger message has its own
CHUNK_BYTES = 1 << 20

# returns the schema and channel records that a chunk of these channels begins with
Define = Callable[[Sequence[int], int], bytes]


@dataclass(frozen=True, slots=True)
class MessageRows:
    """Messages as parallel columns, in the order in which they are written."""

    channels: NDArray[np.uint16]
    sequence: IntArray
    log_ns: IntArray
    publish_ns: IntArray
    messages: Sequence[bytes]

    def take(self, part: slice) -> MessageRows:
        """Return some of the rows."""
        return MessageRows(
            self.channels[part],
            self.sequence[part],
            self.log_ns[part],
            self.publish_ns[part],
            self.messages[part],
        )


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """A chunk record, its message index records, and the fields of its chunk index."""

    chunk: bytes
    indices: Sequence[bytes]
    channels: Sequence[int]
    counts: Sequence[int]
    start_ns: int
    end_ns: int
    compression: str
    compressed_size: int
    size: int

    def indexed(self, offset: int) -> IndexedChunk:
        """Return the chunk's entry for the summary of a file, at position ``offset``."""
        after = offset + len(self.chunk)
        start = after
        offsets = []
        for channel, count in zip(self.channels, self.counts, strict=True):
            offsets.append((channel, start))
            start += 15 + 16 * count
        return IndexedChunk(
            self.start_ns,
            self.end_ns,
            offset,
            len(self.chunk),
            offsets,
            sum(map(len, self.indices)),
            self.compression,
            self.compressed_size,
            self.size,
        )


def chunk_slices(messages: Sequence[bytes]) -> list[slice]:
    """Split messages into chunks of about ``CHUNK_BYTES``; a larger message gets its own chunk."""
    lengths = np.fromiter(map(len, messages), np.int64, len(messages))
    ends = np.cumsum(lengths)
    if not len(ends) or int(ends[-1]) <= CHUNK_BYTES:
        return [slice(0, len(ends))] if len(ends) else []
    slices, start = [], 0
    while start < len(lengths):
        base = int(ends[start] - lengths[start])
        stop = max(start + 1, int(np.searchsorted(ends, base + CHUNK_BYTES, "right")))
        slices.append(slice(start, stop))
        start = stop
    return slices


def pack_chunk(rows: MessageRows, define: Define, zstd: zstandard.ZstdCompressor) -> PackedChunk:
    """Frame and compress one chunk; a message larger than a chunk is not compressed."""
    order = np.argsort(rows.channels, kind="stable")
    grouped = rows.channels[order]
    firsts = np.flatnonzero(np.concatenate(([True], grouped[1:] != grouped[:-1])))
    used = grouped[firsts].tolist()
    start_ns, end_ns = int(rows.log_ns.min()), int(rows.log_ns.max())
    body, starts = _frame(define(used, end_ns), rows)
    compression = "zstd" if len(order) > 1 or len(body) <= CHUNK_BYTES else ""
    data = zstd.compress(body) if compression else bytes(body)
    chunk = mcap.chunk_record(start_ns, end_ns, len(body), zlib.crc32(body), compression, data)
    entries = np.empty((len(order), 2), np.int64)
    entries[:, 0], entries[:, 1] = rows.log_ns[order], starts[order]
    bounds = [*(firsts * 16).tolist(), len(order) * 16]
    raw = entries.tobytes()
    indices = [
        mcap.message_index_record(channel, raw[a:b])
        for channel, a, b in zip(used, bounds[:-1], bounds[1:], strict=True)
    ]
    counts = (np.diff(bounds) // 16).tolist()
    return PackedChunk(
        chunk, indices, used, counts, start_ns, end_ns, compression, len(data), len(body)
    )


def _frame(prefix: bytes, rows: MessageRows) -> tuple[bytearray, IntArray]:
    """Append message records to the definitions; their 31-byte heads are written column-wise."""
    lengths = np.fromiter(map(len, rows.messages), np.int64, len(rows.messages))
    body = bytearray(MESSAGE_HEAD).join([prefix, *rows.messages])
    starts = np.empty(len(lengths), np.int64)
    starts[0] = len(prefix)
    np.cumsum(lengths[:-1] + MESSAGE_HEAD, out=starts[1:])
    starts[1:] += len(prefix)
    u2, u4, u8 = (overlapping_numbers(body, f"<u{size}", size - 1) for size in (2, 4, 8))
    np.frombuffer(body, np.uint8)[starts] = mcap.MESSAGE
    u8[starts + 1] = lengths + (MESSAGE_HEAD - 9)
    u2[starts + 9] = rows.channels
    u4[starts + 11] = rows.sequence & 0xFFFFFFFF
    u8[starts + 15] = rows.log_ns
    u8[starts + 23] = rows.publish_ns
    return body, starts


@dataclass(slots=True)
class SyncMark:
    """Files to make durable; ``wait`` may run in another thread."""

    fds: list[int]
    close: list[int]
    seq: int
    done: Callable[[int], None]

    def wait(self) -> None:
        """Flush everything written before the mark; then ``seq`` is the durable end."""
        try:
            for fd in self.fds:
                os.fdatasync(fd)
        finally:
            for fd in self.close:
                os.close(fd)
        self.done(self.seq)


@dataclass(slots=True)
class _OpenFile:
    """An open journal file and the state of its writer.

    ``block`` is the SHA-256 of the bytes since ``block_start``, where the last link of the chain
    ended; ``schemas_at_ns`` is from when on each schema is to be repeated.
    """

    fd: int
    path: Path
    number: int
    opened_ns: int
    size: int = 0
    summary: McapSummary = field(default_factory=McapSummary)
    schemas_at_ns: dict[int, int] = field(default_factory=dict)
    block: hashlib._Hash = field(default_factory=hashlib.sha256)
    block_start: int = 0

    def released(self) -> int:
        """Return the descriptor, which the caller closes from now on."""
        fd, self.fd = self.fd, -1
        return fd

    def __del__(self) -> None:
        if self.fd >= 0:  # its writer was dropped without an end, as after an error
            os.close(self.fd)


# schemas are repeated after as long as the file is old, but within these limits
SCHEMA_REPEAT_NS = (NS, 10 * NS)
COMPRESSION_LEVEL = 1
EMPTY_CHAIN = "0" * 64


@dataclass(frozen=True, slots=True)
class JournalOptions:
    """Folder, writer and run of a journal, and when a new file begins."""

    folder: Path
    store_id: str
    writer: str
    run: int
    boot_id: str
    rotate_bytes: int = 64_000_000
    rotate_ns: int = 600 * NS

    @property
    def tag(self) -> str:
        """Return the tag of this run in every chunk, to recognise blocks of other files."""
        return f"{self.store_id[:8]}-{self.writer}-{self.run}"

    def file_name(self, number: int) -> str:
        """Return a file name of run, boot and number, never of the wall clock."""
        return f"{self.run:06d}-{self.boot_id.replace('-', '')[:8]}-{number:04d}.mcap"


class JournalWriter:
    """Appends messages of one run to a series of MCAP files. Not thread-safe: one owner."""

    def __init__(self, options: JournalOptions, *, chain: str = EMPTY_CHAIN) -> None:
        self.options = options
        self.next_seq = 0
        self.durable_seq = 0
        self.chain = chain
        self.bytes_written = 0
        self.late_ns = 0  # how much before earlier rows a row may be; stated in each new file
        self._schemas: dict[Schema, int] = {}
        self._schema_list: list[Schema] = []
        self._channels: list[McapChannel] = []
        self._records: list[bytes] = []
        self._file: _OpenFile | None = None
        self._files = 0
        self._closing: list[int] = []
        self._zstd = zstandard.ZstdCompressor(level=COMPRESSION_LEVEL, write_content_size=True)
        options.folder.mkdir(parents=True, exist_ok=True)
        self._head = HeadFile(options.folder)

    def channel(self, topic: Topic, metadata: Mapping[str, str]) -> int:
        """Register a channel and return its number, the same in all files of this run."""
        schema_id = 0
        if topic.schema is not None:
            schema_id = self._schemas.setdefault(topic.schema, len(self._schemas) + 1)
            self._schema_list = list(self._schemas)
        marks = {**metadata, "run": self.options.tag}
        channel = McapChannel(
            len(self._channels), schema_id, topic.name, topic.message_encoding, marks
        )
        self._channels.append(channel)
        self._records.append(mcap.channel_record(channel))
        return channel.id

    @property
    def path(self) -> Path | None:
        """Return the file that is being written, None without one."""
        return self._file.path if self._file else None

    def rotation_due(self, now_ns: int) -> bool:
        """Return whether the file is full, or old enough for a new one."""
        file = self._file
        if file is None:
            return False
        too_old = now_ns - file.opened_ns >= self.options.rotate_ns
        return file.size >= self.options.rotate_bytes or too_old

    def write(
        self,
        channels: Sequence[int] | NDArray[np.uint16],
        log_ns: Sequence[int] | IntArray,
        publish_ns: Sequence[int] | IntArray,
        messages: Sequence[bytes],
    ) -> None:
        """Write messages in their order, sorted by log time, as complete chunks.

        Raises OSError when they cannot be written: the file then ends where it ended before.
        """
        log = np.asarray(log_ns, np.int64)
        if self._file is None:
            self._open(int(log[0]))
        numbers = np.asarray(channels, np.uint16)
        publish = np.asarray(publish_ns, np.int64)
        sequence = np.arange(self.next_seq, self.next_seq + len(messages))
        rows = MessageRows(numbers, sequence, log, publish, messages)
        for part in chunk_slices(messages):
            self._write_chunk(rows.take(part))

    def _write_chunk(self, rows: MessageRows) -> None:
        file = self._opened()
        packed = pack_chunk(rows, partial(self._definitions, file), self._zstd)
        offset = file.size
        self._append([packed.chunk, *packed.indices])
        self._note(file, packed, offset)
        self.next_seq += len(rows.messages)

    def _definitions(self, file: _OpenFile, used: Sequence[int], now_ns: int) -> bytes:
        """Return the channel records of a chunk, and the schema records that are due again."""
        parts = []
        for number in used:
            schema_id = self._channels[number].schema_id
            if schema_id and now_ns >= file.schemas_at_ns.get(schema_id, 0):
                pause_ns = min(
                    max(now_ns - file.opened_ns, SCHEMA_REPEAT_NS[0]), SCHEMA_REPEAT_NS[1]
                )
                file.schemas_at_ns[schema_id] = now_ns + pause_ns
                parts.append(mcap.schema_record(schema_id, self._schema(schema_id)))
        parts.extend(self._records[number] for number in used)
        return b"".join(parts)

    def _schema(self, schema_id: int) -> Schema:
        return self._schema_list[schema_id - 1]

    def _note(self, file: _OpenFile, packed: PackedChunk, offset: int) -> None:
        summary = file.summary
        for number, count in zip(packed.channels, packed.counts, strict=True):
            channel = self._channels[number]
            summary.counts[number] += count
            summary.channels[number] = channel
            if channel.schema_id:
                summary.schemas[channel.schema_id] = self._schema(channel.schema_id)
        summary.add_chunk(packed.indexed(offset))

    def mark_sync(self) -> SyncMark:
        """Close a link of the hash chain; return the mark whose ``wait`` makes all data durable."""
        file, fds = self._file, list(self._closing)
        if file is not None:
            if file.size > file.block_start:
                with suppress(OSError):  # a full disk: a later link covers what is synced now
                    self._write_chain(file)
            fds.append(file.fd)
        mark = SyncMark(fds, self._closing, self.next_seq, self._set_durable)
        self._closing = []
        return mark

    def _set_durable(self, seq: int) -> None:
        self.durable_seq = max(self.durable_seq, seq)

    def _write_chain(self, file: _OpenFile) -> None:
        block, start, digest = file.block, file.size, file.block.hexdigest()
        chain = hashlib.sha256(bytes.fromhex(self.chain + digest)).hexdigest()
        values = {
            "from": str(file.block_start),
            "to": str(start),
            "block": digest,
            "chain": chain,
            "next_seq": str(self.next_seq),
        }
        file.block = hashlib.sha256()
        try:
            self._append_metadata(file, CHAIN_METADATA, values)
        except OSError:
            file.block = block
            raise
        self.chain, file.block_start = chain, start

    def _append_metadata(self, file: _OpenFile, name: str, values: Mapping[str, str]) -> None:
        data = mcap.metadata_record(name, values)
        self._append([data])
        file.summary.metadata.append((file.size - len(data), len(data), name))

    def publish_head(self, watermark_ns: int) -> None:
        """Write the head, by which followers see how far this journal reaches."""
        file = self._file
        self._head.write(
            JournalHead(
                store_id=self.options.store_id,
                run=self.options.run,
                next_seq=self.next_seq,
                durable_seq=self.durable_seq,
                watermark_ns=watermark_ns,
                file=file.path.name if file else "",
                size=file.size if file else 0,
            )
        )

    def rotate(self) -> None:
        """Finish the file; the next write begins a new one.

        On a full disk the file stays without its end, and is read by walking it.
        """
        file = self._file
        if file is None:
            return
        with suppress(OSError):
            self._write_chain(file)
            self._append([file.summary.encode(file.size)])
        self._closing.append(file.released())
        self._file = None

    def close(self) -> None:
        """Finish the file and make everything durable.

        Raises OSError when the disk does not confirm it.
        """
        self.rotate()
        try:
            self.mark_sync().wait()
        finally:
            self._head.close()

    def _opened(self) -> _OpenFile:
        assert self._file is not None
        return self._file

    def _open(self, now_ns: int) -> None:
        folder = self.options.folder
        path = folder / self.options.file_name(self._files)
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
        file = self._file = _OpenFile(fd, path, self._files, now_ns)
        try:
            self._append([mcap.MAGIC + mcap.header(self._profile())])
            self._append_metadata(file, START_METADATA, self._start_values(file))
            sync_folder(folder)
        except OSError:
            self._file = None
            os.close(file.released())
            path.unlink()
            raise
        self._files += 1

    def _start_values(self, file: _OpenFile) -> dict[str, str]:
        options = self.options
        return {
            "store_id": options.store_id,
            "writer": options.writer,
            "run": str(options.run),
            "boot_id": options.boot_id,
            "file": str(file.number),
            "first_seq": str(self.next_seq),
            "chain": self.chain,
            **({"late_ns": str(self.late_ns)} if self.late_ns else {}),
        }

    def _profile(self) -> str:
        encodings = {channel.message_encoding for channel in self._channels}
        if "cdr" in encodings:
            return "ros2"
        return "ros1" if "ros1" in encodings else ""

    def _append(self, parts: Sequence[bytes]) -> None:
        file = self._opened()
        data = b"".join(parts)
        try:
            _expect_room(file.fd, len(data))
            write_all(file.fd, data)
        except OSError:
            os.ftruncate(file.fd, file.size)  # our own torn tail, nothing acknowledged
            file.schemas_at_ns.clear()  # it may have held schemas that count as written
            raise
        file.block.update(data)
        file.size += len(data)
        self.bytes_written += len(data)


def _expect_room(fd: int, size: int) -> None:
    """Raise OSError if the data do not fit: truncating a torn end crashes readers that map it.

    The end is still truncated when another process uses the room at the same moment.
    """
    status = os.fstatvfs(fd)
    if status.f_blocks and status.f_bavail * status.f_frsize < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
