"""Import recordings: the same pipeline as live data, on the recording's own time."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.blackbox.formats import csv_table, mongodump
from amberbox.blackbox.formats.open import find_dump, open_recording
from amberbox.blackbox.formats.options import ReadOptions
from amberbox.blackbox.formats.recording import (
    Account,
    Damage,
    Origin,
    RecordedGap,
    Recording,
    Report,
)
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.keeper.keeper import seal
from amberbox.blackbox.recorder.messageclock import MessageClock
from amberbox.blackbox.recorder.pipeline import Pipeline, PipelineOptions
from amberbox.blackbox.recorder.sink import BlockSink
from amberbox.blackbox.staging import broken_imports, discard, imported_digests, staged
from amberbox.blackbox.store import Store, create_store
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.source import TopicOptions
from amberbox.core.types import Topic

TICK_BYTES = 1 << 20
MOST_NAMED = 5
"""Damaged places of one stretch of time that the reason of a gap names."""
_NO_OPTIONS = ReadOptions()
_WORTH_TELLING = {
    "undecodable", "type_changed", "malformed", "schema_unstable", "filter_failed", "unused_names",
}  # fmt: skip
"""Events of the pipeline that somebody who imports should hear about."""

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
    kinds: dict[str, str] = field(default_factory=dict)
    """Where the columns of an item come from, if its format leaves a choice."""
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
    """Import recordings into a store, one run each; one that is there already is left out.

    Log times are the recording's own, stamps stay with the messages. Items are named as if they
    had been recorded live, or begin with ``source`` if that is given. Raises AmberboxError when
    an input cannot be read or the store not written; that input then leaves nothing behind.
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
        recording: Recording,
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
        self._told: list[str] = []
        options = PipelineOptions(
            robot=recording.path.stem, boot_id=digest[:8], input=digest, queue_bytes=1 << 40,
            counts_silence=False,
        )  # fmt: skip
        clock = MessageClock(recording.report.start_ns or 0)
        self._pipeline = Pipeline(store, clock, options)
        self._pipeline.on_event = self._hear

    def run(self, progress: Progress) -> ImportReport:
        """Copy everything, then write down what was found, and last that all of it is there."""
        recording, pipeline = self._recording, self._pipeline
        try:
            self._copy(progress)
            self._write_gaps()
            for damage in recording.report.damage:
                pipeline.event("recording_damaged", str(damage), offset=damage.offset)
            name = recording.path.name
            pipeline.event("imported", f"{name} is imported whole", sha256=self._digest)
        finally:
            pipeline.close()
        return self._report()

    def _hear(self, kind: str, text: str) -> None:
        if kind in _WORTH_TELLING and text not in self._told:
            self._told.append(text)

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
            if self._pipeline.intake.size_bytes >= TICK_BYTES:
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

    def _sink(self, origin: Origin) -> BlockSink:
        """Return the sink of a source; topics know their own stamps unless told otherwise."""
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

    def _write_gaps(self) -> None:
        for gap in [*self._recording.report.gaps, *_damaged(self._recording.report)]:
            self._pipeline.own(
                reserved.GAP,
                {
                    "item": "", "peer": "", "from_ns": gap.from_ns, "to_ns": gap.to_ns,
                    "reason": gap.reason, "count": None,
                },
            )  # fmt: skip

    def _report(self) -> ImportReport:
        found = self._recording.report
        items = {name: item.counters.kept for name, item in self._pipeline.items.items()}
        notes = [*found.notes, *self._told, *self._missing_topics()]
        damage = [str(damage) for damage in found.damage]
        path, messages = self._recording.path, sum(items.values())
        accounts = [
            text for a in found.accounts for text in account_lines(a, found, self._left_out())
        ]
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

    def _missing_topics(self) -> Iterator[str]:
        names = {topic.name for topic in self._recording.topics}
        for name in sorted(self._chosen - names):
            yield f"there is no topic {name} in it"

    def _left_out(self) -> set[int]:
        topics = enumerate(self._recording.topics)
        return {index for index, topic in topics if not self._wants(topic)}


def _damaged(report: Report) -> Iterator[RecordedGap]:
    """Say when something may be missing because the recording is damaged."""
    whole = report.start_ns or 0, report.end_ns or 0
    found: dict[tuple[int, int], list[Damage]] = {}
    for damage in report.damage:
        found.setdefault(damage.span_ns or whole, []).append(damage)
    for (from_ns, to_ns), damages in found.items():
        reason = "; ".join(map(str, damages[:MOST_NAMED]))
        more = f"; and {len(damages) - MOST_NAMED} more" if len(damages) > MOST_NAMED else ""
        yield RecordedGap(from_ns, to_ns + 1, f"damaged: {reason}{more}")


def account_lines(account: Account, report: Report, left_out: set[int]) -> list[str]:
    """Say what became of every piece of a file; what is not accounted for would stand there, too.

    ``left_out`` are the topics that were not to be imported.
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
    """SHA-256 of a recording: of the file, or of all files of a folder with their names.

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
        elif path.suffix.lower() in csv_table.SUFFIXES:
            total.update(path.name.encode() + b"\0")
        with file.open("rb") as opened:
            total.update(hashlib.file_digest(opened, "sha256").digest())
    return total.hexdigest()


def _files(path: Path) -> tuple[Path | None, list[Path]]:
    """List the files that make up a recording, and the folder they are seen from."""
    if not path.is_dir():
        return None, [path]
    dump = find_dump(path)
    if dump is not None:
        return dump, sorted(mongodump.collections(dump).values())
    return path, sorted(p for p in path.rglob("*") if p.is_file())
