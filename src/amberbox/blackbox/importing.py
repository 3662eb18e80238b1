"""Import recordings: the same pipeline as live data, on the recording's own time."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from amberbox.blackbox.follow import read
from amberbox.blackbox.follow.read import JournalFile
from amberbox.blackbox.formats.open import open_recording
from amberbox.blackbox.formats.recording import Recording
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.keeper import seal
from amberbox.blackbox.recorder.messageclock import MessageClock
from amberbox.blackbox.recorder.pipeline import Pipeline, PipelineOptions
from amberbox.blackbox.recorder.sink import BlockSink
from amberbox.blackbox.segments import manifest
from amberbox.blackbox.store import Store, WriterLock, create_store
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.source import TopicOptions

TICK_BYTES = 1 << 20
SOURCE = "ros"
"""Source name of imported items: the same item names as if the robot had been recorded live."""

Progress = Callable[[float], None]


@dataclass
class ImportReport:
    """What an import did with one input."""

    path: Path
    messages: int = 0
    items: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    damage: list[str] = field(default_factory=list)
    known: bool = False

    def lines(self) -> list[str]:
        """Write the report for a person."""
        if self.known:
            return [f"{self.path}: is in the store already, nothing was done"]
        counts = [f"  {item}: {count}" for item, count in sorted(self.items.items())]
        damage = [f"  damaged: {text}" for text in self.damage]
        notes = [f"  note: {text}" for text in self.notes]
        return [f"{self.path}: {self.messages} messages", *counts, *damage, *notes]


def import_recordings(
    paths: Sequence[Path],
    store_path: Path,
    *,
    topics: Sequence[TopicOptions] = (),
    source: str = SOURCE,
    progress: Progress = lambda fraction: None,
    segments: bool = True,
) -> list[ImportReport]:
    """Import recordings into a store, one run each; one that is there already is left out.

    Log times are the recording's own, stamps stay with the messages. Raises AmberboxError when
    an input cannot be read or the store not written.
    """
    store = create_store(store_path)
    known, broken = _inputs(store)
    reports = []
    for path in paths:
        digest = digest_of(path)
        if digest in known:
            reports.append(ImportReport(path, known=True))
            continue
        note = _discard(store, broken.pop(digest)) if digest in broken else ""
        reports.append(_import(path, store, digest, topics, source, progress))
        reports[-1].notes += [note] if note else []
        known.add(digest)
    if segments:
        seal(store)
    return reports


def _import(
    path: Path,
    store: Store,
    digest: str,
    topics: Sequence[TopicOptions],
    source: str,
    progress: Progress,
) -> ImportReport:
    with open_recording(path) as recording:
        return _copy_all(recording, path, store, digest, topics, source, progress)


def _copy_all(
    recording: Recording,
    path: Path,
    store: Store,
    digest: str,
    topics: Sequence[TopicOptions],
    source: str,
    progress: Progress,
) -> ImportReport:
    clock = MessageClock(recording.report.start_ns or 0)
    options = PipelineOptions(
        robot=path.stem, boot_id=digest[:8], input=digest, queue_bytes=1 << 40, counts_silence=False
    )
    pipeline = Pipeline(store, clock, options)
    sink = BlockSink(pipeline, source, topics, lossless=True)
    chosen = {option.name for option in topics}
    try:
        _copy(recording, pipeline, sink, chosen, progress)
        for damage in recording.report.damage:
            pipeline.event("recording_damaged", str(damage), source, offset=damage.offset)
        pipeline.event("imported", f"{path.name} is imported whole", source, sha256=digest)
    finally:
        pipeline.close()
    items = {name: item.counters.kept for name, item in pipeline.items.items()}
    report = recording.report
    return ImportReport(
        path, sum(items.values()), items, list(report.notes), [str(d) for d in report.damage]
    )


def _copy(
    recording: Recording,
    pipeline: Pipeline,
    sink: BlockSink,
    chosen: set[str],
    progress: Progress,
) -> None:
    streams: dict[int, int] = {}
    start_ns, end_ns = recording.report.start_ns or 0, recording.report.end_ns or 0
    for index, log_ns, _, data in recording.messages():
        if index not in streams:
            topic = recording.topics[index]
            streams[index] = sink.topic(topic) if not chosen or topic.name in chosen else -1
        if streams[index] < 0:
            continue
        sink.message(streams[index], data, log_ns)
        if pipeline.intake.size_bytes >= TICK_BYTES:
            _tick(pipeline)
            progress((log_ns - start_ns) / max(end_ns - start_ns, 1))
    _tick(pipeline)
    progress(1.0)


def _tick(pipeline: Pipeline) -> None:
    pipeline.tick()
    if pipeline.disk_error:
        raise AmberboxError(
            f"the store {pipeline.store.path} does not take data: {pipeline.disk_error}",
            "make room or choose another store, then import again",
        )


def digest_of(path: Path) -> str:
    """SHA-256 of a recording: of the file, or of all files of a folder with their names."""
    if not path.exists():
        raise UsageError(f"there is no recording at {path}", "check the path")
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    total = hashlib.sha256()
    for file in files:
        if path.is_dir():
            total.update(file.relative_to(path).as_posix().encode() + b"\0")
        with file.open("rb") as opened:
            total.update(hashlib.file_digest(opened, "sha256").digest())
    return total.hexdigest()


def _inputs(store: Store) -> tuple[set[str], dict[str, list[JournalFile]]]:
    """Return digests of what was imported whole, and the files of imports that were broken off."""
    runs: dict[int, list[JournalFile]] = {}
    for journal in read.journals(store.path):
        if journal.writer == "main" and journal.places:
            runs.setdefault(journal.run, []).append(journal)
    whole: set[str] = set()
    broken: dict[str, list[JournalFile]] = {}
    for files in runs.values():
        digest = str(read.run_messages(files[0]).get("input") or "")
        if digest and _ends_with_import(files[-1]):
            whole.add(digest)
        elif digest:
            broken.setdefault(digest, []).extend(files)
    return whole, broken


def _ends_with_import(journal: JournalFile) -> bool:
    """Tell whether the last records of a file say that its recording was imported whole."""
    numbers = [n for n, stream in journal.streams.items() if stream.topic.name == reserved.EVENT]
    for chunk in read.sound_chunks(journal, lambda place: place in journal.places[-2:]):
        rows = np.flatnonzero(np.isin(chunk.channel, numbers))
        kinds = [msgspec.json.decode(message)["kind"] for message in chunk.messages(rows)]
        if "imported" in kinds:
            return True
    return False


def _discard(store: Store, files: Sequence[JournalFile]) -> str:
    """Remove what an import that was broken off has left; return what stays of it."""
    lock = WriterLock(store, "main")  # it may just be under way
    in_segments = manifest.read(store.path).journals.keys()
    for journal in files:
        if journal.name not in in_segments:
            journal.path.unlink(missing_ok=True)
    lock.release()
    stays = sum(journal.rows for journal in files if journal.name in in_segments)
    return f"an earlier import was broken off, {stays} of its messages are twice" if stays else ""
