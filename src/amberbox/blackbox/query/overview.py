"""Summarise a record item by item: rows, times, rates, the stamps' distance from receipt.

For journals that are not segments yet, the index is counted, and only messages of a few chunks are
unrolled, so that the list is fast also for an hour that is being written.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema, flatten
from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.index import UnindexedError, count_messages
from amberbox.blackbox.journal.scan import ChannelTally, ChunkPlace, merge_tallies, tally_chunk
from amberbox.blackbox.store.catalogue import StoreCatalogue, item_of, stream_tables, union
from amberbox.blackbox.store.clocks import ClockPoints, ClockTable
from amberbox.blackbox.store.journal_reader import JournalFile, batches_of, sound_chunks
from amberbox.blackbox.store.manifest_entries import SegmentPart
from amberbox.blackbox.store.segment_builder import median
from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time
from amberbox.core.types import IntArray

SequenceStart: TypeAlias = tuple[str, int, int]  # writer, run, and the first sequence number


@dataclass(frozen=True, slots=True)
class JournalShare:
    """The share of one journal in an item."""

    place: SequenceStart
    rows: int
    first_ns: int
    last_ns: int
    bytes: int = 0
    stamp_offset_ns: int | None = None
    estimated: bool = False


def rate_hz(shares: Iterable[JournalShare], holes: Iterable[SequenceStart]) -> float | None:
    """Return the mean rate over all stretches that were recorded without a pause.

    A stretch is one run of one writer, or the time between two holes in it. None where no stretch
    has two rows.
    """
    cuts = sorted(holes)
    stretches: dict[tuple[str, int, int], list[JournalShare]] = {}
    for share in shares:
        writer, run, _ = share.place
        stretches.setdefault((writer, run, bisect_left(cuts, share.place)), []).append(share)
    steps = sum(sum(share.rows for share in found) - 1 for found in stretches.values())
    span_ns = sum(
        max(share.last_ns for share in found) - min(share.first_ns for share in found)
        for found in stretches.values()
    )
    return round(steps * NS / span_ns, 3) if span_ns > 0 else None


def deleted_positions(catalogue: StoreCatalogue) -> Iterator[SequenceStart]:
    """Yield where whole journals were deleted, columns and all."""
    for stone in catalogue.manifest.tombstones:
        if stone.what != "raw" and not set(stone.journals) & set(catalogue.existing):
            yield stone.writer, stone.run, stone.first_seq


_SMALL_BYTES = 1 << 20  # a journal that is no larger is unpacked whole: then every count is exact
_CHUNKS = 16  # chunks of an item that are unpacked for data not in the index


@dataclass(frozen=True, slots=True)
class ItemInfo:
    """One data item or child table of a record.

    ``rate_hz`` is over the time of recording: pauses between runs, and completely deleted parts, do
    not count; None if no run has two rows. ``stamp_offset_s`` is how far stamps are behind receipt
    (median over the record), None without stamps; ``bytes`` counts the messages as received (0 for
    child tables). ``estimated``: the ``rows`` of a child table come from a sample of messages. The
    ``rows`` of an item count all its messages; messages that cannot be decoded are subtracted when
    their journal becomes segments, and ``gaps`` names them. ``no_columns`` is the reason why there
    are only raw messages.
    """

    name: str
    source: str
    topic: str
    type: str
    rows: int
    first_ns: int
    last_ns: int
    rate_hz: float | None
    stamp_offset_s: float | None
    bytes: int
    estimated: bool = False
    no_columns: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the item as JSON has it: times are RFC 3339 strings."""
        return {
            "name": self.name,
            "source": self.source,
            "topic": self.topic,
            "type": self.type,
            "rows": self.rows,
            "first": format_time(self.first_ns),
            "last": format_time(self.last_ns),
            "rate_hz": self.rate_hz,
            "stamp_offset_s": self.stamp_offset_s,
            "bytes": self.bytes,
            **({"estimated": True} if self.estimated else {}),
            **({"no_columns": self.no_columns} if self.no_columns else {}),
        }


def overview(catalogue: StoreCatalogue) -> list[ItemInfo]:
    """Return each table that has rows, by name; the box's own channels come last."""
    holes = list(deleted_positions(catalogue))
    infos = [_info(catalogue, table, holes) for table in sorted(catalogue.schemas)]
    known = [info for info in infos if info is not None]
    known += _without_rows(catalogue, {info.name for info in known})
    known.sort(key=lambda info: info.name)
    return sorted(known, key=lambda info: info.source == channels.SOURCE)


def _info(catalogue: StoreCatalogue, table: str, holes: Sequence[SequenceStart]) -> ItemInfo | None:
    shares = list(_shares(catalogue, table))
    rows, estimated = sum(share.rows for share in shares), any(share.estimated for share in shares)
    if not rows and not estimated:
        return None
    schema = union(catalogue.schemas[table])
    return ItemInfo(
        table,
        schema.source,
        schema.topic,
        schema.type,
        rows,
        min(share.first_ns for share in shares),
        max(share.last_ns for share in shares),
        rate_hz(shares, holes),
        _stamp_offset_s(shares),
        sum(share.bytes for share in shares),
        estimated,
    )


def _stamp_offset_s(shares: Sequence[JournalShare]) -> float | None:
    """Return the median of the journals' medians, weighted by rows, seconds."""
    known = sorted(
        (share.stamp_offset_ns, share.rows) for share in shares if share.stamp_offset_ns is not None
    )
    if not known:
        return None
    passed = np.cumsum([rows for _, rows in known])
    middle = int(np.searchsorted(passed, passed[-1] / 2))
    return known[middle][0] / NS


def _shares(catalogue: StoreCatalogue, table: str) -> Iterator[JournalShare]:
    for segment in catalogue.segments(table):
        for part in segment.parts:
            yield _share_of_part(part)
    for journal in catalogue.journals(skip=catalogue.covered(table)):
        share = _journal_shares(journal).get(table) if item_of(journal, table) else None
        if share is not None:
            yield share


def _share_of_part(part: SegmentPart) -> JournalShare:
    place = part.writer, part.run, part.first_seq
    return JournalShare(place, part.rows, *part.received_range_ns, part.bytes, part.stamp_offset_ns)


def _journal_shares(journal: JournalFile) -> Mapping[str, JournalShare]:
    key = journal.path, journal.bytes, journal.end_seq, journal.clock
    return _counted(_JournalKey(key, journal))


@dataclass(frozen=True, slots=True)
class _JournalKey:
    """A journal as it was found; ``key`` changes with the file and its clock."""

    key: tuple[Path, int, int, ClockPoints]
    journal: JournalFile = field(compare=False)


@dataclass(slots=True)
class _Sample:
    """Rows of a table out of some chunks of a journal."""

    rows: int = 0
    first_ns: int = 0
    last_ns: int = 0
    ages: list[IntArray] = field(default_factory=list)

    def add(self, flat: FlatTable) -> None:
        """Add rows."""
        first_ns, last_ns = int(flat.received_ns.min()), int(flat.received_ns.max())
        self.first_ns = min(self.first_ns, first_ns) if self.rows else first_ns
        self.last_ns = max(self.last_ns, last_ns) if self.rows else last_ns
        self.rows += len(flat)
        if flat.schema.stamp:
            self.ages.append(flat.received_ns - flat.timestamp_ns)


@lru_cache(maxsize=256)
def _counted(journal_key: _JournalKey) -> Mapping[str, JournalShare]:
    """Count a journal's rows by its index; remembered until the file or its clock changes."""
    journal = journal_key.journal
    tallies = _tallies(journal)
    tables: dict[str, dict[str, TableSchema]] = {}
    totals: dict[str, ChannelTally] = {}
    numbers: dict[str, set[int]] = {}
    for number, stream in journal.streams.items():
        made = stream_tables(stream)
        if made and number in tallies and not stream.repeated:
            tables.setdefault(stream.item, {}).update({table.item: table for table in made})
            totals[stream.item] = tallies[number].plus(totals.get(stream.item))
            numbers.setdefault(stream.item, set()).add(number)
    places, whole = _chosen(journal, numbers, {i for i in tables if _is_sampled(tables[i])})
    samples = _sampled(replace(journal, places=places), tables)
    shares: dict[str, JournalShare] = {}
    for item, total in totals.items():
        for table in tables[item].values():
            share = _share(journal, total, table, samples, exact=item in whole)
            if share.rows or share.estimated:
                shares[table.item] = share
    return shares


def _is_sampled(tables: Mapping[str, TableSchema]) -> bool:
    """Return whether an item's index is not enough: it has no stamps and no child tables."""
    return len(tables) > 1 or any(table.stamp for table in tables.values())


def _tallies(journal: JournalFile) -> Mapping[int, ChannelTally]:
    if journal.tallies is not None:
        return journal.tallies
    try:
        return count_messages(journal.path)
    except UnindexedError:
        return merge_tallies(tally_chunk(chunk) for chunk in sound_chunks(journal))


def _chosen(
    journal: JournalFile, numbers: Mapping[str, Collection[int]], sampled: Collection[str]
) -> tuple[list[ChunkPlace], set[str]]:
    """Return the chunks to unpack, and the items of which these are all chunks.

    Of a small journal all chunks are unpacked. In others ``_CHUNKS`` of each item are chosen
    evenly.
    """
    holding: dict[int, list[int]] = {n: [] for found in numbers.values() for n in found}
    for index, place in enumerate(journal.places):
        for number in holding if place.channels is None else place.channels:
            if number in holding:
                holding[number].append(index)
    chosen: set[int] = set()
    whole = set()
    for item, found in numbers.items():
        held = sorted({index for number in found for index in holding[number]})
        if len(held) <= _CHUNKS or journal.bytes <= _SMALL_BYTES:
            whole.add(item)
            chosen.update(held)
        elif item in sampled:
            even = np.linspace(0, len(held) - 1, _CHUNKS).round().astype(int)
            chosen.update(held[index] for index in even.tolist())
    return [journal.places[index] for index in sorted(chosen)], whole


def _sampled(journal: JournalFile, items: Collection[str]) -> dict[str, _Sample]:
    """Unroll the messages of some chunks; return the sample of each table."""
    found: dict[str, _Sample] = {}
    for batch in batches_of(journal, items) if journal.places else ():
        for flat in flatten(batch):
            if len(flat):
                found.setdefault(flat.schema.item, _Sample()).add(flat)
    return found


def _share(
    journal: JournalFile,
    total: ChannelTally,
    table: TableSchema,
    samples: Mapping[str, _Sample],
    *,
    exact: bool,
) -> JournalShare:
    place = journal.writer, journal.run, journal.first_seq
    sample = samples.get(table.item, _Sample())
    size = 0 if table.parent else total.bytes
    if exact:
        return JournalShare(
            place, sample.rows, sample.first_ns, sample.last_ns, size, median(sample.ages)
        )
    first_ns, last_ns = ClockTable(journal.clock).span(total.first_ns, total.last_ns)
    rows, estimated = total.rows, bool(table.parent)
    if estimated:
        messages = samples.get(table.parent, _Sample()).rows
        rows = round(total.rows * sample.rows / max(messages, 1))
    return JournalShare(place, rows, first_ns, last_ns, size, median(sample.ages), estimated)


def _without_rows(catalogue: StoreCatalogue, named: Container[str]) -> Iterator[ItemInfo]:
    """Yield items of which no message can be unrolled, with times and counts of receipt only."""
    found: dict[str, list[tuple[JournalFile, ChannelTally]]] = {}
    for journal in catalogue.journals(skip=catalogue.columns_done):
        for item, count in journal.items.items():
            if count and item not in named:
                numbers = [n for n, s in journal.streams.items() if s.item == item]
                tallies = _tallies(journal)
                for number in numbers:
                    if number in tallies and not journal.streams[number].repeated:
                        found.setdefault(item, []).append((journal, tallies[number]))
    for item, counted_in in found.items():
        stream = next(s for s in counted_in[-1][0].streams.values() if s.item == item)
        shares = [_raw_share(journal, tally) for journal, tally in counted_in]
        raw = catalogue.raw.get(item)
        why = raw[-1][1].reason.partition(": ")[2] if raw else "no message fits its definition"
        yield ItemInfo(
            item, stream.source, stream.topic.name,
            stream.topic.schema.name if stream.topic.schema else "",
            sum(share.rows for share in shares),
            min(share.first_ns for share in shares), max(share.last_ns for share in shares),
            rate_hz(shares, ()), None, sum(share.bytes for share in shares), no_columns=why,
        )  # fmt: skip


def _raw_share(journal: JournalFile, tally: ChannelTally) -> JournalShare:
    place = journal.writer, journal.run, journal.first_seq
    first_ns, last_ns = ClockTable(journal.clock).span(tally.first_ns, tally.last_ns)
    return JournalShare(place, tally.rows, first_ns, last_ns, tally.bytes, None)
