"""The keeper's part of incidents: make those it is asked for, see them through, tell of them."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from amberbox.blackbox import requests
from amberbox.blackbox.deletion.limit import with_reserve
from amberbox.blackbox.deletion.pinlock import pin_lock
from amberbox.blackbox.incidents.budget import Refusal, held_bytes
from amberbox.blackbox.incidents.incident import (
    RING,
    At,
    Incident,
    folder_of,
    load_all,
    save,
    to_line,
    triggered,
    unreadable,
    written_again,
)
from amberbox.blackbox.incidents.pin import Wish, advance, pin
from amberbox.blackbox.incidents.timeline import look_back
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.keeper.options import KeeperOptions
from amberbox.blackbox.keeper.ownjournal import OwnJournal, Record, event
from amberbox.blackbox.keeper.ratelimit import Refusals, refused_by_rate
from amberbox.blackbox.requests import Request
from amberbox.blackbox.segments import manifest
from amberbox.blackbox.store import Store, is_locked
from amberbox.core.errors import UsageError

KIND = "incident"
_HOLD_OFF_S = 60.0


class Pins:
    """Pins what triggers and other processes want, and follows each incident to its end."""

    def __init__(self, store: Store, options: KeeperOptions, journal: OwnJournal) -> None:
        self._store = store
        self._options = options
        self._journal = journal
        self._refusals = Refusals()
        self._unreadable: set[Path] = set()

    def step(self) -> None:
        """See to requests, to open incidents, and to those the journal does not know of yet."""
        for request in requests.pending(self._store):
            if request.kind == KIND:
                self._grant(request)
                requests.finish(request)
        for incident in load_all(self._store):
            self._follow(incident)
        self._write([*self._refusals.due(), *self._damage()])

    def close(self) -> None:
        """Tell of the firings that were not told of yet."""
        self._write(list(self._refusals.due(all_of_them=True)))

    def fire(self, wish: Wish, hold_off_s: float = _HOLD_OFF_S) -> Incident | None:
        """Pin a window for a trigger, unless it fires too often; None if nothing was pinned."""
        known = load_all(self._store)
        if wish.key and triggered(known, wish.key):
            return triggered(known, wish.key)
        why = self._too_often(wish, hold_off_s, known)
        done = Refusal(why) if why else self._pinned(wish)
        if isinstance(done, Refusal):
            self._write(list(self._refusals.note(wish.trigger, done.reason, wish.reason)))
            return None
        self._register(done)
        return done

    def _pinned(self, wish: Wish) -> Incident | Refusal:
        return with_reserve(self._store, lambda: pin(self._store, wish, self._options))

    def _too_often(self, wish: Wish, hold_off_s: float, known: list[Incident]) -> str:
        timeline = look_back(self._store, 0, wish.at) if wish.trigger else None
        if timeline is None:
            return ""
        at_ns = timeline.received_ns(wish.at or timeline.end)
        per_hour = self._options.incidents_per_hour
        return refused_by_rate(wish.trigger, at_ns, hold_off_s, known, per_hour)

    def _grant(self, request: Request) -> None:
        values = request.values
        reason, who = str(values.get("reason", "")), str(values.get("who", ""))
        refused = str(values.get("refused", ""))
        if refused:
            self._write(list(self._refusals.note(who, refused, reason)))
            return
        try:
            before_s = float(values.get("before_s", 60.0))
            after_s = float(values.get("after_s", 20.0))
            trigger, at = str(values.get("trigger", "")), self._moment(request)
            self.fire(Wish(before_s, after_s, reason, who, trigger, at, request.path.stem))
        except (TypeError, ValueError, OverflowError, UsageError) as error:
            text = f"an incident was asked for that cannot be made: {error}"
            self._write([event("incident_refused", text, reason=reason)])

    def _moment(self, request: Request) -> At | None:
        """Find the moment of the record at which a request was made."""
        timeline = look_back(self._store, 0)
        if timeline is None:
            return None
        ago_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - request.boot_ns
        if ago_ns < 0 or not is_locked(self._store, "main"):  # another boot, or a record at rest
            ago_ns = max(timeline.end_received_ns - request.wall_ns, 0)
        timeline = look_back(self._store, ago_ns) or timeline
        return timeline.at(ago_ns)

    def _follow(self, incident: Incident) -> None:
        if incident.state == "open":
            incident = advance(self._store, incident, self._options)
        if incident.state == "released":
            shutil.rmtree(folder_of(self._store, incident.id) / RING, ignore_errors=True)
        if incident.told != incident.state:
            self._register(incident)

    def _register(self, incident: Incident) -> None:
        """Write an incident's state down for good, then note that this was done."""
        if incident.told == incident.state:
            return
        ring = sorted(p.name for p in (folder_of(self._store, incident.id) / RING).glob("*.mcap"))
        held = held_bytes(self._store, [incident])
        line = {**to_line(incident, self._journal.now_ns()), "ring": ring, "bytes": held}
        self._write([(reserved.INCIDENT, line["incident"]), _event(incident)])
        with_reserve(self._store, lambda: manifest.append(self._store.path, [line]))
        with pin_lock(self._store):
            now = {other.id: other for other in load_all(self._store)}.get(incident.id)
            if now is not None:
                told = incident.state if now.reasons == incident.reasons else ""
                held = held if told else held_bytes(self._store, [now])
                save(self._store, replace(now, told=told, bytes=held))

    def _damage(self) -> Iterator[Record]:
        for path in unreadable(self._store):
            if path not in self._unreadable:
                self._unreadable.add(path)
                name = path.relative_to(self._store.path)
                text = f"{name} is damaged or gone"
                with pin_lock(self._store):
                    if written_again(self._store, path.parent.name):
                        text += "; it was written again as the manifest has it"
                yield event("incident_unreadable", text, path=str(name))

    def _write(self, records: list[Record]) -> None:
        if records:
            with_reserve(self._store, lambda: self._journal.write(records))


_KINDS = {"open": "incident", "complete": "incident_complete", "released": "incident_released"}


def _event(incident: Incident) -> Record:
    text = f"{incident.id} {incident.state}: {incident.text or 'no reason given'}"
    if incident.cut and incident.state == "complete":
        text += "; it ends early, for incidents would hold more than they may"
    return event(
        _KINDS[incident.state], text, incident.trigger, id=incident.id, who=incident.who,
        trigger=incident.trigger, from_ns=incident.from_ns, to_ns=incident.to_ns,
        versions=incident.versions,
    )  # fmt: skip
