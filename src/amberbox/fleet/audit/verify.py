"""Verify the audit log: does every row follow on the one before, and where does it break first?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sqlalchemy import Connection

from amberbox.fleet.audit.entry import START, Row, link
from amberbox.fleet.audit.log import Head, head, rows


@dataclass(frozen=True, slots=True)
class Broken:
    """The first row that is not as it was written, and what is wrong."""

    seq: int
    what: str


@dataclass(frozen=True, slots=True)
class Verified:
    """What was found: rows that hold, how far they go, and the first that does not."""

    rows: int
    head: Head
    broken: Broken | None

    @property
    def holds(self) -> bool:
        """Tell whether the log is as it was written, as far as it can be told."""
        return self.broken is None


def verify(connection: Connection, kept: Iterable[Head] = ()) -> Verified:
    """Follow the log from its first row to its last.

    ``kept`` are heads that were noted elsewhere before: with one of them, nobody could have
    written the log anew up to there without being found out, not even with the database in hand.
    """
    return follow(rows(connection), head(connection), kept)


def follow(chain: Iterable[Row], stated: Head, kept: Iterable[Head] = ()) -> Verified:
    """Judge rows in the order of their numbers, by the head that is stated with them."""
    wanted = {one.seq: one.hash for one in kept}
    reached = Head(0, START)
    for row in chain:
        broken = _judge(reached, row, wanted)
        if broken is not None:
            return Verified(reached.seq, reached, broken)
        reached = Head(row.seq, row.hash)
    return Verified(reached.seq, reached, _end(reached, stated, wanted))


def _judge(reached: Head, row: Row, wanted: dict[int, str]) -> Broken | None:
    if row.seq != reached.seq + 1:
        return Broken(reached.seq + 1, f"missing: row {row.seq} comes after row {reached.seq}")
    if row.hash != link(reached.hash, row):
        return Broken(row.seq, "changed: its hash is not that of its contents and the row before")
    if wanted.get(row.seq, row.hash) != row.hash:
        return Broken(row.seq, "rewritten: it has another hash than the head that was noted")
    return None


def _end(reached: Head, stated: Head, wanted: dict[int, str]) -> Broken | None:
    furthest = max(stated.seq, *wanted, 0)
    if reached.seq < furthest:
        return Broken(reached.seq + 1, f"missing: the log went to row {furthest}")
    if stated != reached:
        return Broken(stated.seq + 1, f"added: the log went to row {stated.seq} only")
    return None
