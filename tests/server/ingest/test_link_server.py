"""The server's end: one connection per robot, silence noticed, the board, what is committed."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from sqlalchemy import select, text

from amberbox.blackbox.journal import channels
from amberbox.core.robot_status import Contact
from amberbox.link.frames import (
    Ack,
    BeatFrame,
    Bye,
    HeadsFrame,
    Hello,
    JournalPosition,
    LinkRow,
    LiveFrame,
    Pong,
    RowsFrame,
    RunEnd,
    WatchFrame,
    Welcome,
    WriterReach,
)
from amberbox.link.server_end import ServerEnd
from amberbox.monitoring.current_state import WatcherHeartbeat
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest import ledger
from amberbox.server.ingest.ledger import GroupedWrites, RowBatch, drop_committed
from amberbox.server.ingest.link_server import LinkHooks, LinkServer
from amberbox.server.ingest.link_state import RobotPresence, current_statuses, presences
from amberbox.server.live.records import (
    RetainedStatus,
    ServerNow,
    StatusRecord,
    monitoring_of,
    silence,
)
from amberbox.server.schema import BOOT, EVENT, HEADS, ROW
from amberbox.testing.clock import PATIENCE_S
from tests.support.sockets import FakeSocket

REACH = WriterReach(
    JournalPosition(1, 0),
    JournalPosition(1, 9),
    JournalPosition(1, 5),
    (RunEnd(1, "b", 9, closed=False),),
)
HELLO = Hello("r1", "s", "boot", {"watch": REACH}, "", 0, 0, "1")


@pytest.fixture
def database(tmp_path: Path) -> Iterator[ServerDatabase]:
    found = ServerDatabase(tmp_path / "server.db")
    yield found
    found.close()


def status(seq: int, component: str, level: str = "ok", log_ns: int = 0) -> LinkRow:
    data = msgspec.json.encode({"component": component, "mode": "", "level": level, "seq": seq})
    return LinkRow("watch", 1, seq, channels.STATUS, log_ns, data)


def test_a_robot_that_connects_again_ends_its_older_connection(database: ServerDatabase) -> None:
    async def scene() -> None:
        link = LinkServer(database)
        first, second = FakeSocket(), FakeSocket()
        serving = [asyncio.create_task(link.serve(s, "r1")) for s in (first, second)]
        first.say(HELLO)
        old = await first.hear()
        second.say(HELLO)
        new = await second.hear()
        assert isinstance(old, Welcome) and isinstance(new, Welcome) and new.epoch > old.epoch
        await asyncio.wait_for(serving[0], PATIENCE_S)
        assert first.closed and list(link.robots) == ["r1"]
        second.say(RowsFrame(old.epoch, 1, [status(1, "a")], {}))
        assert isinstance(await second.hear(), Bye)
        await asyncio.wait_for(serving[1], PATIENCE_S)
        link.close()

    asyncio.run(scene())
    with database.reading() as connection:
        assert connection.execute(select(ROW)).all() == []


def test_a_first_key_is_no_other_key(database: ServerDatabase) -> None:
    """A store begins without a key; what comes first is none that takes another's place."""
    with database.begin() as connection:
        for key in ("", "first", "first", "", "second"):
            ledger.admit(connection, msgspec.structs.replace(HELLO, public_key=key), 0)
        found = connection.execute(select(EVENT.c.kind, EVENT.c.text)).all()
    assert [(kind, said.split()[-1]) for kind, said in found] == [("new_key", "second")]


def test_acknowledged_is_what_is_durable_on_the_robot(database: ServerDatabase) -> None:
    async def scene() -> None:
        link, socket = LinkServer(database), FakeSocket()
        task = asyncio.create_task(link.serve(socket, "r1"))
        socket.say(HELLO)
        await socket.hear()
        socket.say(
            RowsFrame(1, 1, [status(n, "a") for n in range(9)], {"watch": JournalPosition(1, 9)})
        )
        assert await socket.hear() == Ack(1, {"watch": JournalPosition(1, 5)})
        await socket.close()
        await task
        link.close()

    asyncio.run(scene())


def test_names_that_fit_in_no_frame_keep_no_robot_out(database: ServerDatabase) -> None:
    async def scene() -> None:
        link, socket = LinkServer(database), FakeSocket()
        await link.watch("r1", [f"{n:04}" + "\N{EURO SIGN}" * 500 for n in range(1000)])
        task = asyncio.create_task(link.serve(socket, "r1"))
        socket.say(HELLO)
        welcome = await socket.hear()
        assert isinstance(welcome, Welcome) and 100 < len(welcome.watch) < 200
        await socket.close()
        await task
        link.close()

    asyncio.run(scene())


def test_what_cannot_be_answered_ends_the_connection(
    database: ServerDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody would be heard on it any more, and the robot would look as if it were there."""

    async def scene() -> None:
        link, socket = LinkServer(database), FakeSocket()
        task = asyncio.create_task(link.serve(socket, "r1"))
        socket.say(HELLO)
        await socket.hear()
        monkeypatch.setattr(ServerEnd, "stored", lambda *_: 1 / 0)
        socket.say(RowsFrame(1, 1, [status(0, "a")], {}))
        await asyncio.wait_for(task, PATIENCE_S)
        assert socket.closed and not link.robots
        link.close()

    asyncio.run(scene())


@pytest.mark.parametrize(
    "place",
    [
        {"run": 2**64 - 1}, {"seq": 2**63}, {"log_ns": 2**64 - 1},
        {"run": 2**63 - 1}, {"seq": 2**63 - 1}, {"log_ns": -(2**63)},
    ],
)  # fmt: skip
def test_numbers_out_of_range_end_the_connection(
    database: ServerDatabase, place: dict[str, int]
) -> None:
    async def scene() -> None:
        link, socket = LinkServer(database), FakeSocket()
        task = asyncio.create_task(link.serve(socket, "r1"))
        socket.say(HELLO)
        await socket.hear()
        socket.say(RowsFrame(1, 1, [msgspec.structs.replace(status(0, "a"), **place)], {}))
        bye = await socket.hear()
        assert isinstance(bye, Bye) and "no frame: Expected `int`" in bye.reason
        await asyncio.wait_for(task, PATIENCE_S)
        link.close()

    asyncio.run(scene())


def test_one_that_takes_nothing_holds_up_nobody(database: ServerDatabase) -> None:
    class Stalled(FakeSocket):
        async def send(self, data: bytes) -> None:
            if self.down.qsize():
                await asyncio.Event().wait()
            await super().send(data)

    async def scene() -> None:
        link, socket = LinkServer(database, silent_s=0.3), Stalled()
        task = asyncio.create_task(link.serve(socket, "r1"))
        socket.say(HELLO)
        while not socket.down.qsize():
            await asyncio.sleep(0.01)
        assert not await asyncio.wait_for(link.send("r1", Bye("x")), PATIENCE_S)
        await asyncio.wait_for(task, PATIENCE_S)
        link.close()

    asyncio.run(scene())


def test_statements_that_are_none_and_statuses_without_an_end_are_not_kept(
    database: ServerDatabase,
) -> None:
    async def scene() -> None:
        link, socket = LinkServer(database), FakeSocket()
        task = asyncio.create_task(link.serve(socket, "r1"))
        socket.say(HELLO)
        await socket.hear()
        long = status(0, "a" * 70_000)
        socket.say(HeadsFrame(1, b"x" * 100_000), HeadsFrame(1, b"{}"), RowsFrame(1, 1, [long], {}))
        assert isinstance(await socket.hear(), Ack)
        await socket.close()
        await task
        link.close()

    asyncio.run(scene())
    with database.reading() as connection:
        assert list(connection.execute(select(HEADS.c.heads)).scalars()) == [b"{}"]
        assert current_statuses(connection, "r1") == []


def test_silence_is_noticed_and_the_robot_is_offline(database: ServerDatabase) -> None:
    async def scene() -> None:
        link, socket = LinkServer(database, silent_s=0.2), FakeSocket()
        task = asyncio.create_task(link.serve(socket, "r1"))
        socket.say(HELLO)
        await socket.hear()
        await asyncio.wait_for(task, PATIENCE_S)
        assert socket.closed and not link.robots
        link.close()

    asyncio.run(scene())
    with database.reading() as connection:
        [seen] = presences(connection)
    assert not seen.connected and seen.last_seen_ns > 0


def test_heartbeats_tell_backlog_and_clock_and_live_values_stay_in_memory(
    database: ServerDatabase,
) -> None:
    async def scene() -> None:
        heard: list[object] = []
        hooks = LinkHooks(live=lambda robot, values: heard.append((robot, values)))
        link, socket = LinkServer(database, hooks), FakeSocket()
        await link.watch("r1", ["odom.x"])
        task = asyncio.create_task(link.serve(socket, "r1"))
        socket.say(HELLO)
        welcome = await socket.hear()
        assert isinstance(welcome, Welcome) and welcome.watch == ["odom.x"]
        socket.say(LiveFrame(1, {"odom.x": (5, 1.5)}), BeatFrame(1, 7, 8, 12, 100, 10))
        answer = await socket.hear()
        assert isinstance(answer, Pong) and answer.mono_ns == 8
        assert heard == [("r1", {"odom.x": (5, 1.5)})]
        await link.watch("r1", [])
        assert await socket.hear() == WatchFrame([])
        await socket.close()
        await task
        link.close()

    asyncio.run(scene())
    with database.reading() as connection:
        assert presences(connection)[0].backlog == 12
        assert connection.execute(select(BOOT.c.boot_id, BOOT.c.offset_ns)).all() == [("boot", 100)]


@pytest.mark.parametrize(
    ("said", "delay_s", "known"),
    [
        ("overloaded", 12.5, WatcherHeartbeat("overloaded", 12.5)),
        ("running", float("nan"), WatcherHeartbeat("running", 0.0)),
        ("silent", -1.0, WatcherHeartbeat("silent", 0.0)),
        ("", 0.0, None),
        ("a word of a later version", 1.0, None),
    ],
)
def test_a_heartbeat_says_how_the_watcher_is_doing(
    database: ServerDatabase, said: str, delay_s: float, known: WatcherHeartbeat | None
) -> None:
    async def scene() -> None:
        link, socket = LinkServer(database), FakeSocket()
        task = asyncio.create_task(link.serve(socket, "r1"))
        socket.say(HELLO)
        await socket.hear()
        socket.say(BeatFrame(1, 7, 8, monitoring=said, delay_s=delay_s))
        await socket.hear()
        assert link.robots["r1"].monitoring == known
        await socket.close()
        await task
        link.close()

    asyncio.run(scene())


def test_what_is_late_is_said_to_be_so_on_the_server() -> None:
    status = RetainedStatus(StatusRecord("laser", level="error", measured_ns=1), 1, 1)
    seen = RobotPresence("r1", True, 1, 1, "s", "b", "", "1", 0, 0)
    when = ServerNow(26_000_000_000, None)
    late = WatcherHeartbeat("overloaded", 25.0)

    def said(contact: Contact, pulse: WatcherHeartbeat | None = None) -> str:
        monitoring = monitoring_of([status], when, pulse)
        return silence(contact, seen, monitoring, [status], when, pulse.delay_s if pulse else 0.0)

    assert said("online") == "its watcher has said nothing for 26 s"
    assert said("online", late) == "monitoring overloaded: the watcher is 25 s behind"
    assert said("offline", late) == "offline, last seen 26 s ago"


def test_the_board_goes_by_position_not_by_clock_or_arrival(database: ServerDatabase) -> None:
    with database.begin() as connection:
        ledger.admit(connection, HELLO, 1)
        late = [status(2, "a", "ok", log_ns=900), LinkRow("watch", 1, 4, channels.STATUS, 0, b"no")]
        for rows in ([status(5, "a", "error", log_ns=-5)], late, [status(3, "b", "warn")]):
            RowBatch("r1", 1, "s", rows, {}, {"watch": REACH}, 2)(connection)
        shown = {s["component"]: s["level"] for s in current_statuses(connection, "r1")}
    assert shown == {"a": "error", "b": "warn"}


def test_committed_rows_go_and_do_not_come_back(database: ServerDatabase) -> None:
    rows = [status(n, "a") for n in range(9)]
    with database.begin() as connection:
        ledger.admit(connection, HELLO, 1)
        RowBatch("r1", 1, "s", rows[:6], {}, {"watch": REACH}, 2)(connection)
        assert drop_committed(connection, "r1", "s", "watch", 1, 0, 3) == 3
        assert drop_committed(connection, "r1", "s", "watch", 1, 3, 8) == 3
        stored = RowBatch("r1", 1, "s", rows, {}, {"watch": REACH}, 2)(connection)
        assert [row.seq for row in stored.new] == [8]
        held = connection.execute(select(ROW.c.seq)).scalars().all()
    assert held == [8]


def test_work_that_fails_leaves_the_rest_of_its_group(database: ServerDatabase) -> None:
    writes = GroupedWrites(database)
    good = [
        writes.submit(lambda c, n=n: ledger.admit(c, HELLO, n).epoch)  # type: ignore[misc]  # n
        for n in range(3)
    ]
    bad = writes.submit(lambda c: c.execute(text("select * from nothing")))
    last = writes.submit(lambda c: ledger.admit(c, HELLO, 9).epoch)
    writes.close()
    assert [one.result() for one in good] == [1, 2, 3] and last.result() == 4
    assert bad.exception() is not None
    assert isinstance(writes.submit(lambda c: None).exception(), RuntimeError)
