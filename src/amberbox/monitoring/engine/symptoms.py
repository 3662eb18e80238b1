"""Symptoms: what each output says for or against faults, told when that changes.

The first word of an epoch on an output is one that counts: what is unknown, or in order while
something blocks it, is not told then. So a robot that starts says each thing once.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, TypeAlias

from amberbox.core.types import Symptom, SymptomState
from amberbox.monitoring.engine.components import ComponentState
from amberbox.monitoring.engine.findings import What
from amberbox.monitoring.engine.outputs import OutputState
from amberbox.monitoring.plan import InputPlan, MappingPlan, OutputPlan

_STATE: Final[Mapping[What, SymptomState]] = {
    **{"ok": "absent", "bad": "present"},
    **{"unknown": "unknown", "stale": "unknown"},
}

Said: TypeAlias = tuple[SymptomState, tuple[str, ...]]
"""What was told of an output: its state, and what blocks its component."""


class _Watched:
    """An output of which something is expected; ``said`` is None until something was told."""

    __slots__ = ("address", "component", "measured", "output", "said")

    def __init__(
        self, address: str, component: ComponentState, output: OutputState, measured: Sequence[str]
    ) -> None:
        self.address = address
        self.component = component
        self.output = output
        self.measured = measured
        self.said: Said | None = None

    def now(self) -> Said:
        """Return what is to be told of it."""
        return _STATE[self.output.shown], self.component.blocked_by

    def tell(self, now_ns: int) -> Symptom | None:
        """Return the symptom if it differs from what was told last."""
        now = self.now()
        if now == self.said or (self.said is None and not _is_word(now)):
            return None
        self.said = now
        state, blocked_by = now
        onset_ns = self.output.onset_ns if state == "present" else None
        evidence: tuple[tuple[str, int, int], ...] = ()
        if onset_ns is not None:
            evidence = tuple((address, onset_ns, now_ns) for address in self.measured)
        return Symptom(
            self.address, state, self.address, onset_ns, now_ns, evidence=evidence,
            blocked_by=blocked_by, reason=self.output.measured if state == "present" else "",
        )  # fmt: skip


class Symptoms:
    """The symptoms of a robot's monitors, by the numbers of outputs."""

    def __init__(self, components: Sequence[ComponentState]) -> None:
        """Watch the outputs of components, numbered in order."""
        self._watched: dict[int, _Watched] = {}
        self._of_component: list[list[int]] = []
        number = 0
        for component in components:
            self._of_component.append([])
            for mode in component.modes:
                inputs = _measured_by(mode.plan.mappings)
                for output, measured in zip(mode.outputs, inputs, strict=True):
                    if mode.runs and output.plan.expectation.value is not None:
                        address = f"{component.plan.id}/{mode.plan.id}/{output.plan.name}"
                        self._watched[number] = _Watched(address, component, output, measured)
                        self._of_component[-1].append(number)
                    number += 1

    def tell(self, outputs: Iterable[int], components: Iterable[int], now_ns: int) -> list[Symptom]:
        """Return what is new of some outputs (numbers) and of all those of components (places)."""
        numbers = {number for number in outputs if number in self._watched}
        for place in components:
            numbers.update(self._of_component[place])
        told = (self._watched[number].tell(now_ns) for number in sorted(numbers))
        return [symptom for symptom in told if symptom is not None]

    def begin(self, at_ns: int) -> list[Symptom]:
        """Begin an epoch, in which nothing is known yet; return what was known before."""
        told = self.tell(self._watched, (), at_ns)
        for watched in self._watched.values():
            watched.said = None
        return told

    def snapshot(self) -> list[int]:
        """Return the outputs that would not be a first word, and had one: of others one sees."""
        return [
            number
            for number, watched in self._watched.items()
            if watched.said is not None and not _is_word(watched.said)
        ]

    def resume(self, held: Iterable[int]) -> None:
        """Go on from what ``snapshot`` returned; outputs and components have been resumed."""
        had_one = set(held)
        for number, watched in self._watched.items():
            now = watched.now()
            watched.said = now if _is_word(now) or number in had_one else None


def _is_word(said: Said) -> bool:
    """Tell whether an epoch may begin with it: it speaks for or against a fault."""
    state, blocked_by = said
    return state == "present" or (state == "absent" and not blocked_by)


def _measured_by(mappings: Iterable[MappingPlan]) -> list[list[str]]:
    """Return for each output of a mode the addresses that it is found from."""
    return [measured_from(mapping, output) for mapping in mappings for output in mapping.outputs]


def measured_from(mapping: MappingPlan, output: OutputPlan) -> list[str]:
    """Return the addresses of what an output of a mapping is found from."""
    own = mapping.inputs if output.place is None else mapping.inputs[output.place :][:1]
    return list(dict.fromkeys(_address(entry) for entry in (*own, *mapping.reads)))


def _address(entry: InputPlan) -> str:
    if not entry.variable:
        return entry.item
    address = f"{entry.item}.{entry.variable}"
    return address if entry.index is None else f"{address}[{entry.index}]"
