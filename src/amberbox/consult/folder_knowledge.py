"""Knowledge of a robot's faults from its folder, and what its failure modes can refer to.

``read_declared_robot`` reads a copy of a folder without running any code in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.blackbox.columns.variables import names_of
from amberbox.blackbox.robot_folder.folder import RobotFolder, declared_folder
from amberbox.core.errors import ConfigurationError, Problem, UsageError
from amberbox.core.expressions.tree import status_address
from amberbox.core.needs import Needs, all_of
from amberbox.core.yaml_nodes import only_below
from amberbox.diagnosis.evidence.rules import rule_files, with_rules
from amberbox.diagnosis.fmea.loader import FILE, load_fmea
from amberbox.diagnosis.fmea.model import Fmea, FmeaReferences
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.prolog.program import read_rules
from amberbox.monitoring.plan import ComponentPlan, MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.recorded_items import RecordedItems

if TYPE_CHECKING:
    from amberbox.monitoring.record_evaluation import MakeDiagnoser


def fmea_references(folder: RobotFolder, plan: MonitoringPlan | None = None) -> FmeaReferences:
    """Return the outputs of a folder's monitors, its components' needs, and the recorded items."""
    plan = plan or load_plan(folder)[0]
    known, variables = declared_references(folder, plan), _variables(RecordedItems(folder))
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
    """Return the same without recorded variables; conditions may then read any variable."""
    return with_rules(plan_references(plan), folder.path)


def _variables(recorded: RecordedItems) -> list[str] | None:
    """Return the addresses of all variables that will be recorded; None if some are unknown."""
    schemas = {item.name: recorded.schema(item) for item in recorded.items}
    if recorded.open or None in schemas.values():
        return None
    return [f"{name}.{of}" for name, schema in schemas.items() if schema for of in names_of(schema)]


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
    return FmeaReferences(frozenset(outputs), frozenset(watched), needs, files=files)


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
        known = declared_references(folder, plan)
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


def load_diagnoser(
    folder: RobotFolder, plan: MonitoringPlan
) -> tuple[MakeDiagnoser | None, list[Problem]]:
    """Return a maker of fault trackers for a folder; None without failure modes."""
    from amberbox.diagnosis.tracker import FaultTracker

    knowledge, problems = load_knowledge(folder, plan)
    return (None if knowledge is None else partial(FaultTracker, knowledge)), problems


def rule_problems(folder: RobotFolder) -> list[Problem]:
    """Return the problems of a folder's rule files, read as one program."""
    try:
        program = read_rules(rule_files(folder.path))
    except ConfigurationError as error:
        return list(error.problems)
    return [*program.notes, *program.problems()]
