"""A database, a clock moved by hand, and passwords that are hashed fast."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.server.accounts.passwords import Passwords
from amberbox.server.database import ServerDatabase
from amberbox.testing.clock import ManualClock
from tests.server.accounts.stand import CHEAP, PASSWORD, Stand
from tests.server.database.portable import portable_database


@pytest.fixture(scope="session")
def passwords() -> Iterator[Passwords]:
    made = Passwords(CHEAP)
    yield made
    made.close()


@pytest.fixture(scope="session")
def hashed(passwords: Passwords) -> str:
    """The hash of ``PASSWORD``."""
    return passwords.hash(PASSWORD)


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def database(tmp_path: Path, clock: ManualClock) -> Iterator[ServerDatabase]:
    with portable_database(tmp_path, clock) as database:
        yield database


@pytest.fixture
def stand(database: ServerDatabase, clock: ManualClock, passwords: Passwords, hashed: str) -> Stand:
    return Stand(database, clock, passwords, hashed)
