"""One server for all tests of the client, and a file of sign-ins for these tests only."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.client import credentials
from amberbox.client.fleet import Fleet
from tests.client.served import Served, served


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server with the record of ``ropod_001``."""
    with served(tmp_path_factory.mktemp("client")) as found:
        yield found


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keep sign-ins in a folder of the test's own."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.delenv(credentials.VARIABLE, raising=False)
    return tmp_path


@pytest.fixture
def technician(server: Served, monkeypatch: pytest.MonkeyPatch) -> Served:
    """The same server, with a technician's token in the environment."""
    monkeypatch.setenv(credentials.VARIABLE, server.tokens["technician"])
    return server


@pytest.fixture
def fleet(server: Served) -> Iterator[Fleet]:
    """A technician's client."""
    with Fleet(server.where, server.tokens["technician"]) as found:
        yield found
