"""Nominal p-values, and the mission's own baseline."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.detection.baselines import MissionStandardisation
from amberbox.detection.nominal import NominalDistribution

scores = st.lists(st.floats(-1e12, 1e12), min_size=1, max_size=300)


@settings(max_examples=60)
@given(scores, st.lists(st.floats(-1e15, 1e15), min_size=2, max_size=20))
def test_p_values_fall_from_one_and_survive_a_file(
    nominal: list[float], asked: list[float]
) -> None:
    distribution = NominalDistribution.of(nominal)
    found = [distribution.p_value(score) for score in sorted(asked)]
    assert all(0 <= p <= 1 for p in found)
    assert found == sorted(found, reverse=True)
    assert distribution.p_value(min(nominal) - 1e9) == 1.0
    assert NominalDistribution.from_numbers(distribution.numbers()) == distribution


def test_p_values_are_the_shares_of_nominal_scores() -> None:
    sample = np.random.default_rng(3).exponential(2.0, 20_000)
    distribution = NominalDistribution.of(sample)
    for p_value in (0.5, 0.1, 0.01, 0.001):
        score = distribution.score_at(p_value)
        assert np.mean(sample >= score) == pytest.approx(p_value, rel=0.15)
        assert distribution.p_value(score) == pytest.approx(p_value, rel=1e-6)
    beyond = distribution.score_at(1e-7)
    assert beyond > sample.max()
    assert distribution.p_value(beyond) == pytest.approx(1e-7, rel=1e-6)


@pytest.mark.parametrize("place", range(4))
def test_a_damaged_distribution_is_refused(place: int) -> None:
    row = NominalDistribution.of(np.arange(50.0)).numbers()
    row[(0, 1, 3, 67)[place]] = (0.0, np.nan, -5.0, 2.0)[place]
    with pytest.raises(ValueError, match="distribution"):
        NominalDistribution.from_numbers(row)


def test_the_mission_baseline_removes_an_offset_and_does_not_learn_a_fault() -> None:
    own = MissionStandardisation()
    random = np.random.default_rng(4)
    found = []
    for step in range(600):
        level = 50.0 if step < 300 else 400.0
        found.append(own.standardise(step * NS // 10, level * random.lognormal(0, 0.1)))
    assert all(value is None for value in found[:100])
    nominal = [value for value in found[100:300] if value is not None]
    assert max(nominal) < 5
    faulty = [value for value in found[300:] if value is not None]
    assert min(faulty) > 5
    again = MissionStandardisation()
    again.resume(json.loads(json.dumps(own.snapshot())))
    assert again.standardise(70 * NS, 60.0) == own.standardise(70 * NS, 60.0)
