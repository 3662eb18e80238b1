"""Working counter: every EtherCAT slave has taken part; one bad sample alone does not count."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.config import Finding
from amberbox.core.mode import Input, Result, numbers, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now

ACCEPTS = ("variable",)
COLUMNS = True
PER_INPUT = True
TIMED = True
RESULTS = (
    Result("complete", "bool", "the counter is what it should be"),
    Result("counter", "int", "the counter"),
)
SAMPLE = """\
name: working_counter_monitor
monitor: working_counter
description: all wheels take part in every EtherCAT cycle
mappings:
  - mapping:
      inputs: [ros_sw_ethercat_parser_data.working_count]
      outputs:
        - output: {name: all_slaves_answer, type: bool, hint: "look for the first dark slave"}
arguments:
  expected: 12
"""


@dataclass(frozen=True, slots=True)
class WorkingCounterOptions:
    """The expected counter, and how many bad samples are a fault."""

    expected: int = option(doc="the counter when every slave takes part")
    samples: int = option(2, "how many bad samples in a row are a fault")
    lasting: float = option(2.0, "how long a single one must stand to be a fault, too", unit="s")

    def check(self) -> Iterator[Finding]:
        """Refuse what no counter can be."""
        if self.expected < 1:
            yield "expected", "must be 1 or more"
        if self.samples < 1:
            yield "samples", "must be 1 or more"
        if not 0 < self.lasting < inf:
            yield "lasting", "must lie above 0"


Config = WorkingCounterOptions


def history_s(config: WorkingCounterOptions) -> float:
    """Return how far back it looks; a counter that has been bad for longer is a fault in
    any case.
    """
    return config.lasting


def evaluate(config: WorkingCounterOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Detect consecutive bad samples, or a single lasting one, as recorded by a change filter."""
    (one,) = inputs
    last = one.samples.last(now)
    places = np.where(_as_expected(config, one), np.arange(len(one.samples)), -1)
    good = np.maximum.accumulate(np.concatenate([[-1], places]))[last + 1]
    began_ns = np.append(one.samples.times_ns, 0)[good + 1]
    stands = (last > good) & (now - began_ns >= round(config.lasting * NS))
    complete = ~((last - good >= config.samples) | stands)
    known = one.samples.known(now)
    count = np.where(known, numbers(one.at(now)), np.nan)[()]
    return {"complete": where_known(known, complete), "counter": count}


def _as_expected(config: WorkingCounterOptions, one: Input) -> Any:
    null = one.samples.null
    return (one.samples.values == config.expected) | (False if null is None else null)


def explain(config: WorkingCounterOptions, results: Mapping[str, Any]) -> str:
    """Describe the counter and its expected value."""
    if results["complete"] is not False:
        return ""
    count = results["counter"]
    shown = "no number" if count is None or np.isnan(count) else f"{count:.0f}"
    return f"the working counter is {shown}, expected {config.expected}"
