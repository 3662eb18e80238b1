"""Commands over real connections: each is done once, and its answer arrives, whatever is lost."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from amberbox.core.command import LeaseState
from amberbox.link import limits
from amberbox.link.client import LinkClient
from amberbox.link.frames import (
    AbortFrame,
    CommandsFrame,
    LeaseFrame,
    RevokedFrame,
    Welcome,
    encode,
    from_robot,
)
from amberbox.server import commands
from amberbox.server.commands import StoredCommand
from amberbox.server.database import ServerDatabase
from amberbox.testing.clock import PATIENCE_S
from amberbox.testing.fault_proxy import FAULTS, Fault, Faults, FrameFaults, Proxy
from tests.link.old_wire import encode as encode_anything
from tests.link.robot.rig import Watcher, client_of, linked, serving, until
from tests.link.robot.simulated_gate import SimulatedGate
from tests.support.commands import created, found

KEY = "0123456789abcdef"


@pytest.fixture
def database(tmp_path: Path) -> Iterator[ServerDatabase]:
    made = ServerDatabase(tmp_path / "server.db")
    yield made
    made.close()


def client_with(gate: SimulatedGate, watcher: Watcher, port: int) -> LinkClient:
    client = client_of(watcher.store, port)
    client.port = gate
    return client


def states(database: ServerDatabase, made: list[StoredCommand]) -> set[str]:
    return {found(database, one.id).state for one in made}


def test_commands_are_done_once_and_answered(tmp_path: Path, database: ServerDatabase) -> None:
    gate = SimulatedGate()
    made = created(database, count=3, revoked=KEY)

    async def scene() -> None:
        watcher = Watcher(tmp_path / "store")
        async with serving(database) as (link, port):
            async with linked(client_with(gate, watcher, port)):
                await until(lambda: states(database, made) == {"accepted"})
                assert gate.begun == [server_id(database)] and gate.keys == {KEY}
                gate.finish()
                await until(lambda: states(database, made) == {"done"})
                await until(lambda: not gate.unanswered())
                made.extend(await asyncio.to_thread(created, database, "r1", count=2))
                link.send_commands("r1")
                await until(lambda: len(gate.pending) == 2)
                gate.finish("failed")
                await until(lambda: states(database, made) == {"done", "failed"})
                await until(lambda: link.challenges("r1") == gate.challenges)
            assert not gate.connected
        watcher.close()

    asyncio.run(scene())
    assert gate.done == [one.id for one in made] and gate.received == 5


def server_id(database: ServerDatabase) -> str:
    with database.begin() as connection:
        return commands.server_id(connection, 0)


def test_leases_and_aborts_reach_the_gate_and_its_word_comes_back(
    tmp_path: Path, database: ServerDatabase
) -> None:
    gate = SimulatedGate()

    def lease() -> LeaseState | None:
        with database.reading() as connection:
            said = commands.commanded(connection, "r1")
        return None if said is None else said.lease

    async def scene() -> None:
        watcher = Watcher(tmp_path / "store")
        async with (
            serving(database) as (link, port),
            linked(client_with(gate, watcher, port)),
        ):
            await until(lambda: bool(link.challenges("r1")))
            assert await link.order("r1", LeaseFrame("take", "server", "run"))
            await until(lambda: lease() == LeaseState(1, "server", "run"))
            assert await link.order("r1", AbortFrame("run"))
            assert await link.order("r1", LeaseFrame("release", "server", "run", 1))
            await until(lambda: lease() == LeaseState(1))
            assert gate.aborted == [AbortFrame("run")]
        watcher.close()

    asyncio.run(scene())


async def command_behind(
    path: Path, database: ServerDatabase, gate: SimulatedGate, faults: Faults, seed: int
) -> tuple[Proxy, list[StoredCommand]]:
    """Give commands for a while behind a faulty network, then wait for all answers."""
    watcher = Watcher(path)
    made: list[StoredCommand] = []
    async with serving(database, silent_s=1.0) as (link, port):
        with Proxy(port, faults, seed) as proxy:
            async with linked(client_with(gate, watcher, proxy.port)):
                for _ in range(40):
                    made += await asyncio.to_thread(created, database, "r1", count=2)
                    watcher.write(10, 1)
                    link.send_commands("r1")
                    await asyncio.sleep(0.03)
                    gate.finish()
                    gate.mint()
                async with asyncio.timeout(PATIENCE_S):
                    while states(database, made) != {"done"} or gate.unanswered():
                        gate.finish()
                        await asyncio.sleep(0.05)
    watcher.close()
    return proxy, made


@pytest.mark.parametrize("kind", [kind for kind in FAULTS if kind != "none"])
def test_no_fault_of_a_connection_does_a_command_twice_or_not_at_all(
    tmp_path: Path, database: ServerDatabase, monkeypatch: pytest.MonkeyPatch, kind: Fault
) -> None:
    monkeypatch.setattr(limits, "SILENT_S", 1.0)
    monkeypatch.setattr(limits, "BEAT_S", 0.2)
    faults = Faults((kind,), after_bytes=(5_000, 40_000), stall_s=1.5, rate=100_000)
    gate = SimulatedGate()
    proxy, made = asyncio.run(command_behind(tmp_path / "store", database, gate, faults, 7))
    assert proxy.struck and set(proxy.struck) == {kind}
    assert sorted(gate.done) == sorted(one.id for one in made) and not gate.refused


def test_frames_twice_swapped_late_and_damaged_do_nothing_twice(
    tmp_path: Path, database: ServerDatabase
) -> None:
    faults = Faults(("none",), frames=FrameFaults(0.08, 0.04, 0.03, 0.04))
    gate = SimulatedGate()
    proxy, made = asyncio.run(command_behind(tmp_path / "store", database, gate, faults, 3))
    assert proxy.connections > 2 and len(gate.begun) > 2
    assert sorted(gate.done) == sorted(one.id for one in made) and not gate.refused


def test_a_server_that_was_restored_from_a_copy_asks_again_and_nothing_is_done_twice(
    tmp_path: Path,
) -> None:
    gate, path, copy = SimulatedGate(), tmp_path / "server.db", tmp_path / "copy.db"
    watcher = Watcher(tmp_path / "store")

    async def contact(made: list[StoredCommand], *, finish: bool) -> None:
        database = ServerDatabase(path)
        want = {"done"} if finish else {"accepted"}
        async with serving(database) as (_, port), linked(client_with(gate, watcher, port)):
            await until(lambda: len(gate.log) >= len(made))
            if finish:
                gate.finish()
            await until(lambda: states(database, made) == want and not gate.unanswered())
        database.close()

    database = ServerDatabase(path)
    made = created(database, count=2)
    database.close()
    asyncio.run(contact(made, finish=False))
    database = ServerDatabase(path)
    made += created(database)
    database.close()
    shutil.copy(path, copy)
    asyncio.run(contact(made, finish=True))
    for file in tmp_path.glob("server.db*"):
        file.unlink()
    shutil.copy(copy, path)
    asyncio.run(contact(made, finish=True))
    watcher.close()
    assert sorted(gate.done) == sorted(one.id for one in made)
    assert len(set(gate.begun)) == 1, "it is the same server"


class ScriptedServer:
    """The server's end of a line that says what a test wants."""

    def __init__(self, welcome: Welcome, *frames: bytes) -> None:
        self.heard: list[object] = []
        self.down: asyncio.Queue[bytes] = asyncio.Queue()
        for data in (encode(welcome), *frames):
            self.down.put_nowait(data)

    async def receive(self) -> bytes:
        return await self.down.get()

    async def send(self, data: bytes) -> None:
        self.heard.append(from_robot(data))

    async def close(self) -> None:
        pass


class Later(msgspec.Struct, tag="later"):
    """A frame of a later version."""


LATER = encode_anything(Later())  # type: ignore[arg-type]  # of no version yet
COMMANDS, REVOKED = encode(CommandsFrame([b"x"])), encode(RevokedFrame([KEY]))


@pytest.mark.parametrize(
    ("said", "mine"), [((), (limits.COMMANDS,)), ((limits.COMMANDS,), ()), (("later",), ("own",))]
)
def test_commands_without_the_capability_are_counted_and_ignored(
    tmp_path: Path, said: tuple[str, ...], mine: tuple[str, ...]
) -> None:
    gate = SimulatedGate(mine)
    server = ScriptedServer(Welcome(1, {}, 5, capabilities=list(said)), LATER, COMMANDS, REVOKED)

    async def scene() -> None:
        watcher = Watcher(tmp_path / "store")
        client = client_with(gate, watcher, 1)

        async def line(*_: object) -> ScriptedServer:
            return server

        client._dial = line
        async with linked(client):
            await until(lambda: client.progress.unknown_frames == 3)
            assert client.progress.connected
        watcher.close()

    asyncio.run(scene())
    assert (gate.begun, gate.received, gate.keys) == ([], 0, set())


def test_bad_content_of_a_known_frame_ends_the_link_of_the_robot(tmp_path: Path) -> None:
    gate = SimulatedGate()
    bad = encode_anything(RevokedFrame(["no id"]))  # type: ignore[arg-type]  # encoded unchecked
    servers: list[ScriptedServer] = []

    async def scene() -> None:
        watcher = Watcher(tmp_path / "store")
        client = client_with(gate, watcher, 1)

        async def line(*_: object) -> ScriptedServer:
            welcome = Welcome(1, {}, 5, capabilities=[limits.COMMANDS], server_id="9f" * 16)
            servers.append(ScriptedServer(welcome, *([bad] if not servers else [COMMANDS])))
            return servers[-1]

        client._dial = line
        async with linked(client):
            await until(lambda: gate.received == 1)
            assert client.progress.attempts == 2 and client.progress.unknown_frames == 0
        watcher.close()

    asyncio.run(scene())
    assert gate.begun == ["9f" * 16] * 2 and gate.refused == [b"x"] and not gate.keys
