"""A small ROS 1 network without ROS: a master and publishers that speak the real protocols."""

from __future__ import annotations

import socket
import struct
import threading
import xmlrpc.client
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from socketserver import ThreadingMixIn
from typing import Any
from xmlrpc.server import SimpleXMLRPCServer

from amberbox.blackbox.sources.ros1.tcpros import encode_header
from amberbox.testing.clock import PATIENCE_S

_LENGTH = struct.Struct("<I")


class _Server(ThreadingMixIn, SimpleXMLRPCServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Stay silent when a caller breaks off."""


def _serve(functions: Mapping[str, Callable[..., Any]], port: int = 0) -> _Server:
    server = _Server(("127.0.0.1", port), logRequests=False, allow_none=True)
    for name, function in functions.items():
        server.register_function(function, name)
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    return server


def _stop(server: _Server) -> None:
    server.shutdown()
    server.server_close()


class RosMaster:
    """Keeps who publishes and subscribes what; announces changes to subscribers.

    With ``announces`` False the notices are lost, as with a master whose workers hang.
    """

    def __init__(self, port: int = 0, announces: bool = True) -> None:
        self.publishers: dict[str, dict[str, str]] = {}
        self.subscribers: dict[str, dict[str, str]] = {}
        self.services: dict[str, str] = {}
        self.types: dict[str, str] = {}
        self.parameters: dict[str, Any] = {}
        self.calls: list[str] = []
        self.announces = announces
        self._server = _serve(self._functions(), port)
        self.port = int(self._server.server_address[1])
        self.uri = f"http://127.0.0.1:{self.port}/"

    def stop(self) -> None:
        """Vanish without a word, as after ``kill -9``."""
        _stop(self._server)

    def register(self, topic: str, node: str, uri: str) -> None:
        """Add a publisher and notify the subscribers."""
        self.publishers.setdefault(topic, {})[node] = uri
        self._announce(topic)

    def unregister(self, topic: str, node: str) -> None:
        """Remove a publisher and notify the subscribers."""
        self.publishers.get(topic, {}).pop(node, None)
        self._announce(topic)

    def _functions(self) -> dict[str, Callable[..., Any]]:
        return {
            "getSystemState": self._state,
            "getTopicTypes": self._topic_types,
            "lookupNode": self._lookup,
            "registerSubscriber": self._subscribe,
            "unregisterSubscriber": self._unsubscribe,
            "registerPublisher": self._publish,
            "unregisterPublisher": self._unpublish,
            "lookupService": self._look_up_service,
            "getParam": lambda caller, name: (1, "", self.parameters),
        }

    def _announce(self, topic: str) -> None:
        if not self.announces:
            return
        uris = list(self.publishers.get(topic, {}).values())
        for subscriber in list(self.subscribers.get(topic, {}).values()):
            with suppress(OSError):
                xmlrpc.client.ServerProxy(subscriber).publisherUpdate("/master", topic, uris)

    def _state(self, caller: str) -> Any:
        self.calls.append("getSystemState")
        tables = (self.publishers, self.subscribers)
        state = [[[t, list(n)] for t, n in table.items() if n] for table in tables]
        return 1, "", [*state, [[name, ["/server"]] for name in self.services]]

    def _topic_types(self, caller: str) -> Any:
        self.calls.append("getTopicTypes")
        return 1, "", [[topic, self.types.get(topic, "*")] for topic in self.publishers]

    def _lookup(self, caller: str, node: str) -> Any:
        self.calls.append("lookupNode")
        for nodes in [*self.publishers.values(), *self.subscribers.values()]:
            if node in nodes:
                return 1, "", nodes[node]
        return -1, "unknown node", ""

    def _subscribe(self, caller: str, topic: str, kind: str, uri: str) -> Any:
        self.calls.append("registerSubscriber")
        self.subscribers.setdefault(topic, {})[caller] = uri
        return 1, "", list(self.publishers.get(topic, {}).values())

    def _publish(self, caller: str, topic: str, kind: str, uri: str) -> Any:
        self.calls.append("registerPublisher")
        self.types[topic] = kind
        self.register(topic, caller, uri)
        return 1, "", list(self.subscribers.get(topic, {}).values())

    def _unpublish(self, caller: str, topic: str, uri: str) -> Any:
        self.calls.append("unregisterPublisher")
        self.unregister(topic, caller)
        return 1, "", 1

    def _look_up_service(self, caller: str, name: str) -> Any:
        self.calls.append("lookupService")
        if name in self.services:
            return 1, "", self.services[name]
        return -1, "unknown service", ""

    def _unsubscribe(self, caller: str, topic: str, uri: str) -> Any:
        self.calls.append("unregisterSubscriber")
        return 1, "", int(self.subscribers.get(topic, {}).pop(caller, None) is not None)


@dataclass
class RosTopic:
    """What a publisher offers: the connection header's fields, and who is connected."""

    type: str = "std_msgs/String"
    definition: str = "string data\n"
    md5sum: str = "992ce8a1687cec8c8bd883ec73ca41d1"
    latching: bool = False
    last: bytes | None = None
    error: str = ""
    connections: list[socket.socket] = field(default_factory=list)


class RosPublisher:
    """One node that publishes topics; ``kill`` it, ``leave`` cleanly, or send any bytes."""

    def __init__(self, node: str, topics: Mapping[str, RosTopic], master: RosMaster | None) -> None:
        self.node = node
        self.topics = dict(topics)
        self.requests: list[dict[str, str]] = []
        self._master = master
        self._changed = threading.Condition()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._api = _serve({"requestTopic": self._request, "getPublications": self._publications})
        self.uri = f"http://127.0.0.1:{self._api.server_address[1]}/"
        threading.Thread(target=self._accept, daemon=True).start()
        for topic in self.topics if master else ():
            self.announce(topic)

    def announce(self, topic: str) -> None:
        """Register a topic with the master."""
        if self._master is not None:
            self._master.types[topic] = self.topics[topic].type
            self._master.register(topic, self.node, self.uri)

    def publish(self, topic: str, *messages: bytes) -> None:
        """Send messages to everybody who is connected."""
        offered = self.topics[topic]
        with self._changed:  # who comes now gets the latched message once
            offered.last = messages[-1] if offered.latching else None
            connections = list(offered.connections)
        _send(connections, b"".join(_LENGTH.pack(len(m)) + m for m in messages))

    def send(self, topic: str, data: bytes) -> None:
        """Send bytes unchanged."""
        with self._changed:
            connections = list(self.topics[topic].connections)
        _send(connections, data)

    def wait_for_subscribers(self, topic: str, count: int = 1) -> None:
        """Wait until so many connections are open; raise TimeoutError."""
        with self._changed:
            connections = self.topics[topic].connections
            if not self._changed.wait_for(lambda: len(connections) >= count, PATIENCE_S):
                raise TimeoutError(f"{len(connections)} of {count} subscribers")

    def hang_up(self, topic: str) -> None:
        """Close the connections of a topic."""
        with self._changed:
            connections = self.topics[topic].connections
            while connections:
                connections.pop().close()

    def kill(self) -> None:
        """Vanish without a word, as after ``kill -9``: the master keeps the registration."""
        with suppress(OSError):  # else the thread that waits would still let one in
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        _stop(self._api)
        for topic in self.topics:
            self.hang_up(topic)

    def leave(self) -> None:
        """Exit cleanly: unregister, then close."""
        for topic in self.topics if self._master else ():
            assert self._master is not None
            self._master.unregister(topic, self.node)
        self.kill()

    def _request(self, caller: str, topic: str, protocols: Sequence[Sequence[str]]) -> Any:
        if topic not in self.topics:
            return -1, f"Not a publisher of [{topic}]", []
        return 1, "", ["TCPROS", *self._listener.getsockname()]

    def _publications(self, caller: str) -> Any:
        return 1, "", [[topic, offered.type] for topic, offered in self.topics.items()]

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                with suppress(OSError, struct.error):  # it has gone again
                    self._welcome(connection)

    def _welcome(self, connection: socket.socket) -> None:
        length = _LENGTH.unpack(connection.recv(4, socket.MSG_WAITALL))[0]
        request = _fields(connection.recv(length, socket.MSG_WAITALL))
        self.requests.append(request)
        offered = self.topics[request["topic"]]
        with self._changed:  # who has the header gets what is sent from now on
            connection.sendall(encode_header(self._answer(offered)))
            if offered.error:
                connection.close()
                return
            if offered.last is not None:
                connection.sendall(_LENGTH.pack(len(offered.last)) + offered.last)
            offered.connections.append(connection)
            self._changed.notify_all()

    def _answer(self, offered: RosTopic) -> dict[str, str | bytes]:
        if offered.error:
            return {"error": offered.error}
        return {
            "callerid": self.node,
            "type": offered.type,
            "md5sum": offered.md5sum,
            "message_definition": offered.definition,
            "latching": "1" if offered.latching else "0",
        }


def _send(connections: Sequence[socket.socket], data: bytes) -> None:
    for connection in connections:
        connection.sendall(data)


def _fields(body: bytes) -> dict[str, str]:
    fields, at = {}, 0
    while at < len(body):
        end = at + 4 + _LENGTH.unpack_from(body, at)[0]
        name, _, value = body[at + 4 : end].decode().partition("=")
        fields[name] = value
        at = end
    return fields
