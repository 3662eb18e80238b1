"""Whether a Docker or Podman container runs and calls itself healthy."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from amberbox.core.container_engine import ask_engine, engine_sockets
from amberbox.core.errors import AmberboxError
from amberbox.core.probe import Measured

MEASURES = {
    "state": ("string", "", "running, exited, paused, restarting ...; absent: there is none"),
    "health": ("string", "", "healthy, unhealthy or starting; null if it has no health check"),
    "restarts": ("int", "", "how often it has been started again by itself"),
}
SUBJECT = "name or id of the container, such as rosbridge"
PERIOD_S = 2.0


def measure(subject: str) -> Measured:
    """Query the engine through its socket; unknown where none runs or access is denied."""
    return ask(None, subject)


def ask(sockets: Iterable[Path] | None, name: str) -> Measured:
    """Query each engine whose socket exists, until one knows the container."""
    there = engine_sockets(sockets)
    if not there:
        raise AmberboxError("neither Docker nor Podman has a socket here")
    refused: AmberboxError | None = None
    for path in there:
        try:
            found = ask_engine(path, f"/containers/{quote(name, safe='')}/json")
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
