"""The verb incident: mark, list, show, release; query and export the window."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import amberbox
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.store.incident import load_all
from amberbox.blackbox.store.store import open_store
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.source import TopicOptions
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.manual_recorder import COUNT, ManualBox, number
from tests.support.processes import command, wait_for


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Path]:
    """A robot folder with 10 s of record; its recorder continues."""
    (tmp_path / "robot.yaml").write_text('id: r\nsoftware_version: "1.2"\nstore: {quota: 1 GB}\n')
    (tmp_path / "black_box.yaml").write_text("- sim:\n    topics: [{name: odom}]\n")
    topics = [TopicOptions("/count", keep="ring")]
    options = PipelineOptions(ring_rotate_ns=2 * NS, config_hash="ab12")
    box = ManualBox(tmp_path / "store", topics, options=options)
    for n in range(100):
        box.hear(COUNT, number(n))
        box.write()
    yield tmp_path
    box.close()


def answer(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    assert main([*arguments]) == 0
    return json.loads(capsys.readouterr().out)


def test_mark_list_show_release(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = str(robot)
    window = ("--before", "3s", "--after", "0s")
    made = answer(capsys, "incident", where, *window, "--reason", "bump", "--who", "me", "--json")
    assert made["versions"]["software_version"] == "1.2"
    assert made["versions"]["config_hash"] == "ab12"
    (listed,) = answer(capsys, "incident", "list", where, "--json")
    assert listed == made
    shown = answer(capsys, "incident", "show", where, made["id"], "--json")
    assert shown["items"] == {"ros_count": 30}
    assert shown["bytes"] > 0
    assert any(found["file"].startswith(f"incidents/{made['id']}/ring") for found in shown["files"])
    assert answer(capsys, "incident", "show", where, "last", "--json") == shown
    assert main(["incident", "show", where, made["id"]]) == 0
    text = capsys.readouterr().out
    assert "bump" in text
    assert "ros_count  30 rows" in text
    assert main(["incident", "list", where]) == 0
    assert made["id"] in capsys.readouterr().out
    assert main(["incident", "release", where, made["id"]]) == 0
    assert "is released" in capsys.readouterr().out
    (after,) = answer(capsys, "incident", "list", where, "--json")
    assert after["state"] == "released"


def test_query_and_export_know_the_window(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = str(robot)
    made = answer(capsys, "incident", where, "--before", "3s", "--after", "0s", "--json")
    rows = answer(
        capsys, "query", where, "ros_count", "data", "--incident", made["id"], "--format", "json"
    )
    assert [row["data"] for row in rows] == list(range(70, 100))
    last = ["query", where, "ros_count", "data", "--incident", "last", "--format", "json"]
    assert answer(capsys, *last) == rows
    target = robot / "rows.csv"
    arguments = ["--item", "ros_count", "--incident", made["id"], "-o", str(target)]
    assert main(["export", where, *arguments]) == 0
    assert len(target.read_text().splitlines()) == 31


def test_mistakes_are_told(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = str(robot)
    made = answer(capsys, "incident", where, "--json")
    mistakes = [
        (["show", where, made["id"][:-1] + "x"], f"did you mean '{made['id']}'"),
        (["list"], "./list"),
        (["show", where], "needs WHERE ID"),
        ([where, "more"], "what is 'more'"),
        ([where, "--before", "soon"], "duration"),
        (["list", str(robot / "nothing")], "nothing at"),
    ]
    for arguments, said in mistakes:
        assert main(["incident", *arguments]) == 2
        assert said in capsys.readouterr().err
    assert main(["query", where, "ros_count", "--incident", made["id"], "--from", "-3s"]) == 2
    assert "its own window" in capsys.readouterr().err


def test_no_room_for_incidents_is_told(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (robot / "robot.yaml").write_text("id: r\nstore: {quota: 1 GB}\nincidents: {share: 0 %}\n")
    assert main(["incident", str(robot)]) == 1
    said = capsys.readouterr().err
    assert "not pinned" in said
    assert "incident release" in said
    assert load_all(open_store(robot / "store")) == []


def test_mark_from_python(robot: Path) -> None:
    made = amberbox.mark(robot, before_s=2, after_s=0, reason="asked", who="program")
    assert (made.text, made.who) == ("asked", "program")
    assert (made.to_ns - made.from_ns) / NS == pytest.approx(2, abs=0.01)


def test_check_knows_the_items_of_triggers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "black_box.yaml").write_text(
        "- ros:\n    topics: [{name: /battery, type: sensor_msgs/BatteryState}]\n"
        "- sim:\n    seed: 1\n"
    )
    (tmp_path / "robot.yaml").write_text(
        "id: r\ntriggers:\n"
        "- {name: low, when: ros_batery.percentage < 0.15 for 5s}\n"
        "- {name: fine, when: ros_battery.percentage < 0.15 and sim_any.thing > 3}\n"
        "- {name: own, when: amberbox_event.kind == 'x'}\n"
        "- {name: odd, silence: arm_joint for 5s}\n"
    )
    assert main(["check", str(tmp_path)]) == 2
    said = capsys.readouterr().out
    assert "robot.yaml:3: triggers[0]: there will be no item 'ros_batery'" in said
    assert "did you mean 'ros_battery'" in said
    assert "triggers[3]: no source of black_box.yaml gives an item 'arm_joint'" in said
    assert "triggers[1]" not in said
    assert "triggers[2]" not in said


@pytest.mark.parametrize(
    ("trigger", "said"),
    [
        ("{name: a, when: x.y +}", "something is missing"),
        ("{name: a, when: x.y + 1}", "no condition"),
        ("{name: a, when: x}", "no recorded variable"),
        ("{name: a}", "one of when, event and silence is needed"),
        ("{name: a, event: b, silence: c for 5s}", "event and silence"),
        ("{name: a, silence: c}", "no silence"),
        ("{name: A b, event: c}", "no id"),
        ("{name: a, event: c, before: -1}", "must not be below 0"),
    ],
)
def test_triggers_that_make_no_sense_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], trigger: str, said: str
) -> None:
    (tmp_path / "black_box.yaml").write_text("- sim:\n    seed: 1\n")
    (tmp_path / "robot.yaml").write_text(f"id: r\ntriggers:\n- {trigger}\n")
    assert main(["check", str(tmp_path)]) == 2
    assert said in capsys.readouterr().out


@contextmanager
def recorder(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command("record", folder, "--quiet"), stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE_S)


def keeper_of(parent: int) -> int | None:
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = status.read_text()
            command = (status.parent / "cmdline").read_bytes()
        except OSError:
            continue
        if int(text.rpartition(")")[2].split()[1]) == parent and b"blackbox.keeper" in command:
            return int(status.parent.name)
    return None


def battery_rows(store: Path) -> int:
    with amberbox.open(store) as record:
        return sum(item.rows for item in record.items() if item.name == "sim_battery")


def test_a_real_recorder_pins_what_its_trigger_says(tmp_path: Path) -> None:
    (tmp_path / "black_box.yaml").write_text(
        "- sim:\n    times: now\n    topics: [{name: odom, keep: ring}, {name: battery}]\n"
    )
    (tmp_path / "robot.yaml").write_text(
        "id: r\nstore: {quota: 1 GB, reserve: 0}\ntriggers:\n"
        "- {name: going, when: known(sim_battery.header_seq), before: 1s, after: 0.5s}\n"
    )
    store = tmp_path / "store"
    with recorder(tmp_path) as process:
        keeper = wait_for(lambda: keeper_of(process.pid), "the recorder has a keeper")
        wait_until(lambda: list(store.glob("ring/*.mcap")), "the ring has a file")
        os.kill(keeper, signal.SIGKILL)
        made = amberbox.mark(tmp_path, before_s=1, after_s=0, reason="by hand")
        assert (store / "incidents" / made.id / "incident.json").exists()
        # the trigger is about the battery, which may come after the ring has its first file
        wait_until(lambda: battery_rows(store) > 1, "the battery is recorded")
    (by_hand,) = [i for i in load_all(open_store(store)) if i.id == made.id]
    assert by_hand.state in ("open", "complete")
    once = [sys.executable, "-m", "amberbox.blackbox.keeper", str(store), "--once"]
    trigger = {"name": "going", "when": "known(sim_battery.header_seq)", "before_s": 1}
    subprocess.run([*once, "--options", json.dumps({"triggers": [trigger]})], check=True)
    incidents = load_all(open_store(store))
    assert all(incident.state == "complete" for incident in incidents)
    reasons = [reason for incident in incidents for reason in incident.reasons]
    assert sorted(reason.trigger for reason in reasons) == ["", "going"]
    for path in (store / "ring").glob("*.mcap"):
        path.unlink()
    assert len(amberbox.open(store).query("sim_odom")) > 0
