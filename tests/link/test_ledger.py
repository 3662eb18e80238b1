"""Frames twice, out of order, late, damaged; power cuts and old images: nothing lost or doubled."""

from __future__ import annotations

import copy
import random
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from amberbox.link.frames import Hello, JournalPosition, LinkRow, WriterReach
from amberbox.link.ledger import LinkAdmission, StoredRows
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest import ledger as sql
from tests.link.machine import Connection, Disk, Ledger, World


class DatabaseLedger:
    """The server's database behind the same words."""

    def __init__(self, database: ServerDatabase) -> None:
        self.database = database

    def admit(self, hello: Hello) -> LinkAdmission:
        with self.database.begin() as connection:
            return sql.admit(connection, hello, 0)

    def store(
        self,
        epoch: int,
        store_id: str,
        rows: Sequence[LinkRow],
        upto: Mapping[str, JournalPosition],
        reaches: Mapping[str, WriterReach],
        *,
        compare: bool = True,
    ) -> StoredRows:
        with self.database.begin() as connection:
            batch = sql.RowBatch("r1", epoch, store_id, rows, upto, reaches, 0, compare)
            return batch(connection)


class LinkMachine(RuleBasedStateMachine):
    """All events that can happen to a robot, a server and the frames between them."""

    with_database: ClassVar[bool] = False

    def __init__(self) -> None:
        super().__init__()
        self.world: World
        self.image: Disk | None = None
        self.folder = Path(tempfile.mkdtemp()) if self.with_database else None
        self.database = None if self.folder is None else ServerDatabase(self.folder / "server.db")

    def _others(self) -> list[Ledger]:
        return [] if self.database is None else [DatabaseLedger(self.database)]

    @initialize(seed=st.integers(0, 1 << 32))
    def begin(self, seed: int) -> None:
        self.world = World(random.Random(seed), self._others)

    @property
    def line(self) -> Connection:
        assert self.world.connection is not None
        return self.world.connection

    @rule(count=st.integers(1, 12))
    def write(self, count: int) -> None:
        self.world.robot.write(count)

    @rule()
    def sync(self) -> None:
        self.world.robot.sync()

    @rule()
    def connect(self) -> None:
        self.world.connect()

    @precondition(lambda self: self.world.connection is not None)
    @rule(durable=st.booleans(), reads=st.integers(0, 3))
    def say(self, durable: bool, reads: int) -> None:
        for _ in range(reads):
            self.world.read()
        self.world.send(durable=durable)

    @precondition(lambda self: self.world.connection is not None)
    @rule(count=st.integers(1, 5))
    def deliver(self, count: int) -> None:
        for _ in range(count):
            if self.world.connection is not None:
                self.world.deliver(self.line)

    @precondition(lambda self: self.world.connection is not None)
    @rule()
    def answer(self) -> None:
        self.world.answer()

    @precondition(lambda self: self.world.connection is not None and self.line.up)
    @rule()
    def send_twice(self) -> None:
        self.line.up.insert(0, self.line.up[0])

    @precondition(lambda self: self.world.connection is not None and len(self.line.up) > 1)
    @rule()
    def swap(self) -> None:
        self.line.up[0], self.line.up[1] = self.line.up[1], self.line.up[0]

    @precondition(lambda self: self.world.connection is not None and self.line.up)
    @rule(at=st.integers(0, 1 << 16), bit=st.integers(0, 7))
    def damage(self, at: int, bit: int) -> None:
        data = bytearray(self.line.up[0])
        data[at % len(data)] ^= 1 << bit
        self.line.up[0] = bytes(data)

    @precondition(lambda self: self.world.connection is not None)
    @rule()
    def drop(self) -> None:
        self.world.drop()

    @precondition(lambda self: any(one.up for one in self.world.late))
    @rule()
    def arrive_late(self) -> None:
        one = next(one for one in self.world.late if one.up)
        self.world.deliver(one)

    @rule(rounds=st.integers(1, 4), counts=st.integers(0, 8), durable=st.booleans())
    def talk(self, rounds: int, counts: int, durable: bool) -> None:
        """Let time pass without faults; new rows stay provisional for a while."""
        if self.world.connection is None:
            self.world.connect()
        for _ in range(rounds):
            self.world.robot.write(counts)
            self.world.read()
            self.world.send(durable=False)
            self.world.send(durable=durable)
            while self.world.connection is not None and self.line.up:
                self.world.deliver(self.line)
            self.world.answer()
            if self.world.connection is None:
                return

    @precondition(lambda self: self.world.connection is not None)
    @rule()
    def kill_recorder(self) -> None:
        """Restart the recorder; the link continues."""
        self.world.robot.kill()

    @rule()
    def take_image(self) -> None:
        self.image = copy.deepcopy(self.world.robot.disk)

    @rule(kind=st.sampled_from(["kill", "cut", "cut", "restore", "card"]))
    def disaster(self, kind: str) -> None:
        """Kill the robot, cut its power, restore an old image of its card, or put in a new one."""
        self.world.drop()
        if kind == "cut":
            self.world.robot.cut_power()
        elif kind == "restore" and self.image is not None:
            self.world.robot.restore(self.image)
        elif kind == "card":
            self.world.robot.new_card()
        else:
            self.world.robot.kill()

    def teardown(self) -> None:
        try:
            if hasattr(self, "world"):
                self.world.settle()
                self.world.judge()
        finally:
            if self.database is not None and self.folder is not None:
                self.database.close()
                shutil.rmtree(self.folder)


class ComparedMachine(LinkMachine):
    """The same, with the server's database beside the ledger in memory."""

    with_database = True


TestLink = LinkMachine.TestCase
TestLink.settings = settings(max_examples=50, stateful_step_count=25)
TestDatabase = ComparedMachine.TestCase
TestDatabase.settings = settings(max_examples=10, stateful_step_count=20)
