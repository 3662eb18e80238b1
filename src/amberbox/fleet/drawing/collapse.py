"""Which boxes of a large graph are drawn: what is wrong first, then what is near to it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

Pair = tuple[str, str]


def kept(
    names: Sequence[str], wrong: Collection[str], pairs: Sequence[Pair], most: int
) -> set[str]:
    """Return the names to draw: all that are wrong, and what is fine, the nearest first.

    Never fewer than what is wrong; else at most ``most``.
    """
    if len(names) <= most:
        return set(names)
    near: dict[str, list[str]] = {name: [] for name in names}
    for start, end in pairs:
        near[start].append(end)
        near[end].append(start)
    found = dict.fromkeys(name for name in names if name in wrong)
    order = list(found)
    for name in order:
        for other in near[name]:
            if other not in found and len(found) < most:
                found[other] = None
                order.append(other)
    return set(found) if found else set(names[:most])


def bridges(pairs: Sequence[Pair], shown: Collection[str]) -> dict[Pair, int]:
    """Return links between what is shown that lead over what is not, and over how much of it.

    Links that are there themselves are left out.
    """
    outgoing: dict[str, list[str]] = {}
    for start, end in pairs:
        outgoing.setdefault(start, []).append(end)
    direct = set(pairs)
    found: dict[Pair, int] = {}
    for name in dict.fromkeys(start for start, _ in pairs if start in shown):
        for end, over in _beyond(name, outgoing, shown).items():
            if end != name and (name, end) not in direct:
                found[name, end] = over
    return found


def _beyond(
    name: str, outgoing: Mapping[str, Sequence[str]], shown: Collection[str]
) -> dict[str, int]:
    """Return what is reached over hidden names only, with their number on the shortest way."""
    distance = {other: 1 for other in outgoing[name] if other not in shown}
    reached: dict[str, int] = {}
    order = list(distance)
    for hidden in order:
        for other in outgoing.get(hidden, ()):
            if other in shown:
                reached.setdefault(other, distance[hidden])
            elif other not in distance:
                distance[other] = distance[hidden] + 1
                order.append(other)
    return reached
