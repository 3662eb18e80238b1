"""Docker and Podman, asked through their sockets by reading calls of the Docker Engine API."""

from __future__ import annotations

import http.client
import json
import os
import socket
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from amberbox.core.errors import AmberboxError

_WAIT_S = 2.0
_LONGEST_BYTES = 16 << 20
_DENIED = "may not be used by this user: its group (docker) may"


def engine_sockets(among: Iterable[Path] | None = None) -> list[Path]:
    """Return the sockets of engines that exist, of the usual places or of given ones."""
    own = Path(os.environ.get("XDG_RUNTIME_DIR", f"/run/user/{os.getuid()}"))
    places = (
        Path("/run/docker.sock"),
        Path("/var/run/docker.sock"),
        own / "docker.sock",
        Path("/run/podman/podman.sock"),
        own / "podman" / "podman.sock",
    )
    found = map(_resolved, places if among is None else among)
    return [path for path in dict.fromkeys(found) if path is not None]


def _resolved(path: Path) -> Path | None:
    try:
        return path.resolve() if path.exists() else None
    except PermissionError:
        return path


def ask_engine(path: Path, address: str) -> Any:
    """Return what an engine answers to GET, decoded; None if it knows no such thing.

    Raises AmberboxError if it cannot be asked or refuses.
    """
    connection = _Connection(path)
    try:
        connection.request("GET", address)
        answer = connection.getresponse()
        text = answer.read(_LONGEST_BYTES + 1)
    except PermissionError as error:
        raise AmberboxError(f"{path} {_DENIED}") from error
    except (OSError, http.client.HTTPException) as error:
        raise AmberboxError(f"{path}: {error}") from error
    finally:
        connection.close()
    if answer.status == http.client.NOT_FOUND:
        return None
    if answer.status != http.client.OK:
        raise AmberboxError(f"{path}: {answer.status} {answer.reason}")
    if len(text) > _LONGEST_BYTES:
        raise AmberboxError(f"{path}: the answer is longer than {_LONGEST_BYTES} bytes")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise AmberboxError(f"{path}: the answer is no JSON") from error


class _Connection(http.client.HTTPConnection):
    """HTTP over a Unix socket."""

    def __init__(self, path: Path) -> None:
        super().__init__("localhost", timeout=_WAIT_S)
        self._path = path

    def connect(self) -> None:
        """Connect to the path instead of a host."""
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(self.timeout)
        self.sock.connect(str(self._path))
