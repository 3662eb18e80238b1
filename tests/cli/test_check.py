"""``amberbox check``: problems, notes, and what would be recorded; no device is opened."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.blackbox.store.store import create_store
from amberbox.cli.main import main

pytestmark = pytest.mark.usefixtures("no_sockets")

GOOD = """\
- default_parameters: {max_frequency: 10, db_name: logs}
- ros:
    topics:
      - topic: {name: odom, type: nav_msgs/Odometry, variable_names: [position/x]}
      - topic: {name: /a/b_c, max_frequency: 3}
      - topic: {name: /a_b/c, keep: ring}
- opcua: {}
"""


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A folder that is fine."""
    (tmp_path / "robot.yaml").write_text(
        "id: r1\nmodel: ROPOD\nserver: {url: https://fleet.example, token: swordfish}\n"
    )
    (tmp_path / "black_box.yaml").write_text(GOOD)
    create_store(tmp_path / "store").next_run()  # before 'opcua' was an error
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
    assert "not built yet  opcua" in text
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
    assert report["not_built"] == ["opcua"]
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


def test_patterns_are_listed_and_triggers_may_name_their_items(
    robot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (robot / "black_box.yaml").write_text(
        "- ros:\n    topics: [{name: /odom}, {name: '/cam/**', keep: ring}, {name: /cam/*}]\n"
    )
    triggers = "triggers:\n  - {name: a, silence: ros_cam_a_b for 5s}\n"
    (robot / "robot.yaml").write_text(f"id: r1\n{triggers}")
    assert main(["check", str(robot)]) == 0
    out = capsys.readouterr().out
    assert "  ros_cam_*  /cam/**  as heard  -        ring  all" in out
    assert "note: ros.topics: '/cam/*' is not used: '/cam/**' before it matches" in out
    (robot / "robot.yaml").write_text(f"id: r1\n{triggers.replace('cam', 'lid')}")
    assert main(["check", str(robot)]) == 2
    assert "there will be no item 'ros_lid_a_b'" in capsys.readouterr().out


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


def test_trust_file(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It names who may command; what is wrong with it does not stop the recorder."""
    key = "ed25519:GUpRv5LUmx+wzUQ9eqtKoAuqOKHHiFV4MRSN0bjrrLc="
    with (robot / "robot.yaml").open("a") as file:
        file.write("commands: trust.yaml\n")
    assert main(["check", str(robot)]) == 0
    assert "trust.yaml cannot be read: No such file" in capsys.readouterr().out
    (robot / "trust.yaml").write_text(
        f"server: s1\npeople:\n  anna: {{key: '{key}', risk: moves, actions: [dokc]}}\n"
    )
    (robot / "trust.yaml").chmod(0o600)
    robot.chmod(0o755)
    (robot / "actions").mkdir()
    (robot / "actions" / "own.yaml").write_text(
        "dock: {kind: shell, command: [dock], risk: state}\n"
    )
    assert main(["check", str(robot)]) == 0
    out = capsys.readouterr().out
    assert "would take commands of server s1:\n  anna  moves  dokc\n" in out
    assert "people.anna.actions: no action is called 'dokc'; did you mean 'dock'?" in out
    (robot / "trust.yaml").write_text("server: s1\npeople: {anna: {key: x, risk: moves}}\n")
    assert main(["check", str(robot)]) == 0
    out = capsys.readouterr().out
    assert "trust.yaml:2: note: people.anna.key: a public key starts with ed25519:" in out
    assert "takes no signed command until it is right" in out


def test_images_that_cannot_be_converted_here_are_a_note(
    robot: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    black_box = robot / "black_box.yaml"
    black_box.write_text("- ros:\n    topics:\n      - {name: /a, image: {scale: 0.5}}\n")
    assert main(["check", str(robot)]) == 0
    assert "pillow" not in capsys.readouterr().out
    monkeypatch.setattr("amberbox.blackbox.robot_folder.black_box_yaml.find_spec", lambda _: None)
    assert main(["check", str(robot)]) == 0
    text = capsys.readouterr().out
    assert "black_box.yaml:3: note: ros.topics.image: images are kept as they come" in text
    assert "pip install 'amberbox[images]'" in text
