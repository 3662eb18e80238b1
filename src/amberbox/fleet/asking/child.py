"""One worker process, seen from the server: asked, watched, and stopped when it takes too long."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.fleet.asking.errors import BrokenError, CancelledError, LimitError, too_big, too_long
from amberbox.fleet.asking.frames import Unpacker, packed
from amberbox.fleet.asking.question import Question

PROGRAM = "amberbox.fleet.asking.worker"

_LOOK_S = 0.05
_READ_BYTES = 1 << 20
_QUESTIONS = 1000


class Child:
    """A process that answers one question after the other; a new one when it had to be stopped."""

    def __init__(self, folder: Path, nice: int = 0, program: str = PROGRAM) -> None:
        self._command = [sys.executable, "-m", program, str(folder), str(nice)]
        self._process: subprocess.Popen[bytes] | None = None
        self._left = 0

    @property
    def pid(self) -> int | None:
        """The process id, while one runs."""
        return None if self._process is None else self._process.pid

    def answer(self, question: Question) -> None:
        """Have a question answered into its sink; raises what the worker says, or why it cannot.

        LimitError for an answer that takes too much, CancelledError when nobody wants it any
        more, BrokenError for a worker that died.
        """
        try:
            self._send(question)
            self._receive(question)
        except (UsageError, _ToldError):
            raise
        except BaseException:
            self.stop()
            raise
        self._left -= 1
        if self._left <= 0:
            self.stop()

    def stop(self) -> None:
        """End the process and what it started, at once."""
        process, self._process = self._process, None
        if process is None:
            return
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):
                    pipe.close()

    def _send(self, question: Question) -> None:
        request = packed(
            {
                "op": question.op, "arguments": dict(question.arguments),
                "limit_s": question.limit_s, "memory_bytes": question.memory_bytes,
            }
        )  # fmt: skip
        for is_last in (False, True):
            process = self._running()
            assert process.stdin is not None
            try:
                process.stdin.write(request)
                process.stdin.flush()
            except BrokenPipeError:  # it was ended from outside since the last question
                self.stop()
                if is_last:
                    raise BrokenError("a worker ended before it was asked") from None
            else:
                return

    def _receive(self, question: Question) -> None:
        process, unpacker = self._running(), Unpacker()
        assert process.stdout is not None
        pipe, ends = process.stdout.fileno(), time.monotonic() + question.limit_s
        poll = select.poll()
        poll.register(pipe, select.POLLIN)
        while True:
            if question.is_cancelled:
                raise CancelledError("nobody waits for this answer any more")
            if time.monotonic() > ends:
                raise too_long(question.limit_s)
            if not poll.poll(_LOOK_S * 1000):
                continue
            data = os.read(pipe, _READ_BYTES)
            if not data:
                raise self._died(question)
            for frame in unpacker.feed(data):
                if _handled(frame, question):
                    return

    def _died(self, question: Question) -> AmberboxError:
        assert self._process is not None
        code = self._process.wait()
        if code == -signal.SIGXCPU:
            return too_long(question.limit_s)
        if code in (-signal.SIGKILL, -signal.SIGABRT, -signal.SIGSEGV):  # how C++ runs out of it
            return too_big(question.memory_bytes)
        return BrokenError(f"the worker at {question.op} ended with {code}")

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
            )
            self._left = _QUESTIONS
        return self._process


class _ToldError(AmberboxError):
    """What a function in the worker raised: the worker itself is well."""


def _handled(frame: dict[str, Any], question: Question) -> bool:
    """Take a frame; True for the last one. Raises what it tells."""
    if "part" in frame:
        question.sink(frame["part"])
        return False
    if "error" not in frame:
        return True
    raise _ERRORS[frame["kind"]](question, frame["error"], frame["hint"])


_ERRORS: dict[str, Callable[[Question, str, str], AmberboxError]] = {
    "usage": lambda _, what, hint: UsageError(what, hint),
    "known": lambda _, what, hint: _ToldError(what, hint),
    "limit": lambda _, what, hint: LimitError(what, hint),
    "memory": lambda question, *_: too_big(question.memory_bytes),
    "broken": lambda _, what, hint: BrokenError(what, hint),
}
