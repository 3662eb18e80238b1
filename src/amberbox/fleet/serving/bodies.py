"""Bodies of requests: not too large, and not too slow."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass

from starlette.exceptions import HTTPException

from amberbox.fleet.serving.asgi import (
    ASGIApp,
    Message,
    Receive,
    Scope,
    Send,
    headers_of,
    refuse,
)
from amberbox.link import limits
from amberbox.link.folders import PACKED_BYTES
from amberbox.link.uploads import PROOF_BYTES


@dataclass(frozen=True, slots=True)
class Limit:
    """Most bytes of a body, and how long it may take: between two pieces, and in all (s)."""

    most: int = 1 << 20
    pause_s: float = 10.0
    whole_s: float = 30.0


USUAL = Limit()
_ROBOTS_S = 20.0, 600.0
LIMITS: Mapping[tuple[str, str], Limit] = {
    ("PATCH", f"{limits.PATH}/journals/"): Limit(limits.PIECE_BYTES, *_ROBOTS_S),
    ("POST", f"{limits.PATH}/journals/"): Limit(PROOF_BYTES, *_ROBOTS_S),
    ("PUT", f"{limits.PATH}/folders/"): Limit(PACKED_BYTES, *_ROBOTS_S),
}
"""Robots send more, over networks that may be slow."""


class BodyLimits:
    """Answers 413 to bodies that are too large, 408 to those that do not come."""

    def __init__(self, app: ASGIApp, usual: Limit = USUAL) -> None:
        self._app = app
        self._usual = usual

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on with a body that is counted as it comes."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit = self._limit(scope)
        said = headers_of(scope).get("content-length", "0")
        if not _is_at_most(said, limit.most):
            what = f"a body has at most {limit.most} bytes here"
            await refuse(scope, send, 413, what, more=[(b"connection", b"close")])
            return
        await self._app(scope, _Counted(receive, limit), send)

    def _limit(self, scope: Scope) -> Limit:
        for (method, start), limit in LIMITS.items():
            if scope["method"] == method and scope["path"].startswith(start):
                return limit
        return self._usual


def _is_at_most(said: str, most: int) -> bool:
    """Compare a number as a client wrote it: with thousands of digits it is not even read."""
    digits = said.lstrip("0") or "0"
    return said.isascii() and said.isdecimal() and len(digits) < 19 and int(digits) <= most


class _Counted:
    """Gives the messages of one request; the app turns what it raises into an answer."""

    def __init__(self, receive: Receive, limit: Limit) -> None:
        self._receive = receive
        self._limit = limit
        self._size = 0
        self._is_whole = False
        self._began_s = asyncio.get_running_loop().time()

    async def __call__(self) -> Message:
        """Return the next message; waiting for the client to leave takes as long as it takes."""
        if self._is_whole:
            return await self._receive()
        passed_s = asyncio.get_running_loop().time() - self._began_s
        patience_s = min(self._limit.pause_s, self._limit.whole_s - passed_s)
        try:
            async with asyncio.timeout(max(patience_s, 0.001)):
                message = await self._receive()
        except TimeoutError:
            raise HTTPException(408, "the body did not come", {"Connection": "close"}) from None
        self._is_whole = message["type"] != "http.request" or not message.get("more_body")
        self._size += len(message.get("body", b""))
        if self._size > self._limit.most:
            what = f"a body has at most {self._limit.most} bytes here"
            raise HTTPException(413, what, {"Connection": "close"})
        return message
