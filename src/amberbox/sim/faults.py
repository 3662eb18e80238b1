"""Faults of the simulated robot: the catalogue, read from ``faults.yaml``, and the injector.

An active fault has a begin, an end and a course of strength; it turns knobs of the robot's parts.
"""

from __future__ import annotations

import difflib
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Any, Literal

import yaml

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.sim.noise import Noise

DOMAINS = (
    "motor",
    "encoder",
    "bus",
    "laser",
    "imu",
    "battery",
    "network",
    "software",
    "localisation",
    "mechanics",
    "safety",
)
OnsetKind = Literal["step", "ramp", "intermittent"]


@dataclass(frozen=True, slots=True)
class FaultMagnitude:
    """How strong a fault is: the default, the range that makes sense, and the unit."""

    default: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True, slots=True)
class FaultOnset:
    """How a fault begins: at once, growing over some time, or coming and going."""

    kind: OnsetKind
    over_s: float = 0.0
    period_s: float = 0.0
    duty: float = 0.0

    def __str__(self) -> str:
        if self.kind == "ramp":
            return f"ramp over {self.over_s:g} s"
        if self.kind == "intermittent":
            return f"intermittent, {self.duty:.0%} of {self.period_s:g} s"
        return "step"


@dataclass(frozen=True, slots=True)
class FaultEffect:
    """One effect of a fault: a knob of a part moves by ``gain`` times the magnitude."""

    part: str
    knob: str
    gain: float


@dataclass(frozen=True, slots=True)
class SimulatedFault:
    """One way in which a component fails.

    ``affects`` names the affected parts, ``shows_in`` variables (topic.path) that show its effects
    after ``visible_s`` at the latest in the scenario named.
    """

    id: str
    component: str
    domain: str
    description: str
    magnitude: FaultMagnitude
    onset: FaultOnset
    effects: tuple[FaultEffect, ...]
    affects: tuple[str, ...]
    shows_in: tuple[str, ...]
    visible_s: float
    scenario: str


@functools.cache
def catalogue() -> Mapping[str, SimulatedFault]:
    """Return the faults of the catalogue, by id."""
    text = resources.files("amberbox.sim").joinpath("faults.yaml").read_text()
    return parse_faults(text, "faults.yaml")


def load_faults(path: Path) -> Mapping[str, SimulatedFault]:
    """Read a user's fault catalogue; raises AmberboxError naming file and entry."""
    return parse_faults(path.read_text(), str(path))


def parse_faults(text: str, origin: str) -> Mapping[str, SimulatedFault]:
    """Read a catalogue from YAML text."""
    faults: dict[str, SimulatedFault] = {}
    for number, entry in enumerate(yaml.safe_load(text) or [], start=1):
        for values in _expand(entry):
            fault = _fault(values, f"{origin}: entry {number}")
            if fault.id in faults:
                raise AmberboxError(f"{origin}: {fault.id} stands there twice", "rename one")
            faults[fault.id] = fault
    return faults


def find_fault(fault_id: str) -> SimulatedFault:
    """Return a fault by id; raises UsageError with a suggestion when there is none."""
    faults = catalogue()
    if fault_id in faults:
        return faults[fault_id]
    close = difflib.get_close_matches(fault_id, faults, n=1)
    hint = f"did you mean {close[0]}?" if close else "python -m amberbox.sim --list-faults"
    raise UsageError(f"unknown fault {fault_id!r}", hint)


def _expand(entry: dict[str, Any]) -> list[dict[str, Any]]:
    """Write an entry out once for each combination of its ``for`` lists."""
    loops = entry.get("for", {})
    body = {key: value for key, value in entry.items() if key != "for"}
    return [
        _fill(body, dict(zip(loops, values, strict=True))) for values in product(*loops.values())
    ]


def _fill(value: Any, names: Mapping[str, str]) -> Any:
    if isinstance(value, dict):
        return {key: _fill(item, names) for key, item in value.items()}
    if isinstance(value, list):
        return [_fill(item, names) for item in value]
    if isinstance(value, str):
        for name, replacement in names.items():
            value = value.replace(f"<{name}>", replacement)
    return value


def _fault(entry: dict[str, Any], where: str) -> SimulatedFault:
    try:
        low, high = entry["magnitude"].pop("range")
        return SimulatedFault(
            id=entry["id"],
            component=entry["component"],
            domain=_domain(entry["domain"]),
            description=entry["description"],
            magnitude=FaultMagnitude(low=low, high=high, **entry["magnitude"]),
            onset=FaultOnset(**entry.get("onset", {"kind": "step"})),
            effects=tuple(FaultEffect(**effect) for effect in entry["effects"]),
            affects=tuple(entry["affects"]),
            shows_in=tuple(entry["shows_in"]),
            visible_s=entry.get("visible_s", 3.0),
            scenario=entry.get("scenario", "transport"),
        )
    except (KeyError, TypeError, ValueError) as error:
        name = entry.get("id", "without id") if isinstance(entry, dict) else entry
        raise AmberboxError(
            f"{where} ({name}): {error}", "see docs/start/simulator.md, how to add a fault"
        ) from error


def _domain(name: str) -> str:
    if name not in DOMAINS:
        raise ValueError(f"unknown domain {name!r}, one of {', '.join(DOMAINS)}")
    return name


@dataclass(frozen=True, slots=True)
class ActiveFault:
    """An injected fault, as the truth records it; ``level`` is 0 while it pauses."""

    id: str
    component: str
    magnitude: float
    since_s: float
    level: float


class _Course:
    """The course of one injected fault: its level from 0 to 1 over time."""

    def __init__(
        self, fault: SimulatedFault, at_s: float, magnitude: float, until_s: float, noise: Noise
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
            while now_s >= self._cycle_until_s:
                length_s = onset.period_s * self._noise.uniform(0.7, 1.3)
                self._on_until_s = self._cycle_until_s + onset.duty * length_s
                self._cycle_until_s += length_s
            return 1.0 if now_s < self._on_until_s else 0.0
        return 1.0


class Injector:
    """Sets the knobs of the robot's parts by the active faults.

    Faults add up: the value of a knob is its nominal value plus gain x magnitude x level of each
    fault.
    """

    def __init__(self, seed: int, parts: Mapping[str, object]) -> None:
        self._seed = seed
        self._parts = parts
        self._courses: list[_Course] = []
        self._nominal: dict[tuple[str, str], float] = {}

    def add(
        self,
        fault: str | SimulatedFault,
        at_s: float,
        magnitude: float | None,
        until_s: float | None,
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
        """End every occurrence of a fault; raises UsageError if there is none."""
        courses = [course for course in self._courses if course.fault.id == fault_id]
        if not courses:
            raise UsageError(f"{fault_id} was not injected", "inject it first")
        for course in courses:
            course.until_s = min(course.until_s, now_s)

    def heal_part(self, part: str, now_s: float) -> None:
        """End every fault that affects a part."""
        for course in self._courses:
            if any(effect.part == part for effect in course.fault.effects):
                course.until_s = min(course.until_s, now_s)

    def apply(self, now_s: float) -> None:
        """Set all knobs to their present values."""
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
