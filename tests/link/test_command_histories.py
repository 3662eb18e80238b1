"""Random lives of a robot's gate and a server: every command once, every answer for good.

Frames lie in lists until they arrive, late ones of older connections too. The server is restarted
and restored from copies, its clock is set; the rows are those of a real database.
"""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from sqlalchemy import select, update

from amberbox.core.clock import NS
from amberbox.core.command import decode_command
from amberbox.link import limits
from amberbox.link.frames import (
    ActionsFrame,
    AnsweredFrame,
    AnswersFrame,
    ChallengeFrame,
    CommandsFrame,
    Hello,
    RevokedFrame,
    RobotFrame,
    ServerFrame,
    Welcome,
    encode,
    from_robot,
    from_server,
)
from amberbox.link.ledger import StaleEpochError
from amberbox.link.robot_end import RobotEnd
from amberbox.link.server_end import AdmitRobot, LinkAction, SendFrames, ServerEnd
from amberbox.server import commands, database
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest import ledger
from amberbox.server.schema import COMMAND, COMMAND_ANSWER
from tests.fuzzing import examples, fuzz
from tests.link.robot.simulated_gate import SimulatedGate
from tests.support.commands import command

HELLO = Hello("r1", "s", "boot", {}, "", 0, 0, "1", capabilities=[limits.COMMANDS])
LIFE_NS, START_NS = 600 * NS, 1_800_000_000 * NS


@dataclass
class Line:
    """One connection, with what is on its way."""

    robot: RobotEnd = field(default_factory=RobotEnd)
    server: ServerEnd = field(default_factory=lambda: ServerEnd("r1"))
    up: list[bytes] = field(default_factory=list)
    down: list[bytes] = field(default_factory=list)


class World:
    """A robot, a server, and the connection between them."""

    def __init__(self, folder: Path, chance: random.Random) -> None:
        self.chance = chance
        self.path, self.copy = folder / "server.db", folder / "copy.db"
        self.rows = ServerDatabase(self.path)
        self.gate = SimulatedGate()
        self.now_ns = START_NS
        self.line: Line | None = None
        self.late: list[Line] = []
        self.made: set[str] = set()
        self.sent_late: list[str] = []
        self.restored = False

    def steps(self) -> list[Callable[[], None]]:
        """Return what may happen next, each as often as it is likely."""
        usual = [self.create, self.report, self.deliver_up, self.deliver_down] * 2
        usual += [self.gate.finish, self.gate.mint]
        rare = [self.connect, self.drop, self.arrive_late, self.wait, self.step_clock]
        return [*usual, *usual, *rare, self.restart, self.take_copy, self.restore]

    def create(self) -> None:
        with self.rows.begin() as connection:
            one = command()
            commands.create(connection, self.now_ns, one, LIFE_NS)
        self.made.add(one.id)

    def connect(self) -> None:
        self.drop()
        line = self.line = Line()
        self._receive(line, HELLO)
        welcome = from_server(line.down.pop(0))
        assert isinstance(welcome, Welcome)
        line.robot.welcome(welcome, {}, self.gate.capabilities)
        self.gate.begin(welcome.server_id)

    def drop(self) -> None:
        """Lose the connection; what is on its way to the server may still arrive there."""
        if self.line is not None:
            self.gate.end()
            self.late.append(self.line)
            self.line = None

    def report(self) -> None:
        if self.line is not None and not self.gate._reports.empty():
            frames = self.line.robot.command_frames(self.gate._reports.get_nowait())
            self.line.up += map(encode, frames)

    def deliver_up(self) -> None:
        if self.line is not None and self.line.up:
            again = self.chance.random() < 0.1
            data = self.line.up[0] if again else self.line.up.pop(0)
            self._receive(self.line, from_robot(data))

    def arrive_late(self) -> None:
        if self.late:
            line = self.chance.choice(self.late)
            if line.up:
                self._receive(line, from_robot(line.up.pop(0)))

    def deliver_down(self) -> None:
        if self.line is None or not self.line.down:
            return
        again = self.chance.random() < 0.1
        frame = from_server(self.line.down[0] if again else self.line.down.pop(0))
        if isinstance(frame, CommandsFrame):
            self.gate.commands(frame.commands)
        elif isinstance(frame, AnsweredFrame):
            self.gate.answered(frame.number)
        elif isinstance(frame, RevokedFrame):
            self.gate.revoked(frame.keys)
        else:
            self.drop()

    def wait(self) -> None:
        self.now_ns += self.chance.choice([1, 11, 700]) * NS

    def step_clock(self) -> None:
        self.now_ns += self.chance.choice([-1, 1]) * 86_400 * NS

    def restart(self) -> None:
        """Kill the server: what was not stored is lost with its connections."""
        self.drop()
        self.late = []
        self.rows.close()
        self.rows = ServerDatabase(self.path)

    def take_copy(self) -> None:
        self.rows.close()
        shutil.copy(self.path, self.copy)
        self.rows = ServerDatabase(self.path)
        self.drop()

    def restore(self) -> None:
        """Restore the server from a copy: what it stored since is lost."""
        if not self.copy.exists():
            return
        self.drop()
        self.late = []
        self.restored = True
        self.rows.close()
        for file in self.path.parent.glob("server.db*"):
            file.unlink()
        shutil.copy(self.copy, self.path)
        self.rows = ServerDatabase(self.path)

    def _receive(self, line: Line, frame: RobotFrame) -> None:
        for action in line.server.receive(frame):
            try:
                with self.rows.begin() as connection:
                    line.down += map(encode, self._do(line, connection, action))
            except StaleEpochError:
                assert line is not self.line, "the present connection is the newest"
                line.server.closed = True
        if line.server.closed and line is self.line:
            self.drop()

    def _do(self, line: Line, connection: Any, action: LinkAction) -> Iterator[ServerFrame]:
        """Do what the server does, in the order of the link."""
        epoch = line.server.epoch or 0
        if isinstance(action, AdmitRobot):
            admission = ledger.admit(connection, action.hello, self.now_ns)
            yield line.server.admitted(admission, 0, wants_folder=False, watch=(), server_id="9f")
            begun = commands.begin_contact(connection, "r1", admission.epoch, "s")
            yield AnsweredFrame(begun.answered)
        elif isinstance(action, ChallengeFrame):
            found = commands.claim(connection, "r1", epoch, self.now_ns)
            sent = [decode_command(data) for data in found]
            self.sent_late += [one.id for one in sent if one.expires_ns <= self.now_ns]
            yield CommandsFrame(found)
        elif isinstance(action, AnswersFrame):
            stored = commands.store_answers(
                connection, "r1", epoch, "s", action.answers, self.now_ns
            )
            yield AnsweredFrame(stored.number)
        else:
            assert isinstance(action, ActionsFrame | SendFrames), action

    def settle(self) -> None:
        """Let everything arrive, without faults, until nothing is on its way."""
        self.chance = random.Random(1)
        self.chance.random = lambda: 1.0  # type: ignore[method-assign]  # nothing comes twice
        for _ in range(3):
            self.connect()
            assert self.line is not None
            for _ in range(10_000):
                self.gate.finish()
                self.report()
                self.deliver_up()
                self.deliver_down()
                assert self.line is not None, "a sound connection was ended"
                if not (self.line.up or self.line.down) and self.gate._reports.empty():
                    break
            else:
                raise AssertionError("it never came to rest")

    def judge(self) -> None:
        """Nothing twice, nothing late, no answer lost, and both agree on what became of each."""
        gate = self.gate
        assert len(gate.done) == len(set(gate.done)) and not gate.refused
        assert set(gate.done) <= self.made
        assert not self.sent_late
        assert not gate.unanswered()
        with self.rows.reading() as connection:
            every = commands.listed(connection, self.now_ns, limit=10_000)
            held = connection.execute(select(COMMAND_ANSWER.c.number)).scalars().all()
        for one in every:
            if one.state == "expired":  # never sent, or restored after its time
                assert one.id not in gate.done or self.restored
            elif one.state == "accepted":  # restored after its time: not asked again
                assert self.restored and one.expires_ns <= self.now_ns
            else:
                assert one.state == "done" and one.id in gate.done
        if not self.restored:
            assert {one.id for one in every} == self.made
            assert set(held) == set(range(1, len(gate.done) * 2 + 1)), "all answers are here"


def live(folder: Path, seed: int) -> World:
    chance = random.Random(seed)
    world = World(folder, chance)
    try:
        for _ in range(chance.randint(20, 150)):
            chance.choice(world.steps())()
        world.settle()
        world.judge()
    finally:
        world.rows.close()
    return world


_really = database._configure


def _configure(connection: Any, record: object) -> None:
    """Do not wait for the disk: no power is cut here."""
    _really(connection, record)
    connection.execute("PRAGMA synchronous=OFF").close()


@fuzz
def test_no_history_does_a_command_twice_or_loses_an_answer(tmp_path: Path) -> None:
    done = restored = 0
    with patch.object(database, "_configure", _configure):
        for seed in range(examples(40)):
            folder = tmp_path / str(seed)
            folder.mkdir()
            world = live(folder, seed)
            done += len(world.gate.done)
            restored += world.restored
            shutil.rmtree(folder)
    assert done > 100 and restored > 5, "the histories have something in them"


def forget_answers(connection: Any, robot: str, epoch: int, *more: Any) -> commands.StoredAnswers:
    return commands.StoredAnswers(max(one.number for one in more[1]))


def send_what_expired(connection: Any, robot: str, epoch: int, now_ns: int) -> list[bytes]:
    return _claim(connection, robot, epoch, now_ns - 10 * LIFE_NS)


def send_once(connection: Any, robot: str, epoch: int, now_ns: int) -> list[bytes]:
    connection.execute(
        update(COMMAND).where(COMMAND.c.sends > 0).values(epoch=epoch, sent_ns=now_ns)
    )
    return _claim(connection, robot, epoch, now_ns)


_claim = commands.claim


@pytest.mark.parametrize(
    ("name", "broken"),
    [
        ("store_answers", forget_answers), ("claim", send_what_expired), ("claim", send_once),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)  # fmt: skip
def test_the_histories_notice_a_server_that_is_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, broken: Callable[..., Any]
) -> None:
    monkeypatch.setattr(database, "_configure", _configure)
    monkeypatch.setattr(commands, name, broken)
    with pytest.raises(AssertionError):
        for seed in range(30):
            folder = tmp_path / str(seed)
            folder.mkdir()
            live(folder, seed)
