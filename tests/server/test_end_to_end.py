"""Robots, bad networks, a server, all killed at random: all written rows are there, once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.server.endtoend import ordeal


@pytest.mark.alone
@pytest.mark.timeout(300)
def test_nothing_is_lost_whatever_is_killed(tmp_path: Path) -> None:
    result = ordeal.run(tmp_path, robots=3, seconds=20, kills=20, seed=6)
    assert result.rows > 300 and result.messages > 1000 and result.journals > 10
    assert result.faults > 0 and result.frames > 0
