"""Zyre networks: messages to groups and to the box, peers that come and go, lost messages."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from amberbox.blackbox.payloads.paced_events import PacedEvents
from amberbox.blackbox.payloads.payload import is_json, payload_topic
from amberbox.blackbox.sources.zre.node import (
    BEACON_PORT,
    MOST_PEERS,
    NoInterfaceError,
    Peer,
    ZreEvent,
    ZreNode,
)
from amberbox.core.errors import AmberboxError
from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.topic_selection import TopicSelection, pattern_problem
from amberbox.core.types import Topic

SAMPLE = """\
- zyre:
    name: black_box_001
    interface: wlan0
    groups: [ROPOD]
    message_types: [CMD, RobotPose2D]
"""
PASSIVE = (
    "is seen as the peer '{config.name}' and joins {config.joined}: sends beacons, HELLO, JOIN, "
    "PING and answers to PING, but no message; whispers between others are not seen"
)

NETWORK = Topic("network", "json")
"""Once a second what the network carries; a message type or group of this name gets a ``_``."""

_POLL_S = 0.1
_RETRY_S = 1.0
_EVERY_S = 1.0
_MOST_TOPICS = 1000
_LONGEST_NAME = 100


class _Header(msgspec.Struct):
    type: str = ""


class _Typed(msgspec.Struct):
    header: _Header


_TYPE = msgspec.json.Decoder(_Typed)
_MISFITS = (msgspec.MsgspecError, RecursionError, ValueError)


@dataclass(frozen=True)
class ZyreOptions:
    """The ``zyre`` block: one Zyre network."""

    name: str = option("amberbox", "name as which the box is seen in the network")
    interface: str = option("", "name or address of the network interface; all when absent")
    groups: Sequence[str] = option((), "groups to join; each that a peer is in when absent")
    message_types: Sequence[str] = option((), "values of header.type to record; all when absent")
    topics: Sequence[TopicOptions] = option((), "the same with options, by name or pattern")
    exclude: Sequence[str] = option((), "names and patterns of message types to leave out")
    port: int = option(BEACON_PORT, "UDP port of the beacons")

    @property
    def joined(self) -> str:
        """Return the groups for a person."""
        return ", ".join(self.groups) or "each group that a peer is in"

    def wanted(self) -> Sequence[TopicOptions]:
        """Return the options of all message types that are listed; none means all."""
        listed = {topic.name for topic in self.topics}
        types = (TopicOptions(name) for name in self.message_types if name not in listed)
        return [*self.topics, *types]

    def selection(self) -> TopicSelection:
        """Return what chooses among the message types."""
        wanted = self.wanted()
        return TopicSelection(wanted, all_topics=not wanted, exclude=self.exclude)

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        if not self.name or len(self.name.encode()) > 255:
            yield "name", "must have 1 to 255 bytes"
        if any(not 0 < len(group.encode()) <= 255 for group in self.groups):
            yield "groups", "names of groups have 1 to 255 bytes"
        if not 0 < self.port < 65536:
            yield "port", "must be between 1 and 65535"
        names = {
            "message_types": self.message_types,
            "topics": [topic.name for topic in self.topics],
            "exclude": self.exclude,
        }
        for key, listed in names.items():
            yield from ((key, pattern_problem(name)) for name in listed if pattern_problem(name))


Config = ZyreOptions


def beside_recorder(config: ZyreOptions) -> ZyreOptions:
    """Return the same under another name."""
    return replace(config, name=f"{config.name}_doctor")


class ZyreSource:
    """A peer that joins groups and listens."""

    lossless = False

    def __init__(self, config: ZyreOptions, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        """Return the message types configured; the state of the network is always there."""
        wanted = self.config.wanted()
        return [*wanted, TopicOptions(NETWORK.name)] if wanted else ()

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Listen until ``stop`` is set; peers and networks may come and go."""
        _Listener(self.config, sink).run(stop)


Source = ZyreSource


@dataclass
class _Listener:
    """The state of a run."""

    config: ZyreOptions
    sink: Sink
    _streams: dict[tuple[str, str], int] = field(default_factory=dict)
    # topics of each peer that is there, by its name
    _links: dict[str, dict[str, None]] = field(default_factory=dict)
    _counts: Counter[str] = field(default_factory=Counter)
    _due_s: float = 0.0

    def run(self, stop: threading.Event) -> None:
        try:
            import zmq
        except ImportError as error:
            raise AmberboxError("pyzmq is missing", "pip install 'amberbox[zmq]'") from error

        self._events = PacedEvents(self.sink)
        self._network = self.sink.topic(NETWORK)
        self._selection = self.config.selection()
        context = zmq.Context()
        context.max_sockets = 8 * MOST_PEERS
        told = ""
        try:
            while not stop.is_set():
                try:
                    node = self._open(context)
                except OSError as error:
                    why = f"cannot listen: {error.strerror}"
                    if why != told:
                        self.sink.event("zyre_missing", why)
                    told = why
                    stop.wait(_RETRY_S)
                    continue
                told = ""
                self._serve(node, stop)
        finally:
            context.destroy(linger=0)

    def _open(self, context: Any) -> ZreNode:
        return ZreNode(
            context,
            self.config.name,
            self.config.groups,
            self.sink.now_ns,
            interface=self.config.interface,
            port=self.config.port,
            longest_bytes=self.sink.longest_message(),
        )

    def _serve(self, node: ZreNode, stop: threading.Event) -> None:
        """Listen as one node, until the network is gone."""
        self.sink.event("zyre_open", f"listening on {node.networks} as {self.config.name}")
        self.sink.link_up(NETWORK.name, self.config.name)
        reason = "stopped"
        try:
            while not stop.is_set():
                for event in node.events(_POLL_S):
                    self._take(event, node)
                if time.monotonic() >= self._due_s:
                    self._due_s = time.monotonic() + _EVERY_S
                    self._report(node)
        except NoInterfaceError as error:
            reason = str(error.strerror)
            self.sink.event("zyre_lost", f"the network is gone: {reason}")
        finally:
            sent = ", ".join(f"{number} {what}" for what, number in sorted(node.sent.items()))
            self._report(node)
            node.close()
            for peer in list(self._links):
                self._close_links(peer, reason)
            self.sink.link_down(NETWORK.name, self.config.name, reason)
            if sent:
                self.sink.event("sent", sent)

    def _take(self, event: ZreEvent, node: ZreNode) -> None:
        peer = event.peer
        details = {"peer": peer.name, "uuid": peer.id}
        if event.kind in ("SHOUT", "WHISPER"):
            self._take_message(event)
        elif event.kind == "LOST":
            self._counts["lost"] += event.missing
            reason = "lost before the box: holes in the sequence numbers"
            span_ns = event.since_ns, max(event.since_ns, event.received_ns)
            self.sink.lost(NETWORK.name, peer.name, *span_ns, event.missing, reason)
        elif event.kind == "ENTER":
            before = [one.heard_ns for one in _of_name(node, peer.name) if one is not peer]
            if before:  # was not missed yet
                self._close_links(peer.name, "it was started anew", max(before))
            headers = {key[:_LONGEST_NAME]: text[:_LONGEST_NAME]
                       for key, text in list(event.headers.items())[:20]}  # fmt: skip
            text = f"{peer.name} is there ({peer.endpoint})"
            self._events.add("zyre_enter", text, **details, address=peer.endpoint, headers=headers)
        elif event.kind == "EXIT":
            self._events.add("zyre_exit", f"{peer.name} is gone: {event.reason}", **details)
            if not _of_name(node, peer.name):
                self._close_links(peer.name, event.reason, event.since_ns)
        else:
            verb = event.kind.lower()
            text = f"{peer.name} {verb}s {event.group}"
            self._events.add(f"zyre_{verb}", text, **details, group=event.group)

    def _take_message(self, event: ZreEvent) -> None:
        content = event.content
        payload = content[0] if len(content) == 1 else b"".join(content)
        self._counts["shouts" if event.kind == "SHOUT" else "whispers"] += 1
        name, is_text = message_type(payload)
        if not is_text:
            self._counts["not_json"] += 1
        name = _free_name(name or event.group or "whisper")
        if not self._selection.chooses(name):
            self._counts["left_out"] += 1
            return
        stream = self._stream(name, "json" if is_text else "raw")
        if stream is None:
            return
        links = self._links.setdefault(event.peer.name, {})
        if name not in links:
            links[name] = None
            self.sink.link_up(name, event.peer.name)
        self.sink.message(stream, payload, event.received_ns)

    def _stream(self, name: str, kind: str) -> int | None:
        stream = self._streams.get((name, kind))
        if stream is None:
            if len(self._streams) >= _MOST_TOPICS and name not in self._selection.named:
                self._counts["left_out"] += 1
                text = f"more than {_MOST_TOPICS} message types; further ones are not recorded"
                self._events.add_once("zyre_many_types", text)
                return None
            stream = self._streams[name, kind] = self.sink.topic(payload_topic(name, kind))
        return stream

    def _close_links(self, peer: str, reason: str, since_ns: int | None = None) -> None:
        for topic in self._links.pop(peer, ()):
            self.sink.link_down(topic, peer, reason, since_ns)

    def _report(self, node: ZreNode) -> None:
        """Put a row of the topic ``network``, of the time since the last one."""
        peers = sum(peer.is_ready for peer in node.peers.values())
        counts, self._counts = self._counts + node.counts, Counter()
        if node.counts["refused"]:
            text = f"more than {MOST_PEERS} peers, or too many new ones; others are not heard"
            self._events.add_once("zyre_many_peers", text)
        node.counts.clear()
        row: Mapping[str, int] = {
            "peers": peers,
            "shouts": counts["shouts"],
            "whispers": counts["whispers"],
            "left_out": counts["left_out"],
            "not_json": counts["not_json"],
            "malformed": counts["malformed"],
            "strangers": counts["strangers"],
            "refused": counts["refused"],
            "lost": counts["lost"],
        }
        self.sink.message(self._network, msgspec.json.encode(row), self.sink.now_ns())


def _of_name(node: ZreNode, name: str) -> Sequence[Peer]:
    return [peer for peer in node.peers.values() if peer.is_ready and peer.name == name]


def message_type(payload: bytes) -> tuple[str, bool]:
    """Return ``header.type`` of a message of ROPOD, empty without one, and whether it is JSON."""
    try:
        return _TYPE.decode(payload).header.type, True
    except _MISFITS:
        return "", is_json(payload)


def _free_name(name: str) -> str:
    shown = "".join(char for char in name[:_LONGEST_NAME] if char.isprintable())
    return f"{shown}_" if shown == NETWORK.name else shown or "message"
