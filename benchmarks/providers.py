"""What each kind of model adds to the FMEA: the same missions, diagnosed with and without it.

``python -m benchmarks.providers --keep FILE --page docs/reference/accuracy.md --state STATE``
drives each mission once. The monitors see it once, and one tracker for each choice of evidence gets
what they found. Rules are asked in none, as in ``benchmarks.diagnosis``.
"""

from __future__ import annotations

import argparse
import functools
import json
import random
import shutil
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from amberbox.consult.context import RobotWindow
from amberbox.core.clock import NS
from amberbox.core.contracts import EvidenceNeeds, Span
from amberbox.core.equations.model_file import load_model
from amberbox.core.errors import UsageError
from amberbox.core.expression import Expression
from amberbox.core.types import Batch, Diagnosis, Status, Symptom
from amberbox.diagnosis.consistency.components import load_components
from amberbox.diagnosis.consistency.online import mapped
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.models import ModelKind, models_of
from amberbox.diagnosis.tracker import FaultTracker
from amberbox.monitoring.engine import Engine
from amberbox.sim.faults import catalogue
from amberbox.sim.robot import START_NS
from benchmarks.accuracy import Outcome, with_figures
from benchmarks.common import kept_lines
from benchmarks.diagnosis import (
    Job,
    counts_of,
    jobs,
    mission_of,
    outcome_of,
    polite,
    robot_folder,
    surveyed,
    truth_of,
    world,
)
from benchmarks.missions import Batches, Mission, disturbed, live, mode_of, with_faults

FIRST_SEED = 990_000
SINGLES, DOUBLES, CHAINED, DRAWN, KNOBS, READ, NOMINAL_H = 30, 30, 20, 30, 10, 24, 0.5
READ_BY: tuple[ModelKind, ...] = ("equations", "components")
"""Kinds of models; a mission of that kind has a disturbance of a variable that they read."""
CHOICES: Mapping[str, frozenset[str]] = {
    "FMEA alone": frozenset(),
    "with residuals": frozenset({"equations"}),
    "with consistency": frozenset({"components"}),
    "with both": frozenset({"equations", "components"}),
}
"""By name: kinds of models whose evidence counts."""
MARKS = "<!-- providers -->", "<!-- end of providers -->"
READ_MARKS = "<!-- read by models -->", "<!-- end of read by models -->"
_KEPT = 2  # batches of an item: of 30 s each, and no model looks further back


@dataclass
class RecentPast:
    """The last rows of a robot, as providers of evidence read its record."""

    end_ns: int = START_NS
    watched: tuple[Span, ...] = ()
    _batches: dict[str, list[Batch]] = field(default_factory=dict)

    @property
    def recorded(self) -> tuple[Span, ...]:
        """Return the run of the recorder."""
        return (self.span,)

    @property
    def span(self) -> Span:
        """Return since when the robot runs, and until when it is known."""
        return START_NS, self.end_ns

    def feed(self, batch: Batch) -> None:
        """Take rows of an item."""
        known = self._batches.setdefault(batch.item, [])
        known.append(batch)
        del known[:-_KEPT]

    def rows(self, topic: str, names: Sequence[str], span: Span) -> Iterable[Mapping[str, Any]]:
        """Yield the rows of an item in a span."""
        for batch in self._batches.get(topic, ()):
            first, end = batch.log_time_ns.searchsorted(span, "left").tolist()
            numbers: list[Any] = [np.ma.asarray(batch.columns[name]) for name in names]
            columns = [column[first:end].tolist() for column in numbers]
            for received, *values in zip(
                batch.log_time_ns[first:end].tolist(), *columns, strict=True
            ):
                yield {"received": received, **dict(zip(names, values, strict=True))}


@dataclass(frozen=True)
class PastWindow(RobotWindow):
    """A robot at an instant, with a record that is in memory."""

    recent: RecentPast | None = None

    def past(self, needs: EvidenceNeeds) -> Any:
        """Return the record."""
        return self.recent


@dataclass
class Choice:
    """A tracker that gets the evidence of some models only, what it has found, and its time."""

    tracker: FaultTracker
    without: frozenset[tuple[str, str]]
    """Component and mode of the monitors that it does not hear."""
    made: list[Diagnosis] = field(default_factory=list)
    cpu_s: float = 0.0

    def advance(self, batches: Sequence[Batch], found: Sequence[object], until_ns: int) -> None:
        """Take rows and findings up to an instant."""
        begun_s = time.process_time()
        for batch in batches:
            self.tracker.feed(batch)
        heard = [one for one in found if _source(one) not in self.without]
        made = self.tracker.advance(heard, until_ns)
        self.made += [one for one in made if isinstance(one, Diagnosis)]
        self.cpu_s += time.process_time() - begun_s


def _source(found: object) -> tuple[str, str]:
    if isinstance(found, Status):
        return found.component, found.mode
    component, mode, *_ = (*found.id.split("/"), "") if isinstance(found, Symptom) else ("", "")
    return component, mode


@functools.cache
def folders() -> Mapping[str, Path]:
    """Return by choice a folder with its models and nothing else."""
    place = Path(_kept_place().name)
    robot = robot_folder(place / "robot")
    made = {}
    for name, kinds in CHOICES.items():
        made[name] = place / name
        (made[name] / "models").mkdir(parents=True)
        for kind, models in models_of(robot).items():
            for path in models.values() if kind in kinds else ():
                shutil.copy(path, made[name] / "models")
    return made


@functools.cache
def _kept_place() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory()


@functools.cache
def columns() -> Mapping[str, set[str]]:
    """Return the columns of each item that monitors, symptoms or models read."""
    found = {item: {*names} for item, names in world().wanted.items()}
    for item, names in read_by("components").items():
        found.setdefault(item, set()).update(names)
    return found


@functools.cache
def read_by(kind: ModelKind) -> Mapping[str, set[str]]:
    """Return the columns of each item that models of a kind read."""
    found: dict[str, set[str]] = {}
    for path in models_of(folders()["with both"])[kind].values():
        for value in _values_of(kind, path):
            for address in value.addresses():
                item, _, variable = address.partition(".")
                found.setdefault(item, set()).add(variable)
    return found


def _values_of(kind: ModelKind, path: Path) -> Iterator[Expression]:
    if kind == "equations":
        yield from load_model(path).recorded.values()
    else:
        yield from (binding.value for binding in load_components(path).observe.values())


def residual_monitors() -> frozenset[tuple[str, str]]:
    """Return component and mode of the monitors that compute residuals of a model."""
    return frozenset(
        (component.id, mode.id)
        for component, mode in world().plan.modes()
        if mode.module is not None and mode.module.__name__.rpartition(".")[2] == "residual"
    )


def choices_of(past: RecentPast) -> dict[str, Choice]:
    """Make the trackers of a mission, by choice."""
    made = {}
    for name, kinds in CHOICES.items():
        window = functools.partial(PastWindow, folder=folders()[name], recent=past)
        without = frozenset() if "equations" in kinds else residual_monitors()
        made[name] = Choice(FaultTracker(world().knowledge, window if kinds else None), without)
        made[name].tracker.begin(START_NS)
    return made


def diagnosed(mission: Mission) -> dict[str, Choice]:
    """Drive a mission once, and diagnose it with each choice."""
    engine, past = Engine(world().plan), RecentPast()
    engine.begin(START_NS)
    choices = choices_of(past)
    batches = Batches(columns())
    for until_s, messages in live(mission):
        until_ns = START_NS + round(until_s * NS)
        taken = list(batches.of(messages))
        for batch in taken:
            engine.feed(batch)
            past.feed(batch)
        past.end_ns = until_ns + 1
        found = engine.advance(until_ns)
        for choice in choices.values():
            choice.advance(taken, found, until_ns)
    return choices


def chained(seed: int) -> Mission:
    """Draw a mission with two faults of components that the models of components describe."""
    chance = random.Random(f"chained {seed}")
    modes = world().knowledge.fmea.modes
    known = _described()
    faults = [one for one in catalogue().values() if mode_of(one, modes) in known]
    return with_faults(seed, chance.sample(faults, 2), chance)


def _described() -> frozenset[str]:
    """Return the failure modes that faults of the models of components stand for."""
    modes = [*world().knowledge.fmea.modes]
    models = models_of(folders()["with both"])["components"].values()
    loaded = [load_components(path) for path in models]
    return frozenset[str]().union(*(mapped(model, model.faults, modes)[0] for model in loaded))


def read(kind: ModelKind, seed: int) -> Mission:
    """Draw a mission with a disturbance of what models of a kind read: evenly over the items."""
    columns_read = read_by(kind)
    item = random.Random(f"{kind} {seed}").choice(sorted(columns_read))
    variables = [
        each
        for each in surveyed()
        if f"sim_{each.item}" == item and each.path.replace(".", "_") in columns_read[item]
    ]
    apart = 100_000 * READ_BY.index(kind)  # not the same kind, amount and time twice
    return replace(disturbed(seed + apart, variables), seed=seed)


def work(job: Job) -> list[Outcome]:
    """Make and judge a mission with each choice."""
    kind = next((each for each in READ_BY if each == job.kind), None)
    if kind is not None:
        mission, truth = read(kind, job.seed), [UNKNOWN]
    else:
        mission = chained(job.seed) if job.kind == "chained" else mission_of(job)
        truth = truth_of(job.kind, mission)
    return [
        replace(
            outcome_of(job.kind, mission, truth, choice.made), cpu_s=choice.cpu_s, evidence=name
        )
        for name, choice in diagnosed(mission).items()
    ]


def table(found: Sequence[Outcome], state: str, cells: Cells) -> str:
    """Return the figures by choice of evidence, as Markdown."""
    seeds = [outcome.seed for outcome in found] or [0]
    of = {name: [one for one in found if one.evidence == name] for name in CHOICES}
    counts = Counter(outcome.kind for outcome in of["FMEA alone"])
    lines = [
        f"State of the code: {state or 'not named'}. Seeds {min(seeds)} to {max(seeds)}: "
        f"{', '.join(f'{count} {kind}' for kind, count in sorted(counts.items()))}.",
        "",
        f"| what | {' | '.join(CHOICES)} |",
        f"|---|{'---|' * len(CHOICES)}",
    ]
    for what, cell in cells.items():
        lines.append(f"| {what} | {' | '.join(cell(of[name]) for name in CHOICES)} |")
    return "\n".join(lines) + "\n"


def _kind(found: Sequence[Outcome], *kinds: str) -> list[Outcome]:
    return [outcome for outcome in found if outcome.kind in kinds]


def _share(found: Sequence[bool]) -> str:
    return f"{sum(found)} of {len(found)}"


def _named_s(found: Sequence[Outcome]) -> str:
    shown = [o for o in found if o.shows]
    times_s = [float("inf") if o.named_s is None else max(0.0, o.named_s) for o in shown]
    return f"{statistics.median(times_s):.2f} s" if times_s else "-"


def _false(found: Sequence[Outcome]) -> str:
    hours = sum(outcome.seconds for outcome in found) / 3600.0
    count = sum(outcome.diagnoses for outcome in found)
    return f"{count} in {hours:g} h"


def _cpu(found: Sequence[Outcome]) -> str:
    seconds = sum(outcome.seconds for outcome in found)
    return f"{100.0 * sum(o.cpu_s for o in found) / max(seconds, 1e-9):.2f} %"


Cells = Mapping[str, Callable[[Sequence[Outcome]], str]]
_OF_ALL: Cells = {
    "diagnoses of a sound robot": lambda o: _false(_kind(o, "nominal")),
    "answer before any fault": lambda o: _share([x.early > 0 for x in o if x.kind != "nominal"]),
    "processor for the tracker, of a core": _cpu,
}
_OF_FAULTS: Cells = {
    "one fault, in the first group": lambda o: _share([x.is_right for x in _kind(o, "single")]),
    "one fault, first member": lambda o: _share([x.leads for x in _kind(o, "single")]),
    "two faults, in the first group": lambda o: _share([x.is_right for x in _kind(o, "double")]),
    "two faults of `chain.yaml`, in the first group": lambda o: _share(
        [x.is_right for x in _kind(o, "chained")]
    ),
    "disturbance: said so, of those with an answer": lambda o: _share(
        [x.leads for x in _kind(o, "drawn") if x.stands]
    ),
    "fault of `unknown_faults.yaml`: said so, of those with an answer": lambda o: _share(
        [x.leads for x in _kind(o, "knobs") if x.stands]
    ),
    "both: wrong mode, above 80 %": lambda o: _share(
        [x.misleads for x in _kind(o, "drawn", "knobs")]
    ),
    "one fault named, from its onset (median)": lambda o: _named_s(_kind(o, "single")),
    "two faults named, from the onset of the second (median)": lambda o: _named_s(
        _kind(o, "double")
    ),
    **_OF_ALL,
}


def _of_read(kind: str, name: str) -> Cells:
    return {
        f"{name}: answered at any time": lambda o: _share([x.shows for x in _kind(o, kind)]),
        f"{name}: answered, and it stands": lambda o: _share([x.stands for x in _kind(o, kind)]),
        f"{name}: said not to be in the FMEA": lambda o: _share([x.leads for x in _kind(o, kind)]),
        f"{name}: wrong mode, above 80 %": lambda o: _share([x.misleads for x in _kind(o, kind)]),
    }


_OF_READ: Cells = {
    **_of_read("equations", "read by `base.yaml`"),
    **_of_read("components", "read by `chain.yaml`"),
    **_OF_ALL,
}


def tables(found: Sequence[Outcome], state: str) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield the tables of the missions that were driven, with the marks of their places."""
    read = [outcome for outcome in found if outcome.kind in READ_BY]
    others = [outcome for outcome in found if outcome.kind not in (*READ_BY, "nominal")]
    nominal = [outcome for outcome in found if outcome.kind == "nominal"]
    if others:
        yield table([*others, *nominal], state, _OF_FAULTS), MARKS
    if read:
        yield table([*read, *nominal], state, _OF_READ), READ_MARKS


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the missions that are not kept yet, print the table and renew the page."""
    options = _parser().parse_args(arguments)
    counts = counts_of(
        options.single, options.double, options.unknown, options.knobs, options.hours
    )
    counts |= {"chained": options.chained} | dict.fromkeys(READ_BY, options.read)
    try:
        found = list(kept_lines(options.keep, Outcome)) if options.keep else []
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    done = {(outcome.kind, outcome.seed) for outcome in found}
    wanted = [job for job in jobs(counts, options.first_seed) if (job.kind, job.seed) not in done]
    found += [] if options.print else _run(wanted, options.keep, options.processes)
    for figures, marks in tables(found, options.state):
        print(figures)
        if options.page:
            options.page.write_text(with_figures(options.page.read_text(), figures, marks))
    return 0


def _run(wanted: Sequence[Job], keep: Path | None, processes: int) -> list[Outcome]:
    found: list[Outcome] = []
    with get_context("spawn").Pool(processes, polite) as pool:
        for outcomes in pool.imap_unordered(work, wanted):
            found += outcomes
            if keep is not None:
                with keep.open("a") as file:
                    file.writelines(f"{json.dumps(asdict(outcome))}\n" for outcome in outcomes)
    return found


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Measure what models add to the FMEA.")
    add = parser.add_argument
    add("--single", type=int, default=SINGLES, help="missions with one fault")
    add("--double", type=int, default=DOUBLES, help="missions with two faults")
    add("--chained", type=int, default=CHAINED, help="missions with two faults of chain.yaml")
    add("--unknown", type=int, default=DRAWN, help="missions with a drawn disturbance")
    add("--knobs", type=int, default=KNOBS, help="missions with a fault of unknown_faults.yaml")
    add("--read", type=int, default=READ, help="disturbances of what each kind of models reads")
    add("--hours", type=float, default=NOMINAL_H, help="hours without any fault")
    add("--first-seed", type=int, default=FIRST_SEED)
    add("--processes", type=int, default=1, help="so many at once")
    add("--keep", type=Path, metavar="FILE", help="add what each mission gave; leave out its own")
    add("--print", action="store_true", help="run nothing, print the table of --keep")
    add("--page", type=Path, metavar="FILE", help="renew the tables of docs/reference/accuracy.md")
    add("--state", default="", help="with --page: the state of the code, as 'version 0.9'")
    return parser


if __name__ == "__main__":
    sys.exit(main())
