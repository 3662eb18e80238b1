"""Tables of the audit log: its rows, and how far they go. The rows refuse to be changed."""

from __future__ import annotations

from sqlalchemy import DDL, BigInteger, Column, Integer, String, Table, Text, event

from amberbox.fleet.database.metadata import METADATA, Digest, Time

AUDIT = Table(
    "audit",
    METADATA,
    Column("seq", BigInteger, primary_key=True, autoincrement=False),
    Column("time_ns", Time, nullable=False, index=True),
    Column("principal", String(140), nullable=False),
    Column("address", String(64), nullable=False),
    Column("action", String(64), nullable=False),
    Column("object", String(300), nullable=False),
    Column("result", String(16), nullable=False),
    Column("details", Text, nullable=False),
    Column("hash", Digest, nullable=False),
)

AUDIT_HEAD = Table(
    "audit_head",
    METADATA,
    Column("one", Integer, primary_key=True, autoincrement=False),
    Column("seq", BigInteger, nullable=False),
    Column("hash", Digest, nullable=False),
)
"""One row: the newest row of the log. Whoever adds one holds it first."""

for _change in ("update", "delete"):
    event.listen(
        AUDIT,
        "after_create",
        DDL(  # type: ignore[no-untyped-call]  # SQLAlchemy has no types for this one
            f"CREATE TRIGGER audit_no_{_change} BEFORE {_change.upper()} ON audit "
            f"BEGIN SELECT RAISE(ABORT, 'rows of the audit log stay as they are'); END"
        ).execute_if(dialect="sqlite"),
    )
