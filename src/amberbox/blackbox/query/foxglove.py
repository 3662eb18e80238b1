"""Serve a record over the Foxglove WebSocket protocol, live or played back."""

from __future__ import annotations

import heapq
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema, flatten
from amberbox.blackbox.columns.json_schema import viewer_schema
from amberbox.blackbox.columns.variables import SelectedColumn
from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.query.export_job import (
    ExportReport,
    RefreshingCatalogue,
    View,
    Window,
    chosen_items,
    chosen_tables,
)
from amberbox.blackbox.query.export_messages import MessageStream, latched_before, without_originals
from amberbox.blackbox.query.export_tables import TableStream, json_rows, json_topic, table_streams
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.query.rows import make_table
from amberbox.blackbox.store.batches import ItemStream
from amberbox.blackbox.store.catalogue import StoreCatalogue, read_catalogue
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.blackbox.store.segment_file import can_build
from amberbox.blackbox.store.store import open_store
from amberbox.blackbox.store.table_reader import merge
from amberbox.blackbox.store.tail import RECORDED, WriterTail, follow, position_at
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Batch, Column, Cursor, IntArray, Topic, Watermark

if TYPE_CHECKING:
    from foxglove import Channel, Context
    from foxglove.websocket import (
        ChannelView,
        Client,
        PlaybackControlRequest,
        PlaybackState,
        WebSocketServer,
    )


BACKLOG = 8192  # messages that wait for a slow viewer before the oldest are dropped

HOST, PORT = "127.0.0.1", 8765


class ViewerMessage(NamedTuple):
    """One message for viewers."""

    topic: Topic
    received_ns: int
    data: bytes


def _new_context() -> Context:
    """Return a new context of the SDK; raises UsageError where it is not installed."""
    try:
        import foxglove
    except ImportError:
        raise UsageError(
            "the Foxglove SDK is not installed", "pip install amberbox[foxglove]"
        ) from None
    return foxglove.Context()


@dataclass
class Server:
    """Sends messages to subscribed viewers; ``send`` may be called from several threads.

    Channels advertised before ``start`` are available to the first viewer.
    """

    listener: ViewerListener
    context: Context = field(default_factory=_new_context)
    _websocket: WebSocketServer | None = None
    _advertising: threading.Lock = field(default_factory=threading.Lock)

    @property
    def websocket(self) -> WebSocketServer:
        """Return the server that was started."""
        assert self._websocket is not None
        return self._websocket

    def start(self, name: str, host: str, port: int, span: tuple[int, int] | None = None) -> None:
        """Begin to serve; with ``span`` viewers may control the playback of that range.

        Raises AmberboxError where the port is not free.
        """
        import foxglove
        from foxglove.websocket import Capability

        listener: Any = self.listener  # the protocol lists more callbacks than are ever called
        try:
            self._websocket = foxglove.start_server(
                name=name,
                host=host,
                port=port,
                capabilities=[Capability.Time],
                server_listener=listener,
                context=self.context,
                playback_time_range=span,
                message_backlog_size=BACKLOG,
            )
        except (RuntimeError, OSError) as error:
            raise AmberboxError(
                f"cannot serve on {host}:{port}: {error}", "choose another --port"
            ) from error

    def stop(self) -> None:
        """Send viewers away."""
        if self._websocket is not None:
            self._websocket.stop()

    def send(self, frame: ViewerMessage) -> None:
        """Send one message; the last one of a latched topic is kept for later viewers."""
        channel = self.advertise(frame.topic)
        if frame.topic.latched:
            self.listener.keep(frame, channel)
        channel.log(frame.data, log_time=frame.received_ns)

    def advertise(self, topic: Topic) -> Channel:
        """Make a topic known to viewers."""
        with self._advertising:
            channel = self.listener.channels.get(topic)
            if channel is None:
                channel = self.listener.channels[topic] = self._channel(topic)
            return channel

    def _channel(self, topic: Topic) -> Channel:
        from foxglove import Channel, Schema

        known = viewer_schema(topic.schema)
        schema = None
        if known is not None:
            schema = Schema(name=known.name, encoding=known.encoding, data=known.data)
        return Channel(
            topic.name, schema=schema, message_encoding=topic.message_encoding, context=self.context
        )


@dataclass
class ViewerListener:
    """Handler of viewers' requests; called by the server's own thread."""

    on_control: Callable[[PlaybackControlRequest], PlaybackState] | None = None
    channels: dict[Topic, Channel] = field(default_factory=dict)
    subscribed: threading.Event = field(default_factory=threading.Event)
    _latched: dict[str, tuple[Channel, ViewerMessage]] = field(default_factory=dict)

    def keep(self, frame: ViewerMessage, channel: Channel) -> None:
        """Keep the last message of a latched topic."""
        self._latched[frame.topic.name] = channel, frame

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Send a viewer the latched messages from before its connection."""
        self.subscribed.set()
        kept = self._latched.get(channel.topic)
        if kept is not None:
            kept[0].log(kept[1].data, log_time=kept[1].received_ns)

    def on_playback_control_request(self, request: PlaybackControlRequest) -> PlaybackState | None:
        """Handle a request to play, pause, seek, or change the speed."""
        return self.on_control(request) if self.on_control is not None else None

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """Do nothing: other viewers are not affected."""


class Frames(Protocol):
    """The messages of a range, in order of time."""

    @property
    def topics(self) -> Sequence[Topic]:
        """All topics of the messages."""

    def latched(self, at_ns: int) -> Sequence[ViewerMessage]:
        """Return the last messages of latched topics before a moment."""

    def read(self, from_ns: int) -> Iterator[ViewerMessage]:
        """Yield the messages from a moment on."""


@dataclass
class MessageFrames:
    """The original messages of a window."""

    record: Record
    items: Sequence[str]
    window: Window

    def __post_init__(self) -> None:
        self.report = ExportReport(None, "messages")
        self.current = RefreshingCatalogue(self.record.path, self.report)
        view = View(items=self.items)
        self.chosen = MessageStream(self.current.ask(lambda known: chosen_items(known, view)))
        for text in without_originals(self.current.catalogue, self.chosen, self.window):
            self.report.miss(text)

    @cached_property
    def topics(self) -> list[Topic]:
        """Return all topics."""
        return [stream.topic for stream in self.current.ask(self.chosen.streams)]

    def latched(self, at_ns: int) -> list[ViewerMessage]:
        """Return the last messages of latched topics before a moment."""
        found = self.current.ask(lambda known: latched_before(known, self.chosen, at_ns))
        return [ViewerMessage(stream.topic, at_ns, data) for stream, _, data in found]

    def read(self, from_ns: int, to_ns: int | None = None) -> Iterator[ViewerMessage]:
        """Read on from a moment, to the end of the window or to another one."""
        window = (from_ns, self.window[1] if to_ns is None else to_ns)
        for block, _ in self.chosen.read(self.current, window):
            topics = [stream.topic for stream in block.streams]
            times, places = block.received_ns.tolist(), block.stream.tolist()
            for place, at_ns, data in zip(places, times, block.data, strict=True):
                yield ViewerMessage(topics[place], at_ns, data)


@dataclass
class ColumnFrames:
    """The rows of a window as JSON, one topic per table."""

    record: Record
    items: Sequence[str]
    window: Window

    def __post_init__(self) -> None:
        self.report = ExportReport(None, "columns")
        self.current = RefreshingCatalogue(self.record.path, self.report)
        view = View(items=self.items)
        self._streams = self.current.ask(lambda known: table_streams(known, view))

    @cached_property
    def topics(self) -> list[Topic]:
        """Return one topic per table."""
        return [json_topic(stream) for stream in self._streams]

    def latched(self, at_ns: int) -> list[ViewerMessage]:
        """Return nothing: rows are not latched."""
        return []

    def read(self, from_ns: int) -> Iterator[ViewerMessage]:
        """Read on from a moment."""
        window = (from_ns, self.window[1])
        streams = [
            TableStream(stream.schema, stream.wanted, [window], stream.by)
            for stream in self._streams
        ]
        rows = [self._rows(s, t) for s, t in zip(streams, self.topics, strict=True)]
        return heapq.merge(*rows, key=attrgetter("received_ns"))

    def _rows(self, stream: TableStream, topic: Topic) -> Iterator[ViewerMessage]:
        for block in stream.blocks(self.current):
            messages = (message for part in json_rows(block.table) for message in part)
            for at_ns, message in zip(block.received_ns.tolist(), messages, strict=True):
                yield ViewerMessage(topic, at_ns, message)


@dataclass(frozen=True)
class MergedFrames:
    """The messages of several sources together."""

    parts: Sequence[Frames]

    @property
    def topics(self) -> Sequence[Topic]:
        """Return the topics of all."""
        return [topic for part in self.parts for topic in part.topics]

    def latched(self, at_ns: int) -> Sequence[ViewerMessage]:
        """Return the last messages of latched topics before a moment."""
        return [message for part in self.parts for message in part.latched(at_ns)]

    def read(self, from_ns: int) -> Iterator[ViewerMessage]:
        """Yield the messages from a moment on."""
        return heapq.merge(
            *(part.read(from_ns) for part in self.parts), key=attrgetter("received_ns")
        )


def span_of(catalogue: StoreCatalogue, window: Window) -> tuple[int, int]:
    """Return the first and the last time (ns) of the data of a record in a window.

    Raises AmberboxError when there are none.
    """
    bounds = list(_bounds(catalogue))
    first = min((low for low, _ in bounds), default=None)
    last = max((high for _, high in bounds), default=None)
    if first is None or last is None:
        raise AmberboxError(f"nothing is recorded in {catalogue.store}", "record something first")
    start = first if window[0] is None else max(first, window[0])
    stop = last if window[1] is None else min(last, window[1])
    if start > stop:
        raise AmberboxError("nothing is recorded in this range", "choose --from and --to otherwise")
    return start, stop


def _bounds(catalogue: StoreCatalogue) -> Iterator[tuple[int, int]]:
    for segments in catalogue.manifest.segments.values():
        yield from (segment.received_range_ns for segment in segments)
    for journal in catalogue.journals(skip=()):
        if journal.places:
            yield journal.received_range_ns


TICK_S = 0.05  # how often viewers get the time, also where nothing was recorded for a while
_SPEEDS = (0.01, 1000.0)


@dataclass
class Playback:
    """Sends the frames of a range when they are due. It begins with the first subscriber."""

    frames: Frames
    span: tuple[int, int]
    speed: float = 1.0
    clock_ns: Callable[[], int] = time.monotonic_ns
    loop: bool = False
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _playing: bool = True
    _ended: bool = False
    _seek_ns: int | None = None
    _at_ns: int = 0
    _anchor: tuple[int, int] = (0, 0)
    """Time of the record and of this computer at which the pace was last set."""

    def __post_init__(self) -> None:
        self._at_ns = self.span[0]

    def pause(self) -> None:
        """Do not play before a viewer asks for it."""
        self._playing = False

    def control(self, request: PlaybackControlRequest) -> PlaybackState:
        """Carry out a viewer's request; called by the server's thread."""
        from foxglove.websocket import PlaybackCommand

        with self._changed:
            if self._playing:
                self._at_ns = min(max(self._at_ns, self._now_ns()), self.span[1])
            self._playing = request.playback_command == PlaybackCommand.Play
            self.speed = min(max(request.playback_speed or 1.0, _SPEEDS[0]), _SPEEDS[1])
            if request.seek_time is not None:
                self._seek_ns = min(max(request.seek_time, self.span[0]), self.span[1])
            elif self._ended and self._playing:
                self._seek_ns = self.span[0]
            if self._seek_ns is not None:
                self._at_ns = self._seek_ns
            self._set_pace()
            self._changed.notify_all()
            return self._state(request.request_id, did_seek=self._seek_ns is not None)

    def run(self, server: Server, stop: threading.Event) -> None:
        """Play until stopped; at the end wait for a viewer to seek or to play again."""
        while not server.listener.subscribed.wait(TICK_S):
            if stop.is_set():
                return
        start_ns: int | None = self.span[0]
        while start_ns is not None and not stop.is_set():
            with self._changed:
                self._at_ns, self._ended = start_ns, False
                self._set_pace()
                state = self._state("")
            server.websocket.broadcast_playback_state(state)
            for frame in self.frames.latched(start_ns):
                server.send(frame)
            if self._play(server, start_ns, stop):
                with self._changed:
                    if self._seek_ns is None and self.loop:
                        self._seek_ns = self.span[0]
                    elif self._seek_ns is None:
                        self._playing, self._ended, self._at_ns = False, True, self.span[1]
                    state = self._state("")
                server.websocket.broadcast_time(self._at_ns)
                server.websocket.broadcast_playback_state(state)
            start_ns = self._wait_for_seek(stop)

    def _play(self, server: Server, start_ns: int, stop: threading.Event) -> bool:
        """Send frames from a moment on; True at the end, False when something else is wanted."""
        for frame in self.frames.read(start_ns):
            if not self._wait_until_due(frame, server, stop):
                return False
            server.send(frame)
        return True

    def _wait_until_due(self, frame: ViewerMessage, server: Server, stop: threading.Event) -> bool:
        while not stop.is_set():
            with self._changed:
                if self._seek_ns is not None:
                    return False
                if self._playing:
                    wait_s = (frame.received_ns - self._now_ns()) / self.speed / NS
                    if wait_s <= 0:
                        self._at_ns = max(self._at_ns, frame.received_ns)
                        return True
                    self._at_ns = max(self._at_ns, self._now_ns())
                self._changed.wait(min(wait_s, TICK_S) if self._playing else TICK_S)
            server.websocket.broadcast_time(self._at_ns)
        return False

    def _now_ns(self) -> int:
        """Return the time of the record (ns) by the pace."""
        record_ns, began_ns = self._anchor
        return record_ns + round((self.clock_ns() - began_ns) * self.speed)

    def _set_pace(self) -> None:
        self._anchor = self._at_ns, self.clock_ns()

    def _wait_for_seek(self, stop: threading.Event) -> int | None:
        while not stop.is_set():
            with self._changed:
                if self._seek_ns is not None:
                    start_ns, self._seek_ns = self._seek_ns, None
                    return start_ns
                self._changed.wait(TICK_S)
        return None

    def _state(self, request_id: str, *, did_seek: bool = False) -> PlaybackState:
        from foxglove.websocket import PlaybackState, PlaybackStatus

        status = PlaybackStatus.Playing if self._playing else PlaybackStatus.Paused
        if self._ended and self._seek_ns is None:
            status = PlaybackStatus.Ended
        return PlaybackState(status, self._at_ns, self.speed, did_seek, request_id)


_POLL_S = 0.02
_NOW_S = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class ReceivedMessages:
    """Original messages of one stream, with their times of receipt."""

    stream: ItemStream
    received_ns: IntArray
    messages: Sequence[bytes]
    cursor: Cursor = field(default_factory=Cursor)


class MessageTail(WriterTail):
    """Follows one writer's journal and returns messages instead of batches."""

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
            yield self._at(ReceivedMessages(streams[number], received, chunk.messages(part)))


@dataclass
class LiveMessages:
    """New messages of a store, sent as they are written."""

    store: Path
    items: Sequence[str]

    def prepare(self, server: Server) -> None:
        """Advertise the channels; earlier latched messages are kept for viewers."""
        catalogue = read_catalogue(self.store, with_segments=can_build())
        self._chosen = MessageStream(chosen_items(catalogue, View(items=self.items)))
        for stream in self._chosen.streams(catalogue):
            server.advertise(stream.topic)
        for stream, publish_ns, data in latched_before(catalogue, self._chosen, 1 << 62):
            server.send(ViewerMessage(stream.topic, publish_ns, data))

    def run(self, server: Server, stop: threading.Event) -> None:
        """Send messages until stopped."""
        store = open_store(self.store)
        tails: dict[str, MessageTail] = {}
        while not stop.is_set():
            moved = False
            # follow each writer from its end on, also one that begins later
            for writer in store.writers():
                if writer in RECORDED and writer not in tails:
                    start = position_at(store, writer, None, _NOW_S)
                    tails[writer] = MessageTail(store, writer, None, start)
            for tail in list(tails.values()):
                for delivery in tail.step():
                    moved = True
                    if isinstance(delivery, ReceivedMessages) and self._chosen.wants(
                        delivery.stream
                    ):
                        times = delivery.received_ns.tolist()
                        for at_ns, message in zip(times, delivery.messages, strict=True):
                            server.send(ViewerMessage(delivery.stream.topic, at_ns, message))
                    elif isinstance(delivery, Watermark):
                        server.websocket.broadcast_time(delivery.received_ns)
            if not moved:
                stop.wait(_POLL_S)


@dataclass
class LiveColumns:
    """New rows of a store as JSON, sent as they are written; one topic per table."""

    store: Path
    items: Sequence[str]
    _topics: dict[TableSchema, tuple[TableStream, Topic]] = field(default_factory=dict)

    def prepare(self, server: Server) -> None:
        """Advertise the tables."""
        catalogue = read_catalogue(self.store, with_segments=can_build())
        tables = chosen_tables(catalogue, View(items=self.items)) if catalogue.schemas else []
        for table in tables:
            server.advertise(self._stream(table)[1])

    def run(self, server: Server, stop: threading.Event) -> None:
        """Send rows until stopped."""
        items = self.items or None
        for delivery in follow(self.store, items, lookback_s=_NOW_S, stop=stop, poll_s=_POLL_S):
            if isinstance(delivery, Batch) and (items or delivery.source != channels.SOURCE):
                for flat in flatten(delivery):
                    self._send_rows(flat, server)
            elif isinstance(delivery, Watermark):
                server.websocket.broadcast_time(delivery.received_ns)

    def _send_rows(self, flat: FlatTable, server: Server) -> None:
        stream, topic = self._stream(flat.schema)
        if not len(flat):
            return
        names = [column.name for column in flat.schema.columns]
        rows = merge([flat], flat.schema, names, "received")
        table = make_table(flat.schema, stream.wanted, rows)
        messages = (message for part in json_rows(table) for message in part)
        for at_ns, message in zip(rows.received_ns.tolist(), messages, strict=True):
            server.send(ViewerMessage(topic, at_ns, message))

    def _stream(self, schema: TableSchema) -> tuple[TableStream, Topic]:
        if schema not in self._topics:
            stamp = SelectedColumn("timestamp", Column("timestamp", "timestamp", "time"))
            wanted = [stamp, *(SelectedColumn(column.name, column) for column in schema.columns)]
            stream = TableStream(schema, wanted, [(None, None)], "received")
            self._topics[schema] = stream, json_topic(stream)
        return self._topics[schema]
