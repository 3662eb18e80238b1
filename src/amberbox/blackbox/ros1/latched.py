"""Tells a latched message that is delivered again after a reconnect from a new one."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field

from amberbox.blackbox.ros1.held import Deliver
from amberbox.blackbox.ros1.memory import Memory

_FIRST_MOMENT_NS = 1_000_000_000


def digest(data: bytes, has_header: bool) -> str:
    """Identify a message by its content; rospy counts ``header.seq`` up at each delivery."""
    return hashlib.blake2b(data[4:] if has_header else data, digest_size=16).hexdigest()


@dataclass
class LatchedFilter:
    """Passes the messages of one connection on, except one that was delivered already.

    A publisher repeats its latched message to who connects; rospy does so even when it is just
    publishing it to all, so that it comes twice within the first moment of a connection. Only the
    process that delivered a message before can repeat it (``known`` is empty for another): what a
    restarted publisher says anew is recorded, even if it is the same.
    """

    topic: str
    node: str
    has_header: bool
    known: frozenset[str]
    memory: Memory
    deliver: Deliver
    repeated: Callable[[], None]
    _last: str = field(default="", init=False)
    _first_ns: int | None = field(default=None, init=False)

    def __call__(self, data: bytes, received_ns: int) -> None:
        content = digest(data, self.has_header)
        if self._first_ns is None:
            is_repeated = content in self.known
            self._first_ns = received_ns
        else:
            is_new_link = received_ns - self._first_ns < _FIRST_MOMENT_NS
            is_repeated = is_new_link and self.has_header and content == self._last
        self._last = content
        if is_repeated:
            self.repeated()
        else:
            self.deliver(data, received_ns)
        self.memory.latch(self.topic, self.node, content)
