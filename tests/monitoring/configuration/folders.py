"""Robot folders made of texts, for tests of their monitors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.core.errors import Problem
from amberbox.monitoring.plan import ComponentPlan, MappingPlan, ModePlan, MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan

BLACK_BOX = """\
- ros:
    topics:
      - topic: {name: /scan_front, type: sensor_msgs/LaserScan}
      - topic: {name: /odom, type: nav_msgs/Odometry}
      - topic: {name: /own/data, type: own_msgs/Data, variable_names: [sensors, count]}
      - topic: {name: /other, type: own_msgs/Other}
"""


def make_folder(path: Path, files: Mapping[str, str], black_box: str = BLACK_BOX) -> Path:
    """Write a robot folder; names of files are seen from ``components/``."""
    (path / "robot.yaml").write_text("id: ropod_001\n")
    (path / "black_box.yaml").write_text(black_box)
    for name, text in files.items():
        place = path / "components" / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text)
    return path


def plan_of(
    path: Path, files: Mapping[str, str], black_box: str = BLACK_BOX
) -> tuple[MonitoringPlan, list[Problem]]:
    """Load the plan of a folder made of texts."""
    return load_plan(load_folder(make_folder(path, files, black_box)))


def mode_files(text: str) -> Mapping[str, str]:
    """Make a folder's files of one mode file."""
    return {"part.yaml": "component_name: part\nmodes: [mode.yaml]\n", "mode.yaml": text}


def mode_of(path: Path, text: str, black_box: str = BLACK_BOX) -> tuple[ModePlan, list[Problem]]:
    """Load one mode file."""
    plan, problems = plan_of(path, mode_files(text), black_box)
    return plan.components[0].modes[0], problems


def mapping_of(path: Path, text: str, black_box: str = BLACK_BOX) -> MappingPlan:
    """Load one mode file without errors and return its only mapping."""
    mode, problems = mode_of(path, text, black_box)
    assert errors(problems) == []
    (mapping,) = mode.mappings
    return mapping


def component(plan: MonitoringPlan, name: str) -> ComponentPlan:
    """Find a component."""
    return next(entry for entry in plan.components if entry.id == name)


def errors(problems: list[Problem]) -> list[str]:
    """Return the errors, each as ``file:line: where: what``, without the folder."""
    return [_short(problem) for problem in problems if problem.is_error]


def notes(problems: list[Problem]) -> list[str]:
    """Return the notes, in the same form."""
    return [_short(problem) for problem in problems if not problem.is_error]


def _short(problem: Problem) -> str:
    name = problem.file.rpartition("/components/")[2]
    return f"{name}:{problem.line}: {problem.where}: {problem.what}"
