"""Who may ask at all: by a name of this server, and behind a proxy only by way of it.

A page of somebody else cannot make a browser ask under our name; a name that leads to this machine
by a trick of DNS is not ours.
"""

from __future__ import annotations

from urllib.parse import urlsplit

from amberbox.fleet.serving.asgi import ASGIApp, Receive, Scope, Send, headers_of, refuse
from amberbox.fleet.serving.binding import is_local
from amberbox.fleet.serving.forwarded import is_loopback, is_trusted, read
from amberbox.fleet.serving.settings import Settings


class Hosts:
    """Lets requests through that came to this server under one of its names."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._settings = settings
        self._names = {urlsplit(settings.public_url).hostname or "", *settings.names}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer 403 to who came around the proxy, 421 to who asked for somebody else."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        peer = scope["client"][0] if scope.get("client") else ""
        if not self._came_right(peer):
            hint = f"open {self._settings.public_url}"
            await refuse(scope, send, 403, "this server is reached through its proxy", hint)
            return
        if not self._is_ours(headers_of(scope).getlist("host"), peer):
            hint = f"this one is {self._settings.public_url}"
            await refuse(scope, send, 421, "no server of this name is here", hint)
            return
        await self._app(scope, receive, send)

    def _came_right(self, peer: str) -> bool:
        if not self._settings.proxies or is_loopback(peer):
            return True
        found = read(peer)
        return found is not None and is_trusted(found, self._settings.proxies)

    def _is_ours(self, hosts: list[str], peer: str) -> bool:
        if len(hosts) != 1:
            return False
        try:
            name = urlsplit(f"//{hosts[0]}").hostname or ""
        except ValueError:
            return False
        return name in self._names or (is_local(name) and is_loopback(peer))
