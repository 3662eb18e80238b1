"""The archive's catalogue in the database: journals, schemas, batches, and missing rows."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sqlalchemy import Connection, Exists, Row, and_, exists, func, select, update

from amberbox.blackbox.columns.flat_tables import TableSchema
from amberbox.core.names import is_item
from amberbox.server.database import ServerDatabase, upsert_rows
from amberbox.server.journals import JournalKey, MissingRows
from amberbox.server.schema import BATCHES, JOURNALS, MISSING, SCHEMAS, SOURCES, UPLOAD

_KEY = (JOURNALS.c.robot, JOURNALS.c.store_id, JOURNALS.c.file)
PUT, COMMITTED, REFUSED = "put", "committed", "refused"


@dataclass(frozen=True, slots=True)
class RobotStore:
    """One store of one robot; a replaced SD card is another store."""

    robot: str
    store_id: str


@dataclass(frozen=True, slots=True)
class CommitBatch:
    """Journals that are committed together, in the order in which their rows are written."""

    number: int
    journals: Sequence[Row[Any]]


class ArchiveCatalogue:
    """Database access to the rows about journals, batches, tables and missing rows."""

    def __init__(self, database: ServerDatabase) -> None:
        self.database = database

    def find(self, key: JournalKey) -> Row[Any] | None:
        """Return the row of a journal, by robot, store and file; None if unknown."""
        return next(iter(self.database.rows(select(JOURNALS).where(_is(key)))), None)

    def add(self, row: Mapping[str, Any]) -> bool:
        """Add a journal; return False when it is in the catalogue already."""
        with self.database.begin() as connection:
            return upsert_rows(connection, JOURNALS, [row]) > 0

    def open_batch(self) -> CommitBatch | None:
        """Return the batch that was begun and not finished, or None."""
        with self.database.reading() as connection:
            number = connection.scalar(select(BATCHES.c.number).where(BATCHES.c.done.is_(False)))
            if number is None:
                return None
            rows = connection.execute(
                select(JOURNALS).where(JOURNALS.c.batch == number).order_by(*_ORDER)
            ).all()
            return CommitBatch(number, rows)

    def waiting(self) -> list[Row[Any]]:
        """Return the journals whose rows are in no table, in the order in which they arrived."""
        statement = select(JOURNALS).where(
            JOURNALS.c.state == PUT, JOURNALS.c.batch.is_(None), JOURNALS.c.raw_gone.is_(False)
        )
        return list(self.database.rows(statement.order_by(JOURNALS.c.put_ns, *_KEY)))

    def last_batch_ns(self) -> int | None:
        """Return when the newest batch was planned (ns), or None."""
        found = self.database.scalar(select(func.max(BATCHES.c.planned_ns)))
        return None if found is None else int(found)

    def plan(self, journals: Sequence[Row[Any]], now_ns: int) -> None:
        """Begin a batch: from now on it consists of these journals, even after a crash."""
        with self.database.begin() as connection:
            number = 1 + (connection.scalar(select(func.max(BATCHES.c.number))) or 0)
            connection.execute(
                BATCHES.insert().values(number=number, planned_ns=now_ns, done=False)
            )
            for row in journals:
                connection.execute(update(JOURNALS).where(_is(row)).values(batch=number))

    def register(self, schema: TableSchema, source: RobotStore) -> None:
        """Store a table's schema, and that a store has rows in it."""
        with self.database.begin() as connection:
            count = connection.scalar(
                select(func.count()).select_from(SCHEMAS).where(SCHEMAS.c.item == schema.item)
            )
            row = {
                "item": schema.item, "schema_id": schema.id, "number": count,
                "definition": json.dumps(schema.to_json()),
            }  # fmt: skip
            upsert_rows(connection, SCHEMAS, [row])
            held = {**asdict(source), "item": schema.item, "schema_id": schema.id}
            upsert_rows(connection, SOURCES, [held])

    def finish(self, batch: CommitBatch, facts: Mapping[str, str]) -> None:
        """Mark a batch as committed; ``facts`` are new facts of journals, by name."""
        with self.database.begin() as connection:
            done = update(JOURNALS).where(JOURNALS.c.batch == batch.number)
            connection.execute(done.values(state=COMMITTED))
            for row in batch.journals:
                if name_of(row) in facts:
                    known = update(JOURNALS).where(_is(row))
                    connection.execute(known.values(facts=facts[name_of(row)]))
            ended = update(BATCHES).where(BATCHES.c.number == batch.number)
            connection.execute(ended.values(done=True))

    def change(self, rows: Iterable[Row[Any]], **values: object) -> None:
        """Change columns of journals."""
        with self.database.begin() as connection:
            self.change_in(connection, rows, **values)

    def change_in(self, connection: Connection, rows: Iterable[Row[Any]], **values: object) -> None:
        """Change columns of journals within a transaction."""
        for row in rows:
            connection.execute(update(JOURNALS).where(_is(row)).values(**values))

    def cancel(self, connection: Connection, batch: CommitBatch) -> None:
        """End a batch without rows in any table; its journals wait again."""
        of_batch = update(JOURNALS).where(JOURNALS.c.batch == batch.number)
        connection.execute(of_batch.values(batch=None))
        ended = update(BATCHES).where(BATCHES.c.number == batch.number)
        connection.execute(ended.values(done=True))

    def note_missing(self, source: RobotStore, ranges: Sequence[MissingRows]) -> None:
        """Store ranges of rows that will never arrive; known ones are not changed."""
        if ranges:
            with self.database.begin() as connection:
                rows = [asdict(source) | asdict(one) for one in ranges]
                upsert_rows(connection, MISSING, rows)

    def missing(self, source: RobotStore) -> list[MissingRows]:
        """Return the ranges of rows of a store that will never arrive."""
        return [
            MissingRows(r.writer, r.run, r.from_seq, r.to_seq, r.from_ns, r.to_ns, r.kind, r.reason)
            for r in self.database.rows(select(MISSING).where(*_of(MISSING, source)))
        ]

    def sources(self, robots: Sequence[str] = ()) -> list[RobotStore]:
        """Return the stores of robots; of all robots without a name."""
        statement = select(JOURNALS.c.robot, JOURNALS.c.store_id).distinct()
        if robots:
            statement = statement.where(JOURNALS.c.robot.in_(robots))
        return [
            RobotStore(row.robot, row.store_id)
            for row in self.database.rows(statement.order_by(*_KEY[:2]))
        ]

    def last_ns(self, robots: Sequence[str] = ()) -> int | None:
        """Return the latest receive time (ns) in the tables, or None."""
        statement = select(func.max(JOURNALS.c.end_ns)).where(JOURNALS.c.state == COMMITTED)
        if robots:
            statement = statement.where(JOURNALS.c.robot.in_(robots))
        found = self.database.scalar(statement)
        return None if found is None else int(found)

    def journals(self, source: RobotStore | None = None) -> list[Row[Any]]:
        """Return the journals of a store in the order of writing, or all journals."""
        statement = select(JOURNALS).order_by(*_ORDER)
        if source is not None:
            statement = statement.where(*_of(JOURNALS, source))
        return list(self.database.rows(statement))

    def revision(self) -> int:
        """Return the number of the last finished batch; caches of readers are valid for one
        revision.
        """
        return self.database.scalar(select(func.max(BATCHES.c.number)).where(BATCHES.c.done)) or 0

    def schemas(self) -> list[TableSchema]:
        """Return the schemas of all tables, oldest version of an item first.

        Tables whose item name is invalid, as older servers accepted them, are left out.
        """
        rows = self.database.rows(select(SCHEMAS).order_by(SCHEMAS.c.item, SCHEMAS.c.number))
        return [
            TableSchema.from_json(json.loads(row.definition)) for row in rows if is_item(row.item)
        ]

    def held(self, source: RobotStore) -> set[str]:
        """Return the ids of the schemas of which a store has rows."""
        statement = select(SOURCES.c.schema_id).where(*_of(SOURCES, source))
        return {row.schema_id for row in self.database.rows(statement)}


_ORDER = (
    JOURNALS.c.robot, JOURNALS.c.store_id, JOURNALS.c.writer, JOURNALS.c.run, JOURNALS.c.first_seq,
    JOURNALS.c.file,
)  # fmt: skip


def name_of(row: Row[Any]) -> str:
    """Return the name of a journal within the archive: ``robot/store_id/file``."""
    return f"{row.robot}/{row.store_id}/{row.file}"


def in_archive() -> Exists:
    """Return the SQL condition that the archive has a journal with the name of an upload."""
    j, u = JOURNALS.c, UPLOAD.c
    return exists().where(j.robot == u.robot, j.store_id == u.store_id, j.file == u.journal)


def _is(row: Any) -> Any:
    values = (row.robot, row.store_id, row.file)
    return and_(*(column == value for column, value in zip(_KEY, values, strict=True)))


def _of(table: Any, source: RobotStore) -> tuple[Any, Any]:
    return table.c.robot == source.robot, table.c.store_id == source.store_id
