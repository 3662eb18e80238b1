"""Evaluation of detectors against labelled faults, event by event.

A fault is found if an episode of an alarm starts from ``tolerance_s`` before its onset to
``tail_s`` after its end; an alarm that was on already does not count. Every ten seconds begun of an
alarm in nominal time are one false alarm. There are no point-adjusted scores: with them a score of
random numbers seems to find nearly everything.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.timestamps import format_duration
from amberbox.detection.alarms import DetectorAlarm
from amberbox.detection.calibration import LONG_ALARM_S, count_alarms
from amberbox.detection.labels import FaultLabel
from amberbox.detection.record_detection import Detected, DetectorScore

ALL, RANDOM, ALWAYS = "all detectors", "random score", "always-on alarm"
_DRAWS = 200
_LAST_NS = 2**63 - 1
_SHORT_GAP_NS = 2 * NS


@dataclass(frozen=True, slots=True)
class EvaluationOptions:
    """How far from a fault an alarm may start to count for it (s)."""

    tolerance_s: float = 1.0
    tail_s: float = 5.0


@dataclass(frozen=True, slots=True)
class Episode:
    """An alarm of one series, merged over short gaps: when it was confirmed and gone (ns)."""

    from_ns: int
    to_ns: int
    addresses: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class EvaluationRow:
    """The figures of one detector; None where there is nothing to compute them from.

    ``isolated`` is the share of the faults found and labelled with an item or a source, of which
    the first alarm names it. Delays are from the onset of a fault to the first alarm.
    """

    detector: str
    recall: float
    precision: float | None
    f1: float
    false_alarms: float
    false_alarms_per_hour: float | None
    delay_median_s: float | None = None
    delay_max_s: float | None = None
    isolated: float | None = None


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The rows of all detectors, and the nominal time that false alarms were counted in."""

    rows: tuple[EvaluationRow, ...]
    faults: int
    nominal_h: float
    outside: int = 0
    """Faults of which nothing is in the record; they count as not found."""

    @property
    def promise(self) -> str:
        """Return how many faults there were, and which rate of false alarms can be shown."""
        faults = f"{self.faults} fault{'' if self.faults == 1 else 's'}"
        if not self.nominal_h:
            return f"{faults}, no nominal time: no rate of false alarms is known"
        return (
            f"{faults}, {format_duration(round(self.nominal_h * 3600 * NS))} of nominal operation: "
            f"no rate of false alarms below {1 / self.nominal_h:.3g} per hour can be shown"
        )


def evaluate(
    found: Iterable[Detected],
    labels: Sequence[FaultLabel],
    source_of: Mapping[str, str],
    options: EvaluationOptions = EvaluationOptions(),
) -> Evaluation:
    """Judge what detectors found in a record by its labels.

    The seconds of which there are scores count as watched; faults outside of them do as well, as
    not found. ``source_of`` names the source of each item.
    """
    alarms: dict[str, list[DetectorAlarm]] = defaultdict(list)
    watched: set[int] = set()
    names: dict[str, None] = {}
    for one in found:
        names.setdefault(one.detector)
        if isinstance(one, DetectorScore):
            watched.add(one.at_ns // NS - 1)
        else:
            alarms[one.detector].append(one)
    judge = _Judge(labels, watched, source_of, options)
    by_name = {name: _episodes(alarms[name], judge.end_ns) for name in names}
    everything = [episode for part in by_name.values() for episode in part]
    every_row = judge.row(ALL, everything)
    rows = [judge.row(name, part) for name, part in by_name.items()]
    if len(rows) > 1:
        rows.append(every_row)
    rows += [judge.random_row(every_row.false_alarms), judge.row(ALWAYS, judge.always())]
    return Evaluation(tuple(rows), len(labels), judge.nominal_s / 3600, judge.outside)


def _episodes(alarms: Sequence[DetectorAlarm], end_ns: int) -> list[Episode]:
    """Return the episodes of alarms, which come as they begin and as they end."""
    lasting: dict[str, DetectorAlarm] = {}
    done: dict[str, list[Episode]] = defaultdict(list)
    for alarm in alarms:
        if alarm.gone_ns is None:
            lasting[alarm.series] = alarm
        elif lasting.pop(alarm.series, None) is not None:
            _add(done[alarm.series], alarm, alarm.gone_ns)
    for alarm in lasting.values():
        _add(done[alarm.series], alarm, max(end_ns, alarm.confirmed_ns))
    return [episode for part in done.values() for episode in part]


def _add(part: list[Episode], alarm: DetectorAlarm, to_ns: int) -> None:
    if part and alarm.confirmed_ns - part[-1].to_ns < _SHORT_GAP_NS:
        part[-1] = Episode(part[-1].from_ns, to_ns, part[-1].addresses)
    else:
        part.append(Episode(alarm.confirmed_ns, to_ns, alarm.addresses))


class _Judge:
    """Compares episodes with labels in the watched seconds of a record."""

    def __init__(
        self,
        labels: Sequence[FaultLabel],
        watched: set[int],
        source_of: Mapping[str, str],
        options: EvaluationOptions,
    ) -> None:
        self._labels, self._source_of = labels, source_of
        before_ns, after_ns = round(options.tolerance_s * NS), round(options.tail_s * NS)
        self._windows = [
            (max(one.from_ns - before_ns, -_LAST_NS), min(one.to_ns + after_ns, _LAST_NS))
            for one in labels
        ]
        self._seconds = np.array(sorted(watched), np.int64)
        faulty, self.outside = self._inside(self._windows)
        self._nominal = ~faulty
        self.nominal_s = int(self._nominal.sum())
        self.end_ns = (max(watched, default=-1) + 1) * NS

    def _inside(self, spans: Sequence[tuple[int, int]]) -> tuple[NDArray[np.bool_], int]:
        """Return which watched seconds are in spans (ns), and how many spans are outside of all."""
        found = np.zeros(len(self._seconds), bool)
        outside = 0
        for from_ns, to_ns in spans:
            first = int(np.searchsorted(self._seconds, from_ns // NS))
            end = int(np.searchsorted(self._seconds, to_ns // NS, "right"))
            found[first:end] = True
            outside += first == end
        return found, outside

    def row(self, name: str, episodes: Sequence[Episode]) -> EvaluationRow:
        """Return the figures of some episodes."""
        ordered = sorted(episodes, key=lambda episode: episode.from_ns)
        starts = [episode.from_ns for episode in ordered]
        hits: list[tuple[FaultLabel, Episode]] = []
        for label, (from_ns, to_ns) in zip(self._labels, self._windows, strict=True):
            place = bisect_left(starts, from_ns)
            if place < len(starts) and starts[place] <= to_ns:
                hits.append((label, ordered[place]))
        delays = [max(e.from_ns - label.from_ns, 0) / NS for label, e in hits]
        named = [self._names(label, e) for label, e in hits if label.item or label.source]
        return _row(
            name, len(hits), len(self._labels), self._false_alarms(episodes), self.nominal_s,
            (median(delays), max(delays)) if delays else (None, None),
            sum(named) / len(named) if named else None,
        )  # fmt: skip

    def random_row(self, false_alarms: float) -> EvaluationRow:
        """Return the mean figures of a random score at the same rate of false alarms."""
        rate = min(false_alarms * LONG_ALARM_S / max(self.nominal_s, 1), 0.999)
        chance = 1 - (1 - rate) ** (1 / LONG_ALARM_S)
        windows = np.array(self._windows, np.int64).reshape(-1, 2)
        random = np.random.default_rng(0)
        found = 0
        for _ in range(_DRAWS):
            on = self._seconds[random.random(len(self._seconds)) < chance]
            starts = on[np.diff(on, prepend=-(10**10)) > 1] * NS
            first = np.searchsorted(starts, windows[:, 0])
            found += int((np.searchsorted(starts, windows[:, 1], "right") > first).sum())
        return _row(RANDOM, found / _DRAWS, len(self._labels), false_alarms, self.nominal_s)

    def always(self) -> list[Episode]:
        """Return the episode of an alarm that is always on."""
        if not len(self._seconds):
            return []
        return [Episode(int(self._seconds[0]) * NS, self.end_ns, ())]

    def _names(self, label: FaultLabel, episode: Episode) -> bool:
        """Return whether an alarm names the item and the source of a fault."""
        address = episode.addresses[0] if episode.addresses else ""
        item = address.split(".")[0]
        is_item = label.item in ("", item, address)
        return is_item and label.source in ("", self._source_of.get(item, ""))

    def _false_alarms(self, episodes: Sequence[Episode]) -> int:
        """Return how often ten seconds of an alarm begin in nominal seconds."""
        spans = [(e.from_ns, max(e.to_ns - 1, e.from_ns)) for e in episodes]
        on = self._inside(spans)[0] & self._nominal
        return count_alarms([(0, second) for second in self._seconds[on].tolist()])


def _row(
    name: str,
    found: float,
    faults: int,
    false: float,
    nominal_s: int,
    delays: tuple[float | None, float | None] = (None, None),
    isolated: float | None = None,
) -> EvaluationRow:
    recall = found / faults if faults else 0.0
    precision = found / (found + false) if found + false else None
    total = recall + (precision or 0.0)
    f1 = 2 * recall * (precision or 0.0) / total if total else 0.0
    per_hour = false * 3600 / nominal_s if nominal_s else None
    return EvaluationRow(name, recall, precision, f1, false, per_hour, *delays, isolated)
