"""Where everything of an archive lies below the server's data folder."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.segments.flat import TableSchema
from amberbox.core.errors import AmberboxError
from amberbox.core.files import below
from amberbox.core.names import is_item
from amberbox.fleet.archive.log import Snapshot, snapshot
from amberbox.fleet.archive.pyramid import LEVELS, has_levels, level_schema
from amberbox.fleet.archive.where import JOURNALS, TABLES

_VERSION = re.compile(rf"[0-9a-f]{{16}}(\.({'|'.join(LEVELS)}))?")


@dataclass(frozen=True, slots=True)
class Layout:
    """The folders of an archive: nothing else makes a path of a name that robots give."""

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
        """Return where a journal lies; raises AmberboxError for names that lead elsewhere."""
        return below(self.journals, robot, store_id, file)

    def table(self, table: str) -> Path:
        """Return the folder of a table; raises AmberboxError for what names none."""
        item, _, version = table.partition("/")
        if not is_item(item) or not _VERSION.fullmatch(version):
            raise AmberboxError(
                f"{table[:100]!r} is no name of a table",
                "a journal has an item of this name: it is left out of the tables",
            )
        return below(self.tables, item, version)

    def snapshot(self, table: str) -> Snapshot:
        """Read which files of a table are live."""
        return snapshot(self.table(table))


def table_of(schema: TableSchema, level: str = "") -> str:
    """Name the folder of a table: one per item and version of its schema, and per level."""
    return f"{schema.item}/{schema.id}" + (f".{level}" if level else "")


def tables_of(schema: TableSchema) -> list[tuple[str, TableSchema]]:
    """Return the tables that a schema has: its rows, and the levels above them."""
    levels = LEVELS if has_levels(schema) else ()
    raised = [(table_of(schema, level), level_schema(schema, level)) for level in levels]
    return [(table_of(schema), schema), *raised]
