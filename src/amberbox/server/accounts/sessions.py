"""Sessions of people: stored on the server, identified by the hash of a random secret."""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Connection, RowMapping, delete, insert, or_, select, update

from amberbox.core.clock import NS
from amberbox.link.join_line import is_secret
from amberbox.server.accounts.passwords import digest, new_secret
from amberbox.server.accounts.users import User, user_of
from amberbox.server.schema import SESSIONS, USERS

IDLE_NS = 30 * 60 * NS
LONGEST_NS = 12 * 3600 * NS
_TOUCH_NS = 30 * NS
_BACKWARDS_NS = 60 * NS


@dataclass(frozen=True, slots=True)
class NewSession:
    """A new session: the secret for the cookie, shown once, its public id, and its end (ns)."""

    secret: str
    session_id: str
    ends_ns: int

    def __repr__(self) -> str:
        return f"NewSession({self.session_id})"


@dataclass(frozen=True, slots=True)
class Session:
    """A session in a list; ``session_id`` can only be used to revoke it."""

    session_id: str
    created_ns: int
    seen_ns: int
    ends_ns: int
    address: str
    agent: str


@dataclass(frozen=True, slots=True)
class SignedIn:
    """An account and the session by which its request was authenticated."""

    user: User
    session: Session


def begin_session(
    connection: Connection,
    now_ns: int,
    user_id: int,
    address: str,
    agent: str = "",
    *,
    before: str | None = None,
) -> NewSession:
    """Begin a session at a login; end the one that the browser had ``before`` (its secret)."""
    if before is not None:
        end_session(connection, before)
    over = or_(SESSIONS.c.ends_ns <= now_ns, SESSIONS.c.seen_ns <= now_ns - IDLE_NS)
    connection.execute(delete(SESSIONS).where(over))
    secret = new_secret("session")
    row = {
        "hash": secret.hash,
        "session_id": secret.id,
        "user_id": user_id,
        "created_ns": now_ns,
        "seen_ns": now_ns,
        "ends_ns": now_ns + LONGEST_NS,
        "address": address[:64],
        "agent": agent[:200],
    }
    connection.execute(insert(SESSIONS), [row])
    return NewSession(secret.text, secret.id, now_ns + LONGEST_NS)


def find_session(connection: Connection, now_ns: int, secret: str) -> SignedIn | None:
    """Return account and session of a secret; None when unknown, over, or the account is closed."""
    if not is_secret(secret, "session"):
        return None
    joined = select(USERS, *_listed()).join(SESSIONS, SESSIONS.c.user_id == USERS.c.user_id)
    chosen = joined.where(SESSIONS.c.hash == digest(secret))
    row = connection.execute(chosen).mappings().one_or_none()
    if row is None or row["disabled_ns"] is not None:
        return None
    session = _session(row)
    if not _is_open(session, now_ns):
        return None
    return SignedIn(user_of(connection, row), session)


def _is_open(session: Session, now_ns: int) -> bool:
    """Return whether a session is not over, not idle, and did not begin in the future."""
    return (
        session.created_ns - _BACKWARDS_NS <= now_ns < session.ends_ns
        and now_ns - session.seen_ns < IDLE_NS
    )


def needs_touch(session: Session, now_ns: int) -> bool:
    """Return whether to store the time of a request: at most every 30 s, to save disk writes."""
    return now_ns - session.seen_ns >= _TOUCH_NS


def touch_session(connection: Connection, now_ns: int, session_id: str) -> None:
    """Store the time of the last request, from which the idle time of the session counts."""
    chosen = update(SESSIONS).where(SESSIONS.c.session_id == session_id)
    connection.execute(chosen.where(SESSIONS.c.seen_ns < now_ns).values(seen_ns=now_ns))


def end_session(connection: Connection, secret: str) -> None:
    """End the session of a secret, when its person signs out."""
    connection.execute(delete(SESSIONS).where(SESSIONS.c.hash == digest(secret)))


def list_sessions(connection: Connection, now_ns: int, user_id: int) -> list[Session]:
    """Return the open sessions of an account, newest first."""
    chosen = select(*_listed()).where(SESSIONS.c.user_id == user_id)
    found = connection.execute(chosen.order_by(SESSIONS.c.created_ns.desc())).mappings()
    return [one for one in map(_session, found) if _is_open(one, now_ns)]


def revoke_session(connection: Connection, user_id: int, session_id: str) -> bool:
    """End one session of an account; False when there is none of that id."""
    chosen = delete(SESSIONS).where(SESSIONS.c.session_id == session_id)
    return bool(connection.execute(chosen.where(SESSIONS.c.user_id == user_id)).rowcount)


def revoke_sessions(connection: Connection, user_id: int, *, but: str = "") -> int:
    """End all sessions of an account except the one of public id ``but``; return how many."""
    chosen = delete(SESSIONS).where(SESSIONS.c.user_id == user_id)
    return connection.execute(chosen.where(SESSIONS.c.session_id != but)).rowcount


def csrf_token(secret: str) -> str:
    """Return the CSRF token of a session: derived from its secret, which it does not reveal."""
    return hmac.new(secret.encode(), b"amberbox forms", hashlib.sha256).hexdigest()


def is_csrf_token(secret: str, token: str) -> bool:
    """Return whether a CSRF token belongs to this session."""
    return hmac.compare_digest(csrf_token(secret).encode(), token.encode("utf-8", "replace"))


def _listed() -> tuple[ColumnElement[Any], ...]:
    names = ("session_id", "seen_ns", "ends_ns", "address", "agent")
    created = SESSIONS.c.created_ns.label("session_created_ns")  # USERS has a created_ns, too
    return (created, *(SESSIONS.c[name] for name in names))


def _session(row: RowMapping) -> Session:
    return Session(
        row["session_id"],
        row["session_created_ns"],
        row["seen_ns"],
        row["ends_ns"],
        row["address"],
        row["agent"],
    )
