"""MCAP files of any origin, finished or torn: ROS 1, ROS 2, JSON and whatever else is in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from amberbox.blackbox import mcap
from amberbox.blackbox.chunk import Chunk
from amberbox.blackbox.formats.definitions import Definitions
from amberbox.blackbox.formats.recording import (
    Damage,
    Part,
    RecordedMessage,
    Report,
    TopicTable,
)
from amberbox.blackbox.formats.ros2_qos import is_latched
from amberbox.blackbox.scan import ChunkPlace, FileScan, open_buffer, read_chunk, scan
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Topic

MAGIC = mcap.MAGIC
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

    def damaged(self, offset: int, length: int, reason: str) -> None:
        """Note what cannot be read."""
        self.report.add_damage(Damage(self.path.name, offset, length, reason))


def open_mcap(path: Path, report: Report) -> McapFile:
    """Find the chunks of an MCAP file, by its summary if that covers everything."""
    try:
        contents = scan(path)
        if not contents.walked and not _covers_everything(contents):
            contents = scan(path, walk=True)
        mapping = open_buffer(path)
        buffer = mapping.__enter__()
    except OSError as error:
        raise AmberboxError(
            f"cannot open {path}: {error.strerror}", "check the path and its permissions"
        ) from None
    file = McapFile(path, report, contents, buffer, mapping.__exit__)
    _note_state(file)
    return file


def _covers_everything(contents: FileScan) -> bool:
    indexed = sum(place.count for place in contents.places)
    return bool(contents.places) and indexed == sum(contents.summary.counts.values())


def _note_state(file: McapFile) -> None:
    has_no_summary = _FOOTER_WITHOUT_SUMMARY in bytes(file.buffer[-37:])
    for damage in file.contents.damage:
        if not (has_no_summary and damage.to_offset == file.contents.size):
            length = damage.to_offset - damage.from_offset
            file.damaged(damage.from_offset, length, damage.reason)
    if not file.contents.finished and not has_no_summary:
        file.report.add_note(f"{file.path.name} was never finished; it has no summary")


def add_topics(file: McapFile, table: TopicTable, definitions: Definitions) -> None:
    """Add the channels of a file to the topics."""
    summary = file.contents.summary
    for number, channel in sorted(summary.channels.items()):
        schema = summary.schemas.get(channel.schema_id)
        if schema is not None and not schema.data and channel.message_encoding == "cdr":
            schema = definitions.schema(schema.name, partial(_sample, file, number))
        latched = is_latched(channel.metadata.get("offered_qos_profiles", ""))
        latched = latched or channel.metadata.get("latching") in ("1", "true")
        topic = Topic(channel.topic, channel.message_encoding, schema, latched)
        file.topic_of[number] = table.add(topic)


def _sample(file: McapFile, channel: int) -> bytes | None:
    chunks = (read_chunk(file.buffer, place) for place in file.contents.places)
    found = (c.messages(c.rows_of(channel)[:1]) for c in chunks if c is not None)
    return next((messages[0] for messages in islice(found, 100) if messages), None)


def find_parts(file: McapFile) -> list[Part]:
    """Make a part of each chunk."""
    return [
        Part(place.start_ns, place.end_ns, place.count, partial(load_chunk, file, place))
        for place in file.contents.places
    ]


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
        new(RecordedMessage, (topic_of.get(channel, -1), log, publish, body[start:end]))
        for channel, log, publish, start, end in rows
    ]
    known = [message for message in messages if message[0] >= 0]
    if len(known) < len(messages):
        lost = len(messages) - len(known)
        file.damaged(chunk.offset, chunk.end - chunk.offset, f"{lost} messages of unknown channels")
    return known
