"""How long it takes to pin ten minutes of a busy robot's record, while it is being written.

The target is 50 ms. Beside it: reading the window's files whole, as a copy would have to.
"""

from __future__ import annotations

import shutil
import statistics
import tempfile
import time
from pathlib import Path

from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention.pins import PinRequest, advance, pin, release
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store.incident import StoredIncident, load_all
from amberbox.blackbox.store.store import Store, open_store
from amberbox.core.clock import NS
from amberbox.core.source import TopicOptions
from amberbox.core.types import Topic
from benchmarks.common import Row
from tests.support.manual_recorder import COUNT, ManualBox, number

MINUTES = 12
REPEATS = 9
_RING = Topic("/ring", COUNT.message_encoding, COUNT.schema)
_PER_WRITE = 50


def measure() -> list[Row]:
    """Record twelve minutes in files of ten, the ring in files of one; pin the last ten."""
    with tempfile.TemporaryDirectory() as place:
        box = _recorded(Path(place) / "store")
        store = open_store(box.store)
        warm = [_pinned_ms(store, PinRequest(600, 20, "bench")) for _ in range(REPEATS)]
        copied_ms = _copied_ms(store, Path(place))
        box.close()
    note = "target: 50; ten minutes, 6,000 writes, the recorder at work"
    best, median = min(warm), statistics.median(warm)
    peer = "copying the same files"
    return [
        Row("pin ten minutes", median, "ms", peer, copied_ms / median, note),
        Row("pin ten minutes, first in a process", warm[0], "ms", note=note),
        Row("pin ten minutes, best", best, "ms", note=note),
    ]


def _recorded(store: Path) -> ManualBox:
    options = PipelineOptions(rotate_ns=600 * NS, ring_rotate_ns=60 * NS)
    box = ManualBox(store, [TopicOptions("/ring", keep="ring")], options=options)
    for n in range(MINUTES * 600):
        box.hear(COUNT, *(number(n),) * _PER_WRITE)
        box.hear(_RING, *(number(n),) * _PER_WRITE)
        box.write()
    return box


def _pinned_ms(store: Store, wish: PinRequest) -> float:
    began = time.perf_counter()
    made = pin(store, wish, RetentionOptions())
    took_ms = 1000 * (time.perf_counter() - began)
    assert isinstance(made, StoredIncident)
    release(store, advance(store, made))
    return took_ms


def _copied_ms(store: Store, place: Path) -> float:
    assert load_all(store)
    began = time.perf_counter()
    for name in ("journal", "ring"):
        shutil.copytree(store.path / name, place / name)
    return 1000 * (time.perf_counter() - began)


if __name__ == "__main__":
    for row in measure():
        print(f"{row.name:40} {row.value:8.2f} {row.unit}  {row.peer} {row.ratio or ''}")
