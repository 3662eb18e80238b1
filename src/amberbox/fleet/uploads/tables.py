"""The table of journals that came, or are coming, from robots."""

from __future__ import annotations

from sqlalchemy import BigInteger, Boolean, Column, Index, String, Table, Text

from amberbox.fleet.database.metadata import METADATA, Digest, Id, Time

_Word = String(128)

UPLOAD = Table(
    "upload",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("store_id", _Word, primary_key=True),
    Column("journal", _Word, primary_key=True),
    Column("sha256", Digest, primary_key=True),
    Column("bytes", BigInteger, nullable=False),
    Column("state", _Word, nullable=False),
    Column("reason", Text, nullable=False),
    Column("path", Text, nullable=False),
    Column("signed", Boolean, nullable=False),
    Column("writer", _Word, nullable=False),
    Column("run", BigInteger, nullable=False),
    Column("number", BigInteger, nullable=False),
    Column("first_seq", BigInteger, nullable=False),
    Column("end_seq", BigInteger, nullable=False),
    Column("start_ns", BigInteger, nullable=False),
    Column("end_ns", BigInteger, nullable=False),
    Column("began_ns", Time, nullable=False),
    Column("ended_ns", Time, nullable=True),
    Index(None, "state", "robot"),
)
"""Each file by its content; ``state`` is incoming, verified, aside or quarantined.

``path`` is relative to the server's folder. What is verified is part of the robot's record; what is
aside is sound, too, but of another history of the same store than the file held under its name.
``start_ns`` and ``end_ns`` are the robot's corrected times of receipt.
"""
