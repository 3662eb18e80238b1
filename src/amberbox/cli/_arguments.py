"""Arguments that verbs share: WHERE (a folder or a server's address), time ranges, word order.

``VERB ACTION WHERE``, options anywhere between them; ``VERB WHERE ACTION`` is understood as well:
some verbs were written that way before. The client is imported only for an address of a server.
"""

from __future__ import annotations

import argparse
import math
import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.cli._output import print_notes
from amberbox.client.address import is_url, with_robot
from amberbox.core.contracts import Budget
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.timestamps import ordered_span, parse_time
from amberbox.server.archive.location import archive_in

if TYPE_CHECKING:
    from amberbox.blackbox.query.record import Record
    from amberbox.blackbox.retention.missions import RecordedMission
    from amberbox.client.fleet import Fleet
    from amberbox.client.remote import RemoteRecord


PAGE = "a robot's page on a server (https://fleet.example:8443/robots/ropod_001)"

Window = tuple[int | None, int | None]


def accept_any_order(parser: argparse.ArgumentParser) -> None:
    """Accept options between words: ``--json ack ID`` as well as ``ack ID --json``.

    By default argparse accepts optional words only next to the first ones.
    """
    vars(parser)["parse_args"] = parser.parse_intermixed_args


def add_actions(
    parser: argparse.ArgumentParser,
    actions: Mapping[str, Sequence[str]],
    default: str,
    place: str,
    *,
    where_first: bool = False,
) -> None:
    """Add the words ACTION WHERE ...; they are parsed into ``action``, ``where`` and ``rest``.

    ``actions`` names the words of each action after WHERE, ``place`` is the help of WHERE. A single
    word is WHERE, for the action ``default``. With ``where_first`` an ambiguous command line is
    read as WHERE ACTION, which was the only order of such a verb before.
    """
    listed = ", ".join(actions)
    parser.add_argument("words", nargs="+", metavar="ACTION WHERE", help=f"one of {listed} "
                        f"(without: {default}), then {place}")  # fmt: skip

    def parse_args(arguments: Sequence[str]) -> argparse.Namespace:
        parsed = parser.parse_intermixed_args(arguments)
        words = _action_first(parsed.words, actions, default, where_first=where_first)
        if len(words) < 2:
            hint = f"{parser.usage}; a folder called {words[0]}: ./{words[0]}"
            raise UsageError(f"{parser.prog} {words[0]} needs WHERE", hint)
        if words[0] not in actions:
            guesses = [(word, did_you_mean(word, actions)) for word in (words[1], words[0])]
            wrong, near = next((guess for guess in guesses if guess[1]), guesses[0])
            what = f"what is '{wrong}'? there is no action '{wrong}'{near}"
            raise UsageError(what, str(parser.usage))
        parsed.action, parsed.where, parsed.rest = words[0], words[1], words[2:]
        return parsed

    vars(parser)["parse_args"] = parse_args


def accept_where_first(
    parser: argparse.ArgumentParser, actions: Collection[str], default: str = ""
) -> None:
    """Accept WHERE before the action in a parser that takes the action as its first word.

    With ``default`` the action may be left out.
    """
    parse = parser.parse_args

    def parse_args(arguments: Sequence[str]) -> argparse.Namespace:
        first, second = [*arguments[:2], "", ""][:2]
        if first.startswith("-") or first in actions or not first:
            return parse(arguments)
        if second in actions:
            return parse([second, first, *arguments[2:]])
        if default and (not second or second.startswith("-")):
            return parse([default, *arguments])
        return parse(arguments)

    vars(parser)["parse_args"] = parse_args


def _action_first(
    words: list[str], actions: Mapping[str, Sequence[str]], default: str, *, where_first: bool
) -> list[str]:
    if len(words) == 1 and (where_first or words[0] not in actions or words[0] == default):
        return [default, *words]
    orders = [words, [*words[1:2], *words[:1], *words[2:]]]
    known = [order for order in orders if order[0] in actions]
    whole = [order for order in known if len(order) == 2 + len(actions[order[0]])]
    choice = whole or known or orders[:1]
    return choice[-1] if where_first else choice[0]


def add_where(parser: argparse.ArgumentParser, what: str, metavar: str = "WHERE") -> None:
    """Add WHERE, which may be a URL, and ``--robot``."""
    parser.add_argument("where", metavar=metavar, help=f"{what}, or {PAGE}")
    add_robot(parser)


def add_robot(parser: argparse.ArgumentParser) -> None:
    """Add ``--robot``."""
    parser.add_argument("--robot", metavar="ID", help="which one, where WHERE is https://host:port")


def name_robot(args: argparse.Namespace) -> None:
    """Put ``--robot`` into WHERE; raises UsageError where WHERE is no URL."""
    where = getattr(args, "where", None)
    if where is None:
        return
    if not is_url(where):
        raise UsageError("--robot goes with the address of a server", f"{where} is one robot's own")
    args.where = with_robot(where, args.robot)


def robot_at(where: str) -> tuple[Fleet, str]:
    """Return the server and the robot of a URL."""
    from amberbox.client import opening

    return opening.robot_at(where)


def remote_record(where: str) -> RemoteRecord:
    """Open the record of a robot on a server."""
    from amberbox.client.opening import open_remote

    return open_remote(where)


def refuse_options(where: str, given: dict[str, object], hint: str) -> None:
    """Raise UsageError for options that do not apply to a server; false values count as absent."""
    names = [f"--{name.replace('_', '-')}" for name, value in given.items() if value]
    if names:
        raise UsageError(f"a server does not take {', '.join(names)}", hint)


def user_name() -> str:
    """Return the name of the user; empty where the system has none."""
    import getpass  # few verbs need it

    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return ""


@contextmanager
def opened(where: str) -> Iterator[Record]:
    """Open a record, a server's archive of many robots, or a robot's record on a server.

    Prints notes on unreadable parts.
    """
    from amberbox.blackbox.query.record import open as open_record

    if is_url(where):
        with remote_record(where) as remote:
            yield remote
        return
    archive = archive_in(where)
    with open_record(where) if archive is None else _opened_archive(*archive) as record:
        print_notes(record.notes)
        yield record


def _opened_archive(folder: Path, robots: Sequence[str]) -> Record:
    try:
        from amberbox.server.archive.record import open_archive
    except ImportError:
        what = f"{folder} is a server's archive: reading it needs what servers have installed"
        raise UsageError(what, "pip install 'amberbox[server]'") from None
    return open_archive(folder, robots)


def accept_relative_times(parser: argparse.ArgumentParser) -> None:
    """Accept ``--from -10m`` as a value, which argparse would take for an option."""
    parser._negative_number_matcher = re.compile(r"-\d")


def add_seconds(parser: argparse.ArgumentParser, default: float) -> None:
    """Add ``--seconds``, after which a search gives up (``budget_of``)."""
    parser.add_argument(
        "--seconds", type=float, default=default, metavar="S",
        help=f"give up after S seconds (default {default:g})",
    )  # fmt: skip


def budget_of(args: argparse.Namespace, **limits: int) -> Budget:
    """Return a budget that is over ``--seconds`` from now; raises UsageError for no number."""
    if not 0.0 <= args.seconds < math.inf:
        raise UsageError("--seconds must be a number, 0 or more")
    began_s, seconds = time.monotonic(), float(args.seconds)

    def is_past(share: float) -> bool:
        return time.monotonic() >= began_s + share * seconds

    return Budget(is_over=lambda: is_past(1.0), is_past=is_past, **limits)


def add_range_only(parser: argparse.ArgumentParser, end: str = "--to") -> None:
    """Add ``--from`` and ``--to``, or another option for the end of the range."""
    accept_relative_times(parser)
    times = "ISO (UTC), epoch, -10m before the last record, now or now-10m"
    parser.add_argument("--from", dest="from_", metavar="T", help=f"first time: {times}")
    parser.add_argument(end, dest="to", metavar="T", help="end of the range, not included")
    parser.set_defaults(end_option=end)


def span_of(args: argparse.Namespace, record: Record) -> tuple[int | None, int | None]:
    """Return ``--from`` and ``--to`` (ns); raises UsageError that names the invalid option."""
    end = getattr(args, "end_option", "--to")
    return ordered_span(
        time_of("--from", args.from_, record.time_ns), time_of(end, args.to, record.time_ns)
    )


def time_of(option: str, text: str | None, read: Callable[[str | None], int | None]) -> int | None:
    """Parse the time of an option; raises UsageError that names the option."""
    try:
        return read(text)
    except UsageError as error:
        raise UsageError(f"{option}: {error.what}", error.hint) from error


def check_time(option: str, text: str | None) -> None:
    """Raise UsageError, naming the option, for a time that no server can parse."""
    if text:
        time_of(option, text, lambda value: parse_time(value or "", time.time_ns, lambda: 0))


def add_range(parser: argparse.ArgumentParser) -> None:
    """Add ``--from``, ``--to`` and ``--by``."""
    add_range_only(parser)
    parser.add_argument(
        "--by", choices=("received", "timestamp"), default="received",
        help="go by time of receipt (default) or by the item's own stamps",
    )  # fmt: skip


def add_mission(parser: argparse.ArgumentParser) -> None:
    """Add ``--mission``."""
    parser.add_argument(
        "--mission", metavar="M",
        help="instead of --from and --to: id of a mission, last, last:3, failed:3, NAME:3",
    )  # fmt: skip


def missions_of(args: argparse.Namespace, record: Record) -> list[RecordedMission] | None:
    """Return the missions named by ``--mission``; None without it.

    Raises UsageError for an unknown mission, and when a range is given too.
    """
    if args.mission is None:
        return None
    if args.from_ is not None or args.to is not None or getattr(args, "incident", None):
        raise UsageError("a mission has its own window", "leave out --from, --to and --incident")
    from amberbox.blackbox.retention.missions import missions_named

    return missions_named(record.missions(), args.mission)


def add_window(parser: argparse.ArgumentParser) -> None:
    """Add the options that name a window."""
    parser.add_argument("--incident", metavar="ID", help="the window of an incident; 'last' is one")
    add_mission(parser)


def windows(args: argparse.Namespace, record: Record) -> list[Window]:
    """Return the chosen windows, in order; a single one by ``--from`` and ``--to``.

    Raises UsageError for an unknown incident, and for contradictory options.
    """
    span = span_of(args, record)
    missions = missions_of(args, record)
    if missions is not None:
        return [(mission.from_ns, mission.to_ns) for mission in missions]
    if not args.incident:
        return [span]
    if span != (None, None):
        raise UsageError("an incident has its own window", "leave out --from and --to")
    return [*record.incident_windows(args.incident)]


def window_of(args: argparse.Namespace, record: Record) -> Window:
    """Return one window that spans all chosen windows; prints a note when it contains more."""
    found = windows(args, record)
    if args.mission and len(found) > 1:
        raise UsageError(f"'{args.mission}' are {len(found)} missions", "name one of them")
    if len(found) > 1:
        print_notes([f"the clock was set in between: the window is in {len(found)} parts, "
              "rows between them are shown, too"])  # fmt: skip
    return found[0][0], found[-1][1]
