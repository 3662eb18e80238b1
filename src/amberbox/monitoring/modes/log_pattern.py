"""Log pattern: lines that match a pattern are bad news, or the good news that must come."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from amberbox.core.config import Finding
from amberbox.core.mode import Input, Result, numbers, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now, Window

ACCEPTS = ("variable",)
COLUMNS = True
TIMED = True
RESULTS = (
    Result("ok", "bool", "no bad lines came, or enough good ones"),
    Result("lines", "int", "lines that match, within the window", relation="<="),
    Result("last_line", "string", "the last line that matches, within the window"),
)
SAMPLE = """\
name: driver_log_monitor
monitor: log_pattern
description: the laser driver does not complain
stale_after: never
mappings:
  - mapping:
      inputs: [ros_rosout.msg, ros_rosout.level]
      outputs:
        - output: {name: no_timeouts, type: bool, severity: warning}
        - output: {name: complaints, result: lines, type: int}
        - output: {name: last_line, type: string}
arguments:
  pattern: (?i)laser.*time ?out
  level: 4
  count: 3
  window: 60 s
"""


@dataclass(frozen=True, slots=True)
class LogPatternOptions:
    """The lines that count, and their meaning."""

    pattern: str = option(doc="a regular expression that is found anywhere in a line that counts")
    good: bool = option(False, "whether matching lines are good news, which must come")
    count: int = option(1, "how many of them within the window make the news")
    window: float = option(60.0, "over how long lines are counted", unit="s")
    level: float = option(
        -inf, "the least level of a line that counts, where a second input is the level"
    )

    def check(self) -> Iterator[Finding]:
        """Refuse a pattern that cannot be read, and counts that mean nothing."""
        try:
            re.compile(self.pattern)
        except re.error as error:
            yield "pattern", f"is no regular expression: {error}"
        if self.count < 1:
            yield "count", "must be 1 or more"
        if not 0 < self.window < inf:
            yield "window", "must lie above 0"


Config = LogPatternOptions


def history_s(config: LogPatternOptions) -> float:
    """Return how far back it looks."""
    return config.window


def evaluate(config: LogPatternOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Count the lines of the window that match."""
    text = inputs[0].samples
    flags = _matching(config, inputs)
    count = Window(text, now, config.window).sum_of(flags)
    enough = count >= config.count
    waited = inputs[0].flow.listened(now, config.window)
    known = (text.last(now) >= 0) & (enough | waited if config.good else True)
    last = np.concatenate([[-1], np.where(flags, np.arange(len(text)), -1)])
    place = np.maximum.accumulate(last)[text.last(now) + 1]
    lines = np.array([*text.values, ""], object)
    return {
        "ok": where_known(known, enough == config.good),
        "lines": count,
        "last_line": lines[np.where(count > 0, place, -1)],
    }


def _matching(config: LogPatternOptions, inputs: Sequence[Input]) -> Any:
    """Return for each line whether it counts; level and line are of the same message."""
    pattern, lines = re.compile(config.pattern), inputs[0].samples
    found = [isinstance(line, str) and bool(pattern.search(line)) for line in lines.values]
    flags = np.array(found, bool)
    if len(inputs) < 2:
        return flags
    # Return the level of each line: of several at one time the first belongs to the first.
    levels = inputs[1].samples
    times = lines.times_ns
    rank = np.arange(len(times)) - times.searchsorted(times)
    place = levels.times_ns.searchsorted(times) + rank
    at_once = np.append(levels.times_ns, -1)[np.minimum(place, len(levels))] == times
    last = levels.times_ns.searchsorted(times, "right") - 1
    place = np.where(at_once, place, last)
    return flags & (np.append(numbers(levels.values), np.nan)[place] >= config.level)


def explain(config: LogPatternOptions, results: Mapping[str, Any]) -> str:
    """Quote the last bad line, or name the line that is missing."""
    if results["ok"] is not False:
        return ""
    if config.good:
        return f"no line with '{config.pattern}' for {config.window:g} s"
    return f"{results['lines']} lines in {config.window:g} s, the last: {results['last_line']}"
