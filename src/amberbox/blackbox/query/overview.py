"""What a record holds, item by item: rows, times, rates, the stamps' distance from receipt."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from amberbox.blackbox.follow.read import JournalFile, batches_of, journal_file, sound_chunks
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.chunk import sequences
from amberbox.blackbox.journal.clocktable import ClockPoints, ClockTable
from amberbox.blackbox.query.catalogue import Catalogue, item_of, union
from amberbox.blackbox.query.rates import Place, Share, deleted_places, rate_hz
from amberbox.blackbox.segments.build import median
from amberbox.blackbox.segments.flat import Flat, flatten
from amberbox.blackbox.segments.manifest import Part, part_clock
from amberbox.core.clock import NS
from amberbox.core.timetext import format_time


@dataclass(frozen=True, slots=True)
class ItemInfo:
    """One data item or child table of a record.

    ``rate_hz`` is over the time of recording: pauses between runs, and what was deleted whole, do
    not count; None where no two rows came in one run. ``stamp_offset_s`` is how far stamps lie
    behind receipt (median over the record), None without stamps; ``bytes`` counts the messages as
    received (0 for child tables). ``no_columns`` says why the messages are there only as they came.
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
    rows = sum(share.rows for share in shares)
    if not rows:
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


def _journal_shares(journal: JournalFile) -> dict[str, Share]:
    status = journal.path.stat()
    return _counted(journal.path, journal.name, journal.clock, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=256)
def _counted(
    path: Path, name: str, clock: ClockPoints, _mtime_ns: int, _size: int
) -> dict[str, Share]:
    """Count a journal's rows by unrolling it; remembered until the file or its clock changes."""
    journal = replace(journal_file(path, name), clock=clock)
    pieces: dict[str, list[Flat]] = {}
    sizes: dict[str, int] = {}
    for batch in batches_of(journal, sizes=sizes):
        for flat in flatten(batch):
            if len(flat):
                pieces.setdefault(flat.schema.item, []).append(flat.with_columns({}))
    place = journal.writer, journal.run, journal.first_seq
    return {table: _share(place, found, sizes.get(table, 0)) for table, found in pieces.items()}


def _share(place: Place, pieces: Sequence[Flat], size: int) -> Share:
    first = min(int(piece.received_ns.min()) for piece in pieces)
    last = max(int(piece.received_ns.max()) for piece in pieces)
    ages = [p.received_ns - p.timestamp_ns for p in pieces if p.schema.stamp]
    return Share(place, sum(map(len, pieces)), first, last, size, median(ages))


def _without_rows(catalogue: Catalogue, named: Container[str]) -> Iterator[ItemInfo]:
    """Describe items of which no message can be unrolled, by their receipt alone."""
    found: dict[str, list[JournalFile]] = {}
    for journal in catalogue.journals(skip=catalogue.columns_done):
        for item, count in journal.items.items():
            if count and item not in named:
                found.setdefault(item, []).append(journal)
    for item, journals in found.items():
        stream = next(s for s in journals[-1].streams.values() if s.item == item)
        shares = [share for journal in journals for share in _raw_shares(journal, item)]
        if shares:
            raw = catalogue.raw.get(item)
            why = raw[-1][1].reason.partition(": ")[2] if raw else "no message fits its definition"
            yield ItemInfo(
                item, stream.source, stream.topic.name,
                stream.topic.schema.name if stream.topic.schema else "",
                sum(share.rows for share in shares),
                min(share.first_ns for share in shares), max(share.last_ns for share in shares),
                rate_hz(shares, ()), None, sum(share.bytes for share in shares), why,
            )  # fmt: skip


def _raw_shares(journal: JournalFile, item: str) -> Iterator[Share]:
    """Count an item's messages in the chunks of a journal."""
    numbers = [n for n, s in journal.streams.items() if s.item == item and not s.repeated]
    clock = ClockTable(journal.clock)
    for chunk in sound_chunks(journal):
        rows = np.flatnonzero(np.isin(chunk.channel, numbers))
        if len(rows):
            received = clock.received(chunk.log_ns[rows])
            size = int((chunk.ends[rows] - chunk.starts[rows]).sum())
            place = journal.writer, journal.run, int(sequences(chunk, journal.first_seq)[rows[0]])
            yield Share(place, len(rows), int(received.min()), int(received.max()), size, None)
