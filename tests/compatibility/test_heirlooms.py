"""Folders of an older version open, give the same answers, and are continued.

``tests/fixtures/ef939a5/README.md`` describes these folders and how they were made.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from amberbox.testing.clock import wait_until
from tests.compatibility.heirlooms import (
    Person,
    Relay,
    amberbox,
    as_then,
    digest,
    expected,
    lacks,
    rows,
    serving,
    unpacked,
)  # fmt: skip
from tests.support.processes import running

CONCLUSIONS = ("amberbox_status", "amberbox_symptom", "amberbox_diagnosis", "amberbox_alarm")

RING = "sim_imu"
"""This item is kept for a minute, which is long over."""


def words_of(robot: str) -> dict[str, tuple[str, ...]]:
    return {
        "incidents": ("incident", "list", robot),
        "missions": ("mission", "list", robot),
        "gaps": ("gaps", robot),
        "alarms": ("alarm", robot, "list", "--all"),
    }


@pytest.mark.parametrize("robot", ["killed", "linked"])
def test_a_record_says_what_it_said_then(robot: str, tmp_path: Path) -> None:
    folder = unpacked(robot, tmp_path) / robot
    was = expected()[robot]
    for item, then in was["items"].items():
        found = as_then(rows(folder, item), then["columns"])
        assert (item, len(found), digest(found)) == (item, then["rows"], then["sha256"])
    verified = amberbox("verify", folder, "--json").json()
    assert lacks(was["verify"], verified) == []
    for what, words in words_of(str(folder)).items():
        assert lacks(was[what], amberbox(*words, "--json").json(), what) == []
    events = amberbox("events", folder, "--json").json()
    assert [[one["timestamp"], one["kind"], one["text"]] for one in events] == was["events"]


def test_a_watcher_goes_on_from_the_checkpoint_of_the_old_one(tmp_path: Path) -> None:
    """The old watcher was killed before the recorder: its missing findings are written now."""
    folder = unpacked("killed", tmp_path) / "killed"
    was = {name: then["rows"] for name, then in expected()["resumed"].items()}
    assert len(concluded(folder, "amberbox_status")) < len(was["amberbox_status"])

    def is_through() -> bool:
        return bool(concluded(folder, "amberbox_status")[-1] == was["amberbox_status"][-1])

    with running("watch", "--quiet", folder, log=tmp_path / "watch.log"):
        wait_until(is_through, "the watcher has said the last that the old one would have said")
    for name, then in was.items():
        assert concluded(folder, name) == then, name
    assert amberbox("verify", folder).status == 0


def concluded(folder: Path, name: str) -> list[list[str]]:
    """Return the conclusions from a record, without times and without the present state."""
    columns, found = rows(folder, name)
    if "live_only" in columns:
        found = [row for row in found if row[columns.index("live_only")] != "true"]
    return as_then((columns, found), expected()["resumed"][name]["columns"])


def test_recording_goes_on_in_a_store_whose_old_recorder_was_killed(tmp_path: Path) -> None:
    folder = unpacked("killed", tmp_path) / "killed"
    was = expected()["killed"]["items"]
    with running("record", "--quiet", folder, log=tmp_path / "record.log"):
        wait_until(
            lambda: len(rows(folder, "sim_battery")[1]) > was["sim_battery"]["rows"] + 2, "rows"
        )
    verified = amberbox("verify", folder, "--json").json()
    assert verified["good"] and verified["signed"], verified
    for item, then in was.items():
        if item.startswith("sim_") and item != RING:
            found = as_then(rows(folder, item), then["columns"])[: then["rows"]]
            assert (item, digest(found)) == (item, then["sha256"])
    kinds = [one["kind"] for one in amberbox("events", folder, "--json").json()]
    assert kinds.count("started") == 2 and "recovered" in kinds and kinds[-1] == "stopped", kinds
    runs = [int(file.name.split("-")[0]) for file in folder.glob("store/journal/*.mcap")]
    assert len(set(runs)) == 2 and max(runs) > 1, "a run of its own, in files of its own"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot that had joined the old server, and that server's folder."""
    return unpacked("linked", tmp_path_factory.mktemp("linked"))


@pytest.fixture(scope="module")
def server(place: Path) -> Iterator[str]:
    """The address of a server of today on the folder of the old one."""
    with serving(place / "server") as url:
        yield url


def test_the_server_shows_what_the_old_one_showed(server: str) -> None:
    anna = Person(server)
    anna.sign_in("anna", expected()["about"]["password"])

    def alarms() -> list[str]:
        """Robots that are away for long get alarms of their own, in time."""
        was = expected()["api"]["/alarms"]
        known = {one["id"] for one in was}
        return lacks(was, [one for one in anna.get("/alarms") if one["id"] in known], "/alarms")

    wait_until(lambda: not alarms(), "what is over is resolved as it was then")
    for path, was in expected()["api"].items():
        if path != "/alarms":
            assert lacks(was, anna.get(path), path) == []
    parts = anna.get("/robots/linked/status")["components"]
    keys = "level", "state", "measured", "since"
    shown = [[one["component"], *(one["condition"][key] for key in keys)] for one in parts]
    assert shown == expected()["components"]


def test_people_of_the_old_server_sign_in(server: str) -> None:
    about = expected()["about"]
    anna = Person(server).sign_in("anna", about["password"])
    assert (anna["name"], anna["role"]) == ("anna", "admin"), anna
    status, _ = Person(server).ask(
        "POST", "/api/v1/session", {"name": "anna", "password": "another one, wrong"}
    )
    assert status == 401
    otto = Person(server).sign_in("otto", about["otto"]["password"])
    assert otto["must_change"], "the password was made for him"
    token, ends = about["token"]["token"], datetime.fromisoformat(about["token"]["expires"][:19])
    bearer = {"Authorization": f"Bearer {token}"}
    holds = datetime.now(UTC) < ends.replace(tzinfo=UTC)
    assert Person(server).ask("GET", "/api/v1/alarms", **bearer)[0] == (200 if holds else 401)
    assert Person(server).ask("GET", "/api/v1/users", **bearer)[0] == (403 if holds else 401)


def test_the_link_goes_on_and_so_does_the_upload_that_was_cut(place: Path, server: str) -> None:
    """Run last: from here on the server has more data than the old one."""
    folder, data = place / "linked", place / "server"
    store = folder / "store"
    (part,) = data.glob("incoming/linked/*/*.part")
    half, held = part.stat().st_size, expected()["api"]["/robots/linked/recordings"]
    arrived = {one["journal"] for one in held if one["state"] in ("in_columns", "waiting")}
    writer, _, rest = part.name.partition("-")
    cut = f"{writer}/{rest.rpartition('-')[0]}"
    assert 0 < half < (store / cut).stat().st_size and arrived
    relay = Relay(int(urlsplit(server).port or 0))
    settings = folder / "robot.yaml"
    (line,) = [one for one in settings.read_text().splitlines() if "url:" in one]
    url = line.split("url:")[1].strip()
    settings.write_text(settings.read_text().replace(url, f"http://127.0.0.1:{relay.port}"))
    anna = Person(server)
    anna.sign_in("anna", expected()["about"]["password"])

    def copied() -> bool:
        now = {one["journal"]: one["state"] for one in anna.get("/robots/linked/recordings")}
        sealed = {f"{one.parent.name}/{one.name}" for one in store.glob("[jb]*/*.mcap")}
        return sealed <= now.keys() and set(now.values()) <= {"in_columns", "waiting"}

    with running("link", "--quiet", folder, log=place / "link.log"):
        wait_until(lambda: anna.get("/robots/linked")["online"], "the robot is online")
        wait_until(copied, "all journals are copied")
    pieces = relay.pieces()
    relay.close()
    ends = {journal: 0 for journal, _, _ in pieces} | {cut: half}
    for journal, at, size in pieces:
        assert at == ends[journal], "each byte is sent once, and what had arrived not at all"
        ends[journal] = at + size
    assert cut in {journal for journal, _, _ in pieces}
    assert all(size == (store / name).stat().st_size for name, size in ends.items())
    assert not arrived & ends.keys()
    assert not list(data.glob("incoming/linked/*/*.part"))
    events = anna.get("/robots/linked/events?limit=1000")
    then = expected()["api"]["/robots/linked/events?limit=1000"]
    assert lacks(then, [one for one in events if one["at"] <= then[-1]["at"]]) == []
    places = [(one["store_id"], one["writer"], one["run"], one["seq"]) for one in events]
    assert len(places) == len(set(places))
    assert not {one["kind"] for one in events} & {"other_history", "new_store", "copy_refused"}
    assert amberbox("verify", folder).status == 0
