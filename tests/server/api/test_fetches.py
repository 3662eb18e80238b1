"""Windows asked of robots: sent when they connect, answered, copied, or gone."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from amberbox.link.frames import FetchFrame, ServerFrame
from amberbox.link.limits import FILES
from amberbox.server.bus import ServerChange
from amberbox.server.ingest import fetches
from amberbox.server.schema import UPLOAD
from amberbox.testing.clock import ManualClock
from tests.server.house import House, house, work_until

FETCHES = "/api/v1/robots/ropod_001/fetches"
WINDOW = {"item": "odom", "from": "2026-09-21T14:00:00Z", "to": "2026-09-21T14:10:00Z"}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("fetches") / "server") as found:
        yield found


@pytest.fixture
def frames(home: House, monkeypatch: pytest.MonkeyPatch) -> list[ServerFrame]:
    """What ``ropod_001`` is sent; it is connected."""
    sent: list[ServerFrame] = []

    async def send(robot: str, frame: ServerFrame) -> bool:
        assert robot == "ropod_001"
        sent.append(frame)
        return True

    monkeypatch.setattr(home.services.links, "send", send)
    monkeypatch.setitem(home.services.links.robots, "ropod_001", None)
    return sent


def told(home: House, changes: list[ServerChange], until: Callable[[], bool]) -> None:
    """Run the service while it receives changes."""
    fetches = home.services.fetches

    def begun() -> None:
        for change in changes:
            fetches._on_change(change)

    work_until(fetches.run, until, begun)


def ask(home: House, **wanted: str) -> dict[str, Any]:
    answer = home.client("technician").post(FETCHES, json={**WINDOW, **wanted})
    assert answer.status_code == 202, answer.text
    return dict(answer.json())


def state(home: House, one: dict[str, Any]) -> Any:
    return home.client("viewer").get(f"{FETCHES}/{one['id']}").json()


def has(one: dict[str, Any], *files: tuple[str, int]) -> ServerChange:
    return ServerChange(
        "has", "ropod_001", {"store_id": "s1", "id": one["id"], "files": list(files)}
    )


def arrived(home: House, journal: str, state: str = "verified") -> ServerChange:
    row = dict.fromkeys(("reason", "path", "writer"), "") | dict.fromkeys(
        ("bytes", "run", "number", "first_seq", "end_seq", "start_ns", "end_ns", "began_ns"), 0
    )
    with home.services.database.begin() as connection:
        known = {"robot": "ropod_001", "store_id": "s1", "journal": journal, "signed": True}
        connection.execute(UPLOAD.insert(), [{**row, **known, "sha256": "0", "state": state}])
    return ServerChange(
        "journal", "ropod_001", {"store_id": "s1", "journal": journal, "state": state}
    )


def test_it_waits_for_a_robot_that_is_away(home: House) -> None:
    one = ask(home)
    assert (one["state"], one["from"]) == ("waiting", "2026-09-21T14:00:00.000000000Z")
    told(home, [], lambda: state(home, one)["state"] == "waiting")
    home.client("technician").delete(f"{FETCHES}/{one['id']}")
    assert state(home, one)["state"] == "cancelled"


def test_it_is_sent_copied_and_ready(home: House, frames: list[ServerFrame]) -> None:
    one = ask(home)
    told(
        home, [ServerChange("connected", "ropod_001")], lambda: state(home, one)["state"] == "asked"
    )
    (frame, *_) = frames
    assert isinstance(frame, FetchFrame)
    assert (frame.id, frame.item) == (one["id"], "odom")
    assert frame.to_ns - frame.from_ns == 600 * 10**9
    files = [("journal/000001-a-0000.mcap", 10), ("journal/000001-a-0001.mcap", 20)]
    told(home, [has(one, *files)], lambda: state(home, one)["state"] == "copying")
    first = arrived(home, files[0][0])
    told(home, [first], lambda: state(home, one)["copied"] == 1)
    assert state(home, one)["state"] == "copying"
    # asked again the robot names only what it still has
    told(home, [has(one, files[1])], lambda: state(home, one)["copied"] == 1)
    second = arrived(home, files[1][0], "quarantined")
    told(home, [second], lambda: state(home, one)["state"] == "ready")
    assert [file["state"] for file in state(home, one)["journals"]] == ["verified", "quarantined"]


def test_what_the_robot_has_no_more_is_gone(home: House, frames: list[ServerFrame]) -> None:
    one = ask(home, item="")
    told(home, [has(one)], lambda: state(home, one)["state"] == "gone")
    told(home, [ServerChange("connected", "ropod_001")], lambda: bool(state(home, one)["ended"]))
    assert one["id"] not in {f.id for f in frames[1:] if isinstance(f, FetchFrame)}


def test_what_the_robot_deletes_before_it_is_copied_is_not_waited_for(
    home: House, frames: list[ServerFrame]
) -> None:
    one = ask(home, item="laser")
    files = [("journal/000002-a-0000.mcap", 10), ("journal/000002-a-0001.mcap", 20)]
    told(home, [has(one, *files)], lambda: state(home, one)["state"] == "copying")
    told(home, [has(one, files[1])], lambda: state(home, one)["copied"] == 1)
    last = arrived(home, files[1][0])
    told(home, [last], lambda: state(home, one)["state"] == "ready")
    assert [file["state"] for file in state(home, one)["journals"]] == ["gone", "verified"]
    other = ask(home, item="imu")
    lost = ("journal/000002-a-0002.mcap", 10)
    told(home, [has(other, lost)], lambda: state(home, other)["state"] == "copying")
    told(home, [has(other)], lambda: state(home, other)["state"] == "gone")


@pytest.fixture
def hour(home: House, monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Let time pass for windows that wait for robots, and run the service's step."""
    fetches, clock = home.services.fetches, ManualClock()
    monkeypatch.setattr(fetches, "_clock", clock)

    def wait(hours: float) -> None:
        clock.advance(3600 * hours)
        asyncio.run(fetches._check_all())

    return wait


def test_a_robot_that_takes_for_copied_what_is_not_here_is_not_waited_for_for_ever(
    home: House, frames: list[ServerFrame], hour: Callable[[float], None]
) -> None:
    """An older robot that never compares its journals; the server was restored from a backup."""
    one, other = ask(home, item="lost"), ask(home, item="half")
    files = [("journal/000009-a-0000.mcap", 10), ("journal/000009-a-0001.mcap", 20)]
    named = [ServerChange("connected", "ropod_001"), has(one, files[0]), has(other, *files)]
    told(home, named, lambda: state(home, other)["state"] == "copying")
    hour(0)
    hour(0.9)
    told(home, [arrived(home, files[1][0])], lambda: state(home, other)["copied"] == 1)
    hour(0.9)
    assert state(home, one)["state"] == "copying", "something came half an hour ago"
    assert state(home, one)["reason"] == ""
    hour(1.1)
    assert (state(home, one)["state"], state(home, other)["state"]) == ("gone", "ready")
    assert state(home, one)["ended"]
    assert "1 of 1 journals did not come" in state(home, one)["reason"]
    assert "update it on the robot" in state(home, one)["reason"]
    assert [file["state"] for file in state(home, other)["journals"]] == ["late", "verified"]


def test_a_robot_that_sends_again_what_is_missing_is_waited_for(
    home: House, frames: list[ServerFrame], hour: Callable[[float], None]
) -> None:
    one = ask(home, item="later")
    asks = [ServerChange("connected", "ropod_001"), ServerChange("holdings", "ropod_001")]
    named = has(one, ("journal/000008-a-0000.mcap", 10))
    told(home, [*asks, named], lambda: state(home, one)["state"] == "copying")
    for _ in range(30):
        hour(1)
    assert state(home, one)["state"] == "copying"
    home.client("technician").delete(f"{FETCHES}/{one['id']}")


def test_another_robot_cannot_answer(home: House) -> None:
    one = ask(home)
    lie = ServerChange("has", "ropod_003", {"store_id": "s1", "id": one["id"], "files": []})
    told(home, [lie], lambda: state(home, one)["state"] == "waiting")
    home.client("technician").delete(f"{FETCHES}/{one['id']}")


def test_pages_go_on_where_the_last_one_ended(home: House) -> None:
    made = [ask(home)["id"] for _ in range(3)]
    viewer = home.client("viewer")
    seen: list[str] = []
    after = ""
    while page := viewer.get(FETCHES, params={"limit": 2, "after": after}).json():
        seen += [one["id"] for one in page]
        after = seen[-1]
    assert set(made) <= set(seen)
    assert len(seen) == len(set(seen))


@pytest.mark.parametrize(
    ("wanted", "status"),
    [
        ({"from": WINDOW["to"], "to": WINDOW["from"]}, 400),
        ({"from": " "}, 400),
        ({"to": ""}, 422),
        ({"item": "a/b"}, 422),
    ],
)
def test_what_is_wrong_is_refused(home: House, wanted: dict[str, str], status: int) -> None:
    answer = home.client("technician").post(FETCHES, json={**WINDOW, **wanted})
    assert answer.status_code == status, answer.text


def test_who_may_ask(home: House) -> None:
    assert home.client("operator").post(FETCHES, json=WINDOW).status_code == 403
    token = home.token_client("technician", "read:status")
    assert token.post(FETCHES, json=WINDOW).status_code == 403
    away = "/api/v1/robots/ropod_003/fetches"
    assert home.client("nurse").post(away, json=WINDOW).status_code == 404
    assert home.client("nurse").get(away).status_code == 404


def test_a_robot_that_names_ever_more_journals_is_not_believed_for_ever(home: House) -> None:
    def named(start: int) -> list[fetches.RequestedFile]:
        return [fetches.RequestedFile("s", f"journal/{n}", 1) for n in range(start + FILES // 2)]

    with home.services.database.begin() as connection:
        one = fetches.add(connection, 1, "ropod_002", "user:x", "", (1, 2))
        for start in range(0, 2 * FILES, FILES // 2):
            one = fetches.record_answer(connection, 2, one, named(start)) or one
        assert len(one.files) == FILES
        assert fetches.cancel(connection, 3, one)
