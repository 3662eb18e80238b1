"""MCAP files of any origin, finished or torn: ROS 1, ROS 2, JSON and whatever else is in them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from amberbox.blackbox.formats import flat_json
from amberbox.blackbox.formats.compression import unpack
from amberbox.blackbox.formats.definitions import Definitions
from amberbox.blackbox.formats.recording import (
    Damage,
    Origin,
    Part,
    RecordedMessage,
    Report,
    Stretch,
    TopicTable,
)
from amberbox.blackbox.formats.ros2_qos import is_latched
from amberbox.blackbox.journal import mcap
from amberbox.blackbox.journal.buffer import open_buffer
from amberbox.blackbox.journal.chunk import Chunk, open_chunk
from amberbox.blackbox.journal.reserved import SOURCE
from amberbox.blackbox.journal.scan import ChunkPlace, FileScan, read_chunk, scan
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Topic

MAGIC = mcap.MAGIC
_UNKNOWN, _BOOKKEEPING = -1, -2
_FOOTER_WITHOUT_SUMMARY = bytes([mcap.FOOTER]) + (20).to_bytes(8, "little") + bytes(16)


@dataclass
class McapFile:
    """An open MCAP file and the topic index of each of its channels."""

    path: Path
    report: Report
    contents: FileScan
    buffer: Any
    close: Callable[[], None]
    topic_of: dict[int, int] = field(default_factory=dict)
    rewrite: dict[int, flat_json.Rewrite] = field(default_factory=dict)
    torn: Chunk | None = None

    def damaged(self, offset: int, length: int, reason: str) -> None:
        """Note what cannot be read."""
        self.report.add_damage(Damage(self.path.name, offset, length, reason))


def open_mcap(path: Path, report: Report) -> McapFile:
    """Find the chunks of an MCAP file, by its summary if that covers everything."""
    try:
        contents = scan(path)
        if not contents.walked and not _covers_everything(contents):
            contents = scan(path, walk=True)
        mapping = ExitStack()
        buffer = mapping.enter_context(open_buffer(path))
    except OSError as error:
        raise AmberboxError(
            f"cannot open {path}: {error.strerror}", "check the path and its permissions"
        ) from None
    file = McapFile(path, report, contents, buffer, mapping.close)
    known = len(report.damage)
    _note_state(file)
    places = [Stretch(p.offset, p.offset + 1, p.start_ns, p.end_ns) for p in contents.places]
    report.damage[known:] = [damage.between(places) for damage in report.damage[known:]]
    file.torn = _torn_chunk(file)
    return file


def _covers_everything(contents: FileScan) -> bool:
    counts = contents.summary.counts
    indexed = sum(place.count for place in contents.places)
    defined = contents.summary.channels.keys() >= counts.keys()
    return bool(contents.places) and defined and indexed == counts.total()


def _note_state(file: McapFile) -> None:
    has_no_summary = _FOOTER_WITHOUT_SUMMARY in bytes(file.buffer[-37:])
    for damage in file.contents.damage:
        if not (has_no_summary and damage.to_offset == file.contents.size):
            length = damage.to_offset - damage.from_offset
            file.damaged(damage.from_offset, length, damage.reason)
    if not file.contents.finished and not has_no_summary:
        file.report.add_note(f"{file.path.name} was never finished; it has no summary")


def _torn_chunk(file: McapFile) -> Chunk | None:
    """Return what there is of a chunk that the end of the file cut through."""
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


def add_topics(file: McapFile, table: TopicTable, definitions: Definitions) -> None:
    """Add the channels of a file to the topics."""
    summary = file.contents.summary
    for number, channel in sorted(summary.channels.items()):
        if _is_bookkeeping(channel):
            file.topic_of[number] = _BOOKKEEPING
            continue
        schema = summary.schemas.get(channel.schema_id)
        if schema is not None and not schema.data and channel.message_encoding == "cdr":
            schema = definitions.schema(schema.name, partial(_sample, file, number))
        columns = flat_json.flat_columns(channel, schema)
        if columns is None:
            topic = Topic(channel.topic, channel.message_encoding, schema, _is_latched(channel))
            file.topic_of[number] = table.add(topic, _origin(channel))
        else:
            file.rewrite[number] = flat_json.rewriter(columns)
            origin = Origin("", flat_json.own_stamp(columns), flat_json.KIND)
            file.topic_of[number] = table.add(Topic(channel.topic, "msgpack"), origin)


def _is_latched(channel: mcap.Channel) -> bool:
    marks = (channel.metadata.get("latching"), channel.metadata.get("latched"))
    by_qos = is_latched(channel.metadata.get("offered_qos_profiles", ""))
    return by_qos or bool({"1", "true"}.intersection(marks))


def _origin(channel: mcap.Channel) -> Origin:
    """Items that a box has named keep the name of their source, and their stamp."""
    marks = channel.metadata
    if "item" not in marks or "source" not in marks:
        return Origin()
    return Origin(marks["source"], marks.get("stamp"))


def _is_bookkeeping(channel: mcap.Channel) -> bool:
    """Tell what a box wrote about itself in a journal, and repeated messages, from data."""
    marks = channel.metadata
    return "run" in marks and (marks.get("source") == SOURCE or marks.get("repeated") == "1")


def _sample(file: McapFile, channel: int) -> bytes | None:
    chunks = (read_chunk(file.buffer, place) for place in file.contents.places[:100])
    found = (c.messages(c.rows_of(channel)[:1]) for c in (*chunks, file.torn) if c is not None)
    return next((messages[0] for messages in found if messages), None)


def find_parts(file: McapFile) -> list[Part]:
    """Make a part of each chunk."""
    parts = [
        Part(place.start_ns, place.end_ns, place.count, partial(load_chunk, file, place))
        for place in file.contents.places
    ]
    if file.torn is not None:
        first, last = int(file.torn.log_ns.min()), int(file.torn.log_ns.max())
        parts.append(Part(first, last, len(file.torn), partial(_messages, file, file.torn)))
    return parts


def load_chunk(file: McapFile, place: ChunkPlace) -> list[RecordedMessage]:
    """Read the messages of a chunk; none, and a note, if its checksum refuses it."""
    chunk = read_chunk(file.buffer, place)
    if chunk is None:
        head = mcap.parse_chunk_head(file.buffer, place.offset)
        reason = f"chunk with {place.count} messages cannot be read"
        file.damaged(place.offset, head.length if head else 0, reason)
        return []
    return _messages(file, chunk)


def _messages(file: McapFile, chunk: Chunk) -> list[RecordedMessage]:
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


def _rewrite(file: McapFile, chunk: Chunk, messages: list[RecordedMessage]) -> None:
    """Put back what an export had to write differently."""
    broken = 0
    for channel, rewrite in file.rewrite.items():
        for place in chunk.rows_of(channel).tolist():
            topic, log_ns, publish_ns, data = messages[place]
            try:
                data = rewrite(data, log_ns, publish_ns or log_ns)
            except ValueError:
                broken += 1
                data = flat_json.malformed(data)
            messages[place] = RecordedMessage(topic, log_ns, publish_ns, data)
    if broken:
        reason = f"{broken} rows are damaged and kept as {flat_json.MALFORMED!r}"
        file.damaged(chunk.offset, chunk.end - chunk.offset, reason)
