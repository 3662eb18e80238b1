"""Garbage: values that cannot be, such as NaN, counted over a window."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.config import Finding
from amberbox.core.mode import Input, Result, as_single, numbers, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now, is_one

ACCEPTS = ("variable", "list")
COLUMNS = True
PER_INPUT = True
TIMED = True
RESULTS = (
    Result("clean", "bool", "no more of it is garbage than is tolerated"),
    Result("garbage", "int", "how many values of the window are garbage", relation="<="),
    Result("share", "float", "how many of a hundred are", "%", relation="<="),
    Result("missing_s", "float", "how long until the window is full", "s", relation="<="),
)
SAMPLE = """\
name: wheel_garbage_monitor
monitor: garbage
description: the left wheel sends no impossible frames
mappings:
  - mapping:
      inputs: [wheel_left.velocity]
      outputs:
        - output: {name: wheel_left_clean, type: bool, expected: true}
        - output: {name: bad_frames, result: garbage, type: int}
arguments:
  min: -100
  max: 100
  window: 10 s
  tolerated: 1 %
"""


@dataclass(frozen=True, slots=True)
class GarbageOptions:
    """Values that are garbage besides NaN and infinity, and the share that is tolerated."""

    min: float = option(-inf, "what lies below is impossible")
    max: float = option(inf, "what lies above is impossible")
    allowed: Sequence[float] = option((), "the only values that are possible")
    mask: int | None = option(None, "the bits that a status word may have set: 0x1f")
    window: float = option(5.0, "over how long it is counted", unit="s")
    tolerated: float = option(0.0, "which share of garbage is still well", unit="%")

    def check(self) -> Iterator[Finding]:
        """Refuse what nothing can fulfil."""
        if not 0 < self.window < inf:
            yield "window", "must lie above 0"
        if not 0 <= self.tolerated < 100:
            yield "tolerated", "must lie between 0 % and 100 %"
        if not self.min <= self.max:
            yield "nothing lies between 'min' and 'max'"
        if self.mask is not None and self.mask < 0:
            yield "mask", "must not lie below 0"


Config = GarbageOptions


def history_s(config: GarbageOptions) -> float:
    """Return how far back it looks."""
    return config.window


def evaluate(config: GarbageOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Count over the window, including the value at its start.

    There is a result when the window is full, or when the garbage is already more than is tolerated
    of all values that the window will have at the present rate.
    """
    (entry,) = inputs
    total, garbage = _counted(config, entry, now)
    share = np.where(total > 0, 100 * garbage / np.maximum(total, 1), np.nan)
    mixed = (share > config.tolerated) & (garbage < total)
    missing_s, filled = _missing(config, entry, now, mixed)
    too_much = (garbage > 0) & (share * filled > config.tolerated)
    known = (total > 0) & ((missing_s <= 0) | too_much)
    clean = where_known(known, share <= config.tolerated)
    return {"clean": clean, "garbage": garbage, "share": share, "missing_s": missing_s}


def _missing(config: GarbageOptions, entry: Input, now: Now, mixed: Any) -> tuple[Any, Any]:
    """Return the time until a window is full, and the share of it that is filled (1: all).

    It is full if there was a value at its start, unless nothing was received for three quarters of
    it afterwards and several values since, or a single one that is ``mixed`` with the old one.
    """
    window_ns = round(config.window * NS)
    start, times_ns = now - window_ns, entry.samples.times_ns
    before, end = (times_ns.searchsorted(at, "right") for at in (start, now))
    times_ns = np.append(times_ns, np.int64(0))
    first_ns, last_ns = times_ns[np.minimum(before, end)], times_ns[np.maximum(end - 1, 0)]
    count = end - before
    is_gap = ((count > 1) | ((count == 1) & mixed)) & (4 * (now - first_ns) < window_ns)
    is_full = (before > 0) & ~is_gap
    missing_s = np.where(is_full, 0.0, np.where(count > 0, first_ns - start, window_ns) / NS)
    pace_ns = (last_ns - first_ns) / np.maximum(count - 1, 1)
    filled = np.where(is_full, 1.0, np.minimum(count * pace_ns / window_ns, 1.0))
    return missing_s[()], np.where((config.tolerated == 0) & (count > 0), 1.0, filled)[()]


def _counted(config: GarbageOptions, entry: Input, now: Now) -> tuple[Any, Any]:
    """Return the number of values in the windows, and how many of them are garbage."""
    near = Input(entry.name, entry.samples.within(now, config.window))
    near.parts = {name: part.within(now, config.window) for name, part in entry.parts.items()}
    counts = _in_lists(config, near) if "finite" in near.parts else _in_values(config, near)
    if is_one(now):
        return counts[0].sum(), counts[1].sum()
    window, before = near.over(now, config.window), now - round(config.window * NS)
    held = near.samples.last(before)
    total, garbage = (window.sum_of(n) + np.append(n, 0)[held] for n in counts)
    return total, garbage


def _in_values(config: GarbageOptions, entry: Input) -> tuple[Any, Any]:
    """Return for each sample whether it is known (1 or 0), and whether it is garbage."""
    values, null = numbers(entry.samples.values), entry.samples.null
    low, high = min(config.min, as_single(config.min)), max(config.max, as_single(config.max))
    good = np.isfinite(values) & (values >= low) & (values <= high)
    if config.allowed:
        good &= np.isin(values, [*config.allowed, *map(as_single, config.allowed)])
    if config.mask is not None:
        good &= _whole(values) & ~config.mask == 0
    known = np.ones(len(values), bool) if null is None else ~null
    return known.astype(np.int64), (known & ~good).astype(np.int64)


def _in_lists(config: GarbageOptions, entry: Input) -> tuple[Any, Any]:
    """Return for each row how long the list is, and how much of it is garbage at least."""
    columns = (entry.parts[name].column() for name in ("count", "finite", "min", "max"))
    count, finite, low, high = (np.ma.filled(column, np.nan) for column in columns)
    least, greatest = as_single(config.min), as_single(config.max)
    outside = (low < min(config.min, least)).astype(np.int64) + (high > max(config.max, greatest))
    length, good = np.maximum(_whole(count), 0), np.maximum(_whole(finite), 0)
    return length, np.clip(length - good + outside, 0, length)


def _whole(numbers: Any) -> Any:
    """Return numbers as integers, -1 for non-integers."""
    floats = numbers.astype(np.float64)
    is_whole = (np.abs(floats) < 1 << 53) & (np.trunc(floats) == floats)
    return np.where(is_whole, floats, -1).astype(np.int64)


def explain_unknown(config: GarbageOptions, results: Mapping[str, Any]) -> str:
    """Describe how long it still takes until the window is full."""
    missing_s = results["missing_s"]
    if not missing_s > 0:
        return ""
    return f"not judged for another {missing_s:.3g} s: it takes {config.window:g} s of values"


def explain(config: GarbageOptions, results: Mapping[str, Any]) -> str:
    """Describe how much of it is garbage."""
    if results["clean"] is not False:
        return ""
    return f"{results['share']:.3g} % of the values of the last {config.window:g} s are garbage"
