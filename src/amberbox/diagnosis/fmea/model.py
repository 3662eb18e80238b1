"""A failure mode and effects analysis with types expanded and names resolved.

``FmeaReferences`` are the names of the robot's other files that failure modes can refer to;
``DependencyStructure`` gives the components and functions lost when failure modes are present.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

from amberbox.core.expression import Expression
from amberbox.core.needs import NOTHING, Needs
from amberbox.core.robot_status import Severity
from amberbox.core.types import RunKind, TestKind


@dataclass(frozen=True, slots=True)
class RunFacts:
    """What is known of an experiment or unit test: its usual duration, and whether it moves.

    One that is ``parametrised`` runs as ``NAME-VALUE``.
    """

    duration_s: float | None = None
    moves: bool = False
    parametrised: bool = False


@dataclass(frozen=True, slots=True)
class SymptomMeasure:
    """How large a symptom is: a signed number, and its unit; empty if unknown."""

    expression: Expression
    unit: str = ""


@dataclass(frozen=True, slots=True)
class SizeScale:
    """The sizes of a symptom as levels: 0 is absent, then rising with the magnitude.

    ``edges`` divide magnitudes; each part has two levels, the lower one for negative sizes. The
    size of a symptom is the largest of ``settle_s`` seconds after its beginning.
    """

    measure: SymptomMeasure
    edges: tuple[float, ...]
    settle_s: float = 2.0

    @property
    def bins(self) -> int:
        """Return the number of levels above 0."""
        return 2 * (len(self.edges) + 1)

    def level(self, size: float | None) -> int | None:
        """Return the level of a present symptom; None if its size is not known."""
        if size is None or not math.isfinite(size):
            return None
        return 1 + 2 * bisect_right(self.edges, abs(size)) + (size >= 0)

    def shares(self, size: SizeDistribution) -> tuple[float, ...]:
        """Return the probability of each level above 0."""
        ends = [0.0, *self.edges, math.inf]
        found: list[float] = []
        for low, high in pairwise(ends):
            found += (size.up_to(-low) - size.up_to(-high), size.up_to(high) - size.up_to(low))
        return tuple(max(0.0, share) for share in found)


@dataclass(frozen=True, slots=True)
class SizeDistribution:
    """The size of a symptom by a cause: uniform from a to b, or normal with mean and deviation."""

    kind: Literal["uniform", "normal"]
    a: float
    b: float

    def up_to(self, size: float) -> float:
        """Return the probability of sizes up to this one."""
        if self.kind == "uniform":
            return min(1.0, max(0.0, (size - self.a) / (self.b - self.a)))
        return 0.5 * math.erfc((self.a - size) / (self.b * math.sqrt(2)))


@dataclass(frozen=True, slots=True)
class FmeaReferences:
    """The names that failure modes can refer to.

    ``outputs`` are the addresses of all outputs of monitors (``component/mode/output``),
    ``watched`` those with an expected value: only they can be symptoms. ``needs`` are those of
    component files, with a key for every component of the folder; they apply if the failure modes'
    file has none. ``addresses`` are those that conditions may also read, None if unknown. ``files``
    are the files of the components with monitors. ``predicates`` are the names that a finding's
    goal may have, None if the rules are not known; ``heads`` those of rules that no other rule
    calls, with file and line. ``runs`` reads the experiments or unit tests of the folder, by name;
    it returns None if they are not known. ``measures`` are how large outputs are when they are bad,
    as their modes say, None where the modes are not known; ``units`` are those of variables, where
    they are known. ``detected`` are, if detectors run on the robot, per output the addresses of
    what it is measured from.
    """

    outputs: Collection[str] = ()
    watched: Collection[str] = ()
    needs: Mapping[str, Needs] = field(default_factory=dict)
    addresses: Collection[str] | None = None
    predicates: Collection[tuple[str, int]] | None = None
    heads: Mapping[tuple[str, int], tuple[str, int]] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    measures: Mapping[str, SymptomMeasure] | None = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    runs: Callable[[RunKind], Mapping[str, RunFacts] | None] = field(default=lambda kind: None)
    detected: Mapping[str, Collection[str]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FmeaSymptom:
    """An observable symptom: a monitor's output that is bad, or a condition that is true.

    ``id`` is the address of the output, or a name of the file with its ``condition``. ``leak`` is
    the probability that it appears without any of its causes. It counts as absent only ``within_s``
    after a cause can have begun, and is remembered for ``hold_s``. ``by_itself``: it and its
    absence count also while its component is blocked. ``scale`` is that of its size, None if it
    has none.
    """

    id: str
    condition: Expression | None = None
    leak: float = 0.0
    within_s: float = 0.0
    hold_s: float = 0.0
    description: str = ""
    by_itself: bool = False
    scale: SizeScale | None = None


@dataclass(frozen=True, slots=True)
class SymptomLink:
    """A cause shows a symptom: how probable, within what time, remembered for how long.

    It begins ``after_s`` (from, to) after the cause, None if any time will do; ``size`` is how
    large it is then, None if any.
    """

    symptom: str
    detects: float
    within_s: float
    hold_s: float
    after_s: tuple[float, float] | None = None
    size: SizeDistribution | None = None


@dataclass(frozen=True, slots=True)
class FollowingMode:
    """A failure mode that follows from another with probability ``p``, ``after_s`` later."""

    mode: str
    p: float
    after_s: tuple[float, float] | None = None


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
    those that need it. ``make_safe`` is required before a test or repair, ``remedy`` is the repair,
    ``recovery`` are actions of the robot that may help, as written on the command line.
    ``line`` is its line in the file. ``excludes`` are modes of its component that are never present
    together with it, ``leads_to`` modes that may follow from it.
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
    recovery: tuple[str, ...] = ()
    excludes: frozenset[str] = frozenset()
    leads_to: tuple[FollowingMode, ...] = ()

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
    """A test: a check, a question or a run; the first outcome is that of a sound robot.

    ``sure`` is the probability of that outcome when no failure mode affects it. ``run`` is the name
    of the experiment or unit test, ``passed`` the outcome when it passes; else it is the other.
    """

    id: str
    kind: TestKind
    text: str
    role: str = ""
    cost_s: float = 0.0
    risk: float = 0.0
    outcomes: tuple[str, ...] = ("no", "yes")
    sure: float = 0.99
    run: str = ""
    passed: str = ""
    moves: bool = False

    def answer(self, verdict: str) -> str | None:
        """Return the outcome that a verdict means; None if it was neither passed nor failed."""
        if verdict == "passed":
            return self.passed
        if verdict == "failed":
            return next(outcome for outcome in self.outcomes if outcome != self.passed)
        return None


@dataclass(frozen=True, slots=True)
class FindingMapping:
    """A finding of another engine: answers of a ``goal`` of rules, or a ``finding`` by its id.

    ``maps_to`` are failure modes that it indicates, in which ``<Variable>`` stands for a value;
    without any it is only shown. ``proves``: at least one of them is present, so that it is a
    conflict, not a symptom. It is remembered for ``hold_s`` after it has gone. ``is_given``: the
    file states its leak, so that a detector's calibration does not.
    """

    goal: str = ""
    finding: str = ""
    maps_to: tuple[str, ...] = ()
    detects: float = 0.99
    leak: float = 1e-4
    proves: bool = False
    description: str = ""
    hold_s: float = 0.0
    is_given: bool = False


@dataclass(frozen=True, slots=True)
class UnlistedFault:
    """A fault that is not in this analysis: its probability, and that of any symptom of it.

    ``looks_like`` is the probability that it looks like a failure mode when it looks like several
    that begin within ``together_s``. ``share`` is the share of a component's faults that are not
    in this analysis; on average such a fault shows one of the numbers ``shows`` of the symptoms of
    its failure modes.
    """

    probability: float = 1e-3
    detects: float = 0.5
    looks_like: float = 0.0
    together_s: float = 10.0
    share: float = 0.0
    shows: tuple[float, ...] = (1.0, 8.0)


@dataclass(frozen=True, slots=True)
class Fmea:
    """The whole analysis, by id. ``members`` are a team's robots with their folders, where named.

    A symptom that cannot be evaluated any more continues to count for ``remember_s``. ``unusual``
    are the findings that detectors have an alarm about an item, which no file maps: any failure
    mode that shows in the item can cause them. ``readers`` are the components whose monitors read
    an address.
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
    unusual: tuple[FindingMapping, ...] = ()
    readers: Mapping[str, frozenset[str]] = field(default_factory=dict)

    @property
    def all_findings(self) -> tuple[FindingMapping, ...]:
        """Return the findings of the file, and those that no file maps."""
        return (*self.findings, *self.unusual)

    def needs(self) -> dict[str, Needs]:
        """Return what each component and function needs."""
        needs = {name: component.needs for name, component in self.components.items()}
        return needs | {name: function.needs for name, function in self.functions.items()}

    def unshown(self) -> dict[str, tuple[str, ...]]:
        """Return per component the conditions that no failure mode and no lost function shows."""
        shown = {link.symptom for mode in self.modes.values() for link in mode.symptoms}
        shown |= {link.symptom for lost in self.functions.values() for link in lost.symptoms}
        found: dict[str, tuple[str, ...]] = dict.fromkeys(self.components, ())
        for name, symptom in self.symptoms.items():
            component = name.partition(".")[0]
            if symptom.condition is not None and component in found and name not in shown:
                found[component] = (*found[component], name)
        return found

    def unshown_below(self) -> dict[str, tuple[str, ...]]:
        """Return per component such conditions of those that need it, directly or not."""
        own, structure = self.unshown(), DependencyStructure.of(self.needs())
        below = {name: structure.dependents([name]) for name in self.components}
        return {
            name: tuple(condition for one in own if one in users for condition in own[one])
            for name, users in below.items()
        }

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
