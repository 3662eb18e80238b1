"""Serves topics to ROS 1 subscribers over TCPROS, one thread for all connections.

A subscriber that hangs holds up nobody: its queue is bounded and loses the oldest messages, and
whatever a peer sends is limited in size and time.
"""

from __future__ import annotations

import selectors
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

from amberbox.blackbox.sources.ros1.deadline import Deadline
from amberbox.blackbox.sources.ros1.master import RosError, TcprosError, global_name, is_global_name
from amberbox.blackbox.sources.ros1.message_type import MessageType, message_type
from amberbox.blackbox.sources.ros1.tcpros import decode_header, encode_header
from amberbox.core.errors import AmberboxError

MOST_CONNECTIONS = 64
HEADER_BYTES = 1 << 20
LEARNT_BYTES = 64 << 10  # longest definition that is taken over from a subscriber
HEADER_S = 5.0
MOST_REFUSALS = 20
_DEAD_AFTER_MS = 10_000
_LOOK_S = 0.5
_LENGTH = struct.Struct("<I")


@dataclass
class OfferedTopic:
    """A topic that is served; ``kind`` is None until a subscriber brings the definition.

    ``queue`` messages, of ``queue_bytes`` altogether, wait for a slow subscriber at most.
    """

    name: str
    type: str
    kind: MessageType | None = None
    is_latched: bool = False
    queue: int = 10
    queue_bytes: int = 64 << 20
    last: bytes | None = None
    refused: list[str] = field(default_factory=list)


@dataclass(eq=False)
class _Subscriber:
    """A connection: its handshake until ``topic`` is set, then the messages that wait for it."""

    sock: socket.socket
    end_s: float
    received: bytearray = field(default_factory=bytearray)
    topic: OfferedTopic | None = None
    node: str = ""
    waiting: deque[bytes] = field(default_factory=deque)
    waiting_bytes: int = 0
    begun: memoryview = field(default_factory=lambda: memoryview(b""))
    is_closing: bool = False
    progress_s: float = 0.0
    is_ended: bool = False
    is_hung: bool = False
    """It was waited for in vain, and has taken nothing since."""

    @property
    def is_idle(self) -> bool:
        return not self.waiting and not self.begun

    def is_full(self, size: int = 0) -> bool:
        """Return whether there is no room for a message of a size."""
        topic = self.topic
        return (
            topic is not None
            and bool(self.waiting)
            and (len(self.waiting) >= topic.queue or self.waiting_bytes + size > topic.queue_bytes)
        )

    def add(self, framed: bytes) -> None:
        self.waiting.append(framed)
        self.waiting_bytes += len(framed)

    def take(self) -> bytes:
        """Remove the message that has waited longest."""
        framed = self.waiting.popleft()
        self.waiting_bytes -= len(framed)
        return framed


class Patience(NamedTuple):
    """How long (s) a subscriber is waited for that takes nothing, unless ``stopped``."""

    seconds: float
    stopped: Callable[[], bool]


class TopicServer:
    """Sends what is published to every subscriber that connects, until ``close``."""

    def __init__(
        self, bind_host: str, caller_id: str, most_connections: int = MOST_CONNECTIONS
    ) -> None:
        self._caller_id = caller_id
        self._most_connections = most_connections
        self._topics: dict[str, OfferedTopic] = {}
        self._subscribers: set[_Subscriber] = set()
        self._changed = threading.Condition()
        self._selector = selectors.DefaultSelector()
        self._wake_up, self._woken = socket.socketpair()
        self._listener = socket.create_server((bind_host, 0), backlog=16)
        self.port = int(self._listener.getsockname()[1])
        self.dropped = 0
        self._is_finishing = self._is_closed = False
        for sock in (self._listener, self._woken, self._wake_up):
            sock.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="ros-topics", daemon=True)
        self._thread.start()

    def offer(self, topic: OfferedTopic) -> None:
        """Serve a topic from now on."""
        with self._changed:
            self._topics[topic.name] = topic

    def offered(self) -> Sequence[OfferedTopic]:
        """Return the topics that are served."""
        with self._changed:
            return list(self._topics.values())

    def send(self, topic: str, data: bytes) -> int:
        """Queue a message for every subscriber; return to how many it goes now."""
        framed = _LENGTH.pack(len(data)) + data
        with self._changed:
            self._check()
            offered = self._topics[topic]
            if offered.is_latched:
                offered.last = framed
            taking = [s for s in self._subscribers if s.topic is offered]
            for subscriber in taking:
                self._queue(subscriber, framed)
        self._wake()
        return len(taking)

    def _queue(self, subscriber: _Subscriber, framed: bytes) -> None:
        while subscriber.is_full(len(framed)):
            subscriber.take()
            self.dropped += 1
        subscriber.add(framed)

    def wait_for_room(self, topic: str, size: int, patience: Patience) -> None:
        """Wait until all subscribers of a topic have room for a message of a size.

        One that takes nothing for too long is hung: it is not waited for again before it does.
        """

        def is_late(one: _Subscriber) -> bool:
            return one.topic is not None and one.topic.name == topic and one.is_full(framed)

        framed = _LENGTH.size + size
        self._wait_while(is_late, patience)

    def finish(self, patience: Patience) -> None:
        """Accept nobody any more, send what waits, and wait until subscribers have read all of it.

        A connection ends with the last message; its subscriber closes it once it has read that.
        Without this, subscribers that hear from the master that the node is gone drop the rest.
        Messages that hung subscribers have not taken count as dropped.
        """
        with self._changed:
            self._is_finishing = True
        self._wake()
        self._wait_while(lambda s: s.topic is not None, patience)
        with self._changed:
            self.dropped += sum(len(subscriber.waiting) for subscriber in self._subscribers)

    def _wait_while(self, is_late: Callable[[_Subscriber], bool], patience: Patience) -> None:
        begun_s = time.monotonic()
        with self._changed:
            while late := [s for s in self._subscribers if is_late(s) and not s.is_hung]:
                self._check()
                if patience.stopped():
                    return
                for subscriber in late:
                    since_s = max(begun_s, subscriber.progress_s)
                    subscriber.is_hung = time.monotonic() - since_s > patience.seconds
                self._changed.wait(0.02)

    def _of(self, topic: str) -> Iterator[_Subscriber]:
        return (s for s in self._subscribers if s.topic is not None and s.topic.name == topic)

    def nodes(self, topic: str) -> set[str]:
        """Return the names of the nodes that are connected to a topic."""
        with self._changed:
            self._check()
            return self._nodes(topic)

    def _nodes(self, topic: str) -> set[str]:
        return {s.node for s in self._of(topic)}

    def wait_for(self, topic: str, nodes: set[str], count: int, deadline: Deadline) -> set[str]:
        """Wait for all of these nodes, and so many in all; return those that are connected.

        Raises NoAnswerError only if time is up before ``count`` are connected, and StoppedError.
        """
        with self._changed:
            while not (nodes <= (found := self._nodes(topic)) and len(found) >= count):
                self._check()
                if len(found) >= count and not deadline.left_s():
                    break
                deadline.check(self._missing(topic, found, count))
                self._changed.wait(0.02)
            return found

    def _missing(self, topic: str, found: set[str], count: int) -> str:
        why = self._topics[topic].refused[-1:]
        who = f"{len(found)} of {count} subscribers of {topic} are connected"
        return f"{who}; refused: {why[0]}" if why else who

    def flush(self, topic: str, deadline: Deadline) -> set[str]:
        """Wait until all messages are sent; return the nodes that have not taken theirs in time."""
        with self._changed:
            while late := {s.node for s in self._subscribers if _is_late(s, topic)}:
                if deadline.stopped() or not deadline.left_s():
                    break
                self._changed.wait(0.02)
            return late

    def close(self) -> None:
        """Close all connections and free the port."""
        with self._changed:
            self._is_closed = True
        self._wake()
        self._thread.join(1.0)

    def _check(self) -> None:
        if self._is_closed:
            raise RosError("the topics are no longer served")

    def _wake(self) -> None:
        with suppress(BlockingIOError, OSError):  # a wake-up is on its way, or all is closed
            self._wake_up.send(b"x")

    # From here on in the thread of the server.

    def _run(self) -> None:
        try:
            while not self._is_closed:
                for key, events in self._selector.select(_LOOK_S):
                    self._serve(key, events)
                self._send_all()
                self._end_late_handshakes()
        finally:
            with self._changed:
                self._is_closed = True
                for subscriber in list(self._subscribers):
                    self._close(subscriber)
            self._selector.close()
            for sock in (self._listener, self._woken, self._wake_up):
                sock.close()

    def _serve(self, key: selectors.SelectorKey, events: int) -> None:
        if key.fileobj is self._woken:
            with suppress(BlockingIOError):
                self._woken.recv(4096)
        elif key.fileobj is self._listener:
            self._accept()
        elif events & selectors.EVENT_READ:
            self._receive(key.data)

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:  # the peer is gone again, or no file descriptor is free
            time.sleep(0.01)
            return
        if self._is_finishing or len(self._subscribers) >= self._most_connections:
            sock.close()
            return
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _DEAD_AFTER_MS)
        subscriber = _Subscriber(sock, time.monotonic() + HEADER_S)
        self._selector.register(sock, selectors.EVENT_READ, subscriber)
        with self._changed:
            self._subscribers.add(subscriber)

    def _receive(self, subscriber: _Subscriber) -> None:
        try:
            data = subscriber.sock.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        with self._changed:
            if not data or subscriber.topic is not None:  # a subscriber has nothing more to say
                self._close(subscriber)
                return
            if subscriber.is_closing:
                return
            subscriber.received += data
            try:
                fields = _complete_header(subscriber.received)
                if fields is not None:
                    self._welcome(subscriber, fields)
            except TcprosError as error:
                self._refuse(subscriber, error.what)

    def _welcome(self, subscriber: _Subscriber, fields: dict[str, bytes]) -> None:
        """Check the header of a subscriber; raises TcprosError with what is wrong."""
        texts = {name: value.decode("utf-8", "replace").strip() for name, value in fields.items()}
        subscriber.node = global_name(texts.get("callerid", ""))
        if not is_global_name(subscriber.node) or len(subscriber.node) > 255:
            subscriber.node = ""
            raise TcprosError("the callerid is missing or no name of a node")
        offered = self._topics.get(texts.get("topic", ""))
        if offered is None:
            raise TcprosError(f"{self._caller_id} publishes no such topic")
        wanted, md5 = texts.get("type", "*"), texts.get("md5sum", "")
        if wanted not in ("*", offered.type):
            self._note(offered, f"{subscriber.node} expects messages of {wanted[:100]}")
            raise TcprosError(f"{offered.name} has messages of {offered.type}, not {wanted[:100]}")
        if offered.kind is None:
            definition = fields.get("message_definition", b"").decode("utf-8", "replace")
            offered.kind = self._learnt(offered, md5, definition)
        if md5 not in ("*", offered.kind.md5sum):
            self._note(offered, f"{subscriber.node} has another definition of {offered.type}")
            what = (
                f"md5sums of {offered.type} differ: {offered.kind.md5sum} here, {md5[:100]} there"
            )
            raise TcprosError(what)
        answer = {
            "callerid": self._caller_id,
            "topic": offered.name,
            "type": offered.type,
            "md5sum": offered.kind.md5sum,
            "message_definition": offered.kind.definition,
            "latching": "1" if offered.is_latched else "0",
        }
        subscriber.begun = memoryview(encode_header(answer))
        if offered.last is not None:
            subscriber.add(offered.last)
        subscriber.received.clear()
        subscriber.topic = offered
        self._changed.notify_all()

    def _learnt(self, offered: OfferedTopic, md5: str, definition: str) -> MessageType:
        """Return the type as a subscriber defines it, if its own sum agrees."""
        try:
            if not definition or len(definition) > LEARNT_BYTES:
                raise TcprosError(f"it sent no definition of {offered.type}")
            kind = message_type(offered.type, definition)
            if kind.md5sum != md5:
                raise TcprosError(f"its definition of {offered.type} does not have its md5sum")
        except AmberboxError as error:
            self._note(offered, error.what)
            raise TcprosError(f"{offered.type} is not known here, and {error.what}") from error
        return kind

    def _note(self, offered: OfferedTopic, what: str) -> None:
        if len(offered.refused) < MOST_REFUSALS:
            offered.refused.append(what)
        self._changed.notify_all()

    def _refuse(self, subscriber: _Subscriber, what: str) -> None:
        subscriber.begun = memoryview(encode_header({"error": what}))
        subscriber.is_closing = True

    def _send_all(self) -> None:
        with self._changed:
            for subscriber in list(self._subscribers):
                self._send(subscriber)
                if self._is_finishing:
                    self._end(subscriber)

    def _end(self, subscriber: _Subscriber) -> None:
        """Tell a subscriber that has been sent everything that nothing follows."""
        if subscriber.topic is None:
            self._close(subscriber)
        elif subscriber.is_idle and not subscriber.is_ended and subscriber in self._subscribers:
            subscriber.is_ended, subscriber.progress_s = True, time.monotonic()
            with suppress(OSError):
                subscriber.sock.shutdown(socket.SHUT_WR)

    def _send(self, subscriber: _Subscriber) -> None:
        """Send what the socket takes; wait for the socket if something is left."""
        was_idle, waited = subscriber.is_idle, len(subscriber.waiting)
        try:
            while not subscriber.is_idle:
                if not subscriber.begun:
                    subscriber.begun = memoryview(subscriber.take())
                sent = subscriber.sock.send(subscriber.begun)
                subscriber.begun = subscriber.begun[sent:]
                subscriber.progress_s, subscriber.is_hung = time.monotonic(), False
        except BlockingIOError:
            pass
        except OSError:
            self._close(subscriber)
            return
        if subscriber.is_idle and subscriber.is_closing:
            self._close(subscriber)
            return
        if (subscriber.is_idle and not was_idle) or len(subscriber.waiting) < waited:
            self._changed.notify_all()
        wanted = selectors.EVENT_READ | (0 if subscriber.is_idle else selectors.EVENT_WRITE)
        if self._selector.get_key(subscriber.sock).events != wanted:
            self._selector.modify(subscriber.sock, wanted, subscriber)

    def _end_late_handshakes(self) -> None:
        now_s = time.monotonic()
        with self._changed:
            for subscriber in list(self._subscribers):
                if subscriber.topic is None and now_s > subscriber.end_s:
                    self._close(subscriber)

    def _close(self, subscriber: _Subscriber) -> None:
        if subscriber in self._subscribers:
            self._subscribers.discard(subscriber)
            self._selector.unregister(subscriber.sock)
            subscriber.sock.close()
            self._changed.notify_all()


def _is_late(subscriber: _Subscriber, topic: str) -> bool:
    offered = subscriber.topic
    return offered is not None and offered.name == topic and not subscriber.is_idle


def _complete_header(received: bytearray) -> dict[str, bytes] | None:
    """Return the fields of a header, None while it is incomplete; raise TcprosError."""
    if len(received) < _LENGTH.size:
        return None
    length = _LENGTH.unpack_from(received)[0]
    if length > HEADER_BYTES:
        raise TcprosError(f"a connection header of {length} bytes")
    end = _LENGTH.size + length
    return None if len(received) < end else decode_header(bytes(received[_LENGTH.size : end]))
