"""The table of downloads that people have asked for."""

from __future__ import annotations

from sqlalchemy import BigInteger, Column, Float, Index, String, Table, Text

from amberbox.fleet.database.metadata import METADATA, Id, Time

JOB = Table(
    "job",
    METADATA,
    Column("id", Id, primary_key=True),
    Column("owner", String(128), nullable=False),
    Column("request", Text, nullable=False),
    Column("state", String(16), nullable=False),
    Column("progress", Float, nullable=False),
    Column("file", String(200), nullable=False),
    Column("bytes", BigInteger, nullable=False),
    Column("notes", Text, nullable=False),
    Column("error", Text, nullable=False),
    Column("asked_ns", Time, nullable=False),
    Column("started_ns", Time, nullable=True),
    Column("ended_ns", Time, nullable=True),
    Index(None, "state", "asked_ns"),
)
"""``owner`` is the person, also where a token of theirs asked. ``state``: queued, running, done,
failed, cancelled, or expired (its file is gone). ``request`` and ``notes`` are JSON."""
