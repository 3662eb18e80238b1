"""``amberbox foxglove`` for a real WebSocket client that subscribes, decodes and controls."""

from __future__ import annotations

import json
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from rosbags.typesys import Stores, get_typestore
from websockets.sync.client import connect
from websockets.sync.connection import Connection

import amberbox
from amberbox.blackbox.query.foxglove import (
    LiveColumns,
    LiveMessages,
    Server,
    ViewerListener,
)
from amberbox.cli.main import main
from amberbox.core.tls import is_loopback
from amberbox.core.types import Schema, Topic
from amberbox.testing.clock import PATIENCE_S
from amberbox.testing.records import fill_store
from tests.support.manual_recorder import COUNT, ManualBox, number, raw_messages
from tests.support.processes import command

PLAYING, PAUSED, ENDED = 0, 1, 3
TYPES = get_typestore(Stores.ROS1_NOETIC)
STRING = "std_msgs/msg/String"
TEXT = Schema("std_msgs/String", "ros1msg", TYPES.generate_msgdef(STRING)[0].encode())
NAME = Topic("/name", "ros1", TEXT, latched=True)


def text(value: str) -> bytes:
    return bytes(TYPES.serialize_ros1(TYPES.types[STRING](value), STRING))


class State(NamedTuple):
    """The server's report on its playback."""

    status: int
    at_ns: int
    speed: float
    did_seek: bool
    request_id: str


@dataclass
class Viewer:
    """A client of the Foxglove WebSocket protocol, as https://docs.foxglove.dev describes it."""

    socket: Connection
    info: dict[str, Any] = field(default_factory=dict)
    channels: dict[str, dict[str, Any]] = field(default_factory=dict)
    received: dict[str, list[tuple[int, bytes]]] = field(default_factory=dict)
    times: list[int] = field(default_factory=list)
    states: list[State] = field(default_factory=list)

    def wait(self, condition: Callable[[], object]) -> None:
        """Receive until a condition holds."""
        end_s = time.monotonic() + PATIENCE_S
        while not condition():
            self._take(self.socket.recv(timeout=max(end_s - time.monotonic(), 0)))

    def subscribe(self, *topics: str) -> None:
        """Subscribe to topics, waiting until they are advertised."""
        self.wait(lambda: self.channels.keys() >= set(topics))
        wanted = [
            {"id": self.channels[t]["id"], "channelId": self.channels[t]["id"]} for t in topics
        ]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def control(self, play: bool, speed: float = 1.0, seek_ns: int | None = None) -> State:
        """Ask for playback and return what the server answers."""
        request = f"request {len(self.states)}".encode()
        head = struct.pack("<BBfB", 3, 0 if play else 1, speed, seek_ns is not None)
        self.socket.send(head + struct.pack("<QI", seek_ns or 0, len(request)) + request)
        self.wait(lambda: any(state.request_id == request.decode() for state in self.states))
        return next(state for state in self.states if state.request_id == request.decode())

    def messages(self, topic: str) -> list[bytes]:
        return [data for _, data in self.received.get(topic, [])]

    def _take(self, frame: str | bytes) -> None:
        if isinstance(frame, str):
            self._take_text(json.loads(frame))
        elif frame[0] == 1:
            number, at_ns = struct.unpack_from("<IQ", frame, 1)
            topic = next(t for t, c in self.channels.items() if c["id"] == number)
            self.received.setdefault(topic, []).append((at_ns, frame[13:]))
        elif frame[0] == 2:
            self.times.append(struct.unpack_from("<Q", frame, 1)[0])
        elif frame[0] == 5:
            status, at_ns, speed, did_seek, size = struct.unpack_from("<BQfBI", frame, 1)
            self.states.append(
                State(status, at_ns, speed, bool(did_seek), frame[19 : 19 + size].decode())
            )

    def _take_text(self, message: dict[str, Any]) -> None:
        if message["op"] == "serverInfo":
            self.info = message
        elif message["op"] == "advertise":
            self.channels.update({channel["topic"]: channel for channel in message["channels"]})


@contextmanager
def viewer(port: int) -> Iterator[Viewer]:
    protocol: Any = ["foxglove.sdk.v1"]
    with connect(f"ws://127.0.0.1:{port}", subprotocols=protocol) as socket:
        yield Viewer(socket)


@contextmanager
def live(store: Path, kind: Any = LiveMessages) -> Iterator[int]:
    """Serve a store live in a thread; gives the port."""
    stop, server, source = threading.Event(), Server(ViewerListener()), kind(store, [])
    source.prepare(server)
    server.start("test", "127.0.0.1", 0)
    thread = threading.Thread(target=source.run, args=(server, stop))
    thread.start()
    try:
        yield server.websocket.port
    finally:
        stop.set()
        thread.join(PATIENCE_S)
        server.stop()
        assert not thread.is_alive()


def hear_until_heard(box: ManualBox, client: Viewer, topic: str) -> None:
    """Record counts until the viewer's subscription has taken effect."""
    while not client.messages(topic):
        box.hear(COUNT, number(-1))
        box.write()
        client.times.clear()
        client.wait(lambda: client.times or client.messages(topic))


@contextmanager
def program(*arguments: str, verb: str = "foxglove") -> Iterator[tuple[subprocess.Popen[str], int]]:
    """Run the verb as a program of its own; gives process and port."""
    words = command(verb, *arguments, *(["--port", "0"] if verb == "foxglove" else []))
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield process, int(process.stdout.readline().rpartition(":")[2])
    finally:
        process.kill()
        process.communicate()


@pytest.fixture
def box(tmp_path: Path) -> Iterator[ManualBox]:
    box = ManualBox(tmp_path / "store")
    box.hear(NAME, text("hall"))
    box.hear(COUNT, number(0))
    box.write()
    yield box
    box.close()


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """Ten seconds of counts at 10 Hz, and a name that changes in the middle."""
    box = ManualBox(tmp_path / "store")
    for count in range(100):
        if count in (0, 50):
            box.hear(NAME, text(f"name at {count}"))
        box.hear(COUNT, number(count))
        box.write()
    box.close()
    return box.store


def test_live_messages_arrive_as_they_are_written(box: ManualBox) -> None:
    with live(box.store) as port, viewer(port) as client:
        client.subscribe("/count")
        hear_until_heard(box, client, "/count")
        sent = [number(count) for count in range(1, 30)]
        for message in sent:
            box.hear(COUNT, message)
            box.write()
        client.wait(lambda: client.messages("/count")[-len(sent) :] == sent)
        box.hear(Topic("/later", "ros1", TEXT), text("a topic that is new"))
        box.write()
        client.wait(lambda: "/later" in client.channels)
    received = amberbox.open(box.store).query("ros_count", ["received"]).values("received")
    assert [at_ns for at_ns, _ in client.received["/count"]][-29:] == received[-29:]
    channel = client.channels["/count"]
    assert (channel["encoding"], channel["schemaName"]) == ("ros1", "std_msgs/Int64")
    assert (channel["schemaEncoding"], channel["schema"]) == ("ros1msg", "int64 data\n")
    assert client.times and client.info["capabilities"] == ["time"]
    assert not any(topic.startswith("amberbox/") for topic in client.channels)


def test_who_joins_late_gets_what_is_latched(box: ManualBox) -> None:
    with live(box.store) as port:
        for name in ("hall", "garden"):
            with viewer(port) as client:
                client.subscribe("/name")
                client.wait(lambda: client.messages("/name"))
                assert client.messages("/name") == [text(name)]
                box.hear(NAME, text("garden"))
                box.write()
                client.wait(lambda: len(client.messages("/name")) == 2)


def test_live_columns(box: ManualBox) -> None:
    with live(box.store, LiveColumns) as port, viewer(port) as client:
        client.subscribe("ros_count")
        hear_until_heard(box, client, "ros_count")
        box.hear(COUNT, number(7))
        box.write()
        client.wait(lambda: json.loads(client.messages("ros_count")[-1])["data"] == 7)
    assert set(json.loads(client.messages("ros_count")[-1])) == {"timestamp", "data"}
    schema = json.loads(client.channels["ros_count"]["schema"])
    assert schema["properties"]["data"] == {"type": "integer"}


def test_a_range_is_played_to_its_end_and_again(store: Path) -> None:
    with program(str(store), "--speed", "100") as (process, port), viewer(port) as client:
        client.subscribe("/count", "/name")
        client.wait(lambda: client.states and client.states[-1].status == ENDED)
        client.wait(lambda: len(client.messages("/count")) == 100)
        assert client.messages("/count") == raw_messages(store, "/count")
        assert client.messages("/name") == [text("name at 0"), text("name at 50")]
        times = [at_ns for at_ns, _ in client.received["/count"]]
        assert times == amberbox.open(store).query("ros_count", ["received"]).values("received")
        assert client.times == sorted(client.times)
        assert client.info["capabilities"] == ["time", "playbackControl"]
        client.received.clear()
        answer = client.control(play=True, speed=1000)
        assert (answer.status, answer.at_ns, answer.did_seek) == (PLAYING, times[0], True)
        client.wait(lambda: len(client.messages("/count")) == 100)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0


def test_a_viewer_controls_the_playback(store: Path) -> None:
    times = amberbox.open(store).query("ros_count", ["received"]).values("received")
    with program(str(store)) as (_, port), viewer(port) as client:
        client.subscribe("/count", "/name")
        client.wait(lambda: client.messages("/count"))
        assert client.control(play=False).status == PAUSED
        heard = len(client.messages("/count"))
        assert heard < 50
        answer = client.control(play=False, seek_ns=times[80])
        assert (answer.status, answer.at_ns, answer.did_seek) == (PAUSED, times[80], True)
        client.wait(lambda: client.messages("/name")[-1:] == [text("name at 50")])
        client.received.clear()
        answer = client.control(play=True, speed=50)
        assert (answer.status, answer.speed, answer.did_seek) == (PLAYING, 50, False)
        client.wait(lambda: client.states[-1].status == ENDED)
        client.wait(lambda: len(client.messages("/count")) == 20)
        assert client.messages("/count") == [number(count) for count in range(80, 100)]


def test_play_serves_viewers_again_and_again(store: Path) -> None:
    options = ["--to", "foxglove=0", "--loop", "--start-paused", "--prefix", "/replay"]
    with (
        program(str(store), *options, "--speed", "100", verb="play") as (process, port),
        viewer(port) as client,
    ):
        client.subscribe("/replay/count", "/replay/name")
        client.wait(lambda: client.states and client.states[-1].status == PAUSED)
        assert not client.messages("/replay/count")
        client.control(play=True, speed=1000)
        counts = [number(count) for count in range(100)]
        client.wait(lambda: len(client.messages("/replay/count")) >= 200)
        assert client.messages("/replay/count")[:200] == counts + counts
        assert ENDED not in {state.status for state in client.states}
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0


def test_a_range_of_columns_keeps_its_pace(store: Path) -> None:
    last = amberbox.open(store).last_ns()
    assert last is not None
    span = ["--from", str(last - 600_000_000), "--to", str(last), "--item", "ros_count"]
    arguments = [str(store), *span, "--columns", "--speed", "0.5"]
    with program(*arguments) as (_, port):
        started = time.monotonic()
        with viewer(port) as client:
            client.subscribe("ros_count")
            client.wait(lambda: len(client.messages("ros_count")) == 6)
        assert time.monotonic() - started > 0.9  # half a second of the record
    rows = [json.loads(message) for message in client.messages("ros_count")]
    expected = amberbox.open(store).query("ros_count", None, last - 600_000_000, last)
    assert [row["data"] for row in rows] == expected.values("data")
    stamps = [row["timestamp"]["sec"] * 10**9 + row["timestamp"]["nsec"] for row in rows]
    assert stamps == expected.values("timestamp")


def test_json_topics_have_schemas_that_viewers_read(tmp_path: Path) -> None:
    fill_store(tmp_path / "store")
    with program(str(tmp_path / "store"), "--speed", "1000") as (_, port), viewer(port) as client:
        client.subscribe("/odom")
        client.wait(lambda: len(client.messages("/odom")) == 300)
    schema = json.loads(client.channels["/odom"]["schema"])
    assert schema["properties"]["pose"]["properties"]["x"] == {"type": "number"}
    assert json.loads(client.messages("/odom")[7])["pose"]["x"] == 7.0


def test_a_port_that_is_taken(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    taken = Server(ViewerListener())
    taken.start("test", "127.0.0.1", 0)
    port = taken.websocket.port
    assert main(["foxglove", str(store), "--port", str(port)]) == 1
    assert f"cannot serve on 127.0.0.1:{port}" in capsys.readouterr().err
    assert main(["foxglove", str(store), "--live", "--host", "0.0.0.0", "--port", str(port)]) == 1
    assert "can read this record: the protocol has no login" in capsys.readouterr().err
    taken.stop()


def test_wrong_usage(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    for arguments, text_ in (
        (["--live", "--from", "-1s"], "--live goes on from now"),
        (["--speed", "0"], "--speed must be above 0"),
        (["--port", "70000"], "there is no port 70000"),
        (["--item", "ros_cuont"], "did you mean ros_count"),
        (["--live", "--item", "ros_cuont"], "did you mean ros_count"),
    ):
        assert main(["foxglove", str(store), *arguments]) == 2
        assert text_ in capsys.readouterr().err
    assert main(["foxglove", str(store), "--from", "2030-01-01"]) == 1
    assert "nothing is recorded in this range" in capsys.readouterr().err
    ManualBox(tmp_path / "empty").close()
    monkeypatch.setitem(sys.modules, "foxglove", None)
    assert main(["foxglove", str(store)]) == 2
    assert "pip install amberbox[foxglove]" in capsys.readouterr().err


def test_which_addresses_stay_on_this_computer() -> None:
    assert is_loopback("127.0.0.1") and is_loopback("::1") and is_loopback("localhost")
    assert not is_loopback("0.0.0.0") and not is_loopback("robot.local")
