"""The life of one child: started, watched, started again after a while, or left alone."""

from __future__ import annotations

import math
import signal
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from amberbox.blackbox.service import SPENT
from amberbox.link.backoff import Backoff
from amberbox.robot.supervisor.child import REFUSED, Child
from amberbox.robot.supervisor.process import Launch, Process

HEALTHY_S = 60.0
"""A child that ran for so long failed for a new reason: it starts again at once."""
RETRY_S = 60.0
"""A configuration that was refused is tried again after so long, changed or not."""

State = Literal["off", "waiting", "starting", "running", "stopping", "refused", "spent"]


class Tell(Protocol):
    """Hears of what happens to children: it is printed and goes into the record."""

    def __call__(self, kind: str, text: str, **details: Any) -> None:
        """Take an event."""


@dataclass
class Life:
    """One child and what is to be done about it; ``step`` does it. Times are monotonic seconds."""

    child: Child
    launch: Launch
    tell: Tell
    backoff: Backoff = field(default_factory=Backoff)
    state: State = "off"
    status: str = ""
    """What it says it is doing."""
    trouble: str = ""
    """Why it was ended last, if that was not asked for."""
    restarts: int = 0
    _process: Process | None = None
    _due_s: float = 0.0
    _deadline_s: float = math.inf
    _began_s: float = 0.0
    _why_killed: str = ""
    _again: bool = False
    _refusal: str = ""

    @property
    def process(self) -> Process | None:
        """The process, while there is one."""
        return self._process

    @property
    def is_up(self) -> bool:
        """Tell whether it runs and has said that it is ready."""
        return self.state == "running"

    def want(self, now_s: float) -> None:
        """Let it run from now on."""
        if self.state == "off":
            self.state, self._due_s = "waiting", now_s

    def stop(self, now_s: float, within_s: float, *, again: bool = False) -> None:
        """Ask it to end, with ``again`` to start anew after that; late it is killed."""
        self._again = again
        if self._process is None:
            self.state, self._due_s = ("waiting" if again else "off"), now_s
        elif self.state == "stopping":
            self._deadline_s = min(self._deadline_s, now_s + within_s)
        else:
            self.state, self._deadline_s = "stopping", now_s + within_s
            self._process.send(signal.SIGTERM)

    def retry(self, now_s: float) -> None:
        """Try again what was refused: something has changed."""
        if self.state == "refused":
            self._due_s, self._refusal = now_s, ""

    def step(self, now_s: float) -> None:
        """Do what there is to do now."""
        if self._process is None:
            if self.state in ("waiting", "refused") and now_s >= self._due_s:
                self._start(now_s)
            return
        status = self._process.poll()
        self._listen(self._process, now_s)
        if status is not None:
            self._ended(status, now_s)
        elif now_s >= self._deadline_s:
            self._kill(now_s)

    def _start(self, now_s: float) -> None:
        self._began_s, self._why_killed, self.status = now_s, "", ""
        try:
            self._process = self.launch(self.child)
        except OSError as error:
            self._failed(f"cannot be started: {error.strerror or error}", now_s)
            return
        self.state, self._deadline_s = "starting", now_s + self.child.start_s

    def _listen(self, process: Process, now_s: float) -> None:
        """Take its signs of life; each gives it time until the next."""
        for key, value in process.heard():
            if key == "STATUS":
                self.status = value
            elif self.state == "stopping" or self._why_killed:
                continue
            elif key == "READY":
                self._is_ready(now_s)
            elif key == "EXTEND_TIMEOUT_USEC" and self.state == "starting" and value.isdecimal():
                self._deadline_s = max(self._deadline_s, now_s + int(value) / 1e6)
            elif key == "WATCHDOG":
                self._deadline_s = now_s + self.child.watchdog_s
            elif key == "STOPPING":  # by itself: how long it takes is its own affair, in bounds
                self._deadline_s = now_s + max(self.child.start_s, self.child.watchdog_s)

    def _is_ready(self, now_s: float) -> None:
        self.state, self._deadline_s = "running", now_s + self.child.watchdog_s
        self._refusal = ""

    def _kill(self, now_s: float) -> None:
        """End one that does not go on, or does not end."""
        assert self._process is not None
        silent = now_s - self._began_s if self.state == "starting" else self.child.watchdog_s
        gave_none = "is not ready after" if self.state == "starting" else "gave no sign of life for"
        late = "did not end in time" if self.state == "stopping" else f"{gave_none} {silent:.0f} s"
        self._why_killed, self._deadline_s = f"{late} and was killed", math.inf
        self._process.send(signal.SIGKILL)

    def _ended(self, status: int, now_s: float) -> None:
        assert self._process is not None
        error = self._process.error()
        self._process.close()
        self._process, self._deadline_s = None, math.inf
        if self.state == "stopping":
            self._stopped(now_s)
        elif status == REFUSED:
            self._refused(error, now_s)
        elif status == 0 and self.status == SPENT:
            self.state = "spent"
        else:
            why = self._why_killed or in_words(status)
            self._failed(f"{why}: {error}" if error else why, now_s, status=status)

    def _stopped(self, now_s: float) -> None:
        if self._why_killed:
            self.tell("process_killed", f"{self.child.name} {self._why_killed}",
                      process=self.child.name)  # fmt: skip
        self.state, self._due_s = ("waiting" if self._again else "off"), now_s

    def _refused(self, error: str, now_s: float) -> None:
        """Leave it alone for a minute; the same refusal is told once."""
        self.state, self._due_s = "refused", now_s + RETRY_S
        self.trouble = error or "its configuration is wrong"
        if self.trouble != self._refusal:
            self._refusal = self.trouble
            text = f"{self.child.name} cannot run: {self.trouble}; it is tried again when the "
            text += f"folder changes, and every {RETRY_S:.0f} s"
            self.tell("process_refused", text, process=self.child.name)

    def _failed(self, why: str, now_s: float, **details: Any) -> None:
        if now_s - self._began_s >= HEALTHY_S:
            self.backoff.succeeded()
        wait_s = self.backoff.failed()
        self.state, self._due_s, self.trouble = "waiting", now_s + wait_s, why
        self.restarts += 1
        kind = "process_hung" if self._why_killed else "process_died"
        self.tell(kind, f"{self.child.name} {why}; it starts again in {wait_s:.1f} s",
                  process=self.child.name, wait_s=round(wait_s, 3), **details)  # fmt: skip


def in_words(status: int) -> str:
    """Say how a process has ended."""
    if status < 0:
        try:
            return f"was killed by {signal.Signals(-status).name}"
        except ValueError:
            return f"was killed by signal {-status}"
    return f"ended with status {status}" if status else "ended by itself"
