"""The recorder: runs the sources of a robot folder and writes what they say, nothing else."""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from amberbox.blackbox.folder.blocks import SourceBlock
from amberbox.blackbox.folder.folder import RobotFolder
from amberbox.blackbox.follow import read
from amberbox.blackbox.journal.writer import SyncMark
from amberbox.blackbox.recorder.messageclock import MessageClock
from amberbox.blackbox.recorder.pipeline import Pipeline, PipelineOptions
from amberbox.blackbox.recorder.sink import BlockSink
from amberbox.blackbox.store import Store, create_store
from amberbox.core.clock import NS, Clock, RunClock, SystemClock
from amberbox.core.errors import UsageError
from amberbox.core.plugins import get

SOURCES = "amberbox.blackbox.sources"
_MAX_BACKOFF_S = 30.0


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
        clock = clock or SystemClock()
        virtual_ns = virtual_start_ns(folder)
        self._keeper_wanted = keeper
        options = folder.robot.store
        self.pipeline = Pipeline(
            self.store,
            RunClock(clock) if virtual_ns is None else MessageClock(virtual_ns),
            PipelineOptions(
                robot=folder.robot.id,
                config_hash=folder.config_hash,
                boot_id=clock.boot_id(),
                counts_silence=virtual_ns is None,
                queue_bytes=options.queue,
                rotate_bytes=int(options.rotate_mb * 1e6),
                rotate_ns=int(options.rotate_s * NS),
                ring_rotate_ns=int(min(options.ring_s / 5, options.rotate_s) * NS),
            ),
            start_gap_ns=previous_end_ns(self.store),
        )
        self._report_recovery()
        self._sources: list[threading.Thread] = []
        self._rates: dict[str, tuple[int, float]] = {}

    def run(self) -> None:
        """Record until ``stop`` is set (by a signal handler, say) or all files have ended."""
        gc.collect()
        gc.freeze()  # what exists now lives as long as the process: leave it out of collections
        self.pipeline.event("started", f"recording {self.folder.robot.id}")
        for block in self.folder.blocks:
            self._start(block)
        keeper = (
            _Keeper(self.store, self.folder.robot.store.ring_s) if self._keeper_wanted else None
        )
        syncer = _Syncer(self.pipeline, self.folder.robot.store.sync_s)
        try:
            self._tick_until_stopped(syncer, keeper)
        finally:
            self._finish(syncer, keeper)

    def _tick_until_stopped(self, syncer: _Syncer, keeper: _Keeper | None) -> None:
        write_s = self.folder.robot.store.write_s
        due = time.monotonic() + write_s
        while not self.stop.is_set():
            self.pipeline.intake.wake.wait(max(0.0, due - time.monotonic()))
            self.pipeline.intake.wake.clear()
            self.pipeline.tick()
            syncer.poke()
            if keeper is not None:
                keeper.look_after()
            if not any(thread.is_alive() for thread in self._sources):
                break
            due = max(due + write_s, time.monotonic())

    def _finish(self, syncer: _Syncer, keeper: _Keeper | None) -> None:
        self.stop.set()
        for thread in self._sources:
            thread.join(3.0)
        syncer.stop()
        self.pipeline.event("stopped", "recording stopped")
        try:
            self.pipeline.close()
        finally:
            if keeper is not None:
                keeper.stop()

    def _start(self, block: SourceBlock) -> None:
        thread = threading.Thread(target=self._supervise, args=(block,), name=block.name)
        thread.daemon = True
        self._sources.append(thread)
        thread.start()

    def _supervise(self, block: SourceBlock) -> None:
        """Run a source until it ends; start it again when it fails."""
        module = get(SOURCES, block.plugin).load()
        backoff_s, sink = 1.0, None
        while not self.stop.is_set():
            try:
                source = module.Source(block.config, block.name)
                if sink is None:
                    sink = self._sink(block, source)
                source.run(sink, self.stop)
            except Exception as error:
                text = f"{block.name} failed and starts again in {backoff_s:.0f} s: {error}"
                self.pipeline.event("source_failed", text, block.name, error=repr(error))
                self.stop.wait(backoff_s)
                backoff_s = min(2 * backoff_s, _MAX_BACKOFF_S)
                continue
            if not self.stop.is_set():
                self.pipeline.event("source_ended", f"{block.name} has ended", block.name)
            return

    def _sink(self, block: SourceBlock, source: Any) -> BlockSink:
        sink = BlockSink(self.pipeline, block.name, source.topics(), lossless=source.lossless)
        if not source.lossless:
            sink.expect_topics()
        return sink

    def _report_recovery(self) -> None:
        """Say what an earlier run left unfinished or damaged."""
        for journal in _last_run(self.store):
            if journal.finished and not journal.damage:
                continue
            lost = read.holes(journal)
            text = f"{journal.name} was not finished; {journal.rows} messages are there"
            if journal.damage:
                text += (
                    f", {sum(d.to_offset - d.from_offset for d in journal.damage)} bytes are not"
                )
            self.pipeline.event(
                "recovered", text, file=journal.name, rows=journal.rows,
                damage=[(d.from_offset, d.to_offset, d.reason) for d in journal.damage],
                missing=[(gap.from_seq, gap.to_seq) for gap in lost],
                end_seq=journal.end_seq, end_ns=journal.end_ns,
            )  # fmt: skip

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
        )

    def _item_state(self, name: str, now: float) -> ItemState:
        counters = self.pipeline.items[name].counters
        before, then = self._rates.get(name, (0, now))
        rate = (counters.received - before) / (now - then) if now > then else 0.0
        self._rates[name] = (counters.received, now)
        filtered = counters.rate_limited + counters.unchanged
        return ItemState(name, rate, counters.received, counters.kept, filtered,
                         counters.dropped, counters.bytes)  # fmt: skip


class _Syncer:
    """Makes the journals durable every ``sync_s`` in a thread of its own, so writing goes on."""

    def __init__(self, pipeline: Pipeline, sync_s: float) -> None:
        self._pipeline = pipeline
        self._sync_s = sync_s
        self._due = time.monotonic() + sync_s
        self._thread: threading.Thread | None = None

    def poke(self) -> None:
        """Start a sync when one is due and none is under way."""
        now = time.monotonic()
        if now < self._due or (self._thread is not None and self._thread.is_alive()):
            return
        self._due = now + self._sync_s
        try:
            marks = self._pipeline.mark_sync()
        except OSError:  # a full disk: the next write reports it
            return
        self._thread = threading.Thread(target=self._wait, args=(marks,), daemon=True)
        self._thread.start()

    def _wait(self, marks: Sequence[SyncMark]) -> None:
        try:
            for mark in marks:
                mark.wait()
        except OSError as error:
            self._pipeline.event("disk", f"the disk does not sync: {error.strerror}")

    def stop(self) -> None:
        """Wait for the sync that is under way."""
        if self._thread is not None:
            self._thread.join()


class _Keeper:
    """Runs the keeper process beside the recorder and starts it again when it dies."""

    def __init__(self, store: Store, ring_s: float) -> None:
        module = ["-m", "amberbox.blackbox.keeper"]
        self._command = [sys.executable, *module, str(store.path), "--ring-s", str(ring_s)]
        self._process: subprocess.Popen[bytes] | None = None
        self._not_before = 0.0

    def look_after(self) -> None:
        """Start the keeper if it is not running, at most every ten seconds."""
        now = time.monotonic()
        if now < self._not_before or (self._process and self._process.poll() is None):
            return
        self._not_before = now + 10.0
        self._process = subprocess.Popen(
            [*self._command, "--parent", str(os.getpid())], stdin=subprocess.DEVNULL
        )

    def stop(self) -> None:
        """Let it finish what it is doing."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(10.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()


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


def _last_run(store: Store) -> list[read.JournalFile]:
    found = [
        read.journal_file(path, f"{path.parent.name}/{path.name}")
        for writer in ("main", "ring")
        for path in store.journal_files(writer)[-1:]
    ]
    return [journal for journal in found if journal.rows or journal.damage]


def previous_end_ns(store: Store) -> int | None:
    """Corrected time up to which an earlier run recorded; None if there was none."""
    ends = []
    for journal in _last_run(store):
        ends.append(journal.end_ns + (journal.clock[-1][1] if journal.clock else 0))
    return max(ends, default=None)
