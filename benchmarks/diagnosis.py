"""How often a diagnosis names what is broken, on simulated missions with random faults.

``python -m benchmarks.diagnosis --missions 300 --hours 20`` makes the full experiment: two thirds
of the missions have one fault, one third has two. `make bench` makes a smaller one.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import json
import math
import os
import random
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli.main import main as amberbox
from amberbox.consult.folder_knowledge import load_knowledge
from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.tracker import FaultTracker
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import Finding
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.record_evaluation import DiagnosedEngine
from amberbox.sim.faults import load_faults
from amberbox.sim.robot import START_NS
from benchmarks.common import Row
from benchmarks.missions import (
    Batches,
    Mission,
    draw,
    live,
    mode_of,
    nominal,
    seconds_of,
    with_faults,
)  # fmt: skip

FIRST_SEED = 400_000
"""Seeds from here on; the FMEA was written with lower ones."""
SINGLES, DOUBLES, NOMINAL_H = 24, 12, 0.5
"""What `make bench` runs."""
UNKNOWN_FAULTS = Path(__file__).with_name("unknown_faults.yaml")
CHUNK_H = 0.25
BANDS = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0)
Z = 1.96


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a mission was diagnosed.

    ``group`` is the first ambiguity group of the answer that stands at its end, ``probability``
    that of its leading hypothesis. Times are in seconds from the first confirmed symptom.
    """

    kind: str
    seed: int
    faults: list[tuple[str, float, float]]
    truth: list[str]
    group: list[list[str]]
    probability: float = 0.0
    split: bool = True
    named_s: float | None = None
    ended_s: float = 0.0
    early: int = 0
    diagnoses: int = 0
    cpu_s: float = 0.0

    @property
    def shows(self) -> bool:
        """Tell whether any symptom was confirmed."""
        return bool(self.group)

    @property
    def is_right(self) -> bool:
        """Tell whether the first group has the true set of faults."""
        return self.truth in self.group


# -- one mission


@dataclass(frozen=True)
class World:
    """The robot folder that is watched: made once in each process."""

    plan: MonitoringPlan
    knowledge: Knowledge
    wanted: dict[str, set[str]]


@functools.cache
def world() -> World:
    """Make a robot folder and read it."""
    with tempfile.TemporaryDirectory() as place, contextlib.redirect_stdout(io.StringIO()):
        path = Path(place) / "robot"
        amberbox(["new", str(path), "--from", "sim"])
        folder = load_folder(path)
        plan, _ = load_plan(folder)
        knowledge, _ = load_knowledge(folder, plan)
    assert knowledge is not None, "the simulated robot has an FMEA"
    wanted: dict[str, set[str]] = {}
    for entry in plan.inputs():
        wanted.setdefault(entry.item, set()).add(entry.variable)
    for symptom in knowledge.fmea.symptoms.values():
        for address in symptom.condition.addresses() if symptom.condition is not None else ():
            item, _, variable = address.partition(".")
            wanted.setdefault(item, set()).add(variable.partition("[")[0])
    return World(plan, knowledge, wanted)


def findings(mission: Mission) -> Iterator[Finding]:
    """Yield what the watcher of a robot finds in a mission."""
    at = world()
    watcher = DiagnosedEngine(Engine(at.plan), FaultTracker(at.knowledge))
    watcher.begin(START_NS)
    batches = Batches(at.wanted)
    for until_s, messages in live(mission):
        for batch in batches.of(messages):
            watcher.feed(batch)
        yield from watcher.advance(START_NS + round(until_s * NS))


def diagnoses(mission: Mission) -> Iterator[Diagnosis]:
    """Yield the revisions of all diagnoses of a mission."""
    return (found for found in findings(mission) if isinstance(found, Diagnosis))


def judge(kind: str, mission: Mission, truth: Sequence[str]) -> Outcome:
    """Diagnose a mission and compare the answer with what is true."""
    start_s = time.process_time()
    made = list(diagnoses(mission))
    standing = [each for each in made if each.state == "open" and each.hypotheses]
    late = [each for each in standing if seconds_of(each.at_ns) >= mission.onset_s]
    faults = [(p.fault.id, p.magnitude, p.at_s) for p in mission.faults]
    found = Outcome(
        kind, mission.seed, faults, sorted(truth), [],
        early=len(standing) - len(late),
        diagnoses=len({each.id for each in made}),
    )  # fmt: skip
    took_s = time.process_time() - start_s
    if not late:
        return Outcome(**{**asdict(found), "cpu_s": took_s})
    last, first_ns = late[-1], late[0].at_ns
    right = (each.at_ns for each in late if found.truth in first_group(each))
    named_ns = next(right, None)
    return Outcome(
        **{
            **asdict(found),
            "group": first_group(last),
            "probability": last.hypotheses[0].probability,
            "split": len(last.groups[0].members) < 2 or bool(last.groups[0].split_by),
            "named_s": None if named_ns is None else (named_ns - first_ns) / NS,
            "ended_s": (last.at_ns - first_ns) / NS,
            "cpu_s": took_s,
        }
    )


def first_group(diagnosis: Diagnosis) -> list[list[str]]:
    """Return the sets of faults of the leading ambiguity group."""
    faults = {each.id: sorted(each.faults) for each in diagnosis.hypotheses}
    return [faults[name] for name in diagnosis.groups[0].members]


# -- all missions


@dataclass(frozen=True, slots=True)
class Job:
    """A mission to be judged: ``number`` of its ``kind``."""

    kind: str
    number: int


def work(job: Job) -> Outcome:
    """Make and judge a mission."""
    if job.kind == "nominal":
        return judge(job.kind, nominal(FIRST_SEED + job.number, CHUNK_H * 3600.0), [])
    if job.kind == "unknown":
        faults = list(load_faults(UNKNOWN_FAULTS).values())
        chance = random.Random(f"unknown {job.number}")
        fault = faults[job.number % len(faults)]
        return judge(job.kind, with_faults(FIRST_SEED + job.number, [fault], chance), [UNKNOWN])
    mission = draw(FIRST_SEED + job.number, 1 if job.kind == "single" else 2)
    modes = world().knowledge.fmea.modes
    return judge(job.kind, mission, [mode_of(planted.fault, modes) for planted in mission.faults])


def jobs(singles: int, doubles: int, unknown: int, hours: float) -> list[Job]:
    """List the missions of an experiment, mixed so that a part of them is a fair sample."""
    chunks = round(hours / CHUNK_H)
    counts = {"single": singles, "double": doubles, "unknown": unknown, "nominal": chunks}
    made = [Job(kind, number) for kind, count in counts.items() for number in range(count)]
    random.Random(0).shuffle(made)
    return made


def run(wanted: Sequence[Job], tell: Callable[[Outcome], None] = lambda _: None) -> list[Outcome]:
    """Judge missions on all cores, politely."""
    found = []
    with get_context("spawn").Pool(min(2, os.cpu_count() or 1), polite) as pool:
        for outcome in pool.imap_unordered(work, wanted):
            tell(outcome)
            found.append(outcome)
    return sorted(found, key=lambda each: (each.kind, each.seed))


def polite() -> None:
    """Give way to everything else on the machine."""
    os.nice(10)


# -- figures


def measure() -> list[Row]:
    """Run the small experiment."""
    return rows(run(jobs(SINGLES, DOUBLES, 10, NOMINAL_H)))


def rows(found: Sequence[Outcome]) -> list[Row]:
    """Return the figures of an experiment."""
    of = {kind: [o for o in found if o.kind == kind] for kind in ("single", "double", "unknown")}
    faulty = [*of["single"], *of["double"]]
    shown = [outcome for outcome in faulty if outcome.shows]
    nominal_runs = [outcome for outcome in found if outcome.kind == "nominal"]
    made = [
        _share("one fault named", of["single"], "target: 95"),
        _share("two faults named", of["double"], "both, in one set; target: 80"),
        _share("not in the FMEA, said so", of["unknown"], "target: 70"),
        Row("faults without any symptom", len(faulty) - len(shown), f"of {len(faulty)}"),
    ]
    sizes = [len(outcome.group) for outcome in shown]
    if sizes:
        made.append(Row("mean size of the first group", statistics.fmean(sizes), "sets",
                        note="target: 2.0"))  # fmt: skip
        made.append(Row("largest first group", max(sizes), "sets", note="target: 6"))
        times = [math.inf if o.named_s is None else o.named_s for o in shown]
        median = statistics.median(times)
        made.append(Row("median time to name it", median, "s",
                        note="after the first confirmed symptom; target: 3"))  # fmt: skip
    if nominal_runs:
        count = sum(outcome.diagnoses for outcome in nominal_runs)
        note = f"in {len(nominal_runs) * CHUNK_H:g} nominal hours; target: 1 in 20"
        made.append(Row("diagnoses of a sound robot", count, "", note=note))
    return [*made, *_reliability(shown)]


def _share(name: str, outcomes: Sequence[Outcome], note: str) -> Row:
    right, count = sum(o.is_right for o in outcomes), len(outcomes)
    low, high = interval(right, count)
    text = f"{right} of {count}; 95 % interval {100 * low:.0f}-{100 * high:.0f} %; {note}"
    return Row(name, 100.0 * right / max(1, count), "%", note=text)


def _reliability(shown: Iterable[Outcome]) -> Iterator[Row]:
    """Yield how often leading hypotheses are right, by how probable they are said to be."""
    outcomes = list(shown)
    for low, high in pairwise(BANDS):
        inside = [o for o in outcomes if low <= o.probability < high or high == o.probability == 1]
        if not inside:
            continue
        right = sum(o.truth == o.group[0] for o in inside)
        said = statistics.fmean(o.probability for o in inside)
        note = f"{right} of {len(inside)}; said {100 * said:.0f} % on average"
        name = f"right where {100 * low:.0f}-{100 * high:.0f} % is said"
        yield Row(name, 100.0 * right / len(inside), "%", note=note)


def interval(right: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson's)."""
    if not count:
        return 0.0, 1.0
    share, extra = right / count, Z * Z / count
    middle = (share + extra / 2) / (1 + extra)
    half = Z / (1 + extra) * math.sqrt(share * (1 - share) / count + extra / (4 * count))
    return max(0.0, middle - half), min(1.0, middle + half)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run an experiment of a given size and print its figures."""
    parser = argparse.ArgumentParser(description="Measure how often diagnoses are right.")
    parser.add_argument("--missions", type=int, default=SINGLES + DOUBLES)
    parser.add_argument("--unknown", type=int, default=10)
    parser.add_argument("--hours", type=float, default=NOMINAL_H)
    parser.add_argument("--keep", type=Path, help="write what each mission gave to this file")
    options = parser.parse_args(arguments)
    doubles = options.missions // 3
    wanted = jobs(options.missions - doubles, doubles, options.unknown, options.hours)
    kept = options.keep.open("a") if options.keep else None

    def tell(outcome: Outcome) -> None:
        if kept is not None:
            print(json.dumps(asdict(outcome)), file=kept, flush=True)

    _print(rows(run(wanted, tell)))
    return 0


def _print(made: Iterable[Row]) -> None:
    for row in made:
        print(f"{row.name:36} {row.value:8.3g} {row.unit:5} {row.note}")


if __name__ == "__main__":
    sys.exit(main())
