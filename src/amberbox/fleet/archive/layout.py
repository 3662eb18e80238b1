"""How columns lie in the archive: a file of a Delta table, which any Delta reader reads.

A file is a segment (``blackbox/segments``) with columns of ours: who recorded each row. Delta has
no unsigned numbers and no nanoseconds: these are stored as signed numbers that hold them.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amberbox.blackbox.segments import columns as col
from amberbox.blackbox.segments.columns_io import arrow_type
from amberbox.blackbox.segments.flat import Flat, TableSchema
from amberbox.blackbox.segments.parquet import TableFile, key_names
from amberbox.core.types import ColumnData, Ragged

if TYPE_CHECKING:
    import pyarrow as pa

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
    """Name a variable's column in a file: one that is called like ours steps aside."""
    return f"{name}:" if name.casefold() in _TAKEN else name


def stored_type(column_type: str) -> str:
    """Return the type that holds a column where there are no unsigned numbers and no times.

    ``uint64`` becomes ``int64`` with the same bits.
    """
    inner = col.element_type(column_type)
    if inner is not None:
        return f"list<{stored_type(inner)}>"
    return _SIGNED.get(column_type, column_type)


def arrow_schema(schema: TableSchema) -> pa.Schema:
    """Return the columns of a table as Delta has them, partitions first."""
    import pyarrow as pa

    keys = [(name, pa.int64()) for name in key_names(schema)]
    ours = [("received", pa.int64()), ("store_id", pa.string()), ("writer", pa.string())]
    own = [(stored_name(c.name), arrow_type(stored_type(c.type))) for c in schema.columns]
    partitions = [("robot", pa.string()), ("day", pa.date32())]
    return pa.schema([*partitions, *keys, *ours, ("run", pa.int64()), *own])


class ArchiveFile(TableFile):
    """Writes one file of a table: rows of one robot's store."""

    def __init__(self, tables: Path, path: str, schema: TableSchema, store_id: str) -> None:
        super().__init__(tables, path, schema)
        self.store_id = store_id

    def layout(self, flat: Flat) -> tuple[list[str], list[str], list[Any]]:
        """Return names, types and contents of the columns of the file, the keys first."""
        count, own = len(flat), self.schema.columns
        names = [*key_names(self.schema), *OURS, *(stored_name(c.name) for c in own)]
        kinds = ["int64"] * 4 + ["string", "string", "int64", *(stored_type(c.type) for c in own)]
        keys: list[ColumnData] = [flat.seq, flat.log_time_ns, flat.timestamp_ns, flat.received_ns]
        who = [np.full(count, self.store_id, object), np.full(count, flat.writer, object)]
        values = [_signed(flat.columns[c.name]) for c in own]
        return names, kinds, [*keys, *who, np.full(count, flat.run, np.int64), *values]


def _signed(column: ColumnData) -> ColumnData:
    """Keep the bits of 64-bit numbers; smaller ones fit as they are."""
    if isinstance(column, Ragged):
        values = _signed(column.values)
        assert not isinstance(values, Ragged)
        return Ragged(column.offsets, values)
    return column.view(np.int64) if column.dtype == np.uint64 else column
