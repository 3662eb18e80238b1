"""The contract of a monitor mode: a pure function from inputs to outputs, in one file.

A mode is a module whose file name is what ``monitor:`` says in a mode file. It defines

- ``Config``: a frozen dataclass, built from ``arguments:`` of the mode file (see ``core.config``);
- ``ACCEPTS``: what its inputs may be, a tuple of ``variable``, ``list``, ``item``, ``probe``;
- ``RESULTS``: what it finds out, a tuple of ``Result``; outputs of a mode file are bound to them;
- ``SAMPLE``: a mode file as one would write it, shown by ``amberbox plugins``, checked and run;
- ``evaluate(config, inputs, now)``: the results by name at ``now``, from the inputs.

``evaluate`` is called only where every input has a fresh value; for what is missing or stale the
status says so by itself. It must not keep anything between calls, look at a clock or touch the
machine. It may also define

- ``COLUMNS = True``: ``evaluate`` takes many instants at once (``now`` is an array) as well as
  one; everything the inputs give and everything numpy computes works for both. Otherwise it is
  called for one instant at a time, which is slower and simpler;
- ``PER_INPUT = True``: it is called for each input of a mapping alone. One output then says
  whether all are well, or there is one output for each;
- ``TIMED = True``, or ``timed(config)``: the results change as time passes, also without a new
  sample; it is then called every quarter of a second, not with every sample, but with both where
  it looks back less than half a second: no sample passes through such a window unseen;
- ``SEES_SILENCE = True``: it wants to be called also where its inputs are stale;
- ``PARTS = True``: an ``item`` input brings all columns of its rows in ``parts``;
- ``history_s(config)``: how far back it looks, in seconds; ``shortest_s(config)``: its shortest
  window, where that is another one;
- ``results_of(config, inputs, bools)``: the results of a mapping, where they depend on the
  arguments or on how many inputs and bool outputs it has (ints); outputs are bound to these, and
  ``RESULTS`` are those that it always has;
- ``reads(config)``: further addresses that it reads; they follow the inputs of the mapping;
- ``probe_of(config, text)``: kind and subject of the probe that an input means which is no
  recorded variable; without it ``PROBE`` is the kind and the text is the subject;
- ``explain(config, results)``: one sentence on why the results are not as they should be; bools
  that are not known are None there, numbers NaN;
- ``reason(config, given)``: the same by what was looked at (``Given``), with the values that were
  measured and their limits; where it returns nothing, ``explain`` is asked;
- ``explain_unknown(config, results)``: one sentence on what is missing where a result is not known.

A verdict needs evidence: before a window is full, or where its rows are missing, a bool is UNKNOWN
unless what is still missing cannot change it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from math import isfinite, isnan
from typing import Any, Literal, Protocol

import numpy as np

from amberbox.core.expression_reason import number_text
from amberbox.core.flow import Flow
from amberbox.core.samples import Now, Samples, Window

Kind = Literal["variable", "list", "item", "probe"]
"""What an input may be: a variable, a list of numbers, a whole item, or what a probe measures."""

ResultType = Literal["bool", "int", "float", "string"]

FALSE, TRUE, UNKNOWN, HOLD = 0, 1, 2, 3
"""What a bool result may be, beside plain bools: HOLD stays at what it was last, and is nominal
where there was nothing before."""


@dataclass(frozen=True, slots=True)
class Result:
    """One thing that a mode finds out.

    ``nominal`` is what a healthy robot gives: a bool output without ``expected`` expects it.
    ``relation`` says how an ``expected`` number is meant: the value equals it, or is at least or
    at most that.
    """

    name: str
    type: ResultType
    doc: str
    unit: str = ""
    nominal: bool = True
    relation: Literal["==", ">=", "<="] = "=="


@dataclass(slots=True, eq=False)
class Input:
    """One input of a mode, as it looks at the instants asked for.

    ``name`` is its text in the mode file. For a ``list`` the values are the mean of what is
    finite in each row, and ``parts`` has ``count finite min max mean`` of each; for a probe they
    are its ``ok``, and ``parts`` are all that it measures. An ``item`` has no values of its own:
    ``samples`` are then ``flow.rows``, the count of its rows.
    """

    name: str
    samples: Samples = field(default_factory=Samples)
    flow: Flow = field(default_factory=Flow)
    stamps: Samples = field(default_factory=Samples)
    """The own stamps (ns) of the item's rows, by their time of receipt."""
    parts: Mapping[str, Samples] = field(default_factory=dict)
    labels: Mapping[int, str] = field(default_factory=dict)
    """Names of its values, as the constants of the message say."""

    def at(self, now: Now) -> Any:
        """Return the value at ``now``."""
        return self.samples.at(now)

    @property
    def is_item(self) -> bool:
        """Tell whether it is a whole item, which has no values."""
        return self.samples is self.flow.rows

    def over(self, now: Now, seconds: float) -> Window:
        """Return the window of the last ``seconds``."""
        return Window(self.samples, now, seconds)

    def part(self, name: str) -> Input:
        """Return another variable of the same probe, or another figure of the same list."""
        return Input(f"{self.name} {name}", self.parts[name], self.flow, self.stamps)

    def age_s(self, now: Now) -> Any:
        """Return for how long nothing of its item has been received, before any filter."""
        return self.flow.age_s(now)

    def rate_hz(self, now: Now, seconds: float) -> Any:
        """Return messages of its item per second over the last ``seconds``, before any filter."""
        return self.flow.rate_hz(now, seconds)


@dataclass(frozen=True, slots=True)
class Given:
    """What a mode looked at when its results were bad, for people.

    ``inputs`` are those it was called with, ``unit`` is that of its numbers, empty if nobody says.
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


def shortest_window_s(module: Any, config: Any) -> float:
    """Return the shortest window that a mode looks back over, in seconds; 0 if it has none."""
    shortest = getattr(module, "shortest_s", None) or getattr(module, "history_s", None)
    return 0.0 if shortest is None else float(shortest(config))


class Evaluate(Protocol):
    """The function that a mode is."""

    def __call__(self, config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
        """Return the results by name at ``now``; what is left out is unknown."""


@cache
def as_single(number: float) -> float:
    """Return a number as single precision has it: most messages hold 0.1 as 0.10000000149.

    Compare with both where a value may lie right on a limit.
    """
    with np.errstate(over="ignore"):
        rounded = float(np.float32(number))
    return rounded if isfinite(rounded) else float(number)


def where_known(known: Any, value: Any) -> Any:
    """Return the bools of ``value`` where they are known, UNKNOWN elsewhere."""
    if isinstance(known, bool | np.bool_):  # np.where costs more than all the rest
        return value if known else UNKNOWN
    return np.where(known, value, UNKNOWN)


def with_hysteresis(good: Any, bad: Any) -> Any:
    """Return FALSE where it is bad, TRUE where it is good, and what it was in between."""
    if isinstance(bad, bool | np.bool_):
        return FALSE if bad else TRUE if good else HOLD
    return np.where(bad, FALSE, np.where(good, TRUE, HOLD))
