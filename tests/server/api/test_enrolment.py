"""Robots over the API as admins see them: one line to paste, keys replaced and revoked."""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import replace

from starlette.testclient import TestClient

from amberbox.link.join_line import read_join_line
from amberbox.server.bus import ServerChange
from amberbox.server.certificates import CERTIFICATE
from amberbox.server.schema import AUDIT
from tests.server.house import URL, House

ROBOTS = "/api/v1/robots"
DER = b"a certificate, for the test"


def _robot(home: House, line: str) -> TestClient:
    read = read_join_line(line)
    client = home.client()
    client.headers["Authorization"] = f"Robot {read.robot}:{read.key}"
    return client


def _connects(client: TestClient) -> bool:
    return int(client.head("/link/v1/journals/x/y/z").status_code) != 401


def test_a_robot_is_added_with_one_line_to_paste(home: House) -> None:
    heard: list[ServerChange] = []
    home.services.bus.on("robot", heard.append)
    answer = home.client("admin").post(ROBOTS, json={"robot": "ropod_009", "groups": ["ward"]})
    assert answer.status_code == 201
    line = read_join_line(answer.json()["line"])
    assert (line.url, line.robot, line.ca) == (URL, "ropod_009", "")
    assert line.key.startswith(f"abr_{answer.json()['key_id']}_")
    assert _connects(_robot(home, answer.json()["line"]))
    assert [change.robot for change in heard] == ["ropod_009"]


def test_the_line_is_in_no_row_of_the_log(home: House) -> None:
    line = home.client("admin").post(ROBOTS, json={"robot": "ropod_009"}).json()["line"]
    with home.services.database.reading() as connection:
        (row,) = connection.execute(AUDIT.select()).all()
    assert (row.action, row.object) == ("robots.add", "ropod_009")
    assert read_join_line(line).key not in json.dumps(list(map(str, row)))


def test_the_line_holds_the_fingerprint_of_the_servers_own_authority(home: House) -> None:
    path = home.services.folder / CERTIFICATE
    path.parent.mkdir(exist_ok=True)
    text = base64.encodebytes(DER).decode()
    path.write_text(f"-----BEGIN CERTIFICATE-----\n{text}-----END CERTIFICATE-----\n")
    home.services.settings = replace(home.services.settings, certificate=path)
    line = home.client("admin").post(ROBOTS, json={"robot": "ropod_009"}).json()["line"]
    assert read_join_line(line).ca == hashlib.sha256(DER).hexdigest()


def test_a_server_that_robots_cannot_reach_adds_none(home: House) -> None:
    """Without TLS the line would be refused on the robot: it is not made, and no robot either."""
    home.services.settings = replace(home.services.settings, public_url="http://fleet.example")
    assert home.client("admin").post(ROBOTS, json={"robot": "ropod_009"}).status_code == 400
    assert home.client("admin").get(f"{ROBOTS}/ropod_009/keys").status_code == 404


def test_a_robot_is_added_once(home: House) -> None:
    answer = home.client("admin").post(ROBOTS, json={"robot": "ropod_001"})
    assert answer.status_code == 400
    assert "known already" in answer.json()["error"]["what"]


def test_groups_decide_who_sees_it(home: House) -> None:
    nurse = home.client("nurse")
    path = f"{ROBOTS}/ropod_003"
    assert nurse.get(f"{path}/folder").status_code == 404
    answer = home.client("admin").patch(path, json={"groups": ["ward", "kitchen"]})
    assert answer.json()["groups"] == ["kitchen", "ward"]
    assert nurse.get(f"{path}/folder").status_code == 200


def test_a_closed_robot_is_refused_and_may_come_back(home: House) -> None:
    admin, robot = home.client("admin"), home.robot_client()
    assert _connects(robot)
    assert admin.patch(f"{ROBOTS}/ropod_001", json={"disabled": True}).json()["disabled"]
    assert not _connects(robot)
    admin.patch(f"{ROBOTS}/ropod_001", json={"disabled": False})
    assert _connects(robot)


def test_a_new_key_overlaps_with_the_old_one(home: House) -> None:
    old = home.robot_client()
    answer = home.client("admin").post(f"{ROBOTS}/ropod_001/key", json={"overlap_h": 2})
    assert answer.status_code == 201
    new = _robot(home, answer.json()["line"])
    assert _connects(old)
    home.clock.advance(2 * 3600)
    assert not _connects(old)
    assert _connects(new)


def test_a_revoked_key_is_out_at_once(home: House) -> None:
    admin, robot = home.client("admin"), home.robot_client()
    (key,) = admin.get(f"{ROBOTS}/ropod_001/keys").json()
    path = f"{ROBOTS}/ropod_001/keys"
    assert admin.delete(f"{ROBOTS}/ropod_002/keys/{key['id']}").status_code == 404
    assert _connects(robot)
    assert admin.delete(f"{path}/{key['id']}").json() == {"revoked": 1}
    assert not _connects(robot)
    assert admin.delete(f"{path}/{key['id']}").status_code == 404
    assert admin.get(path).json()[0]["works"] is False


def test_all_keys_of_a_stolen_robot_are_revoked(home: House) -> None:
    admin = home.client("admin")
    line = admin.post(f"{ROBOTS}/ropod_001/key").json()["line"]
    assert admin.delete(f"{ROBOTS}/ropod_001/keys").json() == {"revoked": 2}
    assert not _connects(_robot(home, line))
    assert not _connects(home.robot_client())
