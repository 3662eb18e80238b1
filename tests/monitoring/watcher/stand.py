"""A recorder moved by hand, small monitors of its items, and a watcher beside it."""

from __future__ import annotations

import random
import struct
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.journal import channels as journal_channels
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.store import journal_reader
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.core.mode import Input, Result
from amberbox.core.probe import ProbeOrder
from amberbox.core.samples import Now
from amberbox.core.source import TopicOptions
from amberbox.core.types import Schema, Topic
from amberbox.monitoring.findings import Finding, encoded
from amberbox.monitoring.plan import (
    ComponentPlan,
    DependencyPlan,
    Expectation,
    InputPlan,
    MappingPlan,
    ModePlan,
    MonitoringPlan,
    OutputPlan,
)
from amberbox.monitoring.record_evaluation import MakeDiagnoser, replay
from amberbox.monitoring.watcher import RecordWatcher, WatcherSetup
from amberbox.testing.clock import ManualClock, wait_until
from tests.support.manual_recorder import ManualBox

VALUE = Schema("std_msgs/Float64", "ros1msg", b"float64 data\n")
NUMBERS = {keep: Topic(f"/{keep}", "ros1", VALUE) for keep in ("main", "bulk", "ring")}
# of a source whose messages may come late, each kept beside one that comes in time
LATE = {name: Topic(f"/{name}", "ros1", VALUE) for name in ("late", "late_bulk")}
TOPICS = [
    TopicOptions("/bulk", keep="bulk"),
    TopicOptions("/ring", keep="ring"),
    TopicOptions("/late_bulk", keep="bulk"),
]
PROBE = ProbeOrder("path_exists", "/dev/laser")
GOOD = Result("good", "bool", "it is well")


def positive(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Good while the value is above 0."""
    return {"good": inputs[0].at(now) > 0}


def steady(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Good while the mean of the last second is above 0; looks back."""
    return {"good": inputs[0].over(now, 1.0).mean() > 0}


def there(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Good while the probe is ok."""
    return {"good": inputs[0].at(now) == 1}


def endless(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Never return."""
    while True:
        pass


def module_of(function: Any, **marks: Any) -> Any:
    return SimpleNamespace(
        evaluate=function, RESULTS=(GOOD,), ACCEPTS=("variable",), COLUMNS=True, **marks
    )


def component(
    name: str, function: Any, entry: InputPlan, *needs: str, **marks: Any
) -> ComponentPlan:
    output = OutputPlan("good", "bool", GOOD, expectation=Expectation(True))
    module = module_of(function, **marks)
    mode = ModePlan("m", "m", module, None, [MappingPlan([entry], [output])])
    return ComponentPlan(name, name, [mode], [DependencyPlan(n, "", n) for n in needs])


def variable(item: str) -> InputPlan:
    return InputPlan(f"{item}.data", "variable", item, "data")


def plan_of(*more: ComponentPlan, config_hash: str = "hash") -> MonitoringPlan:
    probe = InputPlan(PROBE.subject, "probe", PROBE.item, "ok", probe=PROBE)
    back = {"history_s": lambda config: 1.0, "TIMED": True}
    return MonitoringPlan("robot", config_hash, [
        component("base", positive, variable("ros_main")),
        component("arm", steady, variable("ros_bulk"), "base", **back),
        component("eye", positive, variable("ros_ring"), "arm"),
        component("laser", there, probe),
        *more,
    ])  # fmt: skip


def late_plan() -> MonitoringPlan:
    """Return a plan that also looks at what comes late."""
    back = {"history_s": lambda config: 1.0, "TIMED": True}
    return plan_of(
        component("slow", positive, variable("ros_late")),
        component("slower", steady, variable("ros_late_bulk"), "base", **back),
    )


@dataclass
class Stand:
    """A store with a recorder that writes random messages, run after run."""

    path: Path
    seed: int = 0
    clock: ManualClock = field(default_factory=ManualClock)
    diagnoser: MakeDiagnoser | None = None
    late_s: float = 0.0
    """How late the messages of the topics in ``LATE`` may come; they have none if it is 0."""

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)
        self.held_up: list[tuple[Topic, bytes, int]] = []
        self.late: dict[str, list[int]] = {f"ros_{name}": [] for name in LATE}
        """Times of receipt of the messages that came late, by item."""
        self._held_until_ns = 0
        self.box = self._box()
        self.ok = True

    def _box(self, rotate_s: float = 600.0) -> ManualBox:
        options = PipelineOptions(boot_id=self.clock.boot_id(), rotate_ns=round(rotate_s * NS))
        return ManualBox(self.path, TOPICS, clock=self.clock, options=options, late_s=self.late_s)

    def tick(self) -> None:
        """Receive some messages, or none, and write them."""
        for topic in NUMBERS.values():
            for _ in range(self.random.choice([0, 0, 1, 1, 3])):
                self.box.hear(topic, struct.pack("<d", self.random.uniform(-1, 3)))
        if self.late_s:
            for topic in LATE.values():
                data = struct.pack("<d", self.random.uniform(-1, 3))
                self.held_up.append((topic, data, self.box.sink.now_ns()))
            self._hand_over()
        self.box.write(self.random.choice([0.03, 0.1, 0.1, 0.17]))

    def _hand_over(self) -> None:
        """Hand over what has come late, unless its source is held up, now and then for long."""
        if self.clock.boot < self._held_until_ns:
            return
        for topic, data, received_ns in self.held_up:
            self.box.sink.message(self.box.sink.topic(topic), data, received_ns)
            self.late[f"ros_{topic.name[1:]}"].append(received_ns)
        self.held_up.clear()
        self.box.sink.complete(self.box.sink.now_ns())
        if self.random.random() < 0.1:
            self._held_until_ns = self.clock.boot + round(self.late_s * 0.9 * NS)

    def restart(self, *, clean: bool = True) -> None:
        """End the recorder, and begin another run a moment later."""
        self.box.close() if clean else self.box.crash()
        self.held_up.clear()
        self.clock.advance(self.random.uniform(0.1, 2))
        self.box = self._box(self.random.choice([1.0, 600.0]))

    def watcher(self, plan: MonitoringPlan | None = None) -> RecordWatcher:
        """Begin to watch; probes are not run, ``measured`` gives their rows."""
        return RecordWatcher(self.watch(plan))

    def watch(self, plan: MonitoringPlan | None = None) -> WatcherSetup:
        store, diagnoser = open_store(self.path), self.diagnoser
        return WatcherSetup(
            plan or plan_of(), store, clock=self.clock, clock_s=self.clock_s, diagnoser=diagnoser
        )

    def clock_s(self) -> float:
        return self.clock.boot / NS

    def watch_with_kills(
        self, ticks: int, jumps_s: Sequence[float], *, killed: float, ended: float,
        measured: float = 0.0, plan: MonitoringPlan | None = None,
    ) -> None:  # fmt: skip
        """Watch while the recorder restarts or crashes, its clock is set, the watcher is killed.

        The last three are how likely each tick does that to the watcher, or brings it a row of a
        probe.
        """
        rng = self.random
        self.tick()
        watcher = self.watcher(plan)
        watcher.step()
        for _ in range(ticks):
            what = rng.random()
            if what < 0.02:
                self.restart(clean=rng.random() < 0.5)
            elif what < 0.03:
                self.clock.step(rng.choice(jumps_s) + rng.uniform(0, 0.01))
            elif what < 0.03 + killed:
                kill(watcher)
                watcher = self.watcher(plan)
            elif what < 0.03 + killed + ended:
                watcher.close()
                watcher = self.watcher(plan)
            elif what < 0.03 + killed + ended + measured:
                watcher.measured(PROBE, {"subject": PROBE.subject, "ok": rng.random() < 0.7})
            self.tick()
            if rng.random() < 0.5:
                watcher.step()
        self.box.close()
        watcher.step()
        watcher.close()

    def replayed(self, plan: MonitoringPlan | None = None) -> list[bytes]:
        store, diagnoser = open_store(self.path), self.diagnoser
        return [line_of(f) for f in replay(plan or plan_of(), store, diagnoser=diagnoser)]


def kill(watcher: RecordWatcher) -> None:
    """Leave what a watcher has written as ``kill -9`` does."""
    watcher._lock.release()


def line_of(finding: Finding) -> bytes:
    channel, data = encoded(finding)
    return channel.encode() + b" " + data


def written(store: Path, *, live_only: bool = False) -> list[bytes]:
    """Return the findings in the journal of the watcher, in order."""
    return [line for line, is_live in _written(store) if is_live == live_only]


def values_of(lines: list[bytes], channel: str) -> list[dict[str, object]]:
    """Return the records of a channel."""
    parts = (line.partition(b" ") for line in lines)
    return [msgspec.json.decode(data) for name, _, data in parts if name.decode() == channel]


def _written(store: Path) -> Iterator[tuple[bytes, bool]]:
    channels = (
        *(journal_channels.STATUS, journal_channels.EVENT, journal_channels.ALARM),
        *(journal_channels.SYMPTOM, journal_channels.DIAGNOSIS),
    )
    for journal in journal_reader.files_of(open_store(store), "watch"):
        names = {n: s.topic.name for n, s in journal.streams.items()}
        wanted = [number for number, name in names.items() if name in channels]
        for chunk in journal_reader.sound_chunks(journal):
            rows = np.flatnonzero(np.isin(chunk.channel, wanted))
            for number, data in zip(chunk.channel[rows], chunk.messages(rows), strict=True):
                values = msgspec.json.decode(data)
                details = msgspec.json.decode(values.get("details", b"{}"))
                is_live = bool(values.get("live_only") or details.get("live_only"))
                yield names[int(number)].encode() + b" " + data, is_live


def run_until(watcher: RecordWatcher, holds: Callable[[], object]) -> None:
    """Run a watcher in this thread until something holds."""
    stop = threading.Event()

    def look() -> None:
        try:
            wait_until(holds)
        finally:
            stop.set()

    with ThreadPoolExecutor(1) as pool:
        looking = pool.submit(look)
        watcher.run(stop)
        looking.result()
