"""The record of the simulated robot: columns with units, codes with names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import amberbox
from amberbox.cli.main import main
from amberbox.core.types import Column
from amberbox.testing.records import T0_NS, FakeItem, FakeRun

BLOCK = """\
- sim:
    speed: max
    duration_s: 1.2
    topics: [{name: battery}, {name: log}, {name: wheels}, {name: imu}]
"""


def record(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "robot.yaml").write_text("id: r\n")
    (folder / "black_box.yaml").write_text(BLOCK)
    assert main(["record", str(folder), "--quiet"]) == 0
    return folder


def fields(folder: Path, item: str) -> dict[str, Column]:
    return {column.name: column for column in amberbox.open(folder).query(item).fields}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("sim") / "robot")


def test_variables_have_the_units_of_the_catalogue(folder: Path) -> None:
    assert {name: column.unit for name, column in fields(folder, "sim_battery").items()} == {
        "timestamp": "", "header_seq": "", "header_stamp_sec": "s", "header_stamp_nanosec": "ns",
        "header_frame_id": "", "voltage": "V", "current": "A", "percentage": "%",
        "temperature": "°C", "charging": "", "charger_voltage": "V", "cell_voltage": "V",
    }  # fmt: skip
    assert fields(folder, "sim_imu")["linear_acceleration_x"].unit == "m/s^2"


def test_codes_have_names(folder: Path) -> None:
    assert fields(folder, "sim_log")["level"].labels[40] == "error"
    status = fields(folder, "sim_wheels")["sensors_rear_left_status1"]
    assert (status.type, status.labels[3], status.unit) == ("int64", "on", "")


def test_nobody_is_told_of_a_schema_that_is_the_first(folder: Path) -> None:
    kinds = np.asarray(amberbox.open(folder).events().columns["kind"]).tolist()
    assert "stopped" in kinds and "schema_widened" not in kinds


def test_a_record_that_began_without_units_goes_on_with_them(tmp_path: Path) -> None:
    folder = tmp_path / "robot"
    old = FakeItem("sim_battery", [{"voltage": 24.5}], topic="battery", source="sim")
    run = FakeRun(folder / "store", items=[old])
    run.write([(T0_NS, old, {"voltage": 24.5})])
    run.close()
    table = amberbox.open(record(folder)).query("sim_battery", ["voltage"])
    assert len(table) > 1
    assert 24.5 in np.asarray(table.columns["voltage"]).tolist()
    assert {column.name: column.unit for column in table.fields}["voltage"] == "V"
