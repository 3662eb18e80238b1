"""Processes of the demonstration: they end with it, whatever ends it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from typing import IO

from amberbox.robot.supervisor import leash


def start_tied(
    words: Sequence[str], *, stdin: int = subprocess.DEVNULL, output: IO[bytes] | None = None
) -> subprocess.Popen[bytes]:
    """Start a module of ours with its arguments; it gets SIGTERM when this process is gone.

    Call it on the main thread: a child ends with the thread that began it.
    """
    tied = [sys.executable, "-I", "-S", leash.__file__, str(os.getpid()), "0"]
    return subprocess.Popen(
        [*tied, sys.executable, "-m", *words], stdin=stdin, stdout=output,
        stderr=None if output is None else subprocess.STDOUT,
        process_group=0,  # Ctrl-C in a terminal is for the demonstration only
    )  # fmt: skip
