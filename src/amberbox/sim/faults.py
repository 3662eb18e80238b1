"""Faults at work: when each begins and ends, how strong it is now, which knobs it turns."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from amberbox.core.errors import UsageError
from amberbox.sim.catalogue import Fault, Onset, find_fault
from amberbox.sim.noise import Noise


@dataclass(frozen=True, slots=True)
class ActiveFault:
    """A fault that was injected, as the truth tells it; ``level`` is 0 while it pauses."""

    id: str
    component: str
    magnitude: float
    since_s: float
    level: float


class _Course:
    """The course of one injected fault: its level from 0 to 1 over time."""

    def __init__(
        self, fault: Fault, at_s: float, magnitude: float, until_s: float, noise: Noise
    ) -> None:
        self.fault, self.magnitude = fault, magnitude
        self.at_s, self.until_s = at_s, until_s
        self.level = 0.0
        self._noise = noise
        self._cycle_s, self._on_until_s, self._cycle_until_s = at_s, at_s, at_s

    def update(self, now_s: float) -> bool:
        """Compute the level now; return whether it has changed."""
        before, self.level = self.level, self._level(now_s)
        return self.level != before

    def _level(self, now_s: float) -> float:
        if not self.at_s <= now_s < self.until_s:
            return 0.0
        onset = self.fault.onset
        if onset.kind == "ramp":
            return min(1.0, (now_s - self.at_s) / onset.over_s)
        if onset.kind == "intermittent":
            return self._blink(now_s, onset)
        return 1.0

    def _blink(self, now_s: float, onset: Onset) -> float:
        while now_s >= self._cycle_until_s:
            length_s = onset.period_s * self._noise.uniform(0.7, 1.3)
            self._on_until_s = self._cycle_until_s + onset.duty * length_s
            self._cycle_until_s += length_s
        return 1.0 if now_s < self._on_until_s else 0.0


class Injector:
    """Turns the knobs of the robot's parts as the faults that act demand.

    Faults add up: a knob stands at its nominal value plus gain x magnitude x level of each.
    """

    def __init__(self, seed: int, parts: Mapping[str, object]) -> None:
        self._seed = seed
        self._parts = parts
        self._courses: list[_Course] = []
        self._nominal: dict[tuple[str, str], float] = {}

    def add(
        self, fault: str | Fault, at_s: float, magnitude: float | None, until_s: float | None
    ) -> None:
        """Schedule a fault; UsageError for an unknown one or a magnitude out of its range."""
        fault = find_fault(fault) if isinstance(fault, str) else fault
        size = fault.magnitude
        magnitude = size.default if magnitude is None else magnitude
        if not size.low <= magnitude <= size.high:
            hint = f"take one from {size.low:g} to {size.high:g} {size.unit}"
            raise UsageError(f"{fault.id}: magnitude {magnitude:g} is out of range", hint)
        end_s = math.inf if until_s is None else until_s
        if end_s <= at_s:
            raise UsageError(f"{fault.id}: ends at {end_s:g} s, before it begins", "until > at")
        noise = Noise(self._seed, f"fault {fault.id} {len(self._courses)}")
        for effect in fault.effects:
            key = (effect.part, effect.knob)
            self._nominal.setdefault(key, getattr(self._parts[effect.part], effect.knob))
        self._courses.append(_Course(fault, at_s, magnitude, end_s, noise))

    def heal(self, fault_id: str, now_s: float) -> None:
        """End every course of a fault; UsageError if there is none."""
        courses = [course for course in self._courses if course.fault.id == fault_id]
        if not courses:
            raise UsageError(f"{fault_id} was not injected", "inject it first")
        for course in courses:
            course.until_s = min(course.until_s, now_s)

    def apply(self, now_s: float) -> None:
        """Bring all knobs to where they stand now."""
        changed = [course for course in self._courses if course.update(now_s)]
        for key in {(e.part, e.knob) for course in changed for e in course.fault.effects}:
            setattr(self._parts[key[0]], key[1], self._nominal[key] + self._offset(key))

    def active(self, now_s: float) -> list[ActiveFault]:
        """Return the faults between their begin and end."""
        return [
            ActiveFault(c.fault.id, c.fault.component, c.magnitude, c.at_s, c.level)
            for c in self._courses
            if c.at_s <= now_s < c.until_s
        ]

    def _offset(self, key: tuple[str, str]) -> float:
        return sum(
            effect.gain * course.magnitude * course.level
            for course in self._courses
            for effect in course.fault.effects
            if (effect.part, effect.knob) == key
        )
