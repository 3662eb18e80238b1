"""Bad networks and lost power: what the record holds is on the server, once, and nothing else."""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path

import pytest
from sqlalchemy import select

from amberbox.blackbox.store.store import open_store
from amberbox.link import limits
from amberbox.server.database import ServerDatabase
from amberbox.server.schema import EVENT
from amberbox.testing.fault_proxy import FAULTS, Fault, Faults, FrameFaults, Proxy
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


def kinds(database: ServerDatabase) -> set[str]:
    with database.reading() as connection:
        return set(connection.scalars(select(EVENT.c.kind).where(EVENT.c.robot == "r1")))


async def carry(path: Path, database: ServerDatabase, faults: Faults, seed: int) -> Proxy:
    """Write for a while behind a faulty network, then wait for everything to arrive."""
    watcher = Watcher(path)
    watcher.write(300, 2)
    async with serving(database, silent_s=1.0) as (_, port):
        with Proxy(port, faults, seed) as proxy:
            async with linked(client_of(watcher.store, proxy.port)):
                for _ in range(40):
                    watcher.write(10, 1, sync=False)
                    await asyncio.sleep(0.03)
                watcher.close()
                await until(lambda: held(database) == recorded(path))
    return proxy


@pytest.mark.parametrize("kind", [kind for kind in FAULTS if kind != "none"])
def test_no_fault_of_a_connection_loses_rows(
    tmp_path: Path, database: ServerDatabase, monkeypatch: pytest.MonkeyPatch, kind: Fault
) -> None:
    monkeypatch.setattr(limits, "SILENT_S", 1.0)
    monkeypatch.setattr(limits, "BEAT_S", 0.2)
    faults = Faults((kind,), after_bytes=(20_000, 120_000), stall_s=1.5, rate=100_000)
    proxy = asyncio.run(carry(tmp_path / "store", database, faults, 7))
    assert proxy.struck and set(proxy.struck) == {kind}
    assert not put_aside(database)


def test_frames_twice_swapped_late_and_damaged_change_nothing(
    tmp_path: Path, database: ServerDatabase
) -> None:
    faults = Faults(("none",), frames=FrameFaults(0.08, 0.04, 0.03, 0.04))
    proxy = asyncio.run(carry(tmp_path / "store", database, faults, 3))
    assert proxy.connections > 2
    assert not put_aside(database)


def cut_power(path: Path, keep_bytes: int) -> None:
    """Remove from the newest journal the data after a byte, and its head."""
    newest = open_store(path).journal_files("watch")[-1]
    with newest.open("r+b") as file:
        file.truncate(keep_bytes)
    (newest.parent / "head").unlink()


def test_rows_that_came_early_and_fell_to_a_power_cut_are_kept_marked(
    tmp_path: Path, database: ServerDatabase
) -> None:
    path = tmp_path / "store"

    async def before() -> int:
        watcher = Watcher(path)
        watcher.write(20, 1)
        durable = watcher.store.journal_files("watch")[-1].stat().st_size
        async with serving(database) as (_, port), linked(client_of(watcher.store, port)):
            await asyncio.sleep(0.2)
            watcher.write(7, 1, sync=False)
            await until(lambda: len(held(database)) == 29)
        watcher.lock.release()
        return durable

    async def after() -> None:
        watcher = Watcher(path)
        watcher.write(5)
        async with serving(database) as (_, port), linked(client_of(watcher.store, port)):
            await until(lambda: held(database) == recorded(path))
        watcher.close()

    durable = asyncio.run(before())
    cut_power(path, durable)
    asyncio.run(after())
    assert len(recorded(path)) == 26
    assert len(put_aside(database)) == 8
    assert kinds(database) == {"lost_at_power_cut"}


def test_a_new_card_begins_anew_and_is_told(tmp_path: Path, database: ServerDatabase) -> None:
    async def on(path: Path, rows: int) -> None:
        watcher = Watcher(path)
        watcher.write(rows)
        async with serving(database) as (_, port), linked(client_of(watcher.store, port)):
            await until(lambda: recorded(path).items() <= held(database).items())
        watcher.close()

    asyncio.run(on(tmp_path / "one", 12))
    asyncio.run(on(tmp_path / "two", 5))
    assert held(database) == recorded(tmp_path / "one") | recorded(tmp_path / "two")
    assert kinds(database) == {"new_store"}


@pytest.mark.parametrize("runs_since", [1, 3])
def test_an_old_image_never_joins_what_was_before(
    tmp_path: Path, database: ServerDatabase, monkeypatch: pytest.MonkeyPatch, runs_since: int
) -> None:
    """The image does not contain the last runs; new runs get the same numbers."""
    path, image = tmp_path / "store", tmp_path / "image"

    async def go_on(path: Path, boot: str, runs: int) -> None:
        boot_id = f"{boot}-0000-4000-8000-000000000000"
        monkeypatch.setattr("amberbox.core.clock.SystemClock.boot_id", lambda self: boot_id)
        async with serving(database) as (_, port):
            for _ in range(runs):
                watcher = Watcher(path)
                watcher.count = int(boot[:3], 16)
                watcher.write(9)
                watcher.close()
            async with linked(client_of(watcher.store, port)):
                await until(lambda: recorded(path).items() <= held(database).items())

    asyncio.run(go_on(path, "aaaaaaaa", 2))
    shutil.copytree(path, image)
    asyncio.run(go_on(path, "bbbbbbbb", 2))
    first = recorded(path)
    asyncio.run(go_on(image, "cccccccc", runs_since))
    second = recorded(image)
    assert held(database) == second
    assert put_aside(database) == {k: v for k, v in first.items() if second.get(k) != v}
    assert kinds(database) == {"other_history"}
