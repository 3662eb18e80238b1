"""Tables of the link: robots as they were seen last, and the rows that came from them."""

from __future__ import annotations

from typing import Any

from sqlalchemy import BigInteger, Boolean, Column, Index, LargeBinary, String, Table, Text

from amberbox.fleet.database.metadata import METADATA, Counted, Digest, Id, Time

_Word = String(128)


def _run() -> tuple[Column[Any], ...]:
    """Return the key columns of a run of a writer; each table needs columns of its own."""
    return (
        Column("robot", Id, primary_key=True),
        Column("store_id", _Word, primary_key=True),
        Column("writer", _Word, primary_key=True),
        Column("run", BigInteger, primary_key=True, autoincrement=False),
    )


def _place() -> tuple[Column[Any], ...]:
    """Return the key columns of a row's position."""
    return (*_run(), Column("seq", BigInteger, primary_key=True, autoincrement=False))


ROBOT = Table(
    "link_robot",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("epoch", BigInteger, nullable=False),
    Column("store_id", _Word, nullable=False),
    Column("boot_id", _Word, nullable=False),
    Column("config_hash", _Word, nullable=False),
    Column("version", _Word, nullable=False),
    Column("connected", Boolean, nullable=False),
    Column("connected_ns", Time, nullable=False),
    Column("last_seen_ns", Time, nullable=False),
    Column("backlog", BigInteger, nullable=False),
    Column("backlog_bytes", BigInteger, nullable=False),
)
"""Each robot and its newest connection; ``epoch`` fences off all that came before."""

STORE = Table(
    "link_store",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("store_id", _Word, primary_key=True),
    Column("first_seen_ns", Time, nullable=False),
    Column("public_key", _Word, nullable=False),
)

SIGNING_KEY = Table(
    "link_signing_key",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("store_id", _Word, primary_key=True),
    Column("public_key", _Word, primary_key=True),
    Column("first_seen_ns", Time, nullable=False),
    Column("state", _Word, nullable=False),
)
"""Keys that took the place of another: ``pending`` until an admin has decided."""

WRITER = Table(
    "link_writer",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("store_id", _Word, primary_key=True),
    Column("writer", _Word, primary_key=True),
    Column("run", BigInteger, nullable=False),
    Column("seq", BigInteger, nullable=False),
    Column("upto_run", BigInteger, nullable=False),
    Column("upto_seq", BigInteger, nullable=False),
)
"""Cursor of each writer (never sent again), and what has been received in this epoch."""

RUN = Table(
    "link_run",
    METADATA,
    *_run(),
    Column("boot", _Word, nullable=False),
    Column("end_seq", BigInteger, nullable=False),
)
"""Each run that is known: the boot that wrote it, and the end of what is held of it."""

ROW = Table(
    "link_row",
    METADATA,
    *_place(),
    Column("channel", _Word, nullable=False),
    Column("log_ns", BigInteger, nullable=False),
    Column("data", LargeBinary, nullable=False),
    Column("received_ns", Time, nullable=False),
    Index(None, "robot", "channel", "log_ns"),
)
"""Rows as they stand in the robot's journals, until the journal itself is committed."""

ASIDE = Table(
    "link_aside",
    METADATA,
    *_place(),
    Column("sha256", Digest, primary_key=True),
    Column("why", _Word, nullable=False),
    Column("channel", _Word, nullable=False),
    Column("log_ns", BigInteger, nullable=False),
    Column("data", LargeBinary, nullable=False),
    Column("at_ns", Time, nullable=False),
)
"""Rows that the robot has no more: kept and shown, never joined with its record."""

COMMITTED = Table(
    "link_committed",
    METADATA,
    *_run(),
    Column("from_seq", BigInteger, primary_key=True, autoincrement=False),
    Column("to_seq", BigInteger, nullable=False),
)
"""What the archive holds from journals: rows of it that come late are not taken any more."""

STATUS = Table(
    "link_status",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("component", _Word, primary_key=True),
    Column("mode", _Word, primary_key=True),
    Column("level", _Word, nullable=False),
    Column("store_id", _Word, nullable=False),
    Column("run", BigInteger, nullable=False),
    Column("seq", BigInteger, nullable=False),
    Column("log_ns", BigInteger, nullable=False),
    Column("received_ns", Time, nullable=False),
    Column("data", LargeBinary, nullable=False),
)
"""The newest status of each component and mode."""

BOOT = Table(
    "link_boot",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("boot_id", _Word, primary_key=True),
    Column("offset_ns", BigInteger, nullable=False),
    Column("round_ns", BigInteger, nullable=False),
    Column("at_ns", Time, nullable=False),
)
"""How far the server's clock was from the robot's in each boot."""

EVENT = Table(
    "link_event",
    METADATA,
    Column("number", Counted, primary_key=True),
    Column("robot", Id, nullable=False),
    Column("at_ns", Time, nullable=False),
    Column("kind", _Word, nullable=False),
    Column("text", Text, nullable=False),
    Index(None, "robot", "at_ns"),
)
"""What the server has noticed of a robot's link, store and journals."""

HEADS = Table(
    "link_heads",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("store_id", _Word, primary_key=True),
    Column("sha256", Digest, primary_key=True),
    Column("at_ns", Time, nullable=False),
    Column("heads", LargeBinary, nullable=False),
)
"""Every statement of a robot of how far its record reaches: later changes before it show."""
