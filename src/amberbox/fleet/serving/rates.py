"""How often somebody may ask: so many requests at once, then so many a second."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from amberbox.fleet.accounts.backoff import place
from amberbox.fleet.accounts.keys import digest
from amberbox.fleet.api.who import COOKIE
from amberbox.fleet.serving.asgi import (
    ASGIApp,
    Message,
    Receive,
    Scope,
    Send,
    headers_of,
    refuse,
)
from amberbox.fleet.serving.forwarded import client_address
from amberbox.fleet.serving.settings import Settings
from amberbox.link import limits


@dataclass(frozen=True, slots=True)
class Rate:
    """Requests at once, and a second."""

    burst: float
    per_s: float


ADDRESS = Rate(600, 100)
"""Many people may share one address."""
PRINCIPAL = Rate(200, 40)
STRANGERS = Rate(2000, 200)
"""Robots whose key has not worked yet, of one address: after a start all come at once."""
_MOST = 10_000
"""Buckets and keys that are remembered; the oldest go first."""


class Buckets:
    """One bucket of tokens per key, filled as time goes on."""

    def __init__(self, rate: Rate, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._rate = rate
        self._clock_s = clock_s
        self._held: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, key: str) -> float:
        """Take a token; return 0, or how many seconds to wait for one."""
        now_s = self._clock_s()
        tokens, since_s = self._held.pop(key, (self._rate.burst, now_s))
        tokens = min(self._rate.burst, tokens + (now_s - since_s) * self._rate.per_s)
        is_free = tokens >= 1.0
        self._held[key] = (tokens - 1.0 if is_free else tokens, now_s)
        while len(self._held) > _MOST:
            self._held.popitem(last=False)
        return 0.0 if is_free else (1.0 - tokens) / self._rate.per_s


class RateLimits:
    """Answers 429 to who asks too often; a robot whose key has worked is not counted."""

    def __init__(
        self, app: ASGIApp, settings: Settings, address: Rate = ADDRESS,
        principal: Rate = PRINCIPAL, strangers: Rate = STRANGERS,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self._app = app
        self._settings = settings
        self._addresses = Buckets(address, clock_s)
        self._principals = Buckets(principal, clock_s)
        self._strangers = Buckets(strangers, clock_s)
        self._working: OrderedDict[str, None] = OrderedDict()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on whose turn it is."""
        is_robot = scope["type"] != "lifespan" and _is_robot(scope)
        wait_s = 0.0 if scope["type"] == "lifespan" else self._wait_s(scope, is_robot)
        if wait_s > 0.0:
            after = str(math.ceil(wait_s)).encode()
            await refuse(scope, send, 429, "too many requests", "ask less often",
                         [(b"retry-after", after)])  # fmt: skip
            return
        await self._app(scope, receive, self._learning(scope, send) if is_robot else send)

    def _wait_s(self, scope: Scope, is_robot: bool) -> float:
        headers = headers_of(scope)
        peer = scope["client"][0] if scope.get("client") else ""
        forwarded = headers.getlist("x-forwarded-for")
        address = client_address(peer, forwarded, self._settings.proxies)
        secret = headers.get("authorization", "") or _session(headers.get("cookie", ""))
        if is_robot:
            known = digest(secret) in self._working
            return 0.0 if known else self._strangers.take(place(address))
        wait_s = self._addresses.take(place(address))
        return wait_s or (self._principals.take(digest(secret)) if secret else 0.0)

    def _learning(self, scope: Scope, send: Send) -> Send:
        """Note from the answer whether the robot's key works: anybody can say that he is one."""
        key = digest(headers_of(scope).get("authorization", ""))

        async def answer(message: Message) -> None:
            if message["type"].endswith(("http.response.start", "websocket.accept")):
                status = message.get("status", 101)
                if status < 400:
                    self._working[key] = None
                elif status == 401:
                    self._working.pop(key, None)
                while len(self._working) > _MOST:
                    self._working.popitem(last=False)
            await send(message)

        return answer


def _is_robot(scope: Scope) -> bool:
    is_link = scope["path"] == limits.PATH or scope["path"].startswith(limits.PATH + "/")
    return is_link and headers_of(scope).get("authorization", "")[:6].lower() == "robot "


def _session(cookies: str) -> str:
    """Return the session's cookie: what else a client sends along makes it nobody else."""
    for part in cookies.split(";"):
        name, _, value = part.strip().partition("=")
        if name == COOKIE:
            return value
    return ""
