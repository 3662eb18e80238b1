"""Messages that were converted while a recording was opened, kept as long as there is room."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

ROOM_BYTES = 64 << 20
_OVERHEAD = 160
"""Bytes a message takes beside its payload."""

Converted: TypeAlias = tuple[int, int, bytes]
"""A number for the topic, the log time, the message."""


@dataclass
class Kept:
    """Saves the second conversion of what fits into memory."""

    room_bytes: int = ROOM_BYTES

    def keep(
        self, messages: Sequence[Converted], again: Callable[[], Sequence[Converted]]
    ) -> Callable[[], Sequence[Converted]]:
        """Return what gives these messages once more: from memory, or by converting again."""
        size = sum(len(data) for _, _, data in messages) + _OVERHEAD * len(messages)
        if size > self.room_bytes:
            return again
        self.room_bytes -= size
        return lambda: messages
