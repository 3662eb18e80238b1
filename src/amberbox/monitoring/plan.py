"""The monitoring plan: component and mode files bound to recorded items; its summary.

All names that the engine needs are resolved here, so that it reads no files; ``PlanNames`` are the
names of components and modes in messages.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, Literal, NamedTuple

from amberbox.core.detector_items import copied_from
from amberbox.core.expression import Expression
from amberbox.core.mode import Result
from amberbox.core.needs import Needs
from amberbox.core.probe import ProbeOrder
from amberbox.core.robot_status import Severity
from amberbox.core.types import Status

# how many of a component's modes must be ok for it to be ok
Policy = Literal["all", "any", "majority"]


@dataclass(frozen=True, slots=True)
class InputPlan:
    """One input of a mapping: its text, and the variable, item or probe it refers to.

    ``variable`` is the column, ``index`` the element of a list column. For a probe ``item`` is
    the item that its results are recorded as.
    """

    text: str
    kind: Literal["variable", "list", "item", "probe"]
    item: str
    variable: str = ""
    index: int | None = None
    probe: ProbeOrder | None = None

    @property
    def address(self) -> str:
        """Return its address: ``item``, ``item.variable`` or ``item.variable[index]``."""
        if not self.variable:
            return self.item
        address = f"{self.item}.{self.variable}"
        return address if self.index is None else f"{address}[{self.index}]"


@dataclass(frozen=True, slots=True)
class Expectation:
    """The expectation of an output; ``value`` None means that it never changes the level."""

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
    """Inputs of a mode and its outputs; ``reads`` are inputs that its arguments name."""

    inputs: Sequence[InputPlan]
    outputs: Sequence[OutputPlan]
    reads: Sequence[InputPlan] = ()


def measured_from(mapping: MappingPlan, output: OutputPlan) -> list[str]:
    """Return the addresses of the inputs that an output of a mapping is computed from."""
    own = mapping.inputs if output.place is None else mapping.inputs[output.place :][:1]
    return list(dict.fromkeys(entry.address for entry in (*own, *mapping.reads)))


@dataclass(frozen=True, slots=True)
class ModePlan:
    """One mode file. ``id`` is its name as an id, ``name`` as it was written (``monitorName``).

    ``problem`` is why it cannot run; then ``module`` may be None. ``states`` name fault states by
    conditions over its outputs. ``stale_s`` is how old an input may be, None for any age.
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

    @property
    def outputs(self) -> list[OutputPlan]:
        """Return all outputs of its mappings, in order."""
        return [output for mapping in self.mappings for output in mapping.outputs]


@dataclass(frozen=True, slots=True)
class DependencyPlan:
    """One dependency of a component: a component, or a monitor (a mode, or one output of it).

    ``kind`` is the level of the paper that it belongs to; ``component`` is None if the folder has
    no component of that name, and no monitor gives its state (``problem`` has the text).
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
    """One component file; ``part_of`` is its parent in the tree.

    ``needs`` is how many of which dependencies, by name, have to work; None for all of them.
    """

    id: str
    name: str
    modes: Sequence[ModePlan] = ()
    dependencies: Sequence[DependencyPlan] = ()
    policy: Policy = "all"
    part_of: str = ""
    description: str = ""
    recovery_actions: Sequence[str] = ()
    restart_units: Mapping[str, str] = field(default_factory=dict)
    """The units of those that stand for a restart, by their text."""
    needs: Needs | None = None
    file: str = ""


@dataclass(frozen=True, slots=True)
class MonitoringPlan:
    """The monitoring of one robot (or team), and how its statuses are published."""

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

    def own_items(self) -> list[str]:
        """Return the items that the watcher records itself: of probes, and of detectors' scores."""
        items = {entry.item for entry in self.inputs()}
        detected = [item for item in items if copied_from(item)]
        return sorted({*(order.item for order in self.probes()), *detected})

    def probes(self) -> list[ProbeOrder]:
        """Return the probes that have to be run, each once."""
        return sorted({entry.probe for entry in self.inputs() if entry.probe is not None})


@dataclass(frozen=True, slots=True)
class Naming:
    """The names in messages; without a plan these are the ids."""

    components: Mapping[str, ComponentPlan] = field(default_factory=dict)
    modes: Mapping[tuple[str, str], ModePlan] = field(default_factory=dict)

    @classmethod
    def of(cls, plan: MonitoringPlan | None) -> Naming:
        """Collect the names of a plan."""
        if plan is None:
            return cls()
        components = {component.id: component for component in plan.components}
        return cls(components, {(c.id, mode.id): mode for c, mode in plan.modes()})

    def component(self, status: Status) -> str:
        """Return the name of a status' component by its file."""
        known = self.components.get(status.component)
        return (known.description or known.name) if known else status.component

    def monitor(self, status: Status) -> str:
        """Return the name of a status' mode: ``name`` of its file."""
        known = self.modes.get((status.component, status.mode))
        return known.name if known else status.mode

    def monitor_description(self, status: Status) -> str:
        """Return the description of a status' mode."""
        known = self.modes.get((status.component, status.mode))
        return known.description if known else ""


class ComponentDepth(NamedTuple):
    """One component and its depth in the tree."""

    depth: int
    component: str


def branches(plan: MonitoringPlan) -> list[ComponentDepth]:
    """Return every component of a plan once, each below its parent.

    Without any ``part_of``, a component is below the first one that needs it.
    """
    known = [component.id for component in plan.components]
    parts = {c.id: c.part_of for c in plan.components if c.part_of in known}
    below: dict[str, list[str]] = {name: [] for name in known}
    if parts:
        for part, whole in parts.items():
            below[whole].append(part)
    else:
        for component in plan.components:
            needs = (d.component for d in component.dependencies if d.component in below)
            below[component.id] += [name for name in needs if name]
    return list(_walked(known, below))


def _walked(known: Sequence[str], below: Mapping[str, Sequence[str]]) -> Iterator[ComponentDepth]:
    """Walk the tree from the components without a parent, then from the remaining ones (a
    cycle).
    """
    lower = {name for names in below.values() for name in names}
    roots = [name for name in known if name not in lower]
    seen: set[str] = set()
    left = [ComponentDepth(0, name) for name in reversed((*roots, *known))]
    while left:
        branch = left.pop()
        if branch.component not in seen:
            seen.add(branch.component)
            yield branch
            children = reversed(below[branch.component])
            left += [ComponentDepth(branch.depth + 1, child) for child in children]


def plan_data(plan: MonitoringPlan) -> dict[str, Any]:
    """Return a plan as JSON-compatible values."""
    return {
        "counts": counts(plan),
        "components": [_component(component) for component in plan.components],
        "probes": [
            {"kind": order.kind, "subject": order.subject, "item": order.item}
            for order in plan.probes()
        ],
    }


def counts(plan: MonitoringPlan) -> dict[str, int]:
    """Return the numbers of components, modes and other parts of a plan."""
    modes = [mode for _, mode in plan.modes()]
    return {
        "components": len(plan.components),
        "not_monitored": sum(not component.modes for component in plan.components),
        "modes": len(modes),
        "broken": sum(bool(mode.problem) for mode in modes),
        "outputs": sum(len(mode.outputs) for mode in modes),
        "probes": len(plan.probes()),
    }


def plan_text(plan: MonitoringPlan) -> str:
    """Return a summary of a plan in one line."""
    of = counts(plan)
    without = f" ({of['not_monitored']} without a monitor)" if of["not_monitored"] else ""
    broken = f" ({of['broken']} that cannot run)" if of["broken"] else ""
    parts = (
        _several(of["components"], "component") + without,
        _several(of["modes"], "mode") + broken,
        _several(of["outputs"], "output"),
        _several(of["probes"], "probe"),
    )
    return ", ".join(parts)


def short_table(plan: MonitoringPlan) -> Iterator[tuple[str, ...]]:
    """Yield a line for each component."""
    yield "component", "modes", "outputs", "needs"
    for component in plan.components:
        broken = sum(bool(mode.problem) for mode in component.modes)
        modes = f"{len(component.modes)} ({broken} cannot run)" if broken else len(component.modes)
        outputs = sum(len(mode.outputs) for mode in component.modes)
        yield component.id, str(modes), str(outputs), needs_text(component, " ") or "-"


def needs_text(component: ComponentPlan, joint: str) -> str:
    """Return the needs of a component as text: names, or how many of them."""
    if component.needs is not None:
        return str(component.needs)
    return joint.join(dict.fromkeys(edge.name for edge in component.dependencies))


def monitor_of(mode: ModePlan) -> str:
    """Return the function of a mode; ``cannot run`` if there is none, or it has a problem."""
    if mode.problem or mode.module is None:
        return "cannot run"
    name = mode.module.__name__.rpartition(".")[2]
    return name.rstrip("_")


def _several(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _component(plan: ComponentPlan) -> dict[str, Any]:
    return {
        "id": plan.id,
        "name": plan.name,
        "description": plan.description,
        "part_of": plan.part_of,
        "policy": plan.policy,
        "dependencies": [_dependency(edge) for edge in plan.dependencies],
        "needs": needs_text(plan, " and "),
        "recovery_actions": list(plan.recovery_actions),
        "modes": [_mode(mode) for mode in plan.modes],
    }


def _dependency(edge: DependencyPlan) -> dict[str, Any]:
    judge = (edge.component, edge.mode, edge.output) if edge.judged and not edge.problem else ()
    return {
        "name": edge.name,
        "kind": edge.kind,
        "judged_by": "/".join(part for part in judge if part),
        "problem": edge.problem,
    }


def _mode(mode: ModePlan) -> dict[str, Any]:
    names = ("text", "kind", "item", "variable", "index")
    inputs = [entry for m in mode.mappings for entry in (*m.inputs, *m.reads)]
    return {
        "id": mode.id,
        "name": mode.name,
        "monitor": monitor_of(mode),
        "problem": mode.problem,
        "inputs": [{name: getattr(entry, name) for name in names} for entry in inputs],
        "outputs": [_output(output) for output in mode.outputs],
        "states": {name: condition.text for name, condition in mode.states.items()},
    }


def _output(output: OutputPlan) -> dict[str, Any]:
    known = output.expectation.value is not None
    return {
        "name": output.name,
        "type": output.type,
        "result": output.result.name,
        "expected": str(output.expectation) if known else None,
        "severity": output.severity,
    }
