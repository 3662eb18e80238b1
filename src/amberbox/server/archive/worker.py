"""The worker process of an archive: it commits journals, joins files, deletes and sweeps.

Delta commits happen in this process only, so that the effects of deltalake on memory, threads and
exit do not reach the server. A worker that is killed is restarted and finishes its work.

``python -m amberbox.server.archive.worker DIR [BYTES]``, with BYTES of memory at most, reads
requests and writes answers as JSON lines.
"""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import resource
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import msgspec

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.archive.commit import Step
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.location import TABLES
from amberbox.server.database import DatabaseBusyError
from amberbox.server.journals import CommitResult, Retention
from amberbox.server.workers.pool import PROGRAM, WorkerPool
from amberbox.server.workers.protocol import (
    BrokenError,
    LimitError,
    WorkerTask,
    be_first_to_go,
    memory_limit,
)

OP = "amberbox.server.archive.worker:work"
# Memory limit of a worker; on a small machine half of its memory
MEMORY_BYTES = 4 << 30
# Seconds per journal or table, longer for large ones
STEP_S = 300.0
# Seconds for joining, sweeping or deleting
TIDY_S = 6 * 3600.0
_BYTES_PER_S = 500e3

_DISK = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EACCES, errno.EPERM})
_DISK_HINT = "look at the disk: is it full, or read-only? what was begun is done again"
_AGAIN = "it is tried again; the server's log says more"
_LOCK_TRIES = 40
_LOCK_PAUSE_S = 0.05


def work(folder: Path, request: Mapping[str, Any]) -> Iterator[bytes]:
    """Run a request; yield steps and the answer as JSON. Exits the process if it cannot start.

    The process keeps other workers away from the archive until it ends.
    """
    try:
        archive, _ = _opened(folder)
    except AmberboxError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        os._exit(error.exit_code)
    be_first_to_go()
    yield from map(msgspec.json.encode, _answers(archive, request))


@lru_cache(maxsize=1)
def _opened(folder: Path) -> tuple[FolderArchive, IO[str]]:
    return FolderArchive(folder), _lock(folder)


def _answers(
    archive: FolderArchive, request: Mapping[str, Any]
) -> Iterator[Step | Mapping[str, Any]]:
    """Yield the journal at hand and its size, then ``done`` or ``error``."""
    done: object
    try:
        match request["op"]:
            case "commit":
                done = yield from archive.commit_steps(float(request.get("every_s", 60.0)))
            case "compact":
                done = archive.compact()
            case "retain":
                rules = msgspec.convert(request["rules"], list[Retention])
                done = archive.retain(rules, int(request["now_ns"]))
            case "sweep":
                done = archive.sweep()
            case other:
                raise AmberboxError(f"the archive's worker knows no {other!r}")
    except Exception as error:  # any error that a journal causes in a library is an answer
        yield _error(archive.layout.folder, error, is_commit=request["op"] == "commit")
    else:
        yield {"done": done}


def _error(folder: Path, error: Exception, *, is_commit: bool) -> Mapping[str, Any]:
    """Return an error as an answer, and whether a journal may have caused it (``failed``)."""
    if isinstance(error, DatabaseBusyError) or not _takes_files(folder):
        return {"error": f"the archive: {error}", "hint": _DISK_HINT}
    if isinstance(error, AmberboxError):
        answer = {"error": error.what, "hint": error.hint}
    elif isinstance(error, OSError) and error.errno in _DISK:
        return {"error": f"the archive: {error}", "hint": _DISK_HINT}
    else:
        logging.getLogger(__name__).error("the archive's worker failed", exc_info=error)
        what = str(error)[:300] or "no memory is left"
        answer = {"error": f"the archive: {type(error).__name__}: {what}", "hint": _AGAIN}
    return {**answer, "failed": is_commit}


def _takes_files(folder: Path) -> bool:
    """Return whether the disk accepts a file; libraries report a full disk in different ways."""
    probe = folder / TABLES / ".probe"
    try:
        with probe.open("wb") as file:
            file.write(bytes(1 << 20))
            file.flush()
            os.fsync(file.fileno())
        probe.unlink()
    except OSError:
        return False
    return True


def _lock(folder: Path) -> IO[str]:
    """Lock the archive against a second worker; retry while a killed one is still ending.

    Raises UsageError when another worker has the lock.
    """
    file = (folder / TABLES / ".lock").open("a")
    for _ in range(_LOCK_TRIES):
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            time.sleep(_LOCK_PAUSE_S)
        else:
            return file
    file.close()
    raise UsageError(f"another worker is at the archive {folder}", "there is one per server")


class WorkFailedError(AmberboxError):
    """The worker died, took too long or failed over ``journal`` (empty: not known)."""

    def __init__(self, what: str, hint: str, journal: str) -> None:
        super().__init__(what, hint)
        self.journal = journal


class ArchiveWorker:
    """The server's interface to the archive's worker: one request at a time."""

    def __init__(
        self, folder: Path, memory_bytes: int = MEMORY_BYTES, step_s: float = STEP_S,
        program: str = PROGRAM,
    ) -> None:  # fmt: skip
        self._pool = WorkerPool(folder, 1, program=program)
        self._memory_bytes = memory_limit(memory_bytes)
        self._step_s = step_s
        self._task: WorkerTask | None = None
        self._is_closed = False

    @property
    def pids(self) -> list[int]:
        """The process ids of the worker, while it runs."""
        return self._pool.pids

    def commit(self, every_s: float = 60.0) -> CommitResult:
        """Commit the journals that wait (see ``FolderArchive.commit``)."""
        return msgspec.convert(self.ask("commit", every_s=every_s), CommitResult)

    def compact(self) -> int:
        """Join small files; return how many were replaced."""
        return int(self.ask("compact"))

    def retain(self, now_ns: int, *rules: Retention) -> int:
        """Delete data that are too old as of ``now_ns``; return the number of journals
        concerned.
        """
        return int(self.ask("retain", rules=msgspec.to_builtins(rules), now_ns=now_ns))

    def sweep(self) -> int:
        """Delete files that nothing refers to; return how many."""
        return int(self.ask("sweep"))

    def ask(self, op: str, **arguments: object) -> Any:
        """Send one request and wait for its answer.

        Raises WorkFailedError when the worker died, took too long or failed over a commit: the next
        request starts a new one that finishes the work. Raises AmberboxError with other errors.
        """
        answer, at = dict[str, Any](), ""

        def receive(part: bytes) -> None:
            nonlocal answer, at
            answer = msgspec.json.decode(part)
            if "at" in answer:
                at, task.step_s = answer["at"], self._step_s + answer["bytes"] / _BYTES_PER_S
            elif answer.get("failed"):  # raised in the pool: the state of its memory is not known
                raise WorkFailedError(answer["error"], answer["hint"], at)

        step_s = self._step_s if op == "commit" else TIDY_S
        request = {"op": op, **arguments}
        task = WorkerTask(OP, request, receive, TIDY_S, self._memory_bytes, step_s=step_s)
        self._task = task
        self._pool.submit(task)
        try:
            task.done.result()
        except (WorkFailedError, BrokenError) as error:
            if isinstance(error, BrokenError) and task.exit_code is not None:
                raise self._ended(task, op, at) from None
            raise
        except LimitError:
            if task.exit_code is not None:
                raise self._ended(task, op, at) from None
            what = f"the archive's worker took more than {task.step_s:.0f} s over {op!r}"
            raise WorkFailedError(what, _AGAIN, at) from None
        except AmberboxError:  # the server stops
            raise self._ended(task, op, at) from None
        if "error" in answer:
            raise AmberboxError(answer["error"], answer["hint"])
        return answer["done"]

    def _ended(self, task: WorkerTask, op: str, at: str) -> AmberboxError:
        """Return the error for a worker that ended by itself, or because the server stops."""
        code = -signal.SIGKILL if task.exit_code is None else task.exit_code
        what = f"the archive's worker ended with {code} over {op!r}"
        began = bool(at) or code < 0  # else it did not even start, so no journal caused it
        if self._is_closed or op != "commit" or not began:
            return AmberboxError(what, "ask again")
        return WorkFailedError(what, "ask again", at)

    def close(self, within_s: float = 2.0) -> None:
        """End the worker within ``within_s`` seconds, even during work; thread-safe."""
        self._is_closed = True
        if self._task is not None:
            with suppress(Exception):
                self._task.done.exception(within_s)
        self._pool.close()


def serve(folder: Path, requests: IO[str], answers: IO[str]) -> None:
    """Answer requests, one JSON object per line, until there are no more."""
    archive, held = FolderArchive(folder), _lock(folder)
    for line in requests:
        for answer in _answers(archive, json.loads(line)):
            answers.write(msgspec.json.encode(answer).decode() + "\n")
            answers.flush()
    held.close()


def main() -> None:
    """Serve until stdin closes; exit without exit handlers of libraries (deltalake may abort)."""
    code = 0
    most = memory_limit(int(sys.argv[2]) if len(sys.argv) > 2 else MEMORY_BYTES)
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    be_first_to_go()
    try:
        serve(Path(sys.argv[1]), sys.stdin, sys.stdout)
    except AmberboxError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        code = error.exit_code
    os._exit(code)


if __name__ == "__main__":
    main()
