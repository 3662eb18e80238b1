"""Faults that are repaired: how many alarms each raises, what they say, when their cause leaves.

``python -m benchmarks.repairs`` injects every fault of the catalogue by itself, and every fault
with another one after it, and repairs each after a minute, in virtual time.
"""

from __future__ import annotations

import argparse
import itertools
import os
import random
import statistics
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import get_context

from amberbox.core.types import Diagnosis
from amberbox.monitoring.alarms import FOLLOWS
from amberbox.monitoring.findings import AlarmChange
from amberbox.sim.faults import SimulatedFault, catalogue
from benchmarks.common import Row
from benchmarks.diagnosis import findings, world
from benchmarks.missions import Mission, Planted, mode_of, nominal, seconds_of

SEED = 7
FIRST_S, LASTS_S, PAUSE_S, AFTER_S = 30.0, 60.0, 20.0, 180.0
"""When the first fault begins, how long each lasts, how long after that the next, the end."""
STANDS_S = 5.0
"""A leading cause that stands so long needs an alarm."""
URGENT = ("urgent", "critical", "fatal")
COUNT = 12
"""So many missions of each kind `make bench` runs."""


@dataclass(frozen=True, slots=True)
class Life:
    """What became of one fault; ``alarms`` are those that opened in its time and stayed.

    ``left_s`` is how long after its repair it was in no leading answer; None: at the end it was.
    """

    fault: str
    kind: str
    shows: bool
    alarms: int
    titled: bool
    left_s: float | None
    unalarmed: bool


def row_of(faults: Sequence[str], lasts_s: float = LASTS_S, after_s: float = AFTER_S) -> Mission:
    """Return a mission in which faults come one after the other, each repaired before the next."""
    planted = []
    at_s = FIRST_S
    for name in faults:
        fault = catalogue()[name]
        planted.append(Planted(fault, fault.magnitude.default, at_s, at_s + lasts_s))
        at_s += lasts_s + PAUSE_S
    scenario = next((p.fault.scenario for p in planted), "transport")
    return Mission(SEED, scenario, scenario == "transport", tuple(planted), at_s + after_s)


def pairs(seed: int = SEED) -> Iterator[tuple[str, str]]:
    """Yield each fault with another of the same scenario after it."""
    names = [name for name, fault in catalogue().items() if fault.scenario == "transport"]
    others = random.Random(seed).sample(names, len(names))
    yield from ((one, other) for one, other in zip(names, others, strict=True) if one != other)


def lives(mission: Mission) -> list[Life]:
    """Watch a mission and return what became of its faults."""
    found = list(findings(mission))
    alarms = [one for one in found if isinstance(one, AlarmChange)]
    answers = [one for one in found if isinstance(one, Diagnosis)]
    kind = "single" if len(mission.faults) == 1 else "row"
    return [_life(kind, planted, alarms, answers, mission.seconds) for planted in mission.faults]


def _life(
    kind: str,
    planted: Planted,
    alarms: Sequence[AlarmChange],
    answers: Sequence[Diagnosis],
    end_s: float,
) -> Life:
    mode = mode_of(planted.fault, world().knowledge.fmea.modes)
    until_s = planted.until_s + PAUSE_S
    mine = [a for a in alarms if planted.at_s <= seconds_of(a.opened_ns) < until_s]
    kept = {a.id for a in mine} - {a.id for a in mine if a.reason.startswith(FOLLOWS)}
    spans = list(_spans(mode, answers, end_s))
    named = [a for a in mine if mode in a.cause.replace("(", " ").split()]
    last_s = max((to_s for _, to_s in spans), default=0.0)
    return Life(
        planted.fault.id,
        kind,
        any(planted.at_s <= seconds_of(one.at_ns) < until_s for one in answers),
        len(kept),
        bool(named),
        None if last_s >= end_s else max(0.0, last_s - planted.until_s),
        _is_unalarmed(planted.fault, mode, spans, alarms),
    )


def _spans(mode: str, answers: Sequence[Diagnosis], end_s: float) -> Iterator[tuple[float, float]]:
    """Yield from when to when a failure mode is in the leading answer."""
    ends = [*(seconds_of(one.at_ns) for one in answers[1:]), end_s]
    for one, to_s in zip(answers, ends, strict=True):
        if one.state == "open" and any(mode in hypothesis.faults for hypothesis in one.leading()):
            yield seconds_of(one.at_ns), to_s


def _is_unalarmed(
    fault: SimulatedFault,
    mode: str,
    spans: Iterable[tuple[float, float]],
    alarms: Sequence[AlarmChange],
) -> bool:
    """Tell whether it stood in the leading answer, is urgent or worse, and had no alarm by then."""
    modes = world().knowledge.fmea.modes
    if mode not in modes or modes[mode].severity not in URGENT:
        return False
    stood = [(from_s, to_s) for from_s, to_s in spans if to_s - from_s >= STANDS_S]
    opened_s = [seconds_of(alarm.opened_ns) for alarm in alarms]
    return bool(stood) and not any(at_s <= to_s for at_s in opened_s for _, to_s in stood)


def jobs(most: int | None = None) -> list[tuple[str, ...]]:
    """Return the rows of faults of the experiment; of each kind so many at most, mixed."""
    singles: list[tuple[str, ...]] = [(name,) for name in catalogue()]
    rows: list[tuple[str, ...]] = list(pairs())
    chance = random.Random(SEED)
    if most is not None:
        singles, rows = chance.sample(singles, most), chance.sample(rows, most)
    return [*singles, *rows]


def work(faults: Sequence[str]) -> list[Life]:
    """Make a mission and watch it."""
    return lives(row_of(faults))


def run(wanted: Sequence[tuple[str, ...]]) -> list[Life]:
    """Watch missions on all cores."""
    with get_context("spawn").Pool(min(2, os.cpu_count() or 1)) as pool:
        return list(itertools.chain.from_iterable(pool.imap_unordered(work, wanted)))


def calm(number: int) -> int:
    """Count the alarms of a robot without any fault in a quarter of an hour."""
    found = findings(nominal(400_000 + number, 900.0))
    return len({one.id for one in found if isinstance(one, AlarmChange)})


def measure() -> list[Row]:
    """Run the small experiment."""
    return rows(run(jobs(COUNT)))


def rows(found: Sequence[Life]) -> list[Row]:
    """Return the figures of an experiment."""
    made = []
    for kind, words in (("single", "alone"), ("row", "one after the other")):
        some = [life for life in found if life.kind == kind]
        shown = [life for life in some if life.shows]
        if not shown:
            continue
        left = [life.left_s for life in shown if life.left_s is not None]
        made += [
            _row(f"one alarm for one fault, {words}", [one.alarms == 1 for one in shown]),
            _row(f"two alarms and more, {words}", [one.alarms > 1 for one in shown]),
            _row(f"an alarm names the fault, {words}", [one.titled for one in shown]),
            _row(f"urgent, named, without alarm, {words}", [one.unalarmed for one in some]),
            _row(f"leaves the leading answer, {words}", [one.left_s is not None for one in shown]),
            Row(f"how long after its repair, {words}", statistics.median(left or [0.0]), "s",
                note=f"median; at most {max(left, default=0.0):.0f}"),
        ]  # fmt: skip
    return made


def _row(name: str, each: Sequence[bool]) -> Row:
    share = 100.0 * sum(each) / max(1, len(each))
    return Row(name, share, "%", note=f"{sum(each)} of {len(each)}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run an experiment and print its figures."""
    parser = argparse.ArgumentParser(description="Measure alarms of faults that are repaired.")
    parser.add_argument("--most", type=int, help="so many missions of each kind; else all")
    parser.add_argument("--nominal", type=int, default=0, help="quarters of an hour without fault")
    options = parser.parse_args(arguments)
    for row in rows(run(jobs(options.most))):
        print(f"{row.name:52} {row.value:8.3g} {row.unit:3} {row.note}")
    if options.nominal:
        print("alarms of sound robots", sum(map(calm, range(options.nominal))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
