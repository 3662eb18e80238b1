"""Actions of a robot: list what its folder declares; carry one out by hand, at the robot."""

from __future__ import annotations

import argparse
import getpass
import json
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from amberbox.cli._arguments import add_actions
from amberbox.cli._output import in_columns, print_json, print_lines, print_notes
from amberbox.core.errors import AmberboxError, ConfigurationError, UsageError
from amberbox.core.interrupt import Interrupt
from amberbox.experiments.action import (
    FOLDER,
    DeclaredAction,
    ParameterOptions,
    announcement,
    check_parameters,
    load_action,
    parameters_of_words,
    read_actions,
)
from amberbox.experiments.local import ActionAtWork

_USAGE = (
    "amberbox action [list] FOLDER | run FOLDER NAME [PARAMETER=VALUE ...] [--simulated] [--yes] "
    "[--json]"
)
_RENEW_S = 0.5
_LONG = 40  # characters of choices that are not broken into lines


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this verb."""
    parser.usage = _USAGE
    place = "a robot folder; then the NAME of an action and its parameters, distance_m=0.5"
    add_actions(parser, {"list": (), "run": ("NAME",)}, "list", place)
    parser.add_argument("--simulated", action="store_true", help="run the twin, without the robot")
    parser.add_argument("--yes", action="store_true", help="do not ask before the robot moves")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """List the actions of a folder, or carry one out."""
    folder = Path(args.where)
    if not folder.is_dir():
        hint = "actions are run by hand at the robot, in its folder"
        raise UsageError(f"there is no folder '{args.where}'", hint)
    if args.action == "run":
        return _run(args, folder)
    if args.rest or args.simulated or args.yes:
        raise UsageError("action list takes a folder and no more words", _USAGE)
    return _list(args, folder)


def _list(args: argparse.Namespace, folder: Path) -> int:
    found, problems = read_actions(folder)
    if args.json:
        print_json(json.loads(announcement(folder)))
    elif found:
        header = ("action", "risk", "parameters", "description")
        print_lines(in_columns([header, *action_rows(found.values())], ""))
    else:
        print(f"no actions: there is no {FOLDER}/*.yaml in {folder}")
    errors = [problem for problem in problems if problem.is_error]
    if errors:
        raise ConfigurationError(errors)
    return 0


def action_rows(actions: Iterable[DeclaredAction]) -> list[Sequence[str]]:
    """Return a row for each action: name, risk, parameters with their limits, description."""
    return [
        (
            action.name,
            action.options.risk,
            ", ".join(f"{name} {limits_text(p)}".rstrip() for name, p in action.parameters.items())
            or "-",
            action.options.description,
        )
        for action in actions
    ]


def limits_text(parameter: ParameterOptions) -> str:
    """Return the values that a parameter may have: ``-2 .. 2 m``."""
    if parameter.choices:
        choices = [str(choice) for choice in parameter.choices]
        text = "|".join(choices)
        text = text if len(text) <= _LONG else " | ".join(choices)
    elif parameter.kind in ("int", "float"):
        low, high = parameter.min, parameter.max
        text = f"{'' if low is None else f'{low:g}'} .. {'' if high is None else f'{high:g}'}"
    else:
        text = parameter.kind
    return f"{text} {parameter.unit}".strip()


def _run(args: argparse.Namespace, folder: Path) -> int:
    if not args.rest:
        raise UsageError("action run needs the NAME of an action", _USAGE)
    action = load_action(folder, args.rest[0])
    text = json.dumps(parameters_of_words(action, args.rest[1:]))
    values = check_parameters(action, text)
    if action.options.risk == "moves" and not (args.yes or args.simulated):
        ask_before_moving(action.name, values)
    port = ActionPort(folder, simulated=args.simulated)
    run = port.begin(
        action.name, text, None, lambda line: print(f"  {line}", file=sys.stderr, flush=True)
    )
    interrupted = False
    outcome: Any = None  # of either kind; the command process prints nothing here
    while outcome is None:
        try:
            run.renew()
            outcome = run.wait(_RENEW_S)
        except KeyboardInterrupt:  # the robot is stopped first, however often it is pressed
            interrupted = True
            run.abort("Ctrl-C")
    if args.json:
        print_json({
            "action": action.name, "state": outcome.state, "reason": outcome.reason,
            "result": json.loads(outcome.result) if outcome.result else None,
            "printed": outcome.printed,
        })  # fmt: skip
    else:
        print(outcome.printed, end="", file=sys.stderr)
    if outcome.state != "done" and not interrupted:
        what = f"{action.name}: {outcome.state.replace('_', ' ')}: {outcome.reason}"
        raise AmberboxError(what, outcome.hint)
    if not args.json:
        print(": ".join(filter(None, (outcome.state, outcome.reason, outcome.result))))
    return Interrupt.STATUS if interrupted else 0


class ActionPort:
    """The actions of a robot folder, carried out here (``experiments.local.RobotPort``).

    The command process carries them out where one runs, so that only one commands the robot.
    """

    def __init__(self, folder: Path, *, simulated: bool = False) -> None:
        from amberbox.agent.command_socket import orders_at  # few verbs need it

        self._folder, self._is_simulated = folder, simulated
        self._store = None if simulated else orders_at(folder)
        if not simulated and self._store is None:
            print_notes(["no command process runs (amberbox run): nothing keeps others from "
                         "commanding meanwhile, and the record has nothing of it"])  # fmt: skip

    def begin(
        self, action: str, parameters: str, timeout_s: float | None, report: Callable[[str], None]
    ) -> ActionAtWork:
        """Begin an action; raises AmberboxError if the robot does not take it."""
        from amberbox.agent.actor import Task  # few verbs need them
        from amberbox.agent.actor_supervisor import SupervisedActor
        from amberbox.agent.command_socket import SiteOrder

        declared = self._declared(action)
        check_parameters(declared, parameters)
        if self._is_simulated and not declared.has("simulated"):
            raise UsageError(f"{action} has no simulated twin", "declare 'simulated:' for it")
        if self._store is not None:
            return SiteOrder(
                self._store, action, parameters, who=_who(), confirmed=True, report=report
            )
        task = Task(
            str(self._folder.absolute()), action, parameters, timeout_s,
            simulated=self._is_simulated,
        )  # fmt: skip
        return SupervisedActor(task, report)

    def timeout_s(self, action: str) -> float:
        """Return the longest run of an action, which it declares."""
        return self._declared(action).options.timeout

    def moves(self, action: str) -> bool:
        """Return whether an action moves the robot."""
        return self._declared(action).options.risk == "moves"

    def _declared(self, action: str) -> DeclaredAction:
        """Return an action, or a unit test as one (``test.NAME``), as it is declared now."""
        from amberbox.agent.unit_test_action import is_unit_test, load_unit_test
        from amberbox.agent.unit_tests import collect

        if not is_unit_test(action):
            return load_action(self._folder, action)
        collect(self._folder)
        return load_unit_test(self._folder, action)


def _who() -> str:
    """Return who is at the terminal, for the record."""
    try:
        return f"{os.environ.get('SUDO_USER') or getpass.getuser()} at the robot"
    except (OSError, KeyError):  # a user without a name
        return f"user {os.getuid()} at the robot"


def ask_before_moving(name: str, values: dict[str, Any]) -> None:
    """Ask on the terminal whether the robot may move; raises UsageError if not."""
    if not sys.stdin.isatty():
        raise UsageError(f"{name} moves the robot", "--yes says that nobody is in its way")
    shown = " ".join(f"{name}={value}" for name, value in values.items())
    question = f"{name} {shown}".rstrip() + " moves the robot. Is its way free? [y/N] "
    print(question, end="", flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise UsageError("not confirmed: nothing was done")
