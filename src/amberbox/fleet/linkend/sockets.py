"""What the link needs of a WebSocket, and how the server's own sockets give it."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Any, Protocol

_CLOSE_S = 2.0
"""One who takes nothing any more would have us wait for ever."""


class SocketClosedError(Exception):
    """The other side has closed, or the network has."""


class Socket(Protocol):
    """One WebSocket, accepted; frames are whole binary messages."""

    async def receive(self) -> bytes:
        """Wait for the next message; raises SocketClosedError at the end."""

    async def send(self, data: bytes) -> None:
        """Send a message; raises SocketClosedError when nobody is there any more."""

    async def close(self) -> None:
        """End the connection; harmless when it has ended."""


class StarletteSocket:
    """An accepted ``WebSocket`` of Starlette or FastAPI."""

    def __init__(self, websocket: Any) -> None:
        self._websocket = websocket

    async def receive(self) -> bytes:
        """Wait for the next message; text is none of ours."""
        try:
            message = await self._websocket.receive()
        except RuntimeError as error:  # it was closed before
            raise SocketClosedError(str(error)) from error
        if message["type"] != "websocket.receive":
            raise SocketClosedError(f"closed with {message.get('code')}")
        return message.get("bytes") or b""

    async def send(self, data: bytes) -> None:
        """Send a message."""
        from starlette.websockets import WebSocketDisconnect

        try:
            await self._websocket.send_bytes(data)
        except (RuntimeError, WebSocketDisconnect, OSError) as error:
            raise SocketClosedError(str(error)) from error

    async def close(self) -> None:
        """End the connection."""
        with suppress(Exception):  # closed already, or the network gone: each server's own error
            async with asyncio.timeout(_CLOSE_S):
                await self._websocket.close()
