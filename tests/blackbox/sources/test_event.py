"""The source ``event``: ``amberbox.log`` of real programs, ZeroMQ messages, and what it watches."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zmq

import amberbox
from amberbox.blackbox.robot_folder.black_box_yaml import read_blocks
from amberbox.blackbox.sources import event
from amberbox.blackbox.sources.event import Config, Listener, Source
from amberbox.core import event_log
from amberbox.core.config import build
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.source import TopicOptions
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import MemorySink, ObservedSink, observe
from tests.support.manual_recorder import recording
from tests.support.processes import free_port
from tests.support.ros_network import RosMaster


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The socket of this test, for both ends; programs begin without a connection."""
    path = tmp_path / "log.sock"
    monkeypatch.setenv(event_log.VARIABLE, str(path))
    monkeypatch.setattr(event_log, "_sender", None)
    return path


@contextmanager
def listening(place: Path, **options: Any) -> Iterator[ObservedSink]:
    with observe(Source(Config(**options), "event")) as sink:
        wait_until(place.exists, "the socket is there")
        yield sink


def rows(sink: MemorySink, name: str, count: int = 1) -> list[dict[str, Any]]:
    return [json.loads(data) for data in sink.wait_for(name, count)]


def kinds(sink: MemorySink) -> list[str]:
    return [kind for kind, _, _ in sink.events]


def wait_for_event(sink: MemorySink, kind: str) -> Mapping[str, Any]:
    wait_until(lambda: kind in kinds(sink), kind)
    return next(details for found, _, details in sink.events if found == kind)


def send(place: Path, *messages: bytes) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as peer:
        peer.connect(str(place))
        for message in messages:
            peer.send(message)


def problems(text: str) -> list[str]:
    found: list[Problem] = []
    node = parse_yaml(text, "black_box.yaml", found)
    assert node is not None
    build(Config, node, found, "event")
    return [str(problem) for problem in found]


def test_a_decision_is_recorded_with_its_reasons(place: Path) -> None:
    with listening(place) as sink:
        amberbox.log("grasp", reason="object slipped", force_n=3.2, tries=2, held=False)
        (row,) = rows(sink, "grasp")
    assert isinstance(row.pop("stamp"), int)
    assert row == {"reason": "object slipped", "force_n": 3.2, "tries": 2, "held": False}
    assert sink.topics[0].message_encoding == "json"


def test_values_become_typed_columns_of_an_item(place: Path, tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("id: r1\n")
    (tmp_path / "black_box.yaml").write_text("- event: {}\n")
    with recording(tmp_path):
        wait_until(place.exists, "the socket is there")
        amberbox.log("grasp", reason="slipped", force_n=3.2)
        amberbox.log("grasp", reason="held", force_n=4, held=True)
        assert event_log.flush(PATIENCE_S)
    with amberbox.open(tmp_path) as record:
        table = record.query("event_grasp")
    assert table.values("reason") == ["slipped", "held"]
    assert table.values("force_n") == [3.2, 4.0]
    assert table.values("held") == [None, True]


def test_a_program_of_its_own_sends_all_before_it_ends(place: Path) -> None:
    code = "import amberbox\nfor n in range(800): amberbox.log('count', n=n)"
    with listening(place) as sink:
        subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE_S)
        assert [row["n"] for row in rows(sink, "count", 800)] == list(range(800))


def test_a_child_process_logs_as_its_parent_does(place: Path) -> None:
    code = (
        "import os, amberbox\namberbox.log('parent', n=1)\n"
        "child = os.fork()\namberbox.log('both', pid=os.getpid())\n"
        "if child: os.waitpid(child, 0)"
    )
    with listening(place) as sink:
        subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE_S)
        assert len({row["pid"] for row in rows(sink, "both", 2)}) == 2


class Awkward:
    def __str__(self) -> str:
        raise RuntimeError("no text")


def test_values_of_any_kind_never_raise(place: Path) -> None:
    import numpy as np

    circle: list[Any] = []
    circle.append(circle)
    values = {
        "speed": np.float32(0.5), "path": Path("/a/b"), "nan": float("nan"), "list": (1, 2),
        "scan": np.arange(3), "circle": circle, "bytes": b"x", "broken": "\udc80",
        "stamp": "2026-01-05T08:00:00Z", "pose": {"x": 1.0},
    }  # fmt: skip
    with listening(place) as sink:
        amberbox.log("odd", **values)
        amberbox.log("lost", value=Awkward())
        amberbox.log("long", text="x" * 40_000)
        amberbox.log("last")
        (row,) = rows(sink, "odd")
        details = wait_for_event(sink, "log_lost")
        rows(sink, "last")
    assert row["speed"] == 0.5 and row["path"] == "/a/b" and row["nan"] is None
    assert row["scan"] == [0, 1, 2] and row["list"] == [1, 2] and row["pose"] == {"x": 1.0}
    assert row["stamp"] == "2026-01-05T08:00:00Z" and row["broken"] == "?"
    assert details["lost"] == {"lost": 1, "long": 1}
    assert {(topic, count) for topic, *_, count, _ in sink.losses} == {("lost", 1), ("long", 1)}


def test_without_a_recorder_messages_are_counted_and_told_when_it_is_back(place: Path) -> None:
    amberbox.log("grasp", n=0)
    amberbox.log("grasp", n=1)
    assert event_log.flush(PATIENCE_S)
    with listening(place) as sink:
        assert wait_for_event(sink, "log_lost")["lost"] == {"grasp": 2}
        amberbox.log("grasp", n=2)
        assert [row["n"] for row in rows(sink, "grasp")] == [2]
    with listening(place) as sink:
        amberbox.log("grasp", n=3)
        assert [row["n"] for row in rows(sink, "grasp")] == [3], "the recorder was restarted"


def test_a_recorder_that_does_not_read_never_holds_the_program(place: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as deaf:
        deaf.bind(str(place))
        for number in range(3000):
            amberbox.log("flood", n=number)
        place.unlink()
    with listening(place) as sink:
        wait_until(lambda: sum(count for *_, count, _ in sink.losses) > 1000, "the loss is told")
        amberbox.log("after")
        rows(sink, "after")


def test_hostile_messages_are_counted_and_the_rest_goes_on(place: Path) -> None:
    hostile = [
        b"", b"{", b"[]", b"\xff\xfe", b'{"name": 1}', b'{"name": "a", "value": {}}', b"x" * 32_769,
        b'{"name": "../../etc"}', b'{"name": ""}', '{"name": "ß"}'.encode(), b'{"name": "a\\n"}',
        b'{"name": "' + b"n" * 65 + b'"}', b'{"name": "a", "values": []}',
        b'{"name": "a", "values": ' + b'{"a":' * 5000 + b"1" + b"}" * 5001,
        b'{"lost": {"a": -1}}', b'{"lost": {"a b": 1}}', b'{"name": "rosparam", "values": {}}',
    ]  # fmt: skip
    with listening(place, listeners=[Listener("rosparam")]) as sink:
        send(place, *hostile, b'{"name": "good", "values": {"n": 1}}')
        assert rows(sink, "good") == [{"n": 1}]
        assert wait_for_event(sink, "log_malformed")["count"] == 1
    assert {topic.name for topic in sink.topics} == {"good", "rosparam"}
    assert kinds(sink).count("log_malformed") == 1, "reported once a minute"


def test_a_sender_cannot_make_names_without_end(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event, "_MOST_NAMES", 3)
    with listening(place) as sink:
        send(place, *(b'{"name": "n%d", "values": {"a": 1}}' % number for number in range(6)))
        wait_for_event(sink, "log_malformed")
        send(place, b'{"name": "n0", "values": {"a": 2}}')
        assert rows(sink, "n0", 2)[1] == {"a": 2}
    assert len(sink.topics) == 3


def test_zeromq_messages_of_other_languages(place: Path) -> None:
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    stamp = {"name": "plan", "stamp": 1_750_000_000.25, "values": {"cost": 3.5, "route": [1, 2]}}
    context = zmq.Context()
    with listening(place, endpoint=endpoint) as sink, context.socket(zmq.PUSH) as peer:
        peer.connect(endpoint)
        for message in (b"\0garbage", json.dumps(stamp).encode()):
            peer.send(message)
        assert rows(sink, "plan") == [{"stamp": 1_750_000_000.25, "cost": 3.5, "route": [1, 2]}]
        wait_for_event(sink, "log_malformed")
    context.term()


def test_an_endpoint_in_use_is_an_error_with_a_reason(place: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        endpoint = f"tcp://127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(AmberboxError, match="cannot listen at tcp"):
            Source(Config(endpoint=endpoint), "event").run(MemorySink(), threading.Event())
    assert not place.exists()


def test_the_socket_of_a_killed_recorder_is_replaced_that_of_a_live_one_is_not(place: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as left:
        left.bind(str(place))
        with observe(Source(Config(), "event")) as sink:
            wait_for_event(sink, "log_socket_missing")
            assert "another recorder listens there" in sink.events[0][1]
            left.close()
            wait_until(lambda: _can_send(place), "it takes over")
    assert not place.exists(), "removed at the end"


def _can_send(place: Path) -> bool:
    try:
        send(place, b'{"name": "a", "values": {}}')
    except OSError:
        return False
    return True


def test_options_of_listed_names_hold_and_others_are_recorded(place: Path) -> None:
    config = Config(topics=[TopicOptions("grasp", max_frequency=1.0)])
    assert [topic.name for topic in Source(config, "event").topics()] == ["grasp", "**"]
    with listening(place, topics=config.topics) as sink:
        wait_until(lambda: ("grasp", "programs") in sink.open_links(), "its gap is closed")
        amberbox.log("other", n=1)
        rows(sink, "other")


def test_system_information_is_recorded_once(place: Path) -> None:
    listeners = [Listener("system_info", "ON_STARTUP")]
    with listening(place, listeners=listeners) as sink:
        (row,) = rows(sink, "system_info")
    assert row["kernel"] == os.uname().release and row["cpus"] == os.cpu_count()
    assert row["memory_bytes"] > 10**8 and row["boot_id"]


def test_parameters_are_rows_and_changes_are_events(place: Path) -> None:
    master = RosMaster()
    master.parameters = {"move_base": {"max_vel": 0.5, "frames": ["map"]}, "wifi": {"key": "x"}}
    listener = Listener("rosparam", max_frequency=30, exclude=["/wifi/**"])
    options = {"listeners": [listener], "ros_master_uri": master.uri, "socket": "none"}
    sink = MemorySink()
    with observed(sink, **options):
        rows(sink, "rosparam")
        master.parameters["move_base"]["max_vel"] = 0.8
        assert rows(sink, "rosparam", 2) == [
            {"move_base": {"frames": ["map"], "max_vel": 0.5}, "wifi": {}},
            {"move_base": {"frames": ["map"], "max_vel": 0.8}, "wifi": {}},
        ]
    assert sink.events == [(
        "rosparam_changed", "/move_base/max_vel: 0.5 -> 0.8",
        {"changed": {"/move_base/max_vel": ["0.5", "0.8"]}},
    )]  # fmt: skip
    master.parameters["move_base"]["frames"] = []
    with observed(sink, **options):  # the next run tells what has changed meanwhile
        rows(sink, "rosparam", 3)
        master.stop()
        wait_until(lambda: "rosparam_unreadable" in kinds(sink), "the master is gone")
    assert sink.events[1][1] == '/move_base/frames: ["map"] -> []'
    assert [way for way, *_ in sink.links] == ["up", "up", "down"]


@contextmanager
def observed(sink: MemorySink, **options: Any) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=Source(Config(**options), "event").run, args=(sink, stop))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def test_wrong_keys_are_errors_with_line_and_reason() -> None:
    found = problems("""\
listeners:
  - listener: {name: rosparams}
  - listener: {name: rosparam, event_type: CHANGE}
endpoint: localhost:5600
""")
    assert len(found) == 2 and "did you mean 'rosparam'" in found[0] and ":3:" in found[1]
    found = problems("endpoint: localhost:5600\nlisteners: [{name: rosparam}, {name: rosparam}]\n")
    assert any("is no address; write tcp://127.0.0.1:5600" in problem for problem in found)
    assert any("rosparam is there twice" in problem for problem in found)
    assert list(Config(endpoint="tcp://*:5600").notes())
    assert not list(Config(endpoint="tcp://127.0.0.1:5600").notes())


def test_import_needs_only_the_standard_library() -> None:
    code = (
        "import sys, amberbox\namberbox.log('x')\n"
        "print([m for m in ('numpy', 'msgspec', 'yaml', 'zmq') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.needs_data
@pytest.mark.parametrize(
    ("file", "listeners"),
    [
        ("data_sources.yaml", [Listener("rosparam"), Listener("system_info", "ON_STARTUP")]),
        ("data_sources_nav.yaml", [Listener("rosparam", max_frequency=2)]),
    ],
)
def test_the_blocks_of_real_robots_load_unchanged(
    shared_data: Path, file: str, listeners: list[Listener]
) -> None:
    found: list[Problem] = []
    root = parse_yaml((shared_data / "ropod" / "black_box_configs" / file).read_text(), file, found)
    assert root is not None
    blocks = read_blocks(root, "amberbox.blackbox.sources", found, has_recorded=True)
    (block,) = [block for block in blocks.sources if block.plugin == "event"]
    assert block.config == Config(listeners=tuple(listeners))
    assert not [problem for problem in found if ": event" in str(problem)]
