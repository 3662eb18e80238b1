"""All links of a server: one per robot, each by the rules of ``link/serverend.py``."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeAlias

from sqlalchemy import Connection

from amberbox.core.clock import Clock, SystemClock
from amberbox.core.errors import AmberboxError
from amberbox.fleet.database.database import Database
from amberbox.fleet.linkend import ledger, presence
from amberbox.fleet.linkend.grouped import GroupedWrites
from amberbox.fleet.linkend.sockets import Socket, SocketClosedError
from amberbox.fleet.linkend.together import Taking
from amberbox.link import limits
from amberbox.link.folders import is_config_hash
from amberbox.link.frames import (
    Beat,
    Bye,
    FrameError,
    Has,
    Heads,
    Hello,
    Live,
    Row,
    ServerFrame,
    Watch,
    encode,
    from_robot,
)
from amberbox.link.ledger import Admission, StaleEpochError, Stored
from amberbox.link.serverend import Admit, Deed, Keep, Say, ServerEnd
from amberbox.monitoring.messages.pulse import Pulse

Value = tuple[int, float | str | None]
_SEEN_EVERY_NS = 10 * 1_000_000_000
"""How often a heartbeat is written to the database; in between it is known in memory."""
_WATCHED_BYTES = 256 << 10
"""Names of variables that are asked of a robot: they have to fit in a frame, many times over."""
_HEADS_BYTES = 64 << 10
"""A statement of how far a record reaches has some hundred bytes; a larger one is not kept."""
_WAITING = 64
"""Frames that are taken before the oldest of them is answered."""
QUIET_S = 3.2 * limits.BEAT_S
"""A robot that is connected and says nothing for so long has missed three heartbeats."""


Answer: TypeAlias = "tuple[ServerFrame, ...] | asyncio.Task[Sequence[ServerFrame]]"
"""Frames to send, now or once what they say is true."""


def _nothing(*_: Any) -> None:
    return None


@dataclass(slots=True)
class Hooks:
    """What the rest of the server wants to hear of; called in the event loop, must not block."""

    rows: Callable[[str, str, Sequence[Row]], None] = _nothing
    """(robot, store id, rows that are new), once they are durable."""
    admitted: Callable[[Hello, Admission], None] = _nothing
    gone: Callable[[str], None] = _nothing
    live: Callable[[str, Mapping[str, Value]], None] = _nothing
    has: Callable[[str, str, Has], None] = _nothing
    """(robot, store id, which journals hold a window that was asked for)."""
    wants_folder: Callable[[str, str], bool] = lambda robot, config_hash: False
    """Whether the folder of a robot with this hash is not known yet."""


@dataclass(slots=True, eq=False)
class Connected:
    """One robot that is connected now."""

    robot: str
    socket: Socket
    end: ServerEnd
    last_seen_ns: int
    written_ns: int = 0
    backlog: int = 0
    monitoring: Pulse | None = None
    """How its watcher is doing; None where it has not said."""
    answers: asyncio.Queue[Answer | None] = field(default_factory=lambda: asyncio.Queue(_WAITING))
    heard_s: float = field(default_factory=time.monotonic)
    """When something came last, by a clock that nobody sets."""

    @property
    def is_silent(self) -> bool:
        """Tell whether heartbeats are missing, though the connection holds."""
        return time.monotonic() - self.heard_s > QUIET_S


class LinkServer:
    """Serves the links of all robots in one event loop; ``serve`` is called per connection."""

    def __init__(
        self,
        database: Database,
        hooks: Hooks | None = None,
        clock: Clock | None = None,
        silent_s: float = limits.SILENT_S,
    ) -> None:
        self._database = database
        self._hooks = hooks or Hooks()
        self._clock = clock or SystemClock()
        self._silent_s = silent_s
        self._writes = GroupedWrites(database)
        self._watched: dict[str, tuple[str, ...]] = {}
        self.robots: dict[str, Connected] = {}
        with database.begin() as connection:
            presence.nobody_connected(connection)

    def close(self) -> None:
        """Finish what is being written; connections have ended before."""
        self._writes.close()

    def write(self, work: Callable[[Connection], None]) -> None:
        """Write together with what robots say; returns when it is durable. Blocks.

        When all robots come at once, the disk is waited for once, not for each of them.
        """
        self._writes.submit(work).result()

    async def serve(self, socket: Socket, robot: str) -> None:
        """Talk to a robot, which was authenticated, until either side ends it."""
        one = Connected(robot, socket, ServerEnd(robot), self._clock.wall_ns())
        answering = asyncio.create_task(self._answer(one))
        try:
            await self._listen(one)
            await one.answers.put(None)
            with suppress(asyncio.TimeoutError):
                async with asyncio.timeout(self._silent_s):
                    await asyncio.shield(answering)
        finally:
            answering.cancel()
            await asyncio.gather(answering, *_unanswered(one), return_exceptions=True)
            await self._left(one)

    async def send(self, robot: str, frame: ServerFrame) -> bool:
        """Send a frame to a robot; tell whether it is connected, and takes what it is sent."""
        one = self.robots.get(robot)
        if one is None:
            return False
        try:
            async with asyncio.timeout(self._silent_s):
                await one.socket.send(encode(frame))
        except (TimeoutError, SocketClosedError):
            return False
        return True

    async def watch(self, robot: str, variables: Sequence[str]) -> None:
        """Ask for the latest values of variables from now on, also after a new connection."""
        self._watched[robot] = tuple(_fitting(variables))
        await self.send(robot, Watch(list(self._watched[robot])))

    async def _listen(self, one: Connected) -> None:
        """Take frames until the connection ends, or nothing has come for too long."""
        while not one.end.closed:
            try:
                async with asyncio.timeout(self._silent_s):
                    data = await one.socket.receive()
                frame = from_robot(data)
            except (TimeoutError, SocketClosedError):
                return
            except FrameError as error:
                one.end.closed = True
                await one.answers.put((_bye(str(error)),))
                return
            one.last_seen_ns, one.heard_s = self._clock.wall_ns(), time.monotonic()
            for deed in one.end.receive(frame):
                await self._do(one, deed)

    async def _do(self, one: Connected, deed: Deed) -> None:
        if isinstance(deed, Admit):
            await self._admit(one, deed.hello)
        elif isinstance(deed, Keep):
            await one.answers.put(self._keep(one, deed))
        elif isinstance(deed, Say):
            await one.answers.put(deed.frames)
        elif isinstance(deed, Beat):
            await one.answers.put((one.end.pong(deed, self._clock.wall_ns()),))
            self._beat(one, deed)
        elif isinstance(deed, Live):
            self._hooks.live(one.robot, deed.values)
        elif isinstance(deed, Heads):
            await self._heads(one, deed)
        elif isinstance(deed, Has):
            self._hooks.has(one.robot, _store_of(one), deed)

    async def _admit(self, one: Connected, hello: Hello) -> None:
        """Let a robot in: from here on its older connection can write nothing any more."""
        now_ns = self._clock.wall_ns()
        work = partial(ledger.admit, hello=hello, now_ns=now_ns)
        admission = await asyncio.wrap_future(self._writes.submit(work))
        known = self.robots.get(one.robot)
        self.robots[one.robot] = one
        wants = self._wants_folder(hello)
        watch = self._watched.get(one.robot, ())
        welcome = one.end.admitted(
            admission, self._clock.wall_ns(), wants_folder=wants, watch=watch
        )
        await one.answers.put((welcome,))
        self._hooks.admitted(hello, admission)
        if known is not None:
            known.end.closed = True
            await known.socket.close()

    def _wants_folder(self, hello: Hello) -> bool:
        known = is_config_hash(hello.config_hash)
        return known and self._hooks.wants_folder(hello.robot, hello.config_hash)

    def _keep(self, one: Connected, deed: Keep) -> asyncio.Task[Sequence[ServerFrame]]:
        now_ns = self._clock.wall_ns()
        work = Taking(
            one.robot, deed.epoch, deed.store_id, deed.rows, deed.upto, deed.reaches, now_ns,
            deed.compare,
        )  # fmt: skip
        stored = asyncio.wrap_future(self._writes.submit(work))
        return asyncio.create_task(self._kept(one, deed, stored))

    async def _kept(
        self, one: Connected, deed: Keep, stored: Awaitable[Stored]
    ) -> Sequence[ServerFrame]:
        try:
            found = await stored
        except StaleEpochError:
            return one.end.overtaken().frames
        if found.new:
            self._hooks.rows(one.robot, deed.store_id, found.new)
        return [one.end.stored(deed.number, found)]

    def _beat(self, one: Connected, beat: Beat) -> None:
        one.backlog = beat.backlog
        one.monitoring = presence.monitoring_said(beat)
        now_ns = one.last_seen_ns
        if now_ns - one.written_ns >= _SEEN_EVERY_NS and one.end.hello is not None:
            one.written_ns = now_ns
            self._writes.submit(partial(
                presence.seen, robot=one.robot, epoch=beat.epoch, beat=beat,
                boot=one.end.hello.boot_id, at_ns=now_ns,
            ))  # fmt: skip

    async def _heads(self, one: Connected, deed: Heads) -> None:
        """Keep a statement; more is heard of the robot then, so that nothing piles up."""
        if len(deed.heads) > _HEADS_BYTES:
            return
        kept = self._writes.submit(partial(
            presence.keep_heads, robot=one.robot, store_id=_store_of(one), heads=deed.heads,
            at_ns=one.last_seen_ns,
        ))  # fmt: skip
        with suppress(AmberboxError):  # the database is busy: the next statement says as much
            await asyncio.wrap_future(kept)

    async def _answer(self, one: Connected) -> None:
        """Send answers in the order of what they answer, each once it is true."""
        while True:
            waiting = await one.answers.get()
            if waiting is None:
                return
            try:
                frames = waiting if isinstance(waiting, tuple) else await asyncio.shield(waiting)
                for frame in frames:
                    async with asyncio.timeout(self._silent_s):
                        await one.socket.send(encode(frame))
            except (TimeoutError, SocketClosedError, AmberboxError):
                await _drop(one)  # without an answer the robot tries again
                return
            except Exception:  # something that no robot should say; its listener must not wait
                logging.getLogger(__name__).exception("no answer to %s", one.robot)
                await _drop(one)
                return

    async def _left(self, one: Connected) -> None:
        await one.socket.close()
        was_here = self.robots.get(one.robot) is one
        if was_here:
            del self.robots[one.robot]
        try:
            if one.end.epoch is not None:
                written = self._writes.submit(partial(
                    presence.gone, robot=one.robot, epoch=one.end.epoch,
                    last_seen_ns=one.last_seen_ns,
                ))  # fmt: skip
                with suppress(AmberboxError):  # the database is busy: the rest is told all the same
                    await asyncio.shield(asyncio.wrap_future(written))
        finally:
            if was_here:  # who is told finds in the database when it was seen last
                self._hooks.gone(one.robot)


def _fitting(variables: Sequence[str]) -> Iterator[str]:
    """Give as many of some names as one frame takes."""
    left = _WATCHED_BYTES
    for name in variables[: limits.VARIABLES]:
        left -= len(name.encode("utf-8", "replace"))
        if left < 0:
            return
        yield name


def _store_of(one: Connected) -> str:
    return one.end.hello.store_id if one.end.hello is not None else ""


def _bye(reason: str) -> ServerFrame:
    return Bye(reason[: limits.TEXT_BYTES])


async def _drop(one: Connected) -> None:
    """End a connection and take whatever it still holds, so that its listener sees the end."""
    one.end.closed = True
    await one.socket.close()
    await asyncio.gather(*_unanswered(one), return_exceptions=True)


def _unanswered(one: Connected) -> list[asyncio.Task[Sequence[ServerFrame]]]:
    """Empty the queue of answers; return those whose work is not finished."""
    found = []
    while not one.answers.empty():
        answer = one.answers.get_nowait()
        if isinstance(answer, asyncio.Task):
            found.append(answer)
    return found
