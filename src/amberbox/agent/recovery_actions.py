"""Recovery actions that component files and ``fmea.yaml`` name, as far as the robot can do them.

An entry is written as on the command line, ``restart_driver unit=laser_front.service``. If
``actions/`` declares an action of this name, it can be run; else it is a text for people.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.consult.folder_knowledge import load_knowledge
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.experiments.action import (
    DeclaredAction,
    check_parameters,
    parameters_of_words,
    read_actions,
)
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan

_CALL = re.compile(r"[a-z][a-z0-9_-]*( +[a-z][a-z0-9_]*=\S*)*")
# An action of such a name restarts the units that one of its parameters lists
_RESTARTS = "restart"


@dataclass(frozen=True, slots=True)
class RecoveryAction:
    """What may help against a cause: a component, or a failure mode ``component#mode``.

    ``action`` is empty where it is only a text; ``problem`` is why, if it looks like an action.
    """

    cause: str
    text: str
    action: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    problem: str = ""

    @property
    def call(self) -> str:
        """Return the action and its parameters as words; empty where it is only a text."""
        words = (f"{name}={_word(value)}" for name, value in self.parameters.items())
        return shlex.join([self.action, *words]) if self.action else ""

    def command(self, folder: str) -> str:
        """Return the command that runs it in a robot folder; empty where it is only a text."""
        line = ["amberbox", "action", "run", folder]
        return f"{shlex.join(line)} {self.call}" if self.action else ""


def _word(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def recovery_actions(
    plan: MonitoringPlan, fmea: Fmea | None, actions: Mapping[str, DeclaredAction]
) -> list[RecoveryAction]:
    """Return everything that component files, their restarts and ``fmea.yaml`` name."""
    found = []
    for component in plan.components:
        units = component.restart_units
        for text in component.recovery_actions:
            unit = units.get(text)
            found.append(
                _parsed(component.id, text, actions)
                if unit is None
                else _restart(component.id, text, unit, actions)
            )
    for mode in fmea.modes.values() if fmea is not None else ():
        found += [_parsed(mode.id, text, actions) for text in mode.recovery]
    return found


def folder_recoveries(folder: RobotFolder) -> list[RecoveryAction]:
    """Return the recovery actions of a robot folder; its own Python is not loaded for that."""
    plan, _ = load_plan(folder, own=False)
    knowledge, _ = load_knowledge(folder, plan)
    fmea = None if knowledge is None else knowledge.fmea
    return recovery_actions(plan, fmea, read_actions(folder.path)[0])


def causes_by_action(found: Sequence[RecoveryAction]) -> dict[str, list[str]]:
    """Return what each action recovers, by the action's name."""
    causes: dict[str, list[str]] = {}
    for one in found:
        if one.action and one.cause not in causes.setdefault(one.action, []):
            causes[one.action].append(one.cause)
    return causes


def command_lines(
    found: Sequence[RecoveryAction], causes: Sequence[str], folder: str
) -> Iterator[str]:
    """Yield the commands that may help against causes, each once."""
    commands = (one.command(folder) for cause in causes for one in found if one.cause == cause)
    yield from (line for line in dict.fromkeys(commands) if line)


def _parsed(cause: str, text: str, actions: Mapping[str, DeclaredAction]) -> RecoveryAction:
    if not _CALL.fullmatch(text.strip()):
        return RecoveryAction(cause, text)
    name, *words = text.split()
    action = actions.get(name)
    if action is None:
        what = f"there is no action '{name}'{did_you_mean(name, actions)}" if words else ""
        return RecoveryAction(cause, text, problem=what)
    try:
        values = parameters_of_words(action, words)
        check_parameters(action, json.dumps(values))
    except UsageError as error:
        return RecoveryAction(cause, text, problem=error.what)
    return RecoveryAction(cause, text, name, values)


def _restart(
    cause: str, text: str, unit: str, actions: Mapping[str, DeclaredAction]
) -> RecoveryAction:
    """Return the action that restarts a unit: one of whose parameters has it as a choice."""
    for name, action in actions.items():
        for parameter, options in action.parameters.items():
            if name.startswith(_RESTARTS) and unit in options.choices:
                return RecoveryAction(cause, text, name, {parameter: unit})
    return RecoveryAction(cause, text)
