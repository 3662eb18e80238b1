"""``amberbox.open``: a local record, or a robot's record on a server."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.client.address import Address, is_url, read_address
from amberbox.core.errors import UsageError
from amberbox.core.names import some_names

if TYPE_CHECKING:
    from amberbox.blackbox.query.record import Record
    from amberbox.client.fleet import Fleet
    from amberbox.client.remote import RemoteRecord


def open(where: str | Path) -> Record:
    """Open a record for reading: a robot folder, a store, a recording, or a robot on a server.

    A robot on a server is an address such as ``https://fleet.example:8443/robots/ropod_001``.
    Raises UsageError when ``where`` is none of these.
    """
    if is_url(where):
        return open_remote(where)
    from amberbox.blackbox.query.record import open as open_record

    return open_record(where)


def open_remote(where: str) -> RemoteRecord:
    """Open the record of a robot on a server."""
    from amberbox.client.remote import RemoteRecord

    fleet, robot = robot_at(where)
    return RemoteRecord(Path(robot), fleet=fleet, robot=robot)


def robot_at(where: str) -> tuple[Fleet, str]:
    """Return the server and the robot of an address; without a robot, the server's only one.

    Raises UsageError when the server has none, or several.
    """
    from amberbox.client.fleet import Fleet

    address = read_address(where)
    fleet = Fleet(where)
    return fleet, address.robot or _only_robot(fleet, address)


def _only_robot(fleet: Fleet, address: Address) -> str:
    robots = [one.robot for one in fleet.robots()]
    if len(robots) == 1:
        return robots[0]
    if not robots:
        raise UsageError(f"{address} has no robot that you may see", "amberbox serve add-robot")
    raise UsageError(f"{address} has {len(robots)} robots: {some_names(robots, 8)}",
                     f"--robot, or {Address(address.url, robots[0])}")  # fmt: skip
