"""Folders written by an older version, unpacked; and the program as users call it.

No module of the package is imported here: compatibility is checked from outside.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import lzma
import re
import signal
import socket
import sys
import tarfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from http.cookiejar import CookieJar
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import HTTPCookieProcessor, OpenerDirector, Request, build_opener

import pytest

from tests.support.processes import LOOPBACK, free_port, running, wait_for_listener

FIXTURES = Path(__file__).parents[1] / "fixtures" / "ef939a5"


@cache
def expected() -> dict[str, Any]:
    """Return the older version's output for its folders."""
    data = lzma.decompress((FIXTURES / "expected.json.xz").read_bytes())
    found: dict[str, Any] = json.loads(data)
    return found


def unpacked(name: str, folder: Path) -> Path:
    """Unpack what the old version left; return the folder it is in."""
    with tarfile.open(FIXTURES / f"{name}.tar.xz") as archive:
        archive.extractall(folder, filter="fully_trusted")
    return folder


@dataclass(frozen=True)
class Said:
    """The output of a command line."""

    status: int
    out: str
    err: str

    def json(self) -> Any:
        """Return its answer."""
        assert self.status == 0, self.err
        return json.loads(self.out)


def amberbox(*words: object) -> Said:
    """Run a command line as the installed program would."""
    (program,) = entry_points(group="console_scripts", name="amberbox")
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["amberbox", *map(str, words)])
        # the program changes how Ctrl-C is heeded, which is the test run's
        before = signal.getsignal(signal.SIGINT)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                status = program.load()()
            finally:
                signal.signal(signal.SIGINT, before)
    return Said(status, out.getvalue(), err.getvalue())


def rows(where: Path, item: str) -> tuple[list[str], list[list[str]]]:
    """Return the columns and all rows of an item, as texts."""
    said = amberbox("query", where, item, "--format", "csv")
    assert said.status == 0, said.err
    columns, *found = csv.reader(io.StringIO(said.out, newline=""))
    return columns, found


def as_then(table: tuple[list[str], list[list[str]]], columns: list[str]) -> list[list[str]]:
    """Return the rows with the columns that there were then: newer ones are no loss."""
    places = [table[0].index(column) for column in columns]
    return [[row[place] for place in places] for row in table[1]]


def digest(found: list[list[str]]) -> str:
    """Return the SHA-256 of rows."""
    return sha256(json.dumps(found).encode()).hexdigest()


@dataclass
class Person:
    """A person who calls the server's API."""

    url: str
    csrf: str = ""
    opener: OpenerDirector = field(
        default_factory=lambda: build_opener(HTTPCookieProcessor(CookieJar()))
    )

    def ask(self, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, Any]:
        """Return status and answer."""
        data = None if body is None else json.dumps(body).encode()
        said = {"Content-Type": "application/json", "X-CSRF-Token": self.csrf, **headers}
        return self.send(method, path, data, said)

    def send(
        self, method: str, path: str, data: bytes | None, headers: Mapping[str, str]
    ) -> tuple[int, Any]:
        """Send a request unchanged; return status and answer."""
        asked = Request(self.url + path, data, dict(headers), method=method)
        try:
            with self.opener.open(asked) as answer:
                return answer.status, _decoded(answer.read())
        except HTTPError as error:
            return error.code, _decoded(error.read())

    def get(self, path: str) -> Any:
        """Return the answer of a route of the API."""
        status, answer = self.ask("GET", f"/api/v1{path}")
        assert status == 200, (path, answer)
        return answer

    def sign_in(self, name: str, password: str) -> Any:
        """Sign in; return who one is."""
        status, answer = self.ask("POST", "/api/v1/session", {"name": name, "password": password})
        assert status == 200, answer
        self.csrf = answer["csrf"]
        return answer


def _decoded(data: bytes) -> Any:
    try:
        return json.loads(data)
    except ValueError:
        return data.decode("utf-8", "replace")


@contextmanager
def serving(data: Path) -> Iterator[str]:
    """Start the server on a folder; yield its address."""
    port, log = free_port(), data.parent / "server.log"
    with running("serve", "--data", data, "--port", port, "--quiet", log=log) as process:
        wait_for_listener(port, process, log)
        yield f"http://{LOOPBACK}:{port}"


class Relay:
    """Forwards connections to a port, and stores the data that robots sent."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._server = socket.create_server((LOOPBACK, 0))
        self.port = int(self._server.getsockname()[1])
        self._sent: list[bytearray] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def pieces(self) -> list[tuple[str, int, int]]:
        """Return of each piece of a journal that was sent: which journal, from where, how long."""
        found = []
        for sent in self._sent:
            for one in re.finditer(rb"PATCH (\S+) HTTP/1.1\r\n(.*?)\r\n\r\n", bytes(sent), re.S):
                headers = dict(
                    line.lower().split(b": ", 1) for line in one[2].split(b"\r\n") if b": " in line
                )
                journal = "/".join(one[1].decode().split("/")[-2:])
                at, size = headers[b"upload-offset"], headers[b"content-length"]
                found.append((journal, int(at), int(size)))
        return found

    def close(self) -> None:
        """Take no more connections."""
        self._server.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                robot, _ = self._server.accept()
                server = socket.create_connection((LOOPBACK, self._to))
                kept = bytearray()
                self._sent.append(kept)
                for words in ((robot, server, kept), (server, robot, bytearray())):
                    threading.Thread(target=_pass, args=words, daemon=True).start()


def _pass(source: socket.socket, sink: socket.socket, kept: bytearray) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(1 << 16):
            kept += data
            sink.sendall(data)
    for end in (source, sink):
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)


def lacks(was: Any, now: Any, where: str = "") -> list[str]:
    """Return the values that were in the older output and are missing now; new keys do not
    count.
    """
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        return [
            text for key in was
            for text in (lacks(was[key], now[key], f"{where}.{key}") if key in now
                         else [f"{where}.{key} is gone"])
        ]  # fmt: skip
    if isinstance(was, list) and isinstance(now, list) and len(was) == len(now):
        return [
            text
            for number, (old, new) in enumerate(zip(was, now, strict=True))
            for text in lacks(old, new, f"{where}[{number}]")
        ]
    return [] if was == now else [f"{where}: {was!r:.200} is {now!r:.200} now"]
