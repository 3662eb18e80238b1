"""Calibration: thresholds for a rate of false alarms, and the rate that can be promised.

Each series of a detector has the threshold that equally many of its nominal scores exceed: as many
as possible while nominal missions have no more alarms than the rate allows, each judged by
thresholds from the others, since the thresholds of many series fit the missions that they were made
of. What begins within ten seconds counts as one false alarm, in however many series, and a longer
alarm once for each ten seconds.
"""

from __future__ import annotations

import math
from array import array
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.detection.alarms import AlarmOptions
from amberbox.detection.baselines import Baseline
from amberbox.detection.nominal import NominalDistribution

LONG_ALARM_S = 10.0
LEAK_WINDOW_S = 60.0
"""How long an alarm and a fault may be apart to be taken for one: the time of a leak."""
UNEVALUATED_DETECTS = 0.5
"""The detection probability of a detector that nobody has evaluated on labelled faults."""
LEAST_SCORES = 30
_CANDIDATES = 10.0 ** np.arange(3.0, -4.0, -0.1)
_MOST_P = 0.2
_LEAST_FOLDS, _MOST_FOLDS = 3, 5  # fewer missions are cut in two each
_MOST_SERIES = 4096
_LEAST_SHARE = 1e-4  # so much rarer may a score be taken to be than its threshold
_USUAL = 0.02  # scores below that of this p-value are nominal: an alarm need not wait for less

POOLED = ""
"""The series that stands for those of which nominal missions have too few scores."""


@dataclass(frozen=True, slots=True)
class SeriesThreshold:
    """Nominal scores of one series against one baseline, and its threshold."""

    nominal: NominalDistribution
    threshold: float
    release: float
    """Below it, a score counts as low again."""


Thresholds = Mapping[str, SeriesThreshold]


@dataclass(frozen=True, slots=True)
class Calibration:
    """What a detector was calibrated to, and on how much nominal operation.

    Rates are false alarms per hour. ``promised_per_hour`` is never below 1 in the hours that there
    were: fewer cannot be shown. ``counted`` are the alarms of the calibration missions themselves,
    ``exceedances`` the scores of each series that are expected over its threshold there.
    """

    hours: float
    missions: int
    asked_per_hour: float
    promised_per_hour: float
    exceedances: float
    counted: int
    thresholds: Mapping[Baseline, Thresholds] = field(default_factory=dict)

    def leak(self, baseline: Baseline, series: str, p_value: float) -> float:
        """Return how probable such an alarm of a series is in a minute of nominal operation.

        The false alarms that can be promised are shared by all series alike, as their thresholds
        are. What is rarer than the threshold by its nominal p-value leaks less, by 10,000 at most:
        no tail is known further than that.
        """
        part = self.thresholds.get(baseline, {})
        one = part.get(series) or part.get(POOLED)
        if one is None or not math.isfinite(self.promised_per_hour):
            return 1.0
        usual = one.nominal.p_value(one.threshold)
        share = p_value / usual if usual > 0 else 1.0
        count = max(1, sum(name != POOLED for name in self.thresholds.get("fleet", {})))
        per_hour = self.promised_per_hour / count * min(max(share, _LEAST_SHARE), 1.0)
        return -math.expm1(-per_hour * LEAK_WINDOW_S / 3600)

    def report(self) -> list[str]:
        """Return sentences for a person."""
        lines = [
            f"calibrated on {_hours(self.hours)} of {self.missions} nominal "
            f"{'mission' if self.missions == 1 else 'missions'}: {_alarms(self.counted)} there"
        ]
        if self.counted > self.asked_per_hour * self.hours:
            lines.append(
                "more than asked for: these missions differ from those before them, so learn from "
                "more and longer ones"
            )
        if self.promised_per_hour > self.asked_per_hour:
            lines.append(
                f"asked for {_alarms(self.asked_per_hour)} per hour; with {_hours(self.hours)} "
                f"no rate below {self.promised_per_hour:.3g} per hour can be promised: calibrate "
                f"on more nominal missions, {_hours(1 / self.asked_per_hour)} or more"
            )
        return lines


def _hours(hours: float) -> str:
    return f"{hours:.1f} h" if hours >= 1 else f"{hours * 60:.1f} min"


def _alarms(count: float) -> str:
    return f"{count:g} false {'alarm' if count == 1 else 'alarms'}"


class SeriesScores(NamedTuple):
    """Nominal scores of one series: times (ns), scores, mission and fold of each."""

    baseline: Baseline
    series: str
    times_ns: NDArray[np.int64]
    values: NDArray[np.float64]
    missions: NDArray[np.int64]
    folds: NDArray[np.int64]


class NominalScores:
    """The scores of nominal missions, by baseline and series."""

    def __init__(self) -> None:
        self.span_ns = 0
        self.missions = 0
        self._times: dict[tuple[Baseline, str], array[int]] = defaultdict(lambda: array("q"))
        self._values: dict[tuple[Baseline, str], array[float]] = defaultdict(lambda: array("d"))
        self._parts: dict[tuple[Baseline, str], array[int]] = defaultdict(lambda: array("l"))
        self._middle_ns = 0

    def begin(self, start_ns: int, end_ns: int) -> None:
        """Begin a mission."""
        self.missions += 1
        self.span_ns += max(end_ns - start_ns, 0)
        self._middle_ns = (start_ns + end_ns) // 2

    def add(self, baseline: Baseline, series: str, at_ns: int, value: float) -> None:
        """Add a score."""
        self._times[baseline, series].append(at_ns)
        self._values[baseline, series].append(value)
        part = 2 * self.missions + (at_ns >= self._middle_ns)
        self._parts[baseline, series].append(part)

    def by_series(self) -> Iterator[SeriesScores]:
        """Yield the scores of each series against each baseline."""
        for (baseline, series), values in self._values.items():
            parts = np.frombuffer(self._parts[baseline, series], np.dtype("l"))
            missions = parts // 2
            folds = parts if self.missions < _LEAST_FOLDS else missions % _MOST_FOLDS
            times = np.frombuffer(self._times[baseline, series], np.int64)
            numbers = np.frombuffer(values, np.float64)
            yield SeriesScores(baseline, series, times, numbers, missions, folds)


def calibrated(found: NominalScores, per_hour: float, options: AlarmOptions) -> Calibration:
    """Return thresholds for a number of false alarms per hour, from nominal scores.

    Series with fewer than 30 scores share one distribution with all others of their baseline.
    Where the rate asked for is less than one alarm in all of the nominal time, the threshold is
    extrapolated from that without any, by the tail of the scores.
    """
    hours = found.span_ns / NS / 3600
    everything = list(found.by_series())
    nominal = _distributions(everything)
    allowed = per_hour * hours
    expected, counted = _exceedances(everything, math.floor(allowed), options)
    if allowed < 1:
        expected *= max(allowed, 1e-6)
    thresholds: dict[Baseline, dict[str, SeriesThreshold]] = {}
    for (baseline, series), distribution in nominal.items():
        of_baseline = thresholds.setdefault(baseline, {})
        of_baseline[series] = _threshold(distribution, expected, options)
    promised = max(per_hour, 1 / hours) if hours else math.inf
    return Calibration(hours, found.missions, per_hour, promised, expected, counted, thresholds)


def _threshold(
    nominal: NominalDistribution, exceedances: float, options: AlarmOptions
) -> SeriesThreshold:
    threshold = nominal.score_at(min(exceedances / nominal.count, _MOST_P))
    lower = threshold - (1 - options.release) * abs(threshold)
    usual = nominal.score_at(_USUAL)
    return SeriesThreshold(nominal, threshold, min(max(lower, usual), threshold))


Distributions = Mapping[tuple[Baseline, str], NominalDistribution]


def _distributions(parts: Sequence[SeriesScores]) -> Distributions:
    """Return the distribution of each series that has enough scores, and of all others."""
    nominal: dict[tuple[Baseline, str], NominalDistribution] = {}
    pools: dict[Baseline, list[NDArray[np.float64]]] = defaultdict(list)
    for part in parts:
        pools[part.baseline].append(part.values)
        if len(part.values) >= LEAST_SCORES and len(nominal) < _MOST_SERIES:
            nominal[part.baseline, part.series] = NominalDistribution.of(part.values)
    for baseline, values in pools.items():
        joined = np.concatenate(values)
        if len(joined):
            nominal[baseline, POOLED] = NominalDistribution.of(joined)
    return nominal


def _exceedances(
    everything: Sequence[SeriesScores], allowed: int, options: AlarmOptions
) -> tuple[float, int]:
    """Return the most exceedances with no more alarms than allowed, and how many these are.

    Each fold is judged by thresholds of the others.
    """
    judged: list[tuple[SeriesScores, NominalDistribution, float]] = []
    for fold in sorted({int(one) for part in everything for one in np.unique(part.folds)}):
        others = _distributions([_of_fold(part, part.folds != fold) for part in everything])
        for part in everything:
            inside = _of_fold(part, part.folds == fold)
            known = others.get((part.baseline, part.series)) or others.get((part.baseline, POOLED))
            if len(inside.values) and known is not None:
                share = known.count / max(known.count + len(inside.values), 1)
                judged.append((inside, known, share))
    expected = counted = 0
    for expected in _CANDIDATES.tolist():
        seconds: set[tuple[int, int]] = set()
        for part, nominal, share in judged:
            one = _threshold(nominal, expected * share, options)
            seconds |= _alarm_seconds(part, one, options)
        counted = count_alarms(seconds)
        if counted <= allowed:
            break
    return expected, counted


def _of_fold(part: SeriesScores, chosen: NDArray[np.bool_]) -> SeriesScores:
    return SeriesScores(
        part.baseline,
        part.series,
        part.times_ns[chosen],
        part.values[chosen],
        part.missions[chosen],
        part.folds[chosen],
    )


def _alarm_seconds(
    part: SeriesScores, one: SeriesThreshold, options: AlarmOptions
) -> set[tuple[int, int]]:
    """Return mission and second of scores over the threshold, where they are for long enough."""
    over = part.values > one.threshold
    at, missions = part.times_ns[over], part.missions[over]
    if options.persist_s and len(at):
        apart = (np.diff(at) > options.hold_s * NS) | (np.diff(missions) != 0)
        starts = np.concatenate(([0], np.flatnonzero(apart) + 1))
        ends = np.concatenate((starts[1:] - 1, [len(at) - 1]))
        lasting = np.repeat(at[ends] - at[starts] >= options.persist_s * NS, ends - starts + 1)
        at, missions = at[lasting], missions[lasting]
    return set(zip(missions.tolist(), (at // NS).tolist(), strict=True))


def count_alarms(seconds: Collection[tuple[int, int]]) -> int:
    """Return how many false alarms there are: one for each ten seconds begun of a mission."""
    counted, until = 0, (-1, 0)
    for mission, second in sorted(seconds):
        if (mission, second) >= until:
            counted, until = counted + 1, (mission, second + round(LONG_ALARM_S))
    return counted


def to_arrays(calibration: Calibration) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return a calibration as values for JSON and arrays of numbers."""
    values: dict[str, Any] = {
        "hours": calibration.hours,
        "missions": calibration.missions,
        "asked_per_hour": calibration.asked_per_hour,
        "promised_per_hour": calibration.promised_per_hour if calibration.hours else None,
        "exceedances": calibration.exceedances,
        "counted": calibration.counted,
        "series": {name: list(part) for name, part in calibration.thresholds.items()},
    }
    arrays: dict[str, NDArray[Any]] = {}
    for baseline, part in calibration.thresholds.items():
        rows = [one.nominal.numbers() for one in part.values()]
        arrays[f"{baseline}_nominal"] = np.array(rows)
        levels = [(one.threshold, one.release) for one in part.values()]
        arrays[f"{baseline}_threshold"] = np.array(levels, np.float64)
    return values, arrays


def from_arrays(values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Calibration:
    """Read what ``to_arrays`` returned; raise ValueError, KeyError or TypeError if it is wrong."""
    thresholds: dict[Baseline, Thresholds] = {}
    for baseline in ("fleet", "mission"):
        names = values["series"].get(baseline)
        if names is None:
            continue
        nominal, levels = arrays[f"{baseline}_nominal"], arrays[f"{baseline}_threshold"]
        if levels.shape != (len(names), 2) or len(nominal) != len(names):
            raise ValueError("a calibration has another number of series")
        if not np.isfinite(levels).all() or levels.dtype != np.float64:
            raise ValueError("a threshold is not finite")
        thresholds[baseline] = {
            str(name): SeriesThreshold(NominalDistribution.from_numbers(row), *pair)
            for name, row, pair in zip(names, nominal, levels.tolist(), strict=True)
        }
    promised = values["promised_per_hour"]
    return Calibration(
        float(values["hours"]),
        int(values["missions"]),
        float(values["asked_per_hour"]),
        math.inf if promised is None else float(promised),
        float(values["exceedances"]),
        int(values["counted"]),
        thresholds,
    )
