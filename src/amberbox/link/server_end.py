"""The server's end of one connection: which frames a robot may send when, and the resulting
actions.

No input or output, no clock: frames go in, actions come out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import msgspec

from amberbox.link import limits
from amberbox.link.frames import (
    Ack,
    ActionsFrame,
    AnswersFrame,
    BeatFrame,
    Bye,
    ChallengeFrame,
    DurableFrame,
    HasFrame,
    HeadsFrame,
    Hello,
    JournalPosition,
    LinkRow,
    LiveFrame,
    Pong,
    RobotCommandFrame,
    RobotFrame,
    RowsFrame,
    ServerFrame,
    Welcome,
    WriterReach,
    is_in_range,
)
from amberbox.link.ledger import LinkAdmission, StoredRows


@dataclass(frozen=True, slots=True)
class AdmitRobot:
    """Begin a new epoch for this robot, then call ``admitted``."""

    hello: Hello


@dataclass(frozen=True, slots=True)
class StoreRows:
    """Store rows and the reach of the journals, then call ``stored``."""

    epoch: int
    store_id: str
    number: int
    rows: Sequence[LinkRow]
    upto: dict[str, JournalPosition]
    reaches: dict[str, WriterReach]
    compare: bool = False
    """Whether how far the robot reaches is news."""


@dataclass(frozen=True, slots=True)
class SendFrames:
    """Send frames; with ``ends`` close the connection after them."""

    frames: tuple[ServerFrame, ...] = ()
    ends: bool = False


@dataclass(frozen=True, slots=True)
class IgnoreFrame:
    """Count a frame with an unknown tag, or of a capability that was not said."""


ForwardedFrame: TypeAlias = LiveFrame | BeatFrame | HeadsFrame | HasFrame | RobotCommandFrame
LinkAction: TypeAlias = AdmitRobot | StoreRows | SendFrames | IgnoreFrame | ForwardedFrame


@dataclass(slots=True)
class ServerEnd:
    """One connection of one robot, which was authenticated as ``robot``."""

    robot: str
    epoch: int | None = None
    hello: Hello | None = None
    closed: bool = False
    next_number: int = 1
    next_answers: int = 1
    """The number of the next frame of answers to commands."""
    reaches: dict[str, WriterReach] = field(default_factory=dict)

    @property
    def takes_commands(self) -> bool:
        """Return whether both ends carry commands."""
        return self.hello is not None and limits.COMMANDS in self.hello.capabilities

    def receive(self, frame: RobotFrame) -> list[LinkAction]:
        """Process a frame; return the actions, in order."""
        if self.closed:
            return []
        if isinstance(frame, Hello):
            return self._hello(frame)
        if isinstance(frame, Bye):
            return self._end(frame.reason)
        if self.epoch is None:
            return self._end("say hello first")
        if frame.epoch != self.epoch:
            return self._end(f"epoch {frame.epoch} is over, this is {self.epoch}")
        if isinstance(frame, RowsFrame):
            return self._rows(frame)
        if isinstance(frame, DurableFrame):
            return self._durable(frame)
        if isinstance(frame, ChallengeFrame | ActionsFrame | AnswersFrame):
            return self._command_frame(frame)
        return [frame]

    def receive_unknown(self) -> list[LinkAction]:
        """Process a frame with an unknown tag; return the actions."""
        if self.closed:
            return []
        return self._end("say hello first") if self.epoch is None else [IgnoreFrame()]

    def admitted(
        self,
        admission: LinkAdmission,
        wall_ns: int,
        *,
        wants_folder: bool,
        watch: Sequence[str],
        server_id: str = "",
    ) -> Welcome:
        """Begin the epoch; return the answer to Hello."""
        assert self.hello is not None
        self.epoch = admission.epoch
        self.reaches = dict(self.hello.writers)
        return Welcome(
            admission.epoch, admission.cursor, wall_ns, wants_folder, list(watch),
            [limits.COMMANDS, limits.ACT_ROWS, limits.PICTURES, limits.DETECT_JOURNALS], server_id,
        )  # fmt: skip

    def stored(self, number: int, stored: StoredRows) -> Ack:
        """Return the acknowledgement for rows that are durable."""
        return Ack(number, stored.cursor)

    def overtaken(self) -> SendFrames:
        """Close, because the robot has connected again."""
        self.closed = True
        return SendFrames((Bye("this robot has connected again"),), ends=True)

    def pong(self, beat: BeatFrame, wall_ns: int) -> Pong:
        """Return the answer to a heartbeat."""
        return Pong(wall_ns, beat.mono_ns)

    def _hello(self, hello: Hello) -> list[LinkAction]:
        if self.hello is not None:
            return self._end("hello was said already")
        if hello.protocol != limits.PROTOCOL:
            text = f"protocol {hello.protocol} is not spoken here, but {limits.PROTOCOL}"
            return self._end(text, for_good=True)
        if hello.robot != self.robot:
            return self._end(f"the key is not that of {hello.robot}", for_good=True)
        more = {w: reach for w, reach in hello.more.items() if w in limits.LATER_WRITERS}
        hello = msgspec.structs.replace(hello, writers={**hello.writers, **more}, more={})
        wrong = _wrong(hello.writers)
        if wrong:
            return self._end(wrong)
        self.hello = hello
        return [AdmitRobot(hello)]

    def _rows(self, frame: RowsFrame) -> list[LinkAction]:
        if frame.number < self.next_number:
            return []  # a repeated frame: already processed
        if frame.number > self.next_number:
            return self._end(f"frame {self.next_number} is missing")
        for row in frame.rows:
            known = row.writer in self.reaches and row.channel in limits.CHANNELS
            if not is_in_range(row.run, row.seq, row.log_ns):
                return self._end("a row has numbers that are out of range")
            if not known:
                return self._end(f"no rows of {row.writer}/{row.channel} are taken")
        if not set(frame.upto) <= set(self.reaches) or any(
            min(at) < 0 or not is_in_range(*at) for at in frame.upto.values()
        ):
            return self._end("it reaches where nothing is")
        self.next_number += 1
        return [self._keep(frame.number, frame.rows, dict(frame.upto))]

    def _durable(self, frame: DurableFrame) -> list[LinkAction]:
        wrong = _wrong(frame.writers)
        if wrong:
            return self._end(wrong)
        for writer, reach in frame.writers.items():
            known = self.reaches.get(writer)
            if known is None or reach.end >= known.end:  # else it is late
                self.reaches[writer] = reach
        return [self._keep(self.next_number - 1, (), {}, compare=True)]

    def _command_frame(self, frame: RobotCommandFrame) -> list[LinkAction]:
        if not self.takes_commands:
            return [IgnoreFrame()]
        if isinstance(frame, ActionsFrame) and not _is_json(frame.announcement):
            return self._end("what it can do is no JSON")
        if isinstance(frame, AnswersFrame):
            if frame.number < self.next_answers:
                return []  # a repeated frame: already processed
            if frame.number > self.next_answers:
                return self._end(f"frame {self.next_answers} of answers is missing")
            numbers = [one.number for one in frame.answers if one.number]
            if numbers != sorted(set(numbers)):
                return self._end("answers out of order")
            self.next_answers += 1
        return [frame]

    def _keep(
        self,
        number: int,
        rows: Sequence[LinkRow],
        upto: dict[str, JournalPosition],
        *,
        compare: bool = False,
    ) -> StoreRows:
        assert self.hello is not None and self.epoch is not None
        store_id, reaches = self.hello.store_id, dict(self.reaches)
        return StoreRows(self.epoch, store_id, number, rows, upto, reaches, compare)

    def _end(self, reason: str, *, for_good: bool = False) -> list[LinkAction]:
        self.closed = True
        return [SendFrames((Bye(reason[: limits.TEXT_BYTES], for_good),), ends=True)]


def _is_json(data: bytes) -> bool:
    try:
        msgspec.json.decode(data)
    except (msgspec.DecodeError, ValueError, RecursionError):
        return False
    return True


def _wrong(writers: dict[str, WriterReach]) -> str:
    unknown = set(writers) - set(limits.WRITERS)
    if unknown:
        return f"no rows of {min(unknown)} are taken"
    wrong = next((p for p in (reach.problem() for reach in writers.values()) if p), "")
    return f"what it holds cannot be: {wrong}" if wrong else ""
