"""``amberbox record``: how it ends, what it shows, and that a signal ends it cleanly."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.recorder.recorder import ItemState, RecorderState
from amberbox.blackbox.store import journal_reader
from amberbox.blackbox.store.store import Store
from amberbox.cli.main import main
from amberbox.cli.record import summary, table
from amberbox.core.errors import UsageError
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.manual_recorder import events
from tests.support.processes import command

SIM = "- sim:\n    seed: 1\n    topics: [{name: odom}, {name: wifi}]\n"
STATE = RecorderState(
    [
        ItemState("ros_odom", 49.96, 500, 250, 250, 0, 176_000),
        ItemState("ros_a_long_item_name", 0.0, 3, 1, 0, 2, 12),
    ],
    queue_bytes=1200,
    written_bytes=98_765_432,
    disk_free_bytes=45_600_000_000,
    disk_error="",
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "robot"
    made.mkdir()
    (made / "robot.yaml").write_text("id: r\n")
    (made / "black_box.yaml").write_text(SIM)
    return made


def record(folder: Path, *options: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command("record", folder, *options),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def test_the_table_lines_up() -> None:
    assert table(STATE, 12.3) == [
        "item                  rate Hz  kept  filtered  dropped     bytes",
        "ros_odom                 50.0   250       250        0  176.0 kB",
        "ros_a_long_item_name      0.0     1         0        2      12 B",
        "12 s, written 98.8 MB, queue 1.2 kB, disk left 45.6 GB",
    ]


def test_the_table_names_a_disk_in_trouble() -> None:
    broken = RecorderState([], 0, 0, 0, "No space left on device")
    assert table(broken, 0)[-1] == "DISK: No space left on device"
    assert summary(broken).endswith("; DISK: No space left on device")


def test_the_summary_adds_up() -> None:
    assert summary(STATE) == (
        "2 items, 50 messages/s, 251 kept, 2 dropped, 98.8 MB written, 45.6 GB left"
    )


def test_it_ends_by_itself_and_prints_json_meanwhile(folder: Path) -> None:
    began = time.monotonic()
    process = record(folder, "--for", "4.6 s", "--json")
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert time.monotonic() - began >= 4.6
    states = [json.loads(line) for line in output.splitlines()]
    assert 1 <= len(states) <= 4, "one a second"
    assert [item["name"] for item in states[-1]["items"]] == ["sim_odom", "sim_wifi"]
    odom = states[-1]["items"][0]
    assert 10 < odom["rate_hz"] < 200, "50 Hz; a busy computer records late, and then at once"
    assert states[-1]["disk_free_bytes"] > 0
    assert errors.startswith("recorded ")
    assert all(journal.finished for journal in journal_reader.journals(folder / "store"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_cleanly(folder: Path, number: int) -> None:
    process = record(folder, "--quiet")
    wait_until(lambda: rows(folder) > 20, "rows")
    process.send_signal(number)
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, output, errors) == (0, "", "")
    assert [event["kind"] for event in events(folder / "store", "stopped")] == ["stopped"]
    files = journal_reader.journals(folder / "store")
    assert files and all(journal.finished for journal in files)
    (gap,) = (gap for gap in amberbox.open(folder).gaps("sim_odom") if gap.reason == "stopped")
    assert gap.to_ns >= gap.from_ns


def rows(folder: Path) -> int:
    try:
        return sum(
            journal.items.get("sim_odom", 0)
            for journal in journal_reader.journals(folder / "store")
        )
    except UsageError:  # the store is about to be made
        return 0


def test_inputs_that_end_end_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = SIM.replace("seed: 1", "seed: 1\n    speed: max\n    duration_s: 5")
    (folder / "black_box.yaml").write_text(text)
    assert main(["record", str(folder)]) == 0
    assert f"recorded 255 messages of 2 items in {folder / 'store'}" in capsys.readouterr().err


@pytest.mark.parametrize(("service", "status"), [(False, 1), (True, 0)])
def test_a_robot_that_was_off_is_no_failure_of_a_service(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    service: bool,
    status: int,
) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    if service:
        monkeypatch.setenv("NOTIFY_SOCKET", str(folder / "gone"))
    (folder / "black_box.yaml").write_text("- zmq: {endpoint: tcp://127.0.0.1:1}\n")
    assert main(["record", str(folder), "--for", "0.3", "--quiet"]) == status
    assert "warning: nothing was heard" in capsys.readouterr().err
    assert main(["record", "--help"]) == 0
    assert "1 nothing was heard" in " ".join(capsys.readouterr().out.split())


def test_wrong_usage(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", str(folder / "nowhere")]) == 2
    assert "there is no folder or file" in capsys.readouterr().err
    assert main(["record", str(folder), "--for", "a while"]) == 2
    assert "a while" in capsys.readouterr().err


def test_the_keeper_goes_with_the_recorder(folder: Path) -> None:
    process = record(folder, "--quiet")
    wait_until(lambda: keepers(folder), "a keeper")
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    wait_until(lambda: not keepers(folder), "its end")


def keepers(folder: Path) -> list[int]:
    """Return processes that keep the store."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                command = (entry / "cmdline").read_bytes()
            except OSError:  # it has just ended
                continue
            if b"amberbox.blackbox.keeper" in command and bytes(folder / "store") in command:
                found.append(int(entry.name))
    return found


def test_a_full_disk_is_shown_beside_the_table() -> None:
    full = RecorderState([], 0, 0, 0, "", "disk full")
    assert table(full, 0)[-1] == "DISK FULL: only events are recorded"
    assert summary(full).endswith("; DISK FULL: only events are recorded")


def test_a_disk_without_a_byte_is_an_error_with_a_hint(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(store: Store) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Store, "next_run", refuse)
    assert main(["record", str(folder)]) == 1
    printed = capsys.readouterr().err
    assert "cannot write to the store" in printed
    assert "hint: make room on its disk" in printed
