"""The verb watch: live, once, as a replay; its output and exit status."""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import Store, WriterLock, create_store, open_store
from amberbox.cli.main import main
from amberbox.consult.context import load_diagnoser
from amberbox.core.types import Schema, Topic
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.record_evaluation import replay
from amberbox.monitoring.record_reader import RecordedItemsReader
from amberbox.monitoring.watcher_journal import EvaluatedPosition, recover_progress
from amberbox.testing.clock import PATIENCE_S
from tests.monitoring.watcher.stand import line_of, written
from tests.support.manual_recorder import ManualBox

TEMPERATURE = Topic("/temperature", "ros1", Schema("t/T", "ros1msg", b"float64 data\n"))
BLACK_BOX = """\
- ros:
    topics:
      - topic: {name: /temperature}
"""
MOTOR = "component_name: motor\nmodes: [motor/temperature.yaml]\n"
MODE = """\
name: temperature
monitor: range
mappings:
  - mapping:
      inputs: [ros_temperature.data]
      outputs:
        - output: {name: cool, type: bool, expected: true, hint: let it cool down}
arguments: {max: 80}
"""
FMEA = """\
types:
  motor:
    symptoms: {very_hot: {when: ros_temperature.data > 85}}
    failure_modes:
      fan_stuck: {rate: 1.0e-4, symptoms: [motor/temperature/cool, very_hot]}
"""
CHANGES = [
    "motor: not_initialised -> nominal",
    "motor/temperature: nominal -> cool: cool is false",
    "motor: nominal -> cool",
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Make a robot folder with one component."""
    place = tmp_path / "robot"
    (place / "components" / "motor").mkdir(parents=True)
    (place / "robot.yaml").write_text("id: robot\n")
    (place / "black_box.yaml").write_text(BLACK_BOX)
    (place / "components" / "motor.yaml").write_text(MOTOR)
    (place / "components" / "motor" / "temperature.yaml").write_text(MODE)
    return place


def record(folder: Path, *values: float) -> None:
    """Record temperatures, one each tenth of a second; then the recorder is killed."""
    box = ManualBox(load_folder(folder).store_path)
    for value in values:
        box.hear(TEMPERATURE, struct.pack("<d", value))
        box.write()
    box.crash()


def test_a_replay_prints_what_has_changed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(folder, *[50.0] * 20, *[90.0] * 20)
    assert main(["watch", str(folder), "--replay"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for text in CHANGES:
        assert any(text in line for line in lines), text
    assert any("motor: alarm motor-" in line and "open (urgent)" in line for line in lines)
    assert sum("cool is false" in line for line in lines) == 1, "a reason is told once"
    assert any("(hint: let it cool down)" in line for line in lines)
    assert lines[0].startswith("2023-11-14T22:13:20.")


def test_json_is_what_the_journal_would_have(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(folder, *[50.0] * 20, *[90.0] * 20)
    assert main(["watch", str(folder), "--replay", "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    loaded = load_folder(folder)
    plan, _ = load_plan(loaded)
    found = [line_of(f).partition(b" ")[2] for f in replay(plan, open_store(loaded.store_path))]
    assert [line.encode() for line in lines] == found
    assert {json.loads(line).get("level") for line in lines} >= {"ok", "error", "unknown"}


def test_a_part_of_a_store_is_replayed_with_the_folder_beside_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(folder, *[50.0] * 20, *[90.0] * 20)
    store = str(load_folder(folder).store_path)
    assert main(["watch", store, "--replay"]) == 2
    assert "--folder" in capsys.readouterr().err
    whole = ["watch", store, "--folder", str(folder), "--replay", "--json"]
    assert main(whole) == 0
    everything = capsys.readouterr().out.splitlines()
    assert main([*whole, "--from", "-1s", "--speed", "20"]) == 0
    part = capsys.readouterr().out.splitlines()
    assert 0 < len(part) < len(everything)
    assert everything[-len(part) :] == part
    assert not list((folder / "store").glob("watch/*.mcap"))


def test_once_says_how_it_is_and_fails_on_errors(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(folder, *[50.0] * 20)
    assert main(["watch", str(folder), "--once"]) == 0
    printed = capsys.readouterr()
    assert printed.out == "ok        motor/temperature\nok      motor\n"
    assert "nothing is being recorded" in printed.err
    record(folder, *[90.0] * 20)
    assert main(["watch", str(folder), "--once", "--json"]) == 1
    statuses = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(s["component"], s["mode"], s["level"]) for s in statuses] == [
        ("motor", "temperature", "error"), ("motor", "", "error"),
    ]  # fmt: skip
    assert main(["watch", str(folder), "--once", "--quiet"]) == 1
    assert capsys.readouterr().out == ""


def test_a_second_watcher_is_told_of_the_first(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lock = WriterLock(create_store(load_folder(folder).store_path), "watch")
    assert main(["watch", str(folder)]) == 2
    assert f"process {os.getpid()} (watch)" in capsys.readouterr().err
    lock.release()


def test_wrong_usage_is_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", str(folder), "--from", "-1s"]) == 2
    assert "--replay" in capsys.readouterr().err
    record(folder, 50.0)
    assert main(["watch", str(folder), "--replay", "--speed", "0"]) == 2
    assert "is no speed" in capsys.readouterr().err
    (folder / "components" / "motor.yaml").unlink()
    (folder / "components" / "motor" / "temperature.yaml").unlink()
    assert main(["watch", str(folder)]) == 2
    assert "has no components" in capsys.readouterr().err


class Recording:
    """A running recorder in a thread, with the machine's own clock."""

    def __init__(self, folder: Path) -> None:
        from amberbox.blackbox.recorder.pipeline import PipelineOptions
        from amberbox.core.clock import SystemClock

        clock = SystemClock()
        options = PipelineOptions(boot_id=clock.boot_id())
        self.box = ManualBox(load_folder(folder).store_path, clock=clock, options=options)  # type: ignore[arg-type]  # time passes by itself here
        self.value = 50.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.05):
            self.box.hear(TEMPERATURE, struct.pack("<d", self.value))
            self.box.pipeline.tick()

    def end(self) -> None:
        self._stop.set()
        self._thread.join()
        self.box.close()


def watching(folder: Path) -> subprocess.Popen[str]:
    """Begin to watch in a process of its own, and wait until it does."""
    command = [sys.executable, "-m", "amberbox.cli.main", "watch", str(folder)]
    code = f"import sys; from amberbox.cli.main import main; sys.exit(main({command[3:]!r}))"
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    assert "watching robot: 1 component, 1 mode, " in process.stdout.readline()
    return process


def wait_until_evaluated(plan: MonitoringPlan, store: Store) -> None:
    """Wait until the watcher has noted that it is at the end of a record that has ended."""
    *_, last = RecordedItemsReader(store, Engine(plan).items).step()
    end, deadline_s = EvaluatedPosition(last.epoch, last.until_ns), time.monotonic() + 30.0
    while (reached := recover_progress(store).place) != end:
        assert time.monotonic() < deadline_s, f"evaluated up to {reached}, recorded up to {end}"
        time.sleep(0.05)


def test_watchers_killed_at_random_lose_and_double_nothing(folder: Path) -> None:
    (folder / "fmea.yaml").write_text(FMEA)
    recording = Recording(folder)
    store = load_folder(folder).store_path
    try:
        for pause_s in (0.6, 0.3, 0.9):
            process = watching(folder)
            time.sleep(pause_s)
            process.send_signal(signal.SIGKILL)
            process.communicate()
            recording.value = 140.0 - recording.value
        process = watching(folder)
        time.sleep(0.6)
    finally:
        recording.end()
    loaded = load_folder(folder)
    plan, _ = load_plan(loaded)
    wait_until_evaluated(plan, open_store(store))
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, output
    live = written(store)
    diagnoser, _ = load_diagnoser(loaded, plan)
    assert sum(line.startswith(b"amberbox/diagnosis ") for line in live) > 0
    found = replay(plan, open_store(store), diagnoser=diagnoser)
    assert live == [line_of(finding) for finding in found]
