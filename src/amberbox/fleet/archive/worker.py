"""The process that works on an archive's tables: requests as JSON lines in, answers out.

``python -m amberbox.fleet.archive.worker DIR [BYTES]``, with BYTES of memory at most. Delta commits
are made here and nowhere else: what deltalake does to memory, threads or at exit does not touch the
server, and a worker that is killed is started again and finishes what it had begun.
"""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import select
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import msgspec

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.fleet.archive.committing import Progress, unheard
from amberbox.fleet.archive.folder import FolderArchive
from amberbox.fleet.archive.store import Committed, Retention
from amberbox.fleet.archive.where import TABLES
from amberbox.fleet.asking.memory import limit_memory
from amberbox.fleet.database.database import DatabaseBusyError

PROGRAM = "amberbox.fleet.archive.worker"
MEMORY_BYTES = 4 << 30
"""Most that a worker may take; on a small machine half of its memory."""
STEP_S = 300.0
"""So long a worker may be at one journal, or at one table, and longer for large ones."""
TIDY_S = 6 * 3600.0
"""So long it may join, sweep or delete."""
_BYTES_PER_S = 500e3

_DISK = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EACCES, errno.EPERM})
_DISK_HINT = "look at the disk: is it full, or read-only? what was begun is done again"
_AGAIN = "it is tried again; the server's log says more"
_LOCK_TRIES = 40
_LOCK_PAUSE_S = 0.05


def handle(archive: FolderArchive, request: Mapping[str, Any], progress: Progress = unheard) -> Any:
    """Do what a request asks; raises UsageError for one that nobody knows."""
    match request["op"]:
        case "commit":
            return archive.commit(float(request.get("every_s", 60.0)), progress)
        case "compact":
            return archive.compact()
        case "retain":
            rules = msgspec.convert(request["rules"], list[Retention])
            return archive.retain(rules, int(request["now_ns"]))
        case "sweep":
            return archive.sweep()
        case other:
            raise AmberboxError(f"the archive's worker knows no {other!r}")


def serve(folder: Path, requests: IO[str], answers: IO[str]) -> None:
    """Answer requests one after the other until there are no more.

    Before an answer there may be lines that say which journal is ``at`` hand, and its size.
    """
    archive = FolderArchive(folder)
    held = _lock(folder)

    def send(line: Mapping[str, Any]) -> None:
        answers.write(msgspec.json.encode(line).decode() + "\n")
        answers.flush()

    def progress(name: str, size: int) -> None:
        send({"at": name, "bytes": size})

    for line in requests:
        request = json.loads(line)
        try:
            answer: Mapping[str, Any] = {"done": handle(archive, request, progress)}
        except Exception as error:  # whatever a journal does to a library: it is told
            answer = _told(folder, error, is_commit=request["op"] == "commit")
        send(answer)
    held.close()


def _told(folder: Path, error: Exception, *, is_commit: bool) -> Mapping[str, Any]:
    """Say an error as an answer, and whether a journal is to blame for it (``failed``)."""
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
    """Tell whether the disk takes a file: libraries do not say in one way that it does not."""
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
    """Keep a second worker away; one that was just killed lets go in a moment.

    Raises UsageError when another one works here.
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
    """The worker died, took too long or broke over ``journal`` (empty: not known)."""

    def __init__(self, what: str, hint: str, journal: str) -> None:
        super().__init__(what, hint)
        self.journal = journal


class Worker:
    """The worker of an archive, seen from the server: started when needed, and again if it dies."""

    def __init__(
        self, folder: Path, memory_bytes: int = MEMORY_BYTES, step_s: float = STEP_S,
        program: str = PROGRAM,
    ) -> None:  # fmt: skip
        self.folder = folder
        self._program = program
        self._memory_bytes = memory_bytes
        self._step_s = step_s
        self._process: subprocess.Popen[bytes] | None = None
        self._is_stopped = False

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.close()

    @property
    def pid(self) -> int:
        """The process id of the worker, which is started if it does not run."""
        return self._running().pid

    def commit(self, every_s: float = 60.0) -> Committed:
        """Have the journals that wait committed (see ``FolderArchive.commit``)."""
        return msgspec.convert(self.ask("commit", every_s=every_s), Committed)

    def compact(self) -> int:
        """Have small files joined; return how many went."""
        return int(self.ask("compact"))

    def retain(self, now_ns: int, *rules: Retention) -> int:
        """Have what is too old deleted as of ``now_ns``; return how many journals it concerned."""
        return int(self.ask("retain", rules=msgspec.to_builtins(rules), now_ns=now_ns))

    def sweep(self) -> int:
        """Have files deleted that nothing refers to; return how many."""
        return int(self.ask("sweep"))

    def ask(self, op: str, **arguments: object) -> Any:
        """Send one request and wait for its answer.

        Raises WorkFailedError when it died, took too long or broke over a commit: ask again, and
        a new one finishes what was begun. Raises AmberboxError with what else the worker says.
        """
        process = self._running()
        assert process.stdin is not None
        at = ""
        limit_s = self._step_s if op == "commit" else TIDY_S
        try:
            process.stdin.write(msgspec.json.encode({"op": op, **arguments}) + b"\n")
            process.stdin.flush()
            lines = _Lines(process)
            while "at" in (answer := lines.next(limit_s)):
                at = answer["at"]
                limit_s = self._step_s + answer["bytes"] / _BYTES_PER_S
        except (BrokenPipeError, EOFError):
            raise self._ended(process, op, at) from None
        except TimeoutError:
            self._kill(process)
            what = f"the archive's worker took more than {limit_s:.0f} s over {op!r}"
            raise WorkFailedError(what, _AGAIN, at) from None
        if "error" not in answer:
            return answer["done"]
        if answer.get("failed"):
            self._kill(process)  # what it left in memory, nobody knows
            raise WorkFailedError(answer["error"], answer["hint"], at)
        raise AmberboxError(answer["error"], answer["hint"])

    def _ended(self, process: subprocess.Popen[bytes], op: str, at: str) -> AmberboxError:
        """Say that the worker ended: of itself, or because the server stops."""
        code = process.wait()
        what = f"the archive's worker ended with {code} over {op!r}"
        began = bool(at) or code < 0  # else it did not even start: no journal's fault
        if self._is_stopped or op != "commit" or not began:
            return AmberboxError(what, "ask again")
        return WorkFailedError(what, "ask again", at)

    @staticmethod
    def _kill(process: subprocess.Popen[bytes]) -> None:
        process.kill()
        process.wait()

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._process.poll() is not None:
            self._close_pipes()
            command = [sys.executable, "-m", self._program, str(self.folder)]
            self._process = subprocess.Popen(
                [*command, str(self._memory_bytes)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                start_new_session=True,  # Ctrl-C is for the server, which ends it in order
            )  # fmt: skip
        return self._process

    def close(self) -> None:
        """Let the worker finish and end."""
        self._close_pipes()
        if self._process is not None:
            self._process.wait()

    def stop(self, within_s: float = 2.0) -> None:
        """End the worker soon, in the middle of its work if need be; threads may call it."""
        process, self._is_stopped = self._process, True
        if process is None:
            return
        try:
            if process.stdin is not None and not process.stdin.closed:
                process.stdin.close()
            process.wait(within_s)
        except (subprocess.TimeoutExpired, BrokenPipeError):
            process.kill()
            process.wait()

    def _close_pipes(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout) if self._process else ():
            if pipe is not None and not pipe.closed:
                pipe.close()


class _Lines:
    """Lines of JSON as a worker writes them."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        self._pipe = process.stdout.fileno()
        self._read = b""

    def next(self, within_s: float) -> dict[str, Any]:
        """Return the next one; raises TimeoutError, and EOFError when there are no more."""
        ends, poll = time.monotonic() + within_s, select.poll()
        poll.register(self._pipe, select.POLLIN)
        while b"\n" not in self._read:
            left_s = ends - time.monotonic()
            if left_s <= 0 or not poll.poll(left_s * 1000):
                raise TimeoutError
            data = os.read(self._pipe, 1 << 16)
            if not data:
                raise EOFError
            self._read += data
        line, _, self._read = self._read.partition(b"\n")
        found: dict[str, Any] = msgspec.json.decode(line)
        return found


def main() -> None:
    """Serve until stdin closes; leave without what libraries do at exit (deltalake may abort)."""
    code = 0
    limit_memory(int(sys.argv[2]) if len(sys.argv) > 2 else MEMORY_BYTES)
    try:
        serve(Path(sys.argv[1]), sys.stdin, sys.stdout)
    except AmberboxError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        code = error.exit_code
    os._exit(code)


if __name__ == "__main__":
    main()
