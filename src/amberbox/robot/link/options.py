"""How a robot's link behaves: where to, how fast, and what goes over which network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


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
