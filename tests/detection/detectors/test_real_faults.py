"""One-class AUROC on recorded faults, and on generated windows like them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.detection import (
    SCORERS,
    auroc,
    fold_auroc,
    generated_set,
    uci_sets,
    valve_aurocs,
)

DETECTORS = ("residual", "state_flow")


@pytest.mark.needs_data
@pytest.mark.parametrize("name", DETECTORS)
@pytest.mark.parametrize("number", range(5))
def test_failures_of_a_gripper_are_told_from_nominal_windows(
    name: str, number: int, shared_data: Path
) -> None:
    mean, _ = fold_auroc(uci_sets(shared_data / "detection")[number], SCORERS[name])
    assert mean >= 0.95


@pytest.mark.parametrize("name", DETECTORS)
def test_generated_faults_are_told_from_nominal_windows(name: str) -> None:
    mean, least = fold_auroc(generated_set(), SCORERS[name])
    assert mean >= 0.95
    assert least >= 0.9


@pytest.mark.needs_data
def test_a_closing_valve_is_seen_better_than_by_limits(shared_data: Path) -> None:
    found = [
        valve_aurocs(path) for path in sorted((shared_data / "detection").glob("skab_valve2/*.csv"))
    ]
    means = {name: float(np.mean([one[name] for one in found])) for name in found[0]}
    assert len(found) == 4
    assert min(means[name] for name in DETECTORS) > max(means["limits"] + 0.1, 0.8)


def test_the_rows_beside_ours_are_what_they_are_called() -> None:
    given = generated_set()
    assert fold_auroc(given, SCORERS["always-on alarm"]) == (0.5, 0.5)
    assert 0.3 < fold_auroc(given, SCORERS["random score"])[0] < 0.7
    assert auroc(np.array([1.0, 2.0]), np.array([2.0, 3.0])) == 0.875
