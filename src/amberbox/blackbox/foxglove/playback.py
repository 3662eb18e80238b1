"""A time range played back at its own pace: play, pause, seek and speed as viewers ask."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from amberbox.blackbox.foxglove.frames import Frames
from amberbox.blackbox.foxglove.server import Frame, Server
from amberbox.core.clock import NS

if TYPE_CHECKING:
    from foxglove.websocket import PlaybackControlRequest, PlaybackState

TICK_S = 0.05
"""So often viewers are told the time, also where nothing was recorded for a while."""
_SPEEDS = (0.01, 1000.0)


@dataclass
class Playback:
    """Sends the frames of a range when they are due. It begins with the first subscriber."""

    frames: Frames
    span: tuple[int, int]
    speed: float = 1.0
    clock_ns: Callable[[], int] = time.monotonic_ns
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _playing: bool = True
    _ended: bool = False
    _seek_ns: int | None = None
    _at_ns: int = 0
    _anchor: tuple[int, int] = (0, 0)
    """Time of the record and of this computer at which the pace was last set."""

    def __post_init__(self) -> None:
        self._at_ns = self.span[0]

    def control(self, request: PlaybackControlRequest) -> PlaybackState:
        """Do what a viewer asks; called by the server's thread."""
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
            self._begin(server, start_ns)
            if self._play(server, start_ns, stop):
                self._end(server)
            start_ns = self._wait_for_seek(stop)

    def _begin(self, server: Server, start_ns: int) -> None:
        with self._changed:
            self._at_ns, self._ended = start_ns, False
            self._set_pace()
            state = self._state("")
        server.websocket.broadcast_playback_state(state)
        for frame in self.frames.latched(start_ns):
            server.send(frame)

    def _play(self, server: Server, start_ns: int, stop: threading.Event) -> bool:
        """Send frames from a moment on; True at the end, False when something else is wanted."""
        for frame in self.frames.read(start_ns):
            if not self._wait_until_due(frame, server, stop):
                return False
            server.send(frame)
        return True

    def _wait_until_due(self, frame: Frame, server: Server, stop: threading.Event) -> bool:
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
        """Time of the record by the pace."""
        record_ns, began_ns = self._anchor
        return record_ns + round((self.clock_ns() - began_ns) * self.speed)

    def _set_pace(self) -> None:
        self._anchor = self._at_ns, self.clock_ns()

    def _end(self, server: Server) -> None:
        with self._changed:
            if self._seek_ns is None:
                self._playing, self._ended, self._at_ns = False, True, self.span[1]
            state = self._state("")
        server.websocket.broadcast_time(self._at_ns)
        server.websocket.broadcast_playback_state(state)

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
