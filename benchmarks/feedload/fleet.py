"""10 robots of 40 components that say new values five times a second, and people who look."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from typing import Any

import msgspec
from sqlalchemy import Connection

from amberbox.blackbox.journal import channels
from amberbox.link.frames import LinkRow
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.robots import add_robot
from amberbox.server.accounts.sessions import begin_session
from amberbox.server.accounts.users import add_user
from amberbox.server.bus import ServerChange
from amberbox.server.schema import ROBOT, STATUS
from amberbox.server.services.context import Services

ROBOTS, COMPONENTS, RATE_HZ = 10, 40, 5
LOAD = f"{ROBOTS} x {COMPONENTS} components at {RATE_HZ} Hz"
SENT = "sent_us"
"""The output that says when it was sent, in µs since 1970."""
PEOPLE = 4
CHANGE_S = 10.0
"""Each time one component of the fleet goes wrong or gets well, by turns."""


def fill(services: Services) -> list[str]:
    """Add robots with their statuses, and people; return sessions of these."""
    now_ns = services.clock.wall_ns()
    with services.database.begin() as connection:
        for robot in range(ROBOTS):
            add_robot(connection, now_ns, f"r{robot}", ())
        presences = [_presence(f"r{robot}", now_ns) for robot in range(ROBOTS)]
        connection.execute(ROBOT.insert(), presences)
        connection.execute(STATUS.insert(), list(_statuses(now_ns)))
        return _people(connection, now_ns, services.passwords.hash("a long enough passphrase"))


async def speak(services: Services) -> None:
    """Let robots say all their statuses, each in a frame of its own, evenly over the time."""
    began_s, step = time.perf_counter(), 0
    while True:
        wait_s = began_s + step / (RATE_HZ * ROBOTS) - time.perf_counter()
        await asyncio.sleep(max(wait_s, 0.0))
        step += 1
        robot, round_ = step % ROBOTS, step // ROBOTS
        services.bus.publish(ServerChange("rows", f"r{robot}", _told(robot, round_)))


def _told(robot: int, round_: int) -> dict[str, Any]:
    """Return what a robot says in a round; a change of level comes with its event."""
    wrong, before = _is_wrong(robot, round_), _is_wrong(robot, round_ - 1)
    rows = [status_row(n, round_, wrong=wrong and n == 0) for n in range(COMPONENTS)]
    if wrong != before:
        said = {"kind": "component_state", "text": "c0 has changed", "source": "watch"}
        rows.append(_row(channels.EVENT, round_ * 1000 + 999, said))
    return {"store_id": "s", "rows": rows}


def _is_wrong(robot: int, round_: int) -> bool:
    turn = int(round_ / RATE_HZ / CHANGE_S)
    return turn % 2 == 0 and turn // 2 % ROBOTS == robot


def status_row(component: int, round_: int, *, wrong: bool = False) -> LinkRow:
    """Return a status with values that differ from round to round."""
    now_ns = time.time_ns()
    outputs = [{"name": "volts", "type": "float", "value": 20 + round_ % 80 / 8, "text": None},
               {"name": SENT, "type": "int", "value": now_ns // 1000, "text": None},
               {"name": "working", "type": "bool", "value": 1, "text": None}]  # fmt: skip
    level, state = ("warn", "volts") if wrong else ("ok", "nominal")
    said = {"robot": "r", "component": f"c{component}", "mode": "checks", "level": level,
            "state": state, "outputs": outputs, "blocked_by": [], "measured_ns": now_ns,
            "since_ns": now_ns, "reason": "volts are low" if wrong else "", "config_hash": "",
            "live_only": False}  # fmt: skip
    return _row(channels.STATUS, round_ * 1000 + component, said)


def _row(channel: str, seq: int, said: dict[str, Any]) -> LinkRow:
    return LinkRow("watch", 1, seq, channel, time.time_ns(), msgspec.json.encode(said))


def _people(connection: Connection, now_ns: int, hashed: str) -> list[str]:
    people = [add_user(connection, now_ns, f"p{n}", Role.TECHNICIAN, hashed) for n in range(PEOPLE)]
    return [
        begin_session(connection, now_ns, person.user_id, "127.0.0.1", "bench").secret
        for person in people
    ]


def _presence(robot: str, now_ns: int) -> dict[str, Any]:
    return {"robot": robot, "epoch": 1, "store_id": "s", "boot_id": "b", "config_hash": "",
            "version": "", "connected": True, "connected_ns": now_ns, "last_seen_ns": now_ns,
            "backlog": 0, "backlog_bytes": 0}  # fmt: skip


def _statuses(now_ns: int) -> Sequence[dict[str, Any]]:
    return [
        {"robot": f"r{robot}", "component": f"c{n}", "mode": "checks", "level": "ok",
         "store_id": "s", "run": 1, "seq": 0, "log_ns": now_ns, "received_ns": now_ns,
         "data": status_row(n, 0).data}
        for robot in range(ROBOTS) for n in range(COMPONENTS)
    ]  # fmt: skip
