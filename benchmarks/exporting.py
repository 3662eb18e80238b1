"""Export: rows, messages and bytes per second for each format, and what memory it takes."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import ExportReport, View
from amberbox.blackbox.query.record import LocalRecord
from amberbox.blackbox.store.journal_reader import journals
from amberbox.blackbox.store.segment_builder import build_segments
from amberbox.blackbox.store.store import create_store
from benchmarks import mix
from benchmarks.common import Row, cpu_s

SECONDS = 60
FILES = 4
FORMS = {"csv": "", "parquet": "", "mcap": ".mcap", "mcap-json": ".mcap", "bag": ".bag"}


def measure() -> list[Row]:
    """Export four minutes of the mix in every format, then measure the peers."""
    with tempfile.TemporaryDirectory() as folder:
        made = mix.make(SECONDS)
        _record(Path(folder) / "store", made)
        peers = _peers(Path(folder), made)
        rows = [row for form in FORMS for row in _form(Path(folder), form, peers.get(form))]
        return [*rows, *_memory(Path(folder))]


def _record(store: Path, made: mix.Mix) -> None:
    """Write the mix file after file, as one robot would, and build segments."""
    opened = create_store(store)
    options = JournalOptions(opened.folder("main"), opened.id, "main", 1, "bench000")
    writer = JournalWriter(options)
    channels = [
        writer.channel(topic, {"item": f"item{n}", "source": "bench"})
        for n, topic in enumerate(made.topics)
    ]
    numbers, times = np.array([channels[n] for n in made.numbers]), np.array(made.times_ns)
    for number in range(FILES):
        shifted = times + number * SECONDS * 10**9
        for start in range(0, len(times), 400):
            part = slice(start, start + 400)
            writer.write(numbers[part], shifted[part], shifted[part], made.messages[part])
        writer.rotate()
    writer.close()
    for journal in journals(store):
        build_segments(store, journal)


def _form(folder: Path, form: str, peer: tuple[str, float] | None) -> Iterator[Row]:
    targets = (folder / f"{form}{number}{FORMS[form]}" for number in range(100))
    reports: list[ExportReport] = []

    def work() -> None:
        reports.append(export(LocalRecord(folder / "store"), View(), next(targets), form))

    seconds = cpu_s(work, 3)
    unit = "messages" if form in ("mcap", "bag") else "rows"
    rate = reports[0].total / seconds
    name, ratio = (peer[0], rate / peer[1]) if peer else ("", None)
    note = "the peer only writes, from memory" if peer else ""
    yield Row(f"export to {form}", rate, f"{unit}/s CPU", name, ratio, note)
    yield Row(f"export to {form}: bytes written", reports[0].bytes / 1e6 / seconds, "MB/s CPU")


def _peers(folder: Path, made: mix.Mix) -> dict[str, tuple[str, float]]:
    """Return, for each format that has one, a peer's writer and its messages per second."""
    targets = (folder / f"peer{number}" for number in range(100))
    found = {}
    for form, name, work in (("mcap", "mcap", _with_mcap), ("bag", "rosbags", _with_rosbags)):
        seconds = cpu_s(partial(_next, work, targets, made), 3)
        found[form] = (name, len(made.messages) / seconds)
    return found


def _next(work: Callable[[Path, mix.Mix], None], targets: Iterator[Path], made: mix.Mix) -> None:
    work(next(targets), made)


def _with_mcap(path: Path, made: mix.Mix) -> None:
    from mcap.writer import CompressionType, Writer

    writer = Writer(str(path), compression=CompressionType.ZSTD)
    writer.start("ros1")
    channels = []
    for topic in made.topics:
        assert topic.schema is not None
        schema = writer.register_schema(topic.schema.name, "ros1msg", topic.schema.data)
        channels.append(writer.register_channel(topic.name, "ros1", schema))
    for number, at_ns, data in zip(made.numbers, made.times_ns, made.messages, strict=True):
        writer.add_message(channels[number], at_ns, data, at_ns)
    writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it so


def _with_rosbags(path: Path, made: mix.Mix) -> None:
    from rosbags.rosbag1 import Writer

    with Writer(path) as writer:
        connections = [
            writer.add_connection(topic.name, name, typestore=mix.store())
            for topic, name in zip(made.topics, mix.RATES_HZ, strict=True)
        ]
        for number, at_ns, data in zip(made.numbers, made.times_ns, made.messages, strict=True):
            writer.write(connections[number], at_ns, data)


_CHILD = """
import sys
from pathlib import Path
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import View
from amberbox.blackbox.query.record import LocalRecord
start = (1_700_000_000 * 10**9, 1_700_000_000 * 10**9 + int(sys.argv[4]) * 10**9)
export(LocalRecord(Path(sys.argv[1])), View(windows=[start]), Path(sys.argv[2]), sys.argv[3])
peak = next(l for l in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in l)
print(int(peak.split()[1]) / 1000)
"""


def _memory(folder: Path) -> Iterator[Row]:
    """Compare the peak memory of exporting one file and all of them."""
    for form in ("mcap", "mcap-json", "csv"):
        run = partial(_peak_mb, folder, form)
        one, all_ = run(SECONDS), run(SECONDS * FILES)
        name = f"memory to export {FILES} min to {form}"
        yield Row(name, all_, "MB", "1 min", one / all_, "peak, Python and libraries included")


def _peak_mb(folder: Path, form: str, seconds: int) -> float:
    target = folder / f"memory-{form}-{seconds}{FORMS[form]}"
    command = [sys.executable, "-c", _CHILD, str(folder / "store"), str(target), form, str(seconds)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return float(done.stdout)
