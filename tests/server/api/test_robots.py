"""Robots over the API: cards, trees, what changed when, links; hostile robots break nothing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from amberbox.core.clock import NS
from amberbox.server.bus import ServerChange
from amberbox.server.schema import ROW
from tests.server.house import House, house
from tests.server.state.lives import (
    EVENT,
    HASH,
    MISSION,
    STATUS,
    connect,
    keep_folder,
    put_alarm,
    say,
    status,
    transition,
)

AHEAD_NS = 3600 * NS
"""The server's clock is an hour ahead of the robot's."""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("robots") / "server") as found:
        live(found)
        yield found


def live(home: House) -> None:
    """Let one robot live: its laser is bad, and navigation because of it."""
    connect(home, "ropod_001", ahead_ns=AHEAD_NS, config_hash=HASH)
    keep_folder(home, "ropod_001")
    at_ns = home.clock.wall_ns() - AHEAD_NS
    outputs = [{"name": "front_laser_working", "type": "bool", "value": 0, "text": None}]
    bad = {"state": "front_laser_working", "reason": "front_laser_working is false, expected true"}
    said: list[tuple[str, Any]] = [
        (STATUS, status("laser", "error", at_ns - NS, **bad)),
        (STATUS, status("laser", "error", at_ns - NS, mode="laser_device_monitor",
                        outputs=outputs, **bad)),
        (STATUS, status("navigation", "error", at_ns - NS, blocked_by=["laser"])),
        (STATUS, status("battery", "ok", at_ns - NS)),
        (STATUS, status("battery", "ok", at_ns - NS, mode="charge", outputs=[
            {"name": "charge_percent", "type": "float", "value": 81.5, "text": None}])),
        (EVENT, transition("laser", "ok", "error", at_ns - 60 * NS)),
        (EVENT, {"kind": "power", "text": "low", "source": "x", "details": ""}),
        (MISSION, {"id": "m1", "name": "transport", "state": "started", "from_ns": at_ns,
                   "to_ns": None}),
    ]  # fmt: skip
    for seq, (channel, values) in enumerate(said):
        say(home, "ropod_001", channel, at_ns - (60 * NS if channel == EVENT else 0), seq, values)
    put_alarm(home, 1, "ropod_001")
    put_alarm(home, 2, "ropod_001", "ropod_002", severity="critical")
    home.services.feed.state._load("ropod_001")


def test_cards_say_what_is_worst_and_why(home: House) -> None:
    cards = {card["robot"]: card for card in home.client("viewer").get("/api/v1/robots").json()}
    assert list(cards) == ["ropod_001", "ropod_002", "ropod_003"]
    card = cards["ropod_001"]
    assert (card["online"], card["level"], card["model"]) == (True, "error", "Ropod 2")
    assert card["cause"] == "laser: front_laser_working is false, expected true"
    assert (card["backlog_rows"], card["backlog_bytes"]) == (7, 900)
    assert card["components"] == {"ok": 1, "error": 2}
    assert (card["alarms"], card["severity"]) == (2, "critical")
    assert cards["ropod_002"]["alarms"] == 1
    assert card["mission"]["name"] == "transport"
    assert card["battery"] == {"output": "charge_percent", "value": 81.5}
    never = cards["ropod_003"]
    assert (never["online"], never["level"], never["cause"]) == (
        False, "unknown", "it has never connected"
    )  # fmt: skip
    assert never["last_seen"] is None and never["groups"] == ["kitchen"]


def test_lists_are_of_a_group_and_in_pages(home: House) -> None:
    viewer = home.client("viewer")

    def listed(**query: Any) -> list[str]:
        return [card["robot"] for card in viewer.get("/api/v1/robots", params=query).json()]

    assert listed(group="ward") == ["ropod_001", "ropod_002"]
    assert listed(group="nowhere") == []
    assert listed(limit=1) == ["ropod_001"]
    assert listed(after="ropod_001", limit=1) == ["ropod_002"]
    nurse = home.client("nurse")
    assert [c["robot"] for c in nurse.get("/api/v1/robots").json()] == ["ropod_001", "ropod_002"]
    assert nurse.get("/api/v1/robots/ropod_003/status").status_code == 404


def test_the_tree_has_needs_outputs_and_ages(home: House) -> None:
    tree = home.client("viewer").get("/api/v1/robots/ropod_001/status").json()
    assert tree["note"] == "" and tree["silence"] == "" and tree["clock_offset_s"] == 3600.0
    components = {one["component"]: one for one in tree["components"]}
    assert [(one["component"], one["depth"]) for one in tree["components"]] == [
        ("navigation", 0), ("laser", 1), ("battery", 0)
    ]  # fmt: skip
    needs = components["navigation"]["needs"]
    assert needs == [{"name": "laser", "component": "laser", "level": "error"}]
    (mode,) = components["laser"]["modes"]
    (output,) = mode["outputs"]
    assert (output["value"], output["expected"], output["type"]) == (False, "true", "bool")
    condition = components["laser"]["condition"]
    assert condition["age_s"] == pytest.approx(1.0)  # by the robot's clock; the link took no time
    assert condition["for_s"] == 60.0
    assert condition["measured"] == "2027-01-15T07:59:59.000000000Z"


def test_what_is_said_no_more_counts_no_more(home: House) -> None:
    home.clock.advance(60)
    viewer = home.client("viewer")
    card = viewer.get("/api/v1/robots/ropod_001").json()
    assert (card["level"], card["last_level"]) == ("unknown", "error")
    assert card["cause"] == "its watcher has said nothing for 60 s"
    one = home.services.links.robots.pop("ropod_001")
    card = viewer.get("/api/v1/robots/ropod_001").json()
    assert card["cause"] == "offline, last seen 60 s ago" and not card["online"]
    home.services.links.robots["ropod_001"] = one
    home.clock.advance(-60)


def test_what_came_late_counts_as_old_as_it_is(home: House) -> None:
    connect(home, "ropod_003")
    at_ns = home.clock.wall_ns() - 8 * 3600 * NS
    say(home, "ropod_003", STATUS, at_ns, 1, status("laser", "ok", at_ns))
    card = home.client("viewer").get("/api/v1/robots/ropod_003").json()
    assert (card["online"], card["level"], card["last_level"]) == (True, "unknown", "ok")
    assert card["cause"] == "what it says is 8 h old"


def test_the_timeline_shows_stretches(home: House) -> None:
    viewer = home.client("viewer")
    query = {"from": "2027-01-15T06:50:00Z", "to": "2027-01-15T07:00:00Z", "component": "laser"}
    found = viewer.get("/api/v1/robots/ropod_001/timeline", params=query).json()
    lanes = {(lane["component"], lane["mode"]): lane["stretches"] for lane in found["lanes"]}
    before, after = lanes["laser", ""]
    assert (before["level"], after["level"]) == ("ok", "error")
    assert before["to"] == after["from"] == "2027-01-15T06:59:00.000000000Z"
    assert found["complete"] and lanes["laser", "laser_device_monitor"][0]["level"] == "error"
    wrong = {"from": "2027-01-15T07:00:00Z", "to": "2027-01-15T06:00:00Z"}
    assert viewer.get("/api/v1/robots/ropod_001/timeline", params=wrong).status_code == 400


def test_events_are_of_a_kind_and_a_range(home: House) -> None:
    viewer = home.client("viewer")
    found = viewer.get("/api/v1/robots/ropod_001/events").json()
    assert [event["kind"] for event in found] == ["component_state", "power"]
    assert found[0]["at"] == "2027-01-15T06:59:00.000000000Z"
    assert found[0]["server_at"] == "2027-01-15T07:59:00.000000000Z"
    (only,) = viewer.get("/api/v1/robots/ropod_001/events?kind=power").json()
    assert only["text"] == "low"
    assert viewer.get("/api/v1/robots/ropod_001/events?to=2000-01-01").json() == []
    assert viewer.get("/api/v1/robots/ropod_001/events?from=yesterday").status_code == 400


def test_the_link_has_stores_and_clocks(home: House) -> None:
    found = home.client("viewer").get("/api/v1/robots/ropod_001/link").json()
    assert found["stores"][0]["store_id"] == "s"
    assert found["clocks"][0]["offset_s"] == 3600.0
    assert [event["kind"] for event in found["events"]] == ["folder"]
    number = found["events"][0]["number"]
    assert home.client("viewer").get(
        "/api/v1/robots/ropod_001/link", params={"after": number}
    ).json()["events"] == []  # fmt: skip


def test_what_a_robot_says_cannot_break_what_is_shown(home: House) -> None:
    at_ns = home.clock.wall_ns()
    connect(home, "ropod_002")
    for seq, values in enumerate([
        status("big", "purple", at_ns, since_ns=10**30),
        status("far", "ok", at_ns, since_ns=2**63),
        {"component": "bad", "outputs": "none"},
        status("many", "ok", at_ns, outputs=[{"name": "n", "type": "int", "value": 1e308}]),
    ]):  # fmt: skip
        say(home, "ropod_002", STATUS, at_ns, seq, values)
    say(home, "ropod_002", EVENT, 2**62, 10, {"kind": "component_state", "details": "[[[["})
    with home.services.database.begin() as connection:
        row = {"robot": "ropod_002", "store_id": "s", "writer": "watch", "run": 1, "seq": 11,
               "channel": EVENT, "log_ns": at_ns, "data": b"\xff", "received_ns": 0}  # fmt: skip
        connection.execute(ROW.insert(), [row])
    viewer = home.client("viewer")
    for path in ("", "/ropod_002", "/ropod_002/status", "/ropod_002/timeline",
                 "/ropod_002/events", "/ropod_002/link"):  # fmt: skip
        assert viewer.get(f"/api/v1/robots{path}").status_code == 200, path


def test_a_newer_mission_shows_without_being_asked_for(home: House) -> None:
    state = home.services.feed.state
    row = say(home, "ropod_001", MISSION, home.clock.wall_ns(), 50,
              {"id": "m1", "name": "transport", "state": "ended", "to_ns": 5})  # fmt: skip
    state._rows(ServerChange("rows", "ropod_001", {"store_id": "s", "rows": [row]}))
    card = home.client("viewer").get("/api/v1/robots/ropod_001").json()
    assert card["mission"] is None
