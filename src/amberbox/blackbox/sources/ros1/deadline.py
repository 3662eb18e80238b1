"""A limit for everything that waits for a peer: a moment in time, and a request to stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from amberbox.blackbox.sources.ros1.master import RosError, RosNoAnswerError

LOOK_S = 0.02  # how often a request to stop is looked for

T = TypeVar("T")


class RosStoppedError(RosError):
    """The caller no longer wants the answer it waited for."""


@dataclass(frozen=True)
class Deadline:
    """A moment of the monotonic clock until which to wait, unless ``stopped`` returns true."""

    end_s: float
    stopped: Callable[[], bool] = lambda: False

    @classmethod
    def within(cls, seconds: float, stopped: Callable[[], bool] = lambda: False) -> Deadline:
        """Return the deadline so many seconds from now."""
        return cls(time.monotonic() + seconds, stopped)

    def left_s(self) -> float:
        """Return how much time is left, 0 when it is up."""
        return max(0.0, self.end_s - time.monotonic())

    def check(self, what: str) -> None:
        """Raise StoppedError after a request to stop, NoAnswerError when time is up."""
        if self.stopped():
            raise RosStoppedError(f"stopped: {what}")
        if time.monotonic() >= self.end_s:
            raise RosNoAnswerError(what)

    def call(self, work: Callable[[], T], what: str) -> T:
        """Return the result of a function that may block; raise as ``check``, or its error.

        It runs in a thread, which is left behind if it does not end in time: neither a name server
        nor a peer that hangs holds up the caller.
        """
        self.check(what)
        results: list[T] = []
        errors: list[BaseException] = []
        done = threading.Event()

        def run() -> None:
            try:
                results.append(work())
            except BaseException as error:  # raised again in the thread that waits
                errors.append(error)
            finally:
                done.set()

        threading.Thread(target=run, name="ros-call", daemon=True).start()
        while not done.wait(LOOK_S):
            self.check(what)
        if errors:
            raise errors[0]
        return results[0]

    def wait(self, changed: threading.Condition, holds: Callable[[], bool], what: str) -> None:
        """Wait until a condition holds; ``changed`` is held. Raises as ``check``."""
        while not holds():
            self.check(what)
            changed.wait(LOOK_S)
