"""Delete the units chosen by the rule: tombstones are written and synced before the files are
deleted.

The box's own records of a journal that is deleted before it has columns are copied to a kept
journal; deletions are logged as summarised events. Space is freed in a thread of its own.
``JournalInventory`` describes a store's sealed journals, from which units of the rule are made.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.retention import usage
from amberbox.blackbox.retention.rule import (
    DeletionUnit,
    JournalWindow,
    Removal,
    ages_s,
    for_room,
    spared_columns,
    too_old,
)
from amberbox.blackbox.retention.usage import (
    DiskUse,
    FullMark,
    SpaceBudget,
    SpaceStatement,
    pin_lock,
    space_budget,
    with_reserve,
)
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.blackbox.store.derived_journal import (
    ChannelValues,
    DerivedJournal,
    DerivedStreams,
    event,
)
from amberbox.blackbox.store.journal_reader import (
    JournalFile,
    extent,
    files_of,
    journal_file,
    previous_chain,
    sound_chunks,
)
from amberbox.blackbox.store.manifest import LARGE_BYTES, Manifest, SignHead, condense
from amberbox.blackbox.store.manifest_entries import DeletionKind, Tombstone, to_record
from amberbox.blackbox.store.store import FOLDERS, INCIDENTS, KEPT, Store, is_locked
from amberbox.blackbox.store.tail import RECORDED
from amberbox.core.clock import SystemClock
from amberbox.core.files import below
from amberbox.core.timestamps import format_time

if TYPE_CHECKING:
    from amberbox.blackbox.store.incident import StoredIncident


class JournalInventory:
    """The sealed journals of a store; each file is read once at most."""

    def __init__(self, store: Store, use: DiskUse) -> None:
        self._store = store
        self._use = use
        self._described: dict[str, JournalWindow] = {}
        self._shares: tuple[Manifest, Counter[str]] | None = None

    def sealed(self, writer: str) -> list[str]:
        """Return the names of a writer's finished journal files, as measured last, in order."""
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
        """Return the bytes of a journal file, as measured last."""
        folder, _, file = name.rpartition("/")
        return self._use.sizes(folder).get(file, 0)

    def windows(self, known: Manifest) -> dict[str, JournalWindow]:
        """Return the run and times of each journal whose raw data or columns exist, writer by
        writer.
        """
        found: list[JournalWindow] = []
        on_disk: set[str] = set()
        for writer in RECORDED:
            names = set(self.sealed(writer))
            on_disk |= names
            names |= {name for name, j in known.journals.items() if j.writer == writer}
            found += self._of_writer(known, names)
        for name in self._described.keys() - on_disk:
            del self._described[name]
        return {window.name: window for window in found}

    def _of_writer(self, known: Manifest, names: Collection[str]) -> Iterator[JournalWindow]:
        before: JournalWindow | None = None
        for name in sorted(names, key=_place):
            window = self._window(known, name)
            if window is None or not (window.end_ns or before):
                continue  # gone meanwhile, or nothing in it that has a time
            if not window.end_ns and before is not None:
                window = replace(window, start_ns=before.end_ns, end_ns=before.end_ns)
            before = window
            yield window

    def _window(self, known: Manifest, name: str) -> JournalWindow | None:
        sealed, done = known.sealed.get(name), known.journals.get(name)
        if sealed is not None:
            return JournalWindow(
                name, sealed.writer, sealed.run, sealed.number, sealed.first_seq, sealed.end_seq,
                sealed.start_ns, sealed.end_ns, sealed.chain, _stepped_ns(sealed.clock),
                sealed.synchronised,
            )  # fmt: skip
        if done is not None:
            _, number = _place(name)
            return JournalWindow(name, done.writer, done.run, number, done.first_seq, done.end_seq,
                          done.start_ns, done.end_ns, done.head)  # fmt: skip
        if name not in self._described:
            with suppress(FileNotFoundError):
                self._described[name] = window_of(journal_file(self._store.path / name, name))
        return self._described.get(name)

    def units(
        self,
        known: Manifest,
        windows: Mapping[str, JournalWindow],
        pending: Callable[[str], bool],
        *,
        sure: bool = False,
    ) -> list[DeletionUnit]:
        """Return everything that the rule chooses from; ``sure`` ages are those of ``ages_s``."""
        ages = ages_s([*windows.values(), *self._growing()], sure=sure)
        if self._shares is None or self._shares[0] is not known:
            shares: Counter[str] = Counter()
            for segments in known.segments.values():
                for segment in () if mf.is_kept(known.schemas[segments[0].schema]) else segments:
                    for part in segment.parts:
                        if part.journal not in known.columns_gone:
                            share = segment.bytes * part.rows // max(segment.rows, 1)
                            shares[part.journal] += max(share, 1)
            self._shares = known, shares
        columns = self._shares[1]
        units = [
            DeletionUnit(
                w.name, w.writer, w.run, w.start_ns, w.end_ns, ages[w.name],
                self.bytes_of(w.name), columns[w.name], w.name in known.confirmed,
                w.name not in known.journals and pending(w.name),
            )
            for w in windows.values()
        ]  # fmt: skip
        return [unit for unit in units if unit.raw_bytes or unit.column_bytes]

    def _growing(self) -> list[JournalWindow]:
        """Return the files being written, since their rows add to the age of all others.

        Also while only events are recorded, else no file would become old enough for deletion.
        """
        if not is_locked(self._store, "main"):
            return []
        paths = self._store.journal_files("main")[-1:]
        founds = (extent(path) for path in paths)
        return [
            JournalWindow(
                found.name, "main", found.run, _place(found.name)[1], 0, 0,
                found.start_ns + found.offset_ns, found.end_ns + found.offset_ns, "",
            )
            for found in founds if found is not None
        ]  # fmt: skip

    def ring(self) -> list[tuple[JournalWindow, float]]:
        """Return the finished files of the ring, and their ages."""
        windows = list(self._of_writer(Manifest(), self.sealed("ring")))
        ages = ages_s(windows)
        return [(window, ages[window.name]) for window in windows]


def _place(name: str) -> tuple[int, int]:
    """Read run and file number from a journal's name; called for very many of them."""
    run, _, rest = name.rpartition("/")[2].removesuffix(".mcap").partition("-")
    number = rest.rpartition("-")[2]
    return (int(run), int(number)) if run.isdigit() and number.isdigit() else (0, 0)


def window_of(journal: JournalFile) -> JournalWindow:
    """Return the run and times of a journal file, from its own content."""
    start_ns, end_ns = journal.received_range_ns if journal.rows else (0, 0)
    return JournalWindow(
        journal.name, journal.writer, journal.run, journal.number, journal.first_seq,
        journal.end_seq, start_ns, end_ns, journal.chain, _stepped_ns(journal.clock),
        journal.readings[-1].synchronised if journal.readings else None,
    )  # fmt: skip


def _stepped_ns(clock: Sequence[tuple[int, int]]) -> int:
    """Return by how much the wall clock was set against log time within a file."""
    return clock[-1][1] - clock[0][1] if clock else 0


# Clocks are in the copies' times, runs in the tombstone; counters go with what they count
_LEFT_OUT = (channels.CLOCK, channels.COUNTERS, channels.RUN)
_TIMES = ("from_ns", "to_ns")


@dataclass(frozen=True, slots=True)
class OwnRecord:
    """A record of the box's own; ``received_ns`` is corrected, and so are times in its values."""

    topic: str
    received_ns: int
    data: bytes


class KeptJournal:
    """The journal of the box's own records that are kept. An interrupted copy is not made twice."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._writer: JournalWriter | None = None
        self._streams = DerivedStreams()

    def keep(self, journal: JournalFile) -> int:
        """Copy a journal's own records, durable when this returns; return how many.

        Raises OSError when writing fails.
        """
        records = list(own_records(journal))
        present = self._present(records) if records else set()
        new = [record for record in records if record not in present]
        if new:
            self._write(new)
        return len(new)

    def close(self) -> None:
        """Finish the file, if one was begun."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _present(self, records: list[OwnRecord]) -> set[OwnRecord]:
        first, last = records[0].received_ns, records[-1].received_ns
        found: set[OwnRecord] = set()
        for journal in files_of(self._store, KEPT):
            if journal.rows and journal.start_ns <= last and journal.end_ns >= first:
                found.update(own_records(journal))
        return found

    def _write(self, records: list[OwnRecord]) -> None:
        if self._writer is None:
            store, boot = self._store, SystemClock().boot_id()
            options = JournalOptions(
                store.folder(KEPT), store.id, KEPT, store.next_run(), boot, rotate_ns=1 << 62
            )
            self._streams.begin()
            self._writer = JournalWriter(options, chain=previous_chain(store, KEPT))
        writer = self._writer
        if writer.rotation_due(records[0].received_ns):
            writer.rotate()
        numbers = [self._streams.own_channel(writer, record.topic) for record in records]
        at_ns = [record.received_ns for record in records]
        writer.write(numbers, at_ns, at_ns, [record.data for record in records])
        writer.mark_sync().wait()


def own_records(journal: JournalFile) -> Iterator[OwnRecord]:
    """Yield a journal's own records that stay when the data around them go, in order."""
    wanted = {
        number: stream.topic.name
        for number, stream in journal.streams.items()
        if stream.source == channels.SOURCE and stream.topic.name not in _LEFT_OUT
    }
    clock = ClockTable(journal.clock)
    for chunk in sound_chunks(journal) if wanted else ():
        rows = np.flatnonzero(np.isin(chunk.channel, list(wanted)))
        log_ns = chunk.log_ns[rows]
        received = clock.received(log_ns)
        for row, at_ns, offset_ns, data in zip(
            rows.tolist(), received.tolist(), (received - log_ns).tolist(), chunk.messages(rows),
            strict=True,
        ):  # fmt: skip
            topic = wanted[int(chunk.channel[row])]
            if topic == channels.GAP:
                data = _corrected(data, offset_ns)
            yield OwnRecord(topic, at_ns, data)


def _corrected(data: bytes, offset_ns: int) -> bytes:
    """Move the times of a gap, which are log times, as the record's own was moved."""
    if not offset_ns:
        return data
    values: dict[str, Any] = json.loads(data)
    moved = {n: values[n] + offset_ns for n in _TIMES if isinstance(values.get(n), int)}
    return msgspec.json.encode({**values, **moved}) if moved else data


LOG_PERIOD_S = 60.0
_WORDS = {"raw": "raw journals", "columns": "columns", "both": "journals with their columns"}


@dataclass(slots=True)
class _Sum:
    """Deletions of one kind that were not logged yet."""

    count: int
    size: int
    from_ns: int
    to_ns: int
    first: str
    last: str


class DeletionLog:
    """Adds up deletions to log them as events; the first of a series is logged at once."""

    def __init__(self) -> None:
        self._sums: dict[tuple[str, str, bool], _Sum] = {}
        self._logged_s = -LOG_PERIOD_S

    def add(self, removal: Removal, tombstone: Tombstone) -> None:
        """Count one deletion."""
        key = (tombstone.what, tombstone.reason, tombstone.confirmed)
        name, start_ns, end_ns = tombstone.journals[0], tombstone.start_ns, tombstone.end_ns
        known = self._sums.get(key)
        if known is None:
            self._sums[key] = _Sum(1, removal.freed_bytes, start_ns, end_ns, name, name)
            return
        known.count += 1
        known.size += removal.freed_bytes
        known.from_ns, known.to_ns = min(known.from_ns, start_ns), max(known.to_ns, end_ns)
        known.last = name

    def due(self, *, now: bool = False) -> list[ChannelValues]:
        """Return the events to be written now; ``forget`` them once they are."""
        if not self._sums or not (now or time.monotonic() - self._logged_s >= LOG_PERIOD_S):
            return []
        return [_event(*key, found) for key, found in self._sums.items()]

    def forget(self) -> None:
        """Reset the counts after they have been written."""
        self._sums.clear()
        self._logged_s = time.monotonic()


def _event(what: str, reason: str, confirmed: bool, found: _Sum) -> ChannelValues:
    start, end = format_time(found.from_ns), format_time(found.to_ns)
    known = "confirmed by a server" if confirmed else "not confirmed by a server"
    text = f"{found.count} {_WORDS[what]} deleted {reason}, {start} to {end}, {known}"
    return event(
        "deleted", text, what=what, reason=reason, confirmed=confirmed, journals=found.count,
        first=found.first, last=found.last, bytes=found.size, from_ns=found.from_ns,
        to_ns=found.to_ns,
    )  # fmt: skip


def pinned_incidents(store: Store) -> list[StoredIncident]:
    """Return the incidents that pin a window; before deletion call it under the pin lock."""
    from amberbox.blackbox.store.incident import load_all  # which import the keeper's options

    return [incident for incident in load_all(store) if incident.is_pinned]


def unpinned(store: Store, units: Iterable[DeletionUnit]) -> list[DeletionUnit]:
    """Return the units that no incident holds; before deletion call it under the pin lock.

    Times of receipt leave it open for a few seconds around a window: there the log times count,
    which the journal states. What a budget of incidents does not count must not stay.
    """
    pins = pinned_incidents(store)
    return [unit for unit in units if not _is_held(store, unit, pins)]


def _is_held(store: Store, unit: DeletionUnit, pins: Sequence[StoredIncident]) -> bool:
    likely = [pin for pin in pins if pin.holds_received(unit.run, unit.start_ns, unit.end_ns)]
    found = extent(store.path / unit.name) if likely else None
    if found is None:  # only its columns are left
        return bool(likely)
    return any(pin.holds(found.run, found.start_ns, found.end_ns) for pin in likely)


def release_confirmed(store: Store) -> str | None:
    """Release the oldest incident that a server has confirmed; return its id, None if there is
    none.
    """
    from amberbox.blackbox.retention.pins import release

    confirmed = [incident for incident in pinned_incidents(store) if incident.confirmed]
    if not confirmed:
        return None
    release(store, confirmed[0])
    return confirmed[0].id


def is_needed(store: Store, window: JournalWindow, path: Path) -> bool:
    """Return whether an incident holds this journal of the ring and has no link or copy of it."""
    for incident in pinned_incidents(store):
        if incident.holds_received(window.run, window.start_ns, window.end_ns):
            copy = store.path / INCIDENTS / incident.id / path.parent.name / path.name
            if not copy.exists() or copy.stat().st_size < path.stat().st_size:
                return True
    return False


@dataclass(frozen=True, slots=True)
class Remover:
    """Deletes units of a store."""

    store: Store
    kept: KeptJournal

    def remove(
        self, removals: Sequence[Removal], places: Mapping[str, JournalWindow]
    ) -> list[tuple[Removal, Tombstone]]:
        """Delete the removals that are not pinned; return those deleted, with their tombstones.

        Pinned columns may be deleted if the journal still holds their rows.

        Raises OSError when the tombstones cannot be written: then nothing is deleted.
        """
        with pin_lock(self.store):
            free = {u.name for u in unpinned(self.store, (r.unit for r in removals))}
            chosen = [r for r in removals if r.unit.name in free or self._stays_in_raw(r)]
            return self._remove(chosen, places) if chosen else []

    def _remove(
        self, removals: Sequence[Removal], places: Mapping[str, JournalWindow]
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
            if tombstone.what != "columns":
                for name in tombstone.journals:
                    below(self.store.path, name).unlink(missing_ok=True)
        for path in mf.read(self.store.path).gone_segments - known.gone_segments:
            below(self.store.path, path).unlink(missing_ok=True)
        return gone

    def _stays_in_raw(self, removal: Removal) -> bool:
        return removal.what == "columns" and (self.store.path / removal.unit.name).exists()

    def _what(self, removal: Removal, known: Manifest) -> DeletionKind | None:
        """Return the part that is really deleted; raw data without columns counts as both."""
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

    def finish(self) -> int:
        """Delete the files with a tombstone that were not deleted before the process died."""
        known = mf.read(self.store.path)
        found = [self.store.path / name for name in (*known.raw_gone, *known.gone_segments)]
        left = [path for path in found if path.exists()]
        for path in left:
            path.unlink(missing_ok=True)
        return len(left)


def _tombstone(removal: Removal, what: DeletionKind, place: JournalWindow) -> Tombstone:
    return Tombstone(
        (place.name,), what, place.writer, place.run, place.first_seq, place.end_seq,
        place.start_ns, place.end_ns, place.chain, removal.reason, removal.unit.confirmed,
        time.time_ns(),
    )  # fmt: skip


# Between two checks of the free space while something else is being done
SPACE_CHECK_PERIOD_S = 0.1
_PATIENCE_S = 1.0  # between two searches for units to delete when there were none
_BATCH = 64
_MANIFEST_SHARE = 20


class Deleter:
    """Deletes in one store; ``pending`` returns whether a journal will still have columns.

    Any thread may make room; deleting and listing the store's files need ``mf.CHANGING``.
    """

    def __init__(
        self,
        store: Store,
        options: RetentionOptions,
        journal: DerivedJournal,
        pending: Callable[[str], bool],
    ) -> None:
        self.use = DiskUse(store.path)
        self.inventory = JournalInventory(store, self.use)
        self._store = store
        self._options = options
        self._journal = journal
        self._pending = pending
        self._kept = KeptJournal(store)
        self._remover = Remover(store, self._kept)
        self._full = FullMark(store)
        self._log = DeletionLog()
        self._checked_s = 0.0
        self._retry_after_s = 0.0
        self._busy = ""
        self._expected = 0
        self._stated: tuple[int, int] | None = None
        self._trouble = ""

    def recover(self) -> None:
        """Finish deletions that an earlier process has begun."""
        with mf.CHANGING:
            self._remover.finish()

    def measure(self) -> SpaceBudget:
        """Return the bytes that the store uses and may use, and publish them to the recorder."""
        with mf.CHANGING:
            looked_ns = time.monotonic_ns()
            now = space_budget(self._store, self._options, self.use.measure(), self._expected)
            stated = now.left, now.headroom // 2
            if stated != self._stated:
                with suppress(OSError):  # then the recorder uses the statement before
                    usage.publish_statement(self._store.path, SpaceStatement(*stated, looked_ns))
                    self._stated = stated
            return now

    @contextmanager
    def expecting(self, size: int, busy: str = "") -> Iterator[bool]:
        """Hold ``size`` bytes free for a coming write; yields whether there is space.

        Journal ``busy`` is being read meanwhile and is not deleted.
        """
        with mf.CHANGING:
            self._expected, self._busy = size, busy
            self.make_room()
        try:
            yield not self.is_full
        finally:
            self._expected, self._busy = 0, ""

    @property
    def is_full(self) -> bool:
        """Return whether only events are recorded because of missing space."""
        return self._full.is_set

    def sealed(self, writer: str) -> list[str]:
        """Return the names of a writer's finished journal files, in order."""
        with mf.CHANGING:
            return self.inventory.sealed(writer)

    def make_room_if_due(self) -> None:
        """Check the free space and make room, but not more often than needed."""
        now_s = time.monotonic()
        if now_s - self._checked_s >= SPACE_CHECK_PERIOD_S:
            self._checked_s = now_s
            self.make_room(patient=now_s < self._retry_after_s)

    def make_room(self, *, patient: bool = False) -> None:
        """Delete until there is space again; mark the store as full if nothing may be deleted."""
        try:
            with mf.CHANGING:
                left = self.measure()
                if left.needed > 0 and not patient:
                    left = self._delete_for(left)
                self._mark(left)
        except OSError as error:  # a disk error: the next attempt may succeed
            self._complain(f"cannot delete: {error.strerror or error}")

    def _delete_for(self, left: SpaceBudget) -> SpaceBudget:
        while left.needed > 0:
            if not self._delete_some(left.needed):
                released = release_confirmed(self._store)
                if released is None:
                    self._retry_after_s = time.monotonic() + _PATIENCE_S
                    break
                text = f"incident {released}, which a server holds, is let go for room"
                self._log_event("incident_released", text, incident=released)
            left = self.measure()
        return left

    def _delete_some(self, needed_bytes: int) -> int:
        known = mf.read(self._store.path)
        windows = self.inventory.windows(known)
        units = self.inventory.units(known, windows, self._pending)
        chosen = for_room(self._free(units), needed_bytes, self._options)
        if not chosen:  # then recording would stop: rows stored twice are deleted first
            chosen = spared_columns((u for u in units if u.name != self._busy), needed_bytes)
        return self._remove(chosen[:_BATCH], windows)

    def _free(self, units: Sequence[DeletionUnit]) -> list[DeletionUnit]:
        return unpinned(self._store, (u for u in units if u.name != self._busy))

    def expire(self) -> None:
        """Delete the units that have outlived their lifetime."""
        lifetime = self._options.lifetime
        if lifetime.raw_s is None and lifetime.columns_s is None:
            return
        while self._expire_some() == _BATCH:
            self.make_room_if_due()

    def _expire_some(self) -> int:
        with mf.CHANGING:
            known = mf.read(self._store.path)
            windows = self.inventory.windows(known)
            units = self.inventory.units(known, windows, self._pending, sure=True)
            chosen = too_old(self._free(units), self._options)[:_BATCH]
            return self._remove(chosen, windows)

    def _remove(self, chosen: Sequence[Removal], windows: Mapping[str, JournalWindow]) -> int:
        gone = self._remover.remove(chosen, windows)
        for removal, tombstone in gone:
            self._log.add(removal, tombstone)
        return len(gone)

    def trim_ring(self) -> None:
        """Delete ring files that ended longer ago than the ring is long."""
        with mf.CHANGING:
            ring = self.inventory.ring()
        for window, age_s in ring:
            path = self._store.path / window.name
            if age_s > self._options.ring_s and path.exists():
                with mf.CHANGING, pin_lock(self._store):
                    if not is_needed(self._store, window, path):
                        path.unlink(missing_ok=True)

    def condense(self, sign: SignHead) -> None:
        """Condense the manifest when most of it is about deleted files."""
        with mf.CHANGING:
            large = min(LARGE_BYTES, self.measure().limit // _MANIFEST_SHARE)
            condense(self._store.path, lambda name: (self._store.path / name).exists(), sign, large)

    def report(self, *, now: bool = False) -> None:
        """Log the deletions since the last call."""
        with mf.CHANGING, suppress(OSError):  # it stays due
            records = self._log.due(now=now)
            if records:
                with_reserve(self._store, lambda: self._journal.write(records))
                self._log.forget()

    def close(self) -> None:
        """Write the pending deletions into the log."""
        self.report(now=True)
        with suppress(OSError):
            self._kept.close()

    def _mark(self, left: SpaceBudget) -> None:
        if left.needed > 0 and left.is_full:
            reason = "nothing that is left may be deleted"
            if self._options.when_full == "stop":
                reason = "nothing is deleted for room (when_full: stop)"
            if with_reserve(self._store, lambda: self._full.set(reason)):
                text = f"the store is full: {reason}; only events are recorded"
                self._log_event("store_full", text, used=left.used, limit=left.limit)
        elif left.needed <= 0 and self._full.clear():
            self._log_event("store_room", "there is room in the store again")

    def _log_event(self, kind: str, text: str, **details: object) -> None:
        with suppress(OSError):
            record = event(kind, text, "keeper", **details)
            with_reserve(self._store, lambda: self._journal.write([record]))

    def _complain(self, text: str) -> None:
        if text != self._trouble:
            self._trouble = text
            print(f"amberbox keeper: {text}", file=sys.stderr)


FREE_SPACE_PERIOD_S = 0.1
# How long other threads may keep the interpreter from this one: they have lower priority
_SWITCH_S = 0.0005


class FreeSpaceThread:
    """Checks the free space ten times a second.

    Start it before the process lowers its priority, which on Linux is that of a thread.
    """

    def __init__(self, look: Callable[[], None]) -> None:
        self._look = look
        self._error: Exception | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="room", daemon=True)
        sys.setswitchinterval(_SWITCH_S)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._over.wait(FREE_SPACE_PERIOD_S):
                self._look()
        except Exception as error:  # the maintenance process must not go on without it
            self._error = error

    def check(self) -> None:
        """Raise the error that has ended the thread, if there is one."""
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """Stop the thread after its present work."""
        self._over.set()
        self._thread.join()
