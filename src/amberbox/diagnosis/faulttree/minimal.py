"""Minimal cut sets of a decision diagram, kept as a diagram of sets (ZBDD).

A. Rauzy, "New algorithms for fault trees analysis", 1993, and "Mathematical foundation of minimal
cutsets", 2001. A node of a diagram of sets is a variable, the sets that contain it (the high
branch, without it) and those that do not; 0 is no set at all, 1 is the empty set alone.
"""

from __future__ import annotations

from collections.abc import Sequence

from amberbox.diagnosis.faulttree.bdd import Diagram, reachable
from amberbox.diagnosis.faulttree.budget import CHECK_EVERY, check

_SHIFT = 32
_MASK = (1 << _SHIFT) - 1
_LOOK = CHECK_EVERY - 1


class Family(Diagram):
    """A diagram of sets of which none contains another."""

    def node(self, level: int, high: int, low: int) -> int:
        """Return the node of a variable; none is needed when no set contains it."""
        return low if high == 0 else self.stored(level, high, low)

    def without(self, sets: int, others: int) -> int:
        """Return the sets that contain none of the others.

        On ``todo`` lie pairs to compute as one number, and inverted what to do with results: even
        numbers make the node of a pair, odd ones take further sets out of the last result.
        """
        levels, highs, lows = self.levels, self.highs, self.lows
        cache = self.caches[0]
        todo = [sets << _SHIFT | others]
        done: list[int] = []
        while todo:
            key = todo.pop()
            if key < 0:
                key = ~key
                if key & 1:
                    todo.append(done.pop() << _SHIFT | key >> 1)
                    continue
                key >>= 1
                low, high = done.pop(), done.pop()
                level = levels[key >> _SHIFT]
                result = cache[key] = low if high == 0 else self.stored(level, high, low)
                if not len(cache) & _LOOK:
                    check(self.budget, len(levels) + len(cache))
                done.append(result)
                continue
            f, g = key >> _SHIFT, key & _MASK
            level = levels[f]
            while levels[g] < level:  # sets with a variable that none of ours has
                g = lows[g]
            if f == 0 or g == 0 or f == g or g == 1:
                done.append(f if g == 0 else 0)
                continue
            if f == 1:
                done.append(1)
                continue
            key = f << _SHIFT | g
            known = cache.get(key, -1)
            if known >= 0:
                done.append(known)
            elif levels[g] == level:
                todo += (~(key << 1), lows[f] << _SHIFT | lows[g])
                todo += (~(lows[g] << 1 | 1), highs[f] << _SHIFT | highs[g])
            else:
                todo += (~(key << 1), lows[f] << _SHIFT | g, highs[f] << _SHIFT | g)
        return done[0]


def minimal_solutions(bdd: Diagram, root: int, family: Family) -> int:
    """Return the minimal sets of events that make ``root`` true while all others do not happen.

    For a coherent tree these are its minimal cut sets; with NOT and XOR they are the positive
    parts of its minimal solutions.
    """
    sets = {0: 0, 1: 1}
    for node in reachable(bdd.highs, bdd.lows, [root]):
        high, low = sets[bdd.highs[node]], sets[bdd.lows[node]]
        sets[node] = family.node(bdd.levels[node], family.without(high, low), low)
        family.forget()
    return sets[root]


def minimal_solutions_up_to(
    bdd: Diagram, root: int, family: Family, limit: int, orders: Sequence[int]
) -> int:
    """Return those minimal solutions that have at most ``limit`` events.

    ``orders`` says, by level, how many events a variable stands for at the least.
    """
    needed: dict[int, set[int]] = {root: {limit}}
    inner = reachable(bdd.highs, bdd.lows, [root])
    for node in reversed(inner):
        for left in needed[node]:
            needed.setdefault(bdd.lows[node], set()).add(left)
            needed.setdefault(bdd.highs[node], set()).add(left - orders[bdd.levels[node]])
    sets: dict[tuple[int, int], int] = {}
    for node in (0, 1, *inner):
        for left in needed.get(node, ()):
            sets[node, left] = _limited(bdd, node, left, family, sets, orders)
        family.forget()
    return sets[root, limit]


def _limited(
    bdd: Diagram,
    node: int,
    left: int,
    family: Family,
    sets: dict[tuple[int, int], int],
    orders: Sequence[int],
) -> int:
    if node < 2 or left < 0:
        return node if left >= 0 else 0
    level = bdd.levels[node]
    high = sets[bdd.highs[node], left - orders[level]]
    low = sets[bdd.lows[node], left]
    return family.node(level, family.without(high, low), low)
