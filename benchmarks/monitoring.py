"""Monitoring: a watcher's share of the machine, how fast a record replays, how soon a status is."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np

from amberbox.blackbox.journal import channels as journal_channels
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.store.store import create_store
from amberbox.blackbox.store.tail import follow
from amberbox.core.clock import NS
from amberbox.core.types import Batch, Schema, Topic
from benchmarks.common import Row, percentile
from benchmarks.recorder import TICKS, cpu_ticks, recording, rss_bytes

SECONDS = 15.0
COMPONENTS = 500
INPUTS = 2
TOPICS = 20
VARIABLES = COMPONENTS * INPUTS // TOPICS
HOURS = float(os.environ.get("BENCH_REPLAY_HOURS", "2"))
ITEMS, COLUMNS = 10, 5
START_NS = 1_790_000_000 * NS
WRITE_NS = NS // 10


def measure() -> list[Row]:
    """Measure the watcher live, in a replay, and its latency."""
    return [*_live(), *_replay(), *_latency()]


# -- many components, live


def _live() -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as place, _senders(TOPICS, VARIABLES, 10.0) as endpoint:
        robot = _robot(Path(place), endpoint)
        _write_components(robot, COMPONENTS, _many)
        with recording(robot), _watching(robot) as process:
            time.sleep(SECONDS)
            before, start = cpu_ticks(process.pid), time.monotonic()
            time.sleep(SECONDS)
            used_s = (cpu_ticks(process.pid) - before) / TICKS
            share = used_s / (time.monotonic() - start)
            memory = rss_bytes(process.pid)
        statuses = sum(len(batch) for batch in _statuses(robot / "store"))
    what = f"{COMPONENTS} components, {2 * INPUTS * COMPONENTS} outputs at 10 Hz"
    note = f"{INPUTS * COMPONENTS * 10} evaluations/s of 2 outputs each; to be < 25"
    yield Row(f"watch {what}: CPU", 100 * share, "% of a core", note=note)
    yield Row(f"watch {what}: memory", memory / 1e6, "MB RSS", note=f"{statuses} statuses written")


def _many(number: int) -> str:
    """Write the mode file of one of many components: two inputs, two outputs of each."""
    mappings = ""
    for place in range(INPUTS):
        index = number * INPUTS + place
        address = f"zmq_t{index % TOPICS}.v{index // TOPICS}"
        mappings += f"""
  - mapping:
      inputs: [{address}]
      outputs:
        - output: {{name: ok_{place}, type: bool, expected: true}}
        - output: {{name: value_{place}, type: float}}"""
    return f"name: limits\nmonitor: range\nmappings:{mappings}\narguments: {{min: -9, max: 9}}\n"


# -- a day, replayed


def _replay() -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as place:
        robot = _robot(Path(place), "tcp://127.0.0.1:9")
        _write_components(robot, ITEMS * COLUMNS, _one)
        messages = _write_record(robot / "store", HOURS)
        start, before = time.monotonic(), _children_s()
        command = [
            sys.executable,
            "-m",
            "amberbox",
            "watch",
            str(robot),
            "--replay",
            "--speed",
            "max",
        ]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        seconds, cpu_s = time.monotonic() - start, _children_s() - before
    note = f"{ITEMS * COLUMNS} monitors, {messages:,} messages in chunks of 0.1 s; to be > 300"
    name = f"replay of {HOURS:g} h"
    yield Row(f"{name}: times faster than real time", HOURS * 3600 / seconds, "x", note=note)
    evaluations = HOURS * 3600 * 10 * ITEMS * COLUMNS
    yield Row(f"{name}: evaluations", evaluations / cpu_s, "1/s CPU", note="all else included")


def _one(number: int) -> str:
    """Write the mode file of one of fifty monitors: ranges, rates, frozen values, expressions."""
    address = f"zmq_t{number % ITEMS}.v{number // ITEMS}"
    kinds = (
        ("range", f"[{address}]", "{min: -9, max: 9}"),
        ("rate_of_change", f"[{address}]", "{max: 1000}"),
        ("frozen", f"[{address}]", "{for: 2 s}"),
        ("garbage", f"[{address}]", "{min: -100, max: 100}"),
        ("heartbeat", f"[zmq_t{number % ITEMS}]", "{rate: 10 Hz}"),
    )
    monitor, inputs, arguments = kinds[number // ITEMS]
    return f"""\
name: {monitor}_monitor
monitor: {monitor}
mappings:
  - mapping:
      inputs: {inputs}
      outputs:
        - output: {{name: fine, type: bool, expected: true}}
arguments: {arguments}
"""


def _write_record(store: Path, hours: float) -> int:
    """Write what a robot's recorder writes: ten times a second one message of each item."""
    made = create_store(store)
    writer = JournalWriter(JournalOptions(made.folder("main"), made.id, "main", 1, "bench000"))
    definition = "\n".join(f"float64 v{n}" for n in range(COLUMNS)).encode()
    schema = Schema("bench/Fifty", "ros1msg", definition)
    channels = [
        writer.channel(Topic(f"t{n}", "ros1", schema), {"item": f"zmq_t{n}", "source": "zmq"})
        for n in range(ITEMS)
    ]
    own = {"item": "amberbox_counters", "source": journal_channels.SOURCE}
    channels.append(writer.channel(journal_channels.topic_of(journal_channels.COUNTERS), own))
    values = np.random.default_rng(1).normal(size=(1000, ITEMS, COLUMNS))
    writes = round(hours * 36_000)
    for number in range(writes):
        at_ns = np.full(ITEMS + 1, START_NS + number * WRITE_NS)
        rows = [values[number % 1000, n].tobytes() for n in range(ITEMS)]
        rows.append(_counters(number + 1, int(at_ns[0])))
        writer.write(channels, at_ns, at_ns, rows)
        if number % 6000 == 5999:
            writer.rotate()
    writer.close()
    return writes * (ITEMS + 1)


def _counters(received: int, last_ns: int) -> bytes:
    entry = {"received": received, "kept": received, "rate_limited": 0, "unchanged": 0,
             "dropped": 0, "bytes": 40 * received, "last_received_ns": last_ns}  # fmt: skip
    items = [{"item": f"zmq_t{n}", **entry} for n in range(ITEMS)]
    return msgspec.json.encode({"items": items})


# -- from the bus to the journal


def _latency() -> Iterator[Row]:
    """Time from a publisher's send to the status in the journal, as a follower gets it."""
    with tempfile.TemporaryDirectory() as place:
        import zmq

        context = zmq.Context()
        socket = context.socket(zmq.PUB)
        port = socket.bind_to_random_port("tcp://127.0.0.1")
        robot = _robot(Path(place), f"tcp://127.0.0.1:{port}")
        _write_components(robot, 1, lambda number: _ALTERNATING)
        stop, sent = threading.Event(), list[tuple[float, bool]]()
        sender = threading.Thread(target=_alternate, args=(socket, stop, sent))
        with recording(robot), _watching(robot):
            sender.start()
            delays = _delays_ms(robot / "store", stop, sent)
        sender.join()
        socket.close()
        context.term()
    note = f"{len(delays)} changes of a value, no `for:`"
    yield Row(
        "bus to confirmed status, median", percentile(delays, 50), "ms", note=f"{note}; to be < 200"
    )
    yield Row("bus to confirmed status, p95", percentile(delays, 95), "ms", note=note)


_ALTERNATING = """\
name: limits
monitor: range
mappings:
  - mapping:
      inputs: [zmq_t0.v0]
      outputs:
        - output: {name: fine, type: bool, expected: true, flapping: {changes: 1000, within: 1 s}}
arguments: {max: 0.5}
"""


def _alternate(socket: object, stop: threading.Event, sent: list[tuple[float, bool]]) -> None:
    """Send at 10 Hz; every 730 ms the value is another."""
    start, last = time.monotonic(), None
    while not stop.wait(0.05):
        good = int((time.monotonic() - start) / 0.73) % 2 == 0
        if good != last:
            sent.append((time.monotonic(), good))
            last = good
        socket.send_multipart([b"t0", b'{"v0":%d}' % (not good)])  # type: ignore[attr-defined]  # zmq is imported late


def _delays_ms(
    store: Path, stop: threading.Event, sent: Sequence[tuple[float, bool]]
) -> list[float]:
    """Follow the watcher's statuses for some seconds, and pair each change with its cause."""
    delays: list[float] = []
    end, last, heard = time.monotonic() + 2 * SECONDS, "", 0
    for delivery in follow(store, ["amberbox_status"], writers=("watch",), stop=stop):
        now = time.monotonic()
        if isinstance(delivery, Batch):
            modes: list[str] = np.asarray(delivery.columns["mode"]).tolist()
            found: list[str] = np.asarray(delivery.columns["level"]).tolist()
            for level in [lvl for mode, lvl in zip(modes, found, strict=True) if mode]:
                if level in ("ok", "error") and level != last:
                    last = level
                    causes = [at for at, good in list(sent) if good == (level == "ok") and at < now]
                    delays.append(1000 * (now - causes[-1]))
                    heard += 1
        if now > end:
            stop.set()
    return delays[3:]


# -- what they share


def _robot(place: Path, endpoint: str) -> Path:
    (place / "robot.yaml").write_text("id: bench\n")
    listed = "".join(f"\n    - {{name: t{n}}}" for n in range(TOPICS))
    (place / "black_box.yaml").write_text(
        f"- zmq:\n    endpoint: {endpoint}\n    topics:{listed}\n"
    )
    return place


def _write_components(robot: Path, count: int, mode_file: object) -> None:
    folder = robot / "components"
    folder.mkdir()
    for number in range(count):
        name = f"part_{number}"
        needs = f"[part_{number - 1}]" if number % 10 else "[]"
        text = f"component_name: {name}\nmodes: [{name}/mode.yaml]\ndependencies: {needs}\n"
        (folder / f"{name}.yaml").write_text(text)
        (folder / name).mkdir()
        (folder / name / "mode.yaml").write_text(mode_file(number))  # type: ignore[operator]  # a function


@contextmanager
def _senders(topics: int, variables: int, rate_hz: float) -> Iterator[str]:
    """Publish JSON topics of floats, all of which change with every message."""
    import zmq

    context = zmq.Context()
    socket = context.socket(zmq.PUB)
    port = socket.bind_to_random_port("tcp://127.0.0.1")
    stop = threading.Event()

    def send() -> None:
        random = np.random.default_rng(1)
        while not stop.wait(1 / rate_hz):
            for topic in range(topics):
                values = random.normal(size=variables).round(4).tolist()
                message = {f"v{n}": value for n, value in enumerate(values)}
                socket.send_multipart([b"t%d" % topic, msgspec.json.encode(message)])

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield f"tcp://127.0.0.1:{port}"
    finally:
        stop.set()
        thread.join()
        socket.close()
        context.term()


@contextmanager
def _watching(robot: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run ``amberbox watch`` as a user does, until the block is left."""
    command = [sys.executable, "-m", "amberbox", "watch", str(robot), "--quiet"]
    process = subprocess.Popen(command)
    while not list((robot / "store").glob("watch/*.mcap")):
        time.sleep(0.05)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)


def _statuses(store: Path) -> Iterator[Batch]:
    for delivery in follow(store, ["amberbox_status"], writers=("watch",), live=False):
        if isinstance(delivery, Batch):
            yield delivery


def _children_s() -> float:
    times = os.times()
    return times.children_user + times.children_system
