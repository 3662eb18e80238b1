"""The source of Zyre networks, with pyre as the peer, at the other end of a cable of its own."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import struct
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import Popen
from typing import Any

import pytest
import zmq

import amberbox
from amberbox.blackbox.sources import zyre as source
from amberbox.blackbox.sources.zre import messages, node
from amberbox.blackbox.sources.zre.messages import Beacon, ZreMessage, write_beacon, write_message
from amberbox.blackbox.store.store import create_store
from amberbox.core.errors import AmberboxError
from amberbox.core.source import TopicOptions
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import MemorySink, ObservedSink, observe
from tests.support.networks import BOX, ROBOT, Cable, SourceWithin, cable, ip, within
from tests.support.processes import command
from tests.support.zyre_peer import zyre_peer

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root makes networks")

CMD = '{"header": {"type": "CMD"}, "n": %d}'


@pytest.fixture
def net() -> Iterator[Cable]:
    with cable() as made:
        yield made


@contextmanager
def listening(net: Cable, **options: Any) -> Iterator[ObservedSink]:
    config = source.Config(**{"name": "box", "interface": "near", "groups": ("ROPOD",)} | options)
    with observe(SourceWithin(source.Source(config, "zyre"), net.box)) as sink:
        wait_until(lambda: "zyre_open" in kinds(sink), "it listens")
        yield sink


def kinds(sink: MemorySink) -> list[str]:
    return [kind for kind, _, _ in sink.events]


def happened(sink: MemorySink, kind: str, times: int = 1) -> None:
    wait_until(lambda: kinds(sink).count(kind) >= times, kind)


def total(sink: MemorySink, count: str) -> int:
    return sum(json.loads(row)[count] for row in sink.of("network"))


def numbers(sink: MemorySink, topic: str) -> list[int]:
    return [json.loads(data)["n"] for data in sink.of(topic)]


def ways(sink: MemorySink, topic: str) -> list[str]:
    return [way for way, name, *_ in sink.links if name == topic]


def test_a_peer_comes_speaks_and_leaves(net: Cable) -> None:
    with listening(net) as sink, zyre_peer(net.robot, "robot", "ROPOD", "OTHER") as peer:
        box = peer.sees("ENTER", "box")
        peer.sees("JOIN", "box", "ROPOD")
        peer.order("shout", "ROPOD", CMD, 300, 1000)
        peer.order("shout", "ROPOD", "no JSON", 1, 1)
        peer.order("shout", "ROPOD", '{"header": {"type": "network"}}', 1, 1)
        peer.order("whisper", box, '{"header": {"type": "plan"}, "n": 7}')
        peer.order("leave", "OTHER")
        happened(sink, "zyre_leave")
        peer.order("stop")
        happened(sink, "zyre_exit")
        wait_until(lambda: total(sink, "whispers") == 1, "all is counted")
    assert numbers(sink, "CMD") == list(range(300)) and numbers(sink, "plan") == [7]
    assert sink.of("ROPOD") == [b"no JSON"] and len(sink.of("network_")) == 1
    assert (total(sink, "shouts"), total(sink, "not_json"), total(sink, "lost")) == (302, 1, 0)
    enter = next(details for kind, _, details in sink.events if kind == "zyre_enter")
    assert enter["peer"] == "robot" and enter["address"].startswith(f"tcp://{ROBOT}:")
    joined = [text for kind, text, _ in sink.events if kind == "zyre_join"]
    assert joined == ["robot joins ROPOD", "robot joins OTHER"]
    assert [
        (way, peer, reason) for way, topic, peer, reason, _ in sink.links if topic == "CMD"
    ] == [
        ("up", "robot", ""),
        ("down", "robot", "it has left"),
    ]
    assert kinds(sink)[-1] == "sent" and sink.losses == []


def test_only_chosen_types_are_recorded(net: Cable) -> None:
    options = {"message_types": ("CMD",), "topics": (TopicOptions("Robot*"),)}
    with listening(net, **options) as sink, zyre_peer(net.robot, "robot", "ROPOD") as peer:
        peer.sees("JOIN", "box", "ROPOD")
        for kind in ("plan", "RobotPose2D", "CMD"):
            peer.order("shout", "ROPOD", CMD.replace("CMD", kind), 5, 1000)
        peer.order("shout", "ROPOD", "{}", 1, 1)
        sink.wait_for("CMD", 5)
        wait_until(lambda: total(sink, "left_out") == 6, "the others are counted")
    assert {topic.name for topic in sink.topics} == {"network", "RobotPose2D", "CMD"}


def test_without_groups_those_of_others_are_joined(net: Cable) -> None:
    with listening(net, groups=()) as sink, zyre_peer(net.robot, "robot", "A") as peer:
        peer.sees("JOIN", "box", "A")
        peer.order("join", "B")
        peer.sees("JOIN", "box", "B")
        peer.order("shout", "B", CMD, 1, 1)
        sink.wait_for("CMD", 1)


def test_a_peer_that_is_killed_and_started_again(net: Cable) -> None:
    """The new one ends the gap, which begins when the old one was heard last."""
    with listening(net) as sink:
        for round_ in (1, 2):
            with zyre_peer(net.robot, "robot", "ROPOD") as peer:
                peer.sees("JOIN", "box", "ROPOD")
                peer.order("shout", "ROPOD", CMD, 10, 1000)
                sink.wait_for("CMD", 10 * round_)
                peer.kill()
    assert ways(sink, "CMD") == ["up", "down", "up", "down"]
    _, _, _, reason, down_ns = [link for link in sink.links if link[1] == "CMD"][1]
    assert reason == "it was started anew" and down_ns >= sink.messages[9][2]


def test_a_silent_peer_is_gone_once(net: Cable, monkeypatch: pytest.MonkeyPatch) -> None:
    with listening(net) as sink, zyre_peer(net.robot, "robot", "ROPOD") as peer:
        peer.sees("JOIN", "box", "ROPOD")
        peer.order("shout", "ROPOD", CMD, 1, 1)
        sink.wait_for("CMD", 1)
        peer.process.send_signal(signal.SIGKILL)
        monkeypatch.setattr(node, "EXPIRED_S", 3.0)
        happened(sink, "zyre_exit")
        wait_until(lambda: json.loads(sink.of("network")[-1])["peers"] == 0, "no peer is there")
    assert kinds(sink).count("zyre_exit") == 1
    assert "nothing was heard of it for 3 s" in next(t for k, t, _ in sink.events if "exit" in k)
    assert ways(sink, "CMD") == ["up", "down"]


def test_a_network_that_is_cut_for_10_s(net: Cable) -> None:
    """What is sent meanwhile arrives late or is counted; the peer is not taken for gone."""
    with listening(net) as sink, zyre_peer(net.robot, "robot", "ROPOD") as peer:
        peer.sees("JOIN", "box", "ROPOD")
        peer.order("shout", "ROPOD", CMD, 1300, 100)
        sink.wait_for("CMD", 100)
        net.plug("down")
        silent = len(sink.of("network"))
        wait_until(lambda: len(sink.of("network")) >= silent + 10, "10 s have passed")
        net.plug("up")
        wait_until(lambda: len(sink.of("CMD")) + total(sink, "lost") == 1300, "all is known")
    received = numbers(sink, "CMD")
    assert received == sorted(set(received)) and received[-1] == 1299
    assert sum(count for *_, count, _ in sink.losses) == total(sink, "lost") == 1300 - len(received)
    assert "zyre_exit" not in kinds(sink)


def test_an_interface_that_comes_late_and_goes(net: Cable) -> None:
    net_down = ["-n", net.box, "link", "set", "near", "down"]
    ip(*net_down)
    config = source.Config(name="box", interface=BOX)
    with observe(SourceWithin(source.Source(config, "zyre"), net.box)) as sink:
        happened(sink, "zyre_missing")
        ip(*net_down[:-1], "up")
        happened(sink, "zyre_open")
        ip(*net_down)
        happened(sink, "zyre_lost")
        ip(*net_down[:-1], "up")
        happened(sink, "zyre_open", 2)
        with zyre_peer(net.robot, "robot", "ROPOD") as peer:
            peer.sees("ENTER", "box")
    missing = next(text for kind, text, _ in sink.events if kind == "zyre_missing")
    assert missing == f"cannot listen: no interface {BOX} that is up with an address and broadcasts"


class Stranger:
    """A node of raw bytes in the robot's network."""

    def __init__(self, net: Cable) -> None:
        self.node = uuid.uuid4().bytes
        self._context, self.beacons, self.inbox = within(net.robot, self._open)
        self.port = int(self.inbox.last_endpoint.rpartition(b":")[2])

    def _open(self) -> tuple[Any, socket.socket, Any]:
        beacons = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        for option in (socket.SO_BROADCAST, socket.SO_REUSEADDR, socket.SO_REUSEPORT):
            beacons.setsockopt(socket.SOL_SOCKET, option, 1)
        beacons.bind(("", 5670))
        context = zmq.Context()
        inbox = context.socket(zmq.ROUTER)
        inbox.bind(f"tcp://{ROBOT}:*")
        return context, beacons, inbox

    def __enter__(self) -> Stranger:
        self.beacons.settimeout(PATIENCE_S)
        data = b""
        while not data.startswith(b"ZRE\x01"):
            data = self.beacons.recv(100)
        (port,) = struct.unpack(">H", data[20:])
        self.box = self._context.socket(zmq.DEALER)
        self.box.identity = b"\x01" + self.node
        self.box.connect(f"tcp://{BOX}:{port}")
        return self

    def __exit__(self, *_: object) -> None:
        self._context.destroy(linger=0)
        self.beacons.close()

    def beacon(self, data: bytes) -> None:
        self.beacons.sendto(data, ("10.213.9.255", 5670))

    def greet(self, name: str) -> None:
        endpoint = f"tcp://198.51.100.7:{self.port}"
        hello = ZreMessage(messages.HELLO, 1, name=name, endpoint=endpoint, groups=["ROPOD"])
        self.box.send(write_message(hello))

    def come_and_go(self, times: int) -> None:
        """Be as many nodes, one after the other at the same address."""
        for _ in range(times):
            one = uuid.uuid4().bytes
            self.beacon(write_beacon(Beacon(one, self.port)))
            other = self._context.socket(zmq.DEALER)
            other.identity = b"\x01" + one
            other.connect(self.box.last_endpoint.decode())
            endpoint = f"tcp://{ROBOT}:{self.port}"
            hello = ZreMessage(messages.HELLO, 1, name=one.hex()[:6], endpoint=endpoint)
            other.send(write_message(hello))
            other.poll(20)
            other.close()

    def shout(self, sequence: int, content: bytes) -> None:
        head = write_message(ZreMessage(messages.SHOUT, sequence, "ROPOD"))
        self.box.send_multipart([head, content])


def test_hostile_nodes_are_counted_and_the_rest_goes_on(net: Cable) -> None:
    chance = random.Random(7)
    hello = write_message(ZreMessage(messages.HELLO, 1, endpoint="tcp://1.2.3.4:1", name="x"))
    with listening(net) as sink, zyre_peer(net.robot, "robot", "ROPOD") as peer:
        peer.sees("JOIN", "box", "ROPOD")
        peer.order("shout", "ROPOD", CMD, 400, 200)
        with Stranger(net) as stranger:
            for _ in range(50):
                stranger.beacon(chance.randbytes(chance.randrange(60)))
                stranger.box.send_multipart([chance.randbytes(30), b"x"])
                stranger.box.send(hello[: chance.randrange(len(hello))])
            for _ in range(300):
                stranger.beacon(
                    write_beacon(Beacon(chance.randbytes(16), chance.randrange(1, 65536)))
                )
            stranger.shout(2, b"without a greeting")
            sink.wait_for("CMD", 400)
            wait_until(lambda: total(sink, "malformed") == 150, "all are counted")
            wait_until(lambda: "zyre_many_peers" in kinds(sink), "there are too many")
    assert numbers(sink, "CMD") == list(range(400)) and total(sink, "strangers") == 1
    assert total(sink, "lost") == 0 and sink.losses == []


def test_holes_are_counted_and_a_false_address_is_not_used(net: Cable) -> None:
    """The box answers to where a greeting came from, whatever host it names."""
    with listening(net) as sink, Stranger(net) as stranger:
        stranger.greet("s")
        happened(sink, "zyre_enter")
        assert stranger.inbox.poll(PATIENCE_S * 1000), "the box greets"
        sender, frame = stranger.inbox.recv_multipart()
        hello = messages.read_message(frame)
        assert (hello.name, hello.groups, hello.sequence) == ("box", ["ROPOD"], 1)
        assert sender[1:] != stranger.node and hello.endpoint.startswith(f"tcp://{BOX}:")
        for sequence in (2, 3, 7, 8):
            stranger.shout(sequence, b'{"n": %d}' % sequence)
        stranger.box.send(write_message(ZreMessage(messages.PING, 10)))
        assert stranger.inbox.poll(PATIENCE_S * 1000), "the box answers"
        answer = messages.read_message(stranger.inbox.recv_multipart()[1])
        assert (answer.kind, answer.sequence) == (messages.PING_OK, 2)
        wait_until(lambda: total(sink, "lost") == 4, "all are counted")
    assert numbers(sink, "ROPOD") == [2, 3, 7, 8]
    assert [(topic, peer, count) for topic, peer, _, _, count, _ in sink.losses] == [
        ("network", "s", 3), ("network", "s", 1),
    ]  # fmt: skip
    assert total(sink, "malformed") == total(sink, "strangers") == 0


def test_peers_that_flap_do_not_flood_the_events(net: Cable) -> None:
    """One greets without an end, others come and go under new names."""
    with listening(net) as sink, Stranger(net) as stranger:
        for _ in range(200):
            stranger.greet("s")
        stranger.shout(2, b"{}")
        sink.wait_for("ROPOD", 1)
        wait_until(lambda: total(sink, "malformed") == 199, "all greetings are counted")
        stranger.come_and_go(150)
        wait_until(lambda: total(sink, "refused") > 0, "too many have come")
        peers = [json.loads(row)["peers"] for row in sink.of("network")]
    assert len(sink.events) < 60 and max(peers) <= node.MOST_PEERS
    assert ways(sink, "ROPOD") == ["up", "down"]


def recording(folder: Path, net: Cable) -> Popen[bytes]:
    words = ["ip", "netns", "exec", net.box, *command("record", folder)]
    with (folder / "log").open("wb") as log:
        return Popen(words, stdout=log, stderr=log)


def record_ropod(folder: Path, block: str, net: Cable) -> Any:
    """Record a block that names no interface; another schema comes in between."""
    (folder / "robot.yaml").write_text("id: ropod_001\nstore: {path: store}\n")
    (folder / "black_box.yaml").write_text(block)
    process = recording(folder, net)
    try:
        with zyre_peer(net.robot, "ropod_001", "ROPOD") as peer:
            peer.sees("JOIN", "black_box_001", "ROPOD")
            for n in ("%d", '"late"', '{"deeper": [%d]}'):
                peer.order("shout", "ROPOD", CMD.replace("%d", n), 20, 1000)
            peer.order("shout", "ROPOD", CMD.replace("CMD", "HEALTH-STATUS"), 5, 1000)
            peer.order("shout", "ROPOD", CMD.replace("CMD", "plan"), 1, 1000)
            wait_until(lambda: _rows(folder, "zyre_plan") == 1, "the last message is recorded")
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE_S)
    return amberbox.open(folder)


def _rows(folder: Path, item: str) -> int:
    try:
        return len(amberbox.open(folder).query(item))
    except AmberboxError:
        return 0


BLOCK = """\
- zyre:
    name: black_box_001
    groups:
        - ROPOD
    message_types:
        - CMD
        - plan
        - progress
        - RobotPose2D
"""


def test_the_predecessors_block_is_recorded(net: Cable, tmp_path: Path) -> None:
    record = record_ropod(tmp_path, BLOCK, net)
    values = record.query("zyre_CMD").values("n")
    assert len(values) == 60
    assert "zyre_HEALTH_STATUS" not in record.items()


@pytest.mark.needs_data
def test_a_real_file_is_recorded_as_it_is(net: Cable, shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "ropod" / "black_box_configs" / "data_sources.yaml"
    create_store(tmp_path / "store").next_run()  # so its blocks that are to come are only notes
    record = record_ropod(tmp_path, path.read_text(), net)
    assert len(record.query("zyre_CMD").values("n")) == 60
    assert "zyre_HEALTH_STATUS" not in record.items()


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"name": ""}, "name"),
        ({"name": "x" * 256}, "name"),
        ({"groups": ("",)}, "groups"),
        ({"port": 0}, "port"),
        ({"message_types": ("a**",)}, "message_types"),
    ],
)
def test_wrong_options(options: dict[str, Any], key: str) -> None:
    assert [found for found, _ in source.Config(**options).check()] == [key]
