"""The WebSocket server: channels as they are needed, latched messages for those who join late."""

from __future__ import annotations

import ipaddress
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from amberbox.blackbox.exporting.viewerschema import viewer_schema
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Topic

if TYPE_CHECKING:
    from foxglove import Channel, Context
    from foxglove.websocket import (
        ChannelView,
        Client,
        PlaybackControlRequest,
        PlaybackState,
        WebSocketServer,
    )

BACKLOG = 8192
"""Messages that wait for a slow viewer before the oldest are dropped."""

HOST, PORT = "127.0.0.1", 8765


class Frame(NamedTuple):
    """One message for viewers."""

    topic: Topic
    received_ns: int
    data: bytes


def _new_context() -> Context:
    """Raises UsageError where the SDK is not installed."""
    try:
        import foxglove
    except ImportError:
        raise UsageError(
            "the Foxglove SDK is not installed", "pip install amberbox[foxglove]"
        ) from None
    return foxglove.Context()


@dataclass
class Server:
    """Sends frames to whoever has subscribed. ``send`` belongs to one thread.

    What is advertised before ``start`` is there for the first viewer.
    """

    listener: Listener
    context: Context = field(default_factory=_new_context)
    _websocket: WebSocketServer | None = None

    @property
    def websocket(self) -> WebSocketServer:
        """The server that was started."""
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

    def send(self, frame: Frame) -> None:
        """Send one message; the last one of a latched topic is kept for later viewers."""
        channel = self.advertise(frame.topic)
        if frame.topic.latched:
            self.listener.keep(frame, channel)
        channel.log(frame.data, log_time=frame.received_ns)

    def advertise(self, topic: Topic) -> Channel:
        """Make a topic known to viewers."""
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
class Listener:
    """What viewers ask for; called by the server's own thread."""

    on_control: Callable[[PlaybackControlRequest], PlaybackState] | None = None
    channels: dict[Topic, Channel] = field(default_factory=dict)
    subscribed: threading.Event = field(default_factory=threading.Event)
    _latched: dict[str, tuple[Channel, Frame]] = field(default_factory=dict)

    def keep(self, frame: Frame, channel: Channel) -> None:
        """Remember the last message of a latched topic."""
        self._latched[frame.topic.name] = channel, frame

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Give a viewer what was latched before it came."""
        self.subscribed.set()
        kept = self._latched.get(channel.topic)
        if kept is not None:
            kept[0].log(kept[1].data, log_time=kept[1].received_ns)

    def on_playback_control_request(self, request: PlaybackControlRequest) -> PlaybackState | None:
        """Play, pause, seek, or change the speed."""
        return self.on_control(request) if self.on_control is not None else None

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """Do nothing: nobody else is concerned."""


def is_loopback(host: str) -> bool:
    """Tell whether only this computer can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
