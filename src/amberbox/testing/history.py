"""Random lives of a store: runs, pauses, crashes, keepers, deletion; nobody tampers with it."""

from __future__ import annotations

import random
import threading
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.blackbox.incidents import Wish, load_all, pin, release
from amberbox.blackbox.keeper.keeper import Keeper, wait_for_lock
from amberbox.blackbox.keeper.options import KeeperOptions, Lifetime
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.store import Store, open_store
from amberbox.core.clock import NS
from amberbox.core.source import TopicOptions
from amberbox.core.types import Schema, Topic
from amberbox.testing.box import COUNT, ManualBox, number
from amberbox.testing.clock import ManualClock

TEXT = Topic("/text", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\n"))
RING = Topic("/ring", "ros1", Schema("std_msgs/Int64", "ros1msg", b"int64 data\n"))
_QUOTA_BYTES = 600_000


@dataclass
class History:
    """A store and its random life; ``events`` says what happened, for a failing test."""

    path: Path
    seed: int
    events: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)
        self.clock = ManualClock()
        self._stop = threading.Event()
        self._next = 0

    def live(self, runs: int = 3) -> Store:
        """Live through some runs of the recorder; return the store."""
        for _ in range(self.random.randint(1, runs)):
            self._run()
        return open_store(self.path)

    def _run(self) -> None:
        options = PipelineOptions(
            boot_id=self.clock.boot_id(),
            rotate_ns=self.random.choice([NS, 2 * NS, 600 * NS]),
            rotate_bytes=self.random.choice([8_000, 64_000_000]),
        )
        topics = [TopicOptions("/ring", keep="ring")]
        box = ManualBox(self.path, topics, clock=self.clock, options=options)
        keeper = self._keeper() if self.random.random() < 0.8 else None
        for _ in range(self.random.randint(0, 30)):
            self._write(box)
            if self.random.random() < 0.03:
                self._mark(box.store)
            if keeper is not None and self.random.random() < 0.15:
                self.events.append("step")
                keeper.keeper.step(self._stop)
        self._end(box, keeper)
        if self.random.random() < 0.3:  # the computer starts anew: other boot, clock a bit off
            self.clock.boot_name = f"{self.random.getrandbits(32):08x}-0000-4000-8000-000000000000"
            self.clock.step(self.random.uniform(-100, 100))

    def _write(self, box: ManualBox) -> None:
        for _ in range(self.random.randint(0, 6)):
            self._next += 1
            topic = self.random.choice([COUNT, RING, TEXT])
            box.hear(topic, _text(self.random) if topic is TEXT else number(self._next))
        box.write(self.random.choice([0.1, 0.1, 1.0]))
        if self.random.random() < 0.3:
            for mark in box.pipeline.mark_sync():
                mark.wait()
        if self.random.random() < 0.05:
            self.clock.step(self.random.uniform(-5, 5))

    def _mark(self, path: Path) -> None:
        """Mark an incident, or release one."""
        store = open_store(path)
        known = [incident for incident in load_all(store) if incident.is_pinned]
        if known and self.random.random() < 0.4:
            release(store, self.random.choice(known))
            self.events.append("release")
        elif store.journal_files("main"):
            wish = Wish(self.random.uniform(0, 3), self.random.uniform(0, 3), "bump", "test")
            pin(store, wish, KeeperOptions(quota=_QUOTA_BYTES))
            self.events.append("incident")

    def _end(self, box: ManualBox, keeper: _KeeperProcess | None) -> None:
        """End the recorder and its keeper, each cleanly or not, in either order."""
        clean, keeper_first = self.random.random() < 0.6, self.random.random() < 0.3
        self.events.append("close" if clean else "crash")
        if keeper is not None and keeper_first:
            self._end_keeper(keeper)
        box.close() if clean else box.crash()
        if keeper is not None and not keeper_first:
            self._end_keeper(keeper)

    def _end_keeper(self, keeper: _KeeperProcess) -> None:
        clean = self.random.random() < 0.6
        self.events.append("keeper closes" if clean else "keeper dies")
        keeper.end(clean=clean)

    def _keeper(self) -> _KeeperProcess:
        deletes = self.random.random() < 0.5
        options = KeeperOptions(
            ring_s=self.random.choice([1.0, 300.0]),
            quota=_QUOTA_BYTES if deletes else None,
            min_free=0,
            keep_min_s=self.random.choice([0.0, 86_400.0]),
            lifetime=self.random.choice([Lifetime(), Lifetime(raw_s=2.0), Lifetime(2.0, 4.0)]),
        )
        self.events.append(f"keeper {options.lifetime}")
        return _KeeperProcess(self.path, options, self.clock)


class _KeeperProcess:
    """A keeper that holds its lock, as the process does."""

    def __init__(self, path: Path, options: KeeperOptions, clock: ManualClock) -> None:
        store = open_store(path)
        self.lock = wait_for_lock(store, 0.0, threading.Event())
        self.keeper = Keeper(store, options, clock)

    def end(self, *, clean: bool) -> None:
        if clean:
            self.keeper.close()
        self.lock.release()


def _text(rng: random.Random) -> bytes:
    data = rng.randbytes(rng.randint(0, 3_000)).hex().encode()
    return len(data).to_bytes(4, "little") + data
