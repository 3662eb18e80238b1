"""Journals made beforehand: written, chained, sealed and signed as a robot's are.

All simulated robots upload the same ones, each as its own: to the server they are different files.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.chunk import sequences
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.signing.keys import public_key
from amberbox.blackbox.store.derived_journal import DerivedStreams, EncodedRecord
from amberbox.blackbox.store.journal_reader import JournalFile, journals, sound_chunks
from amberbox.blackbox.store.store import Store, create_store
from amberbox.core.clock import NS
from amberbox.core.types import Schema, Topic
from amberbox.link.frames import LinkRow
from amberbox.link.uploads import Proof, proofs_of
from benchmarks.query import definition, fifty_columns

BOOT = "10adbe9c-0000-4000-8000-000000000001"
COMPONENTS = 20
CHANGING = 5
"""Components whose outputs change with each status; the others say the same every second."""
DATA_HZ = 44
"""Messages of 50 columns a second: about 1 MB a minute in the journal."""
_TURN = 5
"""Statuses that are written at a time, four times a second."""


@dataclass(frozen=True, slots=True)
class Sealed:
    """A journal that can be copied from ``after_s`` seconds on, and what proves it."""

    name: str
    path: Path
    after_s: float
    proof: Proof


@dataclass(frozen=True, slots=True)
class Recording:
    """What each robot has: rows in order, five each quarter of a second, and its journals."""

    store: Store
    public_key: str
    rows: Sequence[LinkRow]
    sealed: Sequence[Sealed]
    end_seq: int
    start_ns: int

    @property
    def bytes(self) -> int:
        """Size of all journals."""
        return sum(one.path.stat().st_size for one in self.sealed)


def make_recording(
    path: Path, seconds: float, file_s: float, start_ns: int, *, hz: int = DATA_HZ
) -> Recording:
    """Write the journals of a robot that begins at ``start_ns``, a file each ``file_s``."""
    store = create_store(path)
    files = max(round(seconds / file_s), 1)
    _write_statuses(store, files, file_s, start_ns)
    if hz:
        _write_data(store, files, file_s, start_ns, hz)
    seal(store)
    rows = [row for one in journals(path) if one.writer == "watch" for row in _rows(one)]
    return Recording(store, public_key(path) or "", rows, sealed(store, file_s),
                     rows[-1].seq + 1, start_ns)  # fmt: skip


def seal(store: Store) -> None:
    """Have the keeper seal and sign what was written."""
    keeper = RetentionService(store, RetentionOptions(robot="r0", quota_percent=100.0, min_free=0))
    keeper._with_segments = False  # columns are made by the server here, not by the robot
    keeper.step(threading.Event())
    keeper.close()


def sealed(store: Store, file_s: float) -> list[Sealed]:
    """Name the journals that were sealed, in the order in which they are copied."""
    names = [
        f"{path.parent.name}/{path.name}"
        for writer in ("main", "watch")
        for path in store.journal_files(writer)
    ]
    proofs = proofs_of(store.path, names)
    found = [
        Sealed(name, store.journal_path(name), (_number(name) + 1) * file_s, proofs[name])
        for name in names
    ]
    return sorted(found, key=lambda one: one.after_s)


def _number(name: str) -> int:
    return int(name.removesuffix(".mcap").rpartition("-")[2])


def _writer(store: Store, writer: str, **more: Any) -> JournalWriter:
    options = JournalOptions(store.folder(writer), store.id, writer, 1, BOOT, **more)
    return JournalWriter(options)


def _write_statuses(store: Store, files: int, file_s: float, start_ns: int) -> None:
    writer, streams, turns = _writer(store, "watch"), DerivedStreams(), round(file_s * 4)
    for turn in range(files * turns):
        at_ns = start_ns + turn * NS // 4
        if turn % turns == 0:
            writer.rotate()
        messages = [EncodedRecord(channels.CLOCK, _clock(at_ns, start_ns))]
        messages += [_status(turn * _TURN + n, at_ns) for n in range(_TURN)]
        placed = [streams.placed(writer, message) for message in messages]
        times = [at_ns] * len(placed)
        writer.write([c for c, _ in placed], times, times, [data for _, data in placed])
        if turn % 4 == 3:
            writer.mark_sync()
    writer.close()


def _clock(at_ns: int, start_ns: int) -> bytes:
    values = {"offset_ns": 0, "synchronised": True, "boot_ns": at_ns - start_ns + 60 * NS}
    return msgspec.json.encode(values)


def _status(number: int, at_ns: int) -> EncodedRecord:
    """Compose the status of a component; its ``number`` is known by the sender."""
    component = number % COMPONENTS
    value = number if component < CHANGING else component
    outputs = [{"name": "number", "type": "int", "value": value, "text": None},
               {"name": "working", "type": "bool", "value": 1, "text": None},
               {"name": "volts", "type": "float", "value": 24.5, "text": None}]  # fmt: skip
    values = {"robot": "r0", "component": f"part.c{component}", "mode": "monitoring",
              "level": "ok", "state": "nominal", "outputs": outputs, "blocked_by": [],
              "measured_ns": at_ns, "since_ns": at_ns - at_ns % (600 * NS), "reason": "",
              "config_hash": "", "live_only": False}  # fmt: skip
    return EncodedRecord(channels.STATUS, msgspec.json.encode(values))


def _write_data(store: Store, files: int, file_s: float, start_ns: int, hz: int) -> None:
    writer, messages = _writer(store, "main"), fifty_columns()
    about = Schema("bench/Fifty", "ros1msg", definition(messages).encode())
    channel = writer.channel(Topic("/fifty", "ros1", about), {"item": "fifty", "source": "bench"})
    size, raw = messages.dtype.itemsize, messages.tobytes()
    every, seconds = len(messages), round(file_s)
    for second in range(files * seconds):
        if second % seconds == 0:
            writer.rotate()
        first = second * hz
        rows = [raw[n % every * size : (n % every + 1) * size] for n in range(first, first + hz)]
        times = start_ns + (first + np.arange(hz)) * (NS // hz)
        writer.write(np.full(hz, channel), times, times, rows)
        writer.mark_sync()
    writer.close()


def make_large(path: Path, files: int, megabytes: int, start_ns: int) -> Recording:
    """Write journals of pictures, which compression does not make smaller."""
    store, noise = create_store(path), np.random.default_rng(3).bytes(1 << 20)
    writer = _writer(store, "main", rotate_bytes=1 << 40)
    channel = writer.channel(Topic("/picture", "raw", None), {"item": "p", "source": "bench"})
    for file in range(files):
        writer.rotate()
        for n in range(megabytes):
            at = [start_ns + (file * megabytes + n) * NS]
            writer.write([channel], at, at, [n.to_bytes(8, "little") + noise])
            if n % 16 == 15:
                writer.mark_sync().wait()
    writer.close()
    seal(store)
    return Recording(store, public_key(path) or "", [], sealed(store, 1.0), 0, start_ns)


def _rows(journal: JournalFile) -> Iterator[LinkRow]:
    """Give the statuses of a journal as they go over the link."""
    for chunk in sound_chunks(journal):
        numbers = sequences(chunk, journal.first_seq).tolist()
        messages = chunk.messages(np.arange(len(chunk)))
        for row, seq in enumerate(numbers):
            topic = journal.streams[int(chunk.channel[row])].topic.name
            if topic == channels.STATUS:
                at_ns = int(chunk.log_ns[row])
                yield LinkRow(journal.writer, journal.run, seq, topic, at_ns, messages[row])
