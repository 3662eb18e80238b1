"""The bridge's client: what servers do that are wrong, hostile, slow or behind TLS."""

from __future__ import annotations

import base64
import json
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from websockets.sync.server import ServerConnection, serve

from amberbox.blackbox.sources.ros2 import Config, Source, read_graph
from amberbox.blackbox.sources.ros2_transports.bridge import SUBPROTOCOLS, decode_text
from amberbox.blackbox.sources.ros2_transports.websocket import WebSocketError
from amberbox.core.errors import AmberboxError
from amberbox.server.certificates import CertificateFiles, make
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import ObservedSink, observe

INFO = {"op": "serverInfo", "name": "test", "capabilities": []}
COUNT = {
    "id": 1, "topic": "/count", "encoding": "cdr", "schemaName": "std_msgs/msg/Int64",
    "schema": "int64 data\n", "schemaEncoding": "ros2msg",
}  # fmt: skip


def advertise(*channels: dict[str, Any]) -> dict[str, Any]:
    return {"op": "advertise", "channels": list(channels)}


def data(number: int, value: int, *, subscription: int = 1) -> bytes:
    return struct.pack("<BIQ4xq", 1, subscription, 5, value)


@contextmanager
def server(
    *scripts: Callable[[ServerConnection], None], tls: ssl.SSLContext | None = None
) -> Iterator[int]:
    """Serve the n-th connection by the n-th script, further ones by the last."""
    lock, count = threading.Lock(), 0

    def handle(connection: ServerConnection) -> None:
        nonlocal count
        with lock:
            script = scripts[min(count, len(scripts) - 1)]
            count += 1
        script(connection)

    protocols: Any = list(SUBPROTOCOLS[:1])
    made = serve(handle, "127.0.0.1", 0, subprotocols=protocols, ssl=tls, max_size=None)
    threading.Thread(target=made.serve_forever, daemon=True).start()
    try:
        yield made.socket.getsockname()[1]
    finally:
        made.shutdown()


def send(connection: ServerConnection, *frames: Any) -> None:
    for frame in frames:
        connection.send(json.dumps(frame) if isinstance(frame, dict) else frame)


def stay(connection: ServerConnection) -> None:
    """Read until the client goes."""
    for _ in connection:
        pass


def honest(connection: ServerConnection) -> None:
    """Send one message once it is subscribed to."""
    send(connection, INFO, advertise(COUNT))
    for text in connection:
        if json.loads(text)["op"] == "subscribe":
            send(connection, data(1, 7))


def listen(port: int, **more: Any) -> Any:
    return observe(Source(Config(via="bridge", url=f"ws://127.0.0.1:{port}", **more), "ros2"))


def kinds(sink: ObservedSink) -> list[str]:
    return [kind for kind, _, _ in sink.events]


Script = Callable[[ServerConnection], None]
BAD_FRAMES: dict[str, Any] = {
    "no json": "{",
    "no object": "[]",
    "deep": "[" * 100_000,
    "wrong types": json.dumps({"op": "advertise", "channels": [{"id": "x"}]}),
    "huge": b"\1" * 3_000_000,
    "wrong code": json.dumps({"op": "advertise", "channels": 7}),
}


@pytest.mark.parametrize("frame", BAD_FRAMES.values(), ids=BAD_FRAMES)
def test_what_is_not_of_the_protocol_ends_the_connection_and_is_said(frame: Any) -> None:
    def hostile(connection: ServerConnection) -> None:
        send(connection, INFO, frame)
        stay(connection)

    with server(hostile, honest) as port, listen(port, all_topics=True, max_message_mb=1) as sink:
        assert sink.wait_for("/count", 1) == [data(1, 7)[13:]]
        assert kinds(sink) == ["bridge_connected", "bridge_unreachable", "bridge_connected"]


UPGRADE = (
    b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Accept: nonsense\r\n\r\n"
)
ANSWERS: dict[str, bytes] = {
    "nothing": b"",
    "not found": b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n",
    "no HTTP": bytes(range(256)) * 100,
    "endless line": b"HTTP/1.1 101 " + b"x" * 1_000_000,
    "endless head": b"HTTP/1.1 101 Fine\r\n" + b"a: b\r\n" * 100_000,
    "wrong key": UPGRADE,
}


@pytest.mark.parametrize("answer", ANSWERS.values(), ids=ANSWERS)
def test_what_is_no_websocket_is_said_and_tried_again(answer: bytes) -> None:
    listener = socket.create_server(("127.0.0.1", 0))
    asked = threading.Semaphore(0)

    def serve_badly() -> None:
        with suppress(OSError):
            while True:
                connection, _ = listener.accept()
                asked.release()
                with connection, suppress(OSError):
                    connection.recv(10_000)
                    connection.sendall(answer)

    threading.Thread(target=serve_badly, daemon=True).start()
    with listen(listener.getsockname()[1], all_topics=True) as sink:
        assert asked.acquire(timeout=PATIENCE_S) and asked.acquire(timeout=PATIENCE_S)
        wait_until(lambda: kinds(sink) == ["bridge_unreachable"])
    listener.close()


def test_odd_frames_are_left_out_and_the_rest_is_recorded() -> None:
    bomb = "/" + "x" * 100_000
    odd = [
        {**COUNT, "id": -1, "topic": "/negative"}, {**COUNT, "id": 2**40, "topic": "/large"},
        {**COUNT, "id": 5, "topic": bomb}, {**COUNT, "id": 6, "topic": "/a\nb\x1b[2J"},
        {**COUNT, "id": 7, "topic": "/../../etc/passwd"},
    ]  # fmt: skip

    def script(connection: ServerConnection) -> None:
        send(connection, INFO, advertise(*odd), {"op": "unknownToUs", "x": 1}, b"", b"\x01\x02")
        send(connection, {"op": "unadvertise", "channelIds": [99]}, data(1, 0, subscription=77))
        send(connection, {"op": "status", "level": 2, "message": "disk\nfull\x1b[31m"})
        honest(connection)

    with server(script) as port, listen(port, all_topics=True) as sink:
        assert set(sink.wait_for("/count", 1)) == {data(1, 7)[13:]}
        wait_until(lambda: "bridge_status" in kinds(sink))
    texts = {kind: text for kind, text, _ in sink.events}
    assert "disk full" in texts["bridge_status"]
    assert {"bridge_malformed", "bridge_connected"} <= texts.keys()
    assert not {bomb, "/a\nb\x1b[2J"} & {topic for _, topic, *_ in sink.links}


def test_a_subscription_that_came_too_early_and_a_message_that_came_too_late() -> None:
    def script(connection: ServerConnection) -> None:
        send(connection, INFO, advertise(COUNT))
        refusals = ["Unknown channel ID: 1", "Channel 1 is not available"]
        ended = {"op": "unadvertise", "channelIds": [1]}
        for text in connection:
            if json.loads(text)["op"] == "subscribe":
                said = {"op": "status", "level": 1, "message": refusals.pop()} if refusals else None
                send(connection, *([said] if said else [data(1, 7), ended, data(1, 8)]))

    with server(script) as port, listen(port, all_topics=True) as sink:
        assert sink.wait_for("/count", 2) == [data(1, 7)[13:], data(1, 8)[13:]]


@settings(max_examples=200)
@given(st.binary(max_size=200) | st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(
        st.sampled_from(["op", "channels", "id", "topic", "advertise", "schema"]), inner, max_size=4
    ),
    max_leaves=12,
).map(lambda value: json.dumps(value).encode()))  # fmt: skip
def test_text_of_any_kind_is_refused_with_the_one_error(text: bytes) -> None:
    with suppress(WebSocketError):
        decode_text(text)


def test_channels_change_and_go() -> None:
    """The same channel with another definition is another stream; a gap when it goes."""
    text = {**COUNT, "schemaName": "std_msgs/msg/String", "schema": "string data\n"}
    steps: list[str] = []

    def script(connection: ServerConnection) -> None:
        send(connection, INFO, advertise(COUNT))
        for said in map(json.loads, connection):
            steps.append(said["op"])
            if steps == ["subscribe"]:
                send(connection, data(1, 1), advertise(text))
            elif steps[-1] == "subscribe":
                send(connection, data(1, 2), {"op": "unadvertise", "channelIds": [1]})

    with server(script) as port, listen(port, all_topics=True) as sink:
        sink.wait_for("/count", 2)
        wait_until(lambda: not sink.open_links())
        assert [topic.schema and topic.schema.name for topic in sink.topics] == [
            "std_msgs/msg/Int64", "std_msgs/msg/String",
        ]  # fmt: skip
        wait_until(lambda: steps == ["subscribe", "unsubscribe", "subscribe", "unsubscribe"])


def test_definitions_of_all_encodings_travel() -> None:
    binary = base64.b64encode(b"\x0a\x02ab").decode()
    offered = {
        "/json": ("json", "jsonschema", "{}", b"{}"),
        "/proto": ("protobuf", None, binary, b"\x0a\x02ab"),
        "/idl": ("cdr", "omgidl", "struct A { long a; };", b"struct A { long a; };"),
        "/old": ("ros1", None, "int64 data\n", b"int64 data\n"),
        "/odd": ("own", "flatbuffer", "not base 64!", b""),
    }
    channels = [
        {
            "id": number, "topic": topic, "encoding": encoding, "schemaName": "A", "schema": text,
            **({} if kind is None else {"schemaEncoding": kind}),
        }
        for number, (topic, (encoding, kind, text, _)) in enumerate(offered.items())
    ]  # fmt: skip

    def script(connection: ServerConnection) -> None:
        send(connection, INFO, advertise(*channels))
        said = json.loads(connection.recv())
        for subscription in said["subscriptions"]:
            send(connection, struct.pack("<BIQ", 1, subscription["id"], 5) + b"{}")
        stay(connection)

    with server(script) as port, listen(port, all_topics=True) as sink:
        for topic in offered:
            sink.wait_for(topic, 1)
        found = {topic.name: (topic.message_encoding, topic.schema) for topic in sink.topics}
    for topic, (encoding, _, _, definition) in offered.items():
        kept = found[topic]
        assert kept[0] == encoding and kept[1] is not None and kept[1].data == definition


def test_a_definition_that_the_bridge_lacks_is_looked_for() -> None:
    lacking = [{**COUNT, "schema": ""}, {**COUNT, "id": 2, "topic": "/odd", "schema": ""}]
    lacking[1]["schemaName"] = "own/msg/Unknown"

    def script(connection: ServerConnection) -> None:
        send(connection, INFO, advertise(*lacking))
        connection.recv()
        message = b"\0\1\0\0" + struct.pack("<q", 7)
        send(connection, *(struct.pack("<BIQ", 1, number, 5) + message for number in (1, 2)))
        stay(connection)

    with server(script) as port, listen(port, all_topics=True) as sink:
        assert sink.wait_for("/count", 1) and sink.wait_for("/odd", 1)
        texts = {topic.name: topic.schema and topic.schema.data for topic in sink.topics}
    assert texts == {"/count": b"int64 data\n", "/odd": b""}
    assert kinds(sink) == ["bridge_connected", "ros2_no_definition"]


def test_tls_with_an_own_authority(tmp_path: Path) -> None:
    make(tmp_path, ["robot.local"], time.time_ns())
    files = CertificateFiles(tmp_path)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(files.server, files.server_key)
    with server(honest, tls=context) as port:
        at: dict[str, Any] = {
            "url": f"wss://robot.local:{port}",
            "hosts": {"robot.local": "127.0.0.1"},
        }
        for given_authority, is_trusted in ((str(files.authority), True), ("", False)):
            config = Config(via="bridge", all_topics=True, authority=given_authority, **at)
            with observe(Source(config, "ros2")) as sink:
                wait_until(partial(is_decided, sink))
                assert bool(sink.messages) is is_trusted


def is_decided(sink: ObservedSink) -> bool:
    return bool(sink.messages) or "bridge_unreachable" in kinds(sink)


def test_a_graph_that_cannot_be_read() -> None:
    with server(stay) as port, pytest.raises(AmberboxError, match="says nothing"):
        read_graph(Config(via="bridge", url=f"ws://127.0.0.1:{port}", all_topics=True), 0.5)
    with pytest.raises(AmberboxError, match="no connection"):
        read_graph(Config(via="bridge", url="ws://127.0.0.1:9", all_topics=True), 0.5)
