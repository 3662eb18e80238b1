"""What a store holds that may be deleted: its journals and their columns as units of the rule."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from amberbox.blackbox.deletion.rule import Unit, Window, ages_s
from amberbox.blackbox.deletion.usage import DiskUse
from amberbox.blackbox.follow.follow import RECORDED
from amberbox.blackbox.follow.read import JournalFile, journal_file
from amberbox.blackbox.incidents.extent import extent
from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.manifest import Manifest
from amberbox.blackbox.store import FOLDERS, Store, is_locked


class Stock:
    """Knows the sealed journals of a store; looks into each file once at most."""

    def __init__(self, store: Store, use: DiskUse) -> None:
        self._store = store
        self._use = use
        self._looked: dict[str, Window] = {}
        self._shares: tuple[Manifest, Counter[str]] | None = None

    def sealed(self, writer: str) -> list[str]:
        """Name a writer's journal files that nobody writes, as measured last, in order."""
        folder = FOLDERS[writer]
        if writer == "ring":  # it may lie elsewhere, and has few files
            names = [path.name for path in self._store.folder(writer).glob("*.mcap")]
        else:
            names = [name for name in self._use.sizes(folder) if name.endswith(".mcap")]
        names.sort(key=_place)
        if is_locked(self._store, writer):
            names = names[:-1]
        return [f"{folder}/{name}" for name in names]

    def bytes_of(self, name: str) -> int:
        """Bytes that a journal file takes, as measured last."""
        folder, _, file = name.rpartition("/")
        return self._use.sizes(folder).get(file, 0)

    def windows(self, known: Manifest) -> dict[str, Window]:
        """Return where each journal lies of which raw or columns are here, writer by writer."""
        found: list[Window] = []
        on_disk: set[str] = set()
        for writer in RECORDED:
            names = set(self.sealed(writer))
            on_disk |= names
            names |= {name for name, j in known.journals.items() if j.writer == writer}
            found += self._of_writer(known, names)
        for name in self._looked.keys() - on_disk:
            del self._looked[name]
        return {window.name: window for window in found}

    def _of_writer(self, known: Manifest, names: Collection[str]) -> Iterator[Window]:
        before: Window | None = None
        for name in sorted(names, key=_place):
            window = self._window(known, name)
            if window is None or not (window.end_ns or before):
                continue  # gone meanwhile, or nothing in it that has a time
            if not window.end_ns and before is not None:
                window = replace(window, start_ns=before.end_ns, end_ns=before.end_ns)
            before = window
            yield window

    def _window(self, known: Manifest, name: str) -> Window | None:
        sealed, done = known.sealed.get(name), known.journals.get(name)
        if sealed is not None:
            return Window(
                name, sealed.writer, sealed.run, sealed.number, sealed.first_seq, sealed.end_seq,
                sealed.start_ns, sealed.end_ns, sealed.chain, _stepped_ns(sealed.clock),
                sealed.synchronised,
            )  # fmt: skip
        if done is not None:
            _, number = _place(name)
            return Window(name, done.writer, done.run, number, done.first_seq, done.end_seq,
                          done.start_ns, done.end_ns, done.head)  # fmt: skip
        if name not in self._looked:
            with suppress(FileNotFoundError):
                self._looked[name] = window_of(journal_file(self._store.path / name, name))
        return self._looked.get(name)

    def units(
        self,
        known: Manifest,
        windows: Mapping[str, Window],
        pending: Callable[[str], bool],
        *,
        sure: bool = False,
    ) -> list[Unit]:
        """Return everything that the rule chooses from; ``sure`` ages are those of ``ages_s``."""
        ages = ages_s([*windows.values(), *self._growing()], sure=sure)
        columns = self._column_bytes(known)
        units = [
            Unit(
                w.name, w.writer, w.run, w.start_ns, w.end_ns, ages[w.name],
                self.bytes_of(w.name), columns[w.name], w.name in known.confirmed,
                w.name not in known.journals and pending(w.name),
            )
            for w in windows.values()
        ]  # fmt: skip
        return [unit for unit in units if unit.raw_bytes or unit.column_bytes]

    def _growing(self) -> list[Window]:
        """Return the file that is being written: what it holds makes all others older.

        Also while nothing but events is recorded, or nothing would become old enough to go.
        """
        if not is_locked(self._store, "main"):
            return []
        paths = self._store.journal_files("main")[-1:]
        founds = (extent(path) for path in paths)
        return [
            Window(
                found.name, "main", found.run, _place(found.name)[1], 0, 0,
                found.start_ns + found.offset_ns, found.end_ns + found.offset_ns, "",
            )
            for found in founds if found is not None
        ]  # fmt: skip

    def ring(self) -> list[tuple[Window, float]]:
        """Return the files of the ring that nobody writes any more, and their ages."""
        windows = list(self._of_writer(Manifest(), self.sealed("ring")))
        ages = ages_s(windows)
        return [(window, ages[window.name]) for window in windows]

    def _column_bytes(self, known: Manifest) -> Counter[str]:
        """Share out the bytes of segments among the journals they came from."""
        if self._shares is None or self._shares[0] is not known:
            shares: Counter[str] = Counter()
            for segments in known.segments.values():
                for segment in () if mf.is_kept(known.schemas[segments[0].schema]) else segments:
                    for part in segment.parts:
                        if part.journal not in known.columns_gone:
                            share = segment.bytes * part.rows // max(segment.rows, 1)
                            shares[part.journal] += max(share, 1)
            self._shares = known, shares
        return self._shares[1]


def _place(name: str) -> tuple[int, int]:
    """Read run and file number from a journal's name; there may be very many of them."""
    run, _, rest = name.rpartition("/")[2].removesuffix(".mcap").partition("-")
    number = rest.rpartition("-")[2]
    return (int(run), int(number)) if run.isdigit() and number.isdigit() else (0, 0)


def window_of(journal: JournalFile) -> Window:
    """Say where a journal file lies, by what it holds itself."""
    edges = np.array([journal.start_ns, journal.end_ns])
    start_ns, end_ns = (
        ClockTable(journal.clock).received(edges).tolist() if journal.rows else (0, 0)
    )
    return Window(
        journal.name, journal.writer, journal.run, journal.number, journal.first_seq,
        journal.end_seq, start_ns, end_ns, journal.chain, _stepped_ns(journal.clock),
        journal.readings[-1].synchronised if journal.readings else None,
    )  # fmt: skip


def _stepped_ns(clock: Sequence[tuple[int, int]]) -> int:
    """Return by how much the wall clock was set against log time within a file."""
    return clock[-1][1] - clock[0][1] if clock else 0
