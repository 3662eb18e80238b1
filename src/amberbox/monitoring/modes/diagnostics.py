"""Diagnostics: what ROS nodes say of themselves in DiagnosticArray messages."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, Literal, NamedTuple

from amberbox.core.clock import NS
from amberbox.core.config import Finding
from amberbox.core.mode import UNKNOWN, Input, Result
from amberbox.core.options import option
from amberbox.core.samples import Now, Samples

ACCEPTS = ("item",)
PARTS = True
TIMED = True
RESULTS = (
    Result("ok", "bool", "all entries that are meant are there, and none says it is not well"),
    Result("level", "int", "the worst level: 0 OK, 1 WARN, 2 ERROR, 3 STALE", relation="<="),
    Result("message", "string", "what the worst entry says"),
)
SAMPLE = """\
name: imu_diagnostics_monitor
monitor: diagnostics
description: what the drivers of the IMU and the laser say of themselves
mappings:
  - mapping:
      inputs: [ros_diagnostics__status]
      outputs:
        - output: {name: drivers_ok, type: bool}
        - output: {name: worst_level, result: level, type: int, expected: 1, severity: critical}
        - output: {name: message, type: string}
arguments:
  names: ["^imu_node: ", "^hokuyo_node: Frequency"]
"""
OK, WARN, ERROR, STALE = range(4)
_WORDS = {"ok": OK, "warn": WARN, "warning": WARN, "error": ERROR, "stale": STALE}


@dataclass(frozen=True, slots=True)
class DiagnosticsOptions:
    """Which entries are meant, and how bad they may be."""

    names: tuple[str, ...] = option(
        doc="regular expressions found in the names of entries; each must find one"
    )
    worst: Literal["ok", "warn"] = option("ok", "the worst level that is well")
    max_age: float = option(5.0, "how long after an entry it is stale", unit="s")
    count: int | None = option(None, "how many entries must be meant; any number when absent")
    absent_ok: bool = option(False, "whether it is well that an entry is not there")

    def check(self) -> Iterator[Finding]:
        """Refuse patterns that cannot be read."""
        if not self.names:
            yield "names", "name at least one entry"
        for name in self.names:
            try:
                re.compile(name)
            except re.error as error:
                yield "names", f"'{name}' is no regular expression: {error}"
        if self.count is not None and self.count < 1:
            yield "count", "must be 1 or more"
        if not 0 < self.max_age < inf:
            yield "max_age", "must lie above 0"


Config = DiagnosticsOptions


class DiagnosticEntry(NamedTuple):
    """One row of the array."""

    level: int
    text: str


def history_s(config: DiagnosticsOptions) -> float:
    """Return how far back it looks: each publisher sends arrays of its own, at its own rate."""
    return config.max_age


def evaluate(config: DiagnosticsOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Take the last entry of each name, and of these the worst."""
    item = inputs[0]
    columns = [item.parts.get(name, Samples()) for name in ("name", "level", "message")]
    edges = (now - round(config.max_age * NS), now)
    first, end = (int(columns[0].times_ns.searchsorted(edge, "right")) for edge in edges)
    behind = len(columns[0]) - first, len(columns[0]) - end
    rows = zip(*(_cells(samples, *behind) for samples in columns), strict=True)
    entries = {
        name: DiagnosticEntry(_level(level), f"{name}: {text or ''}") for name, level, text in rows
    }
    before = now - round(config.max_age * NS)
    received = inputs[0].flow.age_s(before) <= config.max_age
    found = [_of(pattern, entries) for pattern in config.names]
    if config.absent_ok:
        there = [entry for entry in found if entry.level != STALE]
        found = there or [DiagnosticEntry(OK, "none is there")]
    if config.count is not None and (received or entries):
        meant = sum(any(re.search(p, str(name)) for p in config.names) for name in entries)
        if meant != config.count:
            found.append(DiagnosticEntry(ERROR, f"{meant} entries, {config.count} expected"))
    worst = max(found, key=lambda entry: entry.level)
    if worst.level == STALE and not worst.text and not received:
        return {"ok": UNKNOWN}
    text = worst.text or f"no entry for {config.max_age:g} s"
    return {"ok": worst.level <= _WORDS[config.worst], "level": worst.level, "message": text}


def _of(pattern: str, entries: Mapping[str, DiagnosticEntry]) -> DiagnosticEntry:
    """Return the worst entry of a pattern; without any it is stale and has no text."""
    found = [entry for name, entry in entries.items() if re.search(pattern, str(name))]
    return max(found, key=lambda entry: entry.level, default=DiagnosticEntry(STALE, ""))


def _cells(samples: Samples, first: int, end: int) -> Sequence[Any]:
    """Return values counted from the end: a column may be younger than the table."""
    column, count = samples.column(), len(samples)
    cells: list[Any] = column[max(count - first, 0) : max(count - end, 0)].tolist()
    return [None] * (first - end - len(cells)) + cells


def _level(value: Any) -> int:
    """Return the number of a level, which JSON may spell out; an unknown level is an error."""
    number = _WORDS.get(value.lower()) if isinstance(value, str) else value
    return int(number) if number in (OK, WARN, ERROR, STALE) else ERROR


def explain(config: DiagnosticsOptions, results: Mapping[str, Any]) -> str:
    """Return the message of the worst entry."""
    return str(results["message"]) if results.get("ok") is False else ""
