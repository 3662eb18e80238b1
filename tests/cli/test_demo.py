"""``make demo`` works: the main job end to end, as short as it can be."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from amberbox.cli.demo import FAULT, SILENCE, SILENT
from amberbox.cli.main import main


@pytest.mark.timeout(180)
def test_the_demonstration_works_and_shows_every_step(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "amberbox", "demo", "--keep", str(tmp_path)]
    done = subprocess.run(
        command, env={"DEMO_SECONDS": "8", "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
        capture_output=True, text=True, timeout=170, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    steps = [
        "yesterday.mcap, an ordinary MCAP file",
        f"a fault begins: {FAULT}",
        f"another fault begins: {SILENCE}",
        "wheel_rear_right",  # the table of statuses
        f"ok: the monitors saw that {SILENT} has fallen silent",
        "killed with kill -9",
        "ok: the box stopped cleanly",
        "lost 0",
        "ok: every message is there once",
        "ok: what is missing lies in the gap that the record names",
        "zmq_odom",
        "fault.png",
        "messages of the recording went the same way",
    ]
    for step in steps:
        assert step in done.stdout
    assert (tmp_path / "fault.png").stat().st_size > 1000
    assert "Traceback" not in done.stderr


def test_too_short_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--seconds", "3"]) == 2
    assert "at least 8 seconds" in capsys.readouterr().err
