"""MCAP files of any origin, finished or truncated: ROS 1, ROS 2, JSON and other encodings.

Flat columns that were exported as JSON become the same columns again.
"""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.formats._recording import (
    ReadableRange,
    RecordedMessage,
    RecordingDamage,
    RecordingPart,
    RecordingReport,
    TopicOrigin,
    TopicTable,
    cannot_open,
    unpack,
)
from amberbox.blackbox.formats._ros2_types import Ros2Definitions, is_latched
from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.channels import SOURCE
from amberbox.blackbox.journal.chunk import Chunk, open_buffer, open_chunk
from amberbox.blackbox.journal.mcap import McapChannel
from amberbox.blackbox.journal.scan import ChunkPlace, FileScan, read_chunk, scan
from amberbox.core.clock import NS
from amberbox.core.types import Schema, Topic

KIND = "flat columns of an export"
MALFORMED = "malformed"
_TIMESTAMP, _RECEIVED, _STAMP = "timestamp", "received", "stamp"
_PARENT = "parent_seq"
# variables that are the own stamp of most messages; a child table has that of its parent
_STAMPS = ("header_stamp", _STAMP)

# converts a message, given its log time and stamp, to MessagePack
Rewrite = Callable[[bytes, int, int], bytes]


def flat_columns(channel: McapChannel, schema: Schema | None) -> Mapping[str, Any] | None:
    """Return the columns in the schema of a channel that our export wrote, None for any other."""
    if channel.message_encoding != "json" or schema is None or "item" not in channel.metadata:
        return None
    try:
        columns = msgspec.json.decode(schema.data)["properties"]
        is_ours = columns[_TIMESTAMP]["title"] == "time"
    except (msgspec.DecodeError, KeyError, TypeError):
        return None
    return columns if is_ours and isinstance(columns, dict) else None


def own_stamp(columns: Mapping[str, Any]) -> str:
    """Return the variable that holds the own stamps."""
    if _PARENT in columns:
        return _STAMP
    return next((name for name in _STAMPS if name in columns), _STAMP)


def rewriter(columns: Mapping[str, Any]) -> Rewrite:
    """Return a function that converts the JSON rows of an exported table to MessagePack documents.

    Values that JSON does not have are restored: null among numbers is NaN, Base64 is binary. The
    function raises ValueError for any other message.
    """
    repairs = {name: repair for name, kind in columns.items() if (repair := _repair(kind))}
    return partial(_rewritten, repairs, own_stamp(columns) not in columns)


def _repair(kind: Mapping[str, Any]) -> Callable[[Any], Any] | None:
    if kind.get("type") == "number":
        return _number
    if kind.get("contentEncoding") == "base64":
        return b64decode
    if kind.get("type") == "array" and kind.get("items") == {"type": "number"}:
        return lambda values: [_number(value) for value in values]
    return None


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)


def _rewritten(
    repairs: Mapping[str, Callable[[Any], Any]],
    adds_stamp: bool,
    message: bytes,
    log_ns: int,
    stamp_ns: int,
) -> bytes:
    try:
        row = msgspec.json.decode(message)
        at = row.pop(_TIMESTAMP)
        for name in repairs.keys() & row.keys():
            row[name] = repairs[name](row[name])
        if row.get(_RECEIVED) == log_ns:
            del row[_RECEIVED]
        if adds_stamp and stamp_ns != log_ns:
            row[_STAMP] = at["sec"] * NS + at["nsec"]
        return msgspec.msgpack.encode(row)
    except (msgspec.DecodeError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"no row of an export: {error}") from None


def malformed(message: bytes) -> bytes:
    """Return a message that is no row as the only variable of a document."""
    return msgspec.msgpack.encode({MALFORMED: message})


MAGIC = mcap.MAGIC
_UNKNOWN, _BOOKKEEPING = -1, -2
_FOOTER_WITHOUT_SUMMARY = bytes([mcap.FOOTER]) + (20).to_bytes(8, "little") + bytes(16)


@dataclass
class McapRecording:
    """An open MCAP file and the topic index of each of its channels."""

    path: Path
    report: RecordingReport
    contents: FileScan
    buffer: Any
    close: Callable[[], None]
    topic_of: dict[int, int] = field(default_factory=dict)
    rewrite: dict[int, Rewrite] = field(default_factory=dict)
    torn: Chunk | None = None

    def damaged(self, offset: int, length: int, reason: str) -> None:
        """Report a range that cannot be read."""
        self.report.add_damage(RecordingDamage(self.path.name, offset, length, reason))


def open_mcap(path: Path, report: RecordingReport) -> McapRecording:
    """Find the chunks of an MCAP file, by its summary if that covers everything."""
    try:
        contents = scan(path)
        if not contents.walked and not _covers_everything(contents):
            contents = scan(path, walk=True)
        mapping = ExitStack()
        buffer = mapping.enter_context(open_buffer(path))
    except OSError as error:
        raise cannot_open(path, error) from None
    file = McapRecording(path, report, contents, buffer, mapping.close)
    known = len(report.damage)
    _note_state(file)
    places = [ReadableRange(p.offset, p.offset + 1, p.start_ns, p.end_ns) for p in contents.places]
    report.damage[known:] = [damage.between(places) for damage in report.damage[known:]]
    file.torn = _torn_chunk(file)
    return file


def _covers_everything(contents: FileScan) -> bool:
    counts = contents.summary.counts
    indexed = sum(place.count for place in contents.places)
    defined = contents.summary.channels.keys() >= counts.keys()
    return bool(contents.places) and defined and indexed == counts.total()


def _note_state(file: McapRecording) -> None:
    has_no_summary = _FOOTER_WITHOUT_SUMMARY in bytes(file.buffer[-37:])
    for damage in file.contents.damage:
        if not (has_no_summary and damage.to_offset == file.contents.size):
            length = damage.to_offset - damage.from_offset
            file.damaged(damage.from_offset, length, damage.reason)
    if not file.contents.finished and not has_no_summary:
        file.report.add_note(f"{file.path.name} was never finished; it has no summary")


def _torn_chunk(file: McapRecording) -> Chunk | None:
    """Return the complete messages of a chunk that the end of the file cuts off."""
    last = file.contents.damage[-1] if file.contents.damage else None
    if last is None or last.to_offset != file.contents.size:
        return None
    at = last.from_offset + _whole_records(file.buffer[last.from_offset :])
    head = mcap.parse_chunk_head(file.buffer, at)
    if head is None:
        return None
    body, _ = unpack(head.compression, bytes(file.buffer[head.data_offset :]), head.size)
    chunk = open_chunk(body[: _whole_records(body)], head.offset, file.contents.size)
    if chunk is None or not len(chunk):
        return None
    file.report.add_note(f"{len(chunk)} messages come from a torn chunk that no checksum covers")
    file.contents.summary.schemas.update(chunk.schemas)
    file.contents.summary.channels.update(chunk.channels)
    return chunk


def _whole_records(body: bytes | memoryview) -> int:
    """Return the length of the records that are complete."""
    at = 0
    while at + mcap.RECORD_HEAD <= len(body):
        end = at + mcap.RECORD_HEAD + int.from_bytes(body[at + 1 : at + 9], "little")
        if end > len(body):
            break
        at = end
    return at


def add_topics(file: McapRecording, table: TopicTable, definitions: Ros2Definitions) -> None:
    """Add the channels of a file to the topics."""
    summary = file.contents.summary
    for number, channel in sorted(summary.channels.items()):
        if _is_bookkeeping(channel):
            file.topic_of[number] = _BOOKKEEPING
            continue
        schema = summary.schemas.get(channel.schema_id)
        if schema is not None and not schema.data and channel.message_encoding == "cdr":
            schema = definitions.schema(schema.name, partial(_sample, file, number))
        columns = flat_columns(channel, schema)
        if columns is None:
            topic = Topic(channel.topic, channel.message_encoding, schema, _is_latched(channel))
            file.topic_of[number] = table.add(topic, _origin(channel))
        else:
            file.rewrite[number] = rewriter(columns)
            origin = TopicOrigin("", own_stamp(columns), KIND)
            file.topic_of[number] = table.add(Topic(channel.topic, "msgpack"), origin)


def _is_latched(channel: mcap.McapChannel) -> bool:
    marks = (channel.metadata.get("latching"), channel.metadata.get("latched"))
    by_qos = is_latched(channel.metadata.get("offered_qos_profiles", ""))
    return by_qos or bool({"1", "true"}.intersection(marks))


def _origin(channel: mcap.McapChannel) -> TopicOrigin:
    """Return source and stamp of an item that a box has recorded; defaults for other channels."""
    marks = channel.metadata
    if "item" not in marks or "source" not in marks:
        return TopicOrigin()
    return TopicOrigin(marks["source"], marks.get("stamp"))


def _is_bookkeeping(channel: mcap.McapChannel) -> bool:
    """Return whether a channel has own records of a box, or repeated messages."""
    marks = channel.metadata
    return "run" in marks and (marks.get("source") == SOURCE or marks.get("repeated") == "1")


def _sample(file: McapRecording, channel: int) -> bytes | None:
    chunks = (read_chunk(file.buffer, place) for place in file.contents.places[:100])
    found = (c.messages(c.rows_of(channel)[:1]) for c in (*chunks, file.torn) if c is not None)
    return next((messages[0] for messages in found if messages), None)


def find_parts(file: McapRecording) -> list[RecordingPart]:
    """Return one part per chunk."""
    parts = [
        RecordingPart(place.start_ns, place.end_ns, place.count, partial(load_chunk, file, place))
        for place in file.contents.places
    ]
    if file.torn is not None:
        first, last = int(file.torn.log_ns.min()), int(file.torn.log_ns.max())
        parts.append(
            RecordingPart(first, last, len(file.torn), partial(_messages, file, file.torn))
        )
    return parts


def load_chunk(file: McapRecording, place: ChunkPlace) -> list[RecordedMessage]:
    """Read the messages of a chunk; none, and a report, if its checksum is wrong."""
    chunk = read_chunk(file.buffer, place)
    if chunk is None:
        head = mcap.parse_chunk_head(file.buffer, place.offset)
        reason = f"chunk with {place.count} messages cannot be read"
        file.damaged(place.offset, head.length if head else 0, reason)
        return []
    return _messages(file, chunk)


def _messages(file: McapRecording, chunk: Chunk) -> list[RecordedMessage]:
    body, topic_of, new = chunk.body, file.topic_of, tuple.__new__
    rows = zip(
        chunk.channel.tolist(),
        chunk.log_ns.tolist(),
        chunk.publish_ns.tolist(),
        chunk.starts.tolist(),
        chunk.ends.tolist(),
        strict=True,
    )
    messages = [
        new(RecordedMessage, (topic_of.get(channel, _UNKNOWN), log, publish, body[start:end]))
        for channel, log, publish, start, end in rows
    ]
    _rewrite(file, chunk, messages)
    known = [message for message in messages if message[0] >= 0]
    lost = sum(message[0] == _UNKNOWN for message in messages)
    if lost:
        file.damaged(chunk.offset, chunk.end - chunk.offset, f"{lost} messages of unknown channels")
    return known


def _rewrite(file: McapRecording, chunk: Chunk, messages: list[RecordedMessage]) -> None:
    """Convert the rows of exported tables back."""
    broken = 0
    for channel, rewrite in file.rewrite.items():
        for place in chunk.rows_of(channel).tolist():
            topic, log_ns, publish_ns, data = messages[place]
            try:
                data = rewrite(data, log_ns, publish_ns or log_ns)
            except ValueError:
                broken += 1
                data = malformed(data)
            messages[place] = RecordedMessage(topic, log_ns, publish_ns, data)
    if broken:
        reason = f"{broken} rows are damaged and kept as {MALFORMED!r}"
        file.damaged(chunk.offset, chunk.end - chunk.offset, reason)
