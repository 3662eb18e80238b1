"""How much the box writes: bytes per day of recording, by the newest files of its store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amberbox.blackbox.follow.read import JournalFile, journal_file
from amberbox.blackbox.segments import manifest
from amberbox.blackbox.store import Store
from amberbox.core.clock import NS

DAY_S = 86_400
_NEWEST = 10
_ENOUGH_S = 10.0


@dataclass(frozen=True, slots=True)
class Traffic:
    """Bytes per day of recording; ``writers`` are the journals in use."""

    journal_bytes: float
    segment_bytes: float
    writers: int
    seconds: float

    @property
    def kept_bytes(self) -> float:
        """What a day leaves in the store."""
        return self.journal_bytes + self.segment_bytes

    def syncs(self, sync_s: float) -> float:
        """How often a day's journals are made durable."""
        return self.writers * DAY_S / sync_s


def traffic(store: Store) -> Traffic | None:
    """Measure the newest files; None if they hold less than ten seconds."""
    writers = {writer: _newest(store, writer) for writer in store.writers()}
    times = {writer: _seconds(files) for writer, files in writers.items()}
    known = {writer: files for writer, files in writers.items() if times[writer] >= _ENOUGH_S}
    if not known:
        return None
    journals = sum(sum(f.bytes for f in files) / times[w] for w, files in known.items())
    return Traffic(journals * DAY_S, _segment_rate(store) * DAY_S, len(known), max(times.values()))


def _newest(store: Store, writer: str) -> list[JournalFile]:
    files = []
    for path in store.journal_files(writer)[-_NEWEST:]:
        try:
            files.append(journal_file(path))
        except FileNotFoundError:  # the keeper has just deleted it
            continue
    return [file for file in files if file.rows]


def _seconds(files: Sequence[JournalFile]) -> float:
    return sum(file.end_ns - file.start_ns for file in files) / NS


def _segment_rate(store: Store) -> float:
    """Bytes of segments per second of the journals that they were made from."""
    known = manifest.read(store.path)
    seconds = sum(j.end_ns - j.start_ns for j in known.journals.values()) / NS
    size = sum(segment.bytes for found in known.segments.values() for segment in found)
    return size / seconds if seconds > 0 else 0.0
