"""What the server is called: kept in its database, for tools that work beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection

from amberbox.core.errors import UsageError
from amberbox.fleet.accounts.authority import fingerprint
from amberbox.fleet.options import options
from amberbox.fleet.serving.settings import Settings
from amberbox.link.joining import JoinLine, join_line

_NAME = "server.reached"


@dataclass(frozen=True, slots=True)
class Reached:
    """Under which address the server was started last, and whether by TLS of its own."""

    url: str = ""
    own_tls: bool = False


def note_reached(connection: Connection, now_ns: int, settings: Settings) -> None:
    """Remember how the server is reached."""
    found = Reached(settings.public_url, settings.certificate is not None)
    if options.read(connection, _NAME, Reached) != found:
        options.write(connection, now_ns, _NAME, found)


def line_of(connection: Connection, folder: Path, robot: str, key: str) -> JoinLine:
    """Make the line that is pasted on a robot; raises UsageError before the first start."""
    reached = options.read(connection, _NAME, Reached)
    if not reached.url:
        raise UsageError(
            "nobody knows yet what this server is called", f"amberbox serve --data {folder}"
        )
    return join_line(reached.url, robot, key, fingerprint(folder) if reached.own_tls else "")
