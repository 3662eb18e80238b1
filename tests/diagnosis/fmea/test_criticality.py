"""C_m, C_r, S x O x D and the matrix: published values and values worked out by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from amberbox.diagnosis.fmea.criticality import (
    by_risk_number,
    criticalities,
    expected_failures,
    matrix,
    mode_criticality,
)
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.fmea.model import Fmea, RiskRanks
from tests.diagnosis.fmea.small import small


def of_modes(rate: float, hours: float, modes: list[tuple[float, float]]) -> Fmea:
    """Return an analysis of one component with mode ratios and betas."""
    lines = "\n".join(
        f"      m{place}: {{ratio: {alpha}, beta: {beta}, unobservable: example}}"
        for place, (alpha, beta) in enumerate(modes)
    )
    types = f"types:\n  part:\n    rate: {rate}\n    failure_modes:\n{lines}\n"
    fmea, problems = read_fmea(f"exposure_h: {hours}\n{types}")
    assert fmea is not None, problems
    return fmea


@pytest.mark.needs_data
def test_the_worked_example_of_mil_std_1629a(shared_data: Path) -> None:
    path = shared_data / "diagnosis/textbook/known_answers.json"
    known = json.loads(path.read_text())["mil_std_1629a_criticality"]
    example = known["example"]
    modes = [(mode["alpha"], mode["beta"]) for mode in example["modes"]]
    fmea = of_modes(example["lambda_p"], example["t"], modes)
    found = [mode_criticality(mode) for mode in fmea.modes.values()]
    assert found == pytest.approx(known["C_m"], rel=1e-12, abs=0)
    assert criticalities(fmea) == {"part": pytest.approx(known["C_r"], rel=1e-12)}


def test_criticality_by_hand() -> None:
    fmea = of_modes(5e-6, 20, [(0.5, 1.0), (0.25, 0.2), (0.25, 0.0)])
    found = [mode_criticality(mode) for mode in fmea.modes.values()]
    assert found == pytest.approx([5e-5, 5e-6, 0.0], rel=1e-12)
    assert criticalities(fmea)["part"] == pytest.approx(5.5e-5, rel=1e-12)
    assert criticalities(fmea, 40)["part"] == pytest.approx(1.1e-4, rel=1e-12)


def test_a_probability_counts_as_the_rate_that_gives_it() -> None:
    mode = small().modes["hook#bent"]
    assert -math.expm1(-expected_failures(mode)) == pytest.approx(0.03)
    assert expected_failures(mode, 1e6) == expected_failures(mode)


@pytest.mark.needs_data
def test_s_x_o_x_d_takes_few_values_as_published(shared_data: Path) -> None:
    path = shared_data / "diagnosis/textbook/known_answers.json"
    known = json.loads(path.read_text())["rpn"]
    numbers = _all_numbers()
    assert len(numbers) == known["distinct_values_of_SxOxD_1_to_10"]
    assert max(numbers) == known["max"]


def test_s_x_o_x_d_takes_120_values() -> None:
    assert len(_all_numbers()) == 120
    assert RiskRanks(1, 2).number is None


def _all_numbers() -> set[int]:
    ranks = range(1, 11)
    numbers = {RiskRanks(s, o, d).number for s in ranks for o in ranks for d in ranks}
    return {number for number in numbers if number is not None}


def test_the_matrix_holds_every_mode_once() -> None:
    fmea = small()
    found = matrix(fmea)
    placed = [mode for modes in found.cells.values() for mode in modes]
    assert sorted(placed) == sorted(fmea.modes)
    assert "hook#bent" in found.cells["A frequent", "urgent"]
    assert "laser_front#dead" in found.cells["C occasional", "critical"]
    assert found.columns[-1] == "fatal" and found.rows[0] == "A frequent"


def test_the_highest_number_comes_first() -> None:
    numbers = [mode.ranks.number for mode in by_risk_number(small().modes.values())]
    assert numbers == sorted(numbers, key=lambda number: -(number or 0))
