"""The parent of an actor: starts it, renews its lease, and stops the robot if the actor dies."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import IO, Literal

import msgspec

from amberbox.agent.actor import COMMAND, Ended, EndState, State, Task, boot_s, with_trouble
from amberbox.core.errors import UsageError
from amberbox.core.files import wait_readable
from amberbox.core.safe_text import one_line
from amberbox.experiments.action import LONGEST_STOP_S

TASK_BYTES = 60_000  # what fits into a pipe at once
PRINTED_BYTES = 4096  # the end of what the action prints
REASON = 1000  # characters
LOAD_S = 30.0
HEED_S = 1.0
"""How long an actor may take to say that it stops, before it is killed."""
EXIT_S = 3.0
_LINE_BYTES = 1 << 17
_READ = 1 << 16
_MOST_READ = 1 << 20  # at once, so that endless output does not keep us


class Outcome(msgspec.Struct, frozen=True):
    """How an action has ended; ``result`` is the JSON text of an object, or empty."""

    state: EndState
    reason: str = ""
    hint: str = ""
    result: str = ""
    printed: str = ""
    """The end of what it printed, for those who look into it."""


class SupervisedActor:
    """One actor, from its start to the outcome; nothing here waits.

    Call ``step`` at least ten times a second, or whenever one of ``filenos`` can be read, until it
    returns the outcome, and ``renew`` while the lease is held. If the actor dies or does not react,
    what is left of it is killed and its ``safe_stop`` is run in a fresh actor.

    ``process`` is one that was started before there was a task, to save that time. A task with
    ``after`` only stops the robot, such as after a restart that has left a run without an end.
    """

    def __init__(
        self,
        task: Task,
        report: Callable[[str], None] = lambda text: None,
        process: ActorProcess | None = None,
    ) -> None:
        self._task = task
        self._report = report
        self._phase: Literal["loading", "running", "stopping"] = "loading"
        self._since_s = boot_s()
        self._limits = State("running")
        self._abort_s: float | None = None
        self._abort_reason = ""
        self._end: Ended | None = None
        self._killed: Ended | None = None
        self._after = task.after
        self.outcome: Outcome | None = None
        self._actor = ActorProcess() if process is None else process
        self._actor.give(task)

    @property
    def pid(self) -> int:
        """Return the id of the actor's process."""
        return self._actor.process.pid

    @property
    def is_running(self) -> bool:
        """Return whether the action has begun and is not being stopped."""
        return self._phase == "running" and self.outcome is None

    def filenos(self) -> Sequence[int]:
        """Return the file descriptors to wait for; none after the outcome."""
        return () if self.outcome is not None else self._actor.filenos()

    def renew(self) -> None:
        """Renew the lease, at least once a second."""
        if self.outcome is None:
            self._actor.tell("renew")

    def abort(self, reason: str = "aborted") -> None:
        """End the run; the first reason counts."""
        if self._abort_s is None and self.outcome is None:
            self._abort_s, self._abort_reason = boot_s(), one_line(reason)[:300]
            self._actor.tell(f"abort {self._abort_reason}")

    def wait(self, seconds: float) -> Outcome | None:
        """Wait until the actor has something new, or so long; return the outcome, if any."""
        wait_readable(self.filenos(), seconds)
        return self.step()

    def step(self) -> Outcome | None:
        """Read what the actor says, kill it if it does not react; return the outcome at the end."""
        if self.outcome is not None:
            return self.outcome
        is_gone = self._actor.is_gone()
        for state in self._actor.states():
            self._note(state)
        if is_gone:
            self._actor.close()
            self._go_on()
        elif self._killed is None:
            self._killed = self._overdue()
            if self._killed is not None:
                self._actor.kill()
        return self.outcome

    def _note(self, state: State) -> None:
        if state.state == "report":
            self._report(one_line(state.reason))
            return
        self._since_s = boot_s()
        if state.state == "running":
            self._phase, self._limits = "running", state
        elif state.state == "stopping":
            self._phase = "stopping"
        else:
            self._end = Ended(state.state, state.reason, state.hint, state.result)

    def _overdue(self) -> Ended | None:
        """Return how the run ends if its process does not react in time; None while it does."""
        now_s = boot_s()
        for_s = now_s - self._since_s
        stop_s = self._limits.stop_timeout_s or LONGEST_STOP_S
        if self._end is not None:
            return self._end if for_s > EXIT_S else None
        if self._after is not None:
            gone = Ended("outcome_unknown", "the safe stop in a fresh process did not end")
            return gone if for_s > stop_s + LOAD_S else None
        if self._phase == "stopping":
            gone = Ended("outcome_unknown", "its process did not end the safe stop")
            return gone if for_s > 2 * stop_s + LOAD_S else None
        if self._abort_s is not None and now_s - self._abort_s > HEED_S:
            what = f"{self._abort_reason}; its process did not react and was killed"
            return Ended("aborted", what)
        if self._phase == "loading":
            gone = Ended("failed", f"it did not begin within {LOAD_S:g} s")
            return gone if for_s > LOAD_S else None
        if for_s > self._limits.timeout_s + HEED_S:
            what = f"not done within {self._limits.timeout_s:g} s; its process was killed"
            return Ended("failed", what)
        return None

    def _go_on(self) -> None:
        """Set the outcome after the process has ended, or stop the robot in a fresh one."""
        if self._end is not None:
            self._set(self._end)
            return
        died = f"its process {self._actor.death()}"
        if self._after is not None:
            self._set(with_trouble(self._after, f"the safe stop failed: {died}"))
        elif self._phase == "loading":
            self._set(self._killed or Ended("failed", f"{died} before it began"))
        else:
            ended = self._killed or Ended("outcome_unknown", died)
            if self._limits.safe_stop:
                self._stop_in_fresh_actor(ended)
            else:
                self._set(ended)

    def _stop_in_fresh_actor(self, ended: Ended) -> None:
        self._after, self._since_s, self._killed = ended, boot_s(), None
        printed = self._actor.printed
        try:
            self._actor = ActorProcess()
            self._actor.printed = printed
            self._actor.give(msgspec.structs.replace(self._task, after=ended))
        except OSError as error:
            self._set(with_trouble(ended, f"the safe stop failed: {error.strerror}"))

    def _set(self, ended: Ended) -> None:
        printed = self._actor.printed.decode(errors="replace")
        reason, hint = one_line(ended.reason)[:REASON], one_line(ended.hint)[:REASON]
        self.outcome = Outcome(ended.state, reason, hint, ended.result, printed)


class ActorProcess:
    """The process of an actor with its pipes; it leads a session of its own.

    It waits for its task, and ends if it is closed before.
    """

    def __init__(self) -> None:
        left_out = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
        environment = {k: v for k, v in os.environ.items() if k not in left_out}
        self.process = subprocess.Popen(
            COMMAND, bufsize=0, env=environment, start_new_session=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        assert self.process.stdin and self.process.stdout and self.process.stderr, "they are pipes"
        self._commands, self._states, self._prints = (
            self.process.stdin, self.process.stdout, self.process.stderr,
        )  # fmt: skip
        self._watched = os.pidfd_open(self.process.pid)
        self._open: list[IO[bytes]] = [self._states, self._prints]
        self._line = b""
        self.printed = b""
        for pipe in (self._commands, *self._open):
            os.set_blocking(pipe.fileno(), False)

    def give(self, task: Task) -> None:
        """Give it its task; raises UsageError for one that is too long."""
        line = msgspec.json.encode(task) + b"\n"
        if len(line) > TASK_BYTES:
            self.close()
            raise UsageError(f"a task has at most {TASK_BYTES} bytes")
        self._write(line)

    def tell(self, line: str) -> None:
        """Write a line, unless the actor is gone or does not read."""
        self._write(f"{line}\n".encode())

    def _write(self, data: bytes) -> None:
        with suppress(BlockingIOError, BrokenPipeError):
            os.write(self._commands.fileno(), data)

    def filenos(self) -> list[int]:
        """Return the file descriptors to wait for."""
        return [self._watched, *(pipe.fileno() for pipe in self._open)]

    def is_gone(self) -> bool:
        """Return whether the process has ended."""
        return bool(wait_readable([self._watched], 0))

    def states(self) -> list[State]:
        """Return what it has said since the last call; what it prints is read as well."""
        self.printed = (self.printed + self._read(self._prints))[-PRINTED_BYTES:]
        *lines, self._line = (self._line + self._read(self._states)).split(b"\n")
        self._line = self._line[:_LINE_BYTES]
        found = []
        for line in lines:
            with suppress(msgspec.MsgspecError, UnicodeDecodeError):
                found.append(msgspec.json.decode(line, type=State))
        return found

    def _read(self, pipe: IO[bytes]) -> bytes:
        found = b""
        with suppress(BlockingIOError):
            while pipe in self._open and len(found) < _MOST_READ:
                block = os.read(pipe.fileno(), _READ)
                found += block
                if not block:
                    self._open.remove(pipe)
        return found

    def kill(self) -> None:
        """Kill it and what it has started, without waiting."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)

    def close(self) -> None:
        """Kill what a process that is gone has left behind, and close everything."""
        self.kill()  # before it is reaped: until then its id belongs to nobody else
        self.process.wait()
        for pipe in (self._commands, self._states, self._prints):
            pipe.close()
        os.close(self._watched)

    def death(self) -> str:
        """Return how a process that said nothing of its end has ended."""
        status = self.process.returncode
        if status >= 0:
            return f"ended with exit status {status}"
        with suppress(ValueError):
            return f"was killed ({signal.Signals(-status).name})"
        return f"was killed by signal {-status}"
