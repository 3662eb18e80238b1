"""Listens to the feed while the story goes on: what came, when, and waiting for what is to come."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from amberbox.demo.browser import Browser
from amberbox.demo.telling import FailedError


@dataclass(frozen=True, slots=True)
class Heard:
    """A change of the feed; ``at_s`` by the clock that never steps."""

    at_s: float
    kind: str
    robot: str
    data: Any


class Listener:
    """Keeps all that the feed tells, from its making on; ``close`` it."""

    def __init__(self, browser: Browser) -> None:
        self._heard: list[Heard] = []
        self._new = threading.Condition()
        self._is_over = False
        self._socket = browser.feed()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def wait(self, is_it: Callable[[Heard], bool], within_s: float, since_s: float = 0.0) -> Heard:
        """Return the first change since then that is it, waiting for it; raises FailedError."""
        end_s = time.monotonic() + within_s
        seen = 0
        while True:
            news = self._after(seen, end_s)
            seen += len(news)
            for one in news:
                if one.at_s >= since_s and is_it(one):
                    return one

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()
        self._thread.join(5)

    def _after(self, seen: int, end_s: float) -> list[Heard]:
        """Return what came after the first ``seen`` changes, waiting until there is something."""
        with self._new:
            while len(self._heard) == seen:
                left_s = end_s - time.monotonic()
                if left_s <= 0 or self._is_over:
                    raise FailedError("what should follow did not come", "is the machine busy?")
                self._new.wait(left_s)
            return self._heard[seen:]

    def _listen(self) -> None:
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            for message in self._socket:
                self._take(json.loads(message))
        with self._new:
            self._is_over = True
            self._new.notify_all()

    def _take(self, changes: Any) -> None:
        now_s = time.monotonic()
        with self._new:
            self._heard += [
                Heard(now_s, one["kind"], one.get("robot") or "", one.get("data"))
                for one in changes
            ]
            self._new.notify_all()


def is_status(component: str, level: str, robot: str) -> Callable[[Heard], bool]:
    """Make what knows a change by which a component comes to a level."""

    def is_it(heard: Heard) -> bool:
        return (heard.kind, heard.robot) == ("status", robot) and any(
            one["component"] == component and not one["mode"] and one["level"] == level
            for one in heard.data
        )

    return is_it


def is_kind(kind: str, robot: str) -> Callable[[Heard], bool]:
    """Make what knows a change of a kind about a robot."""
    return lambda heard: heard.kind == kind and heard.robot == robot
