"""What went wrong in a page: errors on the console, requests that failed or left the site."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import ConsoleMessage, Page, Request, Response

RESTART: Sequence[str] = (
    "WebSocket connection to", "ERR_CONNECTION_REFUSED", "ERR_CONNECTION_RESET",
    "ERR_EMPTY_RESPONSE", "ERR_INCOMPLETE_CHUNKED_ENCODING",
)  # fmt: skip
"""What a page's console may say while its server is restarted: give it as ``expects``."""
_OWN = ("data:", "blob:", "about:")


@dataclass
class Watched:
    """A page and its troubles, one line each; those with a word of ``expects`` in them are none."""

    page: Page
    url: str
    expects: Sequence[str] = ()
    heard: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.page.on("console", self._console)
        self.page.on("pageerror", lambda error: self.heard.append(f"page error: {error}"))
        self.page.on("request", lambda request: self._left(request.url))
        self.page.on("websocket", lambda socket: self._left(socket.url.replace("ws", "http", 1)))
        self.page.on("response", self._answered)
        self.page.on("requestfailed", self._failed)

    @property
    def troubles(self) -> list[str]:
        """Return what went wrong and was not expected."""
        return [one for one in self.heard if not any(word in one for word in self.expects)]

    def _console(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            where = message.location.get("url", "")
            self.heard.append(f"console: {message.text} ({where})")

    def _left(self, url: str) -> None:
        if not url.startswith((f"{self.url}/", *_OWN)):
            self.heard.append(f"asked another host: {url}")

    def _answered(self, response: Response) -> None:
        if response.status >= 400:
            self.heard.append(f"{response.status} {response.request.method} {response.url}")

    def _failed(self, request: Request) -> None:
        why = request.failure or ""
        if "ERR_ABORTED" not in why:  # who goes to another page lets go of what still comes
            self.heard.append(f"failed: {request.method} {request.url}: {why}")
