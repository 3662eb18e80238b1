"""One publisher of one topic: connects, reads until it ends, tries again with back-off."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from amberbox.blackbox.ros1 import tcpros
from amberbox.blackbox.ros1.framing import Reader
from amberbox.blackbox.ros1.settings import MalformedError, RosError, Settings
from amberbox.blackbox.ros1.tcpros import Publisher
from amberbox.blackbox.ros1.xmlrpc import request_topic
from amberbox.core.clock import NS

ENDED = "the publisher closed the connection"
FAILED = "the recorder failed"


class Owner(Protocol):
    """Whom a link tells what happens to it, from its own thread."""

    def opened(self, link: Link, publisher: Publisher) -> Callable[[bytes, int], None] | None:
        """Take a finished handshake; return where messages go, None to end it."""

    def closed(self, link: Link, reason: str, since_ns: int | None) -> None:
        """Take the end of a connection that ``opened`` accepted, and since when it is dead."""

    def failed(self, link: Link, error: RosError) -> None:
        """Take a failed attempt to connect."""

    def retry_limit_s(self, link: Link) -> float:
        """Return the longest wait between two attempts."""

    def malformed(self, link: Link, error: RosError) -> None:
        """Take data that is not TCPROS; the connection ends and is tried again."""

    def crashed(self, error: Exception) -> None:
        """Take an error that is ours."""


class Link:
    """A thread that keeps one connection. ``peer`` and ``endpoint`` are known once it is open.

    A link is parked while the same process is connected under another address.
    """

    def __init__(
        self, topic: str, uri: str, owner: Owner, settings: Settings, now_ns: Callable[[], int]
    ) -> None:
        self.topic = topic
        self.uri = uri
        self.peer = ""
        self.endpoint: object = None
        self.failures = 0
        self.error = ""
        """Why the last attempt failed; empty once a connection is open."""
        self.is_parked = False
        self.was_unregistered = threading.Event()
        self._owner = owner
        self._settings = settings
        self._now_ns = now_ns
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._sock: socket.socket | None = None
        self._closing = ""
        self._thread = threading.Thread(target=self._run, name=f"ros{topic}", daemon=True)

    def start(self) -> None:
        """Begin to connect."""
        self._thread.start()

    def poke(self) -> None:
        """Try again at once: there is news of this publisher."""
        self.failures = 0
        self.is_parked = False
        self._wake.set()

    def close(self, reason: str) -> None:
        """End the connection and the thread; what has arrived by now is still read."""
        with self._lock:
            self._closing = self._closing or reason
            if self._sock is not None:
                with suppress(OSError):  # the peer may have been faster
                    self._sock.shutdown(socket.SHUT_RDWR)
        self._wake.set()

    def join(self, timeout_s: float) -> None:
        """Wait for the thread to end."""
        if self._thread is not threading.current_thread():
            self._thread.join(timeout_s)

    @property
    def is_closing(self) -> bool:
        """Tell whether ``close`` was called."""
        return bool(self._closing)

    def _run(self) -> None:
        try:
            while not self._closing:
                self._attempt()
                self._pause()
        except Exception as error:
            self._owner.crashed(error)

    def _attempt(self) -> None:
        try:
            host, port = request_topic(self.uri, self.topic, self._settings)
            with tcpros.connect(host, port, self.topic, self._settings) as sock:
                if self._hold(sock):
                    self._serve(sock, tcpros.read_answer(sock, self.uri))
        except RosError as error:
            self.failures += 1
            self.error = error.what
            self._owner.failed(self, error)
        finally:
            self._hold(None)

    def _hold(self, sock: socket.socket | None) -> bool:
        """Let ``close`` reach the socket; False if it came before."""
        with self._lock:
            self._sock = sock
            return not self._closing

    def _serve(self, sock: socket.socket, publisher: Publisher) -> None:
        tcpros.listen_only(sock, self._settings.dead_after_s)
        self.error = ""
        self.peer = publisher.node
        self.endpoint = sock.getpeername()
        deliver = self._owner.opened(self, publisher)
        self.is_parked = deliver is None
        if deliver is None:
            return
        reason: str = FAILED
        since_ns: int | None = None
        try:
            reason, since_ns = self._read(sock, deliver)
        finally:
            self._owner.closed(self, self._closing or reason, since_ns)

    def _read(self, sock: socket.socket, deliver: Callable[[bytes, int], None]) -> tuple[str, int]:
        reader = Reader(sock, self._settings.message_limit, self._now_ns)
        self.failures += 1  # until the connection has been of use
        try:
            reader.run(deliver)
        except MalformedError as error:
            self._owner.malformed(self, error)
            return f"malformed data: {error.what}", self._now_ns()
        except OSError as error:
            self._count_use(reader)
            return f"connection lost: {error.strerror}", self._last_heard_ns(reader)
        self._count_use(reader)
        return ENDED, self._now_ns()

    def _count_use(self, reader: Reader) -> None:
        if reader.has_read:
            self.failures = 0

    def _last_heard_ns(self, reader: Reader) -> int:
        """Tell when the peer was alive at the latest: its data or its answer to a probe."""
        silence_ns = round((self._settings.dead_after_s + 1) * NS)
        return max(reader.last_ns, self._now_ns() - silence_ns)

    def _pause(self) -> None:
        longest_s = self._owner.retry_limit_s(self)
        delay_s = self._settings.first_retry_s * 2.0 ** min(self.failures, 16)
        self._wake.wait(None if self.is_parked else min(delay_s, longest_s))
        self._wake.clear()
