"""The ledger of a server: which rows of each writer it holds, and the rules of admission.

Rows are sent before they are durable on the robot's disk. Rows that the robot loses at a power cut
are kept on the server, marked, and never joined with rows that were written later.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from amberbox.link.frames import START, Cursor, JournalPosition, LinkRow, WriterReach

ConflictReason = Literal["lost_at_power_cut", "other_history"]
LOST: ConflictReason = "lost_at_power_cut"
OTHER: ConflictReason = "other_history"


@dataclass(frozen=True, slots=True)
class HeldRun:
    """A server's data of one run of a writer: the boot that wrote it, and the end of its rows."""

    run: int
    boot: str
    end_seq: int


@dataclass(frozen=True, slots=True)
class RowConflict:
    """Rows of a run from ``from_seq`` on that are no longer part of the record, and why."""

    writer: str
    run: int
    from_seq: int
    why: ConflictReason


def find_conflicts(
    writer: str,
    held: Sequence[HeldRun],
    cursor: JournalPosition,
    reach: WriterReach,
    *,
    is_hello: bool,
) -> Iterator[RowConflict]:
    """Yield the conflicts between the rows that a server holds of a writer and the robot's
    statement.

    Only at Hello no rows are in transit, so that runs being written are compared too. A run of
    another boot, a run that the robot never had, or an end before one stated as durable mean
    another history: an old image of its disk was restored.
    """
    stated = {run.run: run for run in reach.runs}
    for one in held:
        now = stated.get(one.run)
        if now is None:
            if is_hello and one.run > reach.end.run:
                yield _conflict(writer, one.run, 0, cursor)
        elif one.boot and now.boot and one.boot != now.boot:
            yield RowConflict(writer, one.run, 0, OTHER)
        elif (now.closed or is_hello) and now.end_seq < one.end_seq:
            yield _conflict(writer, one.run, now.end_seq, cursor)


def _conflict(writer: str, run: int, from_seq: int, cursor: JournalPosition) -> RowConflict:
    is_other = JournalPosition(run, from_seq) < cursor
    return RowConflict(writer, run, from_seq, OTHER if is_other else LOST)


def rewind_cursor(
    cursor: Mapping[str, JournalPosition], found: Sequence[RowConflict]
) -> dict[str, JournalPosition]:
    """Return the cursor, moved back to where the record of a writer differs."""
    back = dict(cursor)
    for one in found:
        if one.writer in back:
            back[one.writer] = min(back[one.writer], JournalPosition(one.run, one.from_seq))
    return back


def advance_cursor(
    cursor: Mapping[str, JournalPosition],
    upto: Mapping[str, JournalPosition],
    reaches: Mapping[str, WriterReach],
) -> dict[str, JournalPosition]:
    """Return the cursor, advanced to rows that were received and are durable on the robot; never
    back.
    """
    moved = {w: min(at, reaches[w].durable) for w, at in upto.items() if w in reaches}
    return {w: max(at, moved.get(w, START)) for w, at in {**moved, **cursor}.items()}


@dataclass(slots=True)
class StoreLedger:
    """A server's data of one store; ``received`` is the position up to which rows arrived in this
    epoch.
    """

    cursor: Cursor = field(default_factory=dict)
    received: Cursor = field(default_factory=dict)
    runs: dict[tuple[str, int], HeldRun] = field(default_factory=dict)
    """By writer and number."""

    def conflicts(self, reaches: Mapping[str, WriterReach], *, is_hello: bool) -> list[RowConflict]:
        """Return the conflicts: rows that the robot no longer has, by the reach of its journals."""
        found: list[RowConflict] = []
        for writer, reach in reaches.items():
            at = self.cursor.get(writer, START)
            held = [
                replace(one, end_seq=max(one.end_seq, at.seq)) if run == at.run else one
                for (of, run), one in sorted(self.runs.items())
                if of == writer
            ]
            found += find_conflicts(writer, held, at, reach, is_hello=is_hello)
        return found

    def cut(self, conflict: RowConflict) -> None:
        """Truncate a run at a conflict."""
        key = conflict.writer, conflict.run
        if conflict.from_seq == 0:
            self.runs.pop(key, None)
        elif key in self.runs:
            self.runs[key] = replace(self.runs[key], end_seq=conflict.from_seq)

    def note_boots(self, reaches: Mapping[str, WriterReach]) -> Iterator[tuple[str, int]]:
        """Set the boots of runs where they are unknown; yield the runs that changed."""
        for writer, reach in reaches.items():
            for stated in reach.runs:
                known = self.runs.get((writer, stated.run))
                if known is None or (stated.boot and not known.boot):
                    end_seq = 0 if known is None else known.end_seq
                    self.runs[writer, stated.run] = HeldRun(stated.run, stated.boot, end_seq)
                    yield writer, stated.run

    def end_of(self, writer: str, run: int) -> int:
        """Return the end of a run: the number of its last stored row plus one."""
        known = self.runs.get((writer, run))
        return 0 if known is None else known.end_seq

    def extend(self, writer: str, run: int, end_seq: int) -> None:
        """Extend a run to the end of newly stored rows."""
        known = self.runs.get((writer, run), HeldRun(run, "", 0))
        self.runs[writer, run] = replace(known, end_seq=max(known.end_seq, end_seq))

    def advance(
        self,
        upto: Mapping[str, JournalPosition],
        reaches: Mapping[str, WriterReach],
        conflicts: Sequence[RowConflict],
    ) -> None:
        """Advance the cursors, or move them back to where conflicts begin."""
        self.received = rewind_cursor({**self.received, **upto}, conflicts)
        back = rewind_cursor(self.cursor, conflicts)
        self.cursor = advance_cursor(back, self.received, reaches)


class StaleEpochError(Exception):
    """The robot has reconnected: frames of an older connection are refused."""


@dataclass(frozen=True, slots=True)
class LinkAdmission:
    """An admission: the robot's epoch, the cursor to send from, and conflicts."""

    epoch: int
    cursor: Cursor
    conflicts: tuple[RowConflict, ...] = ()
    is_new_store: bool = False


@dataclass(frozen=True, slots=True)
class StoredRows:
    """The result of storing rows: the new cursor, new rows, and rows that contradict stored ones.

    ``conflicts`` are earlier rows that the robot no longer has.
    """

    cursor: Cursor
    new: tuple[LinkRow, ...] = ()
    contradicting: tuple[LinkRow, ...] = ()
    conflicts: tuple[RowConflict, ...] = ()
