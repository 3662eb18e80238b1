"""``amberbox check``: problems, notes, and what would be recorded; no device is opened."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.cli.main import main

pytestmark = pytest.mark.usefixtures("no_sockets")

GOOD = """\
- default_parameters: {max_frequency: 10, db_name: logs}
- ros:
    topics:
      - topic: {name: odom, type: nav_msgs/Odometry, variable_names: [position/x]}
      - topic: {name: /a/b_c, max_frequency: 3}
      - topic: {name: /a_b/c, keep: ring}
- zyre: {}
"""


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A folder that is fine."""
    (tmp_path / "robot.yaml").write_text(
        "id: r1\nmodel: ROPOD\nserver: {url: https://fleet.example, token: swordfish}\n"
    )
    (tmp_path / "black_box.yaml").write_text(GOOD)
    return tmp_path


def test_fine(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(robot)]) == 0
    text = capsys.readouterr().out
    lines = {line.split()[0]: line.split() for line in text.splitlines() if line.strip()}
    assert lines["robot"] == ["robot", "r1", "ROPOD"]
    assert lines["ros_odom"] == [
        "ros_odom", "/odom", "nav_msgs/Odometry", "10", "Hz", "all", "1",
    ]  # fmt: skip
    assert lines["ros_a_b_c"][1:] == ["/a/b_c", "as", "heard", "3", "Hz", "all", "all"]
    assert "not built yet  zyre" in text
    assert "note: default_parameters.db_name: ignored, use robot.yaml store.path" in text
    assert text.endswith(": fine\n")


def test_json(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(robot), "--json"]) == 0
    out = capsys.readouterr().out
    report = json.loads(out)
    assert report["ok"] is True
    server = report["robot"]["server"]
    assert (server["url"], server["token"]) == ("https://fleet.example", "***")
    assert "swordfish" not in out
    assert report["not_built"] == ["zyre"]
    assert len(report["config_hash"]) == 64
    names = [item["item"] for item in report["items"]]
    assert names[:2] == ["ros_odom", "ros_a_b_c"]
    assert names[2].startswith("ros_a_b_c_"), "names that would collide stay apart"
    assert report["items"][2]["keep"] == "ring"
    assert [problem["is_error"] for problem in report["problems"]] == [False, False, False]


def test_wrong(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (robot / "black_box.yaml").write_text("- ros:\n    topcs: []\n- rso: {}\n")
    assert main(["check", str(robot)]) == 2
    text = capsys.readouterr().out
    assert "black_box.yaml:2: ros: unknown key 'topcs'; did you mean 'topics'?" in text
    assert "black_box.yaml:3: rso: there is no source 'rso'; did you mean 'ros'?" in text
    assert text.endswith("2 errors, 1 note\n")
    assert main(["check", str(robot), "--json"]) == 2
    report = json.loads(capsys.readouterr().out)
    assert report["ok"] is False
    errors = [problem["line"] for problem in report["problems"] if problem["is_error"]]
    assert errors == [2, 3]


def test_sources_without_topics_record_what_they_hear(
    robot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (robot / "black_box.yaml").write_text("- ros: {all_topics: true}\n")
    assert main(["check", str(robot)]) == 0
    assert "ros: everything it hears" in capsys.readouterr().out


def test_single_file_and_nothing(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(robot / "black_box.yaml")]) == 0
    assert main(["check", str(robot / "absent")]) == 2
    assert "there is no folder or file" in capsys.readouterr().err


def test_a_recording_that_is_not_there_yet_is_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "here.mcap").touch()
    text = "- recording:\n    speed: 2\n    paths: [here.mcap, '*.bag', a**b, gone.mcap]\n"
    (tmp_path / "black_box.yaml").write_text(text)
    assert main(["check", str(tmp_path), "--json"]) == 0
    problems = json.loads(capsys.readouterr().out)["problems"]
    found = [(p["line"], p["what"]) for p in problems if p["where"] == "recording.paths"]
    assert found == [
        (3, f"there is no recording at {tmp_path / name} yet")
        for name in ("*.bag", "a**b", "gone.mcap")
    ]
    assert not any(problem["is_error"] for problem in problems)
    (tmp_path / "x.bag").touch()
    (tmp_path / "black_box.yaml").write_text("- recording: {path: '*.bag'}\n")
    assert main(["check", str(tmp_path)]) == 0
    assert "there is no recording" not in capsys.readouterr().out
