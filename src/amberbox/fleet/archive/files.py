"""Where everything of an archive lies below the server's data folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.segments.flat import TableSchema
from amberbox.fleet.archive.log import Snapshot, snapshot
from amberbox.fleet.archive.pyramid import LEVELS, has_levels, level_schema
from amberbox.fleet.archive.where import JOURNALS, TABLES


@dataclass(frozen=True, slots=True)
class Layout:
    """The folders of an archive."""

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
        """Return where a journal lies."""
        return self.journals / robot / store_id / file

    def snapshot(self, table: str) -> Snapshot:
        """Read which files of a table are live."""
        return snapshot(self.tables / table)


def table_of(schema: TableSchema, level: str = "") -> str:
    """Name the folder of a table: one per item and version of its schema, and per level."""
    return f"{schema.item}/{schema.id}" + (f".{level}" if level else "")


def tables_of(schema: TableSchema) -> list[tuple[str, TableSchema]]:
    """Return the tables that a schema has: its rows, and the levels above them."""
    levels = LEVELS if has_levels(schema) else ()
    raised = [(table_of(schema, level), level_schema(schema, level)) for level in levels]
    return [(table_of(schema), schema), *raised]
