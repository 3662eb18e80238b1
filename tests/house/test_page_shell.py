"""What a page of the documentation starts ends with its test, also when the test fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.testing.clock import wait_until
from tests.support.page_shell import shell


def runs(pid: int) -> bool:
    """Return whether a process runs; one that has ended may not have been asked for its status."""
    place = Path(f"/proc/{pid}/cmdline")
    return place.exists() and bool(place.read_bytes())


def test_what_a_shell_starts_in_a_session_of_its_own_ends_with_it(tmp_path: Path) -> None:
    with (
        pytest.raises(AssertionError, match="of the page"),
        shell(tmp_path, {"PATH": "/usr/bin:/bin"}, {}) as at,
    ):
        _, output = at.run("setsid sleep 3600 & echo $!")
        wait_until(lambda: runs(int(output)), "it has begun")
        raise AssertionError("of the page")
    assert not runs(int(output))
