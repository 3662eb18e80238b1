"""Mirroring to a MongoDB: round trips, outages, kills, refusals, deletion, the supervisor."""

from __future__ import annotations

import random
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import bson
import msgspec
import pytest

import amberbox
from amberbox.agent import mirror as mirror_module
from amberbox.agent.doctor.processes import mirror as check_mirror
from amberbox.agent.doctor.subject import DoctorFinding, HostSystem, subject
from amberbox.agent.mirror import CURSOR_FILE, MirrorProcess
from amberbox.blackbox.columns.frame_layout import FrameField, FrameLayout
from amberbox.blackbox.mirror import mongodb
from amberbox.blackbox.query.importing import import_recordings
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention.maintenance import RetentionService, wait_for_lock
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.robot_folder.robot_yaml import Lifetime, RetentionOptions, RobotConfig
from amberbox.blackbox.store.store import EVENT_REQUEST, create_store, open_store, pending
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.redaction import redact, secrets
from amberbox.core.types import Topic
from amberbox.core.yaml_nodes import load_yaml
from amberbox.sim.robot import Robot
from amberbox.sim.topics import TOPIC_BY_NAME
from amberbox.testing.clock import PATIENCE_S, ManualClock, wait_until
from tests.blackbox.formats.test_mongodump import KINDS, TYPES, comparable
from tests.blackbox.mirror.test_documents import ros
from tests.support.manual_recorder import COUNT, TEXT, ManualBox, number
from tests.support.mongo_server import MongoServer


@pytest.fixture
def server() -> Iterator[MongoServer]:
    server = MongoServer()
    yield server
    server.thaw()
    server.stop()


def robot(path: Path, server: MongoServer, more: str = "") -> Path:
    """Write a robot folder that mirrors to a server."""
    path.mkdir(exist_ok=True)
    (path / "robot.yaml").write_text(f"id: rob\nmongodb:\n  url: {server.url}\n{more}")
    (path / "black_box.yaml").write_text("- sim:\n    robot: rob\n")
    return path


def mirror_once(folder: Path) -> MirrorProcess:
    """Mirror what is recorded, in this thread."""
    process = MirrorProcess(load_folder(folder), create_store(folder / "store"), poll_s=0.01)
    stop = threading.Event()
    stop.set()
    process.run(stop)
    return process


def counts(server: MongoServer) -> list[int]:
    return sorted(document["data"] for document in server.documents("ros_count"))


def events(store: Path, kind: str) -> list[str]:
    asked = [one.values for one in pending(open_store(store)) if one.kind == EVENT_REQUEST]
    return [values["text"] for values in asked if values["kind"] == kind]


# -- what is mirrored


@pytest.mark.parametrize("layout", ["nested", "flat"])
def test_an_import_of_the_mirrored_collections_gives_the_same_rows(
    tmp_path: Path, server: MongoServer, layout: str
) -> None:
    folder = robot(tmp_path / "rob", server, f"  layout: {layout}\n")
    box = ManualBox(folder / "store")
    for n in range(60):
        for name, (kind, make) in KINDS.items():
            box.hear(ros(name, kind), bytes(TYPES.serialize_ros1(make(n), make(n).__msgtype__)))
        box.write()
    box.close()
    mirror_once(folder)
    import_recordings([server.dump(tmp_path / "dump")], tmp_path / "again")
    mirrored, original = amberbox.open(tmp_path / "again"), amberbox.open(folder / "store")
    items = {i.name: i for i in original.items() if i.name.startswith("ros_")}
    assert items.keys() == {i.name for i in mirrored.items() if i.name.startswith("ros_")}
    assert "ros_marker__points" in items
    for info in mirrored.items():
        if info.name in items:
            other = items[info.name]
            assert (info.type, info.topic, info.rows) == (other.type, other.topic, other.rows)
            found, expected = mirrored.query(info.name), original.query(info.name)
            keys = {"parent_seq", "timestamp"} if "__" in info.name else {"parent_seq"}
            assert [c for c in comparable(found) if c[0] not in keys] == [
                c for c in comparable(expected) if c[0] not in keys
            ]
    received = [r.query("ros_joy", ["received"]).values("received") for r in (mirrored, original)]
    # nanoseconds: a float of seconds has steps of 240 ns
    assert max(abs(a - b) for a, b in zip(*received, strict=True)) < 500
    assert {*server.indexes, "black_box_metadata"} == server.collections.keys()


def test_messages_of_other_sources_come_back(tmp_path: Path, server: MongoServer) -> None:
    """JSON with lists and structures, and raw frames: by their names and values, without a type."""
    folder = robot(tmp_path / "rob", server)
    layout = FrameLayout((FrameField("speed", 0, 16, "int", scale=0.5), FrameField("on", 16, 1)), 3)
    frame = Topic("DRIVE", "frame", layout.to_schema("can/DRIVE"))
    box = ManualBox(folder / "store", source="base")
    for topic, _, message in Robot(5).step_until(3.0):
        box.hear(TOPIC_BY_NAME[topic].topic(), msgspec.json.encode(message))
    box.hear(frame, b"\x10\0\1", b"\xf0\xff\0")
    box.write()
    box.close()
    mirror_once(folder)
    import_recordings([server.dump(tmp_path / "dump")], tmp_path / "again")
    mirrored, original = amberbox.open(tmp_path / "again"), amberbox.open(folder / "store")
    items = [info.name for info in original.items() if info.name.startswith("base_")]
    assert {"base_wheels", "base_battery", "base_DRIVE"} <= set(items)
    for item in items:
        found, expected = mirrored.query(item), original.query(item)
        for name in expected.names[1:]:
            assert str(found.values(name)) == str(expected.values(name)), (item, name)


def test_numbers_of_64_bits_come_back(tmp_path: Path, server: MongoServer) -> None:
    folder = robot(tmp_path / "rob", server)
    box = ManualBox(folder / "store")
    box.hear(ros("/big", "std_msgs/UInt64"), *(n.to_bytes(8, "little") for n in (2**64 - 1, 3)))
    box.write()
    box.close()
    mirror_once(folder)
    import_recordings([server.dump(tmp_path / "dump")], tmp_path / "again")
    assert amberbox.open(tmp_path / "again").query("ros_big").values("data") == [2**64 - 1, 3]


def record_both(folder: Path) -> None:
    """Record a row of a number and one of a text."""
    box = ManualBox(folder / "store")
    box.hear(COUNT, number(1))
    box.hear(TEXT, b"\3\0\0\0abc")
    box.write()
    box.close()


def test_only_chosen_items_are_mirrored(tmp_path: Path, server: MongoServer) -> None:
    folder = robot(tmp_path / "rob", server, "  items: [ros_te*]\n")
    record_both(folder)
    mirror_once(folder)
    assert server.collections.keys() == {"ros_text", "black_box_metadata"}
    (document,) = server.documents("ros_text")
    assert document["data"] == "abc"


def test_new_items_begin_anew_without_doubles(tmp_path: Path, server: MongoServer) -> None:
    folder = robot(tmp_path / "rob", server, "  items: [ros_text]\n")
    record_both(folder)
    mirror_once(folder)
    robot(folder, server)
    mirror_once(folder)
    assert counts(server) == [1] and server.count("ros_text") == 1
    assert len(events(folder / "store", "mirror_anew")) == 1


# -- outages and kills


def test_a_batch_that_was_taken_but_not_acknowledged_gives_no_doubles(
    tmp_path: Path, server: MongoServer
) -> None:
    folder = robot(tmp_path / "rob", server)
    box = ManualBox(folder / "store")
    box.hear(COUNT, *map(number, range(1200)))
    box.write()
    box.close()
    server.die_after = 1
    process = MirrorProcess(load_folder(folder), open_store(folder / "store"), poll_s=0.01)
    stop = threading.Event()
    thread = threading.Thread(target=process.run, args=(stop,))
    thread.start()
    wait_until(lambda: server.count("ros_count") == 1200)
    wait_until(lambda: events(folder / "store", "mirror_up"))
    stop.set()
    thread.join(PATIENCE_S)
    assert counts(server) == list(range(1200))
    assert len(events(folder / "store", "mirror_down")) == 1


def test_a_server_that_is_away_or_hangs_loses_nothing(
    tmp_path: Path, server: MongoServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mongodb, "_ANSWER_MS", 200)
    monkeypatch.setattr(mongodb, "_CONNECT_MS", 200)
    monkeypatch.setattr(mirror_module, "_STATE_S", 0.05)
    folder = robot(tmp_path / "rob", server)
    box = ManualBox(folder / "store")
    box.hear(COUNT, number(0))
    box.write()
    server.stop()
    process = MirrorProcess(load_folder(folder), open_store(folder / "store"), poll_s=0.01)
    stop = threading.Event()
    thread = threading.Thread(target=process.run, args=(stop,))
    thread.start()
    wait_until(lambda: events(folder / "store", "mirror_down"))
    wait_until(lambda: "no connection to 127.0.0.1" in _finding(folder).found)
    assert _finding(folder).level == "warn"
    box.hear(COUNT, number(1))
    box.write()
    server.start()
    wait_until(lambda: counts(server) == [0, 1])
    wait_until(lambda: _finding(folder).level == "ok")
    before = len(events(folder / "store", "mirror_down"))
    server.freeze()
    box.hear(COUNT, number(2))
    box.write()
    wait_until(lambda: len(events(folder / "store", "mirror_down")) > before)
    server.thaw()
    wait_until(lambda: counts(server) == [0, 1, 2])
    box.close()
    wait_until(lambda: _finding(folder).level == "ok")
    stop.set()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert "nothing copies to" in _finding(folder).found


@pytest.mark.parametrize(
    "garbage",
    [
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        b"\xff\xff\xff\x7f" + bytes(60),
        struct.pack("<iiiiIB", 26, 0, 0, 2013, 0, 0) + bson.encode({}),
    ],
)
def test_answers_that_make_no_sense_are_an_outage(
    tmp_path: Path, server: MongoServer, monkeypatch: pytest.MonkeyPatch, garbage: bytes
) -> None:
    folder = robot(tmp_path / "rob", server)
    box = ManualBox(folder / "store")
    box.hear(COUNT, number(1))
    box.write()
    box.close()
    server.garbage = garbage
    with monkeypatch.context() as short:
        short.setattr(mongodb, "_CONNECT_MS", 200)
        short.setattr(mongodb, "_ANSWER_MS", 200)
        mirror_once(folder)
    assert len(events(folder / "store", "mirror_down")) == 1
    server.garbage = b""
    mirror_once(folder)
    assert counts(server) == [1]


def _finding(folder: Path) -> DoctorFinding:
    (finding,) = check_mirror(subject(folder), HostSystem())
    return finding


def _has(server: MongoServer, count: int) -> bool:
    return server.count("ros_count") >= count


def test_kills_at_random_moments_lose_and_repeat_nothing(
    tmp_path: Path, server: MongoServer
) -> None:
    folder = robot(tmp_path / "rob", server)
    box = ManualBox(folder / "store")
    moments = random.Random(4)
    sent = 0

    def record() -> None:
        nonlocal sent
        for _ in range(40):
            box.hear(COUNT, *map(number, range(sent, sent + 25)))
            sent += 25
            box.write()

    for kill in range(4):
        record()
        if kill == 2:
            server.die_after = 1
        wanted = server.count("ros_count") + moments.randrange(1, 900)
        process = subprocess.Popen(
            [sys.executable, "-m", "amberbox", "mirror", "--quiet", str(folder)]
        )
        wait_until(partial(_has, server, wanted))
        process.kill()
        process.wait(PATIENCE_S)
    record()
    box.close()
    mirror_once(folder)
    assert counts(server) == list(range(sent))


# -- what cannot be mirrored


def test_refused_documents_are_counted_and_the_rest_goes_on(
    tmp_path: Path, server: MongoServer
) -> None:
    folder = robot(tmp_path / "rob", server)
    store = folder / "store"
    box = ManualBox(store)
    box.hear(COUNT, *map(number, range(10)))
    box.hear(TEXT, (17 << 20).to_bytes(4, "little") + b"x" * (17 << 20), b"\3\0\0\0abc")
    box.write()
    box.close()
    server.refuse = lambda document: (121, "invalid") if document.get("data") == 4 else None
    process = mirror_once(folder)
    assert counts(server) == [n for n in range(10) if n != 4]
    assert [document["data"] for document in server.documents("ros_text")] == ["abc"]
    assert process._state.refused == 2
    told = events(store, "mirror_refused")
    assert "has refused" in told[0] and len(told) <= 2
    assert server.largest_insert <= mongodb.BATCH_BYTES
    assert mirror_once(folder)._state.refused == 2


def test_a_server_without_room_is_asked_again(tmp_path: Path, server: MongoServer) -> None:
    folder = robot(tmp_path / "rob", server)
    box = ManualBox(folder / "store")
    box.hear(COUNT, number(1))
    box.write()
    box.close()
    full = [True]
    server.refuse = lambda document: (14031, "out of disk space") if full[0] else None
    mirror_once(folder)
    assert counts(server) == []
    assert "out of disk space" in events(folder / "store", "mirror_down")[0]
    full[0] = False
    mirror_once(folder)
    assert counts(server) == [1]


def test_a_login_that_is_refused_is_shown(tmp_path: Path, server: MongoServer) -> None:
    folder = robot(tmp_path / "rob", server)
    box = ManualBox(folder / "store")
    box.hear(COUNT, number(1))
    box.write()
    box.close()
    server.fail = (13, "not authorized on logs to execute command")
    mirror_once(folder)
    assert "not authorized on logs" in events(folder / "store", "mirror_down")[0]


def recorded_and_deleted(store: Path, lifetime: Lifetime) -> None:
    """Record 10 s in several files, and let the keeper delete what is too old."""
    clock = ManualClock()
    box = ManualBox(store, clock=clock, options=PipelineOptions(rotate_ns=NS))
    for n in range(10):
        box.hear(COUNT, number(n))
        box.write(1.0)
    box.close()
    opened, stop = open_store(store), threading.Event()
    lock = wait_for_lock(opened, 0.0, stop)
    keeper = RetentionService(
        opened, RetentionOptions(min_free=0, keep_min_s=0.0, lifetime=lifetime), clock
    )
    for _ in range(20):
        clock.advance(1.0)
        keeper.step(stop)
    keeper.close()
    lock.release()
    assert len(opened.journal_files("main")) < 5


def test_rows_of_deleted_journals_are_mirrored_from_their_columns(
    tmp_path: Path, server: MongoServer
) -> None:
    folder = robot(tmp_path / "rob", server)
    recorded_and_deleted(folder / "store", Lifetime(raw_s=2.0))
    process = mirror_once(folder)
    assert counts(server) == list(range(10))
    assert process._state.missed == 0


def test_rows_that_were_deleted_before_are_counted(tmp_path: Path, server: MongoServer) -> None:
    folder = robot(tmp_path / "rob", server)
    recorded_and_deleted(folder / "store", Lifetime(raw_s=2.0, columns_s=3.0))
    process = mirror_once(folder)
    assert len(counts(server)) < 10
    assert process._state.missed >= 10 - len(counts(server))
    assert "records were not copied: deleted" in events(folder / "store", "mirror_missed")[0]


# -- as a process of the box


def test_the_supervisor_runs_it_and_it_ends_with_everything(
    tmp_path: Path, server: MongoServer, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = robot(tmp_path / "rob", server)
    with (tmp_path / "out").open("w") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "amberbox", "run", "--quiet", str(folder)], stdout=out
        )
    try:
        wait_until(lambda: server.count("sim_odom") > 20, "documents of the robot")
        wait_until(lambda: (folder / "store" / CURSOR_FILE).exists())
        main(["status", str(folder)])
        assert f"copies to 127.0.0.1:{server.port}/logs: " in capsys.readouterr().out
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(PATIENCE_S)
    assert process.returncode == 0
    record = amberbox.open(folder / "store")
    assert server.count("sim_odom") == {i.name: i.rows for i in record.items()}["sim_odom"]


@pytest.mark.parametrize(
    ("lines", "problem"),
    [
        ("url: localhost", "must be mongodb://HOST:27017"),
        ("url: 'mongodb://me:pass@host'", "must not hold a login"),
        ("{url: 'mongodb://h', database: 'a.b'}", "'a.b' is no name"),
        ("{url: 'mongodb://h', items: ['/odom']}", "'/odom' is no item"),
        ("{url: 'mongodb://h', password: x}", "is needed with a password"),
        ("{url: 'mongodb://h', item: [x]}", "did you mean"),
    ],
)
def test_wrong_options(tmp_path: Path, lines: str, problem: str) -> None:
    (tmp_path / "robot.yaml").write_text(f"mongodb:\n  {lines}\n")
    (tmp_path / "black_box.yaml").write_text("- sim:\n    robot: rob\n")
    with pytest.raises(UsageError, match=problem):
        load_folder(tmp_path)


def test_unencrypted_copies_to_another_computer_are_noted(tmp_path: Path) -> None:
    (tmp_path / "black_box.yaml").write_text("- sim:\n    robot: rob\n")
    notes = {}
    for url in ("mongodb://127.0.0.1:1", "mongodb://far:1", "mongodb://far:1/?tls=true"):
        (tmp_path / "robot.yaml").write_text(f"mongodb: {{url: '{url}'}}\n")
        notes[url] = [n.what for n in load_folder(tmp_path).notes if n.where == "mongodb.url"]
    assert [len(found) for found in notes.values()] == [0, 1, 0]


def test_the_password_is_masked_in_copies_of_the_folder(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text("mongodb: {url: 'mongodb://h', user: me, password: s3cret}\n")
    node = load_yaml(path, [])
    assert node is not None
    assert "s3cret" not in redact(path.read_text(), secrets(RobotConfig, node))


def test_a_second_mirror_is_refused(tmp_path: Path, server: MongoServer) -> None:
    folder = robot(tmp_path / "rob", server)
    store = create_store(folder / "store")
    first = MirrorProcess(load_folder(folder), store)
    with pytest.raises(AmberboxError, match="is being written by process"):
        MirrorProcess(load_folder(folder), store)
    del first
