"""The page of data: its functions by role, variables, and the whole time of the data."""

from collections.abc import Iterator

import pytest
from starlette.testclient import TestClient

from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time, parse_time
from amberbox.server.web import data
from amberbox.server.web.data import DataInterval, joined
from amberbox.server.web.diagnosis_card import CardReason, DiagnosisCard
from amberbox.server.web.text import moment_href
from amberbox.server.workers.protocol import BusyError
from amberbox.testing.records import T0_NS
from tests.server.archive.recordings import Robot
from tests.server.data.damaged import WHY, quarantined
from tests.server.data.filled import ROWS, fill
from tests.server.house import House, house

PAGE = "/robots/ropod_001/data"
NOTES = "/api/v1/robots/ropod_001/missions/transport-1/notes"
DIALOGS = ("mark", "note", "download")


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[House, Robot]]:
    folder = tmp_path_factory.mktemp("data")
    with house(folder / "server", shared=True) as found:
        yield found, fill(found, folder)


@pytest.fixture(scope="module")
def home(filled: tuple[House, Robot]) -> House:
    return filled[0]


@pytest.fixture(scope="module")
def robot(filled: tuple[House, Robot]) -> Robot:
    return filled[1]


@pytest.fixture(scope="module")
def viewer(home: House) -> TestClient:
    return home.client("viewer")


@pytest.mark.parametrize(
    ("name", "offered", "may_fetch"),
    [
        ("viewer", [], False),
        ("operator", ["mark", "note"], False),
        ("technician", ["mark", "note", "download"], True),
    ],
)
def test_the_page_offers_what_somebody_may_do(
    home: House, name: str, offered: list[str], may_fetch: bool
) -> None:
    page = home.client(name).get(PAGE).text
    assert [one for one in DIALOGS if f'<dialog id="{one}"' in page] == offered
    assert [one for one in DIALOGS if f'data-open="{one}"' in page] == offered
    assert ("data-fetch" in page) == may_fetch


def test_the_page_needs_no_worker(
    home: House, viewer: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(home.services, "worker_pool", None)
    assert viewer.get(PAGE).status_code == 200


def test_words_in_the_address_are_no_part_of_the_page(viewer: TestClient) -> None:
    page = viewer.get(PAGE, params={"v": "<img src=x onerror=1>", "from": "'\"><script>"}).text
    assert "onerror" not in page
    assert "'\"><script>" not in page


def test_variables_are_told_with_their_items(viewer: TestClient) -> None:
    found = {one["name"]: one for one in viewer.get(f"{PAGE}/variables").json()}
    listed = viewer.get("/api/v1/robots/ropod_001/items").json()
    assert list(found) == [one["name"] for one in listed]
    odom = viewer.get("/api/v1/robots/ropod_001/items/odom").json()
    assert found["odom"]["columns"] == odom["columns"]
    assert found["odom"]["chosen"] == odom["chosen"]
    assert found["odom"]["rows"] == odom["rows"] == ROWS + 40


def test_a_robot_that_sent_nothing_has_no_variables_and_no_time(viewer: TestClient) -> None:
    assert viewer.get("/robots/ropod_002/data").status_code == 200
    assert viewer.get("/robots/ropod_002/data/variables").json() == []
    coverage = viewer.get("/robots/ropod_002/data/coverage").json()
    assert coverage == {"start": None, "end": None, "recorded": [], "missing": []}


def test_coverage_reaches_from_the_first_to_the_last_row(viewer: TestClient) -> None:
    found = viewer.get(f"{PAGE}/coverage").json()
    listed = viewer.get("/api/v1/robots/ropod_001/recordings").json()
    first, last = min(one["from"] for one in listed), max(one["to"] for one in listed)
    assert found["start"] == pytest.approx(_seconds(first), abs=1e-6)
    assert found["end"] == pytest.approx(_seconds(last), abs=1e-6)
    assert found["recorded"][0]["start"] == found["start"]
    assert max(one["end"] for one in found["recorded"]) == found["end"]


def test_a_file_whose_times_are_not_known_counts_for_nothing(
    home: House, robot: Robot, viewer: TestClient
) -> None:
    before = viewer.get(f"{PAGE}/coverage").json()
    with quarantined(home, robot, "watch/000009-00000000-0000.mcap", came_ns=T0_NS + 3600 * NS):
        assert viewer.get(f"{PAGE}/coverage").json() == before
        recordings = viewer.get("/api/v1/robots/ropod_001/recordings").json()
        (found,) = (one for one in recordings if one["state"] == "quarantined")
        page = home.client("technician").get("/recordings/ropod_001?show=trouble").text
    assert (found["from"], found["to"]) == (None, None)
    assert (found["integrity"], found["reason"]) == ("altered", WHY)
    assert '<span class="muted">unknown</span>' in page
    assert "1970" not in page


def test_a_refused_file_is_a_gap_of_its_own_kind(
    home: House, robot: Robot, viewer: TestClient
) -> None:
    last = max(path.name for path in robot.files() if path.parent.name == "journal")
    run, boot, number = last.removesuffix(".mcap").split("-")
    name = f"journal/{run}-{boot}-{int(number) + 1:04d}.mcap"
    known = viewer.get(f"{PAGE}/coverage").json()
    came_ns = int(known["end"] * NS) + 600 * NS
    with quarantined(home, robot, name, came_ns=came_ns):
        gaps = viewer.get("/api/v1/robots/ropod_001/gaps").json()["gaps"]
        (gap,) = (one for one in gaps if one["kind"] == "refused")
        found = viewer.get(f"{PAGE}/coverage").json()
    assert gap["reason"] == f"refused: {name}: {WHY}"
    assert gap["to"] == format_time(came_ns)
    assert found["end"] == pytest.approx(came_ns / NS)
    assert [one["kind"] for one in found["missing"]].count("refused") == 1
    assert not [one for one in gaps if one["kind"] in ("to_come", "waiting")]


def test_stretches_of_one_reason_that_are_near_are_one() -> None:
    lost = [DataInterval(0, 1, "lost"), DataInterval(1.5, 2, "lost"), DataInterval(9, 10, "lost")]
    other = DataInterval(1, 3, "deleted")
    found = joined([*lost, other], least=1)
    assert found == [DataInterval(0, 2, "lost"), other, DataInterval(9, 10, "lost")]


def test_a_stretch_inside_another_does_not_shorten_it() -> None:
    assert joined([DataInterval(0, 9), DataInterval(1, 2)], least=0) == [DataInterval(0, 9)]


def test_variables_of_the_diagnosis_come_first(
    viewer: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    why = (
        CardReason(
            "No scans.", None, moment_href("ropod_001", ("odom.pose_x", "odom.pose_y"), T0_NS)
        ),
        CardReason("It runs.", None, moment_href("ropod_001", ("odom.pose_x",), None)),
    )
    card = DiagnosisCard("ropod_001", "open", None, why=why)
    monkeypatch.setattr(data, "current_card", lambda *_: card)
    assert '"named":["odom.pose_x","odom.pose_y"]' in viewer.get(PAGE).text


def test_a_note_is_put_where_it_belongs(home: House) -> None:
    at = format_time(T0_NS + 1_000_000)
    operator = home.client("operator")
    answer = operator.post(NOTES, json={"text": "it stopped here", "at": at})
    assert answer.status_code == 201
    assert [(note["at"], note["text"]) for note in answer.json()["notes"]] == [
        (at, "it stopped here")
    ]
    late = operator.post(NOTES, json={"text": "and now"}).json()["notes"]
    assert late[-1]["at"] == format_time(home.clock.wall_ns())


def test_others_robots_are_not_there(home: House) -> None:
    nurse = home.client("nurse")
    for path in ("", "/variables", "/coverage", "/around?from=0&to=1"):
        assert nurse.get(f"/robots/ropod_003/data{path}").status_code == 404


def test_one_question_tells_what_is_around_values(viewer: TestClient) -> None:
    api = "/api/v1/robots/ropod_001"
    span = {"from": format_time(T0_NS), "to": format_time(T0_NS + 100 * NS)}
    found = viewer.get(f"{PAGE}/around", params={**span, "item": "odom"}).json()
    parts = ["alarms", "gaps", "incidents", "missions", "notes", "refused", "timeline"]
    assert sorted(found) == parts
    assert found["refused"] == {}
    for name in ("incidents", "missions"):
        assert found[name] == viewer.get(f"{api}/{name}", params=span).json()
    assert found["missions"]
    lanes = viewer.get(f"{api}/timeline", params={**span, "points": 400}).json()
    assert found["timeline"] == lanes
    gaps = found["gaps"]
    assert (gaps["from"], gaps["to"]) == (T0_NS / NS - 50, T0_NS / NS + 150)
    wide = {"from": gaps["from"], "to": gaps["to"], "item": "odom"}
    assert gaps["items"] == {"odom": viewer.get(f"{api}/gaps", params=wide).json()}


def test_what_is_not_asked_for_is_not_told(viewer: TestClient) -> None:
    span = {"from": "now-1h", "to": "now", "marks": "false"}
    assert viewer.get(f"{PAGE}/around", params=span).json() == {"refused": {}}
    assert viewer.get(f"{PAGE}/around", params={"from": "", "to": ""}).status_code == 400


def test_a_part_that_is_refused_takes_no_other_with_it(
    viewer: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def busy(*_: object, **__: object) -> None:
        raise BusyError("too many questions wait")

    monkeypatch.setattr(data, "list_gaps", busy)
    span = {"from": "now-1h", "to": "now", "item": "odom"}
    found = viewer.get(f"{PAGE}/around", params=span).json()
    assert found["refused"] == {"gaps": "too many questions wait"}
    assert "gaps" not in found
    assert "timeline" in found


def test_parts_that_somebody_may_not_see_are_left_out(home: House) -> None:
    tokens = home.client("technician").post(
        "/api/v1/tokens", json={"name": "x", "scopes": ["read:data"]}
    )
    token = tokens.json()["token"]
    found = (
        home.client()
        .get(
            f"{PAGE}/around",
            params={"from": "now-1h", "to": "now", "item": "odom"},
            headers={"Authorization": f"Bearer {token}", "Accept": "application/json"},
        )
        .json()
    )
    assert sorted(found) == ["gaps", "incidents", "missions", "notes", "refused"]


def _seconds(text: str) -> float:
    return parse_time(text, lambda: 0, lambda: None) / NS
