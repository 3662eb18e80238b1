"""How often a diagnosis names what is broken, on simulated missions with random faults.

``python -m benchmarks.diagnosis --single 200 --double 100 --unknown 60 --hours 20 --keep FILE``
makes the full experiment; the same command goes on with FILE after an interruption. `make bench`
makes a smaller one. What counts as right is written in ``docs/reference/accuracy.md``.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import json
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli.main import main as amberbox
from amberbox.consult.folder_knowledge import load_knowledge
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.types import Batch, Diagnosis
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.tracker import FaultTracker
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import Finding
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.record_evaluation import DiagnosedEngine
from amberbox.sim.faults import load_faults
from amberbox.sim.random_disturbances import Variable, simulated_variables
from amberbox.sim.robot import START_NS, Message, Robot
from benchmarks import detectors
from benchmarks.accuracy import UNKNOWN_KINDS, Outcome, measured, rows, with_figures
from benchmarks.common import Row, kept_lines
from benchmarks.missions import (
    Batches,
    Mission,
    disturbed,
    draw,
    live,
    mode_of,
    nominal,
    seconds_of,
    with_faults,
)  # fmt: skip

FIRST_SEED = 400_000
"""Seeds from here on; the FMEA was written with lower ones."""
SINGLES, DOUBLES, DRAWN, KNOBS, NOMINAL_H = 24, 12, 10, 10, 0.5
"""What `make bench` runs."""
SURVEY_SEED, SURVEY_S = 300_000, 60.0
"""The drive that tells which values variables have, for the amounts of drawn disturbances."""
UNKNOWN_FAULTS = Path(__file__).with_name("unknown_faults.yaml")
CHUNK_H = 0.25
SHOWN = 4


# -- one mission


@dataclass(frozen=True)
class World:
    """The robot folder that is watched: made once in each process."""

    plan: MonitoringPlan
    knowledge: Knowledge
    wanted: dict[str, set[str]]


def world() -> World:
    """Return the robot folder of this experiment."""
    return world_with(detectors.model_path())


@functools.cache
def world_with(model: Path | None) -> World:
    """Make a robot folder, which names a model of detectors or none, and read it."""
    with tempfile.TemporaryDirectory() as place:
        path = robot_folder(Path(place) / "robot")
        if model is not None:
            with (path / "robot.yaml").open("a") as file:
                file.write(f"detection: {{model: {json.dumps(str(model.resolve()))}}}\n")
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


def robot_folder(path: Path) -> Path:
    """Make the folder of a simulated robot."""
    with contextlib.redirect_stdout(io.StringIO()):
        amberbox(["new", str(path), "--from", "sim"])
    return path


class Watching:
    """The watcher of a robot folder on one mission."""

    def __init__(self, at: World) -> None:
        self._engine = DiagnosedEngine(Engine(at.plan), FaultTracker(at.knowledge))
        self._engine.begin(START_NS)
        self._batches = Batches(at.wanted)

    def take(
        self, messages: Sequence[Message], until_ns: int, told: Iterable[Batch] = ()
    ) -> Iterator[Finding]:
        """Take messages and what detectors told up to a time; yield what is found."""
        for batch in (*self._batches.of(messages), *told):
            self._engine.feed(batch)
        yield from self._engine.advance(until_ns)


def findings(mission: Mission, *following: detectors.Following) -> Iterator[Finding]:
    """Yield what the watcher of a robot finds in a mission, told by the detectors that follow."""
    watching = Watching(world())
    for until_s, messages in live(mission):
        until_ns = START_NS + round(until_s * NS)
        told = [batch for one in following for batch in one.take(messages, until_ns)]
        yield from watching.take(messages, until_ns, told)


def diagnoses(mission: Mission, *following: detectors.Following) -> Iterator[Diagnosis]:
    """Yield the revisions of all diagnoses of a mission."""
    return (found for found in findings(mission, *following) if isinstance(found, Diagnosis))


def judge(kind: str, mission: Mission, truth: Sequence[str]) -> Outcome:
    """Diagnose a mission and compare the answer with what is true."""
    start_s = time.process_time()
    following = detectors.follow()
    made = list(diagnoses(mission, *following))
    found = replace(outcome_of(kind, mission, truth, made), cpu_s=time.process_time() - start_s)
    return with_alarms(found, mission, *following)


def with_alarms(found: Outcome, mission: Mission, *following: detectors.Following) -> Outcome:
    """Return an outcome with the alarms of the detectors that have followed the mission."""
    for one in following:
        alarmed, alarms = one.found_by(mission.onset_s), one.false_alarms(mission.onset_s)
        found = replace(found, alarmed=alarmed, alarms=alarms)
    return found


def outcome_of(
    kind: str, mission: Mission, truth: Sequence[str], made: Sequence[Diagnosis]
) -> Outcome:
    """Compare the revisions of all diagnoses of a mission with what is true."""
    found = Outcome(
        kind,
        mission.seed,
        described(mission),
        sorted(truth),
        mission.scenario,
        mission.seconds,
        misled=0.0,
        early=sum(seconds_of(each.at_ns) < mission.onset_s for each in made if is_answer(each)),
        diagnoses=len({each.id for each in made}),
    )
    late = [each for each in made if seconds_of(each.at_ns) >= mission.onset_s]
    answers = [each for each in late if is_answer(each)]
    if not answers:
        return found
    standing = {each.id: each for each in made}  # the last revision of each
    last = standing[answers[-1].id]
    stands = is_answer(last)
    groups = [
        (seconds_of(each.at_ns) - mission.last_onset_s, first_group(each)) for each in answers
    ]
    wrong = [
        each.hypotheses[0].probability
        for each, (at_s, group) in zip(answers, groups, strict=True)
        if at_s >= 0 and group[0] and group[0] != found.truth
    ]
    return replace(
        found,
        group=first_group(last) if stands else [],
        probability=last.hypotheses[0].probability if stands else 0.0,
        ended_group=[] if stands else groups[-1][1],
        symptom_s=groups[0][0],
        named_s=next((at_s for at_s, group in groups if found.truth in group), None),
        led_s=next((at_s for at_s, group in groups if found.truth == group[0]), None),
        misled=max(wrong, default=0.0),
    )


def described(mission: Mission) -> list[str]:
    """Return what is wrong in a mission, as the simulator's command line writes it."""
    faults = [f"{p.fault.id}={p.magnitude:.3g}@{p.at_s:.1f}s" for p in mission.faults]
    return faults + [str(each) for each in mission.disturbances]


def is_answer(diagnosis: Diagnosis) -> bool:
    """Tell whether a revision is an answer that stands, as long as no later one follows."""
    return diagnosis.state == "open" and bool(diagnosis.hypotheses)


def first_group(diagnosis: Diagnosis) -> list[list[str]]:
    """Return the sets of faults of the leading ambiguity group, without what followed from them."""
    faults = {each.id: sorted(each.faults - each.follows) for each in diagnosis.hypotheses}
    return [faults[name] for name in diagnosis.groups[0].members]


# -- all missions


@dataclass(frozen=True, slots=True)
class Job:
    """A mission to be judged: ``number`` of its ``kind``, on the seeds from ``first_seed`` on."""

    kind: str
    number: int
    first_seed: int = FIRST_SEED

    @property
    def seed(self) -> int:
        """Return the seed of the mission."""
        return self.first_seed + self.number


def work(job: Job) -> Outcome:
    """Make and judge a mission."""
    mission = mission_of(job)
    return judge(job.kind, mission, truth_of(job.kind, mission))


def truth_of(kind: str, mission: Mission) -> list[str]:
    """Return the failure modes that are there in a mission."""
    if kind in UNKNOWN_KINDS:
        return [UNKNOWN]
    modes = world().knowledge.fmea.modes
    return [mode_of(planted.fault, modes) for planted in mission.faults]


def mission_of(job: Job) -> Mission:
    """Draw the mission of a job."""
    if job.kind == "nominal":
        return nominal(job.seed, CHUNK_H * 3600.0)
    if job.kind == "drawn":
        return disturbed(job.seed, variables())
    if job.kind == "knobs":
        faults = list(load_faults(UNKNOWN_FAULTS).values())
        chance = random.Random(f"unknown {job.number}")
        return with_faults(job.seed, [faults[job.number % len(faults)]], chance)
    return draw(job.seed, 1 if job.kind == "single" else 2)


def revisions(job: Job) -> Iterator[str]:
    """Yield the revisions of a mission as text: what was present, and what was said."""
    mission = mission_of(job)
    yield ", ".join(described(mission)) or "nothing is wrong"
    for each in diagnoses(mission, *detectors.follow()):
        since_s = seconds_of(each.at_ns) - min(mission.last_onset_s, mission.seconds)
        yield f"{since_s:+.1f} s  {each.id} {each.state}: {', '.join(each.symptoms)}"
        for hypothesis in each.hypotheses[:SHOWN]:
            faults = ", ".join(sorted(hypothesis.faults)) or "nothing"
            yield f"    {100 * hypothesis.probability:5.1f} %  {faults}"


@functools.cache
def surveyed() -> list[Variable]:
    """Return all variables of the robot, with the values that they have on a drive."""
    return simulated_variables(Robot(SURVEY_SEED).step_until(SURVEY_S))


@functools.cache
def variables() -> list[Variable]:
    """Return the variables that monitors and symptoms of the robot folder read."""
    wanted = world().wanted
    return [
        each
        for each in surveyed()
        if each.path.replace(".", "_") in wanted.get(f"sim_{each.item}", ())
    ]


def jobs(counts: Mapping[str, int], first_seed: int = FIRST_SEED) -> list[Job]:
    """List the missions of an experiment, mixed so that a part of them is a fair sample."""
    made = [Job(kind, n, first_seed) for kind, count in counts.items() for n in range(count)]
    random.Random(0).shuffle(made)
    return made


def run(
    wanted: Sequence[Job], tell: Callable[[Outcome], None] = lambda _: None, processes: int = 0
) -> list[Outcome]:
    """Judge missions in so many processes, politely; 0 is two, or one on a single core."""
    found = []
    processes = processes or min(2, os.cpu_count() or 1)
    with get_context("spawn").Pool(processes, polite) as pool:
        for outcome in pool.imap_unordered(work, wanted):
            tell(outcome)
            found.append(outcome)
    return sorted(found, key=lambda each: (each.kind, each.seed))


def polite() -> None:
    """Give way to everything else on the machine."""
    os.nice(10)


# -- the experiment


def measure() -> list[Row]:
    """Run the small experiment."""
    return rows(run(jobs(counts_of(SINGLES, DOUBLES, DRAWN, KNOBS, NOMINAL_H))))


def counts_of(single: int, double: int, drawn: int, knobs: int, hours: float) -> dict[str, int]:
    """Return how many missions of each kind an experiment has."""
    chunks = round(hours / CHUNK_H)
    return {"single": single, "double": double, "drawn": drawn, "knobs": knobs, "nominal": chunks}


def kept(path: Path) -> list[Outcome]:
    """Read the outcomes that an earlier run has kept; torn lines are left out."""
    return list({(one.kind, one.seed): one for one in kept_lines(path, Outcome)}.values())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run an experiment of a given size and print its figures."""
    options = _parser().parse_args(arguments)
    detectors.use(options.model)
    if options.show:
        print(*revisions(replace(options.show, first_seed=options.first_seed)), sep="\n")
        return 0
    doubles = options.missions // 3
    double = doubles if options.double is None else options.double
    single = options.missions - doubles if options.single is None else options.single
    counts = counts_of(single, double, options.unknown, options.knobs, options.hours)
    try:
        before = kept(options.keep) if options.keep else []
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    done = {(outcome.kind, outcome.seed) for outcome in before}
    wanted = [job for job in jobs(counts, options.first_seed) if (job.kind, job.seed) not in done]
    found = before + ([] if options.print else _run(wanted, options.keep, options.processes))
    _print(rows(found))
    if options.page:
        path = options.page
        path.write_text(with_figures(path.read_text(), measured(found, options.state)))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Measure how often diagnoses are right.")
    add = parser.add_argument
    add("--single", type=int, help="missions with one fault")
    add("--double", type=int, help="missions with two faults")
    add("--missions", type=int, default=SINGLES + DOUBLES, help="both, two thirds with one fault")
    add("--unknown", type=int, default=DRAWN, help="missions with a drawn disturbance")
    add("--knobs", type=int, default=KNOBS, help="missions with a fault of unknown_faults.yaml")
    add("--hours", type=float, default=NOMINAL_H, help="hours without any fault")
    add("--first-seed", type=int, default=FIRST_SEED)
    add("--processes", type=int, default=0, help="so many at once; 0: two")
    add("--keep", type=Path, metavar="FILE", help="add what each mission gave; leave out its own")
    add("--print", action="store_true", help="run nothing, print the figures of --keep")
    add(
        "--show",
        type=_job,
        metavar="KIND:NUMBER",
        help="print the revisions of one mission, as drawn:7",
    )
    add("--model", metavar="FILE|learn", help="with detectors: a model file, or learn one first")
    add("--page", type=Path, metavar="FILE", help="renew the figures of docs/reference/accuracy.md")
    add("--state", default="", help="with --page: the state of the code, as 'version 0.9'")
    return parser


def _job(text: str) -> Job:
    kind, _, number = text.partition(":")
    if kind not in counts_of(0, 0, 0, 0, 0.0) or not number.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is no mission; one is drawn:7")
    return Job(kind, int(number))


def _run(wanted: Sequence[Job], keep: Path | None, processes: int) -> list[Outcome]:
    if keep is None:
        return run(wanted, processes=processes)
    is_torn = keep.exists() and not keep.read_bytes().endswith(b"\n") and keep.stat().st_size > 0
    with keep.open("a") as file:
        if is_torn:
            print(file=file)

        def tell(outcome: Outcome) -> None:
            print(json.dumps(asdict(outcome)), file=file, flush=True)

        return run(wanted, tell, processes)


def _print(made: Iterable[Row]) -> None:
    for row in made:
        print(f"{row.name:36} {row.value:8.3g} {row.unit:5} {row.note}")


if __name__ == "__main__":
    sys.exit(main())
