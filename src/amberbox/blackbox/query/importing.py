"""Import recordings: the same pipeline as live data, on the recording's own time.

An import that is broken off leaves nothing in the store but a folder that the next one removes.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from amberbox.blackbox.formats import csv, mongodump
from amberbox.blackbox.formats._open import find_dump, open_recording
from amberbox.blackbox.formats._recording import (
    PieceCounts,
    RecordedGap,
    RecordingDamage,
    RecordingReader,
    RecordingReport,
    TopicOrigin,
)
from amberbox.blackbox.formats._recording import ReadOptions as ReadOptions
from amberbox.blackbox.journal import channels
from amberbox.blackbox.query.rows import query_tables
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.recorder.pipeline import MessageClock, Pipeline, PipelineOptions
from amberbox.blackbox.recorder.supervisor import BlockSink
from amberbox.blackbox.retention.maintenance import seal
from amberbox.blackbox.store import journal_reader, manifest
from amberbox.blackbox.store.catalogue import StoreCatalogue, query_catalogue
from amberbox.blackbox.store.journal_reader import JournalFile
from amberbox.blackbox.store.segment_file import can_build
from amberbox.blackbox.store.store import FOLDERS, Store, WriterLock, create_store
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import sync_folder
from amberbox.core.names import identifier
from amberbox.core.source import TopicOptions
from amberbox.core.types import Topic

FOLDER = "importing"
# The event that an import is whole is in a file of the last one
_WRITERS = (*(writer for writer in FOLDERS if writer != "main"), "main")


@dataclass(frozen=True, slots=True)
class StagedStore(Store):
    """A store with new journals in a separate folder, but the names, locks and runs of
    the store.
    """

    def folder(self, writer: str) -> Path:
        """Return the folder of a writer's journal until the import is complete."""
        return self.path / FOLDER / FOLDERS[writer]

    def next_run(self) -> int:
        """Count one more run of the store."""
        return Store(self.path, self.id).next_run()


@contextmanager
def staged(store: Store) -> Iterator[StagedStore]:
    """Yield a store to write an import to; its journals are moved into the store on success."""
    remove_leftovers(store)
    stage = StagedStore(store.path, store.id)
    try:
        yield stage
        try:
            for writer in _WRITERS:
                files = stage.journal_files(writer)
                if files:
                    store.folder(writer).mkdir(exist_ok=True)
                for path in files:
                    path.rename(store.folder(writer) / path.name)
                if files:
                    sync_folder(store.folder(writer))
        except OSError as error:
            raise AmberboxError(
                f"the store {store.path} does not take what was imported: {error.strerror}",
                "see that its folders can be written, then import again",
            ) from error
    finally:
        shutil.rmtree(store.path / FOLDER, ignore_errors=True)


def remove_leftovers(store: Store) -> None:
    """Remove the files of a killed import; raises UsageError while another one is running."""
    lock = WriterLock(store, "main")
    try:
        shutil.rmtree(store.path / FOLDER, ignore_errors=True)
    finally:
        lock.release()


def imported_digests(store: Store) -> set[str]:
    """Return the digests of all recordings that were imported whole, by the store's own events.

    Raw journals may be gone by now; events are never deleted.
    """

    def imported(catalogue: StoreCatalogue) -> Table | None:
        item, columns = identifier(channels.EVENT), ["kind", "details"]
        if item not in catalogue.schemas:
            return None
        return query_tables(catalogue, item, columns, (None, None), "received", None)

    table = query_catalogue(store.path, imported, with_segments=can_build())
    if table is None:
        return set()
    rows = zip(table.values("kind"), table.values("details"), strict=True)
    found = [msgspec.json.decode(details) for kind, details in rows if kind == "imported"]
    return {str(details["sha256"]) for details in found if "sha256" in details}


def broken_imports(store: Store, whole: set[str]) -> dict[str, list[JournalFile]]:
    """Return the files of imports that were broken off, by the digests of their recordings."""
    broken: dict[str, list[JournalFile]] = {}
    for journal in journal_reader.journals(store.path):
        if journal.places:
            digest = str(journal_reader.run_messages(journal).get("input") or "")
            if digest and digest not in whole:
                broken.setdefault(digest, []).append(journal)
    return broken


def discard(store: Store, files: Sequence[JournalFile]) -> str:
    """Remove the files of an aborted import; return a text on the parts that stay."""
    lock = WriterLock(store, "main")  # it may just be under way
    in_segments = manifest.read(store.path).journals.keys()
    for journal in files:
        if journal.name not in in_segments:
            journal.path.unlink(missing_ok=True)
    lock.release()
    stays = sum(journal.rows for journal in files if journal.name in in_segments)
    return f"an earlier import was broken off, {stays} of its messages are twice" if stays else ""


TICK_BYTES = 1 << 20
MOST_NAMED = 5  # damaged places of one stretch of time that the reason of a gap names
_NO_OPTIONS = ReadOptions()
# Events of the pipeline that the report of an import repeats
_REPORTED_EVENTS = {
    "undecodable", "type_changed", "malformed", "schema_unstable", "filter_failed", "unused_names",
}  # fmt: skip

Progress = Callable[[float], None]


@dataclass
class ImportReport:
    """The result of an import of one input."""

    path: Path
    messages: int = 0
    items: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    damage: list[str] = field(default_factory=list)
    known: bool = False
    kinds: dict[str, str] = field(default_factory=dict)
    """Origin of the columns of each item, if its format leaves a choice."""
    accounts: list[str] = field(default_factory=list)
    """What became of every document, row or record of the input."""

    def lines(self) -> list[str]:
        """Write the report for a person."""
        if self.known:
            return [f"{self.path}: is in the store already, nothing was done"]
        counts = [f"  {item}: {self._described(item)}" for item in sorted(self.items)]
        accounts = [f"  {text}" for text in self.accounts]
        damage = [f"  damaged: {text}" for text in self.damage]
        notes = [f"  note: {text}" for text in self.notes]
        return [f"{self.path}: {self.messages} messages", *counts, *accounts, *damage, *notes]

    def _described(self, item: str) -> str:
        kind = self.kinds.get(item)
        return f"{self.items[item]}, {kind}" if kind else str(self.items[item])


def import_recordings(
    paths: Sequence[Path],
    store_path: Path,
    *,
    topics: Sequence[TopicOptions] = (),
    source: str | None = None,
    progress: Progress = lambda fraction: None,
    segments: bool = True,
    options: ReadOptions = _NO_OPTIONS,
) -> list[ImportReport]:
    """Import recordings into a store, one run each; a recording that is already in it is left out.

    Log times are the recording's own, stamps stay with the messages. Items are named as if they had
    been recorded live, or begin with ``source`` if that is given. Raises AmberboxError when an
    input cannot be read or the store not written; that input then leaves nothing behind.
    """
    digests = [digest_of(path) for path in paths]
    store = create_store(store_path)
    known = imported_digests(store)
    broken = broken_imports(store, known)
    reports = []
    for path, digest in zip(paths, digests, strict=True):
        if digest in known:
            reports.append(ImportReport(path, known=True))
            continue
        note = discard(store, broken.pop(digest)) if digest in broken else ""
        with open_recording(path, options) as recording, staged(store) as stage:
            reports.append(_Import(recording, stage, digest, topics, source).run(progress))
        reports[-1].notes += [note] if note else []
        known.add(digest)
    if segments:
        seal(store)
    return reports


class _Import:
    """One recording on its way into a store."""

    def __init__(
        self,
        recording: RecordingReader,
        store: Store,
        digest: str,
        topics: Sequence[TopicOptions],
        source: str | None,
    ) -> None:
        self._recording = recording
        self._digest = digest
        self._chosen = {option.name for option in topics}
        self._topics = list(topics)
        self._source = source
        self._sinks: dict[str, BlockSink] = {}
        self._reported: list[str] = []
        options = PipelineOptions(
            robot=recording.path.stem, boot_id=digest[:8], input=digest, queue_bytes=1 << 40,
            counts_silence=False,
        )  # fmt: skip
        clock = MessageClock(recording.report.start_ns or 0)
        self._pipeline = Pipeline(store, clock, options)
        self._pipeline.on_event = self._on_event

    def run(self, progress: Progress) -> ImportReport:
        """Copy everything, then write the findings, and last that the import is complete."""
        recording, pipeline = self._recording, self._pipeline
        try:
            self._copy(progress)
            for gap in [*self._recording.report.gaps, *_damaged(self._recording.report)]:
                self._pipeline.own(
                    channels.GAP,
                    {
                        "item": "", "peer": "", "from_ns": gap.from_ns, "to_ns": gap.to_ns,
                        "reason": gap.reason, "count": None,
                    },
                )  # fmt: skip
            for damage in recording.report.damage:
                pipeline.event("recording_damaged", str(damage), offset=damage.offset)
            name = recording.path.name
            pipeline.event("imported", f"{name} is imported whole", sha256=self._digest)
        finally:
            pipeline.close()
        return self._report()

    def _on_event(self, kind: str, text: str) -> None:
        if kind in _REPORTED_EVENTS and text not in self._reported:
            self._reported.append(text)

    def _copy(self, progress: Progress) -> None:
        streams: dict[int, tuple[BlockSink, int] | None] = {}
        report = self._recording.report
        start_ns, end_ns = report.start_ns or 0, report.end_ns or 0
        for index, log_ns, _, data in self._recording.messages():
            if index not in streams:
                streams[index] = self._stream(index)
            stream = streams[index]
            if stream is None:
                continue
            stream[0].message(stream[1], data, log_ns)
            if self._pipeline.queue.size_bytes >= TICK_BYTES:
                self._tick()
                progress((log_ns - start_ns) / max(end_ns - start_ns, 1))
        self._tick()
        progress(1.0)

    def _stream(self, index: int) -> tuple[BlockSink, int] | None:
        topic, origin = self._recording.topics[index], self._recording.origins[index]
        if not self._wants(topic):
            return None
        sink = self._sink(origin)
        return sink, sink.topic(topic)

    def _wants(self, topic: Topic) -> bool:
        return not self._chosen or topic.name in self._chosen

    def _sink(self, origin: TopicOrigin) -> BlockSink:
        """Return the sink of a source; topics keep the recording's stamps unless configured."""
        source = origin.source if self._source is None else self._source
        if source not in self._sinks:
            stamped = [
                TopicOptions(topic.name, stamp=other.stamp)
                for topic, other in zip(
                    self._recording.topics, self._recording.origins, strict=True
                )
                if other.stamp is not None and topic.name not in self._chosen
            ]
            options = [*self._topics, *stamped]
            self._sinks[source] = BlockSink(self._pipeline, source, options, lossless=True)
        return self._sinks[source]

    def _tick(self) -> None:
        self._pipeline.tick()
        if self._pipeline.disk_error:
            raise AmberboxError(
                f"the store {self._pipeline.store.path} does not take data: "
                f"{self._pipeline.disk_error}",
                "make room or choose another store, then import again",
            )

    def _report(self) -> ImportReport:
        found = self._recording.report
        items = {name: item.counters.kept for name, item in self._pipeline.items.items()}
        topics = self._recording.topics
        missing = sorted(self._chosen - {topic.name for topic in topics})
        absent = [f"there is no topic {name} in it" for name in missing]
        notes = [*found.notes, *self._reported, *absent]
        damage = [str(damage) for damage in found.damage]
        path, messages = self._recording.path, sum(items.values())
        left_out = {index for index, topic in enumerate(topics) if not self._wants(topic)}
        accounts = [text for a in found.accounts for text in account_lines(a, found, left_out)]
        return ImportReport(
            path, messages, items, notes, damage, kinds=self._kinds(), accounts=accounts
        )

    def _kinds(self) -> dict[str, str]:
        pairs = zip(self._recording.topics, self._recording.origins, strict=True)
        kinds = {
            (origin.source if self._source is None else self._source, topic.name): origin.kind
            for topic, origin in pairs
        }
        named = ((i.name, kinds.get((i.source, i.topic))) for i in self._pipeline.items.values())
        return {name: kind for name, kind in named if kind}


def _damaged(report: RecordingReport) -> Iterator[RecordedGap]:
    """Yield when something may be missing because the recording is damaged."""
    whole = report.start_ns or 0, report.end_ns or 0
    found: dict[tuple[int, int], list[RecordingDamage]] = {}
    for damage in report.damage:
        found.setdefault(damage.span_ns or whole, []).append(damage)
    for (from_ns, to_ns), damages in found.items():
        reason = "; ".join(map(str, damages[:MOST_NAMED]))
        more = f"; and {len(damages) - MOST_NAMED} more" if len(damages) > MOST_NAMED else ""
        yield RecordedGap(from_ns, to_ns + 1, f"damaged: {reason}{more}")


def account_lines(account: PieceCounts, report: RecordingReport, left_out: set[int]) -> list[str]:
    """Return lines on the result of every piece of a file, and on the lost rest.

    ``left_out`` are the topics excluded from the import.
    """
    given = {index: report.per_topic[index] for index in account.topics}
    messages = sum(count for index, count in given.items() if index not in left_out)
    parts = [f"{messages} messages"]
    if other := sum(given.values()) - messages:
        parts.append(f"{other} of topics left out")
    refused = account.refused.total()
    reasons = ", ".join(f"{count} {reason}" for reason, count in account.refused.items())
    parts.append(f"{refused} refused" + (f" ({reasons})" if reasons else ""))
    if rest := account.total - sum(given.values()) - refused:
        parts.append(f"{rest} lost")
    return [f"{account.name}: {account.total} {account.pieces} = {' + '.join(parts)}"]


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a recording: of the file, or of a folder's files with their names.

    Of a mongodump folder only the collections count, and the name of a table counts, for it
    names the item.
    """
    if not path.exists():
        raise UsageError(f"there is no recording at {path}", "check the path")
    folder, files = _files(path)
    total = hashlib.sha256()
    for file in files:
        if folder is not None:
            total.update(file.relative_to(folder).as_posix().encode() + b"\0")
        elif path.suffix.lower() in csv.SUFFIXES:
            total.update(path.name.encode() + b"\0")
        with file.open("rb") as opened:
            total.update(hashlib.file_digest(opened, "sha256").digest())
    return total.hexdigest()


def _files(path: Path) -> tuple[Path | None, list[Path]]:
    """Return the base folder of a recording's names (None for one file), and its files."""
    if not path.is_dir():
        return None, [path]
    dump = find_dump(path)
    if dump is not None:
        return dump, sorted(mongodump.collections(dump).values())
    return path, sorted(p for p in path.rglob("*") if p.is_file())
