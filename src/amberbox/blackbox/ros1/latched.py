"""Tells a latched message that is delivered again after a reconnect from a new one."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field

from amberbox.blackbox.ros1.held import Deliver
from amberbox.blackbox.ros1.memory import Memory


def digest(data: bytes, has_header: bool) -> str:
    """Identify a message by its content; rospy counts ``header.seq`` up at each delivery."""
    return hashlib.blake2b(data[4:] if has_header else data, digest_size=16).hexdigest()


@dataclass
class LatchedFilter:
    """Passes the messages of one connection on, except a first one that is known already.

    Only the process that delivered a message before can repeat it (``known`` is empty for
    another): what a restarted publisher says anew is recorded, even if it is the same.
    """

    topic: str
    node: str
    has_header: bool
    known: frozenset[str]
    memory: Memory
    deliver: Deliver
    repeated: Callable[[], None]
    _is_first: bool = field(default=True, init=False)

    def __call__(self, data: bytes, received_ns: int) -> None:
        content = digest(data, self.has_header)
        if self._is_first and content in self.known:
            self.repeated()
        else:
            self.deliver(data, received_ns)
        self._is_first = False
        self.memory.latch(self.topic, self.node, content)
