"""The table of journals that came, or are coming, from robots."""

from __future__ import annotations

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Connection,
    Index,
    String,
    Table,
    Text,
    and_,
    select,
)

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


Held = tuple[str, int, int, int]
"""Writer and run of a journal, its first row's number, and the one behind its last."""


def is_other_history(connection: Connection, keys: tuple[str, str, str, str], held: Held) -> bool:
    """Tell whether the record of a store holds these rows, or a journal of this name, already.

    ``keys`` are robot, store, journal and its SHA-256: the same bytes are no other history.
    """
    table, (writer, run, first_seq, end_seq) = UPLOAD.c, held
    record = and_(
        table.robot == keys[0], table.store_id == keys[1], table.state == "verified",
        table.sha256 != keys[3],
    )  # fmt: skip
    other = and_(
        table.writer == writer, table.run == run,
        table.first_seq < max(end_seq, first_seq + 1), table.end_seq > first_seq,
    )  # fmt: skip
    wanted = select(table.journal).where(record, other | (table.journal == keys[2])).limit(1)
    return connection.execute(wanted).first() is not None
