"""The robot's link client: connects, sends rows until acknowledged, reconnects.

It only reads the journals, so recording is independent of the link. A session is one connection:
small tasks around the rules of ``link/robot_end.py``. Positions that the server acknowledged are
kept in a small file of the store. The offset between the server's clock and the robot's is
estimated from the answer with the shortest round trip.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import ssl
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from amberbox.blackbox.signing.keys import public_key
from amberbox.blackbox.signing.signatures import HEADS
from amberbox.blackbox.store.store import FOLDERS, Store
from amberbox.core.clock import Clock, SystemClock
from amberbox.core.errors import AmberboxError
from amberbox.core.files import replace_file
from amberbox.core.pacing import Backoff, TokenBucket
from amberbox.core.tls import PinError
from amberbox.core.version import __version__
from amberbox.link import limits
from amberbox.link.command_port import CommandPort, NoCommands
from amberbox.link.connection import (
    LinkConnection,
    LinkDownError,
    LinkOptions,
    LinkRefusedError,
    dial,
    greet,
    tls_context,
)
from amberbox.link.frames import (
    START,
    AbortFrame,
    Ack,
    AnsweredFrame,
    BeatFrame,
    Bye,
    CommandsFrame,
    ConfirmFrame,
    DurableFrame,
    FetchFrame,
    FrameError,
    HasFrame,
    HeadsFrame,
    Hello,
    JournalPosition,
    LeaseFrame,
    LiveFrame,
    Pong,
    RevokedFrame,
    RobotFrame,
    ServerCommandFrame,
    ServerFrame,
    UnknownFrameError,
    WatchFrame,
    Welcome,
    WriterReach,
    encode,
    from_server,
)
from amberbox.link.policy import AllowedTraffic, Network, allowed_traffic, current_network
from amberbox.link.record_reader import LinkEvents, LiveValues, RawRowTail, ReachReader
from amberbox.link.robot_end import Lane, OutOfStepError, RobotEnd

# A wall clock that moved more than this against the time since boot was set
STEP_NS = 50_000_000


@dataclass(slots=True)
class OffsetEstimate:
    """Server's clock minus robot's wall clock in this boot, from the shortest round trip.

    Either direction may have been delayed, so the error is at most half of ``round_ns``.
    """

    offset_ns: int | None = None
    round_ns: int | None = None
    _base_ns: int | None = None

    def add(self, sent_ns: int, received_ns: int, server_ns: int, wall_ns: int) -> None:
        """Add one answer: times since boot of request and answer, and both wall clocks (all ns).

        ``wall_ns`` is the robot's wall clock at the answer. After the wall clock was set, earlier
        measurements are discarded.
        """
        round_ns, base_ns = received_ns - sent_ns, wall_ns - received_ns
        if round_ns < 0:
            return
        if self._base_ns is not None and abs(base_ns - self._base_ns) > STEP_NS:
            self.round_ns = None
        if self.round_ns is None or round_ns < self.round_ns:
            self.offset_ns = server_ns - (wall_ns - round_ns // 2)
            self.round_ns, self._base_ns = round_ns, base_ns


POSITIONS_FILE = "link.json"


@dataclass(frozen=True, slots=True)
class AcknowledgedPositions:
    """The positions that the server acknowledged; ``server`` is its URL, times by the robot's
    clock.

    Used for display and for counting the backlog; sending continues from the server's welcome.
    """

    server: str
    cursor: Mapping[str, JournalPosition] = field(default_factory=dict)
    epoch: int = 0
    at_ns: int = 0


def save_acknowledged(store: Store, what: AcknowledgedPositions) -> None:
    """Write the positions atomically: a power cut leaves the old or the new file.

    Raises OSError when the disk refuses it.
    """
    cursor = {writer: [at.run, at.seq] for writer, at in what.cursor.items()}
    values = {"server": what.server, "store_id": store.id, "cursor": cursor,
              "epoch": what.epoch, "at_ns": what.at_ns}  # fmt: skip
    replace_file(store.path / POSITIONS_FILE, json.dumps(values) + "\n")


def load_acknowledged(store: Store) -> AcknowledgedPositions | None:
    """Read the positions; None without a valid file of this store."""
    try:
        values = json.loads((store.path / POSITIONS_FILE).read_text())
        if values["store_id"] != store.id:
            return None
        cursor = {
            w: JournalPosition(int(run), int(seq)) for w, (run, seq) in values["cursor"].items()
        }
        return AcknowledgedPositions(
            values["server"], cursor, int(values["epoch"]), int(values["at_ns"])
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None


READ_S = 0.05
LIVE_S = 0.2
# How often an idle robot sends how far its journals reach, in heartbeats
IDLE_BEATS = 10
# The network is queried once in so many heartbeats
_NETWORK_BEATS = 10
_SAVE_BEATS = 5
# Rows that are read ahead in a lane; the rest is read from the journal later
_WAITING = 4000
# Time limit in seconds for the last rows when the link is to end
_LAST_S = 5.0


class LinkSession:
    """One connection to the server; ``run`` until it breaks or is to stop."""

    def __init__(
        self,
        client: LinkClient,
        line: LinkConnection,
        welcome: Welcome,
        reach_reader: ReachReader,
        reaches: Mapping[str, WriterReach],
        capabilities: Sequence[str] = (),
    ) -> None:
        self._client = client
        self._line = line
        self._server_id = welcome.server_id
        self._reach_reader = reach_reader
        self._end = RobotEnd()
        ends = {w: reaches[w].end if w in reaches else START for w in limits.WRITERS}
        self._end.welcome(welcome, ends, capabilities)
        self._reaches = self._taken(reaches)
        self._fresh: dict[str, RawRowTail] = {}
        self._old: dict[str, RawRowTail] = {}
        for writer in self._end.writers:
            start, join = self._end.starts(writer)
            self._fresh[writer] = RawRowTail(client.store, writer, join)
            if start < join:
                self._old[writer] = RawRowTail(client.store, writer, start)
        self._allowed = AllowedTraffic()
        self._offered = asyncio.Event()
        self._beats = 0
        self._bare_at = -1
        self._ending = False
        self._heads = b""

    @property
    def left_out(self) -> frozenset[str]:
        """Folders of journals that the server does not know."""
        unknown = {w for w in limits.WRITERS if w not in self._end.writers}
        if limits.DETECT_JOURNALS not in self._client.server_can:
            unknown.add("detect")
        return frozenset(FOLDERS[writer] for writer in unknown)

    def _taken(self, reaches: Mapping[str, WriterReach]) -> dict[str, WriterReach]:
        return {writer: reaches[writer] for writer in self._end.writers if writer in reaches}

    async def run(self, stop: asyncio.Event) -> None:
        """Serve the connection; raises LinkDownError when it breaks."""
        works = [self._listen(), self._read(), self._send_rows(), self._beat(), self._send_live()]
        if self._end.carries_commands:
            self._client.port.begin(self._server_id)
            works.append(self._send_reports())
        tasks = [asyncio.create_task(work) for work in works]
        stopping = asyncio.create_task(_set(stop))
        try:
            await asyncio.wait([*tasks, stopping], return_when=asyncio.FIRST_COMPLETED)
            if stop.is_set() and not any(task.done() for task in tasks):
                await self._last(tasks)
            for task in tasks:
                if task.done():
                    task.result()
        finally:
            for task in [*tasks, stopping]:
                task.cancel()
            await asyncio.gather(*tasks, stopping, return_exceptions=True)
            if self._end.carries_commands:
                self._client.port.end()
            await asyncio.to_thread(self._save_positions)

    async def _last(self, tasks: list[asyncio.Task[None]]) -> None:
        """Send the last rows, wait for their acknowledgement for a while, and send Bye."""
        self._ending = True
        self._reaches = self._taken(await asyncio.to_thread(self._reach_reader.state))
        self._offered.set()
        await self._send(DurableFrame(self._end.epoch, self._reaches))
        until = asyncio.get_running_loop().time() + _LAST_S
        while asyncio.get_running_loop().time() < until and not any(t.done() for t in tasks):
            if all(self._end.cursor.get(w, START) >= r.durable for w, r in self._reaches.items()):
                break
            await asyncio.sleep(READ_S)
        with suppress(LinkDownError):
            await self._send(Bye("the robot's agent stops"))

    async def _listen(self) -> None:
        while True:
            try:
                async with asyncio.timeout(limits.SILENT_S):
                    data = await self._line.receive()
            except TimeoutError:
                raise LinkDownError(f"nothing was heard for {limits.SILENT_S:g} s") from None
            try:
                frame = from_server(data)
            except UnknownFrameError:
                self._client.progress.unknown_frames += 1
            else:
                self._handle(frame)

    def _handle(self, frame: ServerFrame) -> None:
        if isinstance(frame, Ack):
            if frame.number > self._end.acked:
                self._client.frame_bytes = min(self._client.frame_bytes * 2, limits.ROWS_BYTES)
            self._end.acknowledged(frame)
            self._offered.set()
        elif isinstance(frame, Pong):
            self._client.progress.offset.add(
                frame.mono_ns, self._client.clock.boot_ns(), frame.wall_ns,
                self._client.clock.wall_ns(),
            )  # fmt: skip
        elif isinstance(frame, WatchFrame):
            self._client.watch_variables(frame.variables)
        elif isinstance(frame, FetchFrame):
            self._client.asked.fetch(frame)
        elif isinstance(frame, Bye):
            raise LinkDownError(f"the server says: {frame.reason}")
        elif not isinstance(frame, Welcome):
            self._handle_commands(frame)

    def _handle_commands(self, frame: ServerCommandFrame) -> None:
        """Pass a frame to the gate; without the capability it is one that is not known here."""
        port = self._client.port
        if not self._end.carries_commands:
            self._client.progress.unknown_frames += 1
        elif isinstance(frame, CommandsFrame):
            port.commands(frame.commands)
        elif isinstance(frame, AnsweredFrame):
            port.answered(frame.number)
        elif isinstance(frame, RevokedFrame):
            port.revoked(frame.keys)
        elif isinstance(frame, LeaseFrame):
            port.lease(frame)
        elif isinstance(frame, AbortFrame):
            port.abort(frame)
        elif isinstance(frame, ConfirmFrame):
            port.confirm(frame)

    async def _send_reports(self) -> None:
        while True:
            for frame in self._end.command_frames(await self._client.port.report()):
                await self._send(frame)

    async def _read(self) -> None:
        """Read new rows first, then old ones, as far as the lanes have room."""
        while True:
            moved = False
            for writer in list(self._reaches):
                moved |= await self._read_fresh(writer)
                moved |= await self._read_old(writer)
            if moved:
                self._offered.set()
            await asyncio.sleep(0 if moved and self._old else READ_S)

    async def _read_fresh(self, writer: str) -> bool:
        tail, end = self._fresh[writer], self._end
        # reports of an action that wait for a slow line do not keep alarms from being read
        is_later = writer in limits.LATER_WRITERS
        lanes: tuple[Lane, ...] = ("command",) if is_later else ("urgent", "status")
        room = _WAITING - max(map(end.waiting, lanes))
        before = tail.place
        if room <= 0:
            return False
        rows = await asyncio.to_thread(tail.pull, room)
        end.offer_fresh(writer, rows, tail.place)
        return bool(rows) or tail.place > before

    async def _read_old(self, writer: str) -> bool:
        tail = self._old.get(writer)
        room = _WAITING - self._end.waiting("backlog")
        if tail is None or room <= 0:
            return False
        rows = await asyncio.to_thread(tail.pull, room)
        join = self._end.starts(writer)[1]
        self._end.offer_backlog(writer, rows, min(tail.place, join))
        if self._end.is_caught_up(writer):
            del self._old[writer]
        return True

    async def _send_rows(self) -> None:
        while True:
            now = self._beats // IDLE_BEATS
            bare = self._ending or self._bare_at != now  # other rows move it all the time
            frame = self._end.next_rows(self._allowed.lanes, self._most_bytes(), bare=bare)
            if frame is None:
                self._offered.clear()
                await self._offered.wait()
                continue
            self._bare_at = now
            data = encode(frame)
            wait_s = self._client.bucket.take(len(data), asyncio.get_running_loop().time())
            if wait_s:
                await asyncio.sleep(wait_s)
            await self._line.send(data)
            self._client.progress.rows_sent += len(frame.rows)
            self._client.progress.bytes_sent += len(data)

    def _most_bytes(self) -> int:
        """Return the frame size in bytes: half a second of the rate, so that urgent rows get
        through.
        """
        rate, most = self._client.bucket.rate, self._client.frame_bytes
        return int(min(most, max(rate / 2, 1000))) if rate else most

    async def _beat(self) -> None:
        while True:
            if self._beats % _NETWORK_BEATS == 0:
                options = self._client.options
                network = await asyncio.to_thread(self._client.network)
                self._allowed = allowed_traffic(
                    network, options.metered, statuses=options.metered_statuses
                )
                self._offered.set()
            if self._client.current_key() != self._client.announced_key:
                raise LinkDownError("the store signs with a key that the server does not know yet")
            reaches = self._taken(await asyncio.to_thread(self._reach_reader.state))
            if self._is_due(reaches):
                await self._send(DurableFrame(self._end.epoch, reaches))
                self._reaches = reaches
            await self._send(self._heartbeat(reaches))
            await self._send_heads()
            self._beats += 1
            self._offered.set()
            if self._beats % _SAVE_BEATS == 0:
                await asyncio.to_thread(self._save_positions)
            await asyncio.sleep(limits.BEAT_S)

    def _is_due(self, reaches: Mapping[str, WriterReach]) -> bool:
        """Return whether to send the journals' reach: for unacknowledged rows, or when a run has
        ended.

        An idle robot sends it every ``IDLE_BEATS`` heartbeats.
        """
        end = self._end
        waits = any(at > end.cursor.get(writer, START) for writer, at in end.sent_upto.items())
        return waits or self._beats % IDLE_BEATS == 0 or _closed(reaches) != _closed(self._reaches)

    def _heartbeat(self, reaches: Mapping[str, WriterReach]) -> BeatFrame:
        client, offset = self._client, self._client.progress.offset
        client.progress.backlog = self._end.backlog(reaches)
        return BeatFrame(
            self._end.epoch, client.clock.wall_ns(), client.clock.boot_ns(),
            client.progress.backlog, offset.offset_ns, offset.round_ns,
            client.progress.backlog_bytes, *client.monitoring(client.store, client.clock),
        )  # fmt: skip

    async def _send_heads(self) -> None:
        """Send the signed heads, when there are new ones."""
        try:
            heads = (self._client.store.path / HEADS).read_bytes()
        except OSError:
            return
        if heads != self._heads and len(heads) < limits.ROW_BYTES:
            self._heads = heads
            await self._send(HeadsFrame(self._end.epoch, heads))

    async def _send_live(self) -> None:
        while True:
            await asyncio.sleep(LIVE_S)
            values = self._client.live.take() if self._allowed.live else {}
            if values:
                await self._send(LiveFrame(self._end.epoch, values))
            while self._client.answers:
                await self._send(self._client.answers[0].of_epoch(self._end.epoch))
                self._client.answers.popleft()

    async def _send(self, frame: RobotFrame) -> None:
        await self._line.send(encode(frame))

    def _save_positions(self) -> None:
        """Write the acknowledged positions; skip it when the disk refuses it."""
        client = self._client
        cursor: dict[str, JournalPosition] = dict(self._end.cursor)
        with suppress(OSError):
            save_acknowledged(
                client.store,
                AcknowledgedPositions(
                    client.options.url, cursor, self._end.epoch, client.clock.wall_ns()
                ),
            )


async def _set(stop: asyncio.Event) -> None:
    await stop.wait()


def _closed(reaches: Mapping[str, WriterReach]) -> dict[str, list[int]]:
    """Return the closed runs of each writer."""
    return {w: [run.run for run in reach.runs if run.closed] for w, reach in reaches.items()}


# 2024-01-01: an earlier clock has not been set
_EARLIEST_NS = 1_704_067_200 * 1_000_000_000

_LEAST_FRAME = 2048

Dial = Callable[[LinkOptions, ssl.SSLContext | None], Awaitable[LinkConnection]]


@dataclass(slots=True)
class ServerRequestHandlers:
    """Handlers of the server's requests to the agent; called in the event loop."""

    fetch: Callable[[FetchFrame], None] = lambda frame: None
    folder: Callable[[str], None] = lambda config_hash: None


@dataclass(frozen=True, slots=True)
class FetchAnswer:
    """The answer to a fetch request: journals that hold the window, with name and bytes."""

    id: str
    files: tuple[tuple[str, int], ...]

    def of_epoch(self, epoch: int) -> HasFrame:
        """Return the frame for the server."""
        return HasFrame(epoch, list(self.files[: limits.FILES]), self.id)


@dataclass(slots=True)
class LinkProgress:
    """State of the link: connected or not, the last trouble, counters, backlog, clock offset."""

    connected: bool = False
    trouble: str = ""
    attempts: int = 0
    contacts: int = 0
    backlog: int = 0
    backlog_bytes: int = 0
    rows_sent: int = 0
    bytes_sent: int = 0
    unknown_frames: int = 0
    """Frames of the server that were ignored: this version does not know them."""
    offset: OffsetEstimate = field(default_factory=OffsetEstimate)


# Returns the state of a store's watcher, and how late it evaluates rows, in seconds
MonitoringState = Callable[[Store, Clock], tuple[str, float]]


class LinkClient:
    """Keeps one store linked to one server; ``run`` until ``stop`` is set."""

    def __init__(
        self,
        store: Store,
        options: LinkOptions,
        *,
        asked: ServerRequestHandlers | None = None,
        port: CommandPort | None = None,
        clock: Clock | None = None,
        network: Callable[[], Network] = current_network,
        monitoring: MonitoringState = lambda store, clock: ("", 0.0),
        dialer: Dial = dial,
        backoff: Backoff | None = None,
    ) -> None:
        self.store = store
        self.options = options
        self.asked = asked or ServerRequestHandlers()
        self.port: CommandPort = port or NoCommands()
        self.clock = clock or SystemClock()
        self.network = network
        self.monitoring = monitoring
        self.progress = LinkProgress()
        self.bucket = TokenBucket(options.rate)
        self.frame_bytes = limits.ROWS_BYTES
        """How large frames of rows get: smaller after trouble, so that some get through."""
        self.live = LiveValues(store)
        self.answers: deque[FetchAnswer] = deque()
        """Answers to fetch requests; they wait for a connection."""
        self.left_out = frozenset(FOLDERS[writer] for writer in (*limits.LATER_WRITERS, "detect"))
        """Folders of journals that the server does not know, as far as it has said yet."""
        self.server_can: frozenset[str] = frozenset()
        """What the server says that it can."""
        self.announced_key = ""
        """The public key that was sent to the server, which verifies journals with it."""
        self._dial = dialer
        self._backoff = backoff or Backoff()
        self._reaches = ReachReader(store)
        self._link_events = LinkEvents(store)

    async def run(self, stop: asyncio.Event) -> None:
        """Reconnect until ``stop``; then send the durable rows, and end."""
        while not stop.is_set():
            self.progress.attempts += 1
            try:
                await self._once(stop)
                continue
            except (LinkDownError, FrameError, OutOfStepError, AmberboxError, OSError) as error:
                self.progress.connected = False
                self.progress.trouble = str(error)
                self.frame_bytes = max(self.frame_bytes // 4, _LEAST_FRAME)
                if isinstance(error, (LinkRefusedError, PinError)):
                    self._link_events.emit("link_refused", str(error))
            with contextlib.suppress(asyncio.TimeoutError):
                async with asyncio.timeout(self._backoff.failed()):
                    await stop.wait()
        await asyncio.to_thread(self.live.close)

    async def _once(self, stop: asyncio.Event) -> None:
        """Run one connection from its beginning to its end."""
        if self.clock.wall_ns() < _EARLIEST_NS:
            text = "the clock was not set: the server is verified by its authority, not by dates"
            self._link_events.emit("clock_not_set", text)
        else:
            self._link_events.clear("clock_not_set")
        context = await asyncio.to_thread(
            tls_context, self.options.url, self.options.ca, self.store.path
        )
        line = await self._dial(self.options, context)
        try:
            session = await self._greet(line)
            self.left_out = session.left_out
            self._backoff.succeeded()
            self._link_events.clear("link_refused")
            self.progress.connected, self.progress.trouble = True, ""
            self.progress.contacts += 1
            await session.run(stop)
        finally:
            self.progress.connected = False
            await line.close()

    def current_key(self) -> str:
        """Return the public key that the store signs with; empty before the keeper has made it."""
        return public_key(self.store.path) or ""

    async def _greet(self, line: LinkConnection) -> LinkSession:
        """Send Hello; raises LinkRefusedError when the server refuses the robot."""
        reaches = await asyncio.to_thread(self._reaches.state)
        self.announced_key = self.current_key()
        capabilities = list(self.port.capabilities)
        first = {w: reach for w, reach in reaches.items() if w in limits.FIRST_WRITERS}
        more = {w: reach for w, reach in reaches.items() if w not in first}
        hello = Hello(
            self.options.robot, self.store.id, self.clock.boot_id(), first,
            self.options.config_hash, self.clock.wall_ns(), self.clock.boot_ns(), __version__,
            public_key=self.announced_key, capabilities=capabilities, more=more,
        )  # fmt: skip
        answer = await greet(line, hello)
        self.server_can = frozenset(answer.capabilities)
        if answer.wants_folder:
            self.asked.folder(self.options.config_hash)
        self.watch_variables(answer.watch)
        return LinkSession(self, line, answer, self._reaches, reaches, capabilities)

    def watch_variables(self, variables: Sequence[str]) -> None:
        """Send the latest values of these variables from now on, if the folder allows it."""
        if self.options.live:
            self.live.watch(variables)
