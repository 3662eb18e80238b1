"""What a plan monitors, for people and as data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from amberbox.monitoring.plan import (
    ComponentPlan,
    DependencyPlan,
    InputPlan,
    ModePlan,
    OutputPlan,
    Plan,
)


def as_data(plan: Plan) -> dict[str, Any]:
    """Return a plan as JSON has it."""
    return {
        "counts": counts(plan),
        "components": [_component(component) for component in plan.components],
        "probes": [
            {"kind": order.kind, "subject": order.subject, "item": order.item}
            for order in plan.probes()
        ],
    }


def counts(plan: Plan) -> dict[str, int]:
    """Count what is monitored."""
    modes = [mode for _, mode in plan.modes()]
    return {
        "components": len(plan.components),
        "not_monitored": sum(not component.modes for component in plan.components),
        "modes": len(modes),
        "broken": sum(bool(mode.problem) for mode in modes),
        "outputs": sum(len(outputs_of(mode)) for mode in modes),
        "probes": len(plan.probes()),
    }


def in_words(plan: Plan) -> str:
    """Say in one line what is monitored."""
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


def short_table(plan: Plan) -> Iterator[tuple[str, ...]]:
    """Yield a line for each component."""
    yield "component", "modes", "outputs", "needs"
    for component in plan.components:
        broken = sum(bool(mode.problem) for mode in component.modes)
        modes = f"{len(component.modes)} ({broken} cannot run)" if broken else len(component.modes)
        outputs = sum(len(outputs_of(mode)) for mode in component.modes)
        yield component.id, str(modes), str(outputs), needs_text(component, " ") or "-"


def needs_text(component: ComponentPlan, joint: str) -> str:
    """Say what a component needs: names, or how many of which."""
    if component.needs is not None:
        return str(component.needs)
    return joint.join(dict.fromkeys(edge.name for edge in component.dependencies))


def actions(plan: Plan) -> Iterator[tuple[str, str]]:
    """Yield each component's recovery actions, which are not carried out."""
    for component in plan.components:
        yield from ((component.id, action) for action in component.recovery_actions)


def monitor_of(mode: ModePlan) -> str:
    """Return the function of a mode; ``cannot run`` if there is none, or it has a problem."""
    if mode.problem or mode.module is None:
        return "cannot run"
    name = mode.module.__name__.rpartition(".")[2]
    return name.rstrip("_")


def outputs_of(mode: ModePlan) -> list[OutputPlan]:
    """Return all outputs of a mode."""
    return [output for mapping in mode.mappings for output in mapping.outputs]


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
    inputs = [entry for m in mode.mappings for entry in (*m.inputs, *m.reads)]
    return {
        "id": mode.id,
        "name": mode.name,
        "monitor": monitor_of(mode),
        "problem": mode.problem,
        "inputs": _inputs(inputs),
        "outputs": [_output(output) for output in outputs_of(mode)],
        "states": {name: condition.text for name, condition in mode.states.items()},
    }


def _inputs(inputs: Sequence[InputPlan]) -> list[dict[str, Any]]:
    return [
        {
            "text": entry.text,
            "kind": entry.kind,
            "item": entry.item,
            "variable": entry.variable,
            "index": entry.index,
        }
        for entry in inputs
    ]


def _output(output: OutputPlan) -> dict[str, Any]:
    known = output.expectation.value is not None
    return {
        "name": output.name,
        "type": output.type,
        "result": output.result.name,
        "expected": str(output.expectation) if known else None,
        "severity": output.severity,
    }
