"""Sign in: by password, by a one-time code, or as the first admin with the setup code.

Each way delays further attempts after wrong ones, longer each time and across restarts of the
server, and writes a row to the audit log.
"""

from __future__ import annotations

import ipaddress
import re
import secrets
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sqlalchemy import Connection, delete, insert, select, update

from amberbox.core.clock import NS, Clock
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import write_private
from amberbox.server.accounts.passwords import Passwords, digest, refuse_weak
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.sessions import NewSession, begin_session
from amberbox.server.accounts.tokens import revoke_tokens
from amberbox.server.accounts.users import User, add_user, find_user, has_admin, set_password
from amberbox.server.audit import AuditEntry, Result, append
from amberbox.server.database import ServerDatabase, upsert
from amberbox.server.schema import KNOWN_ADDRESSES, LOGIN_ATTEMPTS, SETUP_CODES, USERS

LOGIN = "login"
CHANGE = "password"
_UNKNOWN = "?"


class WrongLoginError(AmberboxError):
    """Name or password is wrong, or the account is closed; the error does not state which."""

    def __init__(self) -> None:
        super().__init__("name or password is wrong", "ask an admin for a new password")


class MustWaitError(AmberboxError):
    """Too many wrong logins; ``seconds`` is the time until the next try."""

    def __init__(self, wait: Wait) -> None:
        super().__init__(
            f"there were too many wrong logins: wait {wait.seconds} s",
            "a login from where you have logged in before is not kept waiting by others",
        )
        self.seconds = wait.seconds


@dataclass(frozen=True, slots=True)
class LoginOrigin:
    """The origin of a login: address, browser, and the secret of the browser's last session."""

    address: str
    agent: str = ""
    before: str | None = None


def sign_in(
    database: ServerDatabase,
    clock: Clock,
    passwords: Passwords,
    name: str,
    password: str,
    caller: LoginOrigin,
) -> tuple[User, NewSession]:
    """Sign in to an account: begin a new session, end the browser's previous one.

    This takes a quarter of a second: in an event loop use ``passwords.apart(sign_in, ...)``. Raises
    WrongLoginError, MustWaitError, TooManyError.
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
    database: ServerDatabase,
    clock: Clock,
    passwords: Passwords,
    name: str,
    old: str,
    new: str,
    caller: LoginOrigin,
    *,
    with_tokens: bool = False,
) -> NewSession:
    """Change one's own password, end all sessions and begin a new one.

    ``with_tokens`` also revokes the tokens. Raises UsageError for a weak password, and what
    ``sign_in`` raises: the old password is required, so that an unattended browser is not enough.
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
        details = {"tokens_revoked": str(revoked)} if with_tokens else {}
        append(connection, now_ns, _entry(account, caller, CHANGE, "ok", **details))
        return begin_session(connection, now_ns, user.user_id, caller.address, caller.agent)


def _checked(
    database: ServerDatabase,
    clock: Clock,
    passwords: Passwords,
    account: str,
    password: str,
    caller: LoginOrigin,
    action: str,
) -> str:
    """Check a password outside of any transaction; return its stored hash."""
    with database.begin() as connection:
        wait = begin_attempt(connection, clock.wall_ns(), account, caller.address)
        held, is_closed = _held(connection, account)
        # An unknown name may be a password in the wrong field, so it is not logged.
        named = _UNKNOWN if held is None else account
        if wait is not None and wait.first:
            entry = _entry(named, caller, action, "refused", why="too many wrong logins")
            append(connection, clock.wall_ns(), entry)
    if wait is not None:
        raise MustWaitError(wait)
    is_right = passwords.verify(held, password)
    if held is not None and is_right and not is_closed:
        return held
    with database.begin() as connection:
        entry = _entry(named, caller, action, "refused", why="wrong login")
        append(connection, clock.wall_ns(), entry)
    raise WrongLoginError


def _held(connection: Connection, account: str) -> tuple[str | None, bool]:
    """Return the hash of an account's password (None: no such account), and if it is closed."""
    chosen = select(USERS.c.password_hash, USERS.c.disabled_ns).where(USERS.c.name == account)
    found = connection.execute(chosen).one_or_none()
    return (None, False) if found is None else (found[0], found[1] is not None)


def _still_there(connection: Connection, account: str, hash_: str) -> User:
    """Return the account; raises WrongLoginError if it was changed during the check."""
    if _held(connection, account) != (hash_, False):
        raise WrongLoginError
    return find_user(connection, account)


def _entry(
    account: str, caller: LoginOrigin, action: str, result: Result = "ok", **details: str
) -> AuditEntry:
    return AuditEntry(f"user:{account}", caller.address, action, account, result, details)


CODE_LASTS_NS = 15 * 60 * NS
LONGEST = 64
"""No code has more letters than this."""
_BYTES = 16
_WRONG = {"why": "wrong code"}
_ACCOUNT = "\0code"
"""Under this name wrong codes are counted: no account can be called so."""


class UsedCodeError(UsageError):
    """The code is wrong, used, or expired; the error does not state which."""

    def __init__(self) -> None:
        super().__init__(
            "this link was used, or is over", "press Enter where the demonstration runs: new links"
        )


@dataclass(eq=False)
class SignInCodes:
    """The valid sign-in codes; threads may share them."""

    clock: Clock
    _held: dict[str, tuple[str, int]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def make(self, name: str) -> str:
        """Return a new code for an account (128 random bits); earlier ones stay valid."""
        code = secrets.token_hex(_BYTES)
        now_ns = self.clock.boot_ns()
        with self._lock:
            self._held = {key: one for key, one in self._held.items() if now_ns < one[1]}
            self._held[digest(code)] = name, now_ns + CODE_LASTS_NS
        return code

    def take(self, code: str) -> str | None:
        """Use up a code; return the name of its account, None if the code is not valid."""
        with self._lock:
            name, until_ns = self._held.pop(digest(code), (None, 0))
        return name if self.clock.boot_ns() < until_ns else None


def sign_in_by_code(
    database: ServerDatabase, clock: Clock, codes: SignInCodes, code: str, caller: LoginOrigin
) -> tuple[User, NewSession]:
    """Begin a session with a code, which is valid once; wrong codes delay further attempts.

    Raises UsedCodeError, MustWaitError.
    """
    _refuse_too_many(database, clock, _ACCOUNT, caller)
    name = codes.take(code)
    with database.begin() as connection:
        now_ns = clock.wall_ns()
        if name is not None:
            user = find_user(connection, name)
            attempt_was_right(connection, now_ns, user.user_id, _ACCOUNT, caller.address)
            session = begin_session(
                connection, now_ns, user.user_id, caller.address, caller.agent, before=caller.before
            )
            details = {"session": session.session_id, "by": "code"}
            entry = AuditEntry(f"user:{name}", caller.address, LOGIN, name, details=details)
            append(connection, now_ns, entry)
            return user, session
        append(
            connection, now_ns, AuditEntry("user:?", caller.address, LOGIN, "?", "refused", _WRONG)
        )
    raise UsedCodeError


def _refuse_too_many(
    database: ServerDatabase, clock: Clock, counted: str, caller: LoginOrigin
) -> None:
    with database.begin() as connection:
        wait = begin_attempt(connection, clock.wall_ns(), counted, caller.address)
    if wait is not None:
        raise MustWaitError(wait)


SETUP_FILE = "setup-code"
SETUP_LASTS_NS = 30 * 60 * NS
SETUP_ACTION = "setup"
_LETTERS = "0123456789abcdefghjkmnpqrstvwxyz"
_GROUPS, _EACH = 5, 4


class WrongCodeError(AmberboxError):
    """The setup code is wrong, used, or expired; the error does not state which."""

    def __init__(self) -> None:
        super().__init__(
            "this code does not hold (any more)", "make a new one: amberbox serve --new-code"
        )


@dataclass(frozen=True, slots=True)
class SetupCode:
    """A new setup code, the file it was written to, and its end (ns)."""

    code: str
    path: Path
    expires_ns: int
    is_first: bool = True
    """Whether there is no admin yet."""

    def __repr__(self) -> str:
        return f"SetupCode({self.path})"

    def text(self, url: str, *, by_proxy: bool = False) -> str:
        """Return the text for stderr; ``by_proxy``: also the first admin needs the code."""
        enter = " and enter this code:"
        if self.is_first and not by_proxy:
            enter = ".\nOn this machine no code is asked for; from elsewhere it takes this one:"
        return (
            f"To become an admin of this server, open {url}{enter}\n\n"
            f"    {self.code}\n\n"
            f"It holds for {SETUP_LASTS_NS // (60 * NS)} minutes and once. "
            f"It is also in {self.path}.\n"
        )


def new_setup_code(database: ServerDatabase, clock: Clock, folder: Path) -> SetupCode:
    """Write a new setup code to the server's folder; older ones become invalid.

    Raises AmberboxError when it cannot be written.
    """
    code = "-".join("".join(map(secrets.choice, [_LETTERS] * _EACH)) for _ in range(_GROUPS))
    now_ns = clock.wall_ns()
    with database.begin() as connection:
        is_first = needs_setup(connection)
        connection.execute(delete(SETUP_CODES))
        row = {"hash": _hash(code), "created_ns": now_ns, "expires_ns": now_ns + SETUP_LASTS_NS}
        connection.execute(insert(SETUP_CODES), [row])
        append(
            connection,
            now_ns,
            AuditEntry("server", "", SETUP_ACTION, "code", details={"made": True}),
        )
    path = folder / SETUP_FILE
    try:
        write_private(path, f"{code}\n")
    except OSError as error:
        raise AmberboxError(
            f"cannot write {path}: {error.strerror}", "name a folder that the server may write"
        ) from error
    return SetupCode(code, path, now_ns + SETUP_LASTS_NS, is_first)


def needs_setup(connection: Connection) -> bool:
    """Return whether the server has no admin yet."""
    return not has_admin(connection)


def code_waits(connection: Connection, now_ns: int) -> bool:
    """Return whether there is a setup code that has not expired."""
    held = (SETUP_CODES.c.created_ns <= now_ns, SETUP_CODES.c.expires_ns > now_ns)
    return connection.execute(select(SETUP_CODES.c.hash).where(*held)).first() is not None


def use_setup_code(
    database: ServerDatabase,
    clock: Clock,
    passwords: Passwords,
    folder: Path,
    code: str,
    name: str,
    password: str,
    caller: LoginOrigin,
) -> User:
    """Add an admin account with a setup code, which is valid once.

    An admin who was locked out uses a new code and a new name. Raises WrongCodeError,
    MustWaitError, and UsageError for a weak password or a name that is taken: then the code stays
    valid.
    """
    refuse_weak(password, name)
    _refuse_too_many(database, clock, "\0setup", caller)
    with database.reading() as connection:
        is_known = _code_holds(connection, clock.wall_ns(), code)
    if not is_known:
        entry = AuditEntry("user:?", caller.address, SETUP_ACTION, "code", "refused", _WRONG)
        with database.begin() as connection:
            append(connection, clock.wall_ns(), entry)
        raise WrongCodeError
    hash_ = passwords.hash(password)
    with database.begin() as connection:
        now_ns = clock.wall_ns()
        used = delete(SETUP_CODES).where(SETUP_CODES.c.hash == _hash(code))
        if not (_code_holds(connection, now_ns, code) and connection.execute(used).rowcount == 1):
            raise WrongCodeError
        user = _admin(connection, now_ns, name, hash_, caller, "code")
    (folder / SETUP_FILE).unlink(missing_ok=True)
    return user


def set_up_here(
    database: ServerDatabase,
    clock: Clock,
    passwords: Passwords,
    folder: Path,
    name: str,
    password: str,
    caller: LoginOrigin,
) -> User:
    """Add the first admin without a code, for a request from the server itself (loopback).

    Raises WrongCodeError when there is an admin already: further ones need a code.
    """
    refuse_weak(password, name)
    hash_ = passwords.hash(password)
    with database.begin() as connection:
        if not needs_setup(connection):
            raise WrongCodeError
        user = _admin(connection, clock.wall_ns(), name, hash_, caller, "loopback")
        forget_codes(connection)
    (folder / SETUP_FILE).unlink(missing_ok=True)
    return user


def forget_codes(connection: Connection) -> None:
    """Delete all setup codes."""
    connection.execute(delete(SETUP_CODES))


def _code_holds(connection: Connection, now_ns: int, code: str) -> bool:
    chosen = select(SETUP_CODES).where(SETUP_CODES.c.hash == _hash(code))
    row = connection.execute(chosen).mappings().one_or_none()
    return row is not None and row["created_ns"] <= now_ns < row["expires_ns"]


def _admin(
    connection: Connection, now_ns: int, name: str, hash_: str, caller: LoginOrigin, how: str
) -> User:
    user = add_user(connection, now_ns, name, Role.ADMIN, hash_)
    entry = AuditEntry(f"user:{name}", caller.address, SETUP_ACTION, name, details={"by": how})
    append(connection, now_ns, entry)
    return user


def _hash(code: str) -> str:
    """Hash a code as typed: any case, with or without hyphens, l and i read as 1, o as 0."""
    plain = re.sub(r"[\s-]", "", code).lower().translate(str.maketrans("lio", "110"))
    return digest(f"setup {plain}")


_DAY_NS = 24 * 3600 * NS
_KNOWN_NS = 60 * _DAY_NS


@dataclass(frozen=True, slots=True)
class AttemptLimit:
    """The number of wrong logins without a wait, and the longest wait (ns)."""

    free: int
    longest_ns: int

    def wait_ns(self, failures: int) -> int:
        """Return the wait (ns) after that many wrong logins: 1 s, 2 s, 4 s, ..."""
        if failures < self.free:
            return 0
        return min(NS << min(failures - self.free, 40), self.longest_ns)


LIMITS: Mapping[str, AttemptLimit] = {
    "pair": AttemptLimit(free=4, longest_ns=15 * 60 * NS),
    "address": AttemptLimit(free=20, longest_ns=15 * 60 * NS),
    "account": AttemptLimit(free=10, longest_ns=30 * NS),
}


@dataclass(frozen=True, slots=True)
class Wait:
    """The wait until the next try; ``first``: it is the first refusal in this wait."""

    wait_ns: int
    first: bool

    @property
    def seconds(self) -> int:
        """Return the wait in whole seconds, rounded up."""
        return -(-self.wait_ns // NS)


def address_key(address: str) -> str:
    """Return the text by which an address is counted: for IPv6 its /64 network."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address[:64]
    if isinstance(found, ipaddress.IPv6Address):
        if found.ipv4_mapped is not None:
            return str(found.ipv4_mapped)
        return str(ipaddress.ip_network((found, 64), strict=False))
    return str(found)


def begin_attempt(connection: Connection, now_ns: int, account: str, address: str) -> Wait | None:
    """Count an attempt as wrong before its password is checked, or return how long to wait.

    Simultaneous attempts therefore cannot bypass the limit. Call ``attempt_was_right`` after a
    right one. An attempt that has to wait is not counted.
    """
    keys = _keys(account, address)
    if _is_known(connection, now_ns, account, address):
        del keys["account"]
    waits = [_wait(connection, now_ns, kind, key) for kind, key in keys.items()]
    longest = max(waits, key=lambda wait: wait.wait_ns)
    if longest.wait_ns > 0:
        chosen = update(LOGIN_ATTEMPTS).where(LOGIN_ATTEMPTS.c.key.in_(keys.values()))
        connection.execute(chosen.values(refused=LOGIN_ATTEMPTS.c.refused + 1))
        return longest
    connection.execute(delete(LOGIN_ATTEMPTS).where(LOGIN_ATTEMPTS.c.last_ns <= now_ns - _DAY_NS))
    old = KNOWN_ADDRESSES.c.last_ns <= now_ns - _KNOWN_NS
    connection.execute(delete(KNOWN_ADDRESSES).where(old))
    for kind, key in _keys(account, address).items():
        _count_failure(connection, now_ns, kind, key)
    return None


def attempt_was_right(
    connection: Connection, now_ns: int, user_id: int, account: str, address: str
) -> None:
    """Remove the wrong attempts of this account at this address, and take one off the other counts.

    The counts of the address and of the account go down by one only: a person with an account
    cannot clear wrong attempts on other accounts.
    """
    keys = _keys(account, address)
    pair = LOGIN_ATTEMPTS.c.key == keys.pop("pair")
    connection.execute(delete(LOGIN_ATTEMPTS).where(pair))
    chosen = update(LOGIN_ATTEMPTS).where(LOGIN_ATTEMPTS.c.key.in_(keys.values()))
    # No wait is running, else the attempt would have been refused.
    connection.execute(chosen.values(failures=LOGIN_ATTEMPTS.c.failures - 1, until_ns=now_ns))
    known = upsert(connection.dialect, KNOWN_ADDRESSES, ("user_id", "address"), ("last_ns",))
    row = {"user_id": user_id, "address": address_key(address), "last_ns": now_ns}
    connection.execute(known, [row])


def _keys(account: str, address: str) -> dict[str, str]:
    """Return the keys of the three counts; hashed, so that no text of an attacker is stored."""
    where, who = address_key(address), account.casefold()
    texts = {"pair": f"pair\0{who}\0{where}", "address": f"at\0{where}", "account": f"of\0{who}"}
    return {kind: digest(text) for kind, text in texts.items()}


def _is_known(connection: Connection, now_ns: int, account: str, address: str) -> bool:
    joined = select(KNOWN_ADDRESSES.c.last_ns).join(USERS)
    chosen = joined.where(USERS.c.name == account.casefold())
    last_ns = connection.execute(
        chosen.where(KNOWN_ADDRESSES.c.address == address_key(address))
    ).scalar()
    return last_ns is not None and now_ns - last_ns < _KNOWN_NS


def _wait(connection: Connection, now_ns: int, kind: str, key: str) -> Wait:
    """Return the wait of one count; a clock that was set back cannot prolong it past its limit."""
    chosen = select(LOGIN_ATTEMPTS).where(LOGIN_ATTEMPTS.c.key == key)
    row = connection.execute(chosen).mappings().one_or_none()
    if row is None:
        return Wait(0, first=False)
    longest_ns = LIMITS[kind].wait_ns(row["failures"])
    return Wait(min(row["until_ns"] - now_ns, longest_ns), first=row["refused"] == 0)


def _count_failure(connection: Connection, now_ns: int, kind: str, key: str) -> None:
    chosen = select(LOGIN_ATTEMPTS.c.failures).where(LOGIN_ATTEMPTS.c.key == key)
    failures = (connection.execute(chosen).scalar() or 0) + 1
    row = {
        "kind": kind,
        "key": key,
        "failures": failures,
        "last_ns": now_ns,
        "until_ns": now_ns + LIMITS[kind].wait_ns(failures),
        "refused": 0,
    }
    change = ("failures", "last_ns", "until_ns", "refused")
    connection.execute(upsert(connection.dialect, LOGIN_ATTEMPTS, ("kind", "key"), change), [row])
