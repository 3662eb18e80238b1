"""What a record holds, item by item: rows, times, rates, the stamps' distance from receipt.

Of journals that are in no segments yet the index is counted, and messages of a few chunks are
unrolled: a list of items has to come at once, also of an hour that is just being written.
"""

from __future__ import annotations

from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from amberbox.blackbox.follow.read import JournalFile, batches_of, sound_chunks
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.clocktable import ClockPoints, ClockTable
from amberbox.blackbox.journal.growing import UnindexedError, counted
from amberbox.blackbox.journal.scan import ChunkPlace, Tally, tally_of, together
from amberbox.blackbox.query.catalogue import Catalogue, item_of, stream_tables, union
from amberbox.blackbox.query.rates import Place, Share, deleted_places, rate_hz
from amberbox.blackbox.segments.build import median
from amberbox.blackbox.segments.flat import Flat, TableSchema, flatten
from amberbox.blackbox.segments.manifest import Part, part_clock
from amberbox.core.clock import NS
from amberbox.core.timetext import format_time
from amberbox.core.types import IntArray

_SMALL_BYTES = 1 << 20
"""A journal that is no larger is unpacked whole: then every count is exact."""
_CHUNKS = 16
"""Chunks of an item that are unpacked for what the index does not say."""


@dataclass(frozen=True, slots=True)
class ItemInfo:
    """One data item or child table of a record.

    ``rate_hz`` is over the time of recording: pauses between runs, and what was deleted whole, do
    not count; None where no two rows came in one run. ``stamp_offset_s`` is how far stamps lie
    behind receipt (median over the record), None without stamps; ``bytes`` counts the messages as
    received (0 for child tables). ``estimated`` tells that ``rows`` of a child table come from a
    sample of messages. Of items the rows are all messages: those that turn out not to decode are
    left out when their journal becomes segments, and ``gaps`` names them. ``no_columns`` says why
    the messages are there only as they came.
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


def overview(catalogue: Catalogue) -> list[ItemInfo]:
    """Describe each table that has rows, by name; the box's own channels come last."""
    holes = list(deleted_places(catalogue))
    infos = [_info(catalogue, table, holes) for table in sorted(catalogue.schemas)]
    known = [info for info in infos if info is not None]
    known += _without_rows(catalogue, {info.name for info in known})
    known.sort(key=lambda info: info.name)
    return sorted(known, key=lambda info: info.source == reserved.SOURCE)


def _info(catalogue: Catalogue, table: str, holes: Sequence[Place]) -> ItemInfo | None:
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


def _stamp_offset_s(shares: Sequence[Share]) -> float | None:
    """Median over the journals' medians, each counting by its rows."""
    known = sorted(
        (share.stamp_offset_ns, share.rows) for share in shares if share.stamp_offset_ns is not None
    )
    if not known:
        return None
    passed = np.cumsum([rows for _, rows in known])
    middle = int(np.searchsorted(passed, passed[-1] / 2))
    return known[middle][0] / NS


def _shares(catalogue: Catalogue, table: str) -> Iterator[Share]:
    for segment in catalogue.segments(table):
        for part in segment.parts:
            yield _share_of_part(part)
    for journal in catalogue.journals(skip=catalogue.covered(table)):
        share = _journal_shares(journal).get(table) if item_of(journal, table) else None
        if share is not None:
            yield share


def _share_of_part(part: Part) -> Share:
    edges = np.array([part.from_ns, part.to_ns])
    first, last = ClockTable(part_clock(part)).received(edges).tolist()
    place = part.writer, part.run, part.first_seq
    return Share(place, part.rows, first, last, part.bytes, part.stamp_offset_ns)


def _journal_shares(journal: JournalFile) -> Mapping[str, Share]:
    key = journal.path, journal.bytes, journal.end_seq, journal.clock
    return _counted(_Asked(key, journal))


@dataclass(frozen=True, slots=True)
class _Asked:
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

    def add(self, flat: Flat) -> None:
        """Take rows."""
        first_ns, last_ns = int(flat.received_ns.min()), int(flat.received_ns.max())
        self.first_ns = min(self.first_ns, first_ns) if self.rows else first_ns
        self.last_ns = max(self.last_ns, last_ns) if self.rows else last_ns
        self.rows += len(flat)
        if flat.schema.stamp:
            self.ages.append(flat.received_ns - flat.timestamp_ns)


@lru_cache(maxsize=256)
def _counted(asked: _Asked) -> Mapping[str, Share]:
    """Count a journal's rows by its index; remembered until the file or its clock changes."""
    journal = asked.journal
    tallies = _tallies(journal)
    tables: dict[str, dict[str, TableSchema]] = {}
    totals: dict[str, Tally] = {}
    numbers: dict[str, set[int]] = {}
    for number, stream in journal.streams.items():
        made = stream_tables(stream)
        if made and number in tallies and not stream.repeated:
            tables.setdefault(stream.item, {}).update({table.item: table for table in made})
            totals[stream.item] = tallies[number].plus(totals.get(stream.item))
            numbers.setdefault(stream.item, set()).add(number)
    places, whole = _chosen(journal, numbers, {i for i in tables if _is_sampled(tables[i])})
    samples = _sampled(replace(journal, places=places), tables)
    shares: dict[str, Share] = {}
    for item, total in totals.items():
        for table in tables[item].values():
            share = _share(journal, total, table, samples, exact=item in whole)
            if share.rows or share.estimated:
                shares[table.item] = share
    return shares


def _is_sampled(tables: Mapping[str, TableSchema]) -> bool:
    """Tell whether an item's index does not say all: of stamps and child tables it does not."""
    return len(tables) > 1 or any(table.stamp for table in tables.values())


def _tallies(journal: JournalFile) -> Mapping[int, Tally]:
    if journal.tallies is not None:
        return journal.tallies
    try:
        return counted(journal.path)
    except UnindexedError:
        return together(tally_of(chunk) for chunk in sound_chunks(journal))


def _chosen(
    journal: JournalFile, numbers: Mapping[str, Collection[int]], sampled: Collection[str]
) -> tuple[list[ChunkPlace], set[str]]:
    """Choose chunks to be unpacked, and name the items of which these are all.

    All are of a small journal. In others ``_CHUNKS`` are taken evenly of each item with more.
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
    """Unroll the messages of some chunks; return what there is of each table."""
    found: dict[str, _Sample] = {}
    for batch in batches_of(journal, items) if journal.places else ():
        for flat in flatten(batch):
            if len(flat):
                found.setdefault(flat.schema.item, _Sample()).add(flat)
    return found


def _share(
    journal: JournalFile,
    total: Tally,
    table: TableSchema,
    samples: Mapping[str, _Sample],
    *,
    exact: bool,
) -> Share:
    place = journal.writer, journal.run, journal.first_seq
    sample = samples.get(table.item, _Sample())
    size = 0 if table.parent else total.bytes
    if exact:
        return Share(place, sample.rows, sample.first_ns, sample.last_ns, size, median(sample.ages))
    edges = np.array([total.first_ns, total.last_ns])
    first_ns, last_ns = ClockTable(journal.clock).received(edges).tolist()
    rows, estimated = total.rows, bool(table.parent)
    if estimated:
        messages = samples.get(table.parent, _Sample()).rows
        rows = round(total.rows * sample.rows / max(messages, 1))
    return Share(place, rows, first_ns, last_ns, size, median(sample.ages), estimated)


def _without_rows(catalogue: Catalogue, named: Container[str]) -> Iterator[ItemInfo]:
    """Describe items of which no message can be unrolled, by their receipt alone."""
    found: dict[str, list[tuple[JournalFile, Tally]]] = {}
    for journal in catalogue.journals(skip=catalogue.columns_done):
        for item, count in journal.items.items():
            if count and item not in named:
                numbers = [n for n, s in journal.streams.items() if s.item == item]
                tallies = _tallies(journal)
                for number in numbers:
                    if number in tallies and not journal.streams[number].repeated:
                        found.setdefault(item, []).append((journal, tallies[number]))
    for item, told in found.items():
        stream = next(s for s in told[-1][0].streams.values() if s.item == item)
        shares = [_raw_share(journal, tally) for journal, tally in told]
        raw = catalogue.raw.get(item)
        why = raw[-1][1].reason.partition(": ")[2] if raw else "no message fits its definition"
        yield ItemInfo(
            item, stream.source, stream.topic.name,
            stream.topic.schema.name if stream.topic.schema else "",
            sum(share.rows for share in shares),
            min(share.first_ns for share in shares), max(share.last_ns for share in shares),
            rate_hz(shares, ()), None, sum(share.bytes for share in shares), no_columns=why,
        )  # fmt: skip


def _raw_share(journal: JournalFile, tally: Tally) -> Share:
    place = journal.writer, journal.run, journal.first_seq
    edges = np.array([tally.first_ns, tally.last_ns])
    first_ns, last_ns = ClockTable(journal.clock).received(edges).tolist()
    return Share(place, tally.rows, first_ns, last_ns, tally.bytes, None)
