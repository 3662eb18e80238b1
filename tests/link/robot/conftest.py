"""A database of a server."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.server.database import ServerDatabase


@pytest.fixture
def database(tmp_path: Path) -> Iterator[ServerDatabase]:
    found = ServerDatabase(tmp_path / "server.db")
    yield found
    found.close()
