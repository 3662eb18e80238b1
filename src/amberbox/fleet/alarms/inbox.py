"""What waits to be looked at: rows of robots, and robots that came and went."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final, TypeAlias

from sqlalchemy import ColumnElement, Connection, and_, or_, select

from amberbox.fleet.alarms.reports import CHANNELS, Offsets, Received, is_of_interest
from amberbox.fleet.alarms.tables import MARK
from amberbox.fleet.alarms.words import Explanation
from amberbox.fleet.database.upsert import upsert
from amberbox.fleet.linkend.presence import short
from amberbox.fleet.linkend.tables import BOOT, ROBOT, ROW, RUN
from amberbox.link.frames import Row

_MARGIN_NS: Final = 10_000_000_000
"""So much of what came before the last mark is looked at again: it may have been on its way."""
_AT_ONCE: Final = 100
"""News in one transaction: others want to write, too."""


@dataclass(frozen=True, slots=True)
class Came:
    """A robot has connected; ``offset_ns`` is how far its clock is behind ours, as it says."""

    robot: str
    boot_id: str
    offset_ns: int
    at_ns: int


@dataclass(frozen=True, slots=True)
class Went:
    """The connection to a robot has ended; ``boot_ns`` counts from the boot of the server."""

    robot: str
    boot_ns: int


News: TypeAlias = Received | Came | Went | Explanation


@dataclass(slots=True)
class Inbox:
    """Keeps news in order until they are taken; what was not ``done`` is given again."""

    _waiting: deque[News] = field(default_factory=deque)

    def put(self, news: News) -> None:
        """Add news."""
        self._waiting.append(news)

    def next(self) -> list[News]:
        """Return the oldest news."""
        return [self._waiting[k] for k in range(min(len(self._waiting), _AT_ONCE))]

    def done(self, count: int) -> None:
        """Forget the oldest news."""
        for _ in range(count):
            self._waiting.popleft()


def missed_rows(connection: Connection, until_ns: int) -> Iterator[Received]:
    """Yield rows that came before the server stopped, and were not looked at then."""
    mark = connection.execute(select(MARK.c.received_ns)).scalar() or 0
    chosen = select(ROW).where(
        ROW.c.received_ns >= mark - _MARGIN_NS,
        ROW.c.received_ns <= until_ns,
        ROW.c.channel.in_(sorted(CHANNELS)),
    )
    for row in connection.execute(chosen):
        found = Row(row.writer, row.run, row.seq, row.channel, row.log_ns, row.data)
        if is_of_interest(found):
            yield Received(row.robot, row.store_id, found, row.received_ns)


def mark(connection: Connection, received_ns: int) -> None:
    """Note up to when all rows have been looked at."""
    newer = upsert(
        connection.dialect, MARK, ("one",), ("received_ns",),
        when=lambda new: new.received_ns > MARK.c.received_ns,
    )  # fmt: skip
    connection.execute(newer, [{"one": 1, "received_ns": received_ns}])


def offsets(
    connection: Connection, rows: Iterable[Received], said: dict[tuple[str, str], int]
) -> Offsets:
    """Return how far the clocks of the runs were behind ours; ``said`` are those of now, by boot.

    What the link has measured in a boot counts more than what a robot said when it came. Who has
    never been linked, such as a team that is watched here, goes by our clock.
    """
    runs = {(one.robot, one.store_id, one.row.writer, one.row.run) for one in rows}
    boots = _boots(connection, runs)
    robots = sorted({run[0] for run in runs})
    now = {row.robot: short(row.boot_id) for row in connection.execute(
        select(ROBOT.c.robot, ROBOT.c.boot_id).where(ROBOT.c.robot.in_(robots)))}  # fmt: skip
    measured = {(row.robot, short(row.boot_id)): row.offset_ns for row in connection.execute(
        select(BOOT).where(BOOT.c.robot.in_(robots)))}  # fmt: skip
    known = {**{(robot, short(boot)): by for (robot, boot), by in said.items()}, **measured}
    return {
        run: known.get((run[0], boots.get(run, "")[:8] or now[run[0]])) if run[0] in now else 0
        for run in runs
    }


def _boots(
    connection: Connection, runs: Iterable[tuple[str, str, str, int]]
) -> dict[tuple[str, str, str, int], str]:
    which: list[ColumnElement[bool]] = [
        and_(
            RUN.c.robot == robot, RUN.c.store_id == store, RUN.c.writer == writer, RUN.c.run == run
        )
        for robot, store, writer, run in runs
    ]
    found: dict[tuple[str, str, str, int], str] = {}
    for first in range(0, len(which), 100):
        chosen = select(RUN).where(or_(*which[first : first + 100]))
        for row in connection.execute(chosen):
            found[row.robot, row.store_id, row.writer, row.run] = row.boot
    return found
