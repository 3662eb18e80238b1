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
from amberbox.core.safe_text import one_line
from amberbox.core.samples import Now, Samples, Window

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
    of: str = option("", "whose lines count, where a third input is the name of who wrote it")
    silence_ok: bool = option(
        False, "whether no line at all is well, also before the first one and without a publisher"
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
_LONGEST = 300  # characters of a line that is quoted
_SETTLES_S = 1.0  # a log is taken for silent once it was listened to for so long


def in_silence(config: LogPatternOptions) -> bool:
    """Return whether a log without lines is judged, too."""
    return config.silence_ok


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
    heard = text.last(now) >= 0
    if config.silence_ok:
        heard |= inputs[0].flow.listened(now, min(config.window, _SETTLES_S))
    known = (heard | enough) & (enough | waited if config.good else True)
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
    if len(inputs) > 1:
        levels = inputs[1].samples
        flags &= np.append(numbers(levels.values), np.nan)[_places(lines, levels)] >= config.level
    if len(inputs) > 2 and config.of:
        names = inputs[2].samples
        flags &= np.append(names.values, "")[_places(lines, names)] == config.of
    return flags


def _places(lines: Samples, others: Samples) -> Any:
    """Return the row of another variable of each line, of several at one time the first for the
    first; -1 before any.
    """
    times = lines.times_ns
    rank = np.arange(len(times)) - times.searchsorted(times)
    place = others.times_ns.searchsorted(times) + rank
    at_once = np.append(others.times_ns, -1)[np.minimum(place, len(others))] == times
    return np.where(at_once, place, others.times_ns.searchsorted(times, "right") - 1)


def explain(config: LogPatternOptions, results: Mapping[str, Any]) -> str:
    """Quote the last bad line, or name the line that is missing."""
    if results["ok"] is not False:
        return ""
    if config.good:
        return f"no line with '{config.pattern}' for {config.window:g} s"
    last = one_line(str(results["last_line"]).rstrip())[:_LONGEST]
    return f"{results['lines']} lines in {config.window:g} s, the last: {last}"
