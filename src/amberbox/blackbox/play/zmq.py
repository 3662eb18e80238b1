"""Plays JSON and msgpack messages over ZeroMQ, in two frames: topic and message."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Topic

ENDPOINT = "tcp://127.0.0.1:5560"
_PATIENCE_S = 5.0  # when no subscriber takes anything for so long, it is not waited for
_RETRY_S = 0.001
_QUEUE = 10_000  # messages that wait for a slow subscriber
_MOST_PREFIXES = 1000
_LINGER_MS = 5000


@dataclass
class ZmqTarget:
    """A publisher that subscribers connect to; it knows what they subscribe to."""

    endpoint: str = ENDPOINT
    stop: threading.Event = field(default_factory=threading.Event)
    _context: Any = None
    _socket: Any = None
    _prefixes: set[bytes] = field(default_factory=set)
    _dropped: int = 0
    _may_drop: bool = False

    def refused(self, topic: Topic) -> str:
        """Return why a topic cannot be played over ZeroMQ; empty if it can."""
        if topic.message_encoding in ("json", "msgpack"):
            return ""
        return f"its messages ({topic.message_encoding or 'raw'}) are neither JSON nor msgpack"

    def open(self, topics: Sequence[Topic]) -> None:
        """Bind the endpoint; raises AmberboxError when that is not possible."""
        try:
            import zmq
        except ImportError:
            raise UsageError("pyzmq is not installed", "pip install amberbox[zmq]") from None
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.XPUB)  # a PUB socket does not tell what it drops
        self._socket.xpub_nodrop = True
        self._socket.sndhwm = _QUEUE
        try:
            self._socket.bind(self.endpoint)
        except zmq.ZMQError as error:
            what = f"cannot publish at {self.endpoint}: {error.strerror}"
            raise AmberboxError(what, "name another address: --to zmq=tcp://*:PORT") from error

    def is_heard(self) -> bool:
        """Return whether there is a subscription."""
        self._take_subscriptions()
        return bool(self._prefixes)

    def _take_subscriptions(self) -> None:
        import zmq

        while True:
            try:
                frame = self._socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                return
            if frame[:1] == b"\x01" and len(self._prefixes) < _MOST_PREFIXES:
                self._prefixes.add(frame[1:])
            elif frame[:1] == b"\x00":
                self._prefixes.discard(frame[1:])

    def send(self, topic: Topic, data: bytes, *, patient: bool) -> int:
        """Send a message; return 1 where anybody has subscribed to the topic."""
        import zmq

        frames = [topic.name.encode(), data]
        self._take_subscriptions()
        end_s = time.monotonic() + (_PATIENCE_S if patient else 0.0)
        while not self._may_drop:
            try:
                self._socket.send_multipart(frames, zmq.NOBLOCK)
            except zmq.Again:
                if time.monotonic() >= end_s or self.stop.wait(_RETRY_S):
                    self._socket.xpub_nodrop, self._may_drop = False, True
            else:
                break
        else:  # subscribers that have no room lose messages from now on, which ZeroMQ does not tell
            self._dropped += 1
            self._socket.send_multipart(frames, zmq.NOBLOCK)
        return int(any(frames[0].startswith(prefix) for prefix in self._prefixes))

    def set_clock(self, at_ns: int) -> None:
        """Do nothing: ZeroMQ has no clock."""

    def dropped(self) -> int:
        """Return how many messages may not have reached all subscribers.

        Counts all that were sent after a subscriber had no room for one.
        """
        return self._dropped

    def close(self) -> None:
        """Wait until everything is sent, within limits, and free the endpoint."""
        if self._context is not None:
            self._context.destroy(linger=0 if self.stop.is_set() else _LINGER_MS)
            self._context = None
