from __future__ import annotations

import random
from itertools import pairwise

import pytest

from amberbox.core.contracts import Budget
from amberbox.diagnosis.covering.hypotheses import diagnose
from tests.diagnosis.covering.brute import named, posterior, restricted
from tests.diagnosis.covering.small_models import random_evidence, random_model

TOLERANCE = 1e-9


@pytest.mark.parametrize("seed", range(200))
def test_every_probability_equals_that_of_writing_out_all_sets(seed: int) -> None:
    rng = random.Random(seed)
    model = random_model(rng)
    evidence = random_evidence(rng, model)
    exact = posterior(model, evidence)

    answer = diagnose(model, evidence, max_hypotheses=5000, mass=2.0)

    ours = {h.faults: h.probability for h in answer.hypotheses}
    if not exact:
        assert not ours
        return
    expected = restricted(exact, named(ours))
    assert len(ours) == len(answer.hypotheses)
    assert ours == pytest.approx({f: p for f, p in expected.items() if f in ours}, abs=TOLERANCE)
    assert sum(p for f, p in expected.items() if f not in ours) < TOLERANCE
    assert answer.mass_covered == 1.0 and not answer.incomplete
    shares = [h.probability for h in answer.hypotheses]
    assert all(later < earlier + 1e-15 for earlier, later in pairwise(shares))


@pytest.mark.parametrize("seed", range(200, 260))
def test_bounds_hold_however_early_the_search_ends(seed: int) -> None:
    rng = random.Random(seed)
    model = random_model(rng)
    evidence = random_evidence(rng, model)
    full = diagnose(model, evidence, max_hypotheses=5000, mass=2.0)
    exact = restricted(posterior(model, evidence), named(h.faults for h in full.hypotheses))
    for nodes in (0, 1, 3, 10, 30):
        answer = diagnose(model, evidence, max_hypotheses=5000, mass=2.0, budget=Budget(nodes))
        assert answer.incomplete or answer.mass_covered == 1.0 or not exact
        for hypothesis in answer.hypotheses:
            share = exact[hypothesis.faults]
            assert share <= hypothesis.probability * (1 + TOLERANCE)
            assert share >= hypothesis.probability * answer.mass_covered * (1 - TOLERANCE)
