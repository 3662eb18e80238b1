"""A journal file cut into stretches of time small enough to be held in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, TypeVar

import numpy as np

from amberbox.blackbox.exporting.view import Window
from amberbox.blackbox.follow.read import JournalFile
from amberbox.blackbox.journal.clocktable import ClockTable

SLICE_BYTES = 8 << 20
SLICE_ROWS = 50_000

Loaded = TypeVar("Loaded")


@dataclass(frozen=True, slots=True, eq=False)
class Part(Generic[Loaded]):
    """A stretch of a record that is read at once; nothing in it is before ``start_ns``."""

    start_ns: int
    load: Callable[[], Loaded]


def slices(journal: JournalFile, span: Window) -> Iterator[tuple[int, int]]:
    """Cut what a file received in ``span`` into stretches ``[from, to)`` of about 8 MB of file."""
    edges = _edges(journal)
    low = edges[0] if span[0] is None else max(span[0], edges[0])
    high = edges[-1] if span[1] is None else min(span[1], edges[-1])
    inside = [low, *(edge for edge in edges if low < edge < high), high]
    for start, stop in pairwise(inside):
        if start < stop:
            yield start, stop


def _edges(journal: JournalFile) -> list[int]:
    if not journal.places:
        return [0, 0]
    clock = ClockTable(journal.clock)
    low, high = clock.bounds()
    begins = clock.received(np.array([place.start_ns for place in journal.places])).tolist()
    edges = [min(place.start_ns for place in journal.places) + low]
    size, rows = 0, 0
    for place, following, begin in zip(
        journal.places, [*journal.places[1:], None], begins, strict=True
    ):
        if (size >= SLICE_BYTES or rows >= SLICE_ROWS) and begin > edges[-1]:
            edges.append(begin)
            size, rows = 0, 0
        end = following.offset if following is not None else journal.bytes
        size += abs(end - place.offset)
        rows += place.count
    return [*edges, max(edges[-1], max(place.end_ns for place in journal.places) + high) + 1]
