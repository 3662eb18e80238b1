"""What the server notices of robots' links, stores and journals."""

from __future__ import annotations

from sqlalchemy import Connection

from amberbox.fleet.linkend.tables import EVENT


def note(connection: Connection, robot: str, at_ns: int, kind: str, text: str) -> None:
    """Write an event down; ``at_ns`` by the server's clock."""
    values = {"robot": robot, "at_ns": at_ns, "kind": kind, "text": text}
    connection.execute(EVENT.insert(), [values])
