"""``amberbox doctor``: its report for people and programs, also while recording."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.agent.doctor.subject import DoctorFinding, error, ok, warn
from amberbox.cli.doctor import report
from amberbox.cli.main import main
from tests.support.manual_recorder import recording


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "robot"
    made.mkdir()
    (made / "robot.yaml").write_text("id: r\nstore: {min_free: 0, quota_percent: 100}\n")
    (made / "black_box.yaml").write_text("- sim:\n    topics: [{name: odom}]\n")
    return made


def test_the_report_lines_up() -> None:
    findings = [ok("clock", "right"), warn("wear", "fast", "slow down"), error("keys", "open", "x")]
    assert list(report(findings)) == [
        "ok     clock  right",
        "warn   wear   fast",
        "              hint: slow down",
        "error  keys   open",
        "              hint: x",
        "1 ok, 1 warn, 1 error",
    ]


def test_it_works_while_recording(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with recording(folder) as recorder:
        while not recorder.pipeline.bytes_written:
            recorder.stop.wait(0.01)
        assert main(["doctor", str(folder), "--json"]) == 0
    findings = [DoctorFinding(**finding) for finding in json.loads(capsys.readouterr().out)]
    levels = {finding.check: finding.level for finding in findings}
    assert levels["configuration"] == levels["source sim"] == levels["recorder"] == "ok"
    assert all(finding.hint for finding in findings if finding.level != "ok")
    assert {"clock", "free space", "file system", "wear", "disk latency", "keys"} <= levels.keys()
    assert {"service", "power", "versions", "real-time clock"} <= levels.keys()


def test_an_error_is_exit_status_1(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "black_box.yaml").write_text("- sim: {sed: 1}\n")
    assert main(["doctor", str(folder)]) == 1
    shown = capsys.readouterr().out
    assert shown.startswith("error  configuration")
    assert shown.rstrip().endswith("1 error")


def test_no_folder_is_wrong_usage(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", str(folder / "nowhere")]) == 2
    assert "there is no folder or file" in capsys.readouterr().err
