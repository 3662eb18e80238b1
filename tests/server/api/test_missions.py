"""Missions, incidents and recordings over the API."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time
from amberbox.server.journals import Retention
from amberbox.server.schema import UPLOAD
from amberbox.server.settings import write
from amberbox.testing.records import T0_NS
from tests.server.data.filled import fill
from tests.server.house import House, house

ROBOT = "/api/v1/robots/ropod_001"
DAY_S = 86_400


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    folder = tmp_path_factory.mktemp("missions")
    with house(folder / "server") as found:
        fill(found, folder)
        yield found


def get(home: House, path: str, **parameters: Any) -> Any:
    return home.client("viewer").get(f"{ROBOT}/{path}", params=parameters).json()


def post(home: House, path: str, body: dict[str, Any], status: int = 201) -> Any:
    answer = home.client("operator").post(f"{ROBOT}/{path}", json=body)
    assert answer.status_code == status, answer.text
    return answer.json()


def test_missions_of_the_robot_are_listed(home: House) -> None:
    found = get(home, "missions/transport-1")
    assert found["origin"] == "robot"
    assert (found["from"], found["to"]) == (format_time(T0_NS), format_time(T0_NS + NS // 2))
    assert (found["outcome"], found["failed"]) == ("aborted", True)
    assert found["parameters"] == {"to": "B"}


def test_people_begin_and_end_missions(home: House) -> None:
    begun = post(home, "missions", {"name": "drill", "parameters": {"floor": 2}})
    assert (begun["origin"], begun["to"]) == ("server", None)
    assert begun["from"] == format_time(home.clock.wall_ns())
    again = post(home, "missions", {"name": "drill"})
    assert get(home, f"missions/{begun['id']}")["outcome"] == "superseded"
    ended = post(home, f"missions/{again['id']}/end", {"outcome": "timeout"}, 200)
    assert ended["failed"]
    assert "ended already" in post(home, f"missions/{again['id']}/end", {}, 400)["error"]["what"]
    early = {"at": "2026-01-01T00:00:00Z"}
    third = post(home, "missions", {"name": "other"})
    assert "began later" in post(home, f"missions/{third['id']}/end", early, 400)["error"]["what"]
    listed = get(home, "missions")
    assert [one["from"] for one in listed] == sorted((o["from"] for o in listed), reverse=True)
    assert {one["id"] for one in get(home, "missions", failed=True)} >= {again["id"], "transport-1"}
    window = {"from": format_time(T0_NS), "to": format_time(T0_NS + NS)}
    assert [one["id"] for one in get(home, "missions", **window)] == ["transport-1"]


def test_pages_of_missions_go_on(home: House) -> None:
    seen: list[str] = []
    after = ""
    while page := get(home, "missions", limit=1, after=after):
        seen += [one["id"] for one in page]
        after = seen[-1]
    assert seen == [one["id"] for one in get(home, "missions")]


def test_the_robot_ends_its_own_missions(home: House) -> None:
    refused = post(home, "missions/transport-1/end", {}, 400)
    assert refused["error"]["hint"] == "the robot ends its own missions"


def test_notes_stay_with_a_mission(home: House) -> None:
    post(home, "missions/transport-1/notes", {"text": "the door was <b>shut</b>"})
    (note,) = get(home, "missions/transport-1")["notes"]
    assert note["text"] == "the door was <b>shut</b>"
    assert note["who"] == "user:operator"
    assert home.client("operator").post(
        f"{ROBOT}/missions/nothing/notes", json={"text": "x"}
    ).status_code == 404  # fmt: skip


def test_incidents_of_robots_and_people_are_listed(home: House) -> None:
    window = {"from": format_time(T0_NS), "to": format_time(T0_NS + NS), "reason": "odd noise"}
    marked = post(home, "incidents", window)
    assert (marked["origin"], marked["state"]) == ("server", "complete")
    found = {one["id"]: one for one in get(home, "incidents")}
    assert found["incident-1"]["state"] == "complete"
    assert found["incident-1"]["trigger"] == "bump"
    assert found[marked["id"]]["reason"] == "odd noise"
    assert get(home, "incidents", **{"from": format_time(T0_NS + 2 * NS)}) == []
    released = post(home, f"incidents/{marked['id']}/release", {}, 200)
    assert released["state"] == "released"
    post(home, f"incidents/{marked['id']}/release", {}, 400)
    post(home, "incidents/incident-1/release", {}, 400)


def test_what_a_marked_window_covers_stays(home: House) -> None:
    rules = [Retention("ropod_003", "*", 0, 0)]
    archive, client = home.services.archive, home.client("operator")
    window = {"from": format_time(T0_NS), "to": format_time(T0_NS + 3600 * NS), "reason": "keep"}
    url = "/api/v1/robots/ropod_003/incidents"
    marked = client.post(url, json=window).json()
    home.clock.advance(3 * DAY_S)
    try:
        assert archive.retain(rules) == 0
        client = home.client("operator")
        assert client.post(f"{url}/{marked['id']}/release").status_code == 200
        assert archive.retain(rules) == 1
    finally:
        home.clock.advance(-3 * DAY_S)
    (gone,) = home.client("viewer").get("/api/v1/robots/ropod_003/recordings").json()
    assert gone["integrity"] == "deleted"


def test_recordings_say_whether_they_hold(home: House) -> None:
    with home.services.database.begin() as connection:
        write(connection, 0, "retention", [Retention("*", "main", 10.0 * DAY_S, None)])
    archive, robot = home.services.archive, "ropod_001"
    rows = [r for r in archive.catalogue.journals() if r.robot == robot and r.keeping == "main"]
    paths = [archive.layout.journal(robot, row.store_id, row.file) for row in rows]
    _sign(home, rows[0])
    content = bytearray(paths[1].read_bytes())
    content[len(content) // 2] ^= 1
    paths[1].write_bytes(content)
    paths[2].unlink()
    found = {one["journal"]: one for one in get(home, "recordings")}
    checked = {one["journal"]: one for one in get(home, "recordings", check=True, limit=50)}
    states = [found[row.file]["integrity"] for row in rows[:4]]
    assert states == ["intact", "unsigned", "missing", "unsigned"]
    assert checked[rows[1].file]["integrity"] == "altered"
    assert checked[rows[0].file]["integrity"] == "intact"
    first = found[rows[0].file]
    assert (first["rows"], first["bytes"], first["state"]) == (
        rows[0].rows, rows[0].bytes, "in_columns"
    )  # fmt: skip
    assert first["journal_until"] == format_time(rows[0].put_ns + 10 * DAY_S * NS)
    assert first["columns_until"] is None
    assert [one["state"] for one in found.values()].count("waiting") == 1
    assert home.client("viewer").get(f"{ROBOT}/recordings?check=true").status_code == 400


def _sign(home: House, journal: Any) -> None:
    texts = dict.fromkeys(("reason", "path"), "")
    numbers = dict.fromkeys(("number", "began_ns"), 0)
    names = ("robot", "store_id", "sha256", "bytes", "writer", "run", "first_seq", "end_seq",
             "start_ns", "end_ns")  # fmt: skip
    row = {name: getattr(journal, name) for name in names}
    known = {"journal": journal.file, "state": "verified", "signed": True}
    with home.services.database.begin() as connection:
        connection.execute(UPLOAD.insert(), [{**row, **texts, **numbers, **known}])


@pytest.mark.parametrize("path", ["missions", "incidents", "recordings", "missions/transport-1"])
def test_others_see_nothing(home: House, path: str) -> None:
    away = f"/api/v1/robots/ropod_003/{path}"
    assert home.client("nurse").get(away).status_code == 404
    assert home.client().get(f"{ROBOT}/{path}").status_code == 401


def test_viewers_change_nothing(home: House) -> None:
    viewer = home.client("viewer")
    window = {"from": "now-1h", "to": "now", "reason": "x"}
    assert viewer.post(f"{ROBOT}/missions", json={"name": "drill"}).status_code == 403
    assert viewer.post(f"{ROBOT}/incidents", json=window).status_code == 403
    assert viewer.post(f"{ROBOT}/missions/transport-1/end", json={}).status_code == 403
