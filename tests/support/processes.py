"""Programs that tests start: a free port, the command line, a process that ends with its block."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from pathlib import Path
from random import SystemRandom
from typing import ParamSpec, TypeVar

from amberbox.testing.clock import PATIENCE_S, wait_until

LOOPBACK = "127.0.0.1"
_PORTS_GIVEN = Path("/proc/sys/net/ipv4/ip_local_port_range")
_UNPRIVILEGED = 1_024
_CHANCE = SystemRandom()  # tests seed the common one, in each worker alike
_GIVEN: set[int] = set()
P = ParamSpec("P")
T = TypeVar("T")


def free_port() -> int:
    """Return a free TCP port that no other test gets.

    It lies below those that the system gives to connections meanwhile. Workers of one run share
    the ports by their remainder, and none gets a port twice: who has one may listen late, or again.
    """
    lowest = int(_PORTS_GIVEN.read_text().split()[0])
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    while True:
        port = _CHANCE.randrange(_UNPRIVILEGED, lowest)
        if port % workers == worker and port not in _GIVEN:
            with suppress(OSError), socket.create_server((LOOPBACK, port)):
                _GIVEN.add(port)
                return port


def command(*words: object) -> list[str]:
    """Return the command line of ``amberbox`` with these words."""
    return [sys.executable, "-m", "amberbox", *map(str, words)]


def apart(function: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
    """Call a function in a process of its own, which a native library may crash."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments, **named).result()


@contextmanager
def running(*words: object, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run ``amberbox`` as a process, its output in ``log``; end it in order behind the block."""
    environment = {**os.environ, "XDG_CONFIG_HOME": str(log.parent / "config")}
    with log.open("ab") as output:
        process = subprocess.Popen(
            command(*words), env=environment, stdin=subprocess.DEVNULL, stdout=output,
            stderr=output,
        )  # fmt: skip
    try:
        yield process
        assert process.poll() in (None, 0), log.read_text()
    finally:
        process.terminate()
        try:
            process.wait(PATIENCE_S)
        finally:
            process.kill()


def wait_for(find: Callable[[], T | None], what: str, every_s: float = 0.05) -> T:
    """Wait until something is found, and return it; raise TimeoutError after ``PATIENCE_S``."""
    end_s = time.monotonic() + PATIENCE_S
    while not (found := find()):
        if time.monotonic() > end_s:
            raise TimeoutError(f"not within {PATIENCE_S:g} s: {what}")
        time.sleep(every_s)
    return found


def wait_for_listener(port: int, process: subprocess.Popen[bytes], log: Path) -> None:
    """Wait until a process listens at a port; fail with its output when it ends before."""

    def listens() -> bool:
        assert process.poll() is None, log.read_text()[-4000:]
        try:
            socket.create_connection((LOOPBACK, port), 1).close()
        except OSError:
            return False
        return True

    wait_until(listens, f"a listener at port {port}")
