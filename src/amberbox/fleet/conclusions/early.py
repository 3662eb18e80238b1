"""Records that came over the link: those that no journal in the archive holds, and those aside."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec
from sqlalchemy import ColumnElement, Connection, Row, and_, exists, select

from amberbox.fleet.archive.catalogue import COMMITTED
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.conclusions.columns import Span
from amberbox.fleet.conclusions.entry import Entry
from amberbox.fleet.conclusions.findings import fits
from amberbox.fleet.linkend.presence import short
from amberbox.fleet.linkend.tables import ASIDE, BOOT, ROW, RUN


def from_link(
    connection: Connection, robot: str, channel: str, span: Span, limit: int, *, newest: bool
) -> list[Entry]:
    """Return rows of the link that are in no committed journal."""
    held = and_(
        JOURNALS.c.robot == ROW.c.robot, JOURNALS.c.store_id == ROW.c.store_id,
        JOURNALS.c.writer == ROW.c.writer, JOURNALS.c.run == ROW.c.run,
        JOURNALS.c.first_seq <= ROW.c.seq, JOURNALS.c.end_seq > ROW.c.seq,
        JOURNALS.c.state == COMMITTED,
    )  # fmt: skip
    wanted = select(ROW).where(*_in(ROW, robot, channel, span), ~exists().where(held))
    order = ROW.c.log_ns.desc() if newest else ROW.c.log_ns
    return _entries(connection.execute(wanted.order_by(order).limit(limit)))


def from_aside(connection: Connection, robot: str, channel: str, span: Span) -> list[Entry]:
    """Return rows that the robot has no more, with the reason."""
    wanted = select(ASIDE).where(*_in(ASIDE, robot, channel, span))
    return _entries(connection.execute(wanted))


def offsets(connection: Connection, robot: str) -> dict[tuple[str, str, int], int]:
    """Return how far the server's clock was ahead, by store, writer and run.

    The names of journals hold the beginning of the boot's id only.
    """
    boots = connection.execute(select(BOOT).where(BOOT.c.robot == robot)).all()
    known = {short(boot.boot_id): boot.offset_ns for boot in boots}
    runs = connection.execute(select(RUN).where(RUN.c.robot == robot, RUN.c.boot != ""))
    return {
        (run.store_id, run.writer, run.run): known[run.boot[:8]]
        for run in runs
        if run.boot[:8] in known
    }


def _in(table: Any, robot: str, channel: str, span: Span) -> list[ColumnElement[bool]]:
    from_ns, to_ns = span
    found = [table.c.robot == robot, table.c.channel == channel]
    found += [] if from_ns is None else [table.c.log_ns >= from_ns]
    return found + ([] if to_ns is None else [table.c.log_ns < to_ns])


def _entries(rows: Iterable[Row[Any]]) -> list[Entry]:
    found = []
    for row in rows:
        try:
            values = msgspec.json.decode(row.data, type=dict[str, Any])
        except msgspec.MsgspecError:
            continue  # kept as it came, but nothing that could be shown
        if not fits(values):
            continue
        why = getattr(row, "why", "")
        found.append(
            Entry(row.channel, row.log_ns, row.log_ns, row.store_id, row.writer, row.run, row.seq,
                  values, why)
        )  # fmt: skip
    return found
