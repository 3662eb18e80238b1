"""What a robot writes, in a process of its own: recorder, watcher and keeper over one store.

The journals are those of the real recorder, rotated every few seconds; segments are left out.
"""

from __future__ import annotations

import random
import sys
import threading
import time
from pathlib import Path

from amberbox.blackbox.recorder.pipeline import Pipeline, PipelineOptions
from amberbox.blackbox.recorder.recorder import Syncer, previous_end_ns
from amberbox.blackbox.recorder.supervisor import BlockSink
from amberbox.blackbox.retention.maintenance import RetentionService, wait_for_lock
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store.store import create_store
from amberbox.core.clock import NS, RunClock, SystemClock
from amberbox.core.source import TopicOptions
from tests.link.robot.rig import Watcher
from tests.support.manual_recorder import COUNT, number

END = "end"
"""A file of this name beside the store ends a robot in order."""
ROTATE_S = 2.0
_TICK_S = 0.1
_MESSAGES = 10


class Robot:
    """One life of a robot: everything is written until its end; numbers are never repeated."""

    def __init__(self, path: Path, robot: str, boot: str, life: int) -> None:
        SystemClock.boot_id = lambda self: boot  # type: ignore[method-assign]  # one per life
        store = create_store(path)
        rotate_ns = int(ROTATE_S * NS)
        options = PipelineOptions(
            robot=robot, boot_id=boot, rotate_ns=rotate_ns, ring_rotate_ns=rotate_ns
        )
        lock = wait_for_lock(store, 10.0, threading.Event())
        self.pipeline = Pipeline(store, RunClock(SystemClock()), options, previous_end_ns(store))
        self.sink = BlockSink(self.pipeline, "ros", [TopicOptions("/count")], lossless=False)
        self.syncer = Syncer(self.pipeline, 0.5)
        self.watcher = Watcher(path, robot)
        self.keeper = RetentionService(
            store, RetentionOptions(robot=robot, quota_percent=100.0, min_free=0)
        )
        self.keeper._with_segments = False  # what is built of journals is not the matter here
        self.keeper_lock = lock
        self.count, self.chance = life * 1_000_000, random.Random(life)
        self.stop = threading.Event()
        self.end = path.with_name(END)

    def live(self) -> None:
        """Write until a file requests the end, and end cleanly."""
        keeping = threading.Thread(target=self._keep, daemon=True)
        keeping.start()
        while not self.end.exists():
            self.turn()
            time.sleep(_TICK_S)
        self.stop.set()
        self.watcher.close()
        self.syncer.stop()
        self.pipeline.close()
        keeping.join()
        self.keeper.step(threading.Event())
        self.keeper.close()
        self.keeper_lock.release()

    def turn(self) -> None:
        """Receive messages, add findings, write."""
        stream = self.sink.topic(COUNT)
        for _ in range(_MESSAGES):
            self.sink.message(stream, number(self.count), self.sink.now_ns())
            self.count += 1
        if self.chance.random() < 0.1:
            self.pipeline.event("test", f"number {self.count}")
        self.pipeline.tick()
        self.syncer.sync_if_due()
        events = int(self.chance.random() < 0.1)
        self.watcher.write(self.chance.randint(1, 4), events, sync=self.chance.random() < 0.3)

    def _keep(self) -> None:
        while not self.stop.is_set():
            self.keeper.step(self.stop)
            time.sleep(0.5)


if __name__ == "__main__":
    Robot(Path(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4])).live()
