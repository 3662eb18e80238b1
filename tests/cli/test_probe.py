"""``amberbox probe``: one measurement, a list, periodic rows, and publishing for a remote box."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

import amberbox
from amberbox.cli.main import main
from amberbox.core.probe import ProbeOrder
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.manual_recorder import recording
from tests.support.processes import command, free_port

COMPONENT = "component_name: laser\nmodes: [laser_device.yaml]\n"
MODE = """\
name: laser_device_monitor
monitor: device
mappings:
  - mapping:
      inputs: [{device}]
      outputs:
        - output: {{name: present, type: bool}}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "robot"
    (made / "components").mkdir(parents=True)
    (made / "robot.yaml").write_text("id: cart\n")
    (made / "black_box.yaml").write_text("- sim: {topics: [{name: odom}]}\n")
    (made / "components" / "laser.yaml").write_text(COMPONENT)
    mode = MODE.format(device=tmp_path / "front_laser")
    (made / "components" / "laser_device.yaml").write_text(mode)
    return made


def start(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command("probe", *arguments),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def test_one_probe_is_tried_once(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    there, missing = str(tmp_path), str(tmp_path / "laser")
    assert main(["probe", "--probe", "path_exists", there]) == 0
    header, row = capsys.readouterr().out.splitlines()
    assert header.split() == ["probe", "subject", "ok", "measured"]
    assert row.split() == ["path_exists", there, "ok"]
    both = ["--probe", "path_exists", there, "--probe", "path_exists", missing]
    assert main(["probe", *both, "--json"]) == 1
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert rows == [
        {"item": ProbeOrder("path_exists", subject).item, "kind": "path_exists",
         "subject": subject, "ok": ok, "error": ""}
        for subject, ok in ((there, True), (missing, False))
    ]  # fmt: skip


def test_what_is_measured_and_what_cannot_be_known_is_shown(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["probe", "--probe", "network_interface", "lo"]) == 0
    assert "carrier=true" in capsys.readouterr().out
    assert main(["probe", "--probe", "path_exists", "laser"]) == 1
    assert "unknown  ('laser' is no absolute path)" in capsys.readouterr().out


def test_the_folder_says_what_is_probed(
    capsys: pytest.CaptureFixture[str], folder: Path, tmp_path: Path
) -> None:
    device = tmp_path / "front_laser"
    assert main(["probe", str(folder), "--list", "--json"]) == 0
    order = ProbeOrder("path_exists", str(device))
    listed = {"kind": "path_exists", "subject": str(device), "item": order.item}
    assert json.loads(capsys.readouterr().out) == [listed]
    assert main(["probe", str(folder), "--once"]) == 1
    assert "not ok" in capsys.readouterr().out
    device.touch()
    assert main(["probe", str(folder), "--once"]) == 0


def test_errors_in_the_monitors_are_told_and_the_rest_is_probed(
    capsys: pytest.CaptureFixture[str], folder: Path, tmp_path: Path
) -> None:
    (folder / "components" / "gripper.yaml").write_text(
        "component_name: gripper\nmodes: [no_such_mode.yaml]\n"
    )
    (tmp_path / "front_laser").touch()
    assert main(["probe", str(folder), "--once"]) == 0
    said = capsys.readouterr()
    assert "path_exists" in said.out
    assert f"in the monitors; amberbox check {folder} shows them" in said.err


def test_a_probe_of_the_robots_own_is_found(
    capsys: pytest.CaptureFixture[str], folder: Path
) -> None:
    (folder / "probes").mkdir()
    (folder / "probes" / "emergency_stop.py").write_text(
        'MEASURES = {"volts": ("float", "V", "at the input")}\nSUBJECT = "the input"\n'
        'def measure(subject):\n    return {"ok": True, "volts": 24}\n'
    )
    own = [str(folder), "--probe", "emergency_stop", "di3", "--once", "--json"]
    main(["probe", *own])
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(row["kind"], row.get("volts")) for row in rows] == [
        ("emergency_stop", 24.0),
        ("path_exists", None),
    ]


def test_all_probes_are_listed_with_what_they_measure(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["probe", "--list"]) == 0
    text = capsys.readouterr().out
    assert "path_exists: Whether a file, folder or device is there" in text
    assert "  latency_ms    there and back, mean of the answers [ms]" in text
    assert main(["probe", "--list", "--json"]) == 0
    listed = {entry["name"]: entry for entry in json.loads(capsys.readouterr().out)}
    assert listed["memory"]["measures"][1]["unit"] == "bytes"


@pytest.mark.parametrize(
    ("arguments", "error", "hint"),
    [
        ([], "there is nothing to probe", "name a FOLDER, or --probe KIND SUBJECT"),
        (
            ["--probe", "path_exist", "/dev/null"],
            "there is no probe 'path_exist'; did you mean 'path_exists'?",
            "known: ",
        ),
        (
            ["--probe", "path_exists", "/dev/null", "--once", "--publish"],
            "--once does not go with --publish: nobody would be listening yet",
            "",
        ),
        (
            ["--probe", "path_exists", "/dev/null", "--publish", "robot:5561"],
            "'robot:5561' is no address to publish at",
            "such as tcp://*:5561",
        ),
    ],
)
def test_wrong_usage_is_explained(
    capsys: pytest.CaptureFixture[str], arguments: list[str], error: str, hint: str
) -> None:
    assert main(["probe", *arguments]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"error: {error}\n")
    assert hint in said


def test_rows_are_printed_until_a_signal(folder: Path, tmp_path: Path) -> None:
    process = start(str(folder))
    assert process.stdout is not None
    device = tmp_path / "front_laser"
    assert process.stdout.readline().rstrip() == f"path_exists  {device}  not ok"
    device.touch()
    assert process.stdout.readline().rstrip() == f"path_exists  {device}  ok"
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=PATIENCE_S) == ("", "")
    assert process.returncode == 0


def test_what_is_published_is_recorded_by_a_box_elsewhere(folder: Path, tmp_path: Path) -> None:
    box, address = tmp_path / "box", f"tcp://127.0.0.1:{free_port()}"
    box.mkdir()
    (box / "robot.yaml").write_text("id: cart\n")
    (box / "black_box.yaml").write_text(f"- zmq: {{name: probe, endpoint: '{address}'}}\n")
    item = ProbeOrder("path_exists", str(tmp_path / "front_laser")).item
    process = start(str(folder), "--publish", address)
    try:
        with recording(box) as recorder:
            wait_until(
                lambda: any(i.name == item and i.received for i in recorder.state().items), item
            )
    finally:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE_S)
    assert errors == f"1 probe, published at {address}; only this computer can read them\n"
    assert process.returncode == 0
    with amberbox.open(box) as record:
        assert record.query(item).columns["ok"][0] == np.False_
