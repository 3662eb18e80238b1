"""Listening for what is usual: when the messages of each topic came, and a few of them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

from amberbox.agent.doctor.listening import CountingSink
from amberbox.blackbox.recorder.supervisor import run_source
from amberbox.blackbox.robot_folder.black_box_yaml import SourceBlock
from amberbox.core.errors import AmberboxError
from amberbox.core.topic_selection import TopicSelection
from amberbox.core.types import Topic

_MOST_TIMES = 500_000  # of a topic; a faster one is steady by then
_MOST_TOPICS = 5_000
_MOST_KEPT, _LONGEST_KEPT = 2_000, 1 << 20  # messages, and bytes of each
_LONGEST_MESSAGE = 64_000_000
_STOP_S = 5.0


@dataclass(slots=True)
class ObservedStream:
    """A topic, when its messages were received (ns), how long they were, and a few of them."""

    topic: Topic
    received_ns: list[int] = field(default_factory=list)
    count: int = 0
    total_bytes: int = 0
    kept: deque[bytes] = field(default_factory=lambda: deque(maxlen=_MOST_KEPT))

    @property
    def type(self) -> str:
        """Return the type of its messages as the bus spells it; empty if it has none."""
        return self.topic.schema.name if self.topic.schema else ""


class ObservingSink(CountingSink):
    """A sink that also keeps when messages came, and those of the types that are named."""

    def __init__(self, name: str, kept_types: Collection[str]) -> None:
        super().__init__(name, TopicSelection(()), _LONGEST_MESSAGE)
        self._kept_types = frozenset(kept_types)
        self._observed: list[ObservedStream] = []

    def topic(self, topic: Topic) -> int:
        """Register a topic."""
        with self._lock:
            number = super().topic(topic)
            if number >= _MOST_TOPICS:
                raise AmberboxError(f"more than {_MOST_TOPICS} topics")
            if number == len(self._observed):
                self._observed.append(ObservedStream(topic))
            return number

    def message(self, stream: int, data: bytes, received_ns: int) -> None:
        """Count a message."""
        super().message(stream, data, received_ns)
        one = self._observed[stream]
        with self._lock:
            if self.ended:
                return
            one.count += 1
            one.total_bytes += len(data)
            if len(one.received_ns) < _MOST_TIMES:
                one.received_ns.append(received_ns)
            if one.type in self._kept_types and len(data) <= _LONGEST_KEPT:
                one.kept.append(data)

    def observed(self) -> list[ObservedStream]:
        """Return the topics; of one with several definitions the last."""
        with self._lock:
            return list({stream.topic.name: stream for stream in self._observed}.values())


def listen(
    source: Any, block: SourceBlock, sink: ObservingSink, seconds: float, stop: threading.Event
) -> int:
    """Run a source for so many seconds, or until ``stop``; return when listening ended (ns).

    Raises the error of a source that fails.
    """
    ended, over, failed = threading.Event(), threading.Event(), list[Exception]()

    def work() -> None:
        try:
            run_source(source, block, sink, ended)
        except Exception as error:  # raised below, in the thread of the caller
            failed.append(error)
        finally:
            over.set()

    thread = threading.Thread(target=work, name="listening", daemon=True)
    thread.start()
    end_s = time.monotonic() + seconds
    while not stop.is_set() and not over.is_set() and (left_s := end_s - time.monotonic()) > 0:
        over.wait(min(left_s, 0.2))
    until_ns = sink.now_ns()
    sink.end()
    ended.set()
    thread.join(_STOP_S)
    if failed:
        raise failed[0]
    return until_ns
