"""Experiments over the API: uploads, also hostile ones, pictures, runs of robots that are away."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from struct import pack as packed_struct
from typing import Any

import pytest

import amberbox.sim
from amberbox.core.errors import ConfigurationError
from amberbox.link import limits
from amberbox.link.folders import pack
from amberbox.link.frames import Hello
from amberbox.server.audit import rows as audited
from amberbox.server.experiments.shelf import MOST_BYTES, MOST_FILES
from amberbox.server.ingest.ledger import admit
from tests.server.house import House, house
from tests.support.experiments import DRIVE, DRIVE_YAML, bpmn

ROBOT = "ropod_001"
API = f"/api/v1/robots/{ROBOT}"
HASH = "0" * 64
PNG = b"\x89PNG\r\n\x1a\n" + b"".join(
    packed_struct(">I", len(data)) + kind + data + packed_struct(">I", zlib.crc32(kind + data))
    for kind, data in (
        (b"IHDR", packed_struct(">IIBBBBB", 1, 1, 8, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(b"\0\0")),
        (b"IEND", b""),
    )
)
SVG = b'<svg xmlns="http://www.w3.org/2000/svg"><script>alert(1)</script></svg>'
PICTURED = DRIVE_YAML.replace("clear:\n", "clear:\n    picture: way.png\n").replace(
    "look:\n", "look:\n    picture: robot.svg\n"
)
FILES = {
    "drive.bpmn": DRIVE.encode(), "drive.yaml": PICTURED.encode(), "way.png": PNG,
    "robot.svg": SVG,
}  # fmt: skip


@pytest.fixture
def home(tmp_path: Path) -> Iterator[House]:
    """A robot that was here once, and is away."""
    with house(tmp_path / "server", shared=True) as found:
        hello = Hello(ROBOT, "s", "boot", {}, HASH, 0, 0, "1", capabilities=[limits.COMMANDS])
        with found.services.database.begin() as connection:
            admit(connection, hello, found.clock.wall_ns())
        yield found


def upload(home: House, files: Mapping[str, bytes], name: str = "drive", **more: Any) -> Any:
    body = {"name": name, "files": {n: base64.b64encode(d).decode() for n, d in files.items()}}
    return home.client("technician").post("/api/v1/experiments", json=body | more)


def refused(answer: Any, status: int, words: str) -> None:
    assert answer.status_code == status, answer.text
    assert words in answer.json()["error"]["what"], answer.text


def test_an_uploaded_experiment_is_listed_for_every_robot(home: House) -> None:
    made = upload(home, FILES)
    assert made.status_code == 201, made.text
    assert (made.json()["title"], made.json()["who"]) == ("Drive a little", "technician")
    client = home.client("viewer")
    for path in ("/api/v1/experiments", f"{API}/experiments"):
        [line] = client.get(path).json()
        assert (line["name"], line["robot"], line["problems"]) == ("drive", "", [])
    drawn = client.get(f"{API}/experiments/drive/diagram")
    assert drawn.headers["content-type"] == "image/svg+xml" and "data-bpmn-id" in drawn.text
    with home.services.database.reading() as connection:
        [row] = [one for one in audited(connection) if one.action == "experiments.upload"]
    assert row.object == "drive"
    assert home.client("technician").delete("/api/v1/experiments/drive").status_code == 204
    assert client.get("/api/v1/experiments").json() == []


def test_an_experiment_goes_with_those_that_it_calls(home: House) -> None:
    """The file of one is called otherwise than the experiment, which has an id."""
    caller = bpmn(
        ['<startEvent id="start"/>', '<callActivity id="all" calledElement="drive"/>',
         '<endEvent id="end"/>'],
        ["start all", "all end"], [("technician", "start all end")],
    )  # fmt: skip
    made = upload(home, {**FILES, "Whole.bpmn": caller.encode()}, "Whole")
    assert made.status_code == 201, made.text
    assert (made.json()["name"], [*made.json()["roles"]]) == ("whole", ["operator"])
    run = home.client("technician").post(
        f"{API}/runs", json={"experiment": "whole", "queue": True}
    )  # fmt: skip
    assert run.status_code == 201, run.text
    path = f"{API}/runs/{run.json()['id']}"
    assert home.client("viewer").get(f"{path}/files/way.png").content == PNG
    assert "data-bpmn-id" in home.client("viewer").get(f"{path}/diagram").text


def test_pictures_come_with_their_type_and_run_nothing(home: House) -> None:
    assert upload(home, FILES).status_code == 201
    client = home.client("viewer")
    found = client.get(f"{API}/experiments/drive/files/robot.svg")
    assert (found.content, found.headers["content-type"]) == (SVG, "image/svg+xml")
    assert "sandbox" in found.headers["content-security-policy"]
    assert found.headers["x-content-type-options"] == "nosniff"
    for name in ("drive.yaml", "drive.bpmn", "none.png", "..%2fserver.db"):
        assert client.get(f"{API}/experiments/drive/files/{name}").status_code in (404, 422), name
    refused(client.get(f"{API}/experiments/other/files/way.png"), 400, "no experiment 'other'")


def test_the_pictures_of_a_robots_folder_come_with_it(home: House) -> None:
    files = {f"experiments/{name}": data for name, data in FILES.items()}
    actions = Path(amberbox.sim.__file__).parent / "folder" / "actions" / "sim.yaml"
    files |= {"robot.yaml": b"", "actions/sim.yaml": actions.read_bytes()}
    body = pack(files, pictures=True)
    answer = home.robot_client().put(f"/link/v1/folders/{HASH}", content=body)
    assert answer.status_code == 204, answer.text
    [line] = home.client("viewer").get(f"{API}/experiments").json()
    assert (line["robot"], line["problems"]) == (ROBOT, [])
    found = home.client("viewer").get(f"{API}/experiments/drive/files/way.png")
    assert (found.content, found.headers["content-type"]) == (PNG, "image/png")


BOMB = "<!DOCTYPE d [<!ENTITY a 'aaaaaaaaaa'>" + "".join(
    f"<!ENTITY {b} '{f'&{a};' * 10}'>" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
HOSTILE: Mapping[str, Mapping[str, bytes]] = {
    "a bomb of entities": {"drive.bpmn": (BOMB + "]><definitions>&i;</definitions>").encode()},
    "a file of ten megabytes": {
        "drive.bpmn": DRIVE.replace("</process>", f"<!--{'x' * (10 << 20)}--></process>").encode()
    },
    "no XML": {"drive.bpmn": b"\xff\xfe\0"},
    "a script": {
        "drive.bpmn": DRIVE.replace("<serviceTask", "<scriptTask").encode(),
        "drive.yaml": DRIVE_YAML.encode(),
    },
    "code in a condition": {
        "drive.bpmn": DRIVE.replace(">path_clear<", ">__import__('os')<").encode(),
        "drive.yaml": DRIVE_YAML.encode(),
    },
    "a picture that is not there": {"drive.bpmn": DRIVE.encode(), "drive.yaml": PICTURED.encode()},
}  # fmt: skip


@pytest.mark.parametrize("files", HOSTILE.values(), ids=HOSTILE)
def test_what_cannot_be_run_is_refused_with_all_problems(
    home: House, files: Mapping[str, bytes]
) -> None:
    answer = upload(home, files)
    assert answer.status_code == 400, answer.text
    assert "drive." in answer.json()["error"]["what"]
    assert str(home.services.folder) not in answer.text
    assert home.client("viewer").get("/api/v1/experiments").json() == []


@pytest.mark.parametrize(
    "name", ["../drive.bpmn", "a/b.bpmn", "/etc/x.bpmn", ".hidden", "a\0b", "n" * 300, "ä.png", ""]
)
def test_names_that_lead_elsewhere_are_refused(home: House, name: str) -> None:
    refused(upload(home, {"drive.bpmn": b"", name: b""}), 400, "no name of a file")


def test_uploads_are_bounded(home: House) -> None:
    many = {f"p{n}.png": b"" for n in range(MOST_FILES + 1)}
    assert upload(home, many).status_code == 422
    half = {"drive.bpmn": b"", "a.png": bytes(MOST_BYTES // 2), "b.png": bytes(MOST_BYTES // 2 + 1)}
    refused(upload(home, half), 400, "16 MB")
    body = {"name": "drive", "files": {"drive.bpmn": "no Base64"}}
    client = home.client("technician")
    refused(client.post("/api/v1/experiments", json=body), 400, "is no Base64")
    refused(client.delete("/api/v1/experiments/none"), 400, "nobody has uploaded 'none'")


def test_a_robot_that_is_away_is_refused_or_planned(home: House) -> None:
    assert upload(home, FILES).status_code == 201
    client = home.client("technician")
    order = {"experiment": "drive", "parameters": {"distance_m": 0.2}}
    refused(client.post(f"{API}/runs", json=order), 409, "is not connected")
    refused(client.post(f"{API}/runs", json=order | {"test": "a"}), 400, "an experiment or a unit")
    wrong = order | {"queue": True, "parameters": {"distance_m": 9, "far": 1}}
    refused(client.post(f"{API}/runs", json=wrong), 400, "no parameter 'far'")
    refused(client.post(f"{API}/runs", json={"test": "none"}), 400, "announces no unit test")
    planned = client.post(f"{API}/runs", json=order | {"queue": True}).json()
    assert (planned["state"], planned["who"], planned["begun"]) == ("planned", "technician", None)
    path = f"{API}/runs/{planned['id']}"
    refused(client.post(f"{path}/begin"), 409, "is not connected")
    refused(client.post(f"{path}/complete", json={"task": "x"}), 409, "the run is planned")
    refused(client.get(f"{path}/report"), 409, "has not begun")
    refused(client.get(f"{API}/comparison", params={"run": [planned["id"]] * 2}), 409, "not begun")
    aborted = home.client("operator").post(f"{path}/abort", json={"reason": "no time"}).json()
    assert (aborted["state"], aborted["reason"]) == ("aborted", "aborted by operator: no time")
    assert [line["id"] for line in client.get("/api/v1/runs?state=aborted").json()] == [
        planned["id"]
    ]


def test_runs_are_seen_by_those_who_see_the_robot(home: House) -> None:
    assert upload(home, FILES).status_code == 201
    order = {"experiment": "drive", "queue": True}
    other = "/api/v1/robots/ropod_003/runs"
    run = home.client("technician").post(other, json=order).json()["id"]
    nurse = home.client("nurse")
    assert nurse.get(other).status_code == 404
    assert nurse.post(other, json=order).status_code == 404
    assert nurse.get(f"{other}/{run}").status_code == 404
    assert nurse.get("/api/v1/runs").json() == []
    # a run of another robot is none of this one, and an unknown one of nobody
    for path in (f"{API}/runs/{run}", f"{API}/runs/r-{'0' * 16}"):
        refused(nurse.get(path), 404, "no such run")
        assert nurse.post(f"{path}/abort", json={}).status_code == 404
        assert nurse.get(f"{path}/files/way.png").status_code == 404
    assert home.client("operator").post(f"{API}/runs", json=order).status_code == 403


def test_an_upload_that_is_refused_leaves_nothing_behind(home: House) -> None:
    with pytest.raises(ConfigurationError):
        home.services.runner.shelf.upload("drive", {"drive.bpmn": b"<x/>"}, "anna")
    assert not [*home.services.folder.glob("tmp*")]
