"""The protocol between server and worker process: tasks, msgpack frames, errors, memory limits."""

from __future__ import annotations

import os
import re
import struct
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, TypeAlias

import msgspec

from amberbox.core.errors import AmberboxError


class BusyError(AmberboxError):
    """Too many tasks wait already."""


class LimitError(AmberboxError):
    """The answer exceeds its limit of time, memory or size."""


class BrokenError(AmberboxError):
    """A worker failed because of a defect in the server."""


class CancelledError(AmberboxError):
    """The task was cancelled."""


TRY_AGAIN = "the server may be busy: try again; if that is no help, ask for less at a time"


def too_long(limit_s: float) -> LimitError:
    """Return the error of an answer that took too long."""
    return LimitError(f"the answer took longer than {limit_s:g} s", TRY_AGAIN)


def too_big(memory_bytes: int) -> LimitError:
    """Return the error of an answer that needs too much memory."""
    size = f"{memory_bytes / (1 << 20):.0f} MB"
    return LimitError(f"the answer needs more memory than {size}", "ask for less at a time")


# Includes what pyarrow and its threads reserve: 1.4 GB before anything is read
_LEAST_BYTES = 2 << 30
_FIRST_TO_GO = "500"


def memory_limit(most_bytes: int) -> int:
    """Return ``most_bytes``, or half of the machine's memory where that is less, at least 2 GB."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min(most_bytes, max(machine // 2, _LEAST_BYTES))


def be_first_to_go() -> None:
    """Make the kernel end this process before the server when memory is short."""
    with suppress(OSError):  # a container may not allow it: then the kernel chooses
        Path("/proc/self/oom_score_adj").write_text(_FIRST_TO_GO)


# Receives the parts of an answer, one after the other, in a thread of its own
Sink: TypeAlias = Callable[[bytes], None]

_OP = re.compile(r"amberbox\.server\.(?:[a-z_]+\.)+worker[a-z_]*:[a-z][a-z_]*")


def checked_op(op: str) -> tuple[str, str]:
    """Return module and function. Raises ValueError for an invalid operation."""
    if not _OP.fullmatch(op):
        raise ValueError(f"{op!r} is nothing that a worker does")
    module, _, name = op.partition(":")
    return module, name


@dataclass(slots=True, eq=False)
class WorkerTask:
    """A task: ``op`` is ``module:function``; ``arguments`` are serialisable by msgpack.

    ``limit_s`` counts from the start of the task; with ``step_s``, which the sink may change, from
    the last part. ``origin`` is for the fair queue. ``exit_code`` is that of a worker that died
    over it.
    """

    op: str
    arguments: Mapping[str, Any]
    sink: Sink
    limit_s: float
    memory_bytes: int
    origin: str = ""
    step_s: float | None = None
    exit_code: int | None = None
    done: Future[None] = field(default_factory=Future)
    _gone: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        checked_op(self.op)

    @property
    def is_cancelled(self) -> bool:
        """Return whether the task was cancelled."""
        return self._gone.is_set()

    def cancel(self) -> None:
        """Cancel the task; a worker that runs it is stopped."""
        self._gone.set()


_LENGTH = struct.Struct("<I")

# Longer frames are invalid: the pipe carries something else
FRAME_BYTES = 64 << 20


def packed(frame: Mapping[str, Any]) -> bytes:
    """Encode a frame, with its length."""
    body = msgspec.msgpack.encode(frame)
    return _LENGTH.pack(len(body)) + body


def read_frame(stream: IO[bytes]) -> dict[str, Any] | None:
    """Wait for the next frame; None at the end."""
    head = stream.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(head)
    body = stream.read(length)
    return _decoded(body) if len(body) == length else None


class Unpacker:
    """Decodes frames from bytes as they arrive."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, data: bytes) -> Iterator[dict[str, Any]]:
        """Add bytes; yield the frames that are complete. Raises ValueError for too long ones."""
        self._bytes += data
        while len(self._bytes) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._bytes)
            if length > FRAME_BYTES:
                raise ValueError(f"a frame of {length} bytes")
            end = _LENGTH.size + length
            if len(self._bytes) < end:
                return
            body = bytes(self._bytes[_LENGTH.size : end])
            del self._bytes[:end]
            yield _decoded(body)


def _decoded(body: bytes) -> dict[str, Any]:
    found: dict[str, Any] = msgspec.msgpack.decode(body)
    return found
