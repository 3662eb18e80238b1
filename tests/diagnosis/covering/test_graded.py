"""Sizes, times, exclusions and consequences: the search equals writing out all sets."""

from __future__ import annotations

import os
import random

import pytest

from amberbox.core.contracts import Budget
from amberbox.diagnosis.covering.hypotheses import diagnose
from amberbox.diagnosis.covering.model import Model
from amberbox.diagnosis.covering.observations import Evidence
from tests.diagnosis.covering.brute import named, restricted
from tests.diagnosis.covering.graded_brute import posterior
from tests.diagnosis.covering.graded_models import (
    graded_evidence,
    graded_model,
    with_exclusions,
    with_functions,
)

TOLERANCE = 1e-9
BATCHES = 400 if os.environ.get("HYPOTHESIS_PROFILE") == "soak" else 12
BATCH = 25


def assert_exact(model: Model, evidence: Evidence) -> None:
    exact = posterior(model, evidence)
    answer = diagnose(model, evidence, max_hypotheses=5000, mass=2.0)
    ours = {h.faults: h.probability for h in answer.hypotheses}
    if not exact:
        assert not ours
        return
    expected = restricted(exact, named(ours))
    assert ours == pytest.approx({f: expected[f] for f in ours}, abs=TOLERANCE)
    assert sum(p for f, p in expected.items() if f not in ours) < TOLERANCE
    assert answer.mass_covered == 1.0 and not answer.incomplete


def random_case(seed: int) -> tuple[Model, Evidence]:
    rng = random.Random(seed)
    model = graded_model(rng)
    if rng.random() < 0.5:
        model = with_exclusions(rng, model)
    if rng.random() < 0.5:
        model = with_functions(rng, model)
    return model, graded_evidence(rng, model)


@pytest.mark.parametrize("batch", range(BATCHES))
def test_every_probability_equals_that_of_writing_out_all_sets(batch: int) -> None:
    for seed in range(batch * BATCH, (batch + 1) * BATCH):
        assert_exact(*random_case(seed))


@pytest.mark.parametrize("seed", [1142, 1213, 2520])
def test_a_mode_that_matters_by_its_time_still_loses_functions(seed: int) -> None:
    assert_exact(*random_case(seed))


@pytest.mark.parametrize("batch", range(BATCHES))
def test_bounds_hold_however_early_the_search_ends(batch: int) -> None:
    for seed in range(batch * BATCH, (batch + 1) * BATCH, 5):
        model, evidence = random_case(seed)
        full = diagnose(model, evidence, max_hypotheses=5000, mass=2.0)
        exact = {h.faults: h.probability for h in full.hypotheses}
        for nodes in (0, 1, 3, 10):
            answer = diagnose(model, evidence, max_hypotheses=5000, mass=2.0, budget=Budget(nodes))
            for hypothesis in answer.hypotheses:
                share, covered = exact[hypothesis.faults], answer.mass_covered
                assert share <= hypothesis.probability * (1 + TOLERANCE)
                assert share >= hypothesis.probability * covered * (1 - TOLERANCE)
        best = diagnose(model, evidence, max_hypotheses=3, mass=2.0).hypotheses
        shares = [exact[hypothesis.faults] for hypothesis in best]
        assert shares == pytest.approx(sorted(exact.values(), reverse=True)[:3], rel=TOLERANCE)
