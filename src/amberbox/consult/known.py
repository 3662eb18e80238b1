"""What a robot folder has that its failure modes can refer to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from amberbox.blackbox.folder.folder import RobotFolder
from amberbox.consult.rulefiles import with_rules
from amberbox.core.expression_tree import status_address
from amberbox.core.needs import Needs, all_of
from amberbox.diagnosis.fmea.known import Known
from amberbox.monitoring.configuration import load_plan
from amberbox.monitoring.configuration.recorded import Recorded
from amberbox.monitoring.configuration.variables import names_of
from amberbox.monitoring.plan import ComponentPlan, OutputPlan, Plan


def known_of(folder: RobotFolder, plan: Plan | None = None) -> Known:
    """Return the outputs of a folder's monitors, what its components need, what is recorded."""
    plan = plan or load_plan(folder)[0]
    known, variables = declared_of(folder, plan), _variables(Recorded(folder))
    return (
        known if variables is None else replace(known, addresses={*variables, *addresses_of(plan)})
    )


def addresses_of(plan: Plan) -> frozenset[str]:
    """Return what expressions can name of monitors: outputs, and statuses with and without mode."""
    subjects = [f"{component.id}/{mode.id}" for component, mode in plan.modes()]
    subjects += [component.id for component in plan.components]
    return frozenset((*known_of_plan(plan).outputs, *map(status_address, subjects)))


def declared_of(folder: RobotFolder, plan: Plan) -> Known:
    """Return the same without what is recorded, of which conditions may then read anything."""
    return with_rules(known_of_plan(plan), folder.path)


def _variables(recorded: Recorded) -> list[str] | None:
    """Return the addresses of all variables to come; None if some are not known before."""
    schemas = {item.name: recorded.schema(item) for item in recorded.items}
    if recorded.open or None in schemas.values():
        return None
    return [f"{name}.{of}" for name, schema in schemas.items() if schema for of in names_of(schema)]


def known_of_plan(plan: Plan) -> Known:
    """Return what a plan has."""
    outputs = {
        f"{component.id}/{mode.id}/{output.name}": output
        for component, mode in plan.modes()
        for mapping in mode.mappings
        for output in mapping.outputs
    }
    watched = [address for address, output in outputs.items() if _watched(output)]
    ids = {component.name: component.id for component in plan.components}
    ids |= {component.id: component.id for component in plan.components}
    needs = {component.id: _needs(component, ids) for component in plan.components}
    files = {component.id: component.file for component in plan.components if component.modes}
    return Known(frozenset(outputs), frozenset(watched), needs, files=files)


def _watched(output: OutputPlan) -> bool:
    """Tell whether an output can be bad: something is expected of it."""
    return output.expectation.value is not None


def _needs(component: ComponentPlan, ids: Mapping[str, str]) -> Needs:
    """Return what a component needs, by ids of components; what is no component is left out.

    Where a monitor of another component speaks for one, that one is needed all the same.
    """
    by_name: dict[str, list[str]] = {}
    for edge in component.dependencies:
        target = ids.get(edge.name, edge.component)
        if target is not None and not edge.problem:
            by_name.setdefault(edge.name, []).append(target)
    if component.needs is None:
        return all_of(*dict.fromkeys(name for names in by_name.values() for name in names))
    return _renamed(component.needs.restricted(by_name.__contains__), by_name)


def _renamed(needs: Needs, by_name: Mapping[str, Sequence[str]]) -> Needs:
    return Needs(needs.at_least, tuple(_part(part, by_name) for part in needs.parts))


def _part(part: Needs | str, by_name: Mapping[str, Sequence[str]]) -> Needs | str:
    if isinstance(part, Needs):
        return _renamed(part, by_name)
    names = tuple(dict.fromkeys(by_name[part]))
    return names[0] if len(names) == 1 else all_of(*names)
