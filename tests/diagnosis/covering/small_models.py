"""Random models small enough to write out every set of faults, and evidence for them."""

from __future__ import annotations

import random

from amberbox.core.needs import Needs
from amberbox.core.types import SymptomState
from amberbox.diagnosis.covering.model import Function, Link, Mode, Model, Sign, Unknown
from amberbox.diagnosis.covering.observations import (
    AnsweredCheck,
    Check,
    CheckDetection,
    Evidence,
    Observation,
)

STATES: tuple[SymptomState, ...] = ("present", "absent", "absent", "unknown")


def random_model(rng: random.Random) -> Model:
    """Make a model of at most 12 failure modes, the unknown one included."""
    components = [f"c{n}" for n in range(rng.randint(1, 5))]
    modes = tuple(
        Mode(f"{rng.choice(components)}#m{n}", _prior(rng), rng.random() < 0.6)
        for n in range(rng.randint(1, 11))
    )
    signs = tuple(
        Sign(f"s{n}", rng.choice([0.0, 0.01, rng.random()])) for n in range(rng.randint(1, 6))
    )
    functions = random_functions(rng, components)
    causes = [mode.id for mode in modes] + [function.id for function in functions]
    links = tuple(
        Link(cause, sign.id, rng.choice([0.0, 0.99, 1.0, rng.random()]))
        for cause in causes
        for sign in signs
        if rng.random() < 0.35
    )
    unknown = Unknown(_prior(rng), rng.random(), rng.choice([0.0, rng.random()]))
    return Model(modes, signs, links, functions, unknown if rng.random() < 0.7 else None)


def random_evidence(rng: random.Random, model: Model) -> Evidence:
    """Observe some symptoms, some of them weakly; add conflicts and answers now and then."""
    observations = {
        sign.id: Observation(rng.choice(STATES), rng.choice([1.0, 1.0, rng.uniform(0.05, 1.0)]))
        for sign in model.signs
    }
    names = [mode.id for mode in model.modes]
    conflicts = tuple(
        frozenset(rng.sample(names, rng.randint(1, len(names))))
        for _ in range(rng.choice([0, 0, 0, 1, 2]))
    )
    answers = tuple(_answered(rng, model, n) for n in range(rng.choice([0, 0, 1, 2])))
    return Evidence(observations, conflicts, answers)


def _answered(rng: random.Random, model: Model, number: int) -> AnsweredCheck:
    outcomes = ("fine", "odd", "broken")[: rng.randint(2, 3)]
    causes = [mode.id for mode in model.modes] + [function.id for function in model.functions]
    detections = tuple(
        CheckDetection(cause, rng.choice(outcomes), rng.choice([0.9, 1.0, rng.random()]))
        for cause in causes
        if rng.random() < 0.5
    )
    sure = rng.uniform(0.5, 1.0)
    check = Check(
        f"t{number}", "check", "Look.", outcomes=outcomes, sure=sure, detections=detections
    )
    return AnsweredCheck(check, rng.choice(outcomes))


def _prior(rng: random.Random) -> float:
    return rng.choice([rng.uniform(0.0, 0.5), rng.uniform(0.0, 0.05), 0.5])


def random_functions(rng: random.Random, components: list[str]) -> tuple[Function, ...]:
    """Make functions over components and earlier functions; some are a component's service."""
    functions: list[Function] = []
    services = rng.random() < 0.5
    for n in range(1, rng.randint(1, 6)):
        is_service = services and rng.random() < 0.5
        below = components[:n] if services else components
        usable = below + [f.id for f in functions if f.id.startswith("f")]
        functions.append(Function(f"c{n}" if is_service else f"f{n}", _needs(rng, usable, 2)))
    return tuple(functions)


def _needs(rng: random.Random, names: list[str], depth: int) -> Needs:
    chosen = rng.sample(names, rng.randint(1, min(4, len(names))))
    parts = tuple(
        _needs(rng, names, depth - 1) if depth and rng.random() < 0.25 else name for name in chosen
    )
    return Needs(rng.randint(1, len(parts)), parts)
