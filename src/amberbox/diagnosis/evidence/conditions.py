"""Evidence from the FMEA's own conditions over the record."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.conditions import (
    as_json,
    batch_and_children,
    batch_column,
    child_row_column,
    from_json,
    last_sample,
    single_value,
    ticks,
)
from amberbox.core.contracts import EvidenceFollower
from amberbox.core.expression import Expression, ExpressionError, reason
from amberbox.core.expressions.evaluation import WindowCache
from amberbox.core.expressions.tree import (
    AddressNode,
    AgeNode,
    CallNode,
    ExpressionNode,
    HeldNode,
    WindowNode,
    children,
    of_monitors,
)
from amberbox.core.names import with_parents
from amberbox.core.samples import Samples
from amberbox.core.types import Batch, IntArray, Status, Symptom, SymptomState
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.symptom_sizes import QUARTER_NS, SymptomSizes


def follow(knowledge: Knowledge) -> EvidenceFollower:
    """Return the follower that evaluates the conditions as the record grows."""
    return ConditionTracker(knowledge.fmea)


@dataclass(slots=True)
class AddressColumn:
    """One address and its samples; ``index`` is the place in a list, None if it is none.

    Rows up to ``held_ns`` are held already: after ``resume`` they come again.
    """

    item: str
    variable: str
    index: int | None
    samples: Samples = field(default_factory=Samples)
    held_ns: int | None = None

    @classmethod
    def of(cls, address: str) -> AddressColumn:
        """Return the column of an address such as ``item.variable[17]``."""
        item, _, variable = address.partition(".")
        name, bracket, place = variable.partition("[")
        return cls(item, name, int(place.rstrip("]")) if bracket else None)

    def extend(self, times_ns: IntArray, values: Any) -> None:
        """Append values, without those that are held already."""
        if self.held_ns is not None and len(times_ns) and times_ns[0] <= self.held_ns:
            new = times_ns > self.held_ns
            times_ns, values = times_ns[new], values[new]
        self.samples.extend(times_ns, values)


class AddressColumns:
    """All columns that are read, by address; ``keep_ns`` is how far back they reach."""

    def __init__(self, addresses: Iterable[str], keep_ns: int) -> None:
        self.keep_ns = keep_ns
        self.of_record: dict[str, AddressColumn] = {}
        self.of_monitors: dict[str, Samples] = {}
        self._by_item: dict[str, list[AddressColumn]] = {}
        self._by_mode: dict[tuple[str, str], list[tuple[str, Samples]]] = {}
        for address in addresses:
            monitored = of_monitors(address)
            if monitored is None:
                column = self.of_record[address] = AddressColumn.of(address)
                self._by_item.setdefault(column.item, []).append(column)
            else:
                self._add_monitored(address, *monitored)

    def _add_monitored(self, address: str, component: str, mode: str, output: str = "") -> None:
        """Add an output, or where none is named a status."""
        samples = self.of_monitors[address] = Samples()
        self._by_mode.setdefault((component, mode), []).append((output, samples))

    @property
    def items(self) -> frozenset[str]:
        """Names of the items whose rows are read; child tables come with the item above them."""
        return frozenset(name for item in self._by_item for name in with_parents(item))

    def samples(self) -> dict[str, Samples]:
        """Return all samples by address."""
        return {name: column.samples for name, column in self.of_record.items()} | self.of_monitors

    def feed(self, batch: Batch) -> None:
        """Take rows; their log times do not decrease."""
        for each in batch_and_children(batch):
            for column in self._by_item.get(each.item, ()):
                name, index = column.variable, column.index
                if not name:  # of an item alone only the age matters
                    column.extend(each.log_time_ns, np.ones(len(each.log_time_ns)))
                elif index is None or "parent_seq" not in each.columns:
                    column.extend(each.log_time_ns, batch_column(each, name, index))
                else:
                    values = child_row_column(batch, each, name, index)
                    column.extend(batch.log_time_ns, values)

    def take(self, status: Status) -> None:
        """Add the level and the outputs of a mode or component from its status."""
        for output, samples in self._by_mode.get((status.component, status.mode), ()):
            value = status.outputs.get(output) if output else status.level
            samples.extend(np.array([status.measured_ns], np.int64), single_value(value))

    def forget(self) -> None:
        """Forget everything, as at the beginning of an epoch."""
        for samples in self.of_monitors.values():
            samples.clear()
        for column in self.of_record.values():
            column.samples.clear()
            column.held_ns = None

    def forget_before(self, until_ns: int) -> None:
        """Forget what no longer matters at ``until_ns`` and later."""
        for samples in self.samples().values():
            samples.forget_before(until_ns - self.keep_ns)

    def snapshot(self, until_ns: int) -> dict[str, Any]:
        """Return samples older than the rows that will be read again, and all of monitors."""
        held = {
            a: last_sample(c.samples, until_ns - self.keep_ns) for a, c in self.of_record.items()
        }
        return {
            "columns": {address: sample for address, sample in held.items() if sample is not None},
            "outputs": {address: _pairs(s) for address, s in self.of_monitors.items()},
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on with what ``snapshot`` returned."""
        self.forget()
        for address, (at_ns, value) in snapshot["columns"].items():
            column = self.of_record[address]
            column.samples.extend(np.array([at_ns], np.int64), single_value(from_json(value)))
            column.held_ns = at_ns
        for address, pairs in snapshot["outputs"].items():
            for at_ns, value in pairs:
                array = single_value(from_json(value))
                self.of_monitors[address].extend(np.array([at_ns], np.int64), array)


def _pairs(samples: Samples) -> list[list[Any]]:
    plain = samples.column().tolist()
    return [[at, as_json(v)] for at, v in zip(samples.times_ns.tolist(), plain, strict=True)]


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


class ConditionTracker:
    """All conditions of an analysis: rows and statuses in, symptoms out when they change.

    They are evaluated every quarter of a second.
    """

    records = True

    def __init__(self, fmea: Fmea) -> None:
        named = {s.id: s.condition for s in fmea.symptoms.values() if s.condition is not None}
        self._sizes = SymptomSizes(fmea)
        measures = {name: of.measure.expression for name, of in self._sizes.scales.items()}
        read = (*named.values(), *measures.values())
        history_ns = max((one.history_ns for one in read), default=0)
        addresses = dict.fromkeys(name for one in read for name in one.addresses())
        self._columns = AddressColumns(addresses, max(history_ns, FRESH_NS) + _MARGIN_NS)
        samples = self._columns.samples()
        self._all = [TrackedCondition(name, one, samples) for name, one in named.items()]
        self._measures = {
            name: TrackedCondition(name, one, samples) for name, one in measures.items()
        }
        self._forgot_ns = 0

    @property
    def items(self) -> frozenset[str]:
        """Names of the items whose rows are read."""
        return self._columns.items

    @property
    def history_s(self) -> float:
        """Return how far back rows have to be fed again after ``resume``, seconds."""
        return self._columns.keep_ns / NS if self._all or self._measures else 0.0

    @property
    def troubles(self) -> dict[str, str]:
        """Return the conditions whose last evaluation failed, with the reason."""
        every = (*self._measures.values(), *self._all)
        return {one.id: one.trouble for one in every if one.trouble}

    def begin(self, at_ns: int) -> list[Symptom]:
        """Begin an epoch, in which nothing is known; return the symptoms that become unknown."""
        self._columns.forget()
        self._sizes.begin()
        self._forgot_ns = at_ns
        return [found for one in self._all for found in one.begin(at_ns)]

    def feed(self, batch: Batch) -> None:
        """Take rows of any item."""
        self._columns.feed(batch)

    def take(self, status: Status) -> None:
        """Add a status of a monitor."""
        self._columns.take(status)

    def receive(self, found: Sequence[object]) -> None:
        """Add the statuses: conditions may read levels and outputs; and the symptoms to measure."""
        for one in found:
            if isinstance(one, Status):
                self._columns.take(one)
            elif isinstance(one, Symptom):
                self._sizes.take(one)

    def advance(self, after_ns: int, until_ns: int) -> list[Symptom]:
        """Return the symptoms that change in ``(after_ns, until_ns]``, in order of time."""
        found: list[Symptom] = []
        while (self._all or self._measures) and after_ns < until_ns:
            end_ns = min(until_ns, after_ns + _BLOCK_NS)
            found += self._block(ticks(QUARTER_NS, after_ns, end_ns))
            after_ns = end_ns
        if until_ns - self._forgot_ns >= _FORGET_NS:
            self._forgot_ns = until_ns
            self._columns.forget_before(until_ns)
        return found

    def _block(self, instants: IntArray) -> list[Symptom]:
        if not len(instants):
            return []
        fresh = SampleFreshness(instants)
        found = [symptom for one in self._all for symptom in one.look(instants, fresh)]
        for symptom in found:
            self._sizes.take(symptom)
        found += self._sizes.look(instants, self._measured)
        found.sort(key=lambda symptom: symptom.confirmed_ns or 0)
        return found

    def _measured(self, name: str, instants: IntArray) -> list[float]:
        return self._measures[name].values(instants)

    def snapshot(self, until_ns: int) -> dict[str, Any]:
        """Return the state needed by ``resume``, as JSON, without the rows of ``history_s``."""
        states = {one.id: one.state for one in self._all}
        sizes = self._sizes.snapshot()
        return {**self._columns.snapshot(until_ns), "states": states, "sizes": sizes}

    def resume(self, snapshot: Mapping[str, Any], until_ns: int) -> None:
        """Go on from what ``snapshot`` returned."""
        self._forgot_ns = until_ns
        self._columns.resume(snapshot)
        for one in self._all:
            one.resume(snapshot["states"][one.id])
        if "sizes" in snapshot:  # not written by earlier versions
            self._sizes.resume(snapshot["sizes"])


class TrackedCondition:
    """One condition over time; unknown also while it reads samples that are no longer fresh."""

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
        self._delay_ns = expression.tree.for_ns if isinstance(expression.tree, HeldNode) else 0
        self._looked_ns: int | None = None

    def begin(self, at_ns: int) -> Iterator[Symptom]:
        """Begin an epoch, in which it is unknown; yield the symptom if it was known."""
        self._looked_ns = None
        yield from self._become("unknown", at_ns)

    def resume(self, state: SymptomState) -> None:
        """Go on from a state."""
        self.state, self._looked_ns = state, None

    def look(self, instants: IntArray, known: SampleFreshness) -> Iterator[Symptom]:
        """Yield its changes at instants, which are in order."""
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

    def values(self, instants: IntArray) -> list[float]:
        """Return its values at instants; NaN where they are not known."""
        known = SampleFreshness(instants)
        fresh = known.all_of(self._wanted)
        found = np.full(len(instants), np.nan)
        try:
            windows = known.windows(instants.tobytes())
            found[fresh] = self._expression.numbers(self._samples, instants, windows)[fresh]
        except _WRONG as error:
            self.trouble = str(error)
        return list(map(float, found))

    def _stays(self, fresh: Any) -> bool:
        """Return whether it cannot have changed since its last evaluation."""
        if not fresh.any():
            return self.state == "unknown"
        if self._timed or self._looked_ns is None or not fresh.all():
            return False
        newest = (int(s.times_ns[-1]) for s in self._samples.values() if len(s))
        return max(newest, default=0) <= self._looked_ns

    def _codes(self, instants: IntArray, known: SampleFreshness) -> Any:
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

    def _code(self, now: int, windows: WindowCache) -> int:
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


class SampleFreshness:
    """Values that conditions share at some instants, each computed once.

    These are the freshness of samples, and the results of windows.
    """

    def __init__(self, instants: IntArray) -> None:
        self._instants = instants
        self._always = np.ones(len(instants), bool)
        self._of: dict[str, Any] = {}
        self._windows: dict[int | bytes, WindowCache] = {}

    def windows(self, instants: int | bytes) -> WindowCache:
        """Return a cache of windows' results at an instant, or at some; evaluation fills it."""
        return self._windows.setdefault(instants, WindowCache())

    def all_of(self, wanted: Mapping[str, Samples]) -> Any:
        """Return at which instants all samples are fresh; they are named by their time axis."""
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
    """Return the time axis of an address: columns of an item share one, others do not."""
    is_column = "/" not in address and "[" not in address
    return address.partition(".")[0] if is_column else address


def _must_be_fresh(tree: ExpressionNode) -> Iterator[str]:
    """Yield the addresses that must be fresh: not those read only for age, count or null."""
    if isinstance(tree, AddressNode):
        yield tree.name
    elif not isinstance(tree, AgeNode) and not _tests_presence(tree):
        for child in children(tree):
            yield from _must_be_fresh(child)


def _tests_presence(tree: ExpressionNode) -> bool:
    return isinstance(tree, WindowNode | CallNode) and tree.name in ("count", "known")
