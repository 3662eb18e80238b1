"""The journal writer: MCAP files made for power cuts.

One ``write`` puts complete chunks with their indices into the file, visible to readers and safe
from ``kill -9``. ``mark_sync`` closes a link of the hash chain and returns what makes it durable.
"""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import zstandard
from numpy.typing import NDArray

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.frame import Packed, Rows, chunk_slices, pack
from amberbox.blackbox.journal.head import Head, HeadFile
from amberbox.blackbox.journal.mcap import (
    CHAIN_METADATA,
    START_METADATA,
    Channel,
)
from amberbox.blackbox.journal.openfile import OpenFile
from amberbox.blackbox.journal.syncmark import SyncMark
from amberbox.core.clock import NS
from amberbox.core.files import sync_folder
from amberbox.core.types import IntArray, Schema, Topic

SCHEMA_REPEAT_NS = (NS, 10 * NS)
"""Schemas are repeated after as long as the file is old, but within these limits."""
COMPRESSION_LEVEL = 1
EMPTY_CHAIN = "0" * 64


@dataclass(frozen=True, slots=True)
class JournalOptions:
    """Where a journal lies, who writes it, and when a new file begins."""

    folder: Path
    store_id: str
    writer: str
    run: int
    boot_id: str
    rotate_bytes: int = 64_000_000
    rotate_ns: int = 600 * NS

    @property
    def tag(self) -> str:
        """Mark of this run in every chunk: blocks of other files are told apart by it."""
        return f"{self.store_id[:8]}-{self.writer}-{self.run}"

    def file_name(self, number: int) -> str:
        """Name a file by run, boot and number, never by the wall clock."""
        return f"{self.run:06d}-{self.boot_id.replace('-', '')[:8]}-{number:04d}.mcap"


class JournalWriter:
    """Appends messages of one run to a series of MCAP files. Not thread-safe: one owner."""

    def __init__(self, options: JournalOptions, *, chain: str = EMPTY_CHAIN) -> None:
        self.options = options
        self.next_seq = 0
        self.durable_seq = 0
        self.chain = chain
        self.bytes_written = 0
        self._schemas: dict[Schema, int] = {}
        self._schema_list: list[Schema] = []
        self._channels: list[Channel] = []
        self._records: list[bytes] = []
        self._file: OpenFile | None = None
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
        channel = Channel(len(self._channels), schema_id, topic.name, topic.message_encoding, marks)
        self._channels.append(channel)
        self._records.append(mcap.channel_record(channel))
        return channel.id

    @property
    def path(self) -> Path | None:
        """The file that is being written, if there is one."""
        return self._file.path if self._file else None

    def rotation_due(self, now_ns: int) -> bool:
        """Tell whether the file is full or old enough for a new one."""
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
        """Write messages in their order as complete chunks.

        Raises OSError when the disk does not take them: the file then ends where it ended before.
        """
        log = np.asarray(log_ns, np.int64)
        if self._file is None:
            self._open(int(log[0]))
        numbers = np.asarray(channels, np.uint16)
        publish = np.asarray(publish_ns, np.int64)
        sequence = np.arange(self.next_seq, self.next_seq + len(messages))
        rows = Rows(numbers, sequence, log, publish, messages)
        for part in chunk_slices(messages):
            self._write_chunk(rows.take(part))

    def _write_chunk(self, rows: Rows) -> None:
        file = self._opened()
        packed = pack(rows, partial(self._definitions, file), self._zstd)
        offset = file.size
        self._append([packed.chunk, *packed.indices])
        self._note(file, packed, offset)
        self.next_seq += len(rows.messages)

    def _definitions(self, file: OpenFile, used: Sequence[int], now_ns: int) -> bytes:
        """Repeat the channels a chunk uses always, their schemas now and then."""
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

    def _note(self, file: OpenFile, packed: Packed, offset: int) -> None:
        summary = file.summary
        for number, count in zip(packed.channels, packed.counts, strict=True):
            channel = self._channels[number]
            summary.counts[number] += count
            summary.channels[number] = channel
            if channel.schema_id:
                summary.schemas[channel.schema_id] = self._schema(channel.schema_id)
        summary.add_chunk(packed.indexed(offset))

    def mark_sync(self) -> SyncMark:
        """Close a link of the chain and return what makes everything so far durable."""
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

    def _write_chain(self, file: OpenFile) -> None:
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

    def _append_metadata(self, file: OpenFile, name: str, values: Mapping[str, str]) -> None:
        data = mcap.metadata_record(name, values)
        self._append([data])
        file.summary.metadata.append((file.size - len(data), len(data), name))

    def publish_head(self, watermark_ns: int) -> None:
        """Tell followers how far this journal reaches, without touching the journal itself."""
        file = self._file
        self._head.write(
            Head(
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
        self._closing.append(file.fd)
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

    def _opened(self) -> OpenFile:
        assert self._file is not None
        return self._file

    def _open(self, now_ns: int) -> None:
        folder = self.options.folder
        path = folder / self.options.file_name(self._files)
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
        file = self._file = OpenFile(fd, path, self._files, now_ns)
        try:
            self._append([mcap.MAGIC + mcap.header(self._profile())])
            self._append_metadata(file, START_METADATA, self._start_values(file))
            sync_folder(folder)
        except OSError:
            self._file = None
            os.close(fd)
            path.unlink()
            raise
        self._files += 1

    def _start_values(self, file: OpenFile) -> dict[str, str]:
        options = self.options
        return {
            "store_id": options.store_id,
            "writer": options.writer,
            "run": str(options.run),
            "boot_id": options.boot_id,
            "file": str(file.number),
            "first_seq": str(self.next_seq),
            "chain": self.chain,
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
            _write_all(file.fd, data)
        except OSError:
            os.ftruncate(file.fd, file.size)  # our own torn tail, nothing acknowledged
            file.schemas_at_ns.clear()  # it may have held schemas that count as written
            raise
        file.block.update(data)
        file.size += len(data)
        self.bytes_written += len(data)


def _expect_room(fd: int, size: int) -> None:
    """Refuse what would not fit whole: to cut off a torn end is deadly for whoever has it mapped.

    It is cut off all the same when others take the room in that very moment.
    """
    status = os.fstatvfs(fd)
    if status.f_blocks and status.f_bavail * status.f_frsize < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _write_all(fd: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(fd, view) :]
