"""The process that answers questions: ``python -m amberbox.fleet.asking.worker DIR``.

Frames in (``op``, ``arguments``, limits), frames out: parts of the answer, then an end or an
error. What an operation prints goes to stderr. It ends when its pipe does.
"""

from __future__ import annotations

import errno
import logging
import os
import resource
import signal
import sys
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import IO, Any

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.fleet.asking.errors import BrokenError, LimitError
from amberbox.fleet.asking.frames import packed, read_frame
from amberbox.fleet.asking.question import checked_op

_PART_BYTES = 1 << 20
_OUT_OF_MEMORY = "OutOfMemoryException"
"""What DuckDB calls it; it is no MemoryError."""


def serve(folder: Path, requests: IO[bytes], answers: IO[bytes]) -> None:
    """Answer one question after the other until there are no more."""
    while (request := read_frame(requests)) is not None:
        try:
            _limit(request["limit_s"], request["memory_bytes"])
            for part in parts(folder, request["op"], request["arguments"]):
                answers.write(packed({"part": part}))
                answers.flush()
            last: Mapping[str, Any] = {}
        except BrokenPipeError:
            return
        except Exception as error:  # every one of them is an answer
            last = told(error)
        try:
            answers.write(packed(last))
            answers.flush()
        except BrokenPipeError:
            return


def parts(folder: Path, op: str, arguments: Mapping[str, Any]) -> Iterator[bytes]:
    """Call an operation and give its answer in parts that fit in a frame."""
    module, name = checked_op(op)
    answer = getattr(import_module(module), name)(folder, arguments)
    for part in (answer,) if isinstance(answer, bytes) else answer:
        for start in range(0, len(part), _PART_BYTES):
            yield part[start : start + _PART_BYTES]


def told(error: Exception) -> Mapping[str, Any]:
    """Say an error as a frame; what nobody foresaw goes to the log with its traceback."""
    if _is_for_memory(error):
        return {"error": "memory", "kind": "memory", "hint": ""}
    if isinstance(error, AmberboxError):
        return {"error": error.what, "hint": error.hint, "kind": _kind(error)}
    logging.getLogger(__name__).error("a worker failed", exc_info=error)
    what = f"the question could not be answered: {type(error).__name__}"
    return {"error": what, "kind": "broken", "hint": "the server's log says more"}


def _is_for_memory(error: Exception) -> bool:
    """Tell all ways in which an operation says that it had no memory, imports among them."""
    no_room = isinstance(error, OSError) and error.errno == errno.ENOMEM
    return no_room or isinstance(error, MemoryError) or type(error).__name__ == _OUT_OF_MEMORY


def _kind(error: AmberboxError) -> str:
    if isinstance(error, LimitError):
        return "limit"
    if isinstance(error, BrokenError):
        return "broken"
    return "usage" if isinstance(error, UsageError) else "known"


def _limit(limit_s: float, memory_bytes: int) -> None:
    """Limit what this question may take, also for a worker whose server has died meanwhile."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = used.ru_utime + used.ru_stime + (limit_s + 1) * (os.cpu_count() or 1) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, resource.RLIM_INFINITY))


def main() -> None:
    """Serve stdin; leave without what libraries do at exit."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    answers = os.fdopen(os.dup(1), "wb", buffering=1 << 16)
    os.dup2(2, 1)
    serve(Path(sys.argv[1]), sys.stdin.buffer, answers)
    os._exit(0)  # without closing: what a server that died left in the pipe cannot be written


if __name__ == "__main__":
    main()
