"""What the watcher's journal says of symptoms and diagnoses at an instant."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from amberbox.blackbox.follow.newest import Written, newest_records, records_of
from amberbox.blackbox.follow.read import newest_first, sound_chunks
from amberbox.blackbox.follow.records import OwnRecords
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.scan import ChunkPlace
from amberbox.blackbox.store import Store
from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Symptom
from amberbox.monitoring.messages.board import SILENT_NS, WRITER
from amberbox.monitoring.messages.records import finding_of

CHANNELS = (reserved.SYMPTOM, reserved.DIAGNOSIS)
_STATUS = (reserved.STATUS,)
_END_S = 2 * SILENT_NS / NS
_LATE_NS = 5 * NS
"""So long after an instant its statuses have been written, unless the watcher was behind."""


@dataclass(frozen=True, slots=True)
class Said:
    """What a watcher had found up to an instant, in the order in which it wrote it."""

    symptoms: Sequence[Symptom] = ()
    diagnoses: Sequence[Diagnosis] = ()
    """Each id's revisions; the last one stood at the instant."""


def end_ns(store: Store) -> int | None:
    """Return up to when a recorder has written, log time, by the end of its journal alone."""
    written = newest_records(store, "main", {reserved.COUNTERS}, 0.0)
    return written[-1].log_ns if written else None


def was_watched(store: Store, config_hash: str, at_ns: int) -> bool:
    """Tell whether a watcher with these monitors has judged what was recorded at an instant."""
    from_ns = at_ns - SILENT_NS
    return any(
        record.values["config_hash"] == config_hash
        and not record.values["live_only"]
        and from_ns <= record.values["measured_ns"] <= at_ns
        for record in _statuses(store, from_ns, at_ns + _LATE_NS)
    )


def said_until(store: Store, at_ns: int) -> Said:
    """Return the symptoms and diagnoses up to an instant, of all that is kept of the journal."""
    symptoms: list[Symptom] = []
    diagnoses: list[Diagnosis] = []
    for finding in findings(OwnRecords(store, WRITER, CHANNELS).step()):
        if isinstance(finding, Symptom) and (finding.confirmed_ns or 0) <= at_ns:
            symptoms.append(finding)
        elif isinstance(finding, Diagnosis) and finding.at_ns <= at_ns:
            diagnoses.append(finding)
    return Said(symptoms, diagnoses)


def findings(records: Iterable[Written]) -> Iterable[Symptom | Diagnosis]:
    """Yield the symptoms and diagnoses among records."""
    for record in records:
        finding = finding_of(record.channel, record.values)
        if isinstance(finding, Symptom | Diagnosis):
            yield finding


def _statuses(store: Store, from_ns: int, to_ns: int) -> Iterable[Written]:
    """Yield the statuses that were written in a span of log time."""
    newest = newest_records(store, WRITER, _STATUS, _END_S)
    if not newest or newest[0].log_ns <= from_ns:
        yield from newest
        return

    def overlaps(place: ChunkPlace) -> bool:
        return place.end_ns >= from_ns and place.start_ns <= to_ns

    for journal in newest_first(store, WRITER):
        if journal.start_ns <= to_ns:
            yield from records_of(sound_chunks(journal, overlaps), _STATUS)
        if journal.start_ns < from_ns:
            return
