"""What a server learns: models of detectors, causes; and what cannot be learnt from."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.blackbox.query.record import open as open_record
from amberbox.cli.main import main
from amberbox.client.fleet import Fleet
from amberbox.client.opening import open_remote
from amberbox.consult.repairs import FoundFaults, read_situations
from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time
from amberbox.detection.model_file import load_model
from amberbox.testing.records import T0_NS
from tests.client.served import Served
from tests.server.knowledge import robot as sim
from tests.support.processes import wait_for

FMEA = """\
defaults: {detects: 0.5, within_s: 0.5}
types:
  laser_front:
    failure_modes:
      silent: {probability: 0.01, symptoms: [laser_front/heartbeat/alive]}
"""

BANK = """\
bank:
  sensors: [battery.volts]
  models:
    holds: {F: [[1]], H: [[1]], Q: [[1e-4 * dt]], R: [[0.01]]}
    falls: {F: [[1]], H: [[1]], Q: [[1 * dt]], R: [[0.01]]}
"""


def test_a_server_keeps_what_it_was_in_the_end(fleet: Fleet) -> None:
    said = fleet.cause("ropod_001", sim.DIAGNOSIS, "laser_front#silent", "the plug was loose")
    assert said["failure_mode"] == "laser_front#silent"
    assert fleet.diagnosis("ropod_001", sim.DIAGNOSIS)["causes"] == [said]


def test_a_record_on_a_server_lasts_as_long_as_the_robots(technician: Served) -> None:
    nothing = FoundFaults({}, {})
    with open_remote(technician.where) as record, open_record(technician.robot.store) as own:
        found, local = (read_situations(one, nothing) for one in (record, own))
    assert 0 < found.hours <= local.hours
    assert all(not one.faults for one in found.situations)


def test_what_cannot_be_learnt_from_is_said(
    technician: Served, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "fmea.yaml"
    file.write_text(FMEA)
    for arguments, what in (
        ([str(file), technician.where], "nobody watched"),
        ([technician.where], "changes a fmea.yaml on this computer"),
        ([str(file), str(technician.data)], "has several robots"),
        ([str(file), str(technician.data / "journals" / "ropod_001")], "nobody watched"),
    ):
        assert main(["fmea", "learn", *arguments]) == 2
        assert what in capsys.readouterr().err


def test_a_server_learns_and_the_model_comes_to_a_robot(
    technician: Served, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kitchen = f"{technician.url}/robots/ropod_003#ca=sha256:{technician.pin}"
    server = f"{technician.url}#ca=sha256:{technician.pin}"
    file, again = tmp_path / "drive.model", tmp_path / "again.model"
    words = ["--name", "drive", "--detectors", "guard", "bank", "--options"]
    options = tmp_path / "options.yaml"
    options.write_text(BANK)
    assert main(["learn", kitchen, *words, str(options), "-o", str(file)]) == 0
    said = capsys.readouterr().out
    assert "learnt drive version 1" in said and "can be promised" in said
    assert set(load_model(file).detectors) == {"guard", "bank"}
    assert main(["learn", kitchen, "--name", "drive", "--detectors", "guard", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["learnt"].startswith("drive version 2")
    assert main(["model", server]) == 0
    assert capsys.readouterr().out.count("done") == 2
    assert main(["model", "get", server, "drive:1", "-o", str(again)]) == 0
    assert again.read_bytes() == file.read_bytes()
    assert main(["model", "get", server, "drive", "-o", str(again)]) == 0
    assert load_model(again).origin["version"] == 2
    span = ["--from", "2026-09-21T14:13:25Z", "--to", "2026-09-21T14:13:40Z"]
    capsys.readouterr()
    assert main(["model", "detect", kitchen, "drive:2", *span]) == 0
    assert "ropod_003  guard.silent." in capsys.readouterr().out
    assert main(["model", "delete", server, "drive:2"]) == 0
    capsys.readouterr()
    for wrong, what in (
        (["model", "get", server, "drvie", "-o", str(again)], "did you mean 'drive'"),
        (["model", "delete", server, "drive"], "name the version"),
        (["model", str(tmp_path)], "no address of a server"),
        (["model", "detect", server, "drive", "--from", "-1m"], "the range of detect"),
        (["model", "follow", server, "drive", "--to", "-1m"], "--from that of follow"),
        (["model", "follow", server, "drive"], "only a model of a team"),
        (["learn", kitchen, "--team"], "two robots at least"),
        (["learn", kitchen, str(tmp_path)], "not both"),
        (["learn", kitchen, "--missions", "nowhere"], "no mission 'nowhere'"),
        (["learn", kitchen, "--monitors", str(tmp_path)], "does not write monitors"),
        (["learn", str(tmp_path), "--name", "x"], "models on a server"),
    ):
        assert main(wrong) in (1, 2)
        assert what in capsys.readouterr().err, wrong


def test_a_model_of_a_team_follows_its_robots(
    technician: Served, capsys: pytest.CaptureFixture[str]
) -> None:
    """As far as the first robot's record reaches, which ends before that of the other begins."""
    server, team = f"{technician.url}#ca=sha256:{technician.pin}", ["ropod_001", "ropod_003"]
    begin_ns, end_ns = T0_NS, T0_NS + 10 * NS
    with Fleet(server) as fleet:
        for robot in team:
            mission = fleet.begin_mission(robot, "together", at=begin_ns)
            fleet.end_mission(robot, mission.id, "done", at=end_ns)
        asked = fleet.learn(
            team, name="pair", team=True, missions=["together"], detectors=["guard"]
        )
        fleet.wait_model(asked.id)
        assert main(["model", "follow", server, "pair", "--from", format_time(begin_ns)]) == 0
        assert "pair version 1 follows ropod_001, ropod_003" in capsys.readouterr().out
        wait_for(
            lambda: fleet.following_model(asked.id).to > format_time(begin_ns + NS) or None,
            "it has read what the first robot has handed in",
        )
    assert main(["model", "follow", server, "pair", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["from"], found["error"]) == (format_time(begin_ns), "")
    assert found["to"] < format_time(begin_ns + 3 * NS)
    assert main(["model", "unfollow", server, "pair"]) == 0
    assert "follows no longer" in capsys.readouterr().out
    assert main(["model", "delete", server, "pair:1"]) == 0
    capsys.readouterr()
