"""Orders to robots that concern only their record: what is wanted of a robot, and its command.

For each matter (an alarm of a robot, an answer, an incident, a journal) there is one order: a newer
one replaces it. Its command is made anew, a few times, if it expired or its outcome is unknown: it
may be carried out twice. Robots that never took such commands get none.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Final

import msgspec
from sqlalchemy import Connection, Row, Select, or_, select, update

from amberbox.core.api import CommandState
from amberbox.core.clock import NS, Clock
from amberbox.core.command import Command, CommandError, new_command_id
from amberbox.core.errors import UsageError
from amberbox.core.record_commands import (
    LONGEST_SHELF_S,
    AlarmShelve,
    RecordCommand,
    action_of,
    decode_record_command,
    parameters_of,
)
from amberbox.server import commands
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import ServerDatabase, upsert_rows
from amberbox.server.schema import COMMAND, COMMAND_ROBOT, RECORD_ORDER

# How long a command waits for its robot
LIFETIME_NS: Final = 30 * 24 * 3600 * NS
# How often a command is made for one order, the first time included
MOST_TRIES: Final = 4
# States after which it may be made anew
_ANEW: Final[Collection[CommandState]] = ("expired", "outcome_unknown", "failed", "aborted")
_LOOK_S: Final = 15.0
_WHO: Final = 128


@dataclass(frozen=True, slots=True)
class RecordOrder:
    """What is wanted of a robot in a matter, and the state of its newest command.

    ``is_seen``: what it wanted has come back in the robot's record. After ``until_ns`` it means
    nothing any more; None for no such end.
    """

    about: str
    wanted: RecordCommand
    issuer: str
    until_ns: int | None
    command: str
    state: CommandState
    reason: str
    tries: int
    is_seen: bool

    @property
    def is_under_way(self) -> bool:
        """Return whether the robot may still do it."""
        return not self.is_seen and self.state in ("waiting", "sent", "accepted", "done")


class _Announced(msgspec.Struct):
    record: list[str] = []


def takes(connection: Connection, robot: str, action: str) -> bool:
    """Return whether a robot takes such commands, or may: it has not said yet which."""
    chosen = select(COMMAND_ROBOT.c.actions, COMMAND_ROBOT.c.actions_ns)
    row = connection.execute(chosen.where(COMMAND_ROBOT.c.robot == robot)).one_or_none()
    if row is None:
        return False
    if row.actions_ns is None:
        return True
    try:
        return action in msgspec.json.decode(row.actions, type=_Announced).record
    except (msgspec.MsgspecError, ValueError, RecursionError):  # a robot wrote it
        return False


def order(
    connection: Connection, now_ns: int, robot: str, about: str, wanted: RecordCommand,
    issuer: str, until_ns: int | None = None, *, tries: int = 1,
) -> bool:  # fmt: skip
    """Order something in a matter, in place of what was ordered before; return whether it was sent.

    Nothing is sent to a robot that takes no such commands, or for which too many wait already. The
    caller publishes ``command`` for the robot after the transaction.
    """
    withdraw(connection, now_ns, robot, about)
    action = action_of(wanted)
    if not takes(connection, robot, action):
        return False
    lifetime_ns = LIFETIME_NS if until_ns is None else min(LIFETIME_NS, until_ns - now_ns)
    try:
        made = Command(
            new_command_id(), robot, action, parameters_of(wanted), _line(issuer, "the server"),
            "record",
        )  # fmt: skip
        commands.create(connection, now_ns, made, lifetime_ns)
    except (CommandError, UsageError):  # names that a robot made up, or too many wait
        return False
    row = {
        "robot": robot, "about": about, "action": action, "parameters": made.parameters,
        "issuer": made.issuer, "until_ns": until_ns, "command": made.id, "tries": tries,
        "seen": False,
    }  # fmt: skip
    changed = [name for name in row if name not in ("robot", "about")]
    upsert_rows(connection, RECORD_ORDER, [row], changed)
    return True


def withdraw(connection: Connection, now_ns: int, robot: str, about: str) -> None:
    """Withdraw the command of an order that the robot has not answered."""
    known = find(connection, robot, about)
    if known is not None and known.state in commands.UNANSWERED:
        reason = "something else is wanted since, or it is over"
        commands.withdraw(connection, now_ns, robot, known.command, reason)


def see(connection: Connection, robot: str, about: str, command: str) -> None:
    """Note that what a command wanted has come back in the robot's record."""
    mine = (RECORD_ORDER.c.robot == robot, RECORD_ORDER.c.about == about)
    newest = RECORD_ORDER.c.command == command
    connection.execute(update(RECORD_ORDER).where(*mine, newest).values(seen=True))


def find(connection: Connection, robot: str, about: str) -> RecordOrder | None:
    """Return the order in a matter; None without one."""
    return found(connection, robot, [about]).get(about)


def found(connection: Connection, robot: str, abouts: Collection[str]) -> Mapping[str, RecordOrder]:
    """Return the orders in some matters of a robot, by matter."""
    chosen = _orders().where(RECORD_ORDER.c.robot == robot, RECORD_ORDER.c.about.in_(abouts))
    return {row.about: _order(row) for row in connection.execute(chosen)}


def renew(connection: Connection, now_ns: int) -> set[str]:
    """Make the commands anew that expired or whose outcome is unknown; return their robots.

    Not more than ``MOST_TRIES`` are made for an order.
    """
    commands.expire(connection, now_ns)
    c = RECORD_ORDER.c
    chosen = _orders().where(
        COMMAND.c.state.in_(_ANEW), c.seen.is_(False), c.tries < MOST_TRIES,
        or_(c.until_ns.is_(None), c.until_ns > now_ns),
    )  # fmt: skip
    robots = set()
    for row in connection.execute(chosen).all():
        one = _order(row)
        wanted, until_ns = one.wanted, one.until_ns
        if isinstance(wanted, AlarmShelve) and until_ns is not None:
            wanted = msgspec.structs.replace(wanted, for_s=shelf_s(now_ns, until_ns))
        is_sent = order(
            connection, now_ns, row.robot, one.about, wanted, one.issuer, until_ns,
            tries=one.tries + 1,
        )  # fmt: skip
        robots |= {row.robot} if is_sent else set()
    return robots


def shelf_s(now_ns: int, until_ns: int) -> float:
    """Return for how long (s) an alarm that is shelved until a time remains so."""
    return min(max((until_ns - now_ns) / NS, 1.0), LONGEST_SHELF_S)


def person_label(who: str) -> str:
    """Return the name of a person as a command can carry it."""
    return _line(who, "somebody")


def _line(text: str, otherwise: str) -> str:
    return "".join(c for c in text if c.isprintable())[:_WHO].strip() or otherwise


def _orders() -> Select[Any]:
    state = (COMMAND.c.state, COMMAND.c.reason)
    return select(RECORD_ORDER, *state).join(COMMAND, COMMAND.c.id == RECORD_ORDER.c.command)


def _order(row: Row[Any]) -> RecordOrder:
    wanted = decode_record_command(row.action, row.parameters)
    return RecordOrder(
        row.about, wanted, row.issuer, row.until_ns, row.command, row.state, row.reason, row.tries,
        row.seen,
    )  # fmt: skip


class RecordOrders:
    """Looks now and then for orders whose command has to be made anew."""

    def __init__(self, database: ServerDatabase, bus: EventBus, clock: Clock) -> None:
        self._database, self._bus, self._clock = database, bus, clock

    async def run(self) -> None:
        """Work until cancelled."""
        while True:
            await asyncio.to_thread(self.step)
            await asyncio.sleep(_LOOK_S)

    def step(self) -> None:
        """Make commands anew, and let them be sent."""
        with self._database.begin() as connection:
            robots = renew(connection, self._clock.wall_ns())
        for robot in sorted(robots):
            self._bus.publish(ServerChange("command", robot, {"ids": []}))

    def close(self) -> None:
        """Do nothing: no resources are held."""
