"""Tables of the archive's catalogue: which journals are here, and what is known to be missing."""

from __future__ import annotations

from sqlalchemy import BigInteger, Boolean, Column, Integer, String, Table, Text

from amberbox.fleet.database.metadata import METADATA, Digest, Id, Time

JOURNALS = Table(
    "archive_journals",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("store_id", Id, primary_key=True),
    Column("file", String(200), primary_key=True),
    Column("sha256", Digest, nullable=False),
    Column("bytes", BigInteger, nullable=False),
    Column("keeping", String(16), nullable=False),
    Column("writer", String(16), nullable=False),
    Column("run", BigInteger, nullable=False),
    Column("first_seq", BigInteger, nullable=False),
    Column("end_seq", BigInteger, nullable=False),
    Column("start_ns", Time, nullable=False),
    Column("end_ns", Time, nullable=False),
    Column("facts", Text, nullable=False),
    Column("put_ns", Time, nullable=False),
    Column("batch", BigInteger, nullable=True, index=True),
    Column("state", String(16), nullable=False, index=True),
    Column("rows", BigInteger, nullable=False),
    Column("raw_gone", Boolean, nullable=False),
    Column("columns_gone", Boolean, nullable=False),
    Column("own_gone", Boolean, nullable=False),
)
"""One row per journal, for ever: what was deleted since says so. ``state`` is ``put`` (kept, its
rows are in no table yet), ``committed``, or ``refused`` (it changed before its rows were read).
``facts`` is JSON: readings of the clock, configured variables, what could not be read.
``own_gone`` is about what the box said (statuses, events ...), ``columns_gone`` about the rest."""

BATCHES = Table(
    "archive_batches",
    METADATA,
    Column("number", BigInteger, primary_key=True, autoincrement=False),
    Column("planned_ns", Time, nullable=False),
    Column("done", Boolean, nullable=False),
)
"""Journals are committed in numbered batches, one after the other. Each Delta table states the
last batch that is in it; so a batch that was cut short is done again without doubling a row."""

SCHEMAS = Table(
    "archive_schemas",
    METADATA,
    Column("item", String(200), primary_key=True),
    Column("schema_id", String(32), primary_key=True),
    Column("number", Integer, nullable=False),
    Column("definition", Text, nullable=False),
)
"""What the columns of each table are; ``number`` says in which order they came."""

SOURCES = Table(
    "archive_sources",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("store_id", Id, primary_key=True),
    Column("item", String(200), primary_key=True),
    Column("schema_id", String(32), primary_key=True),
)
"""Which tables have, or had, rows of which robot's store."""

MISSING = Table(
    "archive_missing",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("store_id", Id, primary_key=True),
    Column("writer", String(16), primary_key=True),
    Column("run", BigInteger, primary_key=True, autoincrement=False),
    Column("from_seq", BigInteger, primary_key=True, autoincrement=False),
    Column("to_seq", BigInteger, primary_key=True, autoincrement=False),
    Column("kind", String(32), primary_key=True),
    Column("from_ns", Time, nullable=False),
    Column("to_ns", Time, nullable=False),
    Column("reason", Text, nullable=False),
)
"""Ranges that the robot says will never come, or that a power cut took; kept and shown as gaps."""
