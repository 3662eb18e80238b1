"""Tables of what people add to diagnoses. What robots found themselves stays in their records."""

from __future__ import annotations

from sqlalchemy import Column, Index, String, Table, Text

from amberbox.fleet.database.metadata import METADATA, Counted, Id, Time

_Name = String(128)
_Long = String(512)

ANSWER = Table(
    "diagnosis_answer",
    METADATA,
    Column("number", Counted, primary_key=True),
    Column("robot", Id, nullable=False),
    Column("diagnosis", _Name, nullable=False),
    Column("test", _Long, nullable=False),
    Column("answer", _Name, nullable=False),
    Column("who", _Long, nullable=False),
    Column("at_ns", Time, nullable=False),
    Index(None, "robot", "diagnosis"),
)
"""What a test of a diagnosis gave; of several answers to one test the last counts."""

REVISION = Table(
    "diagnosis_revision",
    METADATA,
    Column("number", Counted, primary_key=True),
    Column("robot", Id, nullable=False),
    Column("diagnosis", _Name, nullable=False),
    Column("who", _Long, nullable=False),
    Column("at_ns", Time, nullable=False),
    Column("body", Text, nullable=False),
    Index(None, "robot", "diagnosis"),
)
"""What the server made of a diagnosis with an answer more; ``body`` is JSON as people got it."""

CAUSE = Table(
    "diagnosis_cause",
    METADATA,
    Column("number", Counted, primary_key=True),
    Column("robot", Id, nullable=False),
    Column("diagnosis", _Name, nullable=False),
    Column("failure_mode", _Long, nullable=False),
    Column("note", Text, nullable=False),
    Column("who", _Long, nullable=False),
    Column("at_ns", Time, nullable=False),
    Index(None, "robot", "diagnosis"),
)
"""What it was in the end, as somebody says who has found it; nothing is ever taken back here."""
