"""The link from end to end: all rows of the journals are on the server, once each."""

from __future__ import annotations

import asyncio
from pathlib import Path

from sqlalchemy import select

from amberbox.blackbox.journal import channels
from amberbox.blackbox.signing.keys import open_keys, public_key
from amberbox.blackbox.store import store
from amberbox.blackbox.store.store import open_store
from amberbox.link.client import load_acknowledged
from amberbox.link.frames import LinkRow
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.link_server import LinkHooks
from amberbox.server.ingest.link_state import current_statuses, presences
from amberbox.server.schema import STORE
from amberbox.testing.clock import ManualClock
from tests.link.robot.rig import (
    Watcher,
    client_of,
    held,
    linked,
    put_aside,
    recorded,
    serving,
    until,
)


def test_rows_arrive_once_and_are_acknowledged(tmp_path: Path, database: ServerDatabase) -> None:
    async def scene() -> None:
        watcher = Watcher(tmp_path / "store")
        watcher.write(500, 3)
        async with serving(database) as (_, port):
            client = client_of(watcher.store, port)
            async with linked(client):
                await until(lambda: len(held(database)) == 503)
                for _ in range(20):
                    watcher.write(5, 1)
                await until(lambda: held(database) == recorded(tmp_path / "store"))
                await until(lambda: client.progress.offset.offset_ns is not None)
        watcher.close()
        remembered = load_acknowledged(watcher.store)
        assert remembered is not None and remembered.cursor["watch"].seq > 600

    asyncio.run(scene())
    with database.reading() as connection:
        assert [s["component"] for s in current_statuses(connection, "r1")] == [
            "c0",
            "c1",
            "c2",
            "c3",
            "c4",
        ]
        [seen] = presences(connection)
    assert not seen.connected and seen.store_id == open_store(tmp_path / "store").id
    assert not put_aside(database)


def test_an_alarm_does_not_wait_behind_the_backlog(
    tmp_path: Path, database: ServerDatabase
) -> None:
    arrived: list[LinkRow] = []

    async def scene() -> None:
        watcher = Watcher(tmp_path / "store")
        for _ in range(10):
            watcher.write(500)
        hooks = LinkHooks(rows=lambda robot, store_id, rows: arrived.extend(rows))
        async with (
            serving(database, hooks) as (_, port),
            linked(client_of(watcher.store, port, rate=400_000)),
        ):
            await until(lambda: len(arrived) > 100)
            watcher.write(0, 1)
            await until(lambda: any(row.channel == channels.EVENT for row in arrived))
            await until(lambda: held(database) == recorded(tmp_path / "store"))
        watcher.close()

    asyncio.run(scene())
    [place] = [n for n, row in enumerate(arrived) if row.channel == channels.EVENT]
    assert place < 4000 < len(arrived)


def test_a_writer_that_begins_later_is_told_of(tmp_path: Path, database: ServerDatabase) -> None:
    async def scene() -> None:
        watcher = Watcher(tmp_path / "store")
        async with serving(database) as (_, port), linked(client_of(watcher.store, port)):
            await asyncio.sleep(0.3)
            watcher.write(3)
            await until(lambda: len(held(database)) == 3)
        watcher.close()

    asyncio.run(scene())


def test_a_wrong_key_gives_nothing_away(tmp_path: Path, database: ServerDatabase) -> None:
    async def scene() -> None:
        watcher = Watcher(tmp_path / "store")
        watcher.write(3)
        async with serving(database) as (_, port):
            client = client_of(watcher.store, port)
            client.options = type(client.options)(client.options.url, "r1", "wrong")
            async with linked(client):
                await until(lambda: client.progress.attempts > 2)
        watcher.close()
        assert not client.progress.connected and client.progress.trouble

    asyncio.run(scene())
    assert not held(database)


def test_a_robot_in_1970_connects_and_says_so(tmp_path: Path, database: ServerDatabase) -> None:
    async def scene() -> None:
        watcher = Watcher(tmp_path / "store")
        watcher.write(3)
        async with serving(database) as (_, port):
            client = client_of(watcher.store, port)
            client.clock = ManualClock(wall=0)
            async with linked(client):
                await until(lambda: len(held(database)) == 3)
        watcher.close()
        [asked] = store.pending(watcher.store)
        assert (asked.kind, asked.values["kind"]) == ("event", "clock_not_set")

    asyncio.run(scene())


def test_a_key_that_is_made_later_is_told(tmp_path: Path, database: ServerDatabase) -> None:
    def known() -> str:
        with database.reading() as connection:
            return str(connection.execute(select(STORE.c.public_key)).scalar() or "")

    async def scene() -> None:
        watcher = Watcher(tmp_path / "store")
        watcher.write(5)
        async with serving(database) as (_, port), linked(client_of(watcher.store, port)):
            await until(lambda: len(held(database)) == 5)
            assert known() == ""
            open_keys(watcher.store)
            await until(lambda: known() == public_key(watcher.store.path))
            watcher.write(5)
            await until(lambda: len(held(database)) == 10)
        watcher.close()

    asyncio.run(scene())
