"""The fleet's server: run it, and administer it from its computer.

Users, robots, certificates, keys and the audit log can be seen to before the first start and while
the server runs.
"""

from __future__ import annotations

import argparse
import gc
import getpass
import os
import stat
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.cli._output import secret, warn_readable
from amberbox.core.clock import SystemClock
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.files import write_private

if TYPE_CHECKING:
    from amberbox.server.start import StartedServer

_PORT = 8443
_USAGE = """amberbox serve --data DIR [options]
       amberbox serve cert --data DIR --host NAME...
       amberbox serve add-robot ID --data DIR [--group GROUP]... [--line-file FILE]
       amberbox serve add-user NAME --data DIR [--role ROLE] [--group GROUP]... [--one-time]
       amberbox serve signing-key [ID confirm|refuse] --data DIR
       amberbox serve clock --data DIR [--confirm]
       amberbox serve verify-audit --data DIR [--head "NUMBER HASH"]..."""
_EXIT = "exit status: 0 after an orderly end, 1 it cannot go on, 2 wrong usage"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.usage = _USAGE
    parser.epilog = _EXIT
    words = "cert | add-robot ID | add-user NAME | signing-key | clock | verify-audit"
    parser.add_argument("words", nargs="*", metavar=words,
                        help="make a certificate, add a robot or a person, decide on a robot's new "
                        "signing key, judge the clock, verify the audit log")  # fmt: skip
    parser.add_argument("--data", required=True, metavar="DIR", help="the server's data folder")
    parser.add_argument("--host", action="append", metavar="NAME",
                        help="address to listen at (127.0.0.1); cert: what the server is called, "
                        "may be said several times")  # fmt: skip
    parser.add_argument("--port", type=int, default=_PORT, help=f"port to listen at ({_PORT})")
    parser.add_argument("--public-url", default="", metavar="URL",
                        help="what robots and browsers call the server")  # fmt: skip
    parser.add_argument("--behind-proxy", nargs="+", default=[], metavar="ADDR",
                        help="proxies that speak TLS for it; it believes them")  # fmt: skip
    parser.add_argument("--new-code", action="store_true",
                        help="make a code that lets somebody become an admin")  # fmt: skip
    parser.add_argument("--group", action="append", default=[], metavar="GROUP",
                        help="add-robot: a group that the robot is in; add-user: the person sees "
                        "only robots of it")  # fmt: skip
    parser.add_argument("--line-file", metavar="FILE",
                        help="add-robot: write the line into a new file with mode 0600, "
                        "instead of printing it")  # fmt: skip
    parser.add_argument("--role", metavar="ROLE",
                        help="add-user: viewer, operator, technician or admin (the first person "
                        "is an admin, others are viewers)")  # fmt: skip
    parser.add_argument("--one-time", action="store_true",
                        help="add-user: print a password that has to be changed at the first "
                        "login, instead of asking for one")  # fmt: skip
    parser.add_argument("--confirm", action="store_true",
                        help="clock: it is right, recordings may grow old by it")  # fmt: skip
    parser.add_argument("--head", action="append", default=[], metavar="HEAD",
                        help="verify-audit: a head that was noted elsewhere")  # fmt: skip
    parser.add_argument("--quiet", action="store_true", help="print troubles only")


def run(args: argparse.Namespace) -> int:
    """Serve until SIGTERM or Ctrl-C, or run an administrative action."""
    if not args.words:
        return _serve(args)
    do = _BESIDE.get(args.words[0])
    if do is None:
        raise UsageError(
            f"serve knows no '{args.words[0]}'", f"it knows {', '.join(_BESIDE)}, and none of these"
        )
    return do(args)


def _serve(args: argparse.Namespace) -> int:
    if args.group or args.line_file or args.head or args.confirm or args.role or args.one_time:
        what = (
            "--group and --line-file are for add-robot, --role and --one-time for add-user, "
            "--head for verify-audit, --confirm for clock"
        )
        raise UsageError(what, _USAGE)
    if args.host is not None and len(args.host) > 1:
        raise UsageError("a server listens at one address", "--host 0.0.0.0 for all of them")
    check_installed()
    gc.disable()  # until the server answers: objects loaded now are permanent
    from amberbox.server.config import ListenOptions
    from amberbox.server.start import run as start

    host = args.host[0] if args.host else "127.0.0.1"
    wanted = ListenOptions(host, args.port, args.public_url, tuple(args.behind_proxy))
    warn_readable(Path(args.data))
    report = started_reporter(Path(args.data), quiet=args.quiet)
    start(Path(args.data).resolve(), wanted, new_code=args.new_code, begun=report)
    return 0


def started_reporter(folder: Path, *, quiet: bool) -> Callable[[StartedServer], None]:
    """Return a function that prints that the server answers."""

    def report(start: StartedServer) -> None:
        url = start.settings.public_url
        if not quiet:
            if start.renewed:
                print("the server's certificate was made anew, for a year", flush=True)
            print(f"serving {folder} at {url}; Ctrl-C ends it", flush=True)
        if start.code is not None:
            text = start.code.text(f"{url}/setup", by_proxy=bool(start.settings.proxies))
            print(text, file=sys.stderr, flush=True)

    return report


def check_installed() -> None:
    """Raise UsageError where a package is missing that a server needs."""
    from importlib.util import find_spec

    needed = (
        *("fastapi", "uvicorn", "sqlalchemy", "deltalake", "argon2"),
        *("cryptography", "zxcvbn"),
    )
    missing = [name for name in needed if find_spec(name) is None]
    if missing:
        raise UsageError(
            f"a server needs {', '.join(missing)}", "pip install 'amberbox[server,keep,query]'"
        )


def _cert(args: argparse.Namespace) -> int:
    return _make_certificate(Path(args.data), args.host or [])


def _add_robot(args: argparse.Namespace) -> int:
    if len(args.words) != 2:
        raise UsageError("add-robot takes one ID", "amberbox serve add-robot ID --data DIR")
    file = None if args.line_file is None else Path(args.line_file)
    return _enrol_robot(Path(args.data), args.words[1], args.group, file)


def _add_user(args: argparse.Namespace) -> int:
    if len(args.words) != 2:
        raise UsageError("add-user takes one NAME", "amberbox serve add-user NAME --data DIR")
    groups = args.group or None
    return _make_account(Path(args.data), args.words[1], args.role, groups, one_time=args.one_time)


def _signing_key(args: argparse.Namespace) -> int:
    words = args.words[1:]
    if not words:
        return _list_signing_keys(Path(args.data))
    if len(words) != 2 or words[1] not in ("confirm", "refuse"):
        raise UsageError("signing-key takes ID and confirm or refuse, or nothing", _USAGE)
    return _decide_signing_key(Path(args.data), words[0], confirm=words[1] == "confirm")


def _clock(args: argparse.Namespace) -> int:
    return _check_clock(Path(args.data), confirm=args.confirm)


def _verify_audit(args: argparse.Namespace) -> int:
    return _check_audit_log(Path(args.data), args.head)


_BESIDE: Mapping[str, Callable[[argparse.Namespace], int]] = {
    "cert": _cert,
    "add-robot": _add_robot,
    "add-user": _add_user,
    "signing-key": _signing_key,
    "clock": _clock,
    "verify-audit": _verify_audit,
}


def _make_certificate(folder: Path, names: Sequence[str]) -> int:
    """Create the server's certificate, and the authority if missing; print its fingerprint."""
    from amberbox.server import certificates
    from amberbox.server.certificates import fingerprint
    from amberbox.server.start import make_folder

    certificates.checked_names(names)
    make_folder(folder)
    files = certificates.CertificateFiles(folder)
    is_new = not files.authority.exists()
    made = certificates.make(folder, names, SystemClock().wall_ns())
    print(f"certificate for {', '.join(made)}: {files.server}")
    print(f"authority ({'new' if is_new else 'as before'}): {files.authority}")
    print(f"fingerprint: sha256:{fingerprint(folder)}")
    print("a server that runs takes it at its next start; browsers trust it once they have "
          f"{files.authority.name} among their authorities")  # fmt: skip
    return 0


def _enrol_robot(folder: Path, robot: str, groups: Sequence[str], line_file: Path | None) -> int:
    """Register a robot, and new groups; print its join line.

    With ``line_file`` the line is written there instead, readable for this user only.
    """
    if line_file is not None and line_file.exists():
        raise UsageError(f"{line_file} is there already", "name a new file")
    from amberbox.server.accounts import robots
    from amberbox.server.accounts.robots import add_group, list_groups
    from amberbox.server.audit import AuditEntry, append
    from amberbox.server.database import ServerDatabase
    from amberbox.server.start import robot_join_line

    database = ServerDatabase(_database_file(folder))
    try:
        with database.begin() as connection:
            now_ns = SystemClock().wall_ns()
            new = sorted(set(groups) - set(list_groups(connection)))
            for group in new:
                add_group(connection, now_ns, group)
            secret = robots.add_robot(connection, now_ns, robot, groups)
            line = robot_join_line(connection, folder, robot, secret.text)
            details = {"groups": sorted(groups), "new_groups": new, "key_id": secret.id}
            entry = AuditEntry(_operator(), "", "robots.add", robot, details=details)
            append(connection, now_ns, entry)
            if line_file is not None:  # before the robot is added permanently
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
    """Warn if stdout is a file that other users can read."""
    try:
        out = os.fstat(sys.stdout.fileno())
    except (OSError, ValueError):  # not a file
        return
    if stat.S_ISREG(out.st_mode) and out.st_mode & 0o077:
        print("warning: the line holds the robot's key, and others can read this file\n"
              "hint: chmod 600 it now; next time: --line-file FILE", file=sys.stderr)  # fmt: skip


def _list_signing_keys(folder: Path) -> int:
    """Print robots' new signing keys that wait for an admin; return 1 if there are any."""
    from amberbox.core.timestamps import format_time
    from amberbox.server.database import ServerDatabase
    from amberbox.server.ingest.link_state import pending_keys

    database = ServerDatabase(_database_file(folder))
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


def _decide_signing_key(folder: Path, robot: str, *, confirm: bool) -> int:
    """Confirm or refuse a robot's new signing key."""
    from amberbox.server.audit import AuditEntry, append
    from amberbox.server.database import ServerDatabase
    from amberbox.server.ingest.link_state import decide, pending_keys

    word = "confirm" if confirm else "refuse"
    database = ServerDatabase(_database_file(folder))
    try:
        with database.begin() as connection:
            now_ns = SystemClock().wall_ns()
            keys = list(dict.fromkeys(k.public_key for k in pending_keys(connection, robot)))
            if len(keys) != 1:
                what = f"{len(keys) or 'no'} keys of {robot} wait for a decision"
                raise UsageError(what, "amberbox serve signing-key shows all; or at /admin/robots")
            journals = decide(connection, now_ns, robot, keys[0], confirm=confirm)
            details = {"public_key": keys[0], "journals": journals}
            entry = AuditEntry(
                _operator(), "", f"robots.signing_key.{word}", robot, details=details
            )
            append(connection, now_ns, entry)
    finally:
        database.close()
    took = "; a server that runs takes them over with the next that comes" if confirm else ""
    print(f"{'confirmed' if confirm else 'refused'}: {keys[0]}, {journals} journals waited{took}")
    return 0


def _check_clock(folder: Path, *, confirm: bool) -> int:
    """Print whether the machine's clock agrees with confirmed time; return 1 during a jump."""
    from amberbox.core.clock import NS
    from amberbox.server.archive.retention import RetentionClock
    from amberbox.server.audit import AuditEntry, append
    from amberbox.server.database import ServerDatabase

    database = ServerDatabase(_database_file(folder))
    ages = RetentionClock(database, SystemClock())
    try:
        found = ages.read()
        if found.jump and confirm:
            with database.begin() as connection:
                held = ages.confirm(connection, _operator())
                details = {"jump": held.jump, "by_s": round(held.ahead_ns / NS)}
                append(
                    connection,
                    held.wall_ns,
                    AuditEntry(_operator(), "", "clock.confirm", "", "ok", details),
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


def _check_audit_log(folder: Path, heads: Sequence[str]) -> int:
    """Verify the audit log from its first row to its last; return 1 when it is invalid."""
    from amberbox.server.audit import AuditChainHead, verify
    from amberbox.server.database import ServerDatabase

    kept = [AuditChainHead.from_text(text) for text in heads]
    database = ServerDatabase(_database_file(folder), read_only=True)
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


def _operator() -> str:
    """Return the operating system's user as the actor of the audit log."""
    try:
        return f"shell:{getpass.getuser()}"
    except (OSError, KeyError):  # a user without a name
        return f"shell:{os.getuid()}"


def _database_file(folder: Path) -> Path:
    from amberbox.server.database import FILE

    path = folder / FILE
    if not path.is_file():
        raise UsageError(
            f"{folder} is no data folder of a server", f"amberbox serve --data {folder} makes one"
        )
    return path


def _make_account(
    folder: Path, name: str, role: str | None, groups: Sequence[str] | None, *, one_time: bool
) -> int:
    """Add an account; the first one is the admin that the server waits for.

    The password is prompted for, read from standard input, or generated (``one_time``): then it is
    printed, and has to be changed at the first login. It is never an argument, which other users
    could see.
    """
    from amberbox.server.accounts import signin
    from amberbox.server.accounts.passwords import Passwords, one_time_password, refuse_weak
    from amberbox.server.accounts.permissions import Role
    from amberbox.server.accounts.users import add_user as add
    from amberbox.server.audit import AuditEntry, append
    from amberbox.server.database import FILE, ServerDatabase
    from amberbox.server.start import make_folder

    if role is not None and role not in list(Role):
        raise UsageError(f"there is no role '{role}'{did_you_mean(role, list(Role))}",
                         f"roles are {', '.join(Role)}")  # fmt: skip
    password = one_time_password() if one_time else _ask_password(name)
    refuse_weak(password, name)
    hashes = Passwords()
    try:
        hashed = hashes.hash(password)
    finally:
        hashes.close()
    make_folder(folder)
    database = ServerDatabase(folder / FILE)
    try:
        with database.begin() as connection:
            now_ns = SystemClock().wall_ns()
            waits = signin.needs_setup(connection)
            given = Role(role) if role else Role.ADMIN if waits and groups is None else Role.VIEWER
            add(connection, now_ns, name, given, hashed, groups=groups, must_change=one_time)
            details = {"role": given, "groups": groups, "by": "shell"}
            append(
                connection, now_ns, AuditEntry(_operator(), "", "users.add", name, details=details)
            )
            waits_still = signin.needs_setup(connection)
            if waits and not waits_still:
                signin.forget_codes(connection)
    finally:
        database.close()
    if waits and not waits_still:
        (folder / signin.SETUP_FILE).unlink(missing_ok=True)
    print(f"{name} is {'an' if given[0] in 'ao' else 'a'} {given} now")
    if one_time:
        print(f"one-time password: {password}")
    if waits_still:
        print("the server still waits for its first admin\n"
              f"hint: amberbox serve add-user NAME --role admin --data {folder}",
              file=sys.stderr)  # fmt: skip
    return 0


def _ask_password(name: str) -> str:
    """Ask for a password; in a terminal, twice."""
    password = secret(f"password for {name}: ")
    if not password:
        raise UsageError("no password was given", "type it, pipe a line with it, or --one-time")
    if sys.stdin.isatty() and secret("again: ") != password:
        raise UsageError("these are two different passwords", "type the same one twice")
    return password
