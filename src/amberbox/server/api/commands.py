"""Routes of commands: what a robot can do, commands and their answers, leases, revoked keys."""

from __future__ import annotations

import base64
import binascii
from typing import Annotated, Any

from fastapi import Path, Query
from pydantic import Field

from amberbox.core.api import (
    AbortReport,
    CommandLine,
    CommandState,
    RevokedKeyLine,
    RobotCommands,
    RobotLease,
)
from amberbox.core.command import PARAMETERS_BYTES, CommandSignature, Risk
from amberbox.core.errors import UsageError
from amberbox.server.commands import LONGEST_DAYS
from amberbox.server.http.auth import Fleet, OfRobot, Routes, Who
from amberbox.server.http.forms import Form, Limit
from amberbox.server.services import commands
from amberbox.server.services.commands import LIFETIME_S, CommandOrder

routes = Routes("commands")

_NOT_NOW: dict[int | str, dict[str, Any]] = {
    409: {"description": "the robot is away, held by somebody else, or does not allow it now"}
}
_ID = r"^[0-9a-f]{32}$"
_BASE64 = r"^[A-Za-z0-9+/]{2,100}={0,2}$"
CommandId = Annotated[str, Path(pattern=_ID, description="the id of a command")]
_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
_Label = Annotated[str, Field(max_length=128, pattern=r"^[^\x00-\x1f\x7f-\x9f]*$")]
_Run = Annotated[_Label, Field(description="the run that it belongs to; empty: by hand")]
_LeaseNumber = Annotated[int, Field(ge=0, le=2**62, description="of the lease that was taken")]


class Signature(Form):
    """A person's Ed25519 signature over the canonical bytes of a command.

    ``challenge`` (hexadecimal) is what the robot minted, ``signature`` is Base64.
    """

    key_id: Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
    lease: _LeaseNumber
    challenge: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    ttl_s: Annotated[int, Field(ge=1, le=60, description="life after the challenge was minted")]
    server: _Name
    signature: Annotated[str, Field(pattern=_BASE64)]


class NewCommand(Form):
    """A command; without a ``signature`` one of risk ``state`` or ``moves`` waits for one.

    ``parameters`` is the JSON text of an object. A signed command has the ``id`` and ``risk`` that
    were signed.
    """

    action: _Name
    parameters: Annotated[str, Field(max_length=PARAMETERS_BYTES)] = "{}"
    run: _Run = ""
    step: _Label = ""
    risk: Annotated[Risk | None, Field(description="as the robot announces it, if empty")] = None
    id: Annotated[str, Field(pattern=r"^([0-9a-f]{32})?$", description="made here, if empty")] = ""
    lifetime_s: Annotated[
        float,
        Field(gt=0, le=LONGEST_DAYS * 86_400, description="how long it waits without signature"),
    ] = LIFETIME_S
    signature: Signature | None = None


class Target(Form):
    """What to stop: a command (its id), a run (its name); empty: all that the robot does."""

    target: _Label = ""


class MotionCode(Form):
    """The code that is shown at the robot."""

    code: Annotated[str, Field(pattern=r"^[0-9]{4,12}$")]


class TakenLease(Form):
    """The run to take a robot for; empty: by hand, with a name made here."""

    run: _Label = ""


class HeldLease(Form):
    """A lease that the caller has taken."""

    number: _LeaseNumber


class RevokedKey(Form):
    """A person's key that is not to sign anything any more, and why."""

    key_id: Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
    reason: Annotated[str, Field(min_length=1, max_length=1000, pattern=r"\S")]


@routes.get("/robots/{robot}/actions", "commands.read")
def show_robot(fleet: Fleet, who: Who, robot: OfRobot) -> RobotCommands:
    """Show what a robot can do, whether it takes commands, who holds it, and what waits there.

    ``challenge`` is only for those who may send commands.
    """
    return commands.show_robot(fleet, who, robot.id)


@routes.get("/robots/{robot}/commands", "commands.read")
def list_commands(
    fleet: Fleet,
    robot: OfRobot,
    state: Annotated[list[CommandState], Query(max_length=11, description="several fit")] = [],  # noqa: B006 - FastAPI copies it
    run: Annotated[str, Query(max_length=128)] = "",
    after: Annotated[int, Query(ge=0, le=2**62, description="last number of the page before")] = 0,
    limit: Limit = 100,
) -> list[CommandLine]:
    """List the commands of a robot, the newest first."""
    return commands.list_commands(fleet, robot.id, state, run, after, limit)


@routes.get("/robots/{robot}/commands/{id}", "commands.read")
def show_command(fleet: Fleet, robot: OfRobot, id: CommandId) -> CommandLine:
    """Show a command with what the robot answered."""
    return commands.show_command(fleet, robot.id, id)


@routes.post("/robots/{robot}/commands", "commands.write", status_code=201, responses=_NOT_NOW)
def send_command(fleet: Fleet, who: Who, robot: OfRobot, body: NewCommand) -> CommandLine:
    """Send a command that is signed; store one that is not until somebody signs it.

    The same command again changes nothing.
    """
    if body.signature is not None and not (body.id and body.risk):
        raise UsageError("a signed command has the id and the risk that were signed", "give both")
    order = CommandOrder(
        body.action, body.parameters, body.run, body.step, body.risk, body.id, body.lifetime_s,
        None if body.signature is None else _signature(body.signature),
    )  # fmt: skip
    return commands.send(fleet, who, robot.id, order)


@routes.post("/robots/{robot}/commands/{id}/sign", "commands.write", responses=_NOT_NOW)
def sign_command(
    fleet: Fleet, who: Who, robot: OfRobot, id: CommandId, body: Signature
) -> CommandLine:
    """Add a signature to a command that waits for one; it is sent at once."""
    return commands.sign(fleet, who, robot.id, id, _signature(body))


@routes.post("/robots/{robot}/commands/{id}/withdraw", "commands.write")
def withdraw_command(fleet: Fleet, who: Who, robot: OfRobot, id: CommandId) -> CommandLine:
    """Withdraw a command that was not sent yet."""
    return commands.withdraw(fleet, who, robot.id, id)


@routes.post("/robots/{robot}/commands/{id}/confirm", "commands.confirm", responses=_NOT_NOW)
async def confirm_command(
    fleet: Fleet, who: Who, robot: OfRobot, id: CommandId, body: MotionCode
) -> CommandLine:
    """Confirm the motion that waits, with the code that is shown at the robot."""
    return await commands.confirm(fleet, who, robot.id, id, body.code)


@routes.post("/robots/{robot}/abort", "commands.abort")
async def abort(fleet: Fleet, who: Who, robot: OfRobot, body: Target) -> AbortReport:
    """Stop a command, a run or all that a robot does; accepted always, and as often as wanted.

    This is no emergency stop: it needs the link to the robot, and its computer.
    """
    return await commands.abort(fleet, who, robot.id, body.target)


@routes.post("/robots/{robot}/lease", "commands.write", responses=_NOT_NOW)
async def take_lease(fleet: Fleet, who: Who, robot: OfRobot, body: TakenLease) -> RobotLease:
    """Take a robot; the lease is lost if it is not renewed for 3 s."""
    return await commands.take_lease(fleet, who, robot.id, body.run)


@routes.post("/robots/{robot}/lease/renew", "commands.write", responses=_NOT_NOW)
async def renew_lease(fleet: Fleet, who: Who, robot: OfRobot, body: HeldLease) -> RobotLease:
    """Renew a lease that one has taken, once a second."""
    return await commands.renew_lease(fleet, who, robot.id, body.number)


@routes.post("/robots/{robot}/lease/release", "commands.write", responses=_NOT_NOW)
async def release_lease(fleet: Fleet, who: Who, robot: OfRobot, body: HeldLease) -> RobotLease:
    """Release a lease that one has taken; what runs under it is stopped."""
    return await commands.release_lease(fleet, who, robot.id, body.number)


@routes.get("/revoked-keys", "commands.read", each=True)
def list_revoked_keys(fleet: Fleet) -> list[RevokedKeyLine]:
    """List the keys of persons that were revoked, the oldest revocation first."""
    return commands.list_revoked_keys(fleet)


@routes.post("/revoked-keys", "keys.write")
def revoke_key(fleet: Fleet, who: Who, body: RevokedKey) -> RevokedKeyLine:
    """Revoke a person's key on all robots, for ever; a lease that it used ends."""
    return commands.revoke_key(fleet, who, body.key_id, body.reason)


def _signature(body: Signature) -> CommandSignature:
    try:
        made = base64.b64decode(body.signature, validate=True)
    except (binascii.Error, ValueError):
        raise UsageError("the signature is no Base64", "64 bytes as Base64") from None
    return CommandSignature(
        body.key_id, body.lease, bytes.fromhex(body.challenge), body.ttl_s, body.server, made
    )
