"""As long as there is no admin, nothing answers but what makes one."""

from __future__ import annotations

import asyncio

from amberbox.fleet.accounts.setupcode import needs_setup
from amberbox.fleet.api.access import PREFIX
from amberbox.fleet.database.database import Database
from amberbox.fleet.serving.asgi import ASGIApp, Receive, Scope, Send, headers_of, refuse
from amberbox.link import limits
from amberbox.link.refusals import NOT_SET_UP

OPEN = ("/setup", f"{PREFIX}/health", f"{limits.PATH}/ca.pem")
STATIC = "/static/"


class WaitsForAdmin:
    """Answers 503 until the first admin is made; there is always one from then on."""

    def __init__(self, app: ASGIApp, database: Database) -> None:
        self._app = app
        self._database = database
        self._is_ready = False

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on if the server is set up, or if it helps to do that."""
        if scope["type"] != "lifespan" and not _is_open(scope["path"]) and not self._is_ready:
            self._is_ready = await asyncio.to_thread(self._look)
            if not self._is_ready:
                await _send_away(scope, send)
                return
        await self._app(scope, receive, send)

    def _look(self) -> bool:
        with self._database.reading() as connection:
            return not needs_setup(connection)


def _is_open(path: str) -> bool:
    return path in OPEN or path.startswith(STATIC)


async def _send_away(scope: Scope, send: Send) -> None:
    """Show a person's browser to the page that makes the first admin, tell programs of it."""
    if scope.get("method") == "GET" and "text/html" in headers_of(scope).get("accept", ""):
        headers = [(b"location", b"/setup"), (b"content-length", b"0")]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})
        return
    hint = "amberbox serve add-user NAME --data DIR on the server, or open /setup there"
    await refuse(scope, send, 503, "this server is not set up yet", hint, code=NOT_SET_UP)
