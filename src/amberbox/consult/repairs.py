"""Situations whose cause is known: what people said it was, and what was seen meanwhile.

They are read from the findings of the watcher and the notes of people in a record, on a robot, in
an archive or on a server. Time without any fault is divided into situations as well.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from amberbox.blackbox.query.record import Record, Time
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.notes import NO_CAUSE, RecordedNote
from amberbox.core.timestamps import format_time
from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.fmea.learning import SeenSymptom, Situation
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.tracker import FaultTracker
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.record_evaluation import (
    DiagnosedEngine,
    RecordEvaluation,
    ReplayOptions,
    blocks,
    hang_guard,
)

_SYMPTOMS, _DIAGNOSES, _CLOCK = "amberbox_symptom", "amberbox_diagnosis", "amberbox_clock"
_BROKEN_NS = 90 * NS  # a record without clock times for so long was interrupted
_QUIET_NS = 600 * NS  # length of a situation without fault
_SHORTEST_NS = 10 * NS
_WHOLE = 0.9  # an item with so much of the longest one's time has been there all the time
_OWN_ITEMS = "amberbox_"
_UNCONFIRMED_NS = 60 * NS  # how long before its confirmation a symptom may begin
_MOST_QUIET = 2_000

Span: TypeAlias = "tuple[int, int]"


@dataclass(frozen=True, slots=True)
class KnownSituations:
    """What one or several records tell.

    ``hours`` is how long was recorded, ``unsaid`` the number of diagnoses whose cause nobody said.
    ``remarks`` are causes that could not be used, with the reason.
    """

    situations: tuple[Situation, ...] = ()
    hours: float = 0.0
    unsaid: int = 0
    remarks: tuple[str, ...] = ()

    def __add__(self, other: KnownSituations) -> KnownSituations:
        """Return what both tell."""
        return KnownSituations(
            self.situations + other.situations, self.hours + other.hours,
            self.unsaid + other.unsaid, self.remarks + other.remarks,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class SymptomChange:
    """A symptom is ``state`` from ``at_ns`` on; ``unknown`` also where it is blocked."""

    at_ns: int
    state: str
    size: float | None


@dataclass(slots=True)
class FaultTime:
    """A time in which something was wrong, and what people said that it was."""

    from_ns: int
    to_ns: int
    name: str
    causes: list[str] = field(default_factory=list)
    is_over: bool = True


@dataclass(frozen=True, slots=True)
class FoundFaults:
    """What a watcher found: the changes of each symptom, in order of time, and the diagnoses."""

    timelines: Mapping[str, Sequence[SymptomChange]]
    diagnoses: Mapping[str, FaultTime]

    @classmethod
    def of(cls, findings: Iterable[Symptom | Diagnosis], last_ns: int | None) -> FoundFaults:
        """Return those of findings; a diagnosis that is open lasts until the end of the record."""
        timelines: dict[str, list[SymptomChange]] = {}
        times: dict[str, FaultTime] = {}
        for one in findings:
            if isinstance(one, Diagnosis):
                time = times.setdefault(one.id, FaultTime(one.at_ns, one.at_ns, one.id))
                time.from_ns, time.to_ns = min(time.from_ns, one.at_ns), max(time.to_ns, one.at_ns)
                time.is_over = one.state == "healed"
                continue
            at_ns = one.confirmed_ns if one.onset_ns is None else one.onset_ns
            state = "unknown" if one.blocked_by else one.state
            if at_ns is not None:
                timelines.setdefault(one.id, []).append(SymptomChange(at_ns, state, one.size))
        for changes in timelines.values():
            changes.sort(key=lambda change: change.at_ns)
        for time in times.values():
            if not time.is_over and last_ns is not None:
                time.to_ns = max(time.to_ns, last_ns)
            time.from_ns = min(_onsets(timelines.values(), time), default=time.from_ns)
        return cls(timelines, times)


def _onsets(timelines: Iterable[Sequence[SymptomChange]], time: FaultTime) -> Iterator[int]:
    """Yield its beginning, and those of symptoms that were there already, but not confirmed."""
    yield time.from_ns
    for changes in timelines:
        place = bisect_right(changes, time.from_ns, key=lambda change: change.at_ns) - 1
        if place >= 0 and changes[place].state == "present":
            yield max(changes[place].at_ns, time.from_ns - _UNCONFIRMED_NS)


def was_found(record: Record) -> bool:
    """Return whether a watcher has written symptoms into a record."""
    return record.has_item(_SYMPTOMS)


def recorded_faults(record: Record, from_: Time = None, to: Time = None) -> FoundFaults:
    """Return what the watcher of a record has written."""
    return FoundFaults.of(_findings(record, from_, to), record.last_ns())


def evaluated_faults(knowledge: Knowledge, plan: MonitoringPlan, record: Record) -> FoundFaults:
    """Return what a watcher would have found in a record on this computer; nothing is written."""
    engine = DiagnosedEngine(Engine(plan), FaultTracker(knowledge))
    evaluation, findings = RecordEvaluation(engine), list[Symptom | Diagnosis]()
    with hang_guard(plan):
        for block in blocks(plan, open_store(record.path), engine, ReplayOptions()):
            for some in evaluation.take(block):
                findings += [one for one in some if isinstance(one, Symptom | Diagnosis)]
    return FoundFaults.of(findings, record.last_ns())


def _findings(record: Record, from_: Time, to: Time) -> Iterator[Symptom | Diagnosis]:
    """Yield the symptoms and the diagnoses that were written, as far as they are used here."""
    if record.has_item(_SYMPTOMS):
        names = ("id", "state", "address", "onset_ns", "confirmed_ns", "blocked_by", "size")
        have = {column.name for column in record.variables(_SYMPTOMS).columns}
        chosen = [name for name in names if name in have]  # older records have no sizes
        for row in record.query(_SYMPTOMS, chosen, from_, to).rows():
            yield Symptom(
                row["id"], row["state"], row["address"], row["onset_ns"], row["confirmed_ns"],
                blocked_by=tuple(row["blocked_by"]), size=row.get("size"),
            )  # fmt: skip
    if record.has_item(_DIAGNOSES):
        for row in record.query(_DIAGNOSES, ["id", "revision", "at_ns", "state"], from_, to).rows():
            yield Diagnosis(
                row["id"], row["revision"], "", row["at_ns"], "", (), 0.0, state=row["state"]
            )


def read_situations(
    record: Record,
    found: FoundFaults,
    said: Mapping[str, Sequence[str]] | None = None,
    from_: Time = None,
    to: Time = None,
) -> KnownSituations:
    """Return the situations of a record; ``said`` are causes by diagnosis that are not in it.

    Raises AmberboxError for a record that cannot be read.
    """
    timelines, cases = found.timelines, found.diagnoses
    remarks: list[str] = []
    for name, causes in (said or {}).items():
        if name in cases:
            cases[name].causes += causes
    ranges = list(_with_notes(cases, record.annotations(from_, to), remarks))
    known = [case for case in (*cases.values(), *ranges) if case.causes]
    recorded = _recorded(record, from_, to)
    missions = _missions(record)
    situations = [
        _situation(timelines, case.from_ns, case.to_ns, _name(case, missions), case.causes)
        for case in known
    ]
    busy = [(case.from_ns, case.to_ns) for case in (*cases.values(), *ranges)]
    situations += [
        _situation(timelines, start_ns, end_ns, "", [NO_CAUSE])
        for start_ns, end_ns in _pieces(_without(recorded, busy))
    ]
    hours = sum(end - start for start, end in recorded) / (3600 * NS)
    unsaid = sum(not case.causes for case in cases.values())
    return KnownSituations(tuple(situations), hours, unsaid, tuple(remarks))


def _missions(record: Record) -> list[tuple[int, int | None, str]]:
    """Return the missions of a record; none of an archive, which cannot list them."""
    try:
        return [(mission.from_ns, mission.to_ns, mission.id) for mission in record.missions()]
    except UsageError:
        return []


def _with_notes(
    cases: Mapping[str, FaultTime], notes: Iterable[RecordedNote], remarks: list[str]
) -> Iterator[FaultTime]:
    """Add the causes that notes state; yield those of a range that no diagnosis was made in.

    A note on a moment is about the last diagnosis that began before it.
    """
    ordered = sorted(cases.values(), key=lambda case: case.from_ns)
    ranges: dict[Span, FaultTime] = {}
    for note in notes:
        if not note.cause:
            continue
        if note.to_ns is None:
            place = bisect_right(ordered, note.at_ns, key=lambda case: case.from_ns) - 1
            met = ordered[place : place + 1] if place >= 0 else []
        else:
            to_ns = note.to_ns
            met = [c for c in ordered if c.from_ns < to_ns and note.at_ns <= c.to_ns]
        for case in met:
            case.causes.append(note.cause)
        if not met and note.to_ns is not None:
            span = note.at_ns, note.to_ns
            case = ranges.setdefault(span, FaultTime(*span, format_time(note.at_ns)[:19]))
            case.causes.append(note.cause)
        elif not met:
            at = format_time(note.at_ns)[:19]
            remarks.append(f"{note.id} ({note.cause}): nothing was diagnosed before {at}")
    yield from ranges.values()


def _recorded(record: Record, from_: Time, to: Time) -> list[Span]:
    """Return the times in which the recorder ran, by its clock times; of an import by its rows."""
    spans = _spans(record, _CLOCK, from_, to) if record.has_item(_CLOCK) else []
    items = [item for item in record.items() if not item.name.startswith(_OWN_ITEMS)]
    if any(start < end for start, end in spans):  # its first and last seconds have no clock time
        first_ns = 0 if from_ is not None else min((item.first_ns for item in items), default=0)
        last_ns = 0 if to is not None else max((item.last_ns for item in items), default=0)
        return [
            (
                first_ns if 0 < start - first_ns <= _BROKEN_NS else start,
                last_ns if 0 < last_ns - end <= _BROKEN_NS else end,
            )
            for start, end in spans
        ]
    longest = max((item.last_ns - item.first_ns for item in items), default=0)
    whole = [i for i in items if i.last_ns - i.first_ns >= longest * _WHOLE]
    slowest = min(whole, key=lambda item: item.rows, default=None)
    return [] if slowest is None else _spans(record, slowest.name, from_, to)


def _spans(record: Record, item: str, from_: Time, to: Time) -> list[Span]:
    """Return the times in which an item has rows without a long break."""
    stamps = np.asarray(record.query(item, [], from_, to).columns["timestamp"])
    breaks = np.flatnonzero(np.diff(stamps) > _BROKEN_NS)
    if not len(stamps):
        return []
    starts, ends = stamps[[0, *(breaks + 1)]], stamps[[*breaks, -1]]
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def _without(spans: Sequence[Span], busy: Iterable[Span]) -> list[Span]:
    """Return what is left of spans outside of the busy times."""
    left = list(spans)
    for from_ns, to_ns in sorted(busy):
        cut: list[Span] = []
        for start, end in left:
            parts = [(start, end)]
            if from_ns < end and start < to_ns:
                parts = [(start, from_ns), (to_ns, end)]
            cut += [part for part in parts if part[0] < part[1]]
        left = cut
    return left


def _pieces(spans: Sequence[Span]) -> Iterator[Span]:
    """Divide spans into situations; many are longer instead."""
    total = sum(end - start for start, end in spans)
    length = max(_QUIET_NS, total // _MOST_QUIET)
    for start, end in spans:
        for at_ns in range(start, end, length):
            if min(end, at_ns + length) - at_ns >= _SHORTEST_NS:
                yield at_ns, min(end, at_ns + length)


def _situation(
    timelines: Mapping[str, Sequence[SymptomChange]], from_ns: int, to_ns: int, name: str,
    causes: Sequence[str],
) -> Situation:  # fmt: skip
    seen = {symptom: _seen(changes, from_ns, to_ns) for symptom, changes in timelines.items()}
    known = {symptom: one for symptom, one in seen.items() if one is not None}
    faults = frozenset(cause for cause in causes if cause != NO_CAUSE)
    return Situation(faults, (to_ns - from_ns) / NS, known, name)


def _seen(changes: Sequence[SymptomChange], from_ns: int, to_ns: int) -> SeenSymptom | None:
    """Return how a symptom was in a time; None where it was not known all the time.

    Its size is the largest one, by magnitude.
    """
    first = max(0, bisect_right(changes, from_ns, key=lambda change: change.at_ns) - 1)
    last = bisect_left(changes, to_ns, key=lambda change: change.at_ns)
    met = changes[first:last]
    there = [change for change in met if change.state == "present"]
    if there:
        sizes = [change.size for change in there if change.size is not None]
        return SeenSymptom(True, max(sizes, key=abs, default=None))
    if met and all(change.state == "absent" for change in met):
        return SeenSymptom(False)
    return None


def _name(case: FaultTime, missions: Iterable[tuple[int, int | None, str]]) -> str:
    """Return the mission in which it began, else its own name."""
    for from_ns, to_ns, name in missions:
        if from_ns <= case.from_ns and (to_ns is None or case.from_ns < to_ns):
            return name
    return case.name


def with_known_modes(known: KnownSituations, modes: Iterable[str]) -> KnownSituations:
    """Leave out situations whose cause is no failure mode of the analysis, with a remark each."""
    modes = frozenset(modes)
    good = [one for one in known.situations if one.faults <= modes]
    strange = sorted({name for one in known.situations for name in one.faults - modes})
    remarks = tuple(f"{name} is no failure mode of the analysis: left out" for name in strange)
    return replace(known, situations=tuple(good), remarks=known.remarks + remarks)
