"""Replaces itself by ``amberbox run FOLDER``, which ends when the server ends for any reason.

Started as ``python -m amberbox.server.systemchild PARENT FOLDER``.
"""

from __future__ import annotations

import os
import signal
import sys

from amberbox.core.child_process import end_with_parent

_NICE = 5


def main(arguments: list[str]) -> None:
    """Run the supervisor of a folder in place of this process."""
    parent, folder = arguments
    end_with_parent(int(parent), signal.SIGTERM)
    os.nice(_NICE)
    command = [sys.executable, "-m", "amberbox", "run", "--quiet", folder]
    os.execv(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
