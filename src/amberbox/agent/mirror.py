"""The mirror process of the agent: copies chosen items of the record to a MongoDB.

It follows the record with a cursor, which is saved only after the database has acknowledged
everything before it; so nothing is lost in an outage as long as the record is kept. Ids of
documents follow from the position of their row: a row that is sent twice is there once.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field

import msgspec

from amberbox.agent.doctor.processes import MIRROR_LOCK, MIRROR_STATE_FILE, mirror_in_words
from amberbox.blackbox.mirror.mongodb import BATCH_BYTES, MongoMirror, MongoTarget, UnreachableError
from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.blackbox.robot_folder.robot_yaml import MongodbOptions
from amberbox.blackbox.store.item_names import recorded_names, stated_names
from amberbox.blackbox.store.store import Store, WriterLock, request_event
from amberbox.blackbox.store.tail import Delivery, RecordFollower
from amberbox.core.errors import UsageError
from amberbox.core.files import replace_file
from amberbox.core.pacing import Backoff
from amberbox.core.systemd import Notifier
from amberbox.core.types import Batch, Cursor, Gap, Watermark

SOURCE = "mirror"
CURSOR_FILE = "mirror-cursor.json"  # file of the store: how far which database has everything
_POLL_S = 1.0  # rows of about so long are written together
_SAVE_S = 1.0
_STATE_S = 1.0
_PING_S = 10.0  # a database from which nothing was heard for longer is asked
_EVENTS_S = 60.0
_END_S = 7.0  # after a stop; the supervisor ends a process after 10 s


@dataclass(slots=True)
class MirrorState:
    """State of the mirror for ``doctor`` and ``status``; times by the robot's clock."""

    target: str
    connected: bool = False
    trouble: str = ""
    documents: int = 0
    refused: int = 0
    missed: int = 0
    mirrored_ns: int = 0
    """Rows received before it are in the database."""
    at_ns: int = 0


class ChosenItems:
    """The names of the items to copy: of patterns those in the store, also new ones."""

    def __init__(self, options: MongodbOptions, store: Store) -> None:
        self._options, self._store = options, store

    def __contains__(self, item: object) -> bool:
        return isinstance(item, str) and self._options.chooses(item)

    def __iter__(self) -> Iterator[str]:
        stated = stated_names(self._store.path) or {}
        recorded = recorded_names(self._store.path)
        names = {*stated.values(), *(name for listed in recorded.values() for name in listed)}
        return (name for name in sorted(names) if name in self)

    def __len__(self) -> int:
        return sum(1 for _ in self)


@dataclass(slots=True)
class _CountedEvent:
    """An event about a number of records, at most once a minute."""

    kind: str
    count: int = 0
    reason: str = ""
    _due_s: float = 0.0

    def add(self, count: int, reason: str) -> None:
        self.count += count
        self.reason = reason

    def report(self, store: Store, now_s: float, text: str) -> None:
        if self.count and now_s >= self._due_s:
            request_event(store, self.kind, text.format(self.count, self.reason), SOURCE)
            self.count, self._due_s = 0, now_s + _EVENTS_S


class _Saved(msgspec.Struct):
    """The content of the cursor's file."""

    target: str
    cursor: str
    documents: int
    refused: int
    missed: int


@dataclass(frozen=True, slots=True)
class _Progress:
    """How far an earlier process came, and its counts up to there."""

    cursor: Cursor | None = None
    documents: int = 0
    refused: int = 0
    missed: int = 0


@dataclass
class MirrorProcess:
    """Mirrors one robot's record; ``run`` until ``stop`` is set.

    Raises UsageError if the folder names no database, if another process mirrors the store, or if
    pymongo is missing.
    """

    folder: RobotFolder
    store: Store
    log: Callable[[str], None] = lambda text: None
    notifier: Notifier = field(default_factory=Notifier)
    poll_s: float = _POLL_S

    def __post_init__(self) -> None:
        options = self.folder.robot.mongodb
        if options is None:
            raise UsageError(
                f"{self.folder.path} names no database", "robot.yaml: mongodb: {url: mongodb://...}"
            )
        self._options = options
        self._target = f"{options.host}/{options.database}"
        target = MongoTarget(
            options.url, options.database, options.user, options.password, options.layout
        )
        self._lock = WriterLock(self.store, MIRROR_LOCK)
        try:
            self._mongo = MongoMirror(target, self.store.id)
        except UsageError:
            self._lock.release()
            raise
        self._before = self._read_progress()
        self._state = MirrorState(self._target, missed=self._before.missed)
        self._items = ChosenItems(options, self.store)
        self._cursor = self._saved = self._before.cursor
        self._follower = RecordFollower(self.store.path, self._items, self._cursor)
        self._reached_ns = 0
        self._refused = _CountedEvent("mirror_refused")
        self._missed = _CountedEvent("mirror_missed")
        self._saved_s = self._published_s = self._contact_s = -1e9
        self._end_s: float | None = None
        self._backoff = Backoff()

    def run(self, stop: threading.Event) -> None:
        """Mirror until ``stop``; then also what is recorded by then, if the database is there."""
        try:
            self.notifier.ready()
            while self._step(stop):
                if stop.wait(self.poll_s):
                    self.notifier.stopping()
                    self._step(stop)
                    break
        finally:
            self._report_counts(float("inf"))
            self._publish()
            self._mongo.close()
            self._lock.release()

    def _step(self, stop: threading.Event) -> bool:
        """Write everything that is new; return False if stopped before the database took it."""
        for delivery in self._follower.step():
            self._take(delivery)
            if self._mongo.waiting_bytes >= BATCH_BYTES and not self._flush(stop):
                return False
            self._alive()
            if self._is_over(stop):
                break
        return self._flush(stop)

    def _is_over(self, stop: threading.Event) -> bool:
        """Return whether it was stopped so long ago that the rest is left to the next process."""
        if stop.is_set() and self._end_s is None:
            self._end_s = time.monotonic() + _END_S
        return self._end_s is not None and time.monotonic() >= self._end_s

    def _take(self, delivery: Delivery) -> None:
        if isinstance(delivery, Batch):
            refused = self._mongo.written.refused
            self._mongo.add(delivery)
            self._count_refused(refused)
        elif isinstance(delivery, Gap):
            self._count_missing(delivery)
        elif isinstance(delivery, Watermark) and delivery.writer == "main":
            self._reached_ns = delivery.received_ns
        self._cursor = delivery.cursor

    def _count_missing(self, gap: Gap) -> None:
        """Count rows that were recorded and are no more, or cannot be decoded."""
        if gap.from_seq is not None and (not gap.item or gap.item in self._items):
            self._state.missed += gap.count or 0
            self._missed.add(gap.count or 1, gap.reason)

    def _count_refused(self, before: int) -> None:
        written = self._mongo.written
        if written.refused > before:
            self._refused.add(written.refused - before, written.refusal)

    def _flush(self, stop: threading.Event) -> bool:
        """Write what waits, again and again until it is acknowledged; False if stopped before."""
        while True:
            before = self._mongo.written.refused
            try:
                self._mongo.flush(self._contact)
                if time.monotonic() - self._contact_s >= _PING_S:
                    self._mongo.ping()
                    self._contact()
            except UnreachableError as error:
                self._count_refused(before)
                self._is_away(error.what)
                if self._wait(stop, self._backoff.failed()):
                    return False
            else:
                self._count_refused(before)
                self._is_there()
                if stop.is_set() or time.monotonic() - self._saved_s >= _SAVE_S:
                    self._save()
                return True

    def _is_away(self, why: str) -> None:
        if not self._state.trouble:
            self.log(f"no connection to {self._target}: {why}")
            request_event(self.store, "mirror_down", f"{self._target} takes nothing: {why}", SOURCE)
        self._state.connected, self._state.trouble = False, why
        self._publish()

    def _is_there(self) -> None:
        state = self._state
        is_new = not state.connected
        if state.trouble:
            request_event(self.store, "mirror_up", f"{self._target} takes documents again", SOURCE)
        state.connected, state.trouble = True, ""
        state.mirrored_ns = max(state.mirrored_ns, self._reached_ns)
        if is_new:
            self.log(f"copies to {self._target}")
            self._backoff.succeeded()
            self._publish()

    def _wait(self, stop: threading.Event, seconds: float) -> bool:
        """Wait with signs of life; return whether it was stopped."""
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0:
            self._alive()
            if stop.wait(min(left_s, _STATE_S)):
                return True
        return stop.is_set()

    # -- signs of life, state and cursor

    def _contact(self) -> None:
        self._contact_s = time.monotonic()
        self._alive()

    def _words(self) -> str:
        return mirror_in_words(asdict(self._state), time.time_ns())

    def _alive(self) -> None:
        self.notifier.alive(self._words)
        now_s = time.monotonic()
        self._report_counts(now_s)
        if now_s - self._published_s >= _STATE_S:
            self._publish()

    def _report_counts(self, now_s: float) -> None:
        self._refused.report(self.store, now_s, f"{self._target} has refused {{}} documents: {{}}")
        self._missed.report(self.store, now_s, "{} records were not copied: {}")

    def _publish(self) -> None:
        """Write the state file; it need not survive a power cut, so it is not synced."""
        self._published_s = time.monotonic()
        self._count()
        self._state.at_ns = time.time_ns()
        part = self.store.path / f"{MIRROR_STATE_FILE}.part"
        with suppress(OSError):  # a full disk: readers see the age of the state
            part.write_text(json.dumps({**asdict(self._state), "pid": os.getpid()}))
            part.replace(self.store.path / MIRROR_STATE_FILE)

    def _count(self) -> None:
        written, before = self._mongo.written, self._before
        self._state.documents = before.documents + written.taken + written.known
        self._state.refused = before.refused + written.refused

    def _save(self) -> None:
        """Save the cursor with the counts up to it."""
        self._saved_s = time.monotonic()
        if self._cursor is None or self._cursor == self._saved:
            return
        self._count()
        state = self._state
        progress = {
            "target": self._key(), "cursor": self._cursor.to_json(),
            "documents": state.documents, "refused": state.refused, "missed": state.missed,
        }  # fmt: skip
        with suppress(OSError):  # a full disk: the next process sends rows again, without harm
            replace_file(self.store.path / CURSOR_FILE, json.dumps(progress))
            self._saved = self._cursor

    def _key(self) -> str:
        """Return what a cursor is for: another database, or other items, begin anew."""
        options = self._options
        return " ".join((self._target, options.layout, *sorted(options.items)))

    def _read_progress(self) -> _Progress:
        try:
            saved = msgspec.json.decode((self.store.path / CURSOR_FILE).read_bytes(), type=_Saved)
            cursor = Cursor.from_json(saved.cursor)
        except (OSError, ValueError, LookupError, TypeError):
            return _Progress()
        if saved.target != self._key():
            text = f"begins anew: {self._target} or its items are not those of before"
            request_event(self.store, "mirror_anew", text, SOURCE)
            return _Progress()
        return _Progress(cursor, saved.documents, saved.refused, saved.missed)
