"""Residuals of recorded samples: their values over time, and what is concluded at an instant.

All of it is a function of the samples of a bounded past, so that it does not matter how a record
is cut into pieces, and what is found live is found afterwards.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.equations.generator import (
    Differentiated,
    ResidualGenerator,
    Solved,
    Step,
)
from amberbox.core.expression import Expression
from amberbox.core.expressions.evaluation import Instants, Series, evaluate
from amberbox.core.expressions.values import Values, reduce_windows
from amberbox.core.samples import Samples
from amberbox.core.types import IntArray

Floats = NDArray[np.float64]

STEP_NS = NS // 4
"""Sizes are compared with the threshold so often within the persistence."""
UNKNOWN, IDLE, WITHIN, VIOLATED = 0, 1, 2, 3
"""A gap, or too little history; not excited; not above the threshold; above it."""
_FEWEST = 4  # samples that a parabola needs, with one to spare
_MOST_ROWS = 500_000  # of overlapping windows at once
_SIMILAR = 1.25  # rates that differ by less count as equal
_OWN_SHARE = 0.05  # of a term that the others do not explain, at least


@dataclass(frozen=True, slots=True, eq=False)
class ResidualSamples:
    """A residual at the times of its slowest input, NaN where it is unknown.

    ``counts`` are the samples that ``when`` selects. ``terms`` are ``per`` and ``beside``.
    """

    times_ns: IntArray
    values: Floats
    counts: NDArray[np.bool_]
    terms: Sequence[Floats]


@dataclass(frozen=True, slots=True, eq=False)
class Conclusion:
    """The size of a residual at instants, NaN where nothing is concluded, and its state there."""

    sizes: Floats
    states: IntArray


def concluded(
    generator: ResidualGenerator,
    samples: Mapping[str, Samples],
    instants: IntArray,
    shared: dict[Any, dict[str, Floats]] | None = None,
) -> Conclusion:
    """Return size and state at instants, in order, from samples by address.

    Samples after an instant do not count for it. A state is VIOLATED where the size has been above
    the threshold throughout the persistence, IDLE where it has been for a part of it only.
    Residuals of one model that are given the same ``shared``, and the same samples, compute what
    they have in common once.
    """
    persistence_ns = round(generator.options.persistence_s * NS)
    back = np.arange(0, persistence_ns + 1, STEP_NS, dtype=np.int64)
    asked, places = np.unique(instants[:, None] - back, return_inverse=True)
    sizes, states = _at_instants(generator, samples, asked, {} if shared is None else shared)
    places = places.reshape(len(instants), len(back))
    now, all_of = states[places[:, 0]], states[places]
    lasting = (all_of == VIOLATED).all(axis=1)
    return Conclusion(
        sizes[places[:, 0]], np.where((now == VIOLATED) & ~lasting, IDLE, now).astype(np.int64)
    )


def _at_instants(
    generator: ResidualGenerator,
    samples: Mapping[str, Samples],
    instants: IntArray,
    shared: dict[Any, dict[str, Floats]],
) -> tuple[Floats, IntArray]:
    sizes, states = np.full(len(instants), np.nan), np.zeros(len(instants), np.int64)
    clocks = _slowest(generator, samples, instants)
    for place in np.unique(clocks).tolist():
        chosen = np.flatnonzero(clocks == place)
        clock_ns = samples[generator.addresses[place]].times_ns
        found = residual_samples(generator, samples, clock_ns, instants[chosen], shared)
        sizes[chosen], states[chosen] = _windows(generator, found, instants[chosen])
    return sizes, states


def _slowest(
    generator: ResidualGenerator, samples: Mapping[str, Samples], instants: IntArray
) -> IntArray:
    """Return which address sets the times at each instant: the clock, or the rarest one."""
    if generator.clock:
        return np.full(len(instants), generator.addresses.index(generator.clock))
    first = instants - generator.window_ns
    counts = []
    for address in generator.addresses:
        times_ns = samples[address].times_ns
        until = times_ns.searchsorted(instants, "right")
        counts.append(until - times_ns.searchsorted(first, "right"))
    table = np.array(counts)
    slowest: IntArray = (table <= table.min(axis=0) * _SIMILAR).argmax(axis=0)
    return slowest


def residual_samples(
    generator: ResidualGenerator,
    samples: Mapping[str, Samples],
    clock_ns: IntArray,
    instants: IntArray,
    shared: dict[Any, dict[str, Floats]],
) -> ResidualSamples:
    """Return the residual at the times of an input that matter for the instants.

    Its last ``lead_ns`` before the last instant is not final yet.
    """
    since = int(instants[0]) - generator.window_ns
    first, end = (int(clock_ns.searchsorted(t, "right")) for t in (since, int(instants[-1])))
    times_ns = _once(clock_ns[max(first - 1, 0) : end])
    max_age_ns = round(generator.options.max_age_s * NS)
    key = (times_ns.tobytes(), max_age_ns, generator.steps)
    columns = shared.setdefault(key, {})
    for name, expression in generator.recorded.items():
        if name not in columns:
            columns[name] = _recorded(expression, samples, times_ns, max_age_ns)
    for step in generator.steps:
        if step.name not in columns:
            columns[step.name] = _computed(step, times_ns, columns, max_age_ns)
    compared, options = generator.compared, generator.options
    if isinstance(compared, Expression):
        values = _evaluated(compared, times_ns, columns)
    else:
        values = columns[compared.name] - _computed(compared, times_ns, columns, max_age_ns)
    counts = np.ones(len(times_ns), bool)
    if options.when is not None:
        excited = _evaluated(options.when, times_ns, columns)
        values = np.where(np.isnan(excited), np.nan, values)
        counts = excited != 0
    terms = [_evaluated(one, times_ns, columns) for one in _terms(generator)]
    for term in terms:
        values = np.where(np.isnan(term), np.nan, values)
    return ResidualSamples(times_ns, values, counts, terms)


def _terms(generator: ResidualGenerator) -> Iterator[Expression]:
    options = generator.options
    if options.per is not None:
        yield options.per
    yield from options.beside


def _once(times_ns: IntArray) -> IntArray:
    """Return times, each once: of rows with the same time the last one counts."""
    if len(times_ns) < 2:
        return times_ns
    kept: IntArray = times_ns[np.append(times_ns[1:] != times_ns[:-1], True)]
    return kept


def _recorded(
    expression: Expression, samples: Mapping[str, Samples], times_ns: IntArray, max_age_ns: int
) -> Floats:
    """Return an expression of recorded variables at times; NaN where a sample is too old."""
    found: Floats = np.array(expression.numbers(samples, times_ns), np.float64)
    for address in expression.addresses():
        own_ns = samples[address].times_ns
        last = own_ns.searchsorted(times_ns, "right") - 1
        if not len(own_ns):
            return np.full(len(times_ns), np.nan)
        old = (last < 0) | (times_ns - own_ns[np.maximum(last, 0)] > max_age_ns)
        found[old] = np.nan
    return np.where(np.isfinite(found), found, np.nan)


def _evaluated(expression: Expression, times_ns: IntArray, columns: Mapping[str, Floats]) -> Floats:
    """Return an expression of columns; what is no number is unknown, and so is what it gives."""
    series = {
        name: Series(times_ns, Values(columns[name], np.isnan(columns[name]), "number"))
        for name in expression.addresses()
    }
    found = evaluate(expression.tree, Instants(series, times_ns, slice(0, len(times_ns))))
    numbers = found.data.astype(np.float64)
    return np.where(found.null | ~np.isfinite(numbers), np.nan, numbers)


def _computed(
    step: Step, times_ns: IntArray, columns: Mapping[str, Floats], max_age_ns: int
) -> Floats:
    if isinstance(step, Solved):
        return _evaluated(step.expression, times_ns, columns)
    if isinstance(step, Differentiated):
        return slopes(times_ns, columns[step.state], step.window_ns, max_age_ns)
    initial = _evaluated(step.initial, times_ns, columns)
    return integrals(
        times_ns, columns[step.derivative], initial, step.over_ns, step.leak, max_age_ns
    )


def slopes(times_ns: IntArray, values: Floats, window_ns: int, max_gap_ns: int) -> Floats:
    """Return the derivative (per s) of a parabola fitted around each time, by least squares.

    It uses the samples up to half the window before and after. NaN where one of them is unknown,
    where samples are further apart than ``max_gap_ns``, or where there are too few.

    Source: Savitzky, Golay, Analytical Chemistry 36 (1964), for samples that are not evenly spaced.
    """
    half_ns = window_ns // 2
    first = times_ns.searchsorted(times_ns - half_ns, "left")
    last = times_ns.searchsorted(times_ns + half_ns, "right")
    known = (last - first >= _FEWEST) & _without_gap(times_ns, first, last, half_ns, max_gap_ns)
    found = np.full(len(times_ns), np.nan)
    for rows, owners, ends in _window_rows(np.flatnonzero(known), first, last):
        place = (times_ns[rows] - times_ns[owners]) / half_ns
        x = values[rows]
        powers = [_sums(place**n, ends) for n in range(5)]
        sides = [_sums(x * place**n, ends) for n in range(3)]
        matrix = np.array([[powers[i + j] for j in range(3)] for i in range(3)]).transpose(2, 0, 1)
        fitted = np.linalg.solve(matrix, np.array(sides).T[:, :, None])[:, 1, 0]
        found[owners[ends[:-1]]] = fitted * (NS / half_ns)
    return found


def _without_gap(
    times_ns: IntArray, first: IntArray, last: IntArray, half_ns: int, max_gap_ns: int
) -> NDArray[np.bool_]:
    """Return where samples cover a window evenly: at both ends and within, up to the gap."""
    if not len(times_ns):
        return np.zeros(0, bool)
    reach_ns = min(max_gap_ns, half_ns // 2)
    gaps = np.append(0, np.cumsum(np.diff(times_ns) > max_gap_ns))
    covered = (times_ns - half_ns + reach_ns >= times_ns[first]) & (
        times_ns + half_ns - reach_ns <= times_ns[last - 1]
    )
    even: NDArray[np.bool_] = covered & (gaps[last - 1] == gaps[first])
    return even


def _sums(column: Floats, ends: IntArray) -> Floats:
    """Return the sum of each part of a column, between bounds."""
    sums: Floats = np.add.reduceat(column, ends[:-1])
    return sums


def _window_rows(
    wanted: IntArray, first: IntArray, last: IntArray
) -> Iterator[tuple[IntArray, IntArray, IntArray]]:
    """Yield rows of overlapping windows one after the other: rows, owners, and bounds."""
    lengths = last - first
    begin = 0
    totals = np.cumsum(lengths[wanted])
    while begin < len(wanted):
        limit = (totals[begin - 1] if begin else 0) + _MOST_ROWS
        end = max(begin + 1, int(totals.searchsorted(limit, "right")))
        part = wanted[begin:end]
        counts = lengths[part]
        ends = np.append(0, np.cumsum(counts))
        rows = np.arange(ends[-1]) + np.repeat(first[part] - ends[:-1], counts)
        yield rows, np.repeat(part, counts), ends
        begin = end


def integrals(
    times_ns: IntArray,
    rates: Floats,
    initial: Floats,
    over_ns: int,
    leak: float,
    max_gap_ns: int,
) -> Floats:
    """Return ``x(t)`` of ``x' = rate + leak * (initial - x)`` that begins as ``initial``.

    It begins ``over_ns`` before each time: no error is older than that. Rates are joined by lines.
    NaN where a rate or ``initial`` is unknown, or where samples are further apart than
    ``max_gap_ns``.
    """
    first = times_ns.searchsorted(times_ns - over_ns, "left")
    last = np.arange(1, len(times_ns) + 1)
    found = np.full(len(times_ns), np.nan)
    if not len(times_ns):
        return found
    gaps = np.append(0, np.cumsum(np.diff(times_ns) > max_gap_ns))
    before = np.maximum(first - 1, 0)
    begun = (times_ns[before] <= times_ns - over_ns) & (gaps[last - 1] == gaps[before])
    exactly = (times_ns[first] == times_ns - over_ns) & (gaps[last - 1] == gaps[first])
    whole = begun | exactly
    pulled = rates if not leak else rates + leak * initial
    for rows, owners, ends in _window_rows(np.flatnonzero(whole), first, last):
        owner = owners[ends[:-1]]
        fading = np.exp(-leak * (times_ns[owners] - times_ns[rows]) / NS)
        inflow = fading * pulled[rows]
        pieces = (inflow[1:] + inflow[:-1]) / 2 * (np.diff(times_ns[rows]) / NS)
        pieces = np.append(pieces, 0.0)
        pieces[ends[1:] - 1] = 0.0  # between two windows
        found[owner] = fading[ends[:-1]] * initial[first[owner]] + _sums(pieces, ends)
    return found


def _windows(
    generator: ResidualGenerator, found: ResidualSamples, instants: IntArray
) -> tuple[Floats, IntArray]:
    """Return size and state of the window of each instant."""
    options = generator.options
    until = instants - generator.lead_ns
    after = until - round(options.over_s * NS)
    known = _is_known(found, after, until, round(options.max_age_s * NS))
    chosen = found.counts & ~np.isnan(found.values)
    times_ns, values = found.times_ns[chosen], found.values[chosen]
    count = times_ns.searchsorted(until, "right") - times_ns.searchsorted(after, "right")
    excited = known & (count >= options.least)
    sizes = np.full(len(instants), np.nan)
    at = np.flatnonzero(excited)
    if len(at):
        terms = [term[chosen] for term in found.terms]
        sizes[at] = _fitted(times_ns, values, terms, after[at], until[at])
    threshold = np.inf if options.threshold is None else options.threshold
    states = np.where(np.abs(sizes) > threshold, VIOLATED, WITHIN)
    states = np.where(np.isnan(sizes), np.where(known, IDLE, UNKNOWN), states)
    return sizes, states


def _is_known(
    found: ResidualSamples, after: IntArray, until: IntArray, max_gap_ns: int
) -> NDArray[np.bool_]:
    """Return which windows are full: known samples throughout, without a gap."""
    times_ns = found.times_ns
    if not len(times_ns):
        return np.zeros(len(after), bool)
    missing = np.append(0, np.cumsum(np.isnan(found.values) & found.counts))
    gaps = np.append(0, np.cumsum(np.diff(times_ns) > max_gap_ns))
    first, end = times_ns.searchsorted(after, "right"), times_ns.searchsorted(until, "right")
    before, last = np.maximum(first - 1, 0), np.maximum(end - 1, 0)
    full = (first > 0) & (end > first) & (until - times_ns[last] <= max_gap_ns)
    known: NDArray[np.bool_] = (
        full & (missing[end] == missing[np.minimum(first, end)]) & (gaps[last] == gaps[before])
    )
    return known


def _fitted(
    times_ns: IntArray,
    values: Floats,
    terms: Sequence[Floats],
    after: IntArray,
    until: IntArray,
) -> Floats:
    """Return how many times the first term the values are, others beside it; or their mean."""

    def mean(column: Floats) -> Floats:
        return reduce_windows("mean", times_ns, column, after, until).data

    if not terms:
        return mean(values)
    count = len(terms)
    moments = {(i, j): mean(terms[i] * terms[j]) for i in range(count) for j in range(i, count)}
    matrix = np.array([[moments[min(i, j), max(i, j)] for j in range(count)] for i in range(count)])
    matrix = matrix.transpose(2, 0, 1)
    sides = np.array([mean(term * values) for term in terms]).T
    scale = np.sqrt(np.diagonal(matrix, axis1=1, axis2=2))
    usable = (scale > 0).all(axis=1)
    found = np.full(len(after), np.nan)
    scale, sides = scale[usable], sides[usable]
    alike = matrix[usable] / (scale[:, :, None] * scale[:, None, :])
    own = np.ones(len(scale))
    if count > 1:  # what the others leave of the first term
        others = np.linalg.pinv(alike[:, 1:, 1:], hermitian=True)
        left = alike[:, :1, 1:]
        own = 1.0 - (left @ others @ left.transpose(0, 2, 1))[:, 0, 0]
        share = (left @ others @ (sides / scale)[:, 1:, None])[:, 0, 0]
    else:
        share = np.zeros(len(scale))
    distinct = own >= _OWN_SHARE
    with np.errstate(all="ignore"):
        size = ((sides / scale)[:, 0] - share) / own / scale[:, 0]
    found[usable] = np.where(distinct, size, np.nan)
    return found
