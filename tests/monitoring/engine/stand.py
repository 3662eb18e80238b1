"""A test bench for states: findings are written as seconds, levels and reasons."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from amberbox.core.clock import NS
from amberbox.core.mode import Result
from amberbox.core.types import Output, Status, Symptom
from amberbox.monitoring.findings import (
    AlarmChange,
    Finding,
    OutputChange,
    OutputCondition,
    Transition,
)
from amberbox.monitoring.plan import (
    ComponentPlan,
    DependencyPlan,
    MappingPlan,
    ModePlan,
    MonitoringPlan,
    OutputPlan,
)
from amberbox.monitoring.states import RobotStates, outputs_of

T0_NS = 1_790_000_000 * NS


def at_ns(seconds: float) -> int:
    """Return an instant so many seconds after the epoch began."""
    return T0_NS + round(seconds * NS)


def output(name: str = "working", **more: Any) -> OutputPlan:
    """Make an output, a bool that is expected to be true unless ``more`` changes it."""
    kind = more.pop("type", "bool")
    result = Result(name, kind, "made for a test", nominal=more.pop("nominal", True))
    return OutputPlan(name, kind, result, **more)


def mode(name: str = "device", *outputs: OutputPlan, **more: Any) -> ModePlan:
    """Plan a mode; without outputs it has one, ``working``."""
    mappings = [MappingPlan([], list(outputs or [output()]))]
    return ModePlan(name, name, None, mappings=mappings, **more)


def component(
    name: str, *needs: str | DependencyPlan, modes: Sequence[ModePlan] | None = None, **more: Any
) -> ComponentPlan:
    """Make a component with a mode ``device``; ``needs`` are names of components."""
    edges = [DependencyPlan(n, component=n) if isinstance(n, str) else n for n in needs]
    own = [mode()] if modes is None else modes
    return ComponentPlan(name, name, own, edges, **more)


def plan(*components: ComponentPlan) -> MonitoringPlan:
    """Plan a robot."""
    return MonitoringPlan("r1", "hash", components)


class Stand:
    """States of a plan, the changes of outputs so far, and the findings."""

    def __init__(self, *components: ComponentPlan, begin: bool = True) -> None:
        self.plan = plan(*components)
        self.states = RobotStates(self.plan)
        self.places = outputs_of(self.plan)
        self.view = Values(self.plan)
        self.findings: list[Finding] = []
        self._found: list[OutputChange] = []
        if begin:
            self.begin(0)

    def begin(self, seconds: float) -> list[Finding]:
        """Begin an epoch."""
        findings = self.states.begin(at_ns(seconds))
        self.findings += findings
        return findings

    def find(
        self, seconds: float, where: str, what: OutputCondition, value: Output = None, why: str = ""
    ) -> None:
        """Add a change of an output; ``where`` is the beginning of its address."""
        (number,) = [n for n, p in enumerate(self.places) if _address(p).startswith(f"{where}/")]
        self._found.append(OutputChange(at_ns(seconds), number, what, value, why))

    def ok(self, seconds: float, *where: str) -> None:
        """Find outputs ok."""
        for each in where:
            self.find(seconds, each, "ok", True)

    def bad(self, seconds: float, *where: str, why: str = "") -> None:
        """Find outputs bad."""
        for each in where:
            self.find(seconds, each, "bad", False, why)

    def stale(self, seconds: float, where: str) -> None:
        """Find an output stale."""
        self.find(seconds, where, "stale", None, "nothing received of scan for 5 s")

    def until(self, seconds: float) -> list[Finding]:
        """Advance, and return the findings."""
        found = sorted(self._found, key=lambda entry: entry[:2])
        self._found = []
        self.view.take(found)
        findings = self.states.advance(found, at_ns(seconds), self.view)
        self.findings += findings
        return findings

    def status(self, where: str) -> Status:
        """Return the newest status of ``component`` or ``component/mode``."""
        name, _, of_mode = where.partition("/")
        (status,) = [s for s in self.states.statuses() if (s.component, s.mode) == (name, of_mode)]
        return status

    def now(self, where: str) -> tuple[str, str]:
        """Return level and state."""
        status = self.status(where)
        return status.level, status.state


class Values:
    """The values of outputs over time, made from their changes."""

    def __init__(self, plan: MonitoringPlan) -> None:
        self._modes: list[list[tuple[int, str]]] = [[] for _ in plan.modes()]
        numbers = iter(range(len(outputs_of(plan))))
        for place, (_, of_mode) in zip(self._modes, plan.modes(), strict=True):
            for mapping in of_mode.mappings:
                place += [(next(numbers), entry.name) for entry in mapping.outputs]
        self._values: dict[int, list[OutputChange]] = {}

    def take(self, found: Iterable[OutputChange]) -> None:
        """Add changes, in order of time."""
        for entry in found:
            self._values.setdefault(entry.output, []).append(entry)

    def outputs(self, mode: int, at_ns: int) -> Mapping[str, Output]:
        """Return the values of a mode's outputs at an instant."""
        return {name: self._value(number, at_ns) for number, name in self._modes[mode]}

    def _value(self, number: int, at_ns: int) -> Output:
        known = [entry.value for entry in self._values.get(number, ()) if entry.at_ns <= at_ns]
        return known[-1] if known else None


def transitions(findings: Iterable[Finding]) -> list[Transition]:
    """Pick the transitions."""
    return [finding for finding in findings if isinstance(finding, Transition)]


def statuses(findings: Iterable[Finding]) -> list[Status]:
    """Pick the statuses."""
    return [finding for finding in findings if isinstance(finding, Status)]


def alarms(findings: Iterable[Finding]) -> list[AlarmChange]:
    """Pick what happened to alarms."""
    return [finding for finding in findings if isinstance(finding, AlarmChange)]


def symptoms(findings: Iterable[Finding]) -> list[Symptom]:
    """Pick the symptoms."""
    return [finding for finding in findings if isinstance(finding, Symptom)]


def seconds(time_ns: int) -> float:
    """Return how long after the epoch began an instant is."""
    return round((time_ns - T0_NS) / NS, 3)


def _address(place: Any) -> str:
    return f"{place.component}/{place.mode}/{place.output.name}/"
