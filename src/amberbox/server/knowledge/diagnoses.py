"""Diagnoses of robots: their revisions, the evidence at an instant, intervals of symptoms."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS
from amberbox.core.timestamps import format_to_second, parse_time
from amberbox.core.types import Diagnosis, Status, Symptom
from amberbox.monitoring.current_state import RecordedFindings
from amberbox.server.derived import DerivedRecord, RecordStores, derived_records, finding

_STATUS_NS = 30 * NS
"""A watcher that runs repeats the status of every component within this time."""
_LATE_NS = 5 * NS
"""Delay after an instant by which its statuses have been written."""
_FOUND_LATE_NS = 600 * NS
"""The same for symptoms and diagnoses: a watcher that was restarted, or has little processor time,
catches up.
"""
_SYMPTOMS, _DIAGNOSES, _STATUSES = 20_000, 500, 5_000

FindingT = TypeVar("FindingT", Status, Symptom, Diagnosis)


@dataclass(frozen=True, slots=True)
class EvidenceMoment:
    """The evidence at an instant; ``notes`` state how it differs from the requested instant.

    Times are those of the robot, by the latest correction of its clock. ``config_hash`` is of the
    robot folder that the watcher used, empty if it recorded none.
    """

    at_ns: int
    config_hash: str = ""
    findings: RecordedFindings = field(default_factory=RecordedFindings)
    statuses: Sequence[Status] = ()
    notes: tuple[str, ...] = ()


def evidence_at(
    stores: RecordStores, robot: str, at: str, now_ns: int, spoke_ns: int = 0
) -> EvidenceMoment:
    """Return the evidence at a time; without a time, at the newest status.

    ``-10m`` counts from the newest status. ``spoke_ns`` is an instant at which the watcher is known
    to have recorded something. Raises UsageError for an invalid time.
    """
    newest = _newest(stores, robot, None)
    last_ns = None if newest is None else newest.at_ns
    at_ns = parse_time(at, lambda: now_ns, lambda: last_ns) if at else last_ns
    if at_ns is None:
        return EvidenceMoment(now_ns, notes=("nothing has come from this robot yet",))
    before = newest if newest and newest.at_ns <= at_ns else _newest(stores, robot, at_ns)
    if before is None:
        return EvidenceMoment(
            at_ns, notes=(f"nothing is known of the time before {format_to_second(at_ns)}",)
        )
    if max(before.at_ns, min(spoke_ns, at_ns)) < at_ns - _STATUS_NS:
        notes: tuple[str, ...] = (f"the robot said nothing after {format_to_second(before.at_ns)}; "
                                  "this is as of then",)  # fmt: skip
        at_ns = before.at_ns
    else:
        notes = ()
    statuses = _statuses(stores, robot, at_ns)
    config_hash = str(before.values.get("config_hash", ""))
    return EvidenceMoment(at_ns, config_hash, _findings_at(stores, robot, at_ns), statuses, notes)


def _newest(stores: RecordStores, robot: str, to_ns: int | None) -> DerivedRecord | None:
    """Return the newest status up to an instant; None if there is none."""
    span = None, None if to_ns is None else to_ns + 1
    found = derived_records(stores, robot, channels.STATUS, span, 1, newest=True)
    return found[-1] if found else None


def _statuses(stores: RecordStores, robot: str, at_ns: int) -> list[Status]:
    """Return the last status of each component and mode at an instant."""
    span = at_ns - _STATUS_NS, at_ns + _LATE_NS
    found = derived_records(stores, robot, channels.STATUS, span, _STATUSES, newest=True)
    recorded = (status for status in findings(found, Status) if status.measured_ns <= at_ns)
    return list({(status.component, status.mode): status for status in recorded}.values())


def _findings_at(stores: RecordStores, robot: str, at_ns: int) -> RecordedFindings:
    """Return symptoms and diagnoses up to an instant, in the order in which they were recorded."""
    span = None, at_ns + _FOUND_LATE_NS
    symptoms = derived_records(stores, robot, channels.SYMPTOM, span, _SYMPTOMS, newest=True)
    diagnoses = derived_records(stores, robot, channels.DIAGNOSIS, span, _DIAGNOSES, newest=True)
    return RecordedFindings(
        [s for s in findings(symptoms, Symptom) if (s.confirmed_ns or 0) <= at_ns],
        [d for d in findings(diagnoses, Diagnosis) if d.at_ns <= at_ns],
    )


def findings(found: Sequence[DerivedRecord], kind: type[FindingT]) -> Iterator[FindingT]:
    """Yield findings decoded from records, with corrected times; unreadable ones are left out."""
    for entry in found:
        decoded = finding(entry.channel, entry.values)
        if isinstance(decoded, kind):  # else of another version or type
            yield _moved(decoded, entry.at_ns - entry.log_ns)


def _moved(finding: FindingT, by_ns: int) -> FindingT:
    """Shift the times of a finding by ``by_ns``, the correction of the robot's clock."""
    if not by_ns:
        return finding
    names = {Status: ("measured_ns", "since_ns"), Symptom: ("onset_ns", "confirmed_ns"),
             Diagnosis: ("at_ns",)}[type(finding)]  # fmt: skip
    times = {name: getattr(finding, name) for name in names}
    return replace(finding, **{name: t + by_ns for name, t in times.items() if t is not None})


_MOST = 5_000
"""Revisions that are looked through for one page."""
_FEW = 50
"""Revisions that are looked through for the newest diagnosis alone."""


@dataclass(frozen=True, slots=True)
class DiagnosisHistory:
    """A diagnosis with all its revisions, in order."""

    id: str
    revisions: tuple[Diagnosis, ...]

    @property
    def last(self) -> Diagnosis:
        """The newest revision."""
        return self.revisions[-1]

    def until(self, revision: int) -> DiagnosisHistory:
        """Return the history up to a revision; all of it if no revision is that early."""
        early = tuple(one for one in self.revisions if one.revision <= revision)
        return DiagnosisHistory(self.id, early) if early else self

    def differs_since(self, before: Diagnosis) -> int | None:
        """Return since when (ns) other hypotheses lead than in a revision; None if they do not."""
        later = [one for one in self.revisions if one.revision > before.revision]
        other_ns = None
        for one in later:
            same = _leading(one) == _leading(before)
            other_ns = None if same else other_ns or one.at_ns
        return other_ns

    @property
    def peak(self) -> Diagnosis:
        """The last revision with hypotheses, as a healed diagnosis may have none."""
        return next((d for d in reversed(self.revisions) if d.hypotheses), self.last)


def _leading(one: Diagnosis) -> frozenset[frozenset[str]]:
    """Return the leading hypothesis, or all of its ambiguity group, as sets of failure modes."""
    names = one.groups[0].members if one.groups else [h.id for h in one.hypotheses[:1]]
    return frozenset(h.faults for h in one.hypotheses if h.id in names)


def read_diagnoses(
    stores: RecordStores,
    robot: str,
    from_ns: int | None = None,
    to_ns: int | None = None,
    most: int = _MOST,
) -> list[DiagnosisHistory]:
    """Return a robot's diagnoses with a revision in a range, newest first.

    Reads the newest ``most`` revisions. A file of the watcher begins with the open diagnosis, so a
    revision may be written several times; it counts once.
    """
    found = derived_records(stores, robot, channels.DIAGNOSIS, (from_ns, to_ns), most, newest=True)
    by_id: dict[str, dict[tuple[int, str], Diagnosis]] = {}
    for diagnosis in findings(found, Diagnosis):
        revisions = by_id.setdefault(diagnosis.id, {})
        revisions.setdefault((diagnosis.revision, diagnosis.state), diagnosis)
    known = (DiagnosisHistory(name, tuple(revisions.values())) for name, revisions in by_id.items())
    return sorted(known, key=lambda one: (-one.last.at_ns, one.id))


def find_diagnosis(stores: RecordStores, robot: str, name: str) -> DiagnosisHistory | None:
    """Return the diagnosis of an id; None if the robot made none."""
    return next((one for one in read_diagnoses(stores, robot) if one.id == name), None)


def newest_diagnosis(stores: RecordStores, robot: str) -> DiagnosisHistory | None:
    """Return a robot's newest diagnosis with its newest revisions; faster than reading all."""
    return next(iter(read_diagnoses(stores, robot, most=_FEW)), None)


def diagnoses_page(
    found: Sequence[DiagnosisHistory], after: str, limit: int
) -> list[DiagnosisHistory]:
    """Return ``limit`` diagnoses after an id; from the beginning if it is not in the list."""
    at = next((place + 1 for place, one in enumerate(found) if one.id == after), 0)
    return list(found[at : at + limit])


_BEFORE_NS = 60 * NS
"""Longest time by which a symptom is recorded before the diagnosis that it opens."""
_HOLDING_MOST = 2_000
"""Words on symptoms that are looked through, the newest of them."""
_SETTLED_NS = 10 * NS
"""A symptom that disappeared more recently than this may be intermittent."""


class ReportedSymptom(Protocol):
    """The state of a symptom as a robot reported it."""

    @property
    def state(self) -> str:
        """Return its state: ``present``, ``absent`` or ``unknown``."""

    @property
    def onset_ns(self) -> int | None:
        """Return since when it is present, None if unknown."""

    @property
    def confirmed_ns(self) -> int | None:
        """Return when the state was confirmed, None if unknown."""


@dataclass(frozen=True, slots=True)
class SymptomInterval:
    """When a symptom was last present, from onset to its confirmed end; None while it lasts."""

    from_ns: int
    to_ns: int | None = None


def symptom_intervals(
    stores: RecordStores, robot: str, revisions: Iterable[Diagnosis]
) -> dict[str, SymptomInterval]:
    """Return the last interval of the symptoms of a diagnosis, by their ids.

    A symptom without a report that it is absent counts as still present.
    """
    known = list(revisions)
    names = {name for one in known for name in one.symptoms}
    since_ns = min((one.at_ns for one in known), default=0) - _BEFORE_NS
    span = since_ns, None
    records = (
        derived_records(stores, robot, channels.SYMPTOM, span, _HOLDING_MOST, newest=True)
        if names
        else []
    )
    found: dict[str, SymptomInterval] = {}
    for symptom in findings(records, Symptom):
        if symptom.id in names:
            hold = next_interval(found.get(symptom.id), symptom)
            found.update({symptom.id: hold} if hold is not None else {})
    return found


def gone_since(
    symptoms: Sequence[str], holds: Mapping[str, SymptomInterval], now_ns: int
) -> int | None:
    """Return when (ns) the last of some symptoms ended; None while one may be present."""
    ends = [holds[name].to_ns if name in holds else None for name in symptoms]
    known = [end_ns for end_ns in ends if end_ns is not None]
    if not ends or len(known) < len(ends) or now_ns - max(known) < _SETTLED_NS:
        return None
    return max(known)


def next_interval(
    before: SymptomInterval | None, symptom: ReportedSymptom
) -> SymptomInterval | None:
    """Return the interval of a symptom after one more report on it."""
    at_ns = symptom.confirmed_ns or symptom.onset_ns or 0
    if symptom.state == "present" and (before is None or before.to_ns is not None):
        return SymptomInterval(symptom.onset_ns or at_ns)
    if symptom.state == "absent" and before is not None and before.to_ns is None:
        return replace(before, to_ns=max(at_ns, before.from_ns))
    return before
