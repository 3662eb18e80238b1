"""What a robot's folder says about its components, read by a worker with limits."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from amberbox.consult.declared import declared_plan
from amberbox.fleet.folders.shelf import Shelf
from amberbox.fleet.state.facts import ComponentFacts, Facts, NeedFacts, OutputFacts
from amberbox.monitoring.messages.tree import branches
from amberbox.monitoring.plan import ComponentPlan, Plan


def facts(folder: Path, arguments: dict[str, Any]) -> bytes:
    """Return what is to be monitored; nothing of the folder is run, no store of it looked for."""
    name, config_hash = arguments["robot"], arguments["config_hash"]
    place = Shelf(folder).place(name, config_hash)
    robot, plan = declared_plan(place, name, config_hash)
    return msgspec.json.encode(Facts(robot.robot.model, list(_components(plan))))


def _components(plan: Plan) -> Iterator[ComponentFacts]:
    by_id = {component.id: component for component in plan.components}
    for branch in branches(plan):
        component = by_id[branch.component]
        yield ComponentFacts(
            component.id, component.name, branch.depth, component.description, component.part_of,
            "" if component.needs is None else str(component.needs), list(_needs(component)),
            {mode.id: list(_outputs(component, mode.id)) for mode in component.modes},
            {mode.id: mode.name for mode in component.modes}, list(component.recovery_actions),
        )  # fmt: skip


def _needs(component: ComponentPlan) -> Iterator[NeedFacts]:
    for edge in component.dependencies:
        judged = edge.judged and not edge.problem
        yield NeedFacts(edge.name, (edge.component or "") if judged else "", edge.mode)


def _outputs(component: ComponentPlan, mode: str) -> Iterator[OutputFacts]:
    for plan in component.modes:
        for mapping in plan.mappings if plan.id == mode else ():
            for output in mapping.outputs:
                expected = output.expectation
                shown = "" if expected.value is None else str(expected)
                yield OutputFacts(
                    output.name, shown, output.severity if shown else "", output.description,
                    output.hint, output.result.unit,
                )  # fmt: skip
