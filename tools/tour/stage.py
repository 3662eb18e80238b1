"""Starts the demonstration as somebody at a terminal does, and takes the links that it prints."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.demo.fleet import DATA
from amberbox.demo.story import until
from amberbox.server.accounts.permissions import Role
from amberbox.server.middleware import FILE

_LINK = re.compile(r"^ +([a-z]+) +(http://\S+/in#\S+)\s*$", re.MULTILINE)
_BEGIN_S, _END_S = 60.0, 60.0


@dataclass(eq=False)
class Terminal:
    """A terminal in which a program runs: what it has printed so far, and a key to press."""

    master: int
    text: str = ""
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def read(self) -> None:
        """Take what is printed until nobody has the terminal open any more."""
        while True:
            try:
                piece = os.read(self.master, 65536)
            except OSError:  # how Linux says that the other side is closed
                return
            with self._lock:
                self.text += piece.decode("utf-8", "replace")

    def press_enter(self) -> None:
        """Press Enter."""
        os.write(self.master, b"\n")


@dataclass(eq=False)
class Demonstration:
    """The demonstration while it runs."""

    folder: Path
    terminal: Terminal

    def links(self) -> Mapping[str, str]:
        """Return fresh links, by role: each of them signs in once."""
        seen = len(_LINK.findall(self.terminal.text))
        if seen:
            self.terminal.press_enter()
        found = until(lambda: self._new_links(seen), lambda: "links are printed", _BEGIN_S)
        return dict(found)

    def log(self) -> list[str]:
        """Return the lines of the server's access log so far."""
        return (self.folder / DATA / FILE).read_text(encoding="utf-8").splitlines()

    def _new_links(self, seen: int) -> list[tuple[str, str]] | None:
        new = _LINK.findall(self.terminal.text)[seen:]
        return new if len(new) >= len(Role) else None


@contextmanager
def demonstration(port: int) -> Iterator[Demonstration]:
    """Run ``amberbox demo`` in a terminal of its own and a folder that goes at the end."""
    with tempfile.TemporaryDirectory(
        prefix="amberbox-tour-",
        ignore_cleanup_errors=True,  # a keeper that outlives its box may still write something
    ) as place:
        folder = Path(place) / "demo"
        command = ["amberbox", "demo", "--port", str(port), "--keep", str(folder)]
        master, slave = pty.openpty()
        process = subprocess.Popen(
            [sys.executable, "-m", *command], stdin=slave, stdout=slave, stderr=slave,
            process_group=0,
        )  # fmt: skip
        os.close(slave)
        terminal = Terminal(master)
        reader = threading.Thread(target=terminal.read)
        reader.start()
        try:
            yield Demonstration(folder, terminal)
        finally:
            _end(process)
            reader.join()
            os.close(master)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Press Ctrl-C; what does not end by that is ended."""
    process.send_signal(signal.SIGINT)
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
