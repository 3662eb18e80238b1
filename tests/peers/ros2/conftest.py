"""What robots over ROS 2 need to be built."""

from __future__ import annotations

import pytest

from tests.support.ros2_robots import build_fast_dds, missing_fast_dds


@pytest.fixture(scope="session")
def fast_dds(tmp_path_factory: pytest.TempPathFactory) -> None:
    reason = missing_fast_dds()
    if reason:
        pytest.skip(f"requires_fast_dds: {reason}")
    build_fast_dds(tmp_path_factory.mktemp("fastdds"))
