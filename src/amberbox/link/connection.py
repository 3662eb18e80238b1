"""A robot's connection to its server: options of the link, pinned TLS, and the WebSocket."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Awaitable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit, urlunsplit

from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.blackbox.robot_folder.robot_yaml import KEY_FILE, read_key
from amberbox.core.errors import UsageError
from amberbox.core.files import replace_file
from amberbox.core.tls import fetch_ca, fingerprint, normal_fingerprint, pinned_context
from amberbox.link import limits
from amberbox.link.frames import Bye, Hello, Welcome, encode, from_server
from amberbox.link.limits import why_unavailable

_JOIN = "amberbox join {path} LINE, with the line that 'amberbox serve add-robot' prints"


@dataclass(frozen=True, slots=True)
class LinkOptions:
    """Options of the link; ``rate`` in bytes/s, 0 for no limit.

    ``ca`` is the SHA-256 fingerprint of the server's certificate authority (hex); without one the
    system's authorities are trusted. ``metered`` are name patterns of networks that cost money.
    """

    url: str
    robot: str
    key: str
    ca: str = ""
    rate: float = 0.0
    copy: str = "always"
    metered: Sequence[str] = ()
    metered_statuses: bool = True
    config_hash: str = ""
    docked: str = ""
    live: bool = True


def link_options(folder: RobotFolder) -> LinkOptions:
    """Read the options of the link from a robot folder.

    Raises UsageError when it names no server, or holds no key to it.
    """
    server = folder.robot.server
    if server is None:
        raise UsageError(f"{folder.path} names no server", _JOIN.format(path=folder.path))
    key = read_key(folder.path, server)
    if not key:
        place = folder.path / KEY_FILE
        raise UsageError(f"there is no key in {place}", _JOIN.format(path=folder.path))
    return LinkOptions(
        server.url, folder.robot.id, key, server.ca, server.rate, server.copy, server.metered,
        server.metered_sends == "statuses", folder.config_hash, server.docked, server.live,
    )  # fmt: skip


CA_FILE = "server-ca.pem"


def tls_context(url: str, pin: str, store: Path) -> ssl.SSLContext | None:
    """Return the TLS context for a server; None for one without TLS.

    A pinned authority's certificate is fetched once, verified by its fingerprint, and kept in the
    store. Raises PinError, and OSError while the server cannot be reached.
    """
    if urlsplit(url).scheme not in ("https", "wss"):
        return None
    if not pin:
        return ssl.create_default_context()
    kept = store / CA_FILE
    if kept.exists() and _fits(kept.read_bytes(), pin):
        return pinned_context(kept.read_bytes(), pin)
    pem = fetch_ca(url)
    context = pinned_context(pem, pin)
    replace_file(kept, pem.decode("ascii"))
    return context


def _fits(pem: bytes, pin: str) -> bool:
    try:
        return fingerprint(pem) == normal_fingerprint(pin)
    except ValueError:
        return False


_OPEN_S = 10.0
_SCHEMES = {"https": "wss", "http": "ws", "wss": "wss", "ws": "ws"}


class LinkDownError(Exception):
    """There is no connection, or it was lost; trying again may help."""


class LinkRefusedError(LinkDownError):
    """The server refuses this robot."""


class LinkConnection(Protocol):
    """One connection to the server; frames are whole binary messages."""

    async def receive(self) -> bytes:
        """Wait for the next frame; raises LinkDownError at the end."""

    async def send(self, data: bytes) -> None:
        """Send a frame; raises LinkDownError when the connection has ended."""

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
    """Return the URL of the link's WebSocket on a server."""
    parts = urlsplit(url)
    return urlunsplit((_SCHEMES[parts.scheme], parts.netloc, parts.path.rstrip("/") + limits.PATH,
                       "", ""))  # fmt: skip


def authorization(options: LinkOptions) -> dict[str, str]:
    """Return the header that authenticates the robot."""
    return {"Authorization": f"Robot {options.robot}:{options.key}"}


async def dial(options: LinkOptions, context: ssl.SSLContext | None) -> LinkConnection:
    """Connect to the server.

    Raises LinkRefusedError when it refuses the robot, LinkDownError when it cannot be reached.
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
            raise LinkRefusedError(f"the server refuses this robot's key ({status})") from error
        why = f": {why_unavailable(bytes(error.response.body or b''))}" if status == 503 else ""
        raise LinkDownError(f"the server answers {status}{why}") from error
    except (OSError, WebSocketException, TimeoutError) as error:
        raise LinkDownError(f"no connection: {error}") from error


async def greet(line: LinkConnection, hello: Hello) -> Welcome:
    """Send Hello and return the server's welcome.

    Raises LinkRefusedError when the server refuses the robot permanently, LinkDownError when it
    does so temporarily, or sends another frame or none in time; FrameError for invalid data.
    """
    await line.send(encode(hello))
    answer = from_server(await _soon(line.receive()))
    if isinstance(answer, Bye):
        raise (LinkRefusedError if answer.for_good else LinkDownError)(answer.reason)
    if not isinstance(answer, Welcome):
        raise LinkDownError("the server did not say welcome")
    return answer


async def _soon(waiting: Awaitable[bytes]) -> bytes:
    """Wait for an answer; raises LinkDownError when none arrives in time."""
    try:
        async with asyncio.timeout(limits.SILENT_S):
            return await waiting
    except TimeoutError:
        raise LinkDownError(f"nothing was heard for {limits.SILENT_S:g} s") from None
