"""The recorder: runs the sources of a robot folder and writes their messages, nothing else.

Beside it run the syncer (journals durable every ``sync_s``), the power watch (sync often on
battery, end in time) and the maintenance process.
"""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.journal.writer import SyncMark
from amberbox.blackbox.recorder.disk_room import DiskRoom
from amberbox.blackbox.recorder.pipeline import MessageClock, Pipeline, PipelineOptions, StallMeter
from amberbox.blackbox.recorder.supervisor import SourceSupervisor
from amberbox.blackbox.robot_folder.folder import RobotFolder, retention_options_of
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store import store
from amberbox.blackbox.store.journal_reader import JournalFile, holes, newest_first
from amberbox.blackbox.store.store import Store, create_store, is_locked
from amberbox.blackbox.store.tail import RECORDED
from amberbox.core.clock import NS, Clock, RunClock, SystemClock
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import sync_folder
from amberbox.core.source import Power
from amberbox.core.systemd import ALL_INPUTS_ENDED, Notifier

_MOVING = "ring.moving"


def place_ring(store: Store, elsewhere: Path | None) -> None:
    """Make ``STORE/ring`` a folder, or a link to the store's own folder below ``elsewhere``.

    Existing files of the ring are moved; a folder that is gone after a restart of the computer is
    created again. The caller must hold the ring's lock. Raises AmberboxError when the folder
    cannot be written.
    """
    try:
        if elsewhere is None:
            ring, moving = store.folder("ring"), store.path / _MOVING
            if ring.is_symlink():
                moving.mkdir(exist_ok=True)
                _move_files(ring, moving)
                ring.unlink()
            if moving.exists() and not ring.exists():
                moving.rename(ring)
                sync_folder(store.path)
        else:
            _link(store, elsewhere.absolute() / store.id / "ring")
    except OSError as error:
        raise AmberboxError(
            f"cannot keep the ring in {elsewhere or store.path}: {error.strerror}",
            "choose a folder that can be written in robot.yaml store.ring_path",
        ) from error


def _link(store: Store, target: Path) -> None:
    ring = store.folder("ring")
    target.mkdir(parents=True, exist_ok=True)
    if not os.access(target, os.W_OK):
        raise PermissionError(13, os.strerror(13))
    if ring.is_symlink() and ring.readlink() == target:
        return
    _move_files(ring, target)
    if ring.is_symlink():
        ring.unlink()
    elif ring.exists():
        shutil.rmtree(ring)  # only the head is left, a hint that is written again
    ring.symlink_to(target)
    sync_folder(store.path)


def _move_files(ring: Path, target: Path) -> None:
    for path in sorted(ring.glob("*.mcap")):
        shutil.move(path, target / path.name)


def writers_elsewhere(store: Store) -> Collection[str]:
    """Return the writers whose journals are not on the store's disk."""
    device, found = store.path.stat().st_dev, set()
    for writer in RECORDED:
        with suppress(OSError):  # a folder that is not there yet will be made in the store
            if store.folder(writer).stat().st_dev != device:
                found.add(writer)
    return found


def previous_end_ns(store: Store) -> int | None:
    """Return the corrected time up to which an earlier run recorded; None if there was none."""
    ends = [j.end_ns + (j.clock[-1][1] if j.clock else 0) for j in _last_files(store) if j.rows]
    return max(ends, default=None)


def report_recovery(pipeline: Pipeline) -> None:
    """Emit an event for each journal that an earlier run left unfinished or damaged."""
    for journal in _last_files(pipeline.store):
        if not journal.finished or journal.damage:
            text = f"{journal.name} was not finished; {journal.rows} messages are there"
            if journal.damage:
                size = sum(damage.to_offset - damage.from_offset for damage in journal.damage)
                text += f", {size} bytes are not"
            pipeline.event(
                "recovered", text, file=journal.name, rows=journal.rows,
                damage=[(d.from_offset, d.to_offset, d.reason) for d in journal.damage],
                missing=[(gap.from_seq, gap.to_seq) for gap in holes(journal)],
                end_seq=journal.end_seq, end_ns=journal.end_ns,
            )  # fmt: skip


def _last_files(store: Store) -> list[JournalFile]:
    """Return each writer's last file with messages, and the empty files after it."""
    found: list[JournalFile] = []
    for writer in RECORDED:
        for journal in newest_first(store, writer):
            found.append(journal)
            if journal.rows:
                break
    return found


class Syncer:
    """Runs ``fdatasync`` periodically in a thread, never two at a time."""

    def __init__(self, pipeline: Pipeline, sync_s: float) -> None:
        self._pipeline = pipeline
        self._sync_s = sync_s
        self._due = time.monotonic() + sync_s
        self._thread: threading.Thread | None = None
        self._trouble = ""

    def every(self, sync_s: float) -> None:
        """Sync in this interval from now on."""
        self._due += sync_s - self._sync_s
        self._sync_s = sync_s

    def at_once(self, sync_s: float) -> None:
        """Sync as soon as possible, and then in this interval."""
        self._sync_s, self._due = sync_s, 0.0

    def sync_if_due(self) -> None:
        """Start a sync when one is due and none is under way."""
        now = time.monotonic()
        if now < self._due or (self._thread is not None and self._thread.is_alive()):
            return
        self._due = now + self._sync_s
        marks = self._pipeline.mark_sync()
        self._thread = threading.Thread(target=self._wait, args=(marks,), daemon=True)
        self._thread.start()

    def _wait(self, marks: Sequence[SyncMark]) -> None:
        troubles = [trouble for trouble in map(_wait_for, marks) if trouble]
        trouble, before = troubles[0] if troubles else "", self._trouble
        self._trouble = trouble
        if trouble and not before:
            self._pipeline.rotate()  # the kernel reports a page once, then treats it as written
            text = f"the disk does not sync: {trouble}; what came since the last sync may be lost"
            self._pipeline.event("disk", f"{text}, new files begin")
        elif before and not trouble:
            self._pipeline.event("disk", "the disk syncs again")

    def stop(self) -> None:
        """Wait for the sync that is under way."""
        if self._thread is not None:
            self._thread.join()


def _wait_for(mark: SyncMark) -> str:
    """Wait until a journal is durable; return the error text, empty on success."""
    try:
        mark.wait()
    except OSError as error:
        return error.strerror or str(error)
    return ""


BATTERY_SYNC_S = 0.2  # sync interval on battery, when a power cut may come at any time
# values of the incident requested when external power is lost
POWER_INCIDENT = {
    "before_s": 60,
    "after_s": 20,
    "reason": "external power lost",
    "who": "recorder",
    "trigger": "power",
}


class PowerWatch:
    """Reacts to the box's power state; belongs to the writing thread.

    A run that begins with a low battery records on: the run before has ended because of it, and a
    recorder that is started again is meant to record.
    """

    def __init__(self, pipeline: Pipeline, syncer: Syncer, sync_s: float) -> None:
        self._pipeline = pipeline
        self._syncer = syncer
        self._sync_s = sync_s
        self._state: Power | None = None
        self._request: threading.Thread | None = None

    def ends_run(self) -> bool:
        """Handle a change of power; return True when the run has to end as the battery is low."""
        before, state = self._state, self._pipeline.power
        if state == before:
            return False
        self._state = state
        if state == "mains":
            self._syncer.every(self._sync_s)
            return False
        self._syncer.at_once(min(self._sync_s, BATTERY_SYNC_S))
        if before == "mains":
            # ask the keeper for an incident, in a thread: the disk may be slow, and power short
            self._request = threading.Thread(target=self._mark_incident, daemon=True)
            self._request.start()
        return state == "low" and before is not None

    def _mark_incident(self) -> None:
        try:
            store.submit(self._pipeline.store, "incident", POWER_INCIDENT)
        except OSError as error:
            text = f"the incident of the lost power is not marked: {error.strerror}"
            self._pipeline.event("disk", text)

    def stop(self) -> None:
        """Wait for a pending request."""
        if self._request is not None:
            self._request.join()


_PAUSE_S = 10.0
_STOP_S = 10.0


class RetentionProcess:
    """Runs ``amberbox.blackbox.keeper`` on the recorder's store."""

    def __init__(self, pipeline: Pipeline, options: RetentionOptions) -> None:
        module = ["-m", "amberbox.blackbox.keeper", str(pipeline.store.path)]
        parent = ["--parent", str(os.getpid())]
        self._command = [sys.executable, *module, "--options", options.to_json(), *parent]
        self._pipeline = pipeline
        self._process: subprocess.Popen[bytes] | None = None
        self._not_before = 0.0
        self._trouble = ""

    def keep_running(self) -> None:
        """Start the process if it is not running, at most every ten seconds."""
        now = time.monotonic()
        if now < self._not_before or (self._process and self._process.poll() is None):
            return
        self._not_before = now + _PAUSE_S
        if self._process is not None:
            self._report(f"ended with status {self._process.returncode}")
        try:
            self._process = subprocess.Popen(self._command, stdin=subprocess.DEVNULL)
        except OSError as error:
            self._report(f"cannot be started: {error.strerror}")

    def _report(self, trouble: str) -> None:
        """Emit an event once per trouble; recording goes on without segments."""
        if trouble != self._trouble:
            self._trouble = trouble
            text = f"the keeper {trouble}; it is started again every {_PAUSE_S:.0f} s"
            self._pipeline.event("keeper", text)

    def stop(self) -> None:
        """Terminate the process and wait for it."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()


ROTATE_KIND = "rotate"
# Shortest time between two looks for requests, and between two rotations
_REQUESTS_S, _ROTATIONS_S = 0.1, 1.0


class RotationRequests:
    """Begins new files when another process asks for it; looks for requests ten times a second.

    A look at the folder's time of change is cheap: requests are read only when there are new ones.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._folder = pipeline.store.path / store.REQUESTS
        self._due_s = 0.0
        self._changed_ns = -1

    def look(self) -> None:
        """Carry out what is asked for, if it is time to look."""
        now_s = time.monotonic()
        if now_s < self._due_s:
            return
        self._due_s = now_s + _REQUESTS_S
        try:
            changed_ns = self._folder.stat().st_mtime_ns
            if changed_ns == self._changed_ns:
                return
            # one that comes in the same tick of the file system's clock changes no time
            is_settled = abs(time.time_ns() - changed_ns) > NS
            self._changed_ns = changed_ns if is_settled else -1
            asked = [one for one in store.pending(self._pipeline.store) if one.kind == ROTATE_KIND]
            for request in asked:
                store.finish(request)
        except OSError:  # no folder yet, or a disk in trouble, which the writer reports
            return
        if asked:
            who = asked[-1].values.get("who") or "somebody"
            self._due_s = now_s + _ROTATIONS_S
            self._pipeline.event("rotated", f"new files begin: asked for by {who}")
            self._pipeline.rotate()


_RECORDER_STOP_S = 3.0  # time limit for sources to end


@dataclass(frozen=True, slots=True)
class ItemState:
    """One line of the live table."""

    name: str
    rate_hz: float
    received: int
    kept: int
    filtered: int
    dropped: int
    bytes: int


@dataclass(frozen=True, slots=True)
class RecorderState:
    """State of the recorder for the live table."""

    items: Sequence[ItemState]
    queue_bytes: int
    written_bytes: int
    disk_free_bytes: int
    disk_error: str
    full: str = ""  # why only events are recorded; empty while everything is


class Recorder:
    """Records a robot folder until it is stopped or, with files only, until they have ended."""

    def __init__(
        self, folder: RobotFolder, clock: Clock | None = None, *, retention: bool = True
    ) -> None:
        if not folder.blocks:
            raise UsageError(
                f"{folder.path} names no source that can be recorded",
                f"amberbox check {folder.path} tells what its black_box.yaml holds",
            )
        self.folder = folder
        self.store = create_store(folder.store_path)
        self.stop = threading.Event()
        self._notifier = Notifier()
        self._with_retention = retention
        self._ended_by = ""
        clock = clock or SystemClock()
        self.pipeline = _pipeline(folder, self.store, clock)
        self._stalls = StallMeter(clock.boot_ns) if virtual_start_ns(folder) is None else None
        ring_path = folder.robot.store.ring_path
        place_ring(self.store, folder.path / ring_path if ring_path else None)
        self.pipeline.keep_elsewhere(writers_elsewhere(self.store))
        report_recovery(self.pipeline)
        self._sources = [
            SourceSupervisor(self.pipeline, block, self.stop) for block in folder.blocks
        ]
        self._rates: dict[str, tuple[int, float]] = {}

    def run(self) -> None:
        """Record until ``stop`` is set, as by a signal handler, or all files have ended."""
        gc.collect()
        gc.freeze()  # what exists now lives as long as the process: leave it out of collections
        for source in self._sources:
            source.prepare()
        self.pipeline.event("started", f"recording {self.folder.robot.id}")
        for name in self.folder.not_built:
            text = f"there is no source '{name}': its block of black_box.yaml is not recorded"
            self.pipeline.event("source_missing", text, name)
        for source in self._sources:
            source.thread.start()
        options = self.folder.robot.store
        kept = retention_options_of(self.folder)
        retention = RetentionProcess(self.pipeline, kept) if self._with_retention else None
        syncer = Syncer(self.pipeline, options.sync_s)
        if self._stalls is not None:
            self._stalls.start()
            self.pipeline.stalls = self._stalls
        power = PowerWatch(self.pipeline, syncer, options.sync_s)
        try:
            self._tick_until_stopped(syncer, power, retention)
        finally:
            power.stop()
            if self._stalls is not None:
                self.pipeline.stalls = None
                self._stalls.close()
            self._finish(syncer, retention)

    def _tick_until_stopped(
        self, syncer: Syncer, power: PowerWatch, retention: RetentionProcess | None
    ) -> None:
        write_s, rotation = self.folder.robot.store.write_s, RotationRequests(self.pipeline)
        due = time.monotonic() + write_s
        while not self.stop.is_set():
            self.pipeline.queue.wake.wait(max(0.0, due - time.monotonic()))
            self.pipeline.queue.wake.clear()
            due = time.monotonic() + write_s
            rotation.look()
            self.pipeline.tick()
            if self.pipeline.bytes_written:
                self._notifier.ready()
            self._notifier.alive(self._status)
            if power.ends_run():
                self._ended_by = "the battery is low"
                break
            syncer.sync_if_due()
            if retention is not None:
                retention.keep_running()
            if not any(source.thread.is_alive() for source in self._sources):
                break

    def _finish(self, syncer: Syncer, retention: RetentionProcess | None) -> None:
        is_spent = not self._ended_by and not self.stop.is_set()
        self._notifier.stopping(*((ALL_INPUTS_ENDED,) if is_spent else ()))
        self.stop.set()
        self.pipeline.queue.wait_no_more()
        deadline = time.monotonic() + _RECORDER_STOP_S
        for source in self._sources:
            source.thread.join(max(0.0, deadline - time.monotonic()))
        stuck = [source.thread.name for source in self._sources if source.thread.is_alive()]
        syncer.stop()
        text = "recording stopped"
        if self._ended_by:
            text += f": {self._ended_by}"
        if stuck:
            text += f"; still running: {', '.join(stuck)}"
        self.pipeline.event("stopped", text, stuck=stuck)
        try:
            self.pipeline.close()
        finally:
            if retention is not None:
                retention.stop()

    def _status(self) -> str:
        """Return one line about what is being recorded, for systemctl status."""
        items = list(self.pipeline.items.values())
        kept = sum(item.counters.kept for item in items)
        trouble = f"; DISK: {self.pipeline.disk_error}" if self.pipeline.disk_error else ""
        if self.pipeline.full:
            trouble = f"; {self.pipeline.full.upper()}: only events are recorded{trouble}"
        return f"{len(items)} items, {kept} messages kept{trouble}"

    def state(self) -> RecorderState:
        """Return the state of the recording, for the live table."""
        now = time.monotonic()
        items = [self._item_state(name, now) for name in sorted(self.pipeline.items)]
        return RecorderState(
            items,
            self.pipeline.queue.size_bytes,
            self.pipeline.bytes_written,
            shutil.disk_usage(self.store.path).free,
            self.pipeline.disk_error,
            self.pipeline.full,
        )

    def _item_state(self, name: str, now: float) -> ItemState:
        counters = self.pipeline.items[name].counters
        before, then = self._rates.get(name, (0, now))
        rate = (counters.received - before) / (now - then) if now > then else 0.0
        self._rates[name] = (counters.received, now)
        filtered = counters.rate_limited + counters.unchanged
        return ItemState(name, rate, counters.received, counters.kept, filtered,
                         counters.dropped, counters.bytes)  # fmt: skip


def _pipeline(folder: RobotFolder, store: Store, clock: Clock) -> Pipeline:
    """Create the pipeline of a run with the options of its folder.

    Raises AmberboxError when not even a run's first bytes can be written.
    """
    options, virtual_ns = folder.robot.store, virtual_start_ns(folder)
    room = DiskRoom(store.path, options.reserve_bytes)
    try:
        if not is_locked(store, "main"):
            room.begin()
        return Pipeline(
            store,
            RunClock(clock) if virtual_ns is None else MessageClock(virtual_ns),
            PipelineOptions(
                robot=folder.robot.id,
                config_hash=folder.config_hash,
                boot_id=clock.boot_id(),
                counts_silence=virtual_ns is None,
                queue_bytes=options.queue,
                rotate_bytes=options.rotate_bytes,
                rotate_ns=int(options.rotate_s * NS),
                ring_rotate_ns=int(min(options.ring_s / 5, options.rotate_s) * NS),
            ),
            start_gap_ns=previous_end_ns(store),
            room=room,
        )
    except OSError as error:
        raise AmberboxError(
            f"cannot write to the store {store.path}: {error.strerror}",
            "make room on its disk, or choose another one in robot.yaml store.path",
        ) from error


def virtual_start_ns(folder: RobotFolder) -> int | None:
    """Return the start of virtual time if all sources of a folder have times of their own, else
    None.

    Raises UsageError when only some do: a record has one time base.
    """
    virtual = [block for block in folder.blocks if getattr(block.config, "is_virtual", False)]
    if virtual and len(virtual) < len(folder.blocks):
        raise UsageError(
            f"{virtual[0].name} lives in virtual time, other sources of {folder.path} do not",
            f"write 'times: now' at {virtual[0].name}, or give it a robot folder of its own",
        )
    return min((block.config.start_ns() for block in virtual), default=None)
