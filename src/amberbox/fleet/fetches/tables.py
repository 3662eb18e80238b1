"""The table of windows that people have asked robots for."""

from __future__ import annotations

from sqlalchemy import Column, Index, String, Table, Text

from amberbox.fleet.database.metadata import METADATA, Id, Time

FETCH = Table(
    "fetch",
    METADATA,
    Column("id", Id, primary_key=True),
    Column("robot", Id, nullable=False),
    Column("item", String(200), nullable=False),
    Column("from_ns", Time, nullable=False),
    Column("to_ns", Time, nullable=False),
    Column("who", String(200), nullable=False),
    Column("state", String(16), nullable=False),
    Column("files", Text, nullable=False),
    Column("asked_ns", Time, nullable=False),
    Column("sent_ns", Time, nullable=True),
    Column("ended_ns", Time, nullable=True),
    Index(None, "robot", "state"),
)
"""``state``: waiting (for the robot), asked (sent to it), copying, ready, gone (the robot has
nothing of it), cancelled. ``files`` is JSON: the journals that the robot named, by store, and what
became of each."""
