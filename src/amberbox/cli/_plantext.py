"""What would be monitored, laid out for the eye: components, what they need, their modes."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Sequence

from amberbox.cli._text import in_columns
from amberbox.monitoring.configuration.summary import (
    monitor_of,
    needs_text,
    outputs_of,
    short_table,
)
from amberbox.monitoring.plan import ComponentPlan, Plan

_LEAST = 24
"""The last column gets so much room at least, however narrow the terminal is."""


def in_short(plan: Plan, width: int) -> list[str]:
    """Write a line for each component; what it needs goes on in lines below."""
    return _in_width(short_table(plan), width, "  ")


def in_full(plan: Plan, width: int) -> Iterator[str]:
    """Write each component with what it needs, and its modes with their outputs."""
    rows = [
        (mode.id, monitor_of(mode), " ".join(output.name for output in outputs_of(mode)) or "-")
        for _, mode in plan.modes()
    ]
    modes = iter(_entries(rows, width, "    "))
    for component in plan.components:
        yield from _head(component, width)
        for _ in component.modes:
            yield from next(modes)


def _head(component: ComponentPlan, width: int) -> list[str]:
    needs = needs_text(component, ", ")
    about = "" if component.modes else " (nothing monitors it)"
    line = f"  {component.id}{about}{': needs ' if needs else ''}{needs}"
    return textwrap.wrap(line, width, subsequent_indent=" " * 6, break_long_words=False)


def _in_width(rows: Iterable[Sequence[str]], width: int, indent: str) -> list[str]:
    return [line for entry in _entries(list(rows), width, indent) for line in entry]


def _entries(rows: Sequence[Sequence[str]], width: int, indent: str) -> Iterator[list[str]]:
    """Align cells; the words of the last one go on below it. Yield the lines of each row."""
    heads = in_columns([[*row[:-1], "|"] for row in rows], indent)
    for head, row in zip(heads, rows, strict=True):
        at = len(head) - 1
        texts = textwrap.wrap(
            row[-1], max(width - at, _LEAST), break_long_words=False, break_on_hyphens=False
        )
        first, *others = texts or [""]
        yield [(head[:at] + first).rstrip(), *(" " * at + text for text in others)]
