"""The process that works on an archive's tables: requests as JSON lines in, answers out.

``python -m amberbox.fleet.archive.worker DIR``. Delta commits are made here and nowhere else: what
deltalake does to memory, threads or at exit does not touch the server, and a worker that is killed
is started again and finishes what it had begun.
"""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import msgspec

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.fleet.archive.folder import FolderArchive
from amberbox.fleet.archive.store import Committed, Retention
from amberbox.fleet.archive.where import TABLES

_LOCK_TRIES = 40
_LOCK_PAUSE_S = 0.05


def handle(archive: FolderArchive, request: Mapping[str, Any]) -> Any:
    """Do what a request asks; raises UsageError for one that nobody knows."""
    match request["op"]:
        case "commit":
            return archive.commit(float(request.get("every_s", 60.0)))
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
    """Answer requests one after the other until there are no more."""
    archive = FolderArchive(folder)
    held = _lock(folder)
    for line in requests:
        try:
            answer: dict[str, Any] = {"done": handle(archive, json.loads(line))}
        except AmberboxError as error:
            answer = {"error": error.what, "hint": error.hint}
        except OSError as error:
            hint = "look at the disk: is it full, or read-only? what was begun is done again"
            answer = {"error": f"the archive: {error}", "hint": hint}
        answers.write(msgspec.json.encode(answer).decode() + "\n")
        answers.flush()
    held.close()


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


class Worker:
    """The worker of an archive, seen from the server: started when needed, and again if it dies."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._process: subprocess.Popen[str] | None = None

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

        Raises AmberboxError with what the worker says, or when it died over the request: ask
        again, and a new one finishes what was begun.
        """
        process = self._running()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps({"op": op, **arguments}) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line.endswith("\n"):
            code = process.wait()
            raise AmberboxError(f"the archive's worker ended with {code} over {op!r}", "ask again")
        answer = json.loads(line)
        if "error" in answer:
            raise AmberboxError(answer["error"], answer["hint"])
        return answer["done"]

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            self._close_pipes()
            command = [sys.executable, "-m", "amberbox.fleet.archive.worker", str(self.folder)]
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
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
        process = self._process
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


def main() -> None:
    """Serve until stdin closes; leave without what libraries do at exit (deltalake may abort)."""
    code = 0
    try:
        serve(Path(sys.argv[1]), sys.stdin, sys.stdout)
    except AmberboxError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        code = error.exit_code
    os._exit(code)


if __name__ == "__main__":
    main()
