"""The keeper's notary: seals journals, signs the manifest, states how far everything reaches."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from amberbox.blackbox.keeper.ownjournal import OwnJournal, event
from amberbox.blackbox.signing.keys import Keys, open_keys
from amberbox.blackbox.signing.sealing import seal_journals
from amberbox.blackbox.signing.signing import sign_manifest, signature_record, write_heads
from amberbox.blackbox.store import Store

STATE_S = 10.0
"""Between two statements of how far everything reaches."""


class Notary:
    """Vouches for one store with its key, which is made when there is none."""

    def __init__(self, store: Store, journal: OwnJournal | None = None) -> None:
        self._store = store
        self._journal = journal
        self._keys: Keys | None = None
        self._stated_s: float | None = None
        self._trouble = ""

    def seal(self, stop: Callable[[], bool] = lambda: False, *, own: bool = False) -> None:
        """Seal the journals that nobody writes any more; with ``own`` the keeper's last, too."""
        self._try(lambda: seal_journals(self._store, self._opened().key, self._tell, stop, own=own))

    def sign(self) -> None:
        """Sign what the manifest says now; every 10 s, state how far the journals reach."""
        self._try(lambda: sign_manifest(self._store, self._opened().key))
        now_s = time.monotonic()
        if self._stated_s is None or now_s - self._stated_s >= STATE_S:
            self._stated_s = now_s
            self.state()

    def state(self) -> None:
        """State how far everything reaches."""
        self._try(lambda: write_heads(self._store, self._opened().key))

    def close(self) -> None:
        """Seal, sign and state for the last time, the keeper's own finished journals included."""
        self._journal = None
        self.seal(own=True)
        self._try(lambda: sign_manifest(self._store, self._opened().key))
        self.state()

    def signature_of(self, head: str) -> Mapping[str, Any] | None:
        """Compose the line that signs a head of the manifest; None without a key."""
        return signature_record(self._store, self._opened().key, head)

    def _opened(self) -> Keys:
        """Open the keys once and tell what is wrong with them."""
        if self._keys is None:
            self._keys = open_keys(self._store)
            for warning in self._keys.warnings:
                self._tell("keys", warning)
            if self._keys.is_new:  # the last word in the manifest is to be that of this key
                sign_manifest(self._store, self._keys.key, again=True)
        return self._keys

    def _tell(self, kind: str, text: str) -> None:
        if self._journal is None:
            print(f"amberbox keeper: {text}", file=sys.stderr)
            return
        with suppress(OSError):
            self._journal.write([event(kind, text, "keeper")])

    def _try(self, work: Callable[[], object]) -> None:
        """Do something that a full or failing disk may refuse; the next step tries again."""
        try:
            work()
        except OSError as error:
            text = f"cannot seal or sign: {error.strerror or error}"
            if text != self._trouble:
                self._trouble = text
                print(f"amberbox keeper: {text}", file=sys.stderr)
        else:
            self._trouble = ""
