"""Matchings of equations to unknowns, and the parts of Dulmage and Mendelsohn that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amberbox.core.equations.structure import bits

_NOBODY = -1


@dataclass(slots=True)
class Matching:
    """A maximum matching: each unknown has at most one equation that computes it.

    ``edges`` are the unknowns that an equation may compute, ``free`` the equations that compute
    none, as masks.
    """

    edges: Sequence[int]
    equations: int
    owner: list[int]  # by unknown; -1 is nobody
    free: int

    @classmethod
    def of(cls, edges: Sequence[int], equations: int, unknowns: int) -> Matching:
        """Match as many of these equations as can be; ``unknowns`` is how many there are."""
        matching = cls(edges, equations, [_NOBODY] * unknowns, equations)
        matching._complete()
        return matching

    def without(self, removed: int) -> Matching:
        """Return a maximum matching of the equations that are left."""
        owner = [_NOBODY if o >= 0 and removed >> o & 1 else o for o in self.owner]
        left = Matching(self.edges, self.equations & ~removed, owner, self.free & ~removed)
        left._complete()
        return left

    def _complete(self) -> None:
        for equation in bits(self.free):
            if self._augment(equation):
                self.free ^= 1 << equation

    def _augment(self, start: int) -> bool:
        """Give the equation an unknown along an alternating path, if there is one."""
        came_from: dict[int, int] = {}  # unknown to the equation that asks for it
        asked = 0
        waiting = [start]
        for equation in waiting:
            new = self.edges[equation] & ~asked
            asked |= new
            for unknown in bits(new):
                came_from[unknown] = equation
                if self.owner[unknown] == _NOBODY:
                    self._shift(unknown, came_from, start)
                    return True
                waiting.append(self.owner[unknown])
        return False

    def _shift(self, unknown: int, came_from: dict[int, int], start: int) -> None:
        computes = self._computes()
        while True:
            equation = came_from[unknown]
            self.owner[unknown] = equation
            if equation == start:
                return
            unknown = computes[equation]

    def overdetermined_part(self) -> Matching:
        """Return the matching of the over-determined part: equations with free ones above them."""
        equations = self.reached_from(self.free, self.edges)
        owner = [_NOBODY if o >= 0 and not equations >> o & 1 else o for o in self.owner]
        return Matching(self.edges, equations, owner, self.free)

    def reached_from(self, equations: int, variables: Sequence[int]) -> int:
        """Return these equations and those that compute an unknown of one of them, and so on."""
        found, seen, waiting = equations, 0, list(bits(equations))
        for equation in waiting:
            new = variables[equation] & ~seen
            seen |= new
            for unknown in bits(new):
                owner = self.owner[unknown]
                if owner != _NOBODY and not found >> owner & 1:
                    found |= 1 << owner
                    waiting.append(owner)
        return found

    def determined(self) -> int:
        """Return the unknowns that the equations determine, as a mask.

        The others are those of the under-determined part.
        """
        sharing: dict[int, list[int]] = {}
        for equation in bits(self.equations):
            for unknown in bits(self.edges[equation]):
                sharing.setdefault(unknown, []).append(equation)
        computes = self._computes()
        waiting = [unknown for unknown in sharing if self.owner[unknown] == _NOBODY]
        open_ = set(waiting)
        for unknown in waiting:
            new = {computes[e] for e in sharing[unknown] if e in computes} - open_
            open_ |= new
            waiting += new
        return sum(1 << unknown for unknown in sharing.keys() - open_)

    def _computes(self) -> dict[int, int]:
        """Return the unknown of each equation that computes one."""
        return {owner: unknown for unknown, owner in enumerate(self.owner) if owner != _NOBODY}
