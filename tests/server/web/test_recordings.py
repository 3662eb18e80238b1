"""The pages of recordings: their contents by role, and escaping of names."""

import json
import re
from collections.abc import Iterator
from html import unescape
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time
from amberbox.server.archive.delta_files import ArchiveLayout
from amberbox.server.data import recordings
from tests.browser import hostile
from tests.server.archive.recordings import Robot
from tests.server.data.damaged import quarantined
from tests.server.house import START_NS, House, house

HTML = {"accept": "text/html"}
HOUR_NS = 3600 * NS
ROBOT = "ropod_001"


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    folder = tmp_path_factory.mktemp("recordings")
    with house(folder / "server", shared=True) as found:
        robot = Robot(ROBOT, folder)
        robot.record(0, files=3, at_ns=START_NS - HOUR_NS)
        robot.hand_in_all(found.services.archive)
        found.services.archive.commit(0)
        yield found


def text_of(client: TestClient, path: str) -> str:
    answer = client.get(path, headers=HTML)
    assert answer.status_code == 200, answer.text[:500]
    return re.sub(r"\s+", " ", unescape(re.sub(r"<[^>]+>", " ", answer.text)))


def begun(home: House, name: str = "test-drive") -> str:
    answer = home.client("operator").post(
        f"/api/v1/robots/{ROBOT}/missions",
        json={"name": name, "at": format_time(START_NS - HOUR_NS)},
    )
    return str(answer.json()["id"])


def test_all_robots_are_there_with_what_they_have(home: House) -> None:
    text = text_of(home.client("viewer"), "/recordings")
    assert "3 robots ·" in text and "in 3 files" in text
    assert "nothing has come yet, the robot has never been connected" in text


def test_who_is_for_the_ward_sees_its_robots_only(home: House) -> None:
    answer = home.client("nurse").get("/recordings", headers=HTML).text
    assert ROBOT in answer and "ropod_003" not in answer
    assert "ropod_003" not in home.client("nurse").get("/pieces/recordings", headers=HTML).text


@pytest.mark.parametrize(("name", "may"), [("viewer", False), ("nurse", True)])
def test_downloads_are_offered_to_those_who_may(home: House, name: str, may: bool) -> None:
    page = home.client(name).get("/recordings", headers=HTML).text
    assert ('href="/downloads"' in page) is may
    answer = home.client(name).get("/downloads", headers=HTML)
    assert (answer.status_code == 200) is may


def test_the_card_tells_whether_files_hold(home: House) -> None:
    text = text_of(home.client("viewer"), f"/pieces/recordings/{ROBOT}?window=24h")
    assert "3 not signed for yet" in text
    assert "recorded" in text


def test_a_file_that_was_changed_is_named(home: House) -> None:
    journal = home.client("viewer").get(f"/api/v1/robots/{ROBOT}/recordings").json()[0]
    layout = ArchiveLayout(home.services.folder)
    path = layout.journal(ROBOT, journal["store_id"], journal["journal"])
    whole = path.read_bytes()
    try:
        path.write_bytes(whole[:-1])
        assert "1 altered" in text_of(home.client("viewer"), f"/pieces/recordings/{ROBOT}")
        path.unlink()
        text = text_of(home.client("viewer"), f"/recordings/{ROBOT}?show=trouble")
        assert "With trouble 1" in text and journal["journal"] in text and "1 to 1 of 1" in text
    finally:
        path.write_bytes(whole)


def looked_at(home: House, path: str, monkeypatch: pytest.MonkeyPatch) -> int:
    """Return the number of files that a page reads."""
    found: list[str] = []

    def look(_: object, path: str) -> str:
        found.append(path)
        return "intact"

    monkeypatch.setattr(recordings, "_integrity", look)
    assert home.client("viewer").get(path, headers=HTML).status_code == 200
    return len(found)


@pytest.mark.parametrize(
    ("path", "files"),
    [("/recordings", 0), ("/pieces/recordings?robot=ropod_001", 0),
     (f"/pieces/recordings/{ROBOT}?window=24h", 3), ("/pieces/recordings/ropod_002", 0),
     (f"/pieces/recordings/{ROBOT}/incidents", 0)],
)  # fmt: skip
def test_only_files_that_are_shown_are_looked_at(
    home: House, monkeypatch: pytest.MonkeyPatch, path: str, files: int
) -> None:
    assert looked_at(home, path, monkeypatch) == files


def test_files_of_another_time_are_not_looked_at(
    home: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    home.clock.advance(48 * 3600)
    try:
        path = f"/pieces/recordings/{ROBOT}"
        assert looked_at(home, f"{path}?window=24h", monkeypatch) == 0
        assert "no file in this time" in text_of(home.client("viewer"), f"{path}?window=24h")
        assert looked_at(home, f"{path}?window=all", monkeypatch) == 3
    finally:
        home.clock.advance(-48 * 3600)


@pytest.mark.parametrize("path", ["/recordings", f"/recordings/{ROBOT}"])
def test_the_window_is_what_holds_all_unless_somebody_chose(home: House, path: str) -> None:
    viewer = home.client("viewer")
    assert 'data-window="6h"' in viewer.get(path, headers=HTML).text
    assert 'data-window="30d"' in viewer.get(f"{path}?window=30d", headers=HTML).text
    assert 'data-window="7d"' in viewer.get("/recordings/ropod_003", headers=HTML).text


def test_what_is_damaged_comes_first(home: House, tmp_path: Path) -> None:
    damaged, ours = Robot("ropod_002", tmp_path), Robot(ROBOT, tmp_path / "ours")
    for robot in (damaged, ours):
        robot.record(0, files=1, at_ns=START_NS)
    home.clock.advance(-48 * 3600)  # it came before all others
    came_ns = home.clock.wall_ns()
    home.clock.advance(48 * 3600)
    with quarantined(home, damaged, "journal/odd.mcap", came_ns=came_ns):
        answer = home.client("viewer").get("/recordings", headers=HTML).text
        assert re.findall(r'<article[^>]*data-robot="([^"]+)"', answer)[0] == "ropod_002"
    with quarantined(home, ours, "journal/odd.mcap", came_ns=came_ns):
        answer = home.client("viewer").get(f"/recordings/{ROBOT}", headers=HTML).text
        first, *rest = re.findall(r'<tr data-file="([^"]+)"', answer)
        assert first.endswith("journal/odd.mcap") and len(rest) == 3


def test_a_damaged_file_can_be_taken_along(home: House, tmp_path: Path) -> None:
    ours = Robot(ROBOT, tmp_path)
    ours.record(0, files=1, at_ns=START_NS)
    kept = home.services.folder / "quarantine" / "odd.mcap"
    kept.parent.mkdir(exist_ok=True)
    kept.write_bytes(b"odd")
    link = f"/recordings/{ROBOT}/damaged/{'d' * 64}"
    with quarantined(home, ours, "journal/odd.mcap", came_ns=START_NS, path="quarantine/odd.mcap"):
        technician = home.client("technician")
        assert f'href="{link}"' in technician.get(f"/recordings/{ROBOT}", headers=HTML).text
        answer = technician.get(link)
        assert answer.content == b"odd"
        assert answer.headers["content-disposition"].startswith("attachment; filename=")
        shown = technician.get(f"/recordings/{ROBOT}", headers=HTML).text
        assert f'data-post="/api/v1/robots/{ROBOT}/recordings/copy"' in shown
        body = re.search(r'recordings/copy" data-body="([^"]+)"', shown)
        assert body and json.loads(unescape(body[1]))["journal"] == "journal/odd.mcap"
        assert link not in home.client("viewer").get(f"/recordings/{ROBOT}", headers=HTML).text
        assert home.client("viewer").get(link).status_code == 403
        assert technician.get(link.replace(ROBOT, "ropod_002")).status_code == 404
        kept.unlink()
        assert technician.get(link).status_code == 404
    noted = home.client("admin").get("/api/v1/audit?action=downloads.fetch").json()
    assert noted[0]["object"] == "journal/odd.mcap"


def test_only_robots_that_are_named_are_told_of(home: House) -> None:
    answer = home.client("viewer").get("/pieces/recordings?robot=ropod_001&robot=ropod_003")
    assert re.findall('data-state="([^"]+)"', answer.text) == ["ropod_001", "ropod_003"]


def test_a_bar_without_recordings_says_so(home: House) -> None:
    text = text_of(home.client("viewer"), "/pieces/recordings/ropod_002?window=24h")
    assert "Nothing was recorded in this time." in text and "No mission yet" in text


def test_parts_in_which_nothing_is_say_so(home: House) -> None:
    client, base = home.client("viewer"), "/pieces/recordings/ropod_002"
    assert "No mission yet" in text_of(client, f"{base}/missions")
    assert "No incident" in text_of(client, f"{base}/incidents")
    assert "Nothing was asked" in text_of(client, f"{base}/fetches")
    assert "No file yet" in text_of(client, f"{base}/journals")


def test_missions_say_how_much_of_them_is_here(home: House) -> None:
    mission = begun(home)
    path = f"/api/v1/robots/{ROBOT}/missions/{mission}/end"
    home.client("operator").post(path, json={"at": format_time(START_NS - HOUR_NS + NS)})
    text = text_of(home.client("viewer"), f"/pieces/recordings/{ROBOT}/missions")
    assert "test-drive" in text and "all of it" in text and "begun here by" in text


def test_a_new_note_changes_what_is_asked_for_every_ten_seconds(home: House) -> None:
    mission = begun(home, "noted")
    stamp = re.compile(f'data-state="{ROBOT}" data-stamp="([^"]+)"')

    def now() -> str:
        found = stamp.search(home.client("viewer").get("/pieces/recordings", headers=HTML).text)
        assert found is not None
        return found[1]

    before = now()
    assert now() == before
    path = f"/api/v1/robots/{ROBOT}/missions/{mission}/notes"
    home.client("operator").post(path, json={"text": "wheel squeaks"})
    assert now() != before


def test_texts_of_people_stay_text(home: House) -> None:
    mission = begun(home, "hostile")
    operator = home.client("operator")
    path = f"/api/v1/robots/{ROBOT}"
    for text in hostile.TEXTS:
        operator.post(f"{path}/missions/{mission}/notes", json={"text": text})
        window = {"from": format_time(START_NS - HOUR_NS), "to": format_time(START_NS)}
        marked = operator.post(f"{path}/incidents", json={**window, "reason": text})
        assert marked.status_code == 201
    parts = ("", "/missions", "/incidents")
    pages = [operator.get(f"/pieces/recordings/{ROBOT}{one}", headers=HTML).text for one in parts]
    page = "".join(pages)
    assert "<img src=x" not in page and "<script>document" not in page
    assert "{{7*7}}" in page and "49 $" not in page
    assert "&lt;img src=x" in page


def test_what_one_may_not_do_is_not_offered(home: House) -> None:
    offers = {"missions": "Begin a mission", "incidents": "Mark it", "journals": "Original file",
              "fetches": "Ask the robot for data"}  # fmt: skip
    may = {"viewer": [], "operator": ["missions", "incidents"], "technician": [*offers]}
    for name, expected in may.items():
        client = home.client(name)
        texts = {p: text_of(client, f"/pieces/recordings/{ROBOT}/{p}") for p in offers}
        assert [p for p, word in offers.items() if word in texts[p]] == expected, name


def test_files_stand_on_pages_the_newest_first(home: House) -> None:
    listed = home.client("viewer").get(f"/api/v1/robots/{ROBOT}/recordings").json()
    names = [f"{one['store_id']}/{one['journal']}" for one in listed]
    answer = home.client("viewer").get(f"/pieces/recordings/{ROBOT}/journals", headers=HTML)
    assert re.findall('data-file="([^"]+)"', answer.text) == names[::-1]
    rest = home.client("viewer").get(
        f"/pieces/recordings/{ROBOT}/journals", params={"after": names[-1]}, headers=HTML
    )
    assert re.findall('data-file="([^"]+)"', rest.text) == names[-2::-1]


def test_downloads_are_ones_own(home: House) -> None:
    body = {"robots": [ROBOT], "missions": ["last:1"], "items": ["pose"], "format": "mcap"}
    assert home.client("technician").post("/api/v1/downloads", json=body).status_code == 202
    mine = text_of(home.client("technician"), "/downloads")
    assert "waits for its turn" in mine and "missions: the last one" in mine and "pose" in mine
    assert "No download yet" in text_of(home.client("admin"), "/downloads")
    assert "by technician" in text_of(home.client("admin"), "/downloads?all=true")
    assert "No download yet" in text_of(home.client("nurse"), "/downloads?all=true")


def test_the_form_of_downloads_takes_long_names(home: House) -> None:
    client = home.client("technician")
    for name in ("item", "mission"):
        assert client.get("/downloads", params={name: "x" * 300}, headers=HTML).status_code == 200
        assert client.get("/downloads", params={name: "x" * 301}, headers=HTML).status_code != 200


def test_the_form_begins_with_what_the_address_says(home: House) -> None:
    page = home.client("technician").get(
        "/downloads", headers=HTML,
        params={"robot": ROBOT, "mission": [hostile.SCRIPT, "b"], "format": "parquet"},
    ).text  # fmt: skip
    assert f'value="{ROBOT}" checked' in page and 'value="parquet" checked' in page
    assert "<script>document" not in page
    assert 'value="b" aria-pressed="true"' in page
    assert "&gt;&lt;script&gt;document.title=1&lt;/script&gt;" in page


def test_what_ended_can_be_asked_for_again(home: House) -> None:
    client = home.client("technician")
    span = {"from": "2027-01-15T07:00:00Z", "to": "2027-01-15T08:00:00Z"}
    made = client.post("/api/v1/downloads", json={"robots": [ROBOT], "format": "csv", **span})
    client.delete(f"/api/v1/downloads/{made.json()['id']}")
    found = re.search(r'href="(/downloads\?[^"]+#new)"', client.get("/downloads").text)
    assert found is not None
    again = client.get(unescape(found[1]).removesuffix("#new")).text
    assert 'data-at="2027-01-15T07:00:00' in again and f'value="{ROBOT}" checked' in again
