"""A source of datagrams that takes their times of receipt from the kernel, as a bus's would."""

from __future__ import annotations

import os
import socket
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

from amberbox.core.clock import StampConverter
from amberbox.core.files import wait_readable
from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.types import Schema, Topic

SAMPLE = "- stamped: {port: 4711}\n"
PASSIVE = "receives datagrams"
DATAGRAM = Topic("/datagram", "ros1", Schema("std_msgs/Int64", "ros1msg", b"int64 data\n"))
_SO_TIMESTAMPNS = 35
_TIMESPEC = struct.Struct("@ll")


@dataclass(frozen=True)
class Config:
    """The ``stamped`` block."""

    port: int = option(0, "where it listens on the loopback interface")
    process: bool = option(True, "whether it runs in a process of its own")


def needs_process(config: Config) -> bool:
    """Return what the configuration says."""
    return config.process


class Source:
    """Reads datagrams until there are no more, then says so."""

    lossless = False
    late_s = 10.0

    def __init__(self, config: Config, name: str) -> None:
        self._config = config

    def topics(self) -> Sequence[TopicOptions]:
        """Return the one topic."""
        return [TopicOptions(DATAGRAM.name)]

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Receive until ``stop`` is set."""
        stream, stamps = sink.topic(DATAGRAM), StampConverter(sink.now_ns)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bus:
            bus.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            bus.bind(("127.0.0.1", self._config.port))
            sink.save_state({"pid": os.getpid()})
            while not stop.is_set():
                until_ns = sink.now_ns()
                for data, stamp_ns in _waiting(bus):
                    sink.message(stream, data, stamps.log_ns(stamp_ns))
                sink.complete(until_ns)
                wait_readable([bus], 0.05)


def _waiting(bus: socket.socket) -> Iterator[tuple[bytes, int]]:
    """Yield the datagrams that wait, and when the kernel received them (CLOCK_REALTIME, ns)."""
    with suppress(BlockingIOError):
        while True:
            data, ancillary, _, _ = bus.recvmsg(64, 64, socket.MSG_DONTWAIT)
            seconds, nanoseconds = _TIMESPEC.unpack(ancillary[0][2])
            yield data, seconds * 1_000_000_000 + nanoseconds
