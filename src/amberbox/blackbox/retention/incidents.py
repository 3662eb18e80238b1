"""Create incidents on request and by triggers, follow them to their end, log them as events.

Triggers are evaluated along the record; after a crash that continues where it was, and a firing
counts once. How often a trigger may pin is limited, and refused firings are logged.
"""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np

from amberbox.blackbox.journal import channels
from amberbox.blackbox.retention.live_reader import LiveReader, RunSlice
from amberbox.blackbox.retention.pins import (
    PinRefusal,
    PinRequest,
    advance,
    held_bytes,
    look_back,
    pin,
    release,
    window_in,
)
from amberbox.blackbox.retention.usage import pin_lock, with_reserve
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions, Trigger
from amberbox.blackbox.store import manifest, store
from amberbox.blackbox.store.catalogue import read_catalogue
from amberbox.blackbox.store.derived_journal import (
    ChannelValues,
    DerivedJournal,
    ReaderProgress,
    event,
    last_progress,
)
from amberbox.blackbox.store.incident import (
    RING,
    LogMoment,
    StoredIncident,
    damaged_files,
    incident_folder,
    incident_of_firing,
    load_all,
    rewrite_from_manifest,
    save,
    to_line,
)
from amberbox.blackbox.store.store import Store, StoreRequest, is_locked
from amberbox.core.clock import NS
from amberbox.core.conditions import ConditionWatcher, WatchedCondition, item_of
from amberbox.core.errors import AmberboxError, UsageError, did_you_mean
from amberbox.core.expression import parse
from amberbox.core.names import identifier
from amberbox.core.types import Batch, Cursor, IntArray, ItemSchema

_HOUR_S = 3600.0


def refused_by_rate(
    trigger: str, at_ns: int, hold_off_s: float, incidents: Iterable[StoredIncident], per_hour: int
) -> str:
    """Return why a trigger may not pin now; empty if it may.

    One trigger may use half of the rate of all.
    """
    fired = [(r.trigger, at_ns - r.at_ns) for i in incidents for r in i.reasons if r.trigger]
    if any(name == trigger and 0 <= ago < hold_off_s * NS for name, ago in fired):
        return f"it fired less than {hold_off_s:g} s ago"
    recent = [name for name, ago in fired if abs(ago) < _HOUR_S * NS]
    if len(recent) >= per_hour:
        return f"there were {per_hour} incidents in an hour"
    if recent.count(trigger) >= math.ceil(per_hour / 2):
        return f"it fired {recent.count(trigger)} times in an hour"
    return ""


@dataclass(slots=True)
class _Count:
    """Firings of one trigger that were not logged yet."""

    since_s: float
    count: int = 0
    why: str = ""


@dataclass
class Refusals:
    """Logs firings that pinned nothing: the first one at once, then once an hour."""

    _counts: dict[str, _Count] = field(default_factory=dict)

    def note(self, trigger: str, why: str, text: str) -> Iterator[ChannelValues]:
        """Count a firing; yield an event if one is due."""
        known = self._counts.get(trigger)
        if known is None:
            self._counts[trigger] = _Count(time.monotonic())
            yield _event(trigger, 1, why, text)
            return
        known.count, known.why = known.count + 1, why
        yield from self.due()

    def due(self, *, all_of_them: bool = False) -> Iterator[ChannelValues]:
        """Yield the events that are due; at the end all that is left."""
        for trigger, known in list(self._counts.items()):
            if all_of_them or time.monotonic() - known.since_s >= _HOUR_S:
                del self._counts[trigger]
                if known.count:
                    yield _event(trigger, known.count, known.why, "")


def _event(trigger: str, count: int, why: str, text: str) -> ChannelValues:
    times = "once" if count == 1 else f"{count} times more"
    what = f"{trigger or 'somebody'} fired {times} and nothing was pinned: {why}"
    return event(
        "incident_refused", what, trigger, count=count, trigger=trigger, why=why, reason=text
    )


KIND = "incident"
RELEASE_KIND = "incident_release"
_HOLD_OFF_S = 60.0


class IncidentService:
    """Pins windows for triggers and other processes, and follows each incident to its end."""

    def __init__(self, store: Store, options: RetentionOptions, journal: DerivedJournal) -> None:
        self._store = store
        self._options = options
        self._journal = journal
        self._refusals = Refusals()
        self._unreadable: set[Path] = set()

    def step(self) -> None:
        """Handle requests, update open incidents, and write incidents that are not in the journal
        yet.
        """
        for request in store.pending(self._store):
            if request.kind == KIND:
                self._grant(request)
                store.finish(request)
            elif request.kind == RELEASE_KIND:
                self._release(str(request.values.get("key", "")))
                store.finish(request)
        for incident in load_all(self._store):
            self._follow(incident)
        self._write([*self._refusals.due(), *self._damage()])

    def close(self) -> None:
        """Log the firings that were not logged yet."""
        self._write(list(self._refusals.due(all_of_them=True)))

    def fire(self, request: PinRequest, hold_off_s: float = _HOLD_OFF_S) -> StoredIncident | None:
        """Pin a window for a trigger, unless it fires too often; None if nothing was pinned."""
        known = load_all(self._store)
        if request.key and incident_of_firing(known, request.key):
            return incident_of_firing(known, request.key)
        why = self._too_often(request, hold_off_s, known)
        done = PinRefusal(why) if why else self._pinned(request)
        if isinstance(done, PinRefusal):
            self._write(list(self._refusals.note(request.trigger, done.reason, request.reason)))
            return None
        self._register(done)
        return done

    def _pinned(self, request: PinRequest) -> StoredIncident | PinRefusal:
        return with_reserve(self._store, lambda: pin(self._store, request, self._options))

    def _too_often(
        self, request: PinRequest, hold_off_s: float, known: list[StoredIncident]
    ) -> str:
        timeline = look_back(self._store, 0, request.at) if request.trigger else None
        if timeline is None:
            return ""
        at_ns = timeline.received_ns(request.at or timeline.end)
        per_hour = self._options.incidents_per_hour
        return refused_by_rate(request.trigger, at_ns, hold_off_s, known, per_hour)

    def _grant(self, request: StoreRequest) -> None:
        values = request.values
        reason, who = str(values.get("reason", "")), str(values.get("who", ""))
        refused = str(values.get("refused", ""))
        if refused:
            self._write(list(self._refusals.note(who, refused, reason)))
            return
        try:
            if "key" in values:
                span = int(values["from_ns"]), int(values["to_ns"])
                self._mark(str(values["key"]), span, reason, who)
                return
            before_s = float(values.get("before_s", 60.0))
            after_s = float(values.get("after_s", 20.0))
            trigger, at = str(values.get("trigger", "")), self._moment(request)
            self.fire(PinRequest(before_s, after_s, reason, who, trigger, at, request.path.stem))
        except (KeyError, TypeError, ValueError, OverflowError, UsageError) as error:
            text = f"an incident was asked for that cannot be made: {error}"
            self._write([event("incident_refused", text, reason=reason)])

    def _mark(self, key: str, span: tuple[int, int], reason: str, who: str) -> None:
        """Pin a window that was marked on the server; one with the same key is the same incident.

        Raises UsageError if nothing of it is recorded.
        """
        found = window_in(self._store, *span)
        if found is None:
            raise UsageError("nothing of its window is in the record")
        end, before_ns, after_ns = found
        self.fire(PinRequest(before_ns / NS, after_ns / NS, reason, who, at=end, key=key))

    def _release(self, key: str) -> None:
        """Release what was marked with a key; a window that has other reasons stays pinned."""
        incident = incident_of_firing(load_all(self._store), key)
        if incident is None or not incident.is_pinned:
            return
        others = tuple(reason for reason in incident.reasons if reason.key != key)
        if others:
            with pin_lock(self._store):
                kept = save(self._store, replace(incident, reasons=others, told=""))
            self._register(kept)
        else:
            release(self._store, incident)

    def _moment(self, request: StoreRequest) -> LogMoment | None:
        """Find the moment of the record at which a request was made."""
        timeline = look_back(self._store, 0)
        if timeline is None:
            return None
        ago_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - request.boot_ns
        if ago_ns < 0 or not is_locked(self._store, "main"):  # another boot, or a record at rest
            ago_ns = max(timeline.end_received_ns - request.wall_ns, 0)
        timeline = look_back(self._store, ago_ns) or timeline
        return timeline.at(ago_ns)

    def _follow(self, incident: StoredIncident) -> None:
        if incident.state == "open":
            incident = advance(self._store, incident, self._options)
        if incident.state == "released":
            shutil.rmtree(incident_folder(self._store, incident.id) / RING, ignore_errors=True)
        if incident.told != incident.state:
            self._register(incident)

    def _register(self, incident: StoredIncident) -> None:
        """Record an incident's state in journal and manifest, then in its file."""
        if incident.told == incident.state:
            return
        ring = sorted(
            p.name for p in (incident_folder(self._store, incident.id) / RING).glob("*.mcap")
        )
        held = held_bytes(self._store, [incident])
        line = {**to_line(incident, self._journal.now_ns()), "ring": ring, "bytes": held}
        self._write([(channels.INCIDENT, line["incident"]), _pins_event(incident)])
        with_reserve(self._store, lambda: manifest.append(self._store.path, [line]))
        with pin_lock(self._store):
            now = {other.id: other for other in load_all(self._store)}.get(incident.id)
            if now is not None:
                reported = incident.state if now.reasons == incident.reasons else ""
                held = held if reported else held_bytes(self._store, [now])
                save(self._store, replace(now, told=reported, bytes=held))

    def _damage(self) -> Iterator[ChannelValues]:
        for path in damaged_files(self._store):
            if path not in self._unreadable:
                self._unreadable.add(path)
                name = path.relative_to(self._store.path)
                text = f"{name} is damaged or gone"
                with pin_lock(self._store):
                    if rewrite_from_manifest(self._store, path.parent.name):
                        text += "; it was written again as the manifest has it"
                yield event("incident_unreadable", text, path=str(name))

    def _write(self, records: list[ChannelValues]) -> None:
        if records:
            with_reserve(self._store, lambda: self._journal.write(records))


_KINDS = {"open": "incident", "complete": "incident_complete", "released": "incident_released"}


def _pins_event(incident: StoredIncident) -> ChannelValues:
    text = f"{incident.id} {incident.state}: {incident.text or 'no reason given'}"
    if incident.cut and incident.state == "complete":
        text += "; it ends early, for incidents would hold more than they may"
    return event(
        _KINDS[incident.state], text, incident.trigger, id=incident.id, who=incident.who,
        trigger=incident.trigger, from_ns=incident.from_ns, to_ns=incident.to_ns,
        versions=incident.versions,
    )  # fmt: skip


EVENTS = identifier(channels.EVENT)
COUNTERS = identifier(channels.COUNTERS)
_RECEIVED = "heard"
_WATCHED = tuple(
    identifier(channel)
    for channel in (channels.STATUS, channels.ALARM, channels.SYMPTOM, channels.DIAGNOSIS)
)
_SELDOM = frozenset(_WATCHED[1:])  # not written as long as nothing is wrong
_PROBE = "probe_"
_TRANSITION = "component_state"  # kind of the watcher's events for a changed component


@dataclass(frozen=True, slots=True)
class Firing:
    """A trigger has fired at a time; ``detail`` is the event that made it."""

    at_ns: int
    detail: str = ""


class TriggerWatcher(Protocol):
    """Evaluates a trigger on new rows.

    ``items`` are those whose rows it reads, ``waits_for`` those that must have been received before
    it can fire; rows are needed for ``history_ns``.
    """

    items: frozenset[str]
    waits_for: frozenset[str]
    history_ns: int

    def add(self, batch: Batch, times_ns: IntArray) -> None:
        """Take rows of the items it reads."""

    def firings(self, until_ns: int) -> list[Firing]:
        """Return the firings since the last call; all rows up to ``until_ns`` have been added."""

    def problems(self) -> Iterator[str]:
        """Yield the problems that keep it from working."""


class WhenWatcher:
    """Fires when an expression becomes true."""

    def __init__(self, when: str) -> None:
        expression = parse(when)
        self._conditions = ConditionWatcher({"when": WatchedCondition(expression)})
        self.items = self._conditions.items
        self.waits_for = frozenset(map(item_of, expression.addresses()))
        self.history_ns = expression.history_ns

    def add(self, batch: Batch, times_ns: IntArray) -> None:
        """Take rows."""
        self._conditions.add(batch, times_ns)

    def firings(self, until_ns: int) -> list[Firing]:
        """Return when the expression became true."""
        return [Firing(edge.at_ns) for edge in self._conditions.edges(until_ns)]

    def problems(self) -> Iterator[str]:
        """Yield the reasons why the expression cannot be evaluated."""
        yield from self._conditions.problems.values()


class SilenceWatcher:
    """Fires when nothing was received of an item for a while, filtered messages counted."""

    items = frozenset({COUNTERS})

    def __init__(self, item: str, silence_s: float) -> None:
        self._item = item
        self._last_ns = 0
        self._silent = WhenWatcher(f"age({_RECEIVED}.at) >= {silence_s!r}")
        self.waits_for = frozenset({item})
        self.history_ns = round(silence_s * 1e9)

    def add(self, batch: Batch, times_ns: IntArray) -> None:
        """Add counters of the recorder."""
        counts = batch.children.get("items")
        if batch.item != COUNTERS or counts is None or "last_received_ns" not in counts.columns:
            return
        rows = np.flatnonzero(np.asarray(counts.columns["item"], object) == self._item)
        last_ns = np.asarray(counts.columns["last_received_ns"], np.int64)[rows]
        more = np.diff(last_ns, prepend=self._last_ns) != 0
        if more.any():
            self._last_ns = int(last_ns[-1])
            times_ns = times_ns[np.searchsorted(batch.seq, counts.seq[rows[more]])]
            self._silent.add(_received_batch(batch, times_ns), times_ns)

    def firings(self, until_ns: int) -> list[Firing]:
        """Return when the silence had lasted long enough."""
        return self._silent.firings(until_ns)

    def problems(self) -> Iterator[str]:
        """Yield nothing: the box's own counters are always valid."""
        yield from ()


def _received_batch(batch: Batch, times_ns: IntArray) -> Batch:
    columns: dict[str, Any] = {"at": np.ones(len(times_ns))}
    return Batch(
        _RECEIVED, ItemSchema("", ()), batch.writer, batch.run, times_ns, times_ns, times_ns,
        times_ns, columns,
    )  # fmt: skip


class EventWatcher:
    """Fires at each event of a kind."""

    items = frozenset({EVENTS})
    waits_for: frozenset[str] = frozenset()
    history_ns = 0

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._found: list[Firing] = []

    def add(self, batch: Batch, times_ns: IntArray) -> None:
        """Add events."""
        if batch.item != EVENTS:
            return
        kinds, texts = batch.columns["kind"], batch.columns["text"]
        for row, at_ns in enumerate(times_ns.tolist()):
            if fnmatchcase(str(kinds[row]), self._kind):
                self._found.append(Firing(at_ns, f"{kinds[row]}: {texts[row]}"))

    def firings(self, until_ns: int) -> list[Firing]:
        """Return when such events happened."""
        found = [firing for firing in self._found if firing.at_ns <= until_ns]
        self._found = [firing for firing in self._found if firing.at_ns > until_ns]
        return found

    def problems(self) -> Iterator[str]:
        """Yield nothing: the box's own events are always valid."""
        yield from ()


def watcher_of(trigger: Trigger) -> TriggerWatcher:
    """Return the watcher of a trigger; raises ExpressionError for an unreadable one."""
    if trigger.event:
        return EventWatcher(trigger.event)
    if trigger.silence:
        return SilenceWatcher(trigger.silence, trigger.silence_s)
    return WhenWatcher(trigger.when)


def reads_watch(trigger: Trigger, watcher: TriggerWatcher) -> bool:
    """Return whether a trigger reads records of the watcher, which arrive slightly later."""
    if trigger.event:
        return fnmatchcase(_TRANSITION, trigger.event)
    return any(item in _WATCHED or item.startswith(_PROBE) for item in watcher.waits_for)


READER = "triggers"
_SAVE_S = 60.0  # how far was read is saved this often, when nothing else is
_LOOKBACK_NS = 600 * NS  # so that slow items have a sample in the rows read again after a start
_FIRST_NS = 60 * NS  # without saved progress, the last minute of the record is evaluated
_MISSING_NS = 60 * NS
_PATIENCE_NS = 5 * NS  # a watcher that is further behind than this is not waited for


@dataclass(slots=True)
class _Watch:
    """A trigger, and its watcher in the present run."""

    trigger: Trigger
    watcher: TriggerWatcher
    missing: set[str]
    reads_watch: bool


def _watch(trigger: Trigger) -> _Watch:
    watcher = watcher_of(trigger)
    return _Watch(trigger, watcher, set(watcher.waits_for), reads_watch(trigger, watcher))


class Triggers:
    """Evaluates the triggers of a robot on the recorded rows."""

    def __init__(
        self,
        store: Store,
        options: RetentionOptions,
        journal: DerivedJournal,
        pins: IncidentService,
    ) -> None:
        self._store = store
        self._journal = journal
        self._pins = pins
        self._logged: set[str] = set()
        self._pending: list[tuple[PinRequest, float]] = []
        self._unlogged: list[ChannelValues] = []
        self._triggers = [trigger for trigger in options.triggers if self._is_sound(trigger)]
        self._watches: list[_Watch] = []
        self._run = -1
        self._last: RunSlice | None = None
        self._since_ns = 0
        self._saved_s = time.monotonic()
        self._saved = Cursor()
        progress = last_progress(store, "keep", READER)
        self._resume = _horizon(progress)
        watchers = [watcher_of(trigger) for trigger in self._triggers]
        items = frozenset({EVENTS}).union(*(watcher.items for watcher in watchers))
        back_ns = max((watcher.history_ns for watcher in watchers), default=0) + _LOOKBACK_NS
        cursor = progress.cursor if progress else None
        self._reading = LiveReader(store, items, cursor, back_ns / NS)

    def step(self) -> None:
        """Read new rows and pin the windows of triggers that fire."""
        parts = self._reading.step()
        for part in parts:
            if part.run != self._run:
                # begin a run anew: it does not follow from the one before
                self._watches = [*map(_watch, self._triggers)]
                self._since_ns = self._start_ns(part, is_last=part is parts[-1])
                self._run = part.run
            fired = self._firings(part)
            self._pending += [(_pin_request(t, firing, part), t.hold_off_s) for t, firing in fired]
            self._unlogged += self._troubles(part)
        fired_any = bool(self._pending)
        self._settle()
        if parts:
            self._last = parts[-1]
            self._save_progress(parts[-1], at_once=fired_any)

    def close(self) -> None:
        """Save the reading position, unless a pending firing has to be found again."""
        if self._last is None or self._pending or self._reading.cursor() == self._saved:
            return
        self._save_progress(self._last, at_once=True)

    def _settle(self) -> None:
        """Pin and log; after a full disk it is tried again at the next step."""
        while self._pending:
            try:
                self._pins.fire(*self._pending[0])
            except UsageError as error:  # its rows are deleted already
                self._unlogged.append(_refused(self._pending[0][0], error))
            self._pending.pop(0)
        if self._unlogged:
            self._journal.write(self._unlogged)
            self._unlogged = []

    def _is_sound(self, trigger: Trigger) -> bool:
        try:
            watcher_of(trigger)
        except AmberboxError as error:
            self._unlogged.append(_off(trigger, error.what))
            return False
        return True

    def _start_ns(self, part: RunSlice, *, is_last: bool) -> int:
        """Return up to when firings of a run are known already."""
        if self._run >= 0:
            return 0
        if self._resume is None:
            return part.until_ns - _FIRST_NS if is_last else part.until_ns
        if part.run == self._resume.run:
            return part.left_ns(self._resume.log_ns)
        return 0 if part.run > self._resume.run else part.until_ns

    def _firings(self, part: RunSlice) -> list[tuple[Trigger, Firing]]:
        found: list[tuple[Trigger, Firing]] = []
        for watch in list(self._watches):
            try:
                for batch, times_ns in part.batches:
                    watch.missing.discard(batch.item)
                    watch.missing -= {child.item for child in batch.children.values()}
                    watch.watcher.add(batch, times_ns)
                until_ns = _until(watch, part)
                if self._since_ns:
                    watch.watcher.firings(min(self._since_ns, until_ns))
                for firing in watch.watcher.firings(until_ns):
                    if firing.at_ns > self._since_ns:
                        found.append((watch.trigger, firing))
            except Exception as error:  # any error: the other triggers go on
                self._watches.remove(watch)
                self._triggers.remove(watch.trigger)
                self._unlogged.append(_off(watch.trigger, f"{type(error).__name__}: {error}"))
        return sorted(found, key=lambda pair: pair[1].at_ns)

    def _troubles(self, part: RunSlice) -> Iterator[ChannelValues]:
        """Yield an event once per problem of a trigger, such as a wrong type or a missing item."""
        for watch in self._watches:
            name = watch.trigger.name
            for problem in watch.watcher.problems():
                if self._is_new(f"{name}: {problem}"):
                    yield event(
                        "trigger_failed", f"the trigger {name}: {_first_line(problem)}", name
                    )
            lasted_ns = part.until_ns - min(part.axis.starts, default=part.until_ns)
            if watch.missing and lasted_ns >= _MISSING_NS and self._is_new(name):
                yield from self._missing(watch)

    def _is_new(self, text: str) -> bool:
        is_new = text not in self._logged
        self._logged.add(text)
        return is_new

    def _missing(self, watch: _Watch) -> Iterator[ChannelValues]:
        known = read_catalogue(self._store.path).schemas
        name = watch.trigger.name
        for item in sorted(watch.missing - known.keys() - _SELDOM):
            text = f"the trigger {name} waits for {item}, which has not come"
            text += did_you_mean(item, known)
            yield event("trigger_waits", text, name, item=item)

    def _save_progress(self, part: RunSlice, *, at_once: bool) -> None:
        """Save the reading position: with each firing, and once a minute."""
        cursor = self._reading.cursor()
        due = time.monotonic() - self._saved_s >= _SAVE_S and cursor != self._saved
        if at_once or due:
            self._saved, self._saved_s = cursor, time.monotonic()
            judged_ns = (_until(watch, part) for watch in self._watches)
            moment = part.moment(min(judged_ns, default=part.until_ns))
            state = msgspec.json.encode(moment).decode()
            self._journal.write([], ReaderProgress(cursor, READER, state))


def _until(watch: _Watch, part: RunSlice) -> int:
    """Return up to when a trigger can be evaluated: the watcher writes slightly later."""
    if part.watched_ns is None or not watch.reads_watch:
        return part.until_ns
    return min(part.until_ns, max(part.watched_ns, part.until_ns - _PATIENCE_NS))


def _refused(request: PinRequest, error: UsageError) -> ChannelValues:
    text = f"{request.trigger} fired and nothing was pinned: {error.what}"
    return event("incident_refused", text, request.trigger, trigger=request.trigger, why=error.what)


def _off(trigger: Trigger, why: str) -> ChannelValues:
    text = f"the trigger {trigger.name} is off: {_first_line(why)}"
    return event("trigger_failed", text, trigger.name, why=why)


def _first_line(text: str) -> str:
    """Return the first line of a text, without the picture of an expression below it."""
    return text.partition("\n")[0]


def _pin_request(trigger: Trigger, firing: Firing, part: RunSlice) -> PinRequest:
    at = part.moment(firing.at_ns)
    reason = trigger.reason or firing.detail or trigger.when or f"silence of {trigger.silence}"
    key = f"{trigger.name}@{at.run}:{at.log_ns}"
    return PinRequest(trigger.before_s, trigger.after_s, reason, "", trigger.name, at, key)


def _horizon(progress: ReaderProgress | None) -> LogMoment | None:
    """Return up to which moment firings were taken when the progress was noted."""
    if progress is not None:
        with suppress(msgspec.MsgspecError):
            return msgspec.json.decode(progress.state, type=LogMoment)
    return None


class IncidentMaintenance:
    """Runs the incident service and the triggers of a store."""

    def __init__(self, store: Store, options: RetentionOptions, journal: DerivedJournal) -> None:
        self._store, self._options, self._journal = store, options, journal
        self._pins = IncidentService(store, options, journal)
        self._triggers: Triggers | None = None
        self._trouble = ""

    def step(self) -> None:
        """Do the work due now; after a disk error it is tried again at the next step."""
        try:
            self._pins.step()
            if self._triggers is None and self._options.triggers:
                self._triggers = Triggers(self._store, self._options, self._journal, self._pins)
            if self._triggers is not None:
                self._triggers.step()
        except OSError as error:
            self._complain(error.strerror or str(error))
        else:
            self._trouble = ""

    def close(self) -> None:
        """Handle the end of the record, and log the firings not logged yet."""
        self.step()
        try:
            if self._triggers is not None:
                self._triggers.close()
            self._pins.close()
        except OSError as error:
            self._complain(error.strerror or str(error))

    def _complain(self, trouble: str) -> None:
        if trouble != self._trouble:
            self._trouble = trouble
            print(f"amberbox keeper: incidents: {trouble}", file=sys.stderr)
