"""Journals whose file is gone: what the manifest still knows of them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.follow import columns as col
from amberbox.blackbox.follow.columns import Stretch
from amberbox.blackbox.follow.read import JournalFile
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.entries import Sealed, Tombstone
from amberbox.blackbox.segments.manifest import Journal, Manifest
from amberbox.blackbox.store import Store, run_and_number
from amberbox.core.types import Batch, Gap

LOST = "deleted or lost with its file"
FORGOTTEN = "deleted: older than the ring"
_GAP_ITEM = reserved.GAP.replace("/", "_")


@dataclass(frozen=True, slots=True)
class GoneJournal:
    """A journal whose file is gone, or several that stood side by side (then without a name).

    ``reason`` says why rows are missing; it is empty when all of them are in segments. Times are
    times of receipt, ``place`` is run and number of the last file.
    """

    place: tuple[int, int]
    stretch: Stretch
    start_ns: int
    end_ns: int
    reason: str = ""


def gone_journals(known: Manifest, writer: str) -> list[GoneJournal]:
    """List what the manifest knows of a writer's journals, as if all their files were gone."""
    found = {gone.place: gone for gone in _gone(known, writer)}
    return [found[place] for place in sorted(found)]


def _gone(known: Manifest, writer: str) -> Iterator[GoneJournal]:
    """What is known best comes last."""
    for sealed in known.sealed.values():
        if sealed.writer == writer:
            yield _of_file(sealed.journal, sealed, LOST)
    for tombstone in known.tombstones:
        if tombstone.writer == writer and tombstone.what != "raw":
            yield _of_tombstone(tombstone)
    for journal in known.journals.values():
        if journal.writer == writer:
            yield _of_file(journal.name, journal, "")


def _of_file(name: str, found: Sealed | Journal, reason: str) -> GoneJournal:
    stretch = Stretch(name, found.writer, found.run, found.first_seq, found.end_seq)
    return GoneJournal(run_and_number(Path(name)), stretch, found.start_ns, found.end_ns, reason)


def _of_tombstone(found: Tombstone) -> GoneJournal:
    name = found.journals[0] if len(found.journals) == 1 else ""
    stretch = Stretch(name, found.writer, found.run, found.first_seq, found.end_seq)
    place = run_and_number(Path(found.journals[-1]))
    return GoneJournal(place, stretch, found.start_ns, found.end_ns, f"deleted: {found.reason}")


class GoneList:
    """What is gone of a writer's journals; put together anew only when the manifest changed."""

    def __init__(self, store: Store, writer: str) -> None:
        self._store = store
        self._writer = writer
        self._known: Manifest | None = None
        self._journals: list[GoneJournal] = []
        self._places: list[tuple[int, int]] = []

    def since(self, place: tuple[int, int], files: Sequence[Path]) -> list[GoneJournal]:
        """Return those after a place whose file is not among these, in order."""
        known = mf.read(self._store.path)
        if known is not self._known:
            self._known = known
            self._journals = gone_journals(known, self._writer)
            self._places = [gone.place for gone in self._journals]
        later = self._journals[bisect_right(self._places, place) :]
        here = {run_and_number(path) for path in files} if later else set()
        return [gone for gone in later if gone.place not in here]


def outline_of(gone: GoneJournal) -> JournalFile:
    """Describe a journal without its file, in times of receipt."""
    stretch = gone.stretch
    return JournalFile(
        name=stretch.journal, path=Path(), writer=stretch.writer, run=stretch.run,
        number=gone.place[1], first_seq=stretch.first_seq, end_seq=stretch.end_seq,
        start_ns=gone.start_ns, end_ns=gone.end_ns, finished=True, items={}, bytes=0, clock=(),
        chain="", streams={}, places=(),
    )  # fmt: skip


def rows_of_gone(
    store: Path,
    gone: GoneJournal,
    items: Collection[str] | None,
    from_seq: int,
    read_to: Callable[[str], int],
) -> Iterator[tuple[int, list[Batch | Gap]]]:
    """Give what is left of a journal piece by piece: the position after it, batches and gaps.

    ``read_to`` tells up to where an item has been read before. Raises FileNotFoundError when
    segments are moved meanwhile.
    """
    stretch, known = gone.stretch, mf.read(store)
    from_seq = max(from_seq, stretch.first_seq)
    missing: list[Batch | Gap] = [_gap(gone, from_seq, gone.reason)] if gone.reason else []
    if not col.can_read():
        why = missing or [_gap(gone, from_seq, "needs pyarrow to be read")]
        yield stretch.end_seq, why
        return
    if items is not None and not items:
        yield stretch.end_seq, missing
        return
    wanted = None if items is None else {*items, _GAP_ITEM}
    tables = col.tables_of(store, known, stretch, wanted)
    for end_seq in col.windows(tables, stretch):
        found = list(_window(tables, end_seq, items, read_to))
        found += [_gap(gone, from_seq, why, item) for item, why in col.damage(tables)]
        if end_seq == stretch.end_seq:
            found += _noted(known, stretch, items)
            found += missing
        yield end_seq, found


def _window(
    tables: Sequence[col.TableRows],
    end_seq: int,
    items: Collection[str] | None,
    read_to: Callable[[str], int],
) -> Iterator[Batch | Gap]:
    for batch in col.batches(tables, end_seq):
        rest = col.rest_of(batch, read_to(batch.item))
        if rest is None:
            continue
        if items is None or batch.item in items:
            yield rest
        if batch.topic == reserved.GAP:
            yield from col.gaps_recorded(rest)


def _noted(known: Manifest, of: Stretch, items: Collection[str] | None) -> Iterator[Gap]:
    """Give what could not be decoded when the segments were built, and what was damaged."""
    journal, sealed = known.journals.get(of.journal), known.sealed.get(of.journal)
    for gap in journal.gaps if journal is not None else ():
        if items is None or gap.item in items:
            yield gap
    if journal is not None and sealed is not None:
        yield from sealed.gaps()


def _gap(gone: GoneJournal, from_seq: int, reason: str, item: str = "") -> Gap:
    of = gone.stretch
    count = None if item else of.end_seq - from_seq
    return Gap(of.writer, of.run, gone.start_ns, gone.end_ns + 1, reason, item, count,
               from_seq, of.end_seq)  # fmt: skip
