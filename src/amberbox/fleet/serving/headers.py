"""Headers that every answer has: what a browser may do with it."""

from __future__ import annotations

from amberbox.fleet.serving.asgi import ASGIApp, Message, Pairs, Receive, Scope, Send
from amberbox.fleet.serving.settings import Settings

_POLICY = (
    "default-src 'self'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
_ALWAYS: Pairs = (
    (b"content-security-policy", _POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"permissions-policy", b"camera=(), geolocation=(), microphone=(), payment=(), usb=()"),
)
_SECURE: Pairs = ((b"strict-transport-security", b"max-age=31536000"),)
_NO_STORE: Pairs = ((b"cache-control", b"no-store"),)
_PRIVATE = ("/api/", "/link/", "/setup")


class SecurityHeaders:
    """Adds headers to every answer; one that the app has set itself stays."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._always = (*_ALWAYS, *(_SECURE if settings.is_secure else ()))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and its answer back with the headers."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        private = scope["path"].startswith(_PRIVATE)
        added = (*self._always, *(_NO_STORE if private else ()))

        async def answer(message: Message) -> None:
            if message["type"].endswith("http.response.start"):
                own = list(message.get("headers", ()))
                known = {name.lower() for name, _ in own}
                message["headers"] = [*own, *(one for one in added if one[0] not in known)]
            await send(message)

        await self._app(scope, receive, answer)
