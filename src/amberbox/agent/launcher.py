"""Start a program that ends with its parent, with a nice value and without OOM protection.

It imports nothing of Amberbox, so that it takes milliseconds.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_OOM = Path("/proc/self/oom_score_adj")


def main(arguments: list[str]) -> None:
    """Replace this process by ``COMMAND...`` of the arguments ``PARENT NICE COMMAND...``."""
    parent, nice, *command = arguments
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):  # the parent ended before prctl took effect
        sys.exit(1)
    os.nice(int(nice))
    with suppress(OSError, ValueError):
        if int(_OOM.read_text()) < 0:  # the recorder's protection is for it alone
            _OOM.write_text("0")
    os.execv(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
