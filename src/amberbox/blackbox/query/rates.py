"""How often rows came while there was a recording: the pauses between do not count."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

from amberbox.blackbox.query.catalogue import Catalogue
from amberbox.core.clock import NS

Place: TypeAlias = tuple[str, int, int]
"""Writer, run, and the first sequence number."""


@dataclass(frozen=True, slots=True)
class Share:
    """What one journal adds to an item."""

    place: Place
    rows: int
    first_ns: int
    last_ns: int
    bytes: int = 0
    stamp_offset_ns: int | None = None
    estimated: bool = False


def rate_hz(shares: Iterable[Share], holes: Iterable[Place]) -> float | None:
    """Return the mean rate over all stretches that were recorded without a pause.

    A stretch is one run of one writer, or what lies between two holes in it. None where no
    stretch has two rows.
    """
    cuts = sorted(holes)
    stretches: dict[tuple[str, int, int], list[Share]] = {}
    for share in shares:
        writer, run, _ = share.place
        stretches.setdefault((writer, run, bisect_left(cuts, share.place)), []).append(share)
    steps = sum(sum(share.rows for share in found) - 1 for found in stretches.values())
    span_ns = sum(
        max(share.last_ns for share in found) - min(share.first_ns for share in found)
        for found in stretches.values()
    )
    return round(steps * NS / span_ns, 3) if span_ns > 0 else None


def deleted_places(catalogue: Catalogue) -> Iterator[Place]:
    """Give where whole journals were deleted, columns and all."""
    for stone in catalogue.manifest.tombstones:
        if stone.what != "raw" and not set(stone.journals) & set(catalogue.existing):
            yield stone.writer, stone.run, stone.first_seq
