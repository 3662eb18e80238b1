"""What an MCAP file holds, whatever happened to it: every chunk that its CRC vouches for.

A sound summary is believed; without one, or when asked to, the whole file is walked.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.journal.buffer import Buffer, open_buffer
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.mcap import CHAIN_METADATA, START_METADATA
from amberbox.blackbox.journal.summary import Summary, read_summary
from amberbox.blackbox.journal.walk import Damage, Metadata, Walk, chunk_at, metadata_at
from amberbox.core.types import IntArray


class ChunkPlace(NamedTuple):
    """Where a chunk lies and what it holds, without holding it."""

    offset: int
    start_ns: int
    end_ns: int
    count: int  # type: ignore[assignment]  # hides tuple.count, which is not asked of places
    first_sequence: int | None = None
    channels: tuple[int, ...] | None = None
    """Channels that have messages in it, as far as that is known."""

    def may_hold(self, channels: Set[int]) -> bool:
        """Tell whether a message of one of these channels may be in it."""
        return self.channels is None or not channels.isdisjoint(self.channels)


class Tally(NamedTuple):
    """Messages of one channel in a file: how many, first and last log time, their bytes."""

    rows: int
    first_ns: int
    last_ns: int
    bytes: int

    def plus(self, other: Tally | None) -> Tally:
        """Return both together."""
        if other is None:
            return self
        first_ns, last_ns = min(self.first_ns, other.first_ns), max(self.last_ns, other.last_ns)
        return Tally(self.rows + other.rows, first_ns, last_ns, self.bytes + other.bytes)


@dataclass(slots=True)
class FileScan:
    """What a file holds: from its summary if it has a sound one, else from a full walk."""

    path: Path
    size: int
    start: Mapping[str, str] = field(default_factory=dict)
    chain: str = ""
    finished: bool = False
    walked: bool = False
    summary: Summary = field(default_factory=Summary)
    places: list[ChunkPlace] = field(default_factory=list)
    indexed: int | None = None
    """How many messages the file was finished with, also where some are damaged now."""
    damage: list[Damage] = field(default_factory=list)
    tallies: Mapping[int, Tally] | None = None
    """What there is of each channel; None where nobody has counted yet."""


def scan(path: Path, *, walk: bool = False) -> FileScan:
    """Find the chunks of a file; ``walk`` distrusts the summary and checks every byte.

    Chunks of a walked journal of ours come in ``seq`` order even where pages were swapped.
    """
    with open_buffer(path) as data:
        start = _start_record(data)
        summary = read_summary(data)
        headless = summary is not None and not start and _tag_of(summary)
        if summary is None or walk or headless:
            return _from_walk(path, data, summary)
        return _from_summary(path, data, start, summary)


def start_record(path: Path) -> Mapping[str, str]:
    """Read what a journal file says about itself at its start; empty if it says nothing."""
    with path.open("rb") as file:
        return _start_record(file.read(1 << 16))


def _start_record(data: Buffer) -> Mapping[str, str]:
    walk = Walk(data[: 1 << 16], grows=True)
    for found in walk:
        if isinstance(found, Metadata) and found.name == START_METADATA:
            return found.values
        break
    return {}


def _from_summary(path: Path, data: Buffer, start: Mapping[str, str], summary: Summary) -> FileScan:
    places = [
        ChunkPlace(
            c.offset, c.start_ns, c.end_ns, (c.index_length - 15 * len(c.index_offsets)) // 16,
            channels=tuple([number for number, _ in c.index_offsets]) if c.index_offsets else None,
        )
        for c in summary.chunks
    ]  # fmt: skip
    result = FileScan(path, len(data), start, finished=True, summary=summary, places=places)
    for offset, _, name in summary.metadata[-1:]:
        last = metadata_at(data, offset)
        if last is not None and name == CHAIN_METADATA:
            result.chain = last.values.get("chain", "")
    return result


def _from_walk(path: Path, data: Buffer, summary: Summary | None) -> FileScan:
    result = FileScan(path, len(data), walked=True)
    walk = Walk(data)
    tallies: dict[ChunkPlace, Mapping[int, Tally]] = {}
    for found in walk:
        if isinstance(found, Damage):
            result.damage.append(found)
        elif isinstance(found, Metadata):
            _take_metadata(result, found)
        else:
            tallies.update(_take_chunk(result, found))
    result.finished = walk.finished
    if summary is not None:  # it has a checksum of its own: definitions whose chunks are damaged
        result.summary.schemas = {**summary.schemas, **result.summary.schemas}
        result.summary.channels = {**summary.channels, **result.summary.channels}
        result.indexed = summary.counts.total()
    if not result.start:
        result.start = _start_by_mark(result)
    if result.start:
        result.places = _in_order(result)
    result.tallies = together(tallies[place] for place in result.places)
    result.summary.counts = Counter({n: tally.rows for n, tally in result.tallies.items()})
    return result


def _tag_of(summary: Summary) -> str:
    return next((c.metadata["run"] for c in summary.channels.values() if "run" in c.metadata), "")


def _start_by_mark(result: FileScan) -> Mapping[str, str]:
    """Tell from the mark of its chunks whose file this is, when its start is damaged."""
    parts = _tag_of(result.summary).split("-")
    if len(parts) != 3 or not result.places:
        return {}
    first = min(place.first_sequence or 0 for place in result.places)
    result.indexed = None  # of what stood before the first sound chunk nothing is known
    keys = ("store_id", "writer", "run", "first_seq")
    return dict(zip(keys, (*parts, str(first)), strict=True))


def _take_metadata(result: FileScan, found: Metadata) -> None:
    if found.name == START_METADATA:
        result.start = found.values
    elif found.name == CHAIN_METADATA:
        result.chain = found.values.get("chain", "")


def _take_chunk(result: FileScan, chunk: Chunk) -> Mapping[ChunkPlace, Mapping[int, Tally]]:
    """Note a chunk; return its place and what it holds of each channel, if it holds anything."""
    summary = result.summary
    summary.schemas.update(chunk.schemas)
    summary.channels.update(chunk.channels)
    if not len(chunk):
        return {}
    tallies = tally_of(chunk)
    first, last = int(chunk.log_ns.min()), int(chunk.log_ns.max())
    summary.start_ns = min(summary.start_ns, first) if result.places else first
    summary.end_ns = max(summary.end_ns, last)
    first_sequence, channels = int(chunk.sequence[0]), tuple(tallies)
    place = ChunkPlace(chunk.offset, first, last, len(chunk), first_sequence, channels)
    result.places.append(place)
    return {place: tallies}


def tally(
    channels: NDArray[np.uint16],
    first_ns: IntArray,
    last_ns: IntArray,
    sizes: IntArray,
    counts: IntArray,
) -> dict[int, Tally]:
    """Count messages by channel; the columns are parallel, each row stands for some messages."""
    if not len(channels):
        return {}
    order = np.argsort(channels, kind="stable")
    grouped = channels[order]
    starts = np.flatnonzero(np.concatenate(([True], grouped[1:] != grouped[:-1])))
    columns = (
        grouped[starts], np.add.reduceat(counts[order], starts),
        np.minimum.reduceat(first_ns[order], starts), np.maximum.reduceat(last_ns[order], starts),
        np.add.reduceat(sizes[order], starts),
    )  # fmt: skip
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return {number: Tally(*figures) for number, *figures in rows}


def tally_of(chunk: Chunk) -> dict[int, Tally]:
    """Count the messages of a chunk by channel."""
    ones = np.ones(len(chunk), np.int64)
    return tally(chunk.channel, chunk.log_ns, chunk.log_ns, chunk.ends - chunk.starts, ones)


def together(parts: Iterable[Mapping[int, Tally]]) -> dict[int, Tally]:
    """Add up what parts of a file hold of each channel."""
    found: dict[int, Tally] = {}
    for part in parts:
        for number, one in part.items():
            found[number] = one.plus(found.get(number))
    return found


def _in_order(result: FileScan) -> list[ChunkPlace]:
    """Order chunks by sequence and drop what a confused disk shows twice."""
    base = int(result.start.get("first_seq", 0))
    ordered, expected = [], 0
    for place in sorted(result.places, key=lambda p: ((p.first_sequence or 0) - base) & 0xFFFFFFFF):
        relative = ((place.first_sequence or 0) - base) & 0xFFFFFFFF
        if relative >= expected:
            ordered.append(place)
            expected = relative + place.count
    return ordered


def read_chunk(data: Buffer, place: ChunkPlace) -> Chunk | None:
    """Decode one chunk; None if its checksum refuses it."""
    return chunk_at(data, place.offset)
