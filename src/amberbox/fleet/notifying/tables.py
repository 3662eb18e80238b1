"""The outbox: what people were told, are to be told, and could not be told."""

from __future__ import annotations

from sqlalchemy import BigInteger, Column, Index, String, Table, Text

from amberbox.fleet.database.metadata import METADATA, Counted, Id, Time

_Short = String(16)

OUTBOX = Table(
    "notification",
    METADATA,
    Column("number", Counted, primary_key=True),
    Column("key", Id, nullable=False, unique=True),
    Column("destination", Id, nullable=False),
    Column("kind", _Short, nullable=False),
    Column("alarm", BigInteger, nullable=False),
    Column("severity", _Short, nullable=False),
    Column("state", _Short, nullable=False),
    Column("subject", Text, nullable=False),
    Column("body", Text, nullable=False),
    Column("data", Text, nullable=False),
    Column("created_ns", Time, nullable=False),
    Column("due_ns", Time, nullable=False),
    Column("tries", BigInteger, nullable=False),
    Column("trouble", Text, nullable=False),
    Column("sent_ns", Time),
    Index(None, "state", "due_ns"),
    Index(None, "destination", "created_ns"),
)
"""Messages. ``kind``: alarm, acknowledged, resolved or digest. ``state``: waiting, held (for a
digest), sent, failed, digested. ``key`` names a message to who gets it, the same at every
attempt."""

CHANGED = Table(
    "notification_changed",
    METADATA,
    Column("alarm", BigInteger, primary_key=True, autoincrement=False),
    Column("due_ns", Time, nullable=False, index=True),
)
"""Alarms that somebody was told of and whose state has changed since: when to look at them."""
