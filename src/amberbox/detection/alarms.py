"""Alarms of detectors: when a score becomes one, what it states, and when it ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from amberbox.core.clock import NS
from amberbox.core.contracts import ScoreReason
from amberbox.core.options import option
from amberbox.core.types import Symptom
from amberbox.detection.baselines import Baseline

COMBINED: Final = "combined"
"""Stands for all detectors in alarms of an item."""


@dataclass(frozen=True)
class AlarmOptions:
    """Persistence and hysteresis of alarms."""

    persist_s: float = option(0.0, "time for which a score has to be over its threshold", unit="s")
    hold_s: float = option(2.0, "time below the threshold after which an alarm ends", unit="s")
    release: float = option(0.8, "share of the threshold below which a score counts as low again")


@dataclass(frozen=True, slots=True)
class DetectorAlarm:
    """One alarm of a detector; ``gone_ns`` is None while it lasts.

    ``onset_ns`` is when the score first was over its threshold, ``confirmed_ns`` when it had been
    for long enough. ``score``, ``threshold`` and ``p_value`` are those of the confirmation; with
    the baseline ``mission`` they are of the standardised score.

    ``leak`` is how probable such an alarm is in a minute of nominal operation, by the calibration
    and the rarest score since its onset; ``detects`` how probable the detector finds a fault.
    """

    detector: str
    series: str
    onset_ns: int
    confirmed_ns: int
    score: float
    threshold: float
    p_value: float
    baseline: Baseline
    reason: ScoreReason
    gone_ns: int | None = None
    leak: float = 1.0
    detects: float = 0.5

    @property
    def id(self) -> str:
        """Return ``detector.finding.item[.variable]``, which ``fmea.yaml`` can map."""
        parts = (self.detector, self.reason.finding, self.reason.item, self.reason.variable)
        return ".".join(part for part in parts if part)

    @property
    def addresses(self) -> tuple[str, ...]:
        """Return what it was measured from: variables, or items."""
        named = f"{self.reason.item}.{self.reason.variable}".rstrip(".")
        if self.detector == COMBINED:
            return self.reason.suspects or (named,)
        return tuple(dict.fromkeys((named, *(self.reason.conflict or self.reason.suspects))))

    def ended(self, at_ns: int) -> DetectorAlarm:
        """Return the alarm with its end."""
        return replace(self, gone_ns=at_ns)

    def symptom(self) -> Symptom:
        """Return it as evidence, with the addresses that it was measured from."""
        until_ns = self.gone_ns or self.confirmed_ns
        return Symptom(
            self.id,
            "present" if self.gone_ns is None else "absent",
            self.addresses[0],
            self.onset_ns,
            self.confirmed_ns,
            source="detector",
            evidence=tuple((address, self.onset_ns, until_ns) for address in self.addresses),
            reason=self.reason.text,
            gone_ns=self.gone_ns,
        )


class AlarmState:
    """The alarm of one series: off, over the threshold, on, and low again."""

    __slots__ = ("_hold_ns", "_low_ns", "_onset_ns", "_persist_ns", "is_on")

    def __init__(self, options: AlarmOptions) -> None:
        self._persist_ns, self._hold_ns = round(options.persist_s * NS), round(options.hold_s * NS)
        self._onset_ns: int | None = None
        self._low_ns: int | None = None
        self.is_on = False

    @property
    def is_idle(self) -> bool:
        """Return whether it is off, and not over the threshold."""
        return self._onset_ns is None

    @property
    def onset_ns(self) -> int:
        """Return when the score first was over the threshold (ns)."""
        assert self._onset_ns is not None
        return self._onset_ns

    def take(self, at_ns: int, *, over: bool, low: bool) -> bool:
        """Take a score; return whether an alarm begins or ends with it (see ``is_on``)."""
        if self.is_on:
            self._low_ns = None if not low else self._low_ns or at_ns
            return self._ends(at_ns)
        if not over:
            self._onset_ns = None
            return False
        self._onset_ns = at_ns if self._onset_ns is None else self._onset_ns
        self.is_on = at_ns - self._onset_ns >= self._persist_ns
        self._low_ns = None
        return self.is_on

    def pass_time(self, at_ns: int) -> bool:
        """Let time pass without a score; return whether the alarm ends."""
        return self.is_on and self._ends(at_ns)

    def _ends(self, at_ns: int) -> bool:
        if self._low_ns is None or at_ns - self._low_ns < self._hold_ns:
            return False
        self.is_on = False
        self._onset_ns = self._low_ns = None
        return True

    def snapshot(self) -> list[Any]:
        """Return its state as JSON."""
        return [self._onset_ns, self._low_ns, self.is_on]

    def resume(self, snapshot: Sequence[Any]) -> None:
        """Restore the state that ``snapshot`` returned."""
        self._onset_ns, self._low_ns, self.is_on = snapshot


def alarm_to_json(alarm: DetectorAlarm) -> dict[str, Any]:
    """Return an alarm as JSON."""
    return {**asdict(alarm), "id": alarm.id}


def alarm_from_json(values: Mapping[str, Any]) -> DetectorAlarm:
    """Read what ``alarm_to_json`` returned; raise ValueError, KeyError or TypeError if wrong."""
    given = {name: value for name, value in values.items() if name != "id"}
    reason = dict(given.pop("reason"))
    for name in ("transitions", "suspects", "conflict"):  # earlier versions wrote no conflict
        reason[name] = tuple(map(str, reason.get(name, ())))
    shares = [(str(name), float(share)) for name, share in reason["contributions"]]
    reason["contributions"] = tuple(shares)
    return DetectorAlarm(**given, reason=ScoreReason(**reason))
