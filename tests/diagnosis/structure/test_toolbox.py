"""Structural analysis against that of the Fault Diagnosis Toolbox, on random models."""

from __future__ import annotations

import contextlib
import io
import random
from collections.abc import Iterator

import faultdiagnosistoolbox as toolbox
import numpy as np
import pytest

from amberbox.core.equations.structure import Causality, Structure, bits, mask_of
from amberbox.diagnosis.structure.isolability import isolability
from amberbox.diagnosis.structure.submodels import mso_sets, mtes_sets

NOTHING, PLAIN, STATE, DERIVATIVE = range(4)
MODELS = 40


def random_matrix(seed: int) -> tuple[list[list[int]], list[int]]:
    """Return which equation has which unknown, as the toolbox writes it, and the faulty ones."""
    draw = random.Random(seed)
    states, others = draw.randint(0, 4), draw.randint(1, 5)
    unknowns = 2 * states + others
    rows = []
    for state in range(states):
        row = [NOTHING] * unknowns
        row[2 * state : 2 * state + 2] = STATE, DERIVATIVE
        rows.append(row)
    for _ in range(draw.randint(max(1, unknowns - states - 1), unknowns - states + 4)):
        chosen = draw.sample(range(unknowns), min(unknowns, draw.choice([1, 1, 2, 2, 3, 4])))
        rows.append([PLAIN if x in chosen else NOTHING for x in range(unknowns)])
    algebraic = range(states, len(rows))
    return rows, draw.sample(algebraic, min(draw.randint(1, 5), len(algebraic)))


def ours(rows: list[list[int]], faulty: list[int]) -> Structure:
    pairs = {
        number: (row.index(STATE), row.index(DERIVATIVE))
        for number, row in enumerate(rows) if STATE in row
    }  # fmt: skip
    return Structure(
        [f"e{n}" for n in range(len(rows))], [f"x{n}" for n in range(len(rows[0]))],
        [f"f{n}" for n in range(len(faulty))],
        [mask_of(x for x, what in enumerate(row) if what != NOTHING) for row in rows],
        [1 << number for number in faulty], pairs,
    )  # fmt: skip


@contextlib.contextmanager
def theirs(rows: list[list[int]], faulty: list[int]) -> Iterator[toolbox.DiagnosisModel]:
    """Yield the toolbox's model; it prints much."""
    faults = [[int(number == own) for own in faulty] for number in range(len(rows))]
    described = {
        "type": "MatrixStruc", "X": np.array(rows), "F": np.array(faults),
        "Z": np.zeros((len(rows), 1), int), "x": [f"x{n}" for n in range(len(rows[0]))],
        "f": [f"f{n}" for n in range(len(faulty))], "z": ["z"],
    }  # fmt: skip
    with contextlib.redirect_stdout(io.StringIO()):
        yield toolbox.DiagnosisModel(described, name="random")


@pytest.mark.parametrize("causality", Causality)
def test_isolability_is_the_same(causality: Causality) -> None:
    for seed in range(MODELS):
        rows, faulty = random_matrix(seed)
        with theirs(rows, faulty) as model:
            expected = np.array(model.IsolabilityAnalysis(causality=causality.value)).astype(bool)
        assert isolability(ours(rows, faulty), causality) == expected.tolist(), seed


def test_minimal_sets_are_the_same() -> None:
    for seed in range(MODELS):
        rows, faulty = random_matrix(seed)
        model = ours(rows, faulty)
        if model.redundancy(model.all) > 3:
            continue  # the toolbox takes minutes for some of them
        with theirs(rows, faulty) as other:
            mso, mtes = ([[int(n) for n in sorted(found)] for found in sets]
                         for sets in (other.MSO(), other.MTES()))  # fmt: skip
        assert sorted([*bits(mask)] for mask in mso_sets(model)) == sorted(mso), seed
        assert sorted([*bits(mask)] for mask in mtes_sets(model)) == sorted(mtes), seed
