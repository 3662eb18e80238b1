"""A real ROS master and the test robot for the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.processes import free_port
from tests.support.ros_nodes import PYTHON, Processes, Ros, missing_ros

ROBOT = Path(__file__).with_name("robot.py")


@pytest.fixture(scope="session")
def requires_ros() -> None:
    reason = missing_ros()
    if reason:
        pytest.skip(f"requires_ros: {PYTHON} cannot run ROS 1 ({reason})")


@pytest.fixture
def ros(requires_ros: None, tmp_path: Path) -> Iterator[Ros]:
    with Processes(tmp_path / "ros.log") as processes:
        yield Ros(processes, free_port(), tmp_path, ROBOT)
