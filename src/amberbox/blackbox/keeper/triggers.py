"""Triggers: follow the record, and pin its window when one of them fires.

Where the keeper died it goes on where it was; a firing that has been taken counts once.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import msgspec

from amberbox.blackbox.incidents.incident import At
from amberbox.blackbox.incidents.pin import Wish
from amberbox.blackbox.keeper.firing import (
    EVENTS,
    Firing,
    Watcher,
    history_ns,
    items_of,
    reads_watch,
    waits_for,
    watcher_of,
)
from amberbox.blackbox.keeper.options import KeeperOptions, Trigger
from amberbox.blackbox.keeper.ownjournal import OwnJournal, Progress, Record, event, last_progress
from amberbox.blackbox.keeper.pins import Pins
from amberbox.blackbox.keeper.reading import Reading, RunPart
from amberbox.blackbox.query.catalogue import look
from amberbox.blackbox.store import Store
from amberbox.core.clock import NS
from amberbox.core.config import did_you_mean
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Cursor

READER = "triggers"
_NOTE_S = 60.0
"""How far was read is written down this often, when nothing else is."""
_LOOKBACK_NS = 600 * NS
"""Slow items shall have a sample in what is read again after a start."""
_FIRST_NS = 60 * NS
"""A keeper without a memory looks at the last minute of the record."""
_MISSING_NS = 60 * NS
_PATIENCE_NS = 5 * NS
"""A watcher that is further behind than this is not waited for."""


@dataclass(slots=True)
class _Watch:
    """A trigger, and what watches for it in the present run."""

    trigger: Trigger
    watcher: Watcher
    missing: set[str]
    reads_watch: bool


class Triggers:
    """Evaluates the triggers of a robot on what the recorder writes."""

    def __init__(
        self, store: Store, options: KeeperOptions, journal: OwnJournal, pins: Pins
    ) -> None:
        self._store = store
        self._journal = journal
        self._pins = pins
        self._told: set[str] = set()
        self._pending: list[tuple[Wish, float]] = []
        self._untold: list[Record] = []
        self._triggers = [trigger for trigger in options.triggers if self._is_sound(trigger)]
        self._watches: list[_Watch] = []
        self._run = -1
        self._last: RunPart | None = None
        self._since_ns = 0
        self._noted_s = time.monotonic()
        self._noted = Cursor()
        progress = last_progress(store, "keep", READER)
        self._resume = _horizon(progress)
        items = frozenset({EVENTS}).union(*map(items_of, self._triggers))
        back_ns = max(map(history_ns, self._triggers), default=0) + _LOOKBACK_NS
        cursor = progress.cursor if progress else None
        self._reading = Reading(store, items, cursor, back_ns / NS)

    def step(self) -> None:
        """Read what is new and pin what it gives rise to."""
        parts = self._reading.step()
        for part in parts:
            if part.run != self._run:
                self._begin(part, is_last=part is parts[-1])
            fired = self._firings(part)
            self._pending += [(_wish(t, firing, part), t.hold_off_s) for t, firing in fired]
            self._untold += self._troubles(part)
        fired_any = bool(self._pending)
        self._settle()
        if parts:
            self._last = parts[-1]
            self._note(parts[-1], at_once=fired_any)

    def close(self) -> None:
        """Write down how far was read, unless a firing waits that shall be found again then."""
        if self._last is None or self._pending or self._reading.cursor() == self._noted:
            return
        self._note(self._last, at_once=True)

    def _settle(self) -> None:
        """Pin and tell; what a full disk does not take is tried again at the next step."""
        while self._pending:
            try:
                self._pins.fire(*self._pending[0])
            except UsageError as error:  # what it is about is gone already
                self._untold.append(_refused(self._pending[0][0], error))
            self._pending.pop(0)
        if self._untold:
            self._journal.write(self._untold)
            self._untold = []

    def _is_sound(self, trigger: Trigger) -> bool:
        try:
            watcher_of(trigger)
        except AmberboxError as error:
            self._untold.append(_off(trigger, error.what))
            return False
        return True

    def _begin(self, part: RunPart, *, is_last: bool) -> None:
        """Begin a run anew: what was true in the one before says nothing about it."""
        self._watches = [
            _Watch(trigger, watcher_of(trigger), set(waits_for(trigger)), reads_watch(trigger))
            for trigger in self._triggers
        ]
        self._since_ns = self._start_ns(part, is_last=is_last)
        self._run = part.run

    def _start_ns(self, part: RunPart, *, is_last: bool) -> int:
        """Return up to when firings of a run are known already."""
        if self._run >= 0:
            return 0
        if self._resume is None:
            return part.until_ns - _FIRST_NS if is_last else part.until_ns
        if part.run == self._resume.run:
            return part.left_ns(self._resume.log_ns)
        return 0 if part.run > self._resume.run else part.until_ns

    def _firings(self, part: RunPart) -> list[tuple[Trigger, Firing]]:
        found: list[tuple[Trigger, Firing]] = []
        for watch in list(self._watches):
            try:
                self._feed(watch, part)
                until_ns = _until(watch, part)
                if self._since_ns:
                    watch.watcher.firings(min(self._since_ns, until_ns))
                for firing in watch.watcher.firings(until_ns):
                    if firing.at_ns > self._since_ns:
                        found.append((watch.trigger, firing))
            except Exception as error:  # whatever it is: the other triggers go on
                self._disable(watch, f"{type(error).__name__}: {error}")
        return sorted(found, key=lambda pair: pair[1].at_ns)

    def _feed(self, watch: _Watch, part: RunPart) -> None:
        for batch, times_ns in part.batches:
            watch.missing.discard(batch.item)
            watch.missing -= {child.item for child in batch.children.values()}
            watch.watcher.add(batch, times_ns)

    def _disable(self, watch: _Watch, why: str) -> None:
        self._watches.remove(watch)
        self._triggers.remove(watch.trigger)
        self._untold.append(_off(watch.trigger, why))

    def _troubles(self, part: RunPart) -> Iterator[Record]:
        """Tell once what keeps a trigger from firing: a wrong type, an item that does not come."""
        for watch in self._watches:
            name = watch.trigger.name
            for problem in watch.watcher.problems():
                if self._is_new(f"{name}: {problem}"):
                    yield event("trigger_failed", _about(name, problem), name)
            lasted_ns = part.until_ns - min(part.axis.starts, default=part.until_ns)
            if watch.missing and lasted_ns >= _MISSING_NS and self._is_new(name):
                yield from self._missing(watch)

    def _is_new(self, text: str) -> bool:
        is_new = text not in self._told
        self._told.add(text)
        return is_new

    def _missing(self, watch: _Watch) -> Iterator[Record]:
        known = look(self._store.path).schemas
        name = watch.trigger.name
        for item in sorted(watch.missing - known.keys()):
            text = f"the trigger {name} waits for {item}, which has not come"
            text += did_you_mean(item, known)
            yield event("trigger_waits", text, name, item=item)

    def _note(self, part: RunPart, *, at_once: bool) -> None:
        """Write down how far was read: with each firing, and now and then."""
        cursor = self._reading.cursor()
        due = time.monotonic() - self._noted_s >= _NOTE_S and cursor != self._noted
        if at_once or due:
            self._noted, self._noted_s = cursor, time.monotonic()
            judged_ns = (_until(watch, part) for watch in self._watches)
            moment = part.moment(min(judged_ns, default=part.until_ns))
            state = msgspec.json.encode(moment).decode()
            self._journal.write([], Progress(cursor, READER, state))


def _until(watch: _Watch, part: RunPart) -> int:
    """Return up to when a trigger can be judged: the watcher writes a moment later than others."""
    if part.watched_ns is None or not watch.reads_watch:
        return part.until_ns
    return min(part.until_ns, max(part.watched_ns, part.until_ns - _PATIENCE_NS))


def _about(name: str, problem: str) -> str:
    return f"the trigger {name}: {_first_line(problem)}"


def _refused(wish: Wish, error: UsageError) -> Record:
    text = f"{wish.trigger} fired and nothing was pinned: {error.what}"
    return event("incident_refused", text, wish.trigger, trigger=wish.trigger, why=error.what)


def _off(trigger: Trigger, why: str) -> Record:
    text = f"the trigger {trigger.name} is off: {_first_line(why)}"
    return event("trigger_failed", text, trigger.name, why=why)


def _first_line(text: str) -> str:
    """Leave out the picture of an expression, which has lines of its own."""
    return text.partition("\n")[0]


def _wish(trigger: Trigger, firing: Firing, part: RunPart) -> Wish:
    at = part.moment(firing.at_ns)
    reason = trigger.reason or firing.detail or trigger.when or f"silence of {trigger.silence}"
    key = f"{trigger.name}@{at.run}:{at.log_ns}"
    return Wish(trigger.before_s, trigger.after_s, reason, "", trigger.name, at, key)


def _horizon(progress: Progress | None) -> At | None:
    """Return up to which moment firings were taken when the progress was noted."""
    if progress is not None:
        with suppress(msgspec.MsgspecError):
            return msgspec.json.decode(progress.state, type=At)
    return None
