"""Ends of version ef939a5 and of today understand each other, both ways; protocol 1 stays.

The bytes that old ends send were recorded with their code; what they understand is decoded with a
copy of their definitions.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from amberbox.core.pacing import Backoff
from amberbox.link import limits
from amberbox.link.client import LinkClient
from amberbox.link.connection import LinkDownError, LinkOptions
from amberbox.link.frames import (
    AbortFrame,
    Ack,
    ActionsFrame,
    AnsweredFrame,
    AnswersFrame,
    BeatFrame,
    Bye,
    ChallengeFrame,
    CommandsFrame,
    DurableFrame,
    FetchFrame,
    HasFrame,
    HeadsFrame,
    Hello,
    JournalPosition,
    LeaseFrame,
    LinkRow,
    LiveFrame,
    Pong,
    RevokedFrame,
    RobotFrame,
    RowsFrame,
    RunEnd,
    ServerFrame,
    UnknownFrameError,
    WatchFrame,
    Welcome,
    WriterReach,
    encode,
    from_robot,
    from_server,
)
from amberbox.link.policy import Network
from amberbox.server.database import ServerDatabase
from tests.link import old_wire
from tests.link.robot.rig import Watcher, held, linked, recorded, until
from tests.link.robot.simulated_gate import SimulatedGate
from tests.support.command_rows import created
from tests.support.sockets import serving_one

RECORDED: dict[str, list[dict[str, Any]]] = json.loads(
    (Path(__file__).parents[1] / "fixtures" / "ef939a5" / "frames.json").read_text()
)
REACH = WriterReach(
    JournalPosition(1, 0),
    JournalPosition(1, 9),
    JournalPosition(1, 5),
    (RunEnd(1, "b", 9, closed=False),),
)
OF_ROBOTS: list[RobotFrame] = [
    Hello("r1", "s", "b", {"watch": REACH}, "", 1, 2, "3", public_key="k",
          capabilities=[limits.COMMANDS, "of a later version"], more={"act": REACH}),
    RowsFrame(1, 1, [LinkRow("watch", 1, 1, "amberbox/status", 5, b"{}")],
              {"watch": JournalPosition(1, 2)}),
    DurableFrame(1, {"watch": REACH}),
    LiveFrame(1, {"odom.x": (5, 1.5), "state": (6, "on")}),
    BeatFrame(1, 1, 2, 3, 4, 5, 6, "running", 0.5),
    HeadsFrame(1, b"{}"),
    HasFrame(1, [("a", 1)], "f"),
    Bye("x"),
]  # fmt: skip
OF_SERVERS: list[ServerFrame] = [
    Welcome(1, {"watch": JournalPosition(1, 2)}, 5, True, ["odom.x"], [limits.COMMANDS], "9f" * 16),
    Ack(1, {"watch": JournalPosition(1, 2)}),
    Pong(1, 2),
    WatchFrame(["odom.x"]),
    FetchFrame("f", "odom", 1, 2),
    Bye("x", for_good=True),
]
NEW_OF_ROBOTS: list[RobotFrame] = [
    ChallengeFrame(1, bytes(32)), ActionsFrame(1, b"[]"), AnswersFrame(1, 1, []),
]  # fmt: skip
NEW_OF_SERVERS: list[ServerFrame] = [
    CommandsFrame([b"x"]), AnsweredFrame(1), RevokedFrame(["k"]), LeaseFrame("take", "h", "r"),
    AbortFrame("r"),
]  # fmt: skip


def test_the_protocol_is_still_1() -> None:
    """Old ends compare it exactly: another number would keep all of them out."""
    assert limits.PROTOCOL == 1
    assert Hello("r", "s", "b", {}, "", 0, 0, "1").protocol == 1


@pytest.mark.parametrize("one", RECORDED["from robot"], ids=lambda one: str(one["says"]["type"]))
def test_what_old_robots_send_is_understood(one: dict[str, Any]) -> None:
    frame = from_robot(bytes.fromhex(one["bytes"]))
    assert items(frame).items() >= one["says"].items()
    if isinstance(frame, Hello):
        assert frame.capabilities == []


@pytest.mark.parametrize("one", RECORDED["from server"], ids=lambda one: str(one["says"]["type"]))
def test_what_old_servers_send_is_understood(one: dict[str, Any]) -> None:
    frame = from_server(bytes.fromhex(one["bytes"]))
    assert items(frame).items() >= one["says"].items()
    if isinstance(frame, Welcome):
        assert (frame.capabilities, frame.server_id) == ([], "")


def items(frame: object) -> dict[str, Any]:
    """Return the fields of a frame as JSON has them."""
    found: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(frame))
    return found


def test_every_frame_of_an_old_version_was_recorded() -> None:
    kinds = {
        "from robot": {"hello", "rows", "durable", "live", "beat", "heads", "has", "bye"},
        "from server": {"welcome", "ack", "pong", "watch", "fetch", "bye"},
    }
    assert {k: {one["says"]["type"] for one in v} for k, v in RECORDED.items()} == kinds


@pytest.mark.parametrize("frame", OF_ROBOTS, ids=lambda frame: type(frame).__name__)
def test_old_servers_understand_what_is_sent_today(frame: RobotFrame) -> None:
    old = old_wire.from_robot(encode(frame))
    assert items(frame).items() >= items(old).items() and len(items(old)) > 1


@pytest.mark.parametrize("frame", OF_SERVERS, ids=lambda frame: type(frame).__name__)
def test_old_robots_understand_what_is_sent_today(frame: ServerFrame) -> None:
    old = old_wire.from_server(encode(frame))
    assert items(frame).items() >= items(old).items() and len(items(old)) > 1


def test_old_ends_end_the_link_over_new_frames() -> None:
    """So neither end sends one unless the other has said that it can."""
    for up in NEW_OF_ROBOTS:
        with pytest.raises(ValueError, match="Invalid value"):
            old_wire.from_robot(encode(up))
    for down in NEW_OF_SERVERS:
        with pytest.raises(ValueError, match="Invalid value"):
            old_wire.from_server(encode(down))


def test_frames_of_a_later_version_are_told_from_bad_ones() -> None:
    class Later(msgspec.Struct, tag="later"):
        anything: int = 1

    for read in (from_robot, from_server):
        with pytest.raises(UnknownFrameError, match="later"):
            read(old_wire.encode(Later()))  # type: ignore[arg-type]  # of no version yet


@pytest.fixture
def database(tmp_path: Path) -> Iterator[ServerDatabase]:
    found = ServerDatabase(tmp_path / "server.db")
    yield found
    found.close()


def test_an_old_robot_is_sent_nothing_new(database: ServerDatabase) -> None:
    """Commands wait for it, and keys are revoked; all that comes, its code understands."""
    says = [bytes.fromhex(one["bytes"]) for one in RECORDED["from robot"]]
    created(database, "ropod_001", revoked="0123456789abcdef")
    said = from_robot(says[0])
    assert isinstance(said, Hello)
    writers = said.writers.keys()

    async def scene() -> None:
        async with serving_one(database, "ropod_001") as (link, socket):
            for data in says[:-1]:  # all but its Bye; epoch 3 is the third contact
                socket.up.put_nowait(data)
            welcome = old_wire.from_server(await socket.hear_bytes())
            assert isinstance(welcome, old_wire.Welcome) and welcome.epoch == 3
            assert welcome.cursor.keys() == writers
            ack = old_wire.from_server(await socket.hear_bytes())
            assert isinstance(ack, old_wire.Ack)
            link.send_commands()
            assert not await link.order("ropod_001", AbortFrame("r"))
            socket.up.put_nowait(old_wire.encode(old_wire.Beat(3, 1, 77)))
            while True:
                heard = old_wire.from_server(await socket.hear_bytes())
                assert isinstance(heard, old_wire.Ack | old_wire.Pong), heard
                if isinstance(heard, old_wire.Pong) and heard.mono_ns == 77:
                    break
            assert link.unknown_frames == 0 and link.challenges("ropod_001") == []

    async def contact() -> None:
        async with serving_one(database, "ropod_001") as (_, socket):
            socket.up.put_nowait(says[0])
            await socket.hear_bytes()

    asyncio.run(contact())
    asyncio.run(contact())
    asyncio.run(scene())


OLD_WRITERS = {"main", "keep", "watch"}


class OldServer:
    """A server of the old version at the other end of a line; it stores nothing, and says so."""

    def __init__(self, cursor: old_wire.Cursor | None = None) -> None:
        self.heard: list[old_wire.RobotFrame] = []
        self.rows = 0
        self._cursor = cursor or {}
        self._down: asyncio.Queue[bytes | None] = asyncio.Queue()

    async def receive(self) -> bytes:
        data = await self._down.get()
        if data is None:
            raise LinkDownError("closed")
        return data

    async def send(self, data: bytes) -> None:
        frame = old_wire.from_robot(data)  # an old server would end the link over a new frame
        self.heard.append(frame)
        if isinstance(frame, old_wire.Hello | old_wire.Durable):
            assert set(frame.writers) <= OLD_WRITERS  # nor over a writer that it does not know
        if isinstance(frame, old_wire.Hello):
            assert frame.protocol == 1
            cursor = dict.fromkeys(frame.writers, old_wire.Place()) | self._cursor
            self._say(old_wire.Welcome(1, cursor, 5))
        elif isinstance(frame, old_wire.Beat):
            self._say(old_wire.Pong(5, frame.mono_ns))
        elif isinstance(frame, old_wire.Rows):
            assert {*frame.upto, *(row.writer for row in frame.rows)} <= OLD_WRITERS
            self.rows += len(frame.rows)
            self._say(old_wire.Ack(frame.number, {}))

    async def close(self) -> None:
        self._down.put_nowait(None)

    def _say(self, frame: old_wire.ServerFrame) -> None:
        self._down.put_nowait(old_wire.encode(frame))


def test_a_new_robot_with_a_gate_keeps_it_to_itself_at_an_old_server(tmp_path: Path) -> None:
    async def scene() -> None:
        watcher, server, gate = Watcher(tmp_path / "store"), OldServer(), SimulatedGate()
        gate.answer("0" * 32, "done")
        watcher.write(20)

        async def dial(*_: object) -> OldServer:
            return server

        client = LinkClient(
            watcher.store, LinkOptions("http://127.0.0.1:1", "r1", "key"), port=gate, dialer=dial,
            network=lambda: Network("eth0"), backoff=Backoff(least_s=0.05, most_s=0.1),
        )  # fmt: skip
        async with linked(client):
            await until(lambda: server.rows == len(recorded(tmp_path / "store")) == 20)
            await until(lambda: any(isinstance(one, old_wire.Beat) for one in server.heard))
            assert client.progress.connected and client.progress.attempts == 1
            assert client.progress.unknown_frames == 0
        assert gate.begun == [] and [one.number for one in gate.unanswered()] == [1]
        watcher.close()

    asyncio.run(scene())


@pytest.mark.parametrize("cursor", [{}, {"act": old_wire.Place(2, 3)}], ids=["old", "downgraded"])
def test_an_old_server_hears_nothing_of_the_command_process(
    tmp_path: Path, cursor: old_wire.Cursor
) -> None:
    """Neither its rows nor its journals: over those it would end the link, or never take them."""

    async def scene() -> None:
        watcher, act = Watcher(tmp_path / "store"), Watcher(tmp_path / "store", writer="act")
        watcher.write(20)
        act.report(5)
        server = OldServer(cursor)

        async def dial(*_: object) -> OldServer:
            return server

        client = LinkClient(
            watcher.store, LinkOptions("http://127.0.0.1:1", "r1", "key"), dialer=dial,
            network=lambda: Network("eth0"), backoff=Backoff(least_s=0.05, most_s=0.1),
        )  # fmt: skip
        async with linked(client):
            await until(lambda: server.rows == 20)
            watcher.write(5)
            act.report(5)
            await until(lambda: server.rows == 25)
            assert client.progress.attempts == 1
            assert client.left_out == {"act", "experiment", "detect"}
        act.close()
        watcher.close()

    asyncio.run(scene())


def test_a_robot_of_today_without_a_gate_behaves_as_before(
    tmp_path: Path, database: ServerDatabase
) -> None:
    """It says no capability, so that its server sends and stores nothing of commands."""
    from amberbox.server.commands import commanded
    from tests.link.robot.rig import client_of, serving

    created(database, "r1", revoked="0123456789abcdef")

    async def scene() -> None:
        watcher = Watcher(tmp_path / "store")
        watcher.write(20)
        async with serving(database) as (link, port):
            client = client_of(watcher.store, port)
            async with linked(client):
                await until(lambda: held(database) == recorded(tmp_path / "store"))
                link.send_commands()
                await until(lambda: client.progress.offset.offset_ns is not None)
            assert client.progress.unknown_frames == link.unknown_frames == 0
        watcher.close()

    asyncio.run(scene())
    with database.reading() as connection:
        assert commanded(connection, "r1") is None
