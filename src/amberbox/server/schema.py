"""The database schema: every table of the server.

All tables are on ``METADATA``. Times are integer nanoseconds since the Unix epoch (``Time``), by
the server's clock unless the name says otherwise. Of secrets only hashes are stored.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import (
    DDL,
    BigInteger,
    Boolean,
    CheckConstraint,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    event,
)

METADATA = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)
"""All tables of the server. Constraints have names, so that a migration can speak of them."""

Counted = BigInteger().with_variant(Integer(), "sqlite")
"""A key that the database counts up; SQLite does so for INTEGER only, which has 64 bits there."""

Time = BigInteger()
"""Nanoseconds since the Unix epoch, by the server's clock unless the name says otherwise."""

SCHEMA_VERSION = Table(
    "schema_version",
    METADATA,
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("what", Text, nullable=False),
    Column("applied_ns", Time, nullable=False),
)
"""What was done to the database, by number; the largest is its version."""

Id = String(64)
"""An id as in ``core.ids``."""

Digest = String(64)
"""A SHA-256 as hex digits."""


def _belongs_to(target: str) -> ForeignKey:
    return ForeignKey(target, ondelete="CASCADE")


USERS = Table(
    "users",
    METADATA,
    Column("user_id", Counted, primary_key=True),
    Column("name", Id, nullable=False, unique=True),
    Column("role", String(16), nullable=False),
    Column("password_hash", Text, nullable=False),
    Column("all_robots", Boolean, nullable=False),
    Column("must_change", Boolean, nullable=False),
    Column("created_ns", Time, nullable=False),
    Column("changed_ns", Time, nullable=False),
    Column("disabled_ns", Time),
    CheckConstraint("role IN ('viewer', 'operator', 'technician', 'admin')", name="role"),
)
"""People. Without ``all_robots`` a person sees the robots of ``USER_GROUPS`` only."""

GROUPS = Table(
    "groups",
    METADATA,
    Column("name", Id, primary_key=True),
    Column("created_ns", Time, nullable=False),
)

ROBOTS = Table(
    "robots",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("added_ns", Time, nullable=False),
    Column("disabled_ns", Time),
)

USER_GROUPS = Table(
    "user_groups",
    METADATA,
    Column("user_id", _belongs_to("users.user_id"), primary_key=True),
    Column("group", _belongs_to("groups.name"), primary_key=True),
)

ROBOT_GROUPS = Table(
    "robot_groups",
    METADATA,
    Column("robot", _belongs_to("robots.robot"), primary_key=True),
    Column("group", _belongs_to("groups.name"), primary_key=True),
)

ROBOT_KEYS = Table(
    "robot_keys",
    METADATA,
    Column("key_id", Id, primary_key=True),
    Column("robot", _belongs_to("robots.robot"), nullable=False, index=True),
    Column("hash", Digest, nullable=False, unique=True),
    Column("created_ns", Time, nullable=False),
    Column("expires_ns", Time),
    Column("revoked_ns", Time),
    Column("used_ns", Time),
)

SESSIONS = Table(
    "sessions",
    METADATA,
    Column("hash", Digest, primary_key=True),
    Column("session_id", Id, nullable=False, unique=True),
    Column("user_id", _belongs_to("users.user_id"), nullable=False, index=True),
    Column("created_ns", Time, nullable=False),
    Column("seen_ns", Time, nullable=False),
    Column("ends_ns", Time, nullable=False, index=True),
    Column("address", String(64), nullable=False),
    Column("agent", String(200), nullable=False),
)
"""Logins. ``session_id`` is the name to list and revoke one by; it opens nothing."""

TOKENS = Table(
    "tokens",
    METADATA,
    Column("token_id", Id, primary_key=True),
    Column("hash", Digest, nullable=False, unique=True),
    Column("user_id", _belongs_to("users.user_id"), nullable=False, index=True),
    Column("name", String(100), nullable=False),
    Column("scopes", Text, nullable=False),
    Column("all_robots", Boolean, nullable=False),
    Column("created_ns", Time, nullable=False),
    Column("expires_ns", Time, nullable=False),
    Column("revoked_ns", Time),
    Column("used_ns", Time),
)
"""Tokens for programs; ``scopes`` are separated by spaces."""

TOKEN_GROUPS = Table(
    "token_groups",
    METADATA,
    Column("token_id", _belongs_to("tokens.token_id"), primary_key=True),
    Column("group", _belongs_to("groups.name"), primary_key=True),
)

SETUP_CODES = Table(
    "setup_codes",
    METADATA,
    Column("hash", Digest, primary_key=True),
    Column("created_ns", Time, nullable=False),
    Column("expires_ns", Time, nullable=False),
)

LOGIN_ATTEMPTS = Table(
    "login_attempts",
    METADATA,
    Column("kind", String(8), primary_key=True),
    Column("key", Digest, primary_key=True),
    Column("failures", BigInteger, nullable=False),
    Column("last_ns", Time, nullable=False),
    Column("until_ns", Time, nullable=False),
    Column("refused", BigInteger, nullable=False),
    Index("ix_login_attempts_last_ns", "last_ns"),
)
"""Wrong logins per account, per address and per pair of both; ``key`` is a hash of which."""

KNOWN_ADDRESSES = Table(
    "known_addresses",
    METADATA,
    Column("user_id", _belongs_to("users.user_id"), primary_key=True),
    Column("address", String(64), primary_key=True),
    Column("last_ns", Time, nullable=False),
)
"""Where somebody has logged in from: wrong logins elsewhere do not keep them waiting here."""


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


OPTION = Table(
    "option",
    METADATA,
    Column("name", Id, primary_key=True),
    Column("value", Text, nullable=False),
    Column("changed_ns", Time, nullable=False),
)


_Word = String(128)


def _run() -> tuple[Column[Any], ...]:
    """Return new key columns for a run of a writer; columns cannot be shared between tables."""
    return (
        Column("robot", Id, primary_key=True),
        Column("store_id", _Word, primary_key=True),
        Column("writer", _Word, primary_key=True),
        Column("run", BigInteger, primary_key=True, autoincrement=False),
    )


def _place() -> tuple[Column[Any], ...]:
    """Return new key columns for a row's position."""
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


FETCH = Table(
    "fetch",
    METADATA,
    Column("id", Id, primary_key=True),
    Column("robot", Id, nullable=False),
    Column("item", String(200), nullable=False),
    Column("from_ns", Time, nullable=False),
    Column("to_ns", Time, nullable=False),
    Column("who", String(200), nullable=False),
    Column("state", String(16), nullable=False),
    Column("files", Text, nullable=False),
    Column("asked_ns", Time, nullable=False),
    Column("sent_ns", Time, nullable=True),
    Column("ended_ns", Time, nullable=True),
    Index(None, "robot", "state"),
)
"""``state``: waiting (for the robot), asked (sent to it), copying, ready, gone (the robot has
nothing of it), cancelled. ``files`` is JSON: the journals that the robot named, by store, and what
became of each."""


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


MISSION = Table(
    "server_mission",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("id", Id, primary_key=True),
    Column("name", Id, nullable=False),
    Column("from_ns", Time, nullable=False),
    Column("to_ns", Time, nullable=True),
    Column("outcome", Id, nullable=False),
    Column("failed", Boolean, nullable=False),
    Column("who", String(200), nullable=False),
    Column("parameters", Text, nullable=False),
)
"""Missions that people began on the server; ``to_ns`` is null while one lasts."""

MISSION_NOTE = Table(
    "mission_note",
    METADATA,
    Column("number", Counted, primary_key=True),
    Column("robot", Id, nullable=False),
    Column("mission", String(200), nullable=False),
    Column("at_ns", Time, nullable=False),
    Column("who", String(200), nullable=False),
    Column("text", Text, nullable=False),
    Index(None, "robot", "mission"),
)
"""What people remarked on missions, the robots' own ones too; ``mission`` is empty where it is on a
moment alone."""

INCIDENT = Table(
    "server_incident",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("id", Id, primary_key=True),
    Column("from_ns", Time, nullable=False),
    Column("to_ns", Time, nullable=False),
    Column("reason", Text, nullable=False),
    Column("who", String(200), nullable=False),
    Column("made_ns", Time, nullable=False),
    Column("released_ns", Time, nullable=True),
)
"""Windows that people marked on the server: what lies in them is kept until they are released."""


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


IDENTITY = Table(
    "server_identity",
    METADATA,
    Column("one", Integer, primary_key=True, autoincrement=False),
    Column("server_id", Id, nullable=False),
    Column("made_ns", Time, nullable=False),
)
"""One row: the random id of this server, which commands are signed for; made once."""

COMMAND = Table(
    "command",
    METADATA,
    Column("number", Counted, primary_key=True),
    Column("id", Id, nullable=False, unique=True),
    Column("robot", Id, nullable=False),
    Column("action", _Word, nullable=False),
    Column("parameters", Text, nullable=False),
    Column("issuer", _Who, nullable=False),
    Column("run", _Word, nullable=False),
    Column("step", _Word, nullable=False),
    Column("risk", _Short, nullable=False),
    Column("key_id", Id, nullable=False),
    Column("created_ns", Time, nullable=False),
    Column("expires_ns", Time, nullable=False),
    Column("bytes", LargeBinary, nullable=False),
    Column("state", _Short, nullable=False),
    Column("reason", Text, nullable=False),
    Column("epoch", BigInteger, nullable=True),
    Column("sent_ns", Time, nullable=True),
    Column("sends", BigInteger, nullable=False),
    Column("answered_ns", Time, nullable=True),
    Index(None, "robot", "state"),
)
"""What robots are to do. ``state``: waiting, sent, or what the robot answered; expired, with no
``answered_ns``, where the server gave it up. ``bytes`` is sent as it is here; ``key_id`` is empty
where it is not signed; ``epoch`` is that of the connection that sent it last."""

COMMAND_ANSWER = Table(
    "command_answer",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("store_id", _Word, primary_key=True),
    Column("command", Id, primary_key=True),
    Column("number", BigInteger, primary_key=True, autoincrement=False),
    Column("state", _Short, primary_key=True),
    Column("reason", Text, nullable=False),
    Column("result", Text, nullable=False),
    Column("at_ns", BigInteger, nullable=False),
    Column("boot", _Word, nullable=False),
    Column("mono_ns", BigInteger, nullable=False),
    Column("received_ns", Time, nullable=False),
    Index(None, "command"),
)
"""All that robots said of commands, also of such that this server does not know. ``at_ns`` and
``mono_ns`` are the robot's."""

COMMAND_ROBOT = Table(
    "command_robot",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("store_id", _Word, nullable=False),
    Column("answered", BigInteger, nullable=False),
    Column("actions", Text, nullable=False),
    Column("actions_ns", Time, nullable=True),
    Column("lease", BigInteger, nullable=False),
    Column("holder", _Word, nullable=False),
    Column("run", _Word, nullable=False),
    Column("lease_ns", Time, nullable=True),
)
"""Robots that take commands, as they said last: number of the newest answer that is stored,
actions (JSON, unchecked), and the lease: its number, holder and run."""

REVOKED_KEY = Table(
    "command_revoked_key",
    METADATA,
    Column("key_id", Id, primary_key=True),
    Column("who", _Who, nullable=False),
    Column("reason", Text, nullable=False),
    Column("at_ns", Time, nullable=False),
)
"""Keys of persons that sign nothing any more; rows are only added."""
