"""What the server knows of a robot at an instant: what its watcher had said by then."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

from amberbox.blackbox.journal import reserved
from amberbox.consult.journal import Said
from amberbox.core.clock import NS
from amberbox.core.timetext import format_time, parse_time
from amberbox.core.types import Diagnosis, Status, Symptom
from amberbox.fleet.conclusions.entry import Entry
from amberbox.fleet.conclusions.findings import finding
from amberbox.fleet.conclusions.reading import Stores, entries

_STATUS_NS = 30 * NS
"""A watcher that is alive has said of everything within this time how it is."""
_LATE_NS = 5 * NS
"""So long after an instant the statuses of it have been written."""
_FOUND_LATE_NS = 600 * NS
"""The same for symptoms and diagnoses: a watcher that was restarted, or has little of its computer,
catches up with what it missed."""
_SYMPTOMS, _DIAGNOSES, _STATUSES = 20_000, 500, 5_000

Told = TypeVar("Told", Status, Symptom, Diagnosis)


@dataclass(frozen=True, slots=True)
class Moment:
    """An instant and what was known then; ``notes`` say how far it is from what was asked.

    Times are those of the robot as they are known now. ``config_hash`` is of the folder that the
    watcher had, empty if it said nothing.
    """

    at_ns: int
    config_hash: str = ""
    said: Said = field(default_factory=Said)
    statuses: Sequence[Status] = ()
    notes: tuple[str, ...] = ()


def moment(stores: Stores, robot: str, at: str, now_ns: int, spoke_ns: int = 0) -> Moment:
    """Return what was known at a time; of the newest status without one.

    ``-10m`` counts from the newest status. ``spoke_ns`` is an instant at which the watcher is known
    to have said something. Raises UsageError for what is no time.
    """
    newest = _newest(stores, robot, None)
    last_ns = None if newest is None else newest.at_ns
    at_ns = parse_time(at, lambda: now_ns, lambda: last_ns) if at else last_ns
    if at_ns is None:
        return Moment(now_ns, notes=("nothing has come from this robot yet",))
    before = newest if newest and newest.at_ns <= at_ns else _newest(stores, robot, at_ns)
    if before is None:
        return Moment(at_ns, notes=(f"nothing is known of the time before {_words(at_ns)}",))
    if max(before.at_ns, min(spoke_ns, at_ns)) < at_ns - _STATUS_NS:
        notes: tuple[str, ...] = (f"the robot said nothing after {_words(before.at_ns)}; "
                                  "this is as of then",)  # fmt: skip
        at_ns = before.at_ns
    else:
        notes = ()
    statuses = _statuses(stores, robot, at_ns)
    config_hash = str(before.values.get("config_hash", ""))
    return Moment(at_ns, config_hash, _said(stores, robot, at_ns), statuses, notes)


def _newest(stores: Stores, robot: str, to_ns: int | None) -> Entry | None:
    """Return the newest status before an instant."""
    span = None, None if to_ns is None else to_ns + 1
    found = entries(stores, robot, reserved.STATUS, span, 1, newest=True)
    return found[-1] if found else None


def _statuses(stores: Stores, robot: str, at_ns: int) -> list[Status]:
    """Return the last status of each component and mode."""
    span = at_ns - _STATUS_NS, at_ns + _LATE_NS
    found = entries(stores, robot, reserved.STATUS, span, _STATUSES, newest=True)
    told = (status for status in findings(found, Status) if status.measured_ns <= at_ns)
    return list({(status.component, status.mode): status for status in told}.values())


def _said(stores: Stores, robot: str, at_ns: int) -> Said:
    """Return symptoms and diagnoses up to an instant, in the order in which they were told."""
    span = None, at_ns + _FOUND_LATE_NS
    symptoms = entries(stores, robot, reserved.SYMPTOM, span, _SYMPTOMS, newest=True)
    diagnoses = entries(stores, robot, reserved.DIAGNOSIS, span, _DIAGNOSES, newest=True)
    return Said(
        [s for s in findings(symptoms, Symptom) if (s.confirmed_ns or 0) <= at_ns],
        [d for d in findings(diagnoses, Diagnosis) if d.at_ns <= at_ns],
    )


def findings(found: Sequence[Entry], kind: type[Told]) -> Iterator[Told]:
    """Yield what records say, at times as they are known now; what cannot be read is left out."""
    for entry in found:
        said = finding(entry.channel, entry.values)
        if isinstance(said, kind):  # else of another version, or not what its channel says
            yield _moved(said, entry.at_ns - entry.log_ns)


def _moved(finding: Told, by_ns: int) -> Told:
    """Put a finding on the clock as it is known now."""
    if not by_ns:
        return finding
    names = {Status: ("measured_ns", "since_ns"), Symptom: ("onset_ns", "confirmed_ns"),
             Diagnosis: ("at_ns",)}[type(finding)]  # fmt: skip
    times = {name: getattr(finding, name) for name in names}
    return replace(finding, **{name: t + by_ns for name, t in times.items() if t is not None})


def _words(at_ns: int) -> str:
    return f"{format_time(at_ns)[:19]}Z"
