"""Make records for tests: journals written by the real writer, one message after another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.columns.json_messages import widen_schema
from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.store import segment_builder as segments
from amberbox.blackbox.store.journal_reader import journals
from amberbox.blackbox.store.store import FOLDERS, create_store
from amberbox.core.clock import NS
from amberbox.core.types import Topic

_CHUNK_ROWS = 50
_MS = 1_000_000

T0_NS = 1_790_000_000 * NS  # start of the sample record: 2026-09-21T14:13:20Z


@dataclass(frozen=True)
class FakeItem:
    """A data item of JSON messages; its schema is inferred from ``examples``."""

    name: str
    examples: Sequence[Mapping[str, Any]]
    topic: str = ""
    source: str = "test"
    stamp: str = ""
    variables: Sequence[str] = ()

    def mcap_topic(self) -> Topic:
        """Return the topic as a journal's channel has it."""
        messages = [msgspec.json.encode(example) for example in self.examples]
        schema, _ = widen_schema(None, messages, "json", self.name)
        return Topic(self.topic or f"/{self.name}", "json", schema)


@dataclass
class FakeRun:
    """One run of a writer: ``write`` adds messages, ``rotate`` begins a new journal file."""

    store: Path
    writer: str = "main"
    items: Sequence[FakeItem] = ()
    boot: str = ""
    _channels: dict[Topic | str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        store = create_store(self.store)
        self.run = store.next_run()
        boot = self.boot or f"{self.run:08x}"
        folder = self.store / FOLDERS[self.writer]
        self.journal = JournalWriter(JournalOptions(folder, store.id, self.writer, self.run, boot))

    def write(self, rows: Sequence[tuple[int, FakeItem, Any]]) -> None:
        """Write messages given as (log time, item, values); bytes are written unchanged."""
        for start in range(0, len(rows), _CHUNK_ROWS):
            part = rows[start : start + _CHUNK_ROWS]
            self._write([
                (self._channel(item), at_ns, v if isinstance(v, bytes) else msgspec.json.encode(v))
                for at_ns, item, v in part
            ])  # fmt: skip

    def clock(self, at_ns: int, offset_ns: int) -> None:
        """Record that wall time differs from log time from now on."""
        self.own(channels.CLOCK, at_ns, {"offset_ns": offset_ns, "synchronised": True})

    def start(self, at_ns: int) -> None:
        """Write the start record of the run: the variables chosen for its items."""
        items = {item.name: {"variables": list(item.variables)} for item in self.items}
        text = msgspec.json.encode(items).decode()
        self.own(channels.RUN, at_ns, {"writer": self.writer, "run": self.run, "items": text})

    def own(self, topic: str, at_ns: int, values: Mapping[str, Any]) -> None:
        """Write a message on one of the box's own channels."""
        if topic not in self._channels:
            marks = {"item": topic.replace("/", "_"), "source": channels.SOURCE}
            self._channels[topic] = self.journal.channel(channels.topic_of(topic), marks)
        self._write([(self._channels[topic], at_ns, msgspec.json.encode(values))])

    def rotate(self) -> None:
        """Finish the journal file."""
        self.journal.rotate()

    def close(self) -> None:
        """Finish the journal file and the run."""
        self.journal.close()

    def _channel(self, item: FakeItem) -> int:
        topic = item.mcap_topic()
        if topic not in self._channels:
            marks = {"item": item.name, "source": item.source, "stamp": item.stamp}
            self._channels[topic] = self.journal.channel(topic, marks)
        return self._channels[topic]

    def _write(self, rows: Sequence[tuple[int, int, bytes]]) -> None:
        channels, log_ns, messages = zip(*rows, strict=True)
        self.journal.write(channels, log_ns, log_ns, messages)


def pose(number: int) -> dict[str, Any]:
    """Return the values of the sample record's message of that number."""
    return {
        "stamp": T0_NS + number * 10 * _MS - 3 * _MS,
        "pose": {"x": float(number), "y": -number / 4},
        "ranges": [float(n) for n in range(number % 4)],
        "mode": "AB"[number % 2],
        "units": [{"id": number * 10 + n} for n in range(number % 3)],
    }


POSE = FakeItem("odom", [pose(11)], stamp="stamp")
BATTERY = FakeItem("battery", [{"volts": 1.5}], variables=["volts"])


def pose_rows(start: int, stop: int) -> list[tuple[int, FakeItem, Any]]:
    """Return messages of the sample record: POSE every 10 ms, BATTERY with every tenth."""
    made: list[tuple[int, FakeItem, Any]] = []
    for number in range(start, stop):
        at = T0_NS + number * 10 * _MS
        made.append((at, POSE, pose(number)))
        if number % 10 == 0:
            made.append((at + 1, BATTERY, {"volts": 24.0 - number / 100}))
    return made


def fill_store(store: Path) -> None:
    """Write the sample record: three journal files of 100 POSEs, the last unfinished."""
    run = FakeRun(store, items=[POSE, BATTERY])
    run.start(T0_NS - 1)
    for start in (0, 100, 200):
        run.write(pose_rows(start, start + 100))
        if start < 200:
            run.rotate()
    run.journal.mark_sync().wait()


def build_segments_of(store: Path, count: int | None = None) -> None:
    """Turn the first ``count`` finished journals into segments."""
    finished = [journal for journal in journals(store) if journal.finished]
    for journal in finished[:count]:
        segments.build_segments(store, journal)
