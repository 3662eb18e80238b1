"""A failure mode and effects analysis with types expanded and names resolved.

``FmeaReferences`` are the names of the robot's other files that failure modes can refer to;
``DependencyStructure`` gives the components and functions lost when failure modes are present.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from amberbox.core.expression import Expression
from amberbox.core.needs import NOTHING, Needs
from amberbox.core.robot_status import Severity


@dataclass(frozen=True, slots=True)
class FmeaReferences:
    """The names that failure modes can refer to.

    ``outputs`` are the addresses of all outputs of monitors (``component/mode/output``),
    ``watched`` those with an expected value: only they can be symptoms. ``needs`` are those of
    component files, with a key for every component of the folder; they apply if the failure modes'
    file has none. ``addresses`` are those that conditions may also read, None if unknown. ``files``
    are the files of the components with monitors. ``predicates`` are the names that a finding's
    goal may have, None if the rules are not known; ``heads`` those of rules that no other rule
    calls, with file and line.
    """

    outputs: Collection[str] = ()
    watched: Collection[str] = ()
    needs: Mapping[str, Needs] = field(default_factory=dict)
    addresses: Collection[str] | None = None
    predicates: Collection[tuple[str, int]] | None = None
    heads: Mapping[tuple[str, int], tuple[str, int]] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)


Kind: TypeAlias = Literal["read", "question", "check"]


@dataclass(frozen=True, slots=True)
class FmeaSymptom:
    """An observable symptom: a monitor's output that is bad, or a condition that is true.

    ``id`` is the address of the output, or a name of the file with its ``condition``. ``leak`` is
    the probability that it appears without any of its causes. It counts as absent only ``within_s``
    after a cause can have begun, and is remembered for ``hold_s``. ``by_itself``: it counts also
    while its component is blocked.
    """

    id: str
    condition: Expression | None = None
    leak: float = 0.0
    within_s: float = 0.0
    hold_s: float = 0.0
    description: str = ""
    by_itself: bool = False


@dataclass(frozen=True, slots=True)
class SymptomLink:
    """A cause shows a symptom: how probable, within what time, remembered for how long."""

    symptom: str
    detects: float
    within_s: float
    hold_s: float


@dataclass(frozen=True, slots=True)
class ModeEffects:
    """The effects of a failure mode: on its component (text), on the next components, on the
    system.

    ``next`` and ``system`` are names of components and functions; effects that the file leaves out
    are derived from needs.
    """

    local: str = ""
    next: tuple[str, ...] = ()
    system: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RiskRanks:
    """Severity, occurrence and detection from 1 (good) to 10 (bad); None where unknown."""

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
class ExpectedOutcome:
    """The outcome of a test when a failure mode is present, with its probability."""

    test: str
    outcome: str
    detects: float


@dataclass(frozen=True, slots=True)
class FailureMode:
    """One way in which a component fails; its ``id`` is ``component#mode``.

    ``rate`` is per hour of exposure (mode ratio times the component's rate, if the file gives
    these); otherwise ``probability`` applies for any exposure. ``beta`` is the conditional
    probability that the effect on the system occurs. ``takes_down``: the component stops serving
    those that need it. ``make_safe`` is required before a test or repair, ``remedy`` is the repair.
    ``line`` is its line in the file.
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
    ranks: RiskRanks = RiskRanks()
    effects: ModeEffects = ModeEffects()
    symptoms: tuple[SymptomLink, ...] = ()
    unobservable: str = ""
    tests: tuple[ExpectedOutcome, ...] = ()
    remedy: str = ""
    takes_down: bool = True
    intermittent: bool = False
    line: int = 0
    make_safe: str = ""

    def chance(self, exposure_h: float | None = None) -> float:
        """Return the probability that it is present: after the given exposure, else its own."""
        if self.rate is None:
            return self.probability or 0.0
        return -math.expm1(-self.rate * (self.exposure_h if exposure_h is None else exposure_h))


@dataclass(frozen=True, slots=True)
class FmeaComponent:
    """A part that can fail; it serves when no mode has taken it down and its needs are met."""

    id: str
    type: str
    description: str = ""
    needs: Needs = NOTHING
    modes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FmeaFunction:
    """Something the robot can do; lost when its needs are not met. ``system`` marks the top."""

    id: str
    needs: Needs
    description: str = ""
    system: bool = False
    severity: Severity = "urgent"
    symptoms: tuple[SymptomLink, ...] = ()


@dataclass(frozen=True, slots=True)
class FmeaTest:
    """A test: a check or a question; the first outcome is that of a sound robot.

    ``sure`` is the probability of that outcome when no failure mode affects it.
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
class FindingMapping:
    """A finding of another engine: answers of a ``goal`` of rules, or a ``finding`` by its id.

    ``maps_to`` are failure modes that it indicates, in which ``<Variable>`` stands for a value;
    without any it is only shown. ``proves``: at least one of them is present, so that it is a
    conflict, not a symptom.
    """

    goal: str = ""
    finding: str = ""
    maps_to: tuple[str, ...] = ()
    detects: float = 0.99
    leak: float = 1e-4
    proves: bool = False
    description: str = ""


@dataclass(frozen=True, slots=True)
class UnlistedFault:
    """A fault that is not in this analysis: its probability, and that of any symptom of it.

    ``looks_like`` is the probability that it looks like a failure mode when it looks like several
    that begin within ``together_s``.
    """

    probability: float = 1e-3
    detects: float = 0.5
    looks_like: float = 0.0
    together_s: float = 10.0


@dataclass(frozen=True, slots=True)
class Fmea:
    """The whole analysis, by id. ``members`` are a team's robots with their folders, where named.

    A symptom that cannot be evaluated any more continues to count for ``remember_s``.
    """

    name: str
    modes: Mapping[str, FailureMode]
    components: Mapping[str, FmeaComponent]
    functions: Mapping[str, FmeaFunction]
    symptoms: Mapping[str, FmeaSymptom]
    tests: Mapping[str, FmeaTest] = field(default_factory=dict)
    other: UnlistedFault = UnlistedFault()
    exposure_h: float = 24.0
    findings: tuple[FindingMapping, ...] = ()
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


@dataclass(frozen=True, slots=True)
class DependencyStructure:
    """The inverse of needs: ``users`` are the components and functions that need one directly."""

    needs: Mapping[str, Needs]
    users: Mapping[str, tuple[str, ...]]

    @classmethod
    def of(cls, needs: Mapping[str, Needs]) -> DependencyStructure:
        """Return the structure of needs."""
        users: dict[str, list[str]] = {}
        for user, of in needs.items():
            for name in of.names():
                users.setdefault(name, []).append(user)
        return cls(needs, {name: tuple(found) for name, found in users.items()})

    def dependents(self, names: Iterable[str]) -> frozenset[str]:
        """Return everything that needs one of the names, directly or not, ignoring redundancy."""
        found: set[str] = set()
        waiting = list(names)
        while waiting:
            more = [user for user in self.users.get(waiting.pop(), ()) if user not in found]
            found.update(more)
            waiting += more
        return frozenset(found)

    def lost(self, down: Collection[str]) -> frozenset[str]:
        """Return what no longer serves when these components are down, they included."""
        gone = set(down)
        waiting = list(gone)
        while waiting:
            for user in self.users.get(waiting.pop(), ()):
                if user not in gone and not self.needs[user].met(lambda name: name not in gone):
                    gone.add(user)
                    waiting.append(user)
        return frozenset(gone)


def lost(fmea: Fmea, modes: Iterable[str]) -> frozenset[str]:
    """Return the components and functions that no longer serve while these modes are present."""
    down = {fmea.modes[mode].component for mode in modes if fmea.modes[mode].takes_down}
    return DependencyStructure.of(fmea.needs()).lost(down)


def links_by_mode(fmea: Fmea) -> dict[str, tuple[SymptomLink, ...]]:
    """Return the symptoms of each mode alone: its own and those of the functions it loses."""
    structure = DependencyStructure.of(fmea.needs())
    of_loss = {
        name: tuple(
            link
            for gone in sorted(structure.lost([name]))
            if gone in fmea.functions
            for link in fmea.functions[gone].symptoms
        )
        for name in fmea.components
    }
    return {
        mode.id: (*mode.symptoms, *(of_loss[mode.component] if mode.takes_down else ()))
        for mode in fmea.modes.values()
    }


def miss_probability(links: Iterable[SymptomLink]) -> float:
    """Return how probable it is that none of the symptoms shows."""
    share = 1.0
    for link in links:
        share *= 1.0 - link.detects
    return share
