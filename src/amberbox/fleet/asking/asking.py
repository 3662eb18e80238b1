"""Answers questions in workers with limits of time and memory."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, cast

from amberbox.fleet.asking.errors import LimitError
from amberbox.fleet.asking.pool import Pool
from amberbox.fleet.asking.question import Question, Sink

LIMIT_S = 20.0
MEMORY_BYTES = 1 << 30
ANSWER_BYTES = 64 << 20
"""An answer that is kept in memory; longer ones go through a file (``ask_file``)."""

_SPOOL_BYTES = 4 << 20
_WORKERS = 2
_NICE = 5
_WARM_S = 1.0
_READY = "amberbox.fleet.data.worker:ready"


class Asking:
    """Answers questions in workers with limits.

    ``op`` is ``"module:function"`` of a function ``(folder, arguments) -> bytes | Iterator[bytes]``
    in a module ``amberbox.fleet.*.worker*``; ``arguments`` are what msgpack can carry. All raise
    UsageError and AmberboxError as the function does, LimitError for what takes too much,
    BusyError when too many wait. ``asker`` is whose question it is: askers take turns.
    """

    @classmethod
    def for_robots(cls, folder: Path) -> Asking:
        """Make one for what robots send, besides the one that answers people.

        Whatever one of them sends keeps one worker at most, and none of those for people.
        """
        return cls(folder, Pool(folder, _WORKERS, nice=_NICE, at_once=1))

    def __init__(self, folder: Path, pool: Pool | None = None) -> None:
        self._folder = folder
        self._pool = pool or Pool(folder, _WORKERS)

    @property
    def pids(self) -> list[int]:
        """The process ids of the workers that run."""
        return self._pool.pids

    async def ask(
        self, op: str, arguments: Mapping[str, Any], limit_s: float = LIMIT_S,
        memory_bytes: int = MEMORY_BYTES, *, asker: str = "",
    ) -> bytes:  # fmt: skip
        """Return the answer; cancelling stops the worker that is at it."""
        answer = _Answer()
        await self._wait(Question(op, arguments, answer.add, limit_s, memory_bytes, asker))
        return bytes(answer.bytes)

    def ask_now(
        self, op: str, arguments: Mapping[str, Any], limit_s: float = LIMIT_S,
        memory_bytes: int = MEMORY_BYTES, *, asker: str = "",
    ) -> bytes:  # fmt: skip
        """Return the answer, in a thread that may wait for it."""
        answer = _Answer()
        question = Question(op, arguments, answer.add, limit_s, memory_bytes, asker)
        self._pool.put(question)
        question.done.result()
        return bytes(answer.bytes)

    async def ask_file(
        self, op: str, arguments: Mapping[str, Any], limit_s: float = LIMIT_S,
        memory_bytes: int = MEMORY_BYTES, *, asker: str = "", most_bytes: int = 1 << 30,
    ) -> IO[bytes]:  # fmt: skip
        """Return a long answer as a file that vanishes when it is closed.

        No worker has to wait for somebody who reads slowly.
        """
        file = _spool(self._scratch())
        sink = _bounded(file, most_bytes)
        try:
            await self._wait(Question(op, arguments, sink, limit_s, memory_bytes, asker))
        except BaseException:
            file.close()
            raise
        file.seek(0)
        return file

    async def run(self) -> None:
        """Start the workers once the server runs, so that the first question need not wait."""
        await asyncio.sleep(_WARM_S)
        ready = (self.ask(_READY, {}, asker=f"warm-{number}") for number in range(_WORKERS))
        await asyncio.gather(*ready, return_exceptions=True)
        await asyncio.Event().wait()

    def close(self) -> None:
        """Stop the workers."""
        self._pool.close()

    async def _wait(self, question: Question) -> None:
        self._pool.put(question)
        try:
            await asyncio.wrap_future(question.done)
        except asyncio.CancelledError:
            question.cancel()
            raise

    def _scratch(self) -> Path:
        folder = self._folder / "scratch"
        folder.mkdir(exist_ok=True)
        return folder


class _Answer:
    """Keeps an answer in memory, up to a limit."""

    def __init__(self) -> None:
        self.bytes = bytearray()

    def add(self, part: bytes) -> None:
        """Take a part."""
        if len(self.bytes) + len(part) > ANSWER_BYTES:
            raise LimitError(f"the answer is longer than {ANSWER_BYTES >> 20} MB", "ask for less")
        self.bytes += part


def _spool(folder: Path) -> IO[bytes]:
    """Make a file that stays in memory while it is short; whoever reads it closes it."""
    file = tempfile.SpooledTemporaryFile(_SPOOL_BYTES, "w+b", dir=str(folder))  # noqa: SIM115 - kept open
    return cast("IO[bytes]", file)


def _bounded(file: IO[bytes], most_bytes: int) -> Sink:
    def add(part: bytes) -> None:
        if file.tell() + len(part) > most_bytes:
            raise LimitError(f"the answer is longer than {most_bytes >> 20} MB", "ask for less")
        file.write(part)

    return add
