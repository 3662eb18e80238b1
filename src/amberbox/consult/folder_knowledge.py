"""Knowledge of a robot's faults from its folder, and what its failure modes can refer to.

``read_declared_robot`` reads a copy of a folder without running any code in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from amberbox.blackbox.columns.variables import names_of
from amberbox.blackbox.robot_folder.folder import RobotFolder, declared_folder
from amberbox.consult.folder_runs import folder_runs, runs_of_copy
from amberbox.core.contracts import ModeContract
from amberbox.core.errors import ConfigurationError, Problem, UsageError
from amberbox.core.expression import parse
from amberbox.core.expressions.tree import status_address
from amberbox.core.mode import beyond_limits
from amberbox.core.needs import Needs, all_of
from amberbox.core.units import PER_SECOND, per_second
from amberbox.core.yaml_nodes import only_below
from amberbox.diagnosis.evidence.rules import rule_files, with_rules
from amberbox.diagnosis.fmea.loader import FILE, load_fmea
from amberbox.diagnosis.fmea.model import Fmea, FmeaReferences, SymptomMeasure
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.prolog.program import read_rules
from amberbox.monitoring.plan import (
    ComponentPlan,
    MappingPlan,
    ModePlan,
    MonitoringPlan,
    OutputPlan,
    measured_from,
)
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.recorded_items import RecordedItems


def fmea_references(folder: RobotFolder, plan: MonitoringPlan | None = None) -> FmeaReferences:
    """Return the outputs of a folder's monitors, its components' needs, and the recorded items."""
    plan = plan or load_plan(folder)[0]
    recorded = RecordedItems(folder)
    declared, variables = declared_references(folder, plan), _variables(recorded)
    runs = partial(folder_runs, folder.path)
    units = _units(recorded)
    known = replace(declared, runs=runs, units={**units, **_output_units(plan, units)})
    return (
        known
        if variables is None
        else replace(known, addresses={*variables, *monitor_addresses(plan)})
    )


def monitor_addresses(plan: MonitoringPlan) -> frozenset[str]:
    """Return the addresses of monitors: outputs, and statuses with and without mode."""
    subjects = [f"{component.id}/{mode.id}" for component, mode in plan.modes()]
    subjects += [component.id for component in plan.components]
    return frozenset((*plan_references(plan).outputs, *map(status_address, subjects)))


def declared_references(folder: RobotFolder, plan: MonitoringPlan) -> FmeaReferences:
    """Return the same without recorded variables and unit tests: conditions and tests may then
    name any.
    """
    known = replace(plan_references(plan), runs=partial(runs_of_copy, folder.path))
    if folder.robot.detection is not None:
        known = replace(known, detected=detected_references(plan))
    return with_rules(known, folder.path)


def _variables(recorded: RecordedItems) -> list[str] | None:
    """Return the addresses of all variables that will be recorded; None if some are unknown."""
    schemas = {item.name: recorded.schema(item) for item in recorded.items}
    if recorded.open or None in schemas.values():
        return None
    return [f"{name}.{of}" for name, schema in schemas.items() if schema for of in names_of(schema)]


def _units(recorded: RecordedItems) -> dict[str, str]:
    """Return the units of all variables whose messages are known and state one."""
    schemas = {item.name: recorded.schema(item) for item in recorded.items}
    return {
        f"{name}.{column.name}": column.unit
        for name, schema in schemas.items()
        for column in (schema.columns if schema else ())
        if column.unit
    }


def _output_units(plan: MonitoringPlan, units: Mapping[str, str]) -> dict[str, str]:
    """Return the units of outputs that are numbers; ``1/s`` is that of the input per second."""
    found: dict[str, str] = {}
    for component, mode in plan.modes():
        for mapping in mode.mappings:
            for output in mapping.outputs:
                unit = "" if output.type == "bool" else output.result.unit
                if unit == PER_SECOND:
                    own = {units.get(one, "") for one in measured_from(mapping, output)}
                    unit = per_second(own.pop()) if len(own) == 1 and "" not in own else ""
                if unit:
                    found[f"{component.id}/{mode.id}/{output.name}"] = unit
    return found


def plan_references(plan: MonitoringPlan) -> FmeaReferences:
    """Return the outputs and needs of a plan."""
    outputs = {
        f"{component.id}/{mode.id}/{output.name}": output
        for component, mode in plan.modes()
        for mapping in mode.mappings
        for output in mapping.outputs
    }
    watched = [
        address for address, output in outputs.items() if (output.expectation.value is not None)
    ]
    ids = {component.name: component.id for component in plan.components}
    ids |= {component.id: component.id for component in plan.components}
    needs = {component.id: _needs(component, ids) for component in plan.components}
    files = {component.id: component.file for component in plan.components if component.modes}
    return FmeaReferences(
        frozenset(outputs), frozenset(watched), needs, files=files, measures=_measures(plan),
        units=_output_units(plan, {}),
    )  # fmt: skip


def detected_references(plan: MonitoringPlan) -> dict[str, list[str]]:
    """Return per output of a plan the addresses that it is measured from."""
    return {
        f"{component.id}/{mode.id}/{output.name}": measured_from(mapping, output)
        for component, mode in plan.modes()
        for mapping in mode.mappings
        for output in mapping.outputs
    }


def _measures(plan: MonitoringPlan) -> dict[str, SymptomMeasure]:
    """Return how large a bad output is, where its mode or its expected number says so."""
    found: dict[str, SymptomMeasure] = {}
    for component, mode in plan.modes():
        for mapping in mode.mappings:
            for output in mapping.outputs:
                address = f"{component.id}/{mode.id}/{output.name}"
                text = _measure_text(address, mode, mapping, output)
                if text:
                    found[address] = SymptomMeasure(parse(text))
    return found


def _measure_text(address: str, mode: ModePlan, mapping: MappingPlan, output: OutputPlan) -> str:
    expected = output.expectation
    if isinstance(expected.value, int | float) and not isinstance(expected.value, bool):
        high = expected.high if expected.relation == "within" else None
        low = float(expected.value)
        return (
            ""
            if expected.relation == "!="
            else beyond_limits(f"`{address}`", low, low if high is None else high)
        )
    stated = getattr(mode.module, "measure", None)
    if stated is None or output.type != "bool" or expected.value is not True:
        return ""
    inputs = measured_from(replace(mapping, reads=()), output)
    if any(one.kind in ("probe", "list") for one in mapping.inputs):
        return ""
    text: str = stated(mode.config, output.result.name, [_quoted(one) for one in inputs])
    results = _results(mode, mapping)
    if text not in results:
        return text
    place = address.rpartition("/")[0]
    shown = (one.name for one in mapping.outputs if one.result.name == text)
    return next((f"`{place}/{name}`" for name in shown), "")


def _results(mode: ModePlan, mapping: MappingPlan) -> list[str]:
    """Return the names of all results of a mapping."""
    contract = ModeContract.of(mode.module)
    if contract.results_of is None:
        return [result.name for result in contract.results]
    bools = sum(output.type == "bool" for output in mapping.outputs)
    return [r.name for r in contract.results_of(mode.config, len(mapping.inputs), bools)]


def _quoted(address: str) -> str:
    """Return an address as an expression has it: an item alone is in backticks."""
    return address if "." in address else f"`{address}`"


def _needs(component: ComponentPlan, ids: Mapping[str, str]) -> Needs:
    """Return the needs of a component as component ids; names that are no component are left out.

    A dependency whose state another component's monitor gives is included.
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


_SHOWN = 3


@dataclass(frozen=True, slots=True)
class DeclaredRobot:
    """A copy of a robot's folder: its monitors, as far as they are known here, and its failure
    modes.

    ``problems`` are those of ``fmea.yaml``; with an error there are no failure modes.
    """

    folder: RobotFolder
    plan: MonitoringPlan
    known: FmeaReferences
    fmea: Fmea | None
    problems: Sequence[Problem]

    def faults(self) -> Fmea:
        """Return the failure modes; raises UsageError if there are none."""
        if self.fmea is not None:
            return self.fmea
        errors = [problem for problem in self.problems if problem.is_error]
        if not errors:
            what = f"the folder of {self.folder.robot.id} has no {FILE}"
            raise UsageError(f"{what}: nobody has said what can fail", "see docs/robot/fmea.md")
        shown = "; ".join(f"{p.where}: {p.what} (line {p.line})" for p in errors[:_SHOWN])
        raise UsageError(
            f"{FILE} of {self.folder.robot.id} is wrong: {shown}", "see docs/robot/fmea.md"
        )

    def knowledge(self, exposure_h: float | None = None) -> Knowledge:
        """Return the failure modes ready for the engines; raises as ``faults`` does."""
        of = self.folder
        return Knowledge(of.robot.id, self.faults(), of.config_hash, exposure_h)

    def rules(self) -> list[Path]:
        """Return the rule files."""
        return rule_files(self.folder.path)


def read_declared_robot(place: Path, robot: str, config_hash: str) -> DeclaredRobot:
    """Read a copy of a robot's folder: only declarative files, and only files inside it."""
    with only_below(place):
        folder, plan = read_declared_plan(place, robot, config_hash)
        known = replace(declared_references(folder, plan), measures=None)
        path = place / FILE
        fmea, problems = load_fmea(path, known) if path.is_file() else (None, [])
    return DeclaredRobot(folder, plan, known, fmea, problems)


def read_declared_plan(
    place: Path, robot: str, config_hash: str
) -> tuple[RobotFolder, MonitoringPlan]:
    """Read only the monitoring plan from a copy of a robot's folder."""
    with only_below(place):
        folder, _ = declared_folder(place, robot, config_hash)
        plan, _ = load_plan(folder, own=False)
    return folder, plan


def load_knowledge(
    folder: RobotFolder, plan: MonitoringPlan, exposure_h: float | None = None
) -> tuple[Knowledge | None, list[Problem]]:
    """Read a folder's failure modes; None without the file, and if it has errors."""
    path = folder.path / FILE
    if not path.exists():
        return None, []
    fmea, problems = load_fmea(path, fmea_references(folder, plan))
    if fmea is None:
        return None, problems
    return Knowledge(folder.robot.id, fmea, plan.config_hash, exposure_h), problems


def rule_problems(folder: RobotFolder) -> list[Problem]:
    """Return the problems of a folder's rule files, read as one program."""
    try:
        program = read_rules(rule_files(folder.path))
    except ConfigurationError as error:
        return list(error.problems)
    return [*program.notes, *program.problems()]
