"""The fault catalogue: what can go wrong with the robot, read from ``faults.yaml``."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Any, Literal

import yaml

from amberbox.core.errors import AmberboxError, UsageError

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
class Magnitude:
    """How strong a fault is: the default, the range that makes sense, and the unit."""

    default: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True, slots=True)
class Onset:
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
class Effect:
    """What a fault turns: a knob of a part moves by ``gain`` times the magnitude."""

    part: str
    knob: str
    gain: float


@dataclass(frozen=True, slots=True)
class Fault:
    """One way in which a component fails.

    ``affects`` names the parts that feel it, ``shows_in`` variables (topic.path) where its
    consequences stand at the latest after ``visible_s`` in the scenario named.
    """

    id: str
    component: str
    domain: str
    description: str
    magnitude: Magnitude
    onset: Onset
    effects: tuple[Effect, ...]
    affects: tuple[str, ...]
    shows_in: tuple[str, ...]
    visible_s: float
    scenario: str


@functools.cache
def catalogue() -> Mapping[str, Fault]:
    """Return the faults that come with the package, by id."""
    text = resources.files("amberbox.sim").joinpath("faults.yaml").read_text()
    return parse_faults(text, "faults.yaml")


def load_faults(path: Path) -> Mapping[str, Fault]:
    """Read a fault catalogue of one's own; raises AmberboxError naming file and entry."""
    return parse_faults(path.read_text(), str(path))


def parse_faults(text: str, origin: str) -> Mapping[str, Fault]:
    """Read a catalogue from YAML text."""
    faults: dict[str, Fault] = {}
    for number, entry in enumerate(yaml.safe_load(text) or [], start=1):
        for values in _expand(entry):
            fault = _fault(values, f"{origin}: entry {number}")
            if fault.id in faults:
                raise AmberboxError(f"{origin}: {fault.id} stands there twice", "rename one")
            faults[fault.id] = fault
    return faults


def find_fault(fault_id: str) -> Fault:
    """Return a fault by id; UsageError with a suggestion when there is none."""
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


def _fault(entry: dict[str, Any], where: str) -> Fault:
    try:
        low, high = entry["magnitude"].pop("range")
        return Fault(
            id=entry["id"],
            component=entry["component"],
            domain=_domain(entry["domain"]),
            description=entry["description"],
            magnitude=Magnitude(low=low, high=high, **entry["magnitude"]),
            onset=Onset(**entry.get("onset", {"kind": "step"})),
            effects=tuple(Effect(**effect) for effect in entry["effects"]),
            affects=tuple(entry["affects"]),
            shows_in=tuple(entry["shows_in"]),
            visible_s=entry.get("visible_s", 3.0),
            scenario=entry.get("scenario", "transport"),
        )
    except (KeyError, TypeError, ValueError) as error:
        name = entry.get("id", "without id") if isinstance(entry, dict) else entry
        raise AmberboxError(
            f"{where} ({name}): {error}", "see docs/simulator.md, how to add a fault"
        ) from error


def _domain(name: str) -> str:
    if name not in DOMAINS:
        raise ValueError(f"unknown domain {name!r}, one of {', '.join(DOMAINS)}")
    return name
