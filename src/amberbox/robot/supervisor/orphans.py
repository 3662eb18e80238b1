"""Processes that outlived a supervisor that was killed: ended, so that new ones can begin."""

from __future__ import annotations

import os
import select
import signal
from contextlib import suppress
from pathlib import Path

from amberbox.blackbox.store import Store, is_locked
from amberbox.robot.supervisor.child import LINK, RECORD, WATCH
from amberbox.robot.supervisor.process import MARK

WRITER_OF = {WATCH: "watch", RECORD: "main", LINK: "link"}
"""The lock that each child holds: it tells who does."""
_END_S = 10.0


def end_orphan(store: Store, writer: str, within_s: float = _END_S) -> int | None:
    """End the process that a supervisor before this one has left at work; return which it was.

    Only who holds the supervisor's lock may. One that somebody started by hand stays. The watcher
    goes on from where it was, wherever it is stopped, so it is not waited for.
    """
    pid = orphan_of(store, writer)
    if pid is not None:
        _end(pid, within_s if writer == WRITER_OF[RECORD] else 0.0)
    return pid


def orphan_of(store: Store, writer: str) -> int | None:
    """Return the process that a supervisor has started and that writes a journal of the store."""
    if not is_locked(store, writer):
        return None
    with suppress(OSError, ValueError):
        pid = int((store.path / f"lock.{writer}").read_text())
        environ = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
        return pid if f"{MARK}={store.id}".encode() in environ else None
    return None


def _end(pid: int, within_s: float) -> None:
    """Ask a process to end, kill it if it does not, and wait until it is gone."""
    with suppress(ProcessLookupError):
        watched = os.pidfd_open(pid)
        try:
            if within_s:
                signal.pidfd_send_signal(watched, signal.SIGTERM)
                signal.pidfd_send_signal(watched, signal.SIGCONT)
            if not select.select([watched], [], [], within_s)[0]:
                signal.pidfd_send_signal(watched, signal.SIGKILL)
                select.select([watched], [], [], _END_S)
        finally:
            os.close(watched)
