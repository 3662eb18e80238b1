"""Whether a Docker or Podman container runs and calls itself healthy."""

from __future__ import annotations

import http.client
import json
import os
import socket
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from amberbox.core.errors import AmberboxError
from amberbox.core.probe import Measured

MEASURES = {
    "state": ("string", "", "running, exited, paused, restarting ...; absent: there is none"),
    "health": ("string", "", "healthy, unhealthy or starting; null if it has no health check"),
    "restarts": ("int", "", "how often it has been started again by itself"),
}
SUBJECT = "name or id of the container, such as rosbridge"
PERIOD_S = 2.0

_WAIT_S = 2.0
_DENIED = "may not be used by this user: its group (docker) may"


def measure(subject: str) -> Measured:
    """Query the engine through its socket; unknown where none runs or access is denied."""
    own = Path(os.environ.get("XDG_RUNTIME_DIR", f"/run/user/{os.getuid()}"))
    places = (Path("/run/docker.sock"), Path("/var/run/docker.sock"))
    podman = (Path("/run/podman/podman.sock"), own / "podman" / "podman.sock")
    return ask((*places, own / "docker.sock", *podman), subject)


def ask(sockets: Iterable[Path], name: str) -> Measured:
    """Query each engine whose socket exists, until one knows the container."""
    there = [path for path in dict.fromkeys(map(_resolved, sockets)) if path is not None]
    if not there:
        raise AmberboxError("neither Docker nor Podman has a socket here")
    refused: AmberboxError | None = None
    for path in there:
        try:
            found = _inspect(path, name)
        except AmberboxError as error:
            refused = error
            continue
        if found is not None:
            return read(found)
    if refused is not None:
        raise refused
    return {"ok": False, "state": "absent"}


def read(inspected: dict[str, Any]) -> Measured:
    """Return the measurement from an engine's description of a container."""
    state = inspected["State"]
    health = (state.get("Health") or {}).get("Status", "")
    known = health if health not in ("", "none") else None
    return {
        "ok": state["Status"] == "running" and known != "unhealthy",
        "state": state["Status"],
        "health": known,
        "restarts": inspected.get("RestartCount"),
    }


def _resolved(path: Path) -> Path | None:
    try:
        return path.resolve() if path.exists() else None
    except PermissionError:
        return path


def _inspect(path: Path, name: str) -> dict[str, Any] | None:
    """Return an engine's description of a container, None if it has no such one."""
    connection = _Connection(path)
    try:
        connection.request("GET", f"/containers/{quote(name, safe='')}/json")
        answer = connection.getresponse()
        text = answer.read()
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
    found: dict[str, Any] = json.loads(text)
    return found


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
