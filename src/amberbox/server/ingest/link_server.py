"""The link server: one connection per robot over a WebSocket (rules in ``link/server_end.py``).

Connections of robots whose key is revoked are closed.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol, TypeAlias, TypeVar

from sqlalchemy import Connection, or_, select

from amberbox.core.clock import Clock, SystemClock
from amberbox.core.errors import AmberboxError
from amberbox.link import limits
from amberbox.link.folders import is_config_hash
from amberbox.link.frames import (
    AbortFrame,
    ActionsFrame,
    AnswersFrame,
    BeatFrame,
    Bye,
    ChallengeFrame,
    ConfirmFrame,
    FrameError,
    HasFrame,
    HeadsFrame,
    Hello,
    LeaseFrame,
    LinkRow,
    LiveFrame,
    ServerFrame,
    UnknownFrameError,
    WatchFrame,
    encode,
    from_robot,
)
from amberbox.link.ledger import OTHER, LinkAdmission, StaleEpochError, StoredRows
from amberbox.link.server_end import (
    AdmitRobot,
    IgnoreFrame,
    LinkAction,
    SendFrames,
    ServerEnd,
    StoreRows,
)
from amberbox.monitoring.current_state import WatcherHeartbeat
from amberbox.server.bus import EventBus
from amberbox.server.commands import server_id
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest import ledger, link_state
from amberbox.server.ingest.command_link import CommandLink, RobotContact
from amberbox.server.ingest.ledger import GroupedWrites, RowBatch
from amberbox.server.schema import ROBOT_KEYS, ROBOTS

# A peer that stopped reading would block without a limit
_CLOSE_S = 2.0


class SocketClosedError(Exception):
    """The peer or the network has closed the connection."""


class Socket(Protocol):
    """One accepted WebSocket; frames are whole binary messages."""

    async def receive(self) -> bytes:
        """Wait for the next message; raises SocketClosedError at the end."""

    async def send(self, data: bytes) -> None:
        """Send a message; raises SocketClosedError when the connection has ended."""

    async def close(self) -> None:
        """Close the connection; does nothing when it is closed."""


class StarletteSocket:
    """An accepted ``WebSocket`` of Starlette or FastAPI."""

    def __init__(self, websocket: Any) -> None:
        self._websocket = websocket

    async def receive(self) -> bytes:
        """Return the next binary message; empty for a text message, which no robot sends."""
        try:
            message = await self._websocket.receive()
        except RuntimeError as error:  # it was closed before
            raise SocketClosedError(str(error)) from error
        if message["type"] != "websocket.receive":
            raise SocketClosedError(f"closed with {message.get('code')}")
        return message.get("bytes") or b""

    async def send(self, data: bytes) -> None:
        """Send a message."""
        from starlette.websockets import WebSocketDisconnect

        try:
            await self._websocket.send_bytes(data)
        except (RuntimeError, WebSocketDisconnect, OSError) as error:
            raise SocketClosedError(str(error)) from error

    async def close(self) -> None:
        """Close the connection."""
        with suppress(Exception):  # closed already, or network lost; errors differ per server
            async with asyncio.timeout(_CLOSE_S):
                await self._websocket.close()


Value = tuple[int, float | str | None]
T = TypeVar("T")
# How often a heartbeat is written to the database; in between it is known in memory
_SEEN_EVERY_NS = 10 * 1_000_000_000
# Largest size of the names of watched variables, which have to fit in a frame many times over
_WATCHED_BYTES = 256 << 10
# A statement of heads has some hundred bytes; larger ones are not stored
_HEADS_BYTES = 64 << 10
# Frames that are received before the oldest of them is answered
_WAITING = 64
# A connected robot that sends nothing for so long has missed three heartbeats
QUIET_S = 3.2 * limits.BEAT_S


# Frames to send, now or once they are true
Answer: TypeAlias = "tuple[ServerFrame, ...] | asyncio.Task[Sequence[ServerFrame]]"


def _nothing(*_: Any) -> None:
    return None


@dataclass(slots=True)
class LinkHooks:
    """Callbacks into the rest of the server; called in the event loop, must not block."""

    rows: Callable[[str, str, Sequence[LinkRow]], None] = _nothing
    """(robot, store id, rows that are new), once they are durable."""
    admitted: Callable[[Hello, LinkAdmission], None] = _nothing
    gone: Callable[[str], None] = _nothing
    live: Callable[[str, Mapping[str, Value]], None] = _nothing
    has: Callable[[str, str, HasFrame], None] = _nothing
    """Called with robot, store id, and the journals that hold a requested window."""
    wants_folder: Callable[[str, str], bool] = lambda robot, config_hash: False
    """Whether the folder of a robot with this hash is not known yet."""
    commands: Callable[[str, Sequence[str]], None] = _nothing
    """(robot, ids of its commands that it has answered), once the answers are durable."""
    lease: Callable[[str, Sequence[str]], None] = _nothing
    """(robot, ids) when a robot has another holder, or other motions wait for confirmation."""


@dataclass(slots=True, eq=False)
class RobotConnection:
    """One connected robot."""

    robot: str
    socket: Socket
    end: ServerEnd
    last_seen_ns: int
    key_id: str | None = None
    """The key that the connection was opened with."""
    written_ns: int = 0
    backlog: int = 0
    monitoring: WatcherHeartbeat | None = None
    """State of the robot's watcher; None if it was not reported."""
    contact: RobotContact | None = None
    """State of its commands; None if it takes none."""
    answers: asyncio.Queue[Answer | None] = field(default_factory=lambda: asyncio.Queue(_WAITING))
    last_received_s: float = field(default_factory=time.monotonic)
    """Time of the last received frame, by the monotonic clock."""

    @property
    def is_silent(self) -> bool:
        """Return whether heartbeats are missing although the connection holds."""
        return time.monotonic() - self.last_received_s > QUIET_S


class LinkServer:
    """Serves the links of all robots in one event loop; ``serve`` is called per connection."""

    def __init__(
        self,
        database: ServerDatabase,
        hooks: LinkHooks | None = None,
        clock: Clock | None = None,
        silent_s: float = limits.SILENT_S,
    ) -> None:
        self._database = database
        self._hooks = hooks or LinkHooks()
        self._clock = clock or SystemClock()
        self._silent_s = silent_s
        self._writes = GroupedWrites(database)
        self._watched: dict[str, tuple[str, ...]] = {}
        self._commands = CommandLink(
            self._writes, self._clock, self._hooks.commands, self._hooks.lease
        )
        self.robots: dict[str, RobotConnection] = {}
        self.unknown_frames = 0
        """Frames of robots that were ignored: this version does not know them."""
        with database.begin() as connection:
            link_state.reset_connections(connection)
            self.server_id = server_id(connection, self._clock.wall_ns())

    def close(self) -> None:
        """Finish pending writes; all connections have ended before."""
        self._writes.close()

    def write(self, work: Callable[[Connection], None]) -> None:
        """Write together with rows of robots; return when it is durable. Blocks.

        When all robots connect at once, they share one disk sync.
        """
        self._writes.submit(work).result()

    async def serve(self, socket: Socket, robot: str, key_id: str | None = None) -> None:
        """Serve a robot, authenticated with a key, until either side closes the connection."""
        one = RobotConnection(robot, socket, ServerEnd(robot), self._clock.wall_ns(), key_id)
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
        """Send a frame to a robot; return whether it was connected and received it in time."""
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
        """Request the latest values of variables from now on, also after a new connection."""
        self._watched[robot] = tuple(_fitting(variables))
        await self.send(robot, WatchFrame(list(self._watched[robot])))

    async def order(self, robot: str, frame: LeaseFrame | AbortFrame | ConfirmFrame) -> bool:
        """Send a frame now; return whether the robot takes commands, and received it in time.

        Before its first challenge a robot may not have heard Welcome yet.
        """
        return bool(self.challenges(robot)) and await self.send(robot, frame)

    async def ask(
        self,
        robot: str,
        frame: LeaseFrame | ConfirmFrame,
        decided: Callable[[RobotContact], T | None],
        within_s: float,
    ) -> T | None:
        """Send a frame and wait for the challenge that shows what the robot has decided.

        Return what ``decided`` finds in one; None where the robot is away, or does not say in time.
        """
        contact = self.contact(robot)
        if contact is None:
            return None
        heard = contact.heard
        with suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                if await self.order(robot, frame):
                    while self.contact(robot) is contact:
                        await heard.wait()
                        heard = contact.heard
                        found = decided(contact)
                        if found is not None:
                            return found
        return None

    def contact(self, robot: str) -> RobotContact | None:
        """Return what a robot has said of commands on its present connection.

        None of one that is away, or takes no commands. May be called in any thread.
        """
        one = self.robots.get(robot)
        return None if one is None else one.contact

    def challenges(self, robot: str) -> list[bytes]:
        """Return what a robot has minted in the last minute on its present connection.

        May be called in any thread. The newest one is the last; there is none of a robot that is
        away, or takes no commands.
        """
        contact = self.contact(robot)
        return [] if contact is None else contact.fresh(self._clock.boot_ns())

    def send_commands(self, robot: str = "") -> None:
        """Send revocations and what waits to a robot, or to all; called in the event loop.

        Where too much waits to be sent already, this is done after the robot's next challenge.
        """
        for one in self.robots.values():
            is_meant = not robot or one.robot == robot
            is_there = one.contact is not None and one.contact.challenges
            if is_meant and is_there and one.contact is not None and not one.answers.full():
                one.answers.put_nowait(self._task(one, self._commands.send(one.contact)))

    async def _listen(self, one: RobotConnection) -> None:
        """Process frames until the connection ends, or nothing has arrived for too long."""
        while not one.end.closed:
            try:
                async with asyncio.timeout(self._silent_s):
                    data = await one.socket.receive()
                deeds = self._received(one, data)
            except (TimeoutError, SocketClosedError):
                return
            except FrameError as error:
                one.end.closed = True
                await one.answers.put((Bye(str(error)[: limits.TEXT_BYTES]),))
                return
            one.last_seen_ns, one.last_received_s = self._clock.wall_ns(), time.monotonic()
            for deed in deeds:
                await self._do(one, deed)

    def _received(self, one: RobotConnection, data: bytes) -> Sequence[LinkAction]:
        """Return what to do after a frame; raises FrameError for one that ends the connection."""
        try:
            return one.end.receive(from_robot(data))
        except UnknownFrameError:
            return one.end.receive_unknown()

    async def _do(self, one: RobotConnection, deed: LinkAction) -> None:
        if isinstance(deed, AdmitRobot):
            await self._admit(one, deed.hello)
        elif isinstance(deed, StoreRows):
            await one.answers.put(self._keep(one, deed))
        elif isinstance(deed, SendFrames):
            await one.answers.put(deed.frames)
        elif isinstance(deed, BeatFrame):
            await one.answers.put((one.end.pong(deed, self._clock.wall_ns()),))
            self._beat(one, deed)
        elif isinstance(deed, LiveFrame):
            self._hooks.live(one.robot, deed.values)
        elif isinstance(deed, HeadsFrame):
            await self._heads(one, deed)
        elif isinstance(deed, HasFrame):
            self._hooks.has(one.robot, _store_of(one), deed)
        elif isinstance(deed, IgnoreFrame):
            self.unknown_frames += 1
        elif isinstance(deed, ChallengeFrame | ActionsFrame | AnswersFrame):
            assert one.contact is not None
            await one.answers.put(self._task(one, self._commands.receive(one.contact, deed)))

    async def _admit(self, one: RobotConnection, hello: Hello) -> None:
        """Admit a robot; from now on its older connection is closed and cannot write."""
        now_ns = self._clock.wall_ns()
        work = partial(ledger.admit, hello=hello, now_ns=now_ns)
        admission = await asyncio.wrap_future(self._writes.submit(work))
        known = self.robots.get(one.robot)
        self.robots[one.robot] = one
        wants = self._wants_folder(hello)
        watch = self._watched.get(one.robot, ())
        welcome = one.end.admitted(
            admission, self._clock.wall_ns(), wants_folder=wants, watch=watch,
            server_id=self.server_id,
        )  # fmt: skip
        await one.answers.put((welcome,))
        if one.end.takes_commands:
            is_other = any(conflict.why == OTHER for conflict in admission.conflicts)
            one.contact = RobotContact(one.robot, admission.epoch, hello.store_id, is_other)
            await one.answers.put(self._task(one, self._commands.begin(one.contact)))
        self._hooks.admitted(hello, admission)
        if known is not None:
            known.end.closed = True
            await known.socket.close()

    def _wants_folder(self, hello: Hello) -> bool:
        known = is_config_hash(hello.config_hash)
        return known and self._hooks.wants_folder(hello.robot, hello.config_hash)

    def _keep(self, one: RobotConnection, deed: StoreRows) -> asyncio.Task[Sequence[ServerFrame]]:
        now_ns = self._clock.wall_ns()
        work = RowBatch(
            one.robot, deed.epoch, deed.store_id, deed.rows, deed.upto, deed.reaches, now_ns,
            deed.compare,
        )  # fmt: skip
        stored = asyncio.wrap_future(self._writes.submit(work))
        return asyncio.create_task(self._kept(one, deed, stored))

    def _task(
        self, one: RobotConnection, frames: Awaitable[Sequence[ServerFrame]]
    ) -> asyncio.Task[Sequence[ServerFrame]]:
        return asyncio.create_task(self._once_true(one, frames))

    async def _once_true(
        self, one: RobotConnection, frames: Awaitable[Sequence[ServerFrame]]
    ) -> Sequence[ServerFrame]:
        try:
            return await frames
        except StaleEpochError:
            return one.end.overtaken().frames

    async def _kept(
        self, one: RobotConnection, deed: StoreRows, stored: Awaitable[StoredRows]
    ) -> Sequence[ServerFrame]:
        try:
            found = await stored
        except StaleEpochError:
            return one.end.overtaken().frames
        if found.new:
            self._hooks.rows(one.robot, deed.store_id, found.new)
        return [one.end.stored(deed.number, found)]

    def _beat(self, one: RobotConnection, beat: BeatFrame) -> None:
        one.backlog = beat.backlog
        one.monitoring = link_state.reported_monitoring(beat)
        now_ns = one.last_seen_ns
        if now_ns - one.written_ns >= _SEEN_EVERY_NS and one.end.hello is not None:
            one.written_ns = now_ns
            self._writes.submit(partial(
                link_state.record_heartbeat, robot=one.robot, epoch=beat.epoch, beat=beat,
                boot=one.end.hello.boot_id, at_ns=now_ns,
            ))  # fmt: skip

    async def _heads(self, one: RobotConnection, deed: HeadsFrame) -> None:
        """Store a statement of heads before the next frame is read, so that none pile up."""
        if len(deed.heads) > _HEADS_BYTES:
            return
        kept = self._writes.submit(partial(
            link_state.keep_heads, robot=one.robot, store_id=_store_of(one), heads=deed.heads,
            at_ns=one.last_seen_ns,
        ))  # fmt: skip
        with suppress(AmberboxError):  # the database is busy: the next one supersedes it
            await asyncio.wrap_future(kept)

    async def _answer(self, one: RobotConnection) -> None:
        """Send answers in the order of their frames, each once it is true."""
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
            except Exception:  # an unexpected error; the listener must not wait for an answer
                logging.getLogger(__name__).exception("no answer to %s", one.robot)
                await _drop(one)
                return

    async def _left(self, one: RobotConnection) -> None:
        await one.socket.close()
        was_here = self.robots.get(one.robot) is one
        if was_here:
            del self.robots[one.robot]
        try:
            if one.end.epoch is not None:
                written = self._writes.submit(partial(
                    link_state.record_disconnect, robot=one.robot, epoch=one.end.epoch,
                    last_seen_ns=one.last_seen_ns,
                ))  # fmt: skip
                with suppress(AmberboxError):  # the database is busy: go on notifying
                    await asyncio.shield(asyncio.wrap_future(written))
        finally:
            if was_here:  # listeners find in the database when it was last seen
                self._hooks.gone(one.robot)


def _fitting(variables: Sequence[str]) -> Iterator[str]:
    """Yield the first of the names that fit in one frame."""
    left = _WATCHED_BYTES
    for name in variables[: limits.VARIABLES]:
        left -= len(name.encode("utf-8", "replace"))
        if left < 0:
            return
        yield name


def _store_of(one: RobotConnection) -> str:
    return one.end.hello.store_id if one.end.hello is not None else ""


async def _drop(one: RobotConnection) -> None:
    """Close a connection and empty its queue, so that its listener ends."""
    one.end.closed = True
    await one.socket.close()
    await asyncio.gather(*_unanswered(one), return_exceptions=True)


def _unanswered(one: RobotConnection) -> list[asyncio.Task[Sequence[ServerFrame]]]:
    """Empty the queue of answers; return those whose work is not finished."""
    found = []
    while not one.answers.empty():
        answer = one.answers.get_nowait()
        if isinstance(answer, asyncio.Task):
            found.append(answer)
    return found


# Keys also expire, or are revoked by another process: interval of the check of all connections
EVERY_S = 3.0


class SessionRevocation:
    """Closes connections whose key was revoked: when a key changes, else at the next check."""

    def __init__(
        self,
        database: ServerDatabase,
        bus: EventBus,
        clock: Clock,
        links: LinkServer,
        every_s: float = EVERY_S,
    ) -> None:
        self._database = database
        self._clock = clock
        self._links = links
        self._every_s = every_s
        self._changed = asyncio.Event()
        bus.on("robot", lambda _: self._changed.set())
        bus.on("account", lambda _: self._changed.set())

    async def run(self) -> None:
        """Check all connections when a key has changed, and periodically."""
        while True:
            self._changed.clear()
            await self._look()
            try:
                async with asyncio.timeout(self._every_s):
                    await self._changed.wait()
            except TimeoutError:
                continue

    async def _look(self) -> None:
        robots = self._links.robots
        open_ = {robot: one.key_id for robot, one in robots.items() if one.key_id is not None}
        working = await asyncio.to_thread(self._working, set(open_.values())) if open_ else set()
        for robot in [robot for robot, key in open_.items() if key not in working]:
            one = self._links.robots.get(robot)
            if one is None or one.key_id != open_[robot]:
                continue  # it has reconnected with another key
            one.end.closed = True
            await self._links.send(robot, Bye("this key does not work any more", for_good=True))
            await one.socket.close()

    def _working(self, keys: Collection[str]) -> set[str]:
        """Return which keys are valid now, with one query."""
        now_ns = self._clock.wall_ns()
        joined = select(ROBOT_KEYS.c.key_id).join(ROBOTS, ROBOTS.c.robot == ROBOT_KEYS.c.robot)
        still = or_(ROBOT_KEYS.c.expires_ns.is_(None), ROBOT_KEYS.c.expires_ns > now_ns)
        wanted = joined.where(
            ROBOT_KEYS.c.revoked_ns.is_(None), still, ROBOTS.c.disabled_ns.is_(None)
        )
        return {row.key_id for row in self._database.rows(wanted)} & set(keys)

    def close(self) -> None:
        """Do nothing: no resources are held."""
