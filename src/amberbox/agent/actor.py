"""The process that carries out one action: ``python -m amberbox.agent.actor``.

It reads its task from stdin, one line of JSON (``Task``), then lines ``renew`` and ``abort
REASON``, and writes its states to stdout, one line of JSON each (``State``). The action runs in the
main thread. A second thread watches CLOCK_BOOTTIME, stdin and SIGTERM: when the lease is not
renewed, stdin ends, the run is aborted or takes too long, it stops the robot safely and ends the
process, whatever the action does.

A run that goes on although it was told to end could still command the robot. Then the process
replaces itself by a new image (``execv``), without any thread of the run, and stops once more.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import select
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping
from io import TextIOWrapper
from pathlib import Path
from typing import Any, Literal, NoReturn, cast

import msgspec

from amberbox.agent.unit_test_action import is_unit_test, load_unit_test
from amberbox.core.command import MODEL_INSTALL
from amberbox.core.errors import AmberboxError, NotStartedError, UsageError
from amberbox.core.safe_text import one_line
from amberbox.experiments.action import DeclaredAction, Value, check_parameters, load_action

LOST_AFTER = 3
"""A lease is lost after so many intervals in which it should have been renewed."""
RUN_ENDS_S = 0.2  # what a run gets to end by itself before the robot is stopped
MEMORY_BYTES = 1 << 30
LINE_BYTES = 1 << 18
TEXT = 500  # characters of a reason or a report: their line is written in one piece
RESULT_BYTES = 16_384  # JSON text of a result
REPORTS_PER_S = 10
_LOOK_S = 0.1  # the longest look at anything but CLOCK_BOOTTIME, which select does not know
_WRITE_S = 1.0
_NS = 1_000_000_000
_SIGNALS = (signal.SIGTERM, signal.SIGINT)

EndState = Literal["done", "failed", "aborted", "outcome_unknown"]
COMMAND = (sys.executable, "-P", "-m", "amberbox.agent.actor")


class Ended(msgspec.Struct, frozen=True):
    """How a run has ended, before it is known whether the robot could be stopped."""

    state: EndState
    reason: str = ""
    hint: str = ""
    result: str = ""
    """JSON text of an object."""


class Task(msgspec.Struct, frozen=True):
    """One action to carry out; ``parameters`` is the JSON text as it was signed.

    With ``after`` only the safe stop of a run that has ended so is done; stdin is not read on.
    """

    folder: str
    action: str
    parameters: str = "{}"
    timeout_s: float | None = None
    """Shortens the declared timeout."""
    renewal_s: float = 1.0
    """The interval of renewals; the lease is lost after three of them."""
    simulated: bool = False
    after: Ended | None = None


class State(msgspec.Struct, frozen=True, omit_defaults=True):
    """A line of the actor: ``running``, ``report``, ``stopping``, or how it has ended."""

    state: Literal["running", "report", "stopping", EndState]
    reason: str = ""
    hint: str = ""
    result: str = ""
    timeout_s: float = 0.0
    stop_timeout_s: float = 0.0
    safe_stop: bool = False
    """Whether the action has one."""


def boot_s() -> float:
    """Return seconds since boot, suspend included."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) / _NS


class Pipes:
    """The pipes to the parent, out of reach of the action: its prints go to stderr."""

    def __init__(self) -> None:
        self.commands, self.states = os.dup(0), os.dup(1)
        null = os.open(os.devnull, os.O_RDONLY)
        os.dup2(null, 0)
        os.dup2(2, 1)
        os.close(null)
        os.set_blocking(self.commands, False)
        os.set_blocking(self.states, False)
        self._read = b""
        self._lock = threading.Lock()
        self.ended = False
        """Whether the parent has closed its end of stdin."""

    def first_line(self) -> str:
        """Wait for the first line; empty if stdin ends before."""
        while b"\n" not in self._read and not self.ended:
            select.select([self.commands], [], [])
            self._fill()
        line, _, self._read = self._read.partition(b"\n")
        return line.decode(errors="replace")

    def lines(self) -> list[str]:
        """Return the whole lines that can be read now."""
        self._fill()
        *lines, self._read = self._read.split(b"\n")
        return [line.decode(errors="replace") for line in lines]

    def _fill(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while not self.ended:
                block = os.read(self.commands, 1 << 16)
                self._read += block
                self.ended = not block or len(self._read) > LINE_BYTES

    def put(self, state: State, within_s: float = 0.0) -> None:
        """Write a state, or drop it if the parent is gone or does not read it in time."""
        data = msgspec.json.encode(state) + b"\n"
        end_s = boot_s() + within_s
        with self._lock, contextlib.suppress(BrokenPipeError):
            while data:
                with contextlib.suppress(BlockingIOError):
                    data = data[os.write(self.states, data) :]
                    continue
                left_s = end_s - boot_s()
                if left_s <= 0:
                    return
                select.select([], [self.states], [], min(left_s, _LOOK_S))


class Context:
    """What the action sees of its run; ``stop`` is set when it must end."""

    def __init__(
        self, parameters: Mapping[str, Value], stop: threading.Event, pipes: Pipes
    ) -> None:
        self.parameters = parameters
        self._stop = stop
        self._pipes = pipes
        self._reported_s: deque[float] = deque(maxlen=REPORTS_PER_S)

    def stopped(self) -> bool:
        """Return whether the run must end."""
        return self._stop.is_set()

    def wait(self, seconds: float) -> bool:
        """Wait, or until the run must end; return whether it must."""
        return self._stop.wait(max(0.0, seconds))

    def report(self, text: str) -> None:
        """Report progress; what is more than ``REPORTS_PER_S`` is dropped."""
        now_s, latest = boot_s(), self._reported_s
        if len(latest) < REPORTS_PER_S or now_s - latest[0] >= 1.0:
            latest.append(now_s)
            self._pipes.put(State("report", reason=_short(text)))


class Actor:
    """One run of an action: ``carry_out`` in the main thread, ``watch`` in another one."""

    def __init__(self, task: Task, pipes: Pipes) -> None:
        self._task = task
        self._pipes = pipes
        self._stop = threading.Event()
        self._over = threading.Event()
        self._lock = threading.Lock()
        self._action: DeclaredAction | None = None
        self._values: Mapping[str, Value] = {}
        self._begun_s: float | None = None
        self._ended: Ended | None = None
        self._started = True
        self._woken, self._wake = os.pipe()
        os.set_blocking(self._woken, False)
        os.set_blocking(self._wake, False)
        for number in _SIGNALS:
            signal.signal(number, lambda number, frame: None)
        # C code writes the number: it arrives even while the action is deep in a library
        signal.set_wakeup_fd(self._wake, warn_on_full_buffer=False)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)  # see _replace_process

    def carry_out(self) -> None:
        """Load the action and run it; whatever it raises becomes the end of the run."""
        try:
            self._ended = self._run()
        except AmberboxError as error:
            self._started = not isinstance(error, NotStartedError)
            self._ended = Ended("failed", _short(error.what), _short(error.hint))
        except BaseException as error:  # an action may raise anything, also SystemExit
            self._ended = Ended("failed", describe(error))
        self._over.set()
        with contextlib.suppress(BlockingIOError):
            os.write(self._wake, b"\0")

    def _run(self) -> Ended:
        self._load()
        action, stop_s = self._loaded, self._loaded.options.stop_timeout
        with self._lock:
            if self._stop.is_set():
                return Ended("aborted", "it was told to end before it began")
            self._begun_s = boot_s()
        self._pipes.put(
            State("running", timeout_s=self._timeout_s, stop_timeout_s=stop_s,
                  safe_stop=self._can_stop)
        )  # fmt: skip
        function = action.module.simulated if self._task.simulated else action.module.run
        return _done(function(action.config, Context(self._values, self._stop, self._pipes)))

    def _load(self) -> None:
        action = _loader(self._task.action)(Path(self._task.folder), self._task.action)
        if self._task.simulated and not action.has("simulated"):
            raise UsageError(f"{action.name} has no simulated twin", "declare 'simulated:' for it")
        self._values = check_parameters(action, self._task.parameters)
        self._action = action

    @property
    def _loaded(self) -> DeclaredAction:
        assert self._action is not None, "asked for once it is loaded"
        return self._action

    @property
    def _can_stop(self) -> bool:
        return not self._task.simulated and self._loaded.has("safe_stop")

    @property
    def _timeout_s(self) -> float:
        declared = self._loaded.options.timeout
        return min(declared, declared if self._task.timeout_s is None else self._task.timeout_s)

    def watch(self) -> None:
        """Wait for the end of the run or a reason to end it; end the process."""
        try:
            self._watch()
        except BaseException as error:  # such as no memory for one more thread
            with contextlib.suppress(BaseException):
                if self._begun_s is not None and self._can_stop:
                    what = f"the actor failed: {describe(error)}"
                    self._replace_process(Ended("outcome_unknown", what))
        finally:
            os._exit(1)  # the parent stops the robot when we are gone

    def _watch(self) -> NoReturn:
        lost_s = LOST_AFTER * min(1.0, max(0.05, self._task.renewal_s))
        renewed_s = boot_s()
        while True:
            select.select([self._pipes.commands, self._woken], [], [], min(_LOOK_S, lost_s / 4))
            # before renewals are read that have waited while this process did not run
            is_lost = boot_s() - renewed_s >= lost_s
            lines, signals = self._pipes.lines(), self._signals()
            renewed_s = boot_s() if "renew" in lines else renewed_s
            if self._over.is_set():
                self._finish()
            aborts = [line for line in lines if line.partition(" ")[0] == "abort"]
            if aborts or signals:
                reason = aborts[0].partition(" ")[2] if aborts else "its process was terminated"
                self._end(Ended("aborted", _short(reason) or "aborted"))
            if is_lost:
                self._end(Ended("aborted", f"lease lost: no renewal for {lost_s:g} s"))
            if self._pipes.ended:
                self._end(Ended("aborted", "lease lost: the process that held it is gone"))
            if self._begun_s is not None and boot_s() - self._begun_s >= self._timeout_s:
                self._end(Ended("failed", f"not done within {self._timeout_s:g} s"))

    def _signals(self) -> bool:
        """Return whether a signal has asked for the end."""
        with contextlib.suppress(BlockingIOError):
            return any(os.read(self._woken, 4096))
        return False

    def _finish(self) -> NoReturn:
        """End the process after the run has ended by itself."""
        ended = self._ended
        assert ended is not None, "set before the run is over"
        if ended.state == "failed" and self._started and self._begun_s is not None:
            self._stop.set()
            if self._can_stop:
                self._pipes.put(State("stopping", reason=ended.reason))
                self._stop_and_exit(ended, again=False)
        self._exit(ended)

    def _end(self, ended: Ended) -> NoReturn:
        """End the run and the process; the robot is stopped within 0.5 s."""
        with self._lock:
            self._stop.set()
            is_running = self._begun_s is not None
        self._pipes.put(State("stopping", reason=ended.reason))
        if not is_running:
            self._exit(ended)
        hangs = not self._over.wait(RUN_ENDS_S)
        if not self._can_stop:
            self._exit(ended)
        self._stop_and_exit(ended, again=hangs)

    def _stop_and_exit(self, ended: Ended, *, again: bool) -> NoReturn:
        trouble, hangs = stop_safely(self._loaded, self._values, self._pipes)
        if again or hangs:
            self._replace_process(ended)
        self._exit(with_trouble(ended, trouble))

    def _replace_process(self, ended: Ended) -> None:
        """Stop again in a new image of this process: no thread of the run is in it."""
        task = os.memfd_create("task")
        os.write(task, msgspec.json.encode(msgspec.structs.replace(self._task, after=ended)))
        os.write(task, b"\n")
        os.lseek(task, 0, os.SEEK_SET)
        os.dup2(task, 0)
        with contextlib.suppress(OSError):  # an action may close anything
            os.dup2(self._pipes.states, 1)
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)  # until there are handlers again
        os.execv(sys.executable, COMMAND)

    def _exit(self, ended: Ended) -> NoReturn:
        exit_with(ended, self._pipes)

    def stop_only(self, ended: Ended) -> NoReturn:
        """Stop the robot after a run that has ended so elsewhere; end the process."""
        try:
            self._load()
        except AmberboxError as error:
            exit_with(with_trouble(ended, f"the safe stop failed: {error.what}"), self._pipes)
        if not self._can_stop:
            exit_with(ended, self._pipes)
        trouble, _ = stop_safely(self._loaded, self._values, self._pipes)
        exit_with(with_trouble(ended, trouble), self._pipes)


def stop_safely(
    action: DeclaredAction, values: Mapping[str, Value], pipes: Pipes
) -> tuple[str, bool]:
    """Call the safe stop; return what went wrong, empty for nothing, and whether it hangs."""
    trouble: list[str] = []
    over, given_up = threading.Event(), threading.Event()

    def stop() -> None:
        try:
            action.module.safe_stop(action.config, Context(values, given_up, pipes))
        except AmberboxError as error:
            trouble.append(f"the safe stop failed: {_short(error.what)}")
        except BaseException as error:
            trouble.append(f"the safe stop failed: {describe(error)}")
        over.set()

    threading.Thread(target=stop, name="safe stop", daemon=True).start()
    limit_s = action.options.stop_timeout
    if not over.wait(limit_s):
        given_up.set()
        over.wait(RUN_ENDS_S)
    if not over.is_set():
        return f"the safe stop did not end within {limit_s:g} s and was given up", True
    return (trouble[0] if trouble else ""), False


def with_trouble(ended: Ended, trouble: str) -> Ended:
    """Return how a run has ended if the safe stop had trouble: nobody knows what the robot does."""
    if not trouble:
        return ended
    reason = f"{ended.reason}; {trouble}" if ended.reason else trouble
    return msgspec.structs.replace(ended, state="outcome_unknown", reason=reason)


def exit_with(ended: Ended, pipes: Pipes) -> NoReturn:
    """Write the end and leave, whatever other threads do."""
    state = State(ended.state, ended.reason, ended.hint, ended.result)
    pipes.put(state, within_s=_WRITE_S)
    os._exit(0)


def _loader(action: str) -> Callable[[Path, str], DeclaredAction]:
    """Return what loads an action: declared in the robot folder, a unit test, or built in."""
    if action == MODEL_INSTALL:
        from amberbox.agent.model_action import load_install  # others start without it

        return load_install
    return load_unit_test if is_unit_test(action) else load_action


def describe(error: BaseException) -> str:
    """Return an exception in one line, with the file and line that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    try:
        text = str(error)
    except Exception:  # an action may raise an exception that cannot be shown
        text = ""
    return _short(f"{type(error).__name__}{f': {text}' if text else ''}{where}")


def _done(result: Any) -> Ended:
    """Return the end of a run that is done; a result that is no JSON, or too long, is left out."""
    if result is None:
        return Ended("done")
    try:
        text = json.dumps(dict(result), ensure_ascii=False, allow_nan=False)
        size = len(text.encode())
    except Exception as error:
        return Ended("done", f"its result is no JSON: {describe(error)}")
    if size > RESULT_BYTES:
        return Ended("done", f"its result has {size} bytes and was left out")
    return Ended("done", result=text)


def _short(text: str) -> str:
    return one_line(text)[:TEXT]


def main() -> int:
    """Carry out the task on stdin; the watching thread ends the process."""
    pipes = Pipes()
    line = pipes.first_line()
    if not line:
        return 0
    try:
        task = msgspec.json.decode(line, type=Task)
        os.chdir(task.folder)
    except (msgspec.MsgspecError, OSError) as error:
        pipes.put(State("failed", _short(f"this is no task: {error}")), _WRITE_S)
        return 1
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    bound = MEMORY_BYTES if most == resource.RLIM_INFINITY else min(MEMORY_BYTES, most)
    resource.setrlimit(resource.RLIMIT_DATA, (bound, most))
    for stream in (sys.stdout, sys.stderr):
        cast(TextIOWrapper, stream).reconfigure(line_buffering=True, errors="backslashreplace")
    actor = Actor(task, pipes)
    if task.after is not None:
        actor.stop_only(task.after)
    threading.Thread(target=actor.watch, name="watch", daemon=True).start()
    actor.carry_out()
    threading.Event().wait()
    return 1


if __name__ == "__main__":
    sys.exit(main())
