"""Converts the images of a stream in a thread of its own, between its source and the queue.

The source never waits: what does not fit into the few places before the thread is dropped, counted.
The rate limit comes first, so that no image is converted in vain.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import TypeAlias

from amberbox.blackbox.filters.image import ImageError, ImageFilter
from amberbox.blackbox.recorder.queue import EmitEvent, MessageQueue, TopicStream
from amberbox.blackbox.recorder.watermark import LateSource
from amberbox.core.clock import NS

MOST_WAITING = 4
LATE_NS = NS  # how late an image may be, as it waits for its conversion
TOO_SLOW = "images came faster than they could be converted"

_Image: TypeAlias = "tuple[bytes, int]"


class ImageConverter:
    """Puts the converted images of a stream into the queue, on a stream of their own.

    An image that cannot be converted is put on the stream it came on, with an event for the first.
    The record's watermark waits for images as a source that is ``late``. Without it they are
    converted in the thread of the caller: a file, which waits for room.
    """

    def __init__(
        self,
        images: ImageFilter,
        streams: tuple[TopicStream, TopicStream],
        queue: MessageQueue,
        emit: EmitEvent,
        late: LateSource | None,
    ) -> None:
        self._images = images
        self._as_sent, self._converted = streams
        self._queue = queue
        self._emit = emit
        self._late = late
        self._rate = self._as_sent.item.rate
        for stream in streams:
            stream.limited = True
        self._waiting: deque[_Image] = deque()
        self._change = threading.Condition()
        self._ends = False
        self._is_reported = False
        self._thread: threading.Thread | None = None

    def put(self, data: bytes, received_ns: int) -> None:
        """Take an image; it is dropped and counted if too many wait."""
        if self._rate is not None and not self._rate.accept(received_ns):
            self._queue.count_rate_limited(self._as_sent, received_ns)
            return
        if self._late is None:
            self._convert(data, received_ns)
            return
        with self._change:
            waiting = sum(len(image) for image, _ in self._waiting)
            is_full = waiting + len(data) > self._queue.longest_bytes
            if is_full or len(self._waiting) >= MOST_WAITING or self._ends:
                self._queue.count_dropped(self._as_sent, received_ns, received_ns, 1, TOO_SLOW)
                return
            self._waiting.append((data, received_ns))
            self._promise()
            self._change.notify()
            if self._thread is None:
                name = f"images {self._as_sent.item.name}"
                self._thread = threading.Thread(target=self._run, name=name, daemon=True)
                self._thread.start()

    @property
    def is_busy(self) -> bool:
        """Return whether images wait or are being converted."""
        return bool(self._waiting)

    def finish(self) -> None:
        """Convert what waits, and end the thread."""
        with self._change:
            self._ends = True
            self._change.notify()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        while True:
            with self._change:
                while not self._waiting:
                    if self._ends:
                        return
                    self._change.wait()
                data, received_ns = self._waiting[0]
            self._convert(data, received_ns)
            with self._change:
                self._waiting.popleft()
                self._promise()

    def _promise(self) -> None:
        """Let the record's watermark wait for the oldest image that is not in the queue yet."""
        if self._late is not None:
            self._late.complete_ns = self._waiting[0][1] - 1 if self._waiting else None

    def _convert(self, data: bytes, received_ns: int) -> None:
        stream = self._converted
        try:
            data = self._images.convert(data)
        except ImageError as error:
            stream = self._as_sent
            if not self._is_reported:
                self._is_reported = True
                item = stream.item
                text = f"{item.name}: an image is kept as it came: {error}"
                self._emit("image_kept", text, item.source, item=item.name)
        put = self._queue.put_waiting if self._late is None else self._queue.put
        put(stream, data, received_ns)
