"""Evidence, each measurement counted once, and its likelihood factors given sets of faults.

Evidence is symptoms seen and not seen, conflicts, and outcomes of tests. Faults predict losses,
symptoms and outcomes of tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.types import Symptom, SymptomState, TestKind
from amberbox.diagnosis.covering.model import (
    UNKNOWN,
    Cumulated,
    Floats,
    Model,
    bits,
    log_miss,
)


@dataclass(frozen=True, slots=True)
class CheckDetection:
    """A cause (failure mode, or function that is lost) makes a test give an outcome."""

    cause: str
    outcome: str
    detects: float


@dataclass(frozen=True, slots=True)
class Check:
    """A test: a symptom to read, a question, a check by a person, an experiment or a unit test.

    The first outcome is that of a healthy robot, later ones are more severe; each present cause
    reaches its outcome with probability ``detects``, and the most severe outcome that is reached is
    observed (noisy-MAX). Without a cause the first outcome has probability ``sure`` and the others
    share the remainder. For two outcomes ``detects`` and ``sure`` give sensitivity ``1 - sure * (1
    - detects)`` and specificity ``sure``.

    A check that ``reads`` a symptom has the outcomes absent and present, and no detections.
    ``run`` is the name of the experiment or unit test that gives the outcome; the robot ``moves``
    in it or not.
    """

    id: str
    kind: TestKind
    text: str
    role: str = ""
    cost_s: float = 0.0
    risk: float = 0.0
    outcomes: tuple[str, ...] = ("no", "yes")
    sure: float = 0.99
    detections: tuple[CheckDetection, ...] = ()
    reads: str = ""
    run: str = ""
    moves: bool = False

    def __post_init__(self) -> None:
        if len(self.outcomes) < 2:
            raise UsageError(f"the test {self.id} has fewer than two outcomes")
        if not 0.0 < self.sure <= 1.0:
            raise UsageError(f"the test {self.id} is sure to {self.sure:g}, not in (0, 1]")
        for detection in self.detections:
            self.level(detection.outcome)
            if not 0.0 <= detection.detects <= 1.0:
                what = f"the test {self.id} detects {detection.cause} with {detection.detects:g}"
                raise UsageError(f"{what}, no probability")

    def level(self, outcome: str) -> int:
        """Return how grave an outcome is, 0 for sound; raise UsageError for an unknown one."""
        if outcome not in self.outcomes:
            near = did_you_mean(outcome, self.outcomes)
            what = f"the test {self.id} has no outcome '{outcome}'{near}"
            raise UsageError(what, f"it gives {', '.join(self.outcomes)}")
        return self.outcomes.index(outcome)

    def at_most(self, level: int) -> float:
        """Return the probability of an outcome up to this one without any cause."""
        return self.sure + (1 - self.sure) * level / (len(self.outcomes) - 1)


READ_OUTCOMES = ("absent", "present")


def reading_check(symptom: str, cost_s: float) -> Check:
    """Return the check that reads a symptom on demand."""
    return Check(
        f"read:{symptom}", "read", f"Read {symptom}.", cost_s=cost_s,
        outcomes=READ_OUTCOMES, sure=1.0, reads=symptom,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Observation:
    """The state of a symptom and the trust in it.

    With probability ``strength`` the observation is right, else it is random: its likelihood is
    ``strength * P(state | faults) + (1 - strength) / 2``. ``level`` is the bin of a present
    symptom's size, from 1 on, None if that is not known: then it only counts that it is present.
    With K bins the random share of a size, and of their absence, is ``1 / (K + 1)``.
    """

    state: SymptomState
    strength: float = 1.0
    level: int | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.strength <= 1.0:
            raise UsageError(f"the strength of a symptom is {self.strength:g}, not in (0, 1]")


@dataclass(frozen=True, slots=True)
class AnsweredCheck:
    """A test and the outcome that it gave."""

    check: Check
    outcome: str


@dataclass(frozen=True, slots=True)
class Evidence:
    """The evidence: observations, conflicts and answered tests.

    A conflict is a set of failure modes of which at least one is present; a suspicion is one that
    is right with a probability, as an observation is with its strength. ``asked`` are tests that
    were done or cannot be done: they are not proposed again. ``doubled`` are symptoms that do not
    count, because the data they were measured from have been counted. ``onsets_ns`` are when
    present symptoms began, as far as that is known.
    """

    observations: Mapping[str, Observation] = field(default_factory=dict)
    conflicts: tuple[frozenset[str], ...] = ()
    answers: tuple[AnsweredCheck, ...] = ()
    asked: frozenset[str] = frozenset()
    doubled: tuple[str, ...] = ()
    onsets_ns: Mapping[str, int] = field(default_factory=dict)
    suspicions: tuple[tuple[frozenset[str], float], ...] = ()

    def with_observation(self, symptom: str, state: SymptomState) -> Evidence:
        """Return the evidence with the state of a symptom; unknown if it cannot be determined."""
        observations = {name: o for name, o in self.observations.items() if name != symptom}
        return replace(self, observations=observations | {symptom: Observation(state)})


def _no_level(symptom: Symptom) -> int | None:
    return None


def collect_evidence(
    symptoms: Iterable[Symptom],
    conflicts: Iterable[Iterable[str]] = (),
    level_of: Callable[[Symptom], int | None] = _no_level,
) -> Evidence:
    """Collect symptoms so that one measurement counts once; ``level_of`` is the bin of a size.

    Of two observations of one symptom the stronger counts; of equally strong ones the one of state
    present. The same holds for symptoms of different sources: one does not count when all it was
    measured from (address and overlapping time) has been counted for another source. Symptoms of
    the same source are different questions to the data, and all count.
    """
    counted: dict[str, Observation] = {}
    spent: dict[str, list[tuple[str, int, int]]] = {}
    doubled: list[str] = []
    onsets_ns: dict[str, int] = {}
    for symptom in sorted(symptoms, key=_strongest_first):
        if symptom.state == "unknown" or symptom.strength <= 0 or symptom.id in counted:
            continue
        if bool(symptom.evidence) and all(
            any(
                source != symptom.source and from_ns <= until_ns and since_ns <= to_ns
                for source, since_ns, until_ns in spent.get(address, ())
            )
            for address, from_ns, to_ns in symptom.evidence
        ):
            doubled.append(symptom.id)
            continue
        level = level_of(symptom) if symptom.state == "present" else None
        counted[symptom.id] = Observation(symptom.state, min(1.0, symptom.strength), level)
        onset_ns = symptom.confirmed_ns if symptom.onset_ns is None else symptom.onset_ns
        if symptom.state == "present" and onset_ns is not None:
            onsets_ns[symptom.id] = onset_ns
        for address, from_ns, to_ns in symptom.evidence:
            spent.setdefault(address, []).append((symptom.source, from_ns, to_ns))
    sets = tuple(frozenset(conflict) for conflict in conflicts)
    left_out = tuple(name for name in doubled if name not in counted)
    return Evidence(counted, sets, doubled=left_out, onsets_ns=onsets_ns)


def _strongest_first(symptom: Symptom) -> tuple[float, bool, str, str]:
    return (-symptom.strength, symptom.state != "present", symptom.id, symptom.source)


Causes = Sequence[tuple[int, float]]


@dataclass(frozen=True, slots=True)
class LikelihoodFactor:
    """The likelihood ``alpha + beta * q`` over causes (place, detects).

    With ``gain`` it is ``alpha + beta * q + gain * u``, where ``u`` is the q of the next factor.
    """

    alpha: float
    beta: float
    modes: Causes
    functions: Causes = ()
    gain: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class FoldedEvidence:
    """The evidence combined with one model.

    ``log_weight`` is per mode the logarithm of its prior odds times the probability that all
    certainly absent symptoms are absent; ``log_loss`` that probability per lost function.
    ``timed`` are present symptoms of which some cause has a time, with onset and strength.
    ``is_graded``: the size of some symptom counts.
    """

    factors: tuple[LikelihoodFactor, ...]
    log_weight: Floats
    log_loss: Floats
    timed: tuple[TimedSymptom, ...] = ()
    is_graded: bool = False


@dataclass(frozen=True, slots=True)
class TimedSymptom:
    """A present symptom (by place) with a known onset, ns."""

    sign: int
    onset_ns: int
    strength: float


def fold_evidence(model: Model, evidence: Evidence) -> FoldedEvidence:
    """Turn evidence into weights and factors; symptoms that the model lacks are left out."""
    tables = model.tables
    places, gone, factors, sized = model.sign_places, [], [], []
    for name, observation in evidence.observations.items():
        place = places.get(name)
        if place is None or observation.state == "unknown":
            continue
        if observation.state == "absent" and observation.strength == 1.0:
            gone.append(place)
        elif observation.level is not None and place in tables.graded:
            sized.append((place, observation))
        else:
            factors.append(_symptom_factor(model, place, observation))
    absent = np.zeros(len(model.signs), np.bool_)
    absent[gone] = True
    log_weight = tables.log_odds + tables.modes.folded(absent, len(model.mode_ids))
    log_loss = tables.functions.folded(absent, len(model.functions))
    if model.unknown is not None:
        log_weight[-1] += int(absent.sum()) and absent.sum() * log_miss(model.unknown.denies)
    factors += [_conflict(model, names) for names in evidence.conflicts]
    factors += [_conflict(model, *suspicion) for suspicion in evidence.suspicions]
    for answered in evidence.answers:
        factors += _answer(model, answered, log_weight, log_loss)
    for place, observation in sized:
        factors += _size_factors(model, place, observation, log_weight, log_loss)
    timed = _timed_symptoms(model, evidence)
    return FoldedEvidence(tuple(factors), log_weight, log_loss, timed, bool(sized))


def _timed_symptoms(model: Model, evidence: Evidence) -> tuple[TimedSymptom, ...]:
    if not model.tables.timed:
        return ()
    onsets_ns, places = evidence.onsets_ns, model.sign_places
    return tuple(
        TimedSymptom(places[name], onsets_ns[name], observation.strength)
        for name, observation in evidence.observations.items()
        if name in onsets_ns
        and observation.state == "present"
        and places.get(name) in model.tables.timed
    )


def _symptom_factor(model: Model, place: int, observation: Observation) -> LikelihoodFactor:
    trust, silent = observation.strength, 1.0 - model.signs[place].leak
    random = 0.5
    if place in model.tables.graded and observation.state == "absent":
        random = 1 / (1 + model.signs[place].bins)
    modes = list(model.tables.modes.by_sign[place])
    functions = model.tables.functions.by_sign[place]
    present = observation.state == "present"
    if model.unknown is not None:
        shows = model.unknown.detects if present else model.unknown.denies
        modes += [(model.mode_places[UNKNOWN], shows)] if shows else []
    if present:
        return LikelihoodFactor((1 + trust) / 2, -trust * silent, modes, functions)
    return LikelihoodFactor((1 - trust) * random, trust * silent, modes, functions)


def _size_factors(
    model: Model, place: int, observation: Observation, log_weight: Floats, log_loss: Floats
) -> Iterator[LikelihoodFactor]:
    """Yield the factor of a symptom's size, by noisy-MAX.

    ``P(level <= k) = L(k) * prod F(k)`` over the present causes; that of exactly ``k`` is its
    difference to ``k - 1``. Of a certain size, ``prod F(k)`` is folded into the weights.
    """
    trust, level = observation.strength, observation.level or 0
    bins = model.signs[place].bins
    modes, functions = _up_to_level(model, place, level)
    up_to, below = (leak_up_to(model, place, at) for at in (level, level - 1))
    if trust < 1:
        yield LikelihoodFactor(
            (1 - trust) / (bins + 1), -trust * below, _causes(modes, 1), _causes(functions, 1),
            trust * up_to,
        )  # fmt: skip
        yield LikelihoodFactor(1.0, 0.0, _causes(modes, 0), _causes(functions, 0))
        return
    for weights, causes in ((log_weight, modes), (log_loss, functions)):
        for cause, most, _ in causes:
            weights[cause] += math.log(most) if most > 0 else -math.inf
    yield LikelihoodFactor(1.0, -below / up_to, _ratios(modes), _ratios(functions))


UpToLevel = list[tuple[int, float, float]]
"""Causes with the probability that each shows a symptom up to a level, and up to the one below."""


def _up_to_level(model: Model, place: int, level: int) -> tuple[UpToLevel, UpToLevel]:
    graded = model.tables.graded[place]

    def of(cause: int, detects: float, sizes: Cumulated) -> tuple[int, float, float]:
        up_to, below = (1 - detects * (1 - sizes[at]) for at in (level, level - 1))
        return cause, up_to, below

    modes = [of(*cause) for cause in graded.modes]
    if model.unknown is not None and model.unknown.detects:
        sizes = tuple(at / graded.bins for at in range(graded.bins + 1))
        modes.append(of(model.mode_places[UNKNOWN], model.unknown.detects, sizes))
    return modes, [of(*cause) for cause in graded.functions]


def leak_up_to(model: Model, place: int, level: int) -> float:
    """Return the probability that a symptom without a cause shows up to a level, 0 for absent."""
    sign = model.signs[place]
    return 1.0 - sign.leak * (1.0 - level / sign.bins)


def _causes(of: UpToLevel, below: int) -> Causes:
    return [(cause, 1.0 - probabilities[below]) for cause, *probabilities in of]


def _ratios(of: UpToLevel) -> Causes:
    return [(cause, 1.0 - below / most) for cause, most, below in of if most > 0]


def _conflict(model: Model, names: frozenset[str], trust: float = 1.0) -> LikelihoodFactor:
    modes = [(model.mode_place(name), 1.0) for name in sorted(names)]
    return LikelihoodFactor((1.0 + trust) / 2, -trust, modes)


def _answer(
    model: Model, answered: AnsweredCheck, log_weight: Floats, log_loss: Floats
) -> Iterator[LikelihoodFactor]:
    """Fold what graver outcomes would have shown, and yield the factor of the one that was seen."""
    check, level = answered.check, answered.check.level(answered.outcome)
    modes, functions = causes_seen(model, check)
    for place, (at, detects) in modes:
        if at > level:
            log_weight[place] += log_miss(detects)
    for place, (at, detects) in functions:
        if at > level:
            log_loss[place] += log_miss(detects)
    if level == 0:
        return
    yield LikelihoodFactor(
        1.0,
        -check.at_most(level - 1) / check.at_most(level),
        [(place, detects) for place, (at, detects) in modes if at == level],
        [(place, detects) for place, (at, detects) in functions if at == level],
    )


Seers = list[tuple[int, tuple[int, float]]]


def causes_seen(model: Model, check: Check) -> tuple[Seers, Seers]:
    """Return the modes and the functions that a check detects, each with (level, detects)."""
    modes: Seers = []
    functions: Seers = []
    for detection in check.detections:
        seen = (check.level(detection.outcome), detection.detects)
        if detection.cause in model.function_places:
            functions.append((model.function_places[detection.cause], seen))
        else:
            modes.append((model.mode_place(detection.cause), seen))
    return modes, functions


@dataclass(frozen=True, slots=True)
class Prediction:
    """Present modes, lost functions, and their effect on symptoms.

    ``misses`` is per symptom with an active cause the chance that none of them shows it; the
    unknown mode is left to ``unknown``, as it can show anything.
    """

    modes: frozenset[int]
    lost: frozenset[int]
    misses: Mapping[int, float]
    unknown: bool

    def present(self, model: Model, sign: int) -> float:
        """Return how probable it is that a symptom shows."""
        unknown = model.unknown.detects if self.unknown and model.unknown else 0.0
        return self._shows(model, sign, unknown)

    def expected(self, model: Model, sign: int) -> float:
        """Return the weight of a symptom's absence against the faults, 0 to 1."""
        unknown = model.unknown.denies if self.unknown and model.unknown else 0.0
        return self._shows(model, sign, unknown)

    def sizes(self, model: Model, sign: int) -> list[float]:
        """Return the probability of each level of a graded symptom, from absent (0) on."""
        graded = model.tables.graded[sign]
        present = [cause for cause in graded.modes if cause[0] in self.modes]
        present += [cause for cause in graded.functions if cause[0] in self.lost]
        up_to = []
        for level in range(graded.bins + 1):
            chance = leak_up_to(model, sign, level)
            for _, detects, cumulated in present:
                chance *= 1 - detects * (1 - cumulated[level])
            if self.unknown and model.unknown is not None:
                chance *= 1 - model.unknown.detects * (1 - level / graded.bins)
            up_to.append(chance)
        return [most - less for most, less in zip(up_to, [0.0, *up_to[:-1]], strict=True)]

    def _shows(self, model: Model, sign: int, unknown: float) -> float:
        silent = (1.0 - model.signs[sign].leak) * self.misses.get(sign, 1.0)
        return 1.0 - silent * (1.0 - unknown)


def predict(model: Model, faults: Collection[str]) -> Prediction:
    """Return the prediction for exactly these failure modes."""
    tables = model.tables
    modes = [model.mode_place(name) for name in faults if name != UNKNOWN]
    down = 0
    for mode in modes:
        place = tables.component[mode]
        down |= 1 << place if place >= 0 else 0
    lost = frozenset(bits(tables.gates.lost(down)))
    misses: dict[int, float] = {}
    for links, causes in ((tables.modes, modes), (tables.functions, lost)):
        for cause in causes:
            for sign, detects in links.by_cause[cause]:
                misses[sign] = misses.get(sign, 1.0) * (1.0 - detects)
    return Prediction(frozenset(modes), lost, misses, UNKNOWN in faults)


def outcomes(model: Model, check: Check, prediction: Prediction) -> tuple[float, ...]:
    """Return the probability of each outcome of a check, given these faults."""
    if check.reads:
        present = prediction.present(model, model.sign_places[check.reads])
        return (1.0 - present, present)
    return outcomes_seen(check, *causes_seen(model, check), prediction)


def outcomes_seen(
    check: Check, modes: Seers, functions: Seers, prediction: Prediction
) -> tuple[float, ...]:
    """Return the outcomes' probabilities, given which causes the check sees."""
    misses = [1.0] * len(check.outcomes)
    for level, detects in _active(modes, functions, prediction):
        misses[level] *= 1.0 - detects
    graver = 1.0
    up_to = [0.0] * len(misses)
    for level in range(len(misses) - 1, -1, -1):
        up_to[level] = check.at_most(level) * graver
        graver *= misses[level]
    below = [0.0, *up_to[:-1]]
    return tuple(most - less for most, less in zip(up_to, below, strict=True))


def _active(modes: Seers, functions: Seers, prediction: Prediction) -> Iterator[tuple[int, float]]:
    for place, seen in modes:
        if place in prediction.modes:
            yield seen
    for place, seen in functions:
        if place in prediction.lost:
            yield seen
