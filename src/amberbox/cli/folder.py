"""Robot folders: start one from a sample; check one without touching a device."""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import textwrap
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from amberbox.blackbox.robot_folder.folder import (
    BLACK_BOX_FILE,
    ROBOT_FILE,
    SOURCES,
    PlannedItem,
    RobotFolder,
    inspect_folder,
    load_folder,
    planned_items,
)
from amberbox.blackbox.robot_folder.robot_yaml import trigger_problems
from amberbox.cli._output import in_columns, print_lines
from amberbox.cli.action import action_rows
from amberbox.consult.folder_knowledge import load_knowledge, monitor_addresses, rule_problems
from amberbox.core.errors import ConfigurationError, Problem, UsageError
from amberbox.core.names import derive_id
from amberbox.core.plugins import get
from amberbox.core.redaction import masked_values
from amberbox.core.yaml_nodes import load_yaml
from amberbox.experiments.action import DeclaredAction, read_actions
from amberbox.monitoring.component_files import FOLDER as COMPONENTS
from amberbox.monitoring.plan import (
    MonitoringPlan,
    list_recovery_actions,
    monitor_of,
    needs_text,
    plan_data,
    plan_text,
    short_table,
)
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.rule_tests import find_rule_tests, run_rule_tests

_ROBOT = """\
# Who this robot is, and where its record goes. All keys: docs/robot/configuration.md

id: "{id}"                 # name in addresses and on the server: a-z 0-9 _ . -
model: ""                  # make and model
software_version: ""       # version of the robot's own software

store:
  path: store              # folder of the record, relative to this one
  # quota: 50 GB           # most that the record may take; the oldest data go first
  # min_free: 1 GB         # room that stays free on the partition
  # keep_min: 24 h         # the newest data are not deleted for room
  # ring_s: 5 min          # how long topics with 'keep: ring' are kept

# 'amberbox join' with the line that a fleet server printed writes the server here:
# server:
#   url: https://fleet.example.org:8443
#   copy: always           # when journals are copied: docked, on_request, network NAME
#   rate: 0                # most bytes in a second; 0 for as fast as it goes
"""

_BLACK_BOX = """\
# What the box listens to: one block per source. 'amberbox plugins' lists the sources,
# 'amberbox plugins {plugin}' shows all keys of this one.

- default_parameters:
    max_frequency: 100     # Hz, for listed topics that do not state their own

{sample}"""


def configure_new(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this verb."""
    parser.add_argument("folder", help="folder to make, or one without these files")
    parser.add_argument(
        "--from", dest="source", default="sim", metavar="SOURCE", help="source to start with [sim]"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run_new(args: argparse.Namespace) -> int:
    """Write the files; never overwrites any."""
    folder = Path(args.folder)
    plugin = get(SOURCES, args.source, defines=("Config", "Source"))
    module = plugin.load()
    more = _files_of_source(module.FOLDER) if hasattr(module, "FOLDER") else {}
    sample = more.pop(BLACK_BOX_FILE, module.SAMPLE)
    robot = _ROBOT.replace("{id}", derive_id(folder.resolve().name))
    black_box = _BLACK_BOX.replace("{plugin}", plugin.name).replace("{sample}", sample)
    files = {ROBOT_FILE: robot, BLACK_BOX_FILE: black_box, **more}
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"'{folder}' is a file", "name a folder")
    there = [name for name in files if (folder / name).exists()]
    if there:
        what = f"'{folder}' has {_file_names(there)} already, nothing was written"
        raise UsageError(
            what, f"edit what is there, or name another folder; amberbox check {folder}"
        )
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    load_folder(folder)
    if args.json:
        print(json.dumps({"folder": str(folder), "files": sorted(files)}))
    else:
        print(f"wrote {_file_names(files)} in {folder}")
        word = shlex.quote(str(folder))
        watch = (
            f", and beside it amberbox watch {word}" if "components" in _file_names(files) else ""
        )
        print(f"next: look at them, then amberbox check {word}, amberbox record {word}{watch}")
    return 0


def _files_of_source(folder: Path) -> dict[str, str]:
    """Return the files that belong to a source, such as its monitors, by their paths."""
    kinds = {".yaml", ".pl"}
    paths = sorted(path for path in folder.rglob("*") if path.suffix in kinds and path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_text(encoding="utf-8") for path in paths}


def _file_names(names: Iterable[str]) -> str:
    """Return the names of files, with whole folders instead of their contents."""
    return " and ".join(sorted({name.partition("/")[0] for name in names}))


_WIDTH = 100  # columns of the output where there is no terminal

_FEW_MODES = 20  # up to this number, modes are listed without --modes


def configure_check(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this verb."""
    parser.add_argument("folder", help="a robot folder, or a single black_box.yaml")
    parser.add_argument("--modes", action="store_true", help="list every mode of a component")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run_check(args: argparse.Namespace) -> int:
    """Print all problems and notes, and the plan if there is no error; return 0 or 2."""
    folder, problems = inspect_folder(args.folder)
    items = planned_items(folder, problems) if folder else []
    plan = _monitors(folder, problems) if folder and Path(args.folder).is_dir() else None
    problems += _triggers(folder, items, plan) if folder else []
    problems += _not_judged(Path(args.folder)) if folder is None else []
    actions, found = read_actions(Path(args.folder))
    problems += found
    ok = not any(problem.is_error for problem in problems)
    if args.json:
        monitoring = {} if plan is None else {"monitoring": plan_data(plan)}
        able = {"actions": [action.announced() for action in actions.values()]}
        print(json.dumps(_check_json(folder, items, problems, ok) | monitoring | able, indent=2))
    else:
        lines = _action_lines(actions.values())
        print_lines(_check_lines(args.folder, folder, items, problems, plan, lines, args.modes))
    return 0 if ok else ConfigurationError.exit_code


def _not_judged(path: Path) -> list[Problem]:
    """Return a note that component files are not checked until the recording's files are right."""
    if not (path / COMPONENTS).is_dir():
        return []
    what = f"is judged when {ROBOT_FILE} and {BLACK_BOX_FILE} are right"
    return [Problem(str(path / COMPONENTS), 1, "file", what, is_error=False)]


def _monitors(folder: RobotFolder, problems: list[Problem]) -> MonitoringPlan:
    """Check monitors with their tests, failure modes and rules; append their problems."""
    plan, found = load_plan(folder)
    problems += found
    rules = find_rule_tests(folder.path, skip=folder.store_path)
    problems += rules.problems
    problems += [problem for entry in rules.rules for problem in run_rule_tests(entry, plan)]
    place = str(folder.path / COMPONENTS)
    what = (
        "has no monitor, and needs nothing that has one: 'amberbox status --wait' is over at once"
    )
    problems += [
        Problem(place, 1, component.id, what, is_error=False)
        for component in plan.components
        if not component.modes and not any(need.component for need in component.dependencies)
    ]
    problems += [*load_knowledge(folder, plan)[1], *rule_problems(folder)]
    return plan


def _triggers(
    folder: RobotFolder, items: Sequence[PlannedItem], plan: MonitoringPlan | None
) -> list[Problem]:
    """Check the items, outputs and statuses that triggers name against the plan."""
    path, unread = folder.path / ROBOT_FILE, list[Problem]()
    node = load_yaml(path, unread) if folder.robot.triggers else None
    if node is None:
        return []
    sources = [block.name for block in folder.blocks]
    names = [item.item for item in items]
    monitors = None if plan is None else monitor_addresses(plan)
    return list(trigger_problems(node, folder.robot.triggers, sources, names, monitors))


def _check_json(
    folder: RobotFolder | None, items: Sequence[PlannedItem], problems: Sequence[Problem], ok: bool
) -> dict[str, Any]:
    report: dict[str, Any] = {
        "ok": ok,
        "problems": [masked_values(problem) for problem in problems],
    }
    if folder is None:
        return report
    return report | {
        "robot": masked_values(folder.robot),
        "store": str(folder.store_path),
        "config_hash": folder.config_hash,
        "sources": [{"name": block.name, "plugin": block.plugin} for block in folder.blocks],
        "items": [masked_values(item) for item in items],
        "not_built": list(folder.not_built),
    }


def _check_lines(
    name: str,
    folder: RobotFolder | None,
    items: Sequence[PlannedItem],
    problems: Sequence[Problem],
    plan: MonitoringPlan | None,
    actions: Sequence[str],
    each_mode: bool = False,
) -> list[str]:
    errors = [str(problem) for problem in problems if problem.is_error]
    notes = [str(problem) for problem in problems if not problem.is_error]
    verdict = f"{_count_text(errors, 'error')}, {_count_text(notes, 'note')}" if errors else "fine"
    recorded = _recorded_lines(folder, items) if folder and (plan is not None or not errors) else []
    monitored = _monitored(plan, each_mode)
    return [*recorded, *monitored, *actions, *notes, *errors, f"{name}: {verdict}"]


def _monitored(plan: MonitoringPlan | None, each_mode: bool) -> list[str]:
    if plan is None or not plan.components:
        return []
    actions = list(list_recovery_actions(plan))
    shown = ["recovery actions, not carried out:", *in_columns(actions), ""] if actions else []
    width = shutil.get_terminal_size((_WIDTH, 0)).columns
    each_mode = each_mode or len(plan.modes()) <= _FEW_MODES
    table = in_full(plan, width) if each_mode else in_short(plan, width)
    return [f"would monitor: {plan_text(plan)}", *table, "", *shown]


def _action_lines(actions: Collection[DeclaredAction]) -> list[str]:
    width = shutil.get_terminal_size((_WIDTH, 0)).columns
    rows = [
        (name, risk, f"{description} ({parameters})" if parameters != "-" else description)
        for name, risk, parameters, description in action_rows(actions)
    ]
    entries = _entries(rows, width, "  ")
    return ["can do:", *(line for entry in entries for line in entry), ""] if actions else []


def _count_text(of: Sequence[object], what: str) -> str:
    return f"{len(of)} {what}{'' if len(of) == 1 else 's'}"


def _recorded_lines(folder: RobotFolder, items: Sequence[PlannedItem]) -> list[str]:
    facts = [
        ("robot", " ".join(part for part in (folder.robot.id, folder.robot.model) if part)),
        ("store", str(folder.store_path)),
        ("configuration", folder.config_hash[:16]),
        *([("not built yet", ", ".join(folder.not_built))] if folder.not_built else []),
    ]
    listening = {item.source for item in items}
    open_ended = [block.name for block in folder.blocks if block.name not in listening]
    everything = [f"  {name}: everything it hears" for name in open_ended]
    return [
        *in_columns(facts, ""),
        "would record:",
        *everything,
        *in_columns(_planned_table(items)),
        "",
    ]


def _planned_table(items: Sequence[PlannedItem]) -> list[tuple[str, ...]]:
    header = ("item", "topic", "type", "at most", "keep", "variables")
    return [header, *(_planned_row(item) for item in items)] if items else []


def _planned_row(item: PlannedItem) -> tuple[str, ...]:
    rate = "-" if item.max_frequency is None else f"{item.max_frequency:g} Hz"
    variables = str(len(item.variables)) if item.variables else "all"
    return item.item, item.topic, item.type or "as heard", rate, item.keep, variables


_LEAST_COLUMNS = 24  # least width of the last column


def in_short(plan: MonitoringPlan, width: int) -> list[str]:
    """Return a line for each component, with its dependencies folded below."""
    return [line for entry in _entries(list(short_table(plan)), width, "  ") for line in entry]


def in_full(plan: MonitoringPlan, width: int) -> Iterator[str]:
    """Yield each component with its dependencies, and its modes with their outputs."""
    rows = [
        (mode.id, monitor_of(mode), " ".join(output.name for output in mode.outputs) or "-")
        for _, mode in plan.modes()
    ]
    modes = iter(_entries(rows, width, "    "))
    for component in plan.components:
        needs = needs_text(component, ", ")
        about = "" if component.modes else " (nothing monitors it)"
        line = f"  {component.id}{about}{': needs ' if needs else ''}{needs}"
        yield from textwrap.wrap(line, width, subsequent_indent=" " * 6, break_long_words=False)
        for _ in component.modes:
            yield from next(modes)


def _entries(rows: Sequence[Sequence[str]], width: int, indent: str) -> Iterator[list[str]]:
    """Yield the lines of each row: aligned cells, with the last one wrapped below itself."""
    heads = in_columns([[*row[:-1], "|"] for row in rows], indent)
    for head, row in zip(heads, rows, strict=True):
        at = len(head) - 1
        texts = textwrap.wrap(
            row[-1], max(width - at, _LEAST_COLUMNS), break_long_words=False, break_on_hyphens=False
        )
        first, *others = texts or [""]
        yield [(head[:at] + first).rstrip(), *(" " * at + text for text in others)]
