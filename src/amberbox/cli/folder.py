"""Check a robot folder without touching a device; show what would be done with it."""

from __future__ import annotations

import argparse
import fnmatch
import json
import shutil
import textwrap
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from amberbox.agent.command_trust import CommandTrust, read_trust, trust_path
from amberbox.agent.recovery import recovery_problems
from amberbox.agent.recovery_actions import RecoveryAction, causes_by_action, recovery_actions
from amberbox.agent.unit_tests import collect, problems_of
from amberbox.blackbox.robot_folder.folder import (
    BLACK_BOX_FILE,
    ROBOT_FILE,
    PlannedItem,
    RobotFolder,
    inspect_folder,
    planned_items,
)
from amberbox.blackbox.robot_folder.robot_yaml import trigger_problems
from amberbox.cli._output import in_columns, print_lines
from amberbox.cli.action import action_rows
from amberbox.cli.experiment_files import summary
from amberbox.consult.folder_knowledge import load_knowledge, monitor_addresses, rule_problems
from amberbox.core.errors import (
    AmberboxError,
    ConfigurationError,
    Problem,
    did_you_mean,
)
from amberbox.core.redaction import masked_values
from amberbox.core.yaml_nodes import load_yaml
from amberbox.detection.model_file import load_model
from amberbox.diagnosis.fmea.loader import FILE as FMEA
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.models import ModelFile, check_models, unknown_modes
from amberbox.experiments.action import DeclaredAction, read_actions
from amberbox.experiments.experiment import FOLDER as EXPERIMENTS
from amberbox.experiments.profile import Experiment, list_experiments, read_experiment
from amberbox.experiments.unit_tests import ACTION_PREFIX, TestCollection, UnitTest
from amberbox.monitoring.component_files import FOLDER as COMPONENTS
from amberbox.monitoring.plan import (
    MonitoringPlan,
    monitor_of,
    needs_text,
    plan_data,
    plan_text,
    short_table,
)
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.rule_tests import find_rule_tests, run_rule_tests

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
    actions, found = read_actions(Path(args.folder))
    tests = collect(Path(args.folder))
    plan, fmea, recovery = None, None, list[RecoveryAction]()
    if folder and Path(args.folder).is_dir():
        plan, fmea = _monitors(folder, tests, problems)
        recovery = recovery_actions(plan, fmea, actions)
        problems += _recovery(folder, actions, plan, fmea)
    problems += _triggers(folder, items, plan) if folder else []
    problems += _not_judged(Path(args.folder)) if folder is None else []
    problems += found
    problems += problems_of(Path(args.folder), tests)
    orders = [*actions, *(ACTION_PREFIX + test.name for test in tests.tests)]
    trust, found = _trust(folder, orders) if folder else (None, [])
    problems += found
    experiments, found = _experiments(Path(args.folder))
    problems += [*found, *_unknown_modes(experiments, folder, plan)]
    models, found = check_models(Path(args.folder))
    problems += found
    problems += unknown_modes(models, fmea.modes) if fmea is not None else ()
    problems += _detection(folder) if folder else []
    ok = not any(problem.is_error for problem in problems)
    if args.json:
        monitoring = {} if plan is None else {"monitoring": plan_data(plan)}
        causes = causes_by_action(recovery)
        able = {
            "actions": [
                action.announced() | {"recovers": causes.get(action.name, [])}
                for action in actions.values()
            ],
            "tests": [test.announced() for test in tests.tests],
            "recovery_actions": [
                {"cause": one.cause, "text": one.text, "command": one.command(args.folder),
                 "problem": one.problem}
                for one in recovery
            ],
            "experiments": [summary(experiment) for experiment in experiments],
            "models": [{"name": model.name, "kind": model.kind} for model in models],
        }  # fmt: skip
        print(json.dumps(_check_json(folder, items, problems, ok) | monitoring | able, indent=2))
    else:
        lines = [
            *_recovery_lines(recovery), *_action_lines(actions.values()),
            *_test_lines(tests.tests), *_experiment_lines(experiments), *_model_lines(models),
            *_trust_lines(trust),
        ]  # fmt: skip
        print_lines(_check_lines(args.folder, folder, items, problems, plan, lines, args.modes))
    return 0 if ok else ConfigurationError.exit_code


def _trust(
    folder: RobotFolder, actions: Collection[str]
) -> tuple[CommandTrust | None, list[Problem]]:
    """Read the trust file that the folder names; return it and notes on what is wrong with it.

    They are no errors of the folder, which records and monitors all the same: the robot refuses
    signed commands until they are mended.
    """
    path = trust_path(folder)
    if path is None:
        return None, []
    nobody = "the robot takes no signed command until it is right"

    def note(problem: Problem) -> Problem:
        what = f"{problem.what}; {nobody}"
        return replace(problem, what=what, is_error=False)

    try:
        trust = read_trust(path)
    except ConfigurationError as error:
        return None, [note(problem) for problem in error.problems]
    except AmberboxError as error:
        return None, [note(Problem(str(path), 1, "file", error.what, error.hint))]
    unknown = [
        Problem(str(path), 1, f"people.{name}.actions", f"no action is called '{pattern}'"
                f"{did_you_mean(pattern, actions)}", is_error=False)
        for name, person in trust.people.items()
        for pattern in person.actions
        if pattern != "*" and not fnmatch.filter(actions, pattern)
    ]  # fmt: skip
    return trust, unknown


def _detection(folder: RobotFolder) -> list[Problem]:
    """Return a note if the model of the detectors is of no use; all else runs without it."""
    options = folder.robot.detection
    if options is None:
        return []
    node = load_yaml(folder.path / ROBOT_FILE, [])
    place = (node.mapping or {}).get("detection") if node is not None else None
    try:
        load_model(options.file(folder.path))
    except AmberboxError as error:
        what = f"{error.what}; no detector runs until it is right"
        line = 1 if place is None else place.line
        where = str(folder.path / ROBOT_FILE)
        return [Problem(where, line, "detection.model", what, error.hint, is_error=False)]
    return []


def _trust_lines(trust: CommandTrust | None) -> list[str]:
    if trust is None:
        return []
    rows = [(name, one.risk, ", ".join(one.actions)) for name, one in trust.people.items()]
    return [f"would take commands of server {trust.server}:", *in_columns(rows), ""]


def _not_judged(path: Path) -> list[Problem]:
    """Return a note that component files are not checked until the recording's files are right."""
    if not (path / COMPONENTS).is_dir():
        return []
    what = f"is judged when {ROBOT_FILE} and {BLACK_BOX_FILE} are right"
    return [Problem(str(path / COMPONENTS), 1, "file", what, is_error=False)]


def _recovery(
    folder: RobotFolder,
    actions: Mapping[str, DeclaredAction],
    plan: MonitoringPlan,
    fmea: Fmea | None,
) -> list[Problem]:
    """Check the rules of recovery against everything that the folder has."""
    rules, unread = folder.robot.recovery, list[Problem]()
    node = load_yaml(folder.path / ROBOT_FILE, unread) if rules else None
    return [] if node is None else list(recovery_problems(node, rules, actions, plan, fmea))


def _monitors(
    folder: RobotFolder, tests: TestCollection, problems: list[Problem]
) -> tuple[MonitoringPlan, Fmea | None]:
    """Check monitors with their tests, failure modes and rules; append their problems.

    Unit tests are checked for the failure modes that they name.
    """
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
    knowledge, found = load_knowledge(folder, plan)
    problems += [*found, *rule_problems(folder)]
    modes = () if knowledge is None else knowledge.fmea.modes
    problems += [
        Problem(
            str(folder.path / test.file), test.line, test.name,
            f"there is no failure mode '{mode}'{did_you_mean(mode, modes)}", is_error=False,
        )
        for test in tests.tests for mode in test.about if mode not in modes
    ]  # fmt: skip
    if knowledge is not None and not tests.problems:
        problems += _not_collected(folder, knowledge, [test.name for test in tests.tests])
    return plan, None if knowledge is None else knowledge.fmea


def _not_collected(
    folder: RobotFolder, knowledge: Knowledge, names: Collection[str]
) -> Iterator[Problem]:
    """Yield a problem for each unit test of ``fmea.yaml`` that pytest does not find.

    Its names are compared with the text of the files before; values of parameters only here.
    """
    for test in knowledge.fmea.tests.values():
        if test.kind == "unit_test" and test.run not in names:
            what = f"pytest finds no unit test '{test.run}'{did_you_mean(test.run, names)}"
            yield Problem(str(folder.path / FMEA), 1, f"tests.{test.id}.unit_test", what)


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
    width = shutil.get_terminal_size((_WIDTH, 0)).columns
    each_mode = each_mode or len(plan.modes()) <= _FEW_MODES
    table = in_full(plan, width) if each_mode else in_short(plan, width)
    return [f"would monitor: {plan_text(plan)}", *table, ""]


def _recovery_lines(found: Sequence[RecoveryAction]) -> list[str]:
    width = shutil.get_terminal_size((_WIDTH, 0)).columns
    rows = [(one.cause, one.call or f"only a text: {one.text}", one.problem) for one in found]
    entries = _entries([(cause, f"{what} ({why})" if why else what) for cause, what, why in rows],
                       width, "  ")  # fmt: skip
    head = "recovery actions, for 'amberbox action run':"
    return [head, *(line for entry in entries for line in entry), ""] if rows else []


def _action_lines(actions: Collection[DeclaredAction]) -> list[str]:
    width = shutil.get_terminal_size((_WIDTH, 0)).columns
    rows = [
        (name, risk, f"{description} ({parameters})" if parameters != "-" else description)
        for name, risk, parameters, description in action_rows(actions)
    ]
    entries = _entries(rows, width, "  ")
    return ["can do:", *(line for entry in entries for line in entry), ""] if actions else []


def _test_lines(tests: Sequence[UnitTest]) -> list[str]:
    width = shutil.get_terminal_size((_WIDTH, 0)).columns
    rows = [(test.name, test.risk, test.description) for test in tests]
    entries = _entries(rows, width, "  ")
    return ["can test:", *(line for entry in entries for line in entry), ""] if tests else []


def _experiments(folder: Path) -> tuple[list[Experiment], list[Problem]]:
    """Return the experiments of a robot folder that can be run, and the problems of all."""
    found, problems = [], list[Problem]()
    for path in list_experiments(folder / EXPERIMENTS):
        experiment, of_file = read_experiment(path, folder)
        problems += of_file
        found += [] if experiment is None else [experiment]
    return found, problems


def _unknown_modes(
    experiments: Sequence[Experiment], folder: RobotFolder | None, plan: MonitoringPlan | None
) -> list[Problem]:
    """Return the failure modes that an experiment is about and that nothing declares."""
    about = [(one, mode) for one in experiments for mode in one.options.about]
    knowledge = load_knowledge(folder, plan)[0] if about and folder and plan else None
    known = knowledge.fmea.modes if knowledge is not None else {}
    return [
        Problem(str(one.path), 1, "experiment.about", f"there is no failure mode '{mode}'"
                f"{did_you_mean(mode, known)}")
        for one, mode in about
        if knowledge is not None and mode not in known
    ]  # fmt: skip


def _experiment_lines(experiments: Sequence[Experiment]) -> list[str]:
    width = shutil.get_terminal_size((_WIDTH, 0)).columns
    rows = [
        (one.name, ", ".join(one.person_roles) or "-", one.options.description or one.title)
        for one in experiments
    ]
    entries = _entries(rows, width, "  ")
    lines = [line for entry in entries for line in entry]
    return ["experiments:", *lines, ""] if lines else []


def _model_lines(models: Sequence[ModelFile]) -> list[str]:
    rows = [(model.name, model.kind) for model in models]
    return ["models:", *in_columns(rows), ""] if models else []


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
