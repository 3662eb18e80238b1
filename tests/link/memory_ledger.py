"""A ledger in memory: the rules of admission in their plainest form, to compare others with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from amberbox.link.frames import START, Hello, JournalPosition, LinkRow, WriterReach
from amberbox.link.ledger import (
    OTHER,
    ConflictReason,
    HeldRun,
    LinkAdmission,
    RowConflict,
    StaleEpochError,
    StoredRows,
    advance_cursor,
    find_conflicts,
    rewind_cursor,
)

Key = tuple[str, str, int, int]
"""Store, writer, run, seq: what makes a row of a robot the one it is."""


@dataclass(slots=True)
class _Store:
    """The held rows of one store."""

    cursor: dict[str, JournalPosition] = field(default_factory=dict)
    upto: dict[str, JournalPosition] = field(default_factory=dict)
    boots: dict[tuple[str, int], str] = field(default_factory=dict)


class MemoryLedger:
    """Keeps one robot's rows in memory; the rules in their plainest form."""

    def __init__(self) -> None:
        self.epoch = 0
        self.rows: dict[Key, LinkRow] = {}
        self.aside: list[tuple[str, LinkRow, ConflictReason]] = []
        self._stores: dict[str, _Store] = {}

    def admit(self, hello: Hello) -> LinkAdmission:
        """Begin a new epoch: frames of an older one are refused from now on."""
        self.epoch += 1
        is_new = hello.store_id not in self._stores
        store = self._stores.setdefault(hello.store_id, _Store())
        found = self._compare(hello.store_id, hello.writers, is_hello=True)
        store.cursor = rewind_cursor(store.cursor, found)
        store.upto = dict(store.cursor)
        for writer in hello.writers:
            store.cursor.setdefault(writer, START)
        self._note_boots(store, hello.writers)
        return LinkAdmission(self.epoch, dict(store.cursor), tuple(found), is_new)

    def store(
        self,
        epoch: int,
        store_id: str,
        rows: Sequence[LinkRow],
        upto: Mapping[str, JournalPosition],
        reaches: Mapping[str, WriterReach],
        *,
        compare: bool = True,
    ) -> StoredRows:
        """Take rows once each; raises StaleEpochError in an older epoch."""
        if epoch != self.epoch:
            raise StaleEpochError
        store = self._stores[store_id]
        news = reaches if compare else {}
        found = self._compare(store_id, news, is_hello=False)
        self._note_boots(store, news)
        new, conflicts = [], []
        for row in rows:
            key = (store_id, row.writer, row.run, row.seq)
            if key not in self.rows:
                self.rows[key] = row
                new.append(row)
            elif self.rows[key] != row and (store_id, row, OTHER) not in self.aside:
                self.aside.append((store_id, row, OTHER))
                conflicts.append(row)
        store.upto = rewind_cursor({**store.upto, **upto}, found)
        store.cursor = advance_cursor(rewind_cursor(store.cursor, found), store.upto, reaches)
        return StoredRows(dict(store.cursor), tuple(new), tuple(conflicts), tuple(found))

    def _compare(
        self, store_id: str, reaches: Mapping[str, WriterReach], *, is_hello: bool
    ) -> list[RowConflict]:
        """Put aside what the robot has no more."""
        store = self._stores[store_id]
        found: list[RowConflict] = []
        for writer, reach in reaches.items():
            held, cursor = self._held(store_id, writer), store.cursor.get(writer, START)
            found += find_conflicts(writer, held, cursor, reach, is_hello=is_hello)
        for one in found:
            for key in [k for k in self.rows if k[:3] == (store_id, one.writer, one.run)]:
                if key[3] >= one.from_seq:
                    self.aside.append((store_id, self.rows.pop(key), one.why))
            if one.from_seq == 0:
                self._stores[store_id].boots.pop((one.writer, one.run), None)
        return found

    def _held(self, store_id: str, writer: str) -> list[HeldRun]:
        store = self._stores[store_id]
        ends = {run: 0 for w, run in store.boots if w == writer}
        for of, w, run, seq in self.rows:
            if (of, w) == (store_id, writer):
                ends[run] = max(ends.get(run, 0), seq + 1)
        at = store.cursor.get(writer, START)
        if at.seq and at.run in ends:
            ends[at.run] = max(ends[at.run], at.seq)
        return [
            HeldRun(r, store.boots.get((writer, r), ""), end) for r, end in sorted(ends.items())
        ]

    def _note_boots(self, store: _Store, reaches: Mapping[str, WriterReach]) -> None:
        for writer, reach in reaches.items():
            for run in reach.runs:
                store.boots[writer, run.run] = run.boot
