"""How far each writer's journal reaches, and how much of it survives a power cut."""

from __future__ import annotations

import os
from pathlib import Path

from amberbox.blackbox.follow.read import journal_file
from amberbox.blackbox.journal.head import Head, read_head
from amberbox.blackbox.journal.scan import start_record
from amberbox.blackbox.signing.signing import LOCKS
from amberbox.blackbox.store import Store, is_locked, run_and_number
from amberbox.link import limits
from amberbox.link.positions import START, Place, Reach, RunEnd


class Reaches:
    """Looks at the journals of a store; what cannot change any more is looked at once."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._closed: dict[tuple[str, int], RunEnd] = {}

    def state(self) -> dict[str, Reach]:
        """Return how far the journals reach whose rows go over the link."""
        return {w: self.of(w) for w in limits.WRITERS if self._store.folder(w).is_dir()}

    def of(self, writer: str) -> Reach:
        """Return how far a writer's journal reaches."""
        lock = LOCKS.get(writer, writer)
        alive = is_locked(self._store, lock)  # before the files: they may grow until it is free
        head = read_head(self._store.folder(writer))
        last = {run_and_number(path)[0]: path for path in self._store.journal_files(writer)}
        alive = alive or is_locked(self._store, lock)  # the newest run may have begun in between
        runs = sorted(last)
        if not runs:
            at = START if head is None else Place(head.run, head.next_seq)
            return Reach(at, at, at)
        stated = runs[-limits.RUNS_STATED :]
        ends = [self._closed_run(writer, run, last[run]) for run in stated[:-1]]
        newest, durable = self._newest(writer, stated[-1], last[stated[-1]], head, alive=alive)
        return Reach(
            _oldest(self._store, writer, runs[0]), Place(newest.run, newest.end_seq),
            Place(newest.run, durable), (*ends, newest),
        )  # fmt: skip

    def _newest(
        self, writer: str, run: int, path: Path, head: Head | None, *, alive: bool
    ) -> tuple[RunEnd, int]:
        """Describe the newest run and how much of it is durable."""
        if not alive:
            closed = self._closed_run(writer, run, path)
            return closed, closed.end_seq
        if head is not None and head.run == run and head.store_id == self._store.id:
            durable = min(head.durable_seq, head.next_seq)
            return RunEnd(run, _boot(path), _open_end(path, head), closed=False), durable
        return RunEnd(run, _boot(path), _end_of(path), closed=False), 0

    def _closed_run(self, writer: str, run: int, path: Path) -> RunEnd:
        """Describe a run that nobody writes any more, and make its end durable first."""
        known = self._closed.get((writer, run))
        if known is None:
            _sync(path)
            known = self._closed[writer, run] = RunEnd(run, _boot(path), _end_of(path))
        return known


def _boot(path: Path) -> str:
    return path.stem.split("-")[1]


def _open_end(path: Path, head: Head) -> int:
    """Return where a run ends that is being written.

    The head follows the file, after a sync at times, and never for a writer that was killed before.
    Rows are sent as they stand in the file: an end before them would tell that they were lost.
    """
    try:
        is_all = head.file == path.name and path.stat().st_size <= head.size
    except FileNotFoundError:
        is_all = True
    return head.next_seq if is_all else max(head.next_seq, _end_of(path))


def _end_of(path: Path) -> int:
    try:
        return journal_file(path, f"{path.parent.name}/{path.name}").end_seq
    except FileNotFoundError:  # deleted meanwhile: the next look says what is left
        return 0


def _sync(path: Path) -> None:
    """Make a file's end durable; what is stated of it is to hold after a power cut."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return
    try:
        os.fdatasync(descriptor)
    finally:
        os.close(descriptor)


def _oldest(store: Store, writer: str, run: int) -> Place:
    path = store.journal_files(writer)[0]
    try:
        return Place(run, int(start_record(path).get("first_seq", 0)))
    except FileNotFoundError:
        return Place(run, 0)
