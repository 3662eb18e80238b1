"""What tests of the server share: the tables of a new database are worked out once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from sqlalchemy import Connection, MetaData

from amberbox.server import database
from amberbox.server.database import Migration
from amberbox.server.schema import METADATA
from tests.server.house import House, house


@pytest.fixture(scope="session", autouse=True)
def write_tables_once() -> Iterator[None]:
    """Make later databases with the statements of the first: that takes a third of the time."""
    really, made = database.prepare, dict[int, list[str]]()

    def prepare(
        connection: Connection, metadata: MetaData, migrations: Sequence[Migration], now_ns: int
    ) -> None:
        if metadata is not METADATA or database.version(connection) is not None:
            really(connection, metadata, migrations, now_ns)
        elif len(migrations) not in made:
            really(connection, metadata, migrations, now_ns)
            chosen = "SELECT sql FROM sqlite_master WHERE sql IS NOT NULL"
            made[len(migrations)] = [row[0] for row in connection.exec_driver_sql(chosen)]
        else:
            for statement in made[len(migrations)]:
                connection.exec_driver_sql(statement)
            newest = migrations[-1].number if migrations else database.FIRST
            database._note(connection, newest, "made", now_ns)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(database, "prepare", prepare)
        yield


@pytest.fixture
def home(tmp_path: Path) -> Iterator[House]:
    """A server of the test's own, with an app that it has from the test before."""
    with house(tmp_path / "server", shared=True) as found:
        yield found
