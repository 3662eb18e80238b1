"""Temperatures of thermal zones and of hwmon, as kernels lay them out."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.errors import AmberboxError
from amberbox.core.host import temperatures
from amberbox.core.probe import Measured
from amberbox.monitoring.probes.temperature import judge


@pytest.fixture
def root(tmp_path: Path) -> Path:
    files(tmp_path / "thermal" / "thermal_zone0", type="acpitz", temp="27800",
          trip_point_0_type="active", trip_point_0_temp="71000",
          trip_point_1_type="critical", trip_point_1_temp="119000")  # fmt: skip
    files(tmp_path / "thermal" / "thermal_zone1", type="broken")
    files(tmp_path / "hwmon" / "hwmon0", name="coretemp",
          temp1_label="Package id 0", temp1_input="61000", temp1_crit="100000",
          temp2_label="Core 0", temp2_input="58000", temp2_crit="100000")  # fmt: skip
    files(tmp_path / "hwmon" / "hwmon1", name="nvme",
          temp1_input="84850", temp1_crit="84850",
          temp2_input="40000", temp2_crit="65261850")  # fmt: skip
    return tmp_path


def files(place: Path, **texts: str) -> None:
    place.mkdir(parents=True)
    for name, text in texts.items():
        (place / name).write_text(f"{text}\n")


def look(root: Path, subject: str) -> Measured:
    return judge(list(temperatures(root)), subject)


@pytest.mark.parametrize(
    ("subject", "ok", "celsius", "critical", "sensor"),
    [
        ("acpitz", True, 27.8, 119.0, "acpitz"),
        ("coretemp", True, 61.0, 100.0, "coretemp/Package id 0"),
        ("coretemp/Core 0", True, 58.0, 100.0, "coretemp/Core 0"),
        ("nvme", False, 84.85, 84.85, "nvme/temp1"),
        ("nvme/temp2", True, 40.0, None, "nvme/temp2"),
        ("hottest", False, 84.85, 84.85, "nvme/temp1"),
    ],
)
def test_the_hottest_of_the_name_is_read(
    root: Path, subject: str, ok: bool, celsius: float, critical: float | None, sensor: str
) -> None:
    assert look(root, subject) == {
        "ok": ok,
        "celsius": celsius,
        "critical_celsius": critical,
        "sensor": sensor,
    }


def test_a_sensor_that_is_missing_or_does_not_answer_is_unknown(root: Path) -> None:
    with pytest.raises(AmberboxError) as refused:
        look(root, "broken")
    assert refused.value.what == (
        "there is no temperature 'broken'; known: acpitz, coretemp/Core 0, "
        "coretemp/Package id 0, nvme/temp1, nvme/temp2"
    )


def test_without_sensors_nothing_is_known(tmp_path: Path) -> None:
    with pytest.raises(AmberboxError, match="known: none"):
        look(tmp_path, "hottest")
