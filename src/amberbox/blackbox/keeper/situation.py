"""Whether a store has changed so that there may be journals to seal or to build."""

from __future__ import annotations

import time

from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.store import FOLDERS, Store, is_locked

_ALL_THE_SAME_S = 30.0
"""Work that failed, or a change that did not show, is looked for this often."""

Situation = tuple[object, ...]


class Situations:
    """Compares the store with what it was like when it was looked through last."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._before: Situation = ()
        self._until_s = 0.0

    def changed(self, *about: object) -> bool:
        """Tell whether the store, or anything in ``about``, is no longer what it was last time."""
        now, now_s = (*about, *self._now()), time.monotonic()
        if now == self._before and now_s < self._until_s:
            return False
        self._before, self._until_s = now, now_s + _ALL_THE_SAME_S
        return True

    def _now(self) -> Situation:
        """State the manifest's head, which files there are, and which of them are written."""
        folders = [self._store.folder(writer) for writer in FOLDERS]
        times_ns = [folder.stat().st_mtime_ns for folder in folders if folder.exists()]
        locks = [is_locked(self._store, writer) for writer in ("main", "bulk")]
        return (mf.read(self._store.path).last_hash, *times_ns, *locks)
