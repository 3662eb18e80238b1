"""Binary decision diagrams: a formula as one shared graph of decisions, without recursion.

Nodes are numbers; 0 and 1 are false and true. A node's branches always have smaller numbers than
the node, so that whatever is computed from the branches upwards is one pass over a list.
Bryant, "Graph-based algorithms for Boolean function manipulation", 1986.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from amberbox.diagnosis.faulttree.budget import CHECK_EVERY, Budget, check

BELOW = 1 << 30
"""The level of the two constants: below all variables."""

_SHIFT = 32
_MASK = (1 << _SHIFT) - 1
_LOOK = CHECK_EVERY - 1
_SHARE_OF_CACHE = 4


@dataclass
class Diagram:
    """Nodes of a diagram: the level of the variable, the branch where it is true, where false.

    ``limit`` bounds what is held: nodes and remembered results together.
    """

    budget: Budget
    levels: list[int] = field(default_factory=lambda: [BELOW, BELOW])
    highs: list[int] = field(default_factory=lambda: [0, 1])
    lows: list[int] = field(default_factory=lambda: [0, 1])
    tables: dict[int, dict[int, int]] = field(default_factory=dict)
    caches: tuple[dict[int, int], dict[int, int]] = field(default_factory=lambda: ({}, {}))

    def __len__(self) -> int:
        return len(self.levels)

    def node(self, level: int, high: int, low: int) -> int:
        """Return the node of a decision; none is needed when both branches are the same."""
        return low if high == low else self.stored(level, high, low)

    def stored(self, level: int, high: int, low: int) -> int:
        """Return the one node of these branches."""
        table = self.tables.setdefault(level, {})
        found = table.setdefault(high << _SHIFT | low, len(self.levels))
        if found == len(self.levels):
            self.levels.append(level)
            self.highs.append(high)
            self.lows.append(low)
        return found

    def conjunction(self, left: int, right: int) -> int:
        """Return the AND of two nodes."""
        return self._combine(left, right, 0)

    def disjunction(self, left: int, right: int) -> int:
        """Return the OR of two nodes."""
        return self._combine(left, right, 1)

    def negation(self, root: int) -> int:
        """Return the NOT of a node."""
        opposite = {0: 1, 1: 0}
        for node in reachable(self.highs, self.lows, [root]):
            high, low = opposite[self.highs[node]], opposite[self.lows[node]]
            opposite[node] = self.node(self.levels[node], high, low)
        check(self.budget, len(self))
        return opposite[root]

    def exclusive(self, left: int, right: int) -> int:
        """Return the XOR of two nodes."""
        only_left = self.conjunction(left, self.negation(right))
        return self.disjunction(only_left, self.conjunction(self.negation(left), right))

    def all_of(self, nodes: Iterable[int]) -> int:
        """Return the AND of many nodes, those with the lowest variables first."""
        result = 1
        for node in self._from_below(nodes):
            result = self.conjunction(node, result)
        return result

    def any_of(self, nodes: Iterable[int]) -> int:
        """Return the OR of many nodes, those with the lowest variables first."""
        result = 0
        for node in self._from_below(nodes):
            result = self.disjunction(node, result)
        return result

    def at_least(self, count: int, nodes: Sequence[int]) -> int:
        """Return what is true when ``count`` or more of the nodes are."""
        reached = [1] + [0] * count  # [k]: k or more of those seen so far
        left = len(nodes)
        for node in self._from_below(nodes):
            left -= 1
            for k in range(count, max(0, count - left - 1), -1):
                one_more = self.conjunction(node, reached[k - 1])
                reached[k] = self.disjunction(one_more, reached[k])
        return reached[count]

    def _from_below(self, nodes: Iterable[int]) -> list[int]:
        return sorted(nodes, key=lambda node: self.levels[node], reverse=True)

    def _combine(self, left: int, right: int, absorbing: int) -> int:  # noqa: C901 (one hot loop)
        """Compute AND (``absorbing`` 0) or OR (1) of two nodes.

        On ``todo`` lie pairs to compute, as one number, and below them, inverted, the pair whose
        two branches they are. The code is one loop because this is where the time goes.
        """
        levels, highs, lows, tables = self.levels, self.highs, self.lows, self.tables
        cache = self.caches[absorbing]
        todo = [left << _SHIFT | right if left < right else right << _SHIFT | left]
        done: list[int] = []
        while todo:
            key = todo.pop()
            if key < 0:
                key = ~key
                f, g = levels[key >> _SHIFT], levels[key & _MASK]
                high, low = done.pop(), done.pop()
                if high == low:
                    result = low
                else:
                    level = f if f < g else g
                    table = tables.get(level)
                    if table is None:
                        table = tables[level] = {}
                    pair = high << _SHIFT | low
                    result = table.get(pair, -1)
                    if result < 0:
                        result = table[pair] = len(levels)
                        levels.append(level)
                        highs.append(high)
                        lows.append(low)
                cache[key] = result
                if not len(cache) & _LOOK:
                    check(self.budget, len(levels) + len(cache))
                done.append(result)
                continue
            f, g = key >> _SHIFT, key & _MASK
            if f < 2:
                done.append(absorbing if f == absorbing else g)
                continue
            if f == g:
                done.append(f)
                continue
            known = cache.get(key, -1)
            if known >= 0:
                done.append(known)
                continue
            if levels[f] == levels[g]:
                f1, f0, g1, g0 = highs[f], lows[f], highs[g], lows[g]
            elif levels[f] < levels[g]:
                f1, f0, g1, g0 = highs[f], lows[f], g, g
            else:
                f1, f0, g1, g0 = f, f, highs[g], lows[g]
            todo.append(~key)
            todo.append(f1 << _SHIFT | g1 if f1 < g1 else g1 << _SHIFT | f1)
            todo.append(f0 << _SHIFT | g0 if f0 < g0 else g0 << _SHIFT | f0)
        return done[0]

    def forget(self) -> None:
        """Drop remembered results when they take a good part of the budget."""
        for cache in self.caches:
            if len(cache) > self.budget.nodes // _SHARE_OF_CACHE:
                cache.clear()

    def compact(self, roots: Iterable[int]) -> dict[int, int]:
        """Keep only what is below ``roots``; return the new number of every node that stays."""
        levels, highs, lows = self.levels, self.highs, self.lows
        stay = reachable(highs, lows, roots)
        self.levels, self.highs, self.lows, self.tables = [BELOW, BELOW], [0, 1], [0, 1], {}
        for cache in self.caches:
            cache.clear()
        moved = {0: 0, 1: 1}
        for node in stay:
            moved[node] = self.stored(levels[node], moved[highs[node]], moved[lows[node]])
        return moved


def reachable(highs: Sequence[int], lows: Sequence[int], roots: Iterable[int]) -> list[int]:
    """Return the nodes below ``roots`` without the two constants, branches first."""
    seen = {0, 1}
    waiting = list(roots)
    while waiting:
        node = waiting.pop()
        if node not in seen:
            seen.add(node)
            waiting += (highs[node], lows[node])
    return sorted(seen - {0, 1})
