"""The archive: ten minutes of one variable out of a month, a month at a glance, rows committed."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.store.store import create_store
from amberbox.core.clock import NS
from amberbox.core.types import Column, Schema, Topic
from amberbox.server.archive.catalogue import RobotStore
from amberbox.server.archive.delta_files import (
    FileBuilder,
    JournalOrigin,
    LiveFile,
    TableFilePath,
    table_of,
    tables_of,
)
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.rollups import RollupBuilder
from amberbox.server.archive.worker import ArchiveWorker
from amberbox.server.journals import JournalFacts, JournalKey, encode
from benchmarks.common import Row, percentile, wall_s
from benchmarks.query import definition, fifty_columns

START_NS = 1_790_035_200 * NS
"""A day's first second (UTC)."""

DAYS = 30
RATE_HZ = 10
FILE_S = 600
_FILES_A_DAY = 24 * 3600 // FILE_S
_ROWS = FILE_S * RATE_HZ
_SOURCE = RobotStore("r1", "00000000-0000-4000-8000-000000000001")
_COLUMNS = tuple(Column(name, name, "float64") for name in ("x", "y", "volts", "amps"))
_SCHEMA = TableSchema("drive", "bench/Drive", _COLUMNS, topic="/drive", source="bench")


def measure() -> list[Row]:
    """Measure a month of one robot, then how fast journals become rows."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        archive = FolderArchive(Path(folder))
        make_month(archive)
        rows += _questions(archive)
    with tempfile.TemporaryDirectory() as folder:
        rows += _commits(Path(folder))
    return rows


def make_month(archive: FolderArchive) -> None:
    """Write a month of one item as the worker leaves it: a file a day, its levels above it."""
    from amberbox.server.archive import delta_files

    random = np.random.default_rng(1)
    walks = np.cumsum(random.normal(0, 0.01, (4, _FILES_A_DAY * _ROWS)), axis=1).round(3)
    archive.catalogue.register(_SCHEMA, _SOURCE)
    for day in range(DAYS):
        builders: dict[str, FileBuilder] = {}
        for number in range(_FILES_A_DAY):
            _add_journal(archive, builders, walks, day, number)
        for table, builder in builders.items():
            files: list[LiveFile] = [builder.finish()]
            folder = archive.layout.tables / table
            delta_files.change_table(folder, builder.schema, files, batch=day + 1, about="bench")
    archive.catalogue.plan(archive.catalogue.waiting(), 0)
    batch = archive.catalogue.open_batch()
    assert batch is not None
    archive.catalogue.finish(batch, {})


def _add_journal(
    archive: FolderArchive, builders: dict[str, FileBuilder], walks: Any, day: int, number: int
) -> None:
    file = day * _FILES_A_DAY + number
    seq = file * _ROWS + np.arange(_ROWS)
    times = START_NS + seq * (NS // RATE_HZ)
    part = walks[:, number * _ROWS : (number + 1) * _ROWS]
    columns = {column.name: line for column, line in zip(_COLUMNS, part, strict=True)}
    flat = FlatTable(_SCHEMA, "main", 1, seq, times, times, times, columns)
    climb = RollupBuilder(_SCHEMA)
    climb.add(flat)
    name = f"journal/000001-bench000-{file:04}.mcap"
    origin = JournalOrigin(name, "", ((int(times[0]), 0),))
    for level, rows in (("", flat), *climb.levels()):
        table = table_of(_SCHEMA, level)
        if table not in builders:
            date = str(np.datetime64(int(times[0]) // NS, "s"))[:10]
            place = TableFilePath(table, _SOURCE, date, f"{day:08}")
            builders[table] = FileBuilder(archive.layout.tables, place, rows.schema)
        builders[table].add(rows)
        builders[table].end_part(origin, "main", 1)
    archive.catalogue.add(_journal_row(name, flat))


def _journal_row(name: str, flat: FlatTable) -> dict[str, Any]:
    first_ns, last_ns = int(flat.log_time_ns[0]), int(flat.log_time_ns[-1])
    facts = JournalFacts(
        [(first_ns, 0, True, first_ns - START_NS), (last_ns, 0, True, last_ns - START_NS)]
    )
    return {
        "robot": _SOURCE.robot, "store_id": _SOURCE.store_id, "file": name, "sha256": "",
        "bytes": 0, "keeping": "main", "writer": "main", "run": 1,
        "first_seq": int(flat.seq[0]), "end_seq": int(flat.seq[-1]) + 1, "start_ns": first_ns,
        "end_ns": last_ns, "facts": encode(facts), "put_ns": 0, "batch": None, "state": "put",
        "rows": len(flat), "raw_gone": False, "columns_gone": False, "own_gone": False,
    }  # fmt: skip


def _questions(archive: FolderArchive) -> Iterator[Row]:
    record = archive.robot("r1")
    span_ns = 600 * NS
    starts = START_NS + np.random.default_rng(2).integers(0, DAYS * 86_400 - 600, 40) * NS

    def ask(start_ns: int) -> float:
        began = time.perf_counter()
        assert len(record.query("drive", ["volts"], start_ns, start_ns + span_ns)) == _ROWS
        return 1e3 * (time.perf_counter() - began)

    name = f"10 minutes of one variable out of {DAYS} days at {RATE_HZ} Hz"
    yield Row(f"{name}, first of a process", ask(int(starts[0])), "ms", note="the catalogue too")
    taken = [ask(int(start)) for start in starts]
    yield Row(f"{name}, p95", percentile(taken, 95), "ms", note="to be < 100")
    month = START_NS, START_NS + DAYS * 86_400 * NS
    glance = wall_s(lambda: record.envelope("drive", ["volts"], *month, points=700), 3)
    yield Row(f"{DAYS} days of one variable, least and greatest of each hour", 1e3 * glance, "ms")
    size = _table_bytes(archive) / (DAYS * 86_400 * RATE_HZ)
    yield Row("row of 4 variables, its place and its share of the pyramid", size, "B")


def _table_bytes(archive: FolderArchive) -> int:
    """Return the size of the live files of all tables."""
    names = [name for schema in archive.catalogue.schemas() for name, _ in tables_of(schema)]
    return sum(f.bytes for n in names for f in archive.layout.snapshot(n).files.values())


def _commits(folder: Path) -> Iterator[Row]:
    """Commit three journals of ten minutes each, 50 columns at 100 Hz."""
    archive = FolderArchive(folder / "server")
    files = 3
    for path, key in _journals(folder / "store", files):
        copy = folder / "upload"
        shutil.copyfile(path, copy)
        archive.put(key, copy)
    with closing(ArchiveWorker(folder / "server")) as worker:
        worker.sweep()  # it is up
        began = time.perf_counter()
        done = worker.commit(0.0)
        took_s = time.perf_counter() - began
    assert done.journals == files
    note = "unrolled, written, summed up in 3 levels, synced, committed; one process"
    yield Row("rows of 50 columns committed", done.rows / took_s, "rows/s", note=note)


def _journals(store: Path, files: int) -> Iterator[tuple[Path, JournalKey]]:
    made, messages = create_store(store), fifty_columns()
    writer = JournalWriter(JournalOptions(made.folder("main"), made.id, "main", 1, "bench000"))
    topic = Topic("/fifty", "ros1", Schema("bench/Fifty", "ros1msg", definition(messages).encode()))
    channel = writer.channel(topic, {"item": "fifty", "source": "bench"})
    size, raw = messages.dtype.itemsize, messages.tobytes()
    rows = [raw[at : at + size] for at in range(0, len(raw), size)]
    for number in range(files):
        times = START_NS + (number * len(rows) + np.arange(len(rows))) * (NS // 100)
        for start in range(0, len(rows), 1000):
            part = slice(start, start + 1000)
            writer.write(np.full(1000, channel), times[part], times[part], rows[part])
        writer.rotate()
    writer.close()
    for path in sorted(made.folder("main").glob("*.mcap")):
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        yield path, JournalKey("r1", made.id, f"journal/{path.name}", digest)
