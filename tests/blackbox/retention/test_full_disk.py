"""A disk that really fills: the last events are there, and recording resumes when there is room."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from bisect import bisect_left
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import amberbox
from amberbox.blackbox.recorder.disk_room import DiskRoom
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention.usage import DiskUse
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.store import is_store
from amberbox.blackbox.store.tail import follow
from amberbox.core.types import Batch, Gap, Schema, Topic
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.manual_recorder import (
    COUNT,
    ManualBox,
    event_texts,
    events,
    last_counters,
    number,
    own_records,
)
from tests.support.processes import free_port

pytest.importorskip("zmq", reason="the sender speaks ZMQ; pip install 'amberbox[zmq]'")

DISK_BYTES = 12_000_000
RESERVE = 1_000_000
ITEM = "zmq_count"
NOISE = Topic("/noise", "ros1", Schema("test/Noise", "ros1msg", b"uint8[] data\n"))


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path | None]:
    """Give a file system of its own, small, in memory; None where it may not be mounted."""
    path = tmp_path / "disk"
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(path)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        yield None
        return
    yield path
    subprocess.run(["umount", "-l", str(path)], check=True)


def run_apart(request: pytest.FixtureRequest) -> None:
    """Run a test again where everybody is root: in a name space of its own."""
    apart = ["unshare", "-rm"]
    if subprocess.run([*apart, "true"], capture_output=True, check=False).returncode:
        pytest.skip("nothing may be mounted here; test_events_only has a disk that needs no mount")
    again = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", request.node.nodeid]
    root = request.config.rootpath
    done = subprocess.run([*apart, *again], cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


class Sender:
    """Publishes numbered messages that cannot be compressed, and stores the time of each."""

    def __init__(self, port: int, pause_s: float, size: int) -> None:
        self.sent_ns: list[int] = []
        self._end = threading.Event()
        self._port, self._pause_s, self._size = port, pause_s, size
        self._thread = threading.Thread(target=self._send)
        self._thread.start()

    def _send(self) -> None:
        import zmq

        with zmq.Context() as context, context.socket(zmq.PUB) as socket:
            socket.setsockopt(zmq.SNDHWM, 0)
            socket.bind(f"tcp://127.0.0.1:{self._port}")
            while not self._end.wait(self._pause_s):
                noise = os.urandom(self._size // 2).hex()
                message = b'{"n":%d,"noise":"%s"}' % (len(self.sent_ns), noise.encode())
                self.sent_ns.append(time.time_ns())
                socket.send_multipart([b"count", message])
            time.sleep(0.3)  # what was sent is on its way

    def stop(self) -> None:
        self._end.set()
        self._thread.join()


@contextmanager
def sending(pause_s: float = 0.004, size: int = 1000) -> Iterator[tuple[int, Sender]]:
    port = free_port()
    sender = Sender(port, pause_s, size)
    try:
        yield port, sender
    finally:
        sender.stop()


def robot(folder: Path, disk: Path, port: int) -> Path:
    folder.mkdir()
    (folder / "robot.yaml").write_text(
        f"id: full\nstore: {{path: {disk}/store, reserve: {RESERVE} B, min_free: 0 B, "
        "quota_percent: 100, rotate_mb: 2}\n"
    )
    (folder / "black_box.yaml").write_text(
        f"- zmq:\n    endpoint: tcp://127.0.0.1:{port}\n    topics: [{{name: count}}]\n"
    )
    return disk / "store"


WITHOUT_KEEPER = (
    "import signal, sys; from amberbox.blackbox.robot_folder.folder import load_folder;"
    "from amberbox.blackbox.recorder.recorder import Recorder;"
    "r = Recorder(load_folder(sys.argv[1]), retention=False);"
    "signal.signal(signal.SIGTERM, lambda *_: r.stop.set()); r.run()"
)


@contextmanager
def recorder(folder: Path, *, keeper: bool) -> Iterator[subprocess.Popen[bytes]]:
    with_keeper = ["-m", "amberbox", "record", "--quiet", str(folder)]
    words = with_keeper if keeper else ["-c", WITHOUT_KEEPER, str(folder)]
    process = subprocess.Popen([sys.executable, *words], stderr=subprocess.PIPE)
    try:
        yield process
    finally:
        process.terminate()
        _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode in (0, -signal.SIGKILL), said.decode()
    assert b"Traceback" not in said, said.decode()


def fill(disk: Path) -> Path:
    """Use all remaining disk space, as another program may."""
    path = disk / "somebody_else"
    with path.open("wb", buffering=0) as file, pytest.raises(OSError, match="No space"):
        while True:
            file.write(bytes(100_000))
    return path


def kept(store: Path) -> list[int]:
    """Return the numbers in the record as ``follow`` delivers them, which must be in order."""
    found: list[int] = []
    for delivery in follow(store, [ITEM], live=False):
        assert not isinstance(delivery, Gap) or delivery.from_seq is None, delivery
        if isinstance(delivery, Batch):
            found += np.asarray(delivery.columns["n"]).tolist()
    assert found == sorted(set(found)), "doubled or out of order"
    return found


def numbers_of(store: Path) -> list[int]:
    return amberbox.open(store).query(ITEM, ["n"]).values("n")


def heard(store: Path) -> int:
    return last_counters(store).get(ITEM, {}).get("kept", 0) if is_store(store) else 0


def reserved(store: Path) -> int:
    """Size of the reserve: 0 while the disk is full."""
    path = store / "reserve"
    return path.stat().st_size if path.exists() else -1


def check_drops(store: Path, sent_ns: list[int], numbers: list[int]) -> int:
    """Every message sent after the first that was kept is there, or in a gap that counts it.

    Such a gap lies between the times of receipt of the messages that were kept before and after,
    however late the recorder was.
    """
    gaps = [g for g in amberbox.open(store).gaps(ITEM) if g.reason.startswith("dropped")]
    lost = sorted(set(range(numbers[0], len(sent_ns))) - set(numbers))
    assert sum(gap.count or 0 for gap in gaps) == len(lost)
    received = amberbox.open(store).query(ITEM, ["received"]).values("received")
    for n in lost:
        after = bisect_left(numbers, n)
        began_ns, ended_ns = received[after - 1], [*received, 1 << 62][after]
        fits = (g for g in gaps if began_ns <= g.from_ns and g.to_ns <= ended_ns)
        assert any(sent_ns[n] <= g.to_ns + 50_000_000 for g in fits), n
    counters = last_counters(store)[ITEM]
    assert (counters["kept"], counters["dropped"]) == (len(numbers), len(lost))
    return len(lost)


@pytest.mark.parametrize("keeper", [False, True])
def test_recording_resumes_when_somebody_else_makes_room(
    tmp_path: Path, disk: Path | None, keeper: bool, request: pytest.FixtureRequest
) -> None:
    if disk is None:
        run_apart(request)
        return
    with sending() as (port, sender):
        store = robot(tmp_path / "robot", disk, port)
        with recorder(tmp_path / "robot", keeper=keeper):
            wait_until(lambda: heard(store) > 50, "a record")
            assert (store / "reserve").stat().st_blocks * 512 >= RESERVE == reserved(store)
            filler = fill(disk)
            wait_until(lambda: reserved(store) == 0, "the disk is full")
            full_at = len(sender.sent_ns)
            wait_until(lambda: len(sender.sent_ns) > full_at + 200, "messages meanwhile")
            filler.unlink()
            wait_until(lambda: event_texts(store, "recording_resumed"), "there is room")
            resumed_at = len(sender.sent_ns)
            assert reserved(store) == RESERVE
            wait_until(lambda: len(sender.sent_ns) > resumed_at + 100, "messages after")
            sender.stop()
            wait_until(lambda: kept(store)[-1] + 1 == len(sender.sent_ns), "the last message")
    numbers = kept(store)
    lost = check_drops(store, sender.sent_ns, numbers)
    assert lost > 150
    assert set(range(resumed_at + 50, len(sender.sent_ns))) <= set(numbers)
    first, *others = event_texts(store, "events_only")
    assert first == "disk full: only events are recorded until there is room"
    assert keeper or not others
    assert event_texts(store, "stopped") == ["recording stopped"]
    assert event_texts(store, "disk") == []


def test_a_disk_that_the_record_fills_itself(
    tmp_path: Path, disk: Path | None, request: pytest.FixtureRequest
) -> None:
    if disk is None:
        run_apart(request)
        return
    with sending(0.01, 90_000) as (port, sender):
        store = robot(tmp_path / "robot", disk, port)
        with recorder(tmp_path / "robot", keeper=False):
            wait_until(lambda: reserved(store) == 0, "it is full")
            full_at = len(sender.sent_ns)
            wait_until(lambda: len(sender.sent_ns) > full_at + 100, "messages meanwhile")
            oldest = sorted((store / "journal").glob("*.mcap"))[:4]
            for path in oldest:
                path.unlink()
            wait_until(lambda: reserved(store) == RESERVE, "there is room")
            resumed_at = len(sender.sent_ns)
            wait_until(lambda: len(sender.sent_ns) > resumed_at + 20, "messages after")
            sender.stop()
            last = len(sender.sent_ns) - 1
            wait_until(lambda: numbers_of(store)[-1] == last, "the last message")
    numbers = np.array(numbers_of(store))
    gaps = [g for g in amberbox.open(store).gaps(ITEM) if g.reason == "dropped: disk full"]
    lost = set(range(int(numbers[0]), len(sender.sent_ns))) - set(numbers.tolist())
    assert sum(gap.count or 0 for gap in gaps) == len(lost) > 70
    assert (np.diff(numbers) > 0).all()
    assert event_texts(store, "recording_resumed")


def test_a_recorder_killed_while_the_disk_is_full(
    tmp_path: Path, disk: Path | None, request: pytest.FixtureRequest
) -> None:
    if disk is None:
        run_apart(request)
        return
    with sending() as (port, sender):
        store = robot(tmp_path / "robot", disk, port)
        with recorder(tmp_path / "robot", keeper=False) as process:
            wait_until(lambda: heard(store) > 50, "a record")
            filler = fill(disk)
            wait_until(lambda: reserved(store) == 0, "the disk is full")
            wait_until(lambda: own_records(store, "amberbox/gap")[-1]["count"], "an account")
            process.kill()
        with recorder(tmp_path / "robot", keeper=False):
            wait_until(lambda: len(event_texts(store, "events_only")) == 2, "a run that is full")
            assert len(event_texts(store, "recovered")) == 1
            filler.unlink()
            wait_until(lambda: reserved(store) == RESERVE, "there is room")
            numbers = len(kept(store))
            wait_until(lambda: len(kept(store)) > numbers + 50, "a record")
    found = kept(store)
    covered = amberbox.open(store).gaps(ITEM)
    lost = set(range(found[0], found[-1])) - set(found)
    for n in lost:
        at = sender.sent_ns[n]
        assert any(g.from_ns - 200_000_000 <= at <= g.to_ns + 50_000_000 for g in covered), n
    assert len(lost) > 100


def test_the_keeper_makes_room_on_a_full_disk_with_the_help_of_the_reserve(
    request: pytest.FixtureRequest, disk: Path | None
) -> None:
    if disk is None:
        run_apart(request)
        return
    room = DiskRoom(disk / "store", RESERVE)
    box = ManualBox(disk / "store", options=PipelineOptions(rotate_bytes=200_000), room=room)
    room.begin()
    for value in range(40):
        box.hear(COUNT, number(value))
        box.hear(NOISE, (100_000).to_bytes(4, "little") + os.urandom(100_000))
        box.write()
    box.close()
    fill(disk)
    assert (box.store / "reserve").stat().st_size == RESERVE
    options = RetentionOptions(quota=3_000_000, min_free=0, keep_min_s=0.0, headroom=200_000)
    command = [sys.executable, "-m", "amberbox.blackbox.keeper", str(box.store), "--once"]
    subprocess.run([*command, "--options", options.to_json()], check=True)
    assert (box.store / "reserve").stat().st_size < RESERVE
    assert mf.read(box.store).tombstones
    assert not mf.read(box.store).damage
    assert events(box.store, "deleted")
    assert DiskUse(box.store).measure() <= 3_000_000
