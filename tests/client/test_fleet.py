"""The typed client against a server that runs."""

from __future__ import annotations

import socket
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest

import amberbox
from amberbox.client import remote, table_reader, transport
from amberbox.client.fleet import Fleet
from amberbox.client.models import time_ns
from amberbox.client.remote import RemoteRecord
from amberbox.client.transport import (
    ApiConnection,
    ConflictError,
    NotAllowedError,
    NotSignedInError,
    UnreachableError,
)
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time
from amberbox.core.tls import PinError
from amberbox.server.archive.gaps import TO_COME
from amberbox.testing.clock import PATIENCE_S
from amberbox.testing.records import T0_NS
from tests.client.served import Served
from tests.server.data.filled import FORMULAS, ROWS
from tests.server.knowledge import robot as sim
from tests.support.processes import free_port

ROBOT = "ropod_001"
ALL = ROWS + 40


def test_robots_and_one_of_them(fleet: Fleet) -> None:
    robots = fleet.robots()
    assert [one.robot for one in robots] == ["ropod_001", "ropod_002", "ropod_003"]
    assert [one.robot for one in fleet.robots("kitchen")] == ["ropod_003"]
    one = fleet.robot(ROBOT)
    assert (one.groups, one.online, one.level) == (("ward",), False, "unknown")


def test_the_tree_has_components_and_outputs(fleet: Fleet) -> None:
    tree = fleet.status(ROBOT)
    laser = next(one for one in tree.components if one.component == "laser_front")
    assert not tree.online and "offline" in tree.silence
    assert laser.condition is not None and laser.condition.level == "error"
    (mode,) = laser.modes
    assert [(output.name, output.value) for output in mode.outputs] == [("alive", False)]
    lanes = fleet.timeline(ROBOT, sim.AT_NS - 10**10, sim.AT_NS + 10**10).lanes
    assert "laser_front" in [lane.component for lane in lanes]


def test_items_and_columns(fleet: Fleet) -> None:
    odom = next(item for item in fleet.items(ROBOT) if item.name == "odom")
    assert odom.rows == ALL and time_ns(odom.first or "") == T0_NS
    detail = fleet.item(ROBOT, "odom")
    assert {"pose_x"} <= {column.name for column in detail.columns} and detail.rows == ALL


@pytest.mark.parametrize("form", ["arrow", "json"])
def test_rows_are_those_of_the_robot_in_either_form(
    fleet: Fleet, server: Served, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table_reader, "row_format", lambda: form)
    with amberbox.open(server.store) as record:
        for item in ("odom", "battery", "note"):
            ours = fleet.query(ROBOT, item, None)
            own = record.query(item)
            assert ours.fields == own.fields
            assert [*ours.rows()] == [*own.rows()]


@pytest.mark.parametrize("form", ["arrow", "json"])
def test_many_rows_come_in_pages(fleet: Fleet, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_reader, "row_format", lambda: form)
    pages = [*fleet.pages(ROBOT, "odom", ["seq", "pose_x"], rows=50)]
    assert [len(page.table) for page in pages] == [50, 50, 50, 10]
    table = table_reader.concatenate([page.table for page in pages])
    whole = fleet.query(ROBOT, "odom", ["seq", "pose_x"])
    assert [*table.rows()] == [*whole.rows()] and pages[-1].complete_to


def test_rows_are_thinned_out_and_summed_up(fleet: Fleet) -> None:
    assert len(fleet.query(ROBOT, "odom", ["pose_x"], points=10)) <= 10
    (summary,) = fleet.statistics(ROBOT, "odom", ["pose_x"]).variables
    values = np.asarray(fleet.query(ROBOT, "odom", ["pose_x"])["pose_x"])
    assert (summary.count, summary.min, summary.max) == (ALL, values.min(), values.max())


def test_missions_incidents_journals_gaps_events(fleet: Fleet) -> None:
    mission = next(one for one in fleet.missions(ROBOT) if one.origin == "robot")
    assert (mission.id, mission.failed, mission.parameters) == ("transport-1", True, {"to": "B"})
    assert [one.id for one in fleet.incidents(ROBOT) if one.origin == "robot"] == ["incident-1"]
    assert {one.integrity for one in fleet.recordings(ROBOT)} <= {"intact", "unsigned"}
    assert isinstance(fleet.gaps(ROBOT), list) and isinstance(fleet.events(ROBOT), list)


def test_a_note_on_a_moment(fleet: Fleet) -> None:
    made = fleet.annotate(ROBOT, "looked odd", T0_NS)
    assert (made.text, made.mission, made.at) == ("looked odd", "", format_time(T0_NS))
    assert fleet.notes(ROBOT, T0_NS, T0_NS + 1) == [made]
    assert fleet.notes(ROBOT, T0_NS + 1, T0_NS + 2) == []


def test_a_mission_and_an_incident_of_the_server(fleet: Fleet) -> None:
    begun = fleet.begin_mission(ROBOT, "tour", {"rooms": 3})
    ended = fleet.end_mission(ROBOT, begun.id, "aborted")
    assert (ended.name, ended.failed, ended.parameters) == ("tour", True, {"rooms": 3})
    marked = fleet.mark_incident(ROBOT, T0_NS, T0_NS + 10**9, "looked odd")
    assert fleet.release_incident(ROBOT, marked.id).state == "released"


def test_a_window_is_asked_of_the_robot(fleet: Fleet) -> None:
    asked = fleet.fetch(ROBOT, "odom", T0_NS, T0_NS + 10**9)
    assert fleet.fetched(ROBOT, asked.id).state == "waiting"
    assert asked.id in [one.id for one in fleet.fetches(ROBOT)]


def test_a_download_is_made_and_saved(fleet: Fleet, tmp_path: Path) -> None:
    told: list[float] = []
    job = fleet.start_download([ROBOT], ["odom", "note"])
    made = fleet.wait_download(job.id, limit_s=20)
    file = fleet.save_download(made.id, tmp_path, told.append)
    assert file.name == made.file and file.stat().st_size == made.bytes and told[-1] == 1.0
    with zipfile.ZipFile(file) as archive:
        name = next(n for n in archive.namelist() if n.endswith("note.csv"))
        assert FORMULAS[1] in archive.read(name).decode()
    whole = file.read_bytes()
    part = tmp_path / f"again.zip.{made.id}.part"
    part.write_bytes(whole[:100])
    assert fleet.save_download(made.id, tmp_path / "again.zip").read_bytes() == whole
    assert not part.exists() and made.id in [one.id for one in fleet.downloads()]
    assert fleet.cancel_download(made.id).state == "expired"
    with pytest.raises(UsageError, match="expired"):
        fleet.save_download(made.id, tmp_path / "third.zip")


def test_what_is_broken_and_what_can_be(fleet: Fleet) -> None:
    (line,) = fleet.diagnoses(ROBOT)
    assert line.id == sim.DIAGNOSIS and fleet.diagnosis(ROBOT, line.id)["state"] == "open"
    answer = fleet.diagnose(ROBOT, diagnosis=line.id)
    assert answer["state"] == "open" and answer["explanation"]["headline"]
    ranked = fleet.answer(ROBOT, line.id, "laser_front.lamp", "no")
    assert ranked["answers"] == {"laser_front.lamp": "no"}
    assert fleet.fmea(ROBOT)["table"]
    assert fleet.faulttrees(ROBOT)["effects"]
    assert {"power", "wheel"} <= {model.name for model in fleet.model_files(ROBOT)}
    assert fleet.structure(ROBOT, "wheel", show="mso")["count"] == 4
    assert fleet.consistency(ROBOT, "power", ["b1.in=off"])["diagnoses"] == [[]]
    found = fleet.rules(ROBOT, "status(C, ok, From, To)", from_=sim.AT_NS - 10**11)
    assert found["answers"][0]["C"] == "laser_front" and found["proof"]


def test_alarms_can_be_worked_on(fleet: Fleet) -> None:
    open_ones = fleet.alarms(ROBOT, state=["open", "acknowledged"])  # after minutes: it is offline
    (alarm,) = (one for one in open_ones if one.origin == "laser")
    changed = fleet.acknowledge(alarm.id, alarm.revision, "on my way").alarm
    assert changed.state == "acknowledged" and changed.acknowledged is not None
    with pytest.raises(ConflictError, match="meanwhile"):
        fleet.own(alarm.id, alarm.revision, "technician")
    assert fleet.own(alarm.id, changed.revision, "technician").alarm.owner == "technician"
    assert fleet.note(alarm.id, "it was the fuse").history[-1].text == "it was the fuse"
    with pytest.raises(UsageError, match="no such alarm"):
        fleet.resolve(77, 1, "gone")


def test_the_server_itself(server: Served, fleet: Fleet) -> None:
    with pytest.raises(NotAllowedError):
        fleet.audit()
    assert "amberbox_robots 3" in fleet.metrics()
    with Fleet(server.where, server.tokens["admin"]) as admin:
        assert admin.audit(limit=2)[0].seq > 1


def test_changes_are_followed(fleet: Fleet) -> None:
    changes = fleet.follow([ROBOT], ["alarm"])
    first = next(changes)
    assert first.kind == "snapshot" and [r["robot"] for r in first.data["robots"]] == [ROBOT]
    fleet.note(7, "seen by the feed")
    change = next(one for one in changes if one.kind == "alarm")
    assert (change.robot, change.data) == (ROBOT, {"id": 7}) and change.number >= first.number
    with pytest.raises(NotSignedInError):
        next(transport.follow(ApiConnection(fleet.url, "abt_wrong", fleet.wire.context)))


def test_a_connection_that_the_server_closed_is_made_anew(fleet: Fleet) -> None:
    assert fleet.robots()
    kept = fleet.wire._kept
    assert kept is not None and kept.sock is not None
    kept.sock.close()
    assert fleet.robots()


def test_nothing_is_sent_on_a_connection_that_the_server_has_ended() -> None:
    """A request that changes something is never repeated, so it must not go there at first."""

    def answer_once_each() -> None:
        for _ in range(2):
            connection, _address = listener.accept()
            with connection:
                connection.recv(65536)
                connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\n{}")
            ended.set()

    ended = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        server = threading.Thread(target=answer_once_each)
        server.start()
        wire = ApiConnection(f"http://127.0.0.1:{listener.getsockname()[1]}")
        assert wire.send("POST", "/a").body == b"{}"
        assert ended.wait(PATIENCE_S)
        assert wire.send("POST", "/b").body == b"{}"
        server.join(PATIENCE_S)
        wire.close()


def test_each_trouble_is_a_line(server: Served) -> None:
    with pytest.raises(NotSignedInError, match="does not work any more") as wrong:
        Fleet(server.where, "abt_wrong").robots()
    assert server.url in str(wrong.value) and "amberbox sign-in" in wrong.value.hint
    with pytest.raises(NotSignedInError, match="sign in first"):
        Fleet(server.where).robots()
    with pytest.raises(PinError, match="not 0000"):
        Fleet(server.url, "x", ca=f"sha256:{'0' * 64}")
    with pytest.raises(UnreachableError, match="not trusted"):
        Fleet(server.url, "x").robots()
    with pytest.raises(UnreachableError, match="does not answer: Connection refused"):
        Fleet(f"http://localhost:{free_port()}", "x").robots()
    with pytest.raises(UsageError, match="there is no such robot"):
        Fleet(server.where, server.tokens["viewer"]).items("nobody")
    with pytest.raises(NotAllowedError):
        Fleet(server.where, server.tokens["viewer"]).start_download([ROBOT])
    with pytest.raises(NotAllowedError, match="may not"):
        Fleet(server.where, server.tokens["scope"]).items(ROBOT)
    with pytest.raises(UsageError, match="without TLS"):
        Fleet("http://fleet.example")


def test_a_pem_file_says_whom_to_trust(server: Served, tmp_path: Path) -> None:
    authority = server.data / "tls" / "ca.pem"
    with Fleet(server.url, server.tokens["viewer"], authority) as found:
        assert found.robot(ROBOT).robot == ROBOT
    with pytest.raises(UsageError, match="no certificate"):
        Fleet(server.url, "x", tmp_path / "nothing.pem")


def test_a_record_is_opened_by_its_address(technician: Served) -> None:
    with amberbox.open(technician.where) as record:
        assert isinstance(record, RemoteRecord) and record.robot == ROBOT
        assert record.last_ns() is not None
        with pytest.raises(UsageError, match="SQL"):
            record.sql("select 1")
    with pytest.raises(UsageError, match="3 robots: ropod_001"):
        amberbox.open(f"{technician.url}#ca=sha256:{technician.pin}")


def test_an_unknown_variable_is_named(server: Served) -> None:
    with pytest.raises(UsageError, match="nothing"):
        Fleet(server.where, server.tokens["viewer"]).query(ROBOT, "odom", ["nothing"])


def test_the_reason_of_what_is_still_on_the_robot_is_the_servers() -> None:
    assert remote.NOT_YET == TO_COME
