"""What is known of the faults of a robot folder, for those who diagnose."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from amberbox.blackbox.folder.folder import RobotFolder
from amberbox.consult.known import known_of
from amberbox.consult.rulefiles import rule_files
from amberbox.core.errors import ConfigurationError, Problem
from amberbox.diagnosis.fmea.load import FILE, load_fmea
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.rules import read_rules
from amberbox.monitoring.plan import Plan

if TYPE_CHECKING:
    from amberbox.monitoring.watcher.diagnosing import MakeDiagnoser


def knowledge_of(
    folder: RobotFolder, plan: Plan, exposure_h: float | None = None
) -> tuple[Knowledge | None, list[Problem]]:
    """Read a folder's failure modes; None without the file, and if it has errors."""
    path = folder.path / FILE
    if not path.exists():
        return None, []
    fmea, problems = load_fmea(path, known_of(folder, plan))
    if fmea is None:
        return None, problems
    return Knowledge(folder.robot.id, fmea, plan.config_hash, exposure_h), problems


def diagnoser_of(folder: RobotFolder, plan: Plan) -> tuple[MakeDiagnoser | None, list[Problem]]:
    """Return what makes a tracker of a folder's faults; None without failure modes to go by."""
    from amberbox.diagnosis.tracking.tracker import Tracker

    knowledge, problems = knowledge_of(folder, plan)
    return (None if knowledge is None else partial(Tracker, knowledge)), problems


def rule_problems(folder: RobotFolder) -> list[Problem]:
    """Judge the rule files of a folder, read as one program."""
    try:
        program = read_rules(rule_files(folder.path))
    except ConfigurationError as error:
        return list(error.problems)
    return [*program.notes, *program.problems()]
