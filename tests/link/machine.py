"""A robot with a disk, both ends of the link and a server's ledger, driven at random.

Nothing here waits or touches a network: frames lie in lists until they are delivered, twice,
swapped, late, damaged, or not at all.
"""

from __future__ import annotations

import copy
import random
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from amberbox.blackbox.journal import channels
from amberbox.link import limits
from amberbox.link.frames import (
    START,
    Ack,
    DurableFrame,
    FrameError,
    Hello,
    JournalPosition,
    LinkRow,
    RobotFrame,
    RunEnd,
    ServerFrame,
    Welcome,
    WriterReach,
    encode,
    from_robot,
    from_server,
)
from amberbox.link.ledger import LinkAdmission, StaleEpochError, StoredRows
from amberbox.link.robot_end import LANES, OutOfStepError, RobotEnd
from amberbox.link.server_end import AdmitRobot, SendFrames, ServerEnd, StoreRows
from tests.link.memory_ledger import MemoryLedger

WRITERS = ("watch", "keep", "act")


class Ledger(Protocol):
    """What both ledgers can."""

    def admit(self, hello: Hello) -> LinkAdmission: ...

    def store(
        self,
        epoch: int,
        store_id: str,
        rows: Sequence[LinkRow],
        upto: Mapping[str, JournalPosition],
        reaches: Mapping[str, WriterReach],
        *,
        compare: bool = True,
    ) -> StoredRows: ...


@dataclass
class Run:
    """One run of a writer on the robot's disk; ``durable`` rows survive a power cut."""

    boot: str
    rows: list[LinkRow | None] = field(default_factory=list)
    """None stands for a row that is not sent over the link."""
    durable: int = 0


@dataclass
class Disk:
    """The contents of the robot's card; the counter of runs survives everything except an old
    image.
    """

    store_id: str
    runs: dict[str, dict[int, Run]] = field(default_factory=lambda: {w: {} for w in WRITERS})
    counter: int = 0

    def rows(self) -> dict[tuple[str, str, int, int], LinkRow]:
        """Return everything that is sent over the link, by position."""
        return {
            (self.store_id, writer, number, row.seq): row
            for writer, runs in self.runs.items()
            for number, run in runs.items()
            for row in run.rows
            if row is not None
        }


class Robot:
    """Writes rows, syncs some of them, dies in several ways."""

    def __init__(self, chance: random.Random) -> None:
        self.chance = chance
        self.disk = Disk(self._uuid())
        self.written = 0
        self.boot = ""
        self.live: dict[str, int] = {}
        self.start()

    def _uuid(self) -> str:
        return str(uuid.UUID(int=self.chance.getrandbits(128)))

    def start(self, *, new_boot: bool = True) -> None:
        """Begin a run of each writer."""
        if new_boot:
            self.boot = f"{self.chance.getrandbits(32):08x}"
        for writer in WRITERS:
            self.disk.counter += 1
            self.disk.runs[writer][self.disk.counter] = Run(self.boot)
            self.live[writer] = self.disk.counter

    def write(self, count: int) -> None:
        """Write rows that are not durable yet."""
        for _ in range(count):
            writer = self.chance.choice(WRITERS)
            run = self.disk.runs[writer][self.live[writer]]
            self.written += 1
            channel = self.chance.choice([channels.STATUS, channels.ALARM, channels.COMMAND, ""])
            data = b"%d of %s" % (self.written, self.boot.encode())
            place = self.live[writer], len(run.rows)
            run.rows.append(
                LinkRow(writer, *place, channel, self.written, data) if channel else None
            )

    def sync(self) -> None:
        """Make everything durable."""
        for runs in self.disk.runs.values():
            for run in runs.values():
                run.durable = len(run.rows)

    def kill(self) -> None:
        """End as after ``kill -9``: written data stay."""
        self.sync()
        self.start(new_boot=False)

    def cut_power(self) -> None:
        """Remove from each run some of its unsynced rows."""
        for runs in self.disk.runs.values():
            for run in runs.values():
                del run.rows[self.chance.randint(run.durable, len(run.rows)) :]
        self.sync()
        self.start()

    def new_card(self) -> None:
        """Begin with an empty store."""
        self.disk = Disk(self._uuid())
        self.start()

    def restore(self, image: Disk) -> None:
        """Begin with an old image of the card."""
        self.disk = copy.deepcopy(image)
        self.sync()
        self.start()

    def reaches(self) -> dict[str, WriterReach]:
        """State how far the journals reach."""
        return {writer: self._reach(writer) for writer in WRITERS}

    def _reach(self, writer: str) -> WriterReach:
        runs = self.disk.runs[writer]
        newest = runs[self.live[writer]]
        ends = tuple(
            RunEnd(number, run.boot, len(run.rows), number != self.live[writer])
            for number, run in sorted(runs.items())
        )
        end = JournalPosition(self.live[writer], len(newest.rows))
        return WriterReach(
            JournalPosition(min(runs), 0), end, JournalPosition(end.run, newest.durable), ends
        )

    def read(
        self, writer: str, start: JournalPosition, most: int
    ) -> tuple[list[LinkRow], JournalPosition]:
        """Read at most so many positions from a place on."""
        found: list[LinkRow] = []
        at = start
        for number, run in sorted(self.disk.runs[writer].items()):
            for seq in range(at.seq if number == at.run else 0, len(run.rows)):
                if number < at.run or most <= 0:
                    break
                row = run.rows[seq]
                found += [row] if row is not None else []
                at, most = JournalPosition(number, seq + 1), most - 1
        return found, at


@dataclass
class Connection:
    """Both ends and the frames in transit between them."""

    robot_end: RobotEnd
    server_end: ServerEnd
    up: list[bytes] = field(default_factory=list)
    down: list[bytes] = field(default_factory=list)
    fresh: dict[str, JournalPosition] = field(default_factory=dict)
    old: dict[str, JournalPosition] = field(default_factory=dict)
    open: bool = True


class World:
    """The robot, its server, and the network between them."""

    def __init__(
        self, chance: random.Random, others: Callable[[], Sequence[Ledger]] = tuple
    ) -> None:
        self.chance = chance
        self.robot = Robot(chance)
        self.ledger = MemoryLedger()
        self.others = list(others())
        self.connection: Connection | None = None
        self.late: list[Connection] = []
        self.received: dict[tuple[str, str, int, int, bytes], LinkRow] = {}
        self.acked: dict[str, dict[str, JournalPosition]] = {}

    def connect(self) -> None:
        """Connect again; frames of the connection before may still arrive."""
        self.drop()
        reaches = self.robot.reaches()
        one = Connection(RobotEnd(), ServerEnd("r1"))
        first = {w: reach for w, reach in reaches.items() if w in limits.FIRST_WRITERS}
        hello = Hello(
            "r1", self.robot.disk.store_id, self.robot.boot, first, "", 0, 0, "1",
            more={"act": reaches["act"]},
        )  # fmt: skip
        self._take(one, hello)
        answer = from_server(one.down.pop(0))
        assert isinstance(answer, Welcome)
        one.robot_end.welcome(answer, {w: reach.end for w, reach in reaches.items()})
        for writer in WRITERS:
            one.old[writer], one.fresh[writer] = one.robot_end.starts(writer)
        self.connection = one

    def drop(self) -> None:
        """Lose the connection; the server does not notice."""
        if self.connection is not None:
            self.late.append(self.connection)
            self.connection = None

    def read(self) -> None:
        """Read some rows of the journals into the lanes."""
        one = self.connection
        assert one is not None
        for writer in WRITERS:
            rows, one.fresh[writer] = self.robot.read(
                writer, one.fresh[writer], self.chance.randint(0, 8)
            )
            one.robot_end.offer_fresh(writer, rows, one.fresh[writer])
            if not one.robot_end.is_caught_up(writer):
                rows, at = self.robot.read(writer, one.old[writer], self.chance.randint(1, 8))
                join = one.robot_end.starts(writer)[1]
                one.old[writer] = at if rows or at > one.old[writer] else join
                one.robot_end.offer_backlog(writer, rows, min(one.old[writer], join))

    def send(self, *, durable: bool) -> None:
        """Put a frame on its way."""
        one = self.connection
        assert one is not None
        if durable:
            one.up.append(encode(DurableFrame(one.robot_end.epoch, self.robot.reaches())))
        else:
            frame = one.robot_end.next_rows(LANES, self.chance.choice([200, 5000]))
            if frame is not None:
                one.up.append(encode(frame))

    def deliver(self, one: Connection, at: int = 0) -> None:
        """Let a frame arrive at the server."""
        if one.up:
            self.arrive(one, one.up.pop(min(at, len(one.up) - 1)))

    def arrive(self, one: Connection, data: bytes) -> None:
        """Deliver any bytes to the server's end."""
        try:
            frame = from_robot(data)
        except FrameError:
            one.server_end.closed = True
        else:
            self._take(one, frame)
        if one.server_end.closed and one is self.connection:
            self.drop()

    def answer(self) -> None:
        """Let the server's answers arrive at the robot."""
        one = self.connection
        while one is not None and one.down:
            frame = from_server(one.down.pop(0))
            if isinstance(frame, Ack):
                try:
                    one.robot_end.acknowledged(frame)
                except OutOfStepError as error:
                    raise AssertionError(str(error)) from error
                self._note_acked(one)
            else:
                self.drop()
                return

    def _note_acked(self, one: Connection) -> None:
        """Check that acknowledged rows are durable on the robot."""
        acked = self.acked.setdefault(self.robot.disk.store_id, {})
        for writer, at in one.robot_end.cursor.items():
            reach = self.robot.reaches()[writer]
            assert at <= reach.durable
            acked[writer] = at

    def _take(self, one: Connection, frame: RobotFrame) -> None:
        for deed in one.server_end.receive(frame):
            if isinstance(deed, AdmitRobot):
                answers = [x.admit(deed.hello) for x in (self.ledger, *self.others)]
                assert all(answer == answers[0] for answer in answers)
                welcome = one.server_end.admitted(answers[0], 0, wants_folder=False, watch=())
                one.down.append(encode(welcome))
            elif isinstance(deed, StoreRows):
                one.down += map(encode, self._keep(one, deed))
            elif isinstance(deed, SendFrames):
                one.down += map(encode, deed.frames)

    def _keep(self, one: Connection, deed: StoreRows) -> Sequence[ServerFrame]:
        """Store rows in all ledgers; they have to agree."""
        outcomes: list[StoredRows | None] = []
        for ledger in (self.ledger, *self.others):
            try:
                outcomes.append(
                    ledger.store(deed.epoch, deed.store_id, deed.rows, deed.upto, deed.reaches,
                                 compare=deed.compare)
                )  # fmt: skip
            except StaleEpochError:
                outcomes.append(None)
        first = outcomes[0]
        assert all(_same(outcome, first) for outcome in outcomes)
        if first is None:
            return one.server_end.overtaken().frames
        for row in deed.rows:
            place = deed.store_id, row.writer, row.run, row.seq, row.data
            self.received[place] = row
        return [one.server_end.stored(deed.number, first)]

    def settle(self) -> None:
        """Let everything arrive, without faults: the server then holds what the robot holds."""
        self.robot.sync()
        self.connect()
        for _ in range(2000):
            self.read()
            self.send(durable=False)
            self.send(durable=True)
            while self.connection is not None and self.connection.up:
                self.deliver(self.connection)
            self.answer()
            assert self.connection is not None, "a sound connection was ended"
            cursor, reaches = self.connection.robot_end.cursor, self.robot.reaches()
            if all(cursor.get(w, START) == reach.durable for w, reach in reaches.items()):
                return
        raise AssertionError("it never caught up")

    def judge(self) -> None:
        """Compare the rows that the server holds with the robot's, and with all rows ever
        received.
        """
        store_id = self.robot.disk.store_id
        mine = {key: row for key, row in self.ledger.rows.items() if key[0] == store_id}
        assert mine == self.robot.disk.rows()
        kept = {(*key, row.data) for key, row in self.ledger.rows.items()}
        kept |= {(s, r.writer, r.run, r.seq, r.data) for s, r, _ in self.ledger.aside}
        assert kept == set(self.received)


def _same(one: StoredRows | None, other: StoredRows | None) -> bool:
    if one is None or other is None:
        return one is other
    same_rows = sorted(one.new, key=_place) == sorted(other.new, key=_place)
    same_rows &= set(one.contradicting) == set(other.contradicting)
    return one.cursor == other.cursor and same_rows and one.conflicts == other.conflicts


def _place(row: LinkRow) -> tuple[str, int, int]:
    return row.writer, row.run, row.seq
