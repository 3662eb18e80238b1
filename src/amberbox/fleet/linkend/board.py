"""The status board: the newest status of each component of each robot, kept as rows come."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
from sqlalchemy import Connection, and_, or_, select

from amberbox.blackbox.journal import reserved
from amberbox.fleet.database.upsert import Excluded, upsert
from amberbox.fleet.linkend.tables import STATUS
from amberbox.link.frames import Row

LONGEST = 64 << 10
"""Bytes of a status; a longer one is stored as a row, and not shown."""
_KEY = ("robot", "component", "mode")
_CHANGE = ("level", "store_id", "run", "seq", "log_ns", "received_ns", "data")


class _Status(msgspec.Struct):
    """Of a status what the board is ordered by."""

    component: str
    mode: str = ""
    level: str = "unknown"


_DECODER = msgspec.json.Decoder(_Status)


def show(
    connection: Connection, robot: str, store_id: str, rows: Sequence[Row], now_ns: int
) -> None:
    """Enter statuses; one that stands before what is shown (it came late) changes nothing."""
    enter(connection, entries(robot, store_id, rows, now_ns))


def entries(
    robot: str, store_id: str, rows: Sequence[Row], now_ns: int
) -> Sequence[dict[str, Any]]:
    """Return what rows say to the board: the newest status of each component and mode."""
    found = {(s["component"], s["mode"]): s for s in _entries(robot, store_id, rows, now_ns)}
    return list(found.values())


def enter(connection: Connection, values: Sequence[dict[str, Any]]) -> None:
    """Write entries in their order; of two, the one that stands later in the record is shown."""
    if values:
        statement = upsert(connection.dialect, STATUS, _KEY, _CHANGE, when=_is_newer)
        connection.execute(statement, values)


def board(connection: Connection, robot: str) -> list[dict[str, Any]]:
    """Return the newest statuses of a robot as they were written, in the order of components."""
    wanted = select(STATUS).where(STATUS.c.robot == robot).order_by(*STATUS.primary_key.columns)
    return [
        {**msgspec.json.decode(row.data), "received_ns": row.received_ns, "log_ns": row.log_ns}
        for row in connection.execute(wanted)
    ]


def _entries(
    robot: str, store_id: str, rows: Sequence[Row], now_ns: int
) -> Iterator[dict[str, Any]]:
    for row in sorted((r for r in rows if r.channel == reserved.STATUS), key=lambda r: r.place):
        if len(row.data) > LONGEST:
            continue
        try:
            status = _DECODER.decode(row.data)
        except msgspec.MsgspecError:
            continue  # stored as a row all the same, but nothing the board could show
        yield {
            "robot": robot, "component": status.component[:128], "mode": status.mode[:128],
            "level": status.level[:128], "store_id": store_id, "run": row.run, "seq": row.seq,
            "log_ns": row.log_ns, "received_ns": now_ns, "data": row.data,
        }  # fmt: skip


def _is_newer(new: Excluded) -> Any:
    """Compare positions, not times: a robot's clock may say 1970."""
    shown = STATUS.c
    later = and_(new.run == shown.run, new.seq >= shown.seq)
    return or_(new.store_id != shown.store_id, new.run > shown.run, later)
