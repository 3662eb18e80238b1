"""Faults of communication that event timing finds: crash, half the rate, delay, jitter of a source.

Each fault is put into recorded streams of several rates, for each periodic source, in missions that
were not learnt. A fault counts as found if an alarm begins within 10 s of it (six periods of a slow
source), and as named if the first such alarm names the source.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.contracts import Row as MessageRow
from amberbox.detection.alarms import DetectorAlarm
from amberbox.detection.learnt_detector import LearntDetector
from amberbox.detection.model_file import make_detector
from amberbox.sim.robot import Robot
from amberbox.testing.detectors import T0_NS, GivenMission, mission
from benchmarks.common import Row

ABOUT = "What event timing finds of faults of communication, in missions that were not learnt."
FAULTS = ("crash", "half the rate", "half a period later", "jitter")
SECONDS = 60.0
ONSET_S = 30.0
PER_HOUR = 20.0
_TAIL_S, _TAIL_PERIODS = 10.0, 6.0

Times = NDArray[np.float64]


@dataclass(frozen=True)
class Stream:
    """The messages of one source: seconds of arrival and stamp; no period for mere events."""

    arrived_s: Times
    stamped_s: Times
    period_s: float | None


Streams = Mapping[str, Stream]


def chains(seed: int, seconds: float = SECONDS) -> Streams:
    """Make 16 sources: chains of processing at 10, 20 and 50 Hz, others at 1 to 40 Hz, events.

    The recorder stalls now and then, which delays all of them.
    """
    random = np.random.default_rng(seed)
    stamps: dict[str, tuple[Times, float | None]] = {}
    for name, rate_hz, members, step_s, spread_s in (
        ("lidar", 10.0, 4, 0.02, 0.002),
        ("camera", 20.0, 3, 0.01, 0.001),
        ("imu", 50.0, 3, 0.003, 0.0003),
    ):
        times = np.arange(0, seconds, 1 / rate_hz) + random.uniform(0, 1 / rate_hz)
        times = times + random.normal(0, 0.02 / rate_hz, len(times))
        for member in range(members):
            stamps[f"{name}_{member}"] = (times, 1 / rate_hz)
            times = times + np.abs(random.normal(step_s, spread_s, len(times)))
    for name, rate_hz in (("odom", 40), ("joint", 25), ("gps", 5), ("diag", 2), ("battery", 1)):
        times = np.arange(0, seconds, 1 / rate_hz) * (1 + random.normal(0, 1e-4))
        times = times + random.uniform(0, 1 / rate_hz)
        times = times + np.abs(random.normal(0, 0.03 / rate_hz, len(times)))
        stamps[name] = (times, 1 / rate_hz)
    events = np.cumsum(random.exponential(0.5, round(4 * seconds)))
    stamps["log"] = (events[events < seconds], None)
    stalls = np.cumsum(random.exponential(10.0, round(seconds / 5)))
    ends = stalls + random.exponential(0.01, len(stalls))
    return {
        name: Stream(_arrivals(times, stalls, ends, random), times, period_s)
        for name, (times, period_s) in stamps.items()
    }


def _arrivals(times: Times, stalls: Times, ends: Times, random: np.random.Generator) -> Times:
    arrived = times + np.abs(random.normal(0.002, 0.0007, len(times)))
    for start_s, end_s in zip(stalls, ends, strict=True):
        arrived = np.where((arrived > start_s) & (arrived < end_s), end_s, arrived)
    found: Times = np.maximum.accumulate(arrived)
    return found


def simulated(seed: int, seconds: float = SECONDS) -> Streams:
    """Return the streams of a transport of the simulated robot."""
    times: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for topic, at_ns, message in Robot(seed=seed, scenario="transport").step_until(seconds):
        stamp: Mapping[str, Any] = message["header"]["stamp"]
        times[topic].append((at_ns, stamp["sec"] * NS + stamp["nanosec"]))
    first_ns = min(pairs[0][0] for pairs in times.values())
    return {name: _recorded(np.array(pairs), first_ns) for name, pairs in times.items()}


def _recorded(pairs: NDArray[np.int64], first_ns: int) -> Stream:
    seconds = (pairs - first_ns) / NS
    steps = np.diff(seconds[:, 0])
    is_periodic = len(steps) > 20 and steps.std() < 0.5 * steps.mean()
    period_s = float(np.median(steps)) if is_periodic else None
    return Stream(seconds[:, 0], seconds[:, 1], period_s)


def with_fault(streams: Streams, source: str, fault: str, onset_s: float = ONSET_S) -> Streams:
    """Return streams in which a periodic source has a fault from ``onset_s`` on."""
    stream = streams[source]
    assert stream.period_s is not None
    after = stream.arrived_s >= onset_s
    kept = np.ones(len(after), bool)
    later = np.zeros(len(after))
    if fault == "crash":
        kept = ~after
    elif fault == "half the rate":
        kept = ~(after & (np.cumsum(after) % 2 == 1))
    elif fault == "half a period later":
        later = np.where(after, stream.period_s / 2, 0.0)
    else:
        random = np.random.default_rng(0)
        later = np.where(after, random.uniform(0, 0.9 * stream.period_s, len(after)), 0.0)
    arrived, stamped = (stream.arrived_s + later)[kept], (stream.stamped_s + later)[kept]
    order = np.argsort(arrived, kind="stable")
    return {**streams, source: Stream(arrived[order], stamped[order], stream.period_s)}


def as_mission(streams: Streams, name: str = "mission") -> GivenMission:
    """Return streams as a mission."""
    rows = [
        MessageRow(source, T0_NS + round(at_s * NS), T0_NS + round(stamp_s * NS), {})
        for source, stream in streams.items()
        for at_s, stamp_s in zip(stream.arrived_s.tolist(), stream.stamped_s.tolist(), strict=True)
    ]
    return mission(rows, name)


def learnt(make: Callable[[int], Streams], fitted: int = 6, calibrated: int = 12) -> LearntDetector:
    """Learn from missions of some seeds, and calibrate on those of others."""
    detector = make_detector("event_timing")
    detector.fit([as_mission(make(seed)) for seed in range(fitted)])
    detector.calibrate([as_mission(make(100 + seed)) for seed in range(calibrated)], PER_HOUR)
    return detector


def alarms(detector: LearntDetector, streams: Streams) -> list[DetectorAlarm]:
    """Return the alarms that begin in a mission."""
    given = as_mission(streams)
    detector.begin(given.span[0])
    found = [*detector.update(given.rows), *detector.tick(T0_NS + round(SECONDS * NS))]
    return [alarm for alarm in found if alarm.gone_ns is None]


def first_alarm(
    detector: LearntDetector, streams: Streams, source: str, fault: str
) -> DetectorAlarm | None:
    """Return the first alarm after a fault, if one counts."""
    period_s = streams[source].period_s or 0.0
    last_s = ONSET_S + max(_TAIL_S, _TAIL_PERIODS * period_s)
    for alarm in alarms(detector, with_fault(streams, source, fault)):
        if ONSET_S <= (alarm.confirmed_ns - T0_NS) / NS <= last_s:
            return alarm
    return None


def measure() -> list[Row]:
    """Measure recall, names, false alarms and time."""
    made = (("16 generated sources", chains), ("simulated robot", simulated))
    return [row for name, make in made for row in _measured(name, make)]


def _measured(name: str, make: Callable[[int], Streams], missions: int = 3) -> list[Row]:
    detector = learnt(make)
    found: dict[str, list[bool]] = defaultdict(list)
    named: list[bool] = []
    false = messages = 0
    spent_s = 0.0
    for streams in (make(1000 + seed) for seed in range(missions)):
        messages += sum(len(stream.arrived_s) for stream in streams.values())
        begin_s = time.process_time()
        false += len({a.confirmed_ns // (10 * NS) for a in alarms(detector, streams)})
        spent_s += time.process_time() - begin_s
        for source in (name for name, stream in streams.items() if stream.period_s):
            for fault in FAULTS:
                alarm = first_alarm(detector, streams, source, fault)
                found[fault].append(alarm is not None)
                if alarm is not None:
                    named.append(alarm.reason.item == source)
    rows = [Row(f"{name}: {fault}", float(np.mean(found[fault])), "found") for fault in FAULTS]
    per_hour = false * 3600 / (missions * SECONDS)
    return [
        *rows,
        Row(f"{name}: right source", float(np.mean(named)), "of the faults found"),
        Row(f"{name}: false alarms", per_hour, "per hour", note=f"asked for {PER_HOUR:g}"),
        Row(f"{name}: time", 1e6 * spent_s / messages, "us per message"),
    ]


if __name__ == "__main__":
    for row in measure():
        print(f"{row.name}: {row.value:.3g} {row.unit} {row.note}")
