"""The robot's end of the link: what to send next, and how answers are processed.

No input or output, no clock. Rows wait in lanes: urgent (alarms, diagnoses, events), commands,
statuses, and the backlog written while there was no link. Commands have a lane of their own, so
that alarms never wait behind the reports of an action.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import msgspec

from amberbox.core.command import CommandAnswer
from amberbox.link import limits
from amberbox.link.command_port import ActionAnnouncement, GateReport, MintedChallenge
from amberbox.link.frames import (
    START,
    Ack,
    ActionsFrame,
    AnswersFrame,
    ChallengeFrame,
    JournalPosition,
    LinkRow,
    RobotCommandFrame,
    RowsFrame,
    Welcome,
    WriterReach,
)

Lane = Literal["urgent", "command", "status", "backlog"]
LANES: tuple[Lane, ...] = ("urgent", "command", "status", "backlog")
# Approximate overhead of a row in a frame, besides its data and channel
_OVERHEAD = 48


class OutOfStepError(Exception):
    """The server acknowledged frames that were never sent; the robot has to reconnect."""


@dataclass(slots=True)
class _Reading:
    """The reading position of a writer: its backlog, and its new rows."""

    backlog_at: JournalPosition
    join: JournalPosition
    fresh_at: JournalPosition

    @property
    def caught_up(self) -> bool:
        return self.backlog_at >= self.join


@dataclass(slots=True)
class RobotEnd:
    """The state of one connection; rows before ``cursor`` are never needed again."""

    epoch: int = 0
    cursor: dict[str, JournalPosition] = field(default_factory=dict)
    next_number: int = 1
    acked: int = 0
    next_answers: int = 1
    """The number of the next frame of answers to commands."""
    carries_commands: bool = False
    """Whether both ends have said that they carry commands."""
    writers: tuple[str, ...] = limits.FIRST_WRITERS
    """The writers whose rows and journals the server takes."""
    sent_upto: dict[str, JournalPosition] = field(default_factory=dict)
    _lanes: dict[Lane, deque[LinkRow]] = field(default_factory=lambda: {n: deque() for n in LANES})
    _reading: dict[str, _Reading] = field(default_factory=dict)

    def welcome(
        self,
        frame: Welcome,
        ends: Mapping[str, JournalPosition],
        capabilities: Collection[str] = (),
    ) -> None:
        """Begin: ``ends`` are the present ends of the writers' journals; later rows are new.

        ``capabilities`` are those that were said in Hello.
        """
        self.epoch, self.next_number, self.acked = frame.epoch, 1, 0
        self.next_answers = 1
        self.carries_commands = limits.COMMANDS in {*capabilities} & {*frame.capabilities}
        self.cursor = dict(frame.cursor)
        self.sent_upto = dict(self.cursor)
        for lane in self._lanes.values():
            lane.clear()
        is_later = limits.ACT_ROWS in frame.capabilities
        self.writers = limits.WRITERS if is_later else limits.FIRST_WRITERS
        self._reading = {}
        for writer in ends.keys() & set(self.writers):
            at = self.cursor.get(writer, START)
            join = max(ends[writer], at)
            self._reading[writer] = _Reading(at, join, join)

    def starts(self, writer: str) -> tuple[JournalPosition, JournalPosition]:
        """Return where the backlog of a writer begins, and where it ends and new rows begin."""
        reading = self._reading[writer]
        return reading.backlog_at, reading.join

    def offer_fresh(self, writer: str, rows: Sequence[LinkRow], read_to: JournalPosition) -> None:
        """Add new rows of a writer, which was read up to ``read_to``."""
        for row in rows:
            self._lanes[_lane_of(row.channel)].append(row)
        reading = self._reading[writer]
        reading.fresh_at = max(reading.fresh_at, read_to)

    def offer_backlog(self, writer: str, rows: Sequence[LinkRow], read_to: JournalPosition) -> None:
        """Add rows that were written before the connection."""
        reading = self._reading[writer]
        self._lanes["backlog"].extend(row for row in rows if row.place < reading.join)
        reading.backlog_at = max(reading.backlog_at, read_to)

    def waiting(self, lane: Lane) -> int:
        """Return the number of rows that wait in a lane."""
        return len(self._lanes[lane])

    def is_caught_up(self, writer: str) -> bool:
        """Return whether a writer's backlog was read completely."""
        return self._reading[writer].caught_up

    @property
    def window_open(self) -> bool:
        """Return whether another frame may be sent before the next acknowledgement."""
        return self.next_number - 1 - self.acked < limits.WINDOW

    def next_rows(
        self,
        allowed: Collection[Lane] = LANES,
        most_bytes: int = limits.ROWS_BYTES,
        *,
        bare: bool = True,
    ) -> RowsFrame | None:
        """Return the next frame to send, with the most urgent rows; None if there is nothing to
        send.

        A frame has at least one row, even if it exceeds ``most_bytes``; or none, with ``bare``, if
        only the sent positions are new.
        """
        if not self.window_open:
            return None
        rows = self._take(allowed, most_bytes)
        if not rows and not bare:
            return None
        waiting: dict[str, JournalPosition] = {}
        for lane in LANES:
            for writer in self._reading:
                first = next((r.place for r in self._lanes[lane] if r.writer == writer), None)
                if first is not None:
                    waiting[writer] = min(first, waiting.get(writer, first))
        upto = {
            writer: min(
                r.fresh_at if r.caught_up else r.backlog_at, waiting.get(writer, r.fresh_at)
            )
            for writer, r in self._reading.items()
        }
        news = {w: at for w, at in upto.items() if at > self.sent_upto.get(w, START)}
        if not rows and not news:
            return None
        self.sent_upto.update(news)
        frame = RowsFrame(self.epoch, self.next_number, rows, news)
        self.next_number += 1
        return frame

    def _take(self, allowed: Collection[Lane], most_bytes: int) -> list[LinkRow]:
        rows: list[LinkRow] = []
        size = 0
        for name in LANES:
            lane = self._lanes[name]
            while name in allowed and lane and len(rows) < limits.ROWS_COUNT:
                size += len(lane[0].data) + len(lane[0].channel) + _OVERHEAD
                if rows and size > most_bytes:
                    return rows
                rows.append(lane.popleft())
            if rows:
                return rows  # less urgent rows wait for a frame of their own
        return rows

    def acknowledged(self, frame: Ack) -> None:
        """Process an acknowledgement; raises OutOfStepError for frames that were never sent."""
        if frame.number >= self.next_number:
            raise OutOfStepError(f"frame {frame.number} was never sent")
        for writer, at in frame.cursor.items():
            if at > max(self.sent_upto.get(writer, START), self.cursor.get(writer, START)):
                place = f"Place(run={at.run}, seq={at.seq})"
                raise OutOfStepError(f"{writer} was never sent up to {place}")
        self.acked = max(self.acked, frame.number)
        for writer, at in frame.cursor.items():
            self.cursor[writer] = max(at, self.cursor.get(writer, START))

    def command_frames(self, report: GateReport) -> Iterator[RobotCommandFrame]:
        """Yield the frames that carry what the gate reports."""
        if isinstance(report, MintedChallenge):
            yield ChallengeFrame(
                self.epoch, report.challenge, report.lease, report.waiting, report.by_code,
                report.tries,
            )  # fmt: skip
        elif isinstance(report, ActionAnnouncement):
            yield ActionsFrame(self.epoch, report.actions)
        else:
            for answers in _fitting(report.answers):
                yield AnswersFrame(self.epoch, self.next_answers, answers)
                self.next_answers += 1

    def backlog(self, reaches: Mapping[str, WriterReach]) -> int:
        """Return the approximate number of positions between the acknowledged ones and the end."""
        return sum(_between(self.cursor.get(w, START), reach) for w, reach in reaches.items())


def _lane_of(channel: str) -> Lane:
    """Return the lane of new rows of a channel."""
    if channel in limits.URGENT:
        return "urgent"
    return "command" if channel in limits.COMMAND_CHANNELS else "status"


def _fitting(answers: Sequence[CommandAnswer]) -> Iterator[list[CommandAnswer]]:
    """Yield answers in portions that fit into a frame."""
    portion, size = list[CommandAnswer](), 0
    for answer in answers:
        more = len(msgspec.msgpack.encode(answer))
        if portion and (len(portion) == limits.ANSWERS_COUNT or size + more > limits.ROWS_BYTES):
            yield portion
            portion, size = [], 0
        portion.append(answer)
        size += more
    if portion:
        yield portion


def _between(at: JournalPosition, reach: WriterReach) -> int:
    """Return the number of positions from a place to the end, as far as runs are stated."""
    ends = {run.run: run.end_seq for run in reach.runs}
    ends[reach.end.run] = reach.end.seq
    return sum(
        end - (at.seq if run == at.run else 0)
        for run, end in ends.items()
        if run >= at.run and end > (at.seq if run == at.run else 0)
    )
