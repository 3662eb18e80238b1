"""The detectors' process of the agent: runs a model beside the watcher, or over what is recorded.

It follows the record as the watcher does, writes scores and alarms into a journal of its own, and
leaves the findings that last to the watcher as evidence. After a crash it continues from its last
checkpoint; what it had written since is found again, counted, and not written twice.
"""

from __future__ import annotations

import hashlib
import json
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.query.record import open as open_record
from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.blackbox.store.derived_journal import (
    DerivedJournal,
    ItemMessage,
    ReaderProgress,
    last_progress,
)
from amberbox.blackbox.store.journal_reader import newest_first, previous_chain
from amberbox.blackbox.store.store import Store, WriterLock, is_locked, request_event, submit
from amberbox.core.clock import NS
from amberbox.core.detector_items import ALARMS, PREFIX, WRITER
from amberbox.core.errors import AmberboxError
from amberbox.core.files import read_at_most, replace_file
from amberbox.core.given_findings import KIND
from amberbox.core.systemd import Notifier
from amberbox.core.types import Cursor, SymptomState, WriterCursor
from amberbox.detection.alarms import COMBINED, DetectorAlarm
from amberbox.detection.missions import DETECTORS_SOURCE, readable_items
from amberbox.detection.model_file import MOST_BYTES, DetectionModel, read_model
from amberbox.detection.record_detection import (
    Detected,
    DetectorScore,
    RecordDetection,
    learnt_items,
)
from amberbox.monitoring.record_reader import (
    Positions,
    RecordBlock,
    RecordedItemsReader,
    at_time,
    before_checkpoint,
)
from amberbox.monitoring.watcher_journal import Checkpoint, EvaluatedPosition, epoch_of

DETECT = WRITER
CHECKPOINT_FILE = "detect-checkpoint.json"  # file of the store
ALARM_ITEM = ALARMS
_WRITTEN = "written"
_WRITERS = ("main", "bulk", "ring")
_CHECKPOINT_S = 10.0
_POLL_S = 0.1
_MARGIN_S = 5.0
_MOST_CHECKPOINT = 256 << 20
_TELL_S = 0.5
_LOOK_S = 2.0
_MOST_FINDINGS = 200  # that are told to last; as many unknown ones as the diagnosis takes
_MOST_TOLD = 50  # at once: the watcher has other work
_LEAST_LEAK = 1e-12
_MOST_ID, _MOST_REASON, _MOST_MEASURED = 300, 1000, 64


@dataclass(frozen=True)
class ModelInUse:
    """A model file, read; ``key`` is a hash of its content."""

    detection: RecordDetection
    items: frozenset[str]
    key: str


def read_for(model: Path, store: Store) -> ModelInUse:
    """Read a model file to run it on a store; raises AmberboxError if it cannot be used."""
    data = read_at_most(model, MOST_BYTES, "this is no model file of amberbox learn")
    found, items = usable(data, str(model), store)
    return ModelInUse(RecordDetection(found), items, hashlib.sha256(data).hexdigest())


def usable(data: bytes, name: str, store: Store) -> tuple[DetectionModel, frozenset[str]]:
    """Return a model and the items it reads; raises AmberboxError if the store cannot use it."""
    found = read_model(data, name)
    if found.origin.get("team"):
        raise AmberboxError(
            f"{name}: a model of a team, which only the server has all robots of",
            "amberbox model detect URL NAME",
        )
    with open_record(store.path) as record:
        items = learnt_items(found, readable_items(record))
    if not items:
        raise AmberboxError(
            f"{name}: it is not known which items it has learnt", "learn it again: amberbox learn"
        )
    return found, items


def replayed(
    model: ModelInUse,
    store: Store,
    from_ns: int | None = None,
    to_ns: int | None = None,
    stop: threading.Event | None = None,
) -> Iterator[Detected]:
    """Yield what the detectors of a model find in a record, in order of time (log times).

    With ``from_ns`` detection begins with the run of the recorder that contains it, so that what
    follows is the same as without.
    """
    start = {} if from_ns is None else _run_of(store, at_time(store, "main", from_ns).run)
    epoch = None
    for block in RecordedItemsReader(store, model.items, (), start).step():
        found: list[Detected] = []
        if block.epoch != epoch:
            epoch, found = block.epoch, [*model.detection.begin(block.start_ns)]
        found += model.detection.take(block.batches, block.until_ns)
        yield from (one for one in found if _is_inside(one, from_ns, to_ns))
        if (to_ns is not None and block.until_ns >= to_ns) or (stop and stop.is_set()):
            return


def finding_values(alarm: DetectorAlarm | None) -> dict[str, Any]:
    """Return what the watcher is told of an alarm that lasts, but its id and state."""
    if alarm is None:
        return {}
    return {
        "onset_ns": alarm.onset_ns,
        "reason": alarm.reason.text[:_MOST_REASON],
        "measured": [a[:_MOST_ID] for a in alarm.addresses if a][:_MOST_MEASURED],
        "leak": min(max(alarm.leak, _LEAST_LEAK), 1.0),
        "detects": alarm.detects,
        "conflict": [a[:_MOST_ID] for a in alarm.reason.conflict][:_MOST_MEASURED],
    }


def is_much_rarer(alarm: DetectorAlarm, told_leak: float) -> bool:
    """Return whether the score of an alarm has become so rare that the watcher should know."""
    return alarm.leak < told_leak / 2


def changed_ns(found: Detected) -> int:
    """Return when an alarm began or ended, or a score was given (log time, ns)."""
    if isinstance(found, DetectorScore):
        return found.at_ns
    return found.confirmed_ns if found.gone_ns is None else found.gone_ns


def _is_inside(found: Detected, from_ns: int | None, to_ns: int | None) -> bool:
    at_ns = changed_ns(found)
    return (from_ns is None or at_ns >= from_ns) and (to_ns is None or at_ns < to_ns)


def _run_of(store: Store, run: int) -> dict[str, WriterCursor]:
    """Return positions at the start of a run of the recorder."""
    return {writer: WriterCursor(run, 0) for writer in _WRITERS if store.folder(writer).is_dir()}


class _Saved(msgspec.Struct):
    """The content of the checkpoint's file.

    ``count`` are the messages that were written by then, ``epoch`` and ``state`` are empty before
    the first rows, ``present`` the findings that the watcher was told of.
    """

    generation: str
    model: str
    positions: str
    lookback_s: float
    epoch: str
    count: int
    state: dict[str, Any]
    present: list[str]


@dataclass
class DetectProcess:
    """Runs the detectors of a model on one robot's record; ``run`` until ``stop`` is set.

    When the model's file changes, ``run`` ends as well: a new process then begins with it. A file
    that cannot be used is reported once, and the model in use stays.

    ``on_found`` receives what is written. Raises UsageError if another process does it already,
    AmberboxError if the model cannot be used.
    """

    folder: RobotFolder
    store: Store
    model: Path
    on_found: Callable[[Sequence[Detected]], None] = lambda found: None
    notifier: Notifier = field(default_factory=Notifier)

    def __post_init__(self) -> None:
        self._file = _file_state(self.model)
        self._looked_s = time.monotonic()
        self._used = read_for(self.model, self.store)
        self._detection = self._used.detection
        self._lock = WriterLock(self.store, DETECT)
        self._journal = DerivedJournal(
            self.store, DETECT, robot=self.folder.robot.id, config_hash=self.folder.config_hash,
            chain=lambda: previous_chain(self.store, DETECT),
        )  # fmt: skip
        self._count = self._skip = 0
        self._reached: EvaluatedPosition | None = None  # where the checkpoint was made
        self._block: RecordBlock | None = None
        self._present: set[str] = set()
        self._unsure: set[str] = set()  # those of which the watcher may not know
        self._leaks: dict[str, float] = {}  # that it was told
        self._is_behind = True
        self._told, self._told_s = "", -1e9
        saved = self._read_checkpoint()
        self._generation = uuid.uuid4().hex if saved is None else saved.generation
        self._start = self._newest_run() if saved is None else self._resumed(saved)
        self._reader = RecordedItemsReader(self.store, self._used.items, (), self._start)
        self._saved_s = -1e9
        if saved is None:
            self._save()

    def run(self, stop: threading.Event) -> None:
        """Detect until ``stop`` is set, or the model's file has changed."""
        try:
            while not (stop.is_set() or self._is_replaced()):
                self._step(stop)
                self.notifier.ready()
                self.notifier.alive(self._words)
                stop.wait(_POLL_S)
            self.notifier.stopping()
            self._tell_all_unknown()
            self._save()
        finally:
            self._journal.close()
            self._lock.release()

    def _is_replaced(self) -> bool:
        """Return whether the model's file is another one than that in use, and can be used."""
        if time.monotonic() - self._looked_s < _LOOK_S:
            return False
        self._looked_s = time.monotonic()
        state = _file_state(self.model)
        if state is None or state == self._file:
            return False
        self._file = state
        try:
            return read_for(self.model, self.store).key != self._used.key
        except AmberboxError as error:
            text = f"the model in use stays: {error.what[:200]}"
            request_event(self.store, "detect_model_refused", text, DETECTORS_SOURCE)
            return False

    def _words(self) -> str:
        lasting = [a for a in self._detection.open_alarms() if a.detector != COMBINED]
        return f"{len(lasting)} alarms of detectors"

    def _step(self, stop: threading.Event) -> None:
        for block in self._reader.step():
            self._take(block)
            self.notifier.alive(self._words)
            if time.monotonic() - self._saved_s >= _CHECKPOINT_S:
                self._save()
            if stop.is_set():
                return
        self._journal.keep_up()
        self._tell()

    def _take(self, block: RecordBlock) -> None:
        """Run the detectors over a block, and write what is new."""
        found: list[Detected] = []
        epoch = None if self._reached is None else self._reached.epoch
        if block.epoch != epoch:
            if epoch is not None and self._block is None and block.epoch.run <= epoch.run:
                return  # before the checkpoint
            found = [*self._detection.begin(block.start_ns)]
            self._present.clear()
            self._unsure.clear()
        found += self._detection.take(block.batches, block.until_ns)
        self._block = block
        self._reached = EvaluatedPosition(block.epoch, self._detection.until_ns)
        if self._is_behind:  # they may have been told before a crash
            named = {alarm.id for alarm in found if isinstance(alarm, DetectorAlarm)}
            self._present |= named
            self._unsure |= named
        known = min(self._skip, len(found))
        self._skip -= known
        self._write(found[known:])

    def _write(self, found: Sequence[Detected]) -> None:
        """Write messages, and how many there are now, in one chunk."""
        if found:
            self._count += len(found)
            self._journal.append([_message(one) for one in found], [self._written()])
            self.on_found(found)

    def _written(self) -> ReaderProgress:
        state = json.dumps({"generation": self._generation, "count": self._count})
        return ReaderProgress(Cursor(self.store.id), _WRITTEN, state)

    # -- evidence

    def _tell(self) -> None:
        """Leave findings that have changed to the watcher, if one is there to take them."""
        watcher = self._watcher()
        if not watcher or time.monotonic() - self._told_s < _TELL_S:
            return
        if watcher != self._told:  # another one: it may know nothing
            self._told, self._unsure = watcher, {*self._present}
        alarms = sorted(self._detection.open_alarms(), key=changed_ns)
        lasting = {alarm.id: alarm for alarm in alarms[:_MOST_FINDINGS]}
        over = self._present - lasting.keys()
        news = [n for n, alarm in lasting.items() if self._is_news(n, alarm)]
        for name in [*sorted(over), *news][:_MOST_TOLD]:
            alarm = lasting.get(name)
            self._submit(name, "absent" if alarm is None else "present", alarm)
            self._unsure.discard(name)
            if alarm is None:
                self._present.discard(name)
                self._leaks.pop(name, None)
            else:
                self._present.add(name)
                self._leaks[name] = alarm.leak
        self._told_s, self._is_behind = time.monotonic(), False

    def _is_news(self, name: str, alarm: DetectorAlarm) -> bool:
        """Return whether the watcher does not know an alarm, or of a much less rare score."""
        if name not in self._present or name in self._unsure:
            return True
        return is_much_rarer(alarm, self._leaks.get(name, 0.0))

    def _watcher(self) -> str:
        """Return the process id of the watcher; empty if none runs."""
        if not is_locked(self.store, "watch"):
            return ""
        with suppress(OSError):
            return (self.store.path / "lock.watch").read_text()
        return ""

    def _tell_all_unknown(self) -> None:
        """Say that it is not known any more what lasts: this process ends."""
        if self._watcher():
            for name in self._present:
                self._submit(name, "unknown")

    def _submit(self, name: str, state: SymptomState, alarm: DetectorAlarm | None = None) -> None:
        values = {"id": name[:_MOST_ID], "state": state} | finding_values(alarm)
        with suppress(OSError):  # a full disk: monitors go on without it
            submit(self.store, KIND, values)

    # -- checkpoint

    def _newest_run(self) -> dict[str, WriterCursor]:
        newest = next(newest_first(self.store, "main"), None)
        return {} if newest is None else _run_of(self.store, newest.run)

    def _save(self) -> None:
        """Save a checkpoint, after everything written before it is on the disk."""
        self._saved_s = time.monotonic()
        place, block = self._reached, self._block
        if place is not None and block is None:
            return  # nothing new since the checkpoint that it began with
        positions: Positions = self._start if block is None else self._reader.positions()
        lookback_s, epoch, state = 0.0, "", dict[str, Any]()
        if place is not None:
            ahead_s = max(self._reader.last_ns() - place.until_ns, 0) / NS
            lookback_s = ahead_s + _MARGIN_S
            epoch, state = str(place.epoch), self._detection.snapshot()
        cursor = Cursor(self.store.id, positions).to_json()
        saved = _Saved(
            self._generation, self._used.key, cursor, lookback_s, epoch, self._count - self._skip,
            state, sorted(self._present),
        )  # fmt: skip
        try:
            self._journal.write([], self._written())
            replace_file(self.store.path / CHECKPOINT_FILE, msgspec.json.encode(saved))
        except OSError as error:
            text = f"no checkpoint of the detectors could be written: {error.strerror}"
            self.notifier.alive(lambda: text)

    def _read_checkpoint(self) -> _Saved | None:
        """Return the last checkpoint of this model; None, with an event, if it is of no use."""
        path = self.store.path / CHECKPOINT_FILE
        if not path.exists():
            return None
        try:
            saved = msgspec.json.decode(read_at_most(path, _MOST_CHECKPOINT, ""), type=_Saved)
            cursor = Cursor.from_json(saved.positions)
            if saved.model != self._used.key:
                raise ValueError("the model is another one")
            if cursor.store_id != self.store.id:
                raise ValueError("it is of another store")
            if saved.epoch:
                self._detection.resume(saved.state)
        except AmberboxError as error:
            self._begin_anew(error.what)
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            self._begin_anew(str(error))
        else:
            return saved
        return None

    def _begin_anew(self, why: str) -> None:
        text = f"detectors begin anew with this run of the recorder: {why[:200]}"
        request_event(self.store, "detect_anew", text, DETECTORS_SOURCE)

    def _resumed(self, saved: _Saved) -> dict[str, WriterCursor]:
        """Take the checkpoint; return where reading begins."""
        self._count = self._written_before(saved)
        self._skip = self._count - saved.count
        self._present = {*saved.present}
        positions = Cursor.from_json(saved.positions).writers
        epoch = epoch_of(saved.epoch)
        if epoch is None:
            return dict(positions)
        self._reached = EvaluatedPosition(epoch, self._detection.until_ns)
        left = Checkpoint(self._reached, positions, saved.lookback_s, {})
        return before_checkpoint(self.store, left)

    def _written_before(self, saved: _Saved) -> int:
        """Return how many messages were written, also after the checkpoint."""
        last = last_progress(self.store, DETECT, _WRITTEN)
        with suppress(ValueError, LookupError, TypeError):
            values: Mapping[str, Any] = json.loads(last.state) if last is not None else {}
            if values["generation"] == saved.generation:
                return max(int(values["count"]), saved.count)
        return saved.count


def _file_state(path: Path) -> tuple[int, int, int] | None:
    """Return what changes when a file is replaced or written; None without the file."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size


def _message(found: Detected) -> ItemMessage:
    """Return the message that a score or a change of an alarm is recorded as."""
    if isinstance(found, DetectorScore):
        worst = {"score": found.score, "series": found.series}
        values = {**(found.items or worst), "at_ns": found.at_ns, "alarms": found.alarms}
        name = found.detector
        return ItemMessage(f"detector/{name}", f"{PREFIX}{name}", DETECTORS_SOURCE, values)
    values = {
        "id": found.id, "state": "present" if found.gone_ns is None else "absent",
        "at_ns": changed_ns(found), "onset_ns": found.onset_ns, "series": found.series,
        "score": found.score, "threshold": found.threshold, "p_value": found.p_value,
        "baseline": found.baseline, "reason": found.reason.text,
        "measured": " ".join(found.addresses),
    }  # fmt: skip
    return ItemMessage("detector/alarm", ALARM_ITEM, DETECTORS_SOURCE, values)
