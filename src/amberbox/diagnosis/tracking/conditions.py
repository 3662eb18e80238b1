"""The FMEA's own symptoms: conditions over the record, evaluated at every quarter of a second."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.expression import Expression, ExpressionError
from amberbox.core.expression_reason import reason
from amberbox.core.expression_tree import Address, Age, Call, Held, Tree, Window, children
from amberbox.core.samples import Samples
from amberbox.core.types import Batch, IntArray, Status, Symptom, SymptomState
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.tracking.columns import Columns

QUARTER_NS = NS // 4
"""Conditions are looked at at multiples of this."""
FRESH_NS = 5 * NS
"""What is older is not known."""
_MARGIN_NS = NS
_BLOCK_NS = 30 * NS
"""So much of the record is looked at together."""
_FEW = 2
"""Up to so many instants are evaluated one by one."""
_FORGET_NS = 2 * NS
_WRONG = (ExpressionError, ValueError, TypeError)
"""What values of a type that a condition cannot use make of it."""
_STATES: tuple[SymptomState, ...] = ("absent", "present", "unknown")


class Conditions:
    """All conditions of an analysis: rows and statuses in, symptoms out when they change."""

    def __init__(self, fmea: Fmea) -> None:
        named = {s.id: s.condition for s in fmea.symptoms.values() if s.condition is not None}
        history_ns = max((one.history_ns for one in named.values()), default=0)
        addresses = dict.fromkeys(name for one in named.values() for name in one.addresses())
        self._columns = Columns(addresses, max(history_ns, FRESH_NS) + _MARGIN_NS)
        samples = self._columns.samples()
        self._all = [Condition(name, one, samples) for name, one in named.items()]
        self._forgot_ns = 0

    @property
    def items(self) -> frozenset[str]:
        """Names of the items whose rows are read."""
        return self._columns.items

    @property
    def history_s(self) -> float:
        """How far back rows have to be fed again after ``resume``."""
        return self._columns.keep_ns / NS if self._all else 0.0

    @property
    def troubles(self) -> dict[str, str]:
        """Conditions that could not be evaluated when last looked at, and why."""
        return {one.id: one.trouble for one in self._all if one.trouble}

    def begin(self, at_ns: int) -> list[Symptom]:
        """Begin an epoch: nothing is known; tell it of what was."""
        self._columns.forget()
        self._forgot_ns = at_ns
        return [found for one in self._all for found in one.begin(at_ns)]

    def feed(self, batch: Batch) -> None:
        """Take rows of any item."""
        self._columns.feed(batch)

    def take(self, status: Status) -> None:
        """Take what a monitor's mode says."""
        self._columns.take(status)

    def advance(self, after_ns: int, until_ns: int) -> list[Symptom]:
        """Return what changes in ``(after_ns, until_ns]``, in order of time."""
        found: list[Symptom] = []
        while self._all and after_ns < until_ns:
            end_ns = min(until_ns, after_ns + _BLOCK_NS)
            found += self._block(_multiples(after_ns, end_ns))
            after_ns = end_ns
        if until_ns - self._forgot_ns >= _FORGET_NS:
            self._forgot_ns = until_ns
            self._columns.forget_before(until_ns)
        return found

    def _block(self, instants: IntArray) -> list[Symptom]:
        if not len(instants):
            return []
        fresh = Fresh(instants)
        found = [symptom for one in self._all for symptom in one.look(instants, fresh)]
        found.sort(key=lambda symptom: symptom.confirmed_ns or 0)
        return found

    def snapshot(self, until_ns: int) -> dict[str, Any]:
        """Return what has to be known to go on, as JSON, beside the rows of ``history_s``."""
        states = {one.id: one.state for one in self._all}
        return {**self._columns.snapshot(until_ns), "states": states}

    def resume(self, snapshot: Mapping[str, Any], until_ns: int) -> None:
        """Go on from what ``snapshot`` returned."""
        self._forgot_ns = until_ns
        self._columns.resume(snapshot)
        for one in self._all:
            one.resume(snapshot["states"][one.id])


class Condition:
    """One condition as time goes by; unknown also while it reads what is no longer fresh."""

    __slots__ = (
        "_delay_ns", "_expression", "_looked_ns", "_samples", "_timed", "_wanted", "id", "state",
        "trouble",
    )  # fmt: skip

    def __init__(self, name: str, expression: Expression, samples: Mapping[str, Samples]) -> None:
        self.id = name
        self.state: SymptomState = "unknown"
        self.trouble = ""
        self._expression = expression
        self._samples = {address: samples[address] for address in expression.addresses()}
        wanted = dict.fromkeys(_must_be_fresh(expression.tree))
        self._wanted = {_clock(address): samples[address] for address in wanted}
        self._timed = expression.needs_history
        self._delay_ns = expression.tree.for_ns if isinstance(expression.tree, Held) else 0
        self._looked_ns: int | None = None

    def begin(self, at_ns: int) -> Iterator[Symptom]:
        """Begin an epoch: it is not known; tell it if it was."""
        self._looked_ns = None
        yield from self._become("unknown", at_ns)

    def resume(self, state: SymptomState) -> None:
        """Go on from a state."""
        self.state, self._looked_ns = state, None

    def look(self, instants: IntArray, known: Fresh) -> Iterator[Symptom]:
        """Tell how it changes at instants, which are in order."""
        fresh = known.all_of(self._wanted)
        if self._stays(fresh):
            return
        states = np.full(len(instants), 2)
        states[fresh] = self._codes(instants[fresh], known)
        self._looked_ns = int(instants[-1])
        before = _STATES.index(self.state)
        changed = np.flatnonzero(states != np.concatenate([[before], states[:-1]]))
        for place in changed.tolist():
            yield from self._become(_STATES[states[place]], int(instants[place]))

    def _stays(self, fresh: Any) -> bool:
        """Tell whether it cannot have changed since it was looked at last."""
        if not fresh.any():
            return self.state == "unknown"
        if self._timed or self._looked_ns is None or not fresh.all():
            return False
        newest = (int(s.times_ns[-1]) for s in self._samples.values() if len(s))
        return max(newest, default=0) <= self._looked_ns

    def _codes(self, instants: IntArray, known: Fresh) -> Any:
        """Return the places in ``_STATES`` at instants."""
        if len(instants) > _FEW:
            try:
                windows = known.windows(instants.tobytes())
                numbers = self._expression.numbers(self._samples, instants, windows)
            except _WRONG:
                pass  # one by one shows at which instants
            else:
                self.trouble = ""
                return np.where(np.isnan(numbers), 2, (numbers != 0).astype(np.int64))
        return [self._code(now, known.windows(now)) for now in instants.tolist()]

    def _code(self, now: int, windows: dict[str, Any]) -> int:
        """Evaluate at an instant; a value of a wrong type makes it unknown."""
        try:
            value = self._expression.numbers(self._samples, now, windows)
        except _WRONG as error:
            self.trouble = str(error)
            return 2
        self.trouble = ""
        return 2 if value != value else int(value != 0)  # NaN equals nothing

    def _become(self, state: SymptomState, at_ns: int) -> Iterator[Symptom]:
        if state == self.state:
            return
        self.state = state
        reads = tuple(self._samples)
        first = reads[0] if reads else ""
        if state != "present":
            yield Symptom(self.id, state, first, None, at_ns, source="condition")
            return
        onset_ns = at_ns - self._delay_ns
        evidence = tuple((address, onset_ns, at_ns) for address in reads)
        why = reason(self._expression, self._samples, at_ns, expected=False)
        yield Symptom(
            self.id, state, first, onset_ns, at_ns, 1.0, "condition", evidence, reason=why
        )


class Fresh:
    """What conditions share at some instants: each part of it is worked out once.

    It is where samples are fresh enough to count, and what windows give.
    """

    def __init__(self, instants: IntArray) -> None:
        self._instants = instants
        self._always = np.ones(len(instants), bool)
        self._of: dict[str, Any] = {}
        self._windows: dict[int | bytes, dict[str, Any]] = {}

    def windows(self, instants: int | bytes) -> dict[str, Any]:
        """Return what windows give at an instant, or at some; whoever works one out adds it."""
        return self._windows.setdefault(instants, {})

    def all_of(self, wanted: Mapping[str, Samples]) -> Any:
        """Return at which instants all samples are fresh; they are named by what times them."""
        found = self._always
        for clock, samples in wanted.items():
            fresh = self._of.get(clock)
            if fresh is None:
                fresh = self._of[clock] = self._fresh(samples.times_ns)
            found = found & fresh
        return found

    def _fresh(self, times_ns: IntArray) -> Any:
        if not len(times_ns):
            return ~self._always
        last = times_ns.searchsorted(self._instants, "right") - 1
        return (last >= 0) & (self._instants - times_ns[last] <= FRESH_NS)


def _clock(address: str) -> str:
    """Name what times an address: columns of an item come together, all else by itself."""
    is_column = "/" not in address and "[" not in address
    return address.partition(".")[0] if is_column else address


def _must_be_fresh(tree: Tree) -> Iterator[str]:
    """Yield what has to be fresh: all but what is asked for its age, its count, or at all."""
    if isinstance(tree, Address):
        yield tree.name
    elif not isinstance(tree, Age) and not _asks_whether(tree):
        for child in children(tree):
            yield from _must_be_fresh(child)


def _asks_whether(tree: Tree) -> bool:
    return isinstance(tree, Window | Call) and tree.name in ("count", "known")


def _multiples(after_ns: int, until_ns: int) -> IntArray:
    first, last = after_ns // QUARTER_NS + 1, until_ns // QUARTER_NS
    return np.arange(first, last + 1, dtype=np.int64) * QUARTER_NS
