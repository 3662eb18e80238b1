"""Tables of people and robots. Of anything secret only a hash is here."""

from __future__ import annotations

from sqlalchemy import (
    BigInteger,
    Boolean,
    CheckConstraint,
    Column,
    ForeignKey,
    Index,
    String,
    Table,
    Text,
)

from amberbox.fleet.database.metadata import METADATA, Counted, Digest, Id, Time


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
