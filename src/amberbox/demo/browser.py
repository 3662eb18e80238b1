"""Asks the server as a browser does: pages, the API with a session's cookie, and the feed."""

from __future__ import annotations

import http.client
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from amberbox.core.errors import AmberboxError
from amberbox.fleet.api.access import PREFIX
from amberbox.fleet.api.who import COOKIE, CSRF_HEADER

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

_TIMEOUT_S = 30.0
_MOST_BYTES = 64 << 20
_NOT_HERE = 400
"""The answer about an item that no journal had so far."""


@dataclass(frozen=True, slots=True)
class Reply:
    """An answer; ``headers`` have lower-case names."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def value(self) -> Any:
        """Return the JSON of it."""
        return json.loads(self.body)


@dataclass
class Browser:
    """One person's browser; ``url`` is the server's address, without a slash at the end."""

    url: str
    _cookie: str = field(default="", repr=False)
    _csrf: str = field(default="", repr=False)

    def page(self, path: str) -> Reply:
        """Open an address of the server, whatever comes of it."""
        return self._once("GET", path, None)

    def sign_in(self, code: str) -> Reply:
        """Use a one-time code, as its page does."""
        reply = self._once("POST", f"{PREFIX}/session/code", {"code": code})
        for part in reply.headers.get("set-cookie", "").split(";"):
            name, _, value = part.strip().partition("=")
            if name == COOKIE:
                self._cookie, self._csrf = value, reply.value["csrf"]
        return reply

    def get(self, path: str) -> Any:
        """Ask the API; raises AmberboxError for any answer but 200."""
        return self._checked("GET", path, None).value

    def get_data(self, path: str) -> Any:
        """Ask the API for data; None while no journal that has them has come."""
        reply = self.page(PREFIX + path)
        return None if reply.status == _NOT_HERE else _of(reply, "GET", path).value

    def send(self, method: str, path: str, body: Any = None) -> Any:
        """Change something; raises AmberboxError when it is refused."""
        reply = self._checked(method, path, body)
        return reply.value if reply.body else None

    def fetch(self, path: str) -> bytes:
        """Download a file."""
        return self._checked("GET", path, None).body

    def feed(self) -> ClientConnection:
        """Open the feed of changes, and listen to all of them."""
        from websockets.sync.client import connect

        socket = connect(
            f"ws{self.url.removeprefix('http')}{PREFIX}/feed", origin=self.url,  # type: ignore[arg-type]  # a NewType of str
            additional_headers={"Cookie": f"{COOKIE}={self._cookie}"},
            proxy=None, max_size=_MOST_BYTES, open_timeout=_TIMEOUT_S,
        )  # fmt: skip
        socket.send(json.dumps({"robots": None, "kinds": None, "live": {}, "resume": None}))
        return socket

    def _checked(self, method: str, path: str, body: Any) -> Reply:
        return _of(self._once(method, PREFIX + path, body), method, path)

    def _once(self, method: str, target: str, body: Any) -> Reply:
        headers = {"Origin": self.url, "Cookie": f"{COOKIE}={self._cookie}" if self._cookie else ""}
        data = None
        if body is not None:
            data, headers["Content-Type"] = json.dumps(body), "application/json"
        if method != "GET" and self._csrf:
            headers[CSRF_HEADER] = self._csrf
        connection = http.client.HTTPConnection(urlsplit(self.url).netloc, timeout=_TIMEOUT_S)
        try:
            connection.request(method, target, data, headers)
            answer = connection.getresponse()
            known = {name.lower(): value for name, value in answer.getheaders()}
            return Reply(answer.status, known, answer.read())
        except (OSError, http.client.HTTPException) as error:
            raise AmberboxError(f"{self.url} does not answer: {error}") from error
        finally:
            connection.close()


def _of(reply: Reply, method: str, path: str) -> Reply:
    """Return an answer; raises AmberboxError when it is a refusal."""
    if reply.status >= 300:
        what = reply.body.decode("utf-8", "replace")[:300]
        raise AmberboxError(f"{method} {path} answered {reply.status}: {what}")
    return reply
