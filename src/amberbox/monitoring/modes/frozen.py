"""Frozen: values, or an item's own stamps, that stay the same while they should move."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf, nan
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.config import Finding
from amberbox.core.expression import Expression, parse
from amberbox.core.expressions.values import joined_times
from amberbox.core.mode import (
    FALSE,
    HOLD,
    TRUE,
    UNKNOWN,
    Input,
    Result,
    by_name,
    numbers,
    reads_of,
    value_of,
)
from amberbox.core.options import option
from amberbox.core.samples import Now, Samples, Window, is_one
from amberbox.core.types import IntArray

ACCEPTS = ("variable", "list", "item")
COLUMNS = True
PER_INPUT = True
TIMED = True
RESULTS = (
    Result("moving", "bool", "it moves; while it need not, this stays as it was"),
    Result("spread", "float", "greatest less least value of the window", relation=">="),
    Result("gap_s", "float", "while nothing moves: without a valid row", "s", relation="<="),
)
SAMPLE = """\
name: wheel_frozen_monitor
monitor: frozen
description: the encoder of the left wheel moves when the wheel is told to turn
mappings:
  - mapping:
      inputs: [wheel_left.velocity]
      outputs:
        - output: {name: encoder_moving, type: bool, expected: true}
arguments:
  for: 2 s
  while: wheel_left.setpoint != 0
  min: -100
  max: 100
"""
_MOST_MISSING = 0.75  # of a window: two rows in it, one of them late, are enough


@dataclass(frozen=True, slots=True)
class FrozenOptions:
    """The criteria for a changing value, and the condition under which it should change."""

    window: float = option(5.0, "how long it may stay the same", unit="s", aliases=["for"])
    should_move: Expression | None = option(
        None, "when it should move; without it, always", aliases=["while"]
    )
    tolerance: float = option(0.0, "how far it may move and still counts as the same")
    min: float = option(-inf, "what lies below is garbage, not movement")
    max: float = option(inf, "what lies above is garbage, not movement")
    valid: Expression | None = option(
        None, "what holds of a row that is evidence; without it, every row is"
    )

    def check(self) -> Iterator[Finding]:
        """Yield combinations of arguments that cannot be evaluated."""
        if not 0 < self.window < inf:
            yield "window", "must lie above 0"
        if not 0 <= self.tolerance < inf:
            yield "tolerance", "must not lie below 0"
        for name in ("should_move", "valid"):
            asked: Expression | None = getattr(self, name)
            if asked is not None and asked.kind not in ("any", "condition"):
                yield name, "must be a condition, such as wheel_left.setpoint != 0"
        if not self.min < self.max:
            yield "nothing lies between 'min' and 'max'"


Config = FrozenOptions


def history_s(config: FrozenOptions) -> float:
    """Return how far back it looks."""
    asked = (config.should_move, config.valid)
    return config.window + max(0 if one is None else one.history_ns for one in asked) / NS


def reads(config: FrozenOptions) -> Sequence[str]:
    """Return the addresses of the conditions for moving and for valid rows."""
    return reads_of(config.should_move, config.valid)


def evaluate(config: FrozenOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Detect changes between valid values, beginning with the value at the start of the window.

    A change is detected at once. The value is frozen if valid values were received throughout the
    window.
    """
    entry = inputs[0]
    named = by_name(inputs, reads(config))
    low, high = (-inf, inf) if entry.is_item else (config.min, config.max)
    near = (entry.stamps if entry.is_item else entry.samples).within(now, config.window)
    values = numbers(near.values)
    bad = ~np.isfinite(values) | (values < low) | (values > high)
    samples = near.derived(values, bad if near.null is None else bad | near.null)
    start = now - round(config.window * NS)
    rows = samples
    if config.valid is not None:
        first = int(np.min(start))  # only rows after it lie in a window
        valid = _is_valid(config, named, np.maximum(samples.times_ns, first))
        rows = samples.derived(samples.values, samples.null | ~valid)
    known = samples.known(start) & _is_valid(config, named, start)
    held = np.where(known, samples.at(start), np.nan)[()]
    window = Window(rows, now, config.window)
    spread = np.fmax(window.max(), held) - np.fmin(window.min(), held) + 0.0
    gap_s = _gaps_s(config, entry, samples, named, now, spread)
    seen, should = gap_s <= _MOST_MISSING * config.window, _should_move(config, named, now)
    moving = _moving(spread > config.tolerance, should, seen)
    return {"moving": moving, "spread": spread, "gap_s": gap_s}


def _moving(moves: Any, should: Any, seen: Any) -> Any:
    if isinstance(moves, np.bool_):  # np.where costs more than all the rest
        return TRUE if moves else UNKNOWN if not seen else FALSE if should else HOLD
    return np.where(moves, TRUE, np.where(seen, np.where(should, FALSE, HOLD), UNKNOWN))


def _is_valid(config: FrozenOptions, named: Mapping[str, Input], times_ns: Now) -> Any:
    """Return whether the values at each time are valid evidence."""
    return config.valid is None or value_of(config.valid, named, times_ns) == 1


def _gaps_s(
    config: FrozenOptions,
    entry: Input,
    samples: Samples,
    named: Mapping[str, Input],
    now: Now,
    spread: Any,
) -> Any:
    """Return the longest time without evidence where nothing moves, NaN where something does."""
    still = ~(spread > config.tolerance)
    if is_one(now):
        return _gap_s(config, entry, samples, named, int(now)) if still else nan
    instants = np.asarray(now)
    gaps_s = np.full(len(instants), nan)
    for place in np.flatnonzero(still).tolist():
        gaps_s[place] = _gap_s(config, entry, samples, named, int(instants[place]))
    return gaps_s


def _gap_s(
    config: FrozenOptions, entry: Input, samples: Samples, named: Mapping[str, Input], now: int
) -> float:
    """Return the longest time of a window without evidence; NaN before it is full.

    A message that a change filter left out shows that the value has not changed.
    """
    start = now - round(config.window * NS)
    received = joined_times(
        [entry.flow.received_ns(start, now), _near(samples.times_ns, start, now)]
    )
    received = _near(received, start, now)
    if not len(received) or received[0] > start:
        return nan
    good = samples.known(received) & _is_valid(config, named, np.maximum(received, start))
    return entry.flow.longest_gap_s(now, config.window, received[good])


def _near(times_ns: IntArray, since_ns: int, until_ns: int) -> IntArray:
    first, end = (int(times_ns.searchsorted(at, "right")) for at in (since_ns, until_ns))
    return times_ns[max(first - 1, 0) : end]


def _should_move(config: FrozenOptions, named: Mapping[str, Input], now: Now) -> Any:
    """Return whether it should have moved all the time."""
    if config.should_move is None:
        return True
    condition = _throughout(config.should_move.text, round(config.window * NS))
    return value_of(condition, named, now) == 1


@lru_cache
def _throughout(text: str, duration_ns: int) -> Expression:
    return parse(f"({text}) for {duration_ns}ns")


def explain(config: FrozenOptions, results: Mapping[str, Any]) -> str:
    """Describe for how long it has not moved."""
    return f"has not moved for {config.window:g} s" if results["moving"] is False else ""


def explain_unknown(config: FrozenOptions, results: Mapping[str, Any]) -> str:
    """Describe why there is no result: the window is not full, or valid rows are missing."""
    gap_s = results["gap_s"]
    if np.isnan(gap_s):
        return f"not judged before it has been seen for {config.window:g} s"
    return f"not judged: no valid row for {gap_s:.1f} s of the last {config.window:g} s"
