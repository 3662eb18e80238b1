"""ASGI middleware: hosts, headers, body limits, request counts, rate limits, access log.

Until the first admin exists, only the setup pages answer (``WaitsForAdmin``).
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import os
import threading
import time
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from amberbox.core.clock import Clock
from amberbox.core.pacing import TokenBucket
from amberbox.core.timestamps import format_time
from amberbox.link import limits
from amberbox.link.folders import TAKEN_BYTES
from amberbox.link.limits import NOT_SET_UP
from amberbox.link.uploads import PROOF_BYTES
from amberbox.server.accounts.passwords import digest
from amberbox.server.accounts.signin import address_key, needs_setup
from amberbox.server.config import (
    ServerSettings,
    client_address,
    is_local,
    is_loopback,
    is_trusted,
    read,
)
from amberbox.server.database import ServerDatabase
from amberbox.server.experiments.shelf import UPLOADED_BYTES
from amberbox.server.http.auth import COOKIE, PREFIX
from amberbox.server.services.health import MetricFamily, MetricSample

Pairs: TypeAlias = Sequence[tuple[bytes, bytes]]


def headers_of(scope: Scope) -> Headers:
    """Return the headers of a request."""
    return Headers(scope=scope)


async def refuse(
    scope: Scope,
    send: Send,
    status: int,
    what: str,
    hint: str = "",
    more: Pairs = (),
    code: str = "",
) -> None:
    """Answer an HTTP request or WebSocket handshake with an error in the API's JSON form.

    ``code`` is for programs: it distinguishes errors of the same status.
    """
    error = {"what": what, "hint": hint, **({"code": code} if code else {})}
    body = json.dumps({"error": error}).encode()
    prefix = "websocket." if scope["type"] == "websocket" else ""
    about = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(body)), *more]
    start = {"type": f"{prefix}http.response.start", "status": status, "headers": about}
    await send(start)
    content = b"" if scope.get("method") == "HEAD" else body
    await send({"type": f"{prefix}http.response.body", "body": content})


class Hosts:
    """Refuses requests that bypass the proxy, or whose host is not this server."""

    def __init__(self, app: ASGIApp, settings: ServerSettings) -> None:
        self._app = app
        self._settings = settings
        self._names = {urlsplit(settings.public_url).hostname or "", *settings.names}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer 403 to requests that bypass the proxy, 421 to those for another host."""
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
    """Adds security headers to every response; headers that the app has set are kept."""

    def __init__(self, app: ASGIApp, settings: ServerSettings) -> None:
        self._app = app
        self._always = (*_ALWAYS, *(_SECURE if settings.is_secure else ()))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a request, and its response with the added headers."""
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


@dataclass(frozen=True, slots=True)
class BodyLimit:
    """Limits of a request body: bytes, seconds between two pieces, seconds in all."""

    most: int = 1 << 20
    pause_s: float = 10.0
    whole_s: float = 30.0


USUAL = BodyLimit()
_ROBOTS_S = 20.0, 600.0
# Uploads of robots are larger, over networks that may be slow
LIMITS: Mapping[tuple[str, str], BodyLimit] = {
    ("PATCH", f"{limits.PATH}/journals/"): BodyLimit(limits.PIECE_BYTES, *_ROBOTS_S),
    ("POST", f"{limits.PATH}/journals/"): BodyLimit(PROOF_BYTES, *_ROBOTS_S),
    ("POST", f"{PREFIX}/experiments"): BodyLimit(UPLOADED_BYTES, whole_s=120.0),
    ("PUT", f"{limits.PATH}/folders/"): BodyLimit(TAKEN_BYTES, *_ROBOTS_S),
}


class BodyLimits:
    """Answers 413 to bodies that are too large, 408 to those that arrive too slowly."""

    def __init__(self, app: ASGIApp, usual: BodyLimit = USUAL) -> None:
        self._app = app
        self._usual = usual

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a request with a body that is counted as it arrives."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit = self._limit(scope)
        length = headers_of(scope).get("content-length", "0")
        if not _is_at_most(length, limit.most):
            what = f"a body has at most {limit.most} bytes here"
            await refuse(scope, send, 413, what, more=[(b"connection", b"close")])
            return
        await self._app(scope, _Counted(receive, limit), send)

    def _limit(self, scope: Scope) -> BodyLimit:
        for (method, start), limit in LIMITS.items():
            if scope["method"] == method and scope["path"].startswith(start):
                return limit
        return self._usual


def _is_at_most(length: str, most: int) -> bool:
    """Return whether a client's number is at most ``most``; one of thousands of digits is not
    parsed.
    """
    digits = length.lstrip("0") or "0"
    return length.isascii() and length.isdecimal() and len(digits) < 19 and int(digits) <= most


class _Counted:
    """Receives the messages of one request, with limits; raises HTTPException beyond them."""

    def __init__(self, receive: Receive, limit: BodyLimit) -> None:
        self._receive = receive
        self._limit = limit
        self._size = 0
        self._is_whole = False
        self._began_s = asyncio.get_running_loop().time()

    async def __call__(self) -> Message:
        """Return the next message; after the body, wait for the disconnect without a limit."""
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


@dataclass(frozen=True, slots=True)
class Rate:
    """Largest number of requests at once, and per second."""

    burst: float
    per_s: float


# Many people may share one address
ADDRESS = Rate(600, 100)
PRINCIPAL = Rate(200, 40)
# Robots whose key has not been accepted yet, per address: after a start all connect at once
STRANGERS = Rate(2000, 200)
# Largest number of remembered buckets and keys; the oldest are dropped first
_MOST = 10_000


class RateBuckets:
    """One token bucket per key, refilled over time."""

    def __init__(self, rate: Rate, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._rate = rate
        self._clock_s = clock_s
        self._held: OrderedDict[str, TokenBucket] = OrderedDict()

    def take(self, key: str) -> float:
        """Take a token; return 0.0, or how many seconds to wait for one."""
        bucket = self._held.pop(key, None) or TokenBucket(self._rate.per_s, self._rate.burst)
        self._held[key] = bucket
        while len(self._held) > _MOST:
            self._held.popitem(last=False)
        return bucket.take_one(self._clock_s())


class RateLimits:
    """Answers 429 to clients beyond their rate; robots whose key was accepted are not limited."""

    def __init__(
        self, app: ASGIApp, settings: ServerSettings, address: Rate = ADDRESS,
        principal: Rate = PRINCIPAL, strangers: Rate = STRANGERS,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self._app = app
        self._settings = settings
        self._addresses = RateBuckets(address, clock_s)
        self._principals = RateBuckets(principal, clock_s)
        self._strangers = RateBuckets(strangers, clock_s)
        self._working: OrderedDict[str, None] = OrderedDict()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a request within the rate limit, else answer 429."""
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
            return 0.0 if known else self._strangers.take(address_key(address))
        wait_s = self._addresses.take(address_key(address))
        return wait_s or (self._principals.take(digest(secret)) if secret else 0.0)

    def _learning(self, scope: Scope, send: Send) -> Send:
        """Remember from the response whether the robot's key was accepted."""
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
    """Return the value of the session cookie, ignoring other cookies; empty without one."""
    for part in cookies.split(";"):
        name, _, value = part.strip().partition("=")
        if name == COOKIE:
            return value
    return ""


OPEN = ("/setup", f"{PREFIX}/health", f"{limits.PATH}/ca.pem")
STATIC = "/static/"


class WaitsForAdmin:
    """Answers 503 until the first admin exists; from then on there is always one."""

    def __init__(self, app: ASGIApp, database: ServerDatabase) -> None:
        self._app = app
        self._database = database
        self._is_ready = False

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a request if the server is set up, or if its path is part of the setup."""
        if scope["type"] != "lifespan" and not _is_open(scope["path"]) and not self._is_ready:
            self._is_ready = await asyncio.to_thread(self._look)
            if not self._is_ready:
                await _send_away(scope, send)
                return
        await self._app(scope, receive, send)

    def _look(self) -> bool:
        with self._database.reading() as connection:
            return not needs_setup(connection)


def _is_open(path: str) -> bool:
    return path in OPEN or path.startswith(STATIC)


async def _send_away(scope: Scope, send: Send) -> None:
    """Redirect browsers to the setup page, answer 503 to programs."""
    if scope.get("method") == "GET" and "text/html" in headers_of(scope).get("accept", ""):
        headers = [(b"location", b"/setup"), (b"content-length", b"0")]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})
        return
    hint = "amberbox serve add-user NAME --data DIR on the server, or open /setup there"
    await refuse(scope, send, 503, "this server is not set up yet", hint, code=NOT_SET_UP)


FILE = Path("log") / "access.log"
_BYTES = 10 << 20
_FILES = 5
_LONGEST = 300
# Status that is logged for an accepted WebSocket
_SWITCHED = 101


class AccessLog:
    """Writes one line per request or WebSocket, when it has ended."""

    def __init__(self, app: ASGIApp, folder: Path, settings: ServerSettings, clock: Clock) -> None:
        self._app = app
        self._settings = settings
        self._clock = clock
        (folder / FILE).parent.mkdir(mode=0o700, exist_ok=True)
        self._file = _Private(folder / FILE, maxBytes=_BYTES, backupCount=_FILES, encoding="utf-8")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a request, and log its status and duration (ms)."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        status, began_s = 500, time.monotonic()
        scope.setdefault("state", {})

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "websocket.accept":
                status = _SWITCHED
            elif message["type"].endswith("http.response.start"):
                status = message["status"]
            elif message["type"] == "websocket.close" and status != _SWITCHED:
                status = 403
            await send(message)

        try:
            await self._app(scope, receive, answer)
        finally:
            self._write(scope, status, (time.monotonic() - began_s) * 1e3)

    def _write(self, scope: Scope, status: int, took_ms: float) -> None:
        caller = scope["state"].get("caller")
        peer = scope["client"][0] if scope.get("client") else ""
        forwarded = headers_of(scope).getlist("x-forwarded-for")
        line: dict[str, Any] = {
            "time": format_time(self._clock.wall_ns()),
            "principal": "" if caller is None else str(caller.principal),
            "address": client_address(peer, forwarded, self._settings.proxies),
            "method": scope.get("method", "SOCKET"),
            "path": scope["path"][:_LONGEST],
            "status": status,
            "ms": round(took_ms, 1),
        }
        text = json.dumps(line)
        self._file.emit(logging.LogRecord("access", logging.INFO, "", 0, text, None, None))

    def close(self) -> None:
        """Close the log file."""
        self._file.close()


class _Private(RotatingFileHandler):
    """A rotating log file readable by the server's user only; write errors fail no request."""

    def _open(self) -> Any:
        os.close(os.open(self.baseFilename, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600))
        return super()._open()

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 -- logging's name
        """Drop the line, since answering requests matters more."""


BOUNDS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
_OTHER = "other"


@dataclass(slots=True)
class _RequestsCounted:
    """Counts and durations of the requests of one method and route."""

    buckets: list[int] = field(default_factory=lambda: [0] * (len(BOUNDS_S) + 1))
    seconds: float = 0.0
    statuses: dict[int, int] = field(default_factory=dict)


class RequestCounts:
    """Counts requests and their durations by method and route; threads may share it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: dict[tuple[str, str], _RequestsCounted] = {}

    def add(self, method: str, route: str, status: int, took_s: float) -> None:
        """Count one request that took ``took_s`` seconds."""
        with self._lock:
            counted = self._known.setdefault((method, route), _RequestsCounted())
            counted.buckets[bisect_left(BOUNDS_S, took_s)] += 1
            counted.seconds += took_s
            counted.statuses[status] = counted.statuses.get(status, 0) + 1

    def families(self) -> list[MetricFamily]:
        """Return the counts as metrics."""
        with self._lock:
            known = sorted(self._known.items())
            counts = [
                MetricSample(count, {"method": method, "route": route, "status": str(status)})
                for (method, route), counted in known
                for status, count in sorted(counted.statuses.items())
            ]
            times = [sample for key, counted in known for sample in _histogram(key, counted)]
        return [
            MetricFamily("amberbox_requests_total", "counter", "Requests answered.", counts),
            MetricFamily("amberbox_request_seconds", "histogram", "How long answers took.", times),
        ]


def _histogram(key: tuple[str, str], counted: _RequestsCounted) -> list[MetricSample]:
    labels = {"method": key[0], "route": key[1]}
    total, samples = 0, []
    for bound, count in zip((*map(str, BOUNDS_S), "+Inf"), counted.buckets, strict=True):
        total += count
        samples.append(MetricSample(total, {**labels, "le": bound}, "_bucket"))
    return [
        *samples,
        MetricSample(counted.seconds, labels, "_sum"),
        MetricSample(total, labels, "_count"),
    ]


class RequestTimer:
    """Forwards requests and counts them; WebSockets are not counted."""

    def __init__(self, app: ASGIApp, counts: RequestCounts) -> None:
        self._app = app
        self._counts = counts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward one request and count it."""
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        status, began_s = 500, time.monotonic()

        async def answer(message: MutableMapping[str, Any]) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            return await self._app(scope, receive, answer)
        finally:
            route = getattr(scope.get("route"), "path", _OTHER)
            method = scope["method"] if route != _OTHER else _OTHER
            self._counts.add(method, route, status, time.monotonic() - began_s)
