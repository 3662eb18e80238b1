"""A robot folder with two monitors and what can fail, a record of it, and a watcher beside it."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import open_store
from amberbox.consult.context import load_diagnoser
from amberbox.core.clock import NS
from amberbox.core.types import Schema, Topic
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.watcher import RecordWatcher, WatcherSetup
from amberbox.testing.clock import ManualClock
from tests.support.manual_recorder import ManualBox

VALUE = Schema("t/T", "ros1msg", b"float64 data\n")
TEMPERATURE, SPEED = Topic("/temperature", "ros1", VALUE), Topic("/speed", "ros1", VALUE)
FMEA = """\
defaults: {within_s: 1, hold_s: 1}
types:
  motor:
    description: the motor
    failure_modes:
      worn:
        description: the bearing of the motor is worn
        rate: 2.0e-4
        severity: critical
        symptoms: [motor/temperature/cool, fan/speed/turns, {symptom: noisy, detects: 0.3}]
        tests: {sound: rough}
        remedy: replace the bearing
      short:
        description: the winding of the motor has a short
        rate: 1.0e-4
        severity: fatal
        symptoms: [motor/temperature/cool, fan/speed/turns]
        tests: {ohms: low}
    tests:
      sound: {check: Listen to the motor., outcomes: [smooth, rough]}
      ohms: {check: Measure the winding., minutes: 10, outcomes: [good, low]}
  fan:
    description: the fan
    failure_modes:
      stuck:
        description: the fan is stuck
        rate: 5.0e-4
        symptoms: [fan/speed/turns]
symptoms:
  noisy: {when: ros_speed.data > 100}
functions:
  drive: {needs: [motor], system: true}
"""
_MODE = """\
name: {mode}
monitor: range
mappings:
  - mapping:
      inputs: [ros_{mode}.data]
      outputs: [{{output: {{name: {output}, type: bool, expected: true}}}}]
arguments: {arguments}
"""


def write_folder(place: Path) -> Path:
    """Make the folder."""
    for component, mode, output, arguments in (
        ("motor", "temperature", "cool", "{max: 80}"),
        ("fan", "speed", "turns", "{min: 1}"),
    ):
        (place / "components" / component).mkdir(parents=True)
        text = f"component_name: {component}\nmodes: [{component}/{mode}.yaml]\n"
        (place / "components" / f"{component}.yaml").write_text(text)
        text = _MODE.format(mode=mode, output=output, arguments=arguments)
        (place / "components" / component / f"{mode}.yaml").write_text(text)
    (place / "robot.yaml").write_text("id: robot\n")
    topics = "".join(f"      - topic: {{name: {t.name}}}\n" for t in (TEMPERATURE, SPEED))
    (place / "black_box.yaml").write_text(f"- ros:\n    topics:\n{topics}")
    (place / "fmea.yaml").write_text(FMEA)
    return place


@dataclass
class Bench:
    """A recorder of the folder, moved by hand, and the watcher if there is one."""

    folder: Path
    clock: ManualClock = field(default_factory=ManualClock)
    watcher: RecordWatcher | None = None

    def __post_init__(self) -> None:
        self.box = ManualBox(load_folder(self.folder).store_path, clock=self.clock)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Watch while the block runs."""
        folder = load_folder(self.folder)
        plan, _ = load_plan(folder)
        make, _ = load_diagnoser(folder, plan)
        store = open_store(folder.store_path)
        clock_s = lambda: self.clock.boot / NS  # noqa: E731 - no name would say more
        watch = WatcherSetup(plan, store, folder, clock=self.clock, clock_s=clock_s, diagnoser=make)
        self.watcher = RecordWatcher(watch)
        try:
            yield
        finally:
            self.watcher.close()
            self.watcher = None

    def run(self, seconds: float, *, temperature: float = 50.0, speed: float = 10.0) -> None:
        """Let time pass, with values ten times a second."""
        for _ in range(round(seconds * 10)):
            self.box.hear(TEMPERATURE, struct.pack("<d", temperature))
            self.box.hear(SPEED, struct.pack("<d", speed))
            self.box.write()
            if self.watcher is not None:
                self.watcher.step()
