"""CAN and CAN FD: signals by DBC files, CANopen objects by EDS files, raw frames, bus load."""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from amberbox.blackbox.canbus.definition import CanDefinitions, Frames
from amberbox.blackbox.canbus.files import CanopenNode, node_number, read_definitions
from amberbox.blackbox.canbus.frame import (
    BUS,
    BUS_OFF,
    CONTROLLER,
    ERRORS,
    FRAMES,
    RECEIVE_OVERFLOW,
    RESTARTED,
    CanFrame,
    pack_bus,
    wire_time_s,
)
from amberbox.core.clock import NS, StampConverter
from amberbox.core.errors import AmberboxError
from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.topic_selection import TopicSelection, pattern_problem
from amberbox.core.types import Topic

SAMPLE = """\
- can:
    channel: can0
    dbc: base.dbc
    nodes:
      - {id: 5, name: lift, eds: lift.eds}
    topics:
      - topic: {name: MOTORS_DATA, variable_names: [SPEED_L, SPEED_R]}
      - topic: {name: lift/*, max_frequency: 10}
"""
PASSIVE = "{config.seen_as}"

_QUIET: Mapping[str, Mapping[str, Any]] = {
    "slcan": {"listen_only": True},
    "kvaser": {"driver_mode": False},
    "pcan": {},
}
"""Interfaces whose driver can be opened listen-only, and how; ``pcan`` has an enumeration."""
_NO_WIRE = ("virtual", "udp_multicast")
_PURE = ("socketcan", "socketcand", "slcan", "serial", "seeedstudio", "robotell", *_NO_WIRE)
_POLL_S = 0.1
_EVERY_NS = NS
_WAIT_S = (0.5, 30.0)
_MOST_AGE_S = 60.0  # an older time stamp is not of this computer's clock
_ROOM_BYTES = 8 << 20
_SO_RCVBUFFORCE, _SO_MEMINFO = 33, 55
_MEMINFO = struct.Struct("9I")  # the last number counts frames for which there was no room
_MOST_BAD = 1000  # unreadable frames in a row, after which the interface is opened again
_LONGEST_LINE = 1024  # of slcan; a line of a frame has 140 characters
_STATISTICS = ("rx_over_errors", "rx_dropped", "rx_missed_errors")


@dataclass(frozen=True)
class CanopenNodeOptions:
    """A CANopen node of the bus."""

    id: int = option(doc="number of the node, 1 to 127")
    name: str = option("", "name in topics; node_ID when absent")
    eds: str = option("", "its EDS or DCF file; only heartbeat and emergencies when absent")


@dataclass(frozen=True)
class CanOptions:
    """The ``can`` block: one bus."""

    channel: str = option(doc="interface of the computer, such as can0, /dev/ttyACM0, 239.0.0.7")
    interface: str = option("socketcan", "kind of interface, as python-can names it")
    bitrate: int | None = option(
        None, "bit rate; of socketcan that of the interface when absent", unit="bit/s"
    )
    data_bitrate: int | None = option(None, "bit rate of the data in CAN FD frames", unit="bit/s")
    fd: bool = option(False, "receive CAN FD frames as well")
    listen_only: bool = option(True, "do not even acknowledge frames, where the driver can")
    dbc: str | Sequence[str] = option("", "DBC file or files that describe the messages")
    nodes: Sequence[CanopenNodeOptions] = option((), "CANopen nodes")
    frames: Frames = option("unknown", "raw frames to record: unknown to the files, all or none")
    topics: Sequence[TopicOptions] = option((), "described messages to record; all when absent")
    exclude: Sequence[str] = option((), "names and patterns of described messages to leave out")
    driver: Mapping[str, str | int | float | bool] = option(
        {}, "further arguments of the interface in python-can"
    )

    @property
    def files(self) -> Sequence[str]:
        """Return the DBC files as a list."""
        listed = [self.dbc] if isinstance(self.dbc, str) else list(self.dbc)
        return [name for name in listed if name]

    @property
    def seen_as(self) -> str:
        """Return how the source behaves on the bus."""
        if self.interface in _NO_WIRE:
            return "sends no frame; there is no wire on which frames would be acknowledged"
        if not self.listen_only:
            return "sends no frame, but acknowledges those of others: listen_only is false"
        if self.interface == "socketcan":
            return (
                "sends no frame; acknowledges those of others unless the interface is listen-only, "
                "which an event states at the start"
            )
        if self.interface in _QUIET:
            return "opened listen-only: sends no frame and acknowledges none"
        return f"sends no frame; {self.interface} may acknowledge those of others"

    def in_folder(self, folder: Path) -> CanOptions:
        """Return the same with paths seen from a folder."""
        files = [str(folder / Path(name).expanduser()) for name in self.files]
        nodes = [
            replace(node, eds=str(folder / Path(node.eds).expanduser())) if node.eds else node
            for node in self.nodes
        ]
        return replace(self, dbc=files, nodes=nodes)

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        if not self.channel:
            yield "channel", "names no interface; write can0"
        for key in ("bitrate", "data_bitrate"):
            if (value := getattr(self, key)) is not None and value <= 0:
                yield key, "must be above 0"
        numbers = [node.id for node in self.nodes]
        for number in numbers:
            try:
                node_number(str(number))
            except ValueError as error:
                yield "nodes", str(error)
        for number in sorted({n for n in numbers if numbers.count(n) > 1}):
            yield "nodes", f"node {number} is there twice"
        names = {"topics": [topic.name for topic in self.topics], "exclude": self.exclude}
        for key, listed in names.items():
            yield from ((key, pattern_problem(name)) for name in listed if pattern_problem(name))

    def notes(self) -> Iterator[tuple[str, str]]:
        """Yield what keeps the bus from being recorded as one might expect."""
        for key, path in self._missing_files():
            yield key, f"there is no file {path} yet; nothing of the bus is recorded without it"
        known = (*_NO_WIRE, *_QUIET, "socketcan")
        if self.listen_only and self.interface not in known:
            yield (
                "interface",
                f"{self.interface} cannot be opened listen-only: the box may "
                + ("acknowledge frames of others"),
            )

    def _missing_files(self) -> Iterator[tuple[str, str]]:
        yield from (("dbc", name) for name in self.files if not Path(name).exists())
        eds = [node.eds for node in self.nodes if node.eds]
        yield from (("nodes", name) for name in eds if not Path(name).exists())

    def wrong_files(self) -> Iterator[tuple[str, str]]:
        """Yield what is wrong with the files named here, or with names that they should have."""
        if any(self._missing_files()):
            return
        try:
            definitions = self.definitions()
        except ImportError:  # the doctor says what is missing, and so does a run
            return
        except AmberboxError as error:
            yield ("dbc" if self.files else "nodes"), error.what
            return
        known = {topic.name for topic in (*definitions.topics, FRAMES, ERRORS, BUS)}
        for name in TopicSelection(self.topics, all_topics=False).named.keys() - known:
            yield "topics", f"no file describes a message '{name}'"

    def definitions(self) -> CanDefinitions:
        """Read the files; raises AmberboxError."""
        nodes = [
            CanopenNode(
                node.id, node.name or f"node_{node.id}", Path(node.eds) if node.eds else None
            )
            for node in self.nodes
        ]
        return read_definitions([Path(name) for name in self.files], nodes, self.frames)

    def selection(self) -> TopicSelection:
        """Return what chooses among the described messages."""
        return TopicSelection(self.topics, all_topics=not self.topics, exclude=self.exclude)


Config = CanOptions


def needs_process(config: CanOptions) -> bool:
    """Return whether the interface loads a library of its maker."""
    return config.interface not in _PURE


def known_topics(config: CanOptions) -> Sequence[Topic]:
    """Return the topics of the bus that are chosen; raises AmberboxError for a broken file."""
    selection = config.selection()
    try:
        definitions = config.definitions()
    except ImportError as error:
        raise AmberboxError(f"{error.name} is missing", "pip install 'amberbox[can]'") from error
    described = [t for t in definitions.topics if selection.chooses(t.name, "")]
    return [*described, *([] if config.frames == "none" else [FRAMES]), ERRORS, BUS]


class CanSource:
    """A listener on one bus; it never sends a frame."""

    lossless = False
    late_s = 1.0

    def __init__(self, config: CanOptions, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        """Return the topics configured; raw frames, errors and the bus itself are always there."""
        if not self.config.topics:
            return ()
        listed = {topic.name for topic in self.config.topics}
        always = [ERRORS, BUS] if self.config.frames == "none" else [FRAMES, ERRORS, BUS]
        return [
            *self.config.topics,
            *(TopicOptions(topic.name) for topic in always if topic.name not in listed),
        ]

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Receive until ``stop`` is set; an interface that is missing or fails is retried."""
        _Listener(self.config, sink).run(stop)


Source = CanSource


@dataclass
class _Interval:
    """Counts since the last row of the topic ``bus``."""

    since_ns: int
    frames: int = 0
    errors: int = 0
    malformed: int = 0
    lost: int = 0
    least_s: float = 0.0
    most_s: float = 0.0


@dataclass
class _Listener:
    """The state of a run: what is open, what is counted, what is up."""

    config: CanOptions
    sink: Sink
    _last_ns: int = 0
    _bitrate: int = 0
    _data_bitrate: int = 0
    _up: set[str] = field(default_factory=set)
    _streams: dict[str, int | None] = field(default_factory=dict)
    _times: dict[tuple[bool, bool, bool, int], tuple[float, float]] = field(default_factory=dict)
    _bad_stamps: bool = False

    def run(self, stop: threading.Event) -> None:
        """Receive until ``stop`` is set; raises AmberboxError for an unknown interface."""
        import can

        self._definitions = self.config.definitions()
        self._selection = self.config.selection()
        self._stamps = StampConverter(self.sink.now_ns)
        self._count = _Interval(self.sink.now_ns())
        self._errors, self._bus = self.sink.topic(ERRORS), self.sink.topic(BUS)
        wait_s, told = _WAIT_S[0], ""
        while not stop.is_set():
            try:
                bus = self._open()
            except can.CanInterfaceNotImplementedError as error:
                raise AmberboxError(
                    _one_line(error), "python-can's documentation lists its interfaces"
                ) from error
            except Exception as error:  # drivers raise all kinds of errors
                why = f"cannot open {self.config.channel}: {_one_line(error)}"
                if why != told:
                    self.sink.event("can_missing", why, channel=self.config.channel)
                told = why
            else:
                wait_s, told = _WAIT_S[0], ""
                self._listen(bus, stop)
            self._wait(stop, wait_s)
            wait_s = min(2 * wait_s, _WAIT_S[1])

    def _open(self) -> Any:
        import can

        arguments: dict[str, Any] = dict(self.config.driver)
        for key in ("bitrate", "data_bitrate"):
            if getattr(self.config, key) is not None and self.config.interface != "socketcan":
                arguments.setdefault(key, getattr(self.config, key))
        if self.config.fd:
            arguments.setdefault("fd", True)
        if self.config.listen_only:
            arguments |= _QUIET.get(self.config.interface, {})
            if self.config.interface == "pcan":
                arguments["state"] = can.BusState.PASSIVE
        bus = can.Bus(
            self.config.channel,
            interface=self.config.interface,
            ignore_config=True,
            **arguments,
        )
        self._bitrate, self._data_bitrate = self.config.bitrate or 0, self.config.data_bitrate or 0
        if self.config.interface == "socketcan":
            self._examine_link()
        self._losses = _Losses(bus, self.config)
        details = {"channel": self.config.channel, "interface": self.config.interface}
        self.sink.event("can_open", f"listening on {self.config.channel}", **details)
        for name in self._up:
            self.sink.link_up(name, self.config.channel)
        return bus

    def _examine_link(self) -> None:
        """Take the bit rates of the interface, and state whether it is listen-only."""
        channel = self.config.channel
        link = read_link(channel)
        self._bitrate = self._bitrate or link.bitrate
        self._data_bitrate = self._data_bitrate or link.data_bitrate
        if not self.config.listen_only or link.is_virtual or link.listen_only:
            return
        if link.listen_only is None:
            text = f"it is not known whether {channel} is listen-only: {link.problem}"
        else:
            text = (
                f"{channel} is not listen-only: the box acknowledges frames of others; "
                f"ip link set {channel} type can listen-only on"
            )
        self.sink.event("can_not_listen_only", text, channel=channel)

    def _listen(self, bus: Any, stop: threading.Event) -> None:
        """Receive until the interface fails."""
        bad = 0
        reason = ""
        while not stop.is_set():
            before_ns = self.sink.now_ns()
            try:
                frame = bus.recv(_POLL_S)
            except Exception as error:  # drivers raise all kinds of errors, also for what arrived
                if isinstance(error, OSError) or isinstance(error.__cause__, OSError):
                    reason = _one_line(error)
                    break
                bad += 1
                self._count.malformed += 1
                _clear(bus)
                if bad >= _MOST_BAD:
                    reason = f"{bad} unreadable frames in a row"
                    break
                continue
            if frame is None:
                if len(getattr(bus, "_buffer", b"")) > _LONGEST_LINE:
                    self._count.malformed += 1
                    _clear(bus)
                # what arrived before this call has been passed on
                self._last_ns = max(self._last_ns, before_ns)
                self.sink.complete(self._last_ns)
            else:
                bad = 0
                self._receive(frame)
            if before_ns - self._count.since_ns >= _EVERY_NS:
                self._report()
                self.sink.complete(self._last_ns)
        with suppress(Exception):
            bus.shutdown()
        if reason:
            for name in self._up:
                self.sink.link_down(name, self.config.channel, reason)
            self.sink.event("can_lost", f"{self.config.channel}: {reason}")

    def _receive(self, frame: CanFrame) -> None:
        """Pass one frame on."""
        received_ns = self._received_ns(frame.timestamp)
        self._count.frames += 1
        if self._bitrate:
            shape = (
                frame.is_fd, frame.is_extended_id, frame.bitrate_switch, len(frame.data)
            )  # fmt: skip
            times = self._times.get(shape)
            if times is None:
                times = wire_time_s(frame, self._bitrate, self._data_bitrate)
                self._times[shape] = times
            self._count.least_s += times[0]
            self._count.most_s += times[1]
        for topic, data in self._definitions.records(frame):
            stream = self._streams[topic.name] if topic.name in self._streams else self._new(topic)
            if stream is not None:
                self.sink.message(stream, data, received_ns)
        if frame.is_error_frame:
            self._error(frame, received_ns)

    def _received_ns(self, timestamp: float) -> int:
        age_s = time.time() - timestamp
        if -1.0 < age_s < _MOST_AGE_S:
            self._last_ns = max(self._last_ns, self._stamps.log_ns(round(timestamp * NS)))
        else:
            self._last_ns = max(self._last_ns, self.sink.now_ns())
            if not self._bad_stamps:
                self._bad_stamps = True
                text = "time stamps of the interface are not of this computer's clock"
                self.sink.event("can_stamps", f"{text}: times are those of arrival")
        return self._last_ns

    def _new(self, topic: Topic) -> int | None:
        """Announce a topic at its first frame; None if it is not chosen."""
        chosen = topic in (FRAMES, ERRORS) or self._selection.chooses(topic.name, "")
        stream = self._streams[topic.name] = self.sink.topic(topic) if chosen else None
        if chosen:
            self._up.add(topic.name)
            self.sink.link_up(topic.name, self.config.channel)
        return stream

    def _error(self, frame: CanFrame, received_ns: int) -> None:
        """Count an error frame, and note what it says of the bus."""
        self._count.errors += 1
        channel, classes = self.config.channel, frame.arbitration_id
        if classes & BUS_OFF:
            self.sink.event("can_bus_off", f"{channel}: the controller is off the bus")
        if classes & RESTARTED:
            self.sink.event("can_restarted", f"{channel}: the controller was restarted")
        if classes & CONTROLLER and len(frame.data) > 1 and frame.data[1] & RECEIVE_OVERFLOW:
            self._lost(1, received_ns, received_ns, "receive overflow in the controller")

    def _report(self) -> None:
        """Put a row of ``bus``, of the time since the last one."""
        now_ns, count = self.sink.now_ns(), self._count
        for number, reason in self._losses.new():
            self._lost(number, count.since_ns, now_ns, reason)
        loads = None
        if self._bitrate:
            span_s = (now_ns - count.since_ns) / NS
            loads = (100 * count.least_s / span_s, 100 * count.most_s / span_s)
        row = pack_bus(count.frames, count.errors, count.malformed, count.lost, loads)
        self.sink.message(self._bus, row, now_ns)
        self._count = _Interval(now_ns)

    def _lost(self, number: int, from_ns: int, to_ns: int, reason: str) -> None:
        """Note lost frames of the bus; of which topics they were is not known."""
        self._count.lost += number
        self.sink.lost(BUS.name, self.config.channel, from_ns, to_ns, number, reason)

    def _wait(self, stop: threading.Event, wait_s: float) -> None:
        """Wait before the interface is opened again; nothing can arrive meanwhile."""
        until_s = time.monotonic() + wait_s
        while not stop.is_set() and (left_s := until_s - time.monotonic()) > 0:
            self.sink.complete(self.sink.now_ns())
            stop.wait(min(_POLL_S, left_s))


def _one_line(error: BaseException) -> str:
    cause = f" ({error.__cause__})" if error.__cause__ is not None else ""
    return " ".join(f"{error}{cause}".split()) or type(error).__name__


def _clear(bus: Any) -> None:
    """Make slcan forget a line that it cannot read: it would fail at it again and again."""
    flush = getattr(bus, "flush", None)
    if flush is not None:
        with suppress(Exception):
            flush()


class _Losses:
    """Counters of frames that were lost before they could be read."""

    def __init__(self, bus: Any, config: CanOptions) -> None:
        self._socket = _socket_of(bus)
        self._folder = Path("/sys/class/net", config.channel, "statistics")
        self._has_statistics = config.interface == "socketcan" and "/" not in config.channel
        if self._socket is not None:
            with suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _ROOM_BYTES)
            with suppress(OSError):  # beyond the limit of the system, if the box may
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _ROOM_BYTES)
        self._before = self._counters()

    def new(self) -> Iterator[tuple[int, str]]:
        """Yield the number of frames lost since the last call, and why."""
        now = self._counters()
        for reason, number in now.items():
            if number > self._before.get(reason, number):
                yield number - self._before[reason], reason
        self._before = now

    def _counters(self) -> Mapping[str, int]:
        found = {}
        if self._socket is not None:
            with suppress(OSError, struct.error):
                size = _MEMINFO.size
                numbers = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, size)
                found["no room in the socket"] = _MEMINFO.unpack(numbers)[-1]
        for name in _STATISTICS if self._has_statistics else ():
            with suppress(OSError, ValueError):
                found[f"{name} of the interface"] = int((self._folder / name).read_text())
        return found


def _socket_of(bus: Any) -> socket.socket | None:
    """Return the socket that an interface reads, as a copy; None if it reads none."""
    try:
        number = os.dup(bus.fileno())
    except (OSError, NotImplementedError, ValueError):
        return None
    try:
        return socket.socket(fileno=number)
    except OSError:  # a serial port
        os.close(number)
        return None


@dataclass(frozen=True)
class CanLink:
    """A network interface as ``ip -details -json link`` shows it; ``problem`` if it does not."""

    listen_only: bool | None = None
    bitrate: int = 0
    data_bitrate: int = 0
    is_virtual: bool = False
    problem: str = ""


def read_link(channel: str) -> CanLink:
    """Ask ``ip`` how an interface is set."""
    command = ["ip", "-details", "-json", "link", "show", "dev", channel]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        return CanLink(problem=_one_line(error))
    if done.returncode:
        return CanLink(problem=_one_line(OSError(done.stderr.strip())))
    return parse_link(done.stdout)


def parse_link(text: str) -> CanLink:
    """Read what ``ip -details -json link`` prints of one interface."""
    try:
        info = json.loads(text)[0]["linkinfo"]
        data = info.get("info_data", {})
        modes = data.get("ctrlmode", [])
        rates = [int(data.get(key, {}).get("bitrate", 0)) for key in
                 ("bittiming", "data_bittiming")]  # fmt: skip
        is_virtual = info.get("info_kind") != "can"
    except (ValueError, LookupError, TypeError, AttributeError):
        return CanLink(problem="it is no CAN interface, or 'ip' is too old")
    return CanLink("LISTEN-ONLY" in modes, rates[0], rates[1], is_virtual)
