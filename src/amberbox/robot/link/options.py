"""How a robot's link behaves: where to, how fast, and what goes over which network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amberbox.blackbox.folder.folder import RobotFolder
from amberbox.blackbox.folder.server import KEY_FILE, read_key
from amberbox.core.errors import UsageError

_JOIN = "amberbox join {path} LINE, with the line that 'amberbox serve add-robot' prints"


@dataclass(frozen=True, slots=True)
class LinkOptions:
    """What the link needs to know; ``rate`` in bytes/s, 0 for as fast as it goes.

    ``ca`` is the SHA-256 fingerprint of the server's certificate authority (hex); without one the
    computer's own authorities count. ``metered`` are patterns of networks that cost money.
    """

    url: str
    robot: str
    key: str
    ca: str = ""
    rate: float = 0.0
    copy: str = "always"
    metered: Sequence[str] = ()
    metered_statuses: bool = True
    config_hash: str = ""
    docked: str = ""
    live: bool = True


def options_of(folder: RobotFolder) -> LinkOptions:
    """Return what a robot folder says of its server.

    Raises UsageError when it names none, or holds no key to it.
    """
    server = folder.robot.server
    if server is None:
        raise UsageError(f"{folder.path} names no server", _JOIN.format(path=folder.path))
    key = read_key(folder.path, server)
    if not key:
        place = folder.path / KEY_FILE
        raise UsageError(f"there is no key in {place}", _JOIN.format(path=folder.path))
    return LinkOptions(
        server.url, folder.robot.id, key, server.ca, server.rate, server.copy, server.metered,
        server.metered_sends == "statuses", folder.config_hash, server.docked, server.live,
    )  # fmt: skip
