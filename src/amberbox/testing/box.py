"""A recorder without threads: what it hears is given by hand, and time passes when told to."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.folder.folder import load_folder
from amberbox.blackbox.follow import read
from amberbox.blackbox.recorder.pipeline import Pipeline, PipelineOptions
from amberbox.blackbox.recorder.recorder import Recorder
from amberbox.blackbox.recorder.room import Room
from amberbox.blackbox.recorder.sink import BlockSink
from amberbox.blackbox.store import create_store
from amberbox.core.clock import RunClock
from amberbox.core.source import TopicOptions
from amberbox.core.types import Schema, Topic
from amberbox.testing.clock import ManualClock
from amberbox.testing.patience import PATIENCE_S

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
    room: Room | None = None

    def __post_init__(self) -> None:
        store, clock = create_store(self.store), RunClock(self.clock)
        self.pipeline = Pipeline(store, clock, self.options, self.start_gap_ns, self.room)
        self.sink = BlockSink(self.pipeline, self.source, self.topics, lossless=False)

    def hear(self, topic: Topic, *messages: bytes) -> None:
        """Receive messages of a topic now."""
        stream = self.sink.topic(topic)
        for message in messages:
            self.sink.message(stream, message, self.sink.now_ns())

    def write(self, after_s: float = WRITE_S) -> None:
        """Let time pass, then write what was heard."""
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
    recorder = Recorder(load_folder(folder), keeper=False)
    thread = threading.Thread(target=recorder.run)
    thread.start()
    try:
        yield recorder
    finally:
        recorder.stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def raw_messages(store: Path, topic: str, *, repeated: bool = False) -> list[bytes]:
    """Return the messages of a topic as they stand in the journals, file after file."""
    found: list[bytes] = []
    for journal in read.journals(store):
        wanted = {
            n
            for n, stream in journal.streams.items()
            if stream.topic.name == topic and stream.repeated == repeated
        }
        for chunk in read.sound_chunks(journal):
            found += chunk.messages(np.flatnonzero(np.isin(chunk.channel, list(wanted))))
    return found


def own_records(store: Path, topic: str) -> list[dict[str, Any]]:
    """Return what the box itself has written on one of its channels."""
    return [msgspec.json.decode(message) for message in raw_messages(store, topic)]


def events(store: Path, kind: str) -> list[dict[str, Any]]:
    """Return the events of a kind, their details decoded."""
    found = [record for record in own_records(store, "amberbox/event") if record["kind"] == kind]
    return [{**record, "details": msgspec.json.decode(record["details"])} for record in found]


def last_counters(store: Path) -> dict[str, dict[str, int]]:
    """Return the newest counters of each item."""
    newest: dict[str, dict[str, int]] = {}
    for record in own_records(store, "amberbox/counters"):
        newest.update({counters["item"]: counters for counters in record["items"]})
    return newest
