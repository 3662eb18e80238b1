"""Notes on moments of a robot, whether a mission was under way or not."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time
from tests.server.house import START_NS, House, house

ROBOT = "/api/v1/robots/ropod_001"
MINUTE_NS = 60 * NS


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("notes"), shared=True) as found:
        yield found


def at(minutes: int) -> str:
    return format_time(START_NS - minutes * MINUTE_NS)


def note(home: House, text: str, path: str = "notes", who: str = "operator", **more: Any) -> Any:
    answer = home.client(who).post(f"{ROBOT}/{path}", json={"text": text, **more})
    assert answer.status_code == 201, answer.text
    return answer.json()


def notes(home: House, robot: str = ROBOT, **asked: Any) -> list[dict[str, Any]]:
    answer = home.client("viewer").get(f"{robot}/notes", params=asked)
    assert answer.status_code == 200, answer.text
    found: list[dict[str, Any]] = answer.json()
    return found


def test_a_note_stands_at_a_moment_without_any_mission(home: House) -> None:
    made = note(home, "the wheel squeaks", at=at(30))
    assert made == {"id": made["id"], "at": at(30), "who": "user:operator",
                    "text": "the wheel squeaks", "mission": "", "note": made["note"], "to": None,
                    "about": "", "revision": 1}  # fmt: skip
    assert notes(home, **{"from": at(31), "to": at(29)}) == [made]
    assert notes(home, **{"from": at(29)}) == notes(home, to=at(30)) == []
    assert notes(home, "/api/v1/robots/ropod_002") == []


def test_without_a_time_it_is_now(home: House) -> None:
    assert note(home, "it stopped")["at"] == format_time(home.clock.wall_ns())


def test_notes_on_missions_are_listed_with_the_others_newest_first(home: House) -> None:
    begun = home.client("operator").post(f"{ROBOT}/missions", json={"name": "d", "at": at(20)})
    mission = begun.json()["id"]
    note(home, "on the mission", f"missions/{mission}/notes", at=at(12))
    for text in ("first", "second"):
        note(home, text, at=at(11))
    window = {"from": at(13), "to": at(10)}
    found = notes(home, **window)
    assert [(one["text"], one["mission"]) for one in found] == [
        ("second", ""), ("first", ""), ("on the mission", mission),
    ]  # fmt: skip
    paged, after = [], None
    while page := notes(home, **window, limit=1, **({"after": after} if after else {})):
        paged += page
        after = page[-1]["id"]
    assert paged == found
    shown = home.client("viewer").get(f"{ROBOT}/missions/{mission}").json()["notes"]
    assert [one["text"] for one in shown] == ["on the mission"]


def test_a_note_is_in_the_audit_log(home: House) -> None:
    made = note(home, "who wrote this", at=at(5))
    newest = home.client("admin").get("/api/v1/audit", params={"action": "notes.add"}).json()[0]
    assert newest["details"] == {"id": made["id"], "at": at(5), "text": "who wrote this"}


def test_who_may_not_write_missions_may_not_write_notes(home: House) -> None:
    answer = home.client("viewer").post(f"{ROBOT}/notes", json={"text": "no"})
    assert answer.status_code == 403
    assert home.client("nurse").get("/api/v1/robots/ropod_003/notes").status_code == 404


@pytest.mark.parametrize("body", [{"text": ""}, {}, {"text": "x", "at": "yesterdayish"},
                                  {"text": "x" * 4001}])  # fmt: skip
def test_what_is_no_note_is_refused(home: House, body: dict[str, Any]) -> None:
    assert home.client("operator").post(f"{ROBOT}/notes", json=body).status_code in (400, 422)


def test_the_data_page_is_told_of_notes_on_moments_alone(home: House) -> None:
    made = note(home, "seen on the plot", at=at(3))
    path = "/robots/ropod_001/data/around"
    around = home.client("viewer").get(path, params={"from": at(4), "to": at(2)}).json()
    assert around["notes"] == [made]
    window = {"from": at(13), "to": at(11)}
    assert home.client("viewer").get(path, params=window).json()["notes"] == []


def test_a_note_on_a_range_is_found_wherever_the_range_is(home: House) -> None:
    made = note(home, "wet floor", at=at(60), to=at(50), about="odom.speed")
    assert made["to"] == at(50) and made["about"] == "odom.speed"
    assert notes(home, **{"from": at(55), "to": at(54)}) == [made]
    assert notes(home, **{"from": at(50), "to": at(49)}) == []
    wrong = home.client("operator").post(
        f"{ROBOT}/notes", json={"text": "x", "at": at(50), "to": at(60)}
    )
    assert wrong.status_code == 400


def test_a_note_is_changed_and_withdrawn_and_stays_in_the_audit_log(home: House) -> None:
    made = note(home, "squeks", at=at(70))
    path, window = f"{ROBOT}/notes/{made['note']}", {"from": at(71), "to": at(69)}
    client = home.client("operator")
    changed = client.post(path, json={"text": "squeaks"}).json()
    assert changed == {**made, "text": "squeaks", "revision": 2}
    assert notes(home, **window) == [changed]
    assert home.client("viewer").post(path, json={"text": "no"}).status_code == 403
    other = "/api/v1/robots/ropod_002/notes/" + made["note"]
    assert client.post(other, json={"text": "no"}).status_code == 400
    assert client.post(f"{path}/withdraw").status_code == 200
    assert notes(home, **window) == []
    assert client.post(f"{path}/withdraw").status_code == 400
    log = home.client("admin").get("/api/v1/audit", params={"action": "notes.withdraw"}).json()
    assert log[0]["details"]["id"] == made["note"]
