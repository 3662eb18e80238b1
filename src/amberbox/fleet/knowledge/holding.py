"""Which symptoms of a diagnosis are still there, and when the others went."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from amberbox.blackbox.journal import reserved
from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Symptom
from amberbox.fleet.conclusions.reading import Stores, entries
from amberbox.fleet.knowledge.moment import findings

_BEFORE_NS = 60 * NS
"""A symptom is told of at most so long before the diagnosis that it opens."""
_MOST = 2_000
"""Words on symptoms that are looked through, the newest of them."""
_SETTLED_NS = 10 * NS
"""What went so short ago may come and go."""


class Told(Protocol):
    """A word on a symptom, as a robot said it."""

    @property
    def state(self) -> str:
        """Return whether it is there: ``present``, ``absent`` or ``unknown``."""

    @property
    def onset_ns(self) -> int | None:
        """Return since when."""

    @property
    def confirmed_ns(self) -> int | None:
        """Return when that was certain."""


@dataclass(frozen=True, slots=True)
class Hold:
    """Since when a symptom was there last, and when it was seen to be gone; None while it lasts."""

    from_ns: int
    to_ns: int | None = None


def holds_of(stores: Stores, robot: str, revisions: Iterable[Diagnosis]) -> dict[str, Hold]:
    """Return what is known of the symptoms of a diagnosis, by their ids.

    What nobody has told of for long, or what nobody can look at now, counts as still there.
    """
    told = list(revisions)
    names = {name for one in told for name in one.symptoms}
    since_ns = min((one.at_ns for one in told), default=0) - _BEFORE_NS
    span = since_ns, None
    said = entries(stores, robot, reserved.SYMPTOM, span, _MOST, newest=True) if names else []
    found: dict[str, Hold] = {}
    for symptom in findings(said, Symptom):
        if symptom.id in names:
            hold = held_after(found.get(symptom.id), symptom)
            found.update({symptom.id: hold} if hold is not None else {})
    return found


def gone_since(symptoms: Sequence[str], holds: Mapping[str, Hold], now_ns: int) -> int | None:
    """Return when the last of some symptoms went; None while one may be there."""
    ends = [holds[name].to_ns if name in holds else None for name in symptoms]
    known = [end_ns for end_ns in ends if end_ns is not None]
    if not ends or len(known) < len(ends) or now_ns - max(known) < _SETTLED_NS:
        return None
    return max(known)


def held_after(before: Hold | None, told: Told) -> Hold | None:
    """Return since when a symptom is there, or was, after one more word on it."""
    at_ns = told.confirmed_ns or told.onset_ns or 0
    if told.state == "present" and (before is None or before.to_ns is not None):
        return Hold(told.onset_ns or at_ns)
    if told.state == "absent" and before is not None and before.to_ns is None:
        return replace(before, to_ns=max(at_ns, before.from_ns))
    return before
