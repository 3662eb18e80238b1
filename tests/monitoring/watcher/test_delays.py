"""The monitors of the simulated robot beside a watcher, or a recorder, that is held up."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import pytest

from amberbox import sim
from amberbox.blackbox.recorder.pipeline import PipelineOptions, StallMeter
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.core.types import Status
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.record_evaluation import replay
from amberbox.monitoring.watcher import RecordWatcher, WatcherSetup
from amberbox.sim.robot import Robot
from amberbox.sim.topics import TOPICS
from amberbox.testing.clock import ManualClock
from tests.fuzzing import examples, fuzz
from tests.monitoring.watcher.stand import kill, line_of, written
from tests.support.manual_recorder import ManualBox

WATCHED = {"host", "imu", "laser_front", "localisation", "odometry", "wheel_front_left"}
"""Components of the robot whose modes evaluate silence, rates, jumps, means and frozen values."""


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> MonitoringPlan:
    source = Path(sim.__file__).parent / "folder"
    folder = tmp_path_factory.mktemp("robot") / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: robot\n")
    for path in source.rglob("*.yaml"):
        place = folder / path.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(path.read_bytes())
    whole = load_plan(load_folder(folder))[0]
    return replace(whole, components=[c for c in whole.components if c.id in WATCHED])


@dataclass
class Scene:
    """A healthy simulated robot, a recorder that can be held up, and a watcher beside it."""

    path: Path
    plan: MonitoringPlan
    seed: int = 7
    clock: ManualClock = field(default_factory=ManualClock)
    silent: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        options = PipelineOptions(boot_id=self.clock.boot_id())
        self.box = ManualBox(self.path, clock=self.clock, options=options, source="sim")
        self.box.pipeline.stalls = self.meter = StallMeter(self.clock.boot_ns)
        self.robot = Robot(self.seed, "robot", "shuttle", self.clock.wall_ns())
        self.messages = self._messages()
        self.began_ns = self.clock.wall_ns()
        self.next = next(self.messages)
        self.topics = {spec.name: spec.topic() for spec in TOPICS}
        self.write()

    def _messages(self) -> Iterator[tuple[int, str, bytes]]:
        for topic, sent_ns, message in self.robot.step_until(float("inf")):
            yield sent_ns, topic, msgspec.json.encode(message)

    def hear(self) -> None:
        """Receive all that the robot has sent by now."""
        while self.next[0] <= self.clock.wall_ns():
            _, topic, data = self.next
            if topic not in self.silent:
                self.box.hear(self.topics[topic], data)
            self.next = next(self.messages)

    def write(self) -> None:
        """Write the received messages."""
        self.box.write(0.0)

    def go_on(self, seconds: float) -> Iterator[None]:
        """Record for a while; yields after each write."""
        for _ in range(round(seconds / 0.1)):
            for _ in range(4):
                self.clock.advance(0.025)
                self.meter.beat()
                self.hear()
            self.write()
            yield

    def stall(self, seconds: float) -> None:
        """Hold the recorder up: what the robot sends is received at once afterwards."""
        self.clock.advance(seconds)
        self.hear()
        self.write()
        self.meter.beat()

    def watcher(self) -> RecordWatcher:
        store = open_store(self.path)
        return RecordWatcher(
            WatcherSetup(self.plan, store, clock=self.clock, clock_s=lambda: self.clock.boot / NS)
        )

    def replayed(self) -> list[bytes]:
        return [line_of(finding) for finding in replay(self.plan, open_store(self.path))]

    def bad(self) -> set[tuple[str, str, str, str]]:
        """Return the bad outputs."""
        return {
            (found.component, found.mode, found.level, found.reason)
            for found in replay(self.plan, open_store(self.path))
            if isinstance(found, Status) and found.mode and found.level not in ("ok", "unknown")
        }


@fuzz
@pytest.mark.parametrize("seed", range(examples(1)))
def test_delays_of_the_watcher_change_nothing(
    tmp_path: Path, plan: MonitoringPlan, seed: int
) -> None:
    """It is stopped for any time, killed, and catches up; the recorder is held up meanwhile."""
    rng = random.Random(seed)
    scene = Scene(tmp_path / "store", plan, seed)
    watcher = scene.watcher()
    held_up = 0
    for number, _ in enumerate(scene.go_on(5.0)):
        if rng.random() < 0.05:
            scene.stall(rng.choice([0.2, 0.6, 1.5, 4.0]))
        if rng.random() < 0.02:
            kill(watcher)
            watcher = scene.watcher()
        held_up = max(held_up - 1, rng.choice([0, 0, 0, 5, 30]) if number % 7 == 0 else 0)
        if not held_up:
            watcher.step()
    scene.box.close()
    watcher.step()
    watcher.close()
    live = written(scene.path)
    assert len(live) > 200
    assert live == scene.replayed()


def test_a_recorder_that_is_held_up_invents_no_faults(tmp_path: Path, plan: MonitoringPlan) -> None:
    """All that the robot sent meanwhile is received at once, with the same stamp."""
    scene = Scene(tmp_path / "store", plan)
    for seconds in (0.2, 0.7, 25.0):
        for _ in scene.go_on(2.5):
            pass
        scene.stall(seconds)
    for _ in scene.go_on(4.0):
        pass
    scene.box.close()
    assert scene.bad() == set()


def test_what_is_silent_after_a_stall_is_found(tmp_path: Path, plan: MonitoringPlan) -> None:
    scene = Scene(tmp_path / "store", plan)
    for _ in scene.go_on(2.5):
        pass
    scene.silent = frozenset({"scan_front"})
    scene.stall(5.0)
    for _ in scene.go_on(4.0):
        pass
    scene.box.close()
    assert ("laser_front", "heartbeat", "error") in {found[:3] for found in scene.bad()}
