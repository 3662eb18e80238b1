"""From when to when a journal file reaches, read from its first chunk and its end only.

Whoever pins a window is in a hurry; the chunks between are of no interest then.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.follow.read import journal_file
from amberbox.blackbox.journal import mcap, reserved
from amberbox.blackbox.journal.buffer import Buffer, open_buffer
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.head import read_head
from amberbox.blackbox.journal.mcap import START_METADATA
from amberbox.blackbox.journal.scan import start_record
from amberbox.blackbox.journal.summary import FOOTER_SIZE
from amberbox.blackbox.journal.walk import Metadata, Walk

_START_BYTES = 4 << 20


@dataclass(frozen=True, slots=True)
class Extent:
    """What a journal file reaches over, in log time, both ends inclusive.

    ``boot`` names the boot and ``boot_base_ns`` is log time minus boot time, None where the file
    does not say; ``offset_ns`` is wall minus log time at its start.
    """

    path: Path
    name: str
    run: int
    start_ns: int
    end_ns: int
    bytes: int
    boot: str = ""
    boot_base_ns: int | None = None
    offset_ns: int = 0
    config_hash: str = ""


def extent(path: Path) -> Extent | None:
    """Look at a journal file; None where it has no rows, or is gone.

    Of a file that is being written the end is what its writer has told last.
    """
    with suppress(FileNotFoundError):
        status = path.stat()
        found = _extent(path, status.st_mtime_ns, status.st_size)
        if found is None or found.end_ns:
            return found
        return _with_live_end(found)
    return None


def _with_live_end(found: Extent) -> Extent | None:
    head = read_head(found.path.parent)
    if head is not None and head.file == found.path.name and head.watermark_ns >= found.start_ns:
        return _ending(found, head.watermark_ns)
    journal = journal_file(found.path)
    return _ending(found, journal.end_ns) if journal.rows else None


def _ending(found: Extent, end_ns: int) -> Extent:
    return Extent(
        found.path, found.name, found.run, found.start_ns, max(end_ns, found.start_ns),
        found.bytes, found.boot, found.boot_base_ns, found.offset_ns, found.config_hash,
    )  # fmt: skip


@lru_cache(maxsize=4096)
def _extent(path: Path, _mtime_ns: int, size: int) -> Extent | None:
    """Describe a file; an end of 0 means that the file does not say it."""
    start = start_record(path)
    with open_buffer(path) as data:
        chunk = _first_chunk(data)
        end_ns = _stated_end(data)
        if chunk is None:
            return _walked(path, start, size)
        told = {topic: _own_message(chunk, topic) for topic in (reserved.RUN, reserved.CLOCK)}
        first_ns = int(chunk.log_ns.min())
        clock_ns = _own_time(chunk, reserved.CLOCK)
    boot_ns = told[reserved.CLOCK].get("boot_ns")
    return Extent(
        path=path,
        name=f"{path.parent.name}/{path.name}",
        run=int(start.get("run", 0)),
        start_ns=first_ns,
        end_ns=end_ns,
        bytes=size,
        boot=start.get("boot_id", ""),
        boot_base_ns=None if boot_ns is None else clock_ns - int(boot_ns),
        offset_ns=int(told[reserved.CLOCK].get("offset_ns", 0)),
        config_hash=str(told[reserved.RUN].get("config_hash", "")),
    )


def _walked(path: Path, start: Mapping[str, str], size: int) -> Extent | None:
    """Describe a file whose first chunk is damaged by what holds of the rest."""
    journal = journal_file(path)
    if not journal.rows:
        return None
    name = f"{path.parent.name}/{path.name}"
    return Extent(path, name, journal.run, journal.start_ns, journal.end_ns, size)


def _first_chunk(data: Buffer) -> Chunk | None:
    walk = Walk(data[:_START_BYTES], grows=True)
    for found in walk:
        if isinstance(found, Chunk) and len(found):
            return found
        if not isinstance(found, Metadata) or found.name != START_METADATA:
            return None
    return None


def _stated_end(data: Buffer) -> int:
    """Read the last log time from the statistics of a finished file; 0 without them."""
    if len(data) < FOOTER_SIZE or bytes(data[-8:]) != mcap.MAGIC:
        return 0
    end = len(data) - FOOTER_SIZE
    with suppress(struct.error, ValueError):
        _, _, _, at = struct.unpack_from("<BQQQ", data, end)
        while 0 < at < end:
            opcode, length, group, offset = struct.unpack_from("<BQBQ", data, at)
            if opcode == mcap.SUMMARY_OFFSET and group == mcap.STATISTICS:
                return int(struct.unpack_from("<Q", data, offset + 9 + 8 + 2 + 16 + 8)[0])
            at += 9 + length
    return 0


def _rows(chunk: Chunk, topic: str) -> Any:
    numbers = [number for number, c in chunk.channels.items() if c.topic == topic]
    return chunk.rows_of(numbers[0]) if numbers else ()


def _own_message(chunk: Chunk, topic: str) -> dict[str, Any]:
    rows = _rows(chunk, topic)
    if not len(rows):
        return {}
    values: dict[str, Any] = msgspec.json.decode(chunk.messages(rows[:1])[0])
    return values


def _own_time(chunk: Chunk, topic: str) -> int:
    rows = _rows(chunk, topic)
    return int(chunk.log_ns[rows[0]]) if len(rows) else 0
