"""WHERE as the address of a server: told apart cheaply, its client imported only then."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from amberbox.client.address import is_url
from amberbox.core.errors import UsageError

if TYPE_CHECKING:
    from amberbox.client.fleet import Fleet
    from amberbox.client.remote import RemoteRecord

PAGE = "a robot's page on a server (https://fleet.example:8443/robots/ropod_001)"


def add_where(parser: argparse.ArgumentParser, what: str, metavar: str = "WHERE") -> None:
    """Add WHERE, which may be an address, and ``--robot``."""
    parser.add_argument("where", metavar=metavar, help=f"{what}, or {PAGE}")
    add_robot(parser)


def add_robot(parser: argparse.ArgumentParser) -> None:
    """Add ``--robot``."""
    parser.add_argument("--robot", metavar="ID", help="which one, where WHERE is https://host:port")


def name_robot(args: argparse.Namespace) -> None:
    """Put ``--robot`` into WHERE; raises UsageError where WHERE is no address."""
    robot, where = getattr(args, "robot", None), getattr(args, "where", None)
    if robot and where is not None:
        args.where = named(where, robot)


def named(where: str, robot: str | None) -> str:
    """Name a robot in an address."""
    if not robot:
        return where
    if not is_url(where):
        raise UsageError("--robot goes with the address of a server", f"{where} is one robot's own")
    from amberbox.client.address import with_robot

    return with_robot(where, robot)


def robot_at(where: str) -> tuple[Fleet, str]:
    """Return the server and the robot that an address means."""
    from amberbox.client import opening

    return opening.robot_at(where)


def remote_record(where: str) -> RemoteRecord:
    """Open the record of a robot on a server."""
    from amberbox.client.opening import open_remote

    return open_remote(where)


def refuse_options(where: str, given: dict[str, object], hint: str) -> None:
    """Raise UsageError for options that a server does not take; what is false was not given."""
    names = [f"--{name.replace('_', '-')}" for name, value in given.items() if value]
    if names:
        raise UsageError(f"a server does not take {', '.join(names)}", hint)
