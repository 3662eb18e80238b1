"""What is wrong with the server, and with what robots have brought it."""

from __future__ import annotations

from amberbox.fleet.linkend.signingkeys import pending_keys
from amberbox.fleet.services import Services
from amberbox.fleet.state.damaged import damaged_files


def troubles(services: Services) -> list[str]:
    """Say what somebody has to see to soon, in sentences; nothing when all is well."""
    with services.database.reading() as connection:
        damaged = damaged_files(connection, services.clock.wall_ns())
        waiting = pending_keys(connection)
    lately = {robot: one.new for robot, one in damaged.items() if one.new}
    files = sum(lately.values())
    what = "1 file was" if files == 1 else f"{files} files were"
    whose = ", ".join(sorted(lately))
    said = [f"{what} damaged and set aside in the last 24 hours, of {whose}"] if files else []
    said += [
        f"{key.robot} signs with another key than before, which waits for an admin: /admin/robots"
        for key in waiting
    ]
    return [*services.keeping.troubles(), *said]
