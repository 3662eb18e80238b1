"""``amberbox serve add-user``: an account without a browser; before the first start, too."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from amberbox.cli._output import secret
from amberbox.cli._serve_beside import who
from amberbox.core.clock import SystemClock
from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError


def add_user(
    folder: Path, name: str, role: str | None, groups: Sequence[str] | None, *, one_time: bool
) -> int:
    """Add an account; the first one is the admin that the server waits for.

    The password is asked for, read from standard input, or made (``one_time``): then it is printed,
    and has to be changed at the first login. It is never an argument, which others could see.
    """
    from amberbox.fleet.accounts import setupcode
    from amberbox.fleet.accounts.actions import Role
    from amberbox.fleet.accounts.onetime import one_time_password
    from amberbox.fleet.accounts.passwords import Passwords, refuse_weak
    from amberbox.fleet.accounts.users import add_user as add
    from amberbox.fleet.audit.entry import Entry
    from amberbox.fleet.audit.log import append
    from amberbox.fleet.database.database import FILE, Database
    from amberbox.fleet.serving.starting import make_folder

    if role is not None and role not in list(Role):
        raise UsageError(f"there is no role '{role}'{did_you_mean(role, list(Role))}",
                         f"roles are {', '.join(Role)}")  # fmt: skip
    password = one_time_password() if one_time else _asked(name)
    refuse_weak(password, name)
    hashes = Passwords()
    try:
        hashed = hashes.hash(password)
    finally:
        hashes.close()
    make_folder(folder)
    database = Database(folder / FILE)
    try:
        with database.begin() as connection:
            now_ns = SystemClock().wall_ns()
            waits = setupcode.needs_setup(connection)
            given = Role(role) if role else Role.ADMIN if waits and groups is None else Role.VIEWER
            add(connection, now_ns, name, given, hashed, groups=groups, must_change=one_time)
            details = {"role": given, "groups": groups, "by": "shell"}
            append(connection, now_ns, Entry(who(), "", "users.add", name, details=details))
            waits_still = setupcode.needs_setup(connection)
            if waits and not waits_still:
                setupcode.forget_codes(connection)
    finally:
        database.close()
    if waits and not waits_still:
        (folder / setupcode.FILE).unlink(missing_ok=True)
    print(f"{name} is {'an' if given[0] in 'ao' else 'a'} {given} now")
    if one_time:
        print(f"one-time password: {password}")
    if waits_still:
        print("the server still waits for its first admin\n"
              f"hint: amberbox serve add-user NAME --role admin --data {folder}",
              file=sys.stderr)  # fmt: skip
    return 0


def _asked(name: str) -> str:
    """Ask for a password, twice where somebody types it."""
    password = secret(f"password for {name}: ")
    if not password:
        raise UsageError("no password was given", "type it, pipe a line with it, or --one-time")
    if sys.stdin.isatty() and secret("again: ") != password:
        raise UsageError("these are two different passwords", "type the same one twice")
    return password
