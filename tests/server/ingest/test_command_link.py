"""Commands on a connection: the order on contact, two connections, restarts, hostile robots."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import pytest
from sqlalchemy import func, select

from amberbox.core.clock import NS
from amberbox.core.command import CommandAnswer, LeaseState, decode_command
from amberbox.link import limits
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
    Hello,
    JournalPosition,
    LeaseFrame,
    Pong,
    RevokedFrame,
    RowsFrame,
    RunEnd,
    ServerFrame,
    Welcome,
    WriterReach,
)
from amberbox.server import commands
from amberbox.server.bus import ServerChange
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.link_server import LinkHooks, LinkServer
from amberbox.server.schema import COMMAND, COMMAND_ROBOT, EVENT
from amberbox.testing.clock import PATIENCE_S, ManualClock, until
from tests.link.old_wire import encode as encode_anything
from tests.server.house import House, house
from tests.support.command_rows import command, created, found
from tests.support.sockets import FakeSocket, serving_one

HELLO = Hello("r1", "s", "boot", {}, "", 0, 0, "1", capabilities=[limits.COMMANDS])
KEY, OTHER_KEY = "0123456789abcdef", "fedcba9876543210"
NOBODY = LeaseState()


@pytest.fixture
def database(tmp_path: Path) -> Iterator[ServerDatabase]:
    made = ServerDatabase(tmp_path / "server.db")
    yield made
    made.close()


def challenge(epoch: int, number: int = 1, lease: LeaseState = NOBODY) -> ChallengeFrame:
    return ChallengeFrame(epoch, bytes([number] * 32), lease)


def done(command_id: str, number: int) -> CommandAnswer:
    return CommandAnswer(command_id, "done", number=number)


async def greeted(socket: FakeSocket, hello: Hello = HELLO) -> tuple[int, list[ServerFrame]]:
    """Say hello; return the epoch, and what is said before any challenge."""
    socket.say(hello)
    welcome = await socket.hear()
    assert isinstance(welcome, Welcome)
    socket.say(BeatFrame(welcome.epoch, 1, 2))
    heard = list[ServerFrame]()
    while not isinstance(frame := await socket.hear(), Pong):
        heard.append(frame)
    return welcome.epoch, heard


def ids(frame: ServerFrame) -> list[str]:
    assert isinstance(frame, CommandsFrame), frame
    return [decode_command(data).id for data in frame.commands]


def test_on_contact_revocations_then_answered_then_after_the_challenge_commands(
    database: ServerDatabase,
) -> None:
    [one, two] = created(database, count=2, revoked=KEY)

    async def scene() -> None:
        async with serving_one(database, "r1") as (_, socket):
            epoch, heard = await greeted(socket)
            assert heard == [RevokedFrame([KEY]), AnsweredFrame(0)], "and no commands yet"
            socket.say(challenge(epoch))
            assert ids(await socket.hear()) == [one.id, two.id]
            socket.say(AnswersFrame(epoch, 1, [done(one.id, 1), done(two.id, 2)]))
            assert await socket.hear() == AnsweredFrame(2)
        async with serving_one(database, "r1") as (_, socket):
            epoch, heard = await greeted(socket)
            assert heard == [RevokedFrame([KEY]), AnsweredFrame(2)]
            socket.say(challenge(epoch), BeatFrame(epoch, 1, 3))
            assert isinstance(await socket.hear(), Pong), "all are answered"

    asyncio.run(scene())
    assert {found(database, one.id).state, found(database, two.id).state} == {"done"}


def test_unanswered_commands_are_sent_again_on_the_next_contact(database: ServerDatabase) -> None:
    [one, two] = created(database, count=2)

    async def scene() -> None:
        for contact in range(3):
            async with serving_one(database, "r1") as (_, socket):
                epoch, _ = await greeted(socket)
                socket.say(challenge(epoch))
                assert ids(await socket.hear()) == [one.id, two.id], contact
        async with serving_one(database, "r1") as (_, socket):
            epoch, _ = await greeted(socket)
            socket.say(AnswersFrame(epoch, 1, [done(two.id, 1)]), challenge(epoch))
            assert await socket.hear() == AnsweredFrame(1)
            assert ids(await socket.hear()) == [one.id]

    asyncio.run(scene())
    assert found(database, one.id).sends == 4


def test_the_id_in_welcome_is_that_of_the_database(database: ServerDatabase) -> None:
    async def scene() -> list[str]:
        said = []
        for hello in (HELLO, msgspec.structs.replace(HELLO, capabilities=[])):
            async with serving_one(database, "r1") as (_, socket):
                socket.say(hello)
                welcome = await socket.hear()
                assert isinstance(welcome, Welcome)
                assert welcome.capabilities[:3] == [
                    limits.COMMANDS,
                    limits.ACT_ROWS,
                    limits.PICTURES,
                ]
                said.append(welcome.server_id)
        return said

    with database.begin() as connection:
        mine = commands.server_id(connection, 0)
    assert asyncio.run(scene()) == [mine, mine]


def test_what_is_made_while_the_robot_is_there_is_sent_at_once(database: ServerDatabase) -> None:
    async def scene() -> None:
        async with serving_one(database, "r1") as (link, socket):
            epoch, _ = await greeted(socket)
            [early] = await asyncio.to_thread(created, database)
            link.send_commands("r1")
            socket.say(BeatFrame(epoch, 1, 3))
            assert isinstance(await socket.hear(), Pong), "no challenge yet, so no commands"
            socket.say(challenge(epoch))
            assert ids(await socket.hear()) == [early.id]
            [late] = await asyncio.to_thread(created, database)
            link.send_commands("another")
            link.send_commands("r1")
            assert ids(await socket.hear()) == [late.id]
            await asyncio.to_thread(created, database, "r2", revoked=KEY)
            link.send_commands()
            assert await socket.hear() == RevokedFrame([KEY])
            await asyncio.to_thread(created, database, "r1", revoked=OTHER_KEY)
            link.send_commands()
            assert await socket.hear() == RevokedFrame([OTHER_KEY]), "before the commands"
            assert len(ids(await socket.hear())) == 1

    asyncio.run(scene())


def test_many_commands_come_in_frames_of_bounded_size(database: ServerDatabase) -> None:
    text = '{"a": "' + "x" * 30_000 + '"}'
    with database.begin() as connection:
        for _ in range(120):
            commands.create(connection, 1, command(parameters=text), commands.LONGEST_NS)

    async def scene() -> None:
        clock = ManualClock(wall=2)
        async with serving_one(database, "r1", clock=clock) as (_, socket):
            epoch, _ = await greeted(socket)
            heard: list[str] = []
            for number in range(2):
                socket.say(challenge(epoch, number), BeatFrame(epoch, 1, 5))
                while not isinstance(frame := await socket.hear(), Pong):
                    heard += ids(frame)
                assert len(heard) == (100, 120)[number]
            assert len(set(heard)) == 120

    asyncio.run(scene())


def test_an_old_image_of_the_disk_has_nothing_acknowledged_that_did_not_come(
    database: ServerDatabase,
) -> None:
    def hello(run: int) -> Hello:
        at = JournalPosition(run, 9)
        reach = WriterReach(JournalPosition(1, 0), at, at, (RunEnd(run, "b", 9),))
        return msgspec.structs.replace(HELLO, writers={"watch": reach})

    async def scene() -> None:
        for run, answered in ((3, 0), (3, 7), (1, 0)):
            async with serving_one(database, "r1") as (_, socket):
                epoch, heard = await greeted(socket, hello(run))
                assert heard == [AnsweredFrame(answered)]
                socket.say(RowsFrame(epoch, 1, [], {"watch": JournalPosition(run, 9)}))
                socket.say(AnswersFrame(epoch, 1, [done("ab" * 16, 7)]))
                assert isinstance(await socket.hear(), Ack)
                assert await socket.hear() == AnsweredFrame(7)

    asyncio.run(scene())


def test_of_two_connections_only_the_newer_one_sends_and_stores(database: ServerDatabase) -> None:
    [one] = created(database)

    async def scene() -> None:
        link = LinkServer(database)
        old, new = FakeSocket(), FakeSocket()
        serving = [asyncio.create_task(link.serve(old, "r1"))]
        old_epoch, _ = await greeted(old)
        old.say(challenge(old_epoch))
        assert ids(await old.hear()) == [one.id]
        # the same robot at another process of the server, over the same database
        elsewhere = LinkServer(database)
        serving.append(asyncio.create_task(elsewhere.serve(new, "r1")))
        epoch, _ = await greeted(new)
        old.say(AnswersFrame(old_epoch, 1, [done(one.id, 1)]))
        bye = await old.hear()
        assert isinstance(bye, Bye) and "connected again" in bye.reason
        assert found(database, one.id).answers == []
        new.say(challenge(epoch, 2))
        assert ids(await new.hear()) == [one.id]
        link.send_commands("r1")
        new.say(AnswersFrame(epoch, 1, [done(one.id, 1)]))
        assert await new.hear() == AnsweredFrame(1)
        for socket in (old, new):
            await socket.close()
        await asyncio.wait_for(asyncio.gather(*serving), PATIENCE_S)
        link.close()
        elsewhere.close()

    asyncio.run(scene())
    assert found(database, one.id).state == "done"


def test_challenges_are_of_the_present_connection_and_the_last_minute(
    database: ServerDatabase,
) -> None:
    async def scene() -> None:
        clock = ManualClock()
        async with serving_one(database, "r1", clock=clock) as (link, socket):
            epoch, _ = await greeted(socket)
            assert link.challenges("r1") == link.challenges("r2") == []
            for number in range(30):
                clock.advance(10)
                socket.say(challenge(epoch, number), BeatFrame(epoch, 1, number))
                await socket.hear()
            assert link.challenges("r1") == [bytes([n] * 32) for n in range(23, 30)]
            clock.step(-3600)
            assert len(link.challenges("r1")) == 7, "wall clocks count for nothing"
            clock.advance(55)
            assert link.challenges("r1") == [bytes([29] * 32)]
            clock.advance(6)
            assert link.challenges("r1") == []
            for number in range(200):
                socket.say(challenge(epoch, number))
            socket.say(BeatFrame(epoch, 1, 999))
            while not isinstance(frame := await socket.hear(), Pong) or frame.mono_ns != 999:
                pass
            assert len(link.challenges("r1")) == 16, "a hostile robot fills no memory"
            await socket.close()
            await until(lambda: not link.robots)
            assert link.challenges("r1") == []

    asyncio.run(scene())


def test_lease_and_actions_are_recorded_as_the_robot_says(database: ServerDatabase) -> None:
    lease = LeaseState(4, "other server", "run-9")

    async def scene() -> None:
        async with serving_one(database, "r1") as (link, socket):
            epoch, _ = await greeted(socket)
            assert not await link.order("r1", LeaseFrame("take", "h", "r"))
            socket.say(challenge(epoch, 1, lease), ActionsFrame(epoch, b'["dock"]'))
            socket.say(BeatFrame(epoch, 1, 3))
            assert isinstance(await socket.hear(), Pong)
            take = LeaseFrame("take", "h", "r")
            assert await link.order("r1", take) and await socket.hear() == take
            assert await link.order("r1", AbortFrame("r")) and await socket.hear() == AbortFrame(
                "r"
            )
            assert not await link.order("r2", AbortFrame("r"))

    asyncio.run(scene())
    with database.reading() as connection:
        said = commands.commanded(connection, "r1")
    assert said is not None and (said.lease, said.actions) == (lease, '["dock"]')
    assert said.lease_ns and said.actions_ns


def test_a_server_that_is_killed_loses_no_answer_and_sends_nothing_answered(
    database: ServerDatabase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after the answers were stored, before it said so; then started on the same file."""
    [one, two] = created(database, count=2)

    async def before() -> None:
        async with serving_one(database, "r1") as (_, socket):
            epoch, _ = await greeted(socket)
            socket.say(challenge(epoch))
            assert ids(await socket.hear()) == [one.id, two.id]
            monkeypatch.setattr(
                "amberbox.server.ingest.command_link.AnsweredFrame", lambda _: 1 / 0
            )
            socket.say(AnswersFrame(epoch, 1, [done(one.id, 1)]))
            await until(lambda: socket.closed)
        monkeypatch.undo()

    async def after(again: ServerDatabase) -> None:
        async with serving_one(again, "r1") as (_, socket):
            epoch, heard = await greeted(socket)
            assert heard == [AnsweredFrame(1)]
            socket.say(AnswersFrame(epoch, 1, [done(one.id, 1)]), challenge(epoch))
            assert await socket.hear() == AnsweredFrame(1), "repeated, and stored once"
            assert ids(await socket.hear()) == [two.id]

    asyncio.run(before())
    database.close()
    again = ServerDatabase(tmp_path / "server.db")
    asyncio.run(after(again))
    assert [a.number for a in found(again, one.id).answers] == [1]
    again.close()


def test_a_repeated_frame_of_answers_is_stored_once_and_a_missing_one_ends_it(
    database: ServerDatabase,
) -> None:
    [one] = created(database)
    changed: list[tuple[str, Sequence[str]]] = []

    async def scene() -> None:
        hooks = LinkHooks(commands=lambda robot, these: changed.append((robot, these)))
        async with serving_one(database, "r1", hooks=hooks) as (_, socket):
            epoch, _ = await greeted(socket)
            answers = AnswersFrame(epoch, 1, [CommandAnswer(one.id, "accepted", number=1)])
            socket.say(answers, answers, AnswersFrame(epoch, 3, [done(one.id, 3)]))
            assert await socket.hear() == AnsweredFrame(1)
            bye = await socket.hear()
            assert isinstance(bye, Bye) and "frame 2 of answers is missing" in bye.reason

    asyncio.run(scene())
    assert changed == [("r1", (one.id,))]
    assert found(database, one.id).state == "accepted"


def test_answers_to_commands_that_nobody_gave_are_acknowledged_and_noticed_once(
    database: ServerDatabase,
) -> None:
    async def scene() -> None:
        for _ in range(2):
            async with serving_one(database, "r1") as (_, socket):
                epoch, _ = await greeted(socket)
                socket.say(AnswersFrame(epoch, 1, [done("ab" * 16, 7)]))
                assert await socket.hear() == AnsweredFrame(7)

    asyncio.run(scene())
    with database.reading() as connection:
        events = connection.execute(select(EVENT.c.kind, EVENT.c.text)).all()
    assert [kind for kind, _ in events] == ["unknown_command"] and "ab" * 16 in events[0][1]


def test_unknown_frames_are_ignored_and_counted_and_bad_ones_end_the_link(
    database: ServerDatabase,
) -> None:
    class Later(msgspec.Struct, tag="later"):
        epoch: int = 1

    later = encode_anything(Later())  # type: ignore[arg-type]  # of no version yet

    async def scene() -> None:
        async with serving_one(database, "r1") as (link, socket):
            epoch, _ = await greeted(socket)
            for _ in range(3):
                socket.up.put_nowait(later)
            socket.say(BeatFrame(epoch, 1, 3))
            assert isinstance(await socket.hear(), Pong) and link.unknown_frames == 3
            socket.up.put_nowait(later[:-1])
            bye = await socket.hear()
            assert isinstance(bye, Bye) and "no frame" in bye.reason
        async with serving_one(database, "r1") as (link, socket):
            socket.up.put_nowait(later)
            bye = await socket.hear()
            assert isinstance(bye, Bye) and "hello first" in bye.reason
            assert link.unknown_frames == 0

    asyncio.run(scene())


def test_without_the_capability_frames_of_commands_do_nothing(database: ServerDatabase) -> None:
    [one] = created(database)

    async def scene() -> None:
        async with serving_one(database, "r1") as (link, socket):
            epoch, heard = await greeted(socket, msgspec.structs.replace(HELLO, capabilities=[]))
            assert heard == []
            socket.say(challenge(epoch), AnswersFrame(epoch, 1, [done(one.id, 1)]))
            socket.say(ActionsFrame(epoch, b"[]"), BeatFrame(epoch, 1, 3))
            assert isinstance(await socket.hear(), Pong)
            assert link.unknown_frames == 3 and link.challenges("r1") == []

    asyncio.run(scene())
    with database.reading() as connection:
        assert connection.scalar(select(func.count()).select_from(COMMAND_ROBOT)) == 0
    assert found(database, one.id) == one


@pytest.mark.parametrize(
    "frame",
    [
        ActionsFrame(1, b"no json"),
        AnswersFrame(1, 1, [done("ab" * 16, 2), done("cd" * 16, 1)]),
        ChallengeFrame(2, bytes(32)),
    ],
    ids=lambda frame: type(frame).__name__,
)
def test_frames_that_contradict_themselves_end_the_link(
    database: ServerDatabase, frame: ActionsFrame | AnswersFrame | ChallengeFrame
) -> None:
    async def scene() -> None:
        async with serving_one(database, "r1") as (_, socket):
            await greeted(socket)
            socket.say(frame)
            assert isinstance(await socket.hear(), Bye)

    asyncio.run(scene())
    with database.reading() as connection:
        said = commands.commanded(connection, "r1")
    assert said is not None and (said.actions, said.lease) == ("", NOBODY)


def test_one_that_takes_nothing_holds_up_no_sender(database: ServerDatabase) -> None:
    """More waits for it than its queue holds: the rest is sent after its next challenge."""

    class Stalled(FakeSocket):
        async def send(self, data: bytes) -> None:
            await gate.wait()
            await super().send(data)

    gate = asyncio.Event()

    async def scene() -> None:
        link, socket = LinkServer(database, silent_s=PATIENCE_S), Stalled()
        task = asyncio.create_task(link.serve(socket, "r1"))
        socket.say(HELLO)
        await until(lambda: "r1" in link.robots)
        socket.say(challenge(1))
        await until(lambda: bool(link.challenges("r1")))
        for _ in range(200):
            link.send_commands("r1")
        assert link.robots["r1"].answers.full()
        [one] = await asyncio.to_thread(created, database)
        link.send_commands("r1")
        gate.set()
        assert isinstance(await socket.hear(), Welcome)
        assert await socket.hear() == AnsweredFrame(0)
        await until(link.robots["r1"].answers.empty)
        socket.say(challenge(1, 2))
        assert ids(await socket.hear()) == [one.id]
        await socket.close()
        await task
        link.close()

    asyncio.run(scene())


def test_expired_commands_are_given_up_when_the_robot_comes(database: ServerDatabase) -> None:
    clock = ManualClock()
    with database.begin() as connection:
        one = commands.create(connection, clock.wall_ns(), command(), 60 * NS)
    clock.advance(61)

    async def scene() -> None:
        async with serving_one(database, "r1", clock=clock) as (_, socket):
            epoch, _ = await greeted(socket)
            socket.say(challenge(epoch), BeatFrame(epoch, 1, 3))
            assert isinstance(await socket.hear(), Pong)

    asyncio.run(scene())
    with database.reading() as connection:
        state = connection.scalar(select(COMMAND.c.state).where(COMMAND.c.id == one.id))
    assert state == "expired"


def test_the_server_sends_what_was_made_and_tells_what_was_answered(tmp_path: Path) -> None:
    heard: list[ServerChange] = []

    async def scene(home: House) -> None:
        services, socket = home.services, FakeSocket()
        services.bus.attach(asyncio.get_running_loop())
        services.bus.on("answered", heard.append)
        task = asyncio.create_task(services.links.serve(socket, "ropod_001"))
        epoch, _ = await greeted(socket, msgspec.structs.replace(HELLO, robot="ropod_001"))
        socket.say(challenge(epoch), BeatFrame(epoch, 1, 3))
        assert isinstance(await socket.hear(), Pong)

        def make() -> str:
            with services.database.begin() as connection:
                now_ns = services.clock.wall_ns()
                one = commands.create(connection, now_ns, command("ropod_001"), 60 * NS)
            services.bus.publish(ServerChange("command", "ropod_001", {"id": one.id}))
            return one.id

        made = await asyncio.to_thread(make)
        assert ids(await socket.hear()) == [made]
        socket.say(AnswersFrame(epoch, 1, [done(made, 1)]))
        assert await socket.hear() == AnsweredFrame(1)
        assert heard == [ServerChange("answered", "ropod_001", {"ids": (made,)})]
        await socket.close()
        await task

    with house(tmp_path / "server") as home:
        asyncio.run(scene(home))
