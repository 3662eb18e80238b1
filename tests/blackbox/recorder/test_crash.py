"""Promises in the record: what survives ``kill -9`` and what survives a power cut."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from amberbox.blackbox.recorder.recorder import Recorder
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store import journal_reader
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.core.types import Batch
from tests.support.processes import free_port

KILLS = 50
WRITE_S = 0.1
SLACK_S = 0.05
STALLED_S = 3.0
"""How long a computer may stand still before a kill; most of the time it does not."""
_FORK = multiprocessing.get_context("fork")

pytest.importorskip("zmq", reason="the sender speaks ZMQ; pip install 'amberbox[zmq]'")


def send(truth: Path, port: int) -> None:
    """Publish numbered messages at 1 kHz; write the time of each to a file before sending it."""
    import zmq

    context = zmq.Context()
    socket = context.socket(zmq.PUB)
    socket.setsockopt(zmq.SNDHWM, 0)
    socket.bind(f"tcp://127.0.0.1:{port}")
    file = truth.open("wb", buffering=0)
    due = time.monotonic()
    for number in range(10_000_000):
        file.write(np.array([time.time_ns()], np.int64).tobytes())
        socket.send_multipart([b"count", b'{"n":%d}' % number])
        due += 0.001
        time.sleep(max(0.0, due - time.monotonic()))


def record(folder: Path) -> None:
    Recorder(load_folder(folder), retention=False).run()


@pytest.fixture
def sender(tmp_path: Path) -> Iterator[tuple[Path, int]]:
    truth, port = tmp_path / "truth", free_port()
    process = _FORK.Process(target=send, args=(truth, port), daemon=True)
    process.start()
    yield truth, port
    process.kill()
    process.join()


@pytest.fixture
def folder(tmp_path: Path, sender: tuple[Path, int]) -> Path:
    robot = tmp_path / "robot"
    robot.mkdir()
    (robot / "robot.yaml").write_text(
        f"id: crash_robot\nstore: {{write_s: {WRITE_S}, sync_s: 1}}\n"
    )
    (robot / "black_box.yaml").write_text(
        f"- zmq:\n    endpoint: tcp://127.0.0.1:{sender[1]}\n    topics: [{{name: count}}]\n"
    )
    return robot


def journals(folder: Path) -> int:
    """Count journal files: one more says that a run has begun to write."""
    return len(list((folder / "store" / "journal").glob("*.mcap")))


def counted(store: Path) -> NDArray[np.int64]:
    """Return the numbers that are in the record, in the order of their positions."""
    found = [
        (batch.run, batch.seq, batch.columns["n"])
        for batch in journal_reader.batches(store, items={"zmq_count"})
        if isinstance(batch, Batch)
    ]
    found.sort(key=lambda part: (part[0], int(part[1][0])))
    numbers = [np.asarray(n, np.int64) for _, _, n in found]
    return np.concatenate(numbers) if numbers else np.empty(0, np.int64)


@pytest.mark.timeout(180)
def test_kill_9_loses_only_the_last_write_interval(folder: Path, sender: tuple[Path, int]) -> None:
    rng = random.Random(1)
    kills: list[int] = []
    for _ in range(KILLS):
        before = journals(folder)
        process = _FORK.Process(target=record, args=(folder,))
        process.start()
        while journals(folder) == before:
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 0.4))
        kills.append(time.time_ns())
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
    sent_ns = np.frombuffer(sender[0].read_bytes(), np.int64)
    numbers = counted(open_store(folder / "store").path)
    assert len(numbers) > KILLS * 40
    assert (np.diff(numbers) > 0).all(), "a message is doubled or out of order"
    missing = np.setdiff1d(np.arange(numbers[0], numbers[-1]), numbers)
    lost_s, explained = _lost_by_kills(sent_ns, numbers, np.array(kills))
    assert not np.setdiff1d(missing, explained).size, "messages are missing that no kill has lost"
    assert np.percentile(lost_s, 80) < WRITE_S + SLACK_S
    assert max(lost_s) < STALLED_S


def _lost_by_kills(
    sent_ns: NDArray[np.int64], numbers: NDArray[np.int64], kills: NDArray[np.int64]
) -> tuple[list[float], NDArray[np.int64]]:
    """Return how many seconds of messages kills have cost, and the numbers of what is missing:
    also what was sent until the first message of a later run.
    """
    kept_before = np.searchsorted(numbers, np.searchsorted(sent_ns, kills)) - 1
    places, firsts = np.unique(kept_before, return_index=True)
    between = (places >= 0) & (places + 1 < len(numbers))
    firsts, places = firsts[between], places[between]
    last, following = numbers[places], numbers[places + 1]
    lost_s = (kills[firsts] - sent_ns[last + 1]) / NS
    missing = [np.arange(a + 1, b) for a, b in zip(last, following, strict=True)]
    return np.maximum(lost_s, 0.0).tolist(), np.concatenate(missing)
