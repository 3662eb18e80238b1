"""Notify systemd that a process is ready, alive or stopping (the protocol of sd_notify)."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Mapping

_STATUS_S = 5.0  # interval of status messages without a watchdog
_START_PATIENCE_USEC = 30_000_000
# status of a recorder that ends by itself and has nothing to do when started again
ALL_INPUTS_ENDED = "all inputs have ended, writing the rest"


def notify(message: str, environ: Mapping[str, str] = os.environ) -> bool:
    """Send one message such as ``READY=1`` to the service manager; False if it was not taken."""
    address = environ.get("NOTIFY_SOCKET", "")
    if address[:1] not in ("/", "@"):
        return False
    if address[0] == "@":  # Linux' abstract names begin with NUL
        address = "\0" + address[1:]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as link:
            link.setblocking(False)
            link.sendto(message.encode(), address)
    except OSError:  # a manager that is gone or busy must not stop recording
        return False
    return True


def is_service(environ: Mapping[str, str] = os.environ) -> bool:
    """Return whether a service manager started this process and listens to it."""
    return bool(environ.get("NOTIFY_SOCKET"))


def watchdog_s(environ: Mapping[str, str] = os.environ) -> float | None:
    """Return the watchdog timeout of systemd, seconds; None if it has none."""
    if environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    try:
        interval_us = int(environ.get("WATCHDOG_USEC", ""))
    except ValueError:
        return None
    return interval_us / 1e6 if interval_us > 0 else None


class Notifier:
    """Keeps systemd informed about one run; without systemd every call does nothing."""

    def __init__(
        self,
        environ: Mapping[str, str] = os.environ,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._environ = environ
        self._monotonic = monotonic
        self._listens = is_service(environ)
        self._period_s = (watchdog_s(environ) or 2 * _STATUS_S) / 2
        self._due = 0.0
        self._is_ready = False

    def ready(self) -> None:
        """Notify once that the first bytes are in the journal."""
        if self._listens and not self._is_ready:
            self._is_ready = notify("READY=1", self._environ)

    def alive(self, status: Callable[[], str]) -> None:
        """Notify that the process is alive, with its status; twice per watchdog interval.

        Before ``ready`` it asks for more time instead: systemd must not treat a recorder that waits
        for disk space as one that failed to start.
        """
        now = self._monotonic()
        if not self._listens or now < self._due:
            return
        sign = "WATCHDOG=1" if self._is_ready else f"EXTEND_TIMEOUT_USEC={_START_PATIENCE_USEC}"
        if notify(f"{sign}\nSTATUS={status()}", self._environ):
            self._due = now + self._period_s

    def stopping(self, status: str = "writing the rest") -> None:
        """Notify that the end of the run has begun."""
        if self._listens:
            notify(f"STOPPING=1\nSTATUS={status}", self._environ)
