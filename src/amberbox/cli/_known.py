"""What a robot folder has that its failure modes can refer to."""

from __future__ import annotations

from dataclasses import replace

from amberbox.blackbox.folder.folder import RobotFolder
from amberbox.core.needs import Needs
from amberbox.diagnosis.fmea.known import Known
from amberbox.monitoring.configuration import load_plan
from amberbox.monitoring.configuration.recorded import Recorded
from amberbox.monitoring.configuration.variables import names_of
from amberbox.monitoring.plan import ComponentPlan, OutputPlan, Plan


def known_of(folder: RobotFolder, plan: Plan | None = None) -> Known:
    """Return the outputs of a folder's monitors, what its components need, what is recorded."""
    known = known_of_plan(plan or load_plan(folder)[0])
    variables = _variables(Recorded(folder))
    return known if variables is None else replace(known, addresses={*variables, *known.outputs})


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
    needs = {component.id: _needs(component) for component in plan.components}
    return Known(frozenset(outputs), frozenset(watched), needs)


def _watched(output: OutputPlan) -> bool:
    """Tell whether an output can be bad: something is expected of it."""
    return output.expectation.value is not None


def _needs(component: ComponentPlan) -> Needs:
    names = (edge.component for edge in component.dependencies)
    needed = tuple(dict.fromkeys(name for name in names if name is not None))
    return Needs(len(needed), needed)
