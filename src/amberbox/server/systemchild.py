"""Replaces itself by ``amberbox run FOLDER``, which ends when the server ends for any reason.

Started as ``python -m amberbox.server.systemchild PARENT FOLDER``.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1
_NICE = 5


def main(arguments: list[str]) -> None:
    """Run the supervisor of a folder in place of this process."""
    parent, folder = arguments
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):  # the server ended before prctl took effect
        sys.exit(1)
    os.nice(_NICE)
    command = [sys.executable, "-m", "amberbox", "run", "--quiet", folder]
    os.execv(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
