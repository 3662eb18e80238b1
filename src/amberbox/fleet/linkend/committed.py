"""Rows that came early are a cache: they go when the journal that holds them is committed."""

from __future__ import annotations

from collections.abc import Mapping

from sqlalchemy import Connection, and_, delete, select

from amberbox.fleet.linkend.tables import COMMITTED, ROW
from amberbox.link.frames import Row


def drop_committed(
    connection: Connection,
    robot: str,
    store_id: str,
    writer: str,
    run: int,
    from_seq: int,
    to_seq: int,
) -> int:
    """Note that the archive holds ``[from_seq, to_seq)`` of a run; drop those rows, count them.

    Rows of that stretch that come later are not taken any more.
    """
    table = COMMITTED.c
    place = and_(
        table.robot == robot, table.store_id == store_id, table.writer == writer, table.run == run
    )
    low, high = from_seq, to_seq
    meets = and_(place, table.from_seq <= to_seq, table.to_seq >= from_seq)
    for found in connection.execute(select(COMMITTED).where(meets)):
        low, high = min(low, found.from_seq), max(high, found.to_seq)
    connection.execute(delete(COMMITTED).where(meets))
    values = {"robot": robot, "store_id": store_id, "writer": writer, "run": run,
              "from_seq": low, "to_seq": high}  # fmt: skip
    connection.execute(COMMITTED.insert(), [values])
    rows = and_(
        ROW.c.robot == robot, ROW.c.store_id == store_id, ROW.c.writer == writer, ROW.c.run == run,
        ROW.c.seq >= from_seq, ROW.c.seq < to_seq,
    )  # fmt: skip
    return connection.execute(delete(ROW).where(rows)).rowcount


def without_committed(
    connection: Connection,
    keys: tuple[str, str],
    writer: str,
    run: int,
    rows: Mapping[int, Row],
) -> list[Row]:
    """Leave out the rows that the archive holds already."""
    if not rows:
        return []
    table = COMMITTED.c
    where = and_(
        table.robot == keys[0], table.store_id == keys[1], table.writer == writer,
        table.run == run, table.from_seq <= max(rows), table.to_seq > min(rows),
    )  # fmt: skip
    found = [
        (row.from_seq, row.to_seq) for row in connection.execute(select(COMMITTED).where(where))
    ]
    return [row for seq, row in rows.items() if not any(low <= seq < high for low, high in found)]
