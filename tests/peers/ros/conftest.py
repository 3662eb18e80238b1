"""A real ROS master and the test robot for the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from subprocess import Popen

import pytest

from amberbox.testing.realros import Processes, free_port, missing_ros

ROBOT = Path(__file__).with_name("robot.py")


@dataclass
class Ros:
    """A place to run a master and robots in; every robot keeps a truth file of its own."""

    processes: Processes
    port: int
    folder: Path
    robots: int = 0

    @property
    def uri(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def master(self) -> Popen[bytes]:
        return self.processes.master(self.port)

    def robot(self, *options: str) -> Popen[bytes]:
        self.robots += 1
        truth = self.folder / f"truth-{self.robots}.jsonl"
        return self.processes.robot(ROBOT, self.port, truth, *options)

    def truths(self) -> list[Path]:
        return sorted(self.folder.glob("truth-*.jsonl"))


@pytest.fixture(scope="session")
def requires_ros() -> None:
    reason = missing_ros()
    if reason:
        pytest.skip(f"requires ROS 1 for /usr/bin/python3: {reason}")


@pytest.fixture
def ros(requires_ros: None, tmp_path: Path) -> Iterator[Ros]:
    with Processes(tmp_path / "ros.log") as processes:
        yield Ros(processes, free_port(), tmp_path)
