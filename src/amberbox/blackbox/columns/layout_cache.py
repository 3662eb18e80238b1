"""The byte layouts of one topic: split a batch into groups of messages with the same layout.

Messages of one layout have every field at the same place, so their columns are read in one go.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from struct import error
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns import UnrollError
from amberbox.blackbox.columns.row_tables import concat_rows
from amberbox.core.types import Rows

# raised on a message that does not fit its definition
MISFITS = (ValueError, IndexError, error)

MOST_LAYOUTS = 8
_MESSAGES_PER_NEW_LAYOUT = 256
_LARGEST_JOIN = 16 << 20
UnrollPortion = Callable[[Sequence[bytes], list[int]], tuple[Rows, list[int]]]
"""From messages and their lengths to rows, and the places of messages that do not fit."""


class MessageLayout(Protocol):
    """The places of all fields in messages of one size, and the bytes that identify it."""

    @property
    def size(self) -> int:
        """Return the bytes of a message."""

    def fits(self, message: bytes) -> bool:
        """Return whether one message of the right size has this layout."""

    def repeats(self, data: bytes, count: int) -> bool:
        """Return whether all of ``count`` joined messages have this layout and these strings."""

    def matches(self, data: bytes, count: int) -> NDArray[np.bool_]:
        """Return which of ``count`` joined messages, all of the right size, have this layout."""


LayoutT = TypeVar("LayoutT", bound=MessageLayout)


class TooManyLayoutsError(Exception):
    """Raised when messages of a topic differ too often for layouts to save time."""


@dataclass(frozen=True, slots=True, eq=False)
class LayoutGroup(Generic[LayoutT]):
    """Messages of a batch that share a layout: their numbers and their joined bytes.

    ``same_texts`` is True if all their strings are those of the layout.
    """

    layout: LayoutT
    members: NDArray[np.int64]
    data: bytes
    same_texts: bool = False


class LayoutCache(Generic[LayoutT]):
    """The ``most`` most recently used layouts of one topic; ``find`` makes that of a message.

    A topic may need a new layout now and then (a name that changes). When it needs one more often
    than once in 256 messages, ``TooManyLayoutsError`` is raised.
    """

    def __init__(self, find: Callable[[bytes], LayoutT], most: int = MOST_LAYOUTS) -> None:
        self._find = find
        self._most = most
        self._recent: list[LayoutT] = []
        self._new_left = float(most)

    def group(
        self, messages: Sequence[bytes], lengths: list[int]
    ) -> tuple[list[LayoutGroup[LayoutT]], list[int]]:
        """Split a batch by layout; also return the numbers of messages that fit no layout."""
        self._new_left = min(self._most, self._new_left + len(messages) / _MESSAGES_PER_NEW_LAYOUT)
        groups: list[LayoutGroup[LayoutT]] = []
        bad: list[int] = []
        for members in _by_size(lengths):
            rest = members
            while len(rest):
                rest = self._next_group(messages, rest, groups, bad)
        return groups, bad

    def _next_group(
        self,
        messages: Sequence[bytes],
        members: NDArray[np.int64],
        groups: list[LayoutGroup[LayoutT]],
        bad: list[int],
    ) -> NDArray[np.int64]:
        """Append the group of messages with the first member's layout; return the other members."""
        first = int(members[0])
        try:
            layout = self._layout_of(messages[first])
        except MISFITS:
            bad.append(first)
            return members[1:]
        data = _join(messages, members)
        if layout.repeats(data, len(members)):
            groups.append(LayoutGroup(layout, members, data, True))
            return members[:0]
        matching = layout.matches(data, len(members))
        if matching.all():
            groups.append(LayoutGroup(layout, members, data))
            return members[:0]
        groups.append(LayoutGroup(layout, members[matching], _join(messages, members[matching])))
        return members[~matching]

    def _layout_of(self, message: bytes) -> LayoutT:
        for place, layout in enumerate(self._recent):
            if layout.size == len(message) and layout.fits(message):
                self._recent.insert(0, self._recent.pop(place))
                return layout
        layout = self._find(message)
        if self._new_left < 1:
            raise TooManyLayoutsError
        self._new_left -= 1
        self._recent.insert(0, layout)
        del self._recent[self._most :]
        return layout


def _by_size(lengths: list[int]) -> list[NDArray[np.int64]]:
    if lengths.count(lengths[0]) == len(lengths):
        return [np.arange(len(lengths))]
    sizes = np.array(lengths)
    return [np.flatnonzero(sizes == size) for size in np.unique(sizes)]


def _join(messages: Sequence[bytes], members: NDArray[np.int64]) -> bytes:
    if len(members) == len(messages):
        return b"".join(messages)
    return b"".join([messages[member] for member in members.tolist()])


def rows_in_portions(messages: Sequence[bytes], type_name: str, unroll: UnrollPortion) -> Rows:
    """Unroll a batch portion by portion; raises UnrollError for messages that do not fit."""
    parts: list[Rows] = []
    bad: list[int] = []
    for first, portion, lengths in _portions(messages):
        part, misfits = unroll(portion, lengths)
        parts.append(part)
        bad += [first + misfit for misfit in misfits]
    if bad:
        raise UnrollError(type_name, bad, len(messages))
    return concat_rows(parts)


def _portions(
    messages: Sequence[bytes],
) -> Iterator[tuple[int, Sequence[bytes], list[int]]]:
    """Split a batch so that no join is larger than 16 MiB, or only by its last message.

    Yields the number of the first message, the messages, and their lengths.
    """
    lengths = list(map(len, messages))
    if sum(lengths) <= _LARGEST_JOIN:
        yield 0, messages, lengths
        return
    first = size = 0
    for end, length in enumerate(lengths, 1):
        size += length
        if size > _LARGEST_JOIN or end == len(lengths):
            yield first, messages[first:end], lengths[first:end]
            first, size = end, 0
