"""The life of one output: pending, confirmed, healed, flapping."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final, Literal, TypeAlias

from amberbox.core.clock import NS
from amberbox.core.robotstatus import RANK as RANK
from amberbox.core.robotstatus import SEVERITIES as SEVERITIES
from amberbox.core.robotstatus import worst as worst
from amberbox.core.types import Level, Output
from amberbox.monitoring.engine.findings import TICK_NS, Found, What
from amberbox.monitoring.plan import Expectation, OutputPlan, Severity

FUNCTIONAL: Final[frozenset[Level]] = frozenset(("ok", "warn"))
"""Levels of what others can build on."""
NOT_MEASURED: Final = "not measured yet"
News: TypeAlias = Literal["none", "other", "value"]
"""What is new of an output: nothing, another value of a bool or a text, or something else."""
_CODES: Final[tuple[What, ...]] = ("ok", "bad", "unknown", "stale")
_PLAIN: Final[tuple[Any, ...]] = (0, None, "", False, True, None, 1, [], None, None)
"""Snapshot of an output that is ok and has been for long."""


class OutputState:
    """What counts of an output: what is found of it, once that has lasted long enough.

    ``due_ns`` is when what is found will count, ``calm_ns`` when flapping ends; None for never.
    ``onset_ns`` is when it began to be bad, whether that counted at once or not.
    """

    __slots__ = (
        *("plan", "mode", "level", "shown", "due_ns", "calm_ns", "onset_ns", "_for_ns", "_heal_ns"),
        *("_flap_ns", "_discrete", "_raw", "_value", "_why", "_fault", "_good", "_ill", "_flips"),
    )

    def __init__(self, plan: OutputPlan, mode: int) -> None:
        self.plan = plan
        self.mode = mode
        self._for_ns = round(plan.for_s * NS)
        self._heal_ns = round(plan.heal_s * NS)
        self._flap_ns = round(plan.flap_s * NS)
        self._discrete = plan.type in ("bool", "string")
        self.begin()

    def begin(self) -> None:
        """Forget everything: nothing is measured yet."""
        self.level: Level = "unknown"
        self.shown: What = "unknown"
        self.due_ns: int | None = None
        self.calm_ns: int | None = None
        self.onset_ns: int | None = None
        self._raw: What = "unknown"
        self._value: Output = None
        self._why = NOT_MEASURED
        self._fault: bool | None = None
        self._good: bool | None = None
        self._ill: What = "bad"
        self._flips: list[int] = []

    @property
    def value(self) -> Output:
        """Its last value, if that is a bool or a text: numbers come with each status."""
        return self._value if self._discrete else None

    @property
    def severity(self) -> Severity:
        """What the robot can still do, by what is shown."""
        return self.plan.severity if self.shown == "bad" else "urgent"

    @property
    def measured(self) -> str:
        """What was measured when it turned bad and what it should be; empty if nobody can say."""
        if self._raw != "bad":
            return ""
        if self._why or self.plan.type == "bool" or self._value is None:
            return self._why
        value = f"{self._value} {self.plan.result.unit}".rstrip()
        name = self.plan.name.replace("_", " ")
        return f"{name} is {value}, expected {expected_text(self.plan)}"

    def take(self, found: Found) -> News:
        """Take what is found; a number that changes alone is no news."""
        at_ns, _, what, value, why = found
        differs = self._discrete and value != self._value
        if what != self._raw:
            self._turn(what, at_ns)
        elif not differs and why == self._why:
            return "none"
        self._value = value if self._discrete else _number_text(value) if what == "bad" else None
        self._raw, self._why = what, why
        return "value" if differs else "other"

    def _turn(self, what: What, at_ns: int) -> None:
        self.due_ns = None
        if what == "bad" and self.shown != "bad":
            self.onset_ns = at_ns
        if what == "bad" and self._fault is not True:
            self.due_ns = _tick(at_ns + self._for_ns)
        elif what == "ok" and self._fault is not False:
            self.due_ns = at_ns if self._fault is None else _tick(at_ns + self._heal_ns)

    def hold_up(self, from_ns: int, to_ns: int) -> bool:
        """Put off when what is found will count, by a stretch that is not known; tell whether."""
        if self.due_ns is None or self.due_ns <= from_ns:
            return False
        self.due_ns = _tick(self.due_ns + to_ns - from_ns)
        return True

    def settle(self, now_ns: int) -> None:
        """Let what is found count if it is time, and tell whether it flaps."""
        if self.due_ns is not None and now_ns >= self.due_ns:
            self._fault, self.due_ns = self._raw == "bad", None
        if self.calm_ns is not None and now_ns >= self.calm_ns:
            self.calm_ns, self._flips = None, []
        base = self._base()
        if base != "unknown":
            self._count(base, now_ns)
        self.shown = self._ill if self.calm_ns is not None and base == "ok" else base
        self.level = self._level()

    def _base(self) -> What:
        if self._raw in ("unknown", "stale"):
            return self._raw
        if self._fault is None:
            return "unknown"
        return "bad" if self._fault else "ok"

    def _count(self, base: What, now_ns: int) -> None:
        """Count a change between good and not good."""
        good = base == "ok"
        if not good:
            self._ill = base
        if self._good is not None and good != self._good and self.plan.flaps > 0:
            self._flips = [t for t in self._flips if t >= now_ns - self._flap_ns] + [now_ns]
            self._flips = self._flips[-self.plan.flaps - 1 :]
            if self.calm_ns is not None or len(self._flips) > self.plan.flaps:
                self.calm_ns = _tick(now_ns + self._flap_ns)
        self._good = good

    def _level(self) -> Level:
        if self.shown == "bad":
            return "warn" if self.plan.severity == "warning" else "error"
        return self.shown

    def text(self) -> tuple[str, str]:
        """Say what is shown in a line for a person: the fact, and why if that is known."""
        if self.calm_ns is not None and self.shown != "unknown":
            plan = self.plan
            return f"{plan.name} flapping: {plan.flaps + 1} changes in {plan.flap_s:g} s", ""
        if self._raw == "bad":
            fact = f"{self.plan.name} is {_shown(self._value)}, expected {expected_text(self.plan)}"
            return (fact if self._fault is not None else f"not confirmed yet: {fact}"), self._why
        if self.shown == "bad":
            return f"{self.plan.name} was not as expected less than {self.plan.heal_s:g} s ago", ""
        return self._why, ""

    def snapshot(self, now_ns: int) -> list[Any]:
        """Return what has to be known to go on; nothing for a number that is ok."""
        flips = [t for t in self._flips if t >= now_ns - self._flap_ns]
        why = None if self._why == NOT_MEASURED else self._why
        entry = [
            _CODES.index(self._raw), self._value, why, self._fault, self._good,
            self.due_ns, _CODES.index(self._ill), flips, self.calm_ns,
            self.onset_ns if self._may_be_bad() else None,
        ]  # fmt: skip
        while entry and entry[-1] == _PLAIN[len(entry) - 1]:
            entry.pop()
        return entry

    def _may_be_bad(self) -> bool:
        """Tell whether it can be shown as bad without being found so once more."""
        return "bad" in (self._raw, self.shown) or self._fault is True

    def resume(self, entry: Sequence[Any], now_ns: int) -> None:
        """Go on from what ``snapshot`` returned at ``now_ns``."""
        full = [*entry, *_PLAIN[len(entry) :]]
        raw, self._value, why, self._fault, self._good = full[:5]
        self.due_ns, ill, flips, self.calm_ns, self.onset_ns = full[5:]
        self._raw, self._ill = _CODES[raw], _CODES[ill]
        self._why = NOT_MEASURED if why is None else why
        self._flips = list(flips)
        self.settle(now_ns)


def highest(severities: Iterable[Severity]) -> Severity:
    """Return the highest of some severities; ``urgent`` of none."""
    return max(severities, key=SEVERITIES.index, default="urgent")


def expected_text(plan: OutputPlan) -> str:
    """Say what an output should be."""
    if plan.expectation.value is None and plan.type == "bool":
        return str(Expectation(plan.result.nominal))
    return str(plan.expectation)


def _number_text(value: Output) -> str | None:
    """Write a number for people: it is kept for the reason only."""
    if isinstance(value, float):
        return f"{value:.6g}"
    return None if value is None else str(value)


def _shown(value: Output) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return "not known" if value is None else str(value)


def _tick(time_ns: int) -> int:
    """Return the first instant at or after a time."""
    return -(-time_ns // TICK_NS) * TICK_NS
