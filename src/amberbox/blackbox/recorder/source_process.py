"""A source in a process of its own: what a native library does there costs the recorder nothing.

The process has ended, or shows no life, or sends what cannot be read: then the source has failed,
and its gap begins at the last sign of life.
"""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from fcntl import F_SETPIPE_SZ, fcntl
from pathlib import Path
from types import ModuleType
from typing import Protocol

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
    RecorderCall,
    SaveState,
    SourceCall,
    SourceSetup,
    Stop,
    TopicCall,
    decode_source_call,
    encode,
)
from amberbox.core.child_process import ChildOutput, read_all
from amberbox.core.errors import AmberboxError
from amberbox.core.files import wait_readable, write_all
from amberbox.core.source import Sink
from amberbox.core.yaml_nodes import Node

SILENT_S = 10.0  # a process that shows no life for this long has failed
START_S = 60.0  # the same until its first sign of life
STOP_S = 2.0  # how long a source may take to end
PIPE_BYTES = 1 << 20
_BUFFER_BYTES = 1 << 18
_CALL_BYTES = 1 << 26  # the longest call: a topic with its definition, an event
_PAUSE_S = 0.005  # messages that come within it are read at once
_LOOK_S = 0.1
_STEP_NS = 50_000_000  # a larger change of log time against boot time is a new epoch
_LINES, _LINES_PER_S = 20.0, 0.2  # of a source's output that become events


class ProcessSink(Sink, Protocol):
    """A sink of what a source's process passes on a moment later, or has dropped."""

    def link_up_at(self, topic: str, peer: str, at_ns: int, since_ns: int | None) -> None:
        """Report as ``link_up`` that messages arrive since ``at_ns``."""

    def dropped(self, stream: int, from_ns: int, to_ns: int, count: int) -> None:
        """Count messages as dropped for want of room."""


class SourceProcessError(AmberboxError):
    """The process of a source died or failed; ``since_ns`` is its last sign of life (log time)."""

    def __init__(self, what: str, since_ns: int) -> None:
        super().__init__(what)
        self.since_ns = since_ns


class SourceRunError(Exception):
    """``run`` raised an error that is no AmberboxError in the process of a source."""

    def __init__(self, call: Ended) -> None:
        super().__init__(call.error)
        self._representation = call.representation

    def __repr__(self) -> str:
        return self._representation


def needs_process(module: ModuleType, config: object) -> bool:
    """Return whether a source module asks for a process of its own for a configuration."""
    asks: Callable[[object], bool] | None = getattr(module, "needs_process", None)
    return asks is not None and asks(config)


@dataclass
class SourceProcess:
    """Runs a source of a module in a process of its own, with its block as it was read."""

    module: str
    plugin: str
    name: str
    node: Node
    folder: Path
    stop_s: float = STOP_S

    def run(self, sink: ProcessSink, stop: threading.Event) -> None:
        """Run the source until ``stop`` is set or it has ended, as ``Source.run`` does.

        Raises what ``run`` raised, as AmberboxError or SourceRunError, and SourceProcessError if
        the process dies.
        """
        _Run(self, sink, stop).run()


class _Run:
    """One run of a source's process."""

    def __init__(self, source: SourceProcess, sink: ProcessSink, stop: threading.Event) -> None:
        self._source = source
        self._sink = sink
        self._stop = stop
        self._base_ns = self._told_base_ns = _base_ns(sink)
        self._alive_ns = self._boot_ns()
        self._streams: list[int] = []
        self._ended: Ended | None = None
        self._trouble = ""
        self._control = -1
        self._frames = 0
        self._reads = False  # the reader waits for the process, and not for the recorder
        self._control_lock = threading.Lock()
        self._longest = max(sink.longest_message(), _CALL_BYTES)

    def run(self) -> None:
        process, pipe, output = self._start()
        reader = threading.Thread(
            target=self._read, args=(pipe,), name=f"{self._source.name} pipe", daemon=True
        )
        lines = ChildOutput(self._source.name, self._note_line, _LINES, _LINES_PER_S)
        try:
            reader.start()
            self._watch(process, reader, output, lines)
        finally:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)  # with all that it has started
            status = process.wait()
            reader.join()
            lines.feed(read_all(output), time.monotonic())
            lines.end(time.monotonic())
            os.close(output)
            with self._control_lock:
                os.close(self._control)
                self._control = -1
        self._judge(status)

    def _judge(self, status: int) -> None:
        """Raise the error by which the run ended."""
        if self._ended is not None:
            if self._ended.what:
                raise AmberboxError(self._ended.what, self._ended.hint)
            if self._ended.error:
                raise SourceRunError(self._ended)
            return
        reason = self._trouble or f"ended {_how(status)}"
        since_ns = self._base_ns + min(self._alive_ns, self._boot_ns())
        raise SourceProcessError(f"the process of the source {reason}", since_ns)

    def _start(self) -> tuple[subprocess.Popen[bytes], int, int]:
        """Start the process; return it with the pipe to read, and its output."""
        source = self._source
        setup = SourceSetup(
            parent=os.getpid(), module=source.module, plugin=source.plugin, name=source.name,
            node=source.node, folder=str(source.folder.absolute()), base_ns=self._base_ns,
            longest_bytes=self._sink.longest_message(), state=self._sink.state(),
        )  # fmt: skip
        pipe, child_pipe = os.pipe()
        child_control, self._control = os.pipe()
        output, child_output = os.pipe()
        os.set_blocking(output, False)
        os.set_blocking(child_output, False)  # nothing that it prints may hold it up
        with suppress(OSError):  # beyond what this user may have: it stays at 64 KiB
            fcntl(pipe, F_SETPIPE_SZ, PIPE_BYTES)
        program = ["-m", "amberbox.blackbox.recorder.source_child"]
        try:
            process = subprocess.Popen(
                [sys.executable, *program, str(child_pipe), str(child_control)],
                stdin=subprocess.DEVNULL, stdout=child_output, stderr=child_output,
                pass_fds=(child_pipe, child_control), process_group=0,
            )  # fmt: skip
        except OSError:
            for number in (pipe, self._control, output):
                os.close(number)
            raise
        finally:
            for number in (child_pipe, child_control, child_output):
                os.close(number)
        self._tell(setup)
        return process, pipe, output

    # -- the thread that started it

    def _watch(
        self,
        process: subprocess.Popen[bytes],
        reader: threading.Thread,
        output: int,
        lines: ChildOutput,
    ) -> None:
        """Return when the process has ended, or must be ended."""
        watched = os.pidfd_open(process.pid)
        files = [watched, output]
        silent_s, seen, looked_s = 0.0, 0, time.monotonic()
        end_s: float | None = None
        try:
            while reader.is_alive():
                ready = wait_readable(files, _LOOK_S)
                now_s = time.monotonic()
                if output in ready:
                    data = read_all(output)
                    lines.feed(data, now_s)
                    if not data:  # closed; it goes on without
                        files = [watched]
                if watched in ready:
                    return
                if end_s is None and self._stop.is_set():
                    self._tell(Stop())
                    end_s = now_s + self._source.stop_s
                elif end_s is not None and now_s > end_s:
                    self._trouble = f"did not end within {self._source.stop_s:.0f} s"
                    return
                if self._base_ns != self._told_base_ns:
                    self._tell_base(self._base_ns)
                if self._frames != seen or not self._reads:
                    silent_s, seen = 0.0, self._frames
                # if this thread was held up itself, what the process sent may not be read yet
                silent_s += min(now_s - looked_s, 2 * _LOOK_S)
                looked_s = now_s
                limit_s = SILENT_S if self._frames else START_S
                if silent_s > limit_s:
                    self._trouble = f"showed no life for {limit_s:.0f} s and was ended"
                    return
        finally:
            os.close(watched)

    def _tell_base(self, base_ns: int) -> None:
        """Tell the process of a new epoch of log time."""
        if self._tell(NewBase(base_ns)):
            self._told_base_ns = base_ns

    def _tell(self, call: RecorderCall | SourceSetup) -> bool:
        """Send a call; return False while another one cannot be sent."""
        data = encode(call)
        if not self._control_lock.acquire(timeout=_LOOK_S):
            return False
        try:
            if self._control >= 0:
                write_all(self._control, LENGTH.pack(len(data)) + data)
        except OSError:  # it has ended, which is noticed elsewhere
            pass
        finally:
            self._control_lock.release()
        return True

    def _note_line(self, line: str) -> None:
        self._sink.event("source_output", line)

    def _boot_ns(self) -> int:
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)

    # -- the thread that reads

    def _read(self, pipe: int) -> None:
        """Pass on what the process sends, until it ends or sends what is no frame."""
        try:
            with io.BufferedReader(io.FileIO(pipe), _BUFFER_BYTES) as file:
                while self._read_more(file):
                    pass
        except Exception as error:  # whatever it sent: the process is ended, the recorder goes on
            self._trouble = f"sent what cannot be taken ({error}) and was ended"

    def _read_more(self, file: io.BufferedReader[io.FileIO]) -> bool:
        self._reads = True
        data = file.peek()
        self._reads = False
        self._follow_clock()
        taken = self._take(data)
        if taken:
            file.read(taken)
        elif data:  # longer than the buffer: read into its own place
            self._reads = True
            head = file.read(HEAD.size)
            if len(head) < HEAD.size:  # it died amid a frame
                return False
            kind, stream, size, at_ns = self._head(head)
            payload = file.read(size)
            self._reads = False
            if len(payload) < size:
                return False
            self._handle(kind, stream, at_ns, payload)
        if 0 < len(data) < _BUFFER_BYTES // 4:
            time.sleep(_PAUSE_S)
        return bool(data)

    def _follow_clock(self) -> None:
        """Take over a new epoch of log time; the process learns of it by ``_watch``."""
        if all(abs(_base_ns(self._sink) - self._base_ns) > _STEP_NS for _ in range(3)):
            self._base_ns = _base_ns(self._sink)

    def _take(self, data: bytes) -> int:
        """Handle the whole frames in ``data``; return their length."""
        at, head, end = 0, HEAD.size, len(data)
        while at + head <= end:
            kind, stream, size, at_ns = self._head(data[at : at + head])
            if at + head + size > end:
                break
            self._handle(kind, stream, at_ns, data[at + head : at + head + size])
            at += head + size
        return at

    def _head(self, data: bytes) -> tuple[int, int, int, int]:
        kind, stream, size, at_ns = HEAD.unpack(data)
        if kind > ALIVE or size > self._longest:
            raise ValueError(f"a frame of kind {kind} and {size} bytes")
        return kind, stream, size, at_ns

    def _handle(self, kind: int, stream: int, at_ns: int, payload: bytes) -> None:
        self._frames += 1
        self._alive_ns = max(self._alive_ns, at_ns)
        if kind == MESSAGE:
            if stream >= len(self._streams):
                raise ValueError(f"a message of the unknown stream {stream}")
            self._sink.message(self._streams[stream], payload, self._base_ns + at_ns)
        elif kind == CALL:
            self._carry_out(decode_source_call(payload), at_ns)
        elif len(payload) == COMPLETE.size:
            (complete_ns,) = COMPLETE.unpack(payload)
            self._sink.complete(self._base_ns + complete_ns)

    def _carry_out(self, call: SourceCall, at_ns: int) -> None:
        match call:
            case TopicCall(topic):
                self._streams.append(self._sink.topic(topic))
            case Dropped(stream, from_ns, to_ns, count):
                base_ns = self._base_ns
                number = self._streams[stream]
                self._sink.dropped(number, base_ns + from_ns, base_ns + to_ns, count)
            case LastLatched(number, topic_name):
                # in a thread: the journals may be slow to read, and this pipe is always read
                arguments = (number, topic_name)
                threading.Thread(target=self._answer, args=arguments, daemon=True).start()
            case Ended():
                self._ended = call
            case _:
                _pass_on(call, self._sink, self._base_ns, at_ns)

    def _answer(self, number: int, topic: str) -> None:
        data = None
        try:
            data = self._sink.last_latched(topic)
        finally:  # the source waits for an answer, also if the journals cannot be read
            while not self._tell(Answer(number, data)):
                pass


def _pass_on(
    call: LinkUp | LinkDown | Lost | EventCall | PowerCall | SaveState,
    sink: ProcessSink,
    base_ns: int,
    at_ns: int,
) -> None:
    """Call the sink as the source did at ``at_ns``; times become log time."""
    match call:
        case LinkUp(topic, peer, since_ns):
            since_ns = None if since_ns is None else base_ns + since_ns
            sink.link_up_at(topic, peer, base_ns + at_ns, since_ns)
        case LinkDown(topic, peer, reason, since_ns):
            sink.link_down(topic, peer, reason, base_ns + since_ns)
        case Lost(topic, peer, from_ns, to_ns, count, reason):
            sink.lost(topic, peer, base_ns + from_ns, base_ns + to_ns, count, reason)
        case EventCall(kind, text, details):
            sink.event(kind, text, **details)
        case PowerCall(state, text):
            sink.power(state, text)
        case SaveState(state):
            sink.save_state(state)


def _base_ns(sink: Sink) -> int:
    """Return log time minus the time since the computer's start."""
    return sink.now_ns() - time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def _how(status: int) -> str:
    """Return how a process ended, by the status of ``Popen``."""
    if status >= 0:
        return f"with status {status}"
    try:
        return f"by signal {-status} ({signal.Signals(-status).name})"
    except ValueError:
        return f"by signal {-status}"
