"""Tamper evidence: how fast a store is verified and sealed, and what sealing costs the recorder."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.signing.keys import open_keys
from amberbox.blackbox.signing.signatures import seal_journals
from amberbox.blackbox.signing.verify import verify
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.store import Store, create_store
from benchmarks.common import Row, percentile, wall_s
from benchmarks.journal import FULL_SPEED_WRITE, WRITES_PER_SYNC
from benchmarks.mix import Mix, make

SECONDS = 200
FILES = 4
_MESSAGE_BYTES = 40_000
"""Images fill files quickly; they do not compress, as camera images do not."""
_WRITES = 300
_TARGET_MB = 300.0
_PEER = "SHA-256 of the same files, one thread"


def measure() -> list[Row]:
    """Measure over whole stores, files in the page cache."""
    with tempfile.TemporaryDirectory() as folder:
        store = create_store(Path(folder) / "store")
        data = make(SECONDS)
        for run in range(1, FILES + 1):
            write(store, data, run)
        size = sum(path.stat().st_size for path in store.journal_files("main")) / 1e6
        key = open_keys(store).key
        unsealed_s = wall_s(lambda: verify(store.path), 3)
        sealing_s = wall_s(lambda: _seal_again(store, lambda: seal_journals(store, key)), 3)
        sealed_s = wall_s(lambda: verify(store.path), 3)
        hash_s = wall_s(lambda: _hash(store), 3)
        alone, beside = _write_times(store)
    note = f"target {_TARGET_MB:.0f} MB/s; {size:.0f} MB"
    return [
        Row("verify, sealed journals", size / sealed_s, "MB/s", _PEER, hash_s / sealed_s, note),
        Row("verify, journals not yet sealed", size / unsealed_s, "MB/s", note=note),
        Row("sealing", size / sealing_s, "MB/s", note="one thread, synced and signed"),
        Row("write interval at the 99th percentile, alone", 1e3 * alone, "ms"),
        Row("write interval at the 99th percentile, beside sealing", 1e3 * beside, "ms",
            "alone", alone / beside, "the keeper runs at low priority"),
    ]  # fmt: skip


def write(store: Store, data: Mix, run: int, seed: int = 0) -> None:
    """Write one run: the mix of a robot, and images."""
    options = JournalOptions(store.folder("main"), store.id, "main", run, "0" * 8)
    writer = JournalWriter(options)
    for topic in data.topics:
        writer.channel(topic, {"item": topic.name, "source": "ros"})
    rng = np.random.default_rng(run + seed)
    times, numbers = np.array(data.times_ns), np.array(data.numbers, np.uint16)
    messages = list(data.messages)
    for place in range(0, len(messages), 100):
        messages[place] = rng.bytes(_MESSAGE_BYTES)
    for portion, start in enumerate(range(0, len(messages), FULL_SPEED_WRITE // 100)):
        part = slice(start, start + FULL_SPEED_WRITE // 100)
        writer.write(numbers[part], times[part], times[part], messages[part])
        if portion % WRITES_PER_SYNC == WRITES_PER_SYNC - 1:
            writer.mark_sync().wait()
    writer.close()


def _hash(store: Store) -> None:
    for path in store.journal_files("main"):
        with path.open("rb") as file:
            hashlib.file_digest(file, "sha256")


def _seal_again(store: Store, work: Callable[[], object]) -> None:
    (store.path / mf.NAME).unlink(missing_ok=True)
    work()


_SEALING = """
import os, sys
from pathlib import Path
from amberbox.blackbox.signing.signatures import seal_journals
from amberbox.blackbox.store.store import open_store
os.nice(10)
store = open_store(Path(sys.argv[1]))
print("ready", flush=True)
while True:
    (store.path / "manifest").unlink(missing_ok=True)
    seal_journals(store, None)
"""


def _write_times(store: Store) -> tuple[float, float]:
    """Measure what a write of 0.1 s takes the recorder, alone and while a keeper seals, in s."""
    data = make(SECONDS)
    alone = percentile(_timed_writes(data), 99)
    keeper = subprocess.Popen(
        [sys.executable, "-c", _SEALING, str(store.path)], stdout=subprocess.PIPE
    )
    try:
        assert keeper.stdout is not None
        keeper.stdout.readline()
        return alone, percentile(_timed_writes(data), 99)
    finally:
        keeper.kill()
        keeper.wait()


def _timed_writes(data: Mix) -> list[float]:

    found = []
    with tempfile.TemporaryDirectory() as folder:
        writer = JournalWriter(JournalOptions(Path(folder), "0" * 8, "main", 1, "0" * 8))
        for topic in data.topics:
            writer.channel(topic, {"item": topic.name})
        times, numbers = np.array(data.times_ns), np.array(data.numbers, np.uint16)
        for start in range(0, _WRITES * 42, 42):
            part = slice(start, start + 42)
            begin = time.perf_counter()
            writer.write(numbers[part], times[part], times[part], data.messages[part])
            found.append(time.perf_counter() - begin)
        writer.close()
    return found
