"""Note which journals a server holds, verified: they are the first to go when room is needed."""

from __future__ import annotations

import time
from collections.abc import Sequence

from amberbox.blackbox import requests
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.entries import confirmed_record, unconfirmed_record
from amberbox.blackbox.store import Store, WriterLock
from amberbox.core.errors import UsageError

KIND, UNCONFIRM = "confirm", "unconfirm"


def confirm(store: Store, journals: Sequence[str], by: str) -> None:
    """Enter journals (``folder/file``) as held by the server ``by``.

    A keeper that is at work is asked to do it; else it is done at once.
    """
    _have_entered(store, KIND, journals, by)


def unconfirm(store: Store, journals: Sequence[str], by: str) -> None:
    """Enter that the server ``by`` lacks journals that were confirmed: it was restored, say.

    They are deleted no earlier than others then, and are copied again.
    """
    _have_entered(store, UNCONFIRM, journals, by)


def _have_entered(store: Store, kind: str, journals: Sequence[str], by: str) -> None:
    try:
        lock = WriterLock(store, "keeper")
    except UsageError:
        requests.submit(store, kind, {"journals": list(journals), "by": by})
        return
    try:
        _enter(store, kind, journals, by)
    finally:
        lock.release()


def _enter(store: Store, kind: str, journals: Sequence[str], by: str) -> None:
    """Append to the manifest what is news; only who holds the keeper's lock may."""
    known = mf.read(store.path).confirmed
    news = tuple(name for name in journals if (name in known) != (kind == KIND))
    if news:
        record = confirmed_record if kind == KIND else unconfirmed_record
        mf.append(store.path, [record(news, by, time.time_ns())])


def take_requests(store: Store) -> None:
    """See to what other processes have asked to be entered, in the order they did."""
    for request in requests.pending(store):
        if request.kind in (KIND, UNCONFIRM):
            names = [str(name) for name in request.values.get("journals", ())]
            _enter(store, request.kind, names, str(request.values.get("by", "")))
            requests.finish(request)
