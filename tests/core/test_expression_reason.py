"""Why a condition does not hold, in words: terms with their values and limits."""

from __future__ import annotations

import numpy as np
import pytest

from amberbox.core.expression import parse, reason
from amberbox.core.samples import Samples

NOW = 10_000_000_000


def samples(**values: object) -> dict[str, Samples]:
    """Return variables of the item ``sim_battery`` with one value each."""
    found = {}
    for name, value in values.items():
        one = found[f"sim_battery.{name}"] = Samples()
        one.extend(np.array([NOW], np.int64), np.array([value]))
    return found


@pytest.mark.parametrize(
    ("text", "expected", "told"),
    [
        ("sim_battery.current < 0.3", True, "current is 0.52, below 0.3"),
        ("sim_battery.current > 0.3", False, "current is 0.52, at most 0.3"),
        ("0.6 < sim_battery.current", True, "current is 0.52, above 0.6"),
        ("0 <= sim_battery.current <= 0.5", True, "current is 0.52, at most 0.5"),
        ("not (sim_battery.cell_voltage > 4)", True, "cell voltage is 4.25, at most 4"),
        (
            "sim_battery.charging or sim_battery.current < 0.3", True,
            "charging is false; current is 0.52, below 0.3",
        ),
        (
            "sim_battery.current < 9 and sim_battery.cell_voltage < 4", True,
            "cell voltage is 4.25, below 4",
        ),
        ("sim_battery.mode == 'charge'", True, "mode is 'drive', expected 'charge'"),
        ("sim_battery.mode != 'drive'", True, "mode is 'drive', expected other than 'drive'"),
        (
            "abs(sim_battery.current) < sim_battery.cell_voltage / 100", True,
            "abs(current) is 0.52, below 0.0425 (cell voltage / 100)",
        ),
        (
            "max(sim_battery.current over 5s) < 0.3", True,
            "the max of current over 5 s is 0.52, below 0.3",
        ),
        (
            "count(sim_battery.current over 5s) > 0 and sim_battery.current > 0.3", False,
            "current is 0.52, at most 0.3",
        ),
        ("sim_battery.current < 0.3 for 2s", True, "current is 0.52, below 0.3"),
        ("sim_battery.nothing > 3", True, ""),
        (" + ".join(["sim_battery.cell_voltage"] * 20) + " < 4", True, ""),
    ],
)  # fmt: skip
def test_terms_are_told_with_values_and_limits(text: str, expected: bool, told: str) -> None:
    known = samples(current=0.52, cell_voltage=4.25, charging=False, mode="drive")
    known["sim_battery.nothing"] = Samples()
    assert reason(parse(text), known, NOW, expected=expected) == told
