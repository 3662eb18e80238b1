"""Hears the signs of life of one child: the messages that it would send to systemd."""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterator

_CREDENTIALS = struct.Struct("3i")
_MESSAGE = 4096


class Ear:
    """A socket without a name in the file system; only messages of one process count."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self._socket.bind("")  # Linux chooses an abstract name

    def environ(self, watchdog_s: float) -> dict[str, str]:
        """Return the environment of a child that is heard: ours, without what is meant for us."""
        ours = {k: v for k, v in os.environ.items() if k != "WATCHDOG_PID"}
        name = "@" + os.fsdecode(self._socket.getsockname()[1:])
        return {**ours, "NOTIFY_SOCKET": name, "WATCHDOG_USEC": str(round(watchdog_s * 1e6))}

    def fileno(self) -> int:
        """Return what can be waited for."""
        return self._socket.fileno()

    def heard(self, pid: int) -> Iterator[tuple[str, str]]:
        """Yield what a process has said since: pairs such as ``READY``, ``1``."""
        while True:
            try:
                data, ancillary, _, _ = self._socket.recvmsg(
                    _MESSAGE, socket.CMSG_SPACE(_CREDENTIALS.size)
                )
            except BlockingIOError:
                return
            if any(_sender(*entry) == pid for entry in ancillary):
                for line in data.decode(errors="replace").splitlines():
                    key, _, value = line.partition("=")
                    yield key, value

    def close(self) -> None:
        """Hear nothing any more."""
        self._socket.close()


def _sender(level: int, kind: int, data: bytes) -> int | None:
    if (level, kind) != (socket.SOL_SOCKET, socket.SCM_CREDENTIALS):
        return None
    return int(_CREDENTIALS.unpack(data[: _CREDENTIALS.size])[0])
