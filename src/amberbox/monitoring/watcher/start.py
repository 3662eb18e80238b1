"""Where in each journal the reading of an epoch begins, so that windows can be filled again."""

from __future__ import annotations

from collections.abc import Iterator

from amberbox.blackbox.follow.follow import RECORDED
from amberbox.blackbox.follow.read import JournalFile, newest_first, run_messages
from amberbox.blackbox.store import Store
from amberbox.core.clock import NS
from amberbox.core.types import WriterCursor
from amberbox.monitoring.watcher.epoch import Epoch, epoch_of
from amberbox.monitoring.watcher.memory import Checkpoint

WATCH = "watch"
WRITERS = (*RECORDED, WATCH)


def before_end(store: Store, lookback_s: float) -> dict[str, WriterCursor]:
    """Begin so long before the end of each journal, or where its epoch begins."""
    found = {}
    for writer in WRITERS:
        newest = next(newest_first(store, writer), None)
        if newest is not None:
            end = WriterCursor(newest.run, newest.end_seq)
            from_ns = newest.end_ns - round(lookback_s * NS)
            found[writer] = _back(store, writer, end, epoch_of_file(newest), from_ns)
    return found


def before_checkpoint(store: Store, left: Checkpoint) -> dict[str, WriterCursor]:
    """Begin so long before a checkpoint as it says, or where its epoch begins."""
    if left.lookback_s <= 0:
        return dict(left.positions)
    from_ns = left.place.until_ns - round(left.lookback_s * NS)
    return {
        writer: _back(store, writer, at, left.place.epoch, from_ns)
        for writer, at in left.positions.items()
    }


def at_time(store: Store, writer: str, from_ns: int) -> WriterCursor:
    """Begin with the newest file that begins at or before a log time; else with the oldest."""
    at = WriterCursor()
    for journal in newest_first(store, writer):
        at = WriterCursor(journal.run, journal.first_seq)
        if journal.start_ns <= from_ns:
            break
    return at


def _back(
    store: Store, writer: str, at: WriterCursor, epoch: Epoch | None, from_ns: int
) -> WriterCursor:
    """Go back from a position to a log time of its epoch."""
    for journal in _files_of(store, writer, at, epoch):
        for place, seq in zip(journal.places, _starts(journal), strict=True):
            if place.end_ns >= from_ns:
                at = min(at, WriterCursor(journal.run, seq), key=_order)
                break
        if journal.start_ns < from_ns:
            break
    return at


def _files_of(
    store: Store, writer: str, at: WriterCursor, epoch: Epoch | None
) -> Iterator[JournalFile]:
    """Give the files of an epoch that have rows before a position, newest first.

    The position may lie in a later epoch already.
    """
    found = False
    for journal in newest_first(store, writer):
        if (journal.run, journal.first_seq) >= _order(at):
            continue
        matches = epoch_of_file(journal) == epoch
        if (found and not matches) or _is_before(journal, epoch):
            return
        if matches:
            found = True
            yield journal


def _is_before(journal: JournalFile, epoch: Epoch | None) -> bool:
    """Tell whether the recorder's run that a file is of was before that of an epoch."""
    of = epoch_of_file(journal)
    return epoch is not None and of is not None and of.run < epoch.run


def epoch_of_file(journal: JournalFile) -> Epoch | None:
    """Return the epoch that a file is of, if it says so."""
    if journal.writer == WATCH:
        return epoch_of(str(run_messages(journal).get("input", "")))
    for reading in journal.readings:
        if reading.boot_ns is not None:
            return Epoch(journal.run, reading.log_ns - reading.boot_ns)
    return Epoch(journal.run, 0)


def comes_later(store: Store, epoch: Epoch, than: Epoch) -> bool:
    """Tell whether the recorder was in an epoch after another one, by its files."""
    if epoch.run != than.run:
        return epoch.run > than.run
    for journal in newest_first(store, "main"):
        of = epoch_of_file(journal)
        if of == epoch:
            return True
        if of == than or _is_before(journal, than):
            return False
    return False


def _starts(journal: JournalFile) -> Iterator[int]:
    """Give the position at which each chunk begins."""
    seq = journal.first_seq
    for place in journal.places:
        yield seq
        seq += place.count


def _order(at: WriterCursor) -> tuple[int, int]:
    return at.run, at.seq
