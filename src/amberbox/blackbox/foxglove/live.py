"""A store followed live: messages go to viewers as soon as they are written."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amberbox.blackbox.exporting.jsonrows import json_rows, json_topic
from amberbox.blackbox.exporting.messages import MessageStream, latched_before
from amberbox.blackbox.exporting.tables import TableStream
from amberbox.blackbox.exporting.view import View, chosen_items, chosen_tables
from amberbox.blackbox.follow.batching import Stream
from amberbox.blackbox.follow.follow import RECORDED, follow
from amberbox.blackbox.follow.tail import WriterTail, position_at
from amberbox.blackbox.foxglove.server import Frame, Server
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.query.catalogue import look
from amberbox.blackbox.query.gather import merge
from amberbox.blackbox.query.record import make_table
from amberbox.blackbox.query.variables import Wanted
from amberbox.blackbox.segments.build import can_build
from amberbox.blackbox.segments.flat import Flat, TableSchema, flatten
from amberbox.blackbox.store import Store, open_store
from amberbox.core.types import Batch, Column, Cursor, IntArray, Topic, Watermark

_POLL_S = 0.02
_NOW_S = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class RawRows:
    """Messages of one stream as they came, with their times of receipt."""

    stream: Stream
    received_ns: IntArray
    messages: Sequence[bytes]
    cursor: Cursor = field(default_factory=Cursor)


class RawTail(WriterTail):
    """Follows one writer's journal and gives messages instead of batches."""

    def _item_rows(
        self,
        item: str,
        rows: IntArray,
        chunk: Chunk,
        seq: IntArray,
        clock: ClockTable,
        streams: Any,
    ) -> Iterator[Any]:
        for number in sorted({int(chunk.channel[row]) for row in rows}):
            part = rows[chunk.channel[rows] == number]
            self.ahead[item] = int(seq[part[-1]]) + 1
            received = clock.received(chunk.log_ns[part])
            yield self._at(RawRows(streams[number], received, chunk.messages(part)))


@dataclass
class LiveMessages:
    """The messages of a store as they come."""

    store: Path
    items: Sequence[str]

    def prepare(self, server: Server) -> None:
        """Advertise what there is; latched messages from before wait for viewers."""
        catalogue = look(self.store, with_segments=can_build())
        self._chosen = MessageStream(chosen_items(catalogue, View(items=self.items)))
        for stream in self._chosen.streams(catalogue):
            server.advertise(stream.topic)
        for stream, publish_ns, data in latched_before(catalogue, self._chosen, 1 << 62):
            server.send(Frame(stream.topic, publish_ns, data))

    def run(self, server: Server, stop: threading.Event) -> None:
        """Send messages until stopped."""
        store = open_store(self.store)
        tails: dict[str, RawTail] = {}
        while not stop.is_set():
            moved = False
            for tail in _tails(store, tails):
                for delivery in tail.step():
                    moved = True
                    _send(delivery, self._chosen, server)
            if not moved:
                stop.wait(_POLL_S)


def _tails(store: Store, tails: dict[str, RawTail]) -> list[RawTail]:
    """Follow each writer from its end on, also one that begins later."""
    for writer in store.writers():
        if writer in RECORDED and writer not in tails:
            start = position_at(store, writer, None, _NOW_S)
            tails[writer] = RawTail(store, writer, None, start)
    return list(tails.values())


def _send(delivery: Any, chosen: MessageStream, server: Server) -> None:
    if isinstance(delivery, RawRows) and chosen.wants(delivery.stream):
        times = delivery.received_ns.tolist()
        for at_ns, message in zip(times, delivery.messages, strict=True):
            server.send(Frame(delivery.stream.topic, at_ns, message))
    elif isinstance(delivery, Watermark):
        server.websocket.broadcast_time(delivery.received_ns)


@dataclass
class LiveColumns:
    """The rows of a store as JSON as they come, one topic per table."""

    store: Path
    items: Sequence[str]
    _topics: dict[TableSchema, tuple[TableStream, Topic]] = field(default_factory=dict)

    def prepare(self, server: Server) -> None:
        """Advertise the tables that there are."""
        catalogue = look(self.store, with_segments=can_build())
        tables = chosen_tables(catalogue, View(items=self.items)) if catalogue.schemas else []
        for table in tables:
            server.advertise(_topic(table, self._topics)[1])

    def run(self, server: Server, stop: threading.Event) -> None:
        """Send rows until stopped."""
        items = self.items or None
        for delivery in follow(self.store, items, lookback_s=_NOW_S, stop=stop, poll_s=_POLL_S):
            if isinstance(delivery, Batch) and (items or delivery.source != reserved.SOURCE):
                for flat in flatten(delivery):
                    _send_rows(flat, self._topics, server)
            elif isinstance(delivery, Watermark):
                server.websocket.broadcast_time(delivery.received_ns)


def _send_rows(
    flat: Flat, topics: dict[TableSchema, tuple[TableStream, Topic]], server: Server
) -> None:
    stream, topic = _topic(flat.schema, topics)
    if not len(flat):
        return
    names = [column.name for column in flat.schema.columns]
    rows = merge([flat], flat.schema, names, "received")
    table = make_table(flat.schema, stream.wanted, rows)
    messages = (message for part in json_rows(table) for message in part)
    for at_ns, message in zip(rows.received_ns.tolist(), messages, strict=True):
        server.send(Frame(topic, at_ns, message))


def _topic(
    schema: TableSchema, topics: dict[TableSchema, tuple[TableStream, Topic]]
) -> tuple[TableStream, Topic]:
    if schema not in topics:
        stamp = Wanted("timestamp", Column("timestamp", "timestamp", "time"))
        wanted = [stamp, *(Wanted(column.name, column) for column in schema.columns)]
        stream = TableStream(schema, wanted, [(None, None)], "received")
        topics[schema] = stream, json_topic(stream)
    return topics[schema]
