"""Settings by name, each as JSON."""

from __future__ import annotations

from sqlalchemy import Column, Table, Text

from amberbox.fleet.database.metadata import METADATA, Id, Time

OPTION = Table(
    "option",
    METADATA,
    Column("name", Id, primary_key=True),
    Column("value", Text, nullable=False),
    Column("changed_ns", Time, nullable=False),
)
