"""What an unroller offers, and how it says which messages do not fit their definition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from amberbox.core.errors import AmberboxError
from amberbox.core.types import ItemSchema, Rows


class UnrollError(AmberboxError):
    """Messages that do not fit their definition; ``bad`` are their places in the batch."""

    def __init__(self, type_name: str, bad: Sequence[int], count: int) -> None:
        self.bad = tuple(sorted(bad))
        self.type_name = type_name
        super().__init__(
            f"{len(self.bad)} of {count} messages do not fit the definition of {type_name} "
            f"(first: number {self.bad[0]} of the batch)",
            "they stay in the journal as they came; a sender built with another version of the "
            "message, or damage on the way, is the usual cause",
        )


class Unroller(Protocol):
    """Turns the messages of one topic into flat columns."""

    schema: ItemSchema

    def rows(self, messages: Sequence[bytes]) -> Rows:
        """Unroll a batch; ``stamp_ns`` is 0 where a message has no stamp of its own.

        Raises ``UnrollError`` naming every message that does not fit; drop these and call again.
        """

    def stamp_ns(self, message: bytes) -> int | None:
        """Read only the message's own stamp, nanoseconds; None without one or if it is 0."""
