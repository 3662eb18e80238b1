"""Commands for tests: composed, stored in a server's database, and what became of them."""

from __future__ import annotations

import secrets

from amberbox.core.clock import NS, SystemClock
from amberbox.core.command import Command
from amberbox.server import commands
from amberbox.server.commands import StoredCommand
from amberbox.server.database import ServerDatabase

HOUR_NS = 3600 * NS


def command(robot: str = "r1", action: str = "incident.pin", **values: object) -> Command:
    """Compose an unsigned command."""
    given = {"id": secrets.token_hex(16), "parameters": "{}", "issuer": "anna", "risk": "record"}
    return Command(**{"robot": robot, "action": action, **given, **values})  # type: ignore[arg-type]  # any field


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
