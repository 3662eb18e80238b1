"""The Delta tables of an archive: paths, log, Parquet files, and commits to the log.

A commit adds and removes files atomically, with the number of the batch. Only commits need the
library ``deltalake``, which is imported late.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.columns.arrow import arrow_type
from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema, join_tables
from amberbox.blackbox.store.clocks import ClockPoints
from amberbox.blackbox.store.manifest_entries import Segment, SegmentPart, part_from_json
from amberbox.blackbox.store.segment_builder import GROUP_ROWS, bounds_of, median
from amberbox.blackbox.store.segment_file import METADATA, SegmentWriter, key_names, read_segment
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.files import below
from amberbox.core.names import is_item
from amberbox.core.types import ColumnData, IntArray, Ragged
from amberbox.server.archive.catalogue import RobotStore
from amberbox.server.archive.location import JOURNALS, TABLES
from amberbox.server.archive.rollups import LEVELS, has_levels, level_schema

if TYPE_CHECKING:
    import pyarrow as pa
    from deltalake import DeltaTable
    from deltalake.transaction import AddAction, RemoveAction


# The application id under which a table's log states the last batch in it
APP = "amberbox"

_LOG = "_delta_log"


@dataclass(frozen=True, slots=True)
class LiveFile:
    """One live file of a table: its partition, and the bounds of its keys (both inclusive)."""

    path: str
    robot: str
    day: str
    bytes: int
    rows: int
    low: Mapping[str, Any]
    high: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class TableSnapshot:
    """The state of a table at one version of its log; version -1 is no table."""

    version: int = -1
    files: Mapping[str, LiveFile] = field(default_factory=dict)
    batch: int = 0


# The last snapshot of each table; logs only grow, so nothing is read twice
_REMEMBERED: dict[Path, TableSnapshot] = {}


def read_snapshot(table: Path) -> TableSnapshot:
    """Return the newest snapshot of a table, reading only new log entries."""
    found = _followed(table, _REMEMBERED.get(table, TableSnapshot()))
    try:
        mark = int(json.loads((table / _LOG / "_last_checkpoint").read_text())["version"])
    except FileNotFoundError:
        mark = -1
    if mark > found.version:
        import pyarrow.parquet as pq

        path = table / _LOG / f"{mark:020}.checkpoint.parquet"
        rows = pq.read_table(path, columns=["add", "txn"]).to_pylist()
        actions = ({k: v for k, v in row.items() if v} for row in rows)
        found = _followed(table, _applied(TableSnapshot(), mark, actions))
    _REMEMBERED[table] = found
    return found


def _followed(table: Path, before: TableSnapshot) -> TableSnapshot:
    """Return the snapshot after the commits that follow ``before``."""
    actions: list[Mapping[str, Any]] = []
    version = before.version
    while True:
        try:
            text = (table / _LOG / f"{version + 1:020}.json").read_text()
        except FileNotFoundError:
            break
        actions += map(json.loads, text.splitlines())
        version += 1
    return _applied(before, version, actions) if version > before.version else before


def _applied(
    before: TableSnapshot, version: int, actions: Iterable[Mapping[str, Any]]
) -> TableSnapshot:
    files, batch = dict(before.files), before.batch
    for action in actions:
        if "remove" in action:
            files.pop(unquote(action["remove"]["path"]), None)
        elif "add" in action:
            add = action["add"]
            path, partition = unquote(add["path"]), add["partitionValues"]
            stats = json.loads(add["stats"])
            files[path] = LiveFile(
                path, partition["robot"], partition["day"], int(add["size"]),
                int(stats["numRecords"]), stats["minValues"], stats["maxValues"],
            )  # fmt: skip
        elif action.get("txn", {}).get("appId") == APP:
            batch = int(action["txn"]["version"])
    return replace(before, version=version, files=files, batch=batch)


_VERSION = re.compile(rf"[0-9a-f]{{16}}(\.({'|'.join(LEVELS)}))?")


@dataclass(frozen=True, slots=True)
class ArchiveLayout:
    """The folders of an archive; the only place that builds paths from names that robots choose."""

    folder: Path

    @property
    def tables(self) -> Path:
        """Folder of the Delta tables."""
        return self.folder / TABLES

    @property
    def journals(self) -> Path:
        """Folder of the journals."""
        return self.folder / JOURNALS

    def journal(self, robot: str, store_id: str, file: str) -> Path:
        """Return the path of a journal; raises AmberboxError for names that leave the folder."""
        return below(self.journals, robot, store_id, file)

    def table(self, table: str) -> Path:
        """Return the folder of a table; raises AmberboxError for an invalid name."""
        item, _, version = table.partition("/")
        if not is_item(item) or not _VERSION.fullmatch(version):
            raise AmberboxError(
                f"{table[:100]!r} is no name of a table",
                "a journal has an item of this name: it is left out of the tables",
            )
        return below(self.tables, item, version)

    def snapshot(self, table: str) -> TableSnapshot:
        """Return the newest snapshot of a table."""
        return read_snapshot(self.table(table))


def table_of(schema: TableSchema, level: str = "") -> str:
    """Return the name of a table's folder: one per item, schema version and rollup level."""
    return f"{schema.item}/{schema.id}" + (f".{level}" if level else "")


def tables_of(schema: TableSchema) -> list[tuple[str, TableSchema]]:
    """Return the tables of a schema: its rows, and the rollup levels."""
    levels = LEVELS if has_levels(schema) else ()
    raised = [(table_of(schema, level), level_schema(schema, level)) for level in levels]
    return [(table_of(schema), schema), *raised]


PARTITIONS = ("robot", "day")
OURS = ("received", "store_id", "writer", "run")
_TAKEN = frozenset({"log_time", *PARTITIONS, *OURS})
_SIGNED = {
    "uint8": "int16",
    "uint16": "int32",
    "uint32": "int64",
    "uint64": "int64",
    "time": "int64",
    "duration": "int64",
}


def stored_name(name: str) -> str:
    """Return the name of a variable's column in a file; names of key columns get a colon."""
    return f"{name}:" if name.casefold() in _TAKEN else name


def stored_type(column_type: str) -> str:
    """Return the type that stores a column, as Delta has neither unsigned integers nor times.

    ``uint64`` becomes ``int64`` with the same bits.
    """
    inner = col.element_type(column_type)
    if inner is not None:
        return f"list<{stored_type(inner)}>"
    return _SIGNED.get(column_type, column_type)


def arrow_schema(schema: TableSchema) -> pa.Schema:
    """Return the Arrow schema of a Delta table, partition columns first."""
    import pyarrow as pa

    keys = [(name, pa.int64()) for name in key_names(schema)]
    ours = [("received", pa.int64()), ("store_id", pa.string()), ("writer", pa.string())]
    own = [(stored_name(c.name), arrow_type(stored_type(c.type))) for c in schema.columns]
    partitions = [("robot", pa.string()), ("day", pa.date32())]
    return pa.schema([*partitions, *keys, *ours, ("run", pa.int64()), *own])


class ArchiveFile(SegmentWriter):
    """Writes one file of a table, with the rows of one robot's store."""

    def __init__(self, tables: Path, path: str, schema: TableSchema, store_id: str) -> None:
        super().__init__(tables, path, schema)
        self.store_id = store_id

    def layout(self, flat: FlatTable) -> tuple[list[str], list[str], list[Any]]:
        """Return names, types and contents of the columns of the file, the keys first."""
        count, own = len(flat), self.schema.columns
        names = [*key_names(self.schema), *OURS, *(stored_name(c.name) for c in own)]
        kinds = ["int64"] * 4 + ["string", "string", "int64", *(stored_type(c.type) for c in own)]
        keys: list[ColumnData] = [flat.seq, flat.log_time_ns, flat.timestamp_ns, flat.received_ns]
        who = [np.full(count, self.store_id, object), np.full(count, flat.writer, object)]
        values = [_signed(flat.columns[c.name]) for c in own]
        return names, kinds, [*keys, *who, np.full(count, flat.run, np.int64), *values]


def _signed(column: ColumnData) -> ColumnData:
    """Reinterpret 64-bit unsigned integers as signed; other columns are not changed."""
    if isinstance(column, Ragged):
        values = _signed(column.values)
        assert not isinstance(values, Ragged)
        return Ragged(column.offsets, values)
    return column.view(np.int64) if column.dtype == np.uint64 else column


_DAY_NS = 24 * 3600 * NS
_RANGES = ("log_time", "received", "timestamp")


@dataclass(frozen=True, slots=True)
class TableFilePath:
    """The path of a file: ``folder/robot=../day=../name`` below the tables."""

    folder: str
    source: RobotStore
    day: str
    name: str

    @property
    def path(self) -> str:
        """The file's path within its table."""
        return f"robot={self.source.robot}/day={self.day}/{self.name}.parquet"


def by_day(flat: FlatTable) -> Iterator[tuple[str, FlatTable]]:
    """Yield rows by day (UTC) of their receive time, as known now."""
    days = flat.received_ns // _DAY_NS
    for number in np.unique(days).tolist():
        rows = np.flatnonzero(days == number)
        day = str(np.datetime64(number, "D"))
        yield day, flat if len(rows) == len(flat) else flat.take(rows)


@dataclass(frozen=True, slots=True)
class JournalOrigin:
    """The journal that the rows of a part come from."""

    journal: str
    head: str
    clock: ClockPoints


@dataclass
class FileBuilder:
    """Writes one file: ``add`` the rows of one journal, then ``end_part``; repeat per journal."""

    tables: Path
    place: TableFilePath
    schema: TableSchema
    parts: list[SegmentPart] = field(default_factory=list)
    _waiting: list[FlatTable] = field(default_factory=list)
    _bounds: list[tuple[int, ...]] = field(default_factory=list)
    _ages: list[IntArray] = field(default_factory=list)
    _rows: int = 0
    _ranges: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        path, store_id = f"{self.place.folder}/{self.place.path}", self.place.source.store_id
        self._file = ArchiveFile(self.tables, path, self.schema, store_id)

    def add(self, flat: FlatTable) -> None:
        """Add rows of the current journal."""
        self._take(flat)
        self._rows += len(flat)
        self._bounds.append(bounds_of(flat))
        if self.schema.stamp:
            self._ages.append(flat.received_ns - flat.timestamp_ns)

    def add_part(self, flat: FlatTable, part: SegmentPart) -> None:
        """Add rows that another file had, with the part that describes them."""
        self._take(flat)
        self.parts.append(part)

    def _take(self, flat: FlatTable) -> None:
        before = self._waiting[-1] if self._waiting else flat
        if (before.writer, before.run) != (flat.writer, flat.run):
            self._write()
        self._waiting.append(flat)
        keys = (flat.log_time_ns, flat.received_ns, flat.timestamp_ns)
        found = [(int(key.min()), int(key.max())) for key in keys]
        known = self._ranges or found
        self._ranges = [
            (min(a[0], b[0]), max(a[1], b[1])) for a, b in zip(known, found, strict=True)
        ]
        if sum(map(len, self._waiting)) >= GROUP_ROWS:
            self._write()

    def end_part(self, origin: JournalOrigin, writer: str, run: int, size: int = 0) -> None:
        """End the part of a journal: the rows since the last call; ``size`` of its messages in
        bytes.
        """
        if not self._rows:
            return
        lows = np.min([bound[0::2] for bound in self._bounds], axis=0).tolist()
        highs = np.max([bound[1::2] for bound in self._bounds], axis=0).tolist()
        self.parts.append(
            SegmentPart(
                origin.journal, origin.head, writer, run, lows[0], highs[0], self._rows, lows[1],
                highs[1], lows[2], highs[2], 1, size, median(self._ages), origin.clock,
            )
        )  # fmt: skip
        self._bounds, self._ages, self._rows = [], [], 0

    def _write(self) -> None:
        if self._waiting:
            self._file.write(join_tables(self._waiting))
            self._waiting = []

    def finish(self) -> LiveFile:
        """Make the file durable and return it; readers see it once it is committed."""
        self._write()
        segment = self._file.finish(self.parts)
        place, writers = self.place, sorted({part.writer for part in self.parts})
        runs = [part.run for part in self.parts]
        low, high = ({n: r[e] for n, r in zip(_RANGES, self._ranges, strict=True)} for e in (0, 1))
        who = {"store_id": place.source.store_id}
        return LiveFile(
            place.path, place.source.robot, place.day, segment.bytes, segment.rows,
            {**low, **who, "writer": writers[0], "run": min(runs)},
            {**high, **who, "writer": writers[-1], "run": max(runs)},
        )  # fmt: skip

    def discard(self) -> None:
        """Remove the temporary file after an error."""
        self._file.discard()


@lru_cache(maxsize=4096)
def segment_at(tables: Path, path: str) -> Segment:
    """Read the description of a file from its footer; files never change.

    Raises FileNotFoundError for one that has been replaced meanwhile.
    """
    import pyarrow.parquet as pq

    metadata = pq.read_metadata(tables / path)
    data = json.loads(metadata.metadata[METADATA])
    schema = TableSchema.from_json(data["schema"])
    parts = tuple(part_from_json(part) for part in data["parts"])
    size = (tables / path).stat().st_size
    return Segment(path, schema.item, schema.id, int(metadata.num_rows), size, "", parts)


def rows_of(
    tables: Path, table: str, file: LiveFile, schema: TableSchema
) -> Iterator[tuple[FlatTable, SegmentPart]]:
    """Yield all rows of a file, part by part."""
    segment = segment_at(tables, f"{table}/{file.path}")
    names = {column.name for column in schema.columns}
    flats = read_segment(tables, segment, schema, names, stored=stored_name)
    yield from zip(flats, segment.parts, strict=True)


def join_files(
    tables: Path,
    table: str,
    schema: TableSchema,
    files: Iterable[LiveFile],
    without: Collection[str] = (),
) -> LiveFile | None:
    """Write files of one store and day as one, leaving out the journals ``without``.

    Returns None when nothing is left. The name depends on the content only, so that a repetition
    after a crash writes the same file.
    """
    chosen = sorted(files, key=lambda file: (file.low["run"], file.low["log_time"], file.path))
    kept = [
        (file, {p.journal for p in segment_at(tables, f"{table}/{file.path}").parts} - {*without})
        for file in chosen
    ]
    if not any(names for _, names in kept):
        return None
    first = chosen[0]
    source = RobotStore(first.robot, first.low["store_id"])
    text = json.dumps([(file.path, sorted(names)) for file, names in kept])
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    builder = FileBuilder(
        tables, TableFilePath(table, source, first.day, f"joined-{digest}"), schema
    )
    try:
        for file, names in kept:
            for flat, part in rows_of(tables, table, file, schema) if names else ():
                if part.journal in names:
                    builder.add_part(flat, part)
        return builder.finish()
    finally:
        builder.discard()


_STATISTICS = "log_time,received,timestamp,store_id,writer,run"


def open_table(folder: Path, schema: TableSchema) -> DeltaTable:
    """Open a Delta table, or create it."""
    from deltalake import DeltaTable, Schema

    if DeltaTable.is_deltatable(str(folder)):
        return DeltaTable(str(folder))
    folder.mkdir(parents=True, exist_ok=True)
    return DeltaTable.create(
        str(folder),
        Schema.from_arrow(arrow_schema(schema)),
        name=schema.item,
        description=json.dumps(schema.to_json()),
        partition_by=list(PARTITIONS),
        configuration={
            "delta.dataSkippingStatsColumns": _STATISTICS,
            "delta.checkpointInterval": "20",
            "delta.logRetentionDuration": "interval 1 days",
        },
    )


def change_table(
    folder: Path,
    schema: TableSchema,
    add: Sequence[LiveFile],
    remove: Sequence[LiveFile] = (),
    *,
    batch: int | None = None,
    same_rows: bool = False,
    about: str,
) -> None:
    """Add and remove files in one commit.

    ``batch`` is the batch whose rows are in the table from now on; ``same_rows`` marks a commit
    that only joins files.
    """
    from deltalake import CommitProperties
    from deltalake.transaction import RemoveAction, Transaction

    table = open_table(folder, schema)
    actions: list[AddAction | RemoveAction] = [_add(file, not same_rows) for file in add]
    now_ms = time.time_ns() // 1_000_000
    actions += [
        RemoveAction(file.path, not same_rows, now_ms, file.bytes, _partition(file))
        for file in remove
    ]
    marks = [] if batch is None else [Transaction(APP, batch)]
    table.create_write_transaction(
        actions,
        "append",
        table.schema(),
        list(PARTITIONS),
        commit_properties=CommitProperties({"amberbox": about}, app_transactions=marks),
    )


def _add(file: LiveFile, changes: bool) -> AddAction:
    from deltalake.transaction import AddAction

    stats = {"numRecords": file.rows, "minValues": file.low, "maxValues": file.high}
    now_ms = time.time_ns() // 1_000_000
    text = json.dumps({**stats, "nullCount": {}})
    return AddAction(file.path, file.bytes, _partition(file), now_ms, changes, text)


def _partition(file: LiveFile) -> dict[str, str | None]:
    return {"robot": file.robot, "day": file.day}
