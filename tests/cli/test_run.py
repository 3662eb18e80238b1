"""``amberbox run``: a whole box whose parts are killed, and that ends in order."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import amberbox
from amberbox.agent.doctor.processes import SUPERVISOR_STATE_FILE
from amberbox.blackbox.journal.tail import read_head
from amberbox.blackbox.store.store import is_locked, open_store
from amberbox.cli.main import main
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.processes import command

SIM = "- sim:\n    seed: 1\n    topics: [{name: odom}]\n"
BASE = "component_name: base\nmodes: [base/driving.yaml]\n"
DRIVING = """\
name: driving
monitor: range
mappings:
  - mapping:
      inputs: [sim_odom.twist_linear_x]
      outputs:
        - output: {name: slow, type: bool, expected: true}
arguments: {max: 80}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "robot"
    (made / "components" / "base").mkdir(parents=True)
    (made / "robot.yaml").write_text("id: r\nstore: {min_free: 0, quota_percent: 100}\n")
    (made / "black_box.yaml").write_text(SIM)
    (made / "components" / "base.yaml").write_text(BASE)
    (made / "components" / "base" / "driving.yaml").write_text(DRIVING)
    return made


class Box:
    """Runs ``amberbox run``; its children are identified by ``run.json``."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.log = folder, folder.parent / "log"
        words = command("run", "--quiet", folder)
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stderr=log)

    def child(self, name: str) -> dict[str, Any]:
        try:
            state = json.loads((self.folder / "store" / SUPERVISOR_STATE_FILE).read_text())
        except FileNotFoundError:
            return {}
        own = state["pid"] == self.process.pid
        return dict(state["children"].get(name, {})) if own else {}

    def wait_for(self, name: str, state: str = "running", other_than: int | None = None) -> int:
        """Wait until a child has a state, and another process id than before; return its
        process.
        """

        def is_there() -> bool:
            child = self.child(name)
            return child.get("state") == state and child["pid"] != other_than

        wait_until(is_there, f"{name} is {state}")
        return int(self.child(name)["pid"])


@pytest.fixture
def boxes() -> Iterator[list[Box]]:
    begun: list[Box] = []
    yield begun
    for box in begun:
        if box.process.poll() is None:
            box.process.terminate()
            box.process.wait(PATIENCE_S)


def events(folder: Path, kind: str) -> list[str]:
    with amberbox.open(folder / "store") as record:
        return [row["text"] for row in record.events().rows() if row["kind"] == kind]


def test_whatever_is_killed_recording_goes_on(folder: Path, boxes: list[Box]) -> None:
    box = Box(folder)
    boxes.append(box)
    recorder, watcher = box.wait_for("record"), box.wait_for("watch")
    os.kill(watcher, signal.SIGKILL)
    os.kill(recorder, signal.SIGKILL)
    recorder = box.wait_for("record", other_than=recorder)
    box.wait_for("watch", "starting", other_than=watcher)

    box.process.kill()  # the supervisor itself: its recorder goes on
    box.process.wait()
    store = open_store(folder / "store")
    before = read_head(store.folder("main"))

    def goes_on() -> bool:
        head = read_head(store.folder("main"))
        return bool(head and before and head.watermark_ns > before.watermark_ns)

    wait_until(goes_on, "the recorder goes on")
    again = Box(folder)
    boxes.append(again)
    assert again.wait_for("record") != recorder
    again.wait_for("watch", "starting")
    wait_until(lambda: events(folder, "process_taken_over"), "the recorder is taken over")

    again.process.send_signal(signal.SIGTERM)
    assert again.process.wait(PATIENCE_S) == 0
    assert not is_locked(store, "main") and not is_locked(store, "watch")
    assert again.child("record")["state"] == "off"
    died = events(folder, "process_died")
    assert any("watch was killed by SIGKILL" in text for text in died)
    assert any("record was killed by SIGKILL" in text for text in died)
    assert "was killed by SIGKILL; it starts again in 0.5 s" in again.log.read_text()
    assert events(folder, "stopped")[-1] == "recording stopped"


def test_it_ends_with_inputs_that_end(folder: Path) -> None:
    (folder / "black_box.yaml").write_text(f"{SIM}    speed: max\n    duration_s: 5\n")
    words = command("run", "--quiet", folder)
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[-1] == "all inputs have ended"
    assert len(events(folder, "started")) == 1


@pytest.mark.parametrize(
    ("black_box", "words"),
    [("- sim: {sed: 1}\n", "did you mean 'seed'"), ("[]\n", "lists nothing to record")],
)
def test_a_folder_that_cannot_be_recorded_is_refused_at_the_start(
    folder: Path, black_box: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "black_box.yaml").write_text(black_box)
    assert main(["run", str(folder)]) == 2
    assert words in capsys.readouterr().err
    assert not (folder / "store").exists()


def test_a_file_is_no_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(folder / "black_box.yaml")]) == 2
    assert "is no folder" in capsys.readouterr().err


BATTERY = """\
- sim:
    {{seed: 3, speed: {speed}, duration_s: {seconds}, topics: [{{name: battery}}, {{name: odom}}],
     faults: [{faults}]}}
"""


def test_detectors_run_beside_the_watcher_which_records_their_findings(
    folder: Path, boxes: list[Box], capsys: pytest.CaptureFixture[str]
) -> None:
    nominal, model = folder.parent / "nominal", folder.parent / "battery.model"
    nominal.mkdir()
    (nominal / "robot.yaml").write_text("id: n\n")
    (nominal / "black_box.yaml").write_text(BATTERY.format(speed="max", seconds=60, faults=""))
    assert main(["record", str(nominal), "--quiet"]) == 0
    with (folder / "robot.yaml").open("a") as file:
        file.write("detection: {model: ../battery.model}\n")
    fault = "{id: battery_overheats, at_s: 1, magnitude: 1}"
    (folder / "black_box.yaml").write_text(BATTERY.format(speed=1, seconds=3600, faults=fault))
    assert main(["check", str(folder)]) == 0
    assert "no detector runs until it is right" in capsys.readouterr().out
    assert main(["learn", str(nominal), "-o", str(model), "--detectors", "guard"]) == 0
    assert main(["check", str(folder)]) == 0
    assert "no detector" not in capsys.readouterr().out
    box = Box(folder)
    boxes.append(box)
    box.wait_for("detect")
    found = "guard.range.sim_battery.temperature: present"
    wait_until(lambda: any(text.startswith(found) for text in events(folder, "finding")))
    names = ("record", "watch", "detect")
    before = [box.child(name)["pid"] for name in names]
    model.write_bytes(b"half of a model")
    wait_until(lambda: events(folder, "detect_model_refused"), "a damaged file is refused")
    options = folder.parent / "options.yaml"
    options.write_text("guard: {items: 1}\n")
    words = ["--detectors", "guard", "--options", str(options)]
    assert main(["learn", str(nominal), "-o", str(model), *words]) == 0
    wait_until(lambda: events(folder, "detect_anew"), "the new model is in use")
    assert [box.child(name)["pid"] for name in names] == before  # nothing was started again
    box.process.terminate()
    assert box.process.wait(PATIENCE_S) == 0
