"""Results of probes over ZeroMQ, for a box that is another computer than the robot's."""

from __future__ import annotations

import json
import re
import threading
from types import TracebackType

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.probe import ProbeOrder
from amberbox.monitoring.probing.probe import Row

PORT = 5561
HERE = f"tcp://127.0.0.1:{PORT}"
"""Where results are published unless said otherwise: only this computer can read them."""

_ENDPOINT = re.compile(r"tcp://(?P<host>\*|[\w.-]+|\[[0-9A-Fa-f:]+\]):(?P<port>\d{1,5})|ipc://.+")


def is_open(endpoint: str) -> bool:
    """Tell whether others than this computer can read what is published there.

    Raises UsageError if the address is none.
    """
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or (found["port"] and not int(found["port"]) < 65536):
        raise UsageError(f"'{endpoint}' is no address to publish at", f"such as tcp://*:{PORT}")
    host = found["host"]
    return host is not None and host != "localhost" and not host.startswith(("127.", "[::1]"))


class Publisher:
    """Publishes each row as two frames, its topic and JSON, as the source ``zmq`` reads them."""

    def __init__(self, endpoint: str) -> None:
        """Bind the address; raise AmberboxError if it cannot be had."""
        import zmq

        is_open(endpoint)
        self._lock = threading.Lock()  # a socket is for one thread at a time
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        self._socket.ipv6 = "[" in endpoint
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self.close()
            hint = "is another 'amberbox probe' running? choose another port"
            raise AmberboxError(f"cannot publish at {endpoint}: {error.strerror}", hint) from error

    @property
    def endpoint(self) -> str:
        """The address that is bound, with the port that was chosen for ``:0``."""
        import zmq

        return self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def put(self, order: ProbeOrder, row: Row) -> None:
        """Publish a row; never waits, and a reader that is too slow misses rows."""
        frames = [order.topic.encode(), encode(row)]
        with self._lock:
            if not self._socket.closed:
                self._socket.send_multipart(frames)

    def close(self) -> None:
        """Stop publishing."""
        with self._lock:
            self._socket.close(linger=100)
        self._context.term()

    def __enter__(self) -> Publisher:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def encode(row: Row) -> bytes:
    """Write a row as JSON on one line."""
    return json.dumps(row, ensure_ascii=False, allow_nan=False).encode()
