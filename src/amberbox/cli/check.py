"""Judge a robot folder without touching a device; show what would be recorded and monitored."""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from amberbox.blackbox.folder.folder import (
    BLACK_BOX_FILE,
    ROBOT_FILE,
    RobotFolder,
    inspect_folder,
)
from amberbox.blackbox.folder.plan import PlannedItem, planned_items
from amberbox.blackbox.folder.triggers import trigger_problems
from amberbox.cli._plantext import in_full, in_short
from amberbox.cli._text import in_columns, print_lines
from amberbox.consult.knowledge import knowledge_of, rule_problems
from amberbox.consult.known import addresses_of
from amberbox.core.config import load_yaml
from amberbox.core.errors import ConfigurationError, Problem
from amberbox.core.redaction import as_plain
from amberbox.monitoring.configuration import load_plan, summary
from amberbox.monitoring.configuration.tree import FOLDER as COMPONENTS
from amberbox.monitoring.plan import Plan
from amberbox.monitoring.ruletests.files import find_rules
from amberbox.monitoring.ruletests.running import run_rules

_WIDTH = 100
"""Columns of the output where there is no terminal."""

_FEW_MODES = 20
"""So many modes are listed one by one without being asked for."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this verb."""
    parser.add_argument("folder", help="a robot folder, or a single black_box.yaml")
    parser.add_argument("--modes", action="store_true", help="list every mode of a component")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Print all problems and notes, and the plan if there is no error; return 0 or 2."""
    folder, problems = inspect_folder(args.folder)
    items = planned_items(folder, problems) if folder else []
    plan = _monitors(folder, problems) if folder and Path(args.folder).is_dir() else None
    problems += _triggers(folder, items, plan) if folder else []
    problems += _not_judged(Path(args.folder)) if folder is None else []
    ok = not any(problem.is_error for problem in problems)
    if args.json:
        monitoring = {} if plan is None else {"monitoring": summary.as_data(plan)}
        print(json.dumps(_report(folder, items, problems, ok) | monitoring, indent=2))
    else:
        print_lines(_lines(args.folder, folder, items, problems, plan, args.modes))
    return 0 if ok else ConfigurationError.exit_code


def _not_judged(path: Path) -> list[Problem]:
    """Note that component files wait until it is known what is recorded."""
    if not (path / COMPONENTS).is_dir():
        return []
    what = f"is judged when {ROBOT_FILE} and {BLACK_BOX_FILE} are right"
    return [Problem(str(path / COMPONENTS), 1, "file", what, is_error=False)]


def _gates_without_monitor(folder: RobotFolder, plan: Plan) -> list[Problem]:
    """Note components of which nothing can be known: waiting for one is over at once."""
    place = str(folder.path / COMPONENTS)
    what = (
        "has no monitor, and needs nothing that has one: 'amberbox status --wait' is over at once"
    )
    return [
        Problem(place, 1, component.id, what, is_error=False)
        for component in plan.components
        if not component.modes and not any(need.component for need in component.dependencies)
    ]


def _monitors(folder: RobotFolder, problems: list[Problem]) -> Plan:
    """Judge the monitors, run their tests, judge failure modes and rules; add what is wrong."""
    plan, found = load_plan(folder)
    problems += found
    rules = find_rules(folder.path, skip=folder.store_path)
    problems += rules.problems
    problems += [problem for entry in rules.rules for problem in run_rules(entry, plan)]
    problems += _gates_without_monitor(folder, plan)
    problems += [*knowledge_of(folder, plan)[1], *rule_problems(folder)]
    return plan


def _triggers(
    folder: RobotFolder, items: Sequence[PlannedItem], plan: Plan | None
) -> list[Problem]:
    """Judge the items, outputs and statuses that triggers name by the plan."""
    path, unread = folder.path / ROBOT_FILE, list[Problem]()
    node = load_yaml(path, unread) if folder.robot.triggers else None
    if node is None:
        return []
    sources = [block.name for block in folder.blocks]
    names = [item.item for item in items]
    monitors = None if plan is None else addresses_of(plan)
    return list(trigger_problems(node, folder.robot.triggers, sources, names, monitors))


def _report(
    folder: RobotFolder | None, items: Sequence[PlannedItem], problems: Sequence[Problem], ok: bool
) -> dict[str, Any]:
    report: dict[str, Any] = {"ok": ok, "problems": [as_plain(problem) for problem in problems]}
    if folder is None:
        return report
    return report | {
        "robot": as_plain(folder.robot),
        "store": str(folder.store_path),
        "config_hash": folder.config_hash,
        "sources": [{"name": block.name, "plugin": block.plugin} for block in folder.blocks],
        "items": [as_plain(item) for item in items],
        "not_built": list(folder.not_built),
    }


def _lines(
    name: str,
    folder: RobotFolder | None,
    items: Sequence[PlannedItem],
    problems: Sequence[Problem],
    plan: Plan | None,
    each_mode: bool = False,
) -> list[str]:
    errors = [str(problem) for problem in problems if problem.is_error]
    notes = [str(problem) for problem in problems if not problem.is_error]
    verdict = f"{_count(errors, 'error')}, {_count(notes, 'note')}" if errors else "fine"
    recorded = _plan(folder, items) if folder and (plan is not None or not errors) else []
    return [*recorded, *_monitored(plan, each_mode), *notes, *errors, f"{name}: {verdict}"]


def _monitored(plan: Plan | None, each_mode: bool) -> list[str]:
    if plan is None or not plan.components:
        return []
    actions = list(summary.actions(plan))
    shown = ["recovery actions, not carried out:", *in_columns(actions), ""] if actions else []
    width = shutil.get_terminal_size((_WIDTH, 0)).columns
    each_mode = each_mode or len(plan.modes()) <= _FEW_MODES
    table = in_full(plan, width) if each_mode else in_short(plan, width)
    return [f"would monitor: {summary.in_words(plan)}", *table, "", *shown]


def _count(of: Sequence[object], what: str) -> str:
    return f"{len(of)} {what}{'' if len(of) == 1 else 's'}"


def _plan(folder: RobotFolder, items: Sequence[PlannedItem]) -> list[str]:
    facts = [
        ("robot", " ".join(part for part in (folder.robot.id, folder.robot.model) if part)),
        ("store", str(folder.store_path)),
        ("configuration", folder.config_hash[:16]),
        *([("not built yet", ", ".join(folder.not_built))] if folder.not_built else []),
    ]
    listening = {item.source for item in items}
    open_ended = [block.name for block in folder.blocks if block.name not in listening]
    everything = [f"  {name}: everything it hears" for name in open_ended]
    return [*in_columns(facts, ""), "would record:", *everything, *in_columns(_table(items)), ""]


def _table(items: Sequence[PlannedItem]) -> list[tuple[str, ...]]:
    header = ("item", "topic", "type", "at most", "keep", "variables")
    return [header, *(_row(item) for item in items)] if items else []


def _row(item: PlannedItem) -> tuple[str, ...]:
    rate = "-" if item.max_frequency is None else f"{item.max_frequency:g} Hz"
    variables = str(len(item.variables)) if item.variables else "all"
    return item.item, item.topic, item.type or "as heard", rate, item.keep, variables
