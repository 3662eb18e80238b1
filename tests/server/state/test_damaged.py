"""Files that are set aside as damaged are shown to all users of the server."""

from __future__ import annotations

from collections.abc import Iterator
from html import unescape
from pathlib import Path

import pytest

from amberbox.server.archive.commit import KIND
from amberbox.server.ingest.link_state import log_event
from amberbox.server.live.links import NEW_NS
from tests.server.archive.recordings import Robot
from tests.server.data.damaged import quarantined
from tests.server.house import START_NS, House, house

FILES = ("watch/000009-00000000-0000.mcap", "watch/000010-00000000-0000.mcap")


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    made = Robot("ropod_001", tmp_path_factory.mktemp("robot"))
    made.record(0, files=1, at_ns=START_NS)
    return made


@pytest.fixture
def home(tmp_path: Path) -> Iterator[House]:
    with house(tmp_path, shared=True) as made:
        yield made


def read(home: House, path: str, name: str = "admin") -> str:
    return unescape(home.client(name).get(path).text)


def test_new_ones_need_somebody_soon(home: House, robot: Robot) -> None:
    assert home.client().get("/api/v1/health").json() == {"status": "ok"}
    with quarantined(home, robot, *FILES, came_ns=START_NS - NEW_NS + 1):
        assert home.client().get("/api/v1/health").json() == {"status": "poor"}
        said = "2 files were damaged and set aside in the last 24 hours, of ropod_001"
        assert said in read(home, "/admin") and said in read(home, "/admin/health")
        shown = read(home, "/admin/health")
        assert (
            "/recordings/ropod_001?show=trouble#journals" in shown and "ropod_001: 2 files" in shown
        )
        assert "Nothing is known to be wrong." not in shown
        card = read(home, "/pieces/robots/ropod_001", "viewer")
        assert "2 files damaged" in card and "severity-warning" in card
    assert "Nothing is known to be wrong." in read(home, "/admin/health")
    assert "damaged" not in read(home, "/pieces/robots/ropod_001", "viewer")


def test_old_ones_are_still_told_and_alarm_nobody(home: House, robot: Robot) -> None:
    with quarantined(home, robot, FILES[0], came_ns=START_NS - NEW_NS - 1):
        assert home.client().get("/api/v1/health").json() == {"status": "ok"}
        assert "ropod_001: 1 file" in read(home, "/admin/health")
        card = read(home, "/pieces/robots/ropod_001", "viewer")
        assert "1 file damaged" in card and "severity-warning" not in card
        metrics = home.client("admin").get("/api/v1/metrics").text
        assert "amberbox_files_damaged 1" in metrics


def test_a_journal_that_cannot_be_made_rows_of_is_told_with_file_and_cure(home: House) -> None:
    about = "journal/000001-a-0001.mcap is kept and in no table: run amberbox verify on the robot"
    with home.services.database.begin() as connection:
        log_event(connection, "ropod_001", START_NS - NEW_NS + 1, KIND, about)
        log_event(connection, "ropod_003", START_NS - NEW_NS - 1, KIND, "an old one")
    assert home.client().get("/api/v1/health").json() == {"status": "poor"}
    shown = read(home, "/admin/health")
    assert f"ropod_001: {about}" in shown and "an old one" not in shown
