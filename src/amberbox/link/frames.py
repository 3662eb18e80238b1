"""The frames of the link: one struct each, MessagePack with a checksum; journal positions.

TCP's checksum misses about one damaged segment in some millions, and a link without TLS has no
other; so each frame begins with the CRC-32 of its content, little-endian.
"""

from __future__ import annotations

import zlib
from typing import Annotated, NamedTuple, TypeAlias, TypeVar

import msgspec
from msgspec import Meta, Struct

from amberbox.link import limits

# Largest number that a robot may send: sums and ends of ranges still fit into 64 bits
LARGEST = 2**62

# A number, size or position that a robot sends
Count: TypeAlias = Annotated[int, Meta(ge=0, le=LARGEST)]
# A time, duration or clock offset in nanoseconds that a robot sends; until the year 2116
TimeNs: TypeAlias = Annotated[int, Meta(ge=-LARGEST, le=LARGEST)]


def is_in_range(*numbers: int) -> bool:
    """Return whether numbers from a robot fit into databases, columns and times."""
    return all(-LARGEST <= number <= LARGEST for number in numbers)


class JournalPosition(NamedTuple):
    """A position in a writer's journals: all rows before ``(run, seq)``."""

    run: Count = 0
    seq: Count = 0


START = JournalPosition()


class RunEnd(msgspec.Struct, frozen=True, array_like=True):
    """One run of a writer on the robot's disk: the boot that wrote it, and its present end.

    ``closed``: it is no longer written, and its end survives a power cut.
    """

    run: Count
    boot: str
    end_seq: Count
    closed: bool = True


class WriterReach(msgspec.Struct, frozen=True, array_like=True):
    """The reach of a writer's journals: oldest row, end, durable end, and runs."""

    oldest: JournalPosition
    end: JournalPosition
    durable: JournalPosition
    runs: tuple[RunEnd, ...] = ()

    def problem(self) -> str:
        """Return the contradiction in it; empty if there is none."""
        if min(*self.oldest, *self.end, *self.durable) < 0:
            return "a position below 0"
        numbers = [run.run for run in self.runs]
        ends = [run.end_seq for run in self.runs]
        if not is_in_range(*self.oldest, *self.end, *self.durable, *ends, *numbers):
            return "a position that is out of range"
        if self.durable > self.end:
            return "more is durable than was written"
        if numbers != sorted(set(numbers)):
            return "runs out of order"
        return "a run that ends below 0" if any(run.end_seq < 0 for run in self.runs) else ""


Name = Annotated[str, Meta(max_length=128)]
Text = Annotated[str, Meta(max_length=limits.TEXT_BYTES)]
Writers = Annotated[dict[Name, WriterReach], Meta(max_length=8)]
Cursor: TypeAlias = dict[str, JournalPosition]
Upto = Annotated[dict[Name, JournalPosition], Meta(max_length=8)]


class FrameError(ValueError):
    """Data that are not a valid frame: damaged, too large, or of another protocol."""


class LinkRow(Struct, frozen=True, array_like=True):
    """One record of a robot's conclusions, with the bytes as in the journal."""

    writer: Name
    run: Count
    seq: Count
    channel: Name
    log_ns: TimeNs
    data: bytes

    @property
    def place(self) -> JournalPosition:
        """Its position in the writer's journals."""
        return JournalPosition(self.run, self.seq)


class Hello(Struct, frozen=True, tag="hello"):
    """The robot's first frame: its id and store, and how far its journals reach."""

    robot: Name
    store_id: Name
    boot_id: Name
    writers: Writers
    config_hash: Name
    wall_ns: TimeNs
    mono_ns: TimeNs
    version: Name
    protocol: int = limits.PROTOCOL
    public_key: Name = ""


class RowsFrame(Struct, frozen=True, tag="rows"):
    """Rows, and the position up to which all rows of each writer have been sent."""

    epoch: Count
    number: Count
    rows: Annotated[list[LinkRow], Meta(max_length=limits.ROWS_COUNT)]
    upto: Upto


class DurableFrame(Struct, frozen=True, tag="durable"):
    """How far the robot's journals survive a power cut."""

    epoch: Count
    writers: Writers


class LiveFrame(Struct, frozen=True, tag="live"):
    """The latest value of each watched variable; never stored."""

    epoch: Count
    values: Annotated[
        dict[Text, tuple[TimeNs, float | str | None]], Meta(max_length=limits.VARIABLES)
    ]


class BeatFrame(Struct, frozen=True, tag="beat"):
    """A heartbeat. ``mono_ns`` is the robot's time since boot; ``backlog`` counts unsent rows.

    ``offset_ns`` is its estimate of the server's clock minus its own, ``round_ns`` the round trip
    of that estimate; None before there is one. ``monitoring`` is the state of its watcher (running,
    overloaded, silent, absent; empty where unknown), ``delay_s`` how late that evaluates rows, in
    seconds.
    """

    epoch: Count
    wall_ns: TimeNs
    mono_ns: TimeNs
    backlog: Count = 0
    offset_ns: TimeNs | None = None
    round_ns: TimeNs | None = None
    backlog_bytes: Count = 0
    monitoring: Name = ""
    delay_s: float = 0.0


class HeadsFrame(Struct, frozen=True, tag="heads"):
    """The robot's signed statement of how far its journals reach, as JSON."""

    epoch: Count
    heads: bytes


class HasFrame(Struct, frozen=True, tag="has"):
    """Journals that hold the window of a Fetch and are copied now: name and bytes.

    ``id`` is that of the Fetch; without files the robot holds nothing of the window.
    """

    epoch: Count
    files: Annotated[list[tuple[Text, Count]], Meta(max_length=limits.FILES)]
    id: Name = ""


class Welcome(Struct, frozen=True, tag="welcome"):
    """The server's answer to Hello: the epoch, and the positions from which to send rows."""

    epoch: int
    cursor: Cursor
    server_wall_ns: int
    wants_folder: bool = False
    watch: list[str] = []


class Ack(Struct, frozen=True, tag="ack"):
    """All row frames up to ``number`` are stored; rows before ``cursor`` are never needed again."""

    number: int
    cursor: Cursor


class Pong(Struct, frozen=True, tag="pong"):
    """The answer to a heartbeat: the server's clock, and the heartbeat's ``mono_ns``."""

    wall_ns: int
    mono_ns: int


class WatchFrame(Struct, frozen=True, tag="watch"):
    """The variables whose latest values are requested, replacing earlier ones."""

    variables: Annotated[list[Text], Meta(max_length=limits.VARIABLES)]


class FetchFrame(Struct, frozen=True, tag="fetch"):
    """Request for a window of an item's record; empty means all items."""

    id: str
    item: str
    from_ns: int
    to_ns: int


class Bye(Struct, frozen=True, tag="bye"):
    """Why the sender closes the link; ``for_good``: reconnecting is useless."""

    reason: Text
    for_good: bool = False


RobotFrame: TypeAlias = (
    Hello | RowsFrame | DurableFrame | LiveFrame | BeatFrame | HeadsFrame | HasFrame | Bye
)
ServerFrame: TypeAlias = Welcome | Ack | Pong | WatchFrame | FetchFrame | Bye
FrameT = TypeVar("FrameT")

_ENCODER = msgspec.msgpack.Encoder()
_FROM_ROBOT: msgspec.msgpack.Decoder[RobotFrame] = msgspec.msgpack.Decoder(RobotFrame)
_FROM_SERVER: msgspec.msgpack.Decoder[ServerFrame] = msgspec.msgpack.Decoder(ServerFrame)


def encode(frame: RobotFrame | ServerFrame) -> bytes:
    """Encode a frame; raises FrameError when it is too large."""
    content = _ENCODER.encode(frame)
    if len(content) + 4 > limits.FRAME_BYTES:
        raise FrameError(f"a frame of {len(content)} bytes is too large")
    return zlib.crc32(content).to_bytes(4, "little") + content


def from_robot(data: bytes) -> RobotFrame:
    """Decode a frame from a robot; raises FrameError for invalid data."""
    return _decoded(_FROM_ROBOT, data)


def from_server(data: bytes) -> ServerFrame:
    """Decode a frame from a server; raises FrameError for invalid data."""
    return _decoded(_FROM_SERVER, data)


def _decoded(decoder: msgspec.msgpack.Decoder[FrameT], data: bytes) -> FrameT:
    try:
        if not 4 < len(data) <= limits.FRAME_BYTES:
            raise FrameError(f"{len(data)} bytes")
        content = memoryview(data)[4:]
        if zlib.crc32(content) != int.from_bytes(data[:4], "little"):
            raise FrameError("the checksum does not fit")
        return decoder.decode(content)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise FrameError(f"no frame: {error}") from error
