"""The robot's end of the link: what is sent next, and what an answer means.

No input or output, no clock. Rows wait in three lanes: what is urgent (alarms, diagnoses, events),
statuses, and the backlog of what was written while there was no link.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from amberbox.link import limits
from amberbox.link.frames import Ack, Row, Rows, Welcome
from amberbox.link.positions import START, Place, Reach

Lane = Literal["urgent", "status", "backlog"]
LANES: tuple[Lane, ...] = ("urgent", "status", "backlog")
_OVERHEAD = 48
"""About what a row takes in a frame besides its data and channel."""


class OutOfStepError(Exception):
    """The server said what it cannot have meant: the link is made anew."""


@dataclass(slots=True)
class _Reading:
    """How far a writer has been read: what was written before the link, and what is new."""

    backlog_at: Place
    join: Place
    fresh_at: Place

    @property
    def caught_up(self) -> bool:
        return self.backlog_at >= self.join


@dataclass(slots=True)
class RobotEnd:
    """One connection. ``cursor`` is what the server needs never be sent again."""

    epoch: int = 0
    cursor: dict[str, Place] = field(default_factory=dict)
    next_number: int = 1
    acked: int = 0
    said: dict[str, Place] = field(default_factory=dict)
    _lanes: dict[Lane, deque[Row]] = field(default_factory=lambda: {n: deque() for n in LANES})
    _reading: dict[str, _Reading] = field(default_factory=dict)

    def welcome(self, frame: Welcome, ends: Mapping[str, Place]) -> None:
        """Begin: ``ends`` is where each writer's journal ends now, what follows is new."""
        self.epoch, self.next_number, self.acked = frame.epoch, 1, 0
        self.cursor = dict(frame.cursor)
        self.said = dict(self.cursor)
        for lane in self._lanes.values():
            lane.clear()
        self._reading = {}
        for writer, end in ends.items():
            at = self.cursor.get(writer, START)
            join = max(end, at)
            self._reading[writer] = _Reading(at, join, join)

    def starts(self, writer: str) -> tuple[Place, Place]:
        """Return where the backlog of a writer begins, and where it ends and the new begins."""
        reading = self._reading[writer]
        return reading.backlog_at, reading.join

    def offer_fresh(self, writer: str, rows: Sequence[Row], read_to: Place) -> None:
        """Take new rows of a writer, which has been read so far."""
        for row in rows:
            self._lanes["urgent" if row.channel in limits.URGENT else "status"].append(row)
        reading = self._reading[writer]
        reading.fresh_at = max(reading.fresh_at, read_to)

    def offer_backlog(self, writer: str, rows: Sequence[Row], read_to: Place) -> None:
        """Take rows that were written before the link was made."""
        reading = self._reading[writer]
        self._lanes["backlog"].extend(row for row in rows if row.place < reading.join)
        reading.backlog_at = max(reading.backlog_at, read_to)

    def waiting(self, lane: Lane) -> int:
        """Number of rows that wait in a lane."""
        return len(self._lanes[lane])

    def is_caught_up(self, writer: str) -> bool:
        """Tell whether a writer's backlog has been read to its end."""
        return self._reading[writer].caught_up

    @property
    def window_open(self) -> bool:
        """Tell whether another frame may be sent before the next acknowledgement."""
        return self.next_number - 1 - self.acked < limits.WINDOW

    def next_rows(
        self,
        allowed: Collection[Lane] = LANES,
        most_bytes: int = limits.ROWS_BYTES,
        *,
        bare: bool = True,
    ) -> Rows | None:
        """Return the frame to send next, the most urgent rows of it; None if there is nothing.

        A frame has at least one row, whatever ``most_bytes`` says; or none, when ``bare``, where
        only how far everything was sent is news.
        """
        if not self.window_open:
            return None
        rows = self._take(allowed, most_bytes)
        if not rows and not bare:
            return None
        upto = self._upto()
        news = {w: at for w, at in upto.items() if at > self.said.get(w, START)}
        if not rows and not news:
            return None
        self.said.update(news)
        frame = Rows(self.epoch, self.next_number, rows, news)
        self.next_number += 1
        return frame

    def _take(self, allowed: Collection[Lane], most_bytes: int) -> list[Row]:
        rows: list[Row] = []
        size = 0
        for name in LANES:
            lane = self._lanes[name]
            while name in allowed and lane and len(rows) < limits.ROWS_COUNT:
                size += len(lane[0].data) + len(lane[0].channel) + _OVERHEAD
                if rows and size > most_bytes:
                    return rows
                rows.append(lane.popleft())
            if rows:
                return rows  # what is less urgent does not ride along
        return rows

    def _upto(self) -> dict[str, Place]:
        """Return up to where all rows of each writer are sent, this frame included."""
        waiting: dict[str, Place] = {}
        for lane in LANES:
            for writer in self._reading:
                first = next((r.place for r in self._lanes[lane] if r.writer == writer), None)
                if first is not None:
                    waiting[writer] = min(first, waiting.get(writer, first))
        return {
            writer: min(
                r.fresh_at if r.caught_up else r.backlog_at, waiting.get(writer, r.fresh_at)
            )
            for writer, r in self._reading.items()
        }

    def acknowledged(self, frame: Ack) -> None:
        """Take an acknowledgement; raises OutOfStepError for frames that were never sent."""
        if frame.number >= self.next_number:
            raise OutOfStepError(f"frame {frame.number} was never sent")
        for writer, at in frame.cursor.items():
            if at > max(self.said.get(writer, START), self.cursor.get(writer, START)):
                raise OutOfStepError(f"{writer} was never sent up to {at}")
        self.acked = max(self.acked, frame.number)
        for writer, at in frame.cursor.items():
            self.cursor[writer] = max(at, self.cursor.get(writer, START))

    def backlog(self, reaches: Mapping[str, Reach]) -> int:
        """About how many positions lie between what is acknowledged and the end."""
        return sum(_between(self.cursor.get(w, START), reach) for w, reach in reaches.items())


def _between(at: Place, reach: Reach) -> int:
    """Count the positions from a place to the end, as far as the runs are stated."""
    ends = {run.run: run.end_seq for run in reach.runs}
    ends[reach.end.run] = reach.end.seq
    return sum(
        end - (at.seq if run == at.run else 0)
        for run, end in ends.items()
        if run >= at.run and end > (at.seq if run == at.run else 0)
    )
