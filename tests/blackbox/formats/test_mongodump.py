"""mongodump folders: typed as if recorded live, else inferred, every document accounted for."""

from __future__ import annotations

import datetime
import gzip
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bson
import msgspec
import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

import amberbox
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.formats import _recording, mongodump
from amberbox.blackbox.formats._open import open_recording
from amberbox.blackbox.formats._recording import ReadOptions, RecordingReader
from amberbox.blackbox.query.importing import ImportReport, import_recordings
from amberbox.blackbox.query.table import Table
from amberbox.core.errors import AmberboxError, UsageError
from tests.blackbox.formats.dump_folder import (
    START_S,
    as_document,
    write_collection,
    write_metadata,
)

TYPES = get_typestore(Stores.ROS1_NOETIC)
T = TYPES.types
COUNT = 60
MADE = "5c0e4e40c3eceb2410151130"


def log_ns(n: int) -> int:
    return 1_544_445_498_250_000_000 + n * 125_000_000


def header(n: int, stamp_s: float) -> Any:
    time = T["builtin_interfaces/msg/Time"](int(stamp_s), int(stamp_s % 1 * 1e9))
    return T["std_msgs/msg/Header"](n, time, f"frame {n % 3}")


def laser(n: int) -> Any:
    ranges = np.array([math.inf, -math.inf, math.nan, n / 8, *range(n % 5)], np.float32)
    return T["sensor_msgs/msg/LaserScan"](
        header(n, START_S + 84.4 + n / 8), 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, ranges,
        np.zeros(0, np.float32),
    )  # fmt: skip


def odom(n: int) -> Any:
    vector, point, quaternion = (
        T[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Point", "Quaternion")
    )
    pose = T["geometry_msgs/msg/Pose"](point(n / 3, -0.0, 1e300), quaternion(0.0, 0.0, 0.6, 0.8))
    twist = T["geometry_msgs/msg/Twist"](vector(n * 1.5, 0.0, 0.0), vector(0.0, 0.0, math.nan))
    covariance = np.arange(36, dtype=np.float64) * n
    return T["nav_msgs/msg/Odometry"](
        header(n, START_S + 84.4 + n / 8),
        "base_link",
        T["geometry_msgs/msg/PoseWithCovariance"](pose, covariance),
        T["geometry_msgs/msg/TwistWithCovariance"](twist, covariance / 2),
    )


def joy(n: int) -> Any:
    return T["sensor_msgs/msg/Joy"](
        header(n, START_S), np.array([n, -n], np.float32), np.arange(n % 4, dtype=np.int32)
    )


def camera(n: int) -> Any:
    """Make a message with bools, bytes, durations, texts and structures in lists."""
    return T["visualization_msgs/msg/Marker"](
        header(n, START_S), "ns", n, 1, 0, odom(n).pose.pose, odom(n).twist.twist.linear,
        T["std_msgs/msg/ColorRGBA"](1.0, 0.5, 0.25, 1.0),
        T["builtin_interfaces/msg/Duration"](-n, 5), n % 2 == 0,
        [odom(k).pose.pose.position for k in range(n % 3)],
        [T["std_msgs/msg/ColorRGBA"](0.0, 0.0, 0.0, float(n))] * (n % 2), "text ü", "", False,
    )  # fmt: skip


KINDS = {
    "/ropod/odom": ("nav_msgs/Odometry", odom),
    "/ropod/laser/scan": ("sensor_msgs/LaserScan", laser),
    "/joy": ("sensor_msgs/Joy", joy),
    "/marker": ("visualization_msgs/Marker", camera),
}


def collection_of(topic: str) -> str:
    return "ros_" + topic.strip("/").replace("/", "_")


def write_dump(folder: Path, count: int = COUNT) -> Path:
    write_metadata(folder, *((collection_of(t), t, kind) for t, (kind, _) in KINDS.items()))
    for topic, (_, make) in KINDS.items():
        documents = ({**as_document(make(n)), "timestamp": START_S + n / 8} for n in range(count))
        write_collection(folder, collection_of(topic), documents)
    return folder


def write_bag(path: Path) -> Path:
    """Write the same messages as the robot's own recorder would have."""
    with Writer(path) as writer:
        for topic, (kind, make) in KINDS.items():
            name = kind.replace("/", "/msg/")
            connection = writer.add_connection(topic, name, typestore=TYPES)
            for n in range(COUNT):
                data = TYPES.serialize_ros1(make(n), name)
                writer.write(connection, log_ns(n), data)
    return path


def imported(path: Path, store: Path, **options: Any) -> ImportReport:
    (report,) = import_recordings([path], store, options=ReadOptions(**options))
    return report


def comparable(table: Table) -> list[tuple[Any, ...]]:
    return [(f.name, f.type, f.unit, str(table.values(f.name))) for f in table.fields]


@pytest.mark.parametrize("room", [_recording.ROOM_BYTES, 0])
def test_typed_collections_are_columns_as_if_recorded_live(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    monkeypatch.setattr(
        _recording.ConversionCache, "__init__", lambda self: setattr(self, "room_bytes", room)
    )
    monkeypatch.setattr(mongodump, "STRETCH_BYTES", 10_000)
    report = imported(write_dump(tmp_path / "dump"), tmp_path / "store")
    imported(write_bag(tmp_path / "same.bag"), tmp_path / "live")
    dumped, live = (amberbox.open(tmp_path / name) for name in ("store", "live"))
    items = {i.name: i for i in live.items() if i.name.startswith("ros_")}
    assert items.keys() == {i.name for i in dumped.items() if i.name.startswith("ros_")}
    assert "ros_marker__points" in items
    for info in dumped.items():
        if info.name in items:
            other = items[info.name]
            assert (info.type, info.topic, info.rows) == (other.type, other.topic, other.rows)
            expected, found = live.query(info.name), dumped.query(info.name)
            skip = {"parent_seq"}
            assert [c for c in comparable(found) if c[0] not in skip] == [
                c for c in comparable(expected) if c[0] not in skip
            ]
    assert report.kinds == {
        collection_of(topic): f"typed ({kind}, built in)" for topic, (kind, _) in KINDS.items()
    }
    assert report.accounts == [
        f"{collection_of(topic)}.bson: {COUNT} documents = {COUNT} messages + 0 refused"
        for topic in sorted(KINDS, key=collection_of)
    ]


def test_own_stamps_and_log_times_are_both_kept(tmp_path: Path) -> None:
    imported(write_dump(tmp_path / "dump"), tmp_path / "store")
    record = amberbox.open(tmp_path / "store")
    table = record.query("ros_ropod_odom", ["timestamp", "received"])
    assert table.values("received") == [log_ns(n) for n in range(COUNT)]
    infos = {info.name: info for info in record.items()}
    assert infos["ros_ropod_odom"].stamp_offset_s == pytest.approx(-84.4, abs=1e-6)


# -- what is not typed


def documents(folder: Path, topic: str) -> list[tuple[int, dict[str, Any]]]:
    with open_recording(folder) as recording:
        place = [t.name for t in recording.topics].index(topic)
        return [
            (m.log_time_ns, msgspec.msgpack.decode(m.data))
            for m in recording.messages()
            if m.topic_index == place
        ]


def test_collections_without_a_type_are_kept_as_they_are(tmp_path: Path) -> None:
    folder = tmp_path / "dump"
    write_metadata(folder, ("zyre_pose", "", ""), ("ros_odd", "/odd", "nobody_msgs/Odd"))
    said = {
        "x": math.nan, "y": math.inf, "big": 2**62, "data": b"\0\1", "no": None,
        "when": datetime.datetime(2018, 12, 10, 12, 0), "id": bson.ObjectId(MADE),
        "list": [1, 2], "deep": {"a": {"b": "text"}},
    }  # fmt: skip
    write_collection(folder, "zyre_pose", [{**said, "timestamp": START_S}] * 3)
    write_collection(folder, "ros_odd", [{"n": n, "timestamp": START_S + n} for n in range(2)])
    write_collection(folder, "event", [{"what": "start", "timestamp": START_S}])
    report = imported(folder, tmp_path / "store")
    assert report.items == {"zyre_pose": 3, "ros_odd": 2, "event": 1}
    assert report.kinds["zyre_pose"] == report.kinds["event"] == "inferred"
    assert "--msg DIR names its definition" in report.kinds["ros_odd"]
    assert "event is not described in black_box_metadata" in report.notes
    table = amberbox.open(tmp_path / "store").query("zyre_pose")
    (row, *_) = table.rows()
    assert math.isnan(row["x"]) and row["y"] == math.inf
    assert (row["big"], row["data"], list(row["list"])) == (2**62, b"\0\1", [1, 2])
    assert (row["deep_a_b"], row["id"]) == ("text", MADE)
    assert row["when"].startswith("2018-12-10T12:00:00")
    assert row["timestamp"] == log_ns(0)


def test_documents_that_do_not_fit_get_a_topic_of_their_own(tmp_path: Path) -> None:
    folder = tmp_path / "dump"
    write_metadata(folder, ("ros_joy", "/joy", "sensor_msgs/Joy"))
    good = [as_document(joy(n)) for n in range(4)]
    misfits = [
        {key: value for key, value in good[0].items() if key != "axes"},
        {**good[0], "surprise": 1},
        {**good[0], "buttons": [1.5]},
        {**good[0], "header": 3},
    ]
    rows = [{**d, "timestamp": START_S + n} for n, d in enumerate([*good, *misfits])]
    write_collection(folder, "ros_joy", rows)
    report = imported(folder, tmp_path / "store")
    assert report.items == {"ros_joy": 4, "ros_joy_unfit": 4}
    assert report.kinds["ros_joy_unfit"] == "inferred (does not fit sensor_msgs/Joy)"
    assert report.notes == [
        "ros_joy: 4 documents do not fit sensor_msgs/Joy (the first: lacks axes)"
    ]
    assert report.accounts == ["ros_joy.bson: 8 documents = 8 messages + 0 refused"]
    table = amberbox.open(tmp_path / "store").query("ros_joy_unfit")
    assert table.values("surprise") == [None, 1, None, None]


def test_a_collection_of_which_nothing_fits_keeps_its_name(tmp_path: Path) -> None:
    folder = tmp_path / "dump"
    write_metadata(folder, ("ros_joy", "/joy", "sensor_msgs/Joy"))
    write_collection(folder, "ros_joy", [{"pressed": True, "timestamp": START_S}])
    assert imported(folder, tmp_path / "store").items == {"ros_joy": 1}


@pytest.mark.parametrize("value", [{"x": 1.0, "y": 2.0, "z": 3.0}, {"x": 1, "y": 2, "z": 3}])
def test_unrolled_variables_are_put_together_again(
    tmp_path: Path, value: Mapping[str, Any]
) -> None:
    folder = tmp_path / "dump"
    write_metadata(folder, ("ros_cmd_vel", "/cmd_vel", "geometry_msgs/Twist"))
    flat = {f"{part}/{k}": v for part in ("linear", "angular") for k, v in value.items()}
    write_collection(folder, "ros_cmd_vel", [{**flat, "timestamp": START_S}])
    write_collection(folder, "ros_pose", [{"pose/position/x": 1.0, "timestamp": START_S}])
    write_collection(folder, "ros_twice", [{"a/b": 1, "a": 2, "timestamp": START_S}])
    report = imported(folder, tmp_path / "store")
    assert report.kinds["ros_cmd_vel"] == "typed (geometry_msgs/Twist, built in)"
    record = amberbox.open(tmp_path / "store")
    assert record.query("ros_cmd_vel").values("angular_z") == [3.0]
    assert record.query("ros_pose").names == ["timestamp", "pose_position_x"]
    assert len(record.query("ros_twice").names) == 3


def test_whole_numbers_and_floats_stand_for_each_other_where_nothing_is_lost(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "dump"
    write_metadata(folder, ("ros_joy", "/joy", "sensor_msgs/Joy"))
    document = {
        "header": {"seq": 3.0, "stamp": 1544445498.5, "frame_id": ""},
        "axes": [1, 2], "buttons": [1.0, 0.0], "timestamp": START_S,
    }  # fmt: skip
    write_collection(folder, "ros_joy", [document])
    assert imported(folder, tmp_path / "store").kinds["ros_joy"].startswith("typed")
    table = amberbox.open(tmp_path / "store").query("ros_joy")
    assert table.values("timestamp") == [1544445498_500000000]
    assert (table.values("buttons"), table.values("header_seq")) == ([[1, 0]], [3])


# -- definitions


WHEEL = "std_msgs/Header header\nInput[] commands # of this package\nint32 count\n"
INPUT = "uint8 NONE=0\nuint8 LINEAR=1\nfloat64 speed\nuint8 kind\n"


@pytest.mark.parametrize(
    ("layout", "header_type"),
    [
        *(("", "std_msgs/Header"), ("own_msgs/msg", "roslib/Header")),
        *(("src/own_msgs/own_msgs/msg", "Header"), ("own_msgs", "std_msgs/Header")),
    ],
)
def test_definitions_come_from_a_folder(tmp_path: Path, layout: str, header_type: str) -> None:
    place = tmp_path / "definitions" / layout
    place.mkdir(parents=True)
    (place / "Wheel.msg").write_text(WHEEL.replace("std_msgs/Header", header_type))
    (place / "Input.msg").write_text(INPUT)
    folder = tmp_path / "dump"
    write_metadata(folder, ("ros_wheel", "/wheel", "own_msgs/Wheel"))
    head = as_document(header(1, START_S))
    commands = [{"speed": 0.5, "kind": 1}, {"speed": -0.5, "kind": 0}]
    document = {"header": head, "commands": commands, "count": 2, "timestamp": START_S}
    write_collection(folder, "ros_wheel", [document])
    report = imported(folder, tmp_path / "store", messages=tmp_path / "definitions")
    assert report.kinds == {"ros_wheel": f"typed (own_msgs/Wheel, from {tmp_path / 'definitions'})"}
    record = amberbox.open(tmp_path / "store")
    child = record.query("ros_wheel__commands", ["speed", "kind"])
    assert (child.values("speed"), child.values("kind")) == ([0.5, -0.5], [1, 0])
    with open_recording(folder, ReadOptions(messages=tmp_path / "definitions")) as recording:
        schema = unroller(recording.topics[0]).schema.children["commands"]
    assert dict(schema.columns[1].labels) == {0: "NONE", 1: "LINEAR"}
    (info,) = (i for i in record.items() if i.name == "ros_wheel__commands")
    assert info.type == "own_msgs/Input"


def test_a_definition_that_lacks_one_leaves_the_collection_inferred(tmp_path: Path) -> None:
    definitions = tmp_path / "definitions"
    definitions.mkdir()
    (definitions / "Wheel.msg").write_text(WHEEL)
    (definitions / "Bad.msg").write_text("this is; no definition\n")
    folder = tmp_path / "dump"
    write_metadata(folder, ("ros_w", "/w", "own_msgs/Wheel"), ("ros_b", "/b", "own_msgs/Bad"))
    for name in ("ros_w", "ros_b"):
        write_collection(folder, name, [{"a": 1, "timestamp": START_S}])
    report = imported(folder, tmp_path / "store", messages=definitions)
    assert report.kinds["ros_w"].startswith("inferred (own_msgs/Wheel is not known")
    assert report.kinds["ros_b"].startswith("inferred (cannot read the definition of own_msgs/Bad")


def test_a_folder_of_definitions_must_hold_some(tmp_path: Path) -> None:
    folder = write_dump(tmp_path / "dump", 1)
    with pytest.raises(UsageError, match="there is no folder"):
        open_recording(folder, ReadOptions(messages=tmp_path / "none"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match=r"holds no \.msg file"):
        open_recording(folder, ReadOptions(messages=tmp_path / "empty"))


# -- damage, and other folders


def test_a_cut_collection_gives_its_whole_documents(tmp_path: Path) -> None:
    folder = write_dump(tmp_path / "dump")
    path = folder / "ros_ropod_odom.bson"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2 + 7])
    report = imported(folder, tmp_path / "store")
    assert report.items["ros_ropod_odom"] == COUNT // 2
    (damage,) = report.damage
    assert damage.startswith("ros_ropod_odom.bson: ") and damage.endswith("the file is cut short")


@pytest.mark.parametrize("junk", [b"\xff" * 40, bytes(40)])
def test_damage_costs_the_documents_it_touches(tmp_path: Path, junk: bytes) -> None:
    folder = tmp_path / "dump"
    rows = [{"n": n, "pad": "x" * 50, "timestamp": START_S + n} for n in range(100)]
    path = write_collection(folder, "zyre_n", rows)
    content = bytearray(path.read_bytes())
    at = len(content) // 2 // 96 * 96
    content[at : at + len(junk)] = junk
    path.write_bytes(content)
    report = imported(folder, tmp_path / "store")
    assert report.damage
    numbers = amberbox.open(tmp_path / "store").query("zyre_n").values("n")
    assert 97 <= len(numbers) < 100 and set(numbers) < set(range(100))
    assert report.accounts[0].startswith("zyre_n.bson: ")
    assert " lost" not in report.accounts[0]


def test_documents_without_a_time_are_counted(tmp_path: Path) -> None:
    folder = tmp_path / "dump"
    made = bson.ObjectId(MADE)
    rows: list[dict[str, Any]] = [
        {"_id": made, "n": 1}, {"_id": 7, "n": 2}, {"n": 3, "timestamp": "2018-12-10T12:00:00Z"},
        {"n": 4, "timestamp": datetime.datetime(2018, 12, 10, 12)}, {"_id": 8, "timestamp": -1.0},
    ]  # fmt: skip
    write_collection(folder, "zyre_n", rows)
    report = imported(folder, tmp_path / "store")
    assert report.accounts == ["zyre_n.bson: 5 documents = 3 messages + 2 refused (2 has no time)"]
    assert any("the second that their id was made" in note for note in report.notes)
    table = amberbox.open(tmp_path / "store").query("zyre_n")
    noon = 1544443200 * 10**9
    assert table.values("timestamp") == [int(made.generation_time.timestamp()) * 10**9, noon, noon]


def test_folders_of_databases_packed_files_and_missing_collections(tmp_path: Path) -> None:
    folder = write_dump(tmp_path / "all" / "logs", 3)
    path = folder / "ros_joy.bson"
    (folder / "ros_joy.bson.gz").write_bytes(gzip.compress(path.read_bytes()))
    path.unlink()
    (folder / "ros_marker.bson").unlink()
    write_collection(folder, "system.indexes", [{"a": 1}])
    report = imported(tmp_path / "all", tmp_path / "store")
    assert report.items["ros_joy"] == 3
    assert report.notes == [
        "ros_marker is described in black_box_metadata, but its file is missing",
        "system.indexes.bson is MongoDB's own and left out",
    ]
    (folder / "README.md").write_text("what lies beside a dump does not make another one")
    assert import_recordings([tmp_path / "all"], tmp_path / "store")[0].known
    assert import_recordings([folder], tmp_path / "store")[0].known
    write_dump(tmp_path / "all" / "other", 1)
    with pytest.raises(AmberboxError, match="a dump of 2 databases"):
        open_recording(tmp_path / "all")


def test_a_packed_collection_that_is_cut_gives_what_it_holds(tmp_path: Path) -> None:
    folder = write_dump(tmp_path / "dump")
    path = folder / "ros_joy.bson"
    packed = gzip.compress(path.read_bytes())
    (folder / "ros_joy.bson.gz").write_bytes(packed[: len(packed) // 2])
    path.unlink()
    report = imported(folder, tmp_path / "store")
    assert 0 < report.items["ros_joy"] < COUNT
    assert any("unpacked in part only" in text for text in report.damage)


def test_without_pymongo_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_dump(tmp_path / "dump", 1)
    mongodump.bson_package.cache_clear()
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "bson", None)
        with pytest.raises(UsageError) as caught:
            open_recording(folder)
        assert "pip install amberbox[formats]" in caught.value.hint
    mongodump.bson_package.cache_clear()


# -- the real ones


def leaves(value: Any, path: str = "") -> dict[str, Any]:
    """Flatten a document's structures; lists and times stay."""
    if not isinstance(value, dict) or value.keys() == {"secs", "nsecs"}:
        return {path: value}
    return {
        name: leaf
        for key, inner in value.items()
        if key not in ("_id", "timestamp")
        for name, leaf in leaves(inner, f"{path}_{key}" if path else key).items()
    }


def real_documents(path: Path) -> list[dict[str, Any]]:
    return sorted(bson.decode_all(path.read_bytes()), key=lambda d: float(d["timestamp"]))


@pytest.mark.needs_data
def test_every_value_of_the_real_dumps_is_there(shared_data: Path, tmp_path: Path) -> None:
    dumps = [shared_data / "ropod" / name for name in ("nominal", "bb_test_data")]
    compared = 0
    for number, dump in enumerate(dumps):
        store = tmp_path / str(number)
        options = {"messages": shared_data / "ropod/message_definitions"}
        report = imported(dump, store, **options)
        assert all(kind.startswith("typed (") for kind in report.kinds.values())
        record = amberbox.open(store)
        for path in sorted(dump.glob("ros_*.bson")):
            found = real_documents(path)
            assert report.items[path.stem] == len(found)
            assert f"{path.name}: {len(found)} documents = {len(found)} messages + 0 refused" in (
                report.accounts
            )
            compared += compare(record.query(path.stem, None), [leaves(d) for d in found])
    assert compared > 40_000


def compare(table: Table, expected: list[dict[str, Any]]) -> int:
    """Compare all columns that are no lists of structures; returns how many values."""
    count = 0
    for name in set(table.names) - {"timestamp"}:
        ours = table.values(name)
        if name not in expected[0]:
            base, _, place = name.rpartition("_")
            theirs = [row[base][int(place)] for row in expected]
        else:
            theirs = [row[name] for row in expected]
        theirs = [t["secs"] * 10**9 + t["nsecs"] if isinstance(t, dict) else t for t in theirs]
        assert str(ours) == str(theirs) or np.array_equal(ours, theirs, equal_nan=True)
        count += len(ours)
    return count


@pytest.mark.needs_data
def test_the_stamps_of_the_nominal_dump_run_84_seconds_ahead(
    shared_data: Path, tmp_path: Path
) -> None:
    report = imported(shared_data / "ropod/nominal", tmp_path / "store")
    assert report.items == {
        "ros_ropod_cmd_vel": 1091, "ros_ropod_laser_scan": 185, "ros_ropod_odom": 838,
    }  # fmt: skip
    (note,) = report.notes
    assert note.startswith("ros_sw_ethercat_parser_data is described")
    infos = {info.name: info for info in amberbox.open(tmp_path / "store").items()}
    for name in ("ros_ropod_laser_scan", "ros_ropod_odom"):
        assert infos[name].stamp_offset_s == pytest.approx(-84.4, abs=0.05)


@pytest.mark.needs_data
def test_the_wheels_are_inferred_without_definitions(shared_data: Path, tmp_path: Path) -> None:
    dump = shared_data / "ropod/bb_test_data"
    report = imported(dump, tmp_path / "store")
    assert report.kinds["ros_sw_ethercat_parser_data"].startswith("inferred")
    imported(dump, tmp_path / "typed", messages=shared_data / "ropod/message_definitions")
    inferred, typed = (
        amberbox.open(tmp_path / name).query("ros_sw_ethercat_parser_data__sensors")
        for name in ("store", "typed")
    )
    assert len(inferred) == len(typed) == 4 * 182
    for name in ("velocity_1", "sensor_ts", "pressure"):
        assert inferred.values(name) == typed.values(name)


def test_topics_can_be_chosen(tmp_path: Path) -> None:
    from amberbox.core.source import TopicOptions

    folder = write_dump(tmp_path / "dump")
    (report,) = import_recordings(
        [folder], tmp_path / "store", topics=[TopicOptions("/joy"), TopicOptions("/typo")]
    )
    assert report.items == {"ros_joy": COUNT}
    assert "there is no topic /typo in it" in report.notes
    others = [text for text in report.accounts if "ros_joy" not in text]
    assert all(f"= 0 messages + {COUNT} of topics left out + 0 refused" in t for t in others)


def test_a_recording_source_replays_a_dump(tmp_path: Path) -> None:
    with open_recording(write_dump(tmp_path / "dump", 2)) as recording:
        assert isinstance(recording, RecordingReader)
        assert {origin.source for origin in recording.origins} == {"ros"}
        assert len(list(recording.messages())) == 2 * len(KINDS)
        assert recording.report.messages == 2 * len(KINDS)
