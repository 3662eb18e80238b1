"""Delete what the rule chose: tombstones first and durable, then the files."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from amberbox.blackbox.deletion.kept import KeptJournal
from amberbox.blackbox.deletion.limit import with_reserve
from amberbox.blackbox.deletion.pinlock import pin_lock
from amberbox.blackbox.deletion.rule import Pin, Removal, Window, unpinned
from amberbox.blackbox.follow.read import journal_file
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.entries import Tombstone, What, to_record
from amberbox.blackbox.segments.manifest import Manifest
from amberbox.blackbox.store import Store
from amberbox.core.files import below

Pins = Callable[[], Sequence[Pin]]


@dataclass(frozen=True, slots=True)
class Remover:
    """Deletes units of a store; ``pins`` reads what may not go."""

    store: Store
    kept: KeptJournal
    pins: Pins

    def remove(
        self, removals: Sequence[Removal], places: Mapping[str, Window]
    ) -> list[tuple[Removal, Tombstone]]:
        """Delete what is not pinned; return what went, with its tombstone.

        Of what is pinned columns may go whose rows the journal still holds.

        Raises OSError when the disk does not take the tombstones: then nothing went.
        """
        with pin_lock(self.store):
            free = {u.name for u in unpinned([r.unit for r in removals], self.pins())}
            chosen = [r for r in removals if r.unit.name in free or self._stays_in_raw(r)]
            return self._remove(chosen, places) if chosen else []

    def _remove(
        self, removals: Sequence[Removal], places: Mapping[str, Window]
    ) -> list[tuple[Removal, Tombstone]]:
        known = mf.read(self.store.path)
        gone = []
        for removal in removals:
            what = self._what(removal, known)
            if what is not None:
                if what != "columns":
                    self._keep_own(removal.unit.name, known)
                gone.append((removal, _tombstone(removal, what, places[removal.unit.name])))
        if not gone:
            return []
        records = [to_record(tombstone) for _, tombstone in gone]
        with_reserve(self.store, lambda: mf.append(self.store.path, records))
        for _, tombstone in gone:
            self._unlink_raw(tombstone)
        self._unlink_segments(known)
        return gone

    def _stays_in_raw(self, removal: Removal) -> bool:
        return removal.what == "columns" and (self.store.path / removal.unit.name).exists()

    def _what(self, removal: Removal, known: Manifest) -> What | None:
        """Say what really goes: what is not there cannot, raw alone is all there is without."""
        has_raw = (self.store.path / removal.unit.name).exists()
        has_columns = removal.unit.name in known.journals
        raw = has_raw and removal.what != "columns"
        columns = has_columns and removal.what != "raw"
        if raw and (columns or not (has_columns or removal.unit.name in known.columns_gone)):
            return "both"
        return "raw" if raw else "columns" if columns else None

    def _keep_own(self, name: str, known: Manifest) -> None:
        """Copy events and the like of a journal without columns, for these are never deleted."""
        if name in known.journals or name in known.columns_gone or name.startswith("ring/"):
            return
        with suppress(FileNotFoundError):
            journal = journal_file(self.store.path / name, name)
            with_reserve(self.store, lambda: self.kept.keep(journal))

    def _unlink_raw(self, tombstone: Tombstone) -> None:
        if tombstone.what != "columns":
            for name in tombstone.journals:
                below(self.store.path, name).unlink(missing_ok=True)

    def _unlink_segments(self, before: Manifest) -> None:
        for path in mf.read(self.store.path).gone_segments - before.gone_segments:
            below(self.store.path, path).unlink(missing_ok=True)

    def finish(self) -> int:
        """Delete what has its tombstone but was not deleted before the keeper died."""
        known = mf.read(self.store.path)
        found = [self.store.path / name for name in (*known.raw_gone, *known.gone_segments)]
        left = [path for path in found if path.exists()]
        for path in left:
            path.unlink(missing_ok=True)
        return len(left)


def _tombstone(removal: Removal, what: What, place: Window) -> Tombstone:
    return Tombstone(
        (place.name,), what, place.writer, place.run, place.first_seq, place.end_seq,
        place.start_ns, place.end_ns, place.chain, removal.reason, removal.unit.confirmed,
        time.time_ns(),
    )  # fmt: skip
