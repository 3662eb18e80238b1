"""Measures of recorded variables, and what they say of a run: passed, failed, or unknown.

A measure is a pure function of a signal, the samples of an expression in an interval. A variable
that was not recorded without gaps in the interval makes its criterion unknown, never passed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from amberbox.blackbox.columns.arrays import null_mask
from amberbox.blackbox.query.record import Record
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.expression import Expression
from amberbox.core.timestamps import format_duration
from amberbox.core.types import IntArray, Ragged
from amberbox.experiments.experiment import CriterionOptions, Outcome

LOOKBACK_NS = 10 * NS
"""How far before an interval a sample may be that still counts at its beginning."""
Verdict: TypeAlias = Literal["passed", "failed", "undecided", "aborted", "error"]


class MeasureError(AmberboxError):
    """A measure that a signal does not have; the text says why."""


@dataclass(frozen=True, eq=False)
class Signal:
    """Samples of an expression in an interval.

    ``times_s`` are seconds since the interval began, which lasts ``length_s``; ``values`` are
    finite numbers, conditions 0 and 1. ``along`` is the second coordinate of a path.
    """

    times_s: NDArray[np.float64]
    values: NDArray[np.float64]
    length_s: float
    target: float | None = None
    band: float | None = None
    is_condition: bool = False
    along: NDArray[np.float64] | None = None


def _max(signal: Signal) -> float:
    """Largest sample, in the unit of the variable."""
    return float(signal.values.max())


def _min(signal: Signal) -> float:
    """Smallest sample, in the unit of the variable."""
    return float(signal.values.min())


def _mean(signal: Signal) -> float:
    """Mean of the samples, in the unit of the variable."""
    return float(signal.values.mean())


def _std(signal: Signal) -> float:
    """Standard deviation of the samples (of all of them, not of a population behind them)."""
    return float(signal.values.std())


def _rms(signal: Signal) -> float:
    """Root of the mean square of the samples, in the unit of the variable."""
    return float(np.sqrt(np.mean(np.square(signal.values))))


def _final(signal: Signal) -> float:
    """Last sample, in the unit of the variable."""
    return float(signal.values[-1])


def _range(signal: Signal) -> float:
    """Largest minus smallest sample, in the unit of the variable."""
    return _max(signal) - _min(signal)


def _count(signal: Signal) -> float:
    """Number of times that a condition became true; once if it was true from the beginning."""
    true = _true(signal)
    return float(true[0]) + float(np.count_nonzero(true[1:] & ~true[:-1]))


def _duration(signal: Signal) -> float:
    """How long a condition was true in all, s; each sample counts until the next one."""
    ends = np.append(signal.times_s[1:], signal.length_s)
    return float(((ends - signal.times_s) * _true(signal)).sum())


def _fraction(signal: Signal) -> float:
    """Share of the time in which a condition was true, 0 to 1."""
    known_s = signal.length_s - float(signal.times_s[0])
    if known_s <= 0:
        raise MeasureError("the interval has no length")
    return _duration(signal) / known_s


def _settling_time(signal: Signal) -> float:
    """Time after which the value stays within the band around the target, s; infinite if never.

    As in control engineering (Franklin, Powell, Emami-Naeini, *Feedback Control of Dynamic
    Systems*, 3.4), with the band in the unit of the variable.
    """
    outside = np.flatnonzero(np.abs(signal.values - _target(signal)) > _band(signal))
    if not len(outside):
        return float(signal.times_s[0])
    last = int(outside[-1])
    return math.inf if last + 1 == len(signal.values) else float(signal.times_s[last + 1])


def _overshoot(signal: Signal) -> float:
    """How far the value goes beyond the target, away from its first sample; 0 if it does not.

    In the unit of the variable (IEEE Std 181 gives it as a share of the step).
    """
    step = _target(signal) - float(signal.values[0])
    beyond = (signal.values - _target(signal)) * (1.0 if step >= 0 else -1.0)
    return max(0.0, float(beyond.max()))


def _rise_time(signal: Signal) -> float:
    """Time from 10 % to 90 % of the way from the first sample to the target, s.

    The transition duration of IEEE Std 181; infinite if 90 % are never reached.
    """
    step = _target(signal) - float(signal.values[0])
    if step == 0:
        raise MeasureError("the first value is the target already")
    share = (signal.values - signal.values[0]) / step
    reached = [np.flatnonzero(share >= part) for part in (0.1, 0.9)]
    if not len(reached[1]):
        return math.inf
    return float(signal.times_s[reached[1][0]] - signal.times_s[reached[0][0]])


def _distance(signal: Signal) -> float:
    """Length of the path: of one coordinate, or of two with ``along``; in their unit."""
    steps = np.diff(signal.values)
    other = np.zeros(len(steps)) if signal.along is None else np.diff(signal.along)
    return float(np.hypot(steps, other).sum())


def _delay(signal: Signal) -> float:
    """Time until a condition is true, or the value is within the band of the target, s.

    Infinite if that never happens.
    """
    if signal.is_condition:
        reached = np.flatnonzero(_true(signal))
    else:
        reached = np.flatnonzero(np.abs(signal.values - _target(signal)) <= _band(signal))
    return float(max(0.0, signal.times_s[reached[0]])) if len(reached) else math.inf


MEASURES: Mapping[str, Callable[[Signal], float]] = {
    "max": _max,
    "min": _min,
    "mean": _mean,
    "std": _std,
    "rms": _rms,
    "final": _final,
    "range": _range,
    "count": _count,
    "duration": _duration,
    "fraction": _fraction,
    "settling_time": _settling_time,
    "overshoot": _overshoot,
    "rise_time": _rise_time,
    "distance": _distance,
    "delay": _delay,
}
"""Measures by name; ``docs/robot/experiments.md`` describes them."""
OF_CONDITIONS = frozenset({"count", "duration", "fraction"})
"""Measures of a condition; ``delay`` measures both."""
FROM_BEFORE = frozenset({*OF_CONDITIONS, "delay"})
"""Measures that use the last sample before the interval, which holds at its beginning."""


def _true(signal: Signal) -> NDArray[np.bool_]:
    if not signal.is_condition:
        raise MeasureError("is no condition", "compare it with something, such as: x > 0")
    return signal.values > 0


def _target(signal: Signal) -> float:
    if signal.target is None:
        raise MeasureError("has no target", "add the key target")
    return signal.target


def _band(signal: Signal) -> float:
    if signal.band is None:
        raise MeasureError("has no band", "add the key band: how far from the target is reached")
    return signal.band


class CriterionResult(Struct, frozen=True):
    """What a criterion has given; ``value`` is None where it is unknown or never reached.

    ``text`` says why it is unknown, or ``never``. Times are those of the record.
    """

    name: str
    measure: str
    of: str
    verdict: Literal["passed", "failed", "unknown"]
    value: float | None = None
    text: str = ""
    unit: str = ""
    above: float | None = None
    below: float | None = None
    during: str = ""
    from_ns: int = 0
    to_ns: int = 0


Interval: TypeAlias = tuple[int, int]


def judge(
    criteria: Sequence[CriterionOptions],
    record: Record | None,
    intervals: Mapping[str, Interval],
) -> list[CriterionResult]:
    """Return the result of each criterion over a record.

    ``intervals`` are times of the record by the id of a step, the whole run by an empty text.
    """
    return [_judged(criterion, record, intervals.get(criterion.during)) for criterion in criteria]


def _judged(
    criterion: CriterionOptions, record: Record | None, interval: Interval | None
) -> CriterionResult:
    value, text = math.nan, ""
    try:
        if interval is None:
            raise MeasureError(f"the step '{criterion.during}' was not carried out to its end")
        if record is None:
            raise MeasureError("there is no record of the run")
        value = MEASURES[criterion.measure](signal_of(criterion, record, interval))
    except AmberboxError as error:
        text = error.what
    verdict: Literal["passed", "failed", "unknown"] = "unknown"
    if not text:
        is_low = criterion.above is not None and value < criterion.above
        is_high = criterion.below is not None and value > criterion.below
        verdict = "failed" if is_low or is_high else "passed"
    from_ns, to_ns = interval or (0, 0)
    is_finite = math.isfinite(value)
    return CriterionResult(
        criterion.name or f"{criterion.measure} of {criterion.of.text}",
        criterion.measure,
        criterion.of.text,
        verdict,
        value if is_finite else None,
        text or ("" if is_finite else "never"),
        criterion.unit,
        criterion.above,
        criterion.below,
        criterion.during,
        from_ns,
        to_ns,
    )


def signal_of(criterion: CriterionOptions, record: Record, interval: Interval) -> Signal:
    """Return what a criterion measures; raises AmberboxError where the record does not have it."""
    from_ns, to_ns = interval
    expressions = [criterion.of, *([] if criterion.along is None else [criterion.along])]
    resolved = [_resolved(one, record) for one in expressions]
    names = list(dict.fromkeys(name for one in resolved for name in one.addresses()))
    if not names:
        raise MeasureError("reads no variable")
    series = _series(record, names, (from_ns - LOOKBACK_NS - criterion.history_ns, to_ns))
    _require_whole(record, names, interval)
    times = np.unique(np.concatenate([times for times, _ in series.values()]))
    instants = times[(times >= from_ns) & (times < to_ns)]
    if not len(instants):
        raise MeasureError("has no samples in the interval")
    before = times[times < from_ns]
    if criterion.measure in FROM_BEFORE and len(before) and instants[0] > from_ns:
        instants = np.concatenate([before[-1:], instants])
    columns = [_numbers(one, series, instants) for one in resolved]
    is_condition = columns[0][1]
    seconds = np.maximum(0.0, (instants - from_ns) / NS)
    return Signal(
        seconds, columns[0][0], (to_ns - from_ns) / NS, criterion.target, criterion.band,
        is_condition, columns[1][0] if len(columns) > 1 else None,
    )  # fmt: skip


def _numbers(
    expression: Expression, series: Mapping[str, Any], instants: IntArray
) -> tuple[NDArray[np.float64], bool]:
    """Return the values of an expression as numbers, and whether it is a condition."""
    values = expression.evaluate_series(series, instants)
    if values.dtype.kind not in "biuf":
        raise MeasureError(f"'{expression.text}' is no number")
    data = np.ma.getdata(values).astype(np.float64)
    unknown = int(np.count_nonzero(null_mask(values) | ~np.isfinite(data)))
    if unknown:
        raise MeasureError(f"{unknown} of {len(data)} values are unknown")
    return data, values.dtype.kind == "b"


def _resolved(expression: Expression, record: Record) -> Expression:
    """Return an expression with the full addresses of its variables."""
    if all(record.has_item(name.partition(".")[0]) for name in expression.addresses()):
        return expression
    known = [
        f"{item.name}.{column.name}"
        for item in record.items()
        if record.has_item(item.name)
        for column in record.variables(item.name).columns
    ]
    return expression.resolve(known)


def _series(record: Record, names: Sequence[str], span: Interval) -> dict[str, tuple[Any, Any]]:
    """Return times of receipt (ns) and values by address."""
    found: dict[str, tuple[Any, Any]] = {}
    for name in names:
        item, _, variable = name.partition(".")
        table = record.query(item, [variable, "received"], span[0], span[1])
        column = next(
            table[field] for field in table.names if field not in ("timestamp", "received")
        )
        if isinstance(column, Ragged):
            raise MeasureError(f"'{name}' is a list", f"name an element: {name}[0]")
        found[name] = (np.asarray(table["received"], np.int64), column)
    return found


def _require_whole(record: Record, names: Sequence[str], interval: Interval) -> None:
    """Raise MeasureError if the record has gaps in the interval, or ends before it."""
    from_ns, to_ns = interval
    for item in dict.fromkeys(name.partition(".")[0] for name in names):
        gaps = record.gaps(item, from_ns, to_ns)
        if gaps:
            missing_ns = min(gaps[0].to_ns, to_ns) - max(gaps[0].from_ns, from_ns)
            what = f"'{item}' has a gap of {format_duration(max(0, missing_ns))}"
            raise MeasureError(f"{what}: {gaps[0].reason}")
    last_ns = record.last_ns()
    if last_ns is None or last_ns < to_ns - NS:
        raise MeasureError("the record ends before the interval does")


def verdict_of(
    outcome: Outcome, results: Sequence[CriterionResult], skipped: Sequence[str] = ()
) -> tuple[Verdict, list[str]]:
    """Return the verdict of a run, and its reasons besides those of the outcome.

    A failed criterion fails a run that went through; one that is unknown, or a question that was
    skipped, leaves it undecided.
    """
    failed = [f"{one.name}: {_measured(one)}" for one in results if one.verdict == "failed"]
    unknown = [f"{one.name}: unknown, {one.text}" for one in results if one.verdict == "unknown"]
    open_ = [*(f"{text}: skipped" for text in skipped), *unknown]
    if outcome != "passed":
        return outcome, failed
    if failed:
        return "failed", failed
    return ("undecided", open_) if open_ else ("passed", [])


def _measured(result: CriterionResult) -> str:
    unit = f" {result.unit}" if result.unit else ""
    value = result.text if result.value is None else f"{result.value:.4g}{unit}"
    limits = [
        f"{word} {limit:.4g}{unit}"
        for word, limit in (("at least", result.above), ("at most", result.below))
        if limit is not None
    ]
    return f"{value}, expected {' and '.join(limits)}"
