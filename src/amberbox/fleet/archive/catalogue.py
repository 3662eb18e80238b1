"""What the archive knows of its journals, in the server's database."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sqlalchemy import Connection, Row, and_, func, select, update

from amberbox.blackbox.segments.flat import TableSchema
from amberbox.core.names import is_item
from amberbox.fleet.archive.store import JournalKey, Missing
from amberbox.fleet.archive.tables import BATCHES, JOURNALS, MISSING, SCHEMAS, SOURCES
from amberbox.fleet.database.database import Database
from amberbox.fleet.database.upsert import upsert

_KEY = (JOURNALS.c.robot, JOURNALS.c.store_id, JOURNALS.c.file)
PUT, COMMITTED, REFUSED = "put", "committed", "refused"


@dataclass(frozen=True, slots=True)
class Source:
    """One store of one robot: an SD card that was replaced is another."""

    robot: str
    store_id: str


@dataclass(frozen=True, slots=True)
class Batch:
    """Journals that are committed together, in the order in which their rows are written."""

    number: int
    journals: Sequence[Row[Any]]


class Catalogue:
    """Rows about journals, batches, tables and what is missing."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def find(self, key: JournalKey) -> Row[Any] | None:
        """Return the row of a journal, whatever its content is said to be."""
        with self.database.reading() as connection:
            return _find(connection, key)

    def add(self, row: Mapping[str, Any]) -> bool:
        """Enter a journal; False when it is there already."""
        with self.database.begin() as connection:
            statement = upsert(connection.dialect, JOURNALS, ("robot", "store_id", "file"), ())
            return connection.execute(statement, dict(row)).rowcount > 0

    def open_batch(self) -> Batch | None:
        """Return the batch that was begun and not finished."""
        with self.database.reading() as connection:
            number = connection.scalar(select(BATCHES.c.number).where(BATCHES.c.done.is_(False)))
            if number is None:
                return None
            rows = connection.execute(
                select(JOURNALS).where(JOURNALS.c.batch == number).order_by(*_ORDER)
            ).all()
            return Batch(number, rows)

    def waiting(self) -> list[Row[Any]]:
        """Return the journals whose rows are in no table, in the order in which they came."""
        with self.database.reading() as connection:
            statement = select(JOURNALS).where(
                JOURNALS.c.state == PUT, JOURNALS.c.batch.is_(None), JOURNALS.c.raw_gone.is_(False)
            )
            return list(connection.execute(statement.order_by(JOURNALS.c.put_ns, *_KEY)))

    def last_batch_ns(self) -> int | None:
        """Return when the newest batch was planned."""
        with self.database.reading() as connection:
            found = connection.scalar(select(func.max(BATCHES.c.planned_ns)))
            return None if found is None else int(found)

    def plan(self, journals: Sequence[Row[Any]], now_ns: int) -> None:
        """Begin a batch: from here on it is this set of journals, also after a crash."""
        with self.database.begin() as connection:
            number = 1 + (connection.scalar(select(func.max(BATCHES.c.number))) or 0)
            connection.execute(
                BATCHES.insert().values(number=number, planned_ns=now_ns, done=False)
            )
            for row in journals:
                connection.execute(update(JOURNALS).where(_is(row)).values(batch=number))

    def register(self, schema: TableSchema, source: Source) -> None:
        """Remember a table's columns, and that a store has rows in it."""
        with self.database.begin() as connection:
            count = connection.scalar(
                select(func.count()).select_from(SCHEMAS).where(SCHEMAS.c.item == schema.item)
            )
            row = {
                "item": schema.item, "schema_id": schema.id, "number": count,
                "definition": json.dumps(schema.to_json()),
            }  # fmt: skip
            keys = ("item", "schema_id")
            connection.execute(upsert(connection.dialect, SCHEMAS, keys, ()), row)
            held = {**asdict(source), "item": schema.item, "schema_id": schema.id}
            connection.execute(upsert(connection.dialect, SOURCES, tuple(held), ()), held)

    def finish(self, batch: Batch, facts: Mapping[str, str]) -> None:
        """End a batch; ``facts`` are those of journals of which more has become known."""
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

    def cancel(self, connection: Connection, batch: Batch) -> None:
        """End a batch of which no row is in any table: its journals wait again."""
        of_batch = update(JOURNALS).where(JOURNALS.c.batch == batch.number)
        connection.execute(of_batch.values(batch=None))
        ended = update(BATCHES).where(BATCHES.c.number == batch.number)
        connection.execute(ended.values(done=True))

    def note_missing(self, source: Source, ranges: Sequence[Missing]) -> None:
        """Remember what will not come; what is known already stays as it is."""
        if not ranges:
            return
        keys = ("robot", "store_id", "writer", "run", "from_seq", "to_seq", "kind")
        with self.database.begin() as connection:
            statement = upsert(connection.dialect, MISSING, keys, ())
            connection.execute(statement, [asdict(source) | asdict(one) for one in ranges])

    def missing(self, source: Source) -> list[Missing]:
        """Return what will not come of a store."""
        with self.database.reading() as connection:
            rows = connection.execute(select(MISSING).where(*_of(MISSING, source)))
            return [
                Missing(r.writer, r.run, r.from_seq, r.to_seq, r.from_ns, r.to_ns, r.kind, r.reason)
                for r in rows
            ]

    def sources(self, robots: Sequence[str] = ()) -> list[Source]:
        """Return the stores of robots, of all without a name."""
        with self.database.reading() as connection:
            statement = select(JOURNALS.c.robot, JOURNALS.c.store_id).distinct()
            if robots:
                statement = statement.where(JOURNALS.c.robot.in_(robots))
            return [Source(*row) for row in connection.execute(statement.order_by(*_KEY[:2]))]

    def last_ns(self, robots: Sequence[str] = ()) -> int | None:
        """Return when the newest record was received that is in the tables."""
        with self.database.reading() as connection:
            statement = select(func.max(JOURNALS.c.end_ns)).where(JOURNALS.c.state == COMMITTED)
            if robots:
                statement = statement.where(JOURNALS.c.robot.in_(robots))
            found = connection.scalar(statement)
            return None if found is None else int(found)

    def journals(self, source: Source | None = None) -> list[Row[Any]]:
        """Return the journals of a store in the order of writing, or all."""
        with self.database.reading() as connection:
            statement = select(JOURNALS).order_by(*_ORDER)
            if source is not None:
                statement = statement.where(*_of(JOURNALS, source))
            return list(connection.execute(statement))

    def revision(self) -> int:
        """Return the last batch that is done: what readers may remember changes with it."""
        with self.database.reading() as connection:
            done = select(func.max(BATCHES.c.number)).where(BATCHES.c.done)
            return connection.scalar(done) or 0

    def schemas(self) -> list[TableSchema]:
        """Return what the columns of all tables are, oldest version of an item first.

        Tables that an older server made of names that lead elsewhere are none.
        """
        with self.database.reading() as connection:
            rows = connection.execute(select(SCHEMAS).order_by(SCHEMAS.c.item, SCHEMAS.c.number))
            return [
                TableSchema.from_json(json.loads(row.definition))
                for row in rows
                if is_item(row.item)
            ]

    def held(self, source: Source) -> set[str]:
        """Return the ids of the schemas that a store has rows of."""
        with self.database.reading() as connection:
            statement = select(SOURCES.c.schema_id).where(*_of(SOURCES, source))
            return set(connection.scalars(statement))


_ORDER = (
    JOURNALS.c.robot, JOURNALS.c.store_id, JOURNALS.c.writer, JOURNALS.c.run, JOURNALS.c.first_seq,
    JOURNALS.c.file,
)  # fmt: skip


def name_of(row: Row[Any]) -> str:
    """Name a journal within the archive."""
    return f"{row.robot}/{row.store_id}/{row.file}"


def _find(connection: Connection, key: JournalKey) -> Row[Any] | None:
    return connection.execute(select(JOURNALS).where(_is(key))).one_or_none()


def _is(row: Any) -> Any:
    values = (row.robot, row.store_id, row.file)
    return and_(*(column == value for column, value in zip(_KEY, values, strict=True)))


def _of(table: Any, source: Source) -> tuple[Any, Any]:
    return table.c.robot == source.robot, table.c.store_id == source.store_id
