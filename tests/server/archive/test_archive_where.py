"""The command line takes an archive for WHERE, whole or one robot of it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from amberbox.cli.main import main
from amberbox.server.archive.folder import FolderArchive
from tests.server.archive.recordings import Robot


@pytest.fixture
def folder(archive: FolderArchive, tmp_path: Path) -> Path:
    """An archive of two robots."""
    for name, start in (("r1", 0), ("r2", 100)):
        robot = Robot(name, tmp_path)
        robot.record(start, files=1, rows=2)
        robot.hand_in_all(archive)
    archive.commit()
    return archive.layout.folder


def _printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> list[dict[str, object]]:
    assert main(list(arguments)) == 0
    rows: list[dict[str, object]] = json.loads(capsys.readouterr().out)
    return rows


def test_all_robots_of_a_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = _printed(capsys, "query", str(folder), "battery", "volts", "--json")
    told = sorted((str(row["robot"]), row["volts"]) for row in rows)
    assert told == [("r1", 0.0), ("r1", 0.125), ("r2", 12.5), ("r2", 12.625)]


def test_one_robot_of_a_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = str(folder / "journals" / "r2")
    rows = _printed(capsys, "query", where, "odom", "pose_x", "--json")
    assert [row["pose_x"] for row in rows] == [100.0, 101.0]
    statement = "select count(*) n from odom where robot = 'r2'"
    assert _printed(capsys, "sql", where, statement, "--json") == [{"n": 2}]
    assert [item["name"] for item in _printed(capsys, "items", where, "--json")][:2] == [
        "battery", "odom",
    ]  # fmt: skip
    assert _printed(capsys, "gaps", where, "--json") == []


def test_a_robot_that_is_not_there(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["query", str(folder / "journals" / "r3"), "odom"]) == 2
    assert "there are: r1, r2" in capsys.readouterr().err


def test_without_what_servers_have_installed_it_says_so(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "amberbox.server.archive.record", None)
    assert main(["query", str(folder), "odom"]) == 2
    assert "pip install 'amberbox[server]'" in capsys.readouterr().err
