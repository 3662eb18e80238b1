"""Talks to one listener over its socket: a snapshot, then what changes, in the order of numbers.

Nothing is queued for a listener: all read the one ring, each at its own pace. Who falls behind is
told so, and gets a new snapshot.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from typing import Protocol

from amberbox.core.errors import UsageError
from amberbox.fleet.feed.asked import parsed
from amberbox.fleet.feed.delta import Delta, message
from amberbox.fleet.feed.feed import Feed
from amberbox.fleet.feed.listener import Listener

PING_S = 1.0
BEHIND_S = 5.0
"""What is older than this is not sent as news."""
FIRST_S = 10.0
SEND_S = 30.0
FRAME_BYTES = 1 << 20
_PAUSE_S = 0.1
WRONG, SLOW = 4400, 4408


class TextSocket(Protocol):
    """An accepted WebSocket with text messages."""

    async def receive(self) -> str | None:
        """Wait for a message; None at the end."""

    async def send(self, text: str) -> None:
        """Send a message; raises OSError when nobody is there any more."""

    async def close(self, code: int, reason: str) -> None:
        """End the connection; harmless when it has ended."""


class Talk:
    """One conversation; ``run`` ends when either side does."""

    def __init__(self, feed: Feed, listener: Listener, socket: TextSocket) -> None:
        self._feed = feed
        self._listener = listener
        self._socket = socket
        self._is_asked = asyncio.Event()
        self._may_be_old = False
        self._sent_s = time.monotonic()

    async def run(self) -> None:
        """Hear what is asked, tell what changes."""
        tasks = [asyncio.create_task(self._hear()), asyncio.create_task(self._tell())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        code, reason = self._listener.ended or (1000, "")
        await self._socket.close(code, reason)

    async def _hear(self) -> None:
        """Take what is asked for, each time in place of what was asked before."""
        while True:
            wait_s = None if self._is_asked.is_set() else FIRST_S
            try:
                async with asyncio.timeout(wait_s):
                    text = await self._socket.receive()
                if text is None:
                    return None
                self._ask(text)
            except TimeoutError:
                return self._listener.end(WRONG, "say what you want to hear first")
            except UsageError as error:
                return self._listener.end(WRONG, error.what)
            await asyncio.sleep(_PAUSE_S)

    def _ask(self, text: str) -> None:
        listener, ring = self._listener, self._feed.ring
        listener.asked = parsed(text)
        listener.settle()
        resume = listener.asked.resume
        self._may_be_old = resume is not None and ring.holds(resume)
        listener.needs_snapshot = not self._may_be_old
        listener.number = resume if resume is not None and self._may_be_old else ring.number
        listener.live.clear()
        self._feed.show_live(listener)
        self._is_asked.set()
        listener.wake.set()

    async def _tell(self) -> None:
        await self._is_asked.wait()
        listener = self._listener
        while listener.ended is None:
            text = await self._next()
            if text:
                try:
                    async with asyncio.timeout(SEND_S):
                        await self._socket.send(text)
                    self._sent_s = time.monotonic()
                except TimeoutError:
                    return listener.end(SLOW, "nothing was taken for too long")
                except OSError:
                    return None
        return None

    async def _next(self) -> str:
        """Return the next frame: an array of messages; waits until there is one."""
        listener = self._listener
        if listener.needs_snapshot:
            return await self._snapshot()
        deltas = list(self._feed.ring.after(listener.number))
        if self._is_behind(deltas):
            listener.needs_snapshot = True
            return f"[{message(self._feed.ring.number, 'missed', '', None)}]"
        live, listener.live = list(listener.live.values()), {}
        if not deltas and not live:
            return await self._wait()
        self._may_be_old = False
        text = self._feed.frame(listener, deltas, FRAME_BYTES)
        if not text and not live:
            return ""
        return f"[{','.join((*((text,) if text else ()), *live))}]"

    def _is_behind(self, deltas: Sequence[Delta]) -> bool:
        """Tell whether something is lost, or what is next is too old to be news."""
        if not self._feed.ring.holds(self._listener.number):
            return True
        if self._may_be_old or not deltas:
            return False
        return time.monotonic() - deltas[0].at_s > BEHIND_S

    async def _wait(self) -> str:
        wait_s = max(self._sent_s + PING_S - time.monotonic(), 0.0)
        try:
            async with asyncio.timeout(wait_s):
                await self._listener.wake.wait()
        except TimeoutError:
            return f"[{message(self._feed.ring.number, 'ping', '', None)}]"
        self._listener.wake.clear()
        return ""

    async def _snapshot(self) -> str:
        """Write how everything is, with the number of the last change that is in it for certain."""
        listener = self._listener
        listener.needs_snapshot, self._may_be_old = False, True
        number = listener.number = self._feed.ring.number
        data = await self._feed.snapshot(listener)
        return f"[{message(number, 'snapshot', '', data)}]"
