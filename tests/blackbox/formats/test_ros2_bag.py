"""ROS 2 bags: both storages, compressions, split, torn, without metadata, without definitions."""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from amberbox.blackbox.formats._open import open_recording
from amberbox.blackbox.formats._ros2_types import is_latched
from amberbox.core.errors import AmberboxError
from tests.blackbox.formats.conftest import read_all

Messages = list[tuple[str, int, bytes]]
WriteBag = Callable[..., None]
KINDS = [
    ("sqlite3", ""),
    ("sqlite3", "file"),
    ("sqlite3", "message"),
    ("mcap", ""),
    ("mcap", "file"),
    ("mcap", "message"),
    ("mcap", "storage"),
]


@pytest.mark.parametrize(("storage", "compression"), KINDS)
@pytest.mark.parametrize("has_metadata", [True, False])
def test_generated_bag_gives_every_message(
    tmp_path: Path,
    messages: Messages,
    ros2_bag: WriteBag,
    storage: str,
    compression: str,
    has_metadata: bool,
) -> None:
    ros2_bag(tmp_path / "a", messages, storage, compression)
    if not has_metadata:
        (tmp_path / "a" / "metadata.yaml").unlink()
    found, recording = read_all(tmp_path / "a")
    assert found == messages
    assert recording.report.damage == []
    assert any("no metadata.yaml" in note for note in recording.report.notes) != has_metadata
    odom = next(t for t in recording.topics if t.name == "/odom")
    assert odom.message_encoding == "cdr"
    assert odom.schema is not None
    assert (odom.schema.name, odom.schema.encoding) == ("geometry_msgs/msg/Pose", "ros2msg")
    assert b"MSG: geometry_msgs/Quaternion" in odom.schema.data


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_one_file_of_a_bag_reads_alone(
    tmp_path: Path, messages: Messages, ros2_bag: WriteBag, storage: str
) -> None:
    ros2_bag(tmp_path / "a", messages, storage)
    file = next(p for p in (tmp_path / "a").iterdir() if p.suffix != ".yaml")
    assert read_all(file)[0] == messages


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_split_bag_reads_as_one(
    tmp_path: Path, messages: Messages, ros2_bag: WriteBag, storage: str
) -> None:
    suffix = {"sqlite3": ".db3", "mcap": ".mcap"}[storage]
    folder = split_bag(tmp_path, messages, ros2_bag, storage, suffix)
    found, recording = read_all(folder)
    assert found == messages
    assert len(recording.topics) == 2
    assert recording.report.damage == []


def split_bag(
    tmp_path: Path, messages: Messages, ros2_bag: WriteBag, storage: str, suffix: str
) -> Path:
    """Make a bag of 11 files with metadata that names them under a folder of long ago."""
    folder = tmp_path / "split"
    folder.mkdir()
    names = []
    for number in range(11):
        part = tmp_path / f"part{number}"
        ros2_bag(part, messages[number * 200 : number * 200 + 200], storage)
        names.append(f"split_{number}{suffix}")
        shutil.copy(part / f"part{number}{suffix}", folder / names[-1])
    listed = "".join(f"    - recorded_once/{name}\n" for name in names)
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 4\n  storage_identifier: " + storage + "\n"
        "  relative_file_paths:\n" + listed
    )
    return folder


def test_files_that_metadata_names_but_are_missing_are_reported(
    tmp_path: Path, messages: Messages, ros2_bag: WriteBag
) -> None:
    folder = split_bag(tmp_path, messages, ros2_bag, "sqlite3", ".db3")
    (folder / "split_3.db3").unlink()
    found, recording = read_all(folder)
    assert found == messages[:600] + messages[800:]
    assert [(d.file, d.reason) for d in recording.report.damage] == [
        ("split_3.db3", "named in metadata.yaml but missing")
    ]


def test_files_that_metadata_does_not_name_are_read(
    tmp_path: Path, messages: Messages, ros2_bag: WriteBag
) -> None:
    folder = split_bag(tmp_path, messages, ros2_bag, "mcap", ".mcap")
    text = (folder / "metadata.yaml").read_text()
    text = text.replace("    - recorded_once/split_10.mcap\n", "")
    (folder / "metadata.yaml").write_text(text)
    found, recording = read_all(folder)
    assert found == messages
    assert recording.report.notes == ["not named in metadata.yaml but read: split_10.mcap"]


def test_broken_metadata_is_noted(tmp_path: Path, messages: Messages, ros2_bag: WriteBag) -> None:
    ros2_bag(tmp_path / "a", messages, "sqlite3")
    (tmp_path / "a" / "metadata.yaml").write_text("rosbag2_bagfile_information: [}")
    found, recording = read_all(tmp_path / "a")
    assert found == messages
    assert "metadata.yaml cannot be read" in recording.report.notes[0]


@pytest.mark.parametrize("compression", ["", "message"])
def test_missing_definitions_come_from_a_distribution(
    tmp_path: Path, messages: Messages, ros2_bag: WriteBag, compression: str
) -> None:
    ros2_bag(tmp_path / "a", messages, "sqlite3", compression)
    with sqlite3.connect(tmp_path / "a" / "a.db3") as database:
        database.execute("DELETE FROM message_definitions")
        database.execute("UPDATE topics SET type = 'my_robot/msg/Wheel' WHERE name = '/text'")
        database.execute("UPDATE schema SET ros_distro = 'humble'")
    found, recording = read_all(tmp_path / "a")
    assert found == messages
    schemas = {t.name: t.schema for t in recording.topics}
    odom, text = schemas["/odom"], schemas["/text"]
    assert odom is not None
    assert text is not None
    assert b"geometry_msgs/Point" in odom.data
    assert (text.name, text.encoding, text.data) == ("my_robot/msg/Wheel", "", b"")
    assert sorted(recording.report.notes) == [
        "definitions not in the recording are those of ROS 2 humble",
        "my_robot/msg/Wheel: no definition in the recording and none known; bytes are kept",
    ]


def test_definition_must_read_the_message(
    tmp_path: Path, messages: Messages, ros2_bag: WriteBag
) -> None:
    """Range got a variance in Jazzy: an older bag must not get the new definition."""
    store = get_typestore(Stores.ROS2_DASHING)
    ros2_bag(tmp_path / "a", messages[:20], "sqlite3")
    range_type = "sensor_msgs/msg/Range"
    header = store.types["std_msgs/msg/Header"](
        stamp=store.types["builtin_interfaces/msg/Time"](sec=1, nanosec=2), frame_id="base"
    )
    message = store.types[range_type](
        header=header,
        radiation_type=0,
        field_of_view=0.1,
        min_range=0.2,
        max_range=3.0,
        range=1.0,
    )
    data = bytes(store.serialize_cdr(message, range_type))
    with sqlite3.connect(tmp_path / "a" / "a.db3") as database:
        database.execute("DELETE FROM message_definitions")
        database.execute("UPDATE schema SET ros_distro = 'rosbags'")
        database.execute("UPDATE topics SET type = ? WHERE name = '/odom'", (range_type,))
        database.execute(
            "UPDATE messages SET data = ? WHERE topic_id = "
            "(SELECT id FROM topics WHERE name = '/odom')",
            (data,),
        )
    _, recording = read_all(tmp_path / "a")
    schema = next(t.schema for t in recording.topics if t.name == "/odom")
    assert schema is not None
    assert b"variance" not in schema.data.split(b"=====")[0]


@pytest.mark.parametrize("compression", ["", "message"])
def test_truncated_sqlite_gives_a_prefix(
    tmp_path: Path, messages: Messages, ros2_bag: WriteBag, compression: str
) -> None:
    ros2_bag(tmp_path / "a", messages, "sqlite3", compression)
    content = (tmp_path / "a" / "a.db3").read_bytes()
    torn = tmp_path / "torn.db3"
    counts = []
    for share in range(30, 100, 7):
        torn.write_bytes(content[: len(content) * share // 100])
        found, recording = read_all(torn)
        assert found == messages[: len(found)]
        assert recording.report.damage[0].reason == "the file is cut short"
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[0] > 0.1 * len(messages)
    assert counts[-1] > 0.8 * len(messages)


def test_damaged_sqlite_loses_only_what_is_touched(
    tmp_path: Path, messages: Messages, ros2_bag: WriteBag
) -> None:
    ros2_bag(tmp_path / "a", messages, "sqlite3")
    content = (tmp_path / "a" / "a.db3").read_bytes()
    rng = random.Random(7)  # a repeatable sequence, no secret
    for _ in range(40):
        page = rng.randrange(20, len(content) // 4096)
        broken = bytearray(content)
        broken[page * 4096 : (page + 1) * 4096] = bytes(4096)
        (tmp_path / "b.db3").write_bytes(broken)
        found, recording = read_all(tmp_path / "b.db3")
        assert set(found) <= set(messages)
        assert len(found) >= len(messages) - 4096 // 30
        assert len(found) == len(messages) or recording.report.damage


def test_long_messages_survive_on_overflow_pages(tmp_path: Path, ros2_bag: WriteBag) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    string = store.types["std_msgs/msg/String"]
    rng = random.Random(5)  # a repeatable sequence, no secret
    long = [
        ("/text", 1000 + n, bytes(store.serialize_cdr(string("ab" * size), "std_msgs/msg/String")))
        for n, size in enumerate(rng.randrange(0, 30_000) for _ in range(100))
    ]
    ros2_bag(tmp_path / "a", long, "sqlite3")
    content = (tmp_path / "a" / "a.db3").read_bytes()
    (tmp_path / "b.db3").write_bytes(content[: len(content) * 9 // 10])
    found, _ = read_all(tmp_path / "b.db3")
    assert len(found) > 70
    assert found == long[: len(found)]


def test_rows_in_a_write_ahead_log_are_read_and_the_original_stays(
    tmp_path: Path, messages: Messages, ros2_bag: WriteBag
) -> None:
    ros2_bag(tmp_path / "a", messages[:-1], "sqlite3")
    path = tmp_path / "a" / "a.db3"
    database = sqlite3.connect(path)
    database.execute("PRAGMA journal_mode = WAL")
    topic, time_ns, data = messages[-1]
    database.execute(
        "INSERT INTO messages (topic_id, timestamp, data) "
        "SELECT id, ?, ? FROM topics WHERE name = ?",
        (time_ns, data, topic),
    )
    database.commit()
    killed = tmp_path / "killed"
    shutil.copytree(tmp_path / "a", killed)
    database.close()
    before = (killed / "a.db3").read_bytes()
    found, recording = read_all(killed)
    assert found == messages
    assert (killed / "a.db3").read_bytes() == before
    assert recording.report.notes == ["a.db3: a journal of SQLite was replayed in a copy"]


@pytest.mark.parametrize(
    ("profiles", "latched"),
    [
        ("- history: 1\n  durability: 1\n", True),
        ("- history: 1\n  durability: 2\n", False),
        ([{"durability": "transient_local"}], True),
        ([{"durability": "volatile"}], False),
        ("", False),
        ("[}", False),
        (None, False),
    ],
)
def test_transient_local_is_latched(profiles: object, latched: bool) -> None:
    assert is_latched(profiles) is latched


def test_what_is_no_recording_is_refused_with_a_hint(tmp_path: Path) -> None:
    (tmp_path / "empty.bag").touch()
    (tmp_path / "text.bag").write_text("hello")
    (tmp_path / "old.bag").write_text("#ROSBAG V1.2\n")
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:")
    (tmp_path / "folder").mkdir()
    (tmp_path / "bags").mkdir()
    (tmp_path / "bags" / "one.bag").touch()
    (tmp_path / "other.db3").write_bytes(b"SQLite format 3\0")
    for name, words in {
        "empty.bag": "is empty",
        "text.bag": "not a recording",
        "old.bag": "rosbag fix",
        "metadata.yaml": "did you mean the folder",
        "folder": "holds no recording",
        "bags": "one.bag",
        "other.db3": "topics cannot be read",
        "missing.bag": "does not exist",
    }.items():
        with pytest.raises(AmberboxError) as caught:
            open_recording(tmp_path / name)
        assert words in str(caught.value)
        assert caught.value.hint


@pytest.mark.needs_data
@pytest.mark.parametrize("name", [".", "rosbag2_test_0.db3"])
def test_real_bag_equals_rosbags(shared_data: Path, name: str) -> None:
    folder = shared_data / "recordings" / "plotjuggler_rosbag2_test"
    with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_DASHING)) as reader:
        expected = [(c.topic, t, bytes(data)) for c, t, data in reader.messages()]
    found, recording = read_all(folder / name)
    assert found == expected
    assert len(found) == 4695
    assert recording.report.damage == []
    assert all(t.schema is not None and t.schema.data for t in recording.topics)
    assert len(recording.report.notes) == 1
    assert "definitions not in the recording" in recording.report.notes[0]
