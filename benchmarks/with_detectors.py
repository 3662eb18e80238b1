"""What detectors find that nobody has written a monitor for, and what they add to diagnoses.

``python -m benchmarks.with_detectors --model learn --keep FILE`` drives each mission once, watched
without and with the detectors of a nominal hour beside it; the same command goes on with FILE after
an interruption. ``--keep FILE --print --page docs/reference/accuracy.md`` renews the tables there.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import msgspec

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.types import Diagnosis, Symptom
from amberbox.detection.alarms import COMBINED, DetectorAlarm
from amberbox.sim.faults import catalogue
from amberbox.sim.robot import START_NS
from benchmarks import detectors
from benchmarks.accuracy import KNOWN_KINDS, Outcome, with_figures
from benchmarks.common import kept_lines
from benchmarks.detectors import HOUR_S, Following
from benchmarks.detects import place_of
from benchmarks.diagnosis import (
    CHUNK_H,
    Job,
    Watching,
    mission_of,
    outcome_of,
    polite,
    truth_of,
    with_alarms,
    world,
    world_with,
)
from benchmarks.missions import Mission, live, seconds_of, with_faults

FIRST_SEED = 980_000
EACH = "each"
"""Missions with one fault each, all of the catalogue in turns."""
KINDS = {EACH: len(catalogue()), "double": 30, "drawn": 40, "knobs": 20}
HOURS = 1.0
BEGIN, END = "<!-- detectors -->", "<!-- end of detectors -->"


@dataclass(frozen=True, slots=True)
class Scored:
    """One mission, watched without and with detectors.

    ``found_s`` are the seconds from the onset to the first alarm of each detector since then, and
    ``named_s`` to the first alarm that names the disturbed variable (of a whole message, the item)
    or one of the faulty component; ``shown_s`` to the first symptom of a monitor or condition.
    Each is None if there was none. ``false`` are the alarms of each detector before it.
    """

    without: Outcome
    found: Outcome
    found_s: dict[str, float] = field(default_factory=dict)
    named_s: float | None = None
    shown_s: float | None = None
    false: dict[str, int] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """Return the kind of mission."""
        return self.without.kind

    @property
    def detected_s(self) -> float | None:
        """Return the seconds to the first alarm of any detector."""
        return min(self.found_s.values(), default=None)


# -- one mission


def score(job: Job) -> Scored:
    """Drive the mission of a job, and watch it without and with detectors."""
    return score_mission(job.kind, _mission(job))


def score_mission(kind: str, mission: Mission) -> Scored:
    """Drive a mission, and watch it without and with detectors."""
    start_s = time.process_time()
    following = Following(_model())
    watchers = Watching(world_with(None)), Watching(world())
    made: tuple[list[Diagnosis], list[Diagnosis]] = ([], [])
    shown_s: float | None = None
    for until_s, messages in live(mission):
        until_ns = START_NS + round(until_s * NS)
        told = list(following.take(messages, until_ns))
        for watching, of, heard in zip(watchers, made, ((), told), strict=True):
            for one in watching.take(messages, until_ns, heard):
                if isinstance(one, Diagnosis):
                    of.append(one)
                elif shown_s is None and not heard and isinstance(one, Symptom):
                    shown_s = _shown_s(one, mission)
    without, found = (outcome_of(kind, mission, truth_of(kind, mission), of) for of in made)
    found = replace(with_alarms(found, mission, following), cpu_s=time.process_time() - start_s)
    return _scored(without, found, mission, following.alarms, shown_s)


def _mission(job: Job) -> Mission:
    if job.kind != EACH:
        return mission_of(job)
    faults = list(catalogue().values())
    chance = random.Random(f"each {job.seed}")
    return with_faults(job.seed, [faults[job.number % len(faults)]], chance)


def _model() -> Path:
    path = detectors.model_path()
    assert path is not None, "the experiment has a model"
    return path


def _shown_s(symptom: Symptom, mission: Mission) -> float | None:
    """Return how long after the onset a symptom that counts was confirmed."""
    if symptom.state != "present" or symptom.blocked_by:
        return None
    after_s = seconds_of(symptom.confirmed_ns or 0) - mission.onset_s
    return after_s if after_s >= 0 else None


def _scored(
    without: Outcome,
    found: Outcome,
    mission: Mission,
    alarms: Sequence[DetectorAlarm],
    shown_s: float | None,
) -> Scored:
    own = [alarm for alarm in alarms if alarm.detector != COMBINED]
    after = [(seconds_of(a.confirmed_ns) - mission.onset_s, a) for a in own]
    named = [s for s, alarm in after if s >= 0 and names(alarm, mission)]
    found_s: dict[str, float] = {}
    for s, alarm in after:
        if s >= 0:
            found_s[alarm.detector] = min(s, found_s.get(alarm.detector, s))
    false = {
        name: detectors.counted([a for s, a in after if s < 0 and a.detector == name])
        for name in detectors.DETECTORS
    }
    return Scored(without, found, found_s, min(named, default=None), shown_s, false)


def names(alarm: DetectorAlarm, mission: Mission) -> bool:
    """Return whether an alarm names what is wrong: a disturbed variable, or a faulty component.

    A component is named by a variable that its monitors read; of one of several like ones, such as
    the wheel units, by a variable of its own.
    """
    address = alarm.addresses[0]
    for one in mission.disturbances:
        for path in (one.variable, one.other or one.variable):
            disturbed = f"sim_{one.item}.{path.replace('.', '_')}".rstrip(".")
            if address == disturbed or address.startswith((f"{disturbed}.", f"{disturbed}[")):
                return True
    readers = world().knowledge.fmea.readers.get(address.partition("[")[0], frozenset())
    faulty = {mode.partition("#")[0] for mode in truth_of(EACH, mission)}
    return any(place_of(component) in address for component in faulty & readers)


# -- the tables


def tables(scored: Sequence[Scored], state: str) -> str:
    """Return what was measured as Markdown."""
    seeds = [one.without.seed for one in scored] or [0]
    lines = [
        f"State of the code: {state or 'not named'}. Seeds {min(seeds)} to {max(seeds)}.",
        "",
        *_found(scored),
        "",
        *_false(scored),
        "",
        *_diagnosed(scored),
        "",
        *_kinds(scored),
        "",
        *_faults(scored),
    ]
    return "\n".join(lines) + "\n"


_NAMES = {
    EACH: "one fault of the catalogue",
    "double": "two faults",
    "knobs": "fault of `unknown_faults.yaml`",
    "drawn": "drawn disturbance",
}


def _found(scored: Sequence[Scored]) -> Iterator[str]:
    yield (
        "| mission with | missions | monitors find | detectors find | only detectors | neither "
        "| delay, median | the right one named | by |"
    )
    yield "|---|--:|--:|--:|--:|--:|--:|--:|---|"
    for kind, name in _NAMES.items():
        of = [one for one in scored if one.kind == kind]
        if not of:
            continue
        found = [one for one in of if one.found_s]
        delays = [one.detected_s for one in found if one.detected_s is not None]
        by = Counter(detector for one in found for detector in one.found_s)
        yield _cells(
            name, len(of), sum(one.shown_s is not None for one in of), len(found),
            sum(one.shown_s is None for one in found),
            sum(one.shown_s is None and not one.found_s for one in of),
            f"{statistics.median(delays):.1f} s" if delays else "",
            f"{sum(one.named_s is not None for one in found)} of {len(found)}",
            ", ".join(f"{detector} {count}" for detector, count in sorted(by.items())),
        )  # fmt: skip


def _false(scored: Sequence[Scored]) -> Iterator[str]:
    """Yield the false alarms of nominal hours, and of faulty missions before their onset."""
    yield "| false alarms | hours | " + " | ".join(detectors.DETECTORS) + " | all | per hour |"
    yield "|---|--:|" + "--:|" * (len(detectors.DETECTORS) + 2)
    for name, is_nominal in (("nominal missions", True), ("before the onset", False)):
        of = [one for one in scored if (one.kind == "nominal") == is_nominal]
        hours = sum(_sound_s(one.without) for one in of) / HOUR_S
        counts = [sum(one.false.get(d, 0) for one in of) for d in detectors.DETECTORS]
        total = sum(one.found.alarms or 0 for one in of)
        rate = f"{total / hours:.2g}" if hours else ""
        yield _cells(name, f"{hours:.3g}", *counts, total, rate)


def _sound_s(outcome: Outcome) -> float:
    """Return how long a mission was sound, in seconds."""
    if outcome.kind == "nominal":
        return outcome.seconds
    return min(float(fault.rpartition("@")[2].rstrip("s")) for fault in outcome.faults)


_Share = Callable[[Outcome], bool]
_FIGURES: Sequence[tuple[str, tuple[str, ...], _Share]] = (
    ("one fault, in the first group", (EACH, "single"), lambda o: o.is_right),
    ("one fault, first member", (EACH, "single"), lambda o: o.leads),
    ("two faults, in the first group", ("double",), lambda o: o.is_right),
    ("two faults, first member", ("double",), lambda o: o.leads),
    ("faults of the FMEA without any answer", (EACH, *KNOWN_KINDS), lambda o: not o.stands),
    ("disturbance: no answer", ("drawn",), lambda o: not o.stands),
    ("disturbance: nothing shown at all", ("drawn",), lambda o: not o.shows),
    ("disturbance: said not to be in the FMEA", ("drawn",), lambda o: o.leads),
    ("disturbance: nothing is broken", ("drawn",), lambda o: o.clears),
    ("disturbance: wrong mode", ("drawn",), lambda o: o.is_wrong_mode),
    ("disturbance: wrong mode, above 80 %", ("drawn",), lambda o: o.misleads),
    ("unknown fault: said not to be in the FMEA", ("knobs",), lambda o: o.leads),
    ("unknown fault: wrong mode", ("knobs",), lambda o: o.is_wrong_mode),
)


def _diagnosed(scored: Sequence[Scored]) -> Iterator[str]:
    without, found = [one.without for one in scored], [one.found for one in scored]
    yield "| diagnosis | without | with detectors |"
    yield "|---|--:|--:|"
    for name, kinds, test in _FIGURES:
        if any(outcome.kind in kinds for outcome in without):
            yield _cells(name, _count(without, kinds, test), _count(found, kinds, test))
    yield _cells("diagnoses of a sound robot", *map(_false_diagnoses, (without, found)))
    yield _cells("answer before any fault", *map(_early, (without, found)))


def _count(found: Iterable[Outcome], kinds: Sequence[str], test: _Share) -> str:
    of = [outcome for outcome in found if outcome.kind in kinds]
    return f"{sum(map(test, of))} of {len(of)}"


def _false_diagnoses(found: Iterable[Outcome]) -> str:
    of = [outcome for outcome in found if outcome.kind == "nominal"]
    hours = sum(outcome.seconds for outcome in of) / HOUR_S
    return f"{sum(outcome.diagnoses for outcome in of)} in {hours:.3g} h"


def _early(found: Iterable[Outcome]) -> str:
    of = [outcome for outcome in found if outcome.kind != "nominal"]
    return f"{sum(outcome.early > 0 for outcome in of)} of {len(of)}"


def _kinds(scored: Sequence[Scored]) -> Iterator[str]:
    yield (
        "| disturbance | missions | monitors find | detectors find | only detectors | no answer, "
        "without | with | said not to be in the FMEA, without | with |"
    )
    yield "|---|" + "--:|" * 8
    kinds: dict[str, list[Scored]] = {}
    for one in scored:
        if one.kind == "drawn":
            kinds.setdefault(one.without.faults[0].partition(":")[0], []).append(one)
    for kind, of in sorted(kinds.items()):
        yield _cells(
            kind, len(of), sum(one.shown_s is not None for one in of),
            sum(bool(one.found_s) for one in of),
            sum(bool(one.found_s) and one.shown_s is None for one in of),
            sum(not one.without.stands for one in of), sum(not one.found.stands for one in of),
            sum(one.without.leads for one in of), sum(one.found.leads for one in of),
        )  # fmt: skip


def _faults(scored: Sequence[Scored]) -> Iterator[str]:
    """Yield what happened where monitors, or detectors, or both found nothing."""
    yield "| found by | fault or disturbance |"
    yield "|---|---|"
    for name, shows, detects in (
        ("only detectors", False, True), ("only monitors", True, False), ("neither", False, False),
    ):  # fmt: skip
        of = [
            one.without.faults
            for one in scored
            if one.kind in (EACH, "drawn")
            and (one.shown_s is not None, bool(one.found_s)) == (shows, detects)
        ]
        yield _cells(name, ", ".join(f"`{fault}`" for faults in sorted(of) for fault in faults))


def _cells(*cells: Any) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


# -- the experiment


def kept(path: Path) -> list[Scored]:
    """Read the missions that an earlier run has kept; torn lines are left out."""
    found = kept_lines(path, lambda **values: msgspec.convert(values, Scored))
    return list({(one.kind, one.without.seed): one for one in found}.values())


def main(arguments: Sequence[str] | None = None) -> int:
    """Drive the missions that are not kept, and print or renew the tables."""
    options = _parser().parse_args(arguments)
    try:
        found = kept(options.keep)
        if not options.print:
            detectors.use(options.model)
            found += _run(_jobs(options, found), options.keep)
        text = tables(found, options.state)
        print(text)
        if options.page:
            page = options.page.read_text()
            options.page.write_text(with_figures(page, text, (BEGIN, END)))
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Score detectors, and diagnoses with them.")
    add = parser.add_argument
    add("--model", default="learn", metavar="FILE|learn", help="a model file, or learn one first")
    for kind, count in KINDS.items():
        add(f"--{kind}", type=int, default=count, help=f"missions of this kind ({count})")
    add("--hours", type=float, default=HOURS, help="hours without any fault")
    add("--first-seed", type=int, default=FIRST_SEED)
    add("--keep", type=Path, required=True, metavar="FILE", help="add what each mission gave")
    add("--print", action="store_true", help="drive nothing, print the tables of --keep")
    add("--page", type=Path, metavar="FILE", help="renew the tables there")
    add("--state", default="", help="the state of the code, as 'version 0.9'")
    return parser


def _jobs(options: argparse.Namespace, known: Sequence[Scored]) -> list[Job]:
    """Return the missions that are not kept, mixed so that a part of them is a fair sample."""
    counts = {kind: getattr(options, kind) for kind in KINDS}
    counts["nominal"] = round(options.hours / CHUNK_H)
    done = {(one.kind, one.without.seed) for one in known}
    made = [
        Job(kind, n, options.first_seed) for kind, count in counts.items() for n in range(count)
    ]
    random.Random(0).shuffle(made)
    return [job for job in made if (job.kind, job.seed) not in done]


def _run(jobs: Sequence[Job], keep: Path) -> list[Scored]:
    found = []
    with get_context("spawn").Pool(1, polite) as pool, keep.open("a") as file:
        for one in pool.imap_unordered(score, jobs):
            print(json.dumps(asdict(one)), file=file, flush=True)
            found.append(one)
    return found


if __name__ == "__main__":
    sys.exit(main())
