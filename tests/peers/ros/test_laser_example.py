"""The paper's laser example with a real device path, a real ROS master and a real publisher."""

from __future__ import annotations

import signal
from pathlib import Path

from tests.monitoring.laserexample import EXPECTED, play, watched
from tests.support.ros_nodes import Ros, end


def test_the_papers_laser(ros: Ros, tmp_path: Path) -> None:
    ros.master()
    drivers = [ros.robot("--topics", "scan")]
    with watched(tmp_path, ros.uri, "/robot/scan") as laser:
        play(
            laser,
            lambda: end(drivers[-1], signal.SIGKILL),
            lambda: drivers.append(ros.robot("--topics", "scan")),
        )
    assert laser.transitions()[-4:] == EXPECTED
