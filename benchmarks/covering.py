"""Covering: how fast sets of faults are ranked and the next test is found, and how often right.

Robots and faults are random; of each robot's monitors 60 % can be read, 1 % of what they should
show they miss, 0.1 % of what they show is false. Times are CPU times of single questions.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import random
import resource
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from amberbox.core.needs import Needs, all_of, any_of
from amberbox.diagnosis.covering.hypotheses import RankedHypotheses, diagnose
from amberbox.diagnosis.covering.model import (
    UNKNOWN,
    Function,
    Link,
    Mode,
    Model,
    Sign,
    Unknown,
)
from amberbox.diagnosis.covering.next_test import next_tests, with_answer
from amberbox.diagnosis.covering.observations import Evidence, Observation, predict
from benchmarks.common import Row, percentile

SIZES = ((200, 500, 300), (500, 2000, 750), (1000, 5000, 1500))
CASES = (300, 120, 60)
TARGETS_MS = {200: {"ranking, median": 1, "ranking, largest": 50, "next test, largest": 10}}
READABLE, LEAK, DETECTS = 0.6, 1e-3, 0.99
TESTS = 10
BINS = 8
STRANGE = 40


@dataclass(frozen=True)
class Case:
    """What was broken, and what the monitors say: those that are read, and all of them."""

    faults: frozenset[str]
    evidence: Evidence
    truth: Evidence


@dataclass(frozen=True)
class Outcome:
    """What the engine made of a case."""

    case: Case
    answer: RankedHypotheses
    rank_ms: float
    test_ms: float


def random_robot(components: int, modes: int, monitors: int, seed: int = 0) -> Model:
    """Make a robot: components that need others, failure modes, monitors.

    Each component needs up to two others of lower number, now and then either of two. A third
    of the failure modes take their component down; the first monitor of a component watches its
    service. Each mode shows one to three further monitors, most of them of its own component.
    """
    rng = random.Random(seed)
    names = [f"c{n}" for n in range(components)]
    functions = [Function(name, _needs(rng, names, n)) for n, name in enumerate(names)]
    made = [
        Mode(f"{names[n % components]}#m{n}", 10 ** rng.uniform(-4, -2.3), rng.random() < 1 / 3)
        for n in range(modes)
    ]
    signs = [Sign(f"{names[n % components]}/o{n // components}", LEAK) for n in range(monitors)]
    links = [Link(name, f"{name}/o0", DETECTS) for name in names]
    links += [link for mode in made for link in _links(rng, mode, signs, components)]
    return Model(tuple(made), tuple(signs), tuple(links), tuple(functions), Unknown())


def _needs(rng: random.Random, names: Sequence[str], place: int) -> Needs:
    lower = names[max(0, place - 40) : place]
    chosen = rng.sample(lower, min(len(lower), rng.choice([0, 1, 1, 2])))
    return any_of(*chosen) if len(chosen) == 2 and rng.random() < 0.3 else all_of(*chosen)


def _links(rng: random.Random, mode: Mode, signs: Sequence[Sign], components: int) -> set[Link]:
    own = int(mode.component[1:])
    near = [(own + rng.choice([0, 0, 0, 1, 2, 3])) % components for _ in range(rng.randint(1, 3))]
    places = [place + components * rng.randint(0, 1) for place in near]
    shown = {signs[place % len(signs)].id for place in places}
    return {Link(mode.id, symptom, DETECTS) for symptom in shown}


def random_case(model: Model, rng: random.Random, count: int) -> Case:
    """Break so many failure modes, drawn by their priors, and let the monitors speak."""
    priors = [mode.prior for mode in model.modes]
    faults: set[str] = set()
    while len(faults) < count:
        faults.add(rng.choices(model.modes, priors)[0].id)
    prediction = predict(model, faults)
    everything = {
        sign.id: Observation("present" if rng.random() < prediction.present(model, n) else "absent")
        for n, sign in enumerate(model.signs)
    }
    read = {name: state for name, state in everything.items() if rng.random() < READABLE}
    return Case(frozenset(faults), Evidence(read), Evidence(everything))


def measure() -> list[Row]:
    """Measure every size."""
    return [row for size, cases in zip(SIZES, CASES, strict=True) for row in _at(size, cases)]


def _at(size: tuple[int, int, int], cases: int) -> Iterator[Row]:
    name = "{}/{}/{}".format(*size)
    model = random_robot(*size)
    spent, _ = _cpu_ms(lambda: model.tables)
    yield Row(f"{name}: compile once", spent, "ms", note="components/failure modes/monitors")
    rng = random.Random(1)
    outcomes = [_outcome(model, random_case(model, rng, 1 + n % 3)) for n in range(cases)]
    yield from _times(name, size[0], outcomes)
    yield from _with_sizes(name, model, outcomes)
    yield from _beside_clingo(name, model, outcomes[:30])
    yield from _accuracy(name, model, outcomes)
    yield _not_in_the_fmea(name, model, rng)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    yield Row(f"{name}: most memory of the process", memory, "MB")


def _outcome(model: Model, case: Case) -> Outcome:
    rank_ms, answer = _cpu_ms(lambda: diagnose(model, case.evidence))
    test_ms, _ = _cpu_ms(lambda: next_tests(model, case.evidence, answer.hypotheses))
    return Outcome(case, answer, rank_ms, test_ms)


def _times(name: str, components: int, outcomes: Sequence[Outcome]) -> Iterator[Row]:
    ranks, tests = [o.rank_ms for o in outcomes], [o.test_ms for o in outcomes]
    measured = {
        "ranking, median": percentile(ranks, 50),
        "ranking, 90th percentile": percentile(ranks, 90),
        "ranking, largest": max(ranks),
        "next test, median": percentile(tests, 50),
        "next test, largest": max(tests),
    }
    for what, value in measured.items():
        target = TARGETS_MS.get(components, {}).get(what)
        note = f"to be <= {target}" if target else f"{len(outcomes)} questions"
        yield Row(f"{name}: {what}", value, "ms", note=note)
    covered = percentile([100 * o.answer.mass_covered for o in outcomes], 50)
    yield Row(f"{name}: least share of the probability that was enumerated, median", covered, "%")
    incomplete = sum(bool(o.answer.incomplete) for o in outcomes)
    yield Row(f"{name}: questions that ran into a budget", incomplete, "")


def graded(model: Model, rng: random.Random) -> Model:
    """Let each failure mode show its symptoms with sizes of its own; modes exclude each other."""
    links = tuple(
        replace(link, sizes=_spread(rng)) if "#" in link.cause else link for link in model.links
    )
    of: dict[str, list[str]] = {}
    for mode in model.modes:
        of.setdefault(mode.component, []).append(mode.id)
    modes = tuple(
        replace(mode, excludes=frozenset(of[mode.component]) - {mode.id}) for mode in model.modes
    )
    signs = tuple(replace(sign, bins=BINS) for sign in model.signs)
    return replace(model, links=links, modes=modes, signs=signs)


def _spread(rng: random.Random) -> tuple[float, ...]:
    first, weights = rng.randrange(BINS - 1), [0.0] * BINS
    weights[first] = weights[first + 1] = 0.5
    return tuple(weights)


def sized(model: Model, case: Case, rng: random.Random) -> Evidence:
    """Give the present symptoms of a case sizes that its faults show."""
    prediction = predict(model, case.faults)

    def level(place: int) -> int:
        shares = prediction.sizes(model, place)[1:] if place in model.tables.graded else []
        return 1 + rng.choices(range(BINS), shares)[0] if any(shares) else rng.randint(1, BINS)

    observations = {
        name: replace(seen, level=level(model.sign_places[name]))
        if seen.state == "present"
        else seen
        for name, seen in case.evidence.observations.items()
    }
    return replace(case.evidence, observations=observations)


def _with_sizes(name: str, model: Model, outcomes: Sequence[Outcome]) -> Iterator[Row]:
    """Ask the same questions with sizes, and with modes of a component that exclude each other."""
    rng = random.Random(2)
    other = graded(model, rng)
    assert other.tables
    plain, times, right, before = [], [], [], []
    for outcome in outcomes:
        evidence = sized(other, outcome.case, rng)
        spent, answer = _cpu_ms(partial(diagnose, other, evidence))
        again, _ = _cpu_ms(partial(diagnose, model, outcome.case.evidence))
        times.append(spent)
        plain.append(again)
        if _visible(model, outcome.case):
            right.append(_in_groups(answer, outcome.case.faults, 1))
            before.append(_in_groups(outcome.answer, outcome.case.faults, 1))
    ratio = sum(times) / sum(plain)
    yield Row(f"{name}: ranking with sizes, median", percentile(times, 50), "ms")
    yield Row(f"{name}: ranking with sizes, largest", max(times), "ms")
    yield Row(f"{name}: the same questions with sizes cost", ratio, "x", note="to be <= 2")
    note = f"without sizes {100 * statistics.fmean(before):.0f} %"
    share = 100 * statistics.fmean(right)
    yield Row(f"{name}: with sizes, exact set in the first group", share, "%", note=note)


def _accuracy(name: str, model: Model, outcomes: Sequence[Outcome]) -> Iterator[Row]:
    for count in (1, 2, 3):
        of = [o for o in outcomes if len(o.case.faults) == count and _visible(model, o.case)]
        first = [_in_groups(o.answer, o.case.faults, 1) for o in of]
        five = [_in_groups(o.answer, o.case.faults, 5) for o in of]
        tested = [_with_tests(model, o) for o in of]
        right = [_in_groups(t[0], o.case.faults, 1) for o, t in zip(of, tested, strict=True)]
        sizes = [len(o.answer.groups[0].members) for o in of]
        other = [UNKNOWN in o.answer.hypotheses[0].faults for o in of]
        tests = statistics.mean(number for _, number in tested)
        what = f"{name}: {count} fault{'s' * (count > 1)}"
        exact = f"{what}, exact set in the first"
        note = f"of {len(of)} cases in which each fault shows something that is read"
        yield Row(f"{exact} group", 100 * statistics.fmean(first), "%", note=note)
        note = f"{100 * statistics.fmean(other):.0f} % begin with something not in the FMEA"
        yield Row(f"{exact} five groups", 100 * statistics.fmean(five), "%", note=note)
        note = f"{tests:.1f} tests on average, at most {TESTS}"
        yield Row(f"{exact} group after tests", 100 * statistics.fmean(right), "%", note=note)
        note = f"largest {max(sizes)}"
        yield Row(f"{what}, mean size of the first group", statistics.mean(sizes), "", note=note)


def _not_in_the_fmea(name: str, model: Model, rng: random.Random) -> Row:
    """Show two to four monitors at random: hardly any failure mode explains them."""
    found = []
    for number in range(STRANGE):
        read = [sign.id for sign in model.signs if rng.random() < READABLE]
        bad = set(rng.sample(read, 2 + number % 3))
        states = {n: Observation("present" if n in bad else "absent") for n in read}
        found.append(UNKNOWN in diagnose(model, Evidence(states)).hypotheses[0].faults)
    note = f"of {STRANGE} cases in which two to four monitors at random are bad"
    return Row(
        f"{name}: not in the FMEA comes first", 100 * statistics.fmean(found), "%", note=note
    )


def _visible(model: Model, case: Case) -> bool:
    states = case.evidence.observations
    present = {model.sign_places[name] for name, o in states.items() if o.state == "present"}
    return all(present & predict(model, {fault}).misses.keys() for fault in case.faults)


def _in_groups(answer: RankedHypotheses, faults: frozenset[str], groups: int) -> bool:
    names = {hypothesis.id: hypothesis.faults for hypothesis in answer.hypotheses}
    return any(
        names[member] == faults
        for group in answer.groups[:groups]
        for member in (*group.members, *group.wider)
    )


def _with_tests(model: Model, outcome: Outcome) -> tuple[RankedHypotheses, int]:
    """Read what is proposed until nothing more is, at most ``TESTS`` times."""
    answer, evidence = outcome.answer, outcome.case.evidence
    for number in range(TESTS):
        proposals = next_tests(model, evidence, answer.hypotheses)
        if not proposals or proposals[0].test.gain_bits < 0.05:
            return answer, number
        check = proposals[0].check
        state = outcome.case.truth.observations[check.reads].state
        evidence = with_answer(evidence, check, state)
        answer = diagnose(model, evidence)
    return answer, TESTS


def _cpu_ms(work: Callable[[], Any]) -> tuple[float, Any]:
    start_s = time.process_time()
    result = work()
    return (time.process_time() - start_s) * 1e3, result


def _beside_clingo(name: str, model: Model, outcomes: Sequence[Outcome]) -> Iterator[Row]:
    """Compare with the best single set by clingo, without the mode that can show anything."""
    if importlib.util.find_spec("clingo") is None:
        return
    known = replace(model, unknown=None)
    ours, theirs, equal = [], [], 0
    for evidence in (outcome.case.evidence for outcome in outcomes):
        ms, cost = _cpu_ms(partial(_clingo_cost, known, evidence))
        theirs.append(ms)
        ms, answer = _cpu_ms(partial(diagnose, known, evidence, max_hypotheses=1))
        ours.append(ms)
        equal += abs(cost / SCALE - _cost(known, evidence, answer.hypotheses[0].faults)) < 0.1
    for what, percent in (("median", 50), ("largest", 100)):
        mine, peer = percentile(ours, percent), percentile(theirs, percent)
        note = f"grounding included; equal cost in {equal} of {len(outcomes)}"
        what = f"{name}: best set only, {what}"
        yield Row(what, mine, "ms", f"clingo {peer:.3g} ms", peer / mine, note)


def _cost(model: Model, evidence: Evidence, faults: frozenset[str]) -> float:
    """Return minus the logarithm of the probability, relative to nothing being broken."""
    prediction = predict(model, faults)
    priors = {mode.id: mode.prior for mode in model.modes}
    cost = sum(math.log(1 / priors[fault] - 1) for fault in faults)
    for name, observation in evidence.observations.items():
        present = prediction.present(model, model.sign_places[name])
        cost -= math.log(present if observation.state == "present" else (1 - present) / (1 - LEAK))
    return cost


SCALE = 1000
"""clingo minimises whole numbers: thousandths of natural logarithms."""

RULES = """
{ fault(M) : mode(M) }.
lost(C) :- fault(M), takes(M, C).
lost(F) :- all(F, P), lost(P).
lost(F) :- any(F), lost(P) : either(F, P).
active(M) :- fault(M).
active(F) :- lost(F).
seen(S) :- active(X), shows(X, S).
twice(S) :- active(X), active(Y), X < Y, shows(X, S), shows(Y, S), bad(S).
:~ fault(M), prior(M, W). [W, prior, M]
:~ bad(S), not seen(S). [leak, leak, S]
:~ bad(S), seen(S), not twice(S). [once, once, S]
:~ good(S), active(X), shows(X, S). [miss, miss, S, X]
"""


def _clingo_cost(model: Model, evidence: Evidence) -> int:
    clingo = importlib.import_module("clingo")

    constants = {"leak": LEAK, "once": 1 - (1 - LEAK) * (1 - DETECTS), "miss": 1 - DETECTS}
    given = [f"-c{name}={-SCALE * math.log(value):.0f}" for name, value in constants.items()]
    control = clingo.Control(["--opt-strategy=usc", *given])
    control.add("base", [], RULES + "".join(_facts(model, evidence)))
    control.ground([("base", [])])
    with control.solve(yield_=True) as handle:
        costs = [found.cost for found in handle]
    return int(sum(costs[-1]))


def _facts(model: Model, evidence: Evidence) -> Iterator[str]:
    for mode in model.modes:
        yield f'mode("{mode.id}").'
        yield f'prior("{mode.id}",{SCALE * math.log(1 / mode.prior - 1):.0f}).'
        if mode.takes_down:
            yield f'takes("{mode.id}","{mode.component}").'
    for function in model.functions:
        every = function.needs.at_least == len(function.needs.parts)
        yield "" if every else f'any("{function.id}").'
        for part in function.needs.parts:
            yield f'{"all" if every else "either"}("{function.id}","{part}").'
    for link in model.links:
        if link.symptom in evidence.observations:
            yield f'shows("{link.cause}","{link.symptom}").'
    for name, observation in evidence.observations.items():
        yield f'{"bad" if observation.state == "present" else "good"}("{name}").'
