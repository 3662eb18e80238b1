"""Commands to robots: rows that are sent until they are answered, answers, and revoked keys.

A command is at most sent again, never changed. What a robot says of one arrives as answers, which
it repeats until they are stored; each is stored once. The robot decides what it does: what is
checked here spares people a refusal.
"""

from __future__ import annotations

import re
import secrets
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import msgspec
from sqlalchemy import Connection, Row, func, or_, select, update

from amberbox.core.api import CommandState
from amberbox.core.clock import NS
from amberbox.core.command import (
    MODEL_INSTALL,
    MOST_TTL_S,
    AnswerState,
    Command,
    CommandAnswer,
    CommandError,
    CommandSignature,
    LeaseState,
    Risk,
    decode_command,
    encode_command,
)
from amberbox.core.errors import UsageError
from amberbox.link import limits
from amberbox.link.ledger import StaleEpochError
from amberbox.server.database import upsert_rows
from amberbox.server.schema import (
    COMMAND,
    COMMAND_ANSWER,
    COMMAND_ROBOT,
    IDENTITY,
    REVOKED_KEY,
    ROBOT,
)

# States of a command that is sent until it is answered, and of one that may still be
UNANSWERED: Final[Sequence[CommandState]] = ("waiting", "sent")
OPEN: Final[Sequence[CommandState]] = ("unsigned", *UNANSWERED)
# Longest time that a command waits for its robot
LONGEST_DAYS: Final = 90
LONGEST_NS: Final = LONGEST_DAYS * 24 * 3600 * NS
# A command without an answer is sent again after this time, on the same connection
RESEND_NS: Final = 10 * NS
# Largest number of unanswered commands per robot
MOST_OPEN: Final = 1000
# Answers to one command that are stored; later ones change its state only
MOST_ANSWERS: Final = 50
# Commands that this server does not know whose answers are stored, per robot
MOST_UNKNOWN: Final = 1000

# What is said of a command that expired in this state
_EXPIRED: Final[Mapping[str, str]] = {
    "unsigned": "it expired before anybody signed it",
    "waiting": "it expired before the robot was there",
    "sent": "it expired without an answer: the robot may have received it",
}


@dataclass(frozen=True, slots=True)
class ReceivedAnswer:
    """One answer of a robot; ``at_ns`` by its clock, ``received_ns`` by the server's.

    ``mono_ns`` counts from the robot's ``boot``, and never steps.
    """

    number: int
    state: AnswerState
    reason: str
    result: str
    at_ns: int
    received_ns: int
    boot: str = ""
    mono_ns: int = 0


@dataclass(frozen=True, slots=True)
class StoredCommand:
    """A command and what became of it; times (ns) by the server's clock.

    ``state`` is ``expired`` without ``answered_ns`` where the server gave it up. ``key_id`` is
    empty where nobody signed it; ``sends`` counts how often it was sent.
    """

    number: int
    id: str
    robot: str
    action: str
    parameters: str
    issuer: str
    run: str
    step: str
    risk: Risk
    key_id: str
    created_ns: int
    expires_ns: int
    state: CommandState
    reason: str
    sent_ns: int | None
    sends: int
    answered_ns: int | None
    answers: Sequence[ReceivedAnswer]


@dataclass(frozen=True, slots=True)
class CommandedRobot:
    """What a robot has said last of commands: its lease and, as JSON, what it can do.

    The robot wrote the JSON: nothing in it was checked. Times (ns) by the server's clock.
    """

    robot: str
    actions: str
    actions_ns: int | None
    lease: LeaseState
    lease_ns: int | None


@dataclass(frozen=True, slots=True)
class RevokedKey:
    """A person's key that signs nothing any more."""

    key_id: str
    who: str
    reason: str
    at_ns: int


def server_id(connection: Connection, now_ns: int) -> str:
    """Return the id of this server, 32 hex digits; made at the first call."""
    row = {"one": 1, "server_id": secrets.token_hex(16), "made_ns": now_ns}
    upsert_rows(connection, IDENTITY, [row])
    return str(connection.execute(select(IDENTITY.c.server_id)).scalar_one())


def create(
    connection: Connection,
    now_ns: int,
    command: Command,
    lifetime_ns: int,
    challenges: Collection[bytes] = (),
) -> StoredCommand:
    """Store a command, which is sent once its robot is there; return it.

    Its times are set here. ``challenges`` are those that the robot has lately minted on its present
    connection: one that is signed needs one of them, and lives as long as it was signed for. A
    command that is stored already is returned as it is. Raises UsageError for one that no robot
    would accept, or with the id of another command.
    """
    known = _same_id(connection, now_ns, command)
    if known is not None:
        return known
    _check_signature(connection, now_ns, command, challenges)
    if command.signature is not None:
        lifetime_ns = min(lifetime_ns, command.signature.ttl_s * NS)
    return _store(connection, now_ns, command, lifetime_ns, "waiting")


def models_to_install(connection: Connection, robot: str) -> set[str]:
    """Return the SHA-256 of the models that commands which a robot carries out now install."""
    chosen = select(COMMAND.c.parameters).where(
        COMMAND.c.robot == robot, COMMAND.c.action == MODEL_INSTALL,
        COMMAND.c.state.in_(("sent", "accepted")),
    )  # fmt: skip
    texts = connection.execute(chosen).scalars()
    return {str(msgspec.json.decode(text).get("sha256", "")) for text in texts}


def model_takers(connection: Connection) -> set[str]:
    """Return the robots that have announced that they install models."""
    announced = COMMAND_ROBOT.c.actions.contains(f'"{MODEL_INSTALL}"')
    return set(connection.execute(select(COMMAND_ROBOT.c.robot).where(announced)).scalars())


def intend(
    connection: Connection, now_ns: int, command: Command, lifetime_ns: int
) -> StoredCommand:
    """Store a command that waits on the server until somebody signs it; return it.

    One that is stored already is returned as it is. Raises UsageError as ``create`` does.
    """
    known = _same_id(connection, now_ns, command)
    if known is not None:
        return known
    if command.risk == "record" or command.signature is not None:
        raise UsageError("this command needs no signature, or has one", "send it")
    return _store(connection, now_ns, command, lifetime_ns, "unsigned")


def _store(
    connection: Connection, now_ns: int, command: Command, lifetime_ns: int, state: CommandState
) -> StoredCommand:
    if not 0 < lifetime_ns <= LONGEST_NS:
        raise UsageError(
            f"a command waits for its robot for at most {LONGEST_DAYS} days",
            "choose a shorter time",
        )
    timed = msgspec.structs.replace(command, created_ns=now_ns, expires_ns=now_ns + lifetime_ns)
    data = _encoded(timed)
    expire(connection, now_ns, command.robot)
    # intents that nobody signs do not take the room of commands
    alike = UNANSWERED if state in UNANSWERED else (state,)
    mine = (COMMAND.c.robot == command.robot, COMMAND.c.state.in_(alike))
    count = connection.scalar(select(func.count()).select_from(COMMAND).where(*mine)) or 0
    if count >= MOST_OPEN:
        raise UsageError(
            f"{count} commands to {command.robot} wait for an answer or a signature",
            "wait until it is back, or withdraw some",
        )
    values = {
        "id": timed.id, "robot": timed.robot, "action": timed.action,
        "parameters": timed.parameters, "issuer": timed.issuer, "run": timed.run,
        "step": timed.step, "risk": timed.risk,
        "key_id": "" if timed.signature is None else timed.signature.key_id,
        "created_ns": timed.created_ns, "expires_ns": timed.expires_ns, "bytes": data,
        "state": state, "reason": "", "sends": 0,
    }  # fmt: skip
    connection.execute(COMMAND.insert(), [values])
    return _known(connection, now_ns, timed.id)


def sign(
    connection: Connection,
    now_ns: int,
    command_id: str,
    signature: CommandSignature,
    challenges: Collection[bytes],
) -> StoredCommand:
    """Add a signature to a command that waits for one, which is then sent; return it.

    It lives as long as it was signed for. The same signature again changes nothing; raises
    UsageError for another one, and for what ``create`` refuses.
    """
    row = connection.execute(select(COMMAND).where(COMMAND.c.id == command_id)).one_or_none()
    if row is None:
        raise UsageError(f"there is no command '{command_id}'", "list the commands of the robot")
    command = decode_command(row.bytes)
    if row.state != "unsigned" or row.expires_ns <= now_ns:
        if command.signature == signature:
            return _known(connection, now_ns, command_id)
        state = _stored(row, (), now_ns).state
        raise UsageError(f"the command waits for no signature: it is {state}", "look at it again")
    signed = msgspec.structs.replace(
        command, signature=signature, expires_ns=now_ns + signature.ttl_s * NS
    )
    _check_signature(connection, now_ns, signed, challenges)
    values = {
        "bytes": _encoded(signed), "state": "waiting", "key_id": signature.key_id,
        "expires_ns": signed.expires_ns,
    }  # fmt: skip
    mine = update(COMMAND).where(COMMAND.c.id == command_id, COMMAND.c.state == "unsigned")
    connection.execute(mine.values(**values))
    return _known(connection, now_ns, command_id)


def withdraw(
    connection: Connection, now_ns: int, robot: str, target: str, reason: str
) -> list[str]:
    """Withdraw commands of a robot that have no answer: one, a run's, or all; return their ids.

    They are neither signed nor sent any more; what the robot says of them still counts. All are
    those that change or move something: what only concerns the record stays.
    """
    expire(connection, now_ns, robot)
    c = COMMAND.c
    chosen = select(c.id).where(c.robot == robot, c.state.in_(OPEN))
    chosen = chosen.where(or_(c.id == target, c.run == target) if target else c.risk != "record")
    ids = list(connection.scalars(chosen))
    withdrawn = update(COMMAND).where(c.id.in_(ids))
    connection.execute(withdrawn.values(state="withdrawn", reason=reason))
    return ids


def _encoded(command: Command) -> bytes:
    try:
        return encode_command(command)
    except CommandError as error:
        raise UsageError(error.what, error.hint) from error


def _check_signature(
    connection: Connection, now_ns: int, command: Command, challenges: Collection[bytes]
) -> None:
    """Raise UsageError for a signature that the robot is sure to refuse, or for none."""
    signature = command.signature
    if signature is None:
        if command.risk != "record":
            raise UsageError(
                f"a command with the risk '{command.risk}' has to be signed",
                "sign it with 'amberbox sign' while the robot is connected",
            )
        return
    again = "sign it again while the robot is connected"
    if signature.server != server_id(connection, now_ns):
        raise UsageError("the command is signed for another server", again)
    if not 0 < signature.ttl_s <= MOST_TTL_S:
        raise UsageError(f"a signature holds for 1 to {MOST_TTL_S} s", again)
    if signature.challenge not in challenges:
        what = f"{command.robot} is not connected, or has not minted this challenge in the last "
        raise UsageError(f"{what}{MOST_TTL_S} s", again)
    revoked = select(REVOKED_KEY).where(REVOKED_KEY.c.key_id == signature.key_id)
    if connection.execute(revoked).first() is not None:
        raise UsageError(f"the key {signature.key_id} is revoked", "sign with another key")


def _same_id(connection: Connection, now_ns: int, command: Command) -> StoredCommand | None:
    """Return the stored command with this id; raises UsageError when it is another one."""
    row = connection.execute(select(COMMAND).where(COMMAND.c.id == command.id)).one_or_none()
    if row is None:
        return None
    times = {"created_ns": row.created_ns, "expires_ns": row.expires_ns}
    if _encoded(msgspec.structs.replace(command, **times)) != row.bytes:
        raise UsageError(f"another command has the id '{command.id}'", "make a new id")
    return find(connection, now_ns, command.id)


def _known(connection: Connection, now_ns: int, command_id: str) -> StoredCommand:
    found = find(connection, now_ns, command_id)
    assert found is not None, "it was stored before"
    return found


def find(connection: Connection, now_ns: int, command_id: str) -> StoredCommand | None:
    """Return a command with its answers; None if there is none of this id."""
    row = connection.execute(select(COMMAND).where(COMMAND.c.id == command_id)).one_or_none()
    return None if row is None else _stored(row, _answers(connection, [row])[row.id], now_ns)


def listed(
    connection: Connection,
    now_ns: int,
    robot: str = "",
    before: int | None = None,
    limit: int = 100,
    *,
    states: Collection[CommandState] = (),
    run: str = "",
) -> list[StoredCommand]:
    """Return commands with their answers, newest first, of all robots without a name.

    ``before`` is the number of a command: older ones are returned. ``states`` are those wanted,
    all without one; ``run`` is the run that they belong to.
    """
    chosen = select(COMMAND).order_by(COMMAND.c.number.desc()).limit(limit)
    if robot:
        chosen = chosen.where(COMMAND.c.robot == robot)
    if states:
        c = COMMAND.c
        is_late = c.state.in_(OPEN) & (c.expires_ns <= now_ns)
        is_wanted = c.state.in_(states) & ~is_late
        chosen = chosen.where(or_(is_wanted, is_late) if "expired" in states else is_wanted)
    if run:
        chosen = chosen.where(COMMAND.c.run == run)
    if before is not None:
        chosen = chosen.where(COMMAND.c.number < before)
    rows = connection.execute(chosen).all()
    answers = _answers(connection, rows)
    return [_stored(row, answers[row.id], now_ns) for row in rows]


def expire(connection: Connection, now_ns: int, robot: str = "") -> list[str]:
    """Give up commands whose time is over without an answer; return their ids."""
    late = [COMMAND.c.state.in_(OPEN), COMMAND.c.expires_ns <= now_ns]
    if robot:
        late.append(COMMAND.c.robot == robot)
    rows = connection.execute(select(COMMAND.c.id, COMMAND.c.state).where(*late)).all()
    for before, reason in _EXPIRED.items():
        ids = [row.id for row in rows if row.state == before]
        if ids:
            given_up = update(COMMAND).where(COMMAND.c.id.in_(ids))
            connection.execute(given_up.values(state="expired", reason=reason))
    return [row.id for row in rows]


def claim(connection: Connection, robot: str, epoch: int, now_ns: int) -> list[bytes]:
    """Return the commands to send now on the connection with this epoch, and note that they are.

    Those without an answer are sent on each connection, and again after ``RESEND_NS``; those that
    were only accepted once on each connection, so that the robot repeats what it answered since.
    Nothing expired is sent. Raises StaleEpochError when the robot has since connected again.
    """
    _hold(connection, robot, epoch)
    expire(connection, now_ns, robot)
    c = COMMAND.c
    is_new = or_(c.epoch.is_(None), c.epoch != epoch)
    is_due = or_(c.sent_ns <= now_ns - RESEND_NS, c.sent_ns > now_ns)
    chosen = (
        select(c.id, c.state, c.bytes)
        .where(c.robot == robot, c.expires_ns > now_ns)
        .where(or_(c.state.in_(UNANSWERED) & or_(is_new, is_due), (c.state == "accepted") & is_new))
        .order_by(c.number)
        .limit(limits.COMMANDS_COUNT)
    )
    rows = connection.execute(chosen).all()
    sent = {"epoch": epoch, "sent_ns": now_ns, "sends": c.sends + 1}
    for state in {row.state for row in rows}:
        ids = [row.id for row in rows if row.state == state]
        to = state if state == "accepted" else "sent"
        connection.execute(update(COMMAND).where(c.id.in_(ids)).values(state=to, **sent))
    return [row.bytes for row in rows]


@dataclass(frozen=True, slots=True)
class StoredAnswers:
    """The number of the newest of these answers, and the ids of commands that changed.

    The number is 0 where the robot could not store its answers: it gives them again itself.
    ``unknown`` are ids of commands that this server does not know, answered for the first time; of
    a robot at most ``MOST_UNKNOWN`` are kept.
    """

    number: int
    changed: Sequence[str] = ()
    unknown: Sequence[str] = ()


def store_answers(
    connection: Connection,
    robot: str,
    epoch: int,
    store_id: str,
    answers: Sequence[CommandAnswer],
    now_ns: int,
) -> StoredAnswers:
    """Store what a robot says of commands, each answer once.

    The first final answer counts; also one to a command that was given up. Answers to commands that
    this server does not know, as after it was restored, are stored as well. Raises StaleEpochError
    when the robot has since connected again.
    """
    _hold(connection, robot, epoch)
    rows = [
        {
            "robot": robot, "store_id": store_id, "command": one.id, "number": one.number,
            "state": one.state, "reason": one.reason, "result": one.result, "at_ns": one.at_ns,
            "boot": one.boot, "mono_ns": one.mono_ns, "received_ns": now_ns,
        }
        for one in answers
    ]  # fmt: skip
    ids = {one.id for one in answers}
    of_robot = select(COMMAND).where(COMMAND.c.robot == robot, COMMAND.c.id.in_(ids))
    known: Mapping[str, Row[Any]] = {row.id: row for row in connection.execute(of_robot)}
    stray = ids - set(known)
    known_stray = select(COMMAND_ANSWER.c.command).where(
        COMMAND_ANSWER.c.robot == robot, COMMAND_ANSWER.c.command.in_(stray)
    )
    unknown = sorted(stray - set(connection.scalars(known_stray)))
    if unknown:
        kept = set(unknown[: max(0, MOST_UNKNOWN - _unknown_count(connection, robot))])
        rows = [row for row in rows if row["command"] in kept or row["command"] not in unknown]
        unknown = sorted(kept)
    upsert_rows(connection, COMMAND_ANSWER, _with_room(connection, robot, rows))
    changes: dict[str, CommandAnswer] = {}
    for one in answers:
        row = known.get(one.id)
        if row is None:
            continue
        last = changes.get(one.id)
        is_answered = last is not None or row.answered_ns is not None
        state = row.state if last is None else last.state
        # a refusal without a number is of other bytes with this id, or was not stored
        is_end = bool(one.number) and state == "accepted" and one.state != "accepted"
        if not is_answered or is_end:
            changes[one.id] = one
    for command_id, one in changes.items():
        values = {"state": one.state, "reason": one.reason, "answered_ns": now_ns}
        connection.execute(update(COMMAND).where(COMMAND.c.id == command_id).values(**values))
    number = max((one.number for one in answers), default=0)
    if number:
        mine = update(COMMAND_ROBOT).where(COMMAND_ROBOT.c.robot == robot)
        connection.execute(mine.values(answered=number))
    return StoredAnswers(number, tuple(changes), tuple(unknown))


def _unknown_count(connection: Connection, robot: str) -> int:
    """Return how many commands that this server does not know have stored answers of a robot."""
    a, ids = COMMAND_ANSWER.c, select(COMMAND.c.id).where(COMMAND.c.robot == robot)
    wanted = select(func.count(a.command.distinct())).where(a.robot == robot, a.command.not_in(ids))
    return int(connection.scalar(wanted) or 0)


def _with_room(
    connection: Connection, robot: str, rows: Sequence[Mapping[str, Any]]
) -> list[Mapping[str, Any]]:
    """Return the answers that are stored: a robot gives three, a hostile one any number."""
    counted = (
        select(COMMAND_ANSWER.c.command, func.count())
        .where(COMMAND_ANSWER.c.robot == robot)
        .where(COMMAND_ANSWER.c.command.in_({row["command"] for row in rows}))
        .group_by(COMMAND_ANSWER.c.command)
    )
    counts = Counter({row[0]: int(row[1]) for row in connection.execute(counted)})
    found = []
    for row in rows:
        counts[row["command"]] += 1
        if counts[row["command"]] <= MOST_ANSWERS:
            found.append(row)
    return found


@dataclass(frozen=True, slots=True)
class CommandContact:
    """What the server says first: keys that are revoked, and which answers are stored."""

    revoked: Sequence[str]
    answered: int


def begin_contact(
    connection: Connection,
    robot: str,
    epoch: int,
    store_id: str,
    *,
    is_other_history: bool = False,
) -> CommandContact:
    """Begin a connection of a robot that takes commands.

    In another store it counts its answers anew, and after an old image of its disk was restored
    (``is_other_history``) from an earlier number: none are acknowledged then before they come.
    Raises StaleEpochError when the robot has since connected again.
    """
    _hold(connection, robot, epoch)
    known = select(COMMAND_ROBOT.c.store_id).where(COMMAND_ROBOT.c.robot == robot)
    if is_other_history or connection.execute(known).scalar() != store_id:
        row = {"robot": robot, "store_id": store_id, "answered": 0, "actions": "", "lease": 0,
               "holder": "", "run": ""}  # fmt: skip
        upsert_rows(connection, COMMAND_ROBOT, [row], ("store_id", "answered"))
    return CommandContact(
        [one.key_id for one in revoked_keys(connection)], _answered(connection, robot)
    )


def _answered(connection: Connection, robot: str) -> int:
    chosen = select(COMMAND_ROBOT.c.answered).where(COMMAND_ROBOT.c.robot == robot)
    return int(connection.execute(chosen).scalar() or 0)


def announce(
    connection: Connection, robot: str, epoch: int, announcement: str, now_ns: int
) -> None:
    """Store what a robot can do, as JSON; raises StaleEpochError for an older connection."""
    _hold(connection, robot, epoch)
    mine = update(COMMAND_ROBOT).where(COMMAND_ROBOT.c.robot == robot)
    connection.execute(mine.values(actions=announcement, actions_ns=now_ns))


def record_lease(
    connection: Connection, robot: str, epoch: int, lease: LeaseState, now_ns: int
) -> None:
    """Store who holds a robot, as it says; raises StaleEpochError for an older connection."""
    _hold(connection, robot, epoch)
    mine = update(COMMAND_ROBOT).where(COMMAND_ROBOT.c.robot == robot)
    values = {"lease": lease.number, "holder": lease.holder, "run": lease.run, "lease_ns": now_ns}
    connection.execute(mine.values(**values))


def commanded(connection: Connection, robot: str) -> CommandedRobot | None:
    """Return what a robot has said last; None for one that never took commands."""
    chosen = select(COMMAND_ROBOT).where(COMMAND_ROBOT.c.robot == robot)
    row = connection.execute(chosen).one_or_none()
    if row is None:
        return None
    lease = LeaseState(row.lease, row.holder, row.run)
    return CommandedRobot(robot, row.actions, row.actions_ns, lease, row.lease_ns)


def revoke(connection: Connection, now_ns: int, key_id: str, who: str, reason: str) -> bool:
    """Revoke a person's key for ever; return whether it was not revoked before.

    Raises UsageError for what is no id of a key.
    """
    if not re.fullmatch(r"[0-9a-f]{16}", key_id):
        raise UsageError(f"'{key_id}' is no id of a key", "it has 16 hexadecimal digits")
    row = {"key_id": key_id, "who": who, "reason": reason, "at_ns": now_ns}
    return upsert_rows(connection, REVOKED_KEY, [row]) > 0


def revoked_keys(connection: Connection) -> list[RevokedKey]:
    """Return the revoked keys, the oldest revocation first."""
    chosen = select(REVOKED_KEY).order_by(REVOKED_KEY.c.at_ns, REVOKED_KEY.c.key_id)
    return [RevokedKey(*row) for row in connection.execute(chosen)]


def _hold(connection: Connection, robot: str, epoch: int) -> None:
    """Raise StaleEpochError unless the connection with this epoch is the robot's present one."""
    present = connection.execute(select(ROBOT.c.epoch).where(ROBOT.c.robot == robot)).scalar()
    if present != epoch:
        raise StaleEpochError(f"epoch {epoch} of {robot} is over")


def _answers(
    connection: Connection, rows: Sequence[Row[Any]]
) -> Mapping[str, Sequence[ReceivedAnswer]]:
    """Return the answers of each command, in their order; of its own robot only."""
    found: dict[str, list[ReceivedAnswer]] = {row.id: [] for row in rows}
    robots = {row.id: row.robot for row in rows}
    a = COMMAND_ANSWER.c
    chosen = select(COMMAND_ANSWER).where(a.command.in_(found)).order_by(a.received_ns, a.number)
    for row in connection.execute(chosen):
        if robots[row.command] == row.robot:
            found[row.command].append(ReceivedAnswer(
                row.number, row.state, row.reason, row.result, row.at_ns, row.received_ns,
                row.boot, row.mono_ns,
            ))  # fmt: skip
    return found


def _stored(row: Row[Any], answers: Sequence[ReceivedAnswer], now_ns: int) -> StoredCommand:
    state, reason = row.state, row.reason
    if state in OPEN and row.expires_ns <= now_ns:
        state, reason = "expired", _EXPIRED[state]
    return StoredCommand(
        row.number, row.id, row.robot, row.action, row.parameters, row.issuer, row.run, row.step,
        row.risk, row.key_id, row.created_ns, row.expires_ns, state, reason, row.sent_ns,
        row.sends, row.answered_ns, answers,
    )  # fmt: skip
