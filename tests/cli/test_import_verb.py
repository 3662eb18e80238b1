"""``amberbox import``: exit status, report, JSON, bar; and a recording in place of a store."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from amberbox.cli.main import main
from tests.blackbox.formats.test_mongodump import write_dump
from tests.blackbox.formats.ulog_file import flight
from tests.support.manual_recorder import COUNT, ManualBox, number

TYPES = get_typestore(Stores.ROS1_NOETIC)
Capture = pytest.CaptureFixture[str]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path, kind = tmp_path / "some.bag", "std_msgs/msg/Float64"
    writer = Writer(path)
    writer.chunk_threshold = 1000
    with writer:
        connection = writer.add_connection("/voltage", kind, typestore=TYPES)
        for n in range(500):
            data = TYPES.serialize_ros1(TYPES.types[kind](n / 2), kind)
            writer.write(connection, 10**18 + n * 10**8, data)
    return path


@pytest.fixture
def torn(bag: Path) -> Path:
    path = bag.with_name("torn.bag")
    path.write_bytes(bag.read_bytes()[:9000])
    return path


def test_the_report_for_people(bag: Path, tmp_path: Path, capsys: Capture) -> None:
    store = str(tmp_path / "store")
    assert main(["import", str(bag), "--store", store]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == [f"{bag}: 500 messages", "  ros_voltage: 500"]
    assert lines[-1].startswith("500 messages in ") and lines[-1].endswith(f"now in {store}")
    assert main(["import", str(bag), "--store", store]) == 0
    assert "is in the store already, nothing was done" in capsys.readouterr().out
    assert main(["items", store]) == 0
    assert "ros_voltage" in capsys.readouterr().out


def test_the_report_for_programs(bag: Path, torn: Path, tmp_path: Path, capsys: Capture) -> None:
    arguments = ["--store", str(tmp_path / "store"), "--source", "robot", "--json"]
    assert main(["import", str(bag), str(torn), *arguments]) == 1
    whole, broken = json.loads(capsys.readouterr().out)
    assert whole == {
        "path": str(bag),
        "messages": 500,
        "items": {"robot_voltage": 500},
        "kinds": {},
        "accounts": [],
        "notes": [],
        "damage": [],
        "already_imported": False,
    }
    assert 0 < broken["messages"] < 500
    assert broken["damage"]


def test_a_bar_shows_progress_on_a_terminal(
    bag: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert main(["import", str(bag), "--store", str(tmp_path / "store")]) == 0
    assert capsys.readouterr().err.endswith("[##############################] 100%\n")


def test_wrong_usage(tmp_path: Path, capsys: Capture) -> None:
    assert main(["import", str(tmp_path / "none.bag"), "--store", str(tmp_path / "store")]) == 2
    assert "there is no recording at" in capsys.readouterr().err
    assert main(["import", "x.bag"]) == 2
    assert "--store" in capsys.readouterr().err


def test_what_is_no_recording_is_a_problem(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "notes.bag").write_text("milk, bread, and a long line of something else")
    store = str(tmp_path / "store")
    assert main(["import", str(tmp_path / "notes.bag"), "--store", store]) == 1
    printed = capsys.readouterr().err
    assert "notes.bag" in printed
    assert "Traceback" not in printed


def test_a_bag_is_a_record_like_any_other(bag: Path, capsys: Capture) -> None:
    assert main(["items", str(bag), "--json"]) == 0
    items = {item["name"]: item for item in json.loads(capsys.readouterr().out)}
    assert (items["ros_voltage"]["rows"], items["ros_voltage"]["rate_hz"]) == (500, 10.0)
    assert main(["query", str(bag), "ros_voltage", "--from", "-1s", "--format", "json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["data"] for row in rows] == [n / 2 for n in range(489, 500)]
    assert main(["sql", str(bag), "select max(data) as most from ros_voltage"]) == 0
    assert "249.5" in capsys.readouterr().out
    assert sorted(path.name for path in bag.parent.iterdir()) == ["some.bag"]


def test_damage_of_a_bag_is_told_beside_the_answer(torn: Path, capsys: Capture) -> None:
    assert main(["items", str(torn), "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)[0]["name"] == "ros_voltage"
    assert printed.err.startswith("note: damaged: ")


def test_a_journal_file_is_a_record_like_any_other(tmp_path: Path, capsys: Capture) -> None:
    box = ManualBox(tmp_path / "store")
    for n in range(20):
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    (journal,) = (box.store / "journal").glob("*.mcap")
    assert main(["query", str(journal), "ros_count", "--format", "csv"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 21


def test_inputs_of_many_kinds_in_one_call(bag: Path, tmp_path: Path, capsys: Capture) -> None:
    dump = write_dump(tmp_path / "dump", 5)
    log = flight(20, with_gps=False).write(tmp_path / "flight.ulg")
    (tmp_path / "weather.csv").write_text("when_s,wind,time\n3,2.5,x\n4,3.5,y\n")
    inputs = [str(path) for path in (bag, dump, log, tmp_path / "weather.csv")]
    store = str(tmp_path / "store")
    options = ["--time", "when_s", "--start", "2018-12-10T12:00:00Z", "--store", store]
    assert main(["import", *inputs, *options]) == 0
    printed = capsys.readouterr().out
    assert "  ros_joy: 5, typed (sensor_msgs/Joy, built in)" in printed
    assert "  ros_joy.bson: 5 documents = 5 messages + 0 refused" in printed
    assert "  weather: 2, from a table: 1 float, 1 text" in printed
    assert main(["items", store, "--json"]) == 0
    items = {item["name"]: item for item in json.loads(capsys.readouterr().out)}
    assert items["weather"]["first"] == "2018-12-10T12:00:00.000000000Z"
    assert items["ulog_sensor_accel"]["first"] == "2018-12-10T12:00:00.000000000Z"
    assert items["ros_ropod_odom"]["stamp_offset_s"] == pytest.approx(-84.4)


def test_definitions_and_topics_are_chosen(tmp_path: Path, capsys: Capture) -> None:
    dump = write_dump(tmp_path / "dump", 5)
    arguments = ["import", str(dump), "--store", str(tmp_path / "store")]
    assert main([*arguments, "--msg", str(tmp_path / "none")]) == 2
    assert "there is no folder" in capsys.readouterr().err
    assert main([*arguments, "--start", "soon"]) == 2
    assert "not a time" in capsys.readouterr().err
    assert main([*arguments, "--topics", "/joy", "/marker", "--json"]) == 0
    (report,) = json.loads(capsys.readouterr().out)
    assert report["items"] == {"ros_joy": 5, "ros_marker": 5}
    assert report["kinds"]["ros_joy"] == "typed (sensor_msgs/Joy, built in)"
    assert len(report["accounts"]) == 4


def test_a_dump_is_a_record_like_any_other(tmp_path: Path, capsys: Capture) -> None:
    dump = write_dump(tmp_path / "dump", 5)
    assert main(["items", str(dump)]) == 0
    assert "ros_ropod_odom" in capsys.readouterr().out


@pytest.mark.needs_data
def test_the_84_seconds_of_the_nominal_dump_are_told(
    shared_data: Path, tmp_path: Path, capsys: Capture
) -> None:
    store = str(tmp_path / "store")
    assert main(["import", str(shared_data / "ropod/nominal"), "--store", store]) == 0
    capsys.readouterr()
    assert main(["items", store]) == 0
    lines = capsys.readouterr().out.splitlines()
    (odom,) = (line.split() for line in lines if line.startswith("ros_ropod_odom"))
    assert odom[2] == "838" and "-84.4238" in odom
