"""Learns the delays between messages of pairs of items; finds silent, late, fast, jittery sources.

The method is that of Golombek et al. (2010): only the times of messages count. The delay since the
last message of an item, seen at a message of another one, has a distribution in nominal operation;
an improbable delay is a surprise, ``-log p`` less its nominal mean. Each source has two moving
means of surprises: of the delays since its messages, at messages of all sources, which notices a
source that is late while others go on; and of the delays at its own messages, which notices a
changed rhythm or phase. What has been silent for long is found as time passes, also where nothing
comes at all. A periodic source that goes on out of its own schedule is found by its stamps, which a
busy recorder does not delay, or by its arrivals where these are more regular. The lag of arrival
behind the own stamp is judged by itself.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.contracts import LearntState, MissionRows, Row, Score, ScoreReason
from amberbox.core.errors import AmberboxError
from amberbox.core.options import option
from amberbox.detection.schedule import Schedule, usual_off

BINS = 60
SHORTEST_S, LONGEST_S = 1e-4, 30.0
_BINS_PER_LOG = BINS / math.log(LONGEST_S / SHORTEST_S)
_LOG_SHORTEST = math.log(SHORTEST_S)
_PRIOR = 0.5
_FEWEST = 20
_CHECKED = 300_000  # messages of the fit by which the moving means are standardised
_FOLLOWED = 100_000  # messages of a source from which its schedule is learnt
_LEAST_SPREAD = 0.05
_OVERDUE = 1.1  # of its longest gap, from which a delay is the fault of the silent source
_RECENT = 8  # messages of a source of which reasons are made
_LEAST_INFORMATION = 0.7  # nats; delays that say less of a rhythm add noise
_LAG_WEIGHT = 0.2
_INTERVAL_WEIGHT = 0.25  # of a message in the mean interval that reasons state
_MOST_LAG_S = 1e6
_LEAST_LAG_SPREAD_S = 0.002


@dataclass(frozen=True)
class Config:
    """Options of the detector."""

    sources: int = option(40, "most items that are learnt, those with the most messages first")
    pairs: int = option(16, "items whose delays are measured at a message: those of similar rates")
    weight: float = option(0.05, "weight of a delay in the mean of its source")
    rhythm_weight: float = option(0.02, "weight of a message in the mean of its own rhythm")


@dataclass
class _Events:
    """The messages of one mission: time of arrival, place of the item, lag behind the stamp."""

    times: NDArray[np.int64]
    sources: NDArray[np.int64]
    lags_s: NDArray[np.float64]
    span: tuple[int, int]


class Detector:
    """Scores up to five series of each source: ITEM, and its rhythm, phase, silence and lag."""

    version = 1
    own_baseline = False

    def __init__(self, config: Config) -> None:
        self.config = config
        self.counts: dict[str, int] = {}
        self.items: list[str] = []
        self._at_ns = 0

    def fit(self, missions: Sequence[MissionRows]) -> None:
        """See ``Detector`` in ``amberbox.core.contracts``."""
        names: dict[str, int] = {}
        missions_of_events = [_events(mission, names) for mission in missions]
        counts = np.zeros(len(names), np.int64)
        for events in missions_of_events:
            counts += np.bincount(events.sources, minlength=len(names))
        order = sorted(range(len(names)), key=lambda i: (-counts[i], list(names)[i]))
        kept = [i for i in order if counts[i] >= _FEWEST][: self.config.sources]
        if not kept:
            raise AmberboxError(
                f"event_timing: no item has {_FEWEST} messages to learn from",
                "learn from longer missions",
            )
        listed = list(names)
        self.items = [listed[i] for i in kept]
        place = np.full(len(names), -1)
        place[kept] = np.arange(len(kept))
        learnt = [_kept(events, place) for events in missions_of_events]
        self._learn_rates(learnt)
        self._learn_delays(learnt)
        self._learn_lags(learnt)
        self._learn_schedules(learnt)
        self._prepare()
        self._learn_means(learnt)

    def begin(self, at_ns: int) -> None:
        """See ``Detector``."""
        count = len(self.items)
        self._at_ns = at_ns
        self._last = np.full(count, at_ns, np.int64)
        self._seen = np.zeros(count, bool)
        self._missing = count
        self._mean = self._usual[0].copy()
        self._rhythm = self._usual[2].tolist()
        self._rhythm_heights = 0.0
        self._recent = [deque[NDArray[np.float64]](maxlen=_RECENT) for _ in self._pairs]
        self._interval_s = self._period_s.tolist()
        self._lag_s = self._usual_lag[0].tolist()
        self._schedules = [Schedule(period_s) if period_s else None for period_s in self._steps_s]

    def observe(self, row: Row) -> Sequence[Score]:
        """See ``Detector``."""
        j = self._place.get(row.item)
        if j is None:
            self._count("messages of items that were not learnt")
            return ()
        at_ns = self._at_ns = row.at_ns
        own, chosen = self._own[j], self._chosen[j]
        delays_s = (at_ns - self._last[chosen]) / NS
        surprise = self._surprises(j, delays_s)
        mean = self._mean[chosen]
        mean = mean + self.config.weight * (surprise - mean)
        self._mean[chosen] = mean
        usual, spread = self._usual_of[j]
        height = _apart((mean - usual) / spread)
        worst = int(height.argmax())
        self._recent[j].append(surprise)
        scores = [
            Score(at_ns, row.item, _positive(float(height[own]))),
            Score(at_ns, self._rhythm_names[j], self._follow_rhythm(j, delays_s, surprise)),
        ]
        if worst != own:
            late = self.items[self._pairs[j][worst]]
            scores.append(Score(at_ns, late, _positive(float(height[worst]))))
        if row.stamp_ns != at_ns or self._has_lag[j]:
            scores.append(self._lag_score(j, row))
        schedule = self._schedules[j]
        if schedule is not None:
            off = schedule.take(row.stamp_ns if self._by_stamp[j] else at_ns)
            score = math.log1p(off / self._usual_off[j])
            scores.append(Score(at_ns, self._phase_names[j], score))
        if not self._seen[j]:
            self._seen[j] = True
            self._missing -= 1
        else:
            interval_s = float(delays_s[own])
            self._interval_s[j] += _INTERVAL_WEIGHT * (interval_s - self._interval_s[j])
        self._last[j] = at_ns
        return scores

    def tick(self, now_ns: int) -> Sequence[Score]:
        """See ``Detector``."""
        self._at_ns = now_ns
        silent = ((now_ns - self._last) / NS / self._gap_s).tolist()
        return [
            Score(now_ns, name, max(age - 1.0, 0.0))
            for name, age in zip(self._silence_names, silent, strict=True)
        ]

    def explain(self, series: str) -> ScoreReason:
        """See ``Detector``."""
        item, _, kind = series.partition("/")
        place = self._place[item]
        if kind == "lag":
            return self._explain_lag(place)
        guilty = self._guilty(place) if kind == "rhythm" else place
        finding, text = self._finding(guilty, kind)
        pairs = self._worst_pairs(guilty)
        if pairs:
            text += f"; least usual: {pairs[0][0]}"
        return ScoreReason(finding, self.items[guilty], "", text, tuple(pairs))

    def learnt(self) -> LearntState:
        """See ``Detector``."""
        values = {
            "items": self.items,
            "pairs": [pairs.tolist() for pairs in self._pairs],
            "has_lag": self._has_lag,
            "weights": [self.config.weight, self.config.rhythm_weight],
        }
        arrays = {
            "period_s": self._period_s,
            "gap_s": self._gap_s,
            "surprise": np.concatenate(self._table),
            "rhythm_weights": np.concatenate(self._weights),
            "usual": self._usual,
            "usual_lag": self._usual_lag,
        }
        arrays["schedule"] = np.array((self._steps_s, self._by_stamp, self._usual_off), np.float64)
        return LearntState(values, arrays)

    def restore(self, state: LearntState) -> None:
        """See ``Detector``."""
        values, arrays = state.values, state.arrays
        items = [str(item) for item in values["items"]]
        pairs = [np.array(entry, np.int64) for entry in values["pairs"]]
        count, total = len(items), sum(len(entry) for entry in pairs)
        shapes = {
            "period_s": (count,),
            "gap_s": (count,),
            "surprise": (total, BINS),
            "rhythm_weights": (total,),
            "usual": (4, count),
            "usual_lag": (2, count),
        }
        schedules = arrays.get("schedule", np.repeat([[0.0], [0.0], [1.0]], count, 1))
        for name, shape in {**shapes, "schedule": (3, count)}.items():
            found = schedules if name == "schedule" else arrays[name]
            if found.shape != shape or found.dtype != np.float64 or not np.isfinite(found).all():
                raise ValueError(f"event_timing: {name} is not as it should be")
        for j, entry in enumerate(pairs):
            if entry.ndim != 1 or j not in entry or entry.min() < 0 or entry.max() >= count:
                raise ValueError("event_timing: the pairs of an item do not fit")
        if not count or len(set(items)) < count or len(pairs) != count:
            raise ValueError("event_timing: the items do not fit")
        positive = (
            arrays["period_s"],
            arrays["gap_s"],
            arrays["usual"][1::2],
            arrays["usual_lag"][1],
            schedules[2],
        )
        if not all(bool((part > 0).all()) for part in positive):
            raise ValueError("event_timing: a period or a spread is not above 0")
        if (schedules[0] < 0).any():
            raise ValueError("event_timing: the period of a schedule is below 0")
        weight, rhythm_weight = (float(number) for number in values["weights"])
        if not (0 < weight <= 1 and 0 < rhythm_weight <= 1):
            raise ValueError("event_timing: a weight is not between 0 and 1")
        has_lag = [bool(entry) for entry in values["has_lag"]]
        if len(has_lag) != count:
            raise ValueError("event_timing: has_lag does not fit")
        self.config = Config(self.config.sources, self.config.pairs, weight, rhythm_weight)
        self.items, self._pairs, self._has_lag = items, pairs, has_lag
        self._period_s, self._gap_s = arrays["period_s"], arrays["gap_s"]
        self._usual, self._usual_lag = arrays["usual"], arrays["usual_lag"]
        self._set_schedules(schedules)
        cuts = np.cumsum([len(entry) for entry in pairs])[:-1]
        self._table = np.split(arrays["surprise"], cuts)
        self._weights = np.split(arrays["rhythm_weights"], cuts)
        self._prepare()

    def snapshot(self) -> dict[str, Any]:
        """See ``Detector``."""
        return {
            "at_ns": self._at_ns,
            "last": self._last.tolist(),
            "seen": self._seen.tolist(),
            "mean": self._mean.tolist(),
            "rhythm": self._rhythm,
            "rhythm_heights": self._rhythm_heights,
            "recent": [[entry.tolist() for entry in recent] for recent in self._recent],
            "interval_s": self._interval_s,
            "lag_s": self._lag_s,
            "schedules": [one and one.snapshot() for one in self._schedules],
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """See ``Detector``."""
        self.begin(int(snapshot["at_ns"]))
        count = len(self.items)
        self._last = _array(snapshot["last"], np.int64, count)
        self._seen = _array(snapshot["seen"], np.bool_, count)
        self._missing = count - int(self._seen.sum())
        self._mean = _array(snapshot["mean"], np.float64, count)
        self._rhythm = _array(snapshot["rhythm"], np.float64, count).tolist()
        self._rhythm_heights = float(snapshot["rhythm_heights"])
        self._interval_s = _array(snapshot["interval_s"], np.float64, count).tolist()
        self._lag_s = _array(snapshot["lag_s"], np.float64, count).tolist()
        for recent, given, pairs in zip(self._recent, snapshot["recent"], self._pairs, strict=True):
            recent.extend(_array(entry, np.float64, len(pairs)) for entry in given)
        for schedule, state in zip(self._schedules, snapshot.get("schedules", ()), strict=False):
            if schedule is not None:
                schedule.resume(state)

    def _learn_rates(self, missions: Sequence[_Events]) -> None:
        """Learn the mean interval and the longest gap of each source, in seconds."""
        count = len(self.items)
        intervals = [
            np.concatenate([np.diff(events.times[events.sources == i]) / NS for events in missions])
            for i in range(count)
        ]
        self._period_s = np.array(
            [max(float(np.mean(part)) if len(part) else 1.0, SHORTEST_S) for part in intervals]
        )
        longest = [float(np.max(part)) if len(part) else 1.0 for part in intervals]
        self._gap_s = np.maximum(np.array(longest), self._period_s)

    def _learn_delays(self, missions: Sequence[_Events]) -> None:
        """Learn the surprise of each delay of each pair, by bins of its logarithm."""
        self._pairs = _similar_rates(self._period_s, self.config.pairs)
        times = [
            [events.times[events.sources == i] for i in range(len(self.items))]
            for events in missions
        ]
        self._table, entropies = [], []
        for j, pairs in enumerate(self._pairs):
            counted = np.zeros((len(pairs), BINS))
            for of_mission in times:
                for row, i in enumerate(pairs.tolist()):
                    counted[row] += _counted(of_mission[i], of_mission[j], same=i == j)
            likely = _smoothed(counted)
            surprise = -np.log(likely)
            shares = counted / np.maximum(counted.sum(1, keepdims=True), 1)
            entropy = np.sum(shares * surprise, 1)
            self._table.append(surprise - entropy[:, None])
            entropies.append(entropy)
        self._weights = _informative(self._pairs, entropies)

    def _learn_lags(self, missions: Sequence[_Events]) -> None:
        """Learn the median lag behind the stamp, and its spread, in seconds."""
        rows = []
        self._has_lag = []
        for i in range(len(self.items)):
            lags = np.concatenate([events.lags_s[events.sources == i] for events in missions])
            low, median, high = np.quantile(lags, (0.05, 0.5, 0.95)).tolist()
            rows.append((median, max((high - low) / 3.29, _LEAST_LAG_SPREAD_S)))
            self._has_lag.append(bool(lags.any()))
        self._usual_lag = np.array(rows).T.copy()

    def _learn_schedules(self, missions: Sequence[_Events]) -> None:
        """Learn the period of each source that has one, and which of its times keep it better."""
        found = np.repeat([[0.0], [0.0], [1.0]], len(self.items), 1)
        most = max(_FOLLOWED // max(len(missions), 1), _FEWEST)
        for i in range(len(self.items)):
            best = math.inf
            for by_stamp in (False, True) if self._has_lag[i] else (False,):
                times = [_times_of(events, i, by_stamp)[:most] for events in missions]
                steps = np.concatenate([np.diff(one) for one in times]) / NS
                period_s = float(np.median(steps)) if len(steps) else 0.0
                if not SHORTEST_S <= period_s <= LONGEST_S:
                    continue
                usual = usual_off(period_s, [one.tolist() for one in times])
                if usual is not None and usual < best:
                    best, found[:, i] = usual, (period_s, by_stamp, usual)
        self._set_schedules(found)

    def _set_schedules(self, found: NDArray[np.float64]) -> None:
        """Set the period (s) of each source or 0, whether stamps keep it, and what is usual."""
        self._steps_s: list[float] = found[0].tolist()
        self._by_stamp = (found[1] > 0).tolist()
        self._usual_off: list[float] = found[2].tolist()

    def _learn_means(self, missions: Sequence[_Events]) -> None:
        """Learn mean and spread of the moving means, by running over the missions."""
        count = len(self.items)
        sums = np.zeros((3, count))
        own = np.zeros((3, count))
        share = _CHECKED / max(sum(len(events.times) for events in missions), 1)
        for events in missions:
            self.begin(events.span[0])
            until = max(math.ceil(share * len(events.times)), 1)
            for at_ns, j in zip(
                events.times[:until].tolist(), events.sources[:until].tolist(), strict=True
            ):
                self.observe(Row(self.items[j], at_ns, at_ns, {}))
                if self._missing:
                    continue
                sums += (np.ones(count), self._mean, self._mean**2)
                rhythm = self._rhythm[j]
                own[:, j] += (1, rhythm, rhythm * rhythm)
        self._usual = np.concatenate((_mean_and_spread(sums), _mean_and_spread(own)))
        self._prepare()
        self.counts.clear()

    def _prepare(self) -> None:
        """Make the tables that a message needs of what was learnt."""
        count = len(self.items)
        self._place = {item: i for i, item in enumerate(self.items)}
        self._rhythm_names = [f"{item}/rhythm" for item in self.items]
        self._lag_names = [f"{item}/lag" for item in self.items]
        self._phase_names = [f"{item}/phase" for item in self.items]
        self._silence_names = [f"{item}/silence" for item in self.items]
        self._own = [int(np.flatnonzero(pairs == j)[0]) for j, pairs in enumerate(self._pairs)]
        everything = np.arange(count)
        self._chosen: list[slice | NDArray[np.int64]] = [
            slice(None) if np.array_equal(pairs, everything) else pairs for pairs in self._pairs
        ]
        self._starts = [np.arange(len(pairs)) * BINS for pairs in self._pairs]
        self._flat = [np.ascontiguousarray(table).ravel() for table in self._table]
        self._limits = [_OVERDUE * self._gap_s[pairs] for pairs in self._pairs]
        if not hasattr(self, "_usual") or self._usual.shape != (4, count):
            self._usual = np.repeat(np.array([[0.0], [1.0]] * 2), count, 1)
        self._usual_of = [(self._usual[0, p], self._usual[1, p]) for p in self._pairs]
        self._usual_rhythm = self._usual[2:].T.tolist()
        self._usual_lag_of = self._usual_lag.T.tolist()
        self.begin(self._at_ns)

    def _surprises(self, j: int, delays_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the surprise of each delay, less its nominal mean."""
        places = np.log(np.maximum(delays_s, SHORTEST_S))
        places -= _LOG_SHORTEST
        places *= _BINS_PER_LOG
        bins = np.minimum(places, BINS - 1).astype(np.int64)
        bins += self._starts[j]
        found = self._flat[j].take(bins)
        if self._missing:
            pairs = self._pairs[j]
            early = ~self._seen[pairs] & (delays_s < 1.5 * self._gap_s[pairs])
            found = np.where(early, 0.0, found)
        return found

    def _follow_rhythm(
        self, j: int, delays_s: NDArray[np.float64], surprise: NDArray[np.float64]
    ) -> float:
        """Add a message to the mean of its own rhythm; return the score.

        The delay since a source that is overdue is not held against this one.
        """
        weights = self._weights[j]
        found = float(surprise @ weights)
        overdue = delays_s > self._limits[j]
        if np.count_nonzero(overdue):
            overdue[self._own[j]] = False
            found -= float((surprise * weights) @ overdue)
        before = self._rhythm_height(j)
        self._rhythm[j] += self.config.rhythm_weight * (found - self._rhythm[j])
        height = self._rhythm_height(j)
        self._rhythm_heights += height - before
        if len(self.items) > 1:
            height -= max((self._rhythm_heights - height) / (len(self.items) - 1), 0.0)
        return _positive(height)

    def _rhythm_height(self, j: int) -> float:
        usual, spread = self._usual_rhythm[j]
        return float((self._rhythm[j] - usual) / spread)

    def _lag_score(self, j: int, row: Row) -> Score:
        lag_s = min(max((row.at_ns - row.stamp_ns) / NS, -_MOST_LAG_S), _MOST_LAG_S)
        self._lag_s[j] += _LAG_WEIGHT * (lag_s - self._lag_s[j])
        usual_s, spread_s = self._usual_lag_of[j]
        off = math.log1p(abs(self._lag_s[j] - usual_s) / spread_s)
        return Score(row.at_ns, self._lag_names[j], off)

    def _guilty(self, place: int) -> int:
        """Return whose fault a changed rhythm is: that of the source, or of one it goes with."""
        surprise = self._recent_surprise(place) * self._weights[place]
        other = int(self._pairs[place][int(surprise.argmax())])
        heights = (self._mean - self._usual[0]) / self._usual[1]
        ours, theirs = (float(heights[i]) + self._rhythm_height(i) for i in (place, other))
        return other if theirs > ours else place

    def _recent_surprise(self, place: int) -> NDArray[np.float64]:
        """Return the mean surprise of the delays at the last messages of a source."""
        recent = self._recent[place]
        return np.mean(recent, 0) if recent else np.zeros(len(self._pairs[place]))

    def _finding(self, place: int, kind: str) -> tuple[str, str]:
        """Return what is wrong with a source in one word, and a sentence."""
        item = self.items[place]
        age_s = (self._at_ns - int(self._last[place])) / NS
        gap_s, period_s = float(self._gap_s[place]), float(self._period_s[place])
        usual = f"longest gap learnt {gap_s:.3g} s, on average {period_s:.3g} s, by arrival"
        if kind == "silence" or age_s > 3 * gap_s:
            return "silent", f"{item}: no message for {age_s:.3g} s ({usual})"
        if age_s > _OVERDUE * gap_s:
            return "late", f"{item}: late, its last message came {age_s:.3g} s ago ({usual})"
        interval_s = self._interval_s[place]
        measured = f"{item}: a message each {interval_s:.3g} s of late ({usual})"
        if interval_s < 0.75 * period_s:
            return "fast", f"{measured}, too fast"
        if interval_s > 1.5 * period_s:
            return "slow", f"{measured}, too slow"
        return "jitter", f"{measured}, out of step"

    def _explain_lag(self, place: int) -> ScoreReason:
        item, usual_s = self.items[place], float(self._usual_lag[0, place])
        lag_s = self._lag_s[place]
        finding = "lag" if lag_s > usual_s else "ahead"
        text = f"{item}: arrives {lag_s:.3g} s after its stamp (usual: {usual_s:.3g} s)"
        return ScoreReason(finding, item, "", text, ((item, 1.0),))

    def _worst_pairs(self, place: int, most: int = 5) -> list[tuple[str, float]]:
        """Return the pairs with this source, the least usual first, and their shares."""
        found: dict[str, float] = {}
        for j, pairs in enumerate(self._pairs):
            for i, height in zip(pairs.tolist(), self._recent_surprise(j).tolist(), strict=True):
                if place in (i, j) and height > 0:
                    found[f"{self.items[i]} before {self.items[j]}"] = height
        total = sum(found.values())
        ranked = sorted(found.items(), key=lambda entry: -entry[1])[:most]
        return [(name, height / total) for name, height in ranked]

    def _count(self, what: str) -> None:
        self.counts[what] = self.counts.get(what, 0) + 1


def _events(mission: MissionRows, names: dict[str, int]) -> _Events:
    """Read the times of a mission; ``names`` gets the items that it has."""
    times, sources, lags = array("q"), array("q"), array("d")
    for row in mission:
        sources.append(names.setdefault(row.item, len(names)))
        times.append(row.at_ns)
        lag_s = (row.at_ns - row.stamp_ns) / NS
        lags.append(min(max(lag_s, -_MOST_LAG_S), _MOST_LAG_S))
    return _Events(
        np.frombuffer(times, np.int64) if times else np.empty(0, np.int64),
        np.frombuffer(sources, np.int64) if sources else np.empty(0, np.int64),
        np.frombuffer(lags, np.float64) if lags else np.empty(0),
        mission.span,
    )


def _kept(events: _Events, place: NDArray[np.int64]) -> _Events:
    """Return the messages of the learnt sources, numbered by ``place``."""
    sources = place[events.sources]
    known = sources >= 0
    return _Events(events.times[known], sources[known], events.lags_s[known], events.span)


def _times_of(events: _Events, source: int, by_stamp: bool) -> NDArray[np.int64]:
    """Return the times at which messages of a source arrived, or were stamped (ns)."""
    chosen = events.sources == source
    times: NDArray[np.int64] = events.times[chosen]
    if by_stamp:
        times = times - np.rint(events.lags_s[chosen] * NS).astype(np.int64)
    return times


def _similar_rates(period_s: NDArray[np.float64], most: int) -> list[NDArray[np.int64]]:
    """Return for each source those to measure at its messages: itself, and similar rates.

    Each source is measured by the four of the most similar rates in any case.
    """
    logs = np.log(period_s)
    apart = np.abs(logs[:, None] - logs)
    np.fill_diagonal(apart, -1.0)
    nearest = np.argsort(apart, 1, kind="stable")
    kept = [set(row[:most].tolist()) for row in nearest]
    for i, row in enumerate(nearest):
        for j in row[:5].tolist():
            kept[j].add(i)
    return [np.array(sorted(entry), np.int64) for entry in kept]


def _counted(of: NDArray[np.int64], at: NDArray[np.int64], *, same: bool) -> NDArray[np.float64]:
    """Return how many delays since ``of``, seen at ``at``, are in each bin."""
    last = np.searchsorted(of, at, "left" if same else "right") - 1
    if same:
        last = np.arange(-1, len(at) - 1)
    delays_s = (at[last >= 0] - of[last[last >= 0]]) / NS
    places = (np.log(np.maximum(delays_s, SHORTEST_S)) - _LOG_SHORTEST) * _BINS_PER_LOG
    bins = np.minimum(places, BINS - 1).astype(np.int64)
    return np.bincount(bins, minlength=BINS).astype(np.float64)


def _smoothed(counted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return probabilities, smoothed with the bins beside, none of them 0."""
    wide = np.pad(counted, ((0, 0), (1, 1)))
    mixed = 0.25 * wide[:, :-2] + 0.5 * wide[:, 1:-1] + 0.25 * wide[:, 2:] + _PRIOR
    found: NDArray[np.float64] = mixed / mixed.sum(1, keepdims=True)
    return found


def _informative(
    pairs: Sequence[NDArray[np.int64]], entropies: Sequence[NDArray[np.float64]]
) -> list[NDArray[np.float64]]:
    """Return how much each delay at a message of a source says of its rhythm; they sum to 1.

    A delay says more the less uncertain it is, compared with delays since the same source that are
    seen at other messages.
    """
    most: dict[int, float] = {}
    for entry, entropy in zip(pairs, entropies, strict=True):
        for i, value in zip(entry.tolist(), entropy.tolist(), strict=True):
            most[i] = max(most.get(i, 0.0), value)
    found = []
    for j, (entry, entropy) in enumerate(zip(pairs, entropies, strict=True)):
        weights = np.array([most[i] for i in entry.tolist()]) - entropy - _LEAST_INFORMATION
        weights = np.maximum(weights, 0.0)
        weights[entry == j] = max(float(weights.max()), 1.0)
        found.append(weights / weights.sum())
    return found


def _mean_and_spread(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return means and standard deviations of counts, sums and sums of squares."""
    count = np.maximum(sums[0], 1)
    mean = sums[1] / count
    spread = np.sqrt(np.maximum(sums[2] / count - mean * mean, 0.0))
    return np.array((mean, np.maximum(spread, _LEAST_SPREAD)))


def _apart(heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much each height is above the mean of the others, or above 0.

    A stall of the recorder, or of a whole computer, delays all sources alike.
    """
    if len(heights) < 2:
        return heights
    others = (float(heights.sum()) - heights) / (len(heights) - 1)
    apart: NDArray[np.float64] = heights - np.maximum(others, 0.0)
    return apart


def _positive(height: float) -> float:
    """Return a smooth positive score: near 0 far below the usual, the height itself far above."""
    return height if height > 30 else math.log1p(math.exp(height))


def _array(values: Any, dtype: Any, count: int) -> NDArray[Any]:
    found = np.array(values, dtype)
    if found.shape != (count,) or not np.isfinite(found).all():
        raise ValueError("event_timing: the state does not fit")
    return found
