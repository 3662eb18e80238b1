"""Tables of alarms: how they stand, what they are made of, and what became of them."""

from __future__ import annotations

from sqlalchemy import BigInteger, Boolean, Column, Float, Index, String, Table, Text

from amberbox.fleet.database.metadata import METADATA, Counted, Id, Time

_Word = String(128)
_Short = String(16)
_Who = String(140)

ALARM = Table(
    "alarm",
    METADATA,
    Column("number", Counted, primary_key=True),
    Column("kind", _Short, nullable=False),
    Column("robot", Id, nullable=False),
    Column("origin", _Word, nullable=False),
    Column("severity", _Short, nullable=False),
    Column("level", _Short, nullable=False),
    Column("reason", Text, nullable=False),
    Column("cause", Text, nullable=False),
    Column("diagnosis", _Word, nullable=False),
    Column("opened_ns", Time, nullable=False),
    Column("changed_ns", Time, nullable=False),
    Column("active", Boolean, nullable=False),
    Column("cleared_ns", Time),
    Column("count", BigInteger, nullable=False),
    Column("state", _Short, nullable=False),
    Column("late", Boolean, nullable=False),
    Column("acknowledged_by", _Who, nullable=False),
    Column("acknowledged_ns", Time),
    Column("shelved_by", _Who, nullable=False),
    Column("shelved_until_ns", Time),
    Column("owner", _Who, nullable=False),
    Column("resolved_by", _Who, nullable=False),
    Column("resolved_ns", Time),
    Column("resolution", Text, nullable=False),
    Column("merged_into", BigInteger),
    Column("told", _Short, nullable=False),
    Column("notify_ns", Time),
    Column("revision", BigInteger, nullable=False),
    Column("revised", BigInteger, nullable=False, server_default="0"),
    Column("effect", _Short, nullable=False, server_default=""),
    Column("worst", _Short, nullable=False, server_default=""),
    Column("words", Text, nullable=False, server_default=""),
    Index(None, "robot", "origin"),
    Index(None, "state"),
    Index(None, "notify_ns"),
)
"""Alarms. ``robot`` is empty where several robots are in one; ``told`` is the severity that was
last notified, ``notify_ns`` when the next notification is due; ``revised``, ``effect`` and
``words`` are of the diagnosis as it was last while the alarm lasted."""

ALARM_ROBOT = Table(
    "alarm_robot",
    METADATA,
    Column("alarm", BigInteger, primary_key=True, autoincrement=False),
    Column("robot", Id, primary_key=True),
    Column("from_ns", Time, nullable=False),
    Column("to_ns", Time),
    Index(None, "robot"),
)
"""Which robots an alarm is about, and since when; of an offline robot also until when."""

PART = Table(
    "alarm_part",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("source", _Word, primary_key=True),
    Column("alarm", BigInteger, nullable=False, index=True),
    Column("component", _Word, nullable=False),
    Column("severity", _Short, nullable=False),
    Column("level", _Short, nullable=False),
    Column("reason", Text, nullable=False),
    Column("cause", Text, nullable=False),
    Column("diagnosis", _Word, nullable=False),
    Column("active", Boolean, nullable=False),
    Column("opened_ns", Time, nullable=False),
    Column("changed_ns", Time, nullable=False),
    Column("count", BigInteger, nullable=False),
    Column("store_id", _Word, nullable=False),
    Column("run", BigInteger, nullable=False),
    Column("seq", BigInteger, nullable=False),
)
"""What robots said: their own alarms (``source`` is its id there), each part of one of ours."""

HISTORY = Table(
    "alarm_history",
    METADATA,
    Column("number", Counted, primary_key=True),
    Column("alarm", BigInteger, nullable=False, index=True),
    Column("at_ns", Time, nullable=False),
    Column("who", _Who, nullable=False),
    Column("what", _Short, nullable=False),
    Column("text", Text, nullable=False),
)
"""What happened to an alarm, and who did what; ``who`` is empty for the server itself."""

BLOCKED = Table(
    "alarm_blocked",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("component", _Word, primary_key=True),
    Column("blocked_by", Text, nullable=False),
    Column("level", _Short, nullable=False),
    Column("reason", Text, nullable=False),
    Column("since_ns", Time, nullable=False),
    Column("store_id", _Word, nullable=False),
    Column("run", BigInteger, nullable=False),
    Column("seq", BigInteger, nullable=False),
)
"""Components by the last transition that was told of each; ``blocked_by`` is a list as JSON."""

CONSEQUENCE = Table(
    "alarm_consequence",
    METADATA,
    Column("alarm", BigInteger, primary_key=True, autoincrement=False),
    Column("component", _Word, primary_key=True),
    Column("level", _Short, nullable=False),
    Column("reason", Text, nullable=False),
    Column("from_ns", Time, nullable=False),
    Column("to_ns", Time),
)
"""What suffers, or suffered, from the root of an alarm."""

ROOTS = Table(
    "alarm_roots",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("diagnosis", _Word, primary_key=True),
    Column("revision", BigInteger, nullable=False),
    Column("components", Text, nullable=False),
    Column("probability", Float, nullable=False),
    Column("effect", _Short, nullable=False, server_default=""),
    Column("words", Text, nullable=False, server_default=""),
)
"""What the leading answer of a robot's diagnosis says has failed: components, as JSON; ``effect``
and ``words`` are those that were explained last, see ``words.py``."""

MARK = Table(
    "alarm_mark",
    METADATA,
    Column("one", BigInteger, primary_key=True, autoincrement=False),
    Column("received_ns", Time, nullable=False),
)
"""All rows that robots sent up to here have been looked at."""
