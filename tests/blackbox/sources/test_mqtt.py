"""The source of MQTT brokers, with mosquitto, and with brokers of raw bytes."""

from __future__ import annotations

import json
import os
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import amberbox
from amberbox.blackbox.sources import mqtt as source
from amberbox.blackbox.sources.mqtt import MqttTopic, Vda5050Options
from amberbox.core.errors import AmberboxError
from amberbox.core.mqtt import broker_address, filter_problem, overlap
from amberbox.server import certificates
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import MemorySink, ObservedSink, observe
from tests.support.mqtt_broker import Mosquitto, mosquitto, publisher
from tests.support.networks import ROBOT, SourceWithin, cable, within
from tests.support.processes import running

NUMBER = '{"n": %d}'
VEHICLE = "uagv/v2/ACME/0007"


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    with mosquitto(tmp_path) as made:
        yield made


@contextmanager
def subscribed(broker: Mosquitto, **options: Any) -> Iterator[ObservedSink]:
    with observe(source.Source(source.Config(**broker.block | options), "mqtt")) as sink:
        happened(sink, "mqtt_connected")
        yield sink


def kinds(sink: MemorySink) -> list[str]:
    return [kind for kind, _, _ in sink.events]


def texts(sink: MemorySink, kind: str) -> list[str]:
    return [text for found, text, _ in sink.events if found == kind]


def happened(sink: MemorySink, kind: str, times: int = 1) -> None:
    wait_until(lambda: kinds(sink).count(kind) >= times, kind)


def total(sink: MemorySink, count: str) -> int:
    return sum(json.loads(row)[count] for row in sink.of("broker"))


def ways(sink: MemorySink, topic: str) -> list[str]:
    return [way for way, name, *_ in sink.links if name == topic]


def numbers(sink: MemorySink, topic: str) -> list[int]:
    return [json.loads(data)["n"] for data in sink.of(topic)]


def test_each_message_arrives_with_its_bytes(broker: Mosquitto) -> None:
    with subscribed(broker) as sink, publisher(broker) as peer:
        for number in range(500):
            peer.publish("base/odom", NUMBER % number, qos=1)
        peer.publish("base/image", b"\xff\xd8\0")
        peer.publish("broker", "23.5")
        sink.wait_for("base/odom", 500)
        sink.wait_for("base/image", 1)
        sink.wait_for("broker_", 1)
        wait_until(lambda: total(sink, "messages") == 502, "all are counted")
    assert numbers(sink, "base/odom") == list(range(500))
    assert sink.of("base/image") == [b"\xff\xd8\0"] and sink.of("broker_") == [b"23.5"]
    encodings = {topic.name: topic.message_encoding for topic in sink.topics}
    assert (encodings["base/odom"], encodings["base/image"]) == ("json", "frame")
    assert (total(sink, "not_json"), total(sink, "lost")) == (1, 0)
    assert ways(sink, "base/odom") == ["up", "down"]


def test_filters_choose(broker: Mosquitto) -> None:
    topics = (MqttTopic("arm/+/angle"), MqttTopic("base/#"), MqttTopic("base/odom", qos=0))
    options: dict[str, Any] = {"topics": topics, "exclude": ("base/+/debug",)}
    with subscribed(broker, **options) as sink, publisher(broker) as peer:
        for name in ("arm/1/angle", "arm/1/2/angle", "base/odom", "base/a/debug", "other"):
            peer.publish(name, "1", qos=1)
        peer.publish("base/end", "1", qos=1)
        sink.wait_for("base/end", 1)
        wait_until(lambda: total(sink, "left_out") == 1, "what is excluded is counted")
    names = [sink.topics[stream].name for stream, _, _ in sink.messages]
    assert sorted({*names}) == ["arm/1/angle", "base/end", "base/odom", "broker"]
    assert names.count("base/odom") == 1, "no filter is subscribed that another one covers"


def test_a_broker_that_is_killed_and_started_again(broker: Mosquitto) -> None:
    with subscribed(broker, topics=(MqttTopic("t"),)) as sink:
        with publisher(broker) as peer:
            peer.publish("t", NUMBER % 1, qos=1)
            sink.wait_for("t", 1)
        broker.kill()
        happened(sink, "mqtt_lost")
        happened(sink, "mqtt_missing")
        broker.start()
        happened(sink, "mqtt_connected", 2)
        with publisher(broker) as peer:
            peer.publish("t", NUMBER % 2, qos=1)
            sink.wait_for("t", 2)
    assert ways(sink, "t") == ["up", "down", "up", "down"]
    assert kinds(sink).count("mqtt_missing") == 1, "the same error is told once"
    states = [json.loads(row)["connected"] for row in sink.of("broker")]
    assert False in states[:-1] and True in states


def repeated(sink: MemorySink, times: int) -> None:
    wait_until(lambda: total(sink, "repeated") == times, f"{times} came again")


BACK = {2: 2, 3: 4, 4: 5}
"""Messages that are delivered again, by the number of the connection."""


def test_a_retained_message_is_recorded_once(broker: Mosquitto) -> None:
    """Each subscription gets it; it comes again only when it has changed."""
    with publisher(broker) as peer:
        peer.publish("map", '"old"', qos=1, retain=True).wait_for_publish(PATIENCE_S)
        with subscribed(broker) as sink:
            sink.wait_for("map", 1)
            peer.publish("map", '"old"', qos=1, retain=True)
            peer.publish("speed", "1", qos=1, retain=True)
            sink.wait_for("map", 2)
            sink.wait_for("speed", 1)
            name = source.Config(**broker.block).client_name + "_mqtt"
            for round_ in (2, 3, 4):
                with publisher(broker, name=name):  # it takes the box's place
                    happened(sink, "mqtt_lost", round_ - 1)
                    if round_ == 4:
                        peer.publish("map", '"new"', qos=1, retain=True)
                happened(sink, "mqtt_connected", round_)
                repeated(sink, BACK[round_])
            sink.wait_for("map", 3)
            happened(sink, "mqtt_unstable")
    assert sink.of("map") == [b'"old"', b'"old"', b'"new"'] and sink.of("speed") == [b"1"]
    assert {topic.latched for topic in sink.topics if topic.name in ("map", "speed")} == {True}


def test_hostile_payloads_are_counted_and_the_rest_goes_on(broker: Mosquitto) -> None:
    chance = random.Random(3)
    topics = (MqttTopic("good", type="json"), MqttTopic("any/#"))
    with subscribed(broker, topics=topics) as sink, publisher(broker) as peer:
        for number in range(200):
            name = f"any/{chr(chance.randrange(64, 0xD7FF))}"
            peer.publish(name, b"\xff" + chance.randbytes(chance.randrange(300)), qos=1)
            peer.publish("any/deep", b"[" * 5000, qos=1)
            peer.publish("good", NUMBER % number, qos=1)
        peer.publish("any/long", bytes(2_000_000), qos=1)
        sink.wait_for("good", 200)
        sink.wait_for("any/long", 1)
        wait_until(lambda: total(sink, "not_json") == 401, "all are counted")
    assert numbers(sink, "good") == list(range(200))
    assert kinds(sink) == ["mqtt_connected"]


def test_topics_without_an_end_are_bounded(
    broker: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source, "_MOST_TOPICS", 10)
    topics = (MqttTopic("listed"), MqttTopic("any/+"))
    with subscribed(broker, topics=topics) as sink, publisher(broker) as peer:
        for number in range(50):
            peer.publish(f"any/{number}", "1", qos=1)
        peer.publish("listed", "1", qos=1)
        sink.wait_for("listed", 1)
        wait_until(lambda: total(sink, "left_out") == 41, "the others are counted")
    assert kinds(sink) == ["mqtt_connected", "mqtt_many_topics"]


class RawBroker:
    """A broker of raw bytes: what it does with each connection is given, one after the other."""

    def __init__(self, *answers: Callable[[socket.socket], None]) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.block: dict[str, Any] = {"broker": f"127.0.0.1:{self.listener.getsockname()[1]}"}
        self._answers = answers
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        for number in range(1000):
            try:
                connection, _ = self.listener.accept()
            except OSError:
                return
            with connection, suppress(OSError):
                self._answers[min(number, len(self._answers) - 1)](connection)


ACCEPTED_5, ACCEPTED_3 = b"\x20\x03\x00\x00\x00", b"\x20\x02\x00\x00"


def packet(kind: int, body: bytes) -> bytes:
    assert len(body) < 128
    return bytes([kind, len(body)]) + body


def subscribe_id(connection: socket.socket) -> bytes:
    """Read up to SUBSCRIBE; return its packet id."""
    data = b""
    while not data.startswith(b"\x82"):
        data = connection.recv(4096)
    return data[2:4]


def test_bytes_that_are_no_mqtt_end_only_the_connection() -> None:
    chance = random.Random(5)

    def nonsense(connection: socket.socket) -> None:
        connection.recv(4096)
        connection.sendall(ACCEPTED_5 + chance.randbytes(2000))
        connection.recv(4096)

    def throws_out(connection: socket.socket) -> None:
        connection.recv(4096)
        connection.sendall(ACCEPTED_5 + packet(0xE0, b"\x8e\x00"))
        connection.recv(4096)

    def good(connection: socket.socket) -> None:
        connection.recv(4096)
        connection.sendall(ACCEPTED_5)
        number = subscribe_id(connection)
        connection.sendall(packet(0x90, number + b"\x00\x01"))
        connection.sendall(packet(0x30, b"\x00\x02\xff\xfe\x00x") + packet(0x30, b"\x00\x01t\x007"))
        while connection.recv(4096):
            pass

    raw = RawBroker(nonsense, nonsense, throws_out, good)
    with observe(source.Source(source.Config(**raw.block), "mqtt")) as sink:
        assert sink.wait_for("t", 1) == [b"7"]
        wait_until(lambda: total(sink, "malformed") >= 1, "a name that is no text is counted")
    raw.listener.close()
    assert "another client has the name" in texts(sink, "mqtt_lost")[-1]


def test_a_broker_of_mqtt_3() -> None:
    def refuses(connection: socket.socket) -> None:
        connection.recv(4096)
        connection.sendall(b"\x20\x02\x00\x01")

    def accepts(connection: socket.socket) -> None:
        connect = connection.recv(4096)
        assert connect[8] == 4, "version 3.1.1"
        connection.sendall(ACCEPTED_3)
        connection.sendall(packet(0x90, subscribe_id(connection) + b"\x01"))
        connection.sendall(packet(0x31, b"\x00\x01t7"))
        while connection.recv(4096):
            pass

    raw = RawBroker(refuses, accepts)
    with observe(source.Source(source.Config(**raw.block), "mqtt")) as sink:
        assert sink.wait_for("t", 1) == [b"7"]
    raw.listener.close()
    assert "does not speak MQTT 5" in texts(sink, "mqtt_missing")[0]
    assert "MQTT 3.1.1" in texts(sink, "mqtt_connected")[0]


def test_a_user_who_is_refused(tmp_path: Path) -> None:
    with mosquitto(tmp_path, "allow_anonymous false") as broker:
        config = source.Config(**broker.block, username="u", password="swordfish")
        with observe(source.Source(config, "mqtt")) as sink:
            happened(sink, "mqtt_missing")
    assert "Not authorized" in texts(sink, "mqtt_missing")[0]
    assert "swordfish" not in repr(sink.events)


def test_tls_with_the_right_authority_only(tmp_path: Path) -> None:
    own, other = tmp_path / "own", tmp_path / "other"
    for folder in (own, other):
        folder.mkdir()
        certificates.make(folder, ["127.0.0.1"], time.time_ns())
    files = certificates.CertificateFiles(own)
    lines = (f"certfile {files.server}", f"keyfile {files.server_key}", "user root")
    with mosquitto(tmp_path, *lines) as broker:
        address = f"mqtts://127.0.0.1:{broker.port}"
        for folder, kind in ((own, "mqtt_connected"), (other, "mqtt_missing")):
            authority = str(certificates.CertificateFiles(folder).authority)
            config = source.Config(broker=address, ca_file=authority)
            with observe(source.Source(config, "mqtt")) as sink:
                happened(sink, kind)
    assert "CERTIFICATE_VERIFY_FAILED" in texts(sink, "mqtt_missing")[0]
    missing = source.Config(broker=address, ca_file=str(tmp_path / "no.pem"))
    with pytest.raises(AmberboxError, match="there is no file"):
        source.Source(missing, "mqtt").run(MemorySink(), threading.Event())


def connection_state(state: str, number: int = 1) -> str:
    return json.dumps({"headerId": number, "timestamp": "2026-01-01T00:00:00Z",
                       "connectionState": state})  # fmt: skip


def test_a_vehicle_of_vda_5050(broker: Mosquitto) -> None:
    """Missing headerIds are counted; its connection, and its last will, are its link."""
    options = {"vda5050": Vda5050Options(manufacturer="ACME")}
    will = (f"{VEHICLE}/connection", connection_state("CONNECTIONBROKEN"))
    with subscribed(broker, **options) as sink, publisher(broker) as other:
        with publisher(broker, will=will) as vehicle:
            vehicle.publish(will[0], connection_state("ONLINE"), qos=1, retain=True)
            for number in (1, 2, 5, 6, 1, 2):
                vehicle.publish(f"{VEHICLE}/state", json.dumps({"headerId": number}), qos=1)
            sink.wait_for(f"{VEHICLE}/state", 6)
            other.publish("uagv/v2/OTHER/1/state", "{}", qos=1)
            other.publish(f"{VEHICLE}/order", "{}", qos=1)
            cut: Any = vehicle.socket()  # as if it had been switched off
            cut.shutdown(socket.SHUT_RDWR)
            happened(sink, "vda5050_connection", 2)
        other.publish(will[0], connection_state("ONLINE"), qos=1, retain=True)
        other.publish(f"{VEHICLE}/state", '{"headerId": 3}', qos=1)
        sink.wait_for(f"{VEHICLE}/state", 7)
        other.publish(will[0], b"\xff", qos=1)
        sink.wait_for(f"{VEHICLE}/connection", 4)
        wait_until(lambda: total(sink, "malformed") == 1, "what is no state is counted")
    assert texts(sink, "vda5050_connection") == [
        f"ACME/0007 is {s}" for s in ("ONLINE", "CONNECTIONBROKEN", "ONLINE")
    ]
    assert [(topic, peer, count) for topic, peer, _, _, count, _ in sink.losses] == [
        (f"{VEHICLE}/state", "ACME/0007", 2)
    ]
    links = [link[:4] for link in sink.links if link[1] == f"{VEHICLE}/state"]
    assert links == [
        ("up", f"{VEHICLE}/state", "ACME/0007", ""),
        ("down", f"{VEHICLE}/state", "ACME/0007", "the vehicle is CONNECTIONBROKEN"),
        ("up", f"{VEHICLE}/state", "ACME/0007", ""),
        ("down", f"{VEHICLE}/state", "ACME/0007", "stopped"),
    ]
    assert {topic.name for topic in sink.topics} == {
        "broker", f"{VEHICLE}/state", f"{VEHICLE}/connection",
    }  # fmt: skip


@pytest.mark.skipif(os.geteuid() != 0, reason="only root makes networks")
def test_a_network_that_is_cut_for_10_s(tmp_path: Path) -> None:
    """The gap begins when the broker was last known to be there; the missing are counted."""
    with cable() as net:
        prefix = ["ip", "netns", "exec", net.robot]
        broker = Mosquitto(tmp_path, port=1883, prefix=prefix, address=ROBOT)
        broker.start(waits=False)
        options = {"topics": (MqttTopic("t", sequence="n"),), "keepalive_s": 2}
        config = source.Config(**broker.block | options)
        try:
            with observe(SourceWithin(source.Source(config, "mqtt"), net.box)) as sink:
                happened(sink, "mqtt_connected")

                def publish(first: int, last: int) -> None:
                    with publisher(broker) as peer:
                        for number in range(first, last):
                            sent = peer.publish("t", NUMBER % number, qos=1)
                        sent.wait_for_publish(PATIENCE_S)

                within(net.robot, lambda: publish(0, 100))
                sink.wait_for("t", 100)
                net.plug("down")
                silent = len(sink.of("broker"))
                happened(sink, "mqtt_lost")
                within(net.robot, lambda: publish(100, 150))
                wait_until(lambda: len(sink.of("broker")) >= silent + 10, "10 s have passed")
                net.plug("up")
                happened(sink, "mqtt_connected", 2)
                within(net.robot, lambda: publish(150, 200))
                sink.wait_for("t", 150)
                wait_until(lambda: total(sink, "lost") == 50, "all are counted")
        finally:
            broker.kill()
    assert ways(sink, "t") == ["up", "down", "up", "down"]
    assert [count for *_, count, _ in sink.losses] == [50]
    down_ns = next(at for way, name, _, _, at in sink.links if (way, name) == ("down", "t"))
    times = [at for stream, _, at in sink.messages if sink.topics[stream].name == "t"]
    assert times[99] <= down_ns < times[100]


def test_the_recorder_records_it(broker: Mosquitto, tmp_path: Path) -> None:
    """A schema that changes in flight; a retained message that is delivered to two runs."""
    folder = tmp_path / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: r1\nstore: {path: store}\n")
    block = {"broker": broker.block["broker"], "vda5050": {"serial": "0007"},
             "topics": [{"name": "map"}, {"name": "changes/#"}]}  # fmt: skip
    (folder / "black_box.yaml").write_text(json.dumps([{"mqtt": block}]))

    def rows(item: str) -> int:
        try:
            return len(amberbox.open(folder).query(item))
        except AmberboxError:
            return 0

    stamp = "2026-01-01T10:00:00.5Z"
    with publisher(broker) as peer:
        peer.publish("map", '{"name": "hall"}', qos=1, retain=True)
        for run in (1, 2):
            with running("record", folder, log=tmp_path / "log"):
                wait_until(lambda: rows("mqtt_broker") > 0, "it runs")
                state = json.dumps({"headerId": run, "timestamp": stamp})

                def is_heard(run: int = run, state: str = state) -> bool:
                    for n in ("1", '"text"', '{"deeper": 1}'):
                        peer.publish("changes/n", f'{{"n": {n}}}', qos=1)
                    peer.publish("changes/n", b"\xffno JSON", qos=1)
                    peer.publish(f"{VEHICLE}/state", state, qos=1)
                    return rows("mqtt_changes_n") > 8 * run

                wait_until(is_heard, "what is sent is recorded")
    record = amberbox.open(folder)
    assert len(record.query("mqtt_map")) == 1
    table = record.query("mqtt_changes_n")
    assert {*table.names} == {"timestamp", "n", "data"}
    assert {"1", "text", '{"deeper":1}', None} == {*table.values("n")}
    times = record.query("mqtt_uagv_v2_ACME_0007_state", ["timestamp"]).values("timestamp")
    assert {int(at) for at in times} == {1_767_261_600_500_000_000}


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"broker": "http://x"}, "broker"),
        ({"broker": "x:99999"}, "broker"),
        ({"broker": "u:p@x"}, "broker"),
        ({"ca_file": "ca.pem"}, "ca_file"),
        ({"broker": "mqtts://x", "cert_file": "a.pem"}, "cert_file"),
        ({"broker": "mqtts://x", "key_file": "a.pem"}, "key_file"),
        ({"password": "x"}, "username"),
        ({"qos": 3}, "qos"),
        ({"keepalive_s": 0}, "keepalive_s"),
        ({"topics": (MqttTopic("a/#/b"),)}, "topics"),
        ({"topics": (MqttTopic("a*"),)}, "topics"),
        ({"exclude": ("a+",)}, "exclude"),
    ],
)
def test_wrong_options(options: dict[str, Any], key: str) -> None:
    assert [found for found, _ in source.Config(**options).check()] == [key]


def test_wrong_options_below() -> None:
    assert [key for key, _ in MqttTopic("a", type="xml", qos=7).check()] == ["type", "qos"]
    vehicle = Vda5050Options(serial="a/b", topics=("+",))
    assert [key for key, _ in vehicle.check()] == ["serial", "topics"]


def test_overlapping_filters_are_noted() -> None:
    topics = [MqttTopic(name) for name in ("a/+", "+/b", "a/#", "c")]
    notes = [what for _, what in source.Config(topics=topics).notes()]
    assert [note.partition(" overlap")[0] for note in notes] == [
        "'a/+' and '+/b'",
        "'+/b' and 'a/#'",
    ]


@pytest.mark.parametrize(
    ("text", "shown", "tls"),
    [("x", "x:1883", False), ("mqtts://x", "x:8883", True), ("[::1]:9", "[::1]:9", False)],
)
def test_addresses(text: str, shown: str, tls: bool) -> None:
    assert (str(broker_address(text)), broker_address(text).tls) == (shown, tls)


@given(st.text(max_size=30))
def test_any_text_is_an_address_and_a_filter_or_an_error(text: str) -> None:
    with suppress(ValueError):
        broker_address(text)
    if not filter_problem(text):
        assert overlap(text, text) and overlap(text, "#")
