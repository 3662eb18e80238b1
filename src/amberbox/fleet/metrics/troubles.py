"""What is wrong with the server, and with what robots have brought it."""

from __future__ import annotations

from sqlalchemy import Connection, select

from amberbox.fleet.archive.suspects import KIND
from amberbox.fleet.linkend.signingkeys import pending_keys
from amberbox.fleet.linkend.tables import EVENT
from amberbox.fleet.notifying.settings import LOST_HINT, NAME, Notifications
from amberbox.fleet.options.options import read
from amberbox.fleet.services import Services
from amberbox.fleet.state.damaged import NEW_NS, damaged_files

_SHOWN = 5


def troubles(services: Services) -> list[str]:
    """Say what somebody has to see to soon, in sentences; nothing when all is well."""
    with services.database.reading() as connection:
        now_ns = services.clock.wall_ns()
        damaged = damaged_files(connection, now_ns)
        refused = _refused(connection, now_ns - NEW_NS)
        notified = read(connection, NAME, Notifications)
        waiting = pending_keys(connection)
    lately = {robot: one.new for robot, one in damaged.items() if one.new}
    files = sum(lately.values())
    what = "1 file was" if files == 1 else f"{files} files were"
    whose = ", ".join(sorted(lately))
    said = [f"{what} damaged and set aside in the last 24 hours, of {whose}"] if files else []
    if notified.has_lost_secrets:
        said.append(f"secrets of notifications cannot be read: {LOST_HINT}")
    said += [
        f"{key.robot} signs with another key than before, which waits for an admin: /admin/robots"
        for key in waiting
    ]
    return [*services.keeping.troubles(), *said, *refused]


def _refused(connection: Connection, since_ns: int) -> list[str]:
    """Say of which journals no rows could be made lately: robot, file and what to do."""
    chosen = select(EVENT.c.robot, EVENT.c.text).where(EVENT.c.kind == KIND)
    newest = chosen.where(EVENT.c.at_ns >= since_ns).order_by(EVENT.c.at_ns.desc()).limit(_SHOWN)
    return [f"{row.robot}: {row.text}" for row in connection.execute(newest)]
