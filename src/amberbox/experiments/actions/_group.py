"""Run a command in a process group that ends with the process that holds the other end of stdin.

It imports nothing of Amberbox, so that it takes milliseconds: ``python -I -S _group.py END_S
COMMAND...``. It ends with the command's exit status, and 128 + N after the signal N, as a shell.
"""

from __future__ import annotations

import os
import resource
import select
import signal
import subprocess
import sys
from contextlib import suppress

NOT_FOUND = 127


def main(arguments: list[str]) -> int:
    """Run the command until it ends or stdin does; then end its whole group."""
    end_s, command = float(arguments[0]), arguments[1:]
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # only the end of stdin counts
    for limit in (resource.RLIMIT_DATA, resource.RLIMIT_CORE):
        most = resource.getrlimit(limit)[1]
        resource.setrlimit(limit, (most, most))  # those of the actor are not for its programs
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=_default_signals,  # this process has one thread
        )
    except OSError as error:
        print(f"{command[0]}: {error.strerror}", file=sys.stderr)
        return NOT_FOUND
    watched = os.pidfd_open(process.pid)
    ready, _, _ = select.select([watched, sys.stdin], [], [])
    if watched not in ready:
        _signal_group(process.pid, signal.SIGTERM)
        select.select([watched], [], [], end_s)
    _signal_group(process.pid, signal.SIGKILL)  # also what the command has left behind
    status = process.wait()
    return status if status >= 0 else 128 - status


def _default_signals() -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _signal_group(group: int, number: int) -> None:
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(group, number)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
