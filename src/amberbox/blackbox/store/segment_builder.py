"""Turn sealed journals into Parquet segments, and merge small ones.

``drop_gone`` takes the rows of journals whose columns were deleted out of shared segments.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema, flatten, join_tables
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.journal_reader import (
    JournalFile,
    batches_of,
    run_messages,
    with_columns,
)
from amberbox.blackbox.store.manifest import FOLDER
from amberbox.blackbox.store.manifest_entries import Segment, SegmentPart
from amberbox.blackbox.store.segment_file import SegmentWriter, describe, read_segment
from amberbox.core.files import below
from amberbox.core.types import ColumnData, Gap, IntArray, Ragged

GROUP_ROWS = 60_000
_GROUP_BYTES = 16 << 20
SMALL_ROWS = 6_000
_MERGED_BYTES = 64 << 20
MERGE_COUNT = 6
_SIZED_ROWS = 16


@dataclass
class _TableBuilder:
    """Collects one table's rows of one journal and writes them in row groups."""

    file: SegmentWriter
    waiting: list[FlatTable] = field(default_factory=list)
    rows: int = 0
    bytes: int = 0
    bounds: list[tuple[int, ...]] = field(default_factory=list)
    ages: list[IntArray] = field(default_factory=list)

    def add(self, flat: FlatTable) -> None:
        self.waiting.append(flat)
        self.rows += len(flat)
        self.bytes += sum(_size(column) for column in flat.columns.values())
        self.bounds.append(bounds_of(flat))
        if flat.schema.stamp:
            self.ages.append(flat.received_ns - flat.timestamp_ns)
        if self.rows >= GROUP_ROWS or self.bytes >= _GROUP_BYTES:
            self.write()

    def write(self) -> None:
        if self.waiting:
            self.file.write(join_tables(self.waiting))
        self.waiting, self.rows, self.bytes = [], 0, 0

    def finish(self, journal: JournalFile, files: int, size: int) -> Segment:
        self.write()
        lows = np.min([bound[0::2] for bound in self.bounds], axis=0).tolist()
        highs = np.max([bound[1::2] for bound in self.bounds], axis=0).tolist()
        part = SegmentPart(
            journal.name, journal.chain, journal.writer, journal.run, lows[0], highs[0],
            self.file.rows, lows[1], highs[1], lows[2], highs[2], files, size,
            median(self.ages), tuple(journal.clock),
        )  # fmt: skip
        return self.file.finish([part])


def median(ages: Sequence[IntArray]) -> int | None:
    """Return the median of received minus stamp; None without stamps."""
    return int(np.median(np.concatenate(ages))) if ages else None


def bounds_of(flat: FlatTable) -> tuple[int, ...]:
    """Return the least and greatest ``seq``, log time and stamp, in this order."""
    keys = (flat.seq, flat.log_time_ns, flat.timestamp_ns)
    return tuple(int(edge) for key in keys for edge in (key.min(), key.max()))


def _size(column: ColumnData) -> int:
    if isinstance(column, Ragged):
        return column.offsets.nbytes + _size(column.values)
    if column.dtype != object:
        return column.nbytes
    sample = column[:: max(len(column) // _SIZED_ROWS, 1)]
    known = [len(value) for value in sample if value is not None]
    return len(column) * (64 + sum(known) // max(len(sample), 1))


def _no_pause() -> None:
    """Do nothing: the default where there is no other work to continue meanwhile."""


def build_segments(
    store: Path, journal: JournalFile, report_progress: Callable[[], None] = _no_pause
) -> list[Segment]:
    """Write a sealed journal's rows as one Parquet file per table and enter them in the manifest.

    ``breathe`` is called repeatedly meanwhile.

    A journal that is in the manifest already is left alone. A crash leaves files that the next call
    overwrites; readers use the journal until its entries are durable. Undecodable messages are
    entered as gaps.
    """
    known = mf.read(store)
    if journal.name in known.journals:
        return []
    gaps: list[Gap] = []
    sizes: dict[str, int] = {}
    builders: dict[TableSchema, _TableBuilder] = {}
    try:
        for flat in _flats(known, journal, gaps, sizes):
            _builder(builders, store, journal, flat.schema).add(flat)
            report_progress()
        segments = _finish(builders, journal, sizes, report_progress)
    finally:
        for builder in builders.values():
            builder.file.discard()
    new = [schema for schema in builders if schema.id not in known.schemas]
    records = [mf.schema_record(schema) for schema in new]
    records += [mf.segment_record(segment) for segment in segments]
    done = _done(journal, gaps)
    mf.append(store, [*records, mf.journal_record(done)])
    return segments


def _done(journal: JournalFile, gaps: Sequence[Gap]) -> mf.ManifestJournal:
    start_ns, end_ns = journal.received_range_ns
    return mf.ManifestJournal(
        journal.name, journal.chain, journal.writer, journal.run, journal.first_seq,
        journal.end_seq, start_ns, end_ns, tuple(gaps), selection_of(journal),
    )  # fmt: skip


def _finish(
    builders: Mapping[TableSchema, _TableBuilder],
    journal: JournalFile,
    sizes: dict[str, int],
    report_progress: Callable[[], None],
) -> list[Segment]:
    files = Counter(schema.item for schema in builders)
    segments = []
    for schema, builder in builders.items():
        size = sizes.pop(schema.item, 0)  # once, should there be several versions
        segments.append(builder.finish(journal, files[schema.item], size))
        report_progress()  # each file is synced
    return segments


def selection_of(journal: JournalFile) -> dict[str, list[str]]:
    """Return the variables that were configured for a journal's items."""
    items = json.loads(run_messages(journal).get("items") or "{}")
    chosen = {item: options.get("variables") for item, options in items.items()}
    return {item: list(names) for item, names in chosen.items() if names}


def _flats(
    known: mf.Manifest, journal: JournalFile, gaps: list[Gap], sizes: dict[str, int]
) -> Iterator[FlatTable]:
    """Yield the rows that are not in a segment yet (all of them, but after a rebuild)."""
    items = with_columns(journal, gaps.append)
    for batch in batches_of(journal, items, on_gap=gaps.append, sizes=sizes):
        for flat in flatten(batch):
            if len(flat) and journal.name not in known.complete(flat.schema.item):
                yield flat


def _builder(
    builders: dict[TableSchema, _TableBuilder],
    store: Path,
    journal: JournalFile,
    schema: TableSchema,
) -> _TableBuilder:
    if schema not in builders:
        version = 1 + sum(other.item == schema.item for other in builders)
        path = segment_path(schema.item, journal.name, version)
        builders[schema] = _TableBuilder(SegmentWriter(store, path, schema))
    return builders[schema]


def segment_path(item: str, journal: str, version: int) -> str:
    """Return the path of the file of a table's rows of one journal."""
    folder, _, name = journal.rpartition("/")
    writer = "" if folder in ("", "journal") else f"{folder}-"
    number = f".{version}" if version > 1 else ""
    return f"{FOLDER}/{item}/{writer}{Path(name).stem}{number}.parquet"


def merge_small(store: Path, report_progress: Callable[[], None] = _no_pause) -> list[Segment]:
    """Join neighbouring small segments, so that slow items do not fill the disk with files.

    Whenever 6 segments of one table (one hour at 10 minutes each) of fewer than 6,000 rows are
    adjacent, they become one. The old ones are deleted once the manifest lists it.
    """
    merged = []
    for item in mf.read(store).segments:
        report_progress()  # which may delete segments
        known = mf.read(store)
        whole = [s for s in known.segments.get(item, ()) if not is_partly_gone(s, known)]
        for group in _small_groups(whole):
            with suppress(FileNotFoundError):  # deleted for room meanwhile
                merged += _merge(store, known.schemas[group[0].schema], group)
    return merged


def is_partly_gone(segment: Segment, known: mf.Manifest) -> bool:
    """Return whether a segment holds rows of deleted journals; kept ones never do."""
    gone = any(part.journal in known.columns_gone for part in segment.parts)
    return gone and not is_kept_segment(segment, known)


def _small_groups(segments: Sequence[Segment]) -> Iterator[list[Segment]]:
    """Find runs of small segments of one writer and schema whose log time only grows."""
    group: list[Segment] = []
    for segment in sorted(segments, key=_order):
        if not (group and _may_follow(group, segment)):
            if len(group) >= MERGE_COUNT:
                yield group
            group = []
        if segment.rows < SMALL_ROWS and segment.bytes < _MERGED_BYTES:
            group.append(segment)
    if len(group) >= MERGE_COUNT:
        yield group


def _order(segment: Segment) -> tuple[str, int, int]:
    first = segment.parts[0]
    return first.writer, first.run, first.first_seq


def _may_follow(group: Sequence[Segment], segment: Segment) -> bool:
    last, first = group[-1].parts[-1], segment.parts[0]
    same = group[-1].schema == segment.schema and last.writer == first.writer
    size = sum(member.bytes for member in group) + segment.bytes
    return same and last.to_ns < first.from_ns and size < _MERGED_BYTES


def _merge(store: Path, schema: TableSchema, group: Sequence[Segment]) -> list[Segment]:
    first = Path(group[0].path)
    stem = first.stem.partition("+")[0]
    count = sum(map(_journal_count, group))
    file = SegmentWriter(store, str(first.with_name(f"{stem}+{count}.parquet")), schema)
    names = {column.name for column in schema.columns}
    flats = [flat for s in group for flat in read_segment(store, s, schema, names)]
    try:
        for start in group_starts(flats):
            file.write(start)
        segment = file.finish([part for member in group for part in member.parts])
    finally:
        file.discard()
    return [segment] if put_in_place_of(store, segment, group) else []


def put_in_place_of(store: Path, segment: Segment, before: Sequence[Segment]) -> bool:
    """Replace segments by one; return False, and do not, if one of them was deleted meanwhile."""
    paths = [one.path for one in before]
    with mf.CHANGING:
        known = mf.read(store)
        named = {part.journal for part in segment.parts}
        is_late = not known.gone_segments.isdisjoint(paths)
        if is_late or not (known.columns_gone.isdisjoint(named) or is_kept_segment(segment, known)):
            below(store, segment.path).unlink(missing_ok=True)
            return False
        mf.append(store, [mf.segment_record(segment, paths)])
        for path in paths:
            below(store, path).unlink(missing_ok=True)
    return True


def is_kept_segment(segment: Segment, known: mf.Manifest) -> bool:
    """Return whether a segment stays when the data around it go."""
    return mf.is_kept(known.schemas[segment.schema])


def _journal_count(segment: Segment) -> int:
    """Count the journals of a segment by its name: of old ones the manifest joins the parts."""
    return int(Path(segment.path).stem.partition("+")[2] or 1)


def group_starts(flats: Sequence[FlatTable]) -> Iterator[FlatTable]:
    """Join rows up to the size of a row group."""
    waiting: list[FlatTable] = []
    for flat in flats:
        waiting.append(flat)
        if sum(map(len, waiting)) >= GROUP_ROWS:
            yield join_tables(waiting)
            waiting = []
    if waiting:
        yield join_tables(waiting)


def remove_leftovers(store: Path) -> int:
    """Delete temporary files and joined segments that a crash left behind."""
    known = mf.read(store)
    live = {segment.path for found in known.segments.values() for segment in found}
    removed = 0
    for path in (store / FOLDER).glob("*/*"):
        name = str(path.relative_to(store))
        covered = path.suffix == ".parquet" and name not in live and _is_merged(store, name, known)
        if path.name.endswith(".tmp") or covered:
            with suppress(OSError):
                path.unlink()
                removed += 1
    return removed


def _is_merged(store: Path, name: str, known: mf.Manifest) -> bool:
    try:
        _, segment = describe(store, name)
    except mf.UNREADABLE:
        return False
    return all(part.journal in known.complete(segment.item) for part in segment.parts)


def drop_gone(store: Path, report_progress: Callable[[], None]) -> int:
    """Rewrite joined segments without the journals whose columns were deleted."""
    count = 0
    for item in mf.read(store).segments:
        report_progress()  # which may delete segments
        known = mf.read(store)
        for segment in known.segments.get(item, ()):
            if is_partly_gone(segment, known):
                with suppress(FileNotFoundError):  # deleted for room meanwhile
                    count += _rewrite(store, known, segment)
    return count


def _rewrite(store: Path, known: mf.Manifest, segment: Segment) -> bool:
    """Replace a segment by its rows of the journals that still have columns."""
    schema = known.schemas[segment.schema]
    parts = [part for part in segment.parts if part.journal not in known.columns_gone]
    names = {column.name for column in schema.columns}
    flats = [f for f in read_segment(store, segment, schema, names) if _is_of(f, parts)]
    file = SegmentWriter(store, _path_without(segment, parts), schema)
    try:
        for rows in group_starts(flats):
            file.write(rows)
        rest = file.finish(parts)
    finally:
        file.discard()
    return put_in_place_of(store, rest, [segment])


def _is_of(flat: FlatTable, parts: Sequence[SegmentPart]) -> bool:
    first = int(flat.seq[0])
    return any(p.run == flat.run and p.first_seq <= first <= p.last_seq for p in parts)


def _path_without(segment: Segment, parts: Sequence[SegmentPart]) -> str:
    """Return the path of a segment's rest: its first journal, schema version, number of parts."""
    stem = Path(segment.path).stem.partition("+")[0]
    version = stem.partition(".")[2]
    first = Path(segment_path(segment.item, parts[0].journal, int(version or 1)))
    return str(first.with_name(f"{first.stem}+{len(parts)}.parquet"))
