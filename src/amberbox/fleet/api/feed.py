"""The socket over which the server tells what has changed."""

from __future__ import annotations

import asyncio

from fastapi import HTTPException, WebSocket
from starlette.websockets import WebSocketDisconnect

from amberbox.fleet.api.access import Fleet, Routes, Who
from amberbox.fleet.api.who import COOKIE
from amberbox.fleet.feed.gate import ACTION, Credential, permission
from amberbox.fleet.feed.listener import Listener
from amberbox.fleet.feed.talking import Talk

routes = Routes("feed")

_BEARER = "bearer "


@routes.socket("/feed", ACTION, each=True)
async def listen(websocket: WebSocket, fleet: Fleet, who: Who) -> None:
    """Say what you want to hear, then hear it: a snapshot, and what changes from there on."""
    credential = _credential(websocket)
    may = await asyncio.to_thread(permission, fleet.database, fleet.clock, credential)
    if may is None or may.principal.id != who.principal.id:
        raise HTTPException(401, "sign in first")
    listener = Listener(credential, may)
    if not fleet.feed.join(listener):
        raise HTTPException(429, "too many sockets are open")
    try:
        await websocket.accept()
        await Talk(fleet.feed, listener, _Socket(websocket)).run()
    finally:
        fleet.feed.leave(listener)


def _credential(websocket: WebSocket) -> Credential:
    header = websocket.headers.get("authorization", "")
    if header:
        return Credential(token=header[len(_BEARER) :].strip())
    return Credential(session=websocket.cookies.get(COOKIE, ""))


class _Socket:
    """An accepted WebSocket as the feed takes it."""

    def __init__(self, websocket: WebSocket) -> None:
        self._websocket = websocket

    async def receive(self) -> str | None:
        """Wait for a message; None at the end. Binary ones are none of ours."""
        try:
            got = await self._websocket.receive()
        except RuntimeError:  # it was closed before
            return None
        return (got.get("text") or "") if got["type"] == "websocket.receive" else None

    async def send(self, text: str) -> None:
        """Send a message; raises OSError when nobody is there any more."""
        try:
            await self._websocket.send({"type": "websocket.send", "text": text})
        except (RuntimeError, WebSocketDisconnect) as error:
            raise OSError("the socket is closed") from error

    async def close(self, code: int, reason: str) -> None:
        """End the connection; harmless when it has ended."""
        try:
            await self._websocket.close(code, reason[:100])
        except (RuntimeError, WebSocketDisconnect, OSError):
            return
