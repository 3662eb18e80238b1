"""The recorder: runs the sources of a robot folder and writes what they say, nothing else."""

from __future__ import annotations

import gc
import shutil
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass

from amberbox.blackbox.folder.folder import RobotFolder
from amberbox.blackbox.folder.keeping import keeper_options
from amberbox.blackbox.recorder.keeperprocess import KeeperProcess
from amberbox.blackbox.recorder.messageclock import MessageClock
from amberbox.blackbox.recorder.pipeline import Pipeline, PipelineOptions
from amberbox.blackbox.recorder.power import PowerWatch
from amberbox.blackbox.recorder.recovery import previous_end_ns, report_recovery
from amberbox.blackbox.recorder.ringfolder import place_ring, writers_elsewhere
from amberbox.blackbox.recorder.room import Room
from amberbox.blackbox.recorder.stalls import StallMeter
from amberbox.blackbox.recorder.supervisor import Supervisor
from amberbox.blackbox.recorder.syncer import Syncer
from amberbox.blackbox.service import SPENT, Notifier
from amberbox.blackbox.store import Store, create_store, is_locked
from amberbox.core.clock import NS, Clock, RunClock, SystemClock
from amberbox.core.errors import AmberboxError, UsageError

_STOP_S = 3.0
"""How long sources may take to end."""


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
    """What the recorder is doing right now."""

    items: Sequence[ItemState]
    queue_bytes: int
    written_bytes: int
    disk_free_bytes: int
    disk_error: str
    full: str = ""
    """Why only events are recorded; empty while everything is."""


class Recorder:
    """Records a robot folder until it is stopped or, with files only, until they have ended."""

    def __init__(
        self, folder: RobotFolder, clock: Clock | None = None, *, keeper: bool = True
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
        self._keeper_wanted = keeper
        self._ended_by = ""
        clock = clock or SystemClock()
        self.pipeline = _pipeline(folder, self.store, clock)
        self._stalls = StallMeter(clock.boot_ns) if virtual_start_ns(folder) is None else None
        ring_path = folder.robot.store.ring_path
        place_ring(self.store, folder.path / ring_path if ring_path else None)
        self.pipeline.keep_elsewhere(writers_elsewhere(self.store))
        report_recovery(self.pipeline)
        self._sources = [Supervisor(self.pipeline, block, self.stop) for block in folder.blocks]
        self._rates: dict[str, tuple[int, float]] = {}

    def run(self) -> None:
        """Record until ``stop`` is set (by a signal handler, say) or all files have ended."""
        gc.collect()
        gc.freeze()  # what exists now lives as long as the process: leave it out of collections
        for source in self._sources:
            source.prepare()
        self.pipeline.event("started", f"recording {self.folder.robot.id}")
        for source in self._sources:
            source.thread.start()
        options = self.folder.robot.store
        kept = keeper_options(self.folder)
        keeper = KeeperProcess(self.pipeline, kept) if self._keeper_wanted else None
        syncer = Syncer(self.pipeline, options.sync_s)
        if self._stalls is not None:
            self._stalls.start()
            self.pipeline.stalls = self._stalls
        power = PowerWatch(self.pipeline, syncer, options.sync_s)
        try:
            self._tick_until_stopped(syncer, power, keeper)
        finally:
            power.stop()
            if self._stalls is not None:
                self.pipeline.stalls = None
                self._stalls.close()
            self._finish(syncer, keeper)

    def _tick_until_stopped(
        self, syncer: Syncer, power: PowerWatch, keeper: KeeperProcess | None
    ) -> None:
        write_s = self.folder.robot.store.write_s
        due = time.monotonic() + write_s
        while not self.stop.is_set():
            self.pipeline.intake.wake.wait(max(0.0, due - time.monotonic()))
            self.pipeline.intake.wake.clear()
            due = time.monotonic() + write_s
            self.pipeline.tick()
            if self.pipeline.bytes_written:
                self._notifier.ready()
            self._notifier.alive(self._status)
            if power.ends_run():
                self._ended_by = "the battery is low"
                break
            syncer.poke()
            if keeper is not None:
                keeper.look_after()
            if not any(source.thread.is_alive() for source in self._sources):
                break

    def _finish(self, syncer: Syncer, keeper: KeeperProcess | None) -> None:
        is_spent = not self._ended_by and not self.stop.is_set()
        self._notifier.stopping(*((SPENT,) if is_spent else ()))
        self.stop.set()
        self.pipeline.intake.wait_no_more()
        stuck = self._join_sources()
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
            if keeper is not None:
                keeper.stop()

    def _join_sources(self) -> list[str]:
        """Wait for the sources to end; return the names of those that do not."""
        deadline = time.monotonic() + _STOP_S
        for source in self._sources:
            source.thread.join(max(0.0, deadline - time.monotonic()))
        return [source.thread.name for source in self._sources if source.thread.is_alive()]

    def _status(self) -> str:
        """Say in one line what is being recorded, for systemctl status."""
        items = list(self.pipeline.items.values())
        kept = sum(item.counters.kept for item in items)
        trouble = f"; DISK: {self.pipeline.disk_error}" if self.pipeline.disk_error else ""
        if self.pipeline.full:
            trouble = f"; {self.pipeline.full.upper()}: only events are recorded{trouble}"
        return f"{len(items)} items, {kept} messages kept{trouble}"

    def state(self) -> RecorderState:
        """Describe what is being recorded, for the live table."""
        now = time.monotonic()
        items = [self._item_state(name, now) for name in sorted(self.pipeline.items)]
        return RecorderState(
            items,
            self.pipeline.intake.size_bytes,
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
    """Begin a run on a store, with what its folder says and the room that there is.

    Raises AmberboxError when not even a run's first bytes can be written.
    """
    options, virtual_ns = folder.robot.store, virtual_start_ns(folder)
    room = Room(store.path, options.reserve_bytes)
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
    """Return when time begins if all sources of a folder bring their own, None if none does.

    Raises UsageError when some do: one record has one time.
    """
    virtual = [block for block in folder.blocks if getattr(block.config, "is_virtual", False)]
    if virtual and len(virtual) < len(folder.blocks):
        raise UsageError(
            f"{virtual[0].name} lives in virtual time, other sources of {folder.path} do not",
            f"write 'times: now' at {virtual[0].name}, or give it a robot folder of its own",
        )
    return min((block.config.start_ns() for block in virtual), default=None)
