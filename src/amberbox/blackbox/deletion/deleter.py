"""Keeps a store within its limits: deletes by the one rule, says when there is no room left."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress

from amberbox.blackbox.deletion import allowance
from amberbox.blackbox.deletion.allowance import Statement
from amberbox.blackbox.deletion.holding import is_needed, pinning, release_confirmed
from amberbox.blackbox.deletion.kept import KeptJournal
from amberbox.blackbox.deletion.limit import FullMark, Room, room, with_reserve
from amberbox.blackbox.deletion.log import DeletionLog
from amberbox.blackbox.deletion.pinlock import pin_lock
from amberbox.blackbox.deletion.removal import Remover
from amberbox.blackbox.deletion.rule import (
    Removal,
    Unit,
    Window,
    for_room,
    spared_columns,
    too_old,
    unpinned,
)
from amberbox.blackbox.deletion.stock import Stock
from amberbox.blackbox.deletion.usage import DiskUse
from amberbox.blackbox.keeper.options import KeeperOptions
from amberbox.blackbox.keeper.ownjournal import OwnJournal, event
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.condense import LARGE_BYTES, SignHead, condense
from amberbox.blackbox.store import Store

BREATH_S = 0.1
"""Between two looks at the room that is left, while something else is being done."""
_PATIENCE_S = 1.0
"""Between two searches for what may be deleted when there was nothing."""
_BATCH = 64
_MANIFEST_SHARE = 20


class Deleter:
    """Deletes in one store; ``pending`` tells which journals will still have columns.

    Any thread may make room; whoever deletes, or looks at what there is, holds ``mf.CHANGING``.
    """

    def __init__(
        self,
        store: Store,
        options: KeeperOptions,
        journal: OwnJournal,
        pending: Callable[[str], bool],
    ) -> None:
        self.use = DiskUse(store.path)
        self.stock = Stock(store, self.use)
        self._store = store
        self._options = options
        self._journal = journal
        self._pending = pending
        self._kept = KeptJournal(store)
        self._remover = Remover(store, self._kept, lambda: pinning(store))
        self._full = FullMark(store)
        self._log = DeletionLog()
        self._looked_s = 0.0
        self._in_vain_s = 0.0
        self._busy = ""
        self._expected = 0
        self._stated: tuple[int, int] | None = None
        self._trouble = ""

    def recover(self) -> None:
        """Finish what a keeper before has begun to delete."""
        with mf.CHANGING:
            self._remover.finish()

    def measure(self) -> Room:
        """Return how much the store takes and may take now, and tell the recorder."""
        with mf.CHANGING:
            looked_ns = time.monotonic_ns()
            now = room(self._store, self._options, self.use.measure(), self._expected)
            self._state(now, looked_ns)
            return now

    def _state(self, now: Room, looked_ns: int) -> None:
        stated = now.left, now.headroom // 2
        if stated != self._stated:
            with suppress(OSError):  # then the recorder goes by the statement before
                allowance.state(self._store.path, Statement(*stated, looked_ns))
                self._stated = stated

    @contextmanager
    def expecting(self, size: int, busy: str = "") -> Iterator[bool]:
        """Hold room free for what is about to be written; tells whether there is any.

        Journal ``busy`` is being read meanwhile and stays.
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
        """Tell whether nothing but events is recorded for want of room."""
        return self._full.is_set

    def sealed(self, writer: str) -> list[str]:
        """Name a writer's journal files that nobody writes, in order."""
        with mf.CHANGING:
            return self.stock.sealed(writer)

    def breathe(self) -> None:
        """See to the room that is left, but not more often than needed."""
        now_s = time.monotonic()
        if now_s - self._looked_s >= BREATH_S:
            self._looked_s = now_s
            self.make_room(patient=now_s < self._in_vain_s)

    def make_room(self, *, patient: bool = False) -> None:
        """Delete until there is room again; where nothing may go, say that the store is full."""
        try:
            with mf.CHANGING:
                left = self.measure()
                if left.needed > 0 and not patient:
                    left = self._delete_for(left)
                self._mark(left)
        except OSError as error:  # a disk in trouble: the next look may find it better
            self._complain(f"cannot delete: {error.strerror or error}")

    def _delete_for(self, left: Room) -> Room:
        while left.needed > 0:
            if not self._delete_some(left.needed):
                released = release_confirmed(self._store)
                if released is None:
                    self._in_vain_s = time.monotonic() + _PATIENCE_S
                    break
                text = f"incident {released}, which a server holds, is let go for room"
                self._tell("incident_released", text, incident=released)
            left = self.measure()
        return left

    def _delete_some(self, needed_bytes: int) -> int:
        known = mf.read(self._store.path)
        windows = self.stock.windows(known)
        units = self.stock.units(known, windows, self._pending)
        chosen = for_room(self._free(units), needed_bytes, self._options)
        if not chosen:  # then recording would stop: what is there twice goes first
            chosen = spared_columns((u for u in units if u.name != self._busy), needed_bytes)
        return self._remove(chosen[:_BATCH], windows)

    def _free(self, units: Sequence[Unit]) -> list[Unit]:
        return unpinned((u for u in units if u.name != self._busy), pinning(self._store))

    def expire(self) -> None:
        """Delete what has outlived its lifetime."""
        lifetime = self._options.lifetime
        if lifetime.raw_s is None and lifetime.columns_s is None:
            return
        while self._expire_some() == _BATCH:
            self.breathe()

    def _expire_some(self) -> int:
        with mf.CHANGING:
            known = mf.read(self._store.path)
            windows = self.stock.windows(known)
            units = self.stock.units(known, windows, self._pending, sure=True)
            chosen = too_old(self._free(units), self._options)[:_BATCH]
            return self._remove(chosen, windows)

    def _remove(self, chosen: Sequence[Removal], windows: Mapping[str, Window]) -> int:
        gone = self._remover.remove(chosen, windows)
        for removal, tombstone in gone:
            self._log.add(removal, tombstone)
        return len(gone)

    def trim_ring(self) -> None:
        """Delete ring files that ended longer ago than the ring is long."""
        with mf.CHANGING:
            ring = self.stock.ring()
        for window, age_s in ring:
            path = self._store.path / window.name
            if age_s > self._options.ring_s and path.exists():
                with mf.CHANGING, pin_lock(self._store):
                    if not is_needed(self._store, window, path):
                        path.unlink(missing_ok=True)

    def condense(self, sign: SignHead) -> None:
        """Write the manifest anew when most of it is about what is long gone."""
        with mf.CHANGING:
            self._condense(sign)

    def _condense(self, sign: SignHead) -> None:
        large = min(LARGE_BYTES, self.measure().limit // _MANIFEST_SHARE)
        condense(self._store.path, lambda name: (self._store.path / name).exists(), sign, large)

    def report(self, *, now: bool = False) -> None:
        """Write down what was deleted since the last time."""
        with mf.CHANGING, suppress(OSError):  # it stays due
            records = self._log.due(now=now)
            if records:
                with_reserve(self._store, lambda: self._journal.write(records))
                self._log.forget()

    def close(self) -> None:
        """Write down the rest."""
        self.report(now=True)
        with suppress(OSError):
            self._kept.close()

    def _mark(self, left: Room) -> None:
        if left.needed > 0 and left.is_full:
            reason = "nothing that is left may be deleted"
            if self._options.when_full == "stop":
                reason = "nothing is deleted for room (when_full: stop)"
            if with_reserve(self._store, lambda: self._full.set(reason)):
                text = f"the store is full: {reason}; only events are recorded"
                self._tell("store_full", text, used=left.used, limit=left.limit)
        elif left.needed <= 0 and self._full.clear():
            self._tell("store_room", "there is room in the store again")

    def _tell(self, kind: str, text: str, **details: object) -> None:
        with suppress(OSError):
            record = event(kind, text, "keeper", **details)
            with_reserve(self._store, lambda: self._journal.write([record]))

    def _complain(self, text: str) -> None:
        if text != self._trouble:
            self._trouble = text
            print(f"amberbox keeper: {text}", file=sys.stderr)
