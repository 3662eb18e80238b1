"""Structural analysis of models with 90 to 95 equations, made at random."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from functools import partial

from amberbox.core.equations.structure import Causality, Structure, mask_of
from amberbox.diagnosis.structure.isolability import isolability
from amberbox.diagnosis.structure.submodels import mso_sets, mtes_sets
from benchmarks.common import Row, cpu_s

STATES, OTHERS, FAULTS = 13, 60, 12


def measure() -> list[Row]:
    """Measure CPU seconds for all sets of a model, and for its isolability."""
    return [row for seed, redundancy in ((1, 4), (2, 5), (3, 5)) for row in _of(seed, redundancy)]


def _of(seed: int, redundancy: int) -> Iterator[Row]:
    model = random_model(random.Random(seed), redundancy)
    name = f"{len(model.equations)} equations (seed {seed})"
    for kind, walk in (("MSO", mso_sets), ("MTES", mtes_sets)):
        count = len(_all(walk, model))
        taken = cpu_s(partial(_all, walk, model), 3)
        target = "; to be <= 5 s for thousands" if kind == "MSO" else ""
        yield Row(f"{name}: all {kind} sets", taken, "s", note=f"{count:,} sets{target}")
    for causality in Causality:
        taken = cpu_s(partial(isolability, model, causality), 3)
        yield Row(
            f"{name}: isolability, {causality}", taken * 1e3, "ms",
            note=f"{FAULTS} faults; to be <= 50 ms",
        )  # fmt: skip


def _all(walk: Callable[[Structure], Iterator[int]], model: Structure) -> list[int]:
    return list(walk(model))


def random_model(rng: random.Random, redundancy: int) -> Structure:
    """Return a model whose equations join neighbouring unknowns, with ``redundancy`` sensors."""
    unknowns = 2 * STATES + OTHERS
    variables = [mask_of((2 * state, 2 * state + 1)) for state in range(STATES)]
    for place in range(unknowns - STATES):
        near = range(max(0, place - 6), min(unknowns, place + 7))
        joined = {rng.choice(near) for _ in range(rng.choice([2, 3, 3, 4]))}
        variables.append(mask_of(joined | {STATES + place}))
    variables += [1 << rng.randrange(unknowns) for _ in range(redundancy)]
    faulty = rng.sample(range(STATES, len(variables)), FAULTS)
    return Structure(
        [f"e{number}" for number in range(len(variables))],
        [f"x{number}" for number in range(unknowns)],
        [f"f{number}" for number in faulty],
        variables,
        [1 << number for number in faulty],
        {state: (2 * state, 2 * state + 1) for state in range(STATES)},
    )
