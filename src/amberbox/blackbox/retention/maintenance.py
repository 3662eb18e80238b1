"""The maintenance process of a store: build segments, seal, pin, delete, beside the recorder.

It runs as a process of its own at low priority, so that nothing it does can hold up recording.
Only this process deletes.
"""

from __future__ import annotations

import sys
import threading
import time
from contextlib import suppress

from amberbox.blackbox.retention.deletion import Deleter, FreeSpaceThread
from amberbox.blackbox.retention.incidents import IncidentMaintenance
from amberbox.blackbox.retention.missions import MissionService
from amberbox.blackbox.retention.notes import NoteService
from amberbox.blackbox.retention.usage import DISK_FULL_ERRORS, with_reserve
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.signing.signatures import Signer
from amberbox.blackbox.store import manifest
from amberbox.blackbox.store import store as store_store
from amberbox.blackbox.store.derived_journal import DerivedJournal, event
from amberbox.blackbox.store.item_names import new_names, stated_names
from amberbox.blackbox.store.journal_reader import journal_file, previous_chain
from amberbox.blackbox.store.manifest import in_short, restore
from amberbox.blackbox.store.segment_builder import (
    build_segments,
    drop_gone,
    merge_small,
    remove_leftovers,
)
from amberbox.blackbox.store.segment_file import can_build
from amberbox.blackbox.store.store import EVENT_REQUEST, FOLDERS, Store, WriterLock, is_locked
from amberbox.core.clock import Clock
from amberbox.core.errors import UsageError


def take_event_requests(store: Store, journal: DerivedJournal) -> None:
    """Write the events that other processes have requested."""
    for request in store_store.pending(store):
        if request.kind == EVENT_REQUEST:
            about = {name: str(request.values.get(name, "")) for name in ("kind", "text", "source")}
            try:
                journal.write([event(**about, asked_ns=request.wall_ns)])
            except OSError:
                return  # no room just now: with the next step
            store_store.finish(request)


# Interval of retries of failed work and of checks for unnoticed changes
_RECHECK_S = 30.0

Situation = tuple[object, ...]


class StoreChangeDetector:
    """Compares the store with its state at the last check."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._before: Situation = ()
        self._until_s = 0.0

    def changed(self, *about: object) -> bool:
        """Return whether the store, or anything in ``about``, has changed since the last call."""
        now, now_s = (*about, *self._now()), time.monotonic()
        if now == self._before and now_s < self._until_s:
            return False
        self._before, self._until_s = now, now_s + _RECHECK_S
        return True

    def _now(self) -> Situation:
        """Return the manifest's head, the existing files, and which of them are being written."""
        folders = [self._store.folder(writer) for writer in FOLDERS]
        times_ns = [folder.stat().st_mtime_ns for folder in folders if folder.exists()]
        locks = [is_locked(self._store, writer) for writer in ("main", "bulk")]
        return (manifest.read(self._store.path).last_hash, *times_ns, *locks)


# After a recorder was killed its maintenance process lives on for a moment; the next one waits
LOCK_TIMEOUT_S = 10.0
_BUILT = ("main", "bulk")


class RetentionService:
    """Maintains one store; ``step`` does the work due now, ``breathe`` the urgent part of it."""

    def __init__(
        self, store: Store, options: RetentionOptions | None = None, clock: Clock | None = None
    ) -> None:
        self._store = store
        self._options = options or RetentionOptions()
        self.journal = DerivedJournal(
            store, "keep", robot=self._options.robot, config_hash=self._options.config_hash,
            clock=clock, chain=lambda: previous_chain(store, "keep"),
        )  # fmt: skip
        self._with_segments = can_build()
        self._refused: set[str] = set()
        self._signer = Signer(store, self.journal)
        self._deleter = Deleter(store, self._options, self.journal, self._is_pending)
        self._incidents = IncidentMaintenance(store, self._options, self.journal)
        self._missions = MissionService(store, self._options.missions, self.journal)
        self._notes = NoteService(store, self.journal)
        self._recovered = False
        self._room: FreeSpaceThread | None = None
        self._situations = StoreChangeDetector(store)
        self._dropped: manifest.Manifest | None = None
        """The manifest for which nothing is left to be dropped."""

    def start_space_thread(self) -> None:
        """Start the thread that frees disk space from now on, independent of other tasks."""
        self._room = FreeSpaceThread(self._deleter.make_room_if_due)

    def step(self, stop: threading.Event) -> None:
        """Do everything once: requests, segments, deletion, signatures."""
        self._recover()
        self._incidents.step()  # windows pinned now are not deleted below
        self._missions.step()
        self._notes.step()
        manifest.take_confirmations(self._store)  # deleted last below
        self._make_room()
        take_event_requests(self._store, self.journal)
        if self._situations.changed(self._deleter.is_full):
            self.build(stop)
        self._deleter.trim_ring()
        self._deleter.expire()
        # take the rows of deleted journals out of segments that hold others, too
        known = manifest.read(self._store.path)
        if self._with_segments and known is not self._dropped:
            with suppress(OSError):  # no room for it just now
                drop_gone(self._store.path, self.make_room_if_due)
                self._dropped = known
        self._make_room()
        self._deleter.condense(self._signer.signature_of)
        self._deleter.report()
        # enter the items' names in the manifest, where they are signed
        path = self._store.path
        with manifest.CHANGING, suppress(OSError):  # no room for it just now
            new = new_names(stated_names(path) or {}, manifest.read(path).names)
            if new:
                manifest.append(path, [manifest.names_record(new)])
        self._signer.sign()

    def _make_room(self) -> None:
        if self._room is None:
            self._deleter.make_room()
        else:
            self._room.check()

    def make_room_if_due(self) -> None:
        """Make room if due, where no thread does so; called often in long work."""
        if self._room is None:
            self._deleter.make_room_if_due()

    def close(self) -> None:
        """Log pending firings and deletions, finish the maintenance journal."""
        if self._room is not None:
            self._room.stop()
        self._incidents.close()
        self._missions.close()
        self._deleter.close()
        with suppress(OSError):
            self.journal.close()
        self._signer.close()

    def _recover(self) -> None:
        """Finish the work in which an earlier process was killed."""
        if not self._recovered:
            self._recovered = True
            # restore the manifest where lines of it, or segments, are damaged, and log it
            with suppress(OSError):  # no room for it just now: the next keeper tries again
                damaged = restore(self._store.path)
                if damaged:
                    text = "damage was found and made up for as far as segments and journals tell: "
                    self.journal.write([event("restored", text + in_short(damaged), "keeper")])
            self._deleter.recover()
            if self._with_segments:
                remove_leftovers(self._store.path)

    def build(self, stop: threading.Event) -> None:
        """Seal finished journals, and build their segments."""
        self._deleter.measure()
        self._signer.seal(lambda: self._interrupted(stop))
        if not self._with_segments:
            return
        built = 0
        for name in self._to_build():
            if stop.is_set() or self._deleter.is_full:
                return
            built += self._build_one(name)
        if built:
            try:
                merge_small(self._store.path, self.make_room_if_due)
            except OSError as error:
                if error.errno not in DISK_FULL_ERRORS:
                    raise

    def _interrupted(self, stop: threading.Event) -> bool:
        """Make room if due amid long work, and return whether to stop."""
        self.make_room_if_due()
        return stop.is_set()

    def _to_build(self) -> list[str]:
        done = manifest.read(self._store.path).journals
        names = [name for writer in _BUILT for name in self._deleter.sealed(writer)]
        return [name for name in names if name not in done and self._is_pending(name)]

    def _is_pending(self, name: str) -> bool:
        """Return whether a journal that has no columns will have some."""
        columns_gone = manifest.read(self._store.path).columns_gone
        return self._with_segments and name not in self._refused and name not in columns_gone

    def _build_one(self, name: str) -> int:
        size = self._deleter.inventory.bytes_of(name)
        try:
            with self._deleter.expecting(size, busy=name) as has_room:
                return has_room and self._build_from(name)
        except FileNotFoundError:  # deleted for room meanwhile
            return 0
        except Exception as error:  # any error: the other journals go on
            if isinstance(error, OSError) and error.errno in DISK_FULL_ERRORS:
                return 0  # tried again with the next step
            self._refused.add(name)  # its rows stay readable in the journal
            print(f"amberbox keeper: {name}: no segments: {error}", file=sys.stderr)
            return 0

    def _build_from(self, name: str) -> int:
        journal = journal_file(self._store.path / name, name)
        if not journal.rows:
            self._refused.add(name)
            return 0
        build_segments(self._store.path, journal, self.make_room_if_due)
        return 1


def wait_for_lock(store: Store, patience_s: float, stop: threading.Event) -> WriterLock:
    """Return the maintenance lock of a store; raises UsageError when another process keeps it."""
    end = time.monotonic() + patience_s
    while True:
        try:
            return with_reserve(store, lambda: WriterLock(store, "keeper"))
        except UsageError:
            if time.monotonic() >= end or stop.wait(0.2):
                raise


def seal(store: Store) -> None:
    """Seal and build once, as an import does at its end; nothing is deleted."""
    with suppress(UsageError):  # another keeper is at work here: it does so, too
        lock = wait_for_lock(store, LOCK_TIMEOUT_S, threading.Event())
        keeper = RetentionService(store, RetentionOptions(quota_percent=100.0, min_free=0))
        keeper.build(threading.Event())
        keeper.close()
        lock.release()
