"""Learns limits, jumps, rest, garbage, rates and gaps of all items, and guards them.

What it learns is also written as mode files for a person to edit (``amberbox learn --monitors``).
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.contracts import LearntState, MissionRows, Row, Score, ScoreReason
from amberbox.core.errors import AmberboxError
from amberbox.core.options import option
from amberbox.detection.limits import (
    RATE_WINDOW_PERIODS,
    RATE_WINDOW_S,
    ItemLimits,
    VariableLimits,
)

_FEWEST = 20
_FEWEST_CHANGES = 20
_GARBAGE_WEIGHT = 0.1
_MOST = 1e6
_TICKS_PER_S = 2


@dataclass(frozen=True)
class Config:
    """Options of the detector."""

    items: int = option(200, "most items that are learnt, in the order of their names")
    variables: int = option(200, "most variables of an item that are learnt")


@dataclass
class _Learning:
    """The rows of one item in all missions, as they are read."""

    names: dict[str, int] = field(default_factory=dict)
    times: list[array[int]] = field(default_factory=list)
    values: list[list[Mapping[str, float]]] = field(default_factory=list)


class _Watched:
    """One learnt item and its rows in the present mission."""

    def __init__(self, limits: ItemLimits, at_ns: int) -> None:
        self.limits = limits
        self.names = [variable.name for variable in limits.variables]
        self.known = frozenset(self.names)
        count = len(self.names)
        of = limits.variables
        self.low = np.array([-np.inf if v.counter else v.low for v in of])
        self.high = np.array([np.inf if v.counter else v.high for v in of])
        self.width = np.array([v.width for v in of])
        self.jump = np.array([np.inf if v.counter else max(v.jump, 0.1 * v.width) for v in of])
        self.rest_s = np.array([np.inf if v.rest_s is None else v.rest_s for v in of])
        self.garbage_share = max((v.garbage for v in of), default=0.0)
        self.last = np.full(count, np.nan)
        self.changed_ns = np.full(count, at_ns, np.int64)
        self.last_ns = at_ns
        self.garbage = self.garbage_share
        self.ticks: deque[int] = deque(maxlen=math.ceil(limits.window_s * _TICKS_PER_S))
        self.received = 0
        self.reasons: dict[str, tuple[str, list[tuple[str, float]], str]] = {}
        self.series = {
            kind: f"{limits.item}/{kind}"
            for kind in ("range", "jump", "garbage", "frozen", "silence", "rate")
        }


class Detector:
    """Scores six series of each item; 0 is within what was learnt."""

    version = 1
    own_baseline = False

    def __init__(self, config: Config) -> None:
        self.config = config
        self.counts: dict[str, int] = {}
        self.limits: tuple[ItemLimits, ...] = ()
        self._watched: dict[str, _Watched] = {}
        self._at_ns = 0

    def fit(self, missions: Sequence[MissionRows]) -> None:
        """See ``Detector`` in ``amberbox.core.contracts``."""
        learning: dict[str, _Learning] = {}
        for number, mission in enumerate(missions):
            for row in mission:
                of_item = learning.setdefault(row.item, _Learning())
                while len(of_item.times) <= number:
                    of_item.times.append(array("q"))
                    of_item.values.append([])
                of_item.times[-1].append(row.at_ns)
                of_item.values[-1].append(row.values)
                if row.values.keys() - of_item.names.keys():
                    for name in row.values:
                        of_item.names.setdefault(name, len(of_item.names))
        found = [_learn_item(item, learning[item], self.config) for item in sorted(learning)]
        self.limits = tuple(limits for limits in found if limits is not None)[: self.config.items]
        if not self.limits:
            raise AmberboxError(
                f"guard: no item has {_FEWEST} messages to learn from", "learn from longer missions"
            )
        self.begin(self._at_ns)

    def begin(self, at_ns: int) -> None:
        """See ``Detector``."""
        self._at_ns = at_ns
        self._watched = {limits.item: _Watched(limits, at_ns) for limits in self.limits}

    def observe(self, row: Row) -> Sequence[Score]:
        """See ``Detector``."""
        of = self._watched.get(row.item)
        if of is None:
            self._count("messages of items that were not learnt")
            return ()
        at_ns = self._at_ns = of.last_ns = row.at_ns
        of.received += 1
        if not of.names:
            return ()
        if not row.values.keys() <= of.known:
            self._count("values of variables that were not learnt")
        given = row.values.get
        values = np.array([given(name, math.nan) for name in of.names])
        finite = np.isfinite(values)
        if not finite.all():
            values[~finite] = math.nan
        with np.errstate(over="ignore", invalid="ignore"):
            outside = np.fmax(of.low - values, values - of.high) / of.width
            steps = np.abs(values - of.last)
            jumps = steps / of.jump - 1.0
        changed = ~(steps == 0) & finite
        of.changed_ns[changed] = at_ns
        np.copyto(of.last, values, where=finite)
        return [
            self._worst(of, "range", at_ns, outside, values),
            self._worst(of, "jump", at_ns, jumps, steps),
            self._garbage_score(of, row, at_ns),
        ]

    def tick(self, now_ns: int) -> Sequence[Score]:
        """See ``Detector``."""
        self._at_ns = now_ns
        return [score for of in self._watched.values() for score in self._tick_item(of, now_ns)]

    def explain(self, series: str) -> ScoreReason:
        """See ``Detector``."""
        item, _, kind = series.rpartition("/")
        of = self._watched[item]
        limits = of.limits
        if kind == "silence":
            age_s = (self._at_ns - of.last_ns) / NS
            longest = f"longest gap learnt: {limits.longest_gap_s:.3g} s"
            text = f"{item}: no message for {age_s:.3g} s ({longest})"
            return ScoreReason("silent", item, "", text, ((item, 1.0),))
        if kind == "rate":
            rate_hz = _rate_hz(of)
            finding = "slow" if rate_hz < limits.mean_hz else "fast"
            text = f"{item}: {rate_hz:.3g} Hz (learnt: {limits.low_hz:.3g} to {limits.high_hz:.3g})"
            return ScoreReason(finding, item, "", text, ((item, 1.0),))
        variable, shares, text = of.reasons.get(kind) or ("", [], f"{item}: nothing yet")
        return ScoreReason(kind, item, variable, text, tuple(shares))

    def learnt(self) -> LearntState:
        """See ``Detector``."""
        return LearntState({"items": [asdict(limits) for limits in self.limits]})

    def restore(self, state: LearntState) -> None:
        """See ``Detector``."""
        self.limits = tuple(_read_item(given) for given in state.values["items"])
        self.begin(0)

    def snapshot(self) -> dict[str, Any]:
        """See ``Detector``."""
        return {
            "at_ns": self._at_ns,
            "items": {
                item: {
                    "last": [None if math.isnan(value) else value for value in of.last.tolist()],
                    "changed_ns": of.changed_ns.tolist(),
                    "last_ns": of.last_ns,
                    "garbage": of.garbage,
                    "ticks": list(of.ticks),
                    "received": of.received,
                    "reasons": of.reasons,
                }
                for item, of in self._watched.items()
            },
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """See ``Detector``."""
        self.begin(int(snapshot["at_ns"]))
        for item, of in self._watched.items():
            given = snapshot["items"][item]
            last = [math.nan if value is None else float(value) for value in given["last"]]
            if len(last) != len(of.names) or len(given["changed_ns"]) != len(of.names):
                raise ValueError("guard: the state of an item does not fit")
            of.last = np.array(last, np.float64)
            of.changed_ns = np.array(given["changed_ns"], np.int64)
            of.last_ns, of.received = int(given["last_ns"]), int(given["received"])
            of.garbage = float(given["garbage"])
            of.ticks.extend(int(count) for count in given["ticks"])
            of.reasons = {
                kind: (name, [(v, float(share)) for v, share in shares], text)
                for kind, (name, shares, text) in given["reasons"].items()
            }

    def _worst(
        self,
        of: _Watched,
        kind: str,
        at_ns: int,
        heights: NDArray[np.float64],
        measured: NDArray[np.float64],
    ) -> Score:
        """Return the score of the worst variable, and note why where it is not 0."""
        over = np.fmin(np.fmax(heights, 0.0), _MOST)  # 0 where a height is NaN
        worst = int(over.argmax())
        height = float(over[worst])
        if height == 0:
            return Score(at_ns, of.series[kind], 0.0)
        limits = of.limits.variables[worst]
        order = np.argsort(-over, kind="stable")[:5].tolist()
        total = float(over.sum())
        shares = [(of.names[i], float(over[i]) / total) for i in order if over[i] > 0]
        value = f"{of.limits.item}.{limits.name}: {float(measured[worst]):.4g}"
        learnt = f"{limits.low:.4g} to {limits.high:.4g}"
        if kind == "jump":
            value, learnt = value.replace(": ", ": changed by "), f"at most {limits.jump:.4g}"
        of.reasons[kind] = (limits.name, shares, f"{value} (learnt: {learnt})")
        return Score(at_ns, of.series[kind], height)

    def _garbage_score(self, of: _Watched, row: Row, at_ns: int) -> Score:
        bad = [name for name, value in row.values.items() if not math.isfinite(value)]
        share = len(bad) / len(row.values) if row.values else 0.0
        of.garbage += _GARBAGE_WEIGHT * (share - of.garbage)
        over = max(of.garbage - of.garbage_share, 0.0) / max(of.garbage_share, 0.05)
        if bad:
            known = [name for name in bad if name in of.known] or [""]
            text = f"{of.limits.item}: {share:.0%} of the values are not finite"
            usual = f" (learnt: {of.garbage_share:.2%})"
            shares = [(name, 1 / len(bad)) for name in bad[:5]]
            of.reasons["garbage"] = (known[0], shares, text + usual)
        return Score(at_ns, of.series["garbage"], over)

    def _tick_item(self, of: _Watched, now_ns: int) -> Sequence[Score]:
        limits = of.limits
        age_s = (now_ns - of.last_ns) / NS
        of.ticks.append(of.received)
        of.received = 0
        silence = max(age_s / limits.longest_gap_s - 1.0, 0.0)
        found = [Score(now_ns, of.series["silence"], silence)]
        if silence == 0 and len(of.ticks) == of.ticks.maxlen:
            rate_hz, one_hz = _rate_hz(of), 2.0 / limits.window_s
            slow = limits.low_hz / max(rate_hz + one_hz, 1e-9) - 1.0
            fast = (rate_hz - one_hz) / limits.high_hz - 1.0
            found.append(Score(now_ns, of.series["rate"], max(slow, fast, 0.0)))
        if silence == 0 and of.names:
            rest_s = (of.last_ns - of.changed_ns) / NS
            height = rest_s / of.rest_s - 1.0
            score = self._worst(of, "frozen", now_ns, height, rest_s)
            if score.value > 0:
                name, shares, _ = of.reasons["frozen"]
                place = of.names.index(name)
                text = f"{limits.item}.{name}: no change for {float(rest_s[place]):.3g} s"
                learnt = f" (learnt: at most {float(of.rest_s[place]):.3g} s)"
                of.reasons["frozen"] = (name, shares, text + learnt)
            found.append(score)
        return found

    def _count(self, what: str) -> None:
        self.counts[what] = self.counts.get(what, 0) + 1


def _rate_hz(of: _Watched) -> float:
    return sum(of.ticks) * _TICKS_PER_S / max(len(of.ticks), 1)


def _learn_item(item: str, rows: _Learning, config: Config) -> ItemLimits | None:
    """Return the limits of an item; None for one with too few messages, or all at one instant."""
    times = [np.frombuffer(part, np.int64) for part in rows.times if len(part)]
    messages = sum(len(part) for part in times)
    gaps_s = [np.diff(part) / NS for part in times]
    lasted_s = float(sum(part.sum() for part in gaps_s))
    if messages < _FEWEST or lasted_s <= 0:
        return None
    mean_hz = sum(len(part) for part in gaps_s) / lasted_s
    window_s = max(RATE_WINDOW_S, RATE_WINDOW_PERIODS / mean_hz)
    rates = np.concatenate([_window_rates(part, window_s) for part in times])
    low_hz, high_hz = (rates.min(), rates.max()) if len(rates) else (mean_hz, mean_hz)
    names = sorted(rows.names, key=rows.names.__getitem__)[: config.variables]
    variables = [_learn_variable(name, times, rows) for name in names]
    return ItemLimits(
        item,
        messages,
        mean_hz,
        max(min(float(low_hz), mean_hz), 1e-9),
        max(float(high_hz), mean_hz),
        float(max(part.max() for part in gaps_s if len(part))),
        tuple(variable for variable in variables if variable is not None),
    )


def _window_rates(times_ns: NDArray[np.int64], window_s: float) -> NDArray[np.float64]:
    """Return the rates (Hz) of all windows that begin at a message and end before the last one."""
    window_ns = round(window_s * NS)
    starts = times_ns[times_ns + window_ns <= times_ns[-1]]
    counts = times_ns.searchsorted(starts + window_ns) - times_ns.searchsorted(starts)
    rates: NDArray[np.float64] = counts / window_s
    return rates


def _learn_variable(
    name: str, times: Sequence[NDArray[np.int64]], rows: _Learning
) -> VariableLimits | None:
    """Return the limits of a variable; None if it was never finite."""
    parts: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []
    given = garbage = 0
    for at_ns, values in zip(times, (part for part in rows.values if part), strict=True):
        column = np.array([entry.get(name, math.nan) for entry in values])
        there = np.array([name in entry for entry in values])
        finite = np.isfinite(column) & (np.abs(column) < 1e300)
        given += int(there.sum())
        garbage += int((there & ~finite).sum())
        if finite.any():
            parts.append((at_ns[finite], column[finite]))
    if not parts:
        return None
    everything = np.concatenate([values for _, values in parts])
    steps = np.concatenate([np.diff(values) for _, values in parts])
    moves = steps[steps != 0]
    changes = [change for part in parts if (change := _change_per_s(*part)) is not None]
    return VariableLimits(
        name,
        float(everything.min()),
        float(everything.max()),
        float(np.abs(steps).max(initial=0.0)),
        max(changes, default=None),
        _longest_rest_s(parts) if len(moves) >= _FEWEST_CHANGES else None,
        garbage / given,
        bool((everything == np.round(everything)).all()),
        bool(len(moves) >= _FEWEST_CHANGES and (moves > 0).mean() >= 0.99),
    )


def _change_per_s(times_ns: NDArray[np.int64], values: NDArray[np.float64]) -> float | None:
    """Return the greatest change from a row to the last one a second later, as the mode has it."""
    later = times_ns[times_ns + NS <= times_ns[-1]]
    if not len(later):
        return None
    after = values[times_ns.searchsorted(later + NS, "right") - 1]
    return float(np.abs(after - values[: len(later)]).max())


def _longest_rest_s(parts: Sequence[tuple[NDArray[np.int64], NDArray[np.float64]]]) -> float:
    """Return the longest time without a change, at least two intervals between rows."""
    longest = 0.0
    for times_ns, values in parts:
        moved = np.flatnonzero(np.diff(values) != 0) + 1
        marks = np.concatenate((times_ns[:1], times_ns[moved], times_ns[-1:]))
        gaps_s = np.diff(times_ns) / NS
        usual_s = 2 * float(np.median(gaps_s)) if len(gaps_s) else 0.0
        longest = max(longest, float(np.diff(marks).max()) / NS, usual_s)
    return max(longest, 1e-3)


def _read_item(given: Mapping[str, Any]) -> ItemLimits:
    """Read the limits of an item; raise ValueError, KeyError or TypeError if they are wrong."""
    variables = tuple(_read_variable(entry) for entry in given["variables"])
    found = ItemLimits(
        str(given["item"]),
        int(given["messages"]),
        _finite(given["mean_hz"]),
        _finite(given["low_hz"]),
        _finite(given["high_hz"]),
        _finite(given["longest_gap_s"]),
        variables,
    )
    if min(found.mean_hz, found.low_hz, found.high_hz, found.longest_gap_s) <= 0:
        raise ValueError("guard: a rate or a gap is not above 0")
    return found


def _read_variable(given: Mapping[str, Any]) -> VariableLimits:
    change, rest = given["change_per_s"], given["rest_s"]
    found = VariableLimits(
        str(given["name"]),
        _finite(given["low"]),
        _finite(given["high"]),
        _finite(given["jump"]),
        None if change is None else _finite(change),
        None if rest is None else _finite(rest),
        _finite(given["garbage"]),
        bool(given["whole"]),
        bool(given["counter"]),
    )
    if found.low > found.high or found.jump < 0 or (found.rest_s or 1) <= 0:
        raise ValueError("guard: the limits of a variable do not fit")
    return found


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError("guard: a limit is not finite")
    return number
