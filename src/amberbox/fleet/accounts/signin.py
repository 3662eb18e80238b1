"""Log in: who it is, whether to wait, the session, and the row in the audit log."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, select, update

from amberbox.core.clock import Clock
from amberbox.core.errors import AmberboxError
from amberbox.fleet.accounts.backoff import Wait, attempt_was_right, begin_attempt
from amberbox.fleet.accounts.passwords import Passwords, refuse_weak
from amberbox.fleet.accounts.sessions import NewSession, begin_session
from amberbox.fleet.accounts.tables import USERS
from amberbox.fleet.accounts.tokens import revoke_tokens
from amberbox.fleet.accounts.users import User, find_user, set_password
from amberbox.fleet.audit.entry import Entry, Result
from amberbox.fleet.audit.log import append
from amberbox.fleet.database.database import Database

LOGIN = "login"
CHANGE = "password"
_UNKNOWN = "?"


class WrongLoginError(AmberboxError):
    """Name or password is wrong, or the account is closed: it is never said which."""

    def __init__(self) -> None:
        super().__init__("name or password is wrong", "ask an admin for a new password")


class MustWaitError(AmberboxError):
    """There were too many wrong logins; ``seconds`` until the next try."""

    def __init__(self, wait: Wait) -> None:
        super().__init__(
            f"there were too many wrong logins: wait {wait.seconds} s",
            "a login from where you have logged in before is not kept waiting by others",
        )
        self.seconds = wait.seconds


@dataclass(frozen=True, slots=True)
class Caller:
    """Where a login comes from: the address, the browser, the session that it had (a secret)."""

    address: str
    agent: str = ""
    before: str | None = None


@dataclass(frozen=True, slots=True)
class _Held:
    """What the database has of the name that was given: nothing, if it knows none such."""

    hash: str | None = None
    is_closed: bool = False


def sign_in(
    database: Database,
    clock: Clock,
    passwords: Passwords,
    name: str,
    password: str,
    caller: Caller,
) -> tuple[User, NewSession]:
    """Log somebody in; a new session is made, the browser's old one ends.

    This takes a quarter of a second: in an event loop use ``passwords.apart(sign_in, ...)``.
    Raises WrongLoginError, MustWaitError, TooManyError.
    """
    account = name.casefold()
    hash_ = _checked(database, clock, passwords, account, password, caller, LOGIN)
    fresh = passwords.hash(password) if passwords.is_outdated(hash_) else None
    with database.begin() as connection:
        now_ns = clock.wall_ns()
        user = _still_there(connection, account, hash_)
        if fresh is not None:
            chosen = update(USERS).where(USERS.c.user_id == user.user_id)
            connection.execute(chosen.values(password_hash=fresh))
        attempt_was_right(connection, now_ns, user.user_id, account, caller.address)
        session = begin_session(
            connection, now_ns, user.user_id, caller.address, caller.agent, before=caller.before
        )
        entry = _entry(account, caller, LOGIN, session=session.session_id)
        append(connection, now_ns, entry)
    return user, session


def change_password(
    database: Database,
    clock: Clock,
    passwords: Passwords,
    name: str,
    old: str,
    new: str,
    caller: Caller,
    *,
    with_tokens: bool = False,
) -> NewSession:
    """Change one's own password: all sessions end (``with_tokens`` these, too), a new one begins.

    Raises UsageError for a weak one, and what ``sign_in`` raises: the old one is asked for, so that
    a browser that was left open does not give the account away.
    """
    account = name.casefold()
    refuse_weak(new, account)
    old_hash = _checked(database, clock, passwords, account, old, caller, CHANGE)
    new_hash = passwords.hash(new)
    with database.begin() as connection:
        now_ns = clock.wall_ns()
        user = _still_there(connection, account, old_hash)
        attempt_was_right(connection, now_ns, user.user_id, account, caller.address)
        set_password(connection, now_ns, account, new_hash)
        revoked = revoke_tokens(connection, now_ns, user.user_id) if with_tokens else 0
        told = {"tokens_revoked": str(revoked)} if with_tokens else {}
        append(connection, now_ns, _entry(account, caller, CHANGE, "ok", **told))
        return begin_session(connection, now_ns, user.user_id, caller.address, caller.agent)


def _checked(
    database: Database,
    clock: Clock,
    passwords: Passwords,
    account: str,
    password: str,
    caller: Caller,
    action: str,
) -> str:
    """Check a password outside of any transaction; return the hash that it has."""
    with database.begin() as connection:
        wait = begin_attempt(connection, clock.wall_ns(), account, caller.address)
        held = _held(connection, account)
        # What is no account may be a password in the wrong field: it is not written down.
        named = _UNKNOWN if held.hash is None else account
        if wait is not None and wait.first:
            entry = _entry(named, caller, action, "refused", why="too many wrong logins")
            append(connection, clock.wall_ns(), entry)
    if wait is not None:
        raise MustWaitError(wait)
    is_right = passwords.verify(held.hash, password)
    if held.hash is not None and is_right and not held.is_closed:
        return held.hash
    with database.begin() as connection:
        entry = _entry(named, caller, action, "refused", why="wrong login")
        append(connection, clock.wall_ns(), entry)
    raise WrongLoginError


def _held(connection: Connection, account: str) -> _Held:
    chosen = select(USERS.c.password_hash, USERS.c.disabled_ns).where(USERS.c.name == account)
    found = connection.execute(chosen).one_or_none()
    return _Held() if found is None else _Held(found[0], found[1] is not None)


def _still_there(connection: Connection, account: str, hash_: str) -> User:
    """Return the account, if nobody closed it or changed its password while it was checked."""
    if _held(connection, account) != _Held(hash_):
        raise WrongLoginError
    return find_user(connection, account)


def _entry(
    account: str, caller: Caller, action: str, result: Result = "ok", **details: str
) -> Entry:
    return Entry(f"user:{account}", caller.address, action, account, result, details)
