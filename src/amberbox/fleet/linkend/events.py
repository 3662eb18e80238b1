"""What the server has noticed of robots' links, stores and journals."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, select

from amberbox.fleet.linkend.tables import EVENT


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """One thing that was noticed; ``at_ns`` by the server's clock."""

    number: int
    robot: str
    at_ns: int
    kind: str
    text: str


def note(connection: Connection, robot: str, at_ns: int, kind: str, text: str) -> None:
    """Write an event down."""
    values = {"robot": robot, "at_ns": at_ns, "kind": kind, "text": text}
    connection.execute(EVENT.insert(), [values])


def link_events(connection: Connection, robot: str, after: int = 0) -> list[LinkEvent]:
    """Return the events of a robot behind number ``after``, oldest first."""
    wanted = select(EVENT).where(EVENT.c.robot == robot, EVENT.c.number > after)
    return [
        LinkEvent(row.number, row.robot, row.at_ns, row.kind, row.text)
        for row in connection.execute(wanted.order_by(EVENT.c.number))
    ]
