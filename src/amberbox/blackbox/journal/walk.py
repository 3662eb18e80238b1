"""Walk an MCAP file record by record, whatever happened to it.

Where something does not hold, the walk looks for the next chunk that does, starting right after
the last one that held, so that damage costs only what it touches.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.buffer import Buffer
from amberbox.blackbox.journal.chunk import Chunk, decompress, index_offsets, open_chunk
from amberbox.blackbox.journal.mcap import CHAIN_METADATA, START_METADATA
from amberbox.blackbox.journal.summary import ends_of_data, is_finished
from amberbox.core.types import IntArray

_KNOWN = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}
_LOOSE = {mcap.SCHEMA, mcap.CHANNEL, mcap.MESSAGE}
_LOOSE_BYTES = 4 << 20
_INDEX = struct.Struct("<QHI")
_MARK = re.compile(
    rb"\x06.{36}(?:\x04\0\0\0zstd|\0\0\0\0.{8}[\x03\x04\x05]|\x03\0\0\0lz4)"
    rb"|\x0c.{8}(?:\x0e\0\0\0" + START_METADATA.encode() + rb"|\x0e\0\0\0"
    + CHAIN_METADATA.encode() + rb")",
    re.DOTALL,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes of a file that no checksum vouches for."""

    from_offset: int
    to_offset: int
    reason: str


@dataclass(frozen=True, slots=True)
class Metadata:
    """A metadata record, with the offset of its end."""

    offset: int
    end: int
    name: str
    values: Mapping[str, str]


Found: TypeAlias = "Chunk | Metadata | Damage"


@dataclass(slots=True)
class Walk:
    """A walk over a buffer that may still grow; ``at`` is where the next one would go on."""

    data: Buffer
    at: int = 0
    tag: str = ""
    grows: bool = False
    finished: bool = False
    trusted: int = 0
    _failed: str = ""
    _waits: bool = False

    def __iter__(self) -> Iterator[Found]:
        if self.at == 0:
            self._start()
        while self.at < len(self.data) and not self.finished:
            before = self.at
            found = self._step()
            if found is not None:
                yield from self._report_damage(self._offset_of(found))
                self._trust(found)
                yield found
            elif self.at == before and (self._waits or not self._failed):
                break
        if not self.grows:
            yield from self._report_damage(len(self.data), "cut short")

    def _start(self) -> None:
        if bytes(self.data[: len(mcap.MAGIC)]) == mcap.MAGIC:
            self.at = self.trusted = len(mcap.MAGIC)
        else:
            self._failed = "no MCAP magic"

    def _offset_of(self, found: Found) -> int:
        return found.from_offset if isinstance(found, Damage) else found.offset

    def _trust(self, found: Found) -> None:
        if not isinstance(found, Damage):
            self.trusted = found.end

    def _report_damage(self, until: int, reason: str = "") -> Iterator[Damage]:
        """Tell of the bytes since the last thing that held, if something went wrong there."""
        torn = reason if until > self.at else ""
        if (self._failed or torn) and until > self.trusted and not self.finished:
            yield Damage(self.trusted, until, self._failed or torn)
        self._failed = ""

    def _step(self) -> Found | None:
        """Take the record at ``at``; None when it is of no interest or does not hold."""
        if self._failed:
            return self._resync()
        head = self._record_head()
        if head is None:
            return None
        opcode, end = head
        if opcode == mcap.CHUNK:
            return self._chunk(end)
        if opcode in _LOOSE:
            return self._loose_messages()
        if opcode == mcap.METADATA:
            return self._metadata(end)
        if opcode in (mcap.DATA_END, mcap.FOOTER):
            self._data_end()
        elif opcode == mcap.MESSAGE_INDEX:  # a sound one was taken with its chunk
            self._fail("message index is damaged")
        else:
            self.at = end
        return None

    def _record_head(self) -> tuple[int, int] | None:
        """Return opcode and end of the record at ``at``, or note that there is none."""
        if self.at + 9 > len(self.data):
            self._incomplete()
            return None
        opcode, length = struct.unpack_from("<BQ", self.data, self.at)
        end = self.at + 9 + length
        if opcode not in _KNOWN:
            self._fail("unknown record")
            return None
        if end > len(self.data):
            self._incomplete()
            return None
        return opcode, end

    def _incomplete(self) -> None:
        if not self.grows:
            self._fail("record is cut short or its length is damaged")

    def _fail(self, reason: str) -> None:
        """Remember the damage and go back to right behind what held last."""
        self._failed = reason
        self.at = max(self.trusted, len(mcap.MAGIC) if self.trusted else 0)

    def _resync(self) -> Found | None:
        """Find the next chunk or start record that holds, from ``at`` on."""
        for match in _MARK.finditer(self.data, self.at):
            found = self._probe(match.start())
            if found is not None:
                self.at = found.end
                return found
        self._waits = self.grows  # what is being written may complete a match
        if not self.grows:
            self.at = len(self.data)
        return None

    def _probe(self, offset: int) -> Chunk | Metadata | None:
        if self.data[offset] == mcap.METADATA:
            return metadata_at(self.data, offset)
        head = mcap.parse_chunk_head(self.data, offset)
        if head is None:
            return None
        return self._open(head.offset, head.offset + head.length)

    def _chunk(self, end: int) -> Found | None:
        chunk = self._open(self.at, end)
        if chunk is None:
            self._fail("chunk does not match its checksum")
            return None
        self.at = chunk.end
        return chunk

    def _open(self, offset: int, end: int) -> Chunk | None:
        head = mcap.parse_chunk_head(self.data, offset)
        body = decompress(head, self.data) if head else None
        if body is None:
            return None
        offsets, end = self._index_after(end)
        chunk = open_chunk(body, offset, end, offsets)
        return chunk if chunk is not None and self._is_ours(chunk) else None

    def _index_after(self, at: int) -> tuple[IntArray, int]:
        """Read the message index records that follow a chunk."""
        data, end, entries = self.data, len(self.data), []
        while at + 15 <= end and data[at] == mcap.MESSAGE_INDEX:
            length, _, size = _INDEX.unpack_from(data, at + 1)
            if length != size + 6 or size % 16 or at + 9 + length > end:
                break
            entries.append(data[at + 15 : at + 15 + size])
            at += 9 + length
        return index_offsets(entries), at

    def _is_ours(self, chunk: Chunk) -> bool:
        """Tell a chunk of this run from a block of another file that a dying disk put here."""
        if not self.tag:
            return True
        return all(c.metadata.get("run", self.tag) == self.tag for c in chunk.channels.values())

    def _metadata(self, end: int) -> Found | None:
        found = metadata_at(self.data, self.at)
        if found is None:
            self._fail("metadata record is damaged")
            return None
        self.at = end
        if found.name == START_METADATA:
            self.tag = run_tag(found.values)
        return found

    def _loose_messages(self) -> Found | None:
        """Take records that stand outside chunks, as other writers may leave them."""
        at, first = self.at, self.at
        while at + 9 <= len(self.data) and self.data[at] in _LOOSE and at - first < _LOOSE_BYTES:
            (length,) = struct.unpack_from("<Q", self.data, at + 1)
            if at + 9 + length > len(self.data):
                break
            at += 9 + length
        chunk = open_chunk(bytes(self.data[first:at]), first, at) if at > first else None
        if chunk is None:
            self._incomplete()
            return None
        self.at = at
        return chunk

    def _data_end(self) -> None:
        if not is_finished(self.data):
            if not self.grows:
                self._fail("summary is damaged")
            return
        if self.at not in ends_of_data(self.data):  # a damaged record that looks like the end
            self._fail("end of data in the middle")
            return
        self.finished = True
        self.at = len(self.data)


def run_tag(start: Mapping[str, str]) -> str:
    """Compose the mark that all chunks of a run carry, from the file's start record."""
    try:
        return f"{start['store_id'][:8]}-{start['writer']}-{start['run']}"
    except KeyError:
        return ""


def metadata_at(data: Buffer, offset: int) -> Metadata | None:
    """Read the metadata record at an offset; None if its lengths do not fit together."""
    try:
        opcode, length = struct.unpack_from("<BQ", data, offset)
        content = bytes(data[offset + 9 : offset + 9 + length])
        if opcode != mcap.METADATA or len(content) != length or length > 1 << 24:
            return None
        name, values = mcap.parse_metadata(content)
    except (ValueError, struct.error):
        return None
    if len(mcap.text(name) + mcap.text_map(values)) != length:
        return None
    return Metadata(offset, offset + 9 + length, name, values)


def chunk_at(data: Buffer, offset: int) -> Chunk | None:
    """Decode the chunk at an offset, or the loose messages; None if they do not hold."""
    walk = Walk(data, at=offset, grows=True)
    head = mcap.parse_chunk_head(data, offset)
    if head is not None:
        return walk._open(offset, offset + head.length)
    found = walk._loose_messages() if data[offset] in _LOOSE else None
    return found if isinstance(found, Chunk) else None
