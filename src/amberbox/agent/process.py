"""Child processes of the recorder: commands, output, watchdog messages (``sd_notify``), orphans."""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from amberbox.blackbox.robot_folder.folder import ROBOT_FILE
from amberbox.blackbox.robot_folder.robot_yaml import KEY_FILE
from amberbox.blackbox.store.store import Store, is_locked
from amberbox.core.child_process import ChildOutput, read_all
from amberbox.core.files import wait_readable
from amberbox.core.yaml_nodes import Node, load_yaml
from amberbox.monitoring.component_files import FOLDER as COMPONENTS

RECORD, WATCH, LINK, ACT, MIRROR, DETECT = "record", "watch", "link", "act", "mirror", "detect"
REFUSED = 2  # exit status of a process that refuses its configuration


@dataclass(frozen=True, slots=True)
class ChildProcess:
    """A supervised child process.

    ``stage`` orders the shutdown: all of a stage have ended before the next is terminated.
    ``end_s`` is how long after the stop began it may still run. ``watchdog_s`` is the longest time
    between watchdog messages, ``start_s`` that until it is ready. It is started after ``follows``
    is ready.
    """

    name: str
    command: Sequence[str]
    stage: int = 0
    end_s: float = 3.0
    watchdog_s: float = 60.0
    start_s: float = 300.0
    nice: int = 0
    outlives: bool = False
    """It survives the supervisor."""
    follows: str = ""


def children_of(folder: Path, write_s: float, *, quiet: bool = True) -> list[ChildProcess]:
    """Return the child processes of a robot folder, the recorder first.

    The link and the mirror end last, so that they send what the others have written.
    """
    recorder = ChildProcess(
        RECORD, amberbox_command(RECORD, "--quiet", str(folder)), stage=1, end_s=9.0,
        watchdog_s=max(10.0, 4 * write_s), outlives=True,
    )  # fmt: skip
    words = ("--quiet",) if quiet else ()
    watcher = ChildProcess(
        WATCH, amberbox_command(WATCH, *words, str(folder)), end_s=4.0, nice=5, follows=RECORD
    )
    linker = ChildProcess(
        LINK,
        amberbox_command(LINK, *words, str(folder)),
        stage=2,
        end_s=10.0,
        nice=5,
        follows=RECORD,
    )
    actor = ChildProcess(
        ACT, amberbox_command(ACT, *words, str(folder)), end_s=12.0, watchdog_s=20.0, follows=RECORD
    )
    mirror = ChildProcess(
        MIRROR, amberbox_command(MIRROR, *words, str(folder)), stage=2, end_s=10.0, nice=5,
        follows=RECORD,
    )  # fmt: skip
    detector = ChildProcess(
        DETECT, amberbox_command(DETECT, *words, str(folder)), end_s=4.0, nice=10, follows=RECORD
    )
    return [recorder, watcher, linker, actor, mirror, detector]


def amberbox_command(*arguments: str) -> list[str]:
    """Return the command of a verb."""
    return [sys.executable, "-m", "amberbox", *arguments]


def is_wanted(child: ChildProcess, folder: Path) -> bool:
    """Return whether the present configuration of a folder needs a child."""
    if child.name == LINK:
        return has_server(folder)
    if child.name == ACT:
        return takes_commands(folder)
    if child.name == MIRROR:
        return has_mirror(folder)
    if child.name == DETECT:
        return has_detection(folder)
    return child.name != WATCH or has_components(folder)


def has_server(folder: Path) -> bool:
    """Return whether a robot folder names a server and has its key."""
    server = _robot_keys(folder).get("server")
    keys = (server.mapping or {}) if server is not None else {}
    return bool(keys) and ((folder / KEY_FILE).exists() or "token" in keys)


def has_mirror(folder: Path) -> bool:
    """Return whether a robot folder names a database that items are copied to."""
    database = _robot_keys(folder).get("mongodb")
    return database is not None and bool(database.mapping)


def has_detection(folder: Path) -> bool:
    """Return whether a robot folder names a model of detectors."""
    detection = _robot_keys(folder).get("detection")
    return detection is not None and bool(detection.mapping)


def _robot_keys(folder: Path) -> Mapping[str, Node]:
    root = load_yaml(folder / ROBOT_FILE, []) if (folder / ROBOT_FILE).exists() else None
    return (root.mapping if root else None) or {}


def takes_commands(folder: Path) -> bool:
    """Return whether somebody may command the robot: a server, people at it, or its own rules."""
    given = _robot_keys(folder)
    return has_server(folder) or "commands" in given or "recovery" in given


def has_components(folder: Path) -> bool:
    """Return whether a robot folder has component files."""
    place = folder / COMPONENTS
    return any(place.rglob("*.yaml")) or any(place.rglob("*.yml"))


_CREDENTIALS = struct.Struct("3i")
_MESSAGE = 4096


class NotifySocket:
    """A notify socket with an abstract name; only messages of one process are accepted."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self._socket.bind("")  # Linux chooses an abstract name

    def environ(self, watchdog_s: float) -> dict[str, str]:
        """Return the environment of a child, with this socket as its ``NOTIFY_SOCKET``."""
        ours = {k: v for k, v in os.environ.items() if k != "WATCHDOG_PID"}
        name = "@" + os.fsdecode(self._socket.getsockname()[1:])
        return {**ours, "NOTIFY_SOCKET": name, "WATCHDOG_USEC": str(round(watchdog_s * 1e6))}

    def fileno(self) -> int:
        """Return the file descriptor to wait for."""
        return self._socket.fileno()

    def received(self, pid: int) -> Iterator[tuple[str, str]]:
        """Yield the messages of a process since the last call: pairs such as ``READY``, ``1``."""
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
        """Close the socket."""
        self._socket.close()


def _sender(level: int, kind: int, data: bytes) -> int | None:
    if (level, kind) != (socket.SOL_SOCKET, socket.SCM_CREDENTIALS):
        return None
    return int(_CREDENTIALS.unpack(data[: _CREDENTIALS.size])[0])


# in the environment of each child: the store for which it was started
SUPERVISED_MARK = "AMBERBOX_SUPERVISED"
_LAUNCHER = Path(__file__).with_name("launcher.py")


class Process(Protocol):
    """Interface of a process; tests use one that is controlled by hand."""

    pid: int

    def poll(self) -> int | None:
        """Return its exit status, negative for a signal; None while it runs."""

    def received(self) -> Iterable[tuple[str, str]]:
        """Return the watchdog messages since the last call."""

    def send(self, number: int) -> None:
        """Send a signal."""

    def filenos(self) -> Sequence[int]:
        """Return the file descriptors to wait for."""

    def error(self) -> str:
        """Return the last line of its output that began with ``error:``."""

    def close(self) -> None:
        """Read the remaining output, and close everything."""


Launch = Callable[[ChildProcess], Process]


class RealProcess:
    """Runs a child's command and prints its output.

    A child never blocks on its output: lines that are not read in time are lost.
    """

    def __init__(self, child: ChildProcess, store_id: str, output: ChildOutput) -> None:
        self._notify_socket, self._child_output = NotifySocket(), output
        output.error = ""
        self._output, writing = os.pipe()
        os.set_blocking(writing, False)
        os.set_blocking(self._output, False)
        try:
            self._process = subprocess.Popen(
                command_of(child), stdin=subprocess.DEVNULL, stdout=writing, stderr=writing,
                env={**self._notify_socket.environ(child.watchdog_s), SUPERVISED_MARK: store_id},
                process_group=0,  # Ctrl-C in a terminal is for the supervisor only
            )  # fmt: skip
            self._watched = os.pidfd_open(self._process.pid)
        except OSError:
            os.close(self._output)
            self._notify_socket.close()
            raise
        finally:
            os.close(writing)
        self.pid = self._process.pid

    def poll(self) -> int | None:
        """Return the exit status, None while it runs; forward its output."""
        status = self._process.poll()
        self._read_output()
        return status

    def received(self) -> Iterable[tuple[str, str]]:
        """Return the watchdog messages since the last call."""
        return self._notify_socket.received(self.pid)

    def send(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        self._process.send_signal(number)

    def filenos(self) -> Sequence[int]:
        """Return the file descriptors to wait for: output, watchdog messages, exit."""
        return self._output, self._notify_socket.fileno(), self._watched

    def error(self) -> str:
        """Return the last output line that began with ``error:``."""
        return self._child_output.error

    def close(self) -> None:
        """Read the remaining output, and close everything."""
        self._read_output()
        self._child_output.end(time.monotonic())
        for fd in (self._output, self._watched):
            os.close(fd)
        self._notify_socket.close()

    def _read_output(self) -> None:
        self._child_output.feed(read_all(self._output), time.monotonic())


def command_of(child: ChildProcess) -> list[str]:
    """Return the command, through the launcher unless the child outlives the supervisor."""
    if child.outlives:
        return list(child.command)
    launcher = [sys.executable, "-I", "-S", str(_LAUNCHER), str(os.getpid()), str(child.nice)]
    return [*launcher, *child.command]


# the lock that each child holds; its file contains the process id
WRITER_OF = {
    WATCH: "watch", RECORD: "main", LINK: "link", ACT: "act", MIRROR: "mirror", DETECT: "detect",
}  # fmt: skip
_END_S = 10.0


def end_orphan(store: Store, writer: str, within_s: float = _END_S) -> int | None:
    """End a process that an earlier supervisor left running; return its id.

    For the holder of the supervisor's lock only. Processes started by hand are kept. The watcher is
    killed at once, since it resumes from its checkpoint.
    """
    pid = orphan_of(store, writer)
    if pid is not None:
        _end(pid, within_s if writer == WRITER_OF[RECORD] else 0.0)
    return pid


def orphan_of(store: Store, writer: str) -> int | None:
    """Return the id of a supervised process that writes a journal of the store, or None."""
    if not is_locked(store, writer):
        return None
    with suppress(OSError, ValueError):
        pid = int((store.path / f"lock.{writer}").read_text())
        environ = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
        return pid if f"{SUPERVISED_MARK}={store.id}".encode() in environ else None
    return None


def _end(pid: int, within_s: float) -> None:
    """Terminate a process, kill it if it does not end, and wait until it is gone."""
    with suppress(ProcessLookupError):
        watched = os.pidfd_open(pid)
        try:
            if within_s:
                signal.pidfd_send_signal(watched, signal.SIGTERM)
                signal.pidfd_send_signal(watched, signal.SIGCONT)
            if not wait_readable([watched], within_s):
                signal.pidfd_send_signal(watched, signal.SIGKILL)
                wait_readable([watched], _END_S)
        finally:
            os.close(watched)
