"""What stands beside serving: certificates, robots, the audit log; also while the server runs."""

from __future__ import annotations

import getpass
import os
import stat
import sys
from collections.abc import Sequence
from pathlib import Path

from amberbox.core.clock import SystemClock
from amberbox.core.errors import UsageError
from amberbox.core.files import write_private


def make_certificate(folder: Path, names: Sequence[str]) -> int:
    """Make the server's certificate, and the authority if there is none; print its fingerprint."""
    from amberbox.fleet.accounts.authority import fingerprint
    from amberbox.fleet.serving import certificates
    from amberbox.fleet.serving.starting import make_folder

    certificates.checked_names(names)
    make_folder(folder)
    files = certificates.Files(folder)
    is_new = not files.authority.exists()
    made = certificates.make(folder, names, SystemClock().wall_ns())
    print(f"certificate for {', '.join(made)}: {files.server}")
    print(f"authority ({'new' if is_new else 'as before'}): {files.authority}")
    print(f"fingerprint: sha256:{fingerprint(folder)}")
    print("a server that runs takes it at its next start; browsers trust it once they have "
          f"{files.authority.name} among their authorities")  # fmt: skip
    return 0


def add_robot(folder: Path, robot: str, groups: Sequence[str], line_file: Path | None) -> int:
    """Make a robot known, and groups that are new; print the one line that is pasted on it.

    With ``line_file`` the line is written there instead, readable for this user only.
    """
    if line_file is not None and line_file.exists():
        raise UsageError(f"{line_file} is there already", "name a new file")
    from amberbox.fleet.accounts import robotkeys
    from amberbox.fleet.accounts.groups import add_group, list_groups
    from amberbox.fleet.audit.entry import Entry
    from amberbox.fleet.audit.log import append
    from amberbox.fleet.database.database import Database
    from amberbox.fleet.serving.reached import line_of

    database = Database(_database(folder))
    try:
        with database.begin() as connection:
            now_ns = SystemClock().wall_ns()
            new = sorted(set(groups) - set(list_groups(connection)))
            for group in new:
                add_group(connection, now_ns, group)
            secret = robotkeys.add_robot(connection, now_ns, robot, groups)
            line = line_of(connection, folder, robot, secret.text)
            details = {"groups": sorted(groups), "new_groups": new, "key_id": secret.id}
            entry = Entry(who(), "", "robots.add", robot, details=details)
            append(connection, now_ns, entry)
            if line_file is not None:  # before the robot is added for good
                write_private(line_file, f"{line}\n")
    finally:
        database.close()
    if line_file is None:
        print(str(line))
        _warn_readable()
    else:
        print(f"the line for {robot} is in {line_file}: it holds the robot's key; delete the file "
              "once the robot has joined")  # fmt: skip
    return 0


def _warn_readable() -> None:
    """Warn where what is printed lands in a file that others can read."""
    try:
        out = os.fstat(sys.stdout.fileno())
    except (OSError, ValueError):  # it is no file at all
        return
    if stat.S_ISREG(out.st_mode) and out.st_mode & 0o077:
        print("warning: the line holds the robot's key, and others can read this file\n"
              "hint: chmod 600 it now; next time: --line-file FILE", file=sys.stderr)  # fmt: skip


def list_signing_keys(folder: Path) -> int:
    """Print the keys that robots sign with since and that wait for an admin; 1 if there are any."""
    from amberbox.core.timetext import format_time
    from amberbox.fleet.database.database import Database
    from amberbox.fleet.linkend.signingkeys import pending_keys

    database = Database(_database(folder))
    try:
        with database.reading() as connection:
            found = pending_keys(connection)
    finally:
        database.close()
    for key in found:
        print(f"{key.robot}: signs with {key.public_key} since {format_time(key.first_seen_ns)}")
        print(f"hint: amberbox serve signing-key {key.robot} confirm --data {folder}, or refuse")
    if not found:
        print("no robot signs with another key than before")
    return 1 if found else 0


def decide_signing_key(folder: Path, robot: str, *, confirm: bool) -> int:
    """Confirm or refuse the key that a robot signs with since."""
    from amberbox.fleet.audit.entry import Entry
    from amberbox.fleet.audit.log import append
    from amberbox.fleet.database.database import Database
    from amberbox.fleet.linkend.signingkeys import decide, pending_keys

    word = "confirm" if confirm else "refuse"
    database = Database(_database(folder))
    try:
        with database.begin() as connection:
            now_ns = SystemClock().wall_ns()
            keys = list(dict.fromkeys(k.public_key for k in pending_keys(connection, robot)))
            if len(keys) != 1:
                what = f"{len(keys) or 'no'} keys of {robot} wait for a decision"
                raise UsageError(what, "amberbox serve signing-key shows all; or at /admin/robots")
            journals = decide(connection, now_ns, robot, keys[0], confirm=confirm)
            details = {"public_key": keys[0], "journals": journals}
            entry = Entry(who(), "", f"robots.signing_key.{word}", robot, details=details)
            append(connection, now_ns, entry)
    finally:
        database.close()
    took = "; a server that runs takes them over with the next that comes" if confirm else ""
    print(f"{'confirmed' if confirm else 'refused'}: {keys[0]}, {journals} journals waited{took}")
    return 0


def judge_clock(folder: Path, *, confirm: bool) -> int:
    """Print whether the machine's clock agrees with confirmed time; 1 while a jump is held."""
    from amberbox.core.clock import NS
    from amberbox.fleet.archive.ageclock import AgeClock
    from amberbox.fleet.audit.entry import Entry
    from amberbox.fleet.audit.log import append
    from amberbox.fleet.database.database import Database

    database = Database(_database(folder))
    ages = AgeClock(database, SystemClock())
    try:
        found = ages.read()
        if found.jump and confirm:
            with database.begin() as connection:
                held = ages.confirm(connection, who())
                details = {"jump": held.jump, "by_s": round(held.ahead_ns / NS)}
                append(
                    connection, held.wall_ns, Entry(who(), "", "clock.confirm", "", "ok", details)
                )
    finally:
        database.close()
    if not found.jump:
        print("the server's clock agrees with the confirmed time: nothing is held")
        return 0
    print("confirmed: recordings grow old by the server's clock again" if confirm else found.text)
    if not confirm:
        print(f"hint: if it is right: amberbox serve clock --data {folder} --confirm")
    return 0 if confirm else 1


def verify_audit(folder: Path, heads: Sequence[str]) -> int:
    """Follow the audit log from its first row to its last; 1 when it does not hold."""
    from amberbox.fleet.audit.log import Head
    from amberbox.fleet.audit.verify import verify
    from amberbox.fleet.database.database import Database

    kept = [Head.from_text(text) for text in heads]
    database = Database(_database(folder), read_only=True)
    try:
        with database.reading() as connection:
            found = verify(connection, kept)
    finally:
        database.close()
    if found.broken is not None:
        print(f"the audit log does not hold: row {found.broken.seq} is {found.broken.what}")
        return 1
    print(f"{found.rows} rows hold; head to note elsewhere: {found.head}")
    return 0


def who() -> str:
    """Name who types, for the audit log."""
    try:
        return f"shell:{getpass.getuser()}"
    except (OSError, KeyError):  # a user without a name
        return f"shell:{os.getuid()}"


def _database(folder: Path) -> Path:
    from amberbox.fleet.database.database import FILE

    path = folder / FILE
    if not path.is_file():
        raise UsageError(
            f"{folder} is no data folder of a server", f"amberbox serve --data {folder} makes one"
        )
    return path
