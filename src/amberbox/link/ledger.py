"""What a server keeps of the link, and the rules by which it does; and one that keeps it in memory.

The server's database follows the same rules (``fleet/linkend``), and tests compare the two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from amberbox.link.frames import Cursor, Hello, Row
from amberbox.link.history import OTHER, Aside, Held, Why, aside, set_back
from amberbox.link.positions import START, Place, Reach

Key = tuple[str, str, int, int]
"""Store, writer, run, seq: what makes a row of a robot the one it is."""


class StaleEpochError(Exception):
    """The robot has connected again since: what comes on an older connection is not taken."""


@dataclass(frozen=True, slots=True)
class Admission:
    """A robot was let in: its epoch, where its rows go on, and what was put aside."""

    epoch: int
    cursor: Cursor
    aside: tuple[Aside, ...] = ()
    is_new_store: bool = False


@dataclass(frozen=True, slots=True)
class Stored:
    """What came of some rows: the new cursor, those that were new, those put aside."""

    cursor: Cursor
    new: tuple[Row, ...] = ()
    conflicts: tuple[Row, ...] = ()
    aside: tuple[Aside, ...] = ()


@dataclass(slots=True)
class _Store:
    """What is held of one store."""

    cursor: dict[str, Place] = field(default_factory=dict)
    upto: dict[str, Place] = field(default_factory=dict)
    boots: dict[tuple[str, int], str] = field(default_factory=dict)


class MemoryLedger:
    """Keeps one robot's rows in memory; the rules in their plainest form."""

    def __init__(self) -> None:
        self.epoch = 0
        self.rows: dict[Key, Row] = {}
        self.aside: list[tuple[str, Row, Why]] = []
        self._stores: dict[str, _Store] = {}

    def admit(self, hello: Hello) -> Admission:
        """Begin a new epoch: whatever comes in an older one is refused from now on."""
        self.epoch += 1
        is_new = hello.store_id not in self._stores
        store = self._stores.setdefault(hello.store_id, _Store())
        found = self._compare(hello.store_id, hello.writers, is_hello=True)
        store.cursor = set_back(store.cursor, found)
        store.upto = dict(store.cursor)
        for writer in hello.writers:
            store.cursor.setdefault(writer, START)
        self._note_boots(store, hello.writers)
        return Admission(self.epoch, dict(store.cursor), tuple(found), is_new)

    def store(
        self,
        epoch: int,
        store_id: str,
        rows: Sequence[Row],
        upto: Mapping[str, Place],
        reaches: Mapping[str, Reach],
        *,
        compare: bool = True,
    ) -> Stored:
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
        store.upto = set_back({**store.upto, **upto}, found)
        store.cursor = advanced(set_back(store.cursor, found), store.upto, reaches)
        return Stored(dict(store.cursor), tuple(new), tuple(conflicts), tuple(found))

    def _compare(
        self, store_id: str, reaches: Mapping[str, Reach], *, is_hello: bool
    ) -> list[Aside]:
        """Put aside what the robot has no more."""
        store = self._stores[store_id]
        found: list[Aside] = []
        for writer, reach in reaches.items():
            held, cursor = self._held(store_id, writer), store.cursor.get(writer, START)
            found += aside(writer, held, cursor, reach, is_hello=is_hello)
        for one in found:
            self._move(store_id, one)
        return found

    def _held(self, store_id: str, writer: str) -> list[Held]:
        store = self._stores[store_id]
        ends = {run: 0 for w, run in store.boots if w == writer}
        for of, w, run, seq in self.rows:
            if (of, w) == (store_id, writer):
                ends[run] = max(ends.get(run, 0), seq + 1)
        at = store.cursor.get(writer, START)
        if at.seq and at.run in ends:
            ends[at.run] = max(ends[at.run], at.seq)
        return [Held(r, store.boots.get((writer, r), ""), end) for r, end in sorted(ends.items())]

    def _move(self, store_id: str, one: Aside) -> None:
        for key in [k for k in self.rows if k[:3] == (store_id, one.writer, one.run)]:
            if key[3] >= one.from_seq:
                self.aside.append((store_id, self.rows.pop(key), one.why))
        if one.from_seq == 0:
            self._stores[store_id].boots.pop((one.writer, one.run), None)

    def _note_boots(self, store: _Store, reaches: Mapping[str, Reach]) -> None:
        for writer, reach in reaches.items():
            for run in reach.runs:
                store.boots[writer, run.run] = run.boot


def advanced(
    cursor: Mapping[str, Place], upto: Mapping[str, Place], reaches: Mapping[str, Reach]
) -> dict[str, Place]:
    """Move a cursor on to what was received and is durable on the robot; never back."""
    moved = {w: min(at, reaches[w].durable) for w, at in upto.items() if w in reaches}
    return {w: max(at, moved.get(w, START)) for w, at in {**moved, **cursor}.items()}
