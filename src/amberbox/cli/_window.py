"""Which part of a record is meant: ``--from`` and ``--to``, an incident, missions."""

from __future__ import annotations

import argparse

from amberbox.blackbox.query.record import Record
from amberbox.cli._missions import add_mission, missions_of
from amberbox.cli._output import span_of, tell
from amberbox.core.errors import UsageError

Window = tuple[int | None, int | None]


def add_window(parser: argparse.ArgumentParser) -> None:
    """Add the options that name a window."""
    parser.add_argument("--incident", metavar="ID", help="the window of an incident; 'last' is one")
    add_mission(parser)


def windows(args: argparse.Namespace, record: Record) -> list[Window]:
    """Return the windows that are meant, in order; one by ``--from`` and ``--to``.

    Raises UsageError for an incident that is not there, and for two ways of saying a window.
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
    """Return one window that holds all that is meant; says so when it holds more."""
    found = windows(args, record)
    if args.mission and len(found) > 1:
        raise UsageError(f"'{args.mission}' are {len(found)} missions", "name one of them")
    if len(found) > 1:
        tell([f"the clock was set in between: the window is in {len(found)} parts, "
              "rows between them are shown, too"])  # fmt: skip
    return found[0][0], found[-1][1]
