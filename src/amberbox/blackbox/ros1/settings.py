"""How the box behaves on a ROS 1 network, and what can go wrong there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from amberbox.core.errors import AmberboxError


@dataclass(frozen=True)
class Settings:
    """What the parts of the subscriber share; times that only tests change have defaults."""

    master_uri: str = "http://localhost:11311/"
    caller_id: str = "/amberbox"
    hosts: Mapping[str, str] = field(default_factory=dict)
    advertise: str = ""
    invisible: bool = False
    all_topics: bool = False
    poll_s: float = 1.0
    tcp_nodelay: bool = True
    message_limit: int = 64_000_000
    dead_after_s: float = 40.0
    timeout_s: float = 3.0
    unknown_after_s: float = 10.0
    first_retry_s: float = 0.1
    listed_retry_s: float = 2.0
    unlisted_retry_s: float = 30.0


class RosError(AmberboxError):
    """Something on the ROS network did not answer as it should."""


class NoAnswerError(RosError):
    """Nobody answers at an address, or what answers does not speak ROS."""


class RefusedError(RosError):
    """A master or node answered, and said no."""


class MalformedError(RosError):
    """A peer sent what TCPROS does not allow."""
