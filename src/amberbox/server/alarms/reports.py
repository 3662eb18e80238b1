"""Reports of robots that concern alarms: new rows of their journals, connections and their ends."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import msgspec
from sqlalchemy import ColumnElement, Connection, and_, or_, select

from amberbox.blackbox.journal import channels
from amberbox.core.given_answers import RecordedAnswer, answer_of
from amberbox.core.notes import RecordedNote, note_of
from amberbox.core.types import Diagnosis
from amberbox.link.frames import LinkRow
from amberbox.monitoring.findings import AlarmChange, Transition
from amberbox.server.alarms.alarm import AlarmExplanation
from amberbox.server.database import upsert
from amberbox.server.derived import finding
from amberbox.server.ingest.link_state import short_boot_id
from amberbox.server.schema import BOOT, MARK, ROBOT, ROW, RUN

CHANNELS: Final = frozenset({channels.ALARM, channels.DIAGNOSIS, channels.EVENT})
"""Channels that alarms are made of."""
ReportContent: TypeAlias = AlarmChange | Diagnosis | Transition | RecordedAnswer | RecordedNote
_EVENT_KINDS: Final = (b'"component_state"', b'"diagnosis_answer"', b'"note"')


@dataclass(frozen=True, slots=True)
class ReceivedRow:
    """A row of a robot's journal, and when it arrived by the server's clock."""

    robot: str
    store_id: str
    row: LinkRow
    received_ns: int


@dataclass(frozen=True, slots=True)
class AlarmReport:
    """A decoded report; ``offset_ns`` is added to its times, ``late``: it arrived long after.

    ``written_ns`` is when it was written, by the robot's clock.
    """

    robot: str
    store_id: str
    run: int
    seq: int
    content: ReportContent
    offset_ns: int
    late: bool
    written_ns: int = 0


Offsets: TypeAlias = Mapping[tuple[str, str, str, int], int | None]
"""By robot, store, writer and run: the server's clock minus the robot's, None if unknown."""


def is_of_interest(row: LinkRow) -> bool:
    """Return whether a row may concern alarms, without decoding it."""
    if row.channel == channels.EVENT:
        return any(kind in row.data for kind in _EVENT_KINDS)
    return row.channel in CHANNELS


def reports(rows: Iterable[ReceivedRow], offsets: Offsets, late_ns: int) -> Iterator[AlarmReport]:
    """Yield decoded reports in the order in which they were written; unreadable rows are left out.

    A row whose clock offset is unknown is late: its alarm is listed, but not notified before the
    robot has caught up, and never if it is over by then.
    """
    for one in sorted(rows, key=_order):
        content = content_of(one.row)
        if content is None:
            continue
        row = one.row
        offset_ns = offsets.get((one.robot, one.store_id, row.writer, row.run))
        late = offset_ns is None or one.received_ns - row.log_ns - offset_ns > late_ns
        yield AlarmReport(
            one.robot, one.store_id, row.run, row.seq, content, offset_ns or 0, late, row.log_ns
        )


def _order(one: ReceivedRow) -> tuple[str, str, str, int, int]:
    return (one.robot, one.store_id, one.row.writer, one.row.run, one.row.seq)


def content_of(row: LinkRow) -> ReportContent | None:
    """Decode a row; None for an invalid one, which is stored all the same."""
    try:
        values = msgspec.json.decode(row.data)
    except msgspec.MsgspecError:
        return None
    if row.channel == channels.EVENT and isinstance(values, dict) and row.writer == "watch":
        given = answer_of(values)
        if given is not None:
            return given
    if row.channel == channels.EVENT and isinstance(values, dict) and row.writer == "keep":
        return note_of(values)
    found = finding(row.channel, values)
    return found if isinstance(found, ReportContent) else None


_MARGIN_NS: Final = 10_000_000_000
"""Overlap before the last mark that is read again: its rows may have been in transit."""
_AT_ONCE: Final = 100
"""Maximum number of reports in one transaction, so that other writers are not blocked."""


@dataclass(frozen=True, slots=True)
class RobotConnected:
    """A robot has connected; ``offset_ns`` is the server's clock minus that of its hello."""

    robot: str
    boot_id: str
    offset_ns: int
    at_ns: int


@dataclass(frozen=True, slots=True)
class RobotDisconnected:
    """A robot has disconnected; ``boot_ns`` counts from the boot of the server."""

    robot: str
    boot_ns: int


InboxEntry: TypeAlias = ReceivedRow | RobotConnected | RobotDisconnected | AlarmExplanation


@dataclass(slots=True)
class Inbox:
    """A queue of entries; ``next`` returns the same ones until they are marked ``done``."""

    _waiting: deque[InboxEntry] = field(default_factory=deque)

    def put(self, news: InboxEntry) -> None:
        """Add an entry."""
        self._waiting.append(news)

    def next(self) -> list[InboxEntry]:
        """Return the oldest entries, 100 at most, without removing them."""
        return [self._waiting[k] for k in range(min(len(self._waiting), _AT_ONCE))]

    def done(self, count: int) -> None:
        """Remove the ``count`` oldest entries."""
        for _ in range(count):
            self._waiting.popleft()


def missed_rows(connection: Connection, until_ns: int) -> Iterator[ReceivedRow]:
    """Yield rows that arrived until ``until_ns`` and may not have been processed yet."""
    mark = connection.execute(select(MARK.c.received_ns)).scalar() or 0
    chosen = select(ROW).where(
        ROW.c.received_ns >= mark - _MARGIN_NS,
        ROW.c.received_ns <= until_ns,
        ROW.c.channel.in_(sorted(CHANNELS)),
    )
    for row in connection.execute(chosen):
        found = LinkRow(row.writer, row.run, row.seq, row.channel, row.log_ns, row.data)
        if is_of_interest(found):
            yield ReceivedRow(row.robot, row.store_id, found, row.received_ns)


def mark(connection: Connection, received_ns: int) -> None:
    """Store the time up to which all rows have been processed."""
    newer = upsert(
        connection.dialect, MARK, ("one",), ("received_ns",),
        when=lambda new: new.received_ns > MARK.c.received_ns,
    )  # fmt: skip
    connection.execute(newer, [{"one": 1, "received_ns": received_ns}])


def offsets(
    connection: Connection, rows: Iterable[ReceivedRow], stated: dict[tuple[str, str], int]
) -> Offsets:
    """Return the server's clock minus the robot's (ns) for the runs of some rows, None if unknown.

    An offset that the link measured in a boot counts more than ``stated``, the one from the robot's
    hello. A robot that was never linked, such as a team watched by the server, has offset 0.
    """
    runs = {(one.robot, one.store_id, one.row.writer, one.row.run) for one in rows}
    boots = _boots(connection, runs)
    robots = sorted({run[0] for run in runs})
    now = {row.robot: short_boot_id(row.boot_id) for row in connection.execute(
        select(ROBOT.c.robot, ROBOT.c.boot_id).where(ROBOT.c.robot.in_(robots)))}  # fmt: skip
    measured = {
        (row.robot, short_boot_id(row.boot_id)): row.offset_ns
        for row in connection.execute(select(BOOT).where(BOOT.c.robot.in_(robots)))
    }
    known = {
        **{(robot, short_boot_id(boot)): by for (robot, boot), by in stated.items()},
        **measured,
    }
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
