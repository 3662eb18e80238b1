"""The keeper: turns finished journals into segments and bounds the disk, beside the recorder.

It runs as a process of its own at low priority, so that nothing it does can hold up recording.
Only the keeper deletes.
"""

from __future__ import annotations

import sys
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING

from amberbox.blackbox.deletion import confirm
from amberbox.blackbox.deletion.deleter import Deleter
from amberbox.blackbox.deletion.limit import NO_ROOM, with_reserve
from amberbox.blackbox.deletion.roomthread import RoomThread
from amberbox.blackbox.follow.chain import previous_chain
from amberbox.blackbox.follow.read import journal_file
from amberbox.blackbox.keeper import remarks
from amberbox.blackbox.keeper.options import KeeperOptions
from amberbox.blackbox.keeper.ownjournal import OwnJournal, event
from amberbox.blackbox.keeper.situation import Situations
from amberbox.blackbox.recorder.names import new_names, stated_names
from amberbox.blackbox.segments import manifest
from amberbox.blackbox.segments.build import (
    build_segments,
    can_build,
    merge_small,
    remove_leftovers,
)
from amberbox.blackbox.segments.dropping import drop_gone
from amberbox.blackbox.segments.restoring import in_short, restore
from amberbox.blackbox.signing.notary import Notary
from amberbox.blackbox.store import Store, WriterLock
from amberbox.core.clock import Clock
from amberbox.core.errors import UsageError

if TYPE_CHECKING:
    from amberbox.blackbox.keeper.incidents import IncidentKeeping
    from amberbox.blackbox.keeper.missions import MissionKeeper

PATIENCE_S = 10.0
"""After the recorder was killed its keeper lives on for a moment; the next one waits for it."""
_BUILT = ("main", "bulk")
"""Writers whose journals become segments."""


class Keeper:
    """Keeps one store; ``step`` does what there is to do now, ``breathe`` what cannot wait."""

    def __init__(
        self, store: Store, options: KeeperOptions | None = None, clock: Clock | None = None
    ) -> None:
        self._store = store
        self._options = options or KeeperOptions()
        self.journal = OwnJournal(
            store, "keep", robot=self._options.robot, config_hash=self._options.config_hash,
            clock=clock, chain=lambda: previous_chain(store, "keep"),
        )  # fmt: skip
        self._with_segments = can_build()
        self._refused: set[str] = set()
        self._notary = Notary(store, self.journal)
        self._deleter = Deleter(store, self._options, self.journal, self._is_pending)
        self._incidents = _incidents(store, self._options, self.journal)
        self._missions = _missions(store, self._options, self.journal)
        self._recovered = False
        self._room: RoomThread | None = None
        self._situations = Situations(store)
        self._dropped: manifest.Manifest | None = None
        """The manifest for which nothing is left to be dropped."""

    def mind_room(self) -> None:
        """Make room in a thread of its own from now on, whatever else there is to do."""
        self._room = RoomThread(self._deleter.breathe)

    def step(self, stop: threading.Event) -> None:
        """Do everything once: what others ask for, segments, deletion, accounts."""
        self._recover()
        self._incidents.step()  # what is pinned now is not deleted below
        self._missions.step()
        confirm.take_requests(self._store)  # what a server lacks is not the first to go below
        self._make_room()
        remarks.take_requests(self._store, self.journal)
        if self._situations.changed(self._deleter.is_full):
            self.build(stop)
        self._deleter.trim_ring()
        self._deleter.expire()
        self._drop_gone()
        self._make_room()
        self._deleter.condense(self._notary.signature_of)
        self._deleter.report()
        self._note_names()
        self._notary.sign()

    def _drop_gone(self) -> None:
        """Take the rows of deleted journals out of segments that hold others, too."""
        known = manifest.read(self._store.path)
        if self._with_segments and known is not self._dropped:
            with suppress(OSError):  # no room for it just now
                drop_gone(self._store.path, self.breathe)
                self._dropped = known

    def _make_room(self) -> None:
        if self._room is None:
            self._deleter.make_room()
        else:
            self._room.check()

    def breathe(self) -> None:
        """See to the room that is left, where no thread does; to be called often in long work."""
        if self._room is None:
            self._deleter.breathe()

    def close(self) -> None:
        """Write down what is left to say, finish the keeper's own journals."""
        if self._room is not None:
            self._room.stop()
        self._incidents.close()
        self._missions.close()
        self._deleter.close()
        with suppress(OSError):
            self.journal.close()
        self._notary.close()

    def _recover(self) -> None:
        """Finish what a keeper before this one was killed over."""
        if not self._recovered:
            self._recovered = True
            self._restore()
            self._deleter.recover()
            if self._with_segments:
                remove_leftovers(self._store.path)

    def _restore(self) -> None:
        """Put the manifest right where lines of it, or segments, are damaged, and say so."""
        with suppress(OSError):  # no room for it just now: the next keeper tries again
            told = restore(self._store.path)
            if told:
                text = "damage was found and made up for as far as segments and journals tell: "
                self.journal.write([event("restored", text + in_short(told), "keeper")])

    def _note_names(self) -> None:
        """Enter the items' names in the manifest, where they are signed."""
        path = self._store.path
        with manifest.CHANGING, suppress(OSError):  # no room for it just now
            new = new_names(stated_names(path) or {}, manifest.read(path).names)
            if new:
                manifest.append(path, [manifest.names_record(new)])

    def build(self, stop: threading.Event) -> None:
        """Seal the journals that nobody writes any more, and build their segments."""
        self._deleter.measure()
        self._notary.seal(lambda: self._interrupted(stop))
        if not self._with_segments:
            return
        built = 0
        for name in self._to_build():
            if stop.is_set() or self._deleter.is_full:
                return
            built += self._build_one(name)
        if built:
            self._merge()

    def _interrupted(self, stop: threading.Event) -> bool:
        """See to the room that is left amid long work, and tell whether it is time to go."""
        self.breathe()
        return stop.is_set()

    def _to_build(self) -> list[str]:
        done = manifest.read(self._store.path).journals
        names = [name for writer in _BUILT for name in self._deleter.sealed(writer)]
        return [name for name in names if name not in done and self._is_pending(name)]

    def _is_pending(self, name: str) -> bool:
        """Tell whether a journal that has no columns will have some."""
        columns_gone = manifest.read(self._store.path).columns_gone
        return self._with_segments and name not in self._refused and name not in columns_gone

    def _build_one(self, name: str) -> int:
        size = self._deleter.stock.bytes_of(name)
        try:
            with self._deleter.expecting(size, busy=name) as has_room:
                return has_room and self._build_from(name)
        except FileNotFoundError:  # deleted for room meanwhile
            return 0
        except Exception as error:  # whatever it is: the other journals go on
            if isinstance(error, OSError) and error.errno in NO_ROOM:
                return 0  # tried again with the next step
            self._refused.add(name)  # its rows stay readable in the journal
            print(f"amberbox keeper: {name}: no segments: {error}", file=sys.stderr)
            return 0

    def _merge(self) -> None:
        """Join small segments, where there is room for that."""
        try:
            merge_small(self._store.path, self.breathe)
        except OSError as error:
            if error.errno not in NO_ROOM:
                raise

    def _build_from(self, name: str) -> int:
        journal = journal_file(self._store.path / name, name)
        if not journal.rows:
            self._refused.add(name)
            return 0
        build_segments(self._store.path, journal, self.breathe)
        return 1


def _missions(store: Store, options: KeeperOptions, journal: OwnJournal) -> MissionKeeper:
    from amberbox.blackbox.keeper.missions import MissionKeeper  # see above

    return MissionKeeper(store, options.missions, journal)


def _incidents(store: Store, options: KeeperOptions, journal: OwnJournal) -> IncidentKeeping:
    from amberbox.blackbox.keeper.incidents import IncidentKeeping  # it imports our options

    return IncidentKeeping(store, options, journal)


def wait_for_lock(store: Store, patience_s: float, stop: threading.Event) -> WriterLock:
    """Become the keeper of a store; raises UsageError when another one stays."""
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
        lock = wait_for_lock(store, PATIENCE_S, threading.Event())
        keeper = Keeper(store, KeeperOptions(quota_percent=100.0, min_free=0))
        keeper.build(threading.Event())
        keeper.close()
        lock.release()
