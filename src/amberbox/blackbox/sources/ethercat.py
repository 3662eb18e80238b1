"""EtherCAT: process images, working counters and states of slaves, by frames that pass."""

from __future__ import annotations

import select
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.blackbox.ethercat.bus import EtherCatBus, topic
from amberbox.blackbox.ethercat.images import InterfaceOptions
from amberbox.blackbox.ethercat.options import EtherCatOptions
from amberbox.blackbox.ethercat.ring import FrameRing, RingFrame
from amberbox.core.clock import NS, StampConverter
from amberbox.core.errors import AmberboxError
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.types import Topic

SAMPLE = """\
- ethercat:
    interfaces:
      - interface_specification:
          interface: eth1
          number_of_slaves: 4
          input_message_elements:
            - element: {name: setpoint, type: float}
          output_message_elements:
            - element: {name: status, type: uint16}
            - element: {name: velocity, type: float, unit: rad/s}
          output_data_items: {name: wheels, variable_names: [velocity]}
"""
PASSIVE = "receives copies of frames from the kernel and never sends one; needs only CAP_NET_RAW"

Config = EtherCatOptions

_POLL_S = 0.1
_SILENT_NS = NS
_AT_MOST_LATE_NS = 3 * NS // 10  # of a frame in a block that is not full
_WAIT_S = (0.5, 5.0)
_STATE = "expected"


def known_topics(config: EtherCatOptions) -> Sequence[Topic]:
    """Return the topics of all segments."""
    found: list[Topic] = []
    for one in config.interfaces:
        found += one.images().topics
        names = ["bus", "al_status", *(["datagrams"] if one.datagrams != "none" else [])]
        found += [topic(name, config.prefix(one)) for name in names]
    return found


class EtherCatSource:
    """A listener on one or more segments; it never sends a frame."""

    lossless = False
    late_s = 5.0

    def __init__(self, config: EtherCatOptions, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        """Return the messages configured, with their filters; the health of a segment has none."""
        return self.config.listed()

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Receive until ``stop`` is set; an interface that is missing or down is retried."""
        segments = [
            _Segment(one, self.config.prefix(one), sink, _learnt(sink, one.interface))
            for one in self.config.interfaces
        ]
        stored = {segment.options.interface: dict(segment.bus.learnt) for segment in segments}
        try:
            while not stop.is_set():
                _wait(segments, stop)
                for segment in segments:
                    segment.receive()
                sink.complete(min(segment.complete_ns for segment in segments))
                learnt = {s.options.interface: dict(s.bus.learnt) for s in segments}
                if learnt != stored:
                    sink.save_state({_STATE: learnt})
                    stored = learnt
        finally:
            for segment in segments:
                segment.close()


Source = EtherCatSource


def _learnt(sink: Sink, interface: str) -> dict[str, int]:
    """Return the expected working counters of earlier runs, as far as they can be read."""
    saved = sink.state().get(_STATE)
    kept = saved.get(interface) if isinstance(saved, dict) else None
    entries = kept.items() if isinstance(kept, dict) else ()
    return {name: counter for name, counter in entries if isinstance(counter, int)}


def _wait(segments: Sequence[_Segment], stop: threading.Event) -> None:
    """Wait for frames of any segment, not for long."""
    poll = select.poll()
    rings = [segment.ring for segment in segments if segment.ring is not None]
    for ring in rings:
        poll.register(ring.fileno(), select.POLLIN | select.POLLERR)
    if rings:
        poll.poll(1000 * _POLL_S)
    else:
        stop.wait(_POLL_S)


@dataclass
class _Segment:
    """One interface: the ring while it is open, what has arrived, what is to be tried again."""

    options: InterfaceOptions
    prefix: str
    sink: Sink
    learnt: dict[str, int]
    ring: FrameRing | None = None
    complete_ns: int = 0
    """All frames received before this time have been passed on."""
    _streams: dict[str, int] = field(default_factory=dict)
    _up: set[str] = field(default_factory=set)
    _quiet: bool = True
    _last_ns: int = 0
    _told: str = ""
    _wait_s: float = _WAIT_S[0]
    _try_s: float = 0.0

    def __post_init__(self) -> None:
        self.bus = EtherCatBus(self.options, self._put, self._tell, self.prefix, self.learnt)
        self._always = f"{self.prefix}bus"
        self._stamps = StampConverter(self.sink.now_ns)
        self.complete_ns = self.sink.now_ns()
        for one in self.bus.topics:
            self._streams[one.name] = self.sink.topic(one)

    def receive(self) -> None:
        """Pass on the frames that wait; open the interface if it is not, and it is time."""
        if self.ring is None:
            self.complete_ns = max(self.complete_ns, self.sink.now_ns())
            if time.monotonic() >= self._try_s:
                self._open()
            return
        now_ns = self.sink.now_ns()
        failure = self.ring.failure()
        self._note_drops(self.ring.dropped())
        for block in self.ring.blocks():
            self._note_drops(self.ring.dropped())  # before frames that came after those dropped
            self._frames(block)
        self.complete_ns = max(self.complete_ns, self._last_ns, now_ns - _AT_MOST_LATE_NS)
        self.bus.tick(self.complete_ns)
        if not self._quiet and self.complete_ns - self._last_ns > _SILENT_NS:
            self._quiet = True
            self._end("no frames", self._last_ns)
            self._tell("ethercat_silent", f"{self.options.interface}: no frames any more")
        if failure is not None:
            self._close(failure.strerror or str(failure))

    def _open(self) -> None:
        name = self.options.interface
        try:
            self.ring = FrameRing(name, self.options.buffer_mb << 20)
        except PermissionError as error:
            raise AmberboxError(
                f"listening on {name} needs the capability CAP_NET_RAW",
                "AmbientCapabilities=CAP_NET_RAW in the systemd unit; or setcap cap_net_raw=ep "
                "on a copy of the Python program that only the box uses",
            ) from error
        except OSError as error:
            why = f"cannot listen on {name}: {error.strerror or error}"
            if why != self._told:
                self.sink.event("ethercat_missing", why, interface=name)
            self._told = why
            self._try_s = time.monotonic() + self._wait_s
            self._wait_s = min(2 * self._wait_s, _WAIT_S[1])
            return
        self._told, self._wait_s = "", _WAIT_S[0]
        self.sink.event("ethercat_open", f"listening on {name}", interface=name)
        if not self.ring.is_loopback and may_send(name):
            self.sink.event(
                "ethercat_ipv6",
                f"the computer may send IPv6 packets to {name}: "
                f"sysctl net.ipv6.conf.{name}.disable_ipv6=1",
                interface=name,
            )

    def _frames(self, block: Sequence[RingFrame]) -> None:
        if not block:
            return
        last = block[-1].stamp_ns
        shift_ns = self._stamps.log_ns(last) - last
        if self._quiet:
            self._quiet = False
            for name in self._up:
                self.sink.link_up(name, self.options.interface)
        for frame in block:
            # not before a frame that has been passed on, even if the wall clock was set back
            self._last_ns = max(self._last_ns, self.complete_ns, frame.stamp_ns + shift_ns)
            self.bus.frame(frame.data if frame.is_whole else b"", self._last_ns, frame.sent)

    def _put(self, one: Topic, data: bytes, time_ns: int) -> None:
        stream = self._streams[one.name]
        if one.name not in self._up and one.name != self._always:
            self._up.add(one.name)
            self.sink.link_up(one.name, self.options.interface)
        self.sink.message(stream, data, time_ns)

    def _tell(self, kind: str, text: str) -> None:
        self.sink.event(kind, text, interface=self.options.interface)

    def _note_drops(self, count: int) -> None:
        """Report frames without room; the bus' messages of them are missing, too."""
        if not count:
            return
        name, to_ns = self.options.interface, self.sink.now_ns()
        self.bus.dropped(count, to_ns)
        from_ns = min(self.complete_ns, to_ns)
        self.sink.lost(self._always, name, from_ns, to_ns, count, "no room in the ring")

    def _end(self, reason: str, since_ns: int | None = None) -> None:
        for name in self._up:
            self.sink.link_down(name, self.options.interface, reason, since_ns)

    def _close(self, reason: str) -> None:
        """Close a ring that has failed."""
        if self.ring is not None:
            self.ring.close()
            self.ring = None
        if not self._quiet:
            self._quiet = True
            self._end(reason)
        self._tell("ethercat_lost", f"{self.options.interface}: {reason}")

    def close(self) -> None:
        """Close the ring at the end."""
        if self.ring is not None:
            self.ring.close()


def may_send(interface: str) -> bool:
    """Return whether IPv6 is on for an interface: then the kernel sends packets by itself."""
    try:
        text = Path("/proc/sys/net/ipv6/conf", interface, "disable_ipv6").read_text()
    except OSError:
        return False
    return text.strip() == "0"
