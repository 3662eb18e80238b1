"""Recorded variables for unit tests: newest values, and waiting for a condition."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from amberbox.blackbox.query.record import LocalRecord
from amberbox.blackbox.retention.live_reader import LiveReader
from amberbox.blackbox.store.store import Store, is_locked, open_store
from amberbox.core.clock import NS
from amberbox.core.conditions import (
    STATUS_ITEM,
    ConditionWatcher,
    WatchedCondition,
    condition_problem,
    item_of,
)
from amberbox.core.errors import UsageError
from amberbox.core.expression import Expression, parse, variable_text

_LOOK_S = 0.05
_BEFORE_S = 2.0
_BACK_S = (10.0, 600.0)  # where the newest value is looked for, before everything is read


@dataclass(frozen=True)
class RecordedValue:
    """A value of a variable and when it was received, nanoseconds since the Unix epoch."""

    value: Any
    received_ns: int

    @property
    def age_s(self) -> float:
        """Return how old it is, in seconds of this computer's clock."""
        return (time.time_ns() - self.received_ns) / NS


class Variable:
    """A recorded variable of the robot, by its address ``item.variable``.

    Parts of the variable may be separated as in its message (``sim_odom.pose/position/x``).
    """

    def __init__(self, record: LocalRecord, address: str) -> None:
        item, dot, variable = address.partition(".")
        self.address = f"{item}{dot}{variable.replace('/', '_')}"
        self._record = record
        expression = parse(self.address)
        if not dot or expression.addresses() == () or not variable:
            hint = "such as sim_odom.pose_position_x; amberbox items lists what is recorded"
            raise UsageError(f"'{address}' is no address of a variable", hint)
        self._item, _, self._name = self.address.partition(".")

    @property
    def newest(self) -> RecordedValue:
        """Return the newest recorded value; raises UsageError where there is none."""
        __tracebackhide__ = True
        for back_s in (*_BACK_S, None):
            rows = self._rows(back_s)
            if rows:
                return rows[-1]
        raise UsageError(f"nothing of {self.address} is recorded", "does its source run?")

    @property
    def value(self) -> Any:
        """Return the newest recorded value alone."""
        __tracebackhide__ = True
        return self.newest.value

    def last(self, seconds: float) -> list[RecordedValue]:
        """Return the values of the last seconds of the record, in order of time."""
        __tracebackhide__ = True
        rows = self._rows(seconds)  # from then on: while it is read, more may be written
        since_ns = rows[-1].received_ns - round(seconds * NS) if rows else 0
        return [row for row in rows if row.received_ns >= since_ns]

    def wait_for(self, comparison: str, within_s: float) -> RecordedValue:
        """Wait until a comparison holds, such as ``> 0.5 for 2s``; return the newest value.

        Raises AssertionError when it does not within so many seconds.
        """
        __tracebackhide__ = True
        wait_for(self._record, f"{self.address} {comparison}", within_s)
        return self.newest

    def _rows(self, back_s: float | None) -> list[RecordedValue]:
        __tracebackhide__ = True
        since = None if back_s is None else f"-{back_s:g}s"
        try:
            table = self._record.query(self._item, [self._name, "received"], since)
        except UsageError as error:
            raise UsageError(error.what, error.hint) from None  # pytest shows no frames of ours
        rows = zip(table.values(self._name), table.values("received"), strict=True)
        return [RecordedValue(value, received_ns) for value, received_ns in rows]


def wait_for(record: LocalRecord, text: str, within_s: float) -> None:
    """Wait until an expression over variables, outputs and statuses becomes true, or is.

    Raises AssertionError when it does not within so many seconds, UsageError for an expression that
    is none, names what is not recorded, or when the record does not grow.
    """
    __tracebackhide__ = True  # pytest shows the line of the test
    expression = parse(text)
    problem = condition_problem(expression, with_monitors=True)
    if problem:
        raise UsageError(f"'{text}' {problem}")
    store = open_store(record.path)
    watch = _LiveCondition(store, expression)
    end_s = time.monotonic() + within_s
    while not watch.is_true():
        if watch.problems:
            raise UsageError(f"'{text}' cannot be evaluated: {'; '.join(watch.problems)}")
        if not is_locked(store, "main"):
            hint = "start it: amberbox run FOLDER, or amberbox record FOLDER"
            raise UsageError("no recorder runs, so the record does not grow", hint)
        if time.monotonic() > end_s:
            seen = ", ".join(_shown(record, address) for address in expression.addresses())
            raise AssertionError(f"not within {within_s:g} s: {text} ({seen})")
        time.sleep(_LOOK_S)


class _LiveCondition:
    """A condition over a record that grows."""

    def __init__(self, store: Store, expression: Expression) -> None:
        self._watched = {"it": WatchedCondition(expression)}
        self._conditions = ConditionWatcher(self._watched)
        self._reads_status = STATUS_ITEM in map(item_of, expression.addresses())
        back_s = self._conditions.history_ns / NS + _BEFORE_S
        self._reader = LiveReader(store, self._conditions.items, None, back_s)
        self._run: int | None = None
        self._store = store

    @property
    def problems(self) -> Sequence[str]:
        """Return why it cannot be evaluated."""
        return list(self._conditions.problems.values())

    def is_true(self) -> bool:
        """Read what is new; return whether it is true now, or has been since the last call."""
        is_first = self._run is None
        was_true = False
        for part in self._reader.step():
            if part.run != self._run:
                self._conditions = ConditionWatcher(self._watched)  # nothing is known
                self._run = part.run
            for batch, times_ns in part.batches:
                self._conditions.add(batch, times_ns)
            until_ns = part.until_ns
            if self._reads_status and part.watched_ns is not None:
                until_ns = min(until_ns, part.watched_ns)
            was_true = bool(self._conditions.edges(until_ns)) and not is_first
        # what was recorded before the recorder ended says nothing of now
        return is_locked(self._store, "main") and (was_true or bool(self._conditions.true))


def _shown(record: LocalRecord, address: str) -> str:
    if "." not in address or "/" in address or "(" in address:
        return variable_text(address)
    try:
        newest = Variable(record, address).newest
    except UsageError as error:
        return error.what
    return f"{address} is {newest.value}, {newest.age_s:.1f} s old"
