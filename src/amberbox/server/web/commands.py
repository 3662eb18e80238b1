"""Pages of commands: what a robot can be told to do, what it does, what waits for a person."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Final, Literal
from urllib.parse import quote

from fastapi import Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import QueryParams
from starlette.responses import RedirectResponse

from amberbox.core.api import CommandLine, RobotAction, RobotCommands
from amberbox.core.command import is_command_id
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.experiments.action import AnnouncedAction, parameters_of_words
from amberbox.experiments.run import TEST_PREFIX
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.commands import OPEN, UNANSWERED
from amberbox.server.http.auth import Fields, Fleet, OfRobot, Who
from amberbox.server.http.errors import status_of
from amberbox.server.services import commands
from amberbox.server.services.commands import LIFETIME_S, CommandOrder
from amberbox.server.services.context import Caller, Services
from amberbox.server.services.robots import read_card
from amberbox.server.web.page import PageRoutes, is_own_path, render
from amberbox.server.web.text import catalogue

routes = PageRoutes()

FIELD: Final = "p."
"""What the names of parameters begin with in forms and addresses."""
LIFETIMES_S: Final = (3600.0, LIFETIME_S, 7 * 86_400.0)
"""How long a command may wait for a signature."""
_STEP: Final = 30
_LONGEST: Final = 1000

CommandId = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]
Text = Annotated[str, Query(max_length=64)]
Number = Annotated[int, Query(ge=0, le=2**62)]
Aborted = Literal["", "yes", "away"]


@dataclass(frozen=True, slots=True)
class Draft:
    """What somebody has filled in to have an action done, and what is wrong with it.

    ``errors`` are those of parameters by name, ``problem`` is why the whole was refused.
    """

    action: str = ""
    values: Mapping[str, str] = field(default_factory=dict)
    lifetime: str = ""
    errors: Mapping[str, str] = field(default_factory=dict)
    problem: AmberboxError | None = None


@dataclass(frozen=True, slots=True)
class RunningCommand:
    """A command that the robot has, and what it has reported of it last."""

    line: CommandLine
    report: str


@routes.get("/robots/{robot}/commands", "commands.read")
def show_robot(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, action: Text = "",
    after: Number = 0, aborted: Aborted = "",
) -> Response:  # fmt: skip
    """Show what a robot can do, what it does, and the commands of before."""
    draft = Draft(action, _typed(request.query_params))
    return _robot_page(request, fleet, who, robot, draft, after, aborted)


@routes.get("/pieces/robots/{robot}/commands", "commands.read")
def show_robot_parts(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, after: Number = 0
) -> Response:
    """Return the fragments of a robot's commands that change."""
    return render(request, "commands/live.html", **_live(fleet, who, robot, after))


@routes.form("/robots/{robot}/commands", "commands.write")
def order(request: Request, fleet: Fleet, who: Who, robot: OfRobot, fields: Fields) -> Response:
    """Store a command; one that needs a signature then waits for it."""
    draft = Draft(fields.get("action", "")[:64], _typed(fields), fields.get("lifetime", ""))
    try:
        values, errors = _values(commands.find_action(fleet, robot.id, draft.action), draft)
        if errors:
            return _robot_page(request, fleet, who, robot, replace(draft, errors=errors))
        wanted = fields.get("id", "")
        line = commands.send(fleet, who, robot.id, CommandOrder(
            draft.action, json.dumps(values, ensure_ascii=False),
            id=wanted if is_command_id(wanted) else "", lifetime_s=_lifetime_s(draft.lifetime),
        ))  # fmt: skip
    except AmberboxError as error:
        return _robot_page(request, fleet, who, robot, replace(draft, problem=error))
    return RedirectResponse(command_href(line), 303)


def _typed(fields: QueryParams) -> dict[str, str]:
    return {
        name.removeprefix(FIELD): value[: _LONGEST + 1]
        for name, value in fields.items()
        if name.startswith(FIELD)
    }


def _values(action: AnnouncedAction, draft: Draft) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the values of all parameters, and what is wrong with each that was refused.

    Values of parameters that the action does not have are left in: they are refused with the whole.
    """
    words = [f"{name}={text}" for name, text in draft.values.items() if text.strip()]
    values = parameters_of_words(action, words)
    errors: dict[str, str] = {}
    for name, parameter in action.parameters.items():
        value = values.get(name, parameter.default)
        if value is None and parameter.kind == "string":
            value = ""
        try:
            if value is None:
                raise ValueError(catalogue().text("commands.order.missing"))
            values[name] = parameter.accept(value)
        except ValueError as error:
            errors[name] = str(error)
    return values, errors


def _lifetime_s(text: str) -> float:
    if not text:
        return LIFETIME_S
    for lifetime_s in LIFETIMES_S:
        if text == f"{lifetime_s:g}":
            return lifetime_s
    raise UsageError(f"'{text[:20]}' is none of the times to choose from", "choose one")


@routes.form("/robots/{robot}/commands/abort", "commands.abort")
async def abort(fleet: Fleet, who: Who, robot: OfRobot, fields: Fields) -> Response:
    """Stop a command, a run, or all that a robot does."""
    report = await commands.abort(fleet, who, robot.id, fields.get("target", "")[:128])
    aborted = "yes" if report.delivered else "away"
    return RedirectResponse(_next(fields) or f"{robot_href(robot.id)}?aborted={aborted}", 303)


@routes.get("/robots/{robot}/commands/{id}", "commands.read")
def show_command(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, id: CommandId
) -> Response:
    """Show a command: what was ordered, what the robot answered, what it waits for."""
    return _command_page(request, fleet, who, robot, id)


@routes.get("/pieces/robots/{robot}/commands/{id}", "commands.read")
def show_command_parts(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, id: CommandId
) -> Response:
    """Return the fragments of a command that change."""
    return render(request, "commands/of_command.html", **_one(fleet, who, robot, id))


@routes.form("/robots/{robot}/commands/{id}/confirm", "commands.confirm")
async def confirm(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, id: CommandId, fields: Fields
) -> Response:
    """Confirm the motion that waits, with the code that is shown at the robot."""
    code = re.sub(r"\s", "", fields.get("code", "")[:64])
    try:
        if not re.fullmatch(r"[0-9]{4,12}", code):
            hint = catalogue().text("commands.code.read_it")
            raise UsageError(catalogue().text("commands.code.no_code"), hint)
        await commands.confirm(fleet, who, robot.id, id, code)
    except AmberboxError as error:
        return await run_in_threadpool(_command_page, request, fleet, who, robot, id, error)
    return RedirectResponse(_next(fields) or command_href_of(robot.id, id), 303)


@routes.form("/robots/{robot}/commands/{id}/withdraw", "commands.write")
def withdraw(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, id: CommandId, fields: Fields
) -> Response:
    """Withdraw a command that was not sent yet."""
    try:
        commands.withdraw(fleet, who, robot.id, id)
    except UsageError as error:
        return _command_page(request, fleet, who, robot, id, error)
    return RedirectResponse(_next(fields) or command_href_of(robot.id, id), 303)


@routes.get("/commands", "commands.read", each=True)
def show_unsigned(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show what waits for a signature, of all robots."""
    return render(request, "commands/commands.html", **_unsigned(fleet, who))


@routes.get("/pieces/commands", "commands.read", each=True)
def show_unsigned_list(request: Request, fleet: Fleet, who: Who) -> Response:
    """Return the fragment with what waits for a signature."""
    return render(request, "commands/unsigned.html", **_unsigned(fleet, who))


@routes.get("/pieces/commands/count", "commands.read", each=True)
def show_unsigned_count(request: Request, fleet: Fleet, who: Who) -> Response:
    """Return the fragment that says how many commands wait for a signature."""
    unsigned = commands.list_unsigned(fleet, who)
    return render(request, "commands/count.html", unsigned=len(unsigned))


def robot_href(robot: str) -> str:
    """Return the address of the page of a robot's commands."""
    return f"/robots/{quote(robot, safe='')}/commands"


def command_href(line: CommandLine) -> str:
    """Return the address of the page of a command."""
    return command_href_of(line.robot, line.id)


def command_href_of(robot: str, id: str) -> str:
    """Return the address of the page of a command, by its id."""
    return f"{robot_href(robot)}/{id}"


def _next(fields: QueryParams) -> str:
    """Return the address on this server where a form leads on to, empty for none."""
    wanted = fields.get("next", "")
    return wanted if is_own_path(wanted) else ""


def _robot_page(
    request: Request, fleet: Services, who: Caller, robot: KnownRobot, draft: Draft,
    after: int = 0, aborted: Aborted = "",
) -> Response:  # fmt: skip
    shown = _live(fleet, who, robot, after)
    state: RobotCommands = shown["state"]
    status = 400 if draft.errors else status_of(draft.problem) if draft.problem else 200
    return render(
        request, "commands/robot.html", status, card=read_card(fleet, robot), draft=draft,
        groups=_by_risk(state.actions), aborted=aborted, lifetimes=LIFETIMES_S,
        lifetime=draft.lifetime or f"{LIFETIME_S:g}", **shown,
    )  # fmt: skip


def _by_risk(actions: Sequence[RobotAction]) -> Mapping[str, Sequence[RobotAction]]:
    """Return the actions by risk, without unit tests, which are started as runs."""
    mine = [one for one in actions if not one.name.startswith(TEST_PREFIX)]
    groups = {risk: [one for one in mine if one.risk == risk] for risk in ("state", "moves")}
    return {risk: found for risk, found in groups.items() if found}


def _live(fleet: Services, who: Caller, robot: KnownRobot, after: int) -> Mapping[str, Any]:
    """Return what the changing fragments of a robot's commands show."""
    state = commands.show_robot(fleet, who, robot.id)
    present = commands.list_commands(fleet, robot.id, (*OPEN, "accepted"))
    found = commands.list_commands(fleet, robot.id, after=after, limit=_STEP + 1)
    waiting = [one for one in present if one.id == state.waiting]
    return {
        "robot": robot.id, "state": state, "after": after,
        "running": [
            RunningCommand(one, commands.last_report(fleet, robot.id, one.id))
            for one in present if one.state in (*UNANSWERED, "accepted")
        ],
        "waiting": waiting[0] if waiting else None,
        "unsigned": [one for one in present if one.state == "unsigned"],
        "history": found[:_STEP], "more": found[_STEP - 1].number if len(found) > _STEP else 0,
        "may": _may(who, robot), "command_href": command_href,
    }  # fmt: skip


def _command_page(
    request: Request, fleet: Services, who: Caller, robot: KnownRobot, id: str,
    problem: AmberboxError | None = None,
) -> Response:  # fmt: skip
    return render(
        request, "commands/command.html", status_of(problem) if problem else 200,
        card=read_card(fleet, robot), **_one(fleet, who, robot, id, problem),
    )  # fmt: skip


def _one(
    fleet: Services, who: Caller, robot: KnownRobot, id: str,
    problem: AmberboxError | None = None,
) -> Mapping[str, Any]:  # fmt: skip
    """Return what the page of a command shows."""
    line = commands.show_command(fleet, robot.id, id)
    state = commands.show_robot(fleet, who, robot.id)
    report = commands.last_report(fleet, robot.id, id) if line.state == "accepted" else ""
    return {
        "robot": robot.id, "line": line, "state": state, "report": report, "problem": problem,
        "waiting": line if state.waiting == id else None, "may": _may(who, robot),
        "parameters": _shown_parameters(line),
        "typed_run": shlex.quote(line.run) if line.run else "",
    }  # fmt: skip


def _shown_parameters(line: CommandLine) -> Mapping[str, str]:
    """Return the values of a command as JSON texts by name."""
    try:
        found = json.loads(line.parameters)
    except (ValueError, RecursionError):
        return {}
    named = found.items() if isinstance(found, dict) else ()
    return {str(name): json.dumps(value, ensure_ascii=False) for name, value in named}


def _unsigned(fleet: Services, who: Caller) -> Mapping[str, Any]:
    found = commands.list_unsigned(fleet, who)
    with fleet.database.reading() as connection:
        mine = {robot.id for robot in who.robots(connection, "commands.write")}
    return {"unsigned": found, "mine": mine, "command_href": command_href}


def _may(who: Caller, robot: KnownRobot) -> Mapping[str, bool]:
    return {
        name: who.may(f"commands.{name}", robot) for name in ("write", "confirm", "abort")
    } | {"revoke": who.may("keys.write")}  # fmt: skip
