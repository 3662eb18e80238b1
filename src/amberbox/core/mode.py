"""The contract of a monitor mode: a pure function from inputs to outputs, in one file.

A mode is a module whose file name is the value of ``monitor:`` in a mode file. It defines

- ``Config``: a frozen dataclass, built from ``arguments:`` of the mode file (see ``core.config``);
- ``ACCEPTS``: what its inputs may be, a tuple of ``variable``, ``list``, ``item``, ``probe``;
- ``RESULTS``: its results, a tuple of ``Result``; outputs of a mode file are bound to them;
- ``SAMPLE``: a mode file as one would write it, shown by ``amberbox plugins``, checked and run;
- ``evaluate(config, inputs, now)``: the results by name at ``now``, from the inputs.

``evaluate`` is called only where every input has a fresh value; the status of missing and stale
inputs is set by the engine. It must not keep anything between calls, look at a clock or touch the
machine. It may also define

- ``COLUMNS = True``: ``evaluate`` takes many instants at once (``now`` is an array) as well as
  one; everything the inputs give and everything numpy computes works for both. Otherwise it is
  called for one instant at a time, which is slower and simpler;
- ``PER_INPUT = True``: it is called for each input of a mapping alone. One output then covers all
  inputs, or there is one output for each;
- ``TIMED = True``, or ``timed(config)``: the results change as time passes, also without a new
  sample; it is then called every quarter of a second, not with every sample, but with both where
  it looks back less than half a second: no sample passes through such a window unseen;
- ``SEES_SILENCE = True``, or ``in_silence(config)``: it is called also where its inputs are stale;
- ``PARTS = True``: an ``item`` input brings all columns of its rows in ``parts``;
- ``history_s(config)``: how far back it looks, in seconds; ``shortest_s(config)``: its shortest
  window, where that is another one;
- ``results_of(config, inputs, bools)``: the results of a mapping, where they depend on the
  arguments or on how many inputs and bool outputs it has (ints); outputs are bound to these, and
  ``RESULTS`` are those that it always has;
- ``input_problems(config, texts)``: argument and reason where arguments do not fit the inputs of
  the mode file, as ``check`` of a configuration does;
- ``measure(config, result, inputs)``: an expression of how large a fault of a result is, from the
  addresses of the inputs, or the name of another result; signed, empty where nothing says so;
- ``in_folder(config, folder)``: the arguments with what a file of the robot folder adds to them;
  all other functions get these. Raises AmberboxError where the file has mistakes;
- ``reads(config)``: further addresses that it reads; they follow the inputs of the mapping;
- ``probe_of(config, text)``: kind and subject of the probe that an input means which is no
  recorded variable; without it ``PROBE`` is the kind and the text is the subject;
- ``explain(config, results)``: one sentence on why the results are not as they should be; bools
  that are not known are None there, numbers NaN;
- ``reason(config, given)``: the same by what was looked at (``Given``), with the values that
  were measured and their limits; where it returns nothing, ``explain`` is asked;
- ``explain_unknown(config, results)``: one sentence on what is missing where a result is not
  known.

A verdict needs evidence: before a window is full, or where its rows are missing, a bool is UNKNOWN
unless what is still missing cannot change it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from math import isfinite, isnan
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.expression import Expression, number_text
from amberbox.core.expressions.values import joined_times
from amberbox.core.flow import Flow
from amberbox.core.samples import Now, Samples, Window, is_one
from amberbox.core.types import IntArray

# a variable, a list of numbers, a whole item, or what a probe measures
Kind = Literal["variable", "list", "item", "probe"]

ResultType = Literal["bool", "int", "float", "string"]

# Bool results beside plain bools; HOLD keeps the last value, nominal if there was none.
FALSE, TRUE, UNKNOWN, HOLD = 0, 1, 2, 3


@dataclass(frozen=True, slots=True)
class Result:
    """One result of a mode.

    ``nominal`` is the value of a healthy robot: a bool output without ``expected`` expects it.
    ``relation`` is how a value compares with an ``expected`` number: equal, at least or at most.
    """

    name: str
    type: ResultType
    doc: str
    unit: str = ""
    nominal: bool = True
    relation: Literal["==", ">=", "<="] = "=="


@dataclass(slots=True, eq=False)
class Input:
    """One input of a mode, evaluated at the requested instants.

    ``name`` is its text in the mode file. For a ``list`` the values are the mean of the finite
    elements of each row, and ``parts`` has ``count finite min max mean`` of each; for a probe they
    are its ``ok``, and ``parts`` are all of its measurements. An ``item`` has no values of its own:
    ``samples`` are then ``flow.rows``, the count of its rows.
    """

    name: str
    samples: Samples = field(default_factory=Samples)
    flow: Flow = field(default_factory=Flow)
    stamps: Samples = field(default_factory=Samples)
    """The own stamps (ns) of the item's rows, by their time of receipt."""
    parts: Mapping[str, Samples] = field(default_factory=dict)
    labels: Mapping[int, str] = field(default_factory=dict)
    """Names of its values: the constants of the message."""

    def at(self, now: Now) -> Any:
        """Return the value at ``now``."""
        return self.samples.at(now)

    @property
    def is_item(self) -> bool:
        """Return whether it is a whole item, which has no values."""
        return self.samples is self.flow.rows

    def over(self, now: Now, seconds: float) -> Window:
        """Return the window of the last ``seconds``."""
        return Window(self.samples, now, seconds)

    def part(self, name: str) -> Input:
        """Return another variable of the same probe, or another figure of the same list."""
        return Input(f"{self.name} {name}", self.parts[name], self.flow, self.stamps)

    def age_s(self, now: Now) -> Any:
        """Return the time since its item was last received, before any filter, in seconds."""
        return self.flow.age_s(now)

    def rate_hz(self, now: Now, seconds: float) -> Any:
        """Return messages of its item per second over the last ``seconds``, before any filter."""
        return self.flow.rate_hz(now, seconds)


@dataclass(frozen=True, slots=True)
class Given:
    """The values that a mode evaluated when its results were bad, for its reason.

    ``inputs`` are those it was called with, ``unit`` is that of its numbers, empty if unknown.
    """

    inputs: Sequence[Input]
    now_ns: int
    unit: str = ""

    def measured(self, value: float) -> str:
        """Write a number with the unit."""
        return f"{number_text(value)} {self.unit}".rstrip()

    def limited(self, value: float, low: float, high: float) -> str:
        """Write a number with the limit that it has crossed: ``48.1 °C, at most 45``."""
        if isnan(value):
            return "no number"
        limit = f"at least {low:g}" if value < low else f"at most {high:g}"
        return f"{self.measured(value)}, {limit}"


class Evaluate(Protocol):
    """The ``evaluate`` function of a mode."""

    def __call__(self, config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
        """Return the results by name at ``now``; results that are left out are unknown."""


@cache
def as_single(number: float) -> float:
    """Return a number rounded to float32: most messages hold 0.1 as 0.10000000149.

    Compare with both values if a number may be exactly at a limit.
    """
    with np.errstate(over="ignore"):
        rounded = float(np.float32(number))
    return rounded if isfinite(rounded) else float(number)


def beyond_limits(value: str, low: float, high: float) -> str:
    """Return the expression of a value minus the limit that it violates; 0 between the limits."""
    if low == high:
        return f"{value} - {low!r}"
    above = f"max({value} - {high!r}, 0)" if isfinite(high) else ""
    below = f"min({value} - {low!r}, 0)" if isfinite(low) else ""
    return " + ".join(filter(None, (above, below)))


def where_known(known: Any, value: Any) -> Any:
    """Return the bools of ``value`` where they are known, UNKNOWN elsewhere."""
    if isinstance(known, bool | np.bool_):  # np.where costs more than all the rest
        return value if known else UNKNOWN
    return np.where(known, value, UNKNOWN)


def with_hysteresis(good: Any, bad: Any) -> Any:
    """Return FALSE where it is bad, TRUE where it is good, and HOLD in between."""
    if isinstance(bad, bool | np.bool_):
        return FALSE if bad else TRUE if good else HOLD
    return np.where(bad, FALSE, np.where(good, TRUE, HOLD))


@cache
def place_name(place: int) -> str:
    """Return the name of an input in expressions of a mode: ``input_1`` is the first."""
    return f"input_{place + 1}"


@cache
def reads_of(*expressions: Expression | None) -> tuple[str, ...]:
    """Return the addresses that expressions read, each once, without inputs of the mapping."""
    names = [name for one in expressions if one is not None for name in one.addresses()]
    return tuple(dict.fromkeys(name for name in names if not _is_place(name)))


def by_name(inputs: Sequence[Input], reads: Sequence[str]) -> dict[str, Input]:
    """Return the inputs of a mode by name: those of the mapping by position, then those of
    ``reads``.
    """
    own = len(inputs) - len(reads)
    names = [*(place_name(place) for place in range(own)), *reads]
    return dict(zip(names, inputs, strict=True))


def value_of(expression: Expression, inputs: Mapping[str, Input], now: Now) -> Any:
    """Return the value of an expression; NaN where it is unknown, bools as 0 and 1."""
    samples = {name: inputs[name].samples for name in expression.addresses()}
    return expression.numbers(samples, now)


def sample_times(inputs: Iterable[Input], now: Now, seconds: float) -> IntArray:
    """Return when any of the inputs changed in the windows before ``now``, and right before."""
    first_ns, until = (now, now) if is_one(now) else (int(np.min(now)), int(np.max(now)))
    since = first_ns - round(seconds * NS)
    parts = {}
    for one in inputs:
        times_ns = one.samples.times_ns
        first, end = (int(times_ns.searchsorted(t, "right")) for t in (since, until))
        part = times_ns[max(first - 1, 0) : end]
        parts[part.tobytes()] = part  # variables of one message share their times
    return joined_times(list(parts.values()))


def numbers_at(one: Input, now: Now | IntArray) -> Any:
    """Return the value as a number at each instant; NaN where it is unknown or infinite."""
    samples = one.samples
    if not len(samples):
        return np.full(np.shape(now), np.nan)[()]
    last, null = samples.last(now), samples.null
    if is_one(now):
        known = last >= 0 and (null is None or not null[last])
        return finite(numbers(samples.values[last])[()]) if known else np.float64(np.nan)
    column = numbers(samples.values[last])
    known = (last >= 0) & np.isfinite(column)
    return np.where(known if null is None else known & ~null[last], column, np.nan)


def finite(values: Any) -> Any:
    """Return numbers that are finite, NaN in place of others."""
    if isinstance(values, float):  # np.where costs more than all the rest
        return values if isfinite(values) else np.float64(np.nan)
    return np.where(np.isfinite(values), values, np.nan)


def numbers(values: Any) -> NDArray[np.float64]:
    """Return values as numbers; texts and the like are NaN."""
    column = np.asarray(values, object if isinstance(values, str) else None)
    if column.dtype != object:
        return column.astype(np.float64)
    plain = [v if isinstance(v, int | float | np.number) else np.nan for v in column.flat]
    return np.array(plain, np.float64).reshape(column.shape)


def middles(values: NDArray[np.float64]) -> tuple[Any, Any]:
    """Return the two middle numbers over the first axis, which are the same if the count is odd.

    Numbers that are not finite do not count; if there are no others, the middle is NaN.
    """
    if not len(values):
        unknown = np.full(values.shape[1:], np.nan)
        return unknown, unknown
    if np.isfinite(values).all():
        ordered = np.sort(values, axis=0)
        return ordered[(len(values) - 1) // 2], ordered[len(values) // 2]
    ordered = np.sort(np.where(np.isfinite(values), values, np.nan), axis=0)
    count = np.isfinite(ordered).sum(axis=0)[None]
    places = (np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(values) - 1))
    low, high = (np.take_along_axis(ordered, place, 0)[0] for place in places)
    return low, high


def medians(times_ns: IntArray, rows: NDArray[np.float64], now: Now, seconds: float) -> Any:
    """Return the median of each row over the ``seconds`` before each instant.

    ``rows`` have a value for each time. NaN does not count; where a window is empty the last
    value before it does, and without any it is NaN. The result has the shape of ``now`` for each
    row.
    """
    until = np.atleast_1d(np.asarray(now, np.int64))
    ends = times_ns.searchsorted(until, "right")
    starts = np.minimum(times_ns.searchsorted(until - round(seconds * NS), "right"), ends - 1)
    found = np.full((len(until), len(rows)), np.nan)
    for place, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        if end:
            found[place] = _median(rows[:, start:end])
    return found.T.reshape(len(rows), *np.shape(now))


def _median(rows: NDArray[np.float64]) -> Any:
    """Return the median of each row, which has one column at least; infinity counts, NaN not."""
    ordered = np.sort(rows, axis=1)
    if not np.isnan(ordered[:, -1]).any():
        low, high = ordered[:, (rows.shape[1] - 1) // 2], ordered[:, rows.shape[1] // 2]
        return np.where(low == high, low, (low + high) / 2)
    count = np.count_nonzero(~np.isnan(ordered), axis=1)
    which = np.arange(len(rows))
    low = ordered[which, (count - 1) // 2]
    high = ordered[which, np.minimum(count // 2, rows.shape[1] - 1)]
    return np.where(low == high, low, (low + high) / 2)


def worst_of(values: NDArray[np.float64], limit: float) -> Any:
    """Return the greatest number; NaN if something is unknown and all other numbers are within
    limits.
    """
    greatest = np.fmax.reduce(values)
    unknown = np.isnan(values).any(axis=0) & (greatest <= limit)
    return np.where(unknown, np.nan, greatest)[()]


def _is_place(name: str) -> bool:
    return name.startswith("input_") and name.removeprefix("input_").isdigit()
