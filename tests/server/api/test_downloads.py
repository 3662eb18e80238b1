"""Downloads: requested, made, fetched in parts, cancelled, restarted, hidden from others."""

from __future__ import annotations

import csv
import hashlib
import io
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pyarrow.parquet as pq
import pytest

from amberbox.blackbox.query.record import open as open_record
from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time
from amberbox.server.data import downloads
from amberbox.server.data.downloads import SETTING, DownloadRequest, Downloads
from amberbox.server.schema import AUDIT
from amberbox.server.settings import write
from amberbox.server.workers.pool import WorkerPool
from amberbox.server.workers.protocol import WorkerTask
from amberbox.testing.records import T0_NS
from tests.server.data.filled import ROWS, fill
from tests.server.house import House, house, work_until

DOWNLOADS = "/api/v1/downloads"
_MS = 1_000_000


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    folder = tmp_path_factory.mktemp("downloads")
    with house(folder / "server") as found:
        fill(found, folder)
        yield found


def made(home: House, **wanted: Any) -> tuple[dict[str, Any], bytes]:
    """Ask for a download as a technician, have it made, and fetch it."""
    technician = home.client("technician")
    asked = technician.post(DOWNLOADS, json={"robots": ["ropod_001"], **wanted})
    assert asked.status_code == 202, asked.text
    url = f"{DOWNLOADS}/{asked.json()['id']}"
    work_until(
        home.services.jobs.run,
        lambda: technician.get(url).json()["state"] not in ("queued", "running"),
    )
    told = technician.get(url).json()
    return told, technician.get(f"{url}/file").content


def test_a_table_comes_as_csv(home: House) -> None:
    told, content = made(home, variables={"odom": ["pose_x", "received"]})
    assert told["state"] == "done", told
    assert told["file"].startswith("ropod_001-20270115T080000")
    assert told["file"].endswith("-csv.csv")
    lines = list(csv.reader(io.StringIO(content.decode())))
    assert lines[0] == ["timestamp", "pose_x", "received"]
    assert [float(line[1]) for line in lines[1:]] == list(range(ROWS + 40))


def test_several_tables_come_in_a_zip(home: House) -> None:
    told, content = made(home, format="parquet", items=["odom", "battery", "nothing"])
    assert told["notes"] == ["ropod_001: there is no data item 'nothing'"]
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        names = file.namelist()
        assert {"contents.json", "ropod_001/odom.parquet", "ropod_001/battery.parquet"} < {*names}
        table = pq.read_table(io.BytesIO(file.read("ropod_001/odom.parquet")))
        said = msgspec.json.decode(file.read("contents.json"))
    assert table.num_rows == ROWS + 40
    assert table.schema.field("pose_x").metadata[b"path"] == b"pose/x"
    assert {one["name"] for one in said["files"]} == {*names} - {"contents.json"}


def test_missions_have_folders(home: House) -> None:
    _, content = made(home, missions=["failed:1"], items=["odom", "battery"])
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        odom = file.read("ropod_001/transport-1/odom.csv").decode()
    assert len(odom.splitlines()) == 1 + 50


def test_robots_without_such_a_mission_are_noted(home: House) -> None:
    robots = ["ropod_001", "ropod_002"]
    told, content = made(home, robots=robots, missions=["failed:1"], items=["odom"])
    assert told["state"] == "done", told
    assert told["notes"] == ["ropod_002: there is no mission 'failed:1'"]
    assert "ropod_001/transport-1/odom.csv" in zipfile.ZipFile(io.BytesIO(content)).namelist()
    alone, _ = made(home, robots=["ropod_002"], missions=["failed:1"])
    assert (alone["state"], alone["error"]) == ("failed", "there is no mission 'failed:1'")
    by_id, _ = made(home, robots=robots, missions=["transport-1"], items=["odom"])
    assert (by_id["state"], by_id["notes"]) == ("done", [])  # it is the other robot's


def test_journals_come_as_they_are(home: House) -> None:
    _, content = made(home, format="journals", **{"from": format_time(T0_NS + NS)})
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        files = msgspec.json.decode(file.read("contents.json"))["files"]
        for one in files:
            assert hashlib.sha256(file.read(one["name"])).hexdigest() == one["sha256"]
    assert 2 <= len(files) < 5


def test_mcap_has_the_messages(home: House, tmp_path: Path) -> None:
    window = {"from": format_time(T0_NS + 30 * 10 * _MS), "to": format_time(T0_NS + NS)}
    told, content = made(home, format="mcap", items=["odom"], **window)
    assert told["file"].endswith(".mcap")
    path = tmp_path / "file.mcap"
    path.write_bytes(content)
    with open_record(path) as record:
        assert record.query("test_odom", ["pose_x"]).values("pose_x") == list(range(30, 100))


def test_ranges_are_resumed(home: House) -> None:
    told, content = made(home, items=["odom"])
    technician = home.client("technician")
    url = f"{DOWNLOADS}/{told['id']}/file"
    part = technician.get(url, headers={"Range": "bytes=100-"})
    assert part.status_code == 206
    assert part.content == content[100:]
    assert technician.get(url, headers={"Range": "bytes=999999999-"}).status_code == 416


def test_nothing_at_all_is_a_failure(home: House) -> None:
    told, _ = made(home, items=["nothing"])
    assert told["state"] == "failed"
    assert "there is nothing of this" in told["error"]
    late, _ = made(home, missions=["nowhere"])
    assert "no mission 'nowhere'" in late["error"]


def test_others_do_not_see_it(home: House) -> None:
    told, _ = made(home, items=["battery"])
    url = f"{DOWNLOADS}/{told['id']}"
    nurse, admin = home.client("nurse"), home.client("admin")
    for path in (url, f"{url}/file"):
        assert nurse.get(path).status_code == 404
        assert admin.get(path).status_code == 200
        assert home.client("operator").get(path).status_code == 403
        assert home.token_client("technician", "read:download").get(path).status_code == 200
        assert home.token_client("technician", "read:data").get(path).status_code == 403
    assert nurse.delete(url).status_code == 404
    assert told["id"] not in {one["id"] for one in nurse.get(DOWNLOADS).json()}
    assert told["id"] in {one["id"] for one in admin.get(f"{DOWNLOADS}?all=true").json()}


def test_a_token_for_a_group_sees_no_downloads_of_others(home: House) -> None:
    technician = home.client("technician")
    asked = technician.post(DOWNLOADS, json={"robots": ["ropod_001"]}).json()
    for group, is_seen in (("kitchen", False), ("ward", True)):
        token = {"name": "x", "scopes": ["read:download"], "groups": [group]}
        client = home.client()
        secret = technician.post("/api/v1/tokens", json=token).json()["token"]
        client.headers["Authorization"] = f"Bearer {secret}"
        url = f"{DOWNLOADS}/{asked['id']}"
        assert (client.get(url).status_code == 200) is is_seen
        assert (asked["id"] in {one["id"] for one in client.get(DOWNLOADS).json()}) is is_seen
    assert technician.delete(f"{DOWNLOADS}/{asked['id']}").status_code == 200


def test_one_that_fails_in_a_way_nobody_foresaw_holds_up_no_other(
    home: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    submit, failed = WorkerPool.submit, list[str]()

    def fails(pool: WorkerPool, question: WorkerTask) -> None:
        if not failed:
            failed.append(question.op)
            raise KeyError
        submit(pool, question)

    technician = home.client("technician")
    wanted = {"robots": ["ropod_001"], "items": ["odom"]}
    with monkeypatch.context() as patch:
        patch.setattr(WorkerPool, "submit", fails)
        asked = [technician.post(DOWNLOADS, json=wanted).json()["id"] for _ in range(2)]

        def states() -> set[str]:
            return {technician.get(f"{DOWNLOADS}/{one}").json()["state"] for one in asked}

        work_until(home.services.jobs.run, lambda: states() == {"failed", "done"})


def test_robots_of_other_groups_cannot_be_asked_for(home: House) -> None:
    for robots in (["ropod_003"], ["ropod_001", "ropod_003"], ["nobody"]):
        asked = home.client("nurse").post(DOWNLOADS, json={"robots": robots})
        assert asked.status_code == 404


@pytest.mark.parametrize(
    ("wanted", "status"),
    [
        ({"robots": []}, 422),
        ({"robots": ["../x"]}, 422),
        ({"format": "exe"}, 422),
        ({"items": ["../../etc/passwd"]}, 422),
        ({"missions": ["last:1"], "from": "now-1h"}, 400),
        ({"variables": {"odom": ["x"]}, "format": "mcap"}, 400),
        ({"surprise": 1}, 422),
    ],
)
def test_what_is_wrong_is_refused(home: House, wanted: dict[str, Any], status: int) -> None:
    asked = home.client("technician").post(DOWNLOADS, json={"robots": ["ropod_001"], **wanted})
    assert asked.status_code == status, asked.text


def test_a_download_can_be_cancelled(home: House) -> None:
    technician = home.client("technician")
    asked = technician.post(DOWNLOADS, json={"robots": ["ropod_001"]}).json()
    url = f"{DOWNLOADS}/{asked['id']}"
    assert technician.delete(url).json()["state"] == "cancelled"
    done, _ = made(home, items=["odom"])
    assert technician.get(url).json()["state"] == "cancelled"
    assert technician.get(f"{url}/file").status_code == 404
    thrown = technician.delete(f"{DOWNLOADS}/{done['id']}").json()
    assert thrown["state"] == "expired"
    assert technician.get(f"{DOWNLOADS}/{done['id']}/file").status_code == 404


def test_what_was_begun_is_begun_again(home: House) -> None:
    technician = home.client("technician")
    asked = technician.post(DOWNLOADS, json={"robots": ["ropod_001"], "items": ["odom"]}).json()
    with home.services.database.begin() as connection:
        assert downloads.change(connection, asked["id"], only=["queued"], state="running")
    stray = home.services.folder / "downloads" / "d-000000000000000000000000"
    stray.mkdir(parents=True)
    work_until(
        home.services.jobs.run,
        lambda: technician.get(f"{DOWNLOADS}/{asked['id']}").json()["state"] == "done",
    )
    assert not stray.exists()


def test_downloads_go_after_a_day(home: House) -> None:
    told, _ = made(home, items=["odom"])
    home.clock.advance(25 * 3600)
    try:
        url = f"{DOWNLOADS}/{told['id']}"
        admin = home.client("admin")
        work_until(home.services.jobs.run, lambda: admin.get(url).json()["state"] == "expired")
        assert not (home.services.folder / "downloads" / told["id"] / told["file"]).exists()
    finally:
        home.clock.advance(-25 * 3600)


def test_what_is_too_large_is_not_made(home: House) -> None:
    with home.services.database.begin() as connection:
        write(connection, 0, SETTING, Downloads(each_gb=1e-6))
    told, _ = made(home, items=["odom"])
    with home.services.database.begin() as connection:
        write(connection, 0, SETTING, Downloads())
    assert told["state"] == "failed"
    assert "larger than 1e-06 GB" in told["error"]


def test_who_has_too_many_has_to_wait(home: House) -> None:
    options, wanted = Downloads(each_waiting=2), DownloadRequest(["ropod_001"], "csv")
    with home.services.database.begin() as connection:
        mine = [downloads.add(connection, n, "somebody", wanted, options) for n in range(2)]
        with pytest.raises(Exception, match="2 of your downloads"):
            downloads.add(connection, 3, "somebody", wanted, options)
        theirs = downloads.add(connection, 4, "other", wanted, options)
        assert downloads.change(connection, mine[0].id, only=["queued"], state="done", started_ns=5)
        first = downloads.next_one(connection)
        for job in (*mine, theirs):
            downloads.change(connection, job.id, only=["queued"], state="cancelled")
    assert first is not None
    assert first.id == theirs.id


def test_asking_and_fetching_are_in_the_audit_log(home: House) -> None:
    told, _ = made(home, items=["battery"])
    with home.services.database.reading() as connection:
        rows = connection.execute(AUDIT.select()).all()
    about = [row for row in rows if told["id"] in str(row)]
    assert {"downloads.ask", "downloads.fetch"} <= {row.action for row in about}
