"""Repairs: which failure modes of an answer are over, by the symptoms that they showed."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from amberbox.core.types import Diagnosis
from amberbox.diagnosis.tracking.presence import Presence, Presences

NEVER_NS = 1 << 62


class Repairs:
    """Finds failure modes that are over; ``shows`` are the symptoms that each may show."""

    def __init__(self, shows: Mapping[str, Collection[str]]) -> None:
        self._shows = shows

    def ends_ns(
        self, faults: Iterable[str], had: Collection[str], presences: Presences, at_ns: int
    ) -> dict[str, int]:
        """Return when symptoms end to count since all causes they have among faults are over.

        A failure mode is over when everything that it has shown (of the symptoms that the
        diagnosis ``had``) has been seen to be gone for as long as the shortest ``hold_s`` among
        it. Symptoms that are there, or that nobody can look at, have no end.
        """
        ends_ns: dict[str, int] = {}
        for fault in faults:
            names = [n for n in self._shows.get(fault, ()) if n in had and n in presences]
            over_ns = _over_ns([presences[name] for name in names], at_ns)
            for name in names:
                ends_ns[name] = max(ends_ns.get(name, 0), over_ns)
        return {name: end_ns for name, end_ns in ends_ns.items() if end_ns < NEVER_NS}

    def may_replace(self, before: Diagnosis, after: Diagnosis, present: Collection[str]) -> bool:
        """Tell whether an answer may replace another only since symptoms have gone.

        It may narrow the leading group, and leave out causes that show nothing any more. It
        accuses none that was not accused before, unless each leading hypothesis has such a cause,
        so that none holds any longer.
        """
        was, now = leading_faults(before), leading_faults(after)
        if set(now) < set(was) or all(
            any(self._is_over(fault, present) for fault in one) for one in was
        ):
            return True
        left_out = frozenset[str]().union(*was) - frozenset[str]().union(*now)
        accuses_no_other = all(one and any(one <= other for other in was) for one in now)
        return (
            accuses_no_other
            and any(left_out)
            and all(self._is_over(fault, present) for fault in left_out)
        )

    def _is_over(self, fault: str, present: Collection[str]) -> bool:
        shows = self._shows.get(fault)
        return shows is not None and not any(name in present for name in shows)


def leading_faults(diagnosis: Diagnosis) -> list[frozenset[str]]:
    """Return the faults of the leading hypothesis, and of those that nothing tells from it."""
    if not diagnosis.groups:
        return [hypothesis.faults for hypothesis in diagnosis.hypotheses[:1]]
    members = frozenset(diagnosis.groups[0].members)
    return [one.faults for one in diagnosis.hypotheses if one.id in members]


def _over_ns(shown: Collection[Presence], at_ns: int) -> int:
    """Return when the cause of symptoms is over; NEVER_NS while one is there, or hidden."""
    gone_ns = [one.forgotten_since_ns(at_ns) for one in shown]
    if not shown or None in gone_ns:
        return NEVER_NS
    return max(gone or 0 for gone in gone_ns) + min(one.hold_ns for one in shown)
