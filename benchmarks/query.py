"""Segments and queries: bytes per row, messages per second to Parquet, time to one variable."""

from __future__ import annotations

import itertools
import statistics
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.query.record import LocalRecord
from amberbox.blackbox.store.journal_reader import JournalFile, journals
from amberbox.blackbox.store.segment_builder import build_segments
from amberbox.blackbox.store.store import WriterLock, create_store, open_store
from amberbox.core.clock import NS
from amberbox.core.types import Schema, Topic
from benchmarks import mix
from benchmarks.common import Row, cpu_s, meanwhile, wall_s

START_NS = 1_790_000_000 * NS
PERIOD_NS = NS // 100
FILE_ROWS = 60_000
HOURS = 8
RECORDINGS = Path(__file__).resolve().parents[2] / "shared" / "data" / "recordings"
REAL = (
    "plotjuggler_tilt_laser.bag",
    "imu_ardrone.bag",
    "plotjuggler_fake_joint_state.bag",
    "plotjuggler_rosbag2_test",
    "rosbagjs_example.bag",
)


def measure() -> list[Row]:
    """Measure the set of 50 columns, the mix of messages, and the real recordings."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        rows += _fifty_columns(Path(folder) / "fifty")
    with tempfile.TemporaryDirectory() as folder:
        rows += _mix_to_parquet(Path(folder))
    return rows + list(_real_recordings())


def fifty_columns(seed: int = 1) -> NDArray[Any]:
    """Make ten minutes of 50 columns at 100 Hz as ROS 1 messages of one layout.

    10 random walks, 10 with three decimals, 6 of float32 precision, 5 encoders, 8 slow ints,
    6 constants, 2 strings, 2 bools, and the number of the row.
    """
    random, count = np.random.default_rng(seed), FILE_ROWS
    walks = np.cumsum(random.normal(0, 0.01, (count, 26)), axis=0)
    columns: dict[str, tuple[str, NDArray[Any]]] = {}
    for n in range(10):
        columns[f"walk{n}"] = "<f8", walks[:, n]
        columns[f"decimal{n}"] = "<f8", walks[:, 10 + n].round(3)
    for n in range(6):
        columns[f"single{n}"] = "<f8", walks[:, 20 + n].astype(np.float32).astype(np.float64)
        columns[f"constant{n}"] = "<f8", np.full(count, n / 2)
    for n in range(5):
        columns[f"encoder{n}"] = "<i4", np.cumsum(random.integers(0, 40, count))
    for n in range(8):
        columns[f"slow{n}"] = "<i4", np.cumsum(random.random(count) < 0.001)
    columns["row"] = "<i8", np.arange(count)
    for n in range(2):
        words = np.array([b"\4\0\0\0map_", b"\4\0\0\0odom"])
        columns[f"text{n}"] = "S8", words[np.arange(count) // 5000 % 2]
        columns[f"flag{n}"] = "u1", random.random(count) < 0.01
    messages = np.zeros(count, [(name, kind) for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        messages[name] = values
    return messages


def definition(messages: NDArray[Any]) -> str:
    """Write the ROS definition of the messages."""
    types = {"<f8": "float64", "<i4": "int32", "<i8": "int64", "|S8": "string", "|u1": "bool"}
    names = messages.dtype.names or ()
    return "\n".join(f"{types[messages.dtype[name].str]} {name}" for name in names)


def _writer(store: Path, run: int = 1) -> JournalWriter:
    made = create_store(store)
    return JournalWriter(JournalOptions(made.folder("main"), made.id, "main", run, "bench000"))


def _topic(messages: NDArray[Any]) -> Topic:
    return Topic("/fifty", "ros1", Schema("bench/Fifty", "ros1msg", definition(messages).encode()))


def _write_hours(store: Path, messages: NDArray[Any]) -> None:
    writer = _writer(store)
    channel = writer.channel(_topic(messages), {"item": "fifty", "source": "bench"})
    size, raw = messages.dtype.itemsize, messages.tobytes()
    rows = [raw[at : at + size] for at in range(0, len(raw), size)]
    for number in range(HOURS * 6):
        times = START_NS + (number * FILE_ROWS + np.arange(FILE_ROWS)) * PERIOD_NS
        for start in range(0, FILE_ROWS, 1000):
            part = slice(start, start + 1000)
            writer.write(np.full(1000, channel), times[part], times[part], rows[part])
        writer.rotate()
    writer.close()


def _fifty_columns(store: Path) -> Iterator[Row]:
    messages = fifty_columns()
    _write_hours(store, messages)
    found = journals(store)
    built = [0]

    def build_next() -> None:
        build_segments(store, found[built[0]])
        built[0] += 1

    seconds = cpu_s(build_next, 3)
    yield Row("journal of 50 columns to Parquet", FILE_ROWS / seconds, "rows/s CPU")
    while built[0] < len(found):
        build_next()
    yield from _sizes(store, "50 columns", "to be <= 0.7")
    with _recording(store, messages):
        yield from _query_times(store)


@contextmanager
def _recording(store: Path, messages: NDArray[Any]) -> Iterator[None]:
    """Go on at 100 Hz in another run until the block is left: a store is asked while it grows."""
    lock = WriterLock(open_store(store), "main")
    writer = _writer(store, run=2)
    channel = writer.channel(_topic(messages), {"item": "fifty", "source": "bench"})
    size, raw = messages.dtype.itemsize, messages.tobytes()

    starts = itertools.count(0, 10)

    def write() -> None:
        row = next(starts)
        rows = [raw[n * size : (n + 1) * size] for n in range(row, row + 10)]
        times = START_NS + HOURS * 3600 * NS + (row + np.arange(10)) * PERIOD_NS
        writer.write(np.full(10, channel), times, times, rows)

    try:
        with meanwhile(write, 0.1):
            yield
    finally:
        writer.close()
        lock.release()


def _query_times(store: Path) -> Iterator[Row]:
    record = LocalRecord(store)
    from_ns = START_NS + 13_000 * NS + 777

    def ask() -> None:
        table = record.query("fifty", ["walk3"], from_ns, from_ns + 600 * NS)
        assert len(table) == FILE_ROWS

    name = f"10 minutes of one variable out of {HOURS} h at 100 Hz x 50 columns"
    warm = wall_s(ask, 9)
    yield Row(f"{name}, segments", 1e3 * warm, "ms", note="warm, while recording; to be <= 20")
    every = wall_s(lambda: record.query("fifty", ["walk3"], points=2000), 3)
    yield Row(f"{HOURS} h of one variable thinned to 2000 points, segments", 1e3 * every, "ms")
    (store / "manifest").unlink()
    raw = wall_s(ask, 3)
    yield Row(f"{name}, journals", 1e3 * raw, "ms", "segments", warm / raw, "no pyarrow needed")


def _sizes(store: Path, name: str, note: str) -> Iterator[Row]:
    ours, plain, rows = _bytes(store)
    yield Row(f"{name} in segments", ours / rows, "B/row")
    yield Row(f"{name}: bytes against plain zstd Parquet", ours / plain, "", note=note)


def _bytes(store: Path) -> tuple[int, int, int]:
    """Return bytes in segments, bytes of the same tables as plain zstd Parquet, and rows."""
    import pyarrow.parquet as pq

    ours = plain = rows = 0
    for path in sorted((store / "segments").glob("*/*.parquet"))[:60]:
        if path.parent.name.startswith("amberbox_"):
            continue
        table = pq.read_table(path).replace_schema_metadata(None)
        copy = store / "plain.parquet"
        pq.write_table(table, copy, compression="zstd")
        ours, plain = ours + path.stat().st_size, plain + copy.stat().st_size
        rows += table.num_rows
        copy.unlink()
    return ours, plain, rows


def _mix_to_parquet(folder: Path) -> Iterator[Row]:
    """Write and build the mix, in chunks as they come at full speed and as a robot makes them."""
    made = mix.make(100)
    count = len(made.messages)
    stores = (folder / str(number) for number in range(100))
    for tick_ns, name, note in (
        (10 * NS, "bytes to journal and Parquet, mix", "4,210 messages a chunk; to be >= 100,000"),
        (NS // 10, "the same in the chunks of a robot", "42 messages a chunk (write_s 0.1)"),
    ):
        work = partial(_record_and_build, made, tick_ns, stores)
        yield Row(name, count / cpu_s(work, 3), "messages/s CPU", note=note)


def _record_and_build(made: mix.Mix, tick_ns: int, stores: Iterator[Path]) -> None:
    store = next(stores)
    writer = _writer(store)
    channels = [
        writer.channel(topic, {"item": f"item{n}", "source": "bench"})
        for n, topic in enumerate(made.topics)
    ]
    numbers = np.array([channels[number] for number in made.numbers])
    times = np.array(made.times_ns)
    cuts = np.flatnonzero(np.diff(times // tick_ns)) + 1
    for start, stop in zip([0, *cuts], [*cuts, len(times)], strict=True):
        part = slice(start, stop)
        writer.write(numbers[part], times[part], times[part], made.messages[part])
    writer.close()
    (journal,) = journals(store)
    build_segments(store, journal)


def _real_recordings() -> Iterator[Row]:
    from amberbox.blackbox.query.importing import import_recordings

    shares = []
    for name in REAL if RECORDINGS.is_dir() else ():
        with tempfile.TemporaryDirectory() as folder:
            store = Path(folder) / "store"
            import_recordings([RECORDINGS / name], store)
            for journal in _finished(store):
                build_segments(store, journal)
            ours, plain, _ = _bytes(store)
            shares.append(ours / plain)
            yield Row(f"{name}: bytes against plain zstd Parquet", ours / plain, "")
    if shares:
        yield Row("real recordings: bytes against plain zstd Parquet", statistics.median(shares),
                  "", note="median; to be <= 0.85")  # fmt: skip


def _finished(store: Path) -> list[JournalFile]:
    return [journal for journal in journals(store) if journal.finished]
