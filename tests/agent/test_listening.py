"""``amberbox doctor --listen``: what sources hear, without a record."""

from __future__ import annotations

import json
import sys
import threading
from pathlib import Path

import pytest

from amberbox.agent.doctor.listening import HeardTopic, MissingTopic, UnrecordedTopic, listen
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli.main import main
from amberbox.testing.clock import PATIENCE_S
from tests.support.planted_source import plant
from tests.support.talkative_source import HOSTILE


@pytest.fixture(autouse=True)
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(
        tmp_path / "site", monkeypatch,
        talkative="tests.support.talkative_source", planted="tests.support.planted_source",
    )  # fmt: skip


def robot(place: Path, black_box: str) -> Path:
    folder = place / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: r\n")
    (folder / "black_box.yaml").write_text(black_box)
    return folder


def test_everything_that_a_source_reports_is_counted(tmp_path: Path) -> None:
    topics = "topics: [{name: /odom}, {name: /idel}, {name: '/cam/*'}]"
    folder = robot(tmp_path, f"- talkative: {{{topics}}}\n")
    (found,) = listen(load_folder(folder), PATIENCE_S, threading.Event())
    odom = HeardTopic(
        "/odom", "test/Stamped", messages=5, rate_hz=2.0, bytes=40, mean_bytes=8, stamp_age_s=0.5,
        peers=("/robot",), down=("/gone: it left",), lost=7,
    )  # fmt: skip
    assert [topic.name for topic in found.topics] == [HOSTILE, "/odom"]
    assert found.topics[1] == odom
    assert found.topics[0].messages == 1 and found.topics[0].stamp_age_s is None
    assert (found.connected, found.trouble) == (True, "")
    assert found.passive == "says hello as box_2"
    assert found.sent == ("3 greetings",)
    assert found.not_recorded == (
        UnrecordedTopic("/advertised", "", ()), UnrecordedTopic("/idle", "a/B", ("/n",)),
    )  # fmt: skip
    assert found.not_published == (MissingTopic("/idel", "/idle"), MissingTopic("/cam/*", ""))
    assert found.events[0][0] == "malformed"
    assert len(found.events) == 50 and found.more_events == 11
    assert not found.is_fine
    assert sorted(path.name for path in folder.iterdir()) == ["black_box.yaml", "robot.yaml"]


def test_a_source_that_fails_and_a_process_that_dies_leave_the_others_alone(
    tmp_path: Path,
) -> None:
    blocks = "- talkative: {fails: no such device}\n- planted: {after: 5, death: abort}\n"
    folder = load_folder(robot(tmp_path, blocks))
    failed, died = listen(folder, PATIENCE_S, threading.Event())
    assert (failed.connected, failed.trouble) == (True, "no such device")
    assert "SIGABRT" in died.trouble
    assert [(topic.name, topic.messages) for topic in died.topics] == [("/count", 5)]
    assert not failed.is_fine and not died.is_fine


def test_the_report_is_for_people_and_programs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = robot(tmp_path, "- talkative: {}\n")
    assert main(["doctor", str(folder), "--listen", "60"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("talkative: connected\n  sends: says hello as box_2\n")
    assert "\x1b" not in shown and "/evil \\u001b[2J" in shown
    (row,) = [line.split() for line in shown.splitlines() if line.startswith("  /odom")]
    assert row[:9] == ["/odom", "test/Stamped", "5", "2.0", "8", "B", "500.0", "ms", "7"]
    assert "  event: 41 more" in shown
    assert main(["doctor", str(folder), "--listen", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert found["topics"][1]["rate_hz"] == 2.0 and found["sent"] == ["3 greetings"]


@pytest.mark.parametrize("seconds", ["0", "2 h", "soon"])
def test_a_wrong_time_is_wrong_usage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], seconds: str
) -> None:
    assert main(["doctor", str(robot(tmp_path, "- talkative: {}\n")), "--listen", seconds]) == 2
    assert seconds in capsys.readouterr().err


def test_it_listens_until_it_is_stopped(tmp_path: Path) -> None:
    stop = threading.Event()
    folder = load_folder(robot(tmp_path, "- zmq: {endpoint: 'tcp://127.0.0.1:9', topics: []}\n"))
    threading.Timer(0.2, stop.set).start()
    (found,) = listen(folder, PATIENCE_S, stop)
    assert not found.connected and found.trouble


def test_a_missing_library_and_a_folder_without_sources_are_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "zmq", None)
    folder = robot(tmp_path, "- zmq: {endpoint: 'tcp://127.0.0.1:9'}\n")
    (found,) = listen(load_folder(folder), PATIENCE_S, threading.Event())
    assert (found.connected, "zmq" in found.trouble) == (False, True)
    (folder / "black_box.yaml").write_text("- default_parameters: {max_frequency: 5}\n")
    assert main(["doctor", str(folder), "--listen"]) == 2
    assert "names no source to listen to" in capsys.readouterr().err
