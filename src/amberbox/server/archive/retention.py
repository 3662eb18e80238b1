"""Retention: old journals and table rows are deleted; incidents are kept.

Ages are counted by wall time that is plausible, or that an admin has confirmed
(``RetentionClock``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

from sqlalchemy import Connection, Row, Table, delete, exists, func, select, tuple_, update

from amberbox.blackbox.columns.flat_tables import TableSchema
from amberbox.blackbox.columns.table_text import plain
from amberbox.blackbox.journal import channels
from amberbox.blackbox.store.manifest import is_kept
from amberbox.blackbox.store.table_reader import RowRequest, gather
from amberbox.core.clock import NS, Clock
from amberbox.core.errors import UsageError
from amberbox.core.names import identifier
from amberbox.core.timestamps import format_duration, format_to_second
from amberbox.server import settings
from amberbox.server.annotations import pinned as marked
from amberbox.server.archive import delta_files
from amberbox.server.archive.catalogue import COMMITTED, ArchiveCatalogue, RobotStore
from amberbox.server.archive.delta_files import ArchiveLayout, join_files, segment_at, tables_of
from amberbox.server.archive.reader import ArchiveReader
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.link_state import log_event
from amberbox.server.journals import OWN, Retention
from amberbox.server.schema import ALARM, ALARM_ROBOT, EVENT, HEADS, HISTORY, JOURNALS, ROBOT

OPTION = "archive.clock"
# Clocks that differ by less agree
SLACK_NS = 3600 * NS
DAY_NS = 24 * 3600 * NS
# A machine that was off may start this much later than expected without confirmation
OFF_NS = DAY_NS
# A clock before 2023 was never set
EARLIEST_NS = 1_672_531_200 * NS
# How long the kernel's clock and a robot's have to agree with wall time to confirm it
AGREED_NS = 3600 * NS
# The same without connected robots to compare with
ALONE_NS = DAY_NS
# How often the mark is written; a jump is logged when it has lasted as long
_WRITE_NS = 600 * NS
# Differences of at least so many days are given in days
_DAYS = 2

Jump = Literal["", "ahead", "behind"]


@dataclass(frozen=True, slots=True)
class ConfirmedTime:
    """A point of confirmed time, with the monotonic clock at that moment; kept in the database.

    ``agreed``: wall time has agreed with it in this boot. ``told``: the jump that was logged.
    """

    confirmed_ns: int = 0
    boot_id: str = ""
    boot_ns: int = 0
    agreed: bool = False
    told: Jump = ""


@dataclass(frozen=True, slots=True)
class ClockComparison:
    """Wall time beside the earliest possible time, by what was confirmed before.

    ``was_set``: wall time agreed in this boot, so that a later jump is not elapsed time.
    """

    wall_ns: int
    known_ns: int
    boot_id: str
    boot_ns: int
    was_set: bool

    @property
    def ahead_ns(self) -> int:
        """Return how far wall time is ahead of the earliest possible time (ns)."""
        return self.wall_ns - self.known_ns

    @property
    def jump(self) -> Jump:
        """Return the direction in which wall time is implausible; empty where it is plausible."""
        if self.ahead_ns > (SLACK_NS if self.was_set else OFF_NS):
            return "ahead"
        return "behind" if self.ahead_ns < -SLACK_NS else ""

    @property
    def age_ns(self) -> int:
        """Return the time (ns) for computing ages: after a jump, the earlier of both times."""
        return min(self.wall_ns, self.known_ns) if self.jump else self.wall_ns

    @property
    def text(self) -> str:
        """Return a description of the difference between both times; empty where they agree."""
        if not self.jump:
            return ""
        way = "ahead of" if self.jump == "ahead" else "behind"
        wall, known = _time_text(self.wall_ns), _time_text(self.known_ns)
        return (
            f"the server's clock is {_length(self.ahead_ns)} {way} the confirmed time: it says "
            f"{wall}, not {known}; until it is confirmed, no recording is deleted because of the "
            "difference"
        )


class RetentionClock:
    """Tracks confirmed time; its state is in the database, shared by several processes."""

    def __init__(self, database: ServerDatabase, clock: Clock) -> None:
        self._database = database
        self._clock = clock
        self._robots: dict[str, int] = {}
        self._since: tuple[Jump, int] | None = None
        self._agreed: tuple[int, int] | None = None

    def compare_wall(self, robot: str, wall_ns: int) -> None:
        """Note the present time of a robot's clock."""
        self._robots[robot] = wall_ns - self._clock.boot_ns()

    def forget(self, robot: str) -> None:
        """Ignore the clock of a robot that has disconnected."""
        self._robots.pop(robot, None)

    def read(self) -> ClockComparison:
        """Return the comparison of wall time with confirmed time."""
        with self._database.reading() as connection:
            return self._reading(connection)

    def came_ns(self) -> int:
        """Return the receive time for new data (ns): the later of both times, so that it is never
        too old.
        """
        found = self.look()
        return max(found.wall_ns, found.known_ns)

    def look(self) -> ClockComparison:
        """Advance confirmed time; log an event about a jump that lasts, and about its end.

        To be called often, since the duration of a jump is known from earlier calls.
        """
        with self._database.reading() as connection:
            mark, found = _mark(connection), self._reading(connection)
        jump, evidence = self._lasting_jump(found, mark), self._evidence(found)
        is_due = mark.boot_id != found.boot_id or found.boot_ns - mark.boot_ns >= _WRITE_NS
        if not (is_due or evidence or jump != mark.told):
            return found
        with self._database.begin() as connection:
            if evidence:
                self.confirm(connection, evidence)
                return self._reading(connection)
            return self._go_on(connection, jump)

    def confirm(self, connection: Connection, by: str) -> ClockComparison:
        """Confirm wall time, and log it as an event; return the comparison before.

        Raises UsageError for a clock that was never set.
        """
        found = self._reading(connection)
        if found.wall_ns < EARLIEST_NS:
            what = f"the server's clock says {_time_text(found.wall_ns)}: it was never set"
            raise UsageError(what, "set it first")
        if found.jump:
            _move_times(connection, found)
            text = f"the server's clock ({_time_text(found.wall_ns)}) was confirmed by {by}"
            log_event(connection, "", found.wall_ns, "clock_confirmed", text)
        mark = ConfirmedTime(found.wall_ns, found.boot_id, found.boot_ns, agreed=True)
        settings.write(connection, found.wall_ns, OPTION, mark)
        return found

    def _reading(self, connection: Connection) -> ClockComparison:
        mark = _mark(connection)
        wall_ns, boot_ns = self._clock.wall_ns(), self._clock.boot_ns()
        boot_id = self._clock.boot_id()
        is_same = mark.boot_id == boot_id
        known_ns = mark.confirmed_ns + max(0, boot_ns - mark.boot_ns if is_same else boot_ns)
        if not mark.confirmed_ns:  # nothing has arrived yet, so nothing can be too old
            known_ns = wall_ns
        return ClockComparison(wall_ns, known_ns, boot_id, boot_ns, is_same and mark.agreed)

    def _go_on(self, connection: Connection, jump: Jump) -> ClockComparison:
        """Write the confirmed time as of now, and log a jump or its end."""
        mark, found = _mark(connection), self._reading(connection)
        if jump and jump != mark.told:
            text = f"{found.text}: see /admin/health, or amberbox serve clock"
            log_event(connection, "", found.wall_ns, "clock_jumped", text)
        elif mark.told and not found.jump:
            text = "the server's clock agrees again with the time that is confirmed"
            log_event(connection, "", found.wall_ns, "clock_agrees", text)
        at_ns = found.known_ns if found.jump else found.wall_ns
        agreed = not found.jump or found.was_set
        mark = ConfirmedTime(at_ns, found.boot_id, found.boot_ns, agreed, jump)
        settings.write(connection, found.wall_ns, OPTION, mark)
        return found

    def _lasting_jump(self, found: ClockComparison, mark: ConfirmedTime) -> Jump:
        """Return the jump to log, once it has lasted; short ones after a start are ignored."""
        if self._since is None or self._since[0] != found.jump:
            self._since = found.jump, found.boot_ns
        lasts = found.boot_ns - self._since[1] >= _WRITE_NS
        return found.jump if lasts or found.jump == mark.told else ""

    def _evidence(self, found: ClockComparison) -> str:
        """Return what confirms a jump, as text; empty where nothing does yet."""
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


def _mark(connection: Connection) -> ConfirmedTime:
    """Return the last confirmed time; without one, when data were last received."""
    mark = settings.read(connection, OPTION, ConfirmedTime)
    if mark.confirmed_ns:
        return mark
    put_ns = connection.scalar(select(func.max(JOURNALS.c.put_ns)))
    seen_ns = connection.scalar(select(func.max(ROBOT.c.last_seen_ns)))
    return replace(mark, confirmed_ns=max(put_ns or 0, seen_ns or 0))


def _move_times(connection: Connection, found: ClockComparison) -> None:
    """Correct receive times that were taken with a wrong clock, so that ages stay the same."""
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


def _time_text(time_ns: int) -> str:
    """Format a time, to the second."""
    return format_to_second(time_ns)


# Keeping classes to which a rule for ``*`` applies
DATA = ("main", "bulk", "ring")
_RELEASED = "released"


def retain(
    layout: ArchiveLayout, catalogue: ArchiveCatalogue, rules: Sequence[Retention], now_ns: int
) -> int:
    """Delete by the rules; return how many journals are concerned.

    Deletions are noted in the catalogue first. Whole days (UTC) are deleted, so that files are not
    rewritten for every journal.
    """
    pinned = {
        source: [*_windows(layout, catalogue, source), *marked(catalogue.database, source.robot)]
        for source in catalogue.sources()
    }
    concerned: set[tuple[str, str, str]] = set()
    for row in catalogue.journals():
        windows = pinned[RobotStore(row.robot, row.store_id)]
        if row.state != COMMITTED or any(
            row.start_ns <= to_ns and row.end_ns >= from_ns for from_ns, to_ns in windows
        ):
            continue
        changes = {name: True for name in _over(row, rules, now_ns) if not getattr(row, name)}
        if changes:
            catalogue.change([row], **changes)
            concerned.add((row.robot, row.store_id, row.file))
    remove_columns(layout, catalogue)
    remove_journals(layout, catalogue)
    return len(concerned)


def _over(row: Row[Any], rules: Sequence[Retention], now_ns: int) -> Iterable[str]:
    """Yield the flags of the parts of a journal that are older than their rule."""
    age_s = (now_ns // DAY_NS * DAY_NS - row.put_ns) / NS
    rule, own = rule_of(row.robot, row.keeping, rules), rule_of(row.robot, OWN, rules)
    if rule is not None and rule.journals_s is not None and age_s > rule.journals_s:
        yield "raw_gone"
    if rule is not None and rule.columns_s is not None and age_s > rule.columns_s:
        yield "columns_gone"
    if own is not None and own.columns_s is not None and age_s > own.columns_s:
        yield "own_gone"


def rule_of(robot: str, keeping: str, rules: Sequence[Retention]) -> Retention | None:
    """Return the most specific rule for a robot and class, or None."""
    fitting = [
        rule
        for rule in rules
        if rule.robot in ("*", robot)
        and (rule.keeping == keeping or (rule.keeping == "*" and keeping in DATA))
    ]
    return max(fitting, key=lambda rule: (rule.robot != "*", rule.keeping != "*"), default=None)


def _windows(
    layout: ArchiveLayout, catalogue: ArchiveCatalogue, source: RobotStore
) -> list[tuple[int, int]]:
    """Return the windows of incidents that are not released."""
    reader = ArchiveReader(layout, catalogue, [source])
    table = identifier(channels.INCIDENT)
    if table not in reader.schemas:
        return []
    found = gather(reader.of(source, table), RowRequest(table, ("id", "state", "from_ns", "to_ns")))
    last: dict[str, tuple[str, int, int]] = {}
    for piece in sorted(found.pieces, key=lambda piece: (piece.run, int(piece.seq[0]))):
        columns = (plain(piece.columns[n]) for n in ("id", "state", "from_ns", "to_ns"))
        for name, state, from_ns, to_ns in zip(*columns, strict=True):
            last[name] = (state, from_ns, to_ns)
    return [(from_ns, to_ns) for state, from_ns, to_ns in last.values() if state != _RELEASED]


def remove_journals(layout: ArchiveLayout, catalogue: ArchiveCatalogue) -> int:
    """Delete the journal files that the catalogue marks as deleted; return how many are marked."""
    removed = 0
    for row in catalogue.journals():
        if row.raw_gone:
            with suppress(FileNotFoundError):
                layout.journal(row.robot, row.store_id, row.file).unlink()
                removed += 1
    return removed


def remove_columns(layout: ArchiveLayout, catalogue: ArchiveCatalogue) -> None:
    """Remove the rows of journals whose columns are marked as deleted from the tables."""
    for source in catalogue.sources():
        rows = catalogue.journals(source)
        held = catalogue.held(source)
        for schema in (schema for schema in catalogue.schemas() if schema.id in held):
            flag = "own_gone" if is_kept(schema) else "columns_gone"
            gone = [row for row in rows if getattr(row, flag)]
            if gone:
                for table, kind in tables_of(schema):
                    remove_rows(layout, table, kind, source, gone)


def remove_rows(
    layout: ArchiveLayout,
    table: str,
    schema: TableSchema,
    source: RobotStore,
    gone: Sequence[Row[Any]],
    about: str = "rows older than their lifetime went",
) -> None:
    """Remove the rows of some journals of a store from a table."""
    names = {row.file for row in gone}
    runs = {row.run for row in gone}
    for file in list(layout.snapshot(table).files.values()):
        if (file.robot, file.low["store_id"]) != (source.robot, source.store_id) or not any(
            file.low["run"] <= run <= file.high["run"] for run in runs
        ):
            continue
        parts = segment_at(layout.tables, f"{table}/{file.path}").parts
        if any(part.journal in names for part in parts):
            rest = join_files(layout.tables, table, schema, [file], names)
            added = [] if rest is None else [rest]
            delta_files.change_table(layout.table(table), schema, added, [file], about=about)


# Rows in one transaction, so that other writers get a turn
AT_ONCE = 500


def forget_old_rows(database: ServerDatabase, rules: Sequence[Retention], now_ns: int) -> int:
    """Delete database rows older than the rules for their recordings; return how many.

    Events of the link and the history of alarms follow the rules for the recorder's own channels;
    signed heads those for journals of data.
    """
    with database.reading() as connection:
        gone: dict[Table, list[tuple[Any, ...]]] = {
            EVENT: [(number,) for number in _events(connection, rules, now_ns)],
            HISTORY: [(number,) for number in _history(connection, rules, now_ns)],
            HEADS: list(_heads(connection, rules, now_ns)),
        }
    for table, keys in gone.items():
        key = tuple_(*table.primary_key.columns)
        for start in range(0, len(keys), AT_ONCE):
            with database.begin() as connection:
                connection.execute(delete(table).where(key.in_(keys[start : start + AT_ONCE])))
    return sum(len(keys) for keys in gone.values())


def _events(connection: Connection, rules: Sequence[Retention], now_ns: int) -> Iterator[int]:
    for robot in connection.scalars(select(EVENT.c.robot).distinct()).all():
        before_ns = _noted_before(robot, rules, now_ns)
        if before_ns is not None:
            old = select(EVENT.c.number).where(EVENT.c.robot == robot, EVENT.c.at_ns < before_ns)
            yield from connection.scalars(old)


def _history(connection: Connection, rules: Sequence[Retention], now_ns: int) -> Iterator[int]:
    """Yield the history of alarms that were resolved too long ago for all of their robots."""
    recorded = exists().where(HISTORY.c.alarm == ALARM.c.number)
    resolved = select(ALARM.c.number, ALARM.c.resolved_ns).where(
        ALARM.c.state == "resolved", ALARM.c.resolved_ns.is_not(None), recorded
    )
    for alarm, resolved_ns in connection.execute(resolved).all():
        about = select(ALARM_ROBOT.c.robot).where(ALARM_ROBOT.c.alarm == alarm)
        befores = [_noted_before(one, rules, now_ns) for one in connection.scalars(about)]
        if befores and all(ns is not None and resolved_ns < ns for ns in befores):
            yield from connection.scalars(select(HISTORY.c.number).where(HISTORY.c.alarm == alarm))


def _heads(
    connection: Connection, rules: Sequence[Retention], now_ns: int
) -> Iterator[tuple[str, str, str]]:
    stores = select(HEADS.c.robot, HEADS.c.store_id).distinct()
    for robot, store_id in connection.execute(stores).all():
        before_ns = _signed_before(robot, rules, now_ns)
        if before_ns is None:
            continue
        old = (HEADS.c.robot == robot, HEADS.c.store_id == store_id, HEADS.c.at_ns < before_ns)
        last_ns = connection.scalar(select(func.max(HEADS.c.at_ns)).where(*old))
        keys = select(*HEADS.primary_key.columns).where(*old, HEADS.c.at_ns < last_ns)
        yield from (tuple(row) for row in connection.execute(keys))


def _noted_before(robot: str, rules: Sequence[Retention], now_ns: int) -> int | None:
    rule = rule_of(robot, OWN, rules)
    if rule is None or rule.columns_s is None:
        return None
    return now_ns - int(rule.columns_s * NS)


def _signed_before(robot: str, rules: Sequence[Retention], now_ns: int) -> int | None:
    """Return the time (ns) before which no journal of data is kept; None where some are kept for
    ever.
    """
    found = [rule_of(robot, keeping, rules) for keeping in DATA]
    lasts = [None if rule is None else rule.journals_s for rule in found]
    kept = [seconds for seconds in lasts if seconds is not None]
    return now_ns - int(max(kept) * NS) if len(kept) == len(DATA) else None
