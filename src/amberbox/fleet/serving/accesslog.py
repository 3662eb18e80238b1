"""The log of requests: one JSON object per line, in files that are replaced in turn.

Of an address only the path is written: what stands behind the ``?`` may be private.
"""

from __future__ import annotations

import json
import logging
import os
import time
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any

from amberbox.core.clock import Clock
from amberbox.core.timetext import format_time
from amberbox.fleet.serving.asgi import ASGIApp, Message, Receive, Scope, Send, headers_of
from amberbox.fleet.serving.forwarded import client_address
from amberbox.fleet.serving.settings import Settings

FILE = Path("log") / "access.log"
_BYTES = 10 << 20
_FILES = 5
_LONGEST = 300
_SWITCHED = 101
"""Status of a socket that was opened."""


class AccessLog:
    """Writes a line for every request when it has ended, and for every socket."""

    def __init__(self, app: ASGIApp, folder: Path, settings: Settings, clock: Clock) -> None:
        self._app = app
        self._settings = settings
        self._clock = clock
        (folder / FILE).parent.mkdir(mode=0o700, exist_ok=True)
        self._file = _Private(folder / FILE, maxBytes=_BYTES, backupCount=_FILES, encoding="utf-8")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and note what came of it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        status, began_s = 500, time.monotonic()
        scope.setdefault("state", {})

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "websocket.accept":
                status = _SWITCHED
            elif message["type"].endswith("http.response.start"):
                status = message["status"]
            elif message["type"] == "websocket.close" and status != _SWITCHED:
                status = 403
            await send(message)

        try:
            await self._app(scope, receive, answer)
        finally:
            self._write(scope, status, (time.monotonic() - began_s) * 1e3)

    def _write(self, scope: Scope, status: int, took_ms: float) -> None:
        caller = scope["state"].get("caller")
        peer = scope["client"][0] if scope.get("client") else ""
        forwarded = headers_of(scope).getlist("x-forwarded-for")
        line: dict[str, Any] = {
            "time": format_time(self._clock.wall_ns()),
            "principal": "" if caller is None else str(caller.principal),
            "address": client_address(peer, forwarded, self._settings.proxies),
            "method": scope.get("method", "SOCKET"),
            "path": scope["path"][:_LONGEST],
            "status": status,
            "ms": round(took_ms, 1),
        }
        text = json.dumps(line)
        self._file.emit(logging.LogRecord("access", logging.INFO, "", 0, text, None, None))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class _Private(RotatingFileHandler):
    """Files for the server's user only; a full disk is not told to whoever asked."""

    def _open(self) -> Any:
        os.close(os.open(self.baseFilename, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600))
        return super()._open()

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 -- logging's name
        """Lose the line: answering is what counts."""
