"""An archive in a temporary folder, with a clock that is moved by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.server.archive.folder import FolderArchive
from amberbox.testing.clock import ManualClock


@pytest.fixture
def clock() -> ManualClock:
    """A clock that is moved by hand."""
    return ManualClock()


@pytest.fixture
def archive(tmp_path: Path, clock: ManualClock) -> FolderArchive:
    """An empty archive."""
    return FolderArchive(tmp_path / "server", clock=clock)
