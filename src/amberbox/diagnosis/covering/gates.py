"""Which functions are lost while components are down: needs as bit masks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from amberbox.core.needs import Needs


class Gates:
    """The functions over the components that can go down; sets of both are bit masks.

    ``support[f]`` are the components on which function f depends at all, ``alone[c]`` the
    functions that the loss of component c loses by itself.
    """

    def __init__(self, functions: Sequence[tuple[str, Needs]], components: Sequence[str]) -> None:
        self._needs = [needs for _, needs in functions]
        self._function_bits = {name: 1 << place for place, (name, _) in enumerate(functions)}
        self._component_bits = {name: 1 << place for place, name in enumerate(components)}
        order = _in_order(dict(functions), self._function_bits)
        self.support = [0] * len(functions)
        losers = [0] * len(functions)
        for place in order:
            own = self._component_bits.get(functions[place][0], 0)
            names = self._needs[place].names()
            self.support[place] = own | _union(self._of(name, self.support) for name in names)
            losers[place] = own | self._alone(self._needs[place], losers)
        self.alone = _transposed(losers, len(components))
        self._hard = [place for place in order if self.support[place] != losers[place]]
        self._memory: dict[int, int] = {0: 0}

    def lost(self, down: int) -> int:
        """Return the functions that are lost while these components are down."""
        known = self._memory.get(down)
        if known is None:
            if len(self._memory) > 100_000:
                self._memory = {0: 0}
            known = self._memory[down] = self._lost(down)
        return known

    def _lost(self, down: int) -> int:
        lost = _union(self.alone[place] for place in bits(down))
        for place in self._hard:
            if not lost >> place & 1 and (down & self.support[place]).bit_count() > 1:
                lost |= self._loses(place, down, lost) << place
        return lost

    def _loses(self, place: int, down: int, lost: int) -> bool:
        def is_up(name: str) -> bool:
            gone = self._component_bits.get(name, 0) & down
            return not gone and not self._function_bits.get(name, 0) & lost

        return not self._needs[place].met(is_up)

    def _of(self, name: str, masks: Sequence[int]) -> int:
        function = self._function_bits.get(name)
        inherited = 0 if function is None else masks[function.bit_length() - 1]
        return inherited | self._component_bits.get(name, 0)

    def _alone(self, needs: Needs, losers: Sequence[int]) -> int:
        """Return the components of which each by itself makes the needs fail."""
        parts = [
            self._of(part, losers) if isinstance(part, str) else self._alone(part, losers)
            for part in needs.parts
        ]
        spare = len(parts) - needs.at_least
        if spare == 0:
            return _union(parts)
        return _union(
            1 << place
            for place in bits(_union(parts))
            if sum(part >> place & 1 for part in parts) > spare
        )


def bits(mask: int) -> Iterator[int]:
    """Yield the places of the bits that are set, from low to high."""
    while mask:
        low = mask & -mask
        yield low.bit_length() - 1
        mask ^= low


def _union(masks: Iterator[int] | Sequence[int]) -> int:
    result = 0
    for mask in masks:
        result |= mask
    return result


def _transposed(masks: Sequence[int], width: int) -> list[int]:
    columns = [0] * width
    for row, mask in enumerate(masks):
        for place in bits(mask):
            columns[place] |= 1 << row
    return columns


def _in_order(needs: Mapping[str, Needs], bit: Mapping[str, int]) -> list[int]:
    """Return the places of the functions, each after those that it needs."""
    order: list[int] = []
    done: set[str] = set()
    waiting = list(needs)
    while waiting:
        name = waiting[-1]
        first = [n for n in needs[name].names() if n in needs and n not in done]
        if name in done or not first:
            waiting.pop()
            if name not in done:
                done.add(name)
                order.append(bit[name].bit_length() - 1)
        else:
            waiting += first
    return order
