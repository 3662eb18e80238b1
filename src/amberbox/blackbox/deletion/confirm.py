"""Note that a server holds journals, verified: they are the first to go when room is needed."""

from __future__ import annotations

import time
from collections.abc import Sequence

from amberbox.blackbox import requests
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.entries import confirmed_record
from amberbox.blackbox.store import Store, WriterLock
from amberbox.core.errors import UsageError

KIND = "confirm"


def confirm(store: Store, journals: Sequence[str], by: str) -> None:
    """Enter journals (``folder/file``) as held by the server ``by``.

    A keeper that is at work is asked to do it; else it is done at once.
    """
    try:
        lock = WriterLock(store, "keeper")
    except UsageError:
        requests.submit(store, KIND, {"journals": list(journals), "by": by})
        return
    try:
        enter(store, journals, by)
    finally:
        lock.release()


def enter(store: Store, journals: Sequence[str], by: str) -> None:
    """Append the confirmation to the manifest; only who holds the keeper's lock may."""
    known = mf.read(store.path).confirmed
    new = tuple(name for name in journals if name not in known)
    if new:
        mf.append(store.path, [confirmed_record(new, by, time.time_ns())])


def take_requests(store: Store) -> None:
    """See to the confirmations that other processes have asked for."""
    for request in requests.pending(store):
        if request.kind == KIND:
            names = [str(name) for name in request.values.get("journals", ())]
            enter(store, names, str(request.values.get("by", "")))
            requests.finish(request)
