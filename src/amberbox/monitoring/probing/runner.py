"""Probes at work: each in a thread of its own, on time, so that one that hangs disturbs nobody."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from amberbox.core.probe import ProbeOrder, in_order
from amberbox.monitoring.probing.probe import Probe, Row, probes_for

Put: TypeAlias = Callable[[ProbeOrder, Row], None]
"""Takes a finished row; called from many threads, for one order always in order of time."""

_CLOSE_S = 2.0


@dataclass(slots=True, eq=False)
class _Post:
    """One probe and its subject: since when it looks, and when it was last said to hang."""

    order: ProbeOrder
    probe: Probe
    lock: threading.Lock = field(default_factory=threading.Lock)
    since_s: float | None = None
    told_s: float | None = None

    def hangs_in_s(self, now_s: float) -> float:
        """Return in how many seconds it has to be said that it hangs; at most 0 is now."""
        if self.since_s is None:
            return self.probe.timeout_s
        if self.told_s is None:
            return self.since_s + self.probe.timeout_s - now_s
        return self.told_s + self.probe.period_s - now_s


class ProbeRunner:
    """Runs probes from ``start`` to ``close`` and hands each row to ``put``.

    A look that takes longer than the probe's ``TIMEOUT_S`` gives a row that says so, and another
    one each period until it is over; what it finds then is too old and is dropped. Looks that
    were missed are not made up for. After ``close``, ``put`` is not called any more.
    """

    def __init__(
        self, orders: Sequence[ProbeOrder], put: Put, extra_dirs: Sequence[Path] = ()
    ) -> None:
        self._put = put
        probes = probes_for({order.kind for order in orders}, extra_dirs)
        self._posts = [_Post(order, probes[order.kind]) for order in in_order(orders)]
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self.failure: Exception | None = None
        """What ``put`` raised: then no probe runs any more, and ``close`` raises it again."""

    def start(self) -> None:
        """Begin: every probe looks at once, then each by its period."""
        start_s = time.monotonic()
        for post in self._posts:
            self._run(f"probe {post.order.kind} {post.order.subject}", self._work, post, start_s)
        if self._posts:
            self._run("probes that hang", self._watch)

    def close(self) -> None:
        """End; looks that are under way are left behind. Raise what ``put`` raised."""
        self._stop.set()
        end_s = time.monotonic() + _CLOSE_S
        for post, thread in zip(self._posts, self._threads, strict=False):
            with post.lock:  # a row that is being put is finished first
                is_looking = post.since_s is not None
            if not is_looking:
                thread.join(max(0.0, end_s - time.monotonic()))
        if self.failure is not None:
            raise self.failure

    def _run(self, name: str, work: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=work, args=arguments, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _work(self, post: _Post, due_s: float) -> None:
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            with post.lock:
                post.since_s, post.told_s = time.monotonic(), None
            row = post.probe.look(post.order.subject)
            with post.lock:
                is_late = post.told_s is not None
                post.since_s = None
                if not is_late:
                    self._hand_over(post, row)
            due_s = next_due_s(due_s, post.probe.period_s, time.monotonic())

    def _watch(self) -> None:
        wait_s = 0.0
        while not self._stop.wait(wait_s):
            wait_s = min(self._tell_if_it_hangs(post) for post in self._posts)

    def _tell_if_it_hangs(self, post: _Post) -> float:
        """Put the row of a look that takes too long; return when to ask again, in seconds."""
        with post.lock:
            now_s = time.monotonic()
            left_s = post.hangs_in_s(now_s)
            if left_s > 0:
                return left_s
            post.told_s = now_s
            text = f"hangs for {post.probe.timeout_s:g} s or longer"
            self._hand_over(post, post.probe.unknown(post.order.subject, text))
            return post.probe.period_s

    def _hand_over(self, post: _Post, row: Row) -> None:
        if self._stop.is_set():
            return
        try:
            self._put(post.order, row)
        except Exception as error:  # kept for close(): a thread has nobody to raise it to
            self.failure = self.failure or error
            self._stop.set()


def next_due_s(due_s: float, period_s: float, now_s: float) -> float:
    """Return the next instant after ``now_s`` of the schedule that ``due_s`` belongs to."""
    missed = max(0, int((now_s - due_s) // period_s))
    return due_s + (missed + 1) * period_s
