"""Commands for tests: composed, stored in a server's database, and what became of them."""

from __future__ import annotations

from typing import Any

from amberbox.core.clock import NS, SystemClock
from amberbox.core.command import Command, new_command_id
from amberbox.server import commands
from amberbox.server.commands import StoredCommand
from amberbox.server.database import ServerDatabase

HOUR_NS = 3600 * NS


def command(robot: str = "r1", **values: Any) -> Command:
    """Compose an unsigned command, with other values than usual."""
    usual: dict[str, Any] = {
        "id": new_command_id(), "robot": robot, "action": "incident.pin", "parameters": "{}",
        "issuer": "anna", "risk": "record",
    }  # fmt: skip
    return Command(**{**usual, **values})


def created(
    database: ServerDatabase, robot: str = "r1", *, count: int = 1, revoked: str = ""
) -> list[StoredCommand]:
    """Store commands for a robot, and revoke a key if one is named."""
    now_ns = SystemClock().wall_ns()
    with database.begin() as connection:
        if revoked:
            commands.revoke(connection, now_ns, revoked, "anna", "lost")
        return [commands.create(connection, now_ns, command(robot), HOUR_NS) for _ in range(count)]


def found(database: ServerDatabase, command_id: str) -> StoredCommand:
    """Return a stored command as it is now."""
    with database.reading() as connection:
        one = commands.find(connection, SystemClock().wall_ns(), command_id)
    assert one is not None
    return one
