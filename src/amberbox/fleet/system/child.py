"""Becomes ``amberbox run FOLDER`` and ends with the server, whatever ends that.

Started as ``python -m amberbox.fleet.system.child PARENT FOLDER``.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1
_NICE = 5


def main(arguments: list[str]) -> None:
    """Become the supervisor of a folder."""
    parent, folder = arguments
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):  # gone before it was asked for
        sys.exit(1)
    os.nice(_NICE)
    command = [sys.executable, "-m", "amberbox", "run", "--quiet", folder]
    os.execv(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
