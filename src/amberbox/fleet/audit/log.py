"""Add rows to the audit log, and read them.

A row is added in the transaction of the change it speaks of: there is never one without the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass

from sqlalchemy import Connection, Select, select

from amberbox.core.errors import UsageError
from amberbox.fleet.audit.entry import START, Entry, Row, row_after
from amberbox.fleet.audit.tables import AUDIT, AUDIT_HEAD
from amberbox.fleet.database.upsert import upsert

_AT_ONCE = 1_000


@dataclass(frozen=True, slots=True)
class Head:
    """How far the log goes: its newest row. Kept elsewhere, it proves all rows up to there."""

    seq: int
    hash: str

    def __str__(self) -> str:
        return f"{self.seq} {self.hash}"

    @classmethod
    def from_text(cls, text: str) -> Head:
        """Read a head as it is printed; raises UsageError."""
        number, _, digest = text.strip().partition(" ")
        if number.isdecimal() and len(digest) == len(START) and not set(digest) - set(_HEX):
            return cls(int(number), digest)
        raise UsageError(
            f"not a head of an audit log: {text!r}", "it is a number, a space and 64 hex digits"
        )


_HEX = "0123456789abcdef"


def append(connection: Connection, now_ns: int, entry: Entry) -> Row:
    """Add a row; the connection is in a transaction that writes."""
    before = _held(connection)
    row = row_after(before.seq, before.hash, now_ns, entry)
    connection.execute(AUDIT.insert(), [asdict(row)])
    newest = upsert(connection.dialect, AUDIT_HEAD, ("one",), ("seq", "hash"))
    connection.execute(newest, [{"one": 1, "seq": row.seq, "hash": row.hash}])
    return row


def _held(connection: Connection) -> Head:
    """Return the head, made if there is none, and keep other writers from it until the commit."""
    first = upsert(connection.dialect, AUDIT_HEAD, ("one",), ())
    connection.execute(first, [{"one": 1, "seq": 0, "hash": START}])
    chosen = select(AUDIT_HEAD.c.seq, AUDIT_HEAD.c.hash).with_for_update()
    return Head(*connection.execute(chosen).one())


def head(connection: Connection) -> Head:
    """Return how far the log goes; number 0 when nothing is in it."""
    found = connection.execute(select(AUDIT_HEAD.c.seq, AUDIT_HEAD.c.hash)).one_or_none()
    return Head(0, START) if found is None else Head(*found)


def rows(
    connection: Connection,
    *,
    after_seq: int = 0,
    from_ns: int | None = None,
    to_ns: int | None = None,
    principal: str = "",
    action: str = "",
) -> Iterator[Row]:
    """Yield rows in order, a part at a time; all filters must fit, an empty one fits all."""
    chosen = select(AUDIT).order_by(AUDIT.c.seq).limit(_AT_ONCE)
    chosen = chosen if from_ns is None else chosen.where(AUDIT.c.time_ns >= from_ns)
    chosen = chosen if to_ns is None else chosen.where(AUDIT.c.time_ns < to_ns)
    chosen = chosen.where(AUDIT.c.principal == principal) if principal else chosen
    chosen = chosen.where(AUDIT.c.action == action) if action else chosen
    while some := _after(connection, chosen, after_seq):
        yield from some
        after_seq = some[-1].seq


def _after(connection: Connection, chosen: Select[tuple[object, ...]], seq: int) -> list[Row]:
    found = connection.execute(chosen.where(AUDIT.c.seq > seq)).mappings()
    return [Row(**row) for row in found]
