"""Byte layouts: messages whose strings and sequences have the same lengths lie alike.

A layout is exact by induction: the first length prefix of a message lies at a fixed place; if it
is equal to the layout's, the place of the next one is fixed as well, and so on to the end. So a
message of the right size with all prefixes equal has every field where the layout has it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.unroll.places import Evenly, Objects, Scattered
from amberbox.blackbox.unroll.walk import MISFITS, Slots, Walker, compile_walker
from amberbox.blackbox.unroll.wire import Plan, text_slots

MOST_LAYOUTS = 8
_MOST_SPANS = 32
_PADDING = 3
"""Bytes between a string and the next prefix that are compared as if they belonged to it."""
_MESSAGES_PER_NEW_LAYOUT = 256


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Size of the message, places of its fields, and the bytes that make it this layout.

    ``spans`` are the length prefixes (and the CDR header); ``same`` are these and the strings of
    the message that the layout was taken from, whose decoded ``texts`` are kept by slot.
    """

    size: int
    big_endian: bool
    slots: Slots
    spans: tuple[tuple[int, bytes], ...]
    same: tuple[tuple[int, bytes], ...]
    texts: Mapping[int, Objects]

    def fits(self, message: bytes) -> bool:
        """Tell whether one message of the right size has this layout."""
        return all(message.startswith(value, place) for place, value in self.spans)

    def repeats(self, data: bytes, count: int) -> bool:
        """Tell whether all of ``count`` joined messages have this layout and these strings."""
        return len(self.same) <= _MOST_SPANS and all(
            _column(data, self.size, count, place, len(value)).tobytes() == value * count
            for place, value in self.same
        )

    def matches(self, data: bytes, count: int) -> NDArray[np.bool_]:
        """Tell which of ``count`` joined messages, all of the right size, have this layout."""
        alike = np.ones(count, np.bool_)
        for place, value in self.spans:
            column = _column(data, self.size, count, place, len(value))
            alike &= (column == np.frombuffer(value, np.uint8)).all(axis=1)
        return alike


def _column(data: bytes, size: int, count: int, place: int, length: int) -> NDArray[np.uint8]:
    return np.ndarray((count, length), np.uint8, data, place, (size, 1))


def find_layout(plan: Plan, walker: Walker, message: bytes, big_endian: bool) -> Layout:
    """Take the layout of a message; raises one of ``walk.MISFITS`` if it does not fit.

    ``walker`` is one that watches.
    """
    slots: Slots = [[] for _ in range(plan.slots)]
    checks: list[tuple[int, int]] = [(0, 2)] if plan.cdr else []
    walker(big_endian, slots, checks)(message, 0, len(message))
    strings = [
        (start, end - start)
        for slot, _ in text_slots(plan.table)
        for start, end in zip(slots[slot], slots[slot + 1], strict=True)
    ]
    alone = Scattered(message, slots, big_endian)
    return Layout(
        len(message),
        big_endian,
        slots,
        _merged(message, checks),
        _merged(message, checks + strings, gap=_PADDING),
        {slot: alone.texts(slot, slot + 1, wide) for slot, wide in text_slots(plan.table)},
    )


def _merged(
    message: bytes, checks: Sequence[tuple[int, int]], gap: int = 0
) -> tuple[tuple[int, bytes], ...]:
    """Cut the checked bytes out of a message, near neighbours in one piece."""
    merged: list[list[int]] = []
    for place, size in sorted(checks):
        if merged and place <= merged[-1][1] + gap:
            merged[-1][1] = max(merged[-1][1], place + size)
        elif size:
            merged.append([place, place + size])
    return tuple((start, message[start:end]) for start, end in merged)


class TooManyLayoutsError(Exception):
    """Messages of this topic differ too often for layouts to pay."""


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Messages of a batch that share a layout: their numbers and their joined bytes.

    ``same_texts`` is True if all their strings are those of the layout.
    """

    layout: Layout
    members: NDArray[np.int64]
    data: bytes
    same_texts: bool = False

    def places(self) -> Evenly:
        """Give the places of their fields."""
        layout = self.layout
        texts = layout.texts if self.same_texts else None
        count = len(self.members)
        return Evenly(self.data, layout.size, count, layout.slots, layout.big_endian, texts)


class LayoutCache:
    """The layouts of one topic that were used last, at most ``MOST_LAYOUTS``.

    A topic may need a new one every now and then (a name that changes); when it needs them more
    often than once in 256 messages, ``TooManyLayoutsError`` ends the attempt.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._walker = compile_walker(plan, watch=True)
        self._recent: list[Layout] = []
        self._new_left = float(MOST_LAYOUTS)

    def group(self, messages: Sequence[bytes], lengths: list[int]) -> tuple[list[Group], list[int]]:
        """Split a batch by layout; also return the numbers of messages that fit none."""
        self._new_left = min(
            MOST_LAYOUTS, self._new_left + len(messages) / _MESSAGES_PER_NEW_LAYOUT
        )
        groups: list[Group] = []
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
        groups: list[Group],
        bad: list[int],
    ) -> NDArray[np.int64]:
        """Take the first member's layout and all that share it; return the others."""
        first = int(members[0])
        try:
            layout = self._layout_of(messages[first])
        except MISFITS:
            bad.append(first)
            return members[1:]
        data = _join(messages, members)
        if layout.repeats(data, len(members)):
            groups.append(Group(layout, members, data, True))
            return members[:0]
        alike = layout.matches(data, len(members))
        if alike.all():
            groups.append(Group(layout, members, data))
            return members[:0]
        groups.append(Group(layout, members[alike], _join(messages, members[alike])))
        return members[~alike]

    def _layout_of(self, message: bytes) -> Layout:
        for place, layout in enumerate(self._recent):
            if layout.size == len(message) and layout.fits(message):
                self._recent.insert(0, self._recent.pop(place))
                return layout
        layout = find_layout(self._plan, self._walker, message, is_big_endian(self._plan, message))
        if self._new_left < 1:
            raise TooManyLayoutsError
        self._new_left -= 1
        self._recent.insert(0, layout)
        del self._recent[MOST_LAYOUTS:]
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


def is_big_endian(plan: Plan, message: bytes) -> bool:
    """Read the byte order from a CDR header; raises ValueError for an encapsulation not ours."""
    if not plan.cdr or message[:2] == b"\x00\x01":
        return False
    if message[:2] == b"\x00\x00":
        return True
    raise ValueError("not plain CDR")
