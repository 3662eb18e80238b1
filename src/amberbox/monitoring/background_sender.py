"""Sends the newest message to a peer in a thread of its own, so that no peer delays the watcher."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple, Protocol

from amberbox.core.errors import AmberboxError
from amberbox.core.pacing import Backoff

Message = Mapping[str, Any]

CHECK_S = 1.0
_REPORT_S = 60.0  # how often dropped messages are reported
_END_S = 1.0
_LONGEST = 500  # characters of an error, which a peer may have written


class PeerConnection(Protocol):
    """A connection to a peer; it belongs to the thread that made it."""

    def send(self, message: Message) -> None:
        """Send a message; raises an error when the connection is lost."""

    def check(self) -> None:
        """Raise an error when the connection is lost; called every second."""

    def dropped(self) -> int:
        """Return how many messages subscribers have not taken in time."""

    def close(self) -> None:
        """End the connection."""


Connect = Callable[[Callable[[], bool]], PeerConnection]
"""Connects to the peer, unless the function that is passed returns true."""


class SenderEvent(NamedTuple):
    """What happened to a connection, for an event in the record."""

    kind: str
    text: str


@dataclass
class BackgroundSender:
    """Sends messages to ``place``; it connects by itself, and again after every error.

    Only the newest message waits: while a peer hangs, older ones are dropped and counted.
    """

    place: str
    connect: Connect
    superseded: int = 0
    _waiting: Message | None = None
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _stop: threading.Event = field(default_factory=threading.Event)
    _events: SimpleQueue[SenderEvent] = field(default_factory=SimpleQueue)
    _trouble: str | None = None
    _is_connected: bool = False
    _reported: int = 0
    _thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to connect."""
        self._thread = threading.Thread(target=self._run, name=self.place, daemon=True)
        self._thread.start()

    def put(self, message: Message) -> None:
        """Send a message as soon as the peer takes it; never waits."""
        with self._changed:
            if self._waiting is not None and self._is_connected:
                self.superseded += 1
            self._waiting = message
            self._changed.notify_all()

    def events(self) -> list[SenderEvent]:
        """Return what has happened since the last call."""
        found = []
        while True:
            try:
                found.append(self._events.get_nowait())
            except Empty:
                return found

    def close(self) -> None:
        """End the connection; a peer that hangs is left behind."""
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(_END_S)

    def _run(self) -> None:
        backoff = Backoff(least_s=CHECK_S, most_s=10.0)
        while not self._stop.is_set():
            try:
                connection = self.connect(self._stop.is_set)
                try:
                    self._connected()
                    backoff.succeeded()
                    self._send_on(connection)
                finally:
                    self._is_connected = False
                    connection.close()
            except Exception as error:  # whatever a peer does, the next attempt may succeed
                self._failed(error)
            self._stop.wait(backoff.failed())

    def _connected(self) -> None:
        self._is_connected, self._trouble = True, None
        self._events.put(SenderEvent("publish_connected", f"publishes at {self.place}"))

    def _failed(self, error: Exception) -> None:
        """Report an error once, until it is another one."""
        if isinstance(error, AmberboxError):
            text = f"{error.what} (hint: {error.hint})" if error.hint else error.what
        else:
            text = f"{type(error).__name__}: {error}"
        if text != self._trouble and not self._stop.is_set():
            self._trouble = text
            text = f"cannot publish at {self.place}, it is tried again: {text[:_LONGEST]}"
            self._events.put(SenderEvent("publish_failed", text))

    def _send_on(self, connection: PeerConnection) -> None:
        checked_s = reported_s = time.monotonic()
        while not self._stop.is_set():
            with self._changed:
                if self._waiting is None:
                    self._changed.wait(CHECK_S)
                message, self._waiting = self._waiting, None
            if message is not None:
                connection.send(message)
            now_s = time.monotonic()
            if now_s - checked_s >= CHECK_S:
                connection.check()
                checked_s = now_s
            dropped = connection.dropped() + self.superseded
            if dropped > self._reported and now_s - reported_s >= _REPORT_S:
                text = f"{self.place}: {dropped - self._reported} messages were not taken in time"
                self._events.put(SenderEvent("publish_dropped", text))
                self._reported, reported_s = dropped, now_s
