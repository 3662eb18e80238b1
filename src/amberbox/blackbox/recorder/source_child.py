"""The process of a source: runs it, and passes what it receives to the recorder through a pipe.

Started by ``source_process`` as ``python -m amberbox.blackbox.recorder.source_child PIPE CONTROL``.
Each message is put into the pipe at once, so that it is recorded even if the process dies next.
Only when the pipe is full, because the recorder is held up, do messages wait here, bounded.
"""

from __future__ import annotations

import faulthandler
import gc
import importlib
import os
import select
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from amberbox.blackbox.recorder.source_frames import (
    ALIVE,
    CALL,
    COMPLETE,
    HEAD,
    LENGTH,
    MESSAGE,
    Answer,
    Dropped,
    Ended,
    EventCall,
    LastLatched,
    LinkDown,
    LinkUp,
    Lost,
    NewBase,
    PowerCall,
    SaveState,
    SourceCall,
    SourceSetup,
    TopicCall,
    decode_recorder_call,
    encode,
    plain,
)
from amberbox.blackbox.robot_folder.black_box_yaml import read_config
from amberbox.core.child_process import drop_protection, end_with_parent
from amberbox.core.config import raise_errors
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.source import Power
from amberbox.core.types import Topic

ALIVE_S = 0.02
# a message is stamped a moment before the sink gets it: so much earlier it is surely there
_STAMPED_NS = 20_000_000
_OVERHEAD = 120  # bytes of a waiting message beside its payload
_MOST_PARTS = 64  # of one call of writev


class PipeSink:
    """The sink of a source in its own process. Never waits, unless the source is lossless."""

    def __init__(self, pipe: int, setup: SourceSetup) -> None:
        os.set_blocking(pipe, False)
        self._pipe = pipe
        self._name = setup.name
        self._limit = setup.longest_bytes
        self._base_ns = setup.base_ns
        self._state = setup.state
        self._changed = threading.Condition(threading.Lock())
        self._waiting: deque[memoryview] = deque()
        self._waiting_bytes = 0
        self._put_bytes = 0  # all that was ever to be written, and what of it has been
        self._written_bytes = 0
        self._alive_at = 0  # where in these bytes the last sign of life is
        self._topics: dict[Topic, int] = {}
        self._drops: dict[int, tuple[int, int, int]] = {}
        self._events_dropped = 0
        self._answers: dict[int, bytes | None] = {}
        self._asked = 0
        self._complete_ns: int | None = None
        self.is_lossless = False
        self.is_late = False

    # -- the sink

    def now_ns(self) -> int:
        return self._base_ns + time.clock_gettime_ns(time.CLOCK_BOOTTIME)

    def topic(self, topic: Topic) -> int:
        with self._changed:
            if topic not in self._topics:
                self._topics[topic] = len(self._topics)
                self._call(TopicCall(topic))
            return self._topics[topic]

    def message(self, stream: int, data: bytes, received_ns: int) -> None:
        at_ns = received_ns - self._base_ns
        with self._changed:
            if not self._waiting and len(data) <= self._limit:
                self._put((HEAD.pack(MESSAGE, stream, len(data), at_ns), data))
                return
            size = len(data) + _OVERHEAD
            while self.is_lossless and len(data) <= self._limit and self._is_full_for(size):
                self._changed.wait()
            if self._is_full_for(size):
                first, last, count = self._drops.get(stream, (at_ns, at_ns, 0))
                self._drops[stream] = (min(first, at_ns), max(last, at_ns), count + 1)
            else:
                self._put((HEAD.pack(MESSAGE, stream, len(data), at_ns), data))

    def longest_message(self) -> int:
        return self._limit

    def complete(self, until_ns: int) -> None:
        self._complete_ns = until_ns - self._base_ns

    def link_up(self, topic: str, peer: str, since_ns: int | None = None) -> None:
        since = None if since_ns is None else since_ns - self._base_ns
        self._send(LinkUp(topic, peer, since))

    def link_down(self, topic: str, peer: str, reason: str, since_ns: int | None = None) -> None:
        since = self.now_ns() if since_ns is None else since_ns
        self._send(LinkDown(topic, peer, reason, since - self._base_ns))

    def lost(
        self, topic: str, peer: str, from_ns: int, to_ns: int, count: int, reason: str
    ) -> None:
        base_ns = self._base_ns
        self._send(Lost(topic, peer, from_ns - base_ns, to_ns - base_ns, count, reason))

    def event(self, kind: str, text: str, **details: Any) -> None:
        with self._changed:
            if self._waiting_bytes > self._limit:
                self._events_dropped += 1
            else:
                self._call(EventCall(kind, text, details))

    def power(self, state: Power, text: str) -> None:
        self._send(PowerCall(state, text))

    def last_latched(self, topic: str) -> bytes | None:
        with self._changed:
            self._asked += 1
            number = self._asked
            self._call(LastLatched(number, topic))
            self._changed.wait_for(lambda: number in self._answers)
            return self._answers.pop(number)

    def state(self) -> dict[str, Any]:
        return dict(self._state)

    def save_state(self, state: Mapping[str, Any]) -> None:
        self._state = plain(state)
        self._send(SaveState(self._state))

    # -- to the recorder

    def _is_full_for(self, size: int) -> bool:
        """Return whether a message has no room; one of any allowed size fits if none waits."""
        if size - _OVERHEAD > self._limit:
            return True
        return self._waiting_bytes > 0 and self._waiting_bytes + size > self._limit

    def _send(self, call: SourceCall) -> None:
        with self._changed:
            self._call(call)

    def _call(self, call: SourceCall) -> None:
        data = encode(call)
        self._put((HEAD.pack(CALL, 0, len(data), self._boot_ns()), data))

    def _put(self, parts: tuple[bytes, bytes]) -> None:
        """Write a frame as far as the pipe takes it; the rest waits. Holds the lock."""
        size = len(parts[0]) + len(parts[1])
        self._put_bytes += size
        written = 0
        if not self._waiting:
            try:
                written = os.writev(self._pipe, parts)
            except BlockingIOError:
                written = 0
            self._written_bytes += written
        if written == size:
            return
        for part in parts:
            if written < len(part):
                self._waiting.append(memoryview(part)[written:])
                self._waiting_bytes += len(part) - written
            written = max(0, written - len(part))
        self._changed.notify_all()

    def _boot_ns(self) -> int:
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)

    def pass_on(self) -> None:
        """Write what waits, and signs of life, until the process ends; for a thread of its own."""
        while True:
            with self._changed:
                if not self._waiting:
                    self._changed.wait(ALIVE_S)
                is_full = bool(self._waiting)
                self._tell_drops()
                self._show_life()
            if is_full:
                self._write_waiting()

    def flush(self) -> None:
        """Write all that waits; waits for the recorder as long as that takes."""
        while True:
            with self._changed:
                self._tell_drops()
                if not self._waiting:
                    return
            self._write_waiting()

    def _show_life(self) -> None:
        if self._written_bytes < self._alive_at:  # the last sign still waits
            return
        now_ns = self._boot_ns()
        complete_ns = now_ns - _STAMPED_NS
        if self.is_late:
            complete_ns = min(complete_ns, self._complete_ns or 0)
        data = COMPLETE.pack(complete_ns)
        self._put((HEAD.pack(ALIVE, 0, len(data), now_ns), data))
        self._alive_at = self._put_bytes

    def _tell_drops(self) -> None:
        """Report drops once half the room is free again. Holds the lock."""
        if self._waiting_bytes > self._limit // 2:
            return
        for stream, (first_ns, last_ns, count) in self._drops.items():
            self._call(Dropped(stream, first_ns, last_ns, count))
        self._drops = {}
        if self._events_dropped:
            count, self._events_dropped = self._events_dropped, 0
            text = f"{count} events of {self._name} found no room"
            self._call(EventCall("events_dropped", text, {"count": count}))

    def _write_waiting(self) -> None:
        """Wait until the pipe takes more, then write it."""
        waiting = select.poll()
        waiting.register(self._pipe, select.POLLOUT)
        waiting.poll(1000 * ALIVE_S)
        with self._changed:
            parts = [self._waiting[n] for n in range(min(_MOST_PARTS, len(self._waiting)))]
            try:
                written = os.writev(self._pipe, parts)
            except BlockingIOError:
                return
            self._written_bytes += written
            self._waiting_bytes -= written
            while written:
                first = self._waiting.popleft()
                if written < len(first):
                    self._waiting.appendleft(first[written:])
                written = max(0, written - len(first))
            self._changed.notify_all()

    # -- from the recorder

    def follow(self, control: BinaryIO, stop: threading.Event) -> None:
        """Carry out the recorder's calls; end the process when the recorder is gone."""
        while True:
            try:
                call = decode_recorder_call(_frame(control))
            except (OSError, ValueError, msgspec.MsgspecError):
                os._exit(1)
            with self._changed:
                if isinstance(call, Answer):
                    self._answers[call.number] = call.data
                    self._changed.notify_all()
                elif isinstance(call, NewBase):
                    self._base_ns = call.base_ns
                else:
                    stop.set()


def _frame(control: BinaryIO) -> bytes:
    """Read a frame; raises ValueError at the end."""
    head = control.read(LENGTH.size)
    if len(head) < LENGTH.size:
        raise ValueError("the recorder is gone")
    (size,) = LENGTH.unpack(head)
    return control.read(size)


def main(arguments: list[str]) -> None:
    """Run the source that the recorder names, and report how it ended."""
    for number in (signal.SIGINT, signal.SIGTERM):  # the recorder gets them too, and ends this
        signal.signal(number, signal.SIG_IGN)
    pipe, control_fd = map(int, arguments)
    for inherited in (pipe, control_fd):
        os.set_inheritable(inherited, False)
    faulthandler.enable(all_threads=False)
    control = os.fdopen(control_fd, "rb")
    setup = msgspec.msgpack.decode(_frame(control), type=SourceSetup)
    end_with_parent(setup.parent, signal.SIGKILL)
    drop_protection()
    sink, stop = PipeSink(pipe, setup), threading.Event()
    threading.Thread(target=sink.pass_on, name="pipe", daemon=True).start()
    threading.Thread(target=sink.follow, args=(control, stop), name="control", daemon=True).start()
    sink._send(_run(sink, setup, stop))
    sink.flush()
    sys.stdout.flush()
    os._exit(0)  # native libraries may have threads that would keep the process, or crash it


def _run(sink: PipeSink, setup: SourceSetup, stop: threading.Event) -> Ended:
    try:
        module = importlib.import_module(setup.module)
        problems: list[Problem] = []
        config = read_config(module.Config, setup.node, setup.plugin, Path(setup.folder), problems)
        raise_errors(problems)
        source = module.Source(config, setup.name)
        sink.is_lossless = source.lossless
        sink.is_late = getattr(source, "late_s", 0.0) > 0
        gc.collect()
        gc.freeze()
        source.run(sink, stop)
    except AmberboxError as error:
        return Ended(str(error), repr(error), error.what, error.hint)
    except BaseException as error:  # the recorder judges it
        return Ended(str(error) or type(error).__name__, repr(error))
    return Ended()


if __name__ == "__main__":
    main(sys.argv[1:])
