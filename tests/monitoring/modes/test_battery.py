"""Charge from voltages and percentages, time to empty, and what cannot be a charge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import nan
from pathlib import Path

import numpy as np
import pytest

from amberbox.core.mode import FALSE, HOLD, TRUE, UNKNOWN, Input
from amberbox.core.samples import Samples
from amberbox.monitoring.modes import battery as mode
from amberbox.monitoring.modes.battery import Config
from amberbox.testing.modes import assert_mode_contract, at_s, mode_file, one_input

ROPOD = Config(empty=5.0, full=30.0)


def wheels(*volts: float | None) -> list[Input]:
    return [one_input(f"wheel_{k}", times_s=[0], values=[v]) for k, v in enumerate(volts)]


def test_contract() -> None:
    assert_mode_contract(mode, "battery", configs=[Config(empty=0, full=1, window=2)])


def test_the_predecessors_names_of_the_voltages_are_understood() -> None:
    assert mode_file(mode, "battery").config == Config(empty=20.0, full=28.0)


@pytest.mark.parametrize(
    ("volts", "charge", "ok"),
    [(30.0, 100, TRUE), (17.5, 50, TRUE), (10.6, 22.4, TRUE), (10.2, 20.8, HOLD),
     (9.9, 19.6, FALSE), (5.0, 0, FALSE), (30.5, 100, TRUE)],
)  # fmt: skip
def test_charge_lies_between_the_voltages(volts: float, charge: float, ok: int) -> None:
    found = mode.evaluate(ROPOD, wheels(volts, volts, volts, volts), at_s(0))
    assert found["charge_percent"] == pytest.approx(charge)
    assert int(found["ok"]) == ok
    assert found["plausible"]


@pytest.mark.parametrize("volts", [4.0, 3.0, 0.0, -20.0, 31.5, 48.0, nan])
def test_nothing_is_well_at_voltages_that_cannot_be(volts: float) -> None:
    found = mode.evaluate(ROPOD, wheels(volts), at_s(0))
    assert int(found["ok"]) == FALSE
    if volts != 4.0:
        assert not found["plausible"]
        assert np.isnan(found["charge_percent"])


def test_one_wheel_that_shows_nonsense_takes_nothing_away() -> None:
    for nonsense in (nan, 0.0, 1e30, None):
        found = mode.evaluate(ROPOD, wheels(25.0, 25.2, nonsense, 25.1), at_s(0))
        assert found["charge_percent"] == pytest.approx(80.3, abs=0.5)
        assert int(found["ok"]) == TRUE


def test_without_any_value_it_is_not_known() -> None:
    found = mode.evaluate(ROPOD, wheels(None, None), at_s(0))
    assert int(found["ok"]) == int(found["plausible"]) == UNKNOWN


def series(values: Sequence[float]) -> list[Input]:
    return [one_input("battery.percentage", times_s=range(len(values)), values=values)]


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_time_to_empty_follows_from_the_discharge(noise: float) -> None:
    """From 80 % at 36 % per hour: 0.01 % per second, after ten minutes 74 % or 7400 s are left."""
    seconds = np.arange(601)
    shown = 80 - 0.01 * seconds + np.random.default_rng(1).normal(0, noise, 601)
    found = mode.evaluate(Config(), series(shown.tolist()), at_s(300, 599.9, 600))
    assert np.isnan(found["time_to_empty_s"][:2]).all(), "the window is not full yet"
    assert found["time_to_empty_s"][2] == pytest.approx(7400, rel=0.001 if not noise else 0.15)


def test_nobody_knows_when_a_battery_is_empty_that_is_charged_or_rests() -> None:
    rising = mode.evaluate(Config(), series([50 + 0.01 * k for k in range(700)]), at_s(650))
    resting = mode.evaluate(Config(), series([50.0] * 700), at_s(650))
    assert np.isnan(rising["time_to_empty_s"])
    assert np.isnan(resting["time_to_empty_s"])


def test_frames_of_zeros_do_not_empty_it() -> None:
    values = [80 - 0.01 * k for k in range(601)]
    values[100] = values[400] = values[590] = 0.0
    found = mode.evaluate(Config(), series(values), at_s(600))
    assert found["time_to_empty_s"] == pytest.approx(7400, rel=0.02)


def test_explanations() -> None:
    low = {"ok": False, "plausible": True, "charge_percent": 12.0}
    assert mode.explain(Config(), low) == "12 % are left, below 20 % it is low"
    absurd = {"ok": False, "plausible": False, "charge_percent": None}
    assert "far below empty" in mode.explain(Config(), absurd)
    assert mode.explain(Config(), {"ok": None, "plausible": None, "charge_percent": None}) == ""


@pytest.mark.parametrize(
    "config",
    [
        Config(empty=5, full=5),
        Config(low=101),
        Config(hysteresis=-1),
        Config(window=0),
        Config(smoothing=-1),
    ],
)
def test_what_gives_no_percentage_is_refused(config: Config) -> None:
    assert list(config.check())


@pytest.mark.needs_data
def test_the_real_robot_was_at_about_80_percent(shared_data: Path, tmp_path: Path) -> None:
    import amberbox
    from amberbox.blackbox.formats._recording import ReadOptions
    from amberbox.blackbox.query.importing import import_recordings

    options = ReadOptions(messages=shared_data / "ropod/message_definitions")
    dump = shared_data / "ropod/bb_test_data"
    import_recordings([dump], tmp_path, options=options, segments=False)
    with amberbox.open(tmp_path) as record:
        table = record.query("ros_sw_ethercat_parser_data__sensors", ["voltage_bus"])
        times = np.asarray(table["timestamp"]).astype(np.int64).reshape(-1, 4)
        volts = np.asarray(table["voltage_bus"], np.float64).reshape(-1, 4)
    inputs = [Input(f"wheel_{k}", Samples()) for k in range(4)]
    for k, entry in enumerate(inputs):
        entry.samples.extend(times[:, k], volts[:, k])
    found = mode.evaluate(ROPOD, inputs, times[:, 0])
    theirs = (volts.mean(axis=1) - 5.0) / 25.0 * 100
    assert np.median(found["charge_percent"]) == pytest.approx(np.median(theirs), abs=0.5)
    assert np.nanmin(found["charge_percent"]) > 75
    assert np.all(found["ok"] == TRUE), "a frame of zeros is no empty battery"
    assert np.any(mode.evaluate(replace(ROPOD, smoothing=0.0), inputs, times[:, 0])["ok"] == FALSE)
