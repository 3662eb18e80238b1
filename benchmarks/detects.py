"""How often each symptom shows for each fault of the catalogue, beside what the FMEA says of it.

``python -m benchmarks.detects --missions 10`` simulates so many missions of each kind of fault with
random magnitudes, on seeds that the figures of ``benchmarks.diagnosis`` are not measured on, and
prints the links whose ``detects`` lies outside the 95 % interval of what was measured. With
``--sizes`` it prints how large the symptoms were, and how many seconds after the fault they began;
with ``--delays`` these seconds as links with ``after_s``, in the form of ``fmea.yaml``.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from amberbox.core.types import Symptom
from amberbox.diagnosis.tracker import FaultTracker
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.record_evaluation import DiagnosedEngine
from amberbox.sim.faults import SimulatedFault, catalogue
from amberbox.sim.robot import START_NS
from benchmarks.accuracy import interval
from benchmarks.diagnosis import polite, world
from benchmarks.missions import Batches, live, mode_of, seconds_of, with_faults

FIRST_SEED = 60_000
ENOUGH = 5
"""So often a symptom must have begun for an interval of its delays."""
MARGIN, LEAST_S = 0.25, 1.0
"""How much wider ``after_s`` is than what was measured: a share of its length, at least 1 s."""
_PLACES = re.compile("front_left|front_right|rear_left|rear_right")
_MIRRORS = {"front": "rear", "rear": "front", "left": "right", "right": "left"}


@dataclass(frozen=True, slots=True)
class Shown:
    """Which symptoms were present in one mission.

    ``symptoms`` are after how many seconds of its fault each was confirmed, ``began`` after how
    many it had begun, ``sizes`` how large those were that have a size.
    """

    fault: str
    mode: str
    magnitude: float
    symptoms: Mapping[str, float]
    sizes: Mapping[str, float] = field(default_factory=dict)
    began: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Job:
    """One mission with one fault: ``number`` of the missions of its kind."""

    kind: str
    number: int


def work(job: Job) -> Shown:
    """Simulate a mission and note which symptoms were present, blocked or not."""
    chance = random.Random(f"detects {job.kind} {job.number}")
    fault = chance.choice(kinds()[job.kind])
    mission = with_faults(FIRST_SEED + chance.randrange(10_000), [fault], chance)
    at = world()
    watcher = DiagnosedEngine(Engine(at.plan), FaultTracker(at.knowledge))
    watcher.begin(START_NS)
    batches = Batches(at.wanted)
    symptoms: dict[str, float] = {}
    sizes: dict[str, float] = {}
    began: dict[str, float] = {}
    for until_s, messages in live(mission):
        for batch in batches.of(messages):
            watcher.feed(batch)
        for found in watcher.advance(START_NS + round(until_s * 1e9)):
            if isinstance(found, Symptom) and found.state == "present":
                after_s = seconds_of(found.confirmed_ns or found.onset_ns or 0) - mission.onset_s
                if after_s < 0:
                    continue
                symptoms.setdefault(found.id, after_s)
                onset_ns = found.onset_ns or found.confirmed_ns or 0
                began.setdefault(found.id, seconds_of(onset_ns) - mission.onset_s)
                if found.size is not None and abs(found.size) >= abs(sizes.get(found.id, 0.0)):
                    sizes[found.id] = found.size
    mode = mode_of(fault, at.knowledge.fmea.modes)
    return Shown(fault.id, mode, mission.faults[0].magnitude, symptoms, sizes, began)


def kinds() -> dict[str, list[SimulatedFault]]:
    """Return the faults of the catalogue by kind: one that several units can have is one kind."""
    found: dict[str, list[SimulatedFault]] = {}
    for fault in catalogue().values():
        found.setdefault(_pooled(fault.id, place_of(fault.id)), []).append(fault)
    return found


def rows(shown: Iterable[Shown]) -> Iterator[tuple[str, str, float, int, int]]:
    """Yield mode, symptom, what the FMEA says, in how many missions it showed, of how many."""
    fmea = world().knowledge.fmea
    missions: dict[str, list[Shown]] = defaultdict(list)
    for each in shown:
        missions[_pooled(each.mode, place_of(each.mode))].append(each)
    for kind, of in sorted(missions.items()):
        said: dict[str, tuple[float, float]] = {}
        came: dict[str, int] = defaultdict(int)
        for link in fmea.modes[of[0].mode].symptoms:
            name = _pooled(link.symptom, place_of(of[0].mode))
            said[name] = link.detects, link.within_s
        for each in of:
            for symptom, after_s in each.symptoms.items():
                name = _pooled(symptom, place_of(each.mode))
                came[name] += after_s <= said.get(name, (0.0, 60.0))[1]
        for name in sorted({*said, *came}, key=lambda n: -came[n]):
            yield kind, name, said.get(name, (0.0, 0.0))[0], came[name], len(of)


@dataclass(slots=True)
class Amounts:
    """The sizes of a symptom by one kind of fault, the levels of those, and its delays, s."""

    sizes: list[float] = field(default_factory=list)
    levels: Counter[int] = field(default_factory=Counter)
    delays_s: list[float] = field(default_factory=list)


def amounts(shown: Iterable[Shown]) -> dict[tuple[str, str], Amounts]:
    """Return how large and how late symptoms were, by mode and symptom."""
    fmea = world().knowledge.fmea
    found: dict[tuple[str, str], Amounts] = defaultdict(Amounts)
    for each in shown:
        place = place_of(each.mode)
        kind = _pooled(each.mode, place)
        for symptom, after_s in each.began.items():
            of = found[kind, _pooled(symptom, place)]
            of.delays_s.append(after_s)
            known = fmea.symptoms.get(symptom)
            scale = known.scale if known else None
            level = scale.level(each.sizes.get(symptom)) if scale else None
            if level is not None:
                of.sizes.append(each.sizes[symptom])
                of.levels[level] += 1
    return found


def _quantiles(values: Sequence[float]) -> str:
    """Return the least, the median and the largest value."""
    return "/".join(f"{value:.3g}" for value in np.quantile(values, (0.0, 0.5, 1.0)))


def _print_amounts(shown: Iterable[Shown]) -> None:
    for (kind, symptom), of in sorted(amounts(shown).items()):
        levels = " ".join(f"{level}:{count}" for level, count in sorted(of.levels.items()))
        sizes = f"size {_quantiles(of.sizes)} in levels {levels}; " if of.sizes else ""
        print(
            f"{kind:34} {symptom:58} {len(of.delays_s):3} times; {sizes}"
            f"after {_quantiles(of.delays_s)} s"
        )


def delays(shown: Iterable[Shown]) -> Iterator[str]:
    """Yield the links of the FMEA with ``after_s``, as its YAML, by mode; quantiles beside them.

    A symptom that is in the FMEA without its mode, or began too seldom, has none.
    """
    known = world().knowledge.fmea.modes
    links: dict[str, set[str]] = defaultdict(set)
    for mode in known.values():
        place = place_of(mode.id)
        links[_pooled(mode.id, place)] |= {_pooled(each.symptom, place) for each in mode.symptoms}
    before = ""
    for (kind, symptom), of in sorted(amounts(shown).items()):
        if symptom not in links[kind] or len(of.delays_s) < ENOUGH:
            continue
        if kind != before:
            yield f'"{kind}":'
        before = kind
        first_s, last_s = after_s(of.delays_s)
        quantiles = "/".join(f"{s:.1f}" for s in np.quantile(of.delays_s, (0.05, 0.5, 0.95)))
        text = f"{len(of.delays_s)} times, 5/50/95 %: {quantiles} s"
        yield f'  - {{symptom: "{symptom}", after_s: [{first_s:g}, {last_s:g}]}}  # {text}'


def after_s(delays_s: Sequence[float]) -> tuple[float, float]:
    """Return the interval of delays, s, wider than what was measured.

    What begins outside of it is not explained by the mode, so the extremes of few missions would
    exclude the next one.
    """
    first_s, last_s = min(delays_s), max(delays_s)
    margin_s = max(LEAST_S, MARGIN * (last_s - first_s))
    return max(0.0, round(first_s - margin_s, 1)), round(last_s + margin_s, 1)


def place_of(name: str) -> str:
    """Return where a component or failure mode is on the robot; empty if there is only one."""
    found = _PLACES.search(name) or re.search("(?<=laser_)(front|rear)", name)
    return found[0] if found else ""


def _pooled(name: str, place: str) -> str:
    """Name places by how they lie to the one that is faulty, as the FMEA's templates do."""
    if "_" not in place:
        other = _MIRRORS.get(place, "")
        named = {place: "<place>", other: "<other>"} if place else {}
        return re.sub("(?<=laser_)(front|rear)", lambda m: named.get(m[0], m[0]), name)
    end, side = place.split("_")
    named = {
        place: "<place>",
        f"{end}_{_MIRRORS[side]}": "<beside>",
        f"{_MIRRORS[end]}_{side}": "<behind>",
        f"{_MIRRORS[end]}_{_MIRRORS[side]}": "<across>",
    }
    return _PLACES.sub(lambda m: named[m[0]], name)


def main(arguments: Sequence[str] | None = None) -> int:
    """Simulate missions, or read what was kept of them, and print what the FMEA has otherwise."""
    parser = argparse.ArgumentParser(description="Measure how often symptoms show.")
    parser.add_argument("--missions", type=int, default=10, help="of each kind of fault")
    parser.add_argument("--first", type=int, default=0, help="number of the first of each kind")
    parser.add_argument("--kind", default="", help="a regular expression that kinds match")
    parser.add_argument("--keep", type=Path, help="add what each mission gave to this file")
    parser.add_argument("--read", type=Path, help="read such a file and simulate nothing")
    parser.add_argument("--all", action="store_true", help="print the links that agree, too")
    parser.add_argument("--sizes", action="store_true", help="print sizes and delays instead")
    parser.add_argument("--delays", action="store_true", help="print links with after_s instead")
    options = parser.parse_args(arguments)
    if options.read:
        shown = [Shown(**json.loads(line)) for line in options.read.read_text().splitlines()]
    else:
        wanted = [kind for kind in kinds() if re.search(options.kind, kind)]
        numbers = range(options.first, options.first + options.missions)
        jobs = [Job(kind, number) for number in numbers for kind in wanted]
        shown = _run(jobs, options.keep)
    if options.sizes:
        _print_amounts(shown)
        return 0
    if options.delays:
        print(*delays(shown), sep="\n")
        return 0
    for kind, symptom, said, came, count in rows(shown):
        low, high = interval(came, count)
        if options.all or not low <= said <= high:
            print(f"{kind:34} {symptom:58} says {said:5.3f}, {came} of {count}")
    return 0


def _run(jobs: Sequence[Job], keep: Path | None) -> list[Shown]:
    shown = []
    with get_context("spawn").Pool(2, polite) as pool:
        for each in pool.imap_unordered(work, jobs):
            shown.append(each)
            if keep is not None:
                with keep.open("a") as file:
                    print(json.dumps(asdict(each)), file=file)
    return shown


if __name__ == "__main__":
    sys.exit(main())
