"""The lock between those who pin a stretch of the record and the keeper that deletes."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager

from amberbox.blackbox.store import Store

NAME = "lock.pins"


@contextmanager
def pin_lock(store: Store) -> Iterator[None]:
    """Hold the right to pin and to delete; whoever has it reads the pins anew before deleting.

    Waits for the other side, which holds it for a few files at most.
    """
    with (store.path / NAME).open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
