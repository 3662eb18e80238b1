"""Which part of the leading answer of a diagnosis an alarm is about."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

from amberbox.core.sureness import LIKELY
from amberbox.core.types import Diagnosis, FaultFacts, Hypothesis
from amberbox.monitoring.engine.outputs import SEVERITIES, highest
from amberbox.monitoring.plan import Severity
from amberbox.monitoring.watcher.leading import leading, one_of, share_of

Share: TypeAlias = tuple[frozenset[str], ...]
"""The faults that an alarm comes from: sets, of which one is meant."""
URGENT: Final[frozenset[Severity]] = frozenset(SEVERITIES[SEVERITIES.index("urgent") :])
_POSSIBLE: Final = 0.2
_ENDS = re.compile(r"[/#.]")
"""What ends a component in the address of an output, in a failure mode, in a symptom's name."""


class Cause(NamedTuple):
    """A leading cause by itself: one of some failure modes, the first of them gives the name.

    ``is_credible``: it is likely, or possible where the robot must not go on.
    """

    faults: tuple[str, ...]
    severity: Severity
    symptoms: tuple[str, ...]
    is_credible: bool


@dataclass(frozen=True, slots=True)
class Blame:
    """The leading answer of the open diagnosis; of none, without members.

    ``blocked`` is what blocked each component when it was given, ``facts`` what is known of
    failure modes; without facts an alarm is about all that its answer says.
    """

    diagnosis: str = ""
    members: tuple[Hypothesis, ...] = ()
    probability: float = 0.0
    blocked: Mapping[str, Sequence[str]] = field(default_factory=dict)
    facts: Mapping[str, FaultFacts] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        diagnosis: Diagnosis | None,
        blocked: Mapping[str, Sequence[str]],
        facts: Mapping[str, FaultFacts],
    ) -> Blame:
        """Take the leading answer of a diagnosis that is open."""
        if diagnosis is None or diagnosis.state != "open":
            return cls()
        return cls(diagnosis.id, leading(diagnosis), share_of(diagnosis), dict(blocked), facts)

    def share(self, component: str) -> Share:
        """Return what the alarm of a component comes from; empty if it is not concerned.

        Concerned are components that have failed, those whose symptoms are explained, and what
        blocks these. The failures of a component itself come before those that it shows only.
        """
        found = (self._of(hypothesis, component) for hypothesis in self.members)
        return tuple(dict.fromkeys(faults for faults in found if faults is not None))

    def _of(self, hypothesis: Hypothesis, component: str) -> frozenset[str] | None:
        own = frozenset(fault for fault in hypothesis.faults if component_of(fault) == component)
        if own:
            return own
        here = {symptom for symptom in hypothesis.explains if self._is_at(symptom, component)}
        if not here:
            return None
        shown = frozenset(
            fault
            for fault in hypothesis.faults
            if fault in self.facts and not here.isdisjoint(self.facts[fault].shows)
        )
        return shown or hypothesis.faults

    def _is_at(self, symptom: str, component: str) -> bool:
        name = component_of(symptom)
        return name == component or component in map(component_of, self.blocked.get(name, ()))

    def text(self, share: Share) -> str:
        """Say what an alarm comes from, and how sure that is."""
        return one_of(share, self.probability) if share else ""

    def is_one(self, share: Share) -> bool:
        """Tell whether alarms with this share are one: its failure modes are known and likely."""
        known = bool(share) and all(
            faults and all(fault in self.facts for fault in faults) for faults in share
        )
        return known and self.probability >= LIKELY

    def causes(self) -> Iterator[Cause]:
        """Yield the causes by themselves that are urgent or worse.

        A failure mode that all members have is one. What else they have is one together.
        """
        sets = [hypothesis.faults for hypothesis in self.members]
        common = frozenset.intersection(*sets) if sets else frozenset[str]()
        rest = [faults - common for faults in sets]
        alternatives: list[tuple[str, ...]] = [(fault,) for fault in sorted(common)]
        if rest and all(rest):
            alternatives.append(tuple(dict.fromkeys(f for faults in rest for f in sorted(faults))))
        for faults in alternatives:
            severities = [self.facts[fault].severity for fault in faults if fault in self.facts]
            if len(severities) == len(faults) and highest(severities) in URGENT:
                severity = highest(severities)
                least = LIKELY if severity == "urgent" else _POSSIBLE
                shown = self._shown_by(faults)
                yield Cause(faults, severity, shown, self.probability >= least)

    def _shown_by(self, faults: Sequence[str]) -> tuple[str, ...]:
        shows = frozenset[str]().union(*(self.facts[fault].shows for fault in faults))
        explained = (s for hypothesis in self.members for s in hypothesis.explains if s in shows)
        return tuple(dict.fromkeys(explained))


def component_of(name: str) -> str:
    """Return the component that an output, a failure mode or a symptom belongs to."""
    return _ENDS.split(name, maxsplit=1)[0]
