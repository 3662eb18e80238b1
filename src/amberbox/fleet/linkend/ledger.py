"""The ledger of the link in the server's database: the rules of ``link/ledger.py`` in SQL.

Every function runs inside a transaction of its caller; nothing is acknowledged before its end.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import ColumnElement, Connection, and_, delete, select, update

from amberbox.fleet.database.upsert import upsert
from amberbox.fleet.linkend import board
from amberbox.fleet.linkend.committed import without_committed
from amberbox.fleet.linkend.events import note
from amberbox.fleet.linkend.signingkeys import admit_key
from amberbox.fleet.linkend.tables import ASIDE, ROBOT, ROW, RUN, STORE, WRITER
from amberbox.link.frames import Hello, Row
from amberbox.link.history import LOST, OTHER, Aside, Held, aside, set_back
from amberbox.link.ledger import Admission, StaleEpochError, Stored, advanced
from amberbox.link.positions import START, Place, Reach

Upto = dict[str, Place]


def admit(connection: Connection, hello: Hello, now_ns: int) -> Admission:
    """Begin a new epoch of a robot: whatever comes in an older one is refused from now on."""
    epoch = _next_epoch(connection, hello, now_ns)
    is_new = _note_store(connection, hello, now_ns)
    cursor, _ = _cursors(connection, hello.robot, hello.store_id)
    keys = hello.robot, hello.store_id
    found = _compare(connection, keys, cursor, hello.writers, now_ns, is_hello=True)
    cursor = dict.fromkeys(hello.writers, START) | set_back(cursor, found)
    write_cursors(connection, [(keys, cursor, cursor)])
    _note_runs(connection, keys, hello.writers)
    return Admission(epoch, cursor, tuple(found), is_new)


def store(
    connection: Connection,
    robot: str,
    epoch: int,
    store_id: str,
    rows: Sequence[Row],
    upto: Mapping[str, Place],
    reaches: Mapping[str, Reach],
    now_ns: int,
    *,
    compare: bool = True,
) -> Stored:
    """Take rows once each; raises StaleEpochError when the robot has connected again since."""
    keys = robot, store_id
    _fence(connection, robot, epoch)
    cursor, received = _cursors(connection, *keys)
    news = reaches if compare else {}
    found = _compare(connection, keys, cursor, news, now_ns, is_hello=False)
    _note_runs(connection, keys, news)
    new, conflicts = _take(connection, keys, rows, now_ns)
    board.show(connection, robot, store_id, new, now_ns)
    received = set_back({**received, **upto}, found)
    cursor = advanced(set_back(cursor, found), received, reaches)
    write_cursors(connection, [(keys, cursor, received)])
    return Stored(cursor, tuple(new), tuple(conflicts), tuple(found))


def _next_epoch(connection: Connection, hello: Hello, now_ns: int) -> int:
    known = connection.execute(select(ROBOT.c.epoch).where(ROBOT.c.robot == hello.robot)).scalar()
    values = {
        "robot": hello.robot, "epoch": (known or 0) + 1, "store_id": hello.store_id,
        "boot_id": hello.boot_id, "config_hash": hello.config_hash, "version": hello.version,
        "connected": True, "connected_ns": now_ns, "last_seen_ns": now_ns,
        "backlog": 0, "backlog_bytes": 0,
    }  # fmt: skip
    change = [name for name in values if name != "robot"]
    connection.execute(upsert(connection.dialect, ROBOT, ["robot"], change), [values])
    return int(values["epoch"])


def _note_store(connection: Connection, hello: Hello, now_ns: int) -> bool:
    """Enter a store; tell whether it is another one than this robot had before."""
    stores = select(STORE.c.store_id).where(STORE.c.robot == hello.robot)
    known = set(connection.scalars(stores))
    if known and hello.store_id not in known:
        text = f"it has a new store ({hello.store_id}): its disk was replaced, or made anew"
        note(connection, hello.robot, now_ns, "new_store", text)
    is_trusted = admit_key(connection, hello.robot, hello.store_id, hello.public_key, now_ns)
    values = {"robot": hello.robot, "store_id": hello.store_id, "first_seen_ns": now_ns,
              "public_key": hello.public_key if is_trusted else ""}  # fmt: skip
    change = ["public_key"] if hello.public_key and is_trusted else []
    connection.execute(upsert(connection.dialect, STORE, ["robot", "store_id"], change), [values])
    return hello.store_id not in known


def _fence(connection: Connection, robot: str, epoch: int) -> None:
    current = connection.execute(select(ROBOT.c.epoch).where(ROBOT.c.robot == robot)).scalar()
    if current != epoch:
        raise StaleEpochError


def _of(table: Any, keys: tuple[str, str]) -> ColumnElement[bool]:
    return and_(table.c.robot == keys[0], table.c.store_id == keys[1])


def _cursors(connection: Connection, robot: str, store_id: str) -> tuple[Upto, Upto]:
    """Return the cursor of each writer, and up to where rows have been received."""
    rows = connection.execute(select(WRITER).where(_of(WRITER, (robot, store_id)))).all()
    cursor = {row.writer: Place(row.run, row.seq) for row in rows}
    return cursor, {row.writer: Place(row.upto_run, row.upto_seq) for row in rows}


def write_cursors(
    connection: Connection, cursors: Iterable[tuple[tuple[str, str], Upto, Upto]]
) -> None:
    """Write the cursors of stores (robot and store, cursor, up to where rows were received)."""
    values = [
        {
            "robot": keys[0], "store_id": keys[1], "writer": w, "run": at.run, "seq": at.seq,
            "upto_run": received.get(w, at).run, "upto_seq": received.get(w, at).seq,
        }
        for keys, cursor, received in cursors
        for w, at in cursor.items()
    ]  # fmt: skip
    if values:
        key, change = ("robot", "store_id", "writer"), ("run", "seq", "upto_run", "upto_seq")
        connection.execute(upsert(connection.dialect, WRITER, key, change), values)


def _note_runs(connection: Connection, keys: tuple[str, str], reaches: Mapping[str, Reach]) -> None:
    """Note which boot wrote each run, where that is not known yet."""
    if not reaches:
        return
    runs = connection.execute(select(RUN).where(_of(RUN, keys), RUN.c.boot != ""))
    known = {(row.writer, row.run) for row in runs}
    values = [
        {
            "robot": keys[0], "store_id": keys[1], "writer": writer, "run": run.run,
            "boot": run.boot, "end_seq": 0,
        }
        for writer, reach in reaches.items()
        for run in reach.runs
        if (writer, run.run) not in known
    ]  # fmt: skip
    if values:
        key = ("robot", "store_id", "writer", "run")
        connection.execute(upsert(connection.dialect, RUN, key, ("boot",)), values)


def _held(connection: Connection, keys: tuple[str, str], cursor: Upto) -> dict[str, list[Held]]:
    """Return what is held of each writer, run by run."""
    found: dict[str, list[Held]] = {}
    wanted = select(RUN).where(_of(RUN, keys)).order_by(RUN.c.writer, RUN.c.run)
    for row in connection.execute(wanted):
        at = cursor.get(row.writer, START)
        end = max(row.end_seq, at.seq if at.run == row.run else 0)
        found.setdefault(row.writer, []).append(Held(row.run, row.boot, end))
    return found


def _compare(
    connection: Connection,
    keys: tuple[str, str],
    cursor: Upto,
    reaches: Mapping[str, Reach],
    now_ns: int,
    *,
    is_hello: bool,
) -> list[Aside]:
    """Put aside what the robot has no more; tell of it."""
    held = _held(connection, keys, cursor) if reaches else {}
    found = [
        one
        for writer, reach in reaches.items()
        for one in aside(
            writer, held.get(writer, ()), cursor.get(writer, START), reach, is_hello=is_hello
        )
    ]
    moved = sum(_move(connection, keys, one, now_ns) for one in found)
    for why in {one.why for one in found if moved or one.why == OTHER}:
        note(connection, keys[0], now_ns, why, _told(why, found, moved))
    return found


def _told(why: str, found: Sequence[Aside], moved: int) -> str:
    places = ", ".join(f"{a.writer} run {a.run} from {a.from_seq}" for a in found if a.why == why)
    if why == LOST:
        return f"{moved} rows that came early are no more on the robot after a power cut: {places}"
    return f"the robot's record is another one than before ({places}): was an old image restored?"


def _move(connection: Connection, keys: tuple[str, str], one: Aside, now_ns: int) -> int:
    """Put the rows of a run aside from a position on; return how many."""
    where = and_(
        _of(ROW, keys), ROW.c.writer == one.writer, ROW.c.run == one.run, ROW.c.seq >= one.from_seq
    )
    rows = [_row(found) for found in connection.execute(select(ROW).where(where))]
    put_aside(connection, keys, rows, one.why, now_ns)
    connection.execute(delete(ROW).where(where))
    run = and_(_of(RUN, keys), RUN.c.writer == one.writer, RUN.c.run == one.run)
    if one.from_seq == 0:
        connection.execute(delete(RUN).where(run))
    else:
        connection.execute(update(RUN).where(run).values(end_seq=one.from_seq))
    return len(rows)


def _row(found: Any) -> Row:
    return Row(found.writer, found.run, found.seq, found.channel, found.log_ns, found.data)


def put_aside(
    connection: Connection, keys: tuple[str, str], rows: Iterable[Row], why: str, now_ns: int
) -> None:
    """Keep rows beside the record."""
    values = [
        {
            "robot": keys[0], "store_id": keys[1], "writer": row.writer, "run": row.run,
            "seq": row.seq, "sha256": digest_of(row), "why": why, "channel": row.channel,
            "log_ns": row.log_ns, "data": row.data, "at_ns": now_ns,
        }
        for row in rows
    ]  # fmt: skip
    if values:
        key = [column.name for column in ASIDE.primary_key.columns]
        connection.execute(upsert(connection.dialect, ASIDE, key, ()), values)


def digest_of(row: Row) -> str:
    """Return what tells two rows at one position apart."""
    about = f"{row.channel}\n{row.log_ns}\n".encode()
    return hashlib.sha256(about + row.data).hexdigest()


def _take(
    connection: Connection, keys: tuple[str, str], rows: Sequence[Row], now_ns: int
) -> tuple[list[Row], list[Row]]:
    """Insert what is new; put aside what is at a known position with other content."""
    runs: dict[tuple[str, int], dict[int, Row]] = {}
    conflicts: list[Row] = []
    for row in rows:
        first = runs.setdefault((row.writer, row.run), {}).setdefault(row.seq, row)
        if first != row:
            conflicts.append(row)
    new: list[Row] = []
    for (writer, run), found in runs.items():
        known = _known(connection, keys, writer, run, found)
        conflicts += [
            found[seq] for seq, row in known.items() if seq in found and found[seq] != row
        ]
        missing = {seq: row for seq, row in found.items() if seq not in known}
        new += without_committed(connection, keys, writer, run, missing)
        _reach(connection, keys, writer, run, max(found) + 1)
    about = {"robot": keys[0], "store_id": keys[1], "received_ns": now_ns}
    insert(connection, [{**about, **columns(row)} for row in new])
    if conflicts:
        put_aside(connection, keys, conflicts, OTHER, now_ns)
        text = f"{len(conflicts)} rows have other contents than those held at their positions"
        note(connection, keys[0], now_ns, OTHER, text)
    return new, conflicts


def _known(
    connection: Connection, keys: tuple[str, str], writer: str, run: int, rows: Mapping[int, Row]
) -> dict[int, Row]:
    where = and_(
        _of(ROW, keys), ROW.c.writer == writer, ROW.c.run == run,
        ROW.c.seq.between(min(rows), max(rows)),
    )  # fmt: skip
    return {found.seq: _row(found) for found in connection.execute(select(ROW).where(where))}


def _reach(connection: Connection, keys: tuple[str, str], writer: str, run: int, end: int) -> None:
    """Note how far a run is held; which boot wrote it the robot has said, or says later."""
    values = {"robot": keys[0], "store_id": keys[1], "writer": writer, "run": run, "boot": "",
              "end_seq": end}  # fmt: skip
    key = ("robot", "store_id", "writer", "run")
    statement = upsert(
        connection.dialect, RUN, key, ("end_seq",), when=lambda new: new.end_seq > RUN.c.end_seq
    )
    connection.execute(statement, [values])


def insert(connection: Connection, values: Sequence[Mapping[str, Any]]) -> None:
    """Insert rows, each as the columns of its table."""
    if values:
        connection.execute(ROW.insert(), values)


def columns(row: Row) -> dict[str, Any]:
    """Return what of a row stands in columns of its own."""
    return {
        "writer": row.writer, "run": row.run, "seq": row.seq, "channel": row.channel,
        "log_ns": row.log_ns, "data": row.data,
    }  # fmt: skip
