"""Connections to the server: the WebSocket of the link."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Awaitable
from typing import Any, Protocol
from urllib.parse import urlsplit, urlunsplit

from amberbox.link import limits
from amberbox.link.frames import Bye, Hello, Welcome, encode, from_server
from amberbox.link.refusals import why_unavailable
from amberbox.robot.link.options import LinkOptions

_OPEN_S = 10.0
_SCHEMES = {"https": "wss", "http": "ws", "wss": "wss", "ws": "ws"}


class LinkDownError(Exception):
    """There is no connection, or no longer; trying again may help."""


class RefusedError(LinkDownError):
    """The server is there and does not want this robot."""


class Line(Protocol):
    """One connection to the server; frames are whole binary messages."""

    async def receive(self) -> bytes:
        """Wait for the next frame; raises LinkDownError at the end."""

    async def send(self, data: bytes) -> None:
        """Send a frame; raises LinkDownError when nobody is there any more."""

    async def close(self) -> None:
        """End the connection."""


class _WebSocketLine:
    def __init__(self, connection: Any) -> None:
        self._connection = connection

    async def receive(self) -> bytes:
        from websockets.exceptions import ConnectionClosed

        try:
            data = await self._connection.recv()
        except (ConnectionClosed, OSError) as error:
            raise LinkDownError(str(error)) from error
        return data if isinstance(data, bytes) else b""

    async def send(self, data: bytes) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            await self._connection.send(data)
        except (ConnectionClosed, OSError) as error:
            raise LinkDownError(str(error)) from error

    async def close(self) -> None:
        await self._connection.close()


def socket_url(url: str) -> str:
    """Return the address of the link's socket on a server."""
    parts = urlsplit(url)
    return urlunsplit((_SCHEMES[parts.scheme], parts.netloc, parts.path.rstrip("/") + limits.PATH,
                       "", ""))  # fmt: skip


def authorization(options: LinkOptions) -> dict[str, str]:
    """Return the header by which the server knows the robot."""
    return {"Authorization": f"Robot {options.robot}:{options.key}"}


async def dial(options: LinkOptions, context: ssl.SSLContext | None) -> Line:
    """Connect to the server.

    Raises RefusedError when it does not let the robot in, LinkDownError when there is no way.
    """
    from websockets.asyncio.client import connect
    from websockets.exceptions import InvalidStatus, WebSocketException

    try:
        return _WebSocketLine(
            await connect(
                socket_url(options.url), ssl=context, additional_headers=authorization(options),
                compression=None, max_size=limits.FRAME_BYTES, ping_interval=None,
                open_timeout=_OPEN_S, close_timeout=1.0,
            )
        )  # fmt: skip
    except InvalidStatus as error:
        status = error.response.status_code
        if status in (401, 403):
            raise RefusedError(f"the server refuses this robot's key ({status})") from error
        why = f": {why_unavailable(bytes(error.response.body or b''))}" if status == 503 else ""
        raise LinkDownError(f"the server answers {status}{why}") from error
    except (OSError, WebSocketException, TimeoutError) as error:
        raise LinkDownError(f"no connection: {error}") from error


async def greet(line: Line, hello: Hello) -> Welcome:
    """Say hello, and return the server's welcome.

    Raises RefusedError when the server sends the robot away for good, LinkDownError when it does
    so for now, says something else, or nothing for too long; FrameError for what is no frame.
    """
    await line.send(encode(hello))
    answer = from_server(await _soon(line.receive()))
    if isinstance(answer, Bye):
        raise (RefusedError if answer.for_good else LinkDownError)(answer.reason)
    if not isinstance(answer, Welcome):
        raise LinkDownError("the server did not say welcome")
    return answer


async def _soon(waiting: Awaitable[bytes]) -> bytes:
    """Wait for an answer; raises LinkDownError when none comes for too long."""
    try:
        async with asyncio.timeout(limits.SILENT_S):
            return await waiting
    except TimeoutError:
        raise LinkDownError(f"nothing was heard for {limits.SILENT_S:g} s") from None
