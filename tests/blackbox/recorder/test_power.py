"""A power cut: unsynced data are gone or incomplete, everything older is there."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.recorder.pipeline import Pipeline, PipelineOptions
from amberbox.blackbox.recorder.supervisor import BlockSink
from amberbox.blackbox.store import journal_reader
from amberbox.blackbox.store.store import create_store
from amberbox.core.clock import NS, RunClock
from amberbox.core.types import Schema, Topic
from amberbox.testing.clock import ManualClock

WRITE_S, SYNC_S = 0.1, 1.0
COUNTED = Topic("/count", "ros1", Schema("std_msgs/Int64", "ros1msg", b"int64 data\n"))


def record(store_path: Path, ticks: int) -> dict[Path, list[tuple[int, int]]]:
    """Record ten messages per tick; return per file (log time of sync, synced size)."""
    clock = ManualClock()
    pipeline = Pipeline(
        create_store(store_path), RunClock(clock), PipelineOptions(rotate_bytes=20_000)
    )
    sink = BlockSink(pipeline, "ros", (), lossless=False)
    stream = sink.topic(COUNTED)
    synced: dict[Path, list[tuple[int, int]]] = {}
    number = 0
    for tick in range(ticks):
        for _ in range(10):
            clock.advance(WRITE_S / 10)
            sink.message(stream, number.to_bytes(8, "little"), sink.now_ns())
            number += 1
        pipeline.tick()
        if tick % round(SYNC_S / WRITE_S) == 0:
            for mark in pipeline.mark_sync():
                mark.wait()
            for path in pipeline.store.journal_files("main"):
                synced.setdefault(path, []).append((clock.wall_ns(), path.stat().st_size))
    return synced


@pytest.mark.parametrize("torn", ["dropped", "zeroed", "garbage"])
@settings(max_examples=15)
@given(seed=st.integers(0, 2**32), ticks=st.integers(1, 60))
def test_everything_synced_survives(
    tmp_path_factory: pytest.TempPathFactory, torn: str, seed: int, ticks: int
) -> None:
    rng, store = random.Random(seed), tmp_path_factory.mktemp("power") / "store"
    synced = record(store, ticks)
    for path, marks in synced.items():
        lose_unsynced(path, marks[-1][1], torn, rng)
    for path in set((store / "journal").glob("*.mcap")) - set(synced):
        lose_unsynced(path, 0, torn, rng)
    last_sync_ns = max(at for marks in synced.values() for at, _ in marks)
    end_ns = ManualClock().wall_ns() + ticks * round(WRITE_S * NS)
    assert end_ns - last_sync_ns <= (SYNC_S + WRITE_S) * NS
    found = [
        n
        for b in journal_reader.batches(store, {"ros_count"})
        for n in np.asarray(b.columns["data"]).tolist()
    ]
    survivors = round((last_sync_ns - ManualClock().wall_ns()) / (WRITE_S / 10 * NS))
    assert found[:survivors] == list(range(survivors))
    assert found == sorted(set(found))


def lose_unsynced(path: Path, size: int, torn: str, rng: random.Random) -> None:
    """Do to the end of a file what a power cut does: pages dropped, zero or full of old data."""
    content = path.read_bytes()
    kept, rest = content[:size], content[size:]
    if torn == "dropped":
        rest = rest[: rng.randint(0, len(rest))]
    elif torn == "zeroed":
        rest = bytes(len(rest))
    else:
        rest = rng.randbytes(len(rest))
    path.write_bytes(kept + rest)
