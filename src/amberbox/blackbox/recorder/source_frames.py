"""The frames between the recorder and the process of a source.

A frame of the source's process has a head of 17 bytes: its kind (``u8``), the stream's number
(``u32``), the length of what follows (``u32``), a time (``i64``). Times are nanoseconds of
CLOCK_BOOTTIME, which both processes share, so that an epoch of log time may begin in between. A
frame of the recorder has a length (``u32``), then a call.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, TypeAlias

import msgspec

from amberbox.core.source import Power
from amberbox.core.types import Topic
from amberbox.core.yaml_nodes import Node

HEAD = struct.Struct("<BIIq")
LENGTH = struct.Struct("<I")
MESSAGE, CALL, ALIVE = 0, 1, 2
# follows an ALIVE head: the time up to which all messages have been handed over
COMPLETE = struct.Struct("<q")


class SourceSetup(msgspec.Struct, frozen=True):
    """What the process of a source needs to run it: the first frame of the recorder."""

    parent: int
    module: str
    plugin: str
    name: str
    node: Node
    folder: str
    base_ns: int
    """Log time minus the time since the computer's start."""
    longest_bytes: int
    state: dict[str, Any]


class TopicCall(msgspec.Struct, frozen=True, tag="topic"):
    """``Sink.topic``; streams are numbered in the order of these calls."""

    topic: Topic


class LinkUp(msgspec.Struct, frozen=True, tag="link_up"):
    """``Sink.link_up``."""

    topic: str
    peer: str
    since_ns: int | None


class LinkDown(msgspec.Struct, frozen=True, tag="link_down"):
    """``Sink.link_down``; the time is always given."""

    topic: str
    peer: str
    reason: str
    since_ns: int


class Lost(msgspec.Struct, frozen=True, tag="lost"):
    """``Sink.lost``."""

    topic: str
    peer: str
    from_ns: int
    to_ns: int
    count: int
    reason: str


class Dropped(msgspec.Struct, frozen=True, tag="dropped"):
    """Messages of a stream for which the process had no room."""

    stream: int
    from_ns: int
    to_ns: int
    count: int


class EventCall(msgspec.Struct, frozen=True, tag="event"):
    """``Sink.event``."""

    kind: str
    text: str
    details: dict[str, Any]


class PowerCall(msgspec.Struct, frozen=True, tag="power"):
    """``Sink.power``."""

    state: Power
    text: str


class LastLatched(msgspec.Struct, frozen=True, tag="last_latched"):
    """``Sink.last_latched``; answered by an ``Answer`` of the same number."""

    number: int
    topic: str


class SaveState(msgspec.Struct, frozen=True, tag="save_state"):
    """``Sink.save_state``."""

    state: dict[str, Any]


class Ended(msgspec.Struct, frozen=True, tag="ended"):
    """``run`` has returned, or raised: then with the error's text and representation.

    ``what`` and ``hint`` are those of an AmberboxError.
    """

    error: str = ""
    representation: str = ""
    what: str = ""
    hint: str = ""


SourceCall: TypeAlias = (
    TopicCall
    | LinkUp
    | LinkDown
    | Lost
    | Dropped
    | EventCall
    | PowerCall
    | LastLatched
    | SaveState
    | Ended
)


class Answer(msgspec.Struct, frozen=True, tag="answer"):
    """The last latched message that was asked for."""

    number: int
    data: bytes | None


class NewBase(msgspec.Struct, frozen=True, tag="base"):
    """Log time minus the time since the computer's start, from now on."""

    base_ns: int


class Stop(msgspec.Struct, frozen=True, tag="stop"):
    """``run`` is to return."""


RecorderCall: TypeAlias = Answer | NewBase | Stop

_SOURCE_CALLS: msgspec.msgpack.Decoder[SourceCall] = msgspec.msgpack.Decoder(SourceCall)
_RECORDER_CALLS: msgspec.msgpack.Decoder[RecorderCall] = msgspec.msgpack.Decoder(RecorderCall)


def encode(call: SourceCall | RecorderCall | SourceSetup) -> bytes:
    """Encode a call; what it holds that is no plain value becomes text."""
    return msgspec.msgpack.encode(call, enc_hook=str)


def decode_source_call(data: bytes) -> SourceCall:
    """Decode a call of the source; raises msgspec.MsgspecError if it is none."""
    return _SOURCE_CALLS.decode(data)


def decode_recorder_call(data: bytes) -> RecorderCall:
    """Decode a call of the recorder; raises msgspec.MsgspecError if it is none."""
    return _RECORDER_CALLS.decode(data)


def plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values as they are behind a transfer, so that both sides see the same ones."""
    found: dict[str, Any] = msgspec.msgpack.decode(msgspec.msgpack.encode(values, enc_hook=str))
    return found
