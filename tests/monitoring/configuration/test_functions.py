"""Which monitor a mode file means."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.monitoring.component_files import find_functions, function_of
from tests.monitoring.configuration.folders import errors, mode_of

KNOWN = ("device", "heartbeat", "state_bits", "bits", "range", "rate_of_change")


@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("device", "device"),
        ("laser_device_monitor", "device"),
        ("laser_device", "device"),
        ("front_laser_heartbeat", "heartbeat"),
        ("wheel_state_bits_monitor", "state_bits"),
        ("wheel_bits_functional_monitor", "bits"),
        ("range_functional", "range"),
        ("rate_of_change_monitor", "rate_of_change"),
        ("laser_devices", None),
        ("laserdevice", None),
        ("monitor", None),
        ("", None),
    ],
)
def test_names_mean_functions(name: str, function: str | None) -> None:
    assert function_of(name, KNOWN) == function


def test_all_monitors_that_ship_keep_the_contract(tmp_path: Path) -> None:
    functions = find_functions(tmp_path)
    assert {"device", "heartbeat", "range"} <= functions.modes.keys()
    assert "path_exists" in functions.probes
    for name in functions.modes:
        assert functions.load(name).RESULTS is not None


@pytest.mark.parametrize(
    ("head", "line", "what"),
    [
        ("name: x_hartbeat_monitor", 1, "no monitor goes by the name 'x_hartbeat_monitor'; "
         "did you mean 'heartbeat'?"),
        ("name: x\nmonitor: hartbeat", 2, "there is no monitor 'hartbeat'; "
         "did you mean 'heartbeat'?"),
    ],
)  # fmt: skip
def test_unknown_monitors(tmp_path: Path, head: str, line: int, what: str) -> None:
    text = f"{head}\nmappings:\n  - {{inputs: [/odom], outputs: [{{name: a, type: bool}}]}}\n"
    mode, problems = mode_of(tmp_path, text)
    key = "name" if line == 1 else "monitor"
    assert errors(problems) == [f"mode.yaml:{line}: {key}: {what}"]
    assert mode.problem == what
    assert [o.name for m in mode.mappings for o in m.outputs] == ["a"], "its outputs are known"
