"""Models that servers learn: asked for, learnt, fetched, kept in versions, hidden from others."""

from __future__ import annotations

import hashlib
import html
import json
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from amberbox.agent.detect import read_for
from amberbox.agent.model_action import install_action
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.timestamps import format_time
from amberbox.detection.model_file import read_model
from amberbox.server.bus import ServerChange
from amberbox.server.learning import models
from amberbox.server.learning.models import MOST_WAITING, LearnRequest
from amberbox.server.learning.worker import follow
from amberbox.server.schema import AUDIT, COMMAND_ROBOT
from amberbox.testing.records import T0_NS, FakeItem, FakeRun
from tests.server.archive.recordings import Robot
from tests.server.data.filled import fill
from tests.server.house import House, house, work_until

MODELS = "/api/v1/models"
ROBOT, FAILED, OTHER = "ropod_002", "ropod_001", "ropod_003"
BANK = {
    "sensors": ["battery.volts"],
    "models": {
        name: {"f": [["1"]], "h": [["1"]], "q": [[q]], "r": [["0.01"]]}
        for name, q in (("holds", "0.0001 * dt"), ("falls", "dt"))
    },
}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    folder = tmp_path_factory.mktemp("models")
    with house(folder / "server") as found:
        fill(found, folder)
        robot = Robot(ROBOT, folder)
        robot.record(0, files=2, rows=400)
        robot.hand_in_all(found.services.archive)
        found.services.archive.commit(0)
        yield found


def ask(home: House, who: str = "technician", **wanted: Any) -> dict[str, Any]:
    asked = home.client(who).post(MODELS, json={"robots": [ROBOT], **wanted})
    assert asked.status_code == 202, asked.text
    return dict(asked.json())


def learnt(home: House, **wanted: Any) -> dict[str, Any]:
    """Ask for a model as a technician, and have it learnt."""
    technician, asked = home.client("technician"), ask(home, **wanted)

    def state() -> dict[str, Any]:
        return dict(technician.get(f"{MODELS}/{asked['id']}").json())

    work_until(home.services.learning.run, lambda: state()["state"] not in ("queued", "running"))
    return state()


def fetched(home: House, told: dict[str, Any]) -> bytes:
    return bytes(home.client("technician").get(f"{MODELS}/{told['id']}/file").content)


def test_a_model_is_learnt_from_what_robots_recorded(home: House) -> None:
    told = learnt(home, detectors=["guard", "bank"], options={"bank": BANK})
    assert told["state"] == "done", told
    assert (told["name"], told["file"]) == (ROBOT, f"{ROBOT}-v{told['version']}.model")
    assert any("no rate below" in line for line in told["report"]), told["report"]
    data = fetched(home, told)
    assert hashlib.sha256(data).hexdigest() == told["sha256"] and len(data) == told["bytes"]
    model = read_model(data, "fetched")
    assert set(model.detectors) == {"guard", "bank"}
    assert model.origin["items"] == ["battery", "odom"]
    assert (model.origin["robots"], model.origin["version"]) == ([ROBOT], told["version"])


def test_the_page_leads_to_the_order_that_installs_a_model(home: House) -> None:
    told = learnt(home, detectors=["guard"])
    link = f"/robots/{ROBOT}/commands?action=model.install&amp;p.sha256={told['sha256']}"
    assert link not in home.client("technician").get("/detectors").text
    able = json.dumps({"actions": [install_action(Path("robot")).announced()]})
    row = {"robot": ROBOT, "store_id": "", "answered": 0, "actions": able, "actions_ns": 0,
           "lease": 0, "holder": "", "run": ""}  # fmt: skip
    with home.services.database.begin() as connection:
        connection.execute(COMMAND_ROBOT.insert(), [row])
    assert link in home.client("technician").get("/detectors").text
    assert link not in home.client("viewer").get("/detectors").text
    order = html.unescape(link)
    assert told["sha256"] in home.client("technician").get(order).text


def test_each_one_is_the_next_version_of_its_name_and_none_is_used_twice(home: House) -> None:
    first = learnt(home, name="drive", detectors=["guard"])
    second = learnt(home, name="drive", detectors=["guard"])
    technician = home.client("technician")
    assert (first["version"], second["version"]) == (1, 2)
    assert technician.delete(f"{MODELS}/{second['id']}").status_code == 200
    assert technician.get(f"{MODELS}/{second['id']}/file").status_code == 404
    assert not (home.services.folder / "models" / second["id"]).exists()
    assert ask(home, name="drive", detectors=["guard"])["version"] == 3
    versions = [one["version"] for one in technician.get(f"{MODELS}?name=drive").json()]
    assert versions == [3, 1]


def test_missions_and_times_choose_what_is_learnt_from(home: House) -> None:
    operator = home.client("operator")
    begun = operator.post(
        f"/api/v1/robots/{ROBOT}/missions", json={"name": "tour", "at": format_time(T0_NS)}
    )
    assert begun.status_code == 201, begun.text
    end = {"outcome": "done", "at": format_time(T0_NS + 5 * NS)}
    mission = begun.json()["id"]
    ended = operator.post(f"/api/v1/robots/{ROBOT}/missions/{mission}/end", json=end)
    assert ended.status_code == 200, ended.text
    told = learnt(
        home, missions=["tour"], detectors=["guard"], robots=[ROBOT, OTHER], name="tours",
        **{"from": format_time(T0_NS + NS)},
    )  # fmt: skip
    assert told["state"] == "done", told
    assert f"{OTHER}: there is no mission to learn from" in told["report"]
    origin = read_model(fetched(home, told), "fetched").origin
    assert origin["missions"] == [mission]
    assert origin["from"] == format_time(T0_NS + NS)
    wrong = learnt(home, missions=["tuor"], detectors=["guard"])
    assert wrong["state"] == "failed" and "no mission 'tuor'" in wrong["error"]


def test_missions_that_failed_are_not_learnt_from(home: House) -> None:
    told = learnt(home, robots=[FAILED], detectors=["guard"])
    assert told["state"] == "failed" and "no mission to learn from" in told["error"]
    assert home.client("technician").get(f"{MODELS}/{told['id']}/file").status_code == 404


@pytest.mark.parametrize(
    ("wanted", "status"),
    [
        ({"robots": []}, 422),
        ({"robots": ["nobody"]}, 404),
        ({"detectors": ["neural"]}, 400),
        ({"detectors": ["redundant"]}, 400),
        ({"false_alarms_per_hour": 0}, 422),
        ({"name": "../x"}, 422),
        ({"from": "2026-01-02", "to": "2026-01-01"}, 400),
        ({"options": {"guard": {"items": "many"}}}, 400),
        ({"options": {"guard": [[[]]]}}, 400),
        ({"options": {"bank": {"sensors": ["a.b"], "factory": "os:system"}}}, 400),
        ({"options": {"guard": {"items": "9" * 70_000}}}, 400),
        ({"surprise": 1}, 422),
    ],
)
def test_what_is_wrong_is_refused(home: House, wanted: dict[str, Any], status: int) -> None:
    asked = home.client("technician").post(MODELS, json={"robots": [ROBOT], **wanted})
    assert asked.status_code == status, asked.text


def test_who_does_not_see_all_its_robots_does_not_see_a_model(home: House) -> None:
    told = learnt(home, robots=[ROBOT, OTHER], detectors=["guard"])
    assert told["name"] == "fleet"
    url = f"{MODELS}/{told['id']}"
    nurse = home.client("nurse")  # of the ward only
    assert nurse.get(url).status_code == 404 == nurse.delete(url).status_code
    assert nurse.get(f"{url}/file").status_code == 404
    assert told["id"] not in [one["id"] for one in nurse.get(MODELS).json()]
    assert nurse.post(MODELS, json={"robots": [OTHER]}).status_code == 404
    viewer = home.client("viewer")
    assert viewer.get(url).status_code == 200
    assert viewer.get(f"{url}/file").status_code == 403 == viewer.delete(url).status_code


def test_one_that_waits_is_cancelled_and_one_that_was_begun_is_begun_again(home: House) -> None:
    technician = home.client("technician")
    waits, begun = (ask(home, detectors=["guard"]) for _ in range(2))
    assert technician.delete(f"{MODELS}/{waits['id']}").json()["state"] == "cancelled"
    with home.services.database.begin() as connection:
        assert models.change(connection, begun["id"], only=["queued"], state="running")
    stray = home.services.folder / "models" / "m-000000000000000000000000"
    stray.mkdir(parents=True)
    work_until(
        home.services.learning.run,
        lambda: technician.get(f"{MODELS}/{begun['id']}").json()["state"] == "done",
    )
    assert not stray.exists()
    assert technician.get(f"{MODELS}/{waits['id']}").json()["state"] == "cancelled"


def test_who_has_too_many_has_to_wait(home: House) -> None:
    wanted = LearnRequest([ROBOT], ["guard"])
    with home.services.database.begin() as connection:
        for _ in range(MOST_WAITING):
            one = models.add(connection, 0, "somebody", "x", wanted)
        with pytest.raises(Exception, match=f"{MOST_WAITING} of your models"):
            models.add(connection, 0, "somebody", "x", wanted)
        assert models.add(connection, 0, "another", "x", wanted).version == one.version + 1
        for model in models.listed(connection, "x"):
            models.delete(connection, model.id)


def test_learning_fetching_and_deleting_are_in_the_audit_log(home: House) -> None:
    told = learnt(home, detectors=["guard"])
    fetched(home, told)
    home.client("technician").delete(f"{MODELS}/{told['id']}")
    with home.services.database.reading() as connection:
        rows = connection.execute(AUDIT.select().where(AUDIT.c.object == told["id"])).all()
    assert [row.action for row in rows] == ["models.learn", "models.fetch", "models.delete"]


ARM = FakeItem("arm", [{"angle": 0.5}])
_TEAM = ["ropod_001", "ropod_003"]
_TURN_S = 5


def _in_step(second: float, is_other: bool) -> float:
    """Return 0 or 1 by turns; the other robot is always where the first one is not."""
    return float((int(second / _TURN_S) % 2 == 0) != is_other)


def test_robots_of_a_team_are_learnt_side_by_side_and_one_out_of_step_is_found(
    home: House, tmp_path: Path
) -> None:
    begin_ns = T0_NS + 3600 * NS
    for robot in _TEAM:
        own = Robot(robot, tmp_path, items=[ARM])
        run, noise = FakeRun(own.store, items=[ARM]), random.Random(robot)
        run.write([
            (begin_ns + n * NS // 5, ARM, {"angle": _angle(n / 5, robot) + noise.gauss(0, 0.01)})
            for n in range(5 * 200)
        ])  # fmt: skip
        run.close()
        own.hand_in_all(home.services.archive)
    home.services.archive.commit(0)
    times = [format_time(begin_ns + s * NS) for s in (0, 150, 160, 200)]
    for robot in _TEAM:
        _mission(home, robot, times[0], times[1])
    options = {"state_flow": {"window": 1.0, "states": 2}}
    told = learnt(home, robots=_TEAM, team=True, missions=["dance"], options=options)
    assert told["state"] == "done", told
    assert (told["name"], told["detectors"], told["team"]) == ("team", ["state_flow"], True)
    url, technician = f"{MODELS}/{told['id']}/alarms", home.client("technician")
    calm = technician.get(url, params={"from": times[0], "to": times[1]})
    assert calm.status_code == 200, calm.text
    found = technician.get(url, params={"from": times[2], "to": times[3]}).json()
    assert [one["id"] for one in found if one["robot"] == ""] == ["state_flow.team.team"], found
    assert not [one for one in calm.json() if one["series"] == "team"]
    assert "this combination is improbable" in found[0]["reason"]
    for wrong, status in (
        ({"from": times[0]}, 422),
        ({"from": times[0], "to": times[1], "robot": "ropod_001"}, 400),
        ({"from": "2026-01-01", "to": "2026-02-01"}, 400),
    ):
        assert technician.get(url, params=wrong).status_code == status
    assert (
        home.client("nurse").get(url, params={"from": times[0], "to": times[1]}).status_code == 404
    )
    assert home.client("technician").post(MODELS, json={"robots": [ROBOT], "team": True}).is_error
    file = tmp_path / "team.model"
    file.write_bytes(fetched(home, told))
    with pytest.raises(AmberboxError, match="model of a team"):
        read_for(file, open_store(tmp_path / "ropod_001"))


def _hand_in_turns(home: House, folder: Path, begin_ns: int, until_s: int) -> dict[str, list[Path]]:
    """Record both robots of the team in pieces of 50 s; return their journals, none handed in."""
    found = {}
    for robot in _TEAM:
        own = Robot(robot, folder, items=[ARM])
        run, noise = FakeRun(own.store, items=[ARM]), random.Random(robot)
        for n in range(5 * until_s):
            if n % 250 == 0:
                run.start(begin_ns + n * NS // 5 - 1)
            angle = _angle(n / 5, robot) + noise.gauss(0, 0.01)
            run.write([(begin_ns + n * NS // 5, ARM, {"angle": angle})])
            if n % 250 == 249:
                run.rotate()
        run.close()
        found[robot] = own.files()
    return found


def test_a_team_that_is_followed_is_judged_as_its_robots_hand_in_their_records(
    home: House, tmp_path: Path
) -> None:
    """Handed in piece by piece, with the server ending in between, it finds what a replay finds."""
    begin_ns = T0_NS + 7200 * NS
    journals = _hand_in_turns(home, tmp_path, begin_ns, 200)
    owns = {robot: Robot(robot, tmp_path, items=[ARM]) for robot in _TEAM}
    technician, archive = home.client("technician"), home.services.archive

    def hand_in(robot: str, number: int) -> None:
        owns[robot].hand_in(archive, journals[robot][number])
        details = {"store_id": owns[robot].store_id, "journal": "", "state": "verified"}
        home.services.bus.publish(ServerChange("journal", robot, details))

    for robot in _TEAM:
        for number in range(3):  # 150 s, nothing is wrong
            hand_in(robot, number)
    times = [format_time(begin_ns + s * NS) for s in (0, 150, 200)]
    for robot in _TEAM:
        _mission(home, robot, times[0], times[1])
    told = learnt(
        home, robots=_TEAM, team=True, missions=["dance"], name="pair",
        options={"state_flow": {"window": 1.0, "states": 2}}, **{"from": times[0]},
    )  # fmt: skip
    assert told["state"] == "done", told
    url = f"{MODELS}/{told['id']}/follow"
    assert technician.get(url).status_code == 404
    started = technician.post(url, json={"from": times[0]})
    assert started.status_code == 200, started.text
    assert (started.json()["to"], started.json()["alarms"]) == (times[0], [])

    def until() -> str:
        return str(technician.get(url).json()["to"])

    def go_on(to: str, begun: Callable[[], None] | None = None) -> None:
        """Let the service work until it is there; each call is one more start of a server."""
        work_until(home.services.following.run, lambda: until() >= to, begun)

    go_on(format_time(begin_ns + 149 * NS))
    assert technician.get(url).json()["alarms"] == []
    reached = until()
    hand_in(_TEAM[0], 3)
    later = f"{MODELS}/{told['id']}/alarms"
    arguments = {"id": told["id"], "file": told["file"], "robots": _TEAM}
    step = msgspec.json.decode(follow(home.services.folder, arguments))
    assert format_time(step["until_ns"]) == reached  # the other one's record is not here yet
    go_on(format_time(begin_ns + 199 * NS), lambda: hand_in(_TEAM[1], 3))
    found = technician.get(url).json()
    replay = technician.get(later, params={"from": times[0], "to": found["to"]}).json()
    assert (
        found["error"] == ""
        and [one["id"] for one in found["alarms"]].count("state_flow.team.team") == 1
    ), found
    assert found["alarms"] == [one for one in replay if one["robot"] == ""]
    page = technician.get("/detectors").text
    assert "state_flow.team.team" in page and f"{url}" in page
    assert home.client("nurse").get(url).status_code == 404
    assert home.client("viewer").post(url, json={}).status_code == 403
    again = technician.post(url, json={"from": times[0]}).json()
    assert again == found  # it follows already
    assert technician.delete(url).status_code == 200
    assert technician.get(url).status_code == 404


def test_only_a_finished_model_of_a_team_follows(home: House) -> None:
    technician = home.client("technician")
    waits = ask(home, detectors=["guard"])
    url = f"{MODELS}/{waits['id']}/follow"
    assert technician.post(url, json={}).status_code == 404
    technician.delete(f"{MODELS}/{waits['id']}")
    told = learnt(home, detectors=["guard"])
    refused = technician.post(f"{MODELS}/{told['id']}/follow", json={})
    assert refused.status_code == 400 and "of a team" in refused.text


def _angle(second: float, robot: str) -> float:
    """Return where a robot's arm is; at the end the second robot does what the first one does."""
    return _in_step(second, is_other=robot == _TEAM[1] and second < 160)


def _mission(home: House, robot: str, begin: str, end: str) -> None:
    operator, url = home.client("operator"), f"/api/v1/robots/{robot}/missions"
    mission = operator.post(url, json={"name": "dance", "at": begin}).json()["id"]
    assert not operator.post(f"{url}/{mission}/end", json={"outcome": "done", "at": end}).is_error


def test_a_model_is_run_over_what_robots_recorded(home: House) -> None:
    told = learnt(home, detectors=["guard"], **{"to": format_time(T0_NS + 6 * NS)})
    span = {"from": format_time(T0_NS + 5 * NS), "to": format_time(T0_NS + 20 * NS)}
    url = f"{MODELS}/{told['id']}/alarms"
    found = home.client("viewer").get(url, params=span).json()
    silent = [one for one in found if one["id"].startswith("guard.silent.")]
    assert {one["id"] for one in silent} == {"guard.silent.battery", "guard.silent.odom"}, found
    assert {one["robot"] for one in silent} == {ROBOT}
    assert all(one["confirmed"] >= format_time(T0_NS + 8 * NS) for one in silent)
