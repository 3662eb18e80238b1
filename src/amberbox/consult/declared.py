"""What is known of a robot by a copy of its folder, where nothing of it may run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.folder.declared import declared_folder
from amberbox.blackbox.folder.folder import RobotFolder
from amberbox.consult.known import declared_of
from amberbox.consult.rulefiles import rule_files
from amberbox.core.errors import Problem, UsageError
from amberbox.core.nodes import only_below
from amberbox.diagnosis.fmea.known import Known
from amberbox.diagnosis.fmea.load import FILE, load_fmea
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.monitoring.configuration import load_plan
from amberbox.monitoring.plan import Plan

_SHOWN = 3


@dataclass(frozen=True, slots=True)
class Declared:
    """A robot's folder as it was: its monitors, as far as they are known here, and its faults.

    ``problems`` are those of ``fmea.yaml``; with an error there are no failure modes.
    """

    folder: RobotFolder
    plan: Plan
    known: Known
    fmea: Fmea | None
    problems: Sequence[Problem]

    def faults(self) -> Fmea:
        """Return the failure modes; raises UsageError where there are none."""
        if self.fmea is not None:
            return self.fmea
        errors = [problem for problem in self.problems if problem.is_error]
        if not errors:
            what = f"the folder of {self.folder.robot.id} has no {FILE}"
            raise UsageError(f"{what}: nobody has said what can fail", "see docs/fmea.md")
        shown = "; ".join(f"{p.where}: {p.what} (line {p.line})" for p in errors[:_SHOWN])
        raise UsageError(f"{FILE} of {self.folder.robot.id} is wrong: {shown}", "see docs/fmea.md")

    def knowledge(self, exposure_h: float | None = None) -> Knowledge:
        """Return the failure modes ready for the engines; raises as ``faults`` does."""
        of = self.folder
        return Knowledge(of.robot.id, self.faults(), of.config_hash, exposure_h)

    def rules(self) -> list[Path]:
        """Return the rule files."""
        return rule_files(self.folder.path)


def declared(place: Path, robot: str, config_hash: str) -> Declared:
    """Read a copy of a robot's folder: only declarations, and only what is below it."""
    with only_below(place):
        folder, plan = declared_plan(place, robot, config_hash)
        known = declared_of(folder, plan)
        path = place / FILE
        fmea, problems = load_fmea(path, known) if path.is_file() else (None, [])
    return Declared(folder, plan, known, fmea, problems)


def declared_plan(place: Path, robot: str, config_hash: str) -> tuple[RobotFolder, Plan]:
    """Return only what is to be monitored by a copy of a robot's folder."""
    with only_below(place):
        folder, _ = declared_folder(place, robot, config_hash)
        plan, _ = load_plan(folder, own=False)
    return folder, plan
