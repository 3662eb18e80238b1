"""Worker pools: processes with limits of time and memory behind a fair queue, and thread pools."""

from __future__ import annotations

import asyncio
import os
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import IO, Any, TypeVar, cast

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.workers.protocol import (
    BrokenError,
    BusyError,
    CancelledError,
    LimitError,
    Unpacker,
    WorkerTask,
    packed,
    too_big,
    too_long,
)

_HINT = "ask again in a moment"


class FairQueue:
    """A task queue with round-robin between origins, so that many tasks of one do not block others.

    ``at_once`` limits the running tasks per origin, so that others find a free worker.
    """

    def __init__(self, most: int, each: int, at_once: int | None = None) -> None:
        self._most = most
        self._each = each
        self._at_once = at_once
        self._at_work: Counter[str] = Counter()
        self._origins: OrderedDict[str, deque[WorkerTask]] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False

    def add(self, task: WorkerTask) -> None:
        """Add a task. Raises BusyError when the queue is full."""
        with self._changed:
            mine = self._origins.get(task.origin, ())
            if self._closed or sum(map(len, self._origins.values())) >= self._most:
                raise BusyError("the server has too many questions to answer", _HINT)
            if task.origin and len(mine) >= self._each:
                raise BusyError(f"{len(mine)} of your questions wait already", _HINT)
            self._origins.setdefault(task.origin, deque()).append(task)
            self._changed.notify()

    def take(self) -> WorkerTask | None:
        """Wait for the next task: the oldest of the origin that waits longest; None when closed.

        Call ``done`` with it when it has ended.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._next() is not None)
            origin = self._next()
            if self._closed or origin is None:
                return None
            mine = self._origins.pop(origin)
            task = mine.popleft()
            if mine:
                self._origins[origin] = mine
            self._at_work[origin] += 1
            return task

    def done(self, task: WorkerTask) -> None:
        """Note that a task has ended."""
        with self._changed:
            self._at_work[task.origin] -= 1
            self._at_work += Counter()  # drops zero counts
            self._changed.notify()

    def _next(self) -> str | None:
        """Return the origin whose turn it is, or None."""
        most = self._at_once
        free = (one for one in self._origins if most is None or self._at_work[one] < most)
        return next(free, None)

    def close(self) -> list[WorkerTask]:
        """Close the queue, which releases waiting workers; return the remaining tasks."""
        with self._changed:
            self._closed = True
            left = [task for mine in self._origins.values() for task in mine]
            self._origins.clear()
            self._changed.notify_all()
            return left


PROGRAM = "amberbox.server.workers.process"

_LOOK_S = 0.05
_READ_BYTES = 1 << 20
_TASKS = 1000


class WorkerProcess:
    """A process that runs one task after another; replaced after it had to be killed.

    ``patience`` times a task's limit is how long it may take: the time it waits for others counts.
    """

    def __init__(
        self, folder: Path, nice: int = 0, program: str = PROGRAM, patience: int = 1
    ) -> None:
        self._command = [sys.executable, "-m", program, str(folder), str(nice)]
        self._patience = patience
        self._process: subprocess.Popen[bytes] | None = None
        self._left = 0

    @property
    def pid(self) -> int | None:
        """The process id, while one runs."""
        return None if self._process is None else self._process.pid

    def answer(self, task: WorkerTask) -> None:
        """Run a task, whose answer is written to its sink; raises the operation's error.

        Raises LimitError for an answer beyond its limits, CancelledError for a cancelled task,
        BrokenError for a worker that died.
        """
        try:
            self._send(task)
            self._receive(task)
        except (UsageError, _OperationError):
            raise
        except BaseException:
            self.stop()
            raise
        self._left -= 1
        if self._left <= 0:
            self.stop()

    def stop(self) -> None:
        """Kill the process and its children."""
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

    def _send(self, task: WorkerTask) -> None:
        request = packed(
            {
                "op": task.op, "arguments": dict(task.arguments), "limit_s": task.limit_s,
                "memory_bytes": task.memory_bytes,
            }
        )  # fmt: skip
        for is_last in (False, True):
            process = self._running()
            assert process.stdin is not None
            try:
                process.stdin.write(request)
                process.stdin.flush()
            except BrokenPipeError:  # it was ended from outside since the last task
                self.stop()
                if is_last:
                    raise BrokenError("a worker ended before it was asked") from None
            else:
                return

    def _receive(self, task: WorkerTask) -> None:
        process, unpacker = self._running(), Unpacker()
        assert process.stdout is not None
        pipe, since_s = process.stdout.fileno(), time.monotonic()
        poll = select.poll()
        poll.register(pipe, select.POLLIN)
        while True:
            if task.is_cancelled:
                raise CancelledError("nobody waits for this answer any more")
            limit_s = (task.limit_s if task.step_s is None else task.step_s) * self._patience
            if time.monotonic() > since_s + limit_s:
                raise too_long(limit_s)
            if not poll.poll(_LOOK_S * 1000):
                continue
            data = os.read(pipe, _READ_BYTES)
            if not data:
                raise self._died(task)
            for frame in unpacker.feed(data):
                if _handled(frame, task):
                    return
            if task.step_s is not None:
                since_s = time.monotonic()

    def _died(self, task: WorkerTask) -> AmberboxError:
        assert self._process is not None
        code = task.exit_code = self._process.wait()
        if code == -signal.SIGXCPU:
            return too_long(task.limit_s)
        if code in (-signal.SIGKILL, -signal.SIGABRT, -signal.SIGSEGV):  # C++ without memory
            return too_big(task.memory_bytes)
        return BrokenError(f"the worker at {task.op} ended with {code}")

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
            )
            self._left = _TASKS
        return self._process


class _OperationError(AmberboxError):
    """An error that the operation raised; the worker itself is intact."""


def _handled(frame: dict[str, Any], task: WorkerTask) -> bool:
    """Process a frame; return True for the last one. Raises the error that it carries."""
    if "part" in frame:
        task.sink(frame["part"])
        return False
    if "error" not in frame:
        return True
    if frame["kind"] == "memory":
        raise too_big(task.memory_bytes)
    raise _ERRORS[frame["kind"]](frame["error"], frame["hint"])


_ERRORS: Mapping[str, type[AmberboxError]] = {
    "usage": UsageError, "known": _OperationError, "limit": LimitError, "broken": BrokenError,
}  # fmt: skip


LIMIT_S = 20.0
MEMORY_BYTES = 1 << 30
# Limit of an answer in memory; longer ones go through a file (``ask_file``)
ANSWER_BYTES = 64 << 20

_SPOOL_BYTES = 4 << 20
_NICE = 5
_PATIENCE = 4
_WARM_S = 1.0
_READY = "amberbox.server.data.worker:ready"


class WorkerPool:
    """Runs operations in ``count`` worker processes with limits; each starts when needed.

    ``op`` is ``"module:function"`` of a function ``(folder, arguments) -> bytes | Iterator[bytes]``
    in a module ``amberbox.server.*.worker*``; ``arguments`` are serialisable by msgpack. All
    methods raise the function's UsageError and AmberboxError, LimitError beyond the limits,
    BusyError when too many wait. ``origin`` is who the task is for: origins take turns.

    At most ``most`` tasks wait: fewer than the server has threads that answer people, or those
    could all wait. ``each`` limits the waiting tasks of one origin, ``at_once`` its running ones.
    """

    @classmethod
    def for_robots(cls, folder: Path) -> WorkerPool:
        """Create a pool for data of robots, separate from the pool that answers people.

        One robot occupies at most one worker. On a busy machine these workers mostly wait for
        others, so that a task may take four times its limit; its limit of CPU time stays.
        """
        return cls(folder, nice=_NICE, at_once=1, patience=_PATIENCE)

    def __init__(
        self, folder: Path, count: int = 2, *, most: int = 32, each: int = 8, nice: int = 0,
        program: str = PROGRAM, at_once: int | None = None, patience: int = 1,
    ) -> None:  # fmt: skip
        self._folder = folder
        self._processes = [WorkerProcess(folder, nice, program, patience) for _ in range(count)]
        self._queue = FairQueue(most, each, at_once)
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._now: set[WorkerTask] = set()
        self._closing = False

    @property
    def pids(self) -> list[int]:
        """The process ids of the workers that run."""
        return [one.pid for one in self._processes if one.pid is not None]

    def submit(self, task: WorkerTask) -> None:
        """Queue a task; its future ``done`` is set when it has ended. Raises BusyError."""
        self._queue.add(task)
        with self._lock:
            if not self._threads:
                self._threads = [
                    threading.Thread(target=self._work, args=(one,), name="worker", daemon=True)
                    for one in self._processes
                ]
                for thread in self._threads:
                    thread.start()

    def close(self) -> None:
        """Stop the workers, also those that run a task."""
        self._closing = True
        for task in self._queue.close():
            if task.done.set_running_or_notify_cancel():
                task.done.set_exception(BusyError("the server is stopping"))
        for task in tuple(self._now):
            task.cancel()
        for thread in self._threads:
            thread.join()

    def _work(self, process: WorkerProcess) -> None:
        while (task := self._queue.take()) is not None:
            if task.done.set_running_or_notify_cancel():
                self._now.add(task)
                self._answer(process, task)
                self._now.discard(task)
            self._queue.done(task)
        process.stop()

    def _answer(self, process: WorkerProcess, task: WorkerTask) -> None:
        try:
            if self._closing:
                raise BusyError("the server is stopping")
            process.answer(task)
        except BaseException as error:  # raised to the thread that submitted it
            task.done.set_exception(error)
        else:
            task.done.set_result(None)

    async def ask(
        self, op: str, arguments: Mapping[str, Any], limit_s: float = LIMIT_S,
        memory_bytes: int = MEMORY_BYTES, *, origin: str = "",
    ) -> bytes:  # fmt: skip
        """Return the answer; cancellation stops the worker that runs it."""
        answer = bytearray()
        sink = partial(_append, answer)
        await self._wait(WorkerTask(op, arguments, sink, limit_s, memory_bytes, origin))
        return bytes(answer)

    def ask_now(
        self, op: str, arguments: Mapping[str, Any], limit_s: float = LIMIT_S,
        memory_bytes: int = MEMORY_BYTES, *, origin: str = "",
    ) -> bytes:  # fmt: skip
        """Return the answer; blocks the calling thread."""
        answer = bytearray()
        task = WorkerTask(op, arguments, partial(_append, answer), limit_s, memory_bytes, origin)
        self.submit(task)
        task.done.result()
        return bytes(answer)

    async def ask_file(
        self, op: str, arguments: Mapping[str, Any], limit_s: float = LIMIT_S,
        memory_bytes: int = MEMORY_BYTES, *, origin: str = "", most_bytes: int = 1 << 30,
    ) -> IO[bytes]:  # fmt: skip
        """Return a long answer as a temporary file, deleted when it is closed.

        So no worker waits for a slow reader.
        """
        scratch = self._folder / "scratch"
        scratch.mkdir(exist_ok=True)
        spooled = tempfile.SpooledTemporaryFile(_SPOOL_BYTES, "w+b", dir=str(scratch))  # noqa: SIM115 - kept open
        file = cast("IO[bytes]", spooled)

        def write(part: bytes) -> None:
            _refuse_long(file.tell() + len(part), most_bytes)
            file.write(part)

        try:
            await self._wait(WorkerTask(op, arguments, write, limit_s, memory_bytes, origin))
        except BaseException:
            file.close()
            raise
        file.seek(0)
        return file

    async def run(self) -> None:
        """Start the workers soon after the server, so that the first query need not wait."""
        await asyncio.sleep(_WARM_S)
        count = len(self._processes)
        ready = (self.ask(_READY, {}, origin=f"warm-{number}") for number in range(count))
        await asyncio.gather(*ready, return_exceptions=True)
        await asyncio.Event().wait()

    async def _wait(self, task: WorkerTask) -> None:
        self.submit(task)
        try:
            await asyncio.wrap_future(task.done)
        except asyncio.CancelledError:
            task.cancel()
            raise


def _append(answer: bytearray, part: bytes) -> None:
    """Add a part to an answer in memory; raises LimitError when it gets too long."""
    _refuse_long(len(answer) + len(part), ANSWER_BYTES)
    answer += part


def _refuse_long(size: int, most_bytes: int) -> None:
    if size > most_bytes:
        raise LimitError(f"the answer is longer than {most_bytes >> 20} MB", "ask for less")


T = TypeVar("T")

# Request bodies of one robot at a time, which bounds their memory
EACH = 8


class RequestThreads:
    """Thread pools for requests of robots: pieces of journals, ends of uploads, folders.

    Ends wait for the one worker that verifies, folders for those that unpack; separate pools keep
    pieces, and the loop's own threads, from waiting behind them.
    """

    def __init__(self) -> None:
        self._pieces = ThreadPoolExecutor(8, "pieces")
        self._ends = ThreadPoolExecutor(16, "ends")
        self._folders = ThreadPoolExecutor(2 * EACH, "folders")
        self._under_way: Counter[str] = Counter()

    async def piece(self, work: Callable[[], T]) -> T:
        """Run a short job."""
        return await asyncio.get_running_loop().run_in_executor(self._pieces, work)

    async def end(self, work: Callable[[], T]) -> T:
        """Run a job that waits for a verification."""
        return await asyncio.get_running_loop().run_in_executor(self._ends, work)

    async def folder(self, work: Callable[[], T]) -> T:
        """Run a job that waits until a folder is unpacked."""
        return await asyncio.get_running_loop().run_in_executor(self._folders, work)

    @contextmanager
    def turn(self, robot: str) -> Iterator[None]:
        """Count a request with a body while it runs; raises BusyError when a robot has too many.

        In the event loop only.
        """
        if self._under_way[robot] >= EACH:
            raise BusyError(f"{EACH} requests of {robot} are under way already", "one by one")
        self._under_way[robot] += 1
        try:
            yield
        finally:
            self._under_way[robot] -= 1
            self._under_way += Counter()  # drops zero counts

    def close(self) -> None:
        """Cancel waiting jobs and shut down; running ones finish in the background."""
        for threads in (self._pieces, self._ends, self._folders):
            threads.shutdown(wait=False, cancel_futures=True)
