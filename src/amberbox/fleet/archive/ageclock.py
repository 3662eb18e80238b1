"""The time that ages of recordings are counted by: wall time that is plausible, or confirmed.

Wall time may be wrong by years: no battery, a restored image, a typing error. So time goes on from
the last point that was confirmed by the monotonic clock, and wall time is taken over only where it
agrees with that. A jump is *held*: until it is confirmed, nothing becomes older by it. It is
confirmed by an admin, or by evidence: the kernel says that its clock is synchronised, and the
clocks of the robots agree, for a while.

Only a machine that was off may have missed time. A clock that was set while it ran was wrong
before: what came until then is as old as the monotonic clock says, and its times are moved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from sqlalchemy import Connection, func, select, update

from amberbox.core.clock import NS, Clock
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_duration, format_time
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.database.database import Database
from amberbox.fleet.linkend.events import note
from amberbox.fleet.linkend.tables import EVENT, HEADS, ROBOT
from amberbox.fleet.options import options

OPTION = "archive.clock"
SLACK_NS = 3600 * NS
"""Clocks that differ by less agree."""
DAY_NS = 24 * 3600 * NS
OFF_NS = DAY_NS
"""A machine that was switched off may be this much later than expected without a question."""
EARLIEST_NS = 1_672_531_200 * NS
"""A clock before 2023 was never set."""
AGREED_NS = 3600 * NS
"""How long the kernel's clock and a robot's have to agree with wall time to confirm it."""
ALONE_NS = DAY_NS
"""The same where no robot is connected that could agree."""
_WRITE_NS = 600 * NS
"""How often the mark is written; a jump is told of when it has lasted as long."""
_DAYS = 2
"""From so many days on a difference is told in days."""

Jump = Literal["", "ahead", "behind"]


@dataclass(frozen=True, slots=True)
class Mark:
    """A point of confirmed time, with the monotonic clock at that moment; kept in the database.

    ``agreed`` says that wall time has agreed with it in this boot, ``told`` is the jump that an
    event speaks of.
    """

    confirmed_ns: int = 0
    boot_id: str = ""
    boot_ns: int = 0
    agreed: bool = False
    told: Jump = ""


@dataclass(frozen=True, slots=True)
class Reading:
    """Wall time beside the least time that it can be by what was confirmed before.

    ``was_set`` says that wall time agreed in this boot: a jump is no time that has passed.
    """

    wall_ns: int
    known_ns: int
    boot_id: str
    boot_ns: int
    was_set: bool

    @property
    def ahead_ns(self) -> int:
        """Return how far wall time is ahead of the least time that it can be."""
        return self.wall_ns - self.known_ns

    @property
    def jump(self) -> Jump:
        """Return which way wall time is away from what can be; empty where it agrees."""
        if self.ahead_ns > (SLACK_NS if self.was_set else OFF_NS):
            return "ahead"
        return "behind" if self.ahead_ns < -SLACK_NS else ""

    @property
    def age_ns(self) -> int:
        """Return the time that deletion goes by: never later than either of both."""
        return min(self.wall_ns, self.known_ns) if self.jump else self.wall_ns

    @property
    def text(self) -> str:
        """Say what is held; empty where nothing is."""
        if not self.jump:
            return ""
        way = "ahead of" if self.jump == "ahead" else "behind"
        return (
            f"the server's clock is {_length(self.ahead_ns)} {way} the confirmed time: it says "
            f"{_said(self.wall_ns)}, not {_said(self.known_ns)}; until it is confirmed, no "
            "recording is deleted because of the difference"
        )


class AgeClock:
    """Counts confirmed time; its state is in the database, so several processes may ask it."""

    def __init__(self, database: Database, clock: Clock) -> None:
        self._database = database
        self._clock = clock
        self._robots: dict[str, int] = {}
        self._since: tuple[Jump, int] | None = None
        self._agreed: tuple[int, int] | None = None

    def hear(self, robot: str, wall_ns: int) -> None:
        """Take note of what the clock of a robot says now."""
        self._robots[robot] = wall_ns - self._clock.boot_ns()

    def forget(self, robot: str) -> None:
        """Leave the clock of a robot that is gone out of account."""
        self._robots.pop(robot, None)

    def read(self) -> Reading:
        """Compare wall time with confirmed time."""
        with self._database.reading() as connection:
            return self._reading(connection)

    def came_ns(self) -> int:
        """Return the time to note for what comes now: what is kept is never too old by it."""
        found = self.look()
        return max(found.wall_ns, found.known_ns)

    def look(self) -> Reading:
        """Go on with confirmed time; write an event about a jump that lasts, and about its end.

        To be called often: how long a jump lasts is known from the looks before.
        """
        with self._database.reading() as connection:
            mark, found = _mark(connection), self._reading(connection)
        told, evidence = self._told(found, mark), self._evidence(found)
        is_due = mark.boot_id != found.boot_id or found.boot_ns - mark.boot_ns >= _WRITE_NS
        if not (is_due or evidence or told != mark.told):
            return found
        with self._database.begin() as connection:
            if evidence:
                self.confirm(connection, evidence)
                return self._reading(connection)
            return self._go_on(connection, told)

    def confirm(self, connection: Connection, by: str) -> Reading:
        """Take wall time for right from now on, and say so in an event; return what was held.

        Raises UsageError for a clock that cannot be right.
        """
        found = self._reading(connection)
        if found.wall_ns < EARLIEST_NS:
            what = f"the server's clock says {_said(found.wall_ns)}: it was never set"
            raise UsageError(what, "set it first")
        if found.jump:
            _move_times(connection, found)
            text = f"the server's clock ({_said(found.wall_ns)}) was confirmed by {by}"
            note(connection, "", found.wall_ns, "clock_confirmed", text)
        _write(connection, found, Mark(found.wall_ns, found.boot_id, found.boot_ns, agreed=True))
        return found

    def _reading(self, connection: Connection) -> Reading:
        mark = _mark(connection)
        wall_ns, boot_ns = self._clock.wall_ns(), self._clock.boot_ns()
        boot_id = self._clock.boot_id()
        is_same = mark.boot_id == boot_id
        known_ns = mark.confirmed_ns + max(0, boot_ns - mark.boot_ns if is_same else boot_ns)
        if not mark.confirmed_ns:  # nothing has come yet, nothing can be too old
            known_ns = wall_ns
        return Reading(wall_ns, known_ns, boot_id, boot_ns, is_same and mark.agreed)

    def _go_on(self, connection: Connection, told: Jump) -> Reading:
        """Write the mark as of now, and what there is to say about it."""
        mark, found = _mark(connection), self._reading(connection)
        if told and told != mark.told:
            text = f"{found.text}: see /admin/health, or amberbox serve clock"
            note(connection, "", found.wall_ns, "clock_jumped", text)
        elif mark.told and not found.jump:
            text = "the server's clock agrees again with the time that is confirmed"
            note(connection, "", found.wall_ns, "clock_agrees", text)
        at_ns = found.known_ns if found.jump else found.wall_ns
        agreed = not found.jump or found.was_set
        _write(connection, found, Mark(at_ns, found.boot_id, found.boot_ns, agreed, told))
        return found

    def _told(self, found: Reading, mark: Mark) -> Jump:
        """Return the jump that an event speaks of: one may be over a moment after a start."""
        if self._since is None or self._since[0] != found.jump:
            self._since = found.jump, found.boot_ns
        lasts = found.boot_ns - self._since[1] >= _WRITE_NS
        return found.jump if lasts or found.jump == mark.told else ""

    def _evidence(self, found: Reading) -> str:
        """Return what confirms a jump, in words; empty where nothing does yet."""
        if found.known_ns < EARLIEST_NS <= found.wall_ns:
            return "having been set for the first time"
        walls = [base_ns + found.boot_ns for base_ns in list(self._robots.values())]
        walls = [wall_ns for wall_ns in walls if wall_ns >= EARLIEST_NS]
        agree = sum(abs(wall_ns - found.wall_ns) <= SLACK_NS for wall_ns in walls)
        is_seconded = 2 * agree > len(walls) or not walls
        if not (found.jump and is_seconded and self._clock.synchronised()):
            self._agreed = None
            return ""
        base_ns = found.wall_ns - found.boot_ns
        if self._agreed is None or abs(self._agreed[0] - base_ns) > SLACK_NS:
            self._agreed = base_ns, found.boot_ns
        if found.boot_ns - self._agreed[1] < (AGREED_NS if walls else ALONE_NS):
            return ""
        robots = f" and the clocks of {agree} of {len(walls)} robots" if walls else ""
        return f"the kernel's time synchronisation{robots}"


def _mark(connection: Connection) -> Mark:
    """Return the last point of confirmed time; before there was one, when something came last."""
    mark = options.read(connection, OPTION, Mark)
    if mark.confirmed_ns:
        return mark
    put_ns = connection.scalar(select(func.max(JOURNALS.c.put_ns)))
    seen_ns = connection.scalar(select(func.max(ROBOT.c.last_seen_ns)))
    return replace(mark, confirmed_ns=max(put_ns or 0, seen_ns or 0))


def _write(connection: Connection, found: Reading, mark: Mark) -> None:
    options.write(connection, found.wall_ns, OPTION, mark)


def _move_times(connection: Connection, found: Reading) -> None:
    """Move the times of what came by a clock that was wrong: it is as old as it was before."""
    was_wrong = found.was_set or found.known_ns < EARLIEST_NS
    booted_ns = found.known_ns - found.boot_ns
    for column in (JOURNALS.c.put_ns, EVENT.c.at_ns, HEADS.c.at_ns):
        after_ns = -1 if was_wrong and column is JOURNALS.c.put_ns else booted_ns
        if was_wrong or found.jump == "ahead":
            moved = update(column.table).where(column > after_ns, column <= found.known_ns)
            connection.execute(moved.values({column: column + found.ahead_ns}))
        late = update(column.table).where(column > found.wall_ns)
        connection.execute(late.values({column: found.wall_ns}))


def _length(duration_ns: int) -> str:
    days = abs(duration_ns) / DAY_NS
    return f"{days:.0f} days" if days >= _DAYS else format_duration(abs(duration_ns))


def _said(time_ns: int) -> str:
    """Write a time as people read it, to the second."""
    return f"{format_time(time_ns)[:19]}Z"
