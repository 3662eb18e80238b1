"""One connection of a robot's link: four small tasks around the rules of ``link/robotend.py``."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

from amberbox.blackbox.signing.signing import HEADS
from amberbox.link import limits
from amberbox.link.frames import (
    Ack,
    Beat,
    Bye,
    Durable,
    Fetch,
    Heads,
    Live,
    Pong,
    RobotFrame,
    Rows,
    ServerFrame,
    Watch,
    Welcome,
    encode,
    from_server,
)
from amberbox.link.positions import START, Place, Reach
from amberbox.link.robotend import RobotEnd
from amberbox.monitoring.messages.pulse import monitoring_of
from amberbox.robot.link.dialing import Line, LinkDownError
from amberbox.robot.link.network import Allowed, allowed
from amberbox.robot.link.reaching import Reaches
from amberbox.robot.link.remembered import Remembered, remember
from amberbox.robot.link.tails import RawTail

if TYPE_CHECKING:
    from amberbox.robot.link.client import LinkClient

READ_S = 0.05
LIVE_S = 0.2
IDLE_BEATS = 10
"""How often a robot without news says how far its journals reach, in heartbeats."""
_NETWORK_BEATS = 10
"""The network is asked for once in so many heartbeats."""
_REMEMBER_BEATS = 5
_WAITING = 4000
"""Rows that are read ahead in a lane; the rest waits where it is, in the journal."""
_LAST_S = 5.0
"""How long the last rows may take when the link is to end."""


class Session:
    """What one connection knows; ``run`` until it breaks or is to stop."""

    def __init__(
        self,
        client: LinkClient,
        line: Line,
        welcome: Welcome,
        looking: Reaches,
        reaches: Mapping[str, Reach],
    ) -> None:
        self._client = client
        self._line = line
        self._looking = looking
        self._reaches = dict(reaches)
        self._end = RobotEnd()
        ends = {w: reaches[w].end if w in reaches else START for w in limits.WRITERS}
        self._end.welcome(welcome, ends)
        self._fresh: dict[str, RawTail] = {}
        self._old: dict[str, RawTail] = {}
        for writer in limits.WRITERS:
            start, join = self._end.starts(writer)
            self._fresh[writer] = RawTail(client.store, writer, join)
            if start < join:
                self._old[writer] = RawTail(client.store, writer, start)
        self._allowed = Allowed()
        self._offered = asyncio.Event()
        self._beats = 0
        self._told_at = -1
        self._ending = False
        self._heads = b""

    async def run(self, stop: asyncio.Event) -> None:
        """Serve the connection; raises LinkDownError when it breaks."""
        works = [self._listen(), self._read(), self._send_rows(), self._beat(), self._tell_live()]
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
            await asyncio.to_thread(self._remember)

    async def _last(self, tasks: list[asyncio.Task[None]]) -> None:
        """Send what is left, wait for its acknowledgement for a while, and say goodbye."""
        self._ending = True
        self._reaches = await asyncio.to_thread(self._looking.state)
        self._offered.set()
        await self._send(Durable(self._end.epoch, self._reaches))
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
            self._hear(from_server(data))

    def _hear(self, frame: ServerFrame) -> None:
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
        elif isinstance(frame, Watch):
            self._client.look_at(frame.variables)
        elif isinstance(frame, Fetch):
            self._client.asked.fetch(frame)
        elif isinstance(frame, Bye):
            raise LinkDownError(f"the server says: {frame.reason}")

    async def _read(self) -> None:
        """Read the journals as far as there is room for rows; new ones first."""
        while True:
            moved = False
            for writer in [w for w in limits.WRITERS if w in self._reaches]:
                moved |= await self._read_fresh(writer)
                moved |= await self._read_old(writer)
            if moved:
                self._offered.set()
            await asyncio.sleep(0 if moved and self._old else READ_S)

    async def _read_fresh(self, writer: str) -> bool:
        tail, end = self._fresh[writer], self._end
        room = _WAITING - max(end.waiting("urgent"), end.waiting("status"))
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
            bare = self._ending or self._told_at != now  # other rows move it all the time
            frame = self._end.next_rows(self._allowed.lanes, self._most_bytes(), bare=bare)
            if frame is None:
                self._offered.clear()
                await self._offered.wait()
                continue
            self._told_at = now
            await self._paced(frame)

    def _most_bytes(self) -> int:
        """Return how large frames get: half a second of the rate, so urgent rows get through."""
        rate, most = self._client.bucket.rate, self._client.frame_bytes
        return int(min(most, max(rate / 2, 1000))) if rate else most

    async def _paced(self, frame: Rows) -> None:
        """Send rows no faster than the bandwidth that the link may take."""
        data = encode(frame)
        wait_s = self._client.bucket.take(len(data), asyncio.get_running_loop().time())
        if wait_s:
            await asyncio.sleep(wait_s)
        await self._line.send(data)
        self._client.progress.rows_sent += len(frame.rows)
        self._client.progress.bytes_sent += len(data)

    async def _beat(self) -> None:
        while True:
            if self._beats % _NETWORK_BEATS == 0:
                await self._look_at_network()
            if self._client.current_key() != self._client.said_key:
                raise LinkDownError("the store signs with a key that the server does not know yet")
            reaches = await asyncio.to_thread(self._looking.state)
            if self._is_due(reaches):
                await self._send(Durable(self._end.epoch, reaches))
                self._reaches = reaches
            await self._send(self._heartbeat(reaches))
            await self._tell_heads()
            self._beats += 1
            self._offered.set()
            if self._beats % _REMEMBER_BEATS == 0:
                await asyncio.to_thread(self._remember)
            await asyncio.sleep(limits.BEAT_S)

    def _is_due(self, reaches: Mapping[str, Reach]) -> bool:
        """Tell whether the server needs to know how far journals reach: for rows it waits with.

        Else now and then, for a robot that concludes nothing new; and when a run is over.
        """
        end = self._end
        waits = any(at > end.cursor.get(writer, START) for writer, at in end.said.items())
        return waits or self._beats % IDLE_BEATS == 0 or _closed(reaches) != _closed(self._reaches)

    def _heartbeat(self, reaches: Mapping[str, Reach]) -> Beat:
        client, offset = self._client, self._client.progress.offset
        client.progress.backlog = self._end.backlog(reaches)
        return Beat(
            self._end.epoch, client.clock.wall_ns(), client.clock.boot_ns(),
            client.progress.backlog, offset.offset_ns, offset.round_ns,
            client.progress.backlog_bytes, *monitoring_of(client.store, client.clock),
        )  # fmt: skip

    async def _look_at_network(self) -> None:
        options = self._client.options
        network = await asyncio.to_thread(self._client.network)
        self._allowed = allowed(network, options.metered, statuses=options.metered_statuses)
        self._offered.set()

    async def _tell_heads(self) -> None:
        """Send the signed statement of how far everything reaches, when there is a new one."""
        try:
            heads = (self._client.store.path / HEADS).read_bytes()
        except OSError:
            return
        if heads != self._heads and len(heads) < limits.ROW_BYTES:
            self._heads = heads
            await self._send(Heads(self._end.epoch, heads))

    async def _tell_live(self) -> None:
        while True:
            await asyncio.sleep(LIVE_S)
            values = self._client.live.take() if self._allowed.live else {}
            if values:
                await self._send(Live(self._end.epoch, values))
            while self._client.answers:
                await self._send(self._client.answers[0].of_epoch(self._end.epoch))
                self._client.answers.popleft()

    async def _send(self, frame: RobotFrame) -> None:
        await self._line.send(encode(frame))

    def _remember(self) -> None:
        """Write down how far the server has acknowledged; without room it is let go."""
        client = self._client
        cursor: dict[str, Place] = dict(self._end.cursor)
        with suppress(OSError):
            remember(
                client.store,
                Remembered(client.options.url, cursor, self._end.epoch, client.clock.wall_ns()),
            )


async def _set(stop: asyncio.Event) -> None:
    await stop.wait()


def _closed(reaches: Mapping[str, Reach]) -> dict[str, list[int]]:
    """Return the runs of each writer that are over."""
    return {w: [run.run for run in reach.runs if run.closed] for w, reach in reaches.items()}
