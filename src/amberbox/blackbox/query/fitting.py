"""Tables in a terminal: long texts are cut, then columns in the middle are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")

GAP = "  "
DOTS = "..."
_NARROWEST = 12
"""Texts are not cut to less: columns go instead."""


@dataclass(frozen=True, slots=True)
class Room:
    """Characters in a line, and what to say to those who want the columns left out."""

    width: int
    more: str = ""

    def note(self, shown: int, count: int) -> str:
        """Say that not all columns are there."""
        return f"{shown} of {count} columns" + (f"; {self.more}" if self.more else "")


@dataclass(frozen=True, slots=True)
class Fit:
    """Widths of all columns, and numbers of those that are shown; the hole is after ``left``."""

    widths: Sequence[int]
    columns: Sequence[int]
    left: int

    @property
    def hides(self) -> bool:
        """Whether columns are left out."""
        return len(self.columns) < len(self.widths)

    def pick(self, cells: Sequence[T], hole: T) -> list[T]:
        """Take what belongs to the columns that are shown, with ``hole`` for those that are not."""
        shown = [cells[number] for number in self.columns]
        return [*shown[: self.left], hole, *shown[self.left :]] if self.hides else shown


def cut(text: str, width: int) -> str:
    """Shorten a text to a width."""
    return text if len(text) <= width else text[: max(width - len(DOTS), 0)] + DOTS


def fit(widths: Sequence[int], may_cut: Sequence[bool], room: int) -> Fit:
    """Decide what is shown of columns that are ``widths`` wide; the first is never cut.

    Numbers and times are whole or absent: half of one would be another.
    """
    shown, left = _outer(_narrowed(widths, may_cut, room), room)
    if len(shown) < len(widths):
        room -= len(GAP) + len(DOTS)
    kept = _narrowed([widths[n] for n in shown], [may_cut[n] for n in shown], room)
    narrower = dict(zip(shown, kept, strict=True))
    return Fit([narrower.get(n, width) for n, width in enumerate(widths)], shown, left)


def _narrowed(widths: Sequence[int], may_cut: Sequence[bool], room: int) -> list[int]:
    """Take from the longest texts until a line has room, or they are as short as they may be."""
    narrower = list(widths)
    texts = [number for number, text in enumerate(may_cut) if text and number > 0]
    while total(narrower) > room:
        widest = max(texts, key=lambda number: narrower[number], default=0)
        if not texts or narrower[widest] <= _NARROWEST:
            break
        narrower[widest] -= 1
    return narrower


def total(widths: Sequence[int]) -> int:
    """Return how long a line is."""
    return sum(widths) + len(GAP) * (len(widths) - 1)


def _outer(widths: Sequence[int], room: int) -> tuple[Sequence[int], int]:
    """Return the columns from both ends that have room, and how many of them are on the left."""
    if total(widths) <= room:
        return range(len(widths)), len(widths)
    low, high = 1, len(widths)  # what lies between is left out
    used = len(DOTS) + len(GAP) + widths[0]
    sides = ["right", "left"]
    while sides and low < high:
        number = high - 1 if sides[0] == "right" else low
        wanted = len(GAP) + widths[number]
        if used + wanted > room:
            sides.pop(0)  # the other side may have one that is narrower
            continue
        used += wanted
        low, high = (low, number) if sides[0] == "right" else (number + 1, high)
        sides.reverse()
    return [*range(low), *range(high, len(widths))], low
