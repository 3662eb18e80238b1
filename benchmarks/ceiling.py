"""Which misses of a scoring no diagnosis could have avoided, proven by twin missions.

``python -m benchmarks.ceiling OUTCOMES --first-seed 700000 --keep FILE`` reads what
``benchmarks.diagnosis --keep OUTCOMES`` has kept, and goes on with FILE after an interruption. A
twin is the same mission with something else wrong in it. If it gives the same evidence, nothing
that the robot folder configures tells them apart. ``docs/reference/accuracy.md`` says what counts
as the same.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import islice, permutations, product
from multiprocessing import get_context
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.diagnosis.covering.model import Model
from amberbox.diagnosis.covering.observations import Evidence as Counted
from amberbox.diagnosis.diagnose import ObservedSituation, evidence_of_situation
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.symptom_presence import Counts
from amberbox.diagnosis.tracker import FaultTracker
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.record_evaluation import DiagnosedEngine
from amberbox.sim.faults import SimulatedFault, catalogue
from amberbox.sim.robot import START_NS
from benchmarks.accuracy import KNOWN_KINDS, UNKNOWN_KINDS, Outcome, with_figures
from benchmarks.common import kept_lines
from benchmarks.diagnosis import FIRST_SEED, Job, described, kept, mission_of, polite, world
from benchmarks.missions import Batches, Mission, Planted, live, mode_of, seconds_of

TOLERANCE_S = 1.0
"""How far the onset of a symptom may differ of which the FMEA states how soon it shows."""
MAGNITUDES = 3
"""How many magnitudes of a fault's range are tried."""
TWINS = 4
"""How many missions with an answered fault are tried for a miss."""
MARKS = ("<!-- ceiling -->", "<!-- end of ceiling -->")
Verdict: TypeAlias = Literal["shows nothing", "looks like another", "left"]


# -- evidence


class Shown(NamedTuple):
    """What the engine reads of a symptom that counts as present."""

    onset_s: float
    level: int | None
    strength: float

    def __str__(self) -> str:
        size = "" if self.level is None else f", size in level {self.level}"
        return f"present since {self.onset_s:.1f} s{size}"


@dataclass(slots=True)
class Evidence:
    """The evidence that the answer of a mission is a function of.

    ``shown`` are the symptoms that counted as present at any time, as they did last. ``counts`` are
    those that count at the last question to the engine, with state and strength. ``answer`` is the
    first group of what is shown at the end, the leading set of faults first.
    """

    shown: dict[str, Shown] = field(default_factory=dict)
    counts: dict[str, tuple[str, float]] = field(default_factory=dict)
    answer: tuple[str, ...] = ()


Observer: TypeAlias = Callable[[Mission], Iterator[tuple[float, Evidence]]]


class WitnessedTracker(FaultTracker):
    """A tracker that keeps the evidence of all questions that it asks the engine."""

    def __init__(self, knowledge: Knowledge) -> None:
        super().__init__(knowledge)
        self._found = Evidence()

    def evidence(self) -> Evidence:
        """Return the evidence so far, and the answer that is shown now."""
        made = self.current()
        if made is None:
            return replace(self._found, answer=())
        first, *others = made.groups[0].members
        return replace(self._found, answer=(first, *sorted(others)))

    def _situation(self, counting: Mapping[str, Counts]) -> ObservedSituation:
        asked = super()._situation(counting)
        note(self._found, evidence_of_situation(self.knowledge, asked), self.knowledge.model)
        return asked


def observe(mission: Mission) -> Iterator[tuple[float, Evidence]]:
    """Yield until when a mission is known, s, and its evidence so far."""
    at = world()
    tracker = WitnessedTracker(at.knowledge)
    watcher = DiagnosedEngine(Engine(at.plan), tracker)
    watcher.begin(START_NS)
    batches = Batches(at.wanted)
    for until_s, messages in live(mission):
        for batch in batches.of(messages):
            watcher.feed(batch)
        watcher.advance(START_NS + round(until_s * NS))
        yield until_s, tracker.evidence()


def note(found: Evidence, asked: Counted, model: Model) -> None:
    """Add the evidence of a question; symptoms that the model lacks are none."""
    found.counts.clear()
    for name, observation in asked.observations.items():
        if name in model.sign_places:
            found.counts[name] = observation.state, observation.strength
            if observation.state == "present":
                onset_s = seconds_of(asked.onsets_ns.get(name, START_NS))
                found.shown[name] = Shown(onset_s, observation.level, observation.strength)


@dataclass(frozen=True)
class Timing:
    """How far onsets may differ, s: of symptoms that some cause times with ``after_s``, of others.

    Those of others say no more than whether faults began together.
    """

    timed: frozenset[str] = frozenset()
    timed_s: float = TOLERANCE_S
    together_s: float = 10.0

    @classmethod
    def of(cls, knowledge: Knowledge) -> Timing:
        """Return what the engine reads of onsets."""
        model = knowledge.model
        timed = frozenset(model.signs[place].id for place in model.tables.timed)
        return cls(timed, together_s=knowledge.fmea.other.together_s)


def difference(
    one: Evidence, other: Evidence, end_s: float, timing: Timing = Timing()
) -> tuple[float, str] | None:
    """Return the first difference between two missions that end; None if there is none.

    It is when it begins, s, and what it is as text.
    """
    names = sorted({*one.shown, *other.shown})
    found = [each for name in names if (each := _shown_otherwise(name, one, other, timing))]
    if found:
        return min(found)
    for name, _ in sorted(one.counts.items() ^ other.counts.items()):
        here, there = (each.counts.get(name, ("no evidence",))[0] for each in (one, other))
        return end_s, f"{name}: {here} at the end, with the twin {there}"
    if one.answer != other.answer:
        here, there = (" or ".join(each.answer) or "none" for each in (one, other))
        return end_s, f"the same evidence, but the answer is {here}, with the twin {there}"
    return None


def _shown_otherwise(
    name: str, one: Evidence, other: Evidence, timing: Timing
) -> tuple[float, str] | None:
    here, there = one.shown.get(name), other.shown.get(name)
    if here and there and here[1:] == there[1:]:
        within_s = timing.timed_s if name in timing.timed else timing.together_s
        if abs(here.onset_s - there.onset_s) <= within_s:
            return None
    at_s = min(each.onset_s for each in (here, there) if each)
    return at_s, f"{name}: {here or 'not present'}, with the twin {there or 'not present'}"


# -- twins


@dataclass(frozen=True, slots=True)
class Twin:
    """The same mission with something else wrong: ``what``."""

    verdict: Verdict
    what: str
    mission: Mission


def silent_twins(mission: Mission) -> Iterator[Twin]:
    """Yield the mission without what is wrong in it, or without one of two faults."""
    if len(mission.faults) < 2:
        yield Twin("shows nothing", "nothing", replace(mission, faults=(), disturbances=()))
        return
    for n, dropped in enumerate(mission.faults):
        rest = (*mission.faults[:n], *mission.faults[n + 1 :])
        without = replace(mission, faults=rest)
        yield Twin("shows nothing", f"no {dropped.fault.id}", without)


def alike_twins(
    mission: Mission, group: Iterable[Collection[str]], faults: Mapping[str, SimulatedFault]
) -> Iterator[Twin]:
    """Yield missions in which a set of the answered group is what happened.

    ``faults`` are those of the catalogue by their failure mode. A set with a mode that the
    simulator cannot make is left out.
    """
    by_mode = {mode: each for mode, fault in faults.items() for each in mission.faults
               if each.fault == fault}  # fmt: skip
    for answer in group:
        if set(answer) <= set(by_mode) or not set(answer) <= set(faults):
            continue  # a part of what is wrong is a silent twin
        same = tuple(by_mode[mode] for mode in answer if mode in by_mode)
        new = [faults[mode] for mode in answer if mode not in by_mode]
        for planted in _planted(new, _free_onsets(mission, same, len(new))):
            other = replace(mission, faults=(*same, *planted), disturbances=())
            yield Twin("looks like another", ", ".join(described(other)), other)


def _free_onsets(mission: Mission, same: Sequence[Planted], count: int) -> list[float]:
    """Return when something begins that the twin does not have; the last one fills up."""
    onsets = [each.at_s for each in mission.faults if each not in same]
    onsets += [each.at_s for each in mission.disturbances]
    return onsets + [mission.last_onset_s] * (count - len(onsets))


def _planted(
    faults: Sequence[SimulatedFault], onsets: Sequence[float]
) -> Iterator[tuple[Planted, ...]]:
    orders = dict.fromkeys(permutations(onsets, len(faults)))
    for sizes, order in product(product(*map(magnitudes, faults)), orders):
        yield tuple(map(Planted, faults, sizes, order))


def magnitudes(fault: SimulatedFault) -> list[float]:
    """Return some magnitudes of a fault's range, evenly on a scale of factors."""
    low, high = fault.magnitude.low, fault.magnitude.high
    if low == high:
        return [low]
    steps = [n / (MAGNITUDES - 1) for n in range(MAGNITUDES)]
    if low > 0:
        return [low * (high / low) ** step for step in steps]
    return [sign * high**step for step in steps for sign in (1, -1)]


# -- proofs


@dataclass(frozen=True, slots=True)
class Proof:
    """Whether the miss of a mission could have been avoided.

    ``twin`` has the same evidence. If there is none, ``differences`` are, by what was wrong in a
    twin, the first difference to it.
    """

    kind: str
    seed: int
    faults: list[str]
    verdict: Verdict = "left"
    twin: str = ""
    differences: dict[str, str] = field(default_factory=dict)

    @property
    def nearest(self) -> str:
        """Return the twin that is the same for longest, and where it first differs."""
        return next((f"{twin}: {text}" for twin, text in self.differences.items()), "")


def prove(
    outcome: Outcome,
    mission: Mission,
    twins: Iterable[Twin],
    observer: Observer = observe,
    timing: Timing = Timing(),
) -> Proof:
    """Look for a twin with the same evidence as a mission that was missed."""
    mine = [found for _, found in observer(mission)][-1]
    found: list[tuple[float, str, str]] = []
    for twin in twins:
        differs = _differs(mine, twin.mission, observer, timing)
        if differs is None:
            return Proof(outcome.kind, outcome.seed, outcome.faults, twin.verdict, twin.what)
        found.insert(0, (differs[0], twin.what, differs[1]))
    found.sort(key=lambda each: -each[0])
    differences = {what: text for _, what, text in found}
    return Proof(outcome.kind, outcome.seed, outcome.faults, differences=differences)


def _differs(
    mine: Evidence, mission: Mission, observer: Observer, timing: Timing
) -> tuple[float, str] | None:
    """Return the first difference of a twin; it is not simulated on when it shows more."""
    others = Evidence()
    for _, others in observer(mission):
        if others.shown.keys() - mine.shown.keys():
            break
    return difference(mine, others, mission.seconds, timing)


def work(outcome: Outcome, first_seed: int, twins: int) -> Proof:
    """Examine a miss; UsageError if it is of another catalogue or other seeds."""
    mission = mission_of(Job(outcome.kind, outcome.seed - first_seed, first_seed))
    if described(mission) != outcome.faults:
        what = f"{outcome.kind} {outcome.seed} is {', '.join(described(mission))} here"
        raise UsageError(what, "give the --first-seed of the scoring, and its state of the code")
    alike = alike_twins(mission, outcome.group, planted_modes())
    tried = [*silent_twins(mission), *islice(alike, twins)]
    return prove(outcome, mission, tried, timing=Timing.of(world().knowledge))


def planted_modes() -> dict[str, SimulatedFault]:
    """Return the faults of the catalogue by their failure modes."""
    modes = world().knowledge.fmea.modes
    made = {mode_of(fault, modes): fault for fault in catalogue().values()}
    return {mode: fault for mode, fault in made.items() if mode}


def misses(found: Iterable[Outcome], kinds: Collection[str]) -> list[Outcome]:
    """Return the missions whose first member is wrong, those with faults of the FMEA first."""
    missed = [each for each in found if each.kind in kinds and not each.leads]
    order = (*KNOWN_KINDS, *UNKNOWN_KINDS)
    return sorted(missed, key=lambda each: (each.is_right, order.index(each.kind), each.seed))


def kept_proofs(path: Path) -> list[Proof]:
    """Read the proofs that an earlier run has kept; torn lines are left out."""
    return list({(proof.kind, proof.seed): proof for proof in kept_lines(path, Proof)}.values())


# -- figures

NAMES = {
    "single": "one fault",
    "double": "two faults",
    "drawn": "disturbance",
    "knobs": "unknown fault",
}


TARGETS = {("single", "first group"): "95 %", ("single", "first member"): "90 %",
           ("double", "first group"): "80 %"}  # fmt: skip


def ceiling_table(found: Sequence[Outcome], proofs: Sequence[Proof]) -> str:
    """Return targets, what was reached and what can be at most, by kind, as Markdown."""
    lines = [
        "| what | target | reached | at most | misses | it shows nothing | looks like another "
        "| left |",
        f"|---|{'--:|' * 7}",
    ]
    verdicts = {(proof.kind, proof.seed): proof.verdict for proof in proofs}
    for kind, name in NAMES.items():
        of = [each for each in found if each.kind == kind]
        if not any((kind, each.seed) in verdicts for each in of):
            continue
        for place, missed, alike_is_lost in (
            ("first group", [each for each in of if not each.is_right], False),
            ("first member", [each for each in of if not each.leads], True),
        ):
            said = [verdicts.get((kind, each.seed), "left") for each in missed]
            silent, alike = said.count("shows nothing"), said.count("looks like another")
            most = len(of) - silent - alike * alike_is_lost
            cells = (
                TARGETS.get((kind, place), ""), _share(len(of) - len(missed), len(of)),
                _share(most, len(of)), len(missed), silent, alike, len(missed) - silent - alike,
            )  # fmt: skip
            lines.append(f"| {name}, {place} | {' | '.join(map(str, cells))} |")
    missed = misses(found, NAMES)
    count = sum((each.kind, each.seed) in verdicts for each in missed)
    text = f"{count} of {len(missed)} misses were examined; the others count as left."
    return "\n".join(lines) + f"\n\n{text}\n"


def _share(count: int, of: int) -> str:
    return f"{count} of {of}, {100 * count / of:.0f} %"


def case_table(proofs: Iterable[Proof]) -> str:
    """Return each miss with its proof, or the first difference to its nearest twin, as Markdown."""
    lines = ["| kind | seed | what is wrong | verdict | twin, and the first difference to it |"]
    lines.append("|---|--:|---|---|---|")
    for proof in sorted(proofs, key=lambda each: (each.verdict, each.kind, each.seed)):
        faults = ", ".join(f"`{fault}`" for fault in proof.faults)
        text = proof.twin or proof.nearest
        lines.append(f"| {proof.kind} | {proof.seed} | {faults} | {proof.verdict} | {text} |")
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Examine the misses of a scoring, and print what is proven."""
    options = _parser().parse_args(arguments)
    try:
        found = kept(options.outcomes)
        proofs = kept_proofs(options.keep)
        done = {(proof.kind, proof.seed) for proof in proofs}
        wanted = [each for each in misses(found, options.kinds.split(","))
                  if (each.kind, each.seed) not in done]  # fmt: skip
        if not options.print:
            examine = partial(work, first_seed=options.first_seed, twins=options.twins)
            proofs += _run(examine, wanted, options.keep, options.processes)
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    text = f"{ceiling_table(found, proofs)}\n{case_table(proofs)}"
    print(text)
    if options.page:
        page = options.page.read_text()
        options.page.write_text(with_figures(page, f"\n{text}", MARKS))
    return 0


def _run(
    examine: Callable[[Outcome], Proof], wanted: Sequence[Outcome], keep: Path, processes: int
) -> list[Proof]:
    made = []
    with keep.open("a") as file, get_context("spawn").Pool(processes, polite) as pool:
        for proof in pool.imap_unordered(examine, wanted):
            print(json.dumps(asdict(proof)), file=file, flush=True)
            made.append(proof)
    return made


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Prove which misses cannot be avoided.")
    add = parser.add_argument
    add("outcomes", type=Path, help="what benchmarks.diagnosis --keep has kept")
    add("--keep", type=Path, required=True, metavar="FILE", help="add proofs; leave out its own")
    add("--first-seed", type=int, default=FIRST_SEED, help="that of the scoring")
    add("--kinds", default=",".join((*KNOWN_KINDS, *UNKNOWN_KINDS)), help="as single,double")
    add("--twins", type=int, default=TWINS, help="with answered faults, for each miss")
    add("--processes", type=int, default=2)
    add("--print", action="store_true", help="examine nothing, print what --keep has")
    add(
        "--page", type=Path, metavar="FILE", help="renew the ceilings in docs/reference/accuracy.md"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
