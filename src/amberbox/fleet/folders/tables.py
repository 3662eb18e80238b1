"""Tables of robots' folders."""

from __future__ import annotations

from sqlalchemy import BigInteger, Column, Index, Integer, Table

from amberbox.fleet.database.metadata import METADATA, Digest, Id, Time

FOLDER = Table(
    "folder",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("config_hash", Digest, primary_key=True),
    Column("received_ns", Time, nullable=False),
    Column("files", Integer, nullable=False),
    Column("bytes", BigInteger, nullable=False),
    Column("masked", Integer, nullable=False),
    Index(None, "robot", "received_ns"),
)
"""Which folders of robots the server has; ``masked`` files had secrets that the robot let through.
"""
