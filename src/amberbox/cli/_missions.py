"""``--mission``: ranges of time given by missions instead of by times."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from amberbox.core.errors import UsageError

if TYPE_CHECKING:
    from amberbox.blackbox.missions import Mission
    from amberbox.blackbox.query.record import Record


def add_mission(parser: argparse.ArgumentParser) -> None:
    """Add ``--mission``."""
    parser.add_argument(
        "--mission", metavar="M",
        help="instead of --from and --to: id of a mission, last, last:3, failed:3, NAME:3",
    )  # fmt: skip


def missions_of(args: argparse.Namespace, record: Record) -> list[Mission] | None:
    """Return the missions that were named; None if none were.

    Raises UsageError for one that is not there, and when a range is given, too.
    """
    if args.mission is None:
        return None
    if args.from_ is not None or args.to is not None or getattr(args, "incident", None):
        raise UsageError("a mission has its own window", "leave out --from, --to and --incident")
    from amberbox.blackbox.missions.mission import named

    return named(record.missions(), args.mission)
