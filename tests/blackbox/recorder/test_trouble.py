"""Trouble while recording: each kind is a clear error or an event, and nothing else suffers."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import amberbox
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.recorder.recorder import Recorder
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.tail import follow
from amberbox.cli.main import main
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Gap, Schema, Topic
from amberbox.testing.clock import wait_until
from tests.support.manual_recorder import (
    COUNT,
    ManualBox,
    events,
    number,
    own_records,
    raw_messages,
    recording,
)
from tests.support.processes import free_port
from tests.support.ros_network import RosMaster, RosPublisher, RosTopic

INT, FLOAT = (
    Topic("/value", "ros1", Schema("test/Value", "ros1msg", definition))
    for definition in (b"int64 data\nint64 old\n", b"float64 data\nint64 new\n")
)
JSON = Topic("/json", "json")


def robot(folder: Path, blocks: str, robot_yaml: str = "id: r\n") -> Path:
    folder.mkdir()
    (folder / "robot.yaml").write_text(robot_yaml)
    (folder / "black_box.yaml").write_text(blocks)
    return folder


def ros_block(uri: str, *topics: str) -> str:
    listed = ", ".join(f"{{topic: {{name: {topic}}}}}" for topic in topics)
    return (
        f"- ros:\n    ros_master_uri: {uri}\n    advertise: 127.0.0.1\n    poll_s: 0.1\n"
        f"    topics: [{listed}]\n"
    )


def test_wrong_yaml_is_named_by_file_and_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = robot(tmp_path / "robot", "- ros:\n    topics:\n      - topic: {nam: /odom}\n")
    assert main(["record", str(folder)]) == 2
    printed = capsys.readouterr().err
    assert f"{folder / 'black_box.yaml'}:3:" in printed
    assert "did you mean 'name'" in printed
    assert not (folder / "store").exists()


@pytest.mark.parametrize("path", ["/dev/null/store", "robot.yaml"])
def test_a_store_that_cannot_be_written_is_an_error_with_a_hint(
    tmp_path: Path, path: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = robot(tmp_path / "robot", ros_block("http://127.0.0.1:1", "/odom"),
                   f"id: r\nstore: {{path: {path}}}\n")  # fmt: skip
    assert main(["record", str(folder)]) == 1
    printed = capsys.readouterr().err
    assert "cannot write to the store" in printed
    assert "hint: choose a folder that can be written in robot.yaml store.path" in printed


def test_two_recorders_on_one_store(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = robot(tmp_path / "robot", ros_block("http://127.0.0.1:1", "/odom"))
    with recording(folder):
        assert main(["record", str(folder)]) == 2
    assert f"is being written by process {os.getpid()} (main)" in capsys.readouterr().err
    with recording(folder) as again:
        assert again.pipeline.run == 2


def test_a_folder_without_sources_is_no_recorder(tmp_path: Path) -> None:
    folder = robot(tmp_path / "robot", "- default_parameters: {max_frequency: 5}\n")
    with pytest.raises(UsageError, match="names no source"):
        Recorder(load_folder(folder))


def test_a_topic_nobody_publishes_is_a_gap(tmp_path: Path) -> None:
    master = RosMaster()
    publisher = RosPublisher("/robot", {"/chat": RosTopic()}, master)
    with recording(robot(tmp_path / "robot", ros_block(master.uri, "/chat", "/nothing"))) as box:
        publisher.wait_for_subscribers("/chat")
        publisher.publish("/chat", b"\x02\0\0\0hi")
        wait_until(lambda: box.pipeline.items["ros_chat"].counters.received == 1, "a message")
    publisher.kill()
    master.stop()
    record = amberbox.open(tmp_path / "robot")
    (gap,) = record.gaps("ros_nothing")
    started, stopped = (_time(record, kind) for kind in ("started", "stopped"))
    assert gap.reason == "publisher not connected yet"
    assert abs(gap.from_ns - started) < 2e8
    assert abs(gap.to_ns - stopped) < 2e8
    assert record.query("ros_chat").values("data") == ["hi"]


def _time(record: Record, kind: str) -> int:
    table = record.events()
    return next(int(row["timestamp"]) for row in table.rows() if row["kind"] == kind)


def test_a_master_that_comes_late_is_waited_for(tmp_path: Path) -> None:
    port = free_port()
    folder = robot(tmp_path / "robot", ros_block(f"http://127.0.0.1:{port}", "/chat"))
    with recording(folder) as box:
        wait_until(lambda: events(folder / "store", "ros_master_unreachable"), "an event")
        master = RosMaster(port)
        publisher = RosPublisher("/robot", {"/chat": RosTopic()}, master)
        publisher.wait_for_subscribers("/chat")
        publisher.publish("/chat", b"\x02\0\0\0hi")
        wait_until(lambda: box.pipeline.items["ros_chat"].counters.received == 1, "a message")
    publisher.kill()
    master.stop()
    (event,) = events(folder / "store", "ros_master_unreachable")
    assert str(port) in event["text"]
    assert amberbox.open(folder).query("ros_chat").values("data") == ["hi"]


def test_a_source_that_fails_is_told_and_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from amberbox.blackbox.sources.ros import Source

    runs = []

    def fail(self: Source, sink: object, stop: threading.Event) -> None:
        runs.append(time.monotonic())
        if len(runs) == 1:
            raise OSError("no such device")
        stop.wait()

    monkeypatch.setattr(Source, "run", fail)
    folder = robot(tmp_path / "robot", ros_block("http://127.0.0.1:1", "/odom"))
    with recording(folder):
        wait_until(lambda: len(runs) == 2, "a second run")
    (event,) = events(folder / "store", "source_failed")
    assert "ros failed and starts again in 1 s: no such device" in event["text"]


def test_a_type_that_changes_keeps_both_halves(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store")
    box.hear(INT, number(1) + number(2))
    box.write()
    box.hear(FLOAT, np.float64(2.5).tobytes() + number(3))
    box.hear(INT, number(4) + number(5))
    box.write()
    box.close()
    (event,) = events(box.store, "type_changed")
    assert event["details"] == {
        "item": "ros_value", "before": "test/Value", "after": "test/Value",
    }  # fmt: skip
    table = amberbox.open(box.store).query("ros_value")
    assert list(table.rows()) == [
        {"timestamp": table.values("timestamp")[row], "data": data, "old": old, "new": new}
        for row, (data, old, new) in enumerate([(1.0, 2, None), (2.5, None, 3), (4.0, 5, None)])
    ]


def test_a_latched_publisher_beside_another_is_no_change_of_type(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store")
    box.hear(COUNT, number(1))
    box.hear(Topic(COUNT.name, COUNT.message_encoding, COUNT.schema, latched=True), number(2))
    box.close()
    assert events(box.store, "type_changed") == []
    assert amberbox.open(box.store).query("ros_count").values("data") == [1, 2]


def test_json_that_widens_is_told_and_joined(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", source="zmq")
    for message in (b'{"v":1}', b'{"v":2.5}', b'{"v":3,"w":"x"}', b'{"w":"y"}'):
        box.hear(JSON, message)
        box.write()
    box.close()
    assert len(events(box.store, "schema_widened")) >= 2
    table = amberbox.open(box.store).query("zmq_json")
    assert table.values("v") == [1.0, 2.5, 3.0, None]
    assert table.values("w") == [None, None, "x", "y"]


def test_malformed_json_is_kept_raw_and_named(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", source="zmq")
    sent = [b'{"v":1}', b"{broken", b'{"v":2}', b"\xff\xfe", b'{"v":3}']
    box.hear(JSON, *sent)
    box.write()
    box.close()
    assert raw_messages(box.store, "/json") == sent
    assert len(events(box.store, "malformed")) == 1
    assert amberbox.open(box.store).query("zmq_json").values("v") == [1, 2, 3]
    gaps = [d for d in follow(box.store, ["zmq_json"], live=False) if isinstance(d, Gap)]
    assert [gap.count for gap in gaps] == [1, 1]
    assert all(gap.reason.startswith("undecodable") for gap in gaps)
    assert len(amberbox.open(box.store).query("zmq_json").notes) == 1


@pytest.mark.parametrize(
    "schema", [None, Schema("x/Y", "ros1msg", b"unknown/Type thing\n"), Schema("x", "idl?", b"?")]
)
def test_a_type_that_cannot_be_read_is_kept_raw_and_named(
    tmp_path: Path, schema: Schema | None
) -> None:
    box = ManualBox(tmp_path / "store")
    box.hear(Topic("/odd", "ros1", schema), b"abc", b"def")
    box.hear(COUNT, number(1))
    box.close()
    assert raw_messages(box.store, "/odd") == [b"abc", b"def"]
    (event,) = events(box.store, "undecodable")
    assert event["details"] == {"item": "ros_odd"}
    gaps = [d for d in follow(box.store, live=False) if isinstance(d, Gap)]
    assert [(gap.item, gap.count) for gap in gaps] == [("ros_odd", 2)]
    assert amberbox.open(box.store).query("ros_count").values("data") == [1]


def test_a_disk_that_is_full_at_the_end_is_no_silent_loss(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from amberbox.blackbox.journal import writer

    def refuse(fd: int, data: bytes) -> None:
        raise OSError(28, "No space left on device")

    box = ManualBox(tmp_path / "store")
    box.hear(COUNT, number(1))
    box.write()
    monkeypatch.setattr(writer, "write_all", refuse)
    box.hear(COUNT, number(2), number(3))
    box.write()
    with pytest.raises(AmberboxError, match="2 messages are lost"):
        box.close()
    again = ManualBox(tmp_path / "store")  # the locks are free
    assert raw_messages(tmp_path / "store", "/count") == [number(1)]
    again.crash()
    assert own_records(tmp_path / "store", "amberbox/run") != []


def test_a_filter_that_fails_keeps_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("out of order")

    monkeypatch.setattr("amberbox.blackbox.recorder.pipeline.change_filtered", fail)
    box = ManualBox(tmp_path / "store")
    for n in range(3):
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    assert raw_messages(tmp_path / "store", "/count") == [number(n) for n in range(3)]
    found = events(tmp_path / "store", "filter_failed")
    assert len(found) == 1
    assert "out of order" in found[0]["text"]
