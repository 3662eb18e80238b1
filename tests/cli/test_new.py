"""``amberbox new``: its files pass the check, and existing files are not overwritten."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.blackbox.robot_folder.folder import SOURCES, load_folder
from amberbox.cli.main import main
from amberbox.core.plugins import find


@pytest.mark.parametrize("source", sorted(find(SOURCES, defines=("Config", "Source"))))
def test_the_new_folder_passes_the_check(source: str, tmp_path: Path) -> None:
    place = tmp_path / "My Robot"
    assert main(["new", str(place), "--from", source]) == 0
    built = load_folder(place)
    assert built.robot.id == "my_robot"
    assert [block.plugin for block in built.blocks] == [source]
    files = ("recording.path", "status.where", "can.dbc", "can.nodes")
    not_there_yet = [n for n in built.notes if n.where in files]
    others = source in ("recording", "status", "can")
    assert built.notes == tuple(not_there_yet) and bool(not_there_yet) == others
    assert main(["check", str(place)]) == 0


def test_files_are_commented(tmp_path: Path) -> None:
    assert main(["new", str(tmp_path / "r"), "--from", "ros"]) == 0
    for name in ("robot.yaml", "black_box.yaml"):
        assert (tmp_path / "r" / name).read_text().startswith("# ")


def test_the_simulated_robot_comes_with_its_monitors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "r"
    assert main(["new", str(place)]) == 0
    printed = capsys.readouterr().out
    assert "black_box.yaml and components and " in printed
    assert f"and beside it amberbox watch {place}" in printed
    assert (place / "components" / "laser_front" / "heartbeat.yaml").is_file()
    assert main(["check", str(place)]) == 0
    assert "wheel_rear_right" in capsys.readouterr().out
    assert main(["new", str(place)]) == 2
    assert "black_box.yaml and components and " in capsys.readouterr().err


def test_nothing_is_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "black_box.yaml").write_text("mine")
    assert main(["new", str(tmp_path), "--from", "ros"]) == 2
    assert "has black_box.yaml already, nothing was written" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["black_box.yaml"]
    assert (tmp_path / "black_box.yaml").read_text() == "mine"


def test_a_file_is_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "f"
    path.write_text("")
    assert main(["new", str(path), "--from", "ros"]) == 2
    assert "is a file" in capsys.readouterr().err


def test_unknown_source(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["new", str(tmp_path / "r"), "--from", "rso"]) == 2
    assert "there is no source 'rso'; did you mean 'ros'?" in capsys.readouterr().err
    assert not (tmp_path / "r").exists()


def test_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["new", str(tmp_path / "r"), "--from", "ros", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["files"] == [
        "black_box.yaml", "foxglove-layout.json", "robot.yaml",
    ]  # fmt: skip
    layout = json.loads((tmp_path / "r" / "foxglove-layout.json").read_text())
    plots = [one for name, one in layout["configById"].items() if name.startswith("Plot!")]
    assert [[line["value"] for line in plot["paths"]] for plot in plots] == [
        ["/odom.pose.pose.position.x", "/odom.pose.pose.position.y"]
    ]
