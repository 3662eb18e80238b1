"""Codes that sign somebody in without a password: minutes, one use, kept as hashes in memory only.

There are none but in a demonstration, whose accounts have no password that anybody knows.
"""

from __future__ import annotations

import secrets
import threading
from dataclasses import dataclass, field

from sqlalchemy import Connection

from amberbox.core.clock import NS, Clock
from amberbox.core.errors import UsageError
from amberbox.fleet.accounts.backoff import attempt_was_right, begin_attempt
from amberbox.fleet.accounts.keys import digest
from amberbox.fleet.accounts.sessions import NewSession, begin_session
from amberbox.fleet.accounts.signin import LOGIN, Caller, MustWaitError
from amberbox.fleet.accounts.users import User, find_user
from amberbox.fleet.audit.entry import Entry
from amberbox.fleet.audit.log import append
from amberbox.fleet.database.database import Database

LASTS_NS = 15 * 60 * NS
LONGEST = 64
"""No code has more letters than this."""
_BYTES = 16
_WRONG = {"why": "wrong code"}
_ACCOUNT = "\0code"
"""Under this name wrong codes are counted: no account can be called so."""


class UsedCodeError(UsageError):
    """The code is wrong, used, or over: it is never said which."""

    def __init__(self) -> None:
        super().__init__(
            "this link was used, or is over", "press Enter where the demonstration runs: new links"
        )


@dataclass(frozen=True, slots=True)
class _Held:
    name: str
    until_ns: int


@dataclass(eq=False)
class SignInCodes:
    """The codes that hold; threads may share them."""

    clock: Clock
    _held: dict[str, _Held] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def make(self, name: str) -> str:
        """Make a code for an account (128 random bits); others of it go on to hold."""
        code = secrets.token_hex(_BYTES)
        now_ns = self.clock.boot_ns()
        with self._lock:
            self._held = {key: one for key, one in self._held.items() if now_ns < one.until_ns}
            self._held[digest(code)] = _Held(name, now_ns + LASTS_NS)
        return code

    def take(self, code: str) -> str | None:
        """Use a code up; return whose account it opens, None if it does not hold."""
        with self._lock:
            found = self._held.pop(digest(code), None)
        return found.name if found and self.clock.boot_ns() < found.until_ns else None


def sign_in_by_code(
    database: Database, clock: Clock, codes: SignInCodes, code: str, caller: Caller
) -> tuple[User, NewSession]:
    """Begin a session with a code; who comes first has it, and wrong ones make wait.

    Raises UsedCodeError, MustWaitError.
    """
    _refuse_too_many(database, clock, caller)
    name = codes.take(code)
    with database.begin() as connection:
        now_ns = clock.wall_ns()
        if name is not None:
            return _begun(connection, now_ns, name, caller)
        append(connection, now_ns, Entry("user:?", caller.address, LOGIN, "?", "refused", _WRONG))
    raise UsedCodeError


def _begun(
    connection: Connection, now_ns: int, name: str, caller: Caller
) -> tuple[User, NewSession]:
    user = find_user(connection, name)
    attempt_was_right(connection, now_ns, user.user_id, _ACCOUNT, caller.address)
    session = begin_session(
        connection, now_ns, user.user_id, caller.address, caller.agent, before=caller.before
    )
    told = {"session": session.session_id, "by": "code"}
    append(connection, now_ns, Entry(f"user:{name}", caller.address, LOGIN, name, details=told))
    return user, session


def _refuse_too_many(database: Database, clock: Clock, caller: Caller) -> None:
    with database.begin() as connection:
        wait = begin_attempt(connection, clock.wall_ns(), _ACCOUNT, caller.address)
    if wait is not None:
        raise MustWaitError(wait)
