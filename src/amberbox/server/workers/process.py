"""The worker process that runs tasks: ``python -m amberbox.server.workers.process DIR``.

Reads frames (``op``, ``arguments``, limits) and writes frames: parts of the answer, then an end or
an error. Prints of an operation go to stderr. It ends when its pipe does.
"""

from __future__ import annotations

import errno
import logging
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import IO, Any

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.workers.protocol import BrokenError, LimitError, checked_op, packed, read_frame

_PART_BYTES = 1 << 20
_LOOK_S = 0.2
# DuckDB's class, which is no MemoryError
_OUT_OF_MEMORY = "OutOfMemoryException"


def serve(folder: Path, requests: IO[bytes], answers: IO[bytes]) -> None:
    """Run one task after another until there are no more."""
    while (request := read_frame(requests)) is not None:
        try:
            _limit(request["limit_s"], request["memory_bytes"])
            for part in parts(folder, request["op"], request["arguments"]):
                answers.write(packed({"part": part}))
                answers.flush()
            last: Mapping[str, Any] = {}
        except BrokenPipeError:
            return
        except Exception as error:  # every error becomes an answer
            last = error_frame(error)
        try:
            answers.write(packed(last))
            answers.flush()
        except BrokenPipeError:
            return


def parts(folder: Path, op: str, arguments: Mapping[str, Any]) -> Iterator[bytes]:
    """Call an operation and yield its answer in parts that fit in a frame."""
    module, name = checked_op(op)
    answer = getattr(import_module(module), name)(folder, arguments)
    for part in (answer,) if isinstance(answer, bytes) else answer:
        for start in range(0, len(part), _PART_BYTES):
            yield part[start : start + _PART_BYTES]


def error_frame(error: Exception) -> Mapping[str, Any]:
    """Return an error as a frame; an unexpected one is logged with its traceback."""
    if _is_for_memory(error):
        return {"error": "memory", "kind": "memory", "hint": ""}
    if isinstance(error, AmberboxError):
        return {"error": error.what, "hint": error.hint, "kind": _kind(error)}
    logging.getLogger(__name__).error("a worker failed", exc_info=error)
    what = f"the question could not be answered: {type(error).__name__}"
    return {"error": what, "kind": "broken", "hint": "the server's log says more"}


def _is_for_memory(error: Exception) -> bool:
    """Return whether an operation, or an import, ran out of memory."""
    no_room = isinstance(error, OSError) and error.errno == errno.ENOMEM
    return no_room or isinstance(error, MemoryError) or type(error).__name__ == _OUT_OF_MEMORY


def _kind(error: AmberboxError) -> str:
    if isinstance(error, LimitError):
        return "limit"
    if isinstance(error, BrokenError):
        return "broken"
    return "usage" if isinstance(error, UsageError) else "known"


def _limit(limit_s: float, memory_bytes: int) -> None:
    """Set limits of CPU time and memory for this task, effective even if the server has died."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = used.ru_utime + used.ru_stime + (limit_s + 1) * (os.cpu_count() or 1) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, resource.RLIM_INFINITY))


@lru_cache(maxsize=1)
def leave_with_server() -> None:
    """Start a thread that ends this process soon after the server ends, also during an operation.

    Without it, workers of a killed server end only when they read the next request.
    """
    server = os.getppid()

    def wait() -> None:
        while os.getppid() == server:
            time.sleep(_LOOK_S)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def main() -> None:
    """Serve stdin; exit without running exit handlers of libraries."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    answers = os.fdopen(os.dup(1), "wb", buffering=1 << 16)
    os.dup2(2, 1)
    serve(Path(sys.argv[1]), sys.stdin.buffer, answers)
    os._exit(0)  # no flush: a pipe left by a dead server is not writable


if __name__ == "__main__":
    main()
