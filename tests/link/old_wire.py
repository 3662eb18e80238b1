"""The link's frames as version ef939a5 defined them: a copy that never changes.

An old end decodes with these definitions what a newer one sends.
"""

from __future__ import annotations

import zlib
from typing import Annotated, NamedTuple, TypeAlias, TypeVar

import msgspec
from msgspec import Meta, Struct

FRAME_BYTES = 1 << 20


class Place(NamedTuple):
    """A place in a writer's journal: everything before ``(run, seq)``."""

    run: int = 0
    seq: int = 0


class RunEnd(Struct, frozen=True, array_like=True):
    """One run of a writer on the robot's disk."""

    run: int
    boot: str
    end_seq: int
    closed: bool = True


class Reach(Struct, frozen=True, array_like=True):
    """How far a writer's journal reaches."""

    oldest: Place
    end: Place
    durable: Place
    runs: tuple[RunEnd, ...] = ()


Count = Annotated[int, Meta(ge=0)]
Name = Annotated[str, Meta(max_length=128)]
Text = Annotated[str, Meta(max_length=4096)]
Writers = Annotated[dict[Name, Reach], Meta(max_length=8)]
Cursor: TypeAlias = dict[str, Place]
Upto = Annotated[dict[Name, Place], Meta(max_length=8)]


class Row(Struct, frozen=True, array_like=True):
    """One record of a robot's conclusions."""

    writer: Name
    run: Count
    seq: Count
    channel: Name
    log_ns: int
    data: bytes


class Hello(Struct, frozen=True, tag="hello"):
    """The robot's first word."""

    robot: Name
    store_id: Name
    boot_id: Name
    writers: Writers
    config_hash: Name
    wall_ns: int
    mono_ns: int
    version: Name
    protocol: int = 1
    public_key: Name = ""


class Rows(Struct, frozen=True, tag="rows"):
    """Rows."""

    epoch: Count
    number: Count
    rows: Annotated[list[Row], Meta(max_length=2000)]
    upto: Upto


class Durable(Struct, frozen=True, tag="durable"):
    """How far the robot's journals survive a power cut."""

    epoch: Count
    writers: Writers


class Live(Struct, frozen=True, tag="live"):
    """The latest value of each variable."""

    epoch: Count
    values: Annotated[dict[Text, tuple[int, float | str | None]], Meta(max_length=1000)]


class Beat(Struct, frozen=True, tag="beat"):
    """The robot is there."""

    epoch: Count
    wall_ns: int
    mono_ns: int
    backlog: Count = 0
    offset_ns: int | None = None
    round_ns: int | None = None
    backlog_bytes: Count = 0


class Heads(Struct, frozen=True, tag="heads"):
    """The robot's signed statement."""

    epoch: Count
    heads: bytes


class Has(Struct, frozen=True, tag="has"):
    """Journals that hold a window."""

    epoch: Count
    files: Annotated[list[tuple[Text, Count]], Meta(max_length=2000)]
    id: Name = ""


class Welcome(Struct, frozen=True, tag="welcome"):
    """The server's answer to Hello."""

    epoch: int
    cursor: Cursor
    server_wall_ns: int
    wants_folder: bool = False
    watch: list[str] = []


class Ack(Struct, frozen=True, tag="ack"):
    """Frames of rows up to ``number`` are stored."""

    number: int
    cursor: Cursor


class Pong(Struct, frozen=True, tag="pong"):
    """The answer to Beat."""

    wall_ns: int
    mono_ns: int


class Watch(Struct, frozen=True, tag="watch"):
    """Variables that somebody looks at."""

    variables: Annotated[list[Text], Meta(max_length=1000)]


class Fetch(Struct, frozen=True, tag="fetch"):
    """Somebody wants a window."""

    id: str
    item: str
    from_ns: int
    to_ns: int


class Bye(Struct, frozen=True, tag="bye"):
    """Why the sender ends the link."""

    reason: Text
    for_good: bool = False


RobotFrame: TypeAlias = Hello | Rows | Durable | Live | Beat | Heads | Has | Bye
ServerFrame: TypeAlias = Welcome | Ack | Pong | Watch | Fetch | Bye
FrameT = TypeVar("FrameT")
_FROM_ROBOT: msgspec.msgpack.Decoder[RobotFrame] = msgspec.msgpack.Decoder(RobotFrame)
_FROM_SERVER: msgspec.msgpack.Decoder[ServerFrame] = msgspec.msgpack.Decoder(ServerFrame)


def encode(frame: RobotFrame | ServerFrame) -> bytes:
    """Write a frame."""
    content = msgspec.msgpack.encode(frame)
    return zlib.crc32(content).to_bytes(4, "little") + content


def from_robot(data: bytes) -> RobotFrame:
    """Read a frame at an old server; raises ValueError when it is none, which ends the link."""
    return _decoded(_FROM_ROBOT, data)


def from_server(data: bytes) -> ServerFrame:
    """Read a frame at an old robot; raises ValueError when it is none, which ends the link."""
    return _decoded(_FROM_SERVER, data)


def _decoded(decoder: msgspec.msgpack.Decoder[FrameT], data: bytes) -> FrameT:
    if not 4 < len(data) <= FRAME_BYTES:
        raise ValueError(f"{len(data)} bytes")
    if zlib.crc32(data[4:]) != int.from_bytes(data[:4], "little"):
        raise ValueError("the checksum does not fit")
    return decoder.decode(data[4:])
