"""Inputs that are rows of a child table, from the file to the output."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from amberbox.core.clock import NS
from amberbox.core.types import Batch, Column, ItemSchema
from amberbox.monitoring.engine import Engine
from tests.monitoring.configuration.folders import errors, mode_files, plan_of

BLACK_BOX = "- ros: {topics: [{name: /parser/data, type: own_msgs/Wheels}]}\n"
BATTERY = """\
name: battery_functional_monitor
mappings:
    - mapping:
        inputs: []
        outputs:
            - output: {name: battery_percentage, type: float}
            - output: {name: battery_ok, type: bool}
arguments:
    lowest_voltage: 20.0
    highest_voltage: 30.0
    variable_name_pattern: ros_parser_data/sensors/*/voltage_bus
    number_of_wheels: 2
"""
STATUS = """\
name: smart_wheel_status_monitor
mappings:
    - mapping:
        inputs: []
        outputs:
            - output: {name: wheel_1, type: bool}
            - output: {name: wheel_2, type: bool}
arguments:
    variable_name_pattern: ros_parser_data/sensors/*/status1
    number_of_wheels: 2
"""
T0_NS = 1_790_000_000 * NS


def _message(second: int, wheels: Sequence[tuple[float, float]]) -> Batch:
    """Make one message: bus voltage and status word of each wheel."""
    names = ("voltage_bus", "status1")
    schema = ItemSchema("wheel", tuple(Column(name, name, "float64") for name in names))
    time_ns = np.array([T0_NS + second * NS])
    place = ("watch", 1)
    times = np.repeat(time_ns, len(wheels))
    columns = {name: np.array([wheel[k] for wheel in wheels]) for k, name in enumerate(names)}
    keys = {"parent_seq": np.repeat(second, len(wheels)), "index": np.arange(len(wheels))}
    seq = np.arange(len(wheels))
    sensors = Batch(
        "ros_parser_data__sensors", schema, *place, seq, times, times, times, {**keys, **columns}
    )
    whole = ItemSchema("own_msgs/Wheels", (), {"sensors": schema})
    seq = np.array([second])
    return Batch(
        "ros_parser_data", whole, *place, seq, time_ns, time_ns, time_ns, {}, {"sensors": sensors}
    )


@pytest.mark.parametrize(
    ("wheels", "expected"),
    [
        ([(25.0, 1.0), (27.0, 1.0)], {"wheel_1": True, "wheel_2": True}),
        ([(25.0, 1.0), (27.0, 2.0)], {"wheel_1": True, "wheel_2": False}),
        ([(25.0, 2.0), (27.0, 1.0)], {"wheel_1": False, "wheel_2": True}),
    ],
)
def test_each_row_is_an_input(
    tmp_path: Path, wheels: Sequence[tuple[float, float]], expected: dict[str, bool]
) -> None:
    files = {**mode_files(BATTERY), "mode2.yaml": STATUS}
    files["part.yaml"] = "component_name: part\nmodes: [mode.yaml, mode2.yaml]\n"
    plan, problems = plan_of(tmp_path, files, BLACK_BOX)
    assert errors(problems) == []
    engine = Engine(plan)
    engine.begin(T0_NS)
    for second in range(1, 4):
        engine.feed(_message(second, wheels))
    engine.advance(T0_NS + 3 * NS)
    statuses = {status.mode: status for status in engine.statuses()}
    battery = statuses["battery_functional_monitor"]
    assert battery.outputs["battery_percentage"] == pytest.approx(60.0)
    assert (battery.level, battery.outputs["battery_ok"]) == ("ok", True)
    assert dict(statuses["smart_wheel_status_monitor"].outputs) == expected
