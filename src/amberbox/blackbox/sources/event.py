"""Events of the robot: ``amberbox.log`` of its own software, ROS parameters, system information."""

from __future__ import annotations

import os
import platform
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec

from amberbox.blackbox.sources.ros1.master import (
    NodeSettings,
    RosMaster,
    chosen_master,
    master_uri,
)
from amberbox.core.errors import AmberboxError
from amberbox.core.event_log import LONGEST_BYTES, SYSTEM_SOCKET, socket_places
from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.topic_selection import TopicPattern, pattern_problem
from amberbox.core.types import Topic
from amberbox.core.version import __version__

SAMPLE = """\
- event:
    listeners:
      - listener: {name: rosparam, event_type: ON_CHANGE, exclude: [/robot_description]}
      - listener: {name: system_info, event_type: ON_STARTUP}
    endpoint: tcp://127.0.0.1:5600
    topics:
      - topic: {name: grasp, max_frequency: 10}
"""
PASSIVE = (
    "waits for messages of programs on this computer; asks the ROS master for its parameters, "
    "without registering"
)

NO_SOCKET = "none"
_PEER = "programs"
_POLL_S = 0.1
_RETRY_S = 1.0
_MOST_AT_END = 1000
_MOST_NAMES = 500
_LONGEST_NAME = 64
_REPORT_S = 60.0  # between two reports of malformed messages
_MOST_BYTES = 1 << 20  # a longer message closes the connection of its sender (ZeroMQ)
_MOST_SHOWN = 3  # changes in the text of an event
_MOST_CHANGES = 100  # changes in its details
_LONGEST_VALUE = 200
_LONGEST_PATH = 107  # of a Unix socket, in bytes


@dataclass(frozen=True)
class Listener:
    """Something that is read again and again, or once."""

    name: Literal["rosparam", "system_info"] = option(doc="what is read: rosparam or system_info")
    event_type: Literal["ON_CHANGE", "ON_STARTUP"] = option(
        "ON_CHANGE", "record it when it has changed, or once at the start"
    )
    max_frequency: float = option(1.0, "how often it is read", unit="Hz")
    exclude: Sequence[str] = option((), "names and patterns of parameters to leave out")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        if not 0.001 <= self.max_frequency <= 30:
            yield "max_frequency", "must be between 0.001 and 30 Hz"
        yield from (("exclude", what) for what in filter(None, map(pattern_problem, self.exclude)))


@dataclass(frozen=True)
class EventOptions:
    """The ``event`` block."""

    listeners: Sequence[Listener] = option((), "what is watched besides messages of programs")
    socket: str = option(
        "", "Unix socket for amberbox.log, or none; where amberbox.log looks when absent"
    )
    endpoint: str = option("", "where ZeroMQ messages of programs arrive, tcp://ADDRESS:PORT")
    ros_master_uri: str = option("", "the ROS master; ROS_MASTER_URI or localhost when absent")
    topics: Sequence[TopicOptions] = option((), "options of messages of programs, by name")

    def in_folder(self, folder: Path) -> EventOptions:
        """Return the same with the socket's path seen from a folder."""
        if self.socket in ("", NO_SOCKET):
            return self
        return replace(self, socket=str(folder / Path(self.socket).expanduser()))

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        counts = Counter(listener.name for listener in self.listeners)
        for name in (name for name, count in counts.items() if count > 1):
            yield "listeners", f"{name} is there twice"
        transport, _, rest = self.endpoint.partition("://")
        port = rest.rpartition(":")[2]
        if self.endpoint and not (
            (transport == "tcp" and port.isdecimal() and 0 < int(port) < 65536)
            or (transport == "ipc" and rest)
        ):
            yield "endpoint", f"'{self.endpoint}' is no address; write tcp://127.0.0.1:5600"
        if len(os.fsencode(self.socket)) > _LONGEST_PATH:
            yield (
                "socket",
                f"is longer than the {_LONGEST_PATH} bytes that a socket's path may have",
            )
        if self.ros_master_uri:
            try:
                master_uri(self.ros_master_uri)
            except ValueError as error:
                yield "ros_master_uri", str(error)
        for topic in self.topics:
            if pattern_problem(topic.name):
                yield "topics", pattern_problem(topic.name)

    def notes(self) -> Iterator[tuple[str, str]]:
        """Yield a note where other computers can write into the record."""
        host = self.endpoint.partition("://")[2].rpartition(":")[0]
        if self.endpoint.startswith("tcp:") and host not in ("127.0.0.1", "localhost", "[::1]"):
            yield "endpoint", "whoever reaches this address can write into the record"


Config = EventOptions


def beside_recorder(config: EventOptions) -> EventOptions:
    """Return the same without the places where programs send: those are the recorder's."""
    return replace(config, socket=NO_SOCKET, endpoint="")


class EventSource:
    """Receives messages of programs, and watches what the listeners name."""

    lossless = False

    def __init__(self, config: EventOptions, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        """Return the options of the listed names, and the topics of the listeners."""
        listed = {topic.name for topic in self.config.topics}
        watched = [listener.name for listener in self.config.listeners]
        own = [TopicOptions(name, stamp="") for name in watched if name not in listed]
        everything = [TopicOptions("**")] if own or listed else []
        return [*self.config.topics, *own, *everything]

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Listen until ``stop`` is set; what is missing is tried again."""
        config, failed = self.config, threading.Event()

        def ends() -> bool:
            return stop.is_set() or failed.is_set()

        programs = _Programs(sink, [listener.name for listener in config.listeners])
        if jobs := self._receivers(programs, sink, ends):
            programs.expect(topic.name for topic in config.topics if "*" not in topic.name)
        for listener in config.listeners:
            watched = _Watched(listener, sink, _reader(listener, config))
            jobs.append(partial(watched.run, ends))
        with ThreadPoolExecutor(max(1, len(jobs))) as pool:
            running = [pool.submit(job) for job in jobs]
            ended, _ = wait(running, return_when=FIRST_EXCEPTION)
            failed.set()
        for job in ended:
            job.result()
        stop.wait()

    def _receivers(
        self, programs: _Programs, sink: Sink, ends: Callable[[], bool]
    ) -> list[Callable[[], None]]:
        config, jobs = self.config, list[Callable[[], None]]()
        if config.endpoint:
            jobs.append(partial(_receive_zmq, config.endpoint, programs, ends))
        if config.socket != NO_SOCKET:
            path = Path(config.socket or _usual_socket())
            jobs.append(partial(_receive_datagrams, path, programs, sink, ends))
        return jobs


Source = EventSource


def _usual_socket() -> str:
    """Return the place of the socket: that of the system if the recorder may write there."""
    places = socket_places(os.environ)
    may = os.access(Path(SYSTEM_SOCKET).parent, os.W_OK)
    return places[0] if may or len(places) == 1 else places[-1]


class _Message(msgspec.Struct, forbid_unknown_fields=True):
    """What a program sends: an event, or how many it could not send."""

    name: str = ""
    stamp: int | float | str | None = None
    values: dict[str, Any] = {}
    lost: dict[str, int] = {}
    from_ns: int = 0
    to_ns: int = 0


_decode = msgspec.json.Decoder(_Message).decode


@dataclass
class _Programs:
    """Takes messages of programs; any thread."""

    sink: Sink
    taken: Sequence[str]
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _streams: dict[str, int] = field(default_factory=dict)
    _malformed: int = 0
    _reported_s: float = float("-inf")

    def take(self, data: bytes) -> None:
        """Record one message, or count it as malformed."""
        with self._lock:
            try:
                problem = "" if len(data) <= LONGEST_BYTES else f"{len(data)} bytes"
                message = _decode(data) if not problem else _Message()
                problem = problem or self._problem(message)
            except (msgspec.MsgspecError, ValueError, RecursionError) as error:
                problem = str(error) or type(error).__name__
            if problem:
                self._count_malformed(problem)
            elif message.lost:
                self._report_lost(message)
            else:
                stamp = {} if message.stamp is None else {"stamp": message.stamp}
                row = msgspec.json.encode({**stamp, **message.values})
                self.sink.message(self._stream(message.name), row, self.sink.now_ns())

    def expect(self, names: Iterable[str]) -> None:
        """Note that messages of these names can arrive from now on."""
        for name in names:
            self.sink.link_up(name, _PEER)

    def _problem(self, message: _Message) -> str:
        names = [message.name] if not message.lost else [n for n in message.lost if n]
        for name in names:
            if not _is_name(name):
                return f"a name of {len(name)} characters, or with others than A-Z a-z 0-9 _ . / -"
            if name in self.taken:
                return f"the name '{name}', which is a listener's"
            if name not in self._streams and len(self._streams) + len(names) > _MOST_NAMES:
                return f"more than {_MOST_NAMES} names"
        if any(count < 1 for count in message.lost.values()):
            return "a number of lost messages below 1"
        return ""

    def _stream(self, name: str) -> int:
        if name not in self._streams:
            self._streams[name] = self.sink.topic(Topic(name, "json"))
            self.sink.link_up(name, _PEER)
        return self._streams[name]

    def _report_lost(self, message: _Message) -> None:
        """Note what a program could not send: an event, and a gap of each item."""
        now_ns, total = self.sink.now_ns(), sum(message.lost.values())
        length_ns = min(max(message.to_ns - message.from_ns, 0), now_ns - 1)
        reason = "dropped by the program: no recorder listened, or its queue was full"
        for name, count in message.lost.items():
            if name:
                self._stream(name)
                self.sink.lost(name, _PEER, now_ns - length_ns, now_ns, count, reason)
        text = f"{total} messages of a program were {reason}"
        self.sink.event("log_lost", text, lost=message.lost)

    def _count_malformed(self, problem: str) -> None:
        self._malformed += 1
        if time.monotonic() - self._reported_s >= _REPORT_S:
            self._reported_s = time.monotonic()
            text = f"a message of a program is left out: {' '.join(problem.split())[:200]}"
            self.sink.event("log_malformed", text, count=self._malformed)


def _is_name(name: str) -> bool:
    return (
        0 < len(name) <= _LONGEST_NAME
        and name.isascii()
        and name[0].isalpha()
        and all(c.isalnum() or c in "_./-" for c in name)
    )


def _receive_datagrams(
    path: Path, programs: _Programs, sink: Sink, ends: Callable[[], bool]
) -> None:
    told = ""
    while not ends():
        try:
            receiver = _bound(path)
        except OSError as error:
            problem = f"{path}: {error.strerror or error}"
            if problem != told:
                sink.event("log_socket_missing", f"amberbox.log cannot send to {problem}")
            told = problem
            time.sleep(_POLL_S)
            continue
        with receiver:
            while not ends():
                with suppress(TimeoutError):
                    programs.take(receiver.recv(LONGEST_BYTES + 1))
            with suppress(OSError):
                path.unlink()
            receiver.setblocking(False)
            with suppress(BlockingIOError):  # what was sent before the end
                for _ in range(_MOST_AT_END):
                    programs.take(receiver.recv(LONGEST_BYTES + 1))


def _bound(path: Path) -> socket.socket:
    """Bind the socket; one that a killed recorder has left is replaced. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
            try:
                other.connect(str(path))
            except FileNotFoundError:
                pass
            except ConnectionRefusedError:
                path.unlink()
            else:
                raise OSError("another recorder listens there")
        made.bind(str(path))
        path.chmod(0o666)  # programs of other users; the folder decides who reaches it
        made.settimeout(_POLL_S)
    except OSError:
        made.close()
        raise
    return made


def _receive_zmq(endpoint: str, programs: _Programs, ends: Callable[[], bool]) -> None:
    try:
        import zmq
    except ImportError as error:
        raise AmberboxError("'endpoint' needs pyzmq", "pip install 'amberbox[zmq]'") from error
    context = zmq.Context()
    receiver = context.socket(zmq.PULL)
    receiver.maxmsgsize = _MOST_BYTES
    receiver.rcvtimeo = round(_POLL_S * 1000)
    try:
        try:
            receiver.bind(endpoint)
        except zmq.ZMQError as error:
            raise AmberboxError(f"cannot listen at {endpoint}: {error}") from error
        while not ends():
            with suppress(zmq.Again):
                for frame in receiver.recv_multipart():
                    programs.take(frame)
        receiver.rcvtimeo = 0
        with suppress(zmq.Again):  # what has arrived before the end
            for _ in range(_MOST_AT_END):
                for frame in receiver.recv_multipart():
                    programs.take(frame)
    finally:
        context.destroy(linger=0)


Read = Callable[[], Mapping[str, Any]]


@dataclass
class _Watched:
    """What a listener reads, and the last that was recorded of it."""

    listener: Listener
    sink: Sink
    read: Read
    _is_up: bool = False
    _trouble: str = ""

    def run(self, ends: Callable[[], bool]) -> None:
        """Read again and again, or once; what cannot be read is tried again."""
        name, encode = self.listener.name, msgspec.json.Encoder(order="sorted").encode
        stream = self.sink.topic(Topic(name, "json", latched=True))
        last, is_recorded = self.sink.last_latched(name), False
        while not ends():
            try:
                data = encode(self.read())
            except (AmberboxError, OSError, msgspec.MsgspecError, RecursionError) as error:
                self._down(str(error))
            else:
                self._up()
                if data != last and last is not None:
                    self._report_change(last, data)
                if data != last or not is_recorded:
                    self.sink.message(stream, data, self.sink.now_ns())
                last, is_recorded = data, True
                if self.listener.event_type == "ON_STARTUP":
                    return
            until_s = time.monotonic() + 1 / self.listener.max_frequency
            while not ends() and (left_s := until_s - time.monotonic()) > 0:
                time.sleep(min(left_s, _POLL_S))

    def _up(self) -> None:
        if not self._is_up:
            self._is_up, self._trouble = True, ""
            self.sink.link_up(self.listener.name, self.listener.name)

    def _down(self, reason: str) -> None:
        if self._is_up:
            self._is_up = False
            self.sink.link_down(self.listener.name, self.listener.name, reason)
        if reason != self._trouble:
            self._trouble = reason
            text = f"{self.listener.name} cannot be read: {reason}; it is tried again"
            self.sink.event(f"{self.listener.name}_unreadable", " ".join(text.split()))

    def _report_change(self, before: bytes, after: bytes) -> None:
        try:
            was, now = (dict(_leaves(msgspec.json.decode(data))) for data in (before, after))
        except (msgspec.MsgspecError, RecursionError):
            return
        changed = {
            path: [_shown(was.get(path)), _shown(now.get(path))]
            for path in sorted({*was, *now})
            if was.get(path) != now.get(path)
        }
        parts = [f"{path}: {a} -> {b}" for path, (a, b) in list(changed.items())[:_MOST_SHOWN]]
        more = len(changed) - len(parts)
        text = ", ".join(parts) + (f" and {more} more" if more > 0 else "")
        details = dict(list(changed.items())[:_MOST_CHANGES])
        self.sink.event(f"{self.listener.name}_changed", " ".join(text.split()), changed=details)


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict) and (value or path):
        for key, inner in value.items():
            yield from _leaves(inner, f"{path}/{key}")
    else:
        yield path, value


def _shown(value: Any) -> str:
    text = "none" if value is None else msgspec.json.encode(value).decode()
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."


def _reader(listener: Listener, config: EventOptions) -> Read:
    if listener.name == "system_info":
        return read_system_info
    exclude = [TopicPattern(text) for text in listener.exclude]
    uri = chosen_master(config.ros_master_uri, os.environ)
    master = RosMaster(NodeSettings(master_uri=uri))
    return lambda: _without(master.parameters(), exclude)


def _without(tree: Mapping[str, Any], exclude: Sequence[TopicPattern], above: str = "") -> Any:
    """Return a tree of parameters without those that are excluded."""
    return {
        key: _without(value, exclude, f"{above}/{key}") if isinstance(value, dict) else value
        for key, value in tree.items()
        if not any(pattern.fits(f"{above}/{key}") for pattern in exclude)
    }


def read_system_info() -> Mapping[str, Any]:
    """Return what the computer of the box is: hardware, system, network addresses, versions."""
    import psutil

    return {
        "hostname": platform.node(),
        "model": _first_line("/proc/device-tree/model", "/sys/class/dmi/id/product_name"),
        "os": _os_name(),
        "kernel": platform.release(),
        "architecture": platform.machine(),
        "cpus": os.cpu_count(),
        "memory_bytes": psutil.virtual_memory().total,
        "boot_id": _first_line("/proc/sys/kernel/random/boot_id"),
        "python": platform.python_version(),
        "amberbox": __version__,
        "addresses": {
            name: sorted(a.address for a in addresses if a.family in (2, socket.AF_INET6))
            for name, addresses in sorted(psutil.net_if_addrs().items())
            if name != "lo"
        },
    }


def _os_name() -> str:
    with suppress(OSError):
        return platform.freedesktop_os_release().get("PRETTY_NAME", "")
    return platform.system()


def _first_line(*paths: str) -> str:
    """Return the text of the first of some files that can be read."""
    for path in paths:
        with suppress(OSError, UnicodeDecodeError):
            return Path(path).read_text("utf-8").strip("\0 \n")
    return ""
