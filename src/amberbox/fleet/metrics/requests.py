"""Counts requests by the template of their route, never by what was asked: names stay private."""

from __future__ import annotations

import threading
import time
from bisect import bisect_left
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from amberbox.fleet.metrics.text import Family, Sample

Scope: TypeAlias = "MutableMapping[str, Any]"
Receive: TypeAlias = "Callable[[], Awaitable[MutableMapping[str, Any]]]"
Send: TypeAlias = "Callable[[MutableMapping[str, Any]], Awaitable[None]]"
App: TypeAlias = "Callable[[Scope, Receive, Send], Awaitable[None]]"

BOUNDS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
_OTHER = "other"


@dataclass(slots=True)
class _Counted:
    """How long the requests of one kind took."""

    buckets: list[int] = field(default_factory=lambda: [0] * (len(BOUNDS_S) + 1))
    seconds: float = 0.0
    statuses: dict[int, int] = field(default_factory=dict)


class RequestCounts:
    """Counts and durations by method and route; threads may share it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: dict[tuple[str, str], _Counted] = {}

    def add(self, method: str, route: str, status: int, took_s: float) -> None:
        """Count a request."""
        with self._lock:
            counted = self._known.setdefault((method, route), _Counted())
            counted.buckets[bisect_left(BOUNDS_S, took_s)] += 1
            counted.seconds += took_s
            counted.statuses[status] = counted.statuses.get(status, 0) + 1

    def families(self) -> list[Family]:
        """Return what was counted."""
        with self._lock:
            known = sorted(self._known.items())
            counts = [
                Sample(count, {"method": method, "route": route, "status": str(status)})
                for (method, route), counted in known
                for status, count in sorted(counted.statuses.items())
            ]
            times = [sample for key, counted in known for sample in _histogram(key, counted)]
        return [
            Family("amberbox_requests_total", "counter", "Requests answered.", counts),
            Family("amberbox_request_seconds", "histogram", "How long answers took.", times),
        ]


def _histogram(key: tuple[str, str], counted: _Counted) -> list[Sample]:
    labels = {"method": key[0], "route": key[1]}
    total, samples = 0, []
    for bound, count in zip((*map(str, BOUNDS_S), "+Inf"), counted.buckets, strict=True):
        total += count
        samples.append(Sample(total, {**labels, "le": bound}, "_bucket"))
    return [*samples, Sample(counted.seconds, labels, "_sum"), Sample(total, labels, "_count")]


class Timed:
    """Passes requests on and counts them; sockets are not requests."""

    def __init__(self, app: App, counts: RequestCounts) -> None:
        self._app = app
        self._counts = counts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one on."""
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
