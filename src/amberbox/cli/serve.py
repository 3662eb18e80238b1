"""Run the fleet's server: robots send it what they recorded, people see all of it."""

from __future__ import annotations

import argparse
import gc
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.core.errors import UsageError

if TYPE_CHECKING:
    from amberbox.fleet.serving.starting import Start

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
    """Serve until SIGTERM or Ctrl-C, or do what stands beside serving."""
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
    gc.disable()  # until it answers: nothing that is loaded now goes away again
    from amberbox.cli._output import warn_readable
    from amberbox.fleet.serving.binding import Wanted
    from amberbox.fleet.serving.starting import run as start

    host = args.host[0] if args.host else "127.0.0.1"
    wanted = Wanted(host, args.port, args.public_url, tuple(args.behind_proxy))
    warn_readable(Path(args.data))
    told = _told(Path(args.data), quiet=args.quiet)
    start(Path(args.data).resolve(), wanted, new_code=args.new_code, begun=told)
    return 0


def _told(folder: Path, *, quiet: bool) -> Callable[[Start], None]:
    """Make what says that the server answers."""

    def tell(start: Start) -> None:
        url = start.settings.public_url
        if not quiet:
            if start.renewed:
                print("the server's certificate was made anew, for a year", flush=True)
            print(f"serving {folder} at {url}; Ctrl-C ends it", flush=True)
        if start.code is not None:
            text = start.code.text(f"{url}/setup", by_proxy=bool(start.settings.proxies))
            print(text, file=sys.stderr, flush=True)

    return tell


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
    from amberbox.cli._serve_beside import make_certificate

    return make_certificate(Path(args.data), args.host or [])


def _add_robot(args: argparse.Namespace) -> int:
    from amberbox.cli._serve_beside import add_robot

    if len(args.words) != 2:
        raise UsageError("add-robot takes one ID", "amberbox serve add-robot ID --data DIR")
    file = None if args.line_file is None else Path(args.line_file)
    return add_robot(Path(args.data), args.words[1], args.group, file)


def _add_user(args: argparse.Namespace) -> int:
    from amberbox.cli._serve_users import add_user

    if len(args.words) != 2:
        raise UsageError("add-user takes one NAME", "amberbox serve add-user NAME --data DIR")
    groups = args.group or None
    return add_user(Path(args.data), args.words[1], args.role, groups, one_time=args.one_time)


def _signing_key(args: argparse.Namespace) -> int:
    from amberbox.cli._serve_beside import decide_signing_key, list_signing_keys

    words = args.words[1:]
    if not words:
        return list_signing_keys(Path(args.data))
    if len(words) != 2 or words[1] not in ("confirm", "refuse"):
        raise UsageError("signing-key takes ID and confirm or refuse, or nothing", _USAGE)
    return decide_signing_key(Path(args.data), words[0], confirm=words[1] == "confirm")


def _clock(args: argparse.Namespace) -> int:
    from amberbox.cli._serve_beside import judge_clock

    return judge_clock(Path(args.data), confirm=args.confirm)


def _verify_audit(args: argparse.Namespace) -> int:
    from amberbox.cli._serve_beside import verify_audit

    return verify_audit(Path(args.data), args.head)


_BESIDE: Mapping[str, Callable[[argparse.Namespace], int]] = {
    "cert": _cert,
    "add-robot": _add_robot,
    "add-user": _add_user,
    "signing-key": _signing_key,
    "clock": _clock,
    "verify-audit": _verify_audit,
}
