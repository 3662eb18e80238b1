"""The verb alarm: lists the watcher's alarms, and leaves a person's requests for it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.journal.channels import ALARM
from amberbox.blackbox.store.store import WriterLock, open_store, pending
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.testing.records import T0_NS, FakeRun

LASER, ARM, BASE = "laser-20260921t141320", "arm-20260921t141321", "base-20260921t141322"


def alarm(alarm_id: str, opened_s: int, **more: Any) -> dict[str, Any]:
    """Values of a record of an alarm."""
    opened_ns = T0_NS + opened_s * NS
    return {
        "id": alarm_id, "robot": "r1", "component": alarm_id.split("-")[0], "severity": "urgent",
        "state": "open", "level": "error", "reason": f"reason {opened_s}", "opened_ns": opened_ns,
        "changed_ns": opened_ns, "count": 1, "who": "", "until_ns": None, "config_hash": "h",
        "live_only": False, **more,
    }  # fmt: skip


@pytest.fixture
def store(tmp_path: Path) -> Path:
    run = FakeRun(tmp_path / "store", "watch")
    run.start(T0_NS)
    until_ns = T0_NS + 7200 * NS
    shelved = alarm(ARM, 1, state="shelved", who="bo", until_ns=until_ns, live_only=True)
    records = [
        alarm(BASE, 2), alarm(LASER, 0), alarm(ARM, 1), shelved,
        alarm(LASER, 0, count=2), alarm(BASE, 2, state="healed"),
    ]  # fmt: skip
    for number, values in enumerate(records):
        run.own(ALARM, T0_NS + (3 + number) * NS, values)
    run.close()
    return tmp_path / "store"


def test_the_newest_of_each_is_listed(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["alarm", str(store)]) == 0
    *_, laser, arm = capsys.readouterr().out.splitlines()
    assert laser.split() == (f"{LASER} open error urgent 2026-09-21T14:13:20 2 reason 0".split())
    assert "shelved until 2026-09-21T16:13" in arm
    assert main(["alarm", str(store), "list", "--all"]) == 0
    assert BASE in capsys.readouterr().out


def test_programs_get_them_as_json(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["alarm", str(store), "--json"]) == 0
    laser, arm = json.loads(capsys.readouterr().out)
    assert laser == {
        "id": LASER, "robot": "r1", "component": "laser", "severity": "urgent", "state": "open",
        "level": "error", "reason": "reason 0", "count": 2, "who": "", "config_hash": "h",
        "live_only": False, "opened": "2026-09-21T14:13:20.000000000Z",
        "changed": "2026-09-21T14:13:20.000000000Z", "until": None,
    }  # fmt: skip
    assert arm["until"] == "2026-09-21T16:13:20.000000000Z"


def test_nothing_to_list(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    FakeRun(tmp_path / "store").close()
    assert main(["alarm", str(tmp_path / "store")]) == 0
    assert capsys.readouterr().out == "no alarms now\n"


def test_what_a_person_says_is_left_for_the_watcher(
    store: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.time_ns", lambda: T0_NS)
    lock = WriterLock(open_store(store), "watch")
    assert main(["alarm", str(store), "ack", LASER, "--who", "anna", "--note", "on my way"]) == 0
    assert main(["alarm", str(store), "shelve", LASER, "--for", "2h", "--who", "anna"]) == 0
    lock.release()
    assert main(["alarm", str(store), "unshelve", ARM, "--who", "bo"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{LASER} will be acknowledged",
        f"{LASER} will be shelved for 2h00m",
        f"{ARM} will be taken from the shelf as soon as amberbox watch runs on this store",
    ]
    requests = pending(open_store(store))
    assert {request.kind for request in requests} == {"alarm"}
    assert [request.values for request in requests] == [
        {"id": LASER, "action": "acknowledge", "who": "anna", "until_ns": None,
         "note": "on my way"},
        {"id": LASER, "action": "shelve", "who": "anna", "until_ns": T0_NS + 7200 * NS,
         "note": ""},
        {"id": ARM, "action": "unshelve", "who": "bo", "until_ns": None, "note": ""},
    ]  # fmt: skip


def test_a_component_stands_for_its_alarm(store: Path) -> None:
    assert main(["alarm", str(store), "ack", "laser"]) == 0
    (request,) = pending(open_store(store))
    assert request.values["id"] == LASER


def test_the_end_of_a_component_stands_for_its_alarm(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, where = FakeRun(tmp_path / "store", "watch"), str(tmp_path / "store")
    run.start(T0_NS)
    ids = ["laser_front-1", "laser_rear-1", "wheel_rear-1"]
    for number, alarm_id in enumerate(ids):
        run.own(ALARM, T0_NS + (3 + number) * NS, alarm(alarm_id, number))
    run.close()
    assert main(["alarm", "ack", where, "front"]) == 0
    (request,) = pending(open_store(tmp_path / "store"))
    assert request.values["id"] == ids[0]
    assert main(["alarm", "ack", where, "rear"]) == 2
    assert "hint: name one of laser_rear, wheel_rear" in capsys.readouterr().err


def test_the_user_says_it_and_programs_hear_so(
    store: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("getpass.getuser", lambda: "carla")
    assert main(["alarm", str(store), "ack", LASER, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "id": LASER, "action": "acknowledge", "who": "carla", "until_ns": None, "note": "",
        "watched": False,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["eat"], "no action 'eat'"),
        (["acc", LASER], "did you mean 'ack'"),
        (["ack"], "takes the ID of one alarm"),
        (["list", LASER], "takes no more words"),
        (["ack", "laser-2026"], f"did you mean '{LASER}'"),
        (["ack", BASE], "has healed"),
        (["ack", "lasr"], "did you mean 'laser'"),
        (["ack", LASER, "--for", "2h"], "--for goes with shelve"),
        (["shelve", LASER], "shelved for some time"),
        (["shelve", LASER, "--for", "10ms"], "too short"),
        (["shelve", LASER, "--for", "soon"], "not a duration"),
        (["unshelve", LASER], "is not shelved"),
    ],
)
def test_what_makes_no_sense_is_refused(
    store: Path, capsys: pytest.CaptureFixture[str], words: list[str], what: str
) -> None:
    assert main(["alarm", str(store), *words]) == 2
    assert what in capsys.readouterr().err
    assert pending(open_store(store)) == []


def test_options_may_stand_between_words(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["alarm", str(store), "--json", "ack", LASER]) == 0
    assert json.loads(capsys.readouterr().out)["id"] == LASER
    assert main(["alarm", "--who", "bo", str(store), "shelve", "--for", "2h", LASER]) == 0
    assert main(["alarm", str(store), "--no-such", "ack", LASER]) == 2


def test_the_cause_has_a_column_where_there_is_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = FakeRun(tmp_path / "store", "watch")
    run.start(T0_NS)
    values = alarm(LASER, 0, cause="laser#dead (likely)", diagnosis="r1-1")
    run.own(ALARM, T0_NS + 3 * NS, values)
    run.close()
    assert main(["alarm", str(tmp_path / "store")]) == 0
    header, *_, line = capsys.readouterr().out.splitlines()
    assert header.endswith("cause")
    assert "reason 0" in line and line.endswith("laser#dead (likely)")
    assert main(["alarm", str(tmp_path / "store"), "list", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["cause"], row["diagnosis"]) == ("laser#dead (likely)", "r1-1")
