"""A recorder without threads, driven by hand, and random histories of a store for property tests.

Messages are given by hand, and time is moved by hand. A history has runs, pauses, crashes, keepers
and deletion, but no tampering.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.recorder.disk_room import DiskRoom
from amberbox.blackbox.recorder.pipeline import Pipeline, PipelineOptions
from amberbox.blackbox.recorder.recorder import Recorder
from amberbox.blackbox.recorder.supervisor import BlockSink
from amberbox.blackbox.retention.maintenance import RetentionService, wait_for_lock
from amberbox.blackbox.retention.pins import PinRequest, pin, release
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.robot_folder.robot_yaml import Lifetime, RetentionOptions
from amberbox.blackbox.store import journal_reader
from amberbox.blackbox.store.incident import load_all
from amberbox.blackbox.store.store import Store, create_store, open_store
from amberbox.core.clock import NS, RunClock
from amberbox.core.source import TopicOptions
from amberbox.core.types import Schema, Topic
from amberbox.testing.clock import PATIENCE_S, ManualClock

WRITE_S = 0.1

COUNT = Topic("/count", "ros1", Schema("std_msgs/Int64", "ros1msg", b"int64 data\n"))
"""The simplest topic there is; ``number`` makes its messages."""


def number(value: int) -> bytes:
    """Make a message of ``COUNT``."""
    return value.to_bytes(8, "little", signed=True)


@dataclass
class ManualBox:
    """One run of the recorder on a store; ``write`` is one write interval."""

    store: Path
    topics: Sequence[TopicOptions] = ()
    clock: ManualClock = field(default_factory=ManualClock)
    options: PipelineOptions = field(default_factory=PipelineOptions)
    source: str = "ros"
    start_gap_ns: int | None = None
    room: DiskRoom | None = None
    late_s: float = 0.0

    def __post_init__(self) -> None:
        store, clock = create_store(self.store), RunClock(self.clock)
        self.pipeline = Pipeline(store, clock, self.options, self.start_gap_ns, self.room)
        self.sink = BlockSink(
            self.pipeline, self.source, self.topics, lossless=False, late_s=self.late_s
        )

    def hear(self, topic: Topic, *messages: bytes) -> None:
        """Receive messages of a topic now."""
        stream = self.sink.topic(topic)
        for message in messages:
            self.sink.message(stream, message, self.sink.now_ns())

    def write(self, after_s: float = WRITE_S) -> None:
        """Let time pass, then write the received messages."""
        self.clock.advance(after_s)
        self.pipeline.tick()

    def crash(self) -> None:
        """Leave the files as ``kill -9`` does."""
        for lock in self.pipeline._locks:
            lock.release()

    def close(self) -> None:
        """End the run as a clean stop does."""
        self.pipeline.close()


@contextmanager
def recording(folder: Path) -> Iterator[Recorder]:
    """Run the recorder of a robot folder in a thread until the block is left."""
    recorder = Recorder(load_folder(folder), retention=False)
    thread = threading.Thread(target=recorder.run)
    thread.start()
    try:
        yield recorder
    finally:
        recorder.stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def raw_messages(store: Path, topic: str, *, repeated: bool = False) -> list[bytes]:
    """Return the messages of a topic as stored in the journals, file after file."""
    found: list[bytes] = []
    for journal in journal_reader.journals(store):
        wanted = {
            n
            for n, stream in journal.streams.items()
            if stream.topic.name == topic and stream.repeated == repeated
        }
        for chunk in journal_reader.sound_chunks(journal):
            found += chunk.messages(np.flatnonzero(np.isin(chunk.channel, list(wanted))))
    return found


def own_records(store: Path, topic: str) -> list[dict[str, Any]]:
    """Return what the box itself has written on one of its channels."""
    return [msgspec.json.decode(message) for message in raw_messages(store, topic)]


def events(store: Path, kind: str) -> list[dict[str, Any]]:
    """Return the events of a kind, their details decoded."""
    found = [record for record in own_records(store, "amberbox/event") if record["kind"] == kind]
    return [{**record, "details": msgspec.json.decode(record["details"])} for record in found]


def event_texts(store: Path, kind: str) -> list[str]:
    """Return the texts of the events of a kind."""
    return [event["text"] for event in events(store, kind)]


def last_counters(store: Path) -> dict[str, dict[str, int]]:
    """Return the newest counters of each item."""
    newest: dict[str, dict[str, int]] = {}
    for record in own_records(store, "amberbox/counters"):
        newest.update({counters["item"]: counters for counters in record["items"]})
    return newest


TEXT = Topic("/text", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\n"))
RING = Topic("/ring", "ros1", Schema("std_msgs/Int64", "ros1msg", b"int64 data\n"))
_QUOTA_BYTES = 600_000


@dataclass
class History:
    """A store and its random history; ``events`` lists the steps, for a failing test."""

    path: Path
    seed: int
    events: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)
        self.clock = ManualClock()
        self._stop = threading.Event()
        self._next = 0

    def live(self, runs: int = 3) -> Store:
        """Live through some runs of the recorder; return the store."""
        for _ in range(self.random.randint(1, runs)):
            self._run()
        return open_store(self.path)

    def _run(self) -> None:
        options = PipelineOptions(
            boot_id=self.clock.boot_id(),
            rotate_ns=self.random.choice([NS, 2 * NS, 600 * NS]),
            rotate_bytes=self.random.choice([8_000, 64_000_000]),
        )
        topics = [TopicOptions("/ring", keep="ring")]
        box = ManualBox(self.path, topics, clock=self.clock, options=options)
        keeper = self._keeper() if self.random.random() < 0.8 else None
        for _ in range(self.random.randint(0, 30)):
            self._write(box)
            if self.random.random() < 0.03:
                self._mark(box.store)
            if keeper is not None and self.random.random() < 0.15:
                self.events.append("step")
                keeper.keeper.step(self._stop)
        self._end(box, keeper)
        if self.random.random() < 0.3:  # the computer starts anew: other boot, clock a bit off
            self.clock.boot_name = f"{self.random.getrandbits(32):08x}-0000-4000-8000-000000000000"
            self.clock.step(self.random.uniform(-100, 100))

    def _write(self, box: ManualBox) -> None:
        for _ in range(self.random.randint(0, 6)):
            self._next += 1
            topic = self.random.choice([COUNT, RING, TEXT])
            box.hear(topic, _text(self.random) if topic is TEXT else number(self._next))
        box.write(self.random.choice([0.1, 0.1, 1.0]))
        if self.random.random() < 0.3:
            for mark in box.pipeline.mark_sync():
                mark.wait()
        if self.random.random() < 0.05:
            self.clock.step(self.random.uniform(-5, 5))

    def _mark(self, path: Path) -> None:
        """Mark an incident, or release one."""
        store = open_store(path)
        known = [incident for incident in load_all(store) if incident.is_pinned]
        if known and self.random.random() < 0.4:
            release(store, self.random.choice(known))
            self.events.append("release")
        elif store.journal_files("main"):
            wish = PinRequest(self.random.uniform(0, 3), self.random.uniform(0, 3), "bump", "test")
            pin(store, wish, RetentionOptions(quota=_QUOTA_BYTES))
            self.events.append("incident")

    def _end(self, box: ManualBox, keeper: _KeeperProcess | None) -> None:
        """End the recorder and its keeper, each cleanly or not, in either order."""
        clean, keeper_first = self.random.random() < 0.6, self.random.random() < 0.3
        self.events.append("close" if clean else "crash")
        if keeper is not None and keeper_first:
            self._end_keeper(keeper)
        box.close() if clean else box.crash()
        if keeper is not None and not keeper_first:
            self._end_keeper(keeper)

    def _end_keeper(self, keeper: _KeeperProcess) -> None:
        clean = self.random.random() < 0.6
        self.events.append("keeper closes" if clean else "keeper dies")
        keeper.end(clean=clean)

    def _keeper(self) -> _KeeperProcess:
        deletes = self.random.random() < 0.5
        options = RetentionOptions(
            ring_s=self.random.choice([1.0, 300.0]),
            quota=_QUOTA_BYTES if deletes else None,
            min_free=0,
            keep_min_s=self.random.choice([0.0, 86_400.0]),
            lifetime=self.random.choice([Lifetime(), Lifetime(raw_s=2.0), Lifetime(2.0, 4.0)]),
        )
        self.events.append(f"keeper {options.lifetime}")
        return _KeeperProcess(self.path, options, self.clock)


class _KeeperProcess:
    """A keeper that holds its lock, as the process does."""

    def __init__(self, path: Path, options: RetentionOptions, clock: ManualClock) -> None:
        store = open_store(path)
        self.lock = wait_for_lock(store, 0.0, threading.Event())
        self.keeper = RetentionService(store, options, clock)

    def end(self, *, clean: bool) -> None:
        if clean:
            self.keeper.close()
        self.lock.release()


def _text(rng: random.Random) -> bytes:
    data = rng.randbytes(rng.randint(0, 3_000)).hex().encode()
    return len(data).to_bytes(4, "little") + data
