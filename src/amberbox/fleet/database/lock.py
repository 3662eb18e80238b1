"""One server per data folder: a second one is told who is there already."""

from __future__ import annotations

import fcntl
import json
import os
import socket
from pathlib import Path
from typing import IO

from amberbox.core.clock import Clock
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.timetext import format_time

FILE = "lock"


class ServerLock:
    """Keeps a second server away from a folder; the system lets go of it when the process ends."""

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._file = _opened(folder / FILE)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            holder = _holder(self._file)
            self._file.close()
            raise UsageError(
                f"{folder} is in use by a server: {holder}",
                "stop that one first, or give this one a folder of its own with --data",
            ) from None
        held = {"pid": os.getpid(), "host": socket.gethostname(), "since": _since(clock)}
        self._file.seek(0)
        self._file.truncate()
        self._file.write(json.dumps(held) + "\n")
        self._file.flush()

    def release(self) -> None:
        """Let another server have the folder."""
        self._file.close()


def _opened(path: Path) -> IO[str]:
    try:
        return path.open("a+", encoding="utf-8")
    except OSError as error:
        raise AmberboxError(
            f"cannot write {path}: {error.strerror}", "name a folder that the server may write"
        ) from error


def _since(clock: Clock) -> str:
    return format_time(clock.wall_ns()).partition(".")[0] + "Z"


def _holder(file: IO[str]) -> str:
    try:
        file.seek(0)
        held = json.loads(file.read())
        return f"process {held['pid']} on {held['host']}, since {held['since']}"
    except (OSError, ValueError, TypeError, KeyError):
        return "it does not say which"
