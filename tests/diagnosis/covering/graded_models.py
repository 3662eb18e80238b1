"""Random models with sizes, times, exclusions and consequences, and evidence for them."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import combinations

from amberbox.core.clock import NS
from amberbox.diagnosis.covering.model import Consequence, Link, Mode, Model, Sign, Unknown
from amberbox.diagnosis.covering.observations import Evidence, Observation
from tests.diagnosis.covering.small_models import STATES, random_functions

BEGAN_NS = 1_700_000_000 * NS


def graded_model(rng: random.Random) -> Model:
    """Make a model of at most 8 failure modes, 6 symptoms and 4 bins."""
    ids = [f"c{rng.randint(0, 3)}#m{n}" for n in range(rng.randint(1, 8))]
    signs = tuple(
        Sign(f"s{n}", rng.choice([0.0, 0.01, rng.random()]), bins=rng.randint(0, 4))
        for n in range(rng.randint(1, 6))
    )
    links = tuple(
        Link(cause, sign.id, rng.choice([0.99, 1.0, rng.random()]), _sizes(rng, sign.bins))
        for cause in ids
        for sign in signs
        if rng.random() < 0.5
    )
    unknown = Unknown(rng.uniform(0, 0.2), rng.random(), rng.choice([0.0, rng.random()]))
    return Model(
        tuple(Mode(name, rng.uniform(0, 0.3), rng.random() < 0.3) for name in ids),
        signs, _with_times(rng, links), (), unknown if rng.random() < 0.7 else None,
        _consequences(rng, ids),
    )  # fmt: skip


def with_functions(rng: random.Random, model: Model) -> Model:
    """Let components take down functions, whose loss shows symptoms with and without sizes."""
    functions = random_functions(rng, [f"c{n}" for n in range(4)])
    links = tuple(
        Link(function.id, sign.id, rng.choice([0.99, 1.0, rng.random()]), _sizes(rng, sign.bins))
        for function in functions
        for sign in model.signs
        if rng.random() < 0.5
    )
    return replace(model, functions=functions, links=model.links + links)


def with_exclusions(rng: random.Random, model: Model) -> Model:
    """Let the modes of some components exclude each other, but for some pairs."""
    exclusive = {mode.component for mode in model.modes if rng.random() < 0.5}
    pairs = {
        pair
        for pair in combinations([mode.id for mode in model.modes], 2)
        if pair[0].partition("#")[0] == pair[1].partition("#")[0]
        and pair[0].partition("#")[0] in exclusive
        and rng.random() < 0.9
    }
    modes = tuple(
        replace(mode, excludes=frozenset(b for a, b in pairs if a == mode.id))
        for mode in model.modes
    )
    return replace(model, modes=modes)


def graded_evidence(rng: random.Random, model: Model) -> Evidence:
    """Observe some symptoms, with sizes and onsets where they have any."""
    observations, onsets_ns = {}, {}
    for sign in model.signs:
        state = rng.choice(("present", *STATES))
        level = rng.randint(1, sign.bins) if sign.bins and state == "present" else None
        strength = rng.choice([1.0, 1.0, rng.uniform(0.05, 1.0)])
        observations[sign.id] = Observation(state, strength, rng.choice([level, level, None]))
        if state == "present" and rng.random() < 0.8:
            onsets_ns[sign.id] = BEGAN_NS + rng.randint(0, 20) * NS
    return Evidence(observations, onsets_ns=onsets_ns)


def _sizes(rng: random.Random, bins: int) -> tuple[float, ...]:
    if not bins or rng.random() < 0.3:
        return ()
    shares = [rng.choice([0.0, rng.random()]) for _ in range(bins)]
    total = sum(shares)
    return tuple(share / total for share in shares) if total else ()


def _with_times(rng: random.Random, links: tuple[Link, ...]) -> tuple[Link, ...]:
    """Give some links a time, at most six: all choices of times are written out."""
    timed = set(rng.sample(range(len(links)), min(len(links), rng.randint(0, 6))))
    return tuple(
        replace(link, after_s=(low := rng.randint(0, 5), low + rng.randint(0, 10)))
        if place in timed
        else link
        for place, link in enumerate(links)
    )


def _consequences(rng: random.Random, ids: list[str]) -> tuple[Consequence, ...]:
    return tuple(
        Consequence(cause, effect, rng.choice([0.3, 1.0, rng.random()]), _after(rng))
        for cause, effect in combinations(ids, 2)
        if rng.random() < 0.1
    )


def _after(rng: random.Random) -> tuple[float, float] | None:
    low = rng.randint(0, 10)
    return None if rng.random() < 0.5 else (low, low + rng.randint(0, 20))
