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


def _keep_diagnoses(connection: Connection) -> None:
    """Give alarms what their diagnosis said last; mend ends that were before their beginnings."""
    for table, column in (
        ("alarm", "revised BIGINT NOT NULL DEFAULT 0"),
        ("alarm", "effect VARCHAR(16) NOT NULL DEFAULT ''"),
        ("alarm", "worst VARCHAR(16) NOT NULL DEFAULT ''"),
        ("alarm", "words TEXT NOT NULL DEFAULT ''"),
        ("alarm_roots", "effect VARCHAR(16) NOT NULL DEFAULT ''"),
        ("alarm_roots", "words TEXT NOT NULL DEFAULT ''"),
    ):
        connection.execute(text(f"ALTER TABLE {table} ADD COLUMN {column}"))
    mend = "UPDATE alarm_consequence SET to_ns = from_ns WHERE to_ns < from_ns"
    connection.execute(text(mend))


MIGRATIONS: Sequence[Migration] = (
    Migration(2, "an index of link_row by robot, channel and time", _index_rows),
    Migration(3, "alarms keep what their diagnosis said last", _keep_diagnoses),
)
"""Every change since the first version, in order."""
