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
from amberbox.core.types import Symptom
from amberbox.diagnosis.knowledge import Knowledge
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
"""Changes of a symptom that are no further apart than this count as simultaneous."""
MAGNITUDES = 3
"""How many magnitudes of a fault's range are tried."""
TWINS = 4
"""How many missions with an answered fault are tried for a miss."""
MARKS = ("<!-- ceiling -->", "<!-- end of ceiling -->")
Verdict: TypeAlias = Literal["shows nothing", "looks like another", "left"]


# -- evidence


class Change(NamedTuple):
    """A change of a symptom: when it was known, and all that a diagnosis can use of it."""

    at_s: float
    onset_s: float | None
    state: str
    level: int | None
    strength: float
    blocked_by: tuple[str, ...]

    def is_like(self, other: Change) -> bool:
        """Tell whether nothing but up to ``TOLERANCE_S`` of time distinguishes two changes."""
        return (
            self[2:] == other[2:]
            and abs(self.at_s - other.at_s) <= TOLERANCE_S
            and (self.onset_s is None) == (other.onset_s is None)
            and abs((self.onset_s or 0.0) - (other.onset_s or 0.0)) <= TOLERANCE_S
        )

    def __str__(self) -> str:
        size = "" if self.level is None else f", size in level {self.level}"
        blocked = f", blocked by {' and '.join(self.blocked_by)}" if self.blocked_by else ""
        return f"{self.state} at {self.at_s:.1f} s{size}{blocked}"


Evidence: TypeAlias = dict[str, list[Change]]
Observer: TypeAlias = Callable[[Mission], Iterator[tuple[float, Evidence]]]


def observe(mission: Mission) -> Iterator[tuple[float, Evidence]]:
    """Yield until when the symptoms of a mission are known, s, and their changes so far."""
    at = world()
    watcher = DiagnosedEngine(Engine(at.plan), FaultTracker(at.knowledge))
    watcher.begin(START_NS)
    batches = Batches(at.wanted)
    found: Evidence = {}
    for until_s, messages in live(mission):
        for batch in batches.of(messages):
            watcher.feed(batch)
        for each in watcher.advance(START_NS + round(until_s * NS)):
            if isinstance(each, Symptom):
                note(found, each, at.knowledge)
        yield until_s, found


def note(found: Evidence, symptom: Symptom, knowledge: Knowledge) -> None:
    """Add what a symptom says, if it is news."""
    known_ns = symptom.confirmed_ns or symptom.onset_ns
    assert known_ns is not None, "the engine states when it knew"
    onset_s = None if symptom.onset_ns is None else seconds_of(symptom.onset_ns)
    change = Change(
        seconds_of(known_ns),
        onset_s,
        symptom.state,
        knowledge.level(symptom) if symptom.state == "present" else None,
        symptom.strength,
        tuple(sorted(symptom.blocked_by)),
    )
    changes = found.setdefault(symptom.id, [])
    if not changes or changes[-1][1:] != change[1:]:
        changes.append(change)


def difference(one: Evidence, other: Evidence, until_s: float) -> tuple[float, str] | None:
    """Return the first difference between two missions, known until so many seconds; None if none.

    It is when it begins, s, and what it is as text.
    """
    found = (_first_of(name, one, other, until_s) for name in sorted({*one, *other}))
    return min((each for each in found if each is not None), default=None)


def _first_of(
    name: str, one: Evidence, other: Evidence, until_s: float
) -> tuple[float, str] | None:
    mine, others = one.get(name, []), other.get(name, [])
    for n in range(max(len(mine), len(others))):
        here = mine[n] if n < len(mine) else None
        there = others[n] if n < len(others) else None
        if here and there and here.is_like(there):
            continue
        at_s = min(each.at_s for each in (here, there) if each)
        # What the other mission has may still come, until the tolerance is over.
        if at_s > until_s - TOLERANCE_S and not (here and there):
            return None
        return at_s, f"{name}: {here or 'no change'}, with the twin {there or 'no change'}"
    return None


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
    outcome: Outcome, mission: Mission, twins: Iterable[Twin], observer: Observer = observe
) -> Proof:
    """Look for a twin with the same evidence as a mission that was missed."""
    mine = [found for _, found in observer(mission)][-1]
    found: list[tuple[float, str, str]] = []
    for twin in twins:
        differs = _differs(mine, twin.mission, observer)
        if differs is None:
            return Proof(outcome.kind, outcome.seed, outcome.faults, twin.verdict, twin.what)
        found.insert(0, (differs[0], twin.what, differs[1]))
    found.sort(key=lambda each: -each[0])
    differences = {what: text for _, what, text in found}
    return Proof(outcome.kind, outcome.seed, outcome.faults, differences=differences)


def _differs(mine: Evidence, mission: Mission, observer: Observer) -> tuple[float, str] | None:
    """Return the first difference of a twin; it is not simulated for longer than needed."""
    others: Evidence = {}
    for until_s, others in observer(mission):
        differs = difference(mine, others, until_s)
        if differs is not None:
            return differs
    # At the end, what has not come will not come.
    return difference(mine, others, mission.seconds + TOLERANCE_S)


def work(outcome: Outcome, first_seed: int, twins: int) -> Proof:
    """Examine a miss; UsageError if it is of another catalogue or other seeds."""
    mission = mission_of(Job(outcome.kind, outcome.seed - first_seed, first_seed))
    if described(mission) != outcome.faults:
        what = f"{outcome.kind} {outcome.seed} is {', '.join(described(mission))} here"
        raise UsageError(what, "give the --first-seed of the scoring, and its state of the code")
    alike = alike_twins(mission, outcome.group, planted_modes())
    return prove(outcome, mission, [*silent_twins(mission), *islice(alike, twins)])


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


def ceiling_table(found: Sequence[Outcome], proofs: Sequence[Proof]) -> str:
    """Return misses, reasons and ceilings by kind, as Markdown."""
    names = (
        "misses of the first group", "it shows nothing", "looks like another", "left",
        "first group, at most", "misses of the first member", "it shows nothing",
        "looks like another", "left", "first member, at most",
    )  # fmt: skip
    lines = [f"| kind | {' | '.join(names)} |", f"|---|{'--:|' * len(names)}"]
    verdicts = {(proof.kind, proof.seed): proof.verdict for proof in proofs}
    for kind, name in NAMES.items():
        of = [each for each in found if each.kind == kind]
        if not any((kind, each.seed) in verdicts for each in of):
            continue
        cells: list[str] = []
        for missed, alike_is_lost in (
            ([each for each in of if not each.is_right], False),
            ([each for each in of if not each.leads], True),
        ):
            said = [verdicts.get((kind, each.seed), "left") for each in missed]
            silent, alike = said.count("shows nothing"), said.count("looks like another")
            lost = silent + alike * alike_is_lost
            cells += map(str, (len(missed), silent, alike, len(missed) - silent - alike))
            cells.append(f"{len(of) - lost} of {len(of)}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    missed = misses(found, NAMES)
    count = sum((each.kind, each.seed) in verdicts for each in missed)
    text = f"{count} of {len(missed)} misses were examined; the others count as left."
    return "\n".join(lines) + f"\n\n{text}\n"


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
