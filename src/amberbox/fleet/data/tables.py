"""Tables of what people have written down on the server: missions, notes on them, incidents."""

from __future__ import annotations

from sqlalchemy import Boolean, Column, Index, String, Table, Text

from amberbox.fleet.database.metadata import METADATA, Counted, Id, Time

MISSION = Table(
    "server_mission",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("id", Id, primary_key=True),
    Column("name", Id, nullable=False),
    Column("from_ns", Time, nullable=False),
    Column("to_ns", Time, nullable=True),
    Column("outcome", Id, nullable=False),
    Column("failed", Boolean, nullable=False),
    Column("who", String(200), nullable=False),
    Column("parameters", Text, nullable=False),
)
"""Missions that people began on the server; ``to_ns`` is null while one lasts."""

MISSION_NOTE = Table(
    "mission_note",
    METADATA,
    Column("number", Counted, primary_key=True),
    Column("robot", Id, nullable=False),
    Column("mission", String(200), nullable=False),
    Column("at_ns", Time, nullable=False),
    Column("who", String(200), nullable=False),
    Column("text", Text, nullable=False),
    Index(None, "robot", "mission"),
)
"""What people remarked on missions, the robots' own ones too; ``mission`` is empty where it is on a
moment alone."""

INCIDENT = Table(
    "server_incident",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("id", Id, primary_key=True),
    Column("from_ns", Time, nullable=False),
    Column("to_ns", Time, nullable=False),
    Column("reason", Text, nullable=False),
    Column("who", String(200), nullable=False),
    Column("made_ns", Time, nullable=False),
    Column("released_ns", Time, nullable=True),
)
"""Windows that people marked on the server: what lies in them is kept until they are released."""
