"""Which rank each box of a layered drawing stands in: circles broken, longest paths first."""

from __future__ import annotations

from collections.abc import Collection, Sequence

Links = Sequence[tuple[int, int]]
"""Links between boxes by their numbers."""


def backward(count: int, links: Links) -> set[int]:
    """Return the links (by place) that close a circle when boxes are walked in their order."""
    outgoing: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for place, (start, end) in enumerate(links):
        outgoing[start].append((end, place))
    state = [0] * count
    found: set[int] = set()
    for box in _entrances(count, links):
        if not state[box]:
            _walk(box, outgoing, state, found)
    return found


def _entrances(count: int, links: Links) -> list[int]:
    """Return the boxes, those that no link leads to first."""
    reached = {end for start, end in links if start != end}
    return sorted(range(count), key=lambda box: box in reached)


def _walk(
    box: int, outgoing: Sequence[list[tuple[int, int]]], state: list[int], found: set[int]
) -> None:
    """Walk in depth: a link to a box that is still open (1) leads back."""
    state[box] = 1
    path = [(box, iter(outgoing[box]))]
    while path:
        here, links = path[-1]
        for end, place in links:
            if state[end] == 1:
                found.add(place)
            elif not state[end]:
                state[end] = 1
                path.append((end, iter(outgoing[end])))
                break
        else:
            state[here] = 2
            path.pop()


def ranks(
    count: int, links: Links, first: Collection[int] = (), last: Collection[int] = ()
) -> list[int]:
    """Return the rank of each box: one after the last box that leads to it.

    ``links`` have no circle. Boxes of ``last`` without a link out stand in the last rank; others
    with more links out than in stand as near to what they lead to as they can, but not ``first``.
    """
    outgoing: list[list[int]] = [[] for _ in range(count)]
    waiting = [0] * count
    for start, end in links:
        outgoing[start].append(end)
        waiting[end] += 1
    entering = list(waiting)
    found = [0] * count
    order = [box for box in range(count) if not waiting[box]]
    for box in order:
        for end in outgoing[box]:
            found[end] = max(found[end], found[box] + 1)
            waiting[end] -= 1
            if not waiting[end]:
                order.append(end)
    _to_the_end(found, outgoing, last)
    for box in reversed(order):
        if len(outgoing[box]) > entering[box] and box not in first:
            found[box] = min(found[end] for end in outgoing[box]) - 1
    return _from_zero(found)


def _to_the_end(found: list[int], outgoing: Sequence[Sequence[int]], last: Collection[int]) -> None:
    movable = [box for box in last if not outgoing[box]]
    others = max((rank for box, rank in enumerate(found) if box not in set(movable)), default=-1)
    end = max(others + 1, max((found[box] for box in movable), default=0))
    for box in movable:
        found[box] = end


def _from_zero(found: list[int]) -> list[int]:
    """Number the ranks that are used from 0, without holes."""
    used = {rank: place for place, rank in enumerate(sorted(set(found)))}
    return [used[rank] for rank in found]
