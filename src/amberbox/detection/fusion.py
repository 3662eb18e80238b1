"""One finding of all detectors about an item: their alarms, combined by nominal p-values.

When its messages come is one finding (``timing``), what they hold another (``values``).

Detectors that read the same rows raise their scores together, in nominal operation too: a product
of their p-values (Fisher 1932) would count one accident several times. Simes' p-value (1986) holds
for scores that depend on each other positively (Sarkar 1998); for any other dependence it is too
small by ``1 + 1/2 + ... + 1/n`` at most (Hommel 1983), 2.5 times for six detectors.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from amberbox.core.contracts import ScoreReason
from amberbox.detection.alarms import COMBINED, DetectorAlarm, alarm_from_json, alarm_to_json

TIMING: Final = "timing"
VALUES: Final = "values"
_MOST_MEMBERS = 8


def combined_p_value(p_values: Iterable[float], of: int) -> float:
    """Return Simes' p-value of ``of`` tests; those without a p-value count as 1."""
    ordered = sorted(p_values)
    return min([1.0, *(of * p / place for place, p in enumerate(ordered, 1))])


class Fusion:
    """The combined alarms of all items; ``detectors`` is how many detectors there are.

    An alarm lasts while that of any detector about its item does. The p-values are those of a
    minute, the leaks of the detectors' alarms; of one detector the smallest counts.
    """

    def __init__(self, detectors: int) -> None:
        self._detectors = detectors
        self._open: dict[str, DetectorAlarm] = {}

    @property
    def open_alarms(self) -> tuple[DetectorAlarm, ...]:
        """Return the alarms that last, each with all of its members until now."""
        return tuple(self._open.values())

    def begin(self, at_ns: int) -> list[DetectorAlarm]:
        """Begin anew; return the alarms that end."""
        ended = [one.ended(max(at_ns, one.confirmed_ns)) for one in self._open.values()]
        self._open = {}
        return ended

    def take(self, alarms: Iterable[DetectorAlarm], at_ns: int) -> list[DetectorAlarm]:
        """Take the alarms that last now; return the combined ones that begin or end."""
        about: dict[str, list[DetectorAlarm]] = {}
        for alarm in alarms:
            if alarm.reason.item:
                kind = VALUES if alarm.reason.variable else TIMING
                about.setdefault(f"{alarm.reason.item} {kind}", []).append(alarm)
        over = [series for series in self._open if series not in about]
        changed = [self._open.pop(series).ended(at_ns) for series in over]
        for series, members in about.items():
            known = self._open.get(series)
            self._open[series] = made = self._combined(series, members, at_ns, known)
            if known is None:
                changed.append(made)
        return changed

    def _combined(
        self, series: str, members: Sequence[DetectorAlarm], at_ns: int, known: DetectorAlarm | None
    ) -> DetectorAlarm:
        item, _, kind = series.rpartition(" ")
        ordered = sorted(members, key=lambda one: (one.leak, one.id))
        best: dict[str, float] = {}
        for one in ordered:
            best.setdefault(one.detector, one.leak)
        p_value = combined_p_value(best.values(), self._detectors)
        if known is not None and known.p_value <= p_value:
            return known
        reason = ScoreReason(
            kind, item, text=_text(ordered, p_value),
            contributions=tuple((one.id, _rareness(one.leak)) for one in ordered[:_MOST_MEMBERS]),
            suspects=tuple(dict.fromkeys(name for one in ordered for name in one.addresses)),
        )  # fmt: skip
        made = DetectorAlarm(
            COMBINED, series, min(one.onset_ns for one in members), at_ns, _rareness(p_value), 0.0,
            p_value, "fleet", reason, leak=p_value,
            detects=max(one.detects for one in members),
        )  # fmt: skip
        if known is None:
            return made
        return replace(made, onset_ns=known.onset_ns, confirmed_ns=known.confirmed_ns)

    def snapshot(self) -> list[dict[str, Any]]:
        """Return the alarms that last as JSON."""
        return [alarm_to_json(alarm) for alarm in self._open.values()]

    def resume(self, snapshot: Iterable[Mapping[str, Any]]) -> None:
        """Restore what ``snapshot`` returned; raise ValueError, KeyError or TypeError if wrong."""
        alarms = [alarm_from_json(alarm) for alarm in snapshot]
        self._open = {alarm.series: alarm for alarm in alarms}


def _rareness(p_value: float) -> float:
    """Return the decimal orders of magnitude of a p-value."""
    return -math.log10(max(p_value, 1e-300))


def _text(members: Sequence[DetectorAlarm], p_value: float) -> str:
    names = [f"{one.detector} {one.reason.finding} ({one.leak:.1g})" for one in members]
    more = f" and {len(names) - _MOST_MEMBERS} more" if len(names) > _MOST_MEMBERS else ""
    return (
        f"p-value {p_value:.1g} in a minute of nominal operation: "
        f"{', '.join(names[:_MOST_MEMBERS])}{more}"
    )
