"""Export a view of a record: MCAP and ROS 1 bags of messages, tables as CSV, Parquet or JSON.

ROS 1 bags hold messages of ROS 1 as received and those of ROS 2 converted; MD5 sums of their
definitions are computed as ROS 1 nodes compare them before they connect.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeAlias

import numpy as np
import zstandard

from amberbox.blackbox.columns.json_schema import viewer_schema
from amberbox.blackbox.columns.ros1_text import md5sum
from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.mcap import McapChannel, McapSummary
from amberbox.blackbox.journal.writer import MessageRows, chunk_slices, pack_chunk
from amberbox.blackbox.query.export_job import (
    ExportJob,
    ExportOptions,
    ExportReport,
    Progress,
    RefreshingCatalogue,
    View,
    Window,
    new_file,
    size_of,
)
from amberbox.blackbox.query.export_messages import Messages, read_originals
from amberbox.blackbox.query.export_tables import (
    TableStream,
    json_rows,
    json_topic,
    streams_of,
    write_csv,
    write_parquet,
)
from amberbox.blackbox.store.batches import ItemStream
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Schema, Topic

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Writer

    from amberbox.blackbox.query.record import Record


# The publisher's name in the bag; which node a message came from is not recorded
_CALLER = "/amberbox"

Convert = Callable[[bytes], "bytes | memoryview"]


@dataclass(frozen=True)
class _BagConversion:
    """How messages of a stream become those of a bag."""

    type: str
    definition: str
    md5: str
    convert: Convert


def write_bag(job: ExportJob) -> None:
    """Write one ROS 1 bag; items that cannot be in one are named in the report."""
    originals = read_originals(job)
    conversions = {stream: _conversion(job, stream) for stream in originals.streams}
    if not any(conversions.values()):
        raise AmberboxError("none of these items can be in a ROS 1 bag", job.report.missing[0])
    with new_file(job.path) as part, bag_writer(part, job.options.compression) as writer:
        output = _BagFile(job, writer, conversions)
        for messages in originals.blocks:
            output.write(messages)
    for item in {stream.item for stream, conversion in conversions.items() if conversion is None}:
        job.report.counts.pop(item, None)
    job.report.bytes = size_of(job.path)


def bag_writer(path: Path, compression: str) -> Writer:
    """Return a writer of a bag that keeps little of the chunks it has written."""
    from rosbags.rosbag1 import Writer as BagWriter
    from rosbags.rosbag1.writer import WriteChunk

    class Bounded(BagWriter):
        """A written chunk reduced to the number of messages that the index needs."""

        def write_chunk(self, chunk: WriteChunk) -> None:
            super().write_chunk(chunk)
            counts: Any = {number: range(len(at)) for number, at in chunk.connections.items()}
            chunk.connections = counts

    writer = Bounded(path)
    if compression != "none":
        writer.set_compression(writer.CompressionFormat[compression.upper()])
    return writer


class _BagFile:
    """An open bag, and the messages that could not be converted into it."""

    def __init__(
        self, job: ExportJob, writer: Writer, conversions: dict[ItemStream, _BagConversion | None]
    ) -> None:
        self._job = job
        self._writer = writer
        self._conversions = conversions
        self._connections: dict[ItemStream, Connection] = {}

    def write(self, messages: Messages) -> None:
        used = [messages.streams[place] for place in np.unique(messages.stream).tolist()]
        connections = {
            stream: self._connection(stream) for stream in used if self._conversion(stream)
        }
        conversions = [self._conversions.get(stream) for stream in messages.streams]
        targets = [connections.get(stream) for stream in messages.streams]
        rows = zip(
            messages.stream.tolist(), messages.received_ns.tolist(), messages.data, strict=True
        )
        for place, received_ns, data in rows:
            conversion, connection = conversions[place], targets[place]
            if conversion is None or connection is None:
                continue
            try:
                self._writer.write(connection, received_ns, conversion.convert(data))
            except _conversion_errors() as error:
                item, text = messages.streams[place].item, str(error).partition("\n")[0]
                report = self._job.report
                report.miss(f"{item}: messages that do not convert to ROS 1 ({text})")
                report.add(item, -1)

    def _conversion(self, stream: ItemStream) -> _BagConversion | None:
        """Return how a stream gets into the bag, also one that began after the export."""
        if stream not in self._conversions:
            self._conversions[stream] = _conversion(self._job, stream)
        return self._conversions[stream]

    def _connection(self, stream: ItemStream) -> Connection:
        if stream not in self._connections:
            conversion = self._conversions[stream]
            assert conversion is not None
            self._connections[stream] = self._add(stream, conversion)
        return self._connections[stream]

    def _add(self, stream: ItemStream, conversion: _BagConversion) -> Connection:
        same = [
            c
            for s, c in self._connections.items()
            if _is_like(s, self._conversions[s], stream, conversion)
        ]
        if same:
            return same[0]
        return self._writer.add_connection(
            stream.topic.name,
            conversion.type,
            msgdef=conversion.definition,
            md5sum=conversion.md5,
            callerid=_CALLER,
            latching=int(stream.topic.latched),
        )


def _is_like(
    known: ItemStream,
    known_conversion: _BagConversion | None,
    stream: ItemStream,
    conversion: _BagConversion,
) -> bool:
    """Return whether two streams, such as of two items, are one connection of a bag."""
    return (
        known_conversion is not None
        and (known.topic.name, known.topic.latched) == (stream.topic.name, stream.topic.latched)
        and (known_conversion.type, known_conversion.md5) == (conversion.type, conversion.md5)
    )


def _conversion_errors() -> tuple[type[Exception], ...]:
    from rosbags.serde import SerdeError

    return (SerdeError,)


def _conversion(job: ExportJob, stream: ItemStream) -> _BagConversion | None:
    """Return the conversion of a stream to the bag; None, and a line in the report, without."""
    schema, encoding = stream.topic.schema, stream.topic.message_encoding
    try:
        if schema is None or encoding not in ("ros1", "cdr"):
            raise AmberboxError(f"its messages are {encoding}, not of ROS")
        return _unconverted(schema) if encoding == "ros1" else _converted(job, stream, schema)
    except AmberboxError as error:
        job.report.miss(f"{stream.item} cannot be in a ROS 1 bag: {error.what}")
        return None


def _unconverted(schema: Schema) -> _BagConversion:
    from rosbags.typesys.msg import normalize_msgtype

    text = schema.data.decode("utf-8", "replace")
    return _BagConversion(normalize_msgtype(schema.name), text, md5sum(schema), bytes)


def _converted(job: ExportJob, stream: ItemStream, schema: Schema) -> _BagConversion:
    from rosbags.typesys import Stores, get_typestore
    from rosbags.typesys.msg import normalize_msgtype

    from amberbox.blackbox.columns.ros_definition import HEADER, parse_types

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
    _note_different_type(job, stream, name, md5)
    return _BagConversion(name, text, md5, partial(ros2.cdr_to_ros1, typename=name))


def _note_different_type(job: ExportJob, stream: ItemStream, name: str, md5: str) -> None:
    """Report when ROS 1 has a different type of this name: its nodes refuse ours."""
    from rosbags.typesys import Stores, get_typestore

    noetic = get_typestore(Stores.ROS1_NOETIC)
    if name in noetic.fielddefs and noetic.generate_msgdef(name)[1] != md5:
        job.report.note(f"{stream.item}: {name} differs from that of ROS 1, whose nodes refuse it")


_LEVEL = 1


class McapFileWriter:
    """Writes messages to an open file. Definitions are in the first chunk that needs them."""

    def __init__(self, file: BinaryIO, profile: str) -> None:
        self._file = file
        self._zstd = zstandard.ZstdCompressor(level=_LEVEL, write_content_size=True)
        self._schemas: dict[Schema, int] = {}
        self._channels: list[McapChannel] = []
        self._summary = McapSummary()
        self._size = 0
        self._append(mcap.MAGIC + mcap.header(profile))

    def channel(self, topic: Topic, metadata: Mapping[str, str]) -> int:
        """Register a channel and return its number."""
        schema_id = 0
        if topic.schema is not None:
            schema_id = self._schemas.setdefault(topic.schema, len(self._schemas) + 1)
        number = len(self._channels)
        self._channels.append(
            McapChannel(number, schema_id, topic.name, topic.message_encoding, metadata)
        )
        return number

    def write(self, rows: MessageRows) -> None:
        """Write messages in their order."""
        for part in chunk_slices(rows.messages):
            packed = pack_chunk(rows.take(part), self._definitions, self._zstd)
            offset = self._size
            self._append(b"".join([packed.chunk, *packed.indices]))
            for number, count in zip(packed.channels, packed.counts, strict=True):
                self._summary.counts[number] += count
            self._summary.add_chunk(packed.indexed(offset))

    def close(self) -> None:
        """Write the end of the file; the file itself stays open."""
        for channel in self._channels:  # also those without a message
            self._define(channel)
        self._append(self._summary.encode(self._size))

    def _definitions(self, used: Sequence[int], _now_ns: int) -> bytes:
        new = [self._channels[n] for n in used if n not in self._summary.channels]
        return b"".join(self._define(channel) for channel in new)

    def _define(self, channel: McapChannel) -> bytes:
        records = []
        if channel.schema_id and channel.schema_id not in self._summary.schemas:
            schema = list(self._schemas)[channel.schema_id - 1]
            self._summary.schemas[channel.schema_id] = schema
            records.append(mcap.schema_record(channel.schema_id, schema))
        self._summary.channels[channel.id] = channel
        return b"".join([*records, mcap.channel_record(channel)])

    def _append(self, data: bytes) -> None:
        self._file.write(data)
        self._size += len(data)


# Transient local, as rosbag2 writes it for a latched topic
_QOS = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: 1\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false"
)


def write_mcap(job: ExportJob) -> None:
    """Write one MCAP file, messages of all items in order of receipt."""
    originals = read_originals(job)
    with new_file(job.path) as part, part.open("wb") as file:
        output = McapFileWriter(
            file, profile({s.topic.message_encoding for s in originals.streams})
        )
        channels: dict[ItemStream, int] = {}
        for messages in originals.blocks:
            _write_messages(output, channels, messages)
        output.close()
    job.report.bytes = size_of(job.path)
    if {"json", "msgpack"} & {s.topic.message_encoding for s in channels} and any(
        stream.topic.message_encoding == "cdr" for stream in channels
    ):
        job.report.note("rosbags reads files of ROS 2 items only: choose these with --item")


def profile(encodings: set[str]) -> str:
    """Return the MCAP profile of a set of message encodings."""
    ros = encodings & {"ros1", "cdr"}
    return {"ros1": "ros1", "cdr": "ros2"}[ros.pop()] if len(ros) == 1 else ""


def _write_messages(
    output: McapFileWriter, channels: dict[ItemStream, int], messages: Messages
) -> None:
    for place in np.unique(messages.stream).tolist():
        stream = messages.streams[place]
        if stream not in channels:
            topic = replace(stream.topic, schema=viewer_schema(stream.topic.schema))
            channels[stream] = output.channel(topic, channel_metadata(stream))
    numbers = np.array([channels.get(stream, 0) for stream in messages.streams], np.uint16)
    output.write(
        MessageRows(
            numbers[messages.stream],
            messages.seq,
            messages.received_ns,
            messages.publish_ns,
            messages.data,
        )
    )


def channel_metadata(stream: ItemStream) -> dict[str, str]:
    """Return the metadata of a channel: ours, and whether it is latched in the terms of ROS."""
    marks = {"item": stream.item, "source": stream.source}
    if stream.stamp is not None:
        marks["stamp"] = stream.stamp
    if stream.topic.latched:
        marks["latched"] = "1"
        if stream.topic.message_encoding == "ros1":
            marks["latching"] = "1"
        elif stream.topic.message_encoding == "cdr":
            marks["offered_qos_profiles"] = _QOS
    return marks


# Time of receipt, channel, number of the row, timestamp, message
Row: TypeAlias = tuple[int, int, int, int, bytes]

_BLOCK_ROWS = 4000


def write_mcap_json(job: ExportJob) -> None:
    """Write one MCAP file: a channel per table, rows of all tables in order of receipt."""
    streams = streams_of(job)
    done = [0.0] * len(streams)
    with new_file(job.path) as part, part.open("wb") as file:
        output = McapFileWriter(file, "")
        for stream in streams:
            schema = stream.schema
            output.channel(json_topic(stream), {"item": schema.item, "source": schema.source})
            job.report.add(schema.item, 0)
        sources = [
            _json_row_stream(job, stream, number, done) for number, stream in enumerate(streams)
        ]
        for block in _row_blocks(heapq.merge(*sources, key=itemgetter(0, 1))):
            output.write(_packed(block))
        output.close()
    job.report.bytes = size_of(job.path)
    job.progress(1.0)


def _json_row_stream(
    job: ExportJob, stream: TableStream, number: int, done: list[float]
) -> Iterator[Row]:
    count = 0
    for block in stream.blocks(job.current):
        stamps = block.timestamp_ns.tolist()
        received = block.received_ns.tolist()
        messages = (message for part in json_rows(block.table) for message in part)
        for at_ns, stamp_ns, message in zip(received, stamps, messages, strict=True):
            yield at_ns, number, count, stamp_ns, message
            count += 1
        job.report.add(stream.schema.item, len(block.table))
        done[number] = block.done
        job.progress(sum(done) / len(done))


def _row_blocks(rows: Iterator[Row]) -> Iterator[list[Row]]:
    block: list[Row] = []
    for row in rows:
        block.append(row)
        if len(block) == _BLOCK_ROWS:
            yield block
            block = []
    if block:
        yield block


def _packed(block: Sequence[Row]) -> MessageRows:
    received, channels, numbers, stamps, messages = zip(*block, strict=True)
    return MessageRows(
        np.array(channels, np.uint16),
        np.array(numbers),
        np.array(received),
        np.array(stamps),
        messages,
    )


__all__ = ["FORMS", "ExportOptions", "ExportReport", "View", "Window", "export"]

FORMS: Mapping[str, Callable[[ExportJob], None]] = {
    "csv": write_csv,
    "parquet": write_parquet,
    "mcap": write_mcap,
    "mcap-json": write_mcap_json,
    "bag": write_bag,
}


def export(
    record: Record,
    view: View,
    target: Path | None,
    form: str,
    progress: Progress = lambda fraction: None,
    options: ExportOptions | None = None,
) -> ExportReport:
    """Write a view of a record in one of ``FORMS``.

    Memory use does not depend on the range. The target appears when it is complete; without one,
    CSV goes to stdout. The report names requested data that could not be exported. Raises
    UsageError for an impossible choice, AmberboxError where there are no data.
    """
    if form not in FORMS:
        raise UsageError(f"there is no format {form!r}", f"choose {', '.join(FORMS)}")
    if target is None and form != "csv":
        raise UsageError(f"{form} needs a file", "add -o FILE")
    report = ExportReport(target, form)
    current = RefreshingCatalogue(record.path, report)
    FORMS[form](ExportJob(current, view, target, report, progress, options or ExportOptions()))
    return report
