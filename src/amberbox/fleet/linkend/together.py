"""Rows of many robots taken at once: read once, then written with one statement per table.

What is ordinary (rows that go on where those before ended, nothing put aside) is done here, by the
rules of ``ledger.store``; everything else is left to that.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from sqlalchemy import Connection, bindparam, select

from amberbox.fleet.database.upsert import upsert
from amberbox.fleet.linkend import board, ledger
from amberbox.fleet.linkend.tables import COMMITTED, ROBOT, RUN, WRITER
from amberbox.link.frames import Row
from amberbox.link.history import Held, aside
from amberbox.link.ledger import StaleEpochError, Stored, advanced
from amberbox.link.positions import START, Place, Reach

Keys: TypeAlias = tuple[str, str]
"""Robot and store."""
Run: TypeAlias = tuple[str, str, str, int]
"""Robot, store, writer, run."""
_RUN_KEY = ("robot", "store_id", "writer", "run")


@dataclass(frozen=True, slots=True)
class Taking:
    """Rows of a robot that are to be stored; called by itself it does that (``ledger.store``)."""

    robot: str
    epoch: int
    store_id: str
    rows: Sequence[Row]
    upto: Mapping[str, Place]
    reaches: Mapping[str, Reach]
    now_ns: int
    compare: bool

    def __call__(self, connection: Connection) -> Stored:
        """Store them; raises StaleEpochError when the robot has connected again since."""
        return ledger.store(
            connection, self.robot, self.epoch, self.store_id, self.rows, self.upto, self.reaches,
            self.now_ns, compare=self.compare,
        )  # fmt: skip

    @property
    def keys(self) -> Keys:
        """Whose they are."""
        return self.robot, self.store_id

    def runs(self) -> dict[Run, list[Row]]:
        """Return the rows by run."""
        found: dict[Run, list[Row]] = {}
        for row in self.rows:
            found.setdefault((*self.keys, row.writer, row.run), []).append(row)
        return found

    def stated(self) -> Iterator[Run]:
        """Give the runs of which the robot tells how far they reach."""
        for writer, reach in self.reaches.items():
            yield from ((*self.keys, writer, one.run) for one in reach.runs)


@dataclass(slots=True)
class _Known:
    """What is known of a run: the boot that wrote it, and the end of what is held of it."""

    boot: str = ""
    end_seq: int = 0


@dataclass(slots=True)
class _State:
    """What the database holds of some robots, and what is to be written."""

    epochs: dict[str, int] = field(default_factory=dict)
    cursors: dict[Keys, dict[str, Place]] = field(default_factory=dict)
    received: dict[Keys, dict[str, Place]] = field(default_factory=dict)
    runs: dict[Run, _Known] = field(default_factory=dict)
    committed: dict[Run, list[tuple[int, int]]] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)
    statuses: list[dict[str, Any]] = field(default_factory=list)
    changed_runs: set[Run] = field(default_factory=set)
    changed_cursors: set[Keys] = field(default_factory=set)


def store_all(connection: Connection, takings: Sequence[Taking]) -> list[Stored | StaleEpochError]:
    """Store rows in their order; return what came of the first ones, those that are ordinary."""
    state = _read(connection, takings)
    outcomes: list[Stored | StaleEpochError] = []
    for taking in takings:
        outcome = _taken(state, taking)
        if outcome is None:
            break
        outcomes.append(outcome)
    _write(connection, state)
    return outcomes


def _read(connection: Connection, takings: Sequence[Taking]) -> _State:
    state = _State()
    robots = {taking.robot for taking in takings}
    stores = {taking.keys for taking in takings}
    epochs = select(ROBOT.c.robot, ROBOT.c.epoch).where(ROBOT.c.robot.in_(robots))
    state.epochs = {row.robot: row.epoch for row in connection.execute(epochs)}
    for row in connection.execute(select(WRITER).where(WRITER.c.robot.in_(robots))):
        keys = row.robot, row.store_id
        if keys in stores:
            state.cursors.setdefault(keys, {})[row.writer] = Place(row.run, row.seq)
            state.received.setdefault(keys, {})[row.writer] = Place(row.upto_run, row.upto_seq)
    written = {run for taking in takings for run in taking.runs()}
    stated = {run for taking in takings if taking.compare for run in taking.stated()}
    for run in written | stated:
        for row in connection.execute(_A_RUN, _place(run)):
            state.runs[run] = _Known(row.boot, row.end_seq)
    for run in written:
        found = connection.execute(_COMMITTED_OF, _place(run)).all()
        state.committed[run] = [(row.from_seq, row.to_seq) for row in found]
    return state


def _of_run(table: Any) -> Any:
    """Select what a table holds of one run; made once, for many that are asked for one by one.

    (Many at once, by a list of keys, would be looked for without the table's index.)
    """
    return select(table).where(*(table.c[name] == bindparam(f"of_{name}") for name in _RUN_KEY))


def _place(run: Run) -> dict[str, Any]:
    return {f"of_{name}": value for name, value in zip(_RUN_KEY, run, strict=True)}


_A_RUN, _COMMITTED_OF = _of_run(RUN), _of_run(COMMITTED)


def _taken(state: _State, taking: Taking) -> Stored | StaleEpochError | None:
    """Take rows; None for what is not ordinary, of which nothing is noted then."""
    if state.epochs.get(taking.robot) != taking.epoch:
        return StaleEpochError()
    runs = taking.runs()
    if not all(_goes_on(state, run, rows) for run, rows in runs.items()):
        return None
    if taking.compare and not _agrees(state, taking):
        return None
    new = [row for run, rows in runs.items() for row in _enter(state, run, rows)]
    about = {"robot": taking.robot, "store_id": taking.store_id, "received_ns": taking.now_ns}
    state.rows += ({**about, **ledger.columns(row)} for row in new)
    state.statuses += board.entries(taking.robot, taking.store_id, new, taking.now_ns)
    received = state.received.setdefault(taking.keys, {})
    received.update(taking.upto)
    cursor = advanced(state.cursors.get(taking.keys, {}), received, taking.reaches)
    state.cursors[taking.keys] = cursor
    state.changed_cursors.add(taking.keys)
    return Stored(dict(cursor), tuple(new))


def _goes_on(state: _State, run: Run, rows: Sequence[Row]) -> bool:
    """Tell whether rows stand behind all that is held of their run, each at a place of its own."""
    last = state.runs[run].end_seq - 1 if run in state.runs else -1
    for row in rows:
        if row.seq <= last:
            return False
        last = row.seq
    return True


def _enter(state: _State, run: Run, rows: Sequence[Row]) -> list[Row]:
    """Note how far a run is held now; return the rows that the archive does not hold already."""
    state.runs.setdefault(run, _Known()).end_seq = rows[-1].seq + 1
    state.changed_runs.add(run)
    held = state.committed.get(run)
    if not held:
        return list(rows)
    return [row for row in rows if not any(low <= row.seq < high for low, high in held)]


def _agrees(state: _State, taking: Taking) -> bool:
    """Tell whether nothing has to be put aside; the boots of runs are noted then."""
    cursor = state.cursors.get(taking.keys, {})
    for writer, reach in taking.reaches.items():
        at = cursor.get(writer, START)
        if any(aside(writer, _held(state, taking, writer, at), at, reach, is_hello=False)):
            return False
    for writer, reach in taking.reaches.items():
        for one in reach.runs:
            run = (*taking.keys, writer, one.run)
            known = state.runs.setdefault(run, _Known())
            if not known.boot and (one.boot or run not in state.changed_runs):
                known.boot = one.boot
                state.changed_runs.add(run)
    return True


def _held(state: _State, taking: Taking, writer: str, at: Place) -> list[Held]:
    found = []
    for one in taking.reaches[writer].runs:
        known = state.runs.get((*taking.keys, writer, one.run))
        if known is not None:
            end = max(known.end_seq, at.seq if at.run == one.run else 0)
            found.append(Held(one.run, known.boot, end))
    return found


def _write(connection: Connection, state: _State) -> None:
    """Write everything, one statement for each table."""
    ledger.insert(connection, state.rows)
    board.enter(connection, state.statuses)
    runs = [
        {**dict(zip(_RUN_KEY, run, strict=True)), "boot": state.runs[run].boot,
         "end_seq": state.runs[run].end_seq}
        for run in sorted(state.changed_runs)
    ]  # fmt: skip
    if runs:
        connection.execute(upsert(connection.dialect, RUN, _RUN_KEY, ("boot", "end_seq")), runs)
    ledger.write_cursors(
        connection,
        [
            (keys, state.cursors[keys], state.received[keys])
            for keys in sorted(state.changed_cursors)
        ],
    )
