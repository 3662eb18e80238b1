"""Redundancy: what should be equal is, or equals what can be computed from other variables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from math import inf
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.config import Finding
from amberbox.core.expression import Expression
from amberbox.core.mode import (
    FALSE,
    Input,
    Result,
    by_name,
    finite,
    medians,
    middles,
    numbers_at,
    place_name,
    reads_of,
    sample_times,
    value_of,
    where_known,
    worst_of,
)
from amberbox.core.options import option
from amberbox.core.samples import Now

ACCEPTS = ("variable",)
COLUMNS = True
RESULTS = (
    Result("agree", "bool", "all members agree"),
    Result("residual", "float", "how far the worst member is off", relation="<="),
)
SAMPLE = """\
name: barometers_monitor
monitor: redundancy
description: the barometers of the four wheels measure the same air
mappings:
  - mapping:
      inputs: [wheel_1.pressure, wheel_2.pressure, wheel_3.pressure, wheel_4.pressure]
      outputs:
        - output: {name: barometer_1, type: bool}
        - output: {name: barometer_2, type: bool}
        - output: {name: barometer_3, type: bool}
        - output: {name: barometer_4, type: bool}
arguments:
  threshold: 10.0
  window: 1 s
"""


@dataclass(frozen=True, slots=True)
class RedundancyOptions:
    """The permitted deviation of a member, and its expected value."""

    threshold: float = option(doc="how far a member may be off, in its own unit")
    window: float = option(
        0.0, "the median of that long counts, so that single bad samples do not", unit="s"
    )
    formula: Expression | None = option(
        None,
        "what a member should be; the inputs are input_1, input_2 ..., and those it does not "
        "name are members (without it a member should be what its siblings are)",
    )

    def check(self) -> Iterator[Finding]:
        """Yield limits within which nothing can agree."""
        if not 0 <= self.threshold < inf:
            yield "threshold", "must be 0 or more"
        if not 0 <= self.window < inf:
            yield "window", "must be 0 or more"


Config = RedundancyOptions


def measure(config: RedundancyOptions, result: str, inputs: Sequence[str]) -> str:
    """Return the distance of a member from the middle of the others."""
    place = int(result.removeprefix("member_")) - 1 if result.startswith("member_") else -1
    if config.formula is not None or not 0 <= place < len(inputs) or len(inputs) < 2:
        return ""
    others = ", ".join((*inputs[:place], *inputs[place + 1 :]))
    return f"{inputs[place]} - {f'median({others})' if len(inputs) > 2 else others}"


def reads(config: RedundancyOptions) -> tuple[str, ...]:
    """Return the variables of the formula that are no inputs."""
    return reads_of(config.formula)


def history_s(config: RedundancyOptions) -> float:
    """Return how far back it looks."""
    past_ns = 0 if config.formula is None else config.formula.history_ns
    return config.window + past_ns / 1e9


def timed(config: RedundancyOptions) -> bool:
    """Return whether there is a window, whose samples expire as time passes."""
    return history_s(config) > 0 or (config.formula is not None and config.formula.needs_history)


def results_of(config: RedundancyOptions, inputs: int, bools: int) -> tuple[Result, ...]:
    """Return results per member first where a mapping has several bool outputs."""
    count = len(_members(config, inputs))
    each = [Result(f"member_{k}", "bool", f"member {k} agrees") for k in range(1, count + 1)]
    offs = [
        Result(f"residual_{k}", "float", f"how far member {k} is off", relation="<=")
        for k in range(1, count + 1)
    ]
    return (*each, *offs, *RESULTS) if bools > 1 else (*RESULTS, *each, *offs)


def evaluate(config: RedundancyOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Return the median distance of each member from its expected value, over a full window."""
    named = by_name(inputs, reads(config))
    windowed = timed(config)
    times_ns = sample_times(named.values(), now, config.window) if windowed else np.atleast_1d(now)
    places = _members(config, len(inputs) - len(reads(config)))
    values = np.array([numbers_at(named[place_name(place)], times_ns) for place in places])
    should = _should_be(config, named, times_ns, values)
    off = reduce(np.minimum, [np.abs(values - one) for one in should])
    off = np.where(np.isnan(should[0]), np.nan, np.where(np.isnan(values), inf, off))
    residuals = medians(times_ns, off, now, config.window)
    before = now - round(config.window * NS)
    full = np.array([named[place_name(place)].samples.last(before) >= 0 for place in places])
    residuals = np.where(full, residuals, np.nan)
    found = _judged(config, worst_of(residuals, config.threshold), "agree", "residual")
    for k, residual in enumerate(residuals, 1):
        found |= _judged(config, residual, f"member_{k}", f"residual_{k}")
    return found


def _members(config: RedundancyOptions, inputs: int) -> list[int]:
    named = () if config.formula is None else config.formula.addresses()
    return [place for place in range(inputs) if place_name(place) not in named]


def _should_be(
    config: RedundancyOptions, named: Any, times_ns: Any, values: Any
) -> tuple[Any, ...]:
    """Return what each member should be; of two middle siblings the nearer one will count."""
    if config.formula is not None:
        return (value_of(config.formula, named, times_ns),)
    others = [[k for k in range(len(values)) if k != own] for own in range(len(values))]
    return middles(values[np.array(others, int).T])


def _judged(config: RedundancyOptions, residual: Any, verdict: str, number: str) -> dict[str, Any]:
    well = where_known(~np.isnan(residual), residual <= config.threshold)
    return {verdict: well, number: finite(residual)}


def explain(config: RedundancyOptions, results: Mapping[str, Any]) -> str:
    """Name the members that are off, and how far."""
    verdicts = {n.removeprefix("member_"): v for n, v in results.items() if n.startswith("member_")}
    off = {k: results[f"residual_{k}"] for k, verdict in verdicts.items() if verdict == FALSE}
    far = {
        k: "shows no number" if not _known(by) else f"is off by {by:.4g}" for k, by in off.items()
    }
    who = {k: f"member {k}" if len(verdicts) > 1 else "it" for k in off}
    limit = f" (at most {config.threshold:g})" if any(map(_known, off.values())) else ""
    return ", ".join(f"{who[k]} {far[k]}" for k in off) + limit


def _known(number: float | None) -> bool:
    return number is not None and not np.isnan(number)
