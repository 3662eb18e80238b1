"""Requests to a server: one connection that is kept, TLS, retries of what may be asked twice."""

from __future__ import annotations

import gzip
import http.client
import ssl
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlencode, urlsplit

import msgspec

from amberbox import __version__
from amberbox.client.errors import UnreachableError, refused
from amberbox.core.errors import AmberboxError

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
class Reply:
    """An answer that is no error; ``headers`` have lower-case names."""

    status: int
    headers: Mapping[str, str]
    body: bytes


@dataclass
class Wire:
    """Speaks HTTP with one server. Threads may share it; they take turns."""

    url: str
    token: str = field(default="", repr=False)
    context: ssl.SSLContext | None = None
    timeout_s: float = TIMEOUT_S
    headers: dict[str, str] = field(default_factory=dict, repr=False)
    """What every request has besides."""
    _kept: http.client.HTTPConnection | None = field(default=None, repr=False)
    _used_s: float = field(default=0.0, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def get(self, path: str, query: Query | None = None) -> Reply:
        """Ask; asked again when the server does not answer or is busy.

        Raises UnreachableError, and what the server says (see ``errors.refused``).
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

    def send(self, method: str, path: str, body: Any = None) -> Reply:
        """Change something, once."""
        data = None if body is None else msgspec.json.encode(body)
        try:
            return self._checked(self._once(method, f"{API}{path}", data))
        except (OSError, http.client.HTTPException) as error:
            raise self._unreachable(error) from error

    @contextmanager
    def stream(self, path: str, start: int) -> Iterator[http.client.HTTPResponse]:
        """Open a file from a position on, over a connection of its own."""
        connection = self._connection()
        headers = self._headers() | ({"Range": f"bytes={start}-"} if start else {})
        headers["Accept-Encoding"] = "identity"
        try:
            connection.request("GET", f"{self._base}{API}{path}", headers=headers)
            answer = connection.getresponse()
            if answer.status not in (200, 206):
                raise refused(answer.status, answer.read(), self.url)
            yield answer
        except (OSError, http.client.HTTPException) as error:
            raise self._unreachable(error) from error
        finally:
            connection.close()

    def close(self) -> None:
        """Let the connection go."""
        with self._lock:
            self._drop()

    @property
    def _base(self) -> str:
        return urlsplit(self.url).path

    def _once(self, method: str, target: str, data: bytes | None) -> Reply:
        headers = self._headers()
        if data is not None:
            headers["Content-Type"] = "application/json"
        with self._lock:
            connection = self._ready()
            try:
                connection.request(method, self._base + target, data, headers)
                answer = connection.getresponse()
                found = Reply(
                    answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
                )
            except BaseException:
                self._drop()
                raise
            self._used_s = time.monotonic()
        return _unpacked(found)

    def _headers(self) -> dict[str, str]:
        headers = {"User-Agent": f"amberbox/{__version__}", "Accept-Encoding": "gzip"}
        headers |= self.headers
        if self.token:
            headers["Authorization"] = f"Bearer {self.token}"
        return headers

    def _ready(self) -> http.client.HTTPConnection:
        if self._kept is not None and time.monotonic() - self._used_s > _FRESH_S:
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

    def _checked(self, reply: Reply) -> Reply:
        if 200 <= reply.status < 300:
            return reply
        raise refused(reply.status, reply.body, self.url)

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


def _query(query: Query) -> str:
    """Write parameters; None and empty ones are left out, lists are said again and again."""
    said = {key: _text(value) for key, value in query.items() if value not in (None, "", [])}
    return f"?{urlencode(said, doseq=True)}" if said else ""


def _text(value: Any) -> Any:
    return str(value).lower() if isinstance(value, bool) else value


def _unpacked(reply: Reply) -> Reply:
    if reply.headers.get("content-encoding") != "gzip":
        return reply
    return Reply(reply.status, reply.headers, gzip.decompress(reply.body))


def _is_hopeless(error: Exception) -> bool:
    """Tell whether asking again at once makes no sense: nobody listens there, or it is another."""
    return isinstance(error, ssl.SSLError | ConnectionRefusedError) or (
        type(error).__name__ == "gaierror"
    )


def _wait_s(reply: Reply) -> float:
    try:
        return min(float(reply.headers.get("retry-after", "0")), _MOST_WAIT_S)
    except ValueError:  # a date
        return _MOST_WAIT_S
