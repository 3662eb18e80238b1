"""A node of a ZRE network that only listens: it is visible, joins groups, and sends no message.

It sends what others need to reach it: beacons, HELLO, JOIN, and PING and its answers. It waits for
no peer: queues to them are short, and what does not fit ends the connection.
"""

from __future__ import annotations

import errno
import socket
import struct
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from amberbox.blackbox.sources.zre import messages
from amberbox.blackbox.sources.zre.interfaces import NetworkInterface, find_interfaces
from amberbox.blackbox.sources.zre.messages import (
    Beacon,
    ZreError,
    ZreMessage,
    read_beacon,
    read_message,
    write_beacon,
    write_message,
)
from amberbox.core.pacing import TokenBucket

BEACON_PORT = 5670
MOST_PEERS = 128  # two sockets and about three file descriptors each
MOST_GROUPS = 256
EXPIRED_S = 30.0  # as libzyre and pyre: whoever is silent for so long has left
PING_S = 10.0
UNANSWERED_S = 20.0

_EVERY_S = 1.0
_AT_ONCE = 500  # messages, before beacons have their turn
_BEACONS_AT_ONCE = 100
_QUEUE = 1000  # messages to a peer
_GREETS_S = 1.0  # a peer that greets more often is not listened to
_NEWCOMERS_PER_S = 5.0  # peers, once as many have come as there may be
_IDENTITY = b"\x01"  # before the UUID, as no identity may begin with 0
_IP_PKTINFO = 8
_PACKET_INFO = struct.Struct("i4s4s")
_LONGEST_HOLE = 30_000  # beyond that the number went back
_LONGEST_NAME = 64

Kind = Literal["ENTER", "EXIT", "JOIN", "LEAVE", "SHOUT", "WHISPER", "LOST"]


class NoInterfaceError(OSError):
    """There is no network to listen to."""


@dataclass
class Peer:
    """Another node. ``is_ready`` since its HELLO; times are monotonic (s) and log time (ns)."""

    node: bytes
    host: str
    endpoint: str
    socket: Any
    heard_s: float
    heard_ns: int
    message_s: float
    message_ns: int
    name: str = ""
    groups: set[str] = field(default_factory=set)
    is_ready: bool = False
    sent: int = 0
    last: int = 0
    greeted_s: float = 0.0
    pinged_s: float = 0.0

    @property
    def id(self) -> str:
        """Return the UUID as text."""
        return self.node.hex()


@dataclass(frozen=True, slots=True)
class ZreEvent:
    """What a peer did, or that messages of it were lost.

    ``LOST``: ``missing`` messages between those received at ``since_ns`` and ``received_ns``.
    ``EXIT``: the peer was heard last at ``since_ns``, and is believed gone for the ``reason``.
    """

    kind: Kind
    peer: Peer
    received_ns: int
    group: str = ""
    content: Sequence[bytes] = ()
    missing: int = 0
    since_ns: int = 0
    reason: str = ""
    headers: Mapping[str, str] = field(default_factory=dict)


class ZreNode:
    """One node. ``interface`` is a name or address, empty for all networks of the computer.

    Raises NoInterfaceError while there is no such interface, OSError if the ports are not to be
    had. With ``joins_all`` it joins each group that a peer is in. One thread.
    """

    def __init__(
        self,
        context: Any,
        name: str,
        groups: Sequence[str],
        now_ns: Callable[[], int],
        *,
        interface: str = "",
        port: int = BEACON_PORT,
        longest_bytes: int = 1 << 26,
    ) -> None:
        import zmq

        self.peers: dict[bytes, Peer] = {}
        self.counts: Counter[str] = Counter()
        self.sent: Counter[str] = Counter()
        self._context = context
        self._name, self._wanted, self._port = name, interface, port
        self._groups = list(groups)
        self._joins_all = not groups
        self._status = len(groups) % 256
        self._now_ns = now_ns
        self._node = uuid.uuid4().bytes
        self._interfaces = self._present()
        self._due_s = 0.0
        self._newcomers = TokenBucket(_NEWCOMERS_PER_S, MOST_PEERS)
        self._bound = self._interfaces[0].address if interface else ""
        self._beacons = _beacon_socket(port)
        try:
            self._inbox = self._bind(longest_bytes)
        except BaseException:
            self._beacons.close()
            raise
        endpoint = self._inbox.getsockopt(zmq.LAST_ENDPOINT).rstrip(b"\0").decode()
        self._tcp_port = int(endpoint.rpartition(":")[2])
        self._poller = zmq.Poller()
        self._poller.register(self._inbox, zmq.POLLIN)
        self._poller.register(self._beacons, zmq.POLLIN)

    def _bind(self, longest_bytes: int) -> Any:
        import zmq

        inbox = self._context.socket(zmq.ROUTER)
        # a full queue would make its senders drop the box, or messages: the recorder's own counts
        inbox.rcvhwm = 0
        inbox.maxmsgsize = longest_bytes
        inbox.router_handover = True
        inbox.linger = 0
        inbox.setsockopt(zmq.TCP_KEEPALIVE, 1)
        try:
            inbox.bind(f"tcp://{self._bound or '*'}:*")
        except zmq.ZMQError as error:
            inbox.close()
            raise OSError(error.errno, error.strerror) from error
        return inbox

    def _present(self) -> list[NetworkInterface]:
        found = find_interfaces(self._wanted)
        if not found:
            wanted = f"no interface {self._wanted} that is up" if self._wanted else "no interface"
            raise NoInterfaceError(errno.ENODEV, f"{wanted} with an address and broadcasts")
        return found

    @property
    def networks(self) -> str:
        """Return the interfaces with their addresses, for a person."""
        return ", ".join(f"{one.name} ({one.address})" for one in self._interfaces)

    def events(self, timeout_s: float) -> Iterator[ZreEvent]:
        """Yield what happens within a time; raises NoInterfaceError when the network is gone."""
        ready = dict(self._poller.poll(int(timeout_s * 1000)))
        if self._inbox in ready:
            yield from self._take_messages()
        if self._beacons.fileno() in ready:
            yield from self._take_beacons()
        if time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + _EVERY_S
            self._refresh_interfaces()
            self._send_beacons(self._tcp_port)
            yield from self._examine_peers()

    def close(self) -> None:
        """Leave: peers are told at once."""
        self._send_beacons(0)
        for peer in self.peers.values():
            peer.socket.close(0)
        self.peers.clear()
        self._inbox.close(0)
        self._beacons.close()

    # networks and beacons

    def _refresh_interfaces(self) -> None:
        """Follow interfaces that come and go; raises NoInterfaceError for the chosen one."""
        try:
            self._interfaces = self._present()
        except NoInterfaceError:
            if self._wanted:
                raise
            self._interfaces = []
        if self._wanted and self._interfaces[0].address != self._bound:
            raise NoInterfaceError(errno.EADDRNOTAVAIL, f"{self._wanted} has another address now")

    def _send_beacons(self, port: int) -> None:
        data = write_beacon(Beacon(self._node, port))
        for one in self._interfaces:
            info = _PACKET_INFO.pack(one.index, socket.inet_aton(one.address), bytes(4))
            ancillary = [(socket.IPPROTO_IP, _IP_PKTINFO, info)]
            with suppress(OSError):  # the interface is down, or full
                self._beacons.sendmsg([data], ancillary, 0, (one.broadcast, self._port))
                self.sent["beacons"] += 1

    def _take_beacons(self) -> Iterator[ZreEvent]:
        for _ in range(_BEACONS_AT_ONCE):
            try:
                data, ancillary, _, sender = self._beacons.recvmsg(64, 64)
            except OSError:
                return
            if self._is_chosen(ancillary):
                try:
                    beacon = read_beacon(data)
                except ZreError:
                    self.counts["malformed"] += 1
                    continue
                if beacon.node != self._node:
                    yield from self._take_beacon(beacon, sender[0])

    def _is_chosen(self, ancillary: Sequence[tuple[int, int, bytes]]) -> bool:
        """Return whether a datagram came by the chosen interface."""
        if not self._wanted:
            return True
        known = {one.index for one in self._interfaces}
        return any(
            _PACKET_INFO.unpack_from(data)[0] in known
            for level, kind, data in ancillary
            if (level, kind) == (socket.IPPROTO_IP, _IP_PKTINFO)
        )

    def _take_beacon(self, beacon: Beacon, host: str) -> Iterator[ZreEvent]:
        peer = self.peers.get(beacon.node)
        if not beacon.port:
            if peer is not None and host == peer.host:
                yield from self._remove(peer, "it has left")
        elif peer is not None:
            peer.heard_s, peer.heard_ns = time.monotonic(), self._now_ns()
        else:
            endpoint = f"tcp://{host}:{beacon.port}"
            for other in [one for one in self.peers.values() if one.endpoint == endpoint]:
                yield from self._remove(other, "another node has its address")
            self._add(beacon.node, host, endpoint)

    # messages

    def _take_messages(self) -> Iterator[ZreEvent]:
        import zmq

        for _ in range(_AT_ONCE):
            try:
                frames = self._inbox.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            received_ns = self._now_ns()
            sender = frames[0].bytes
            try:
                if len(frames) < 2 or len(sender) != 17 or not sender.startswith(_IDENTITY):
                    raise ZreError("its sender is no node")
                message = read_message(frames[1].bytes)
            except ZreError:
                self.counts["malformed"] += 1
                continue
            if message.kind == messages.HELLO:
                address = str(frames[0].get("Peer-Address"))
                yield from self._welcome(sender[1:], message, address, received_ns)
                continue
            peer = self.peers.get(sender[1:])
            if peer is None or not peer.is_ready:
                self.counts["strangers"] += 1
                continue
            yield from self._take_message(peer, message, frames[2:], received_ns)

    def _welcome(
        self, node: bytes, hello: ZreMessage, address: str, received_ns: int
    ) -> Iterator[ZreEvent]:
        """Take a HELLO. Its endpoint gives only the port: the host is where it came from."""
        peer = self.peers.get(node)
        if peer is not None and peer.is_ready:
            if time.monotonic() - peer.greeted_s < _GREETS_S:
                self.counts["malformed"] += 1
                return
            yield from self._remove(peer, "it had lost the box, and greets again", peer.message_ns)
            peer = None
        if peer is None:
            port = hello.endpoint.rpartition(":")[2]
            if node == self._node or not (port.isdecimal() and 0 < int(port) < 65536):
                self.counts["malformed"] += 1
                return
            peer = self._add(node, address, f"tcp://{address}:{int(port)}")
        if peer is None:
            return
        peer.is_ready, peer.last, peer.greeted_s = True, hello.sequence, time.monotonic()
        peer.name = _shown(hello.name) or peer.id[:6]
        self._heard(peer, received_ns)
        yield ZreEvent("ENTER", peer, received_ns, headers=hello.headers)
        for group in hello.groups:
            yield from self._join(peer, group, received_ns)

    def _take_message(
        self, peer: Peer, message: ZreMessage, content: Sequence[Any], received_ns: int
    ) -> Iterator[ZreEvent]:
        missing = missing_between(peer.last, message.sequence)
        since_ns = peer.message_ns
        peer.last = message.sequence
        self._heard(peer, received_ns)
        if missing:
            yield ZreEvent("LOST", peer, received_ns, missing=missing, since_ns=since_ns)
        group = _shown(message.group)
        if message.kind == messages.PING:
            self._send(peer, ZreMessage(messages.PING_OK, 0), "answers to PING")
        elif message.kind == messages.JOIN:
            yield from self._join(peer, message.group, received_ns)
        elif message.kind == messages.LEAVE and message.group in peer.groups:
            peer.groups.discard(message.group)
            yield ZreEvent("LEAVE", peer, received_ns, group)
        elif message.kind in (messages.SHOUT, messages.WHISPER):
            kind: Kind = "SHOUT" if message.kind == messages.SHOUT else "WHISPER"
            frames = [frame.bytes for frame in content]
            yield ZreEvent(kind, peer, received_ns, group, frames)

    def _join(self, peer: Peer, group: str, received_ns: int) -> Iterator[ZreEvent]:
        if group in peer.groups or len(peer.groups) >= MOST_GROUPS:
            return
        peer.groups.add(group)
        yield ZreEvent("JOIN", peer, received_ns, _shown(group))
        if self._joins_all and group not in self._groups and len(self._groups) < MOST_GROUPS:
            self._groups.append(group)
            self._status = (self._status + 1) % 256
            for other in list(self.peers.values()):
                join = ZreMessage(messages.JOIN, 0, group, self._status)
                self._send(other, join, "JOIN")

    # peers

    def _add(self, node: bytes, host: str, endpoint: str) -> Peer | None:
        """Connect to a node and greet it; None if there are too many."""
        import zmq

        if len(self.peers) >= MOST_PEERS or self._newcomers.take_one(time.monotonic()):
            self.counts["refused"] += 1
            return None
        outbox = self._context.socket(zmq.DEALER)
        outbox.identity = _IDENTITY + self._node
        outbox.sndhwm = _QUEUE
        outbox.linger = 0
        outbox.reconnect_ivl_max = 5000
        try:
            outbox.connect(endpoint)
        except zmq.ZMQError:
            outbox.close()
            self.counts["malformed"] += 1
            return None
        now_s, now_ns = time.monotonic(), self._now_ns()
        peer = Peer(node, host, endpoint, outbox, now_s, now_ns, now_s, now_ns)
        self.peers[node] = peer
        hello = ZreMessage(
            messages.HELLO,
            0,
            status=self._status,
            endpoint=f"tcp://{self._bound or _address_towards(host)}:{self._tcp_port}",
            name=self._name,
            groups=self._groups,
        )
        self._send(peer, hello, "HELLO")
        return peer

    def _remove(self, peer: Peer, reason: str, since_ns: int | None = None) -> Iterator[ZreEvent]:
        del self.peers[peer.node]
        peer.socket.close(0)
        if peer.is_ready:
            now_ns = self._now_ns()
            last_ns = now_ns if since_ns is None else since_ns
            yield ZreEvent("EXIT", peer, now_ns, since_ns=last_ns, reason=reason)

    def _examine_peers(self) -> Iterator[ZreEvent]:
        """Remove peers that are gone, and reach again those that have lost the box."""
        now_s = time.monotonic()
        for peer in list(self.peers.values()):
            silent_s, unanswered_s = now_s - peer.heard_s, now_s - peer.message_s
            if silent_s > EXPIRED_S:
                reason = f"nothing was heard of it for {EXPIRED_S:g} s"
                yield from self._remove(peer, reason, peer.heard_ns)
            elif unanswered_s > UNANSWERED_S:
                reason = "it is there, but sends the box nothing"
                yield from self._remove(peer, reason, peer.message_ns)
                self._add(peer.node, peer.host, peer.endpoint)
            elif peer.is_ready and min(unanswered_s, now_s - peer.pinged_s) > PING_S / 2:
                peer.pinged_s = now_s
                self._send(peer, ZreMessage(messages.PING, 0), "PING")

    def _heard(self, peer: Peer, received_ns: int) -> None:
        peer.heard_s = peer.message_s = time.monotonic()
        peer.heard_ns = peer.message_ns = received_ns

    def _send(self, peer: Peer, message: ZreMessage, what: str) -> None:
        """Send without waiting; a peer whose queue is full is found silent later."""
        import zmq

        number = (peer.sent + 1) % 65536
        frame = write_message(replace(message, sequence=number))
        with suppress(zmq.ZMQError):
            peer.socket.send(frame, zmq.NOBLOCK)
            peer.sent = number
            self.sent[what] += 1


def missing_between(last: int, now: int) -> int:
    """Return how many messages are missing between two sequence numbers.

    They have 16 bits; pyre goes from 65534 to 0, libzyre from 65535. A number that goes back says
    nothing: 0.
    """
    if (last, now) == (65534, 0):
        return 0
    missing = (now - last - 1) % 65536
    return missing if missing <= _LONGEST_HOLE else 0


def _shown(text: str) -> str:
    """Return a name of a peer or a group, without what cannot be seen."""
    return "".join(char for char in text[:_LONGEST_NAME] if char.isprintable())


def _beacon_socket(port: int) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        for option in (socket.SO_REUSEADDR, socket.SO_REUSEPORT, socket.SO_BROADCAST):
            made.setsockopt(socket.SOL_SOCKET, option, 1)
        made.setsockopt(socket.IPPROTO_IP, _IP_PKTINFO, 1)
        made.setblocking(False)
        made.bind(("", port))
    except BaseException:
        made.close()
        raise
    return made


def _address_towards(host: str) -> str:
    """Return the address of this computer from which a host is reached."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((host, 9))
        except OSError:
            return "127.0.0.1"
        return str(probe.getsockname()[0])
