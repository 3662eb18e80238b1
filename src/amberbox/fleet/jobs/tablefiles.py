"""CSV and Parquet files of a piece: one per item, read and written stretch by stretch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.query.table import Table
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.fleet.data.asked import Asked
from amberbox.fleet.data.forms import arrow_table
from amberbox.fleet.data.look import Look, look
from amberbox.fleet.data.rows import Answer, rows
from amberbox.fleet.jobs.plan import Piece, safe
from amberbox.fleet.jobs.workshop import Workshop

_STEP_ROWS = 200_000
_STEP_BYTES = 16 << 20
"""Of a stretch, as it lies compressed on the disk."""


class _Writer(Protocol):
    def write(self, table: Table) -> None: ...


@dataclass(frozen=True, slots=True)
class _Task:
    """One table of a piece, and how many of its rows to read at a time."""

    table: str
    names: list[str] | None
    step: int


def write_tables(workshop: Workshop, piece: Piece) -> Iterator[float]:
    """Write the tables of a piece; gives how much of it is done."""
    tasks = look(workshop.server, piece.robot, lambda seen: _tasks(seen, workshop, piece))
    for number, task in enumerate(tasks):
        ending = f".{workshop.wanted.format}"
        path = workshop.place(piece.folder, f"{safe(task.table)}{ending}")
        for share in _write(workshop, piece, task, path):
            yield (number + share) / len(tasks)
        if path.exists():
            workshop.add(path)


def _tasks(seen: Look, workshop: Workshop, piece: Piece) -> list[_Task]:
    wanted = workshop.wanted
    tables: dict[str, list[str] | None] = {}
    for name in [*dict.fromkeys([*wanted.items, *wanted.variables])]:
        try:
            schema = seen.schema(name)
        except UsageError as error:
            workshop.note(f"{piece.robot}: {error.what}")
            continue
        named = wanted.variables.get(name)
        tables[schema.item] = named
        if named is None:
            tables |= dict.fromkeys(_children(seen, schema.item))
    if not wanted.items and not wanted.variables:
        tables = {t: None for t, v in seen.schemas.items() if v[-1].source != reserved.SOURCE}
    return [_Task(table, names, _step(seen, table)) for table, names in sorted(tables.items())]


def _children(seen: Look, table: str) -> list[str]:
    return [name for name, versions in seen.schemas.items() if versions[-1].parent == table]


def _step(seen: Look, table: str) -> int:
    """Choose how many rows to read at a time: few of images, many of numbers."""
    files = [
        file
        for source in seen.reader.sources
        for version in seen.reader.schemas.get(table, ())
        for file in seen.reader.files(source, version, None)
    ]
    size = sum(file.bytes for file in files) / max(sum(file.rows for file in files), 1)
    return int(min(max(_STEP_BYTES / max(size, 1), 1), _STEP_ROWS))


def _write(workshop: Workshop, piece: Piece, task: _Task, path: Path) -> Iterator[float]:
    asked = Asked(piece.robot, task.table, task.names, piece.from_ns, piece.to_ns, limit=task.step)
    answer = _read(workshop, asked)
    if not len(answer.table) and answer.about.next_ns is None:
        return
    names = [name for name in answer.table.names if name != "timestamp"]
    with _OPEN[workshop.wanted.format](path, answer.table) as writer:
        while True:
            writer.write(answer.table)
            workshop.note(*(f"{piece.robot}: {note}" for note in answer.about.notes))
            workshop.check([path])
            if answer.about.next_ns is None:
                return
            yield _share(piece, answer.about.next_ns)
            asked = Asked(
                piece.robot, task.table, names, answer.about.next_ns, piece.to_ns, limit=task.step
            )
            answer = _read(workshop, asked)


def _read(workshop: Workshop, asked: Asked) -> Answer:
    return look(workshop.server, asked.robot, lambda seen: rows(seen, asked))


def _share(piece: Piece, reached_ns: int) -> float:
    """Guess how much is done from how far the time is; half where no range was named."""
    if piece.from_ns is None or piece.to_ns is None:
        return 0.5
    return min(max((reached_ns - piece.from_ns) / max(piece.to_ns - piece.from_ns, 1), 0.0), 1.0)


@dataclass(frozen=True)
class _Csv:
    file: Any

    def write(self, table: Table) -> None:
        table.to_csv(self.file, header=False)


@contextmanager
def _open_csv(path: Path, like: Table) -> Iterator[_Writer]:
    with path.open("w", encoding="utf-8", newline="") as file:
        like.take(slice(0)).to_csv(file)
        yield _Csv(file)


@dataclass(frozen=True)
class _Parquet:
    writer: Any
    schema: Any

    def write(self, table: Table) -> None:
        import pyarrow as pa

        try:
            self.writer.write_table(arrow_table(table).cast(self.schema))
        except (pa.ArrowInvalid, ValueError) as error:
            what = f"the columns of {table.item} changed while they were being read"
            raise AmberboxError(what, "ask again") from error


@contextmanager
def _open_parquet(path: Path, like: Table) -> Iterator[_Writer]:
    import pyarrow.parquet as pq

    schema = arrow_table(like.take(slice(0))).schema
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        yield _Parquet(writer, schema)


class _Opener(Protocol):
    def __call__(self, path: Path, like: Table) -> AbstractContextManager[_Writer]: ...


_OPEN: dict[str, _Opener] = {"csv": _open_csv, "parquet": _open_parquet}

FORMATS: Sequence[str] = tuple(_OPEN)
"""The formats that are made here."""
