"""Parquet files: one per table, all types kept, units and paths in the metadata."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amberbox.blackbox.exporting.job import Job
from amberbox.blackbox.exporting.tablefiles import write_tables
from amberbox.blackbox.exporting.tables import Block, TableStream
from amberbox.blackbox.segments.flat import TableSchema
from amberbox.core.errors import UsageError
from amberbox.core.types import Column

if TYPE_CHECKING:
    import pyarrow as pa

METADATA = "amberbox.table"
"""Key of the file's metadata that says, as JSON, what table this is."""


@dataclass(frozen=True)
class _ParquetFile:
    writer: Any
    schema: pa.Schema

    def write(self, block: Block) -> None:
        table = block.table.to_arrow().cast(self.schema)
        self.writer.write_table(table, row_group_size=len(block.table))


def write_parquet(job: Job) -> None:
    """Write Parquet files; raises UsageError where pyarrow is not installed."""
    try:
        import pyarrow.parquet  # noqa: F401  # only asked whether it is there
    except ImportError:
        raise UsageError("Parquet needs pyarrow", "pip install amberbox[query]") from None
    write_tables(job, ".parquet", _opened)


@contextmanager
def _opened(stream: TableStream, path: Path) -> Iterator[_ParquetFile]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    empty = stream.empty
    plain = empty.to_arrow().schema
    described = [
        field.with_metadata(_column_metadata(column))
        for field, column in zip(plain, empty.fields, strict=True)
    ]
    schema = pa.schema(described, metadata={METADATA: json.dumps(_table_metadata(stream.schema))})
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        yield _ParquetFile(writer, schema)


def _column_metadata(column: Column) -> dict[str, str]:
    known = {"path": column.path, "type": column.type, "unit": column.unit}
    if column.labels:
        known["labels"] = json.dumps({str(number): text for number, text in column.labels.items()})
    return {key: value for key, value in known.items() if value}


def _table_metadata(schema: TableSchema) -> dict[str, str]:
    names = ("item", "type", "topic", "source", "stamp", "parent")
    return {name: getattr(schema, name) for name in names}
