"""The code that makes somebody the first admin: 30 minutes, one use, only its hash is kept.

It lies in the server's folder, readable by the server's user only, and is said on stderr: who can
read one of these runs the server anyhow. A new one replaces the old one.
"""

from __future__ import annotations

import re
import secrets
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection, delete, insert, select

from amberbox.core.clock import NS, Clock
from amberbox.core.errors import AmberboxError
from amberbox.core.files import write_private
from amberbox.fleet.accounts.actions import Role
from amberbox.fleet.accounts.backoff import begin_attempt
from amberbox.fleet.accounts.keys import digest
from amberbox.fleet.accounts.passwords import Passwords, refuse_weak
from amberbox.fleet.accounts.signin import Caller, MustWaitError
from amberbox.fleet.accounts.tables import SETUP_CODES
from amberbox.fleet.accounts.users import User, add_user, has_admin
from amberbox.fleet.audit.entry import Entry
from amberbox.fleet.audit.log import append
from amberbox.fleet.database.database import Database

FILE = "setup-code"
LASTS_NS = 30 * 60 * NS
ACTION = "setup"
_LETTERS = "0123456789abcdefghjkmnpqrstvwxyz"
_GROUPS, _EACH = 5, 4


class WrongCodeError(AmberboxError):
    """The code is wrong, used, or over: it is never said which."""

    def __init__(self) -> None:
        super().__init__(
            "this code does not hold (any more)", "make a new one: amberbox serve --new-code"
        )


@dataclass(frozen=True, slots=True)
class SetupCode:
    """A new code and where it lies."""

    code: str
    path: Path
    expires_ns: int
    is_first: bool = True
    """Whether there is no admin yet."""

    def __repr__(self) -> str:
        return f"SetupCode({self.path})"

    def text(self, url: str, *, by_proxy: bool = False) -> str:
        """Return what is said on stderr; the first admin needs no code on the machine itself."""
        enter = " and enter this code:"
        if self.is_first and not by_proxy:
            enter = ".\nOn this machine no code is asked for; from elsewhere it takes this one:"
        return (
            f"To become an admin of this server, open {url}{enter}\n\n"
            f"    {self.code}\n\n"
            f"It holds for {LASTS_NS // (60 * NS)} minutes and once. It is also in {self.path}.\n"
        )


def new_setup_code(database: Database, clock: Clock, folder: Path) -> SetupCode:
    """Make a code, write it to the server's folder, and let older ones hold no more.

    Raises AmberboxError when it cannot be written.
    """
    code = "-".join("".join(map(secrets.choice, [_LETTERS] * _EACH)) for _ in range(_GROUPS))
    now_ns = clock.wall_ns()
    with database.begin() as connection:
        is_first = needs_setup(connection)
        connection.execute(delete(SETUP_CODES))
        row = {"hash": _hash(code), "created_ns": now_ns, "expires_ns": now_ns + LASTS_NS}
        connection.execute(insert(SETUP_CODES), [row])
        append(connection, now_ns, Entry("server", "", ACTION, "code", details={"made": True}))
    _write(folder / FILE, code)
    return SetupCode(code, folder / FILE, now_ns + LASTS_NS, is_first)


def needs_setup(connection: Connection) -> bool:
    """Tell whether the server waits for its first admin."""
    return not has_admin(connection)


def code_waits(connection: Connection, now_ns: int) -> bool:
    """Tell whether a code was made that nobody has used, and that still holds."""
    held = (SETUP_CODES.c.created_ns <= now_ns, SETUP_CODES.c.expires_ns > now_ns)
    return connection.execute(select(SETUP_CODES.c.hash).where(*held)).first() is not None


def use_setup_code(
    database: Database,
    clock: Clock,
    passwords: Passwords,
    folder: Path,
    code: str,
    name: str,
    password: str,
    caller: Caller,
) -> User:
    """Make an admin with a code; the code is gone then, whoever was first.

    An admin who was locked out gets in the same way, with a new code, under a new name. Raises
    WrongCodeError, MustWaitError, and UsageError for a weak password or a name that is taken: then
    the code still holds.
    """
    refuse_weak(password, name)
    _refuse_too_many(database, clock, caller)
    with database.reading() as connection:
        is_known = _held(connection, clock.wall_ns(), code)
    if not is_known:
        _note_wrong(database, clock, caller)
        raise WrongCodeError
    hash_ = passwords.hash(password)
    with database.begin() as connection:
        now_ns = clock.wall_ns()
        if not _take(connection, now_ns, code):
            raise WrongCodeError
        user = _admin(connection, now_ns, name, hash_, caller, "code")
    (folder / FILE).unlink(missing_ok=True)
    return user


def set_up_here(
    database: Database,
    clock: Clock,
    passwords: Passwords,
    folder: Path,
    name: str,
    password: str,
    caller: Caller,
) -> User:
    """Make the first admin without a code, for somebody on the server itself (loopback).

    Raises WrongCodeError when there is an admin already: from then on only a code will do.
    """
    refuse_weak(password, name)
    hash_ = passwords.hash(password)
    with database.begin() as connection:
        if not needs_setup(connection):
            raise WrongCodeError
        user = _admin(connection, clock.wall_ns(), name, hash_, caller, "loopback")
        forget_codes(connection)
    (folder / FILE).unlink(missing_ok=True)
    return user


def forget_codes(connection: Connection) -> None:
    """Let no code hold any more: the first admin is there."""
    connection.execute(delete(SETUP_CODES))


def _refuse_too_many(database: Database, clock: Clock, caller: Caller) -> None:
    with database.begin() as connection:
        wait = begin_attempt(connection, clock.wall_ns(), "\0setup", caller.address)
    if wait is not None:
        raise MustWaitError(wait)


def _take(connection: Connection, now_ns: int, code: str) -> bool:
    """Use up the code; False if there is none such that holds now."""
    used = delete(SETUP_CODES).where(SETUP_CODES.c.hash == _hash(code))
    return _held(connection, now_ns, code) and connection.execute(used).rowcount == 1


def _held(connection: Connection, now_ns: int, code: str) -> bool:
    chosen = select(SETUP_CODES).where(SETUP_CODES.c.hash == _hash(code))
    row = connection.execute(chosen).mappings().one_or_none()
    return row is not None and row["created_ns"] <= now_ns < row["expires_ns"]


def _note_wrong(database: Database, clock: Clock, caller: Caller) -> None:
    entry = Entry("user:?", caller.address, ACTION, "code", "refused", {"why": "wrong code"})
    with database.begin() as connection:
        append(connection, clock.wall_ns(), entry)


def _admin(
    connection: Connection, now_ns: int, name: str, hash_: str, caller: Caller, how: str
) -> User:
    user = add_user(connection, now_ns, name, Role.ADMIN, hash_)
    entry = Entry(f"user:{name}", caller.address, ACTION, name, details={"by": how})
    append(connection, now_ns, entry)
    return user


def _hash(code: str) -> str:
    """Hash what was typed: any case, with or without hyphens, the letters l, i, o for digits."""
    plain = re.sub(r"[\s-]", "", code).lower().translate(str.maketrans("lio", "110"))
    return digest(f"setup {plain}")


def _write(path: Path, code: str) -> None:
    try:
        write_private(path, f"{code}\n")
    except OSError as error:
        raise AmberboxError(
            f"cannot write {path}: {error.strerror}", "name a folder that the server may write"
        ) from error
