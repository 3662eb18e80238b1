"""Since when each publisher may have published: the start of the gap before its first message."""

from __future__ import annotations

from collections.abc import Collection


class Sightings:
    """When the nodes on one topic were last known not to publish it.

    A master's answer knows nothing later than the moment it was asked, so ``asked_ns`` counts,
    not the arrival of the answer. Notifications do not count: they may come late.
    """

    def __init__(self, start_ns: int) -> None:
        self._asked_ns = start_ns
        self._absent_ns: dict[str, int] = {}

    def polled(self, asked_ns: int, nodes: Collection[str]) -> None:
        """Take the publishers of the topic as the master named them."""
        self._absent_ns = {node: self.absent_until_ns(node) for node in nodes}
        self._asked_ns = asked_ns

    def absent_until_ns(self, node: str) -> int:
        """Return the last moment at which a node is known not to have published."""
        return self._absent_ns.get(node, self._asked_ns)
