"""ROS 1 bags: messages of ROS 1 as they came, those of ROS 2 turned into ROS 1."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amberbox.blackbox.exporting.job import Job, new_file, size_of
from amberbox.blackbox.exporting.messages import Messages
from amberbox.blackbox.exporting.originals import read_originals
from amberbox.blackbox.exporting.ros1md5 import md5sum
from amberbox.blackbox.follow.batching import Stream
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Writer

_CALLER = "/amberbox"
"""The publisher's name in the bag; which node a message came from is not recorded."""

Convert = Callable[[bytes], "bytes | memoryview"]


@dataclass(frozen=True)
class _Way:
    """How messages of a stream become those of a bag."""

    type: str
    definition: str
    md5: str
    convert: Convert


def write_bag(job: Job) -> None:
    """Write one ROS 1 bag; items that cannot be in one are named in the report."""
    originals = read_originals(job)
    ways = {stream: _way(job, stream) for stream in originals.streams}
    if not any(ways.values()):
        raise AmberboxError("none of these items can be in a ROS 1 bag", job.report.missing[0])
    with new_file(job.path) as part, _writer(part, job.options.compression) as writer:
        output = _BagFile(job, writer, ways)
        for messages in originals.blocks:
            output.write(messages)
    for item in {stream.item for stream, way in ways.items() if way is None}:
        job.report.counts.pop(item, None)
    job.report.bytes = size_of(job.path)


def _writer(path: Path, compression: str) -> Writer:
    from rosbags.rosbag1 import Writer as BagWriter
    from rosbags.rosbag1.writer import WriteChunk

    class Bounded(BagWriter):
        """Keeps of a chunk that is written only what the index needs: how many messages."""

        def write_chunk(self, chunk: WriteChunk) -> None:
            super().write_chunk(chunk)
            counts: Any = {number: range(len(at)) for number, at in chunk.connections.items()}
            chunk.connections = counts

    writer = Bounded(path)
    if compression != "none":
        writer.set_compression(writer.CompressionFormat[compression.upper()])
    return writer


class _BagFile:
    """An open bag, and what could not be converted into it."""

    def __init__(self, job: Job, writer: Writer, ways: dict[Stream, _Way | None]) -> None:
        self._job = job
        self._writer = writer
        self._ways = ways
        self._connections: dict[Stream, Connection] = {}

    def write(self, messages: Messages) -> None:
        used = [messages.streams[place] for place in np.unique(messages.stream).tolist()]
        connections = {stream: self._connection(stream) for stream in used if self._way(stream)}
        ways = [self._ways.get(stream) for stream in messages.streams]
        targets = [connections.get(stream) for stream in messages.streams]
        rows = zip(
            messages.stream.tolist(), messages.received_ns.tolist(), messages.data, strict=True
        )
        for place, received_ns, data in rows:
            way, connection = ways[place], targets[place]
            if way is None or connection is None:
                continue
            try:
                self._writer.write(connection, received_ns, way.convert(data))
            except _conversion_errors() as error:
                self._lost(messages.streams[place], error)

    def _way(self, stream: Stream) -> _Way | None:
        """Return how a stream gets into the bag, also one that began after the export."""
        if stream not in self._ways:
            self._ways[stream] = _way(self._job, stream)
        return self._ways[stream]

    def _connection(self, stream: Stream) -> Connection:
        if stream not in self._connections:
            way = self._ways[stream]
            assert way is not None
            self._connections[stream] = self._add(stream, way)
        return self._connections[stream]

    def _add(self, stream: Stream, way: _Way) -> Connection:
        same = [c for s, c in self._connections.items() if _is_like(s, self._ways[s], stream, way)]
        if same:
            return same[0]
        return self._writer.add_connection(
            stream.topic.name,
            way.type,
            msgdef=way.definition,
            md5sum=way.md5,
            callerid=_CALLER,
            latching=int(stream.topic.latched),
        )

    def _lost(self, stream: Stream, error: Exception) -> None:
        text = str(error).partition("\n")[0]
        self._job.report.miss(f"{stream.item}: messages that do not convert to ROS 1 ({text})")
        self._job.report.add(stream.item, -1)


def _is_like(known: Stream, known_way: _Way | None, stream: Stream, way: _Way) -> bool:
    """Tell whether two streams, such as of two items, are one connection of a bag."""
    return (
        known_way is not None
        and (known.topic.name, known.topic.latched) == (stream.topic.name, stream.topic.latched)
        and (known_way.type, known_way.md5) == (way.type, way.md5)
    )


def _conversion_errors() -> tuple[type[Exception], ...]:
    from rosbags.serde import SerdeError

    return (SerdeError,)


def _way(job: Job, stream: Stream) -> _Way | None:
    """Choose how a stream gets into the bag; None, and a line in the report, if it cannot."""
    schema, encoding = stream.topic.schema, stream.topic.message_encoding
    try:
        if schema is None or encoding not in ("ros1", "cdr"):
            raise AmberboxError(f"its messages are {encoding}, not of ROS")
        return _as_it_is(schema) if encoding == "ros1" else _converted(job, stream, schema)
    except AmberboxError as error:
        job.report.miss(f"{stream.item} cannot be in a ROS 1 bag: {error.what}")
        return None


def _as_it_is(schema: Schema) -> _Way:
    from rosbags.typesys.msg import normalize_msgtype

    text = schema.data.decode("utf-8", "replace")
    return _Way(normalize_msgtype(schema.name), text, md5sum(schema), bytes)


def _converted(job: Job, stream: Stream, schema: Schema) -> _Way:
    from rosbags.typesys import Stores, get_typestore
    from rosbags.typesys.msg import normalize_msgtype

    from amberbox.blackbox.unroll.definition import HEADER, parse_types

    name, types = normalize_msgtype(schema.name), dict(parse_types(schema))
    ros1, ros2 = get_typestore(Stores.EMPTY), get_typestore(Stores.EMPTY)
    header = get_typestore(Stores.ROS1_NOETIC).fielddefs[HEADER]
    try:
        ros1.register(types | ({HEADER: header} if HEADER in types else {}))
        ros2.register(types)
        text, md5 = ros1.generate_msgdef(name, ros_version=1)
        ros2.get_msgdef(name)
    except Exception as error:  # rosbags raises many kinds on types that ROS 1 does not have
        raise AmberboxError(f"{schema.name} has no form in ROS 1 ({error})") from error
    _tell_other_type(job, stream, name, md5)
    return _Way(name, text, md5, partial(ros2.cdr_to_ros1, typename=name))


def _tell_other_type(job: Job, stream: Stream, name: str, md5: str) -> None:
    """Say when ROS 1 has a type of this name that is another one: its nodes refuse ours."""
    from rosbags.typesys import Stores, get_typestore

    noetic = get_typestore(Stores.ROS1_NOETIC)
    if name in noetic.fielddefs and noetic.generate_msgdef(name)[1] != md5:
        job.report.note(f"{stream.item}: {name} differs from that of ROS 1, whose nodes refuse it")
