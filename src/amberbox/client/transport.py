"""Requests to a server over one persistent connection: TLS, retries, typed errors, the feed."""

from __future__ import annotations

import gzip
import http.client
import select
import ssl
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode, urlsplit

import msgspec

from amberbox.client.models import Answer
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.version import __version__


class UnreachableError(AmberboxError):
    """The server does not answer."""


class NotSignedInError(AmberboxError):
    """There is no token for this server, or it is not valid (any more)."""

    exit_code = UsageError.exit_code


class NotAllowedError(AmberboxError):
    """The token is valid, but not for this action."""

    exit_code = UsageError.exit_code


class ConflictError(AmberboxError):
    """The object was changed since it was read."""


class _ServerError(msgspec.Struct):
    what: str = ""
    hint: str = ""


class _Body(msgspec.Struct):
    error: _ServerError


def error_of(status: int, body: bytes, url: str) -> AmberboxError:
    """Return the exception for a server's error answer, with its address."""
    stated = error_in(body) or _ServerError(f"it answered with status {status}")
    what = f"{url}: {stated.what}"
    if status == 401:
        return NotSignedInError(what, stated.hint or f"amberbox sign-in {url}")
    if status == 403:
        hint = "who made the token can make one with more scopes, or with a higher role"
        return NotAllowedError(what, stated.hint or hint)
    if status == 409:
        return ConflictError(what, stated.hint or "look again, then decide")
    if status in (400, 404):
        return UsageError(what, stated.hint)
    return AmberboxError(what, stated.hint)


def error_in(body: bytes) -> _ServerError | None:
    try:
        return msgspec.json.decode(body, type=_Body).error
    except msgspec.MsgspecError:
        return None


API = "/api/v1"
TIMEOUT_S = 60.0
"""Questions take a server 20 s at most, and may have to wait for others."""
_FRESH_S = 2.0
"""A connection that was idle for longer may be closed by the server at any moment."""
_PAUSES_S = (0.2, 1.0)
_MOST_WAIT_S = 10.0
_BUSY = (429, 503)

Query = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class ApiReply:
    """A successful answer; ``headers`` have lower-case names."""

    status: int
    headers: Mapping[str, str]
    body: bytes


@dataclass
class ApiConnection:
    """An HTTP connection to one server. Threads may share it; requests run one at a time."""

    url: str
    token: str = field(default="", repr=False)
    context: ssl.SSLContext | None = None
    timeout_s: float = TIMEOUT_S
    headers: dict[str, str] = field(default_factory=dict, repr=False)
    """What every request has besides."""
    _kept: http.client.HTTPConnection | None = field(default=None, repr=False)
    _used_s: float = field(default=0.0, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def get(self, path: str, query: Query | None = None) -> ApiReply:
        """Send a GET request; repeat it when the server does not answer or is busy.

        Raises UnreachableError, and the errors of ``error_of``.
        """
        target = f"{API}{path}{_query(query or {})}"
        for pause_s in (*_PAUSES_S, None):
            try:
                reply = self._once("GET", target, None)
            except (OSError, http.client.HTTPException) as error:
                if pause_s is None or _is_hopeless(error):
                    raise self._unreachable(error) from error
                time.sleep(pause_s)
                continue
            if reply.status not in _BUSY or pause_s is None:
                return self._checked(reply)
            time.sleep(max(pause_s, _wait_s(reply)))
        raise AssertionError("the last attempt returns or raises")

    def send(self, method: str, path: str, body: Any = None) -> ApiReply:
        """Send a request that changes something; it is never repeated."""
        data = None if body is None else msgspec.json.encode(body)
        try:
            return self._checked(self._once(method, f"{API}{path}", data))
        except (OSError, http.client.HTTPException) as error:
            raise self._unreachable(error) from error

    @contextmanager
    def stream(self, path: str, start: int) -> Iterator[http.client.HTTPResponse]:
        """Open a file from byte ``start`` on, over a separate connection."""
        connection = self._connection()
        headers = self._headers() | ({"Range": f"bytes={start}-"} if start else {})
        headers["Accept-Encoding"] = "identity"
        try:
            connection.request("GET", f"{self._base}{API}{path}", headers=headers)
            answer = connection.getresponse()
            if answer.status not in (200, 206):
                raise error_of(answer.status, answer.read(), self.url)
            yield answer
        except (OSError, http.client.HTTPException) as error:
            raise self._unreachable(error) from error
        finally:
            connection.close()

    def close(self) -> None:
        """Close the connection."""
        with self._lock:
            self._drop()

    @property
    def _base(self) -> str:
        return urlsplit(self.url).path

    def _once(self, method: str, target: str, data: bytes | None) -> ApiReply:
        headers = self._headers()
        if data is not None:
            headers["Content-Type"] = "application/json"
        with self._lock:
            connection = self._ready()
            try:
                connection.request(method, self._base + target, data, headers)
                answer = connection.getresponse()
                found = ApiReply(
                    answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
                )
            except BaseException:
                self._drop()
                raise
            self._used_s = time.monotonic()
        if found.headers.get("content-encoding") != "gzip":
            return found
        return ApiReply(found.status, found.headers, gzip.decompress(found.body))

    def _headers(self) -> dict[str, str]:
        headers = {"User-Agent": f"amberbox/{__version__}", "Accept-Encoding": "gzip"}
        headers |= self.headers
        if self.token:
            headers["Authorization"] = f"Bearer {self.token}"
        return headers

    def _ready(self) -> http.client.HTTPConnection:
        if self._kept is not None and (
            time.monotonic() - self._used_s > _FRESH_S or _has_ended(self._kept)
        ):
            self._drop()
        if self._kept is None:
            self._kept = self._connection()
        return self._kept

    def _connection(self) -> http.client.HTTPConnection:
        parts = urlsplit(self.url)
        host = parts.hostname or ""
        if parts.scheme == "http":
            return http.client.HTTPConnection(host, parts.port, timeout=self.timeout_s)
        context = self.context or ssl.create_default_context()
        return http.client.HTTPSConnection(
            host, parts.port, timeout=self.timeout_s, context=context
        )

    def _drop(self) -> None:
        if self._kept is not None:
            self._kept.close()
        self._kept = None

    def _checked(self, reply: ApiReply) -> ApiReply:
        if 200 <= reply.status < 300:
            return reply
        raise error_of(reply.status, reply.body, self.url)

    def _unreachable(self, error: Exception) -> AmberboxError:
        if isinstance(error, ssl.SSLCertVerificationError):
            return UnreachableError(
                f"{self.url}: its certificate is not trusted: {error.verify_message}",
                f"amberbox sign-in {self.url}#ca=sha256:... with the fingerprint that "
                "'amberbox serve cert' printed",
            )  # fmt: skip
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        if isinstance(error, TimeoutError):
            why = f"nothing came for {self.timeout_s:g} s"
        return UnreachableError(
            f"{self.url} does not answer: {why}", "is the address right, and does the server run?"
        )


def _has_ended(kept: http.client.HTTPConnection) -> bool:
    """Return whether the server has closed an idle connection, on which nothing else arrives."""
    if kept.sock is None or kept.sock.fileno() < 0:
        return kept.sock is not None
    poll = select.poll()
    poll.register(kept.sock, select.POLLIN)
    return bool(poll.poll(0))


def _query(query: Query) -> str:
    """Return the query string; None and empty values are left out, lists repeat their key."""
    given = {key: _text(value) for key, value in query.items() if value not in (None, "", [])}
    return f"?{urlencode(given, doseq=True)}" if given else ""


def _text(value: Any) -> Any:
    return str(value).lower() if isinstance(value, bool) else value


def _is_hopeless(error: Exception) -> bool:
    """Return whether a retry makes no sense: connection refused, unknown host, or TLS failure."""
    return isinstance(error, ssl.SSLError | ConnectionRefusedError) or (
        type(error).__name__ == "gaierror"
    )


def _wait_s(reply: ApiReply) -> float:
    try:
        return min(float(reply.headers.get("retry-after", "0")), _MOST_WAIT_S)
    except ValueError:  # an HTTP date
        return _MOST_WAIT_S


if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection
    from websockets.sync.connection import Connection

_ENDED, _NOT_ALLOWED, _NOT_UNDERSTOOD = 4401, 4403, 4400
_RECONNECT_PAUSES_S = (0.5, 1.0, 2.0, 5.0, 10.0)
_MOST_BYTES = 64 << 20


class Change(Answer, frozen=True):
    """A change from the feed: ``kind`` determines what ``data`` is (docs/server/state.md)."""

    number: int
    kind: str
    robot: str = ""
    data: Any = None


def follow(
    wire: ApiConnection, robots: Sequence[str] | None = None, kinds: Sequence[str] | None = None,
    live: Mapping[str, Sequence[str]] | None = None,
) -> Iterator[Change]:  # fmt: skip
    """Yield changes, a snapshot first; resume after a lost connection.

    Raises NotSignedInError or NotAllowedError when the server refuses, UsageError without the
    package websockets or for an invalid request, UnreachableError if the first connection fails,
    also when it is tried again.
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
            if number is None and attempt:
                raise
        time.sleep(_RECONNECT_PAUSES_S[min(attempt, len(_RECONNECT_PAUSES_S) - 1)])
        attempt += 1


def _changes(wire: ApiConnection, socket: Connection) -> Iterator[Change]:
    """Yield changes until the connection ends."""
    from websockets.exceptions import ConnectionClosed

    try:
        for message in socket:
            yield from msgspec.json.decode(message, type=list[Change])
    except ConnectionClosed as closed:
        _raise_for(wire, closed.rcvd.code if closed.rcvd else 0,
                   closed.rcvd.reason if closed.rcvd else "")  # fmt: skip
    else:
        _raise_for(wire, socket.close_code or 0, socket.close_reason or "")


def _raise_for(wire: ApiConnection, code: int, reason: str) -> None:
    if code == _ENDED:
        raise NotSignedInError(f"{wire.url}: the token has ended", f"amberbox sign-in {wire.url}")
    if code == _NOT_ALLOWED:
        raise NotAllowedError(f"{wire.url}: this is not allowed any more")
    if code == _NOT_UNDERSTOOD:
        raise UsageError(f"{wire.url}: {reason or 'what was asked is not understood'}")


def _connected(wire: ApiConnection) -> ClientConnection:
    try:
        from websockets.exceptions import InvalidHandshake, InvalidStatus
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
        raise error_of(answer.status_code, answer.body or b"", wire.url) from error
    except (OSError, InvalidHandshake) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise UnreachableError(f"{wire.url} does not answer: {why}") from error
