"""An empty log in a database that refuses what PostgreSQL would not understand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.server.database import ServerDatabase
from amberbox.testing.clock import ManualClock
from tests.server.database.portable import portable_database


@pytest.fixture
def database(tmp_path: Path) -> Iterator[ServerDatabase]:
    with portable_database(tmp_path, ManualClock()) as database:
        yield database
