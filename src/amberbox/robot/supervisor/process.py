"""A child that runs: its process, what it prints and its signs of life."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Protocol

from amberbox.robot.supervisor.child import Child
from amberbox.robot.supervisor.ear import Ear
from amberbox.robot.supervisor.output import Voice, read_all

MARK = "AMBERBOX_SUPERVISED"
"""In the environment of every child: the store that it was started for."""
_LEASH = Path(__file__).with_name("leash.py")


class Process(Protocol):
    """What is asked of a process; tests have one that is moved by hand."""

    pid: int

    def poll(self) -> int | None:
        """Return its exit status, negative for a signal; None while it runs."""

    def heard(self) -> Iterable[tuple[str, str]]:
        """Give what it has told its service manager since."""

    def send(self, number: int) -> None:
        """Send a signal."""

    def filenos(self) -> Sequence[int]:
        """Return what can be waited for."""

    def error(self) -> str:
        """Return what it called its error."""

    def close(self) -> None:
        """Read what is left, close everything."""


Launch = Callable[[Child], Process]


class RealProcess:
    """Runs a child's command; its output goes through ``voice``.

    A child never waits for us: what we do not read is lost to the log, not held up.
    """

    def __init__(self, child: Child, store_id: str, voice: Voice) -> None:
        self._ear, self._voice = Ear(), voice
        voice.error = ""
        self._output, writing = os.pipe()
        os.set_blocking(writing, False)
        os.set_blocking(self._output, False)
        try:
            self._process = subprocess.Popen(
                command_of(child), stdin=subprocess.DEVNULL, stdout=writing, stderr=writing,
                env={**self._ear.environ(child.watchdog_s), MARK: store_id},
                process_group=0,  # Ctrl-C in a terminal is for the supervisor only
            )  # fmt: skip
            self._watched = os.pidfd_open(self._process.pid)
        except OSError:
            os.close(self._output)
            self._ear.close()
            raise
        finally:
            os.close(writing)
        self.pid = self._process.pid

    def poll(self) -> int | None:
        """Return the exit status, None while it runs; what was printed is passed on."""
        status = self._process.poll()
        self._listen()
        return status

    def heard(self) -> Iterable[tuple[str, str]]:
        """Give what it has told its service manager since."""
        return self._ear.heard(self.pid)

    def send(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        self._process.send_signal(number)

    def filenos(self) -> Sequence[int]:
        """Return what can be waited for: output, signs of life, its end."""
        return self._output, self._ear.fileno(), self._watched

    def error(self) -> str:
        """Return the last line it printed that began with ``error:``."""
        return self._voice.error

    def close(self) -> None:
        """Read what is left, close everything."""
        self._listen()
        self._voice.end(time.monotonic())
        for fd in (self._output, self._watched):
            os.close(fd)
        self._ear.close()

    def _listen(self) -> None:
        self._voice.hear(read_all(self._output), time.monotonic())


def command_of(child: Child) -> list[str]:
    """Return the command, on a leash unless the child outlives us."""
    if child.outlives:
        return list(child.command)
    leash = [sys.executable, "-I", "-S", str(_LEASH), str(os.getpid()), str(child.nice)]
    return [*leash, *child.command]
