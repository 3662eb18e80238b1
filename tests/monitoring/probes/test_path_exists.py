"""A path is there, is not, or cannot be known."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.errors import UsageError
from amberbox.monitoring.probes.path_exists import measure


def test_a_path_that_comes_and_goes(tmp_path: Path) -> None:
    device = tmp_path / "front_laser"
    assert measure(str(device)) == {"ok": False}
    device.touch()
    assert measure(str(device)) == {"ok": True}
    device.unlink()
    assert measure(str(device)) == {"ok": False}


def test_a_link_counts_as_what_it_leads_to(tmp_path: Path) -> None:
    target, link = tmp_path / "ttyUSB0", tmp_path / "laser"
    link.symlink_to(target)
    assert measure(str(link)) == {"ok": False}
    target.touch()
    assert measure(str(link)) == {"ok": True}


def test_below_a_file_there_is_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert measure(str(tmp_path / "file" / "laser")) == {"ok": False}


def test_what_cannot_be_looked_at_is_not_called_missing(tmp_path: Path) -> None:
    circle = tmp_path / "circle"
    circle.symlink_to(circle)
    with pytest.raises(OSError, match="symbolic links"):
        measure(str(circle))


def test_a_relative_path_is_refused() -> None:
    with pytest.raises(UsageError, match="no absolute path"):
        measure("dev/laser")
