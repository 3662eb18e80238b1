"""A solver for clauses, with assumptions and the conflict among them.

Conflict-driven clause learning with two watched literals. A literal is a variable (1, 2, ...) or
its negative.

Source: Eén, Sörensson, An extensible SAT-solver, SAT 2003.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping, Sequence

from amberbox.core.contracts import Budget

_DECAY = 1 / 0.95
_LARGEST = 1e100
_FIRST_RESTART = 100  # conflicts
_LONGER = 1.3
_CHECK_EVERY = 256  # conflicts between two looks at the budget; a power of two


class Solver:
    """Clauses over variables that are made by ``variable``.

    Inside, a literal is twice its variable, plus one if it is negative: its opposite is ``^ 1``.
    """

    def __init__(self, budget: Budget | None = None) -> None:
        self._budget = Budget() if budget is None else budget
        self._values: list[int] = [0, 0]  # by literal: 1 true, -1 false, 0 open
        self._watchers: list[list[list[int]]] = [[], []]  # by literal: clauses that watch it
        self._levels: list[int] = [0]
        self._reasons: list[list[int] | None] = [None]
        self._activity: list[float] = [0.0]
        self._phase: list[int] = [0]
        self._order: list[tuple[float, int]] = []  # variables by activity, some entries outdated
        self._trail: list[int] = []
        self._limits: list[int] = []  # where each level begins in the trail
        self._head = 0
        self._step = 1.0
        self._conflicts = 0
        self._is_sound = True
        self.model: Sequence[bool] = ()
        """By variable (the first entry is unused), after ``solve`` has returned True."""
        self.core: Sequence[int] = ()
        """Assumptions that cannot hold together, after ``solve`` has returned False."""

    def variable(self) -> int:
        """Return a new variable."""
        number = len(self._levels)
        self._values += (0, 0)
        self._watchers += ([], [])
        self._levels.append(0)
        self._reasons.append(None)
        self._activity.append(0.0)
        self._phase.append(1)
        heapq.heappush(self._order, (0.0, number))
        return number

    def add(self, literals: Iterable[int]) -> None:
        """Add a clause: at least one of the literals holds."""
        self._back_to(0)
        clause = {_inner(literal) for literal in literals}
        values = self._values
        if any(literal ^ 1 in clause or values[literal] > 0 for literal in clause):
            return
        left = [literal for literal in clause if not values[literal]]
        if len(left) > 1:
            self._watch(left)
        elif not left or not self._assign(left[0], None) or self._propagate() is not None:
            self._is_sound = False

    def solve(self, assumptions: Sequence[int] = ()) -> bool:
        """Return whether all clauses can hold with the assumptions.

        Raises OutOfTimeError when the budget is spent.
        """
        self._budget.check()
        self._back_to(0)
        assumed = [_inner(literal) for literal in assumptions]
        restart = self._conflicts + _FIRST_RESTART
        pause = float(_FIRST_RESTART)
        self.core = ()
        while self._is_sound:
            conflict = self._propagate()
            if conflict is not None:
                if not self._limits:
                    self._is_sound = False
                    break
                self._learn(conflict)
                if self._conflicts >= restart:
                    pause *= _LONGER
                    restart = self._conflicts + round(pause)
                    self._back_to(0)
                continue
            decision = self._next(assumed)
            if decision is None:
                return True
            if decision < 0:
                return False
            self._limits.append(len(self._trail))
            self._assign(decision, None)
        return False

    def lower_bound(self, weights: Mapping[int, int], assumptions: Sequence[int] = ()) -> int:
        """Return a sum below which the weights of literals that hold cannot be; 0 is certain."""
        return 0

    def holds(self, literal: int) -> bool:
        """Return whether a literal holds in the model."""
        return self.model[abs(literal)] == (literal > 0)

    def _next(self, assumed: Sequence[int]) -> int | None:
        """Return the next decision; None if all is decided, -1 if an assumption cannot hold."""
        while len(self._limits) < len(assumed):
            literal = assumed[len(self._limits)]
            if self._values[literal] == 0:
                return literal
            if self._values[literal] < 0:
                self.core = self._assumptions_against(literal)
                return -1
            self._limits.append(len(self._trail))
        while self._order:
            _, number = heapq.heappop(self._order)
            if not self._values[2 * number]:
                return 2 * number + self._phase[number]
        self.model = [value > 0 for value in self._values[::2]]
        return None

    def _assign(self, literal: int, reason: list[int] | None) -> bool:
        if self._values[literal]:
            return self._values[literal] > 0
        self._values[literal], self._values[literal ^ 1] = 1, -1
        self._levels[literal >> 1] = len(self._limits)
        self._reasons[literal >> 1] = reason
        self._trail.append(literal)
        return True

    def _watch(self, clause: list[int]) -> None:
        self._watchers[clause[0]].append(clause)
        self._watchers[clause[1]].append(clause)

    def _propagate(self) -> list[int] | None:
        """Assign what follows; return a clause that does not hold, if there is one."""
        values, watchers, trail = self._values, self._watchers, self._trail
        while self._head < len(trail):
            false = trail[self._head] ^ 1
            self._head += 1
            watching, kept = watchers[false], []
            for place, clause in enumerate(watching):
                if clause[0] == false:
                    clause[0], clause[1] = clause[1], false
                if values[clause[0]] > 0:
                    kept.append(clause)
                    continue
                for other in range(2, len(clause)):
                    literal = clause[other]
                    if values[literal] >= 0:
                        clause[1], clause[other] = literal, false
                        watchers[literal].append(clause)
                        break
                else:
                    kept.append(clause)
                    if not self._assign(clause[0], clause):
                        kept += watching[place + 1 :]
                        watchers[false] = kept
                        return clause
            watchers[false] = kept
        return None

    def _learn(self, conflict: list[int]) -> None:
        """Add the clause of the first unique implication point, and go back to where it acts."""
        self._conflicts += 1
        if not self._conflicts & (_CHECK_EVERY - 1):
            self._budget.check()
        learned = self._implication_point(conflict)
        levels = self._levels
        if len(learned) == 1:
            self._back_to(0)
            self._assign(learned[0], None)
        else:
            second = max(range(1, len(learned)), key=lambda place: levels[learned[place] >> 1])
            learned[1], learned[second] = learned[second], learned[1]
            self._back_to(levels[learned[1] >> 1])
            self._watch(learned)
            self._assign(learned[0], learned)
        self._step *= _DECAY

    def _implication_point(self, conflict: list[int]) -> list[int]:
        level = len(self._limits)
        seen: set[int] = set()
        learned = [0]
        open_ = 0
        place = len(self._trail)
        clause: Sequence[int] = conflict
        while True:
            for literal in clause:
                number = literal >> 1
                if number in seen or not self._levels[number]:
                    continue
                seen.add(number)
                self._bump(number)
                if self._levels[number] == level:
                    open_ += 1
                else:
                    learned.append(literal)
            place -= 1
            while self._trail[place] >> 1 not in seen:
                place -= 1
            literal = self._trail[place]
            open_ -= 1
            if not open_:
                learned[0] = literal ^ 1
                return learned
            clause = self._reasons[literal >> 1] or ()

    def _bump(self, number: int) -> None:
        self._activity[number] += self._step
        if self._activity[number] > _LARGEST:
            self._activity = [value / _LARGEST for value in self._activity]
            self._step /= _LARGEST
            self._order = [(-self._activity[n], n) for n in range(1, len(self._levels))]
            heapq.heapify(self._order)
        else:
            heapq.heappush(self._order, (-self._activity[number], number))

    def _assumptions_against(self, literal: int) -> list[int]:
        """Return the assumptions because of which this one cannot hold, with it."""
        found = [_outer(literal)]
        seen = {literal >> 1}
        for made in reversed(self._trail):
            if made >> 1 not in seen or not self._levels[made >> 1]:
                continue
            reason = self._reasons[made >> 1]
            if reason is None:
                found.append(_outer(made))
            else:
                seen.update(other >> 1 for other in reason)
        return found

    def _back_to(self, level: int) -> None:
        if len(self._limits) <= level:
            return
        start = self._limits[level]
        for literal in self._trail[start:]:
            number = literal >> 1
            self._values[literal] = self._values[literal ^ 1] = 0
            self._phase[number] = literal & 1
            heapq.heappush(self._order, (-self._activity[number], number))
        del self._trail[start:]
        del self._limits[level:]
        self._head = start


def _inner(literal: int) -> int:
    return 2 * literal if literal > 0 else -2 * literal + 1


def _outer(literal: int) -> int:
    return -(literal >> 1) if literal & 1 else literal >> 1
