"""An empty log in a database that refuses what PostgreSQL would not understand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.fleet.database.database import Database
from amberbox.testing.clock import ManualClock
from tests.fleet.database.portable import portable_database


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    with portable_database(tmp_path, ManualClock()) as database:
        yield database
