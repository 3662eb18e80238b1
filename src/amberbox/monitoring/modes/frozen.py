"""Frozen: values, or an item's own stamps, that stay the same while they should move."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.expression import Expression, parse
from amberbox.core.mode import FALSE, HOLD, TRUE, UNKNOWN, Input, Result
from amberbox.core.options import option
from amberbox.core.samples import Now, Samples, Window, is_one
from amberbox.core.standins import Finding
from amberbox.core.together import by_name, value_of

ACCEPTS = ("variable", "list", "item")
COLUMNS = True
PER_INPUT = True
TIMED = True
RESULTS = (
    Result("moving", "bool", "it moves; while it need not, this stays as it was"),
    Result("spread", "float", "greatest less least value of the window", relation=">="),
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


@dataclass(frozen=True, slots=True)
class Config:
    """What counts as moving, and when it should."""

    window: float = option(5.0, "how long it may stay the same", unit="s", aliases=["for"])
    should_move: Expression | None = option(
        None, "when it should move; without it, always", aliases=["while"]
    )
    tolerance: float = option(0.0, "how far it may move and still counts as the same")
    min: float = option(-inf, "what lies below is garbage, not movement")
    max: float = option(inf, "what lies above is garbage, not movement")

    def check(self) -> Iterator[Finding]:
        """Refuse what cannot be judged."""
        if not 0 < self.window < inf:
            yield "window", "must lie above 0"
        if not 0 <= self.tolerance < inf:
            yield "tolerance", "must not lie below 0"
        if self.should_move is not None and self.should_move.kind not in ("any", "condition"):
            yield "should_move", "must be a condition, such as wheel_left.setpoint != 0"
        if not self.min < self.max:
            yield "nothing lies between 'min' and 'max'"


def history_s(config: Config) -> float:
    """Return how far back it looks."""
    condition = config.should_move
    return config.window + (condition.history_ns / NS if condition is not None else 0.0)


def reads(config: Config) -> Sequence[str]:
    """Return what says that it should move."""
    return () if config.should_move is None else config.should_move.addresses()


def evaluate(config: Config, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Look for movement from the value in force when the window began; garbage is none."""
    entry, *others = inputs
    start = now - round(config.window * NS)
    low, high = (-inf, inf) if entry.is_item else (config.min, config.max)
    samples = entry.stamps if entry.is_item else entry.samples
    spread = _spread(samples, low, high, now, config.window)
    seen = samples.last(start) >= 0
    moving = _moving(spread > config.tolerance, _should_move(config, others, now), seen)
    return {"moving": moving, "spread": spread}


def _moving(moves: Any, should: Any, seen: Any) -> Any:
    if isinstance(moves, np.bool_):  # np.where costs more than all the rest
        return TRUE if moves else UNKNOWN if not seen else FALSE if should else HOLD
    return np.where(moves, TRUE, np.where(seen, np.where(should, FALSE, HOLD), UNKNOWN))


def _spread(samples: Samples, low: float, high: float, now: Now, seconds: float) -> Any:
    """Return greatest less least value, NaN where all is garbage."""
    near = samples.within(now, seconds)
    values, null = near.values.astype(np.float64), near.null
    bad = ~np.isfinite(values) | (values < low) | (values > high)
    bad = bad if null is None else bad | null
    if is_one(now):
        return np.ptp(values[~bad]) + 0.0 if not bad.all() else np.float64(np.nan)
    good = near.derived(values, bad)
    start, window = now - round(seconds * NS), Window(good, now, seconds)
    held = np.where(good.known(start), good.at(start), np.nan)
    return np.fmax(window.max(), held) - np.fmin(window.min(), held) + 0.0


def _should_move(config: Config, others: Sequence[Input], now: Now) -> Any:
    """Tell whether it should have moved all the time."""
    if config.should_move is None:
        return True
    condition = _throughout(config.should_move.text, round(config.window * NS))
    return value_of(condition, by_name(others, reads(config)), now) == 1


@lru_cache
def _throughout(text: str, duration_ns: int) -> Expression:
    return parse(f"({text}) for {duration_ns}ns")


def explain(config: Config, results: Mapping[str, Any]) -> str:
    """Say for how long it has not moved."""
    return f"has not moved for {config.window:g} s" if results["moving"] is False else ""
