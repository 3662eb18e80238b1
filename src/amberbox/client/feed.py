"""The feed of a server's changes, for programs; needs the package websockets."""

from __future__ import annotations

import ssl
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from amberbox.client.errors import NotAllowedError, NotSignedInError, UnreachableError, refused
from amberbox.client.models import Answer
from amberbox.client.wire import API, Wire
from amberbox.core.errors import UsageError

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection
    from websockets.sync.connection import Connection

_ENDED, _NOT_ALLOWED, _NOT_UNDERSTOOD = 4401, 4403, 4400
_PAUSES_S = (0.5, 1.0, 2.0, 5.0, 10.0)
_MOST_BYTES = 64 << 20


class Change(Answer, frozen=True):
    """What changed: ``kind`` says what ``data`` is (docs/server_state.md)."""

    number: int
    kind: str
    robot: str = ""
    data: Any = None


def follow(
    wire: Wire, robots: Sequence[str] | None = None, kinds: Sequence[str] | None = None,
    live: Mapping[str, Sequence[str]] | None = None,
) -> Iterator[Change]:  # fmt: skip
    """Yield changes, a snapshot first; go on after a lost connection where it ended.

    Raises NotSignedInError or NotAllowedError when the server says so, UsageError without the
    package or for what it does not understand, UnreachableError when it is not there at first.
    """
    wanted: dict[str, Any] = {"robots": robots, "kinds": kinds, "live": live or {}}
    number: int | None = None
    attempt = 0
    while True:
        try:
            with _connected(wire) as socket:
                socket.send(msgspec.json.encode({**wanted, "resume": number}).decode())
                attempt = 0
                for change in _changes(wire, socket):
                    number = change.number
                    yield change
        except UnreachableError:
            if number is None:
                raise
        time.sleep(_PAUSES_S[min(attempt, len(_PAUSES_S) - 1)])
        attempt += 1


def _changes(wire: Wire, socket: Connection) -> Iterator[Change]:
    """Yield what comes until the connection ends."""
    from websockets.exceptions import ConnectionClosed

    try:
        for message in socket:
            yield from msgspec.json.decode(message, type=list[Change])
    except ConnectionClosed as closed:
        _raise_for(wire, closed.rcvd.code if closed.rcvd else 0,
                   closed.rcvd.reason if closed.rcvd else "")  # fmt: skip
    else:
        _raise_for(wire, socket.close_code or 0, socket.close_reason or "")


def _raise_for(wire: Wire, code: int, reason: str) -> None:
    if code == _ENDED:
        raise NotSignedInError(f"{wire.url}: the token has ended", f"amberbox sign-in {wire.url}")
    if code == _NOT_ALLOWED:
        raise NotAllowedError(f"{wire.url}: this is not allowed any more")
    if code == _NOT_UNDERSTOOD:
        raise UsageError(f"{wire.url}: {reason or 'what was asked is not understood'}")


def _connected(wire: Wire) -> ClientConnection:
    try:
        from websockets.exceptions import InvalidStatus
        from websockets.sync.client import connect
    except ImportError:
        raise UsageError("the feed needs the package websockets", "pip install 'amberbox[link]'") \
            from None  # fmt: skip
    address = f"ws{wire.url.removeprefix('http')}{API}/feed"
    context = wire.context
    if address.startswith("wss") and context is None:
        context = ssl.create_default_context()
    try:
        return connect(
            address, ssl=context, additional_headers={"Authorization": f"Bearer {wire.token}"},
            proxy=None, max_size=_MOST_BYTES, open_timeout=wire.timeout_s,
        )  # fmt: skip
    except InvalidStatus as error:
        answer = error.response
        raise refused(answer.status_code, answer.body or b"", wire.url) from error
    except OSError as error:
        why = error.strerror or str(error)
        raise UnreachableError(f"{wire.url} does not answer: {why}") from error
