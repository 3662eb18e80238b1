"""Events that other processes want in the record: left as requests, written by the keeper."""

from __future__ import annotations

from contextlib import suppress

from amberbox.blackbox import requests
from amberbox.blackbox.keeper.ownjournal import OwnJournal, event
from amberbox.blackbox.store import Store

KIND = "event"


def remark(store: Store, kind: str, text: str, source: str) -> None:
    """Leave an event for the keeper; on a full disk it is let go."""
    with suppress(OSError):
        requests.submit(store, KIND, {"kind": kind, "text": text, "source": source})


def take_requests(store: Store, journal: OwnJournal) -> None:
    """Write down the events that other processes have left."""
    for request in requests.pending(store):
        if request.kind == KIND:
            about = {name: str(request.values.get(name, "")) for name in ("kind", "text", "source")}
            try:
                journal.write([event(**about, asked_ns=request.wall_ns)])
            except OSError:
                return  # no room just now: with the next step
            requests.finish(request)
