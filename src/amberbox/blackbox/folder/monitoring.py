"""``monitoring:`` of ``robot.yaml``: what holds for all monitors, and who is told of statuses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from amberbox.core.errors import Problem
from amberbox.core.nodes import Node
from amberbox.core.options import option

Format = Literal["paper", "health_status", "diagnostics"]

_LOOPBACK = ("127.", "localhost", "[::1]")
_DISCLOSES = "everybody who can reach it reads the robot's name, its components and their states"


@dataclass(frozen=True)
class PublishOptions:
    """One address at which statuses are published (ZeroMQ, PUB)."""

    url: str = option(doc="where it listens for subscribers: tcp://127.0.0.1:5581, ipc://PATH")
    format: Format = option("paper", "how the messages look")
    every: float = option(0.5, "time from one round of messages to the next", unit="s")
    topic: str = option("", "first frame of each message; without, they have one frame")

    def check(self) -> Iterator[tuple[str, str]]:
        """Say which values cannot work; opens nothing."""
        transport, separator, rest = self.url.partition("://")
        host, _, port = rest.rpartition(":")
        if not separator or transport not in ("tcp", "ipc") or not rest:
            yield "url", f"'{self.url}' is no address; write tcp://127.0.0.1:5581 or ipc://PATH"
        elif transport == "tcp" and not (host and port.isdecimal() and 0 < int(port) < 65536):
            yield "url", f"'{self.url}' has no port; write tcp://127.0.0.1:5581"
        if not 0 < self.every < float("inf"):
            yield "every", "must be above 0"

    @property
    def is_local(self) -> bool:
        """Tell whether only this computer can subscribe."""
        transport, _, rest = self.url.partition("://")
        return transport == "ipc" or rest.startswith(_LOOPBACK)


@dataclass(frozen=True)
class MonitoringOptions:
    """What holds for all monitors of a robot."""

    stale_after: float | Literal["never"] = option(
        5.0, "an input that is silent for longer is stale; mode files may say otherwise", unit="s"
    )
    publish: Sequence[PublishOptions] = option((), "where statuses are published; nowhere without")

    @property
    def stale_s(self) -> float | None:
        """How old an input may be; None for any age."""
        return None if self.stale_after == "never" else self.stale_after

    def check(self) -> Iterator[tuple[str, str]]:
        """Say which values cannot work."""
        if self.stale_after != "never" and self.stale_after <= 0:
            yield "stale_after", "must be above 0, or never"


def disclosures(root: Node, options: MonitoringOptions) -> Iterator[Problem]:
    """Note what leaves the computer; ``root`` is ``robot.yaml``."""
    entries = _below(_below(root, "monitoring"), "publish")
    for index, (node, entry) in enumerate(zip(entries.items or (), options.publish, strict=False)):
        if not entry.is_local:
            where = f"monitoring.publish[{index}].url"
            what = f"'{entry.url}' is open to the network: {_DISCLOSES}"
            yield _below(node, "url").problem(where, what, is_error=False)


def _below(node: Node, key: str) -> Node:
    return (node.mapping or {}).get(key, node)
