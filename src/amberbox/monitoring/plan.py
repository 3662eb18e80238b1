"""What is to be monitored: component and mode files, bound to what is recorded.

The configuration makes a plan; the engine runs it. A part that cannot run (no such monitor, an
input that nothing gives) stays in the plan with its problem, and its status is ``unknown``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, Literal

from amberbox.core.expression import Expression
from amberbox.core.mode import Result
from amberbox.core.needs import Needs
from amberbox.core.probe import ProbeOrder
from amberbox.core.robotstatus import Severity as Severity

Policy = Literal["all", "any", "majority"]
"""How many of a component's modes must be ok for it to be ok."""


@dataclass(frozen=True, slots=True)
class InputPlan:
    """One input of a mapping: what was written, and what of the record it is.

    ``variable`` is the column, ``index`` the element of a list column. For a probe ``item`` is
    the item that its results are recorded as.
    """

    text: str
    kind: Literal["variable", "list", "item", "probe"]
    item: str
    variable: str = ""
    index: int | None = None
    probe: ProbeOrder | None = None


@dataclass(frozen=True, slots=True)
class Expectation:
    """What an output should be; ``value`` None means that it never changes the level."""

    value: bool | int | float | str | None = None
    relation: Literal["==", "!=", ">=", "<=", ">", "<", "within"] = "=="
    high: float | None = None
    """End of the range for ``within``; ``value`` is its start."""

    def __str__(self) -> str:
        if self.relation == "within":
            return f"{self.value} to {self.high}"
        text = str(self.value).lower() if isinstance(self.value, bool) else str(self.value)
        return text if self.relation == "==" else f"{self.relation} {text}"


@dataclass(frozen=True, slots=True)
class OutputPlan:
    """One output of a mapping, bound to a result of its mode.

    ``place`` is the input it is about where a mode is called for each input alone; None is all of
    them. ``for_s`` and ``heal_s`` are how long it must be bad, or good, before that counts;
    more than ``flaps`` changes within ``flap_s`` are flapping.
    """

    name: str
    type: Literal["bool", "int", "float", "string"]
    result: Result
    place: int | None = None
    expectation: Expectation = Expectation()
    severity: Severity = "urgent"
    for_s: float = 0.0
    heal_s: float = 0.0
    flaps: int = 6
    flap_s: float = 60.0
    description: str = ""
    hint: str = ""


@dataclass(frozen=True, slots=True)
class MappingPlan:
    """Inputs of a mode and what is made of them; ``reads`` are inputs that its arguments name."""

    inputs: Sequence[InputPlan]
    outputs: Sequence[OutputPlan]
    reads: Sequence[InputPlan] = ()


@dataclass(frozen=True, slots=True)
class ModePlan:
    """One mode file. ``id`` is its name as an id, ``name`` as it was written (``monitorName``).

    ``problem`` says why it cannot run; then ``module`` may be None. ``states`` name fault states
    by conditions over its outputs. ``stale_s`` is how old an input may be, None for any age.
    """

    id: str
    name: str
    module: ModuleType | None
    config: Any = None
    mappings: Sequence[MappingPlan] = ()
    description: str = ""
    states: Mapping[str, Expression] = field(default_factory=dict)
    stale_s: float | None = 5.0
    problem: str = ""


@dataclass(frozen=True, slots=True)
class DependencyPlan:
    """What a component needs: a component, or what a monitor says (a mode, or one output of it).

    ``kind`` is the level of the paper that it belongs to; ``component`` is None where nothing in
    the folder has that name, and nothing judges it (``problem`` says so).
    """

    name: str
    kind: Literal["heartbeat", "functional", ""] = ""
    component: str | None = None
    mode: str = ""
    output: str = ""
    judged: bool = True
    problem: str = ""


@dataclass(frozen=True, slots=True)
class ComponentPlan:
    """One component file; ``part_of`` is the component above it in the tree.

    ``needs`` says which of the dependencies, by their names, it can do without; None if it needs
    all of them.
    """

    id: str
    name: str
    modes: Sequence[ModePlan] = ()
    dependencies: Sequence[DependencyPlan] = ()
    policy: Policy = "all"
    part_of: str = ""
    description: str = ""
    recovery_actions: Sequence[str] = ()
    needs: Needs | None = None
    file: str = ""


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything that is to be monitored of one robot (or team), and how statuses go out."""

    robot: str
    config_hash: str
    components: Sequence[ComponentPlan] = ()

    def modes(self) -> list[tuple[ComponentPlan, ModePlan]]:
        """Return every mode with its component, in order."""
        return [(component, mode) for component in self.components for mode in component.modes]

    def inputs(self) -> list[InputPlan]:
        """Return every input of modes that can run."""
        return [
            entry
            for _, mode in self.modes()
            if not mode.problem
            for mapping in mode.mappings
            for entry in (*mapping.inputs, *mapping.reads)
        ]

    def probes(self) -> list[ProbeOrder]:
        """Return the probes that have to be run, each once."""
        return sorted({entry.probe for entry in self.inputs() if entry.probe is not None})
