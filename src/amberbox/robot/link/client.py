"""The link of a robot: connects, tells, is acknowledged; and when it breaks, begins again.

It only reads the journals. Whatever happens to it or to the network, recording goes on.
"""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field

from amberbox import __version__
from amberbox.blackbox.signing.keys import public_key
from amberbox.blackbox.store import Store
from amberbox.core.clock import Clock, SystemClock
from amberbox.core.errors import AmberboxError
from amberbox.link import limits
from amberbox.link.backoff import Backoff
from amberbox.link.bucket import TokenBucket
from amberbox.link.frames import (
    Fetch,
    FrameError,
    Has,
    Hello,
)
from amberbox.link.offset import OffsetEstimate
from amberbox.link.robotend import OutOfStepError
from amberbox.robot.link.dialing import Line, LinkDownError, RefusedError, dial, greet
from amberbox.robot.link.live import LiveValues
from amberbox.robot.link.network import Network, current_network
from amberbox.robot.link.options import LinkOptions
from amberbox.robot.link.reaching import Reaches
from amberbox.robot.link.remarks import Remarks
from amberbox.robot.link.session import Session
from amberbox.robot.link.tls import PinError, context_for

_EARLIEST_NS = 1_704_067_200 * 1_000_000_000
"""2024-01-01: a clock that says less has not been set."""

_LEAST_FRAME = 2048

Dial = Callable[[LinkOptions, ssl.SSLContext | None], Awaitable[Line]]


@dataclass(slots=True)
class Asked:
    """What the server wants of the rest of the robot's agent; called in the event loop."""

    fetch: Callable[[Fetch], None] = lambda frame: None
    folder: Callable[[str], None] = lambda config_hash: None


@dataclass(frozen=True, slots=True)
class Found:
    """Journals that hold a window that was asked for: name and bytes."""

    id: str
    files: tuple[tuple[str, int], ...]

    def of_epoch(self, epoch: int) -> Has:
        """Return the frame that says so."""
        return Has(epoch, list(self.files[: limits.FILES]), self.id)


@dataclass(slots=True)
class Progress:
    """How the link is doing, for whoever wants to show it."""

    connected: bool = False
    trouble: str = ""
    attempts: int = 0
    contacts: int = 0
    backlog: int = 0
    backlog_bytes: int = 0
    rows_sent: int = 0
    bytes_sent: int = 0
    offset: OffsetEstimate = field(default_factory=OffsetEstimate)


class LinkClient:
    """Keeps one store linked to one server; ``run`` until ``stop`` is set."""

    def __init__(
        self,
        store: Store,
        options: LinkOptions,
        *,
        asked: Asked | None = None,
        clock: Clock | None = None,
        network: Callable[[], Network] = current_network,
        dialer: Dial = dial,
        backoff: Backoff | None = None,
    ) -> None:
        self.store = store
        self.options = options
        self.asked = asked or Asked()
        self.clock = clock or SystemClock()
        self.network = network
        self.progress = Progress()
        self.bucket = TokenBucket(options.rate)
        self.frame_bytes = limits.ROWS_BYTES
        """How large frames of rows get: smaller after trouble, so that some get through."""
        self.live = LiveValues(store)
        self.answers: deque[Found] = deque()
        """What is to be said about journals that were asked for; it waits for a connection."""
        self.said_key = ""
        """The public key that the server was told: it verifies journals with it."""
        self._dial = dialer
        self._backoff = backoff or Backoff()
        self._reaches = Reaches(store)
        self._remarks = Remarks(store)

    async def run(self, stop: asyncio.Event) -> None:
        """Connect again and again until ``stop``; then send what is durable, and end."""
        while not stop.is_set():
            self.progress.attempts += 1
            try:
                await self._once(stop)
                continue
            except (LinkDownError, FrameError, OutOfStepError, AmberboxError, OSError) as error:
                self._failed(error)
            with contextlib.suppress(asyncio.TimeoutError):
                async with asyncio.timeout(self._backoff.failed()):
                    await stop.wait()
        await asyncio.to_thread(self.live.close)

    def _failed(self, error: Exception) -> None:
        self.progress.connected = False
        self.progress.trouble = str(error)
        self.frame_bytes = max(self.frame_bytes // 4, _LEAST_FRAME)
        if isinstance(error, (RefusedError, PinError)):
            self._remarks.say("link_refused", str(error))

    async def _once(self, stop: asyncio.Event) -> None:
        """Hold one connection from its beginning to its end."""
        self._look_at_clock()
        context = await asyncio.to_thread(
            context_for, self.options.url, self.options.ca, self.store.path
        )
        line = await self._dial(self.options, context)
        try:
            session = await self._greet(line)
            self._backoff.succeeded()
            self._remarks.over("link_refused")
            self.progress.connected, self.progress.trouble = True, ""
            self.progress.contacts += 1
            await session.run(stop)
        finally:
            self.progress.connected = False
            await line.close()

    def _look_at_clock(self) -> None:
        """Say that the clock was not set: the server is verified by its chain alone."""
        if self.clock.wall_ns() < _EARLIEST_NS:
            text = "the clock was not set: the server is verified by its authority, not by dates"
            self._remarks.say("clock_not_set", text)
        else:
            self._remarks.over("clock_not_set")

    def current_key(self) -> str:
        """Return the public key that the store signs with; empty before the keeper has made it."""
        return public_key(self.store.path) or ""

    async def _greet(self, line: Line) -> Session:
        """Say hello; raises RefusedError when the server sends the robot away."""
        reaches = await asyncio.to_thread(self._reaches.state)
        self.said_key = self.current_key()
        hello = Hello(
            self.options.robot, self.store.id, self.clock.boot_id(), reaches,
            self.options.config_hash, self.clock.wall_ns(), self.clock.boot_ns(), __version__,
            public_key=self.said_key,
        )  # fmt: skip
        answer = await greet(line, hello)
        if answer.wants_folder:
            self.asked.folder(self.options.config_hash)
        self.look_at(answer.watch)
        return Session(self, line, answer, self._reaches, reaches)

    def look_at(self, variables: Sequence[str]) -> None:
        """Tell the latest values of these from now on, if the robot's folder allows it."""
        if self.options.live:
            self.live.watch(variables)
