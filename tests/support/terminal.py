"""A program that a test talks to in a terminal."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import subprocess
import termios

from amberbox.core.files import wait_readable
from amberbox.testing.clock import PATIENCE_S
from tests.support.processes import command, wait_for


class AtTerminal:
    """A program that somebody talks to in a terminal."""

    def __init__(self, *words: str) -> None:
        self._end, theirs = pty.openpty()
        self.process = subprocess.Popen(
            command(*words), stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )  # fmt: skip
        os.close(theirs)
        self.shown = ""

    def wait(self, text: str) -> None:
        """Wait until a text was shown, and forget all up to it."""

        def look() -> bool:
            if wait_readable([self._end], 0.1):
                with contextlib.suppress(OSError):  # it has ended
                    self.shown += os.read(self._end, 1 << 12).decode(errors="replace")
            return text in self.shown

        wait_for(look, f"{text!r} in {self.shown!r}")
        self.shown = self.shown.partition(text)[2]

    def type(self, text: str) -> None:
        os.write(self._end, text.encode())

    def end(self) -> int:
        """Wait for the end; return the exit status."""
        try:
            return self.process.wait(PATIENCE_S)
        finally:
            os.close(self._end)
