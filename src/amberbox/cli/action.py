"""Actions of a robot: list what its folder declares; carry one out by hand, at the robot."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from amberbox.cli._arguments import add_actions
from amberbox.cli._output import print_grid, print_json
from amberbox.core.errors import AmberboxError, ConfigurationError, UsageError
from amberbox.core.interrupt import Interrupt
from amberbox.experiments.action import (
    FOLDER,
    DeclaredAction,
    ParameterOptions,
    announcement,
    check_parameters,
    load_action,
    read_actions,
)

_USAGE = (
    "amberbox action [list] FOLDER | run FOLDER NAME [PARAMETER=VALUE ...] [--simulated] [--yes] "
    "[--json]"
)
_RENEW_S = 0.5
_YES_NO = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


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
        print_grid(("action", "risk", "parameters", "description"), action_rows(found.values()))
    else:
        print(f"no actions: there is no {FOLDER}/*.yaml in {folder}")
    errors = [problem for problem in problems if problem.is_error]
    if errors:
        raise ConfigurationError(errors)
    return 0


def action_rows(actions: Any) -> list[Sequence[str]]:
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
        text = "|".join(map(str, parameter.choices))
    elif parameter.kind in ("int", "float"):
        low, high = parameter.min, parameter.max
        text = f"{'' if low is None else f'{low:g}'} .. {'' if high is None else f'{high:g}'}"
    else:
        text = parameter.kind
    return f"{text} {parameter.unit}".strip()


def _run(args: argparse.Namespace, folder: Path) -> int:
    from amberbox.agent.actor import Task  # few verbs need it
    from amberbox.agent.actor_supervisor import SupervisedActor

    if not args.rest:
        raise UsageError("action run needs the NAME of an action", _USAGE)
    action = load_action(folder, args.rest[0])
    text = _parameters(action, args.rest[1:])
    values = check_parameters(action, text)
    if args.simulated and not action.has("simulated"):
        raise UsageError(f"{action.name} has no simulated twin", "declare 'simulated:' for it")
    if action.options.risk == "moves" and not (args.yes or args.simulated):
        _ask(action, values)
    task = Task(str(folder.absolute()), action.name, text, simulated=args.simulated)
    actor = SupervisedActor(task, lambda line: print(f"  {line}", file=sys.stderr, flush=True))
    interrupted = False
    outcome = None
    while outcome is None:
        try:
            actor.renew()
            outcome = actor.wait(_RENEW_S)
        except KeyboardInterrupt:  # the robot is stopped first, however often it is pressed
            interrupted = True
            actor.abort("aborted with Ctrl-C")
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


def _parameters(action: DeclaredAction, words: Sequence[str]) -> str:
    """Return words ``NAME=VALUE`` as a JSON object; values are judged with their limits later."""
    found: dict[str, Any] = {}
    for word in words:
        name, is_given, value = word.partition("=")
        if not is_given:
            raise UsageError(f"'{word}' is no parameter", "write it as distance_m=0.5")
        if name in found:
            raise UsageError(f"'{name}' is given twice", _USAGE)
        declared = action.parameters.get(name)
        found[name] = value if declared is None else _value(declared.kind, value)
    return json.dumps(found)


def _value(kind: str, text: str) -> Any:
    if kind == "bool":
        return _YES_NO.get(text.lower(), text)
    if kind != "string":
        with contextlib.suppress(ValueError):
            return int(text)
        with contextlib.suppress(ValueError):
            return float(text)
    return text


def _ask(action: DeclaredAction, values: dict[str, Any]) -> None:
    """Ask on the terminal whether the robot may move; raises UsageError if not."""
    if not sys.stdin.isatty():
        raise UsageError(f"{action.name} moves the robot", "--yes says that nobody is in its way")
    shown = " ".join(f"{name}={value}" for name, value in values.items())
    question = f"{action.name} {shown}".rstrip() + " moves the robot. Is its way free? [y/N] "
    if input(question).strip().lower() not in ("y", "yes"):
        raise UsageError("not confirmed: nothing was done")
