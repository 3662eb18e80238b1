"""Alarms over the API: seen by those who may, changed by one at a time, every change audited."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from amberbox.core.robot_status import Severity
from amberbox.link.frames import Hello, LinkRow
from amberbox.monitoring.findings import AlarmChange, encoded
from amberbox.server.alarms.outbox import NotificationMessage
from amberbox.server.audit import rows as audited
from amberbox.server.bus import ServerChange
from tests.server.alarms.stand import STORE, Stand, blocked
from tests.server.house import House, house

API = "/api/v1/alarms"


@pytest.fixture
def home(tmp_path: Path) -> Iterator[House]:
    with house(tmp_path / "server") as found:
        settle(found)
        yield found


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """Keep a house in which nothing changes."""
    with house(tmp_path_factory.mktemp("still")) as found:
        settle(found)
        yield found


def settle(home: House) -> None:
    home.services.alarms.step()
    for robot in ("ropod_001", "ropod_003"):
        say(home, robot)


def say(
    home: House, robot: str, component: str = "laser", severity: Severity = "urgent", seq: int = 1
) -> None:
    now_ns = home.clock.wall_ns()
    told = AlarmChange(
        robot, f"{component}-1", component, severity, "open", "error", "gone", now_ns, now_ns, 1,
        "", None, "hash",
    )  # fmt: skip
    channel, data = encoded(told)
    row = LinkRow("watch", 1, seq, channel, now_ns, data)
    home.services.bus.publish(ServerChange("rows", robot, {"store_id": STORE, "rows": [row]}))
    home.services.alarms.step()


def ids(answer: Any) -> list[int]:
    assert answer.status_code == 200, answer.text
    return [one["id"] for one in answer.json()]


def test_they_are_listed_newest_first_and_by_page(still: House) -> None:
    viewer = still.client("viewer")
    assert ids(viewer.get(API)) == [2, 1]
    assert ids(viewer.get(API, params={"limit": 1})) == [2]
    assert ids(viewer.get(API, params={"limit": 1, "after": 2})) == [1]


@pytest.mark.parametrize(
    ("params", "found"),
    [
        ({"robot": "ropod_003"}, [2]),
        ({"group": "ward"}, [1]),
        ({"robot": "ropod_003", "group": "ward"}, []),
        ({"severity": "critical"}, []),
        ({"state": ["open", "shelved"]}, [2, 1]),
        ({"state": "resolved"}, []),
        ({"since": "now-1m"}, [2, 1]),
        ({"since": "now+1m"}, []),
    ],
)
def test_filters(still: House, params: dict[str, Any], found: list[int]) -> None:
    assert ids(still.client("viewer").get(API, params=params)) == found


def test_alarms_of_other_groups_are_not_there(still: House) -> None:
    nurse = still.client("nurse")
    assert ids(nurse.get(API)) == [1]
    assert ids(nurse.get(API, params={"robot": "ropod_003"})) == []
    there, missing = nurse.get(f"{API}/2"), nurse.get(f"{API}/77")
    assert there.status_code == 404 and there.text == missing.text
    answer = nurse.post(f"{API}/2/acknowledge", json={"revision": 1})
    assert answer.status_code == 404


def test_of_an_alarm_of_several_robots_one_sees_ones_own(home: House) -> None:
    for robot in ("ropod_001", "ropod_003"):
        home.services.bus.publish(ServerChange("gone", robot))
    home.services.alarms.step()
    home.clock.advance(130)
    home.services.alarms.step()
    everything, mine = home.client("operator"), home.client("nurse")
    assert len(everything.get(f"{API}/3").json()["alarm"]["robots"]) == 2
    page = mine.get(f"{API}/3").json()
    assert [one["robot"] for one in page["alarm"]["robots"]] == ["ropod_001"]
    assert "ropod_003" not in str(page)
    refused = mine.post(f"{API}/3/acknowledge", json={"revision": 1})
    assert (refused.status_code, "robots of others" in refused.text) == (403, True)


def test_how_many_of_others_are_back_is_not_told(home: House) -> None:
    services = home.services
    for robot in ("ropod_001", "ropod_003"):
        services.bus.publish(ServerChange("gone", robot))
    services.alarms.step()
    home.clock.advance(130)
    services.alarms.step()
    hello = Hello("ropod_003", STORE, "b", {}, "", home.clock.wall_ns(), 0, "1")
    services.bus.publish(
        ServerChange("connected", "ropod_003", {"hello": hello, "admission": None})
    )
    services.alarms.step()
    every, mine = (home.client(name).get(f"{API}/3").json() for name in ("operator", "nurse"))
    assert "back" in {one["what"] for one in every["history"]}
    assert "back" not in {one["what"] for one in mine["history"]}


def test_an_owner_that_is_nobody_tells_of_no_account(home: House) -> None:
    own = {"revision": 1, "user": "technicia"}
    answer = home.client("operator").post(f"{API}/1/own", json=own)
    assert answer.status_code == 400 and "technician" not in answer.text


def test_what_people_do_is_kept_with_who_and_when(home: House) -> None:
    operator = home.client("operator")
    heard: list[int] = []
    home.services.bus.on("alarm", lambda change: heard.append(change.data["id"]))
    answer = operator.post(f"{API}/1/acknowledge", json={"revision": 1, "note": "on my way"})
    alarm = answer.json()["alarm"]
    assert (alarm["state"], alarm["acknowledged"]["who"]) == ("acknowledged", "operator")
    own = {"revision": alarm["revision"], "user": "technician"}
    alarm = operator.post(f"{API}/1/own", json=own).json()["alarm"]
    assert alarm["owner"] == "technician"
    shelve = {"revision": alarm["revision"], "until": "now+2h", "reason": "spare part"}
    alarm = operator.post(f"{API}/1/shelve", json=shelve).json()["alarm"]
    assert (
        alarm["state"] == "shelved"
        and alarm["shelved"]["until"] == "2027-01-15T10:00:00.000000000Z"
    )
    unshelve = {"revision": alarm["revision"]}
    alarm = operator.post(f"{API}/1/unshelve", json=unshelve).json()["alarm"]
    assert alarm["state"] == "acknowledged"
    assert operator.post(f"{API}/1/note", json={"text": "it was the fuse"}).status_code == 200
    revision = operator.get(f"{API}/1").json()["alarm"]["revision"]
    resolve = {"revision": revision, "reason": "fuse replaced"}
    page = operator.post(f"{API}/1/resolve", json=resolve).json()
    assert page["alarm"]["resolved"]["reason"] == "fuse replaced" and page["alarm"]["active"]
    assert [(one["what"], one["who"]) for one in page["history"]] == [
        ("opened", ""), *((what, "operator") for what in (
            "acknowledged", "owned", "shelved", "unshelved", "note", "resolved")),
    ]  # fmt: skip
    assert heard == [1] * 6
    with home.services.database.reading() as connection:
        noted = [(row.action, row.object) for row in audited(connection)]
    assert noted == [
        (f"alarms.{what}", "1")
        for what in ("acknowledge", "own", "shelve", "unshelve", "note", "resolve")
    ]


def test_two_people_do_not_overwrite_each_other(home: House) -> None:
    operator, admin = home.client("operator"), home.client("admin")
    body = {"revision": 1, "user": "operator"}
    assert operator.post(f"{API}/1/own", json=body).status_code == 200
    answer = admin.post(f"{API}/1/own", json={"revision": 1, "user": "admin"})
    assert answer.status_code == 409 and "look at it again" in answer.text
    assert admin.get(f"{API}/1").json()["alarm"]["owner"] == "operator"


def test_that_it_lasts_or_comes_again_is_no_conflict(home: House) -> None:
    say(home, "ropod_001", seq=2)
    operator = home.client("operator")
    answer = operator.post(f"{API}/1/acknowledge", json={"revision": 1})
    assert answer.status_code == 200


def test_that_it_got_worse_is_a_conflict(home: House) -> None:
    say(home, "ropod_001", severity="fatal", seq=2)
    operator = home.client("operator")
    assert operator.post(f"{API}/1/acknowledge", json={"revision": 1}).status_code == 409


@pytest.mark.parametrize(
    ("action", "body", "status"),
    [
        ("acknowledge", {}, 422),
        ("acknowledge", {"revision": 1, "who": "anna"}, 422),
        ("shelve", {"revision": 1, "until": "now-2h", "reason": "x"}, 400),
        ("shelve", {"revision": 1, "until": "now+99999h", "reason": "x"}, 400),
        ("shelve", {"revision": 1, "until": "soon", "reason": "x"}, 400),
        ("shelve", {"revision": 1, "until": "now+2h", "reason": " "}, 422),
        ("unshelve", {"revision": 1}, 400),
        ("own", {"revision": 1, "user": "nobody"}, 400),
        ("note", {"text": "x" * 2001}, 422),
        ("resolve", {"revision": 1, "reason": ""}, 422),
    ],
)
def test_what_makes_no_sense_is_refused(
    still: House, action: str, body: dict[str, Any], status: int
) -> None:
    answer = still.client("operator").post(f"{API}/1/{action}", json=body)
    assert (answer.status_code, answer.json()["error"]["what"] != "") == (status, True)
    assert still.client("operator").get(f"{API}/1").json()["alarm"]["revision"] == 1


def test_what_is_over_cannot_be_changed(home: House) -> None:
    operator = home.client("operator")
    operator.post(f"{API}/1/resolve", json={"revision": 1, "reason": "done"})
    answer = operator.post(f"{API}/1/acknowledge", json={"revision": 2})
    assert answer.status_code == 400 and "is over" in answer.text


def test_viewers_and_tokens_without_the_scope_change_nothing(home: House) -> None:
    body = {"revision": 1}
    assert home.client("viewer").post(f"{API}/1/acknowledge", json=body).status_code == 403
    reader = home.token_client("technician", "read:alarms")
    assert reader.get(API).status_code == 200
    assert reader.post(f"{API}/1/acknowledge", json=body).status_code == 403
    writer = home.token_client("technician", "write:alarms")
    page = writer.post(f"{API}/1/acknowledge", json=body).json()
    assert page["alarm"]["acknowledged"]["who"].endswith("of technician")


def test_consequences_and_the_window_of_data(home: House) -> None:
    stand = Stand.__new__(Stand)
    stand.clock = home.clock
    channel, data = encoded(blocked(stand, "loc", "laser"))
    row = LinkRow("watch", 1, 9, channel, home.clock.wall_ns(), data)
    home.services.bus.publish(ServerChange("rows", "ropod_001", {"store_id": STORE, "rows": [row]}))
    home.services.alarms.step()
    page = home.client("viewer").get(f"{API}/1").json()
    assert [one["component"] for one in page["consequences"]] == ["loc"]
    assert page["alarm"]["window"] == {
        "robot": "ropod_001", "from": "2027-01-15T07:59:00.000000000Z", "to": None,
    }  # fmt: skip


def test_a_test_is_sent_to_a_destination_of_the_settings_only(home: House) -> None:
    admin = home.client("admin")
    hook = {"name": "hook", "url": "https://hook.example/", "secret": "0123456789abcdef"}
    answer = admin.put("/api/v1/settings/notifications", json={"webhooks": [hook]})
    assert answer.status_code == 200 and "0123456789abcdef" not in answer.text
    sent: list[str] = []

    def deliver(to: Any, message: NotificationMessage, *_: Any) -> str:
        sent.append(to.secret + message.data["type"])
        return "" if len(sent) == 1 else "the answer was 500"

    home.services.alarms.sender.deliver = deliver
    where = "/api/v1/settings/notifications/test"
    assert admin.post(where, json={"destination": "other"}).status_code == 404
    answers = [admin.post(where, json={"destination": "hook"}).json() for _ in range(2)]
    assert answers == [
        {"arrived": True, "trouble": ""}, {"arrived": False, "trouble": "the answer was 500"},
    ]  # fmt: skip
    assert sent == ["0123456789abcdeftest"] * 2
    assert home.client("technician").post(where, json={"destination": "hook"}).status_code == 403


def test_a_masked_secret_does_not_go_to_another_address(home: House) -> None:
    admin = home.client("admin")
    where = "/api/v1/settings/notifications"
    smtp = {"host": "mail.example", "sender": "a@b.example", "user": "u", "password": "hush-hush"}
    assert admin.put(where, json={"smtp": smtp}).json()["value"]["smtp"]["password"] == "***"
    other = {**smtp, "password": "***", "port": 465, "security": "tls"}
    assert admin.put(where, json={"smtp": other}).status_code == 200
    moved = admin.put(where, json={"smtp": {**other, "host": "evil.example"}})
    assert moved.status_code == 400 and "hush-hush" not in moved.text


def test_what_became_of_messages_is_shown_to_admins(home: House) -> None:
    admin = home.client("admin")
    hook = {"name": "hook", "url": "https://hook.example/", "secret": "0123456789abcdef"}
    admin.put("/api/v1/settings/notifications", json={"webhooks": [hook]})
    alarms = home.services.alarms
    alarms.sender.deliver = lambda *_: "nobody there"
    home.clock.advance(15)
    alarms.step()
    alarms.sender.step()
    where = "/api/v1/settings/notifications/messages"
    found = admin.get(where, params={"state": "waiting"}).json()
    assert [(one["alarm"], one["trouble"]) for one in found] == [
        (2, "nobody there"), (1, "nobody there"),
    ]  # fmt: skip
    assert [one["alarm"] for one in admin.get(where, params={"alarm": 1}).json()] == [1]
    assert admin.get(where, params={"state": "sent"}).json() == []
    assert home.client("technician").get(where).status_code == 403
