"""Commands to robots, for API, pages and runs: send, sign, confirm, abort; leases; revoked keys.

What is checked here spares people a refusal; the robot decides. Whether the caller may do it is
checked before.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import msgspec
from sqlalchemy import Connection, select

from amberbox.blackbox.journal import channels
from amberbox.core.api import (
    AbortReport,
    ActionParameter,
    AnswerLine,
    CommandLine,
    CommandState,
    RevokedKeyLine,
    RobotAction,
    RobotCommands,
    RobotLease,
)
from amberbox.core.clock import NS
from amberbox.core.command import (
    RISKS,
    Command,
    CommandSignature,
    LeaseState,
    Risk,
    is_command_id,
    new_command_id,
)
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.timestamps import format_time, maybe_time
from amberbox.experiments.action import (
    AnnouncedAction,
    ParameterOptions,
    check_parameters,
    read_announcement,
)
from amberbox.experiments.run import TEST_PREFIX
from amberbox.link.frames import AbortFrame, ConfirmFrame, LeaseFrame
from amberbox.server import commands
from amberbox.server.accounts.robots import find_robot
from amberbox.server.bus import ServerChange
from amberbox.server.commands import StoredCommand
from amberbox.server.experiments.runner import CommandReport
from amberbox.server.ingest.command_link import RobotContact
from amberbox.server.schema import ROW
from amberbox.server.services.context import Caller, NotFoundError, NotNowError, Services

# How long a robot has to say what it decided
DECIDE_S = 3.0
# How long a command without a signature waits where nothing else is asked for
LIFETIME_S = 24 * 3600.0
_LABEL = 128
_MOST_UNSIGNED = 1000
# Rows about commands that a report is looked for in: a robot writes at most 10 in a second
_LATEST_ROWS = 100
_REPORT_LENGTH = 500


@dataclass(frozen=True, slots=True)
class CommandOrder:
    """What somebody wants a robot to do.

    ``parameters`` is the JSON text of an object. Without ``risk`` it is that which the robot has
    announced. A signed one has the ``id`` that was signed; its life is that of the signature.
    """

    action: str
    parameters: str = "{}"
    run: str = ""
    step: str = ""
    risk: Risk | None = None
    id: str = ""
    lifetime_s: float = LIFETIME_S
    signature: CommandSignature | None = None


# -- what there is


def list_commands(
    fleet: Services, robot: str, state: Collection[CommandState] = (), run: str = "",
    after: int = 0, limit: int = 100,
) -> list[CommandLine]:  # fmt: skip
    """List the commands of a robot, the newest first; ``after`` is the last number before."""
    with fleet.database.reading() as connection:
        found = commands.listed(
            connection, fleet.clock.wall_ns(), robot, after or None, limit, states=state, run=run
        )
    return [command_line(one) for one in found]


def list_unsigned(fleet: Services, who: Caller) -> list[CommandLine]:
    """List what waits for a signature, of all robots that the caller may see, the newest first."""
    with fleet.database.reading() as connection:
        mine = {robot.id for robot in who.robots(connection, "commands.read")}
        now_ns = fleet.clock.wall_ns()
        found = commands.listed(connection, now_ns, limit=_MOST_UNSIGNED, states=["unsigned"])
    return [command_line(one) for one in found if one.robot in mine]


def last_report(fleet: Services, robot: str, id: str) -> str:
    """Return what a robot has lately reported of a command that it carries out; empty for nothing.

    The robot wrote the text.
    """
    r = ROW.c
    chosen = select(r.data).where(r.robot == robot, r.channel == channels.COMMAND)
    with fleet.database.reading() as connection:
        rows = connection.scalars(chosen.order_by(r.log_ns.desc()).limit(_LATEST_ROWS)).all()
    for data in rows:
        with contextlib.suppress(msgspec.MsgspecError, UnicodeDecodeError):
            said = msgspec.json.decode(data, type=CommandReport)
            if (said.id, said.state) == (id, "report"):
                return said.text[:_REPORT_LENGTH]
    return ""


def find_action(fleet: Services, robot: str, name: str) -> AnnouncedAction:
    """Find an action that a robot has announced; raises UsageError."""
    with fleet.database.reading() as connection:
        known = _announced(connection, robot)
    if name not in known:
        raise _unknown_action(robot, name, known)
    return known[name]


def remedies(fleet: Services, robot: str) -> Mapping[str, Sequence[str]]:
    """Return the actions that a robot says to be remedies, by component or failure mode."""
    found: dict[str, list[str]] = {}
    with fleet.database.reading() as connection:
        for name, action in sorted(_announced(connection, robot).items()):
            # what a unit test names is what it tests
            for cause in () if name.startswith(TEST_PREFIX) else action.recovers:
                found.setdefault(cause, []).append(name)
    return found


def show_command(fleet: Services, robot: str, id: str) -> CommandLine:
    """Show a command with its answers; raises NotFoundError."""
    with fleet.database.reading() as connection:
        return command_line(_find(connection, fleet.clock.wall_ns(), robot, id))


def command_line(one: StoredCommand) -> CommandLine:
    """Return a stored command as an answer of the API."""
    return CommandLine(
        number=one.number, id=one.id, robot=one.robot, action=one.action,
        parameters=one.parameters, risk=one.risk, issuer=one.issuer, run=one.run, step=one.step,
        key_id=one.key_id, state=one.state, reason=one.reason,
        created=format_time(one.created_ns), expires=format_time(one.expires_ns),
        sent=maybe_time(one.sent_ns), answered=maybe_time(one.answered_ns),
        answers=[
            AnswerLine(
                said.state, said.reason, said.result, format_time(said.at_ns),
                format_time(said.received_ns),
            )
            for said in one.answers
        ],
    )  # fmt: skip


def show_robot(fleet: Services, who: Caller, robot: str) -> RobotCommands:
    """Show what a robot can do, who holds it, and what waits; a challenge for who may command."""
    challenges = fleet.links.challenges(robot)
    contact = fleet.links.contact(robot)
    with fleet.database.reading() as connection:
        said = commands.commanded(connection, robot)
        may_command = who.may("commands.write", find_robot(connection, robot))
    actions, left_out = read_announcement(said.actions) if said else ({}, 0)
    number = 0 if said is None else said.lease.number
    lease = (contact.lease if contact else None) or LeaseState(number)
    waiting = contact.waiting if contact else None
    return RobotCommands(
        robot=robot, online=robot in fleet.links.robots, takes_commands=bool(challenges),
        server_id=fleet.links.server_id, lease=RobotLease(lease.number, lease.holder, lease.run),
        waiting=waiting.id if waiting else "", by_code=bool(waiting and waiting.by_code),
        tries=waiting.tries if waiting else 0,
        challenge=challenges[-1].hex() if challenges and may_command else "",
        actions=[_action(actions[name]) for name in sorted(actions)],
        announced=maybe_time(said.actions_ns) if said else None, left_out=left_out,
    )  # fmt: skip


def _action(action: AnnouncedAction) -> RobotAction:
    parameters = [action_parameter(name, one) for name, one in action.parameters.items()]
    return RobotAction(
        action.name, action.risk, action.description, action.timeout_s, action.simulated,
        parameters, action.recovers,
    )  # fmt: skip


def action_parameter(name: str, one: ParameterOptions) -> ActionParameter:
    """Return a parameter as an answer of the API."""
    longest = one.max_length if one.kind == "string" else None
    return ActionParameter(
        name, one.kind, one.unit, one.min, one.max, one.choices, one.default, one.description,
        longest,
    )  # fmt: skip


# -- giving commands


def send(fleet: Services, who: Caller, robot: str, order: CommandOrder) -> CommandLine:
    """Store a command, which is sent at once where the robot is there; return it.

    One that needs a signature and has none is an intent: it waits for ``sign``. Raises UsageError
    for one that the robot is sure to refuse, NotNowError where the lease is another one.
    """
    command_id = order.id or new_command_id()
    challenges = fleet.links.challenges(robot)
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        risk = _check_action(connection, robot, order)
        is_intent = risk != "record" and order.signature is None
        run = order.run or (f"hand-{command_id[:8]}" if is_intent else "")
        command = Command(
            command_id, robot, order.action, order.parameters, who.person, risk, run, order.step,
            signature=order.signature,
        )  # fmt: skip
        lifetime_ns = int(order.lifetime_s * NS)
        if is_intent:
            made = commands.intend(connection, now_ns, command, lifetime_ns)
        else:
            _check_lease(fleet, robot, run, order.signature)
            made = commands.create(connection, now_ns, command, lifetime_ns, challenges)
        details = {
            "robot": robot, "action": made.action, "parameters": made.parameters[:1000],
            "risk": made.risk, "run": made.run, "key_id": made.key_id, "state": made.state,
        }  # fmt: skip
        who.note(connection, now_ns, "commands.send", made.id, details=details)
    _publish(fleet, robot, made.id)
    return command_line(made)


def sign(
    fleet: Services, who: Caller, robot: str, id: str, signature: CommandSignature
) -> CommandLine:
    """Add a person's signature to a command that waits for one; it is sent at once.

    Raises UsageError for one that waits for none, or that the robot is sure to refuse, NotNowError
    where the lease is another one.
    """
    challenges = fleet.links.challenges(robot)
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        found = _find(connection, now_ns, robot, id)
        if found.state == "unsigned":
            _check_lease(fleet, robot, found.run, signature)
        signed = commands.sign(connection, now_ns, id, signature, challenges)
        details = {"robot": robot, "action": signed.action, "key_id": signature.key_id}
        who.note(connection, now_ns, "commands.sign", id, details=details)
    _publish(fleet, robot, id)
    return command_line(signed)


def withdraw(fleet: Services, who: Caller, robot: str, id: str) -> CommandLine:
    """Withdraw a command that was not sent yet; raises UsageError for one that was."""
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        found = _find(connection, now_ns, robot, id)
        if found.state not in ("unsigned", "waiting", "withdrawn"):
            raise UsageError(f"the command is {found.state}", "abort it: that stops the robot")
        commands.withdraw(connection, now_ns, robot, id, f"withdrawn by {who.person}")
        who.note(connection, now_ns, "commands.withdraw", id, details={"robot": robot})
        found = _find(connection, now_ns, robot, id)
    _publish(fleet, robot, id)
    return command_line(found)


def _check_action(connection: Connection, robot: str, order: CommandOrder) -> Risk:
    """Return the risk of a command; raises UsageError for what the robot has not announced."""
    known = _announced(connection, robot)
    action = known.get(order.action)
    if action is not None:
        check_parameters(action, order.parameters)
        risk = order.risk or action.risk
        if RISKS.index(risk) < RISKS.index(action.risk):
            raise UsageError(f"{action.name} has the risk {action.risk}, not {risk}", "say so")
        return risk
    if order.risk == "record":
        return "record"
    raise _unknown_action(robot, order.action, known)


def _announced(connection: Connection, robot: str) -> Mapping[str, AnnouncedAction]:
    said = commands.commanded(connection, robot)
    return read_announcement(said.actions)[0] if said else {}


def _unknown_action(robot: str, name: str, known: Collection[str]) -> UsageError:
    near = did_you_mean(name, known)
    hint = f"it announces: {', '.join(sorted(known))}" if known else "it has announced no actions"
    return UsageError(f"{robot} announces no action '{name[:64]}'{near}", hint)


def _check_lease(fleet: Services, robot: str, run: str, signature: CommandSignature | None) -> None:
    """Raise NotNowError where a signature is for another lease than the robot's present one."""
    contact = fleet.links.contact(robot)
    if signature is None or contact is None or contact.lease is None:
        return
    lease = contact.lease
    if not lease.holder:
        raise NotNowError(f"nobody holds {robot}", "take its lease first")
    if (lease.number, lease.run) != (signature.lease, run):
        raise NotNowError(f"{robot} is held by {_holder(lease)}", "take its lease first")


async def abort(fleet: Services, who: Caller, robot: str, target: str = "") -> AbortReport:
    """Stop a command (its id), a run (its name), or all that a robot does; as often as wanted.

    Commands of it that have no answer are neither signed nor sent any more. Also for a robot that
    is away, which then is not reached: it stops by itself 3 s after its link has ended.
    """
    _check_label(target)
    is_one = is_command_id(target)
    frame = AbortFrame("" if is_one else target, target if is_one else "", who.person)
    delivered = await fleet.links.order(robot, frame)
    reason = f"aborted by {who.person}"
    work = partial(_abort, fleet, who, robot, target, reason, delivered=delivered)
    withdrawn = await asyncio.to_thread(work)
    _publish(fleet, robot, *withdrawn)
    return AbortReport(delivered, withdrawn)


def _abort(
    fleet: Services, who: Caller, robot: str, target: str, reason: str, *, delivered: bool
) -> Sequence[str]:
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        withdrawn = commands.withdraw(connection, now_ns, robot, target, reason)
        details = {"target": target, "delivered": delivered, "withdrawn": len(withdrawn)}
        who.note(connection, now_ns, "commands.abort", robot, details=details)
    return withdrawn


async def confirm(fleet: Services, who: Caller, robot: str, id: str, code: str) -> CommandLine:
    """Confirm the motion that waits, with the code that is shown at the robot; return it.

    The code goes to the robot only. Raises NotNowError for a wrong one, and where the motion does
    not wait for one.
    """
    contact = fleet.links.contact(robot)
    before = contact.waiting if contact else None
    if before is None or before.id != id:
        found = await asyncio.to_thread(show_command, fleet, robot, id)
        raise NotNowError(f"the command does not wait for a confirmation: it is {found.state}")
    if not before.by_code:
        raise NotNowError("the robot waits for its button", "press it, or 'amberbox confirm' there")

    def decided(contact: RobotContact) -> int | None:
        """Return how many wrong codes came, -1 once it does not wait any more; None before."""
        if contact.waiting.id != id:
            return -1
        return contact.waiting.tries if contact.waiting.tries > before.tries else None

    answered = asyncio.Event()
    forget = fleet.bus.on("answered", lambda c: answered.set() if id in c.data["ids"] else None)
    try:
        tries = await fleet.links.ask(robot, ConfirmFrame(id, code), decided, DECIDE_S)
        if tries == -1:
            async with asyncio.timeout(DECIDE_S):
                await answered.wait()
    except TimeoutError:
        pass  # its answer comes later
    finally:
        forget()
    result = "confirmed" if tries == -1 else "no answer" if tries is None else "wrong code"
    line = await asyncio.to_thread(_confirmed, fleet, who, robot, id, result)
    if tries is None:
        raise NotNowError(f"{robot} did not say whether the code is right", "look at the command")
    if tries != -1:
        raise NotNowError("the code is not the one at the robot", "read it again; 3 tries in all")
    return line


def _confirmed(fleet: Services, who: Caller, robot: str, id: str, result: str) -> CommandLine:
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        details = {"robot": robot, "result": result}
        who.note(connection, now_ns, "commands.confirm", id, details=details)
        return command_line(_find(connection, now_ns, robot, id))


# -- who holds a robot


async def take_lease(fleet: Services, who: Caller, robot: str, run: str = "") -> RobotLease:
    """Take a robot for a run, or by hand; return the lease, which has to be renewed each second.

    Raises NotNowError that names who holds it, or where the robot is away.
    """
    _check_label(run)
    holder, run = who.person, run or f"hand-{secrets.token_hex(4)}"

    def is_ours(lease: LeaseState | None) -> bool:
        return lease is not None and (lease.holder, lease.run) == (holder, run)

    def decided(contact: RobotContact) -> LeaseState | None:
        lease = contact.lease
        return lease if lease is not None and (is_ours(lease) or lease.reason) else None

    lease = await fleet.links.ask(robot, LeaseFrame("take", holder, run), decided, DECIDE_S)
    details = {"run": run, "number": lease.number if lease else 0, "given": is_ours(lease)}
    await asyncio.to_thread(_note, fleet, who, "commands.lease", robot, details)
    if lease is None:
        raise _away(fleet, robot)
    if not is_ours(lease):
        raise NotNowError(lease.reason, "wait until it is released, or ask who holds it")
    return RobotLease(lease.number, lease.holder, lease.run)


async def renew_lease(fleet: Services, who: Caller, robot: str, number: int) -> RobotLease:
    """Renew a lease that the caller took; raises NotNowError where it is lost."""
    lease = _own_lease(fleet, who, robot, number)
    frame = LeaseFrame("renew", lease.holder, lease.run, number)
    if not await fleet.links.order(robot, frame):
        raise _away(fleet, robot)
    return RobotLease(lease.number, lease.holder, lease.run)


async def release_lease(fleet: Services, who: Caller, robot: str, number: int) -> RobotLease:
    """Release a lease that the caller took; what runs under it is stopped.

    Raises NotNowError where it is lost already.
    """
    lease = _own_lease(fleet, who, robot, number)
    frame = LeaseFrame("release", lease.holder, lease.run, number)
    if not await fleet.links.order(robot, frame):
        raise _away(fleet, robot)
    details = {"run": lease.run, "number": number}
    await asyncio.to_thread(_note, fleet, who, "commands.release", robot, details)
    return RobotLease(number, "", "")


def _own_lease(fleet: Services, who: Caller, robot: str, number: int) -> LeaseState:
    contact = fleet.links.contact(robot)
    if contact is None or contact.lease is None:
        raise _away(fleet, robot)
    lease = contact.lease
    if lease.number != number or not lease.holder:
        held = f": {robot} is held by {_holder(lease)}" if lease.holder else ""
        raise NotNowError(f"lease {number} is lost{held}", "take it again")
    if lease.holder != who.person:
        raise NotNowError(f"{robot} is held by {_holder(lease)}", "only they renew or release it")
    return lease


def _check_label(text: str) -> None:
    """Raise UsageError for what cannot be the name of a run."""
    if len(text) > _LABEL or not text.isprintable():
        raise UsageError(f"a run has a name of at most {_LABEL} printable characters")


def _holder(lease: LeaseState) -> str:
    return f"{lease.holder} (run {lease.run})" if lease.run else lease.holder


def _away(fleet: Services, robot: str) -> NotNowError:
    contact = fleet.links.contact(robot)
    if robot not in fleet.links.robots:
        return NotNowError(f"{robot} is not connected", "wait until it is, or store an intent")
    if contact is None:
        hint = "amberbox run there, with 'commands:' in robot.yaml, and a version that can"
        return NotNowError(f"{robot} takes no commands", hint)
    return NotNowError(f"{robot} did not answer within {DECIDE_S:g} s", "try again")


# -- keys


def revoke_key(fleet: Services, who: Caller, key_id: str, reason: str) -> RevokedKeyLine:
    """Revoke a person's key for ever, on all robots; a lease that it used ends.

    A key that is revoked already stays as it is. Raises UsageError for what is no id of a key.
    """
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        commands.revoke(connection, now_ns, key_id, who.person, reason)
        who.note(connection, now_ns, "keys.revoke", key_id, details={"reason": reason})
        [found] = [one for one in commands.revoked_keys(connection) if one.key_id == key_id]
    fleet.bus.publish(ServerChange("command"))
    return RevokedKeyLine(found.key_id, found.who, found.reason, format_time(found.at_ns))


def list_revoked_keys(fleet: Services) -> list[RevokedKeyLine]:
    """List the revoked keys, the oldest revocation first."""
    with fleet.database.reading() as connection:
        found = commands.revoked_keys(connection)
    return [
        RevokedKeyLine(one.key_id, one.who, one.reason, format_time(one.at_ns)) for one in found
    ]


def _note(
    fleet: Services, who: Caller, action: str, object: str, details: dict[str, object]
) -> None:
    with fleet.database.begin() as connection:
        who.note(connection, fleet.clock.wall_ns(), action, object, details=details)


def _find(connection: Connection, now_ns: int, robot: str, id: str) -> StoredCommand:
    found = commands.find(connection, now_ns, id)
    if found is None or found.robot != robot:
        raise NotFoundError("there is no such command of this robot")
    return found


def _publish(fleet: Services, robot: str, *ids: str) -> None:
    if ids:
        fleet.bus.publish(ServerChange("command", robot, {"ids": list(ids)}))
