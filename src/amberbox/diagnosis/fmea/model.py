"""A failure mode and effects analysis as it is used: types written out, names resolved."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from amberbox.core.expression import Expression
from amberbox.core.needs import NOTHING, Needs
from amberbox.core.robotstatus import SEVERITIES as SEVERITIES
from amberbox.core.robotstatus import Severity as Severity

Kind: TypeAlias = Literal["read", "question", "check"]


@dataclass(frozen=True, slots=True)
class Symptom:
    """Something that can be seen: a monitor's output that is bad, or a condition that is true.

    ``id`` is the address of the output, or a name of the file; then ``condition`` is what must
    be true. ``leak`` is how probable it shows although no cause of it is there. It counts as
    absent only ``within_s`` after a cause can have begun, and is remembered for ``hold_s``.
    ``by_itself``: it counts also while its component is blocked.
    """

    id: str
    condition: Expression | None = None
    leak: float = 0.0
    within_s: float = 0.0
    hold_s: float = 0.0
    description: str = ""
    by_itself: bool = False


@dataclass(frozen=True, slots=True)
class Link:
    """A cause shows a symptom: how probable, within what time, remembered for how long."""

    symptom: str
    detects: float
    within_s: float
    hold_s: float


@dataclass(frozen=True, slots=True)
class Effects:
    """What a failure mode does: to its component (text), next to it, and to the system.

    ``next`` and ``system`` are names of components and functions; what the file does not say is
    derived from what needs the component.
    """

    local: str = ""
    next: tuple[str, ...] = ()
    system: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Ranks:
    """Severity, occurrence and detection from 1 (good) to 10 (bad); None where nobody knows."""

    severity: int | None = None
    occurrence: int | None = None
    detection: int | None = None

    @property
    def number(self) -> int | None:
        """Return the risk priority number S x O x D, None if one of them is not known."""
        if self.severity is None or self.occurrence is None or self.detection is None:
            return None
        return self.severity * self.occurrence * self.detection


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a test gives when a failure mode is there, and how surely."""

    test: str
    outcome: str
    detects: float


@dataclass(frozen=True, slots=True)
class FailureMode:
    """One way in which a component fails; its ``id`` is ``component#mode``.

    ``rate`` is per hour of exposure (mode ratio times the component's rate, where the file says
    it so); else ``probability`` holds whatever the exposure. ``beta`` is the conditional
    probability that the effect on the system comes about. ``takes_down`` tells whether the
    component stops serving those that need it. ``make_safe`` is what has to be done before anybody
    tests or repairs it, ``remedy`` what mends it. ``line`` is where the file has it.
    """

    id: str
    component: str
    name: str
    description: str = ""
    cause: str = ""
    classes: tuple[str, ...] = ()
    severity: Severity = "urgent"
    rate: float | None = None
    probability: float | None = None
    exposure_h: float = 24.0
    beta: float = 1.0
    ranks: Ranks = Ranks()
    effects: Effects = Effects()
    symptoms: tuple[Link, ...] = ()
    unobservable: str = ""
    tests: tuple[Outcome, ...] = ()
    remedy: str = ""
    takes_down: bool = True
    intermittent: bool = False
    line: int = 0
    make_safe: str = ""

    def chance(self, exposure_h: float | None = None) -> float:
        """Return how probable it is to be there: after an exposure, else its own."""
        if self.rate is None:
            return self.probability or 0.0
        return -math.expm1(-self.rate * (self.exposure_h if exposure_h is None else exposure_h))


@dataclass(frozen=True, slots=True)
class Component:
    """A part that can fail; it serves when no mode has taken it down and its needs are met."""

    id: str
    type: str
    description: str = ""
    needs: Needs = NOTHING
    modes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Function:
    """Something the robot can do; lost when its needs are not met. ``system`` marks the top."""

    id: str
    needs: Needs
    description: str = ""
    system: bool = False
    severity: Severity = "urgent"
    symptoms: tuple[Link, ...] = ()


@dataclass(frozen=True, slots=True)
class FmeaTest:
    """Something to look at, ask or check; the first outcome is that of a sound robot.

    ``sure`` is how probable that outcome is when no failure mode says otherwise.
    """

    id: str
    kind: Kind
    text: str
    role: str = ""
    cost_s: float = 0.0
    risk: float = 0.0
    outcomes: tuple[str, ...] = ("no", "yes")
    sure: float = 0.99


@dataclass(frozen=True, slots=True)
class Mapped:
    """What another engine finds: answers of a ``goal`` of rules, or a ``finding`` by its id.

    ``maps_to`` are failure modes that it speaks for, in which ``<Variable>`` stands for a value;
    none: it is only shown. ``proves``: at least one of them is there, so that it is no symptom.
    """

    goal: str = ""
    finding: str = ""
    maps_to: tuple[str, ...] = ()
    detects: float = 0.99
    leak: float = 1e-4
    proves: bool = False
    description: str = ""


@dataclass(frozen=True, slots=True)
class Other:
    """Something that is not in this analysis: how probable, and what it shows of anything.

    ``looks_like`` is how probable it looks like a failure mode when it looks like several that
    begin within ``together_s``.
    """

    probability: float = 1e-3
    detects: float = 0.5
    looks_like: float = 0.0
    together_s: float = 10.0


@dataclass(frozen=True, slots=True)
class Fmea:
    """Everything, by id. ``members`` are the robots of a team with their folders, where named.

    For ``remember_s`` a symptom that nobody can look at any more goes on to count.
    """

    name: str
    modes: Mapping[str, FailureMode]
    components: Mapping[str, Component]
    functions: Mapping[str, Function]
    symptoms: Mapping[str, Symptom]
    tests: Mapping[str, FmeaTest] = field(default_factory=dict)
    other: Other = Other()
    exposure_h: float = 24.0
    findings: tuple[Mapped, ...] = ()
    members: Mapping[str, str] = field(default_factory=dict)
    remember_s: float = 600.0

    def needs(self) -> dict[str, Needs]:
        """Return what each component and function needs."""
        needs = {name: component.needs for name, component in self.components.items()}
        return needs | {name: function.needs for name, function in self.functions.items()}

    def system_functions(self) -> tuple[str, ...]:
        """Return the effects on the system: functions that are marked so, else all."""
        marked = tuple(name for name, function in self.functions.items() if function.system)
        return marked or tuple(self.functions)
