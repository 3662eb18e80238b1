"""What stands in a journal of conclusions: records of the box's own, and rows of items."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import msgspec

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.writer import JournalWriter
from amberbox.blackbox.unroll.infer import widen
from amberbox.core.types import Schema, Topic


@dataclass(frozen=True, slots=True)
class Own:
    """A record on a reserved channel, as JSON."""

    topic: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Row:
    """A message of a data item that the owner of the journal has measured itself."""

    topic: str
    item: str
    source: str
    values: Mapping[str, Any]


Message: TypeAlias = Own | Row


@dataclass(slots=True)
class Streams:
    """Channels of one run; those of items get another one where their schema has to widen."""

    _own: dict[str, int] = field(default_factory=dict)
    _channels: dict[str, int] = field(default_factory=dict)
    _schemas: dict[str, Schema] = field(default_factory=dict)

    def begin(self) -> None:
        """Begin a run: no channel is known to its writer yet."""
        self._own.clear()
        self._channels.clear()

    def placed(self, writer: JournalWriter, message: Message) -> tuple[int, bytes]:
        """Return channel and bytes of a message."""
        if isinstance(message, Own):
            return self._own_channel(writer, message.topic), message.data
        data = msgspec.json.encode(message.values)
        return self._channel(writer, message, data), data

    def _own_channel(self, writer: JournalWriter, topic: str) -> int:
        if topic not in self._own:
            marks = {"item": topic.replace("/", "_"), "source": reserved.SOURCE}
            self._own[topic] = writer.channel(reserved.topic_of(topic), marks)
        return self._own[topic]

    def _channel(self, writer: JournalWriter, row: Row, data: bytes) -> int:
        before = self._schemas.get(row.item)
        schema, _ = widen(before, [data], "json", row.topic)
        if schema is not before or row.item not in self._channels:
            self._schemas[row.item] = schema
            marks = {"item": row.item, "source": row.source}
            self._channels[row.item] = writer.channel(Topic(row.topic, "json", schema), marks)
        return self._channels[row.item]
