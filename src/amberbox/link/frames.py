"""The frames of the link: one struct each, MessagePack with a checksum; journal positions.

TCP's checksum misses about one damaged segment in some millions, and a link without TLS has no
other; so each frame begins with the CRC-32 of its content, little-endian.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection
from typing import Annotated, Literal, NamedTuple, TypeAlias, TypeVar, get_args

import msgspec
from msgspec import Meta, Struct

from amberbox.core.command import (
    CHALLENGE_BYTES,
    COMMAND_BYTES,
    CommandAnswer,
    CommandId,
    KeyId,
    LeaseState,
)
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
Capability = Annotated[str, Meta(max_length=limits.CAPABILITY_LENGTH)]
Capabilities = Annotated[list[Capability], Meta(max_length=limits.CAPABILITIES)]
EncodedCommand = Annotated[bytes, Meta(max_length=COMMAND_BYTES)]


class FrameError(ValueError):
    """Data that are not a valid frame: damaged, too large, or of another protocol."""


class UnknownFrameError(FrameError):
    """A sound frame with an unknown tag, as a newer version may send; it is ignored and counted."""


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
    """The robot's first frame: its id and store, how far its journals reach, what it can do.

    ``more`` are the journals of ``limits.LATER_WRITERS``, which servers before them overlook.
    """

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
    capabilities: Capabilities = []
    more: Writers = {}


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


class ChallengeFrame(Struct, frozen=True, tag="challenge"):
    """Random bytes that the robot has minted, for signatures of the next minute; its lease.

    It is sent at the beginning, every 10 s, and whenever the lease or the motion changes that waits
    for its confirmation: ``waiting`` is the command's id, ``by_code`` whether a code is shown at
    the robot for it, ``tries`` how many wrong codes were entered.
    """

    epoch: Count
    challenge: Annotated[bytes, Meta(min_length=CHALLENGE_BYTES, max_length=CHALLENGE_BYTES)]
    lease: LeaseState = LeaseState()
    waiting: Annotated[str, Meta(pattern=r"\A([0-9a-f]{32})?\Z")] = ""
    by_code: bool = False
    tries: Count = 0


class ActionsFrame(Struct, frozen=True, tag="actions"):
    """What the robot can do, as JSON: names, risks, parameters with their limits."""

    epoch: Count
    announcement: Annotated[bytes, Meta(max_length=limits.ACTIONS_BYTES)]


class AnswersFrame(Struct, frozen=True, tag="answers"):
    """What the robot says of commands, in the order of its answers; frames are counted from 1."""

    epoch: Count
    number: Count
    answers: Annotated[list[CommandAnswer], Meta(max_length=limits.ANSWERS_COUNT)]


class Welcome(Struct, frozen=True, tag="welcome"):
    """The server's answer to Hello: the epoch, and the positions from which to send rows.

    ``server_id`` is the random id of the server; empty from a server before it had one.
    """

    epoch: int
    cursor: Cursor
    server_wall_ns: int
    wants_folder: bool = False
    watch: list[str] = []
    capabilities: Capabilities = []
    server_id: Name = ""


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


class CommandsFrame(Struct, frozen=True, tag="commands"):
    """Commands as they were encoded; each is sent again on later contacts until it is answered."""

    commands: Annotated[list[EncodedCommand], Meta(max_length=limits.COMMANDS_COUNT)]


class AnsweredFrame(Struct, frozen=True, tag="answered"):
    """All answers of the robot up to ``number`` are stored; they are never needed again."""

    number: Count


class RevokedFrame(Struct, frozen=True, tag="revoked"):
    """Persons' keys that are revoked for ever, by id, besides those of earlier frames."""

    keys: Annotated[list[KeyId], Meta(max_length=limits.KEYS_COUNT)]


class LeaseFrame(Struct, frozen=True, tag="lease"):
    """A run takes, renews or releases the robot; ``number`` is that of the lease it has."""

    do: Literal["take", "renew", "release"]
    holder: Name
    run: Name
    number: Count = 0


class AbortFrame(Struct, frozen=True, tag="abort"):
    """Stop what a run or one command does, safely; without either all that the robot does.

    ``who`` is the person, as the server says.
    """

    run: Name = ""
    command: Name = ""
    who: Name = ""


class ConfirmFrame(Struct, frozen=True, tag="code"):
    """The code that somebody has read at the robot, to confirm this motion and no other."""

    command: CommandId
    code: Annotated[str, Meta(max_length=16)]


class Bye(Struct, frozen=True, tag="bye"):
    """Why the sender closes the link; ``for_good``: reconnecting is useless."""

    reason: Text
    for_good: bool = False


# Frames that need the capability limits.COMMANDS, said by both ends
RobotCommandFrame: TypeAlias = ChallengeFrame | ActionsFrame | AnswersFrame
ServerCommandFrame: TypeAlias = (
    CommandsFrame | AnsweredFrame | RevokedFrame | LeaseFrame | AbortFrame | ConfirmFrame
)
RobotFrame: TypeAlias = (
    Hello
    | RowsFrame
    | DurableFrame
    | LiveFrame
    | BeatFrame
    | HeadsFrame
    | HasFrame
    | Bye
    | RobotCommandFrame
)
ServerFrame: TypeAlias = Welcome | Ack | Pong | WatchFrame | FetchFrame | Bye | ServerCommandFrame
FrameT = TypeVar("FrameT")


class _Tag(Struct):
    """The tag of any frame."""

    type: Capability


_ENCODER = msgspec.msgpack.Encoder()
_FROM_ROBOT: msgspec.msgpack.Decoder[RobotFrame] = msgspec.msgpack.Decoder(RobotFrame)
_FROM_SERVER: msgspec.msgpack.Decoder[ServerFrame] = msgspec.msgpack.Decoder(ServerFrame)
_TAG = msgspec.msgpack.Decoder(_Tag)


def _tags(frames: object) -> frozenset[str]:
    return frozenset(str(kind.__struct_config__.tag) for kind in get_args(frames))


_TAGS_OF_ROBOTS, _TAGS_OF_SERVERS = _tags(RobotFrame), _tags(ServerFrame)


def encode(frame: RobotFrame | ServerFrame) -> bytes:
    """Encode a frame; raises FrameError when it is too large."""
    content = _ENCODER.encode(frame)
    if len(content) + 4 > limits.FRAME_BYTES:
        raise FrameError(f"a frame of {len(content)} bytes is too large")
    return zlib.crc32(content).to_bytes(4, "little") + content


def from_robot(data: bytes) -> RobotFrame:
    """Decode a frame from a robot.

    Raises UnknownFrameError for a frame with an unknown tag, FrameError for invalid data.
    """
    return _decoded(_FROM_ROBOT, _TAGS_OF_ROBOTS, data)


def from_server(data: bytes) -> ServerFrame:
    """Decode a frame from a server.

    Raises UnknownFrameError for a frame with an unknown tag, FrameError for invalid data.
    """
    return _decoded(_FROM_SERVER, _TAGS_OF_SERVERS, data)


def _decoded(
    decoder: msgspec.msgpack.Decoder[FrameT], tags: Collection[str], data: bytes
) -> FrameT:
    try:
        if not 4 < len(data) <= limits.FRAME_BYTES:
            raise FrameError(f"{len(data)} bytes")
        content = memoryview(data)[4:]
        if zlib.crc32(content) != int.from_bytes(data[:4], "little"):
            raise FrameError("the checksum does not fit")
        return decoder.decode(content)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        if isinstance(error, msgspec.ValidationError):
            _refuse_unknown(content, tags)
        raise FrameError(f"no frame: {error}") from error


def _refuse_unknown(content: memoryview, tags: Collection[str]) -> None:
    """Raise UnknownFrameError if the content has a tag, and this is an unknown one."""
    try:
        tag = _TAG.decode(content).type
    except (msgspec.DecodeError, ValueError, RecursionError):
        return
    if tag not in tags:
        raise UnknownFrameError(f"no frame of this version: {tag!r}")
