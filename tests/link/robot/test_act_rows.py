"""Rows of the command process over the link: all of them, after alarms, before statuses."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path

from amberbox.blackbox.journal import channels
from amberbox.link.frames import LinkRow
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.link_server import LinkHooks
from tests.link.robot.rig import Watcher, client_of, held, linked, recorded, serving, until


def test_they_are_stored_once_and_passed_on(tmp_path: Path, database: ServerDatabase) -> None:
    passed_on: list[LinkRow] = []

    def take(robot: str, store_id: str, rows: Sequence[LinkRow]) -> None:
        passed_on.extend(rows)

    async def scene() -> None:
        watcher, act = Watcher(tmp_path / "store"), Watcher(tmp_path / "store", writer="act")
        watcher.write(20)
        act.report(20)  # while there is no link
        async with serving(database, LinkHooks(rows=take)) as (_, port):
            client = client_of(watcher.store, port)
            async with linked(client):
                await until(lambda: len(held(database)) == 40)
                act.report(20)
                await until(lambda: held(database) == recorded(tmp_path / "store"))
                assert client.left_out == frozenset()
        act.close()
        watcher.close()

    asyncio.run(scene())
    assert [row.channel for row in passed_on].count(channels.COMMAND) == 40
    assert len(held(database)) == 60


def test_a_flood_of_reports_does_not_hold_up_alarms(
    tmp_path: Path, database: ServerDatabase
) -> None:
    """On a slow line, with more reports waiting than are read ahead."""

    def received(channel: str) -> int:
        return [found for found, _, _ in held(database).values()].count(channel)

    async def scene() -> None:
        watcher, act = Watcher(tmp_path / "store"), Watcher(tmp_path / "store", writer="act")
        async with serving(database) as (_, port):
            client = client_of(watcher.store, port, rate=100_000.0)
            async with linked(client):
                await until(lambda: client.progress.connected)
                act.report(9000)
                await until(lambda: received(channels.COMMAND) > 0)
                watcher.write(0, 1)
                await until(lambda: received(channels.EVENT) == 1)
                assert received(channels.COMMAND) < 4500, "they came first"
                client.bucket.rate = 0.0
                await until(lambda: received(channels.COMMAND) == 9000)
        act.close()
        watcher.close()

    asyncio.run(scene())
