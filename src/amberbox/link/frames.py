"""The frames of the link: one struct each, msgpack with a checksum in front.

TCP's own checksum lets one damaged segment in some millions through, and a link without TLS has no
other; so each frame begins with the CRC-32 of its content, little-endian.
"""

from __future__ import annotations

import zlib
from typing import Annotated, TypeAlias

import msgspec
from msgspec import Meta, Struct

from amberbox.link import limits
from amberbox.link.positions import Count, Place, Reach, TimeNs

Name = Annotated[str, Meta(max_length=128)]
Text = Annotated[str, Meta(max_length=limits.TEXT_BYTES)]
Writers = Annotated[dict[Name, Reach], Meta(max_length=8)]
Cursor: TypeAlias = dict[str, Place]
Upto = Annotated[dict[Name, Place], Meta(max_length=8)]


class FrameError(ValueError):
    """What came is no frame: damaged, too large, or of another protocol."""


class Row(Struct, frozen=True, array_like=True):
    """One record of a robot's conclusions, its bytes as they stand in the journal."""

    writer: Name
    run: Count
    seq: Count
    channel: Name
    log_ns: TimeNs
    data: bytes

    @property
    def place(self) -> Place:
        """Where it stands in its writer's journal."""
        return Place(self.run, self.seq)


class Hello(Struct, frozen=True, tag="hello"):
    """The robot's first word: who it is, and what its store holds."""

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


class Rows(Struct, frozen=True, tag="rows"):
    """Rows, and up to where all rows of each writer have been sent by now."""

    epoch: Count
    number: Count
    rows: Annotated[list[Row], Meta(max_length=limits.ROWS_COUNT)]
    upto: Upto


class Durable(Struct, frozen=True, tag="durable"):
    """How far the robot's journals survive a power cut."""

    epoch: Count
    writers: Writers


class Live(Struct, frozen=True, tag="live"):
    """The latest value of each variable that somebody looks at; never stored."""

    epoch: Count
    values: Annotated[
        dict[Text, tuple[TimeNs, float | str | None]], Meta(max_length=limits.VARIABLES)
    ]


class Beat(Struct, frozen=True, tag="beat"):
    """The robot is there. ``mono_ns`` is its time since boot; ``backlog`` rows are not sent yet.

    ``offset_ns`` is its estimate of the server's clock minus its own, ``round_ns`` the round trip
    that it comes from; None before there is one. ``monitoring`` is how its watcher is doing
    (running, overloaded, silent, absent; empty where that is not known), ``delay_s`` how late that
    evaluates what is recorded, in seconds.
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


class Heads(Struct, frozen=True, tag="heads"):
    """The robot's signed statement of how far everything reaches, as JSON."""

    epoch: Count
    heads: bytes


class Has(Struct, frozen=True, tag="has"):
    """Journals that hold the window of a Fetch, which are copied now: name and bytes.

    ``id`` is that of the Fetch; without files the robot holds nothing of the window.
    """

    epoch: Count
    files: Annotated[list[tuple[Text, Count]], Meta(max_length=limits.FILES)]
    id: Name = ""


class Welcome(Struct, frozen=True, tag="welcome"):
    """The server's answer to Hello: from where on it wants rows, in which epoch."""

    epoch: int
    cursor: Cursor
    server_wall_ns: int
    wants_folder: bool = False
    watch: list[str] = []


class Ack(Struct, frozen=True, tag="ack"):
    """All frames of rows up to ``number`` are stored; ``cursor`` need never be sent again."""

    number: int
    cursor: Cursor


class Pong(Struct, frozen=True, tag="pong"):
    """The answer to Beat: the server's clock, and the robot's time given back."""

    wall_ns: int
    mono_ns: int


class Watch(Struct, frozen=True, tag="watch"):
    """Variables whose latest values somebody looks at now, in place of those before."""

    variables: Annotated[list[Text], Meta(max_length=limits.VARIABLES)]


class Fetch(Struct, frozen=True, tag="fetch"):
    """Somebody wants a window of an item; empty means all items."""

    id: str
    item: str
    from_ns: int
    to_ns: int


class Bye(Struct, frozen=True, tag="bye"):
    """Why the sender ends the link; ``for_good`` says that to try again is of no use now."""

    reason: Text
    for_good: bool = False


RobotFrame: TypeAlias = Hello | Rows | Durable | Live | Beat | Heads | Has | Bye
ServerFrame: TypeAlias = Welcome | Ack | Pong | Watch | Fetch | Bye

_ENCODER = msgspec.msgpack.Encoder()
_FROM_ROBOT: msgspec.msgpack.Decoder[RobotFrame] = msgspec.msgpack.Decoder(RobotFrame)
_FROM_SERVER: msgspec.msgpack.Decoder[ServerFrame] = msgspec.msgpack.Decoder(ServerFrame)


def encode(frame: RobotFrame | ServerFrame) -> bytes:
    """Write a frame; raises FrameError when it is too large to be taken."""
    content = _ENCODER.encode(frame)
    if len(content) + 4 > limits.FRAME_BYTES:
        raise FrameError(f"a frame of {len(content)} bytes is too large")
    return zlib.crc32(content).to_bytes(4, "little") + content


def from_robot(data: bytes) -> RobotFrame:
    """Read a frame that a robot sent; raises FrameError when it is none."""
    try:
        return _FROM_ROBOT.decode(_checked(data))
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise FrameError(f"no frame: {error}") from error


def from_server(data: bytes) -> ServerFrame:
    """Read a frame that a server sent; raises FrameError when it is none."""
    try:
        return _FROM_SERVER.decode(_checked(data))
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise FrameError(f"no frame: {error}") from error


def _checked(data: bytes) -> memoryview:
    if not 4 < len(data) <= limits.FRAME_BYTES:
        raise FrameError(f"{len(data)} bytes")
    content = memoryview(data)[4:]
    if zlib.crc32(content) != int.from_bytes(data[:4], "little"):
        raise FrameError("the checksum does not fit")
    return content
