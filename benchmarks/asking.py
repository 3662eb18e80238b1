"""Asking while it is recorded: an hour at 421 messages/s, its journal growing, from the shell.

Wall time of a verb less that of its ``--help``, which imports what the verb needs.
The hour is in journals of 64 MB that are segments but for the one that grows, or all of it is in
one journal that grows.
"""

from __future__ import annotations

import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.signing.signatures import seal_journals
from amberbox.blackbox.store.journal_reader import journals
from amberbox.blackbox.store.segment_builder import build_segments
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time
from amberbox.testing.clock import ManualClock
from benchmarks import mix
from benchmarks.common import Row, meanwhile
from tests.support.manual_recorder import WRITE_S, ManualBox

REPEATS = 7
HOUR_S = 3600
_LOOP_S = 20
_GROWING_S = 300
_WRITE_NS = round(WRITE_S * NS)
_ITEM, _VARIABLE = "ros_imu", "linear_acceleration_x"
_STAMPED = struct.Struct("<II")


@dataclass
class _Robot:
    """Records the mix, over and over, each message stamped when it is heard."""

    store: Path
    options: PipelineOptions
    _ticks: list[list[tuple[int, int, bytes]]] = field(default_factory=list)
    _number: int = 0

    def __post_init__(self) -> None:
        made = mix.make(_LOOP_S)
        self._ticks = [[] for _ in range(_LOOP_S * NS // _WRITE_NS)]
        for number, at_ns, message in zip(made.numbers, made.times_ns, made.messages, strict=True):
            tick, since_ns = divmod(at_ns - mix.START_NS, _WRITE_NS)
            self._ticks[tick].append((number, since_ns, message))
        clock = ManualClock(wall=time.time_ns() - HOUR_S * NS, boot=1000 * NS)
        self.box = ManualBox(self.store, clock=clock, options=self.options)
        self._streams = [self.box.sink.topic(topic) for topic in made.topics]
        self._is_stamped = [b"Header header" in t.schema.data for t in made.topics if t.schema]

    def record(self, seconds: float) -> None:
        """Write what so many seconds bring, as fast as that goes."""
        for _ in range(round(seconds / WRITE_S)):
            now_ns = self.box.sink.now_ns()
            for number, since_ns, message in self._ticks[self._number % len(self._ticks)]:
                at_ns = now_ns + since_ns
                if self._is_stamped[number]:
                    message = message[:4] + _STAMPED.pack(*divmod(at_ns, NS)) + message[12:]
                self.box.sink.message(self._streams[number], message, at_ns)
            self.box.write()
            self._number += 1
        self.box.pipeline._journals.publish_heads(self.box.sink.now_ns())

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Go on in real time until the block is left."""
        try:
            with meanwhile(lambda: self.record(WRITE_S), WRITE_S):
                yield
        finally:
            self.box.close()


def measure() -> list[Row]:
    """Ask both records from the shell, each question several times."""
    rows = []
    for name, rotates in (("1 h in segments and a journal", True), ("1 h in one journal", False)):
        with tempfile.TemporaryDirectory() as folder:
            never = PipelineOptions(rotate_bytes=1 << 40, rotate_ns=1 << 62)
            robot = _Robot(Path(folder) / "store", PipelineOptions() if rotates else never)
            robot.record(HOUR_S - _GROWING_S)
            if rotates:
                robot.box.pipeline.rotate()
            robot.record(_GROWING_S)
            if rotates:
                _condense(robot.store)
            with robot.recording():
                rows += [_asked(name, *question) for question in _questions(robot)]
    return rows


def _condense(store: Path) -> None:
    """Do what the keeper does with journals that nobody writes any more."""
    for journal in journals(store):
        if journal.finished:
            build_segments(store, journal)
    seal_journals(open_store(store), None)


def _questions(robot: _Robot) -> Iterator[tuple[str, list[str], str]]:
    store, end_ns = str(robot.store), robot.box.sink.now_ns() - 40 * 60 * NS
    span = ["--from", format_time(end_ns - 600 * NS), "--to", format_time(end_ns)]
    yield "items", ["items", store], "to be <= 0.3"
    query = ["query", store, _ITEM, _VARIABLE, "--format", "csv"]
    yield "query of 10 minutes of a variable", [*query, *span], "to be <= 0.1; 60,000 lines of CSV"
    yield "query of 10 minutes thinned to 1000", [*query, *span, "--points", "1000"], "to be <= 0.1"
    last = ["--from", "-5m", "--points", "1000"]
    yield "query of the last 5 minutes thinned to 1000", [*query, *last], "all of it unpacked"
    yield "sql count(*)", ["sql", store, f"select count(*) from {_ITEM}"], "to be <= 0.5"


def _asked(record: str, name: str, command: Sequence[str], note: str) -> Row:
    """Measure a verb less its start; the note says how long starting and the whole take."""
    starts, plain, wholes = [], [], []
    for _ in range(REPEATS):
        plain.append(_wall_s(["--help"]))
        starts.append(_wall_s([command[0], "--help"]))
        wholes.append(_wall_s(command))
    start, whole = statistics.median(starts), statistics.median(wholes)
    note += f"; {whole:.2f} with the start of Python, --help {statistics.median(plain):.2f}"
    return Row(f"{record}, live: {name}", max(whole - start, 0.0), "s", note=note)


def _wall_s(command: Sequence[str]) -> float:
    began = time.perf_counter()
    whole = [sys.executable, "-m", "amberbox", *command]
    subprocess.run(whole, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.perf_counter() - began


if __name__ == "__main__":
    for row in measure():
        print(f"{row.name:60} {row.value:8.3f} {row.unit}  {row.note}")
