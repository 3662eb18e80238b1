"""The diagnoses that a robot's watcher made: each with its revisions, the newest first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amberbox.blackbox.journal import reserved
from amberbox.core.types import Diagnosis
from amberbox.fleet.conclusions.reading import Stores, entries
from amberbox.fleet.knowledge.moment import findings

_MOST = 5_000
"""Revisions that are looked through for one page."""
_FEW = 50
"""Revisions that are looked through for the newest diagnosis alone."""


@dataclass(frozen=True, slots=True)
class Known:
    """One diagnosis: all that was said of it, in order."""

    id: str
    revisions: tuple[Diagnosis, ...]

    @property
    def last(self) -> Diagnosis:
        """The revision that stands."""
        return self.revisions[-1]

    def until(self, revision: int) -> Known:
        """Return it as it was before later revisions; all of it where it has none so early."""
        early = tuple(one for one in self.revisions if one.revision <= revision)
        return Known(self.id, early) if early else self

    def differs_since(self, before: Diagnosis) -> int | None:
        """Return since when something else leads than by a revision; None if that leads still."""
        later = [one for one in self.revisions if one.revision > before.revision]
        other_ns = None
        for one in later:
            same = _leading(one) == _leading(before)
            other_ns = None if same else other_ns or one.at_ns
        return other_ns

    @property
    def peak(self) -> Diagnosis:
        """The last revision with hypotheses: a healed one may have none any more."""
        return next((d for d in reversed(self.revisions) if d.hypotheses), self.last)


def _leading(one: Diagnosis) -> frozenset[frozenset[str]]:
    """Return the sets of failure modes that lead, those that nothing tells apart together."""
    names = one.groups[0].members if one.groups else [h.id for h in one.hypotheses[:1]]
    return frozenset(h.faults for h in one.hypotheses if h.id in names)


def diagnoses(
    stores: Stores,
    robot: str,
    from_ns: int | None = None,
    to_ns: int | None = None,
    most: int = _MOST,
) -> list[Known]:
    """Return a robot's diagnoses of which something was written in a range, the newest first.

    The newest ``most`` revisions are looked at.

    A file of the watcher begins with what stands, so a revision may be written several times; it
    counts once.
    """
    found = entries(stores, robot, reserved.DIAGNOSIS, (from_ns, to_ns), most, newest=True)
    by_id: dict[str, dict[tuple[int, str], Diagnosis]] = {}
    for diagnosis in findings(found, Diagnosis):
        revisions = by_id.setdefault(diagnosis.id, {})
        revisions.setdefault((diagnosis.revision, diagnosis.state), diagnosis)
    known = (Known(name, tuple(revisions.values())) for name, revisions in by_id.items())
    return sorted(known, key=lambda one: (-one.last.at_ns, one.id))


def find(stores: Stores, robot: str, name: str) -> Known | None:
    """Return one diagnosis; None if the robot made none of this id."""
    return next((one for one in diagnoses(stores, robot) if one.id == name), None)


def newest(stores: Stores, robot: str) -> Known | None:
    """Return what a robot found last, with its newest revisions; quicker than all of them."""
    return next(iter(diagnoses(stores, robot, most=_FEW)), None)


def page(found: Sequence[Known], after: str, limit: int) -> list[Known]:
    """Return the part of a list behind an id; from the beginning where that is not in it."""
    at = next((place + 1 for place, one in enumerate(found) if one.id == after), 0)
    return list(found[at : at + limit])
