"""The XML-RPC server that every ROS 1 node has: other nodes and the master call it.

Every answer is short: a node that does not answer ties up one of the master's three notification
workers.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from http import HTTPStatus
from socketserver import ThreadingMixIn
from typing import Any, Protocol
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

MOST_BYTES = 1 << 20
IDLE_S = 5.0

Answer = tuple[int, str, Any]


class _Handler(SimpleXMLRPCRequestHandler):
    timeout = IDLE_S

    def do_POST(self) -> None:  # noqa: N802 (the name http.server calls)
        length = self.headers.get("content-length", "")
        if not length.isdigit() or int(length) > MOST_BYTES:
            self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
            return
        super().do_POST()

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: requests of other nodes are no events of the robot."""


class _Server(ThreadingMixIn, SimpleXMLRPCServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore callers that break off."""


class PublishedTopics(Protocol):
    """What a node publishes."""

    def address_of(self, topic: str) -> tuple[str, int] | None:
        """Return the host and port where a topic is served; None if it is not published."""

    def topics(self) -> Sequence[tuple[str, str]]:
        """Return the topics that are published, with their types."""


class NodeServer:
    """The XML-RPC server of a node; without ``offered`` it only subscribes."""

    def __init__(
        self,
        bind_host: str,
        port: int,
        master_uri: str,
        on_update: Callable[[str, Sequence[str]], None],
        on_shutdown: Callable[[str], None],
        offered: PublishedTopics | None = None,
    ) -> None:
        self._master_uri = master_uri
        self._offered = offered
        self._on_update = on_update
        self._on_shutdown = on_shutdown
        self._server = _bound(bind_host, port)
        self.port = int(self._server.server_address[1])
        for name, function in self._calls().items():
            self._server.register_function(function, name)
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.2,), name="ros-node", daemon=True
        )

    def start(self) -> None:
        """Answer calls from now on."""
        self._thread.start()

    def close(self) -> None:
        """Stop answering and free the port."""
        self._server.shutdown()
        self._server.server_close()

    def _calls(self) -> dict[str, Callable[..., Answer]]:
        return {
            "publisherUpdate": self._publisher_update,
            "paramUpdate": lambda caller, key, value: (1, "", 0),
            "requestTopic": self._request_topic,
            "getPid": lambda caller: (1, "", os.getpid()),
            "getMasterUri": lambda caller: (1, "", self._master_uri),
            "getPublications": self._publications,
            "getSubscriptions": lambda caller: (1, "", []),
            "getBusInfo": lambda caller: (1, "", []),
            "getBusStats": lambda caller: (1, "", [[], [], []]),
            "shutdown": self._shutdown,
        }

    def _publisher_update(self, caller: str, topic: str, uris: Sequence[str]) -> Answer:
        self._on_update(str(topic), [str(uri) for uri in uris])
        return 1, "", 0

    def _request_topic(self, caller: str, topic: str, protocols: Sequence[Any]) -> Answer:
        if self._offered is None:
            return 0, "amberbox only listens", 0
        address = self._offered.address_of(str(topic))
        if address is None:
            return 0, "not a publisher of this topic", 0
        if not any(isinstance(p, list) and p[:1] == ["TCPROS"] for p in list(protocols)[:16]):
            return 0, "only TCPROS is spoken here", 0
        return 1, "", ["TCPROS", *address]

    def _publications(self, caller: str) -> Answer:
        offered = () if self._offered is None else self._offered.topics()
        return 1, "", [list(topic) for topic in offered]

    def _shutdown(self, caller: str, reason: str = "") -> Answer:
        self._on_shutdown(str(reason))
        return 1, "", 0


def _bound(host: str, port: int) -> _Server:
    """Return a server on the port of the last run if that is free, else on any."""
    try:
        return _Server((host, port), _Handler, logRequests=False, allow_none=True)
    except OSError:
        return _Server((host, 0), _Handler, logRequests=False, allow_none=True)
