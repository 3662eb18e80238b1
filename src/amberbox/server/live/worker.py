"""Worker operation: read the components declared in a robot's folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from amberbox.consult.folder_knowledge import read_declared_plan
from amberbox.monitoring.plan import ComponentPlan, MonitoringPlan, branches
from amberbox.server.ingest.folders import FolderStore
from amberbox.server.live.facts import ComponentFacts, FolderFacts, NeedFacts, OutputFacts


def facts(folder: Path, arguments: dict[str, Any]) -> bytes:
    """Return the declared components; no code of the folder is run, no store is opened."""
    name, config_hash = arguments["robot"], arguments["config_hash"]
    place = FolderStore(folder).place(name, config_hash)
    robot, plan = read_declared_plan(place, name, config_hash)
    return msgspec.json.encode(FolderFacts(robot.robot.model, list(_components(plan))))


def _components(plan: MonitoringPlan) -> Iterator[ComponentFacts]:
    by_id = {component.id: component for component in plan.components}
    for branch in branches(plan):
        component = by_id[branch.component]
        yield ComponentFacts(
            component.id, component.name, branch.depth, component.description, component.part_of,
            "" if component.needs is None else str(component.needs), list(_needs(component)),
            {mode.id: list(output_facts(component, mode.id)) for mode in component.modes},
            {mode.id: mode.name for mode in component.modes}, list(component.recovery_actions),
        )  # fmt: skip


def _needs(component: ComponentPlan) -> Iterator[NeedFacts]:
    for edge in component.dependencies:
        judged = edge.judged and not edge.problem
        yield NeedFacts(edge.name, (edge.component or "") if judged else "", edge.mode)


def output_facts(component: ComponentPlan, mode: str) -> Iterator[OutputFacts]:
    """Yield what the folder states of the outputs of a mode."""
    for plan in component.modes:
        for mapping in plan.mappings if plan.id == mode else ():
            for output in mapping.outputs:
                expected = output.expectation
                shown = "" if expected.value is None else str(expected)
                yield OutputFacts(
                    output.name, shown, output.severity if shown else "", output.description,
                    output.hint, output.result.unit,
                )  # fmt: skip
