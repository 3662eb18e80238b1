"""Analysers of a diagnostic_aggregator become components; what is not imported is named."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.agent.commissioning.analysers import read_analysers
from amberbox.agent.commissioning.draft import DiagnosticSign
from amberbox.cli.main import main
from amberbox.core.errors import UsageError

ROS_1 = """\
pub_rate: 1.0
analyzers:
  sensors:
    type: diagnostic_aggregator/AnalyzerGroup
    path: Sensors
    analyzers:
      hokuyo:
        type: GenericAnalyzer
        path: Hokuyo
        find_and_remove_prefix: hokuyo_node
        num_items: 3
      imu:
        type: diagnostic_aggregator/GenericAnalyzer
        path: IMU
        startswith: [imu_node, "imu (2)"]
        timeout: 3.0
        remove_prefix: imu
  motors: {type: pr2_motors/PR2MotorsAnalyzer, path: Motors}
  power:
    type: diagnostic_aggregator/GenericAnalyzer
    path: Power System
    expected: [Battery, Power board 1017]
    name: Charger
    contains: Smart
    regex: ["Fuse [0-9]+", "("]
    discard_stale: true
    timeout: -1.0
    colour: red
  nothing: {type: GenericAnalyzer, path: Nothing}
"""
ROS_2 = """\
/**:
  ros__parameters:
    path: Robot
    pub_rate: 1.0
    arms:
      type: "diagnostic_aggregator/AnalyzerGroup"
      path: Arms
      analyzers:
        left: {type: diagnostic_aggregator/GenericAnalyzer, path: Left, startswith: ["/arms/left"]}
        right: {type: diagnostic_aggregator/GenericAnalyzer, path: Left, regex: "/arms/right.*"}
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "analyzers.yaml"
    path.write_text(text)
    return path


def test_ros_1(tmp_path: Path) -> None:
    imported = read_analysers(written(tmp_path, ROS_1))
    found = {component.id: component for component in imported.draft.components}
    assert list(found) == ["sensors", "hokuyo", "imu", "power_system"]
    assert found["sensors"].parts == ("hokuyo", "imu")
    assert found["hokuyo"].diagnostics == DiagnosticSign(("^hokuyo_node",), count=3)
    assert found["imu"].diagnostics == DiagnosticSign((r"^imu_node|^imu \(2\)",), max_age_s=3.0)
    assert found["power_system"].diagnostics == DiagnosticSign(
        ("Smart|^Charger$|^(?:Fuse [0-9]+)$", "^Battery$", "^Power board 1017$"),
        max_age_s=600.0, absent_ok=True,
    )  # fmt: skip
    text = "\n".join(imported.draft.remarks)
    assert imported.plugin == "ros"
    for part in (
        "'motors' of type PR2MotorsAnalyzer is not imported", "timeout -1 is not imported",
        "'power': not imported: colour", "regex '(' cannot be used", "'nothing' names no entries",
    ):  # fmt: skip
        assert part in text


def test_ros_2(tmp_path: Path) -> None:
    imported = read_analysers(written(tmp_path, ROS_2))
    found = {component.id: component for component in imported.draft.components}
    assert (imported.plugin, list(found)) == ("ros2", ["arms", "left", "arms_left"])
    assert found["arms"].parts == ("left", "arms_left")


@pytest.mark.parametrize(("text", "block"), [(ROS_1, "ros"), (ROS_2, "ros2")])
def test_the_folder_passes_the_check(text: str, block: str, tmp_path: Path) -> None:
    place = tmp_path / "robot"
    assert main(["new", str(place), "--from", str(written(tmp_path, text))]) == 0
    assert f"- {block}:" in (place / "black_box.yaml").read_text()
    assert main(["check", str(place)]) == 0
    assert main(["fmea", "check", str(place)]) == 0


def test_components_are_added_to_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "robot"
    assert main(["new", str(place), "--from", "ros"]) == 0
    before = (place / "black_box.yaml").read_text()
    capsys.readouterr()
    words = ["new", str(place), "--from", str(written(tmp_path, ROS_1)), "--json"]
    assert main(words) == 0
    made = json.loads(capsys.readouterr().out)
    assert "components/hokuyo/diagnostics.yaml" in made["files"]
    assert "record /diagnostics in black_box.yaml" in made["remarks"]
    assert (place / "black_box.yaml").read_text() == before
    assert main(words) == 2  # nothing is written over


@pytest.mark.parametrize("text", ["", "a: 1", "analyzers: 3", "- 1", "ros__parameters: {}"])
def test_a_file_without_analysers_is_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="has no analysers"):
        read_analysers(written(tmp_path, text))
    with pytest.raises(UsageError, match="there is no file"):
        read_analysers(tmp_path / "none.yaml")
