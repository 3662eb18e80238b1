"""Processors, memory, disks and temperatures against their limits."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from amberbox.core.mode import FALSE, HOLD, TRUE, UNKNOWN
from amberbox.monitoring.modes import host as mode
from amberbox.monitoring.modes.host import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input


def test_contract() -> None:
    parts = dict.fromkeys(("percent", "used_percent", "celsius"), "float")
    configs = [Config(cpu=1.0, window=1.0)]
    assert_mode_contract(mode, "host", configs=configs, parts=parts)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("cpu", ("cpu", "all")), ("cpu cpu3", ("cpu", "cpu3")), ("memory", ("memory", "ram")),
     ("swap", ("memory", "swap")), ("disk /data", ("disk", "/data")), ("disk", ("disk", "/")),
     ("temperature coretemp/Core 0", ("temperature", "coretemp/Core 0")),
     ("temperature", ("temperature", "hottest"))],
)  # fmt: skip
def test_inputs_name_probes_that_measure_the_figure(text: str, expected: tuple[str, str]) -> None:
    assert mode.probe_of(Config(), text) == expected
    figure = {"cpu": "percent", "temperature": "celsius"}.get(expected[0], "used_percent")
    probe = importlib.import_module(f"amberbox.monitoring.probes.{expected[0]}")
    assert figure in probe.MEASURES


@pytest.mark.parametrize(
    ("text", "part", "limit"),
    [("cpu", "percent", 95), ("memory", "used_percent", 90), ("swap", "used_percent", 50),
     ("disk /", "used_percent", 90), ("temperature hottest", "celsius", 85)],
)  # fmt: skip
def test_every_figure_has_its_limit(text: str, part: str, limit: float) -> None:
    for value, expected in [(limit - 3, TRUE), (limit - 1, HOLD), (limit + 1, FALSE)]:
        entry = one_input(text, times_s=[0], values=[True], parts={part: [value]})
        found = mode.evaluate(Config(), [entry], at_s(0))
        assert (int(found["ok"]), float(found["value"])) == (expected, value)


def test_the_mean_counts_and_a_short_peak_does_not() -> None:
    peak = [20.0] * 8 + [100.0] * 2
    full = [100.0] * 10
    for shown, expected in ((peak, TRUE), (full, FALSE)):
        entry = one_input("cpu", times_s=range(10), values=[True] * 10, parts={"percent": shown})
        assert int(mode.evaluate(Config(), [entry], at_s(9))["ok"]) == expected


def test_a_disk_that_cannot_be_written_is_not_well_however_empty() -> None:
    entry = one_input("disk /", times_s=[0], values=[False], parts={"used_percent": [10.0]})
    assert int(mode.evaluate(Config(), [entry], at_s(0))["ok"]) == FALSE


def test_what_could_not_be_measured_is_unknown() -> None:
    entry = one_input("cpu", times_s=[0, 1], values=[None, True], parts={"percent": [None, None]})
    found = mode.evaluate(Config(), [entry], at_s(0, 1))
    assert found["ok"].tolist() == [UNKNOWN, UNKNOWN]
    assert np.isnan(found["value"]).all()


def test_explanations_and_refusals() -> None:
    assert mode.explain(Config(), {"ok": False, "value": 97.2}) == "it is at 97"
    assert "not well" in mode.explain(Config(), {"ok": False, "value": None})
    assert mode.explain(Config(), {"ok": None, "value": None}) == ""
    assert list(Config(window=0).check())
    assert list(Config(hysteresis=-1).check())
