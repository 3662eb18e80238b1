"""Where items of a rank stand: as near to their neighbours as they can without overlap."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from amberbox.fleet.drawing.crossings import Near, Order

PASSES = 6
STRAIGHT = 8.0
"""How much more a lane wants to be in line with a lane than a box with a box."""


def spread(order: Order, above: Near, below: Near, sizes: Sequence[float], gaps: float,
           lanes: Sequence[bool]) -> list[float]:  # fmt: skip
    """Return the middle of each item, the least upper edge at 0.

    ``sizes`` are how much room each takes, ``gaps`` how much is between two boxes; beside a lane
    half of it is enough.
    """
    middles = [0.0] * len(sizes)
    steps = [_steps(items, sizes, gaps, lanes) for items in order]
    for items, offsets in zip(order, steps, strict=True):
        for item, offset in zip(items, offsets, strict=True):
            middles[item] = offset - offsets[-1] / 2
    for turn in range(PASSES):
        down = turn % 2 == 0
        pairs = list(zip(order, steps, strict=True))
        for items, offsets in pairs if down else reversed(pairs):
            near = _near(turn, above, below)
            _settle(items, offsets, near, middles, lanes)
    edge = min((middle - size / 2 for middle, size in zip(middles, sizes, strict=True)), default=0)
    return [middle - edge for middle in middles]


def _near(turn: int, above: Near, below: Near) -> tuple[Near, ...]:
    """Return who counts: the rank before in the direction of the pass, both at the end."""
    if turn >= PASSES - 2:
        return (above, below)
    return (above,) if turn % 2 == 0 else (below,)


def _steps(
    items: Sequence[int], sizes: Sequence[float], gaps: float, lanes: Sequence[bool]
) -> list[float]:
    """Return the least distance of each item from the first one, middle to middle."""
    offsets = [0.0]
    for before, item in pairwise(items):
        gap = gaps / 2 if lanes[before] or lanes[item] else gaps
        offsets.append(offsets[-1] + (sizes[before] + sizes[item]) / 2 + gap)
    return offsets[: len(items)]


def _settle(
    items: Sequence[int], offsets: Sequence[float], near: Sequence[Near], middles: list[float],
    lanes: Sequence[bool],
) -> None:  # fmt: skip
    wishes, weights = [], []
    for item, offset in zip(items, offsets, strict=True):
        wish, weight = _wish(item, near, middles, lanes)
        wishes.append(wish - offset)
        weights.append(weight)
    for item, offset, place in zip(items, offsets, rising(wishes, weights), strict=True):
        middles[item] = place + offset


def _wish(
    item: int, near: Sequence[Near], middles: Sequence[float], lanes: Sequence[bool]
) -> tuple[float, float]:
    """Return where an item wants to stand, and how much; without neighbours where it is."""
    total = weight = 0.0
    for side in near:
        for other in side[item]:
            pull = STRAIGHT if lanes[item] and lanes[other] else 1.0
            total += pull * middles[other]
            weight += pull
    return (total / weight, weight) if weight else (middles[item], 0.1)


def rising(wishes: Sequence[float], weights: Sequence[float]) -> list[float]:
    """Return the rising sequence nearest to the wishes in least squares.

    Neighbours that would overtake each other are pooled (pool adjacent violators; Ayer et al.
    1955).
    """
    pools: list[tuple[float, float, int]] = []
    for wish, weight in zip(wishes, weights, strict=True):
        mean, mass, count = wish, weight, 1
        while pools and pools[-1][0] > mean:
            other, more, members = pools.pop()
            mean = (mean * mass + other * more) / (mass + more)
            mass, count = mass + more, count + members
        pools.append((mean, mass, count))
    return [mean for mean, _, count in pools for _ in range(count)]
