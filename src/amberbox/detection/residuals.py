"""Residuals of a record: their sizes over its missions, when they were violated, thresholds.

The sizes are those of the monitor ``residual``, at the same quarters of a second.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.query.record import Record
from amberbox.core.clock import NS
from amberbox.core.conditions import ticks, true_spans
from amberbox.core.contracts import Budget, Span
from amberbox.core.equations.generator import ResidualGenerator
from amberbox.core.equations.residual import (
    STEP_NS,
    UNKNOWN,
    VIOLATED,
    WITHIN,
    Conclusion,
    concluded,
)
from amberbox.core.errors import UsageError
from amberbox.core.samples import Samples
from amberbox.core.types import IntArray
from amberbox.core.yaml_nodes import Node
from amberbox.detection.missions import missions_of

Floats = NDArray[np.float64]

_PIECE_NS = 300 * NS  # of a record that is read at once
_MOST_KEPT = 1_000  # violations that are listed


@dataclass(frozen=True, slots=True)
class Violation:
    """A violation: from when to when (ns), and its size, the greatest by magnitude."""

    from_ns: int
    to_ns: int
    size: float


@dataclass(slots=True)
class ResidualReport:
    """What a record says of a residual.

    ``missing`` are addresses that are not recorded. ``lasting`` are the sizes that lasted for the
    persistence, by magnitude, at each instant where there was one: what a threshold is learnt from.
    """

    generator: ResidualGenerator
    missing: Sequence[str] = ()
    watched_s: float = 0.0
    known_s: float = 0.0
    excited_s: float = 0.0
    violations: int = 0
    listed: list[Violation] = field(default_factory=list)
    lasting: list[Floats] = field(default_factory=list)

    def quantile(self, share: float) -> float | None:
        """Return a quantile of the lasting sizes; None without any."""
        return float(np.quantile(np.concatenate(self.lasting), share)) if self.lasting else None

    def learnt(self, share: float, margin: float) -> float | None:
        """Return a threshold: the quantile times the margin, to three digits, rounded up."""
        found = self.quantile(share)
        if not found:
            return None
        digit = 10.0 ** (np.floor(np.log10(found * margin)) - 2)
        return float(f"{np.ceil(found * margin / digit) * digit:.3g}")


def residual_reports(
    records: Sequence[Record],
    generators: Sequence[ResidualGenerator],
    missions: Sequence[str] = (),
) -> list[ResidualReport]:
    """Return what missions of records say of residuals, without a name of all that ended well.

    Where nobody recorded missions, the whole record counts as one. Raises UsageError for a mission
    that is not there.
    """
    reports = []
    for generator in generators:
        missing = dict.fromkeys(a for record in records for a in _missing(record, generator))
        reports.append(ResidualReport(generator, tuple(missing)))
    for record in records:
        for mission in missions_of(record, missions):
            _add([report for report in reports if not report.missing], record, mission.span)
    return reports


def _missing(record: Record, generator: ResidualGenerator) -> Iterator[str]:
    for address in generator.addresses:
        item, _, variable = address.partition(".")
        try:
            columns = record.variables(item).columns
        except UsageError:
            yield address
            continue
        if variable not in (column.name for column in columns):
            yield address


def _add(reports: Sequence[ResidualReport], record: Record, span: Span) -> None:
    """Add a mission: what its residuals conclude in it."""
    generators = [report.generator for report in reports]
    parts = list(_pieces(record, generators, span, span[0])) if generators else []
    for number, report in enumerate(reports if parts else ()):
        pieces = [found[number] for _, found in parts]
        sizes = np.concatenate([piece.sizes for piece in pieces])
        states = np.concatenate([piece.states for piece in pieces])
        _judge(report, np.concatenate([at for at, _ in parts]), sizes, states)


def _pieces(
    record: Record, generators: Sequence[ResidualGenerator], span: Span, first_ns: int
) -> Iterator[tuple[IntArray, list[Conclusion]]]:
    """Yield instants of a span and what residuals conclude there, piece by piece.

    Each piece is read with the past that its residuals need, but nothing before ``first_ns``.
    """
    addresses = dict.fromkeys(a for generator in generators for a in generator.addresses)
    history_ns = max((generator.history_ns for generator in generators), default=0)
    for begin_ns in range(span[0], span[1], _PIECE_NS):
        end_ns = min(begin_ns + _PIECE_NS, span[1])
        at = ticks(STEP_NS, begin_ns, end_ns)
        if len(at):
            since_ns = max(first_ns, begin_ns - history_ns - NS)
            samples = _samples(record, list(addresses), (since_ns, end_ns))
            yield at, [concluded(generator, samples, at) for generator in generators]


@dataclass(frozen=True, slots=True, eq=False)
class SizeCurve:
    """The size of a residual over time, for a plot; NaN where nothing is concluded.

    Of each step of ``step_ns`` it is the greatest by magnitude. ``of`` is how many sizes it is made
    of, and ``until_ns`` how far these reach: the end of the span, or where the time was up.
    """

    times_ns: IntArray
    sizes: Floats
    step_ns: int
    of: int
    until_ns: int


def size_curve(
    record: Record, generator: ResidualGenerator, span: Span, points: int, budget: Budget
) -> SizeCurve:
    """Return the size of a residual in a span as at most ``points`` values.

    Raises UsageError if a variable is not recorded.
    """
    if missing := [*_missing(record, generator)]:
        raise UsageError(f"is not recorded: {', '.join(missing)}")
    steps = -(-(span[1] - span[0]) // (STEP_NS * max(1, points)))
    step_ns = max(1, steps) * STEP_NS
    found: dict[int, float] = {}
    count, until_ns = 0, span[0]
    for at, (conclusion,) in _pieces(record, [generator], span, 0):
        steps_ns = (at // step_ns * step_ns).tolist()
        for bin_ns, size in zip(steps_ns, conclusion.sizes.tolist(), strict=True):
            known = found.setdefault(bin_ns, size)
            if known != known or abs(size) > abs(known):
                found[bin_ns] = size
        count, until_ns = count + len(at), int(at[-1])
        if budget.is_over():
            break
    else:
        until_ns = span[1]
    times_ns = np.array([*found], np.int64)
    return SizeCurve(times_ns, np.array([*found.values()]), step_ns, count, until_ns)


def _samples(record: Record, addresses: Sequence[str], span: Span) -> Mapping[str, Samples]:
    by_item: dict[str, list[str]] = {}
    for address in addresses:
        item, _, variable = address.partition(".")
        by_item.setdefault(item, []).append(variable)
    found = {}
    for item, variables in by_item.items():
        table = record.query(item, ["received", *variables], span[0], span[1] + 1)
        for variable in variables:
            samples = found[f"{item}.{variable}"] = Samples()
            samples.extend(np.asarray(table["received"], np.int64), np.ma.asarray(table[variable]))
    return found


def _judge(report: ResidualReport, instants: IntArray, sizes: Floats, states: IntArray) -> None:
    step_s = STEP_NS / NS
    report.watched_s += len(instants) * step_s
    report.known_s += int(np.count_nonzero(states != UNKNOWN)) * step_s
    report.excited_s += int(np.count_nonzero(~np.isnan(sizes))) * step_s
    steps = round(report.generator.options.persistence_s * NS) // STEP_NS + 1
    if len(sizes) >= steps:
        windows = np.lib.stride_tricks.sliding_window_view(np.abs(sizes), steps)
        lasting = windows.min(axis=1)
        lasting = lasting[~np.isnan(lasting)]
        report.lasting += [lasting] if len(lasting) else []
    # a violation lasts until the residual is known to be within its threshold again
    is_decided = (states == VIOLATED) | (states == WITHIN)
    last = np.maximum.accumulate(np.where(is_decided, np.arange(len(states)), -1))
    violated = (last >= 0) & (states[np.maximum(last, 0)] == VIOLATED)
    for from_ns, to_ns in true_spans(instants, violated, int(instants[-1])):
        report.violations += 1
        if len(report.listed) < _MOST_KEPT:
            first, end = instants.searchsorted([from_ns, to_ns])
            inside = sizes[first : max(end, first + 1)]
            inside = inside[~np.isnan(inside)]
            report.listed.append(Violation(from_ns, to_ns, float(max(inside, key=abs))))


def with_thresholds(
    text: str, root: Node, learnt: Mapping[str, float], new: Mapping[str, str]
) -> str:
    """Return the text of a model with thresholds of its residuals; layout and comments stay.

    ``root`` is the tree of the text; ``new`` are residuals that it does not list yet, as YAML.
    """
    assert root.mapping is not None
    listed = root.mapping.get("residuals")
    entries = {} if listed is None else listed.mapping or {}
    edits = [_edit(text, entries[name], f"{learnt[name]:g}") for name in learnt if name in entries]
    if new:
        lines = "".join(f"\n  {name}: {one}" for name, one in new.items())
        if listed is None:
            text = text if text.endswith("\n") else f"{text}\n"
            edits.append((len(text), len(text), f"\nresiduals:{lines}\n"))
        else:
            edits.append((*listed.span, lines))
    for start, end, put in sorted(edits, reverse=True):
        text = text[:start] + put + text[end:]
    return text


def _edit(text: str, node: Node, threshold: str) -> tuple[int, int, str]:
    start, end = node.span
    old = (node.mapping or {}).get("threshold")
    if old is not None:
        return (*old.span, threshold)
    if text[start] == "{":
        return end - 1, end - 1, f", threshold: {threshold}"
    indent = " " * (start - text.rfind("\n", 0, start) - 1)
    return start, start, f"threshold: {threshold}\n{indent}"
