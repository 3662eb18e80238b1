"""Verbs with a robot's page as WHERE give the same as with the robot's own store."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import msgspec
import pyarrow.parquet as pq
import pytest

from amberbox.cli.main import main
from amberbox.client import credentials
from amberbox.client.fleet import Fleet
from amberbox.client.models import Card
from amberbox.client.remote import NOT_YET, RemoteRecord
from amberbox.core.types import Gap
from amberbox.server.accounts import permissions
from amberbox.testing.records import T0_NS
from tests.cli.test_consistency import POWER
from tests.cli.test_structure import WHEEL
from tests.client.served import Served
from tests.server.house import PASSWORD
from tests.support.processes import free_port

Capture = pytest.CaptureFixture[str]


def said(capsys: Capture, *words: str, status: int = 0) -> str:
    capsys.readouterr()
    assert main(list(words)) == status, capsys.readouterr().err
    return capsys.readouterr().out


def refused(capsys: Capture, *words: str, status: int = 2) -> str:
    """Run a command line that has to fail with a line and a hint; return both."""
    capsys.readouterr()
    assert main(list(words)) == status
    text = capsys.readouterr().err
    lines = [line for line in text.splitlines() if not line.startswith("note: ")]
    assert [line.partition(":")[0] for line in lines] in (["error"], ["error", "hint"]), text
    return text


@pytest.mark.parametrize("words", [
    ["query", "odom", "pose_x", "seq", "received", "--json"],
    ["query", "odom", "--from", "-300ms", "--format", "csv"],
    ["query", "note", "--format", "csv"],
    ["query", "battery", "--by", "timestamp", "--to", "2026-09-21T14:13:21Z", "--json"],
    ["query", "odom", "pose_x", "--points", "10", "--json"],
    ["query", "odom", "pose_x", "--mission", "transport-1", "--json"],
    ["events", "--json"],
])  # fmt: skip
def test_rows_are_the_robots_own(technician: Served, capsys: Capture, words: list[str]) -> None:
    verb, *rest = words
    ours = said(capsys, verb, technician.where, *rest)
    assert ours == said(capsys, verb, technician.store, *rest) and ours.strip()


def test_items_are_the_robots_own(technician: Served, capsys: Capture) -> None:
    def known(where: str) -> list[tuple[Any, ...]]:
        listed = json.loads(said(capsys, "items", where, "--json"))
        return [tuple(i[k] for k in ("name", "type", "topic", "rows")) for i in listed]

    assert known(technician.where) == known(technician.store)


def test_missions_are_the_robots_own_and_the_servers(technician: Served, capsys: Capture) -> None:
    ours = json.loads(said(capsys, "mission", "list", technician.where, "--json"))
    own = json.loads(said(capsys, "mission", "list", technician.store, "--json"))
    assert [one for one in ours if one["name"] == "transport"] == own
    begun = said(capsys, "mission", "start", technician.where, "tour", "--parameter", "a=b")
    assert said(capsys, "mission", "end", technician.where).startswith(begun.strip())
    assert "on the robot" in refused(capsys, "mission", "detect", technician.where)


def test_a_plot_is_drawn(technician: Served, capsys: Capture, tmp_path: Path) -> None:
    for where in (technician.where, technician.store):
        said(capsys, "plot", where, "odom", "pose_x", "-o", str(tmp_path / "plot.html"))
        page = (tmp_path / "plot.html").read_text()
        curve = page[page.index('"curves"') :][:2000]
        assert curve.count(",") > 100


def test_gaps_are_listed(technician: Served, capsys: Capture) -> None:
    assert json.loads(said(capsys, "gaps", technician.where, "odom", "--json")) is not None
    assert "no data item" in refused(capsys, "gaps", technician.where, "nothing")


def test_a_file_is_exported_as_on_the_robot(
    technician: Served, capsys: Capture, tmp_path: Path
) -> None:
    words = ("--item", "odom", "--received")
    ours = said(capsys, "export", technician.where, *words)
    assert [*csv.reader(io.StringIO(ours))] == [
        *csv.reader(io.StringIO(said(capsys, "export", technician.store, *words)))
    ]
    for number, where in enumerate((technician.where, technician.store)):
        file = tmp_path / f"{number}.parquet"
        capsys.readouterr()
        main(["export", where, "--item", "odom", "-o", str(file)])
    both = [pq.read_table(tmp_path / f"{number}.parquet") for number in (0, 1)]
    assert both[0].equals(both[1])
    main(["export", technician.where, "--format", "csv", "-o", str(tmp_path / "all")])
    assert {"odom.csv", "note.csv"} <= {path.name for path in (tmp_path / "all").rglob("*.csv")}
    text = refused(capsys, "export", technician.where, "-o", str(tmp_path / "x.bag"))
    assert "does not make bag" in text
    text = refused(capsys, "export", technician.where, "-o", str(tmp_path / "x.csv"), "--received")
    assert "--received" in text


def test_what_is_still_on_the_robot_is_told_with_how_to_get_it(
    technician: Served, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    gap = Gap("", 0, T0_NS, T0_NS + 10**9, NOT_YET)
    monkeypatch.setattr(RemoteRecord, "gaps", lambda *_: [gap])
    text = refused(capsys, "export", technician.where, "--item", "note", status=1)
    assert "not all of it is on the server yet" in text
    window = "note 2026-09-21T14:13:20.000Z 2026-09-21T14:13:21.000Z"
    assert f"amberbox fetch {technician.where} {window} --wait" in text


def test_status_is_a_table_a_component_and_json(technician: Served, capsys: Capture) -> None:
    table = said(capsys, "status", technician.where, status=1)
    assert table.startswith("ropod_001: ") and "laser_front" in table and "offline" in table
    assert "7 (urgent, " in table
    detail = said(capsys, "status", technician.where, "laser_front", status=1)
    assert "heartbeat / alive" in detail and "needs" in detail
    tree = json.loads(said(capsys, "status", technician.where, "--json", status=1))
    laser = next(one for one in tree["components"] if one["component"] == "laser_front")
    assert laser["level"] == "unknown" and laser["modes"][0]["outputs"] == {"alive": False}
    words = ("status", technician.where, "laser_front", "--wait", "100ms")
    assert "offline" in refused(capsys, *words, status=1)
    assert "did you mean" in refused(capsys, "status", technician.where, "laser_fronk")


def test_status_of_a_server_is_that_of_its_fleet_worst_first(
    technician: Served, capsys: Capture
) -> None:
    server = technician.where.replace("/robots/ropod_001", "")
    alarms = json.loads(said(capsys, "alarm", technician.where, "--json"))
    is_open = [one["state"] for one in alarms] == ["open"]  # other tests acknowledge it
    head, columns, *lines = said(capsys, "status", server, status=1).splitlines()
    assert head == "3 robots: 3 unknown" and columns.split() == ["robot", "status", "alarms"]
    first, *others = lines
    number = "1 open" if is_open else "      "
    assert first.startswith(f"ropod_001  unknown  {number}  Offline. When it was last heard of: ")
    assert "(as of 20" in first
    assert [line.split()[0] for line in others] == ["ropod_002", "ropod_003"]
    assert all("Never connected." in line for line in others)
    found = json.loads(said(capsys, "status", server, "--json", status=1))
    assert found["server"] == technician.url
    assert [one["robot"] for one in found["robots"]] == ["ropod_001", "ropod_002", "ropod_003"]
    assert {one["level"] for one in found["robots"]} == {"unknown"}
    assert "--robot" in refused(capsys, "status", server, "laser_front")


def test_robots_that_are_switched_off_are_last_and_do_not_count(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    cards = [
        {"robot": "a", "disabled": True, "level": "unknown"},
        {"robot": "b", "online": True, "level": "ok", "last_level": "ok"},
        {"robot": "c", "online": True, "level": "warn", "last_level": "warn"},
    ]
    monkeypatch.setattr(Fleet, "robots", lambda _: msgspec.convert(cards, list[Card]))
    lines = said(capsys, "status", "https://server.example").splitlines()
    assert [line.split()[0] for line in lines[2:]] == ["c", "b", "a"]
    assert lines[-1].endswith("Switched off by an admin.")


def test_a_diagnosis_is_told_as_on_the_robot(
    technician: Served, capsys: Capture, tmp_path: Path
) -> None:
    text = said(capsys, "diagnose", technician.where, "--answer", "laser_front.lamp=no", status=1)
    assert "The front laser has no power." in text and "Do this next" in text
    made = json.loads(said(capsys, "diagnose", technician.where, "--json", status=1))
    assert made["state"] == "open" and made["hypotheses"]
    svg = tmp_path / "why.svg"
    words = ("--symptom", "laser_rear/heartbeat/alive", "--svg", str(svg))
    what_if = said(capsys, "diagnose", technician.where, *words, status=1)
    assert "rear" in what_if and svg.read_text().startswith("<svg")
    assert "--follow" in refused(capsys, "diagnose", technician.where, "--follow")
    assert "no answer" in refused(capsys, "diagnose", technician.where, "--answer", "x")


def test_what_is_known_of_faults(technician: Served, capsys: Capture) -> None:
    for action in ("table", "criticality", "coverage"):
        assert "laser" in said(capsys, "fmea", action, technician.where)
    assert "on this computer" in refused(capsys, "fmea", "check", technician.where)
    trees = said(capsys, "faulttree", technician.where)
    effect = trees.splitlines()[2].split()[0]
    one = said(capsys, "faulttree", technician.where, "--effect", effect, "--cut-sets", "2",
               "--most-probable", "1")  # fmt: skip
    assert "most probable minimal cut sets: 1, " in one and "{" in one
    assert "missing" in said(capsys, "faulttree", technician.where, "--closest")
    words = ("--ask", "status(C, ok, F, T)", "--from", "2027-01-01", "--why")
    answers = said(capsys, "rules", "--where", technician.where, *words)
    assert answers.startswith("C = laser_front") and "watcher" in answers
    assert "a goal" in refused(capsys, "rules", "--where", technician.where)


def test_models_answer_as_on_the_robot(technician: Served, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "wheel.yaml").write_text(WHEEL)
    (tmp_path / "power.yaml").write_text(POWER)
    archive = str(technician.data)
    for verb, name, words in (
        ("structure", "wheel", []),
        ("structure", "wheel", ["--mso"]),
        ("structure", "wheel", ["--sensors", "--measurable", "torque", "speed"]),
        ("consistency", "power", ["--observe", "b1.out=on", "--minimal", "rank"]),
    ):
        here = said(capsys, verb, str(tmp_path / f"{name}.yaml"), *words)
        assert said(capsys, verb, technician.where, name, *words) == here
        assert said(capsys, verb, archive, name, *words) == here
    assert "its own" in refused(capsys, "structure", technician.where, "wheel", "--seconds", "1")
    assert "did you mean 'wheel'?" in refused(capsys, "structure", technician.where, "wheels")


def test_alarms_are_the_servers(technician: Served, capsys: Capture) -> None:
    listed = json.loads(said(capsys, "alarm", technician.where, "--json"))
    assert list(listed[0])[10:14] == ["changed", "count", "revision", "window"]
    assert list(listed[0])[-1] == "merged_into"
    assert [(one["id"], one["origin"]) for one in listed] == [(7, "laser")]
    assert "acknowledged" in said(capsys, "alarm", technician.where, "ack", "laser")
    words = ("alarm", technician.where, "shelve", "7", "--for", "2h")
    assert "reason" in refused(capsys, *words)
    assert "shelved until" in said(capsys, *words, "--note", "spare part")
    assert "7 (laser)" in said(capsys, "alarm", technician.where, "unshelve", "7")
    assert "no alarm 'nothing'" in refused(capsys, "alarm", technician.where, "ack", "nothing")


def test_incidents_are_listed_marked_shown_released(technician: Served, capsys: Capture) -> None:
    assert "incident-1" in said(capsys, "incident", "list", technician.where)
    shown = said(capsys, "incident", "show", technician.where, "incident-1")
    assert "odom" in shown and "it bumped" in shown
    rows = said(capsys, "query", technician.where, "odom", "--incident", "incident-1", "--json")
    assert len(json.loads(rows)) == 100
    assert "--reason" in refused(capsys, "incident", technician.where)
    made = said(capsys, "incident", technician.where, "--reason", "odd", "--json")
    assert "is released" in said(
        capsys, "incident", "release", technician.where, json.loads(made)["id"]
    )
    refused(capsys, "incident", "release", technician.where, "incident-1")


def test_a_window_is_fetched(technician: Served, capsys: Capture) -> None:
    asked = said(capsys, "fetch", technician.where, "odom", "2026-09-21T14:00Z", "now", "--json")
    (one,) = json.loads(asked)
    assert one["state"] == "waiting"
    assert one["id"] in said(capsys, "fetch", technician.where)
    assert "no address" in refused(capsys, "fetch", technician.store)


def test_what_cannot_be_done_on_a_server_is_a_line(technician: Served, capsys: Capture) -> None:
    for words in (
        ["sql", technician.where, "select 1"], ["query", technician.where, "odom", "--follow"],
        ["verify", technician.where], ["foxglove", technician.where],
        ["items", technician.store, "--robot", "x"],
        ["items", technician.where, "--robot", "other"],
    ):  # fmt: skip
        refused(capsys, *words)


def test_each_trouble_is_a_line(
    server: Served, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "sign-in" in refused(capsys, "items", server.where)
    monkeypatch.setenv(credentials.VARIABLE, "abt_wrong")
    assert "does not work" in refused(capsys, "items", server.where)
    monkeypatch.setenv(credentials.VARIABLE, server.tokens["viewer"])
    other = server.where.replace("ropod_001", "ropod_009")
    assert "no such robot" in refused(capsys, "items", other)
    assert "may not" in refused(capsys, "export", server.where, "--format", "csv", "-o", "all.zip")
    wrong = f"{server.url}/robots/ropod_001#ca=sha256:{'0' * 64}"
    assert "authority" in refused(capsys, "items", wrong, status=1)
    assert "not trusted" in refused(capsys, "items", f"{server.url}/robots/ropod_001", status=1)
    down = f"http://localhost:{free_port()}/robots/r"
    assert "does not answer" in refused(capsys, "items", down, status=1)


def test_signing_in_keeps_a_token_for_its_owner_only(
    server: Served, capsys: Capture, monkeypatch: pytest.MonkeyPatch, home: Path
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(server.tokens["viewer"] + "\n"))
    address = f"{server.url}#ca=sha256:{server.pin}"
    assert "signed in" in said(capsys, "sign-in", address)
    file = home / "config" / "amberbox" / "servers.yaml"
    assert file.stat().st_mode & 0o777 == 0o600
    assert "odom" in said(capsys, "items", f"{server.url}/robots/ropod_001")
    assert "odom" in said(capsys, "items", server.url, "--robot", "ropod_001")
    assert "3 robots" in refused(capsys, "items", server.url)
    file.chmod(0o644)
    assert "chmod 600" in refused(capsys, "items", server.url)
    file.chmod(0o600)
    assert "signed out" in said(capsys, "sign-out", server.url)
    assert "nobody is signed in" in refused(capsys, "sign-out", server.url)


def test_a_name_and_a_password_make_a_token_for_this_computer(
    server: Served, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = f"{server.url}#ca=sha256:{server.pin}"
    monkeypatch.setattr("sys.stdin", io.StringIO("not the right password\n"))
    assert "wrong" in refused(capsys, "sign-in", address, "--user", "technician")
    monkeypatch.setattr("sys.stdin", io.StringIO(PASSWORD + "\n"))
    assert "signed in" in said(capsys, "sign-in", address, "--user", "technician")
    assert "odom" in said(capsys, "items", f"{server.url}/robots/ropod_001")
    monkeypatch.setattr("sys.stdin", io.StringIO(PASSWORD + "\n"))
    refused(capsys, "sign-in", address, "--user", "viewer")  # viewers make no tokens


def test_a_server_without_commands_gives_a_token_for_the_rest(
    server: Served, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    later = {**permissions.SCOPES, "fly:commands": "what this server does not know"}
    monkeypatch.setattr(permissions, "SCOPES", later)
    monkeypatch.setattr("sys.stdin", io.StringIO(PASSWORD + "\n"))
    address = f"{server.url}#ca=sha256:{server.pin}"
    assert "signed in" in said(capsys, "sign-in", address, "--user", "technician")
    assert "odom" in said(capsys, "items", f"{server.url}/robots/ropod_001")


def test_a_strange_authority_and_a_wrong_token_are_not_kept(
    server: Served, capsys: Capture, monkeypatch: pytest.MonkeyPatch, home: Path
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("abt_wrong\n"))
    assert server.pin in refused(capsys, "sign-in", server.url)
    address = f"{server.url}#ca=sha256:{server.pin}"
    assert "does not work" in refused(capsys, "sign-in", address)
    refused(capsys, "sign-in", f"{server.url}#ca=sha256:{'1' * 64}", status=1)
    assert not (home / "config").exists()
