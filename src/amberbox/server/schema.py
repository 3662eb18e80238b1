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
    UniqueConstraint,
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
"""All tables of the server. Constraints have names, so that migrations can refer to them."""

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
"""Applied migrations by number; the largest is the version of the database."""

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
"""Wrong logins per account, per address and per pair of both; ``key`` is a hash of these."""

KNOWN_ADDRESSES = Table(
    "known_addresses",
    METADATA,
    Column("user_id", _belongs_to("users.user_id"), primary_key=True),
    Column("address", String(64), primary_key=True),
    Column("last_ns", Time, nullable=False),
)
"""Addresses of earlier logins: there, wrong logins from other addresses cause no waiting."""


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
"""One row: the newest row of the log. A transaction that adds a row locks it first."""

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
"""Each robot and its newest connection; frames of an older ``epoch`` are refused."""

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
"""Known runs: the boot that wrote each, and the end of its stored rows."""

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
"""Rows of the robot's journals, until the journal itself is committed."""

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
"""Ranges that the archive holds from journals: late rows of them are ignored."""

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
"""Events about a robot's link, store and journals, recorded by the server."""

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

``path`` is relative to the server's folder. A verified file is part of the robot's record; a file
set aside is valid too, but of another history of the same store than the file held under its name.
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
"""Windows requested from robots.

``state``: waiting (for the robot), asked (sent to it), copying, ready, gone (the robot has none of
its data), cancelled. ``files`` is JSON: the journals that the robot named, by store, and the state
of each.
"""


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
"""One row per journal, kept for ever, with its deletion if it was deleted.

``state`` is ``put`` (kept, its rows are in no table yet), ``committed``, or ``refused`` (it changed
before its rows were read). ``facts`` is JSON: readings of the clock, configured variables,
unreadable parts. ``own_gone`` is about the box's own records (statuses, events ...),
``columns_gone`` about all others.
"""

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
"""Columns of each table; ``number`` is the order in which the schemas arrived."""

SOURCES = Table(
    "archive_sources",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("store_id", Id, primary_key=True),
    Column("item", String(200), primary_key=True),
    Column("schema_id", String(32), primary_key=True),
)
"""The tables that have, or had, rows of a robot's store."""

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
"""Ranges that will never arrive according to the robot, or that a power cut destroyed; shown as
gaps.
"""


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
    Column("uid", String(64), nullable=False, server_default=""),
    Column("to_ns", Time),
    Column("about", String(200), nullable=False, server_default=""),
    Column("revision", BigInteger, nullable=False, server_default="1"),
    Column("withdrawn", Boolean, nullable=False, server_default="0"),
    Column("written_ns", Time, nullable=False, server_default="0"),
    Index(None, "robot", "mission"),
    Index(None, "robot", "uid"),
)
"""Notes on missions and moments; ``mission`` is empty for a moment without a mission.

``uid`` is the id that the robot's record has as well.
"""

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
"""Windows that people marked on the server: their data are kept until they are released."""


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
"""Answers to tests of a diagnosis; of several answers to one test the last counts."""

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
"""Revisions of diagnoses that the server made after an answer; ``body`` is JSON as it was sent."""

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
"""Confirmed causes of diagnoses, entered by people; entries are never deleted."""


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
"""Alarms. ``robot`` is empty for an alarm of several robots; ``told`` is the severity that was last
notified, ``notify_ns`` when the next notification is due; ``revised``, ``effect`` and ``words``
are those of the last diagnosis while the alarm was active.
"""

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
"""Robots' own alarms (``source`` is the id on the robot), each part of an alarm of the server."""

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
"""History of an alarm; ``who`` is the person who made the change, empty for the server itself."""

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
"""Components by their last reported transition; ``blocked_by`` is a list as JSON."""

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
"""Components that have failed according to the leading answer of a robot's diagnosis, as JSON;
``effect`` and ``words`` are those that were explained last, see ``words.py``.
"""

MARK = Table(
    "alarm_mark",
    METADATA,
    Column("one", BigInteger, primary_key=True, autoincrement=False),
    Column("received_ns", Time, nullable=False),
)
"""Position up to which all rows of robots have been processed."""


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
"""Alarms with notifications whose state has changed since, and when to check them."""


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
"""Downloads. ``owner`` is the person, also for a request with a token.

``state``: queued, running, done, failed, cancelled, or expired (its file is deleted). ``request``
and ``notes`` are JSON.
"""


MODEL = Table(
    "learnt_model",
    METADATA,
    Column("id", Id, primary_key=True),
    Column("name", Id, nullable=False),
    Column("version", Integer, nullable=False),
    Column("owner", String(128), nullable=False),
    Column("request", Text, nullable=False),
    Column("state", String(16), nullable=False),
    Column("progress", Float, nullable=False),
    Column("bytes", BigInteger, nullable=False),
    Column("sha256", Digest, nullable=False),
    Column("report", Text, nullable=False),
    Column("error", Text, nullable=False),
    Column("asked_ns", Time, nullable=False),
    Column("started_ns", Time, nullable=True),
    Column("ended_ns", Time, nullable=True),
    UniqueConstraint("name", "version"),
    Index(None, "state", "asked_ns"),
)
"""Models of detectors, learnt or to be learnt. ``owner`` is the person who asked.

``state``: queued, running, done, failed, cancelled, or deleted: then only its version stays, which
is not used again. ``request`` and ``report`` are JSON.
"""

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
"""What robots are to do. ``state``: unsigned until a person signs it, waiting, sent, or what the
robot answered; withdrawn by a person; expired, with no ``answered_ns``, where the server gave it
up. ``bytes`` is sent as it is here; ``key_id`` is empty where it is not signed; ``epoch`` is that
of the connection that sent it last."""

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

RECORD_ORDER = Table(
    "record_order",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("about", String(700), primary_key=True),
    Column("action", _Word, nullable=False),
    Column("parameters", Text, nullable=False),
    Column("issuer", _Who, nullable=False),
    Column("until_ns", Time, nullable=True),
    Column("command", Id, nullable=False, index=True),
    Column("tries", BigInteger, nullable=False),
    Column("seen", Boolean, nullable=False),
)
"""What is wanted of robots' records, by matter: the newest ``command`` for it, how many there were,
whether it has come back in the robot's record (``seen``), and until when it means anything."""

ALARM_WORD = Table(
    "alarm_word",
    METADATA,
    Column("robot", Id, primary_key=True),
    Column("source", _Word, primary_key=True),
    Column("state", _Short, nullable=False),
    Column("who", _Word, nullable=False),
    Column("until_ns", Time, nullable=True),
    Column("said_ns", Time, nullable=False),
    Column("at_ns", Time, nullable=False),
    Column("command", Id, nullable=False),
)
"""What people did last with robots' own alarms (``source``), as the robots' records say."""

REVOKED_KEY = Table(
    "command_revoked_key",
    METADATA,
    Column("key_id", Id, primary_key=True),
    Column("who", _Who, nullable=False),
    Column("reason", Text, nullable=False),
    Column("at_ns", Time, nullable=False),
)
"""Keys of persons that sign nothing any more; rows are only added."""

EXPERIMENT = Table(
    "experiment",
    METADATA,
    Column("sha256", String(64), primary_key=True),
    Column("name", Id, nullable=False),
    Column("title", Text, nullable=False),
    Column("who", _Who, nullable=False),
    Column("added_ns", Time, nullable=False),
    Column("listed", Boolean, nullable=False),
    Index(None, "name"),
)
"""Experiments whose files are kept in ``DIR/experiments/SHA256``: uploaded ones, of which those
that are ``listed`` can be started, and those of robots' folders that were started."""

RUN_CLOCK = Table(
    "run_clock",
    METADATA,
    Column("one", Integer, primary_key=True, autoincrement=False),
    Column("boot_id", Id, nullable=False),
    Column("base_ns", BigInteger, nullable=False),
)
"""One row: the time of runs at the server's boot. It stays while runs are under way, so that steps
of the wall clock neither fire their timers nor hold them up, whatever restarts."""

EXPERIMENT_RUN = Table(
    "experiment_run",
    METADATA,
    Column("number", Counted, primary_key=True),
    Column("id", Id, nullable=False, unique=True),
    Column("robot", Id, nullable=False),
    Column("kind", _Short, nullable=False),
    Column("name", _Word, nullable=False),
    Column("title", Text, nullable=False),
    Column("sha256", String(64), nullable=False),
    Column("state", _Short, nullable=False),
    Column("reason", Text, nullable=False),
    Column("who", _Who, nullable=False),
    Column("parameters", Text, nullable=False),
    Column("series", Id, nullable=False),
    Column("left", BigInteger, nullable=False),
    Column("diagnosis", _Word, nullable=False),
    Column("test", String(512), nullable=False),
    Column("config_hash", String(64), nullable=False),
    Column("versions", Text, nullable=False),
    Column("at_robot", Boolean, nullable=False),
    Column("created_ns", Time, nullable=False),
    Column("begun_ns", Time, nullable=True),
    Column("ended_ns", Time, nullable=True),
    Column("kept", LargeBinary, nullable=False),
    Column("report", Text, nullable=False),
    Index(None, "robot", "state"),
    Index(None, "sha256"),
)
"""Runs of experiments and of unit tests. ``kept`` is the state of ``experiments.run.ExperimentRun``
with all events; ``series`` are runs that repeat each other, of which ``left`` are to follow;
``test`` is the test of the diagnosis that the verdict answers; ``report`` its verdict, ``versions``
those of software by name, as JSON. Those that robots carried out alone (``at_robot``) come from
their record when they are over."""
