"""Two network namespaces with an Ethernet cable (veth) between them; needs root."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import IO

_numbers = count()
_NEWNET = 0x40000000


class NetworkPair:
    """Namespaces ``near`` and ``far``, each with one interface of the same name."""

    def __init__(self) -> None:
        self.interface = f"e{os.getpid() % 10**6}x{next(_numbers)}"
        self.near, self.far = (f"{self.interface}{side}" for side in "nf")

    def __enter__(self) -> NetworkPair:
        for name in (self.near, self.far):
            _ip("netns", "add", name)
        self.plug()
        return self

    def plug(self) -> None:
        """Connect the two by a new cable, with IPv6 off: nothing is sent by itself."""
        _ip(
            "-n", self.near, "link", "add", self.interface, "type", "veth", "peer", "name",
            self.interface, "netns", self.far,
        )  # fmt: skip
        for name in (self.near, self.far):
            switch = f"/proc/sys/net/ipv6/conf/{self.interface}/disable_ipv6"
            command = f"test ! -e {switch} || echo 1 > {switch}"
            subprocess.run(["ip", "netns", "exec", name, "sh", "-c", command], check=True)
        for name in (self.far, self.near):
            self.switch("up", name)

    def unplug(self) -> None:
        """Remove the cable and both interfaces."""
        _ip("-n", self.near, "link", "del", self.interface)

    def switch(self, state: str, namespace: str) -> None:
        """Switch an interface ``up`` or ``down``."""
        _ip("-n", namespace, "link", "set", self.interface, state)

    def __exit__(self, *_: object) -> None:
        for name in (self.near, self.far):
            _ip("netns", "del", name)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


@contextmanager
def in_namespace(name: str) -> Iterator[None]:
    """Be in a network namespace with this thread and those that it starts."""
    libc = ctypes.CDLL(None, use_errno=True)
    with Path("/proc/thread-self/ns/net").open() as home, Path("/run/netns", name).open() as there:
        _enter(libc, there)
        try:
            yield
        finally:
            _enter(libc, home)


def _enter(libc: ctypes.CDLL, namespace: IO[str]) -> None:
    if libc.setns(namespace.fileno(), _NEWNET):
        raise OSError(ctypes.get_errno(), "setns")


class Helper:
    """A module of the tests that runs in a namespace, takes lines and answers each with one."""

    def __init__(self, namespace: str, module: str, *arguments: object) -> None:
        words: Sequence[object] = (sys.executable, "-m", module, *arguments)
        self.process = subprocess.Popen(
            ["ip", "netns", "exec", namespace, *map(str, words)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.greeting = self._answer()

    def ask(self, line: str) -> str:
        """Send a line and return the answer."""
        self.tell(line)
        return self._answer()

    def tell(self, line: str) -> None:
        """Send a line."""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def _answer(self) -> str:
        assert self.process.stdout is not None
        answer = self.process.stdout.readline()
        if not answer:
            raise RuntimeError(f"it ended with {self.process.wait(10)}")
        return answer.strip()

    def kill(self) -> None:
        """End it at once."""
        self.process.kill()
        self.process.wait()

    def __enter__(self) -> Helper:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.returncode is None:
            self.kill()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()
