"""``amberbox demo``: the story against a real server, and the recorder's own demonstration."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

from amberbox.cli.main import main
from amberbox.demo.recorder import FAULT, SLOW, SLOWED
from amberbox.demo.story import CAUSE
from amberbox.testing.clock import wait_until
from tests.support.processes import command

STORY = [
    "4 people signed in by their links; none works a second time",
    "ropod_001, ropod_002, ropod_003 are online and well",
    "symptom after",
    "alarm after",
    f"diagnosis after .* {CAUSE}",
    "next test after .* Pull gently at the fieldbus plug",
    "is acknowledged",
    "the plug is off",
    "ropod_001 is repaired",
    "pivot_check is proposed after .* wheel_front_left#pivot_offset",
    "pivot_check is started by one request",
    "the motion is signed, and confirmed at the robot",
    "ropod_002 has driven 30 cm",
    "it has passed",
    "the causes are ranked anew: wheel_front_left#motor_weak",
    r"from the fault to the new ranking: [\d.]+ s \(aim: 20 s",
    "bus was well again",
    "ropod_003 went offline",
    "ropod_003 came back",
    "rows of sim_odom of that time are here",
    "ropod_002 goes on with its deliveries",
    "working_counter show the fault",
    "downloaded .*csv",
    "pages and the .* files they are made of answer 200",
    "all .* steps worked",
]
RECORDER = [
    "yesterday.mcap, an ordinary MCAP file",
    f"a fault begins: {FAULT}",
    f"another fault begins: {SLOW}",
    "wheel_rear_right",  # the table of statuses
    f"ok: the monitors saw that the motor of {SLOWED} is slow",
    "killed with kill -9",
    "ok: the box stopped cleanly",
    f"ok: {SLOWED}#motor_slow is to blame first of all",
    "lost 0",
    "ok: every message is there once",
    "ok: what is missing lies in the gap that the record names",
    "zmq_odom",
    "fault.png",
    "messages of the recording went the same way",
]


def demo(home: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(home), "TMPDIR": str(home)}
    return subprocess.run(
        command("demo", *words), env=environment, stdin=subprocess.DEVNULL,
        capture_output=True, text=True, timeout=290, check=False,
    )  # fmt: skip


@pytest.mark.alone
@pytest.mark.timeout(300)
def test_the_story_goes_through_by_itself_and_leaves_nothing_behind(tmp_path: Path) -> None:
    done = demo(tmp_path, "--seconds", "30", "--port", "18443")
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(".*".join(STORY), done.stdout, re.DOTALL), done.stdout
    assert "Traceback" not in done.stderr
    assert list(tmp_path.glob("amberbox-demo-*")) == []
    # what a recorder had started notices its end by itself
    wait_until(lambda: not still_running(tmp_path), "no process is left")


@pytest.mark.alone
@pytest.mark.timeout(180)
def test_the_recorder_alone_loses_nothing_when_it_is_killed(tmp_path: Path) -> None:
    done = demo(tmp_path, "--recorder", "--seconds", "8", "--keep", str(tmp_path / "kept"))
    assert done.returncode == 0, done.stdout + done.stderr
    for step in RECORDER:
        assert step in done.stdout
    assert (tmp_path / "kept" / "fault.png").stat().st_size > 1000
    assert "Traceback" not in done.stderr


def test_too_short_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--seconds", "3"]) == 2
    assert "at least 8 seconds" in capsys.readouterr().err


def test_a_folder_that_is_not_empty_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["demo", "--seconds", "30", "--keep", str(tmp_path)]) == 2
    assert "is not empty" in capsys.readouterr().err
    assert (tmp_path / "mine.txt").read_text() == "mine"


def still_running(place: Path) -> list[str]:
    """Return the commands of processes that work below a folder."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:  # it ended meanwhile
                continue
            if str(place) in command and "pytest" not in command.partition(" -m ")[0]:
                found.append(command)
    return found
