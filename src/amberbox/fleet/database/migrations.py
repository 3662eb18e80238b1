"""What was changed in tables that exist, since the first version of the database."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, text

from amberbox.fleet.database.schema import Migration


def _index_rows(connection: Connection) -> None:
    """Find what a robot said on a channel without reading all that came from it."""
    connection.execute(
        text("CREATE INDEX ix_link_row_robot_channel_log_ns ON link_row (robot, channel, log_ns)")
    )


MIGRATIONS: Sequence[Migration] = (
    Migration(2, "an index of link_row by robot, channel and time", _index_rows),
)
"""Every change since the first version, in order."""
