"""What failure modes, components, functions and symptoms are called: by the FMEA's descriptions."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from amberbox.core.types import Hypothesis
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.explanation.explanation import Fault, Possibility
from amberbox.diagnosis.explanation.instances import kind_of
from amberbox.diagnosis.explanation.words import both, count, readable
from amberbox.diagnosis.fmea.findings import text_of as finding_text
from amberbox.diagnosis.fmea.model import Fmea

OTHER = "something that the FMEA does not know"
FALSE_ALARM = "probably a false alarm"


@dataclass(frozen=True, slots=True)
class Names:
    """Speaks of an FMEA's parts; what it does not have is called by its id.

    ``cleared`` are failure modes of which nothing shows any more, and since when: beside others
    that are active they are not named.
    """

    fmea: Fmea
    cleared: Mapping[str, int] = field(default_factory=dict)

    def mode(self, mode_id: str) -> str:
        """Describe a failure mode."""
        if mode_id == UNKNOWN:
            return OTHER
        mode = self.fmea.modes.get(mode_id)
        if mode is not None and mode.description:
            return mode.description
        component, _, name = mode_id.partition("#")
        return f"{self.component(component)}: {readable(name)}"

    def component(self, name: str) -> str:
        """Describe a component."""
        component = self.fmea.components.get(name)
        return component.description if component and component.description else readable(name)

    def function(self, name: str) -> str:
        """Describe what the robot does."""
        function = self.fmea.functions.get(name)
        return function.description if function and function.description else readable(name)

    def part(self, name: str) -> str:
        """Say in a few words that a component or a function is lost."""
        if name in self.fmea.functions:
            return f"cannot: {self.function(name)}"
        return f"out of service: {self.component(name)}"

    def symptom(self, symptom_id: str, reason: str = "") -> str:
        """Say what is seen when a symptom is there; ``reason`` is a value and its limit."""
        symptom = self.fmea.symptoms.get(symptom_id)
        told = symptom.description if symptom is not None else ""
        told = told or finding_text(self.fmea, symptom_id)
        if told:
            return f"{told} ({reason})" if reason else told
        parts = symptom_id.split("/")
        if len(parts) == 3 and reason:
            return f"{self.component(parts[0])}: {reason}"
        if len(parts) == 3:
            return f'{self.component(parts[0])}: the self-check "{_check(*parts[1:])}" fails'
        if symptom is not None and symptom.condition is not None and "#" in symptom_id:
            return f"it is true that {symptom.condition.text}"
        return self._named(symptom_id)

    def owner(self, symptom_id: str) -> str:
        """Describe the component where a symptom shows."""
        component = symptom_id.partition("/")[0]
        if component not in self.fmea.components:
            component = component.partition("#")[0].partition(".")[0]
        return self.component(component)

    def _named(self, symptom_id: str) -> str:
        component, dot, name = symptom_id.partition(".")
        if dot and component in self.fmea.components:
            return f"{self.component(component)}: {readable(name)}"
        return readable(symptom_id)

    def faults(self, faults: Collection[str]) -> str:
        """Describe failure modes that are there together; none is a false alarm."""
        if not faults:
            return FALSE_ALARM
        texts = [self.mode(fault) for fault in in_order(self.active(faults))]
        return f"{both(texts)}{together(len(texts))}"

    def active(self, faults: Collection[str]) -> Collection[str]:
        """Return those of some failure modes that show still; all if none does."""
        return set(faults) - self.cleared.keys() or faults

    def fault(self, mode_id: str) -> Fault:
        """Describe a failure mode with what may be its cause and what helps."""
        mode, gone_ns = self.fmea.modes.get(mode_id), self.cleared.get(mode_id)
        if mode is None:
            return Fault(mode_id, self.mode(mode_id), gone_ns=gone_ns)
        return Fault(
            mode_id, self.mode(mode_id), mode.severity, mode.cause, mode.remedy, gone_ns,
            mode.intermittent, kind_of(self.fmea, mode_id),
        )  # fmt: skip

    def possibility(self, hypothesis: Hypothesis) -> Possibility:
        """Describe a hypothesis."""
        return Possibility(
            hypothesis.id,
            self.faults(hypothesis.faults),
            hypothesis.probability,
            tuple(self.fault(fault) for fault in in_order(hypothesis.faults)),
            hypothesis.criticality,
            hypothesis.proof,
        )


def together(number: int) -> str:
    """Say that several faults are there at once."""
    if number < 2:
        return ""
    return " (both together)" if number == 2 else f" (all {count(number)} together)"


def in_order(faults: Collection[str]) -> list[str]:
    """Put failure modes in the order of their ids, what the FMEA does not know last."""
    return sorted(faults, key=lambda fault: (fault == UNKNOWN, fault))


def _check(mode: str, output: str) -> str:
    """Name an output by its mode, once if both are called the same."""
    return readable(mode) if mode == output else f"{readable(mode)}: {readable(output)}"
