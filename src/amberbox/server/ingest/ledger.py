"""The ledger of the link in the server's database, and batch ingest: rows of many robots are read
once and written with one statement per table and one sync.

The rules are those of ``link/ledger.py``. Rows that were sent over the link are a cache: they are
dropped when the journal that holds them is committed.
"""

from __future__ import annotations

import hashlib
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeAlias, TypeVar

from sqlalchemy import ColumnElement, Connection, and_, bindparam, delete, select, update

from amberbox.link.frames import START, Hello, JournalPosition, LinkRow, WriterReach
from amberbox.link.ledger import (
    LOST,
    OTHER,
    HeldRun,
    LinkAdmission,
    RowConflict,
    StaleEpochError,
    StoredRows,
    StoreLedger,
    rewind_cursor,
)
from amberbox.server.database import ServerDatabase, upsert_rows
from amberbox.server.ingest.link_state import (
    admit_key,
    log_event,
    newest_statuses,
    write_statuses,
)
from amberbox.server.schema import ASIDE, COMMITTED, ROBOT, ROW, RUN, STORE, WRITER

# Robot and store
Keys: TypeAlias = tuple[str, str]
# Robot, store, writer, run
RunKey: TypeAlias = tuple[str, str, str, int]
_RUN_KEY = ("robot", "store_id", "writer", "run")


@dataclass(frozen=True, slots=True)
class RowBatch:
    """Rows that a robot sent in one frame; calling the object stores them."""

    robot: str
    epoch: int
    store_id: str
    rows: Sequence[LinkRow]
    upto: Mapping[str, JournalPosition]
    reaches: Mapping[str, WriterReach]
    now_ns: int
    compare: bool = True
    """Whether how far the robot's journals reach is news."""

    def __call__(self, connection: Connection) -> StoredRows:
        """Store the rows; raises StaleEpochError when the robot has since connected again."""
        (outcome,) = store_batches(connection, [self])
        if isinstance(outcome, StaleEpochError):
            raise outcome
        return outcome

    @property
    def keys(self) -> Keys:
        """The robot and its store."""
        return self.robot, self.store_id

    @property
    def news(self) -> Mapping[str, WriterReach]:
        """The reaches of the robot's journals, where they are to be compared."""
        return self.reaches if self.compare else {}

    def runs(self) -> set[RunKey]:
        """Return the runs of the rows."""
        return {(*self.keys, row.writer, row.run) for row in self.rows}

    def stated(self) -> Iterator[RunKey]:
        """Yield the runs whose reach is stated."""
        for writer, reach in self.news.items():
            yield from ((*self.keys, writer, one.run) for one in reach.runs)


@dataclass(slots=True)
class _Ledgers:
    """The ledgers of some stores in one transaction, with pending writes."""

    connection: Connection
    epochs: dict[str, int] = field(default_factory=dict)
    stores: dict[Keys, StoreLedger] = field(default_factory=dict)
    committed: dict[RunKey, list[tuple[int, int]]] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)
    statuses: list[dict[str, Any]] = field(default_factory=list)
    changed_runs: set[RunKey] = field(default_factory=set)
    changed_cursors: set[Keys] = field(default_factory=set)

    def load(self, batches: Sequence[RowBatch]) -> None:
        """Read the state of the stores and runs of the batches."""
        robots = {batch.robot for batch in batches}
        epochs = select(ROBOT.c.robot, ROBOT.c.epoch).where(ROBOT.c.robot.in_(robots))
        self.epochs = {row.robot: row.epoch for row in self.connection.execute(epochs)}
        self.stores = {batch.keys: StoreLedger() for batch in batches}
        self._load_cursors(WRITER.c.robot.in_(robots))
        written = {run for batch in batches for run in batch.runs()}
        for run in written.union(*(batch.stated() for batch in batches)):
            for row in self.connection.execute(_RUN_ROW, _place(run)):
                self.stores[run[:2]].runs[run[2:]] = HeldRun(row.run, row.boot, row.end_seq)
        for run in written:
            found = self.connection.execute(_COMMITTED_ROWS, _place(run))
            self.committed[run] = [(row.from_seq, row.to_seq) for row in found]

    def load_store(self, keys: Keys) -> StoreLedger:
        """Read the whole state of a store."""
        store = self.stores[keys] = StoreLedger()
        self._load_cursors(_of(WRITER, keys))
        for row in self.connection.execute(select(RUN).where(_of(RUN, keys))):
            store.runs[row.writer, row.run] = HeldRun(row.run, row.boot, row.end_seq)
        return store

    def _load_cursors(self, where: ColumnElement[bool]) -> None:
        for row in self.connection.execute(select(WRITER).where(where)):
            store = self.stores.get((row.robot, row.store_id))
            if store is not None:
                store.cursor[row.writer] = JournalPosition(row.run, row.seq)
                store.received[row.writer] = JournalPosition(row.upto_run, row.upto_seq)

    def store(self, batch: RowBatch) -> StoredRows | StaleEpochError:
        """Add the rows of a batch to the ledger, each once."""
        if self.epochs.get(batch.robot) != batch.epoch:
            return StaleEpochError()
        store = self.stores[batch.keys]
        conflicts = self.compare(batch.keys, batch.news, batch.now_ns, is_hello=False)
        new, contradicting = self._new_rows(batch)
        about = {"robot": batch.robot, "store_id": batch.store_id, "received_ns": batch.now_ns}
        self.rows += ({**about, **columns(row)} for row in new)
        self.statuses += newest_statuses(batch.robot, batch.store_id, new, batch.now_ns)
        store.advance(batch.upto, batch.reaches, conflicts)
        self.changed_cursors.add(batch.keys)
        return StoredRows(dict(store.cursor), tuple(new), tuple(contradicting), tuple(conflicts))

    def compare(
        self, keys: Keys, reaches: Mapping[str, WriterReach], now_ns: int, *, is_hello: bool
    ) -> list[RowConflict]:
        """Set aside rows that the robot no longer has, and log it; note the boots of runs."""
        store = self.stores[keys]
        conflicts = store.conflicts(reaches, is_hello=is_hello)
        if conflicts:
            self.write()
            moved = sum(_store_conflict(self.connection, keys, one, now_ns) for one in conflicts)
            for one in conflicts:
                store.cut(one)
            for why in {one.why for one in conflicts if moved or one.why == OTHER}:
                text = _conflict_text(why, conflicts, moved)
                log_event(self.connection, keys[0], now_ns, why, text)
        self.changed_runs.update((*keys, *run) for run in store.note_boots(reaches))
        return conflicts

    def _new_rows(self, batch: RowBatch) -> tuple[list[LinkRow], list[LinkRow]]:
        """Return the rows that are new, and those at a known position with other content."""
        runs: dict[tuple[str, int], dict[int, LinkRow]] = {}
        contradicting: list[LinkRow] = []
        for row in batch.rows:
            first = runs.setdefault((row.writer, row.run), {}).setdefault(row.seq, row)
            if first != row:
                contradicting.append(row)
        store, new = self.stores[batch.keys], list[LinkRow]()
        for run, rows in runs.items():
            known: dict[int, LinkRow] = {}
            if min(rows) < store.end_of(*run):
                self.write()  # rows of this transaction count as well
                held = ROW.c.seq.between(min(rows), max(rows))
                chosen = select(ROW).where(_of(ROW, batch.keys, run), held)
                known = {found.seq: _row(found) for found in self.connection.execute(chosen)}
            contradicting += [rows[n] for n, row in known.items() if n in rows and rows[n] != row]
            committed = self.committed[*batch.keys, *run]
            new += [
                row
                for seq, row in rows.items()
                if seq not in known and not any(low <= seq < high for low, high in committed)
            ]
            store.extend(*run, max(rows) + 1)
            self.changed_runs.add((*batch.keys, *run))
        if contradicting:
            write_conflicts(self.connection, batch.keys, contradicting, OTHER, batch.now_ns)
            text = (
                f"{len(contradicting)} rows have other contents than those held at their positions"
            )
            log_event(self.connection, batch.robot, batch.now_ns, OTHER, text)
        return new, contradicting

    def write(self) -> None:
        """Write all changes, one statement per table."""
        insert(self.connection, self.rows)
        write_statuses(self.connection, self.statuses)
        runs = [
            {**dict(zip(_RUN_KEY, run, strict=True)), "boot": held.boot, "end_seq": held.end_seq}
            for run in sorted(self.changed_runs)
            for held in [self.stores[run[:2]].runs[run[2:]]]
        ]
        upsert_rows(self.connection, RUN, runs, ("boot", "end_seq"))
        cursors = [
            {
                "robot": keys[0], "store_id": keys[1], "writer": writer, "run": at.run,
                "seq": at.seq, "upto_run": received.run, "upto_seq": received.seq,
            }
            for keys in sorted(self.changed_cursors)
            for writer, at in self.stores[keys].cursor.items()
            for received in [self.stores[keys].received.get(writer, at)]
        ]  # fmt: skip
        upsert_rows(self.connection, WRITER, cursors, ("run", "seq", "upto_run", "upto_seq"))
        self.rows, self.statuses = [], []
        self.changed_runs, self.changed_cursors = set(), set()


def store_batches(
    connection: Connection, batches: Sequence[RowBatch]
) -> list[StoredRows | StaleEpochError]:
    """Store the rows of batches in their order; return the result of each."""
    ledgers = _Ledgers(connection)
    ledgers.load(batches)
    outcomes = [ledgers.store(batch) for batch in batches]
    ledgers.write()
    return outcomes


def admit(connection: Connection, hello: Hello, now_ns: int) -> LinkAdmission:
    """Begin a new epoch of a robot; frames of older epochs are refused from now on."""
    known = connection.execute(select(ROBOT.c.epoch).where(ROBOT.c.robot == hello.robot)).scalar()
    values = {
        "robot": hello.robot, "epoch": (known or 0) + 1, "store_id": hello.store_id,
        "boot_id": hello.boot_id, "config_hash": hello.config_hash, "version": hello.version,
        "connected": True, "connected_ns": now_ns, "last_seen_ns": now_ns,
        "backlog": 0, "backlog_bytes": 0,
    }  # fmt: skip
    upsert_rows(connection, ROBOT, [values], [name for name in values if name != "robot"])
    is_new = _enter_store(connection, hello, now_ns)
    ledgers, keys = _Ledgers(connection), (hello.robot, hello.store_id)
    store = ledgers.load_store(keys)
    conflicts = ledgers.compare(keys, hello.writers, now_ns, is_hello=True)
    store.cursor = dict.fromkeys(hello.writers, START) | rewind_cursor(store.cursor, conflicts)
    store.received = dict(store.cursor)
    ledgers.changed_cursors.add(keys)
    ledgers.write()
    return LinkAdmission(int(values["epoch"]), dict(store.cursor), tuple(conflicts), is_new)


def _enter_store(connection: Connection, hello: Hello, now_ns: int) -> bool:
    """Add a store; return whether it is another one than this robot had before."""
    stores = select(STORE.c.store_id).where(STORE.c.robot == hello.robot)
    known = set(connection.scalars(stores))
    if known and hello.store_id not in known:
        text = f"it has a new store ({hello.store_id}): its disk was replaced, or made anew"
        log_event(connection, hello.robot, now_ns, "new_store", text)
    is_trusted = admit_key(connection, hello.robot, hello.store_id, hello.public_key, now_ns)
    values = {"robot": hello.robot, "store_id": hello.store_id, "first_seen_ns": now_ns,
              "public_key": hello.public_key if is_trusted else ""}  # fmt: skip
    upsert_rows(connection, STORE, [values], ["public_key"] if values["public_key"] else ())
    return hello.store_id not in known


def drop_committed(
    connection: Connection,
    robot: str,
    store_id: str,
    writer: str,
    run: int,
    from_seq: int,
    to_seq: int,
) -> int:
    """Note that the archive holds ``[from_seq, to_seq)`` of a run; delete those rows, return how
    many.

    Rows of that range that arrive later are ignored.
    """
    of_run = _of(COMMITTED, (robot, store_id), (writer, run))
    meets = and_(of_run, COMMITTED.c.from_seq <= to_seq, COMMITTED.c.to_seq >= from_seq)
    low, high = from_seq, to_seq
    for found in connection.execute(select(COMMITTED).where(meets)):
        low, high = min(low, found.from_seq), max(high, found.to_seq)
    connection.execute(delete(COMMITTED).where(meets))
    values = {"robot": robot, "store_id": store_id, "writer": writer, "run": run,
              "from_seq": low, "to_seq": high}  # fmt: skip
    connection.execute(COMMITTED.insert(), [values])
    rows = _of(ROW, (robot, store_id), (writer, run))
    dropped = delete(ROW).where(rows, ROW.c.seq >= from_seq, ROW.c.seq < to_seq)
    return connection.execute(dropped).rowcount


def _of(table: Any, keys: Keys, run: tuple[str, int] | None = None) -> ColumnElement[bool]:
    """Return the condition for the rows of a store, or of one run of a writer."""
    of_store = and_(table.c.robot == keys[0], table.c.store_id == keys[1])
    return and_(of_store, table.c.writer == run[0], table.c.run == run[1]) if run else of_store


def _select_run(table: Any) -> Any:
    """Return the statement that selects a table's rows of one run; built once, used for many.

    (Selecting many runs by a list of keys would not use the table's index.)
    """
    return select(table).where(*(table.c[name] == bindparam(f"of_{name}") for name in _RUN_KEY))


_RUN_ROW, _COMMITTED_ROWS = _select_run(RUN), _select_run(COMMITTED)


def _place(run: RunKey) -> dict[str, Any]:
    return {f"of_{name}": value for name, value in zip(_RUN_KEY, run, strict=True)}


def _conflict_text(why: str, found: Sequence[RowConflict], moved: int) -> str:
    places = ", ".join(f"{a.writer} run {a.run} from {a.from_seq}" for a in found if a.why == why)
    if why == LOST:
        return f"{moved} rows that came early are no more on the robot after a power cut: {places}"
    return f"the robot's record is another one than before ({places}): was an old image restored?"


def _store_conflict(connection: Connection, keys: Keys, one: RowConflict, now_ns: int) -> int:
    """Set the rows of a run aside from a position on; return how many."""
    run = one.writer, one.run
    where = and_(_of(ROW, keys, run), ROW.c.seq >= one.from_seq)
    rows = [_row(found) for found in connection.execute(select(ROW).where(where))]
    write_conflicts(connection, keys, rows, one.why, now_ns)
    connection.execute(delete(ROW).where(where))
    if one.from_seq == 0:
        connection.execute(delete(RUN).where(_of(RUN, keys, run)))
    else:
        connection.execute(update(RUN).where(_of(RUN, keys, run)).values(end_seq=one.from_seq))
    return len(rows)


def _row(found: Any) -> LinkRow:
    return LinkRow(found.writer, found.run, found.seq, found.channel, found.log_ns, found.data)


def write_conflicts(
    connection: Connection, keys: Keys, rows: Iterable[LinkRow], why: str, now_ns: int
) -> None:
    """Store rows beside the record, with the reason."""
    about = {"robot": keys[0], "store_id": keys[1], "why": why, "at_ns": now_ns}
    upsert_rows(connection, ASIDE, [{**about, **columns(r), "sha256": row_digest(r)} for r in rows])


def row_digest(row: LinkRow) -> str:
    """Return the SHA-256 of a row's content, to compare rows at one position."""
    about = f"{row.channel}\n{row.log_ns}\n".encode()
    return hashlib.sha256(about + row.data).hexdigest()


def insert(connection: Connection, values: Sequence[Mapping[str, Any]]) -> None:
    """Insert rows, given as columns."""
    if values:
        connection.execute(ROW.insert(), values)


def columns(row: LinkRow) -> dict[str, Any]:
    """Return the columns of a row."""
    return {
        "writer": row.writer, "run": row.run, "seq": row.seq, "channel": row.channel,
        "log_ns": row.log_ns, "data": row.data,
    }  # fmt: skip


T = TypeVar("T")
Work = Callable[[Connection], T]
_Piece: TypeAlias = "tuple[Work[Any], Future[Any]]"
_Result: TypeAlias = tuple[Any, BaseException | None]

# Largest number of jobs in one transaction
_MOST = 256
# Least time between transactions: under load each does more, and others get to write
GATHER_S = 0.05


class GroupedWrites:
    """Runs jobs on the database in their order, each atomically.

    Batches of rows are stored first and together. The result of a job is available when it is
    durable. ``close`` finishes submitted jobs.
    """

    def __init__(self, database: ServerDatabase, gather_s: float = GATHER_S) -> None:
        self._database = database
        self._queue: queue.SimpleQueue[_Piece | None] = queue.SimpleQueue()
        self._gather_s = gather_s
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="link writes", daemon=True)
        self._thread.start()

    def submit(self, work: Work[T]) -> Future[T]:
        """Queue a job; its future gets the result or exception once it is durable."""
        future: Future[T] = Future()
        if self._closing.is_set():
            future.set_exception(RuntimeError("the server is stopping"))
        else:
            self._queue.put((work, future))
        return future

    def close(self) -> None:
        """Finish the submitted jobs, then stop."""
        self._closing.set()
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        ended_s = -self._gather_s
        while True:
            group = [self._queue.get()]
            self._closing.wait(max(ended_s + self._gather_s - time.monotonic(), 0.0))
            while len(group) < _MOST and not self._queue.empty():
                group.append(self._queue.get())
            self._do([one for one in group if one is not None])
            ended_s = time.monotonic()
            if None in group:
                return

    def _do(self, group: Sequence[_Piece]) -> None:
        batches = [(work, future) for work, future in group if isinstance(work, RowBatch)]
        others = [(work, future) for work, future in group if not isinstance(work, RowBatch)]
        futures = [future for _, future in (*batches, *others)]
        try:
            with self._database.begin() as connection:
                results = _stored(connection, [batch for batch, _ in batches])
                results += [_tried(connection, work) for work, _ in others]
        except Exception as error:  # the transaction itself failed: nothing is stored
            results = [(None, error)] * len(group)
        for future, (result, trouble) in zip(futures, results, strict=True):
            if not future.set_running_or_notify_cancel():
                continue
            if trouble is None:
                future.set_result(result)
            else:
                future.set_exception(trouble)


def _stored(connection: Connection, batches: Sequence[RowBatch]) -> list[_Result]:
    """Store batches together; when that fails, each by itself."""
    if len(batches) > 1:
        found, _ = _tried(connection, partial(store_batches, batches=batches))
        if found is not None:
            return [
                (None, one) if isinstance(one, StaleEpochError) else (one, None) for one in found
            ]
    return [_tried(connection, batch) for batch in batches]


def _tried(connection: Connection, work: Work[Any]) -> _Result:
    """Run one job; when it fails, undo only that one."""
    point = connection.begin_nested()
    try:
        result = work(connection)
    except Exception as error:  # raised to the submitter; others continue
        point.rollback()
        return None, error
    point.commit()
    return result, None
