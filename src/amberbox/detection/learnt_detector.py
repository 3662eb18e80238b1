"""A detector with what stands around all of them: ticks, baselines, thresholds, alarms, counts.

The scores of a stream are those of a batch, to the last bit: a detector observes one row at a time,
and ticks come at times that the rows alone decide.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.contracts import Detector, LearntState, MissionRows, Row, Score
from amberbox.core.errors import AmberboxError
from amberbox.detection.alarms import (
    AlarmOptions,
    AlarmState,
    DetectorAlarm,
    alarm_from_json,
    alarm_to_json,
)
from amberbox.detection.baselines import Baseline, MissionStandardisation
from amberbox.detection.calibration import (
    POOLED,
    UNEVALUATED_DETECTS,
    Calibration,
    NominalScores,
    SeriesThreshold,
    calibrated,
    from_arrays,
    to_arrays,
)

TICK_NS: Final = NS // 2
SILENCE_NS: Final = 60 * NS
"""Without any row for so long, the recorder is taken to be off: the next row begins a mission."""
STEP_BACK_NS: Final = NS
"""A row that arrived so long before the one before it is after a step of the clock."""
_MOST_SERIES = 4096
_MOST_EXCESS = 1e6
_LATEST_NS = 2**62


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """All scores of a mission in the order in which they arose; arrays of one length.

    ``series`` are places in ``names``. ``standardised`` is NaN during the warm-up; ``p_value`` is
    the smaller one of both baselines, NaN without a calibration.
    """

    names: tuple[str, ...]
    at_ns: NDArray[np.int64]
    series: NDArray[np.int64]
    value: NDArray[np.float64]
    standardised: NDArray[np.float64]
    p_value: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.at_ns)


class _SeriesState:
    """The past of one series in the present mission."""

    __slots__ = ("alarm", "fleet", "mission", "own")

    def __init__(
        self, fleet: SeriesThreshold | None, mission: SeriesThreshold | None, options: AlarmOptions
    ) -> None:
        self.fleet, self.mission = fleet, mission
        self.own = MissionStandardisation()
        self.alarm = AlarmState(options)


_Note = Callable[[Score, "float | None"], None]


class LearntDetector:
    """Learns what is normal, is calibrated on other missions, and gives alarms.

    ``update`` and ``tick`` return alarms that begin, and those that end (with ``gone_ns``). Neither
    raises for any row; what could not be used is in ``counts``.
    """

    def __init__(self, name: str, detector: Detector, options: AlarmOptions | None = None) -> None:
        self.name = name
        self.detector = detector
        self.options = options or AlarmOptions()
        self.calibration: Calibration | None = None
        self.found: tuple[int, int] | None = None
        """How many labelled faults it has found, of how many; None if nobody has evaluated it."""
        self._own_baseline = bool(getattr(detector, "own_baseline", True))
        self._counts: Counter[str] = Counter()
        self._series: dict[str, _SeriesState] = {}
        self._note: _Note | None = None
        self._last_ns: int | None = None
        self._next_tick_ns = 0
        self._open: dict[str, DetectorAlarm] = {}
        self._worst: tuple[float, str] | None = None

    @property
    def open_alarms(self) -> tuple[DetectorAlarm, ...]:
        """Return the alarms that last, one at most of each series."""
        return tuple(self._open.values())

    @property
    def detects(self) -> float:
        """Return how probable it finds a fault (Laplace's rule); 0.5 if it was never evaluated."""
        if self.found is None:
            return UNEVALUATED_DETECTS
        found, of = self.found
        return (found + 1) / (of + 2)

    def take_worst(self) -> tuple[float, str] | None:
        """Return the greatest score since the last call, as a multiple of its threshold.

        With the name of its series; None if there was no score.
        """
        worst, self._worst = self._worst, None
        return worst

    @property
    def counts(self) -> dict[str, int]:
        """Return what could not be used so far, by its reason."""
        return dict(self._counts + Counter(self.detector.counts))

    def fit(self, missions: Iterable[MissionRows]) -> None:
        """Learn from nominal missions; raises AmberboxError if there is nothing to learn from."""
        self.calibration = None
        self.detector.fit(list(missions))
        self._forget()

    def calibrate(
        self, missions: Iterable[MissionRows], false_alarms_per_hour: float
    ) -> Calibration:
        """Set thresholds on nominal missions, others than those of ``fit``.

        Raises AmberboxError if they have no scores.
        """
        if not (math.isfinite(false_alarms_per_hour) and false_alarms_per_hour > 0):
            raise AmberboxError("the rate of false alarms has to be a number above 0")
        found = NominalScores()
        self.calibration = None

        def note(score: Score, standardised: float | None) -> None:
            found.add("fleet", score.series, score.at_ns, score.value)
            if standardised is not None:
                found.add("mission", score.series, score.at_ns, standardised)

        for mission in missions:
            found.begin(*mission.span)
            self._run(mission, note)
        if next(found.by_series(), None) is None:
            raise AmberboxError(
                f"{self.name}: the missions to calibrate on have no scores",
                "they need rows of the items that were learnt",
            )
        self.calibration = calibrated(found, false_alarms_per_hour, self.options)
        self._forget()
        return self.calibration

    def score(self, mission: MissionRows) -> Scores:
        """Return all scores of a mission; ``update`` and ``tick`` alarm on the same ones."""
        names: dict[str, int] = {}
        rows: list[tuple[int, int, float, float, float]] = []

        def note(score: Score, standardised: float | None) -> None:
            place = names.setdefault(score.series, len(names))
            own = math.nan if standardised is None else standardised
            rows.append((score.at_ns, place, score.value, own, self.p_value(score, standardised)))

        self._run(mission, note)
        times, places, *numbers = zip(*rows, strict=True) if rows else ((),) * 5
        columns = [np.array(column, np.float64) for column in numbers]
        return Scores(tuple(names), np.array(times, np.int64), np.array(places, np.int64), *columns)

    def p_value(self, score: Score, standardised: float | None) -> float:
        """Return the nominal p-value of a score: the smaller one of the two baselines."""
        if self.calibration is None:
            return math.nan
        fleet, mission = self._threshold("fleet", score), self._threshold("mission", score)
        found = [] if fleet is None else [fleet.nominal.p_value(score.value)]
        if mission is not None and standardised is not None:
            found.append(mission.nominal.p_value(standardised))
        return min(found, default=math.nan)

    def begin(self, at_ns: int) -> list[DetectorAlarm]:
        """Begin a mission; return the alarms that end with the one before."""
        ended = [alarm.ended(max(at_ns, alarm.confirmed_ns)) for alarm in self._open.values()]
        self._forget()
        self._start(at_ns)
        return ended

    def update(self, rows: Sequence[Row]) -> list[DetectorAlarm]:
        """Take rows in the order of their arrival; return the alarms that change."""
        return [alarm for row in rows for alarm in self._take(row)]

    def tick(self, now_ns: int) -> list[DetectorAlarm]:
        """Let time pass up to ``now_ns`` (as ``Row.at_ns``); return the alarms that change.

        All rows that arrived before have to be taken already: later ones count as arrived now.
        """
        return list(self._pass_time(now_ns))

    def snapshot(self) -> dict[str, Any]:
        """Return the state within a mission as JSON, for ``resume``."""
        return {
            "detector": self.detector.snapshot(),
            "last_ns": self._last_ns,
            "next_tick_ns": self._next_tick_ns,
            "series": {
                name: [state.own.snapshot(), state.alarm.snapshot()]
                for name, state in self._series.items()
            },
            "open": [alarm_to_json(alarm) for alarm in self._open.values()],
            "worst": self._worst,
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a snapshot; raises AmberboxError if it is none of this detector."""
        try:
            self._forget()
            self._start(snapshot["last_ns"] or 0)
            self.detector.resume(snapshot["detector"])
            self._last_ns, self._next_tick_ns = snapshot["last_ns"], int(snapshot["next_tick_ns"])
            for name, (own, alarm) in snapshot["series"].items():
                state = self._state(str(name))
                assert state is not None
                state.own.resume(own)
                state.alarm.resume(alarm)
            alarms = [alarm_from_json(alarm) for alarm in snapshot["open"]]
            self._open = {alarm.series: alarm for alarm in alarms}
            worst = snapshot.get("worst")
            self._worst = None if worst is None else (float(worst[0]), str(worst[1]))
        except (ValueError, KeyError, TypeError, AttributeError, AssertionError) as error:
            raise AmberboxError(
                f"the checkpoint does not fit the detector {self.name}: {error!r}",
                "delete it: the detector then begins anew",
            ) from None

    def learnt(self) -> LearntState:
        """Return what was learnt and the calibration, for a model file."""
        state = self.detector.learnt()
        values: dict[str, Any] = {"version": self.detector.version, "learnt": dict(state.values)}
        arrays = {f"learnt_{name}": array for name, array in state.arrays.items()}
        values["options"] = [self.options.persist_s, self.options.hold_s, self.options.release]
        if self.found is not None:
            values["found"] = list(self.found)
        if self.calibration is not None:
            values["calibration"], more = to_arrays(self.calibration)
            arrays |= {f"calibration_{name}": array for name, array in more.items()}
        return LearntState(values, arrays)

    def restore(self, state: LearntState) -> None:
        """Restore what ``learnt`` returned; raise ValueError, KeyError or TypeError if wrong."""
        values = state.values
        if values["version"] != self.detector.version:
            raise ValueError(
                f"version {values['version']} of the detector '{self.name}', "
                f"this program has {self.detector.version}"
            )
        options = [float(number) for number in values["options"]]
        if not all(math.isfinite(number) and number >= 0 for number in options):
            raise ValueError("the options of alarms are not numbers from 0")
        self.options = AlarmOptions(*options)
        self.detector.restore(LearntState(values["learnt"], _named(state, "learnt_")))
        found, of = values.get("found") or (0, 0)
        if not (type(found) is type(of) is int and 0 <= found <= of):
            raise ValueError("the faults found are not numbers of them")
        self.found = (found, of) if of else None
        self.calibration = None
        if "calibration" in values:
            self.calibration = from_arrays(values["calibration"], _named(state, "calibration_"))
        self._forget()

    def _run(self, mission: MissionRows, note: _Note) -> None:
        """Feed a mission from its start to its end."""
        start_ns, end_ns = mission.span
        self._note = note
        try:
            self.begin(start_ns)
            for row in mission:
                for _ in self._take(row):
                    pass
            self.tick(end_ns)
        finally:
            self._note = None
            self._forget()

    def _forget(self) -> None:
        self._series.clear()
        self._open.clear()
        self._worst = None
        self._last_ns = None

    def _start(self, at_ns: int) -> None:
        self._last_ns = at_ns
        self._next_tick_ns = at_ns + TICK_NS
        self.detector.begin(at_ns)

    def _take(self, row: Row) -> Iterator[DetectorAlarm]:
        at_ns = row.at_ns
        if not -_LATEST_NS < at_ns < _LATEST_NS:
            self._counts["rows whose time cannot be"] += 1
            return
        if self._last_ns is None:
            self._start(at_ns)
        assert self._last_ns is not None
        if at_ns < self._last_ns - STEP_BACK_NS:
            self._counts["steps of the clock back by more than a second"] += 1
            yield from self.begin(at_ns)
        elif at_ns > self._last_ns + SILENCE_NS:
            yield from self._pass_time(at_ns)
            self._counts["silences of everything for more than a minute"] += 1
            yield from self.begin(at_ns)
        elif at_ns < self._last_ns or at_ns < self._next_tick_ns - TICK_NS:
            self._counts["rows out of order"] += 1
            row = row._replace(at_ns=max(self._last_ns, self._next_tick_ns - TICK_NS))
        if row.at_ns >= self._next_tick_ns:
            yield from self._pass_time(row.at_ns)
        self._last_ns = row.at_ns
        for score in self.detector.observe(row):
            alarm = self._judge(score)
            if alarm is not None:
                yield alarm

    def _pass_time(self, now_ns: int) -> Iterator[DetectorAlarm]:
        if self._last_ns is None:
            self._start(now_ns)
        assert self._last_ns is not None
        end_ns = min(now_ns, self._last_ns + SILENCE_NS)
        while self._next_tick_ns <= end_ns:
            at_ns = self._next_tick_ns
            self._next_tick_ns += TICK_NS
            for score in self.detector.tick(at_ns):
                alarm = self._judge(score)
                if alarm is not None:
                    yield alarm
            for series in list(self._open):
                if self._series[series].alarm.pass_time(at_ns):
                    yield self._open.pop(series).ended(at_ns)

    def _judge(self, score: Score) -> DetectorAlarm | None:
        value = score.value
        if not 0.0 <= value < math.inf:
            self._counts["scores that are not finite"] += 1
            return None
        state = self._series.get(score.series) or self._state(score.series)
        if state is None:
            self._counts[f"scores of more than {_MOST_SERIES} series"] += 1
            return None
        own = state.own.standardise(score.at_ns, value) if self._own_baseline else None
        if self._note is not None:
            self._note(score, own)
        if state.fleet is None:
            return None
        fleet, mission = state.fleet, state.mission
        excess = _excess(value, fleet)
        if mission is not None and own is not None:
            excess = max(excess, _excess(own, mission))
        if self._worst is None or excess > self._worst[0]:
            self._worst = excess, score.series
        over_own = mission is not None and own is not None and own > mission.threshold
        over = value > fleet.threshold or over_own
        alarm = state.alarm
        if not over and alarm.is_idle:
            return None
        low = value < fleet.release and (mission is None or own is None or own < mission.release)
        if not alarm.take(score.at_ns, over=over, low=low):
            self._note_rarer(score, own, over=over)
            return None
        if not alarm.is_on:
            return self._open.pop(score.series).ended(score.at_ns)
        found = self._alarm(score, own, state)
        self._open[score.series] = found
        return found

    def _note_rarer(self, score: Score, own: float | None, *, over: bool) -> None:
        """Lower the leak of an alarm that lasts, if there is one and its score is much rarer."""
        known = self._open.get(score.series) if over else None
        if known is None or self.calibration is None:
            return
        leaks = [self._leak("fleet", score.series, score.value)]
        if own is not None and "mission" in self.calibration.thresholds:
            leaks.append(self._leak("mission", score.series, own))
        if min(leaks) < known.leak / 2:
            self._open[score.series] = replace(known, leak=min(leaks))

    def _leak(self, baseline: Baseline, series: str, value: float) -> float:
        assert self.calibration is not None
        part = self.calibration.thresholds[baseline]
        one = part.get(series) or part.get(POOLED)
        return (
            1.0
            if one is None
            else self.calibration.leak(baseline, series, one.nominal.p_value(value))
        )

    def _alarm(self, score: Score, own: float | None, state: _SeriesState) -> DetectorAlarm:
        """Return the alarm by the baseline against which the score is rarer."""
        assert state.fleet is not None
        baseline: Baseline = "fleet"
        used, value = state.fleet, score.value
        p_value = used.nominal.p_value(value)
        if state.mission is not None and own is not None:
            other = state.mission.nominal.p_value(own)
            if value <= used.threshold or (own > state.mission.threshold and other < p_value):
                baseline, used, value, p_value = "mission", state.mission, own, other
        return DetectorAlarm(
            self.name,
            score.series,
            state.alarm.onset_ns,
            score.at_ns,
            value,
            used.threshold,
            p_value,
            baseline,
            self.detector.explain(score.series),
            leak=self._leak(baseline, score.series, value),
            detects=self.detects,
        )

    def _state(self, series: str) -> _SeriesState | None:
        if len(self._series) >= _MOST_SERIES:
            return None
        fleet = mission = None
        if self.calibration is not None:
            fleet, mission = (
                part.get(series) or part.get(POOLED)
                for part in (
                    self.calibration.thresholds.get("fleet", {}),
                    self.calibration.thresholds.get("mission", {}),
                )
            )
        state = self._series[series] = _SeriesState(fleet, mission, self.options)
        return state

    def _threshold(self, baseline: Baseline, score: Score) -> SeriesThreshold | None:
        assert self.calibration is not None
        part = self.calibration.thresholds.get(baseline, {})
        return part.get(score.series) or part.get(POOLED)


def _excess(value: float, used: SeriesThreshold) -> float:
    """Return a score as a multiple of its threshold, 0 to 1e6."""
    if used.threshold <= 0:
        return 0.0 if value <= used.threshold else _MOST_EXCESS
    return min(max(value / used.threshold, 0.0), _MOST_EXCESS)


def _named(state: LearntState, prefix: str) -> dict[str, NDArray[Any]]:
    """Return the arrays whose names begin with a prefix, without it."""
    return {n.removeprefix(prefix): a for n, a in state.arrays.items() if n.startswith(prefix)}
