"""Columns: messages of any type become flat, typed columns, compiled from their definition.

This module holds the interface of the unrollers that do it, and their error.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from amberbox.core.errors import AmberboxError
from amberbox.core.types import ItemSchema, Rows

MOST_PLACES = 16_384  # most columns of all tables of one type; a type with more is not unrolled


def check_places(type_name: str, count: int) -> None:
    """Raise AmberboxError for a type with more than ``MOST_PLACES`` columns."""
    if count > MOST_PLACES:
        raise AmberboxError(
            f"{type_name} has more than {MOST_PLACES} columns",
            "the messages are still recorded, but have no columns",
        )


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
    """Unrolls the messages of one topic into flat columns."""

    schema: ItemSchema

    def rows(self, messages: Sequence[bytes]) -> Rows:
        """Unroll a batch; ``stamp_ns`` is 0 where a message has no stamp of its own.

        Raises ``UnrollError`` naming every message that does not fit; drop these and call again.
        """

    def stamp_ns(self, message: bytes) -> int | None:
        """Read only the message's own stamp, nanoseconds; None without one or if it is 0."""

    def no_stamp(self, message: bytes) -> Any:
        """Return the value at the place of the stamp if it is not a time, else None."""
