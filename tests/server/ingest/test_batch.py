"""Rows of many robots stored together give the same database as rows stored one by one."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import msgspec
import pytest
from sqlalchemy import Connection, select

from amberbox.blackbox.journal import channels
from amberbox.link.frames import Hello, JournalPosition, LinkRow, RunEnd, WriterReach
from amberbox.link.ledger import StaleEpochError, StoredRows
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest import ledger
from amberbox.server.ingest.ledger import (
    GroupedWrites,
    RowBatch,
    drop_committed,
    store_batches,
)
from amberbox.server.schema import ASIDE, COMMITTED, EVENT, ROW, RUN, STATUS, WRITER

TABLES = (ROW, RUN, WRITER, STATUS, ASIDE, EVENT, COMMITTED)
ROBOTS = ("r1", "r2", "r3")
BEYOND = 1 << 63


class Chance:
    """Makes random frames of robots: mostly the expected next one, sometimes any other."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.ends: dict[tuple[str, int], int] = {}

    def batch(self) -> RowBatch:
        """Return the next batch."""
        robot, run = self.random.choice(ROBOTS), self.random.choice((1, 1, 1, 2))
        end = self.ends.get((robot, run), 0)
        start = end if self.random.random() < 0.9 else self.random.randint(0, end)
        rows = [self._row(run, start + n * self.random.choice((1, 1, 2))) for n in range(3)]
        rows = rows[: self.random.choice((0, 1, 3))]
        end = max([end, *(row.seq + 1 for row in rows if row.seq < BEYOND)])
        self.ends[robot, run] = end
        upto = {"watch": JournalPosition(run, end)} if self.random.random() < 0.8 else {}
        epoch = 1 if self.random.random() < 0.95 else 2
        compare = self.random.random() < 0.4
        return RowBatch(robot, epoch, "s", rows, upto, self._reach(run, end), 7, compare)

    def _row(self, run: int, seq: int) -> LinkRow:
        if self.random.random() < 0.01:
            seq = BEYOND
        status = {"component": self.random.choice("ab"), "level": "ok", "reason": str(seq)}
        return LinkRow("watch", run, seq, channels.STATUS, seq, msgspec.json.encode(status))

    def _reach(self, run: int, end: int) -> dict[str, WriterReach]:
        boot, closed = self.random.choice(("b",) * 12 + ("", "other")), self.random.random() < 0.1
        stated = max(end - 1, 0) if self.random.random() < 0.1 else end
        runs = (RunEnd(1, "b", 0, closed=False),) if run == 2 else ()
        last = RunEnd(run, boot, stated, closed=closed)
        return {
            "watch": WriterReach(
                JournalPosition(1, 0),
                JournalPosition(run, stated),
                JournalPosition(run, stated),
                (*runs, last),
            )
        }


def _begin(folder: Path, name: str) -> ServerDatabase:
    database = ServerDatabase(folder / name)
    with database.begin() as connection:
        for robot in ROBOTS:
            ledger.admit(connection, Hello(robot, "s", "b", {}, "", 0, 0, "1"), 1)
            drop_committed(connection, robot, "s", "watch", 1, 4, 7)
    return database


def _content(database: ServerDatabase) -> dict[str, list[Any]]:
    with database.reading() as connection:
        return {
            table.name: sorted(
                map(repr, (tuple(row) for row in connection.execute(select(table)))), key=str
            )
            for table in TABLES
        }


@pytest.mark.parametrize("seed", range(12))
def test_what_is_taken_together_is_what_is_taken_one_by_one(tmp_path: Path, seed: int) -> None:
    chance = Chance(seed)
    batches = [chance.batch() for _ in range(80)]
    many, single = _begin(tmp_path, "many.db"), _begin(tmp_path, "single.db")
    got, expected = [], []
    for start in range(0, len(batches), 16):
        part = batches[start : start + 16]
        with many.begin() as connection:
            got += ledger._stored(connection, part)
        with single.begin() as connection:
            expected += [ledger._tried(connection, batch) for batch in part]
    assert [_told(one) for one in got] == [_told(one) for one in expected]
    assert _content(many) == _content(single)
    many.close()
    single.close()


def _told(result: tuple[Any, BaseException | None]) -> object:
    found, trouble = result
    return found if trouble is None else type(trouble)


def test_what_is_ordinary_is_taken_together(tmp_path: Path) -> None:
    database, chance = _begin(tmp_path, "server.db"), Chance(0)
    rows = [chance._row(1, seq) for seq in range(20)]
    batches = [
        RowBatch(robot, 1, "s", rows[n : n + 5], {"watch": JournalPosition(1, n + 5)},
               chance._reach(1, n + 5), 7, n == 10)
        for n in (0, 5, 10) for robot in ROBOTS
    ]  # fmt: skip
    with database.begin() as connection:
        done = store_batches(connection, batches)
        assert len(done) == len(batches)
        again = store_batches(connection, batches[:2])
    assert [one.new for one in again if isinstance(one, StoredRows)] == [(), ()]
    assert not any(isinstance(one, StaleEpochError) for one in done)
    database.close()


def test_a_stopped_writer_has_written_everything(tmp_path: Path) -> None:
    database = _begin(tmp_path, "server.db")
    writes, seen = GroupedWrites(database, gather_s=30.0), []

    def note(connection: Connection) -> None:
        seen.append(connection.in_transaction())

    writes.submit(note).result(10)
    waiting = [writes.submit(note) for _ in range(300)]
    writes.close()
    assert [one.result(0) for one in waiting] == [None] * 300 and seen == [True] * 301
    database.close()
