"""``amberbox.open``: a record here, or a robot's record on a server."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.client.address import Address, is_url, read_address
from amberbox.core.errors import UsageError

if TYPE_CHECKING:
    from amberbox.blackbox.query.record import Record
    from amberbox.client.fleet import Fleet
    from amberbox.client.remote import RemoteRecord
    from amberbox.client.wire import Wire


def open(where: str | Path) -> Record:
    """Open for reading: a robot folder, a store, a recording, or a robot's page on a server.

    The last is an address such as ``https://fleet.example:8443/robots/ropod_001``.
    Raises UsageError when there is none of these at ``where``.
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
    """Return the server and the robot that an address means; of a server with one robot that."""
    from amberbox.client.fleet import Fleet

    address = read_address(where)
    fleet = Fleet(where)
    return fleet, address.robot or _only_robot(fleet, address)


def wire_to(url: str, token: str | None, ca: str | Path | None, timeout_s: float) -> Wire:
    """Prepare to speak with a server: whose token, and whom to trust."""
    from amberbox.client import servers, trust
    from amberbox.client.wire import Wire

    address = read_address(url)
    kept = servers.sign_in_of(address.url)
    given = os.environ.get(servers.VARIABLE) if token is None else token
    text = given or (kept.token if kept and token is None else "")
    if isinstance(ca, Path) or (ca and not ca.startswith("sha256:")):
        return Wire(address.url, text or "", trust.context_from(Path(ca)), timeout_s)
    context = trust.context_of(address.url, str(ca or address.pin), kept)
    return Wire(address.url, text or "", context, timeout_s)


def _only_robot(fleet: Fleet, address: Address) -> str:
    robots = [one.robot for one in fleet.robots()]
    if len(robots) == 1:
        return robots[0]
    if not robots:
        raise UsageError(f"{address} has no robot that you may see", "amberbox serve add-robot")
    names = ", ".join(robots[:8]) + (f" and {len(robots) - 8} more" if len(robots) > 8 else "")
    raise UsageError(f"{address} has {len(robots)} robots: {names}",
                     f"--robot, or {Address(address.url, robots[0])}")  # fmt: skip
