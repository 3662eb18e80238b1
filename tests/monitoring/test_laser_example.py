"""The paper's laser example on a ROS network without ROS."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.monitoring.laserexample import EXPECTED, play, watched
from tests.support.ros_network import RosMaster, RosPublisher, RosTopic

TOPIC = "/scan_front"
SCAN = b"\4\0\0\0scan"


class Driver:
    """Publishes at 10 Hz until it is killed."""

    def __init__(self, master: RosMaster, node: str) -> None:
        self._publisher = RosPublisher(node, {TOPIC: RosTopic()}, master)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.1):
            with suppress(OSError):  # a subscriber that has left
                self._publisher.publish(TOPIC, SCAN)

    def kill(self) -> None:
        self._stop.set()
        self._thread.join()
        self._publisher.kill()


@contextmanager
def drivers(master: RosMaster) -> Iterator[list[Driver]]:
    started = [Driver(master, "/driver_1")]
    try:
        yield started
    finally:
        started[-1].kill()
        master.stop()


def test_the_papers_laser(tmp_path: Path) -> None:
    master = RosMaster()
    uri = f"http://127.0.0.1:{master.port}"
    with drivers(master) as started, watched(tmp_path, uri, TOPIC) as laser:
        play(
            laser,
            lambda: started[-1].kill(),
            lambda: started.append(Driver(master, "/driver_2")),
        )
    assert laser.transitions()[-4:] == EXPECTED
