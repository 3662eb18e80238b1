"""Tells browsers and programs what has changed."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

from amberbox.core.clock import Clock
from amberbox.fleet.alarms.listing import robots_of
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.database.database import Database
from amberbox.fleet.feed.ages import EVERY_S as AGES_S
from amberbox.fleet.feed.ages import ages_data
from amberbox.fleet.feed.changes import (
    Changed,
    StatusMemory,
    diagnosis_data,
    event_data,
    statuses_data,
)
from amberbox.fleet.feed.delta import Delta, Kind, Ring
from amberbox.fleet.feed.gate import permission
from amberbox.fleet.feed.listener import Filter, Listener
from amberbox.fleet.feed.live import EVERY_S, Live
from amberbox.fleet.feed.silence import LOOK_S, Silence
from amberbox.fleet.linkend.server import LinkServer
from amberbox.fleet.state.standing import SILENT_NS, Moment, clock_offsets_ns
from amberbox.fleet.state.state import Snapshot, State

GATHER_S = 0.05
"""Changes of statuses are gathered for so long: many of one robot go as one."""
CHECK_S = 30.0
ENDED, FORBIDDEN = 4401, 4403
MOST, MOST_EACH = 500, 8
"""Listeners at a time, in all and of one person or token."""
_MAKING = 2
"""Snapshots that are made at a time."""


class Feed:
    """Numbers changes, holds the newest, and wakes those who listen. All in the event loop."""

    def __init__(
        self, database: Database, bus: Bus, clock: Clock, links: LinkServer, state: State
    ) -> None:
        self.state = state
        self.ring = Ring(clock.wall_ns())
        self._first = self.ring.number
        self.live = Live(links, lambda: [one.watch for one in self.listeners])
        self.listeners: list[Listener] = []
        self._links = links
        self._database = database
        self._bus = bus
        self._clock = clock
        self._memory = StatusMemory()
        self._silence = Silence()
        self._repeated: set[str] = set()
        self._pending: dict[str, list[dict[tuple[str, str], Changed]]] = {}
        self._is_due = False
        self._last_s = 0.0
        self._check = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        self._making = asyncio.Semaphore(_MAKING)
        self._joined: dict[tuple[Filter, int, int], tuple[int, str]] = {}
        self._joined_at = 0

    async def run(self) -> None:
        """Listen to what happens until cancelled."""
        await asyncio.to_thread(self._load)
        ends = [self._bus.on(kind, work) for kind, work in self._hears()]
        works = (self.state.run(), self.live.run(), self._checks(), self._lives(),
                 self._silences(), self._ages())  # fmt: skip
        try:
            async with asyncio.TaskGroup() as group:  # none of them goes on without the others
                for work in works:
                    group.create_task(work)
        finally:
            for end in ends:
                end()

    def close(self) -> None:
        """Send everybody away."""
        for listener in self.listeners:
            listener.end(1001, "the server stops")

    @property
    def told(self) -> int:
        """Return how many changes were told since the start."""
        return self.ring.number - self._first

    def join(self, listener: Listener) -> bool:
        """Let somebody listen; False when there are too many."""
        own = sum(one.who == listener.who for one in self.listeners)
        if len(self.listeners) >= MOST or own >= MOST_EACH:
            return False
        self.listeners.append(listener)
        return True

    def leave(self, listener: Listener) -> None:
        """End listening."""
        with suppress(ValueError):
            self.listeners.remove(listener)
        self.live.look_again()

    def add(self, kind: Kind, robot: str, data: Any, owner: str = "") -> None:
        """Hold a change and wake those who listen."""
        self._wake([self.ring.add(kind, robot, data, time.monotonic(), owner)])

    def _hears(self) -> Iterator[tuple[Any, Callable[[Change], None]]]:
        yield from (("rows", self._rows), ("live", self._values))
        yield from (("connected", self._connected), ("gone", self._gone))
        yield from (("account", self._accounts), ("robot", self._accounts))
        yield "alarm", self._alarm
        yield "job", lambda c: self.add("job", c.robot, dict(c.data), str(c.data.get("owner", "")))
        yield "fetch", lambda c: self.add("fetch", c.robot, {"id": c.data["id"]})
        yield "diagnosis", lambda c: self.add("diagnosis", c.robot, [dict(c.data)])

    def _load(self) -> None:
        with self._database.reading() as connection:
            self._memory.load(connection)

    def _rows(self, change: Change) -> None:
        robot, rows = change.robot, change.data["rows"]
        for kind, data in (("event", event_data(rows)), ("diagnosis", diagnosis_data(rows))):
            if data:
                self.add(kind, robot, data)  # type: ignore[arg-type]  # one of two literals
        self._repeated.add(robot)
        now_ns = self._clock.wall_ns()
        changed = self._memory.changed(robot, change.data["store_id"], rows, now_ns)
        if changed:
            self._pending.setdefault(robot, []).append(changed)
            self._plan()

    def _plan(self) -> None:
        """Send what is pending soon: at once, if nothing was sent for a while."""
        if not self._is_due:
            self._is_due = True
            wait_s = max(self._last_s + GATHER_S - time.monotonic(), 0.0)
            asyncio.get_running_loop().call_later(wait_s, self._flush)

    def _flush(self) -> None:
        self._is_due, self._last_s = False, time.monotonic()
        pending, self._pending = self._pending, {}
        added = [
            self.ring.add(kind, robot, data, self._last_s)
            for robot, changed in pending.items()
            for kind, data in statuses_data(changed)
        ]
        self._wake(added)

    def _wake(self, deltas: Sequence[Delta]) -> None:
        """Wake who hears one of these changes; the others pass over them at their next ping."""
        for listener in self.listeners:
            if any(map(listener.filter.hears, deltas)):
                listener.wake.set()

    def _connected(self, change: Change) -> None:
        self.add("presence", change.robot, {"online": True})

    def _gone(self, change: Change) -> None:
        self.add("presence", change.robot, {"online": False})

    def _alarm(self, change: Change) -> None:
        """Tell of an alarm; of one about several robots for each of them."""
        if change.robot:
            return self.add("alarm", change.robot, dict(change.data))
        task = asyncio.create_task(self._common_alarm(change.data))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return None

    async def _common_alarm(self, data: Mapping[str, Any]) -> None:
        for robot in await asyncio.to_thread(self._robots_of, data["id"]):
            self.add("alarm", robot, dict(data))

    def _robots_of(self, number: int) -> list[str]:
        with self._database.reading() as connection:
            return [row["robot"] for row in robots_of(connection, [number])[number]]

    def _values(self, change: Change) -> None:
        self.live.take(change.robot, change.data["values"])

    async def _lives(self) -> None:
        """Hand live values out, those of one set of variables written once."""
        while True:
            await asyncio.sleep(EVERY_S)
            news = self.live.news()
            texts: dict[tuple[str, tuple[str, ...]], str] = {}
            for listener in self.listeners if news else ():
                for robot, names in listener.watch.items():
                    key = robot, tuple(names)
                    if robot in news and key not in texts:
                        texts[key] = self.live.text(self.ring.number, robot, names)
                    if texts.get(key):
                        listener.live[robot] = texts[key]
                        listener.wake.set()

    async def _silences(self) -> None:
        """Tell of robots that miss heartbeats while their link holds, and of silent watchers."""
        while True:
            await asyncio.sleep(LOOK_S)
            unheard = self._memory.unheard(self._clock.wall_ns() - SILENT_NS)
            for robot, data in (
                *self._silence.news(self._links.robots),
                *self._silence.watchers(self._links.robots, unheard),
            ):
                self.add("presence", robot, data)

    async def _ages(self) -> None:
        """Tell how old statuses are, of robots that said them again, as long as somebody asks."""
        while True:
            await asyncio.sleep(AGES_S)
            repeated, self._repeated = self._repeated, set()
            heard = {robot for one in self.listeners for robot in one.robots_of("ages")}
            wanted = sorted(repeated & heard)
            offsets = await asyncio.to_thread(self._offsets, wanted) if wanted else {}
            now_ns = self._clock.wall_ns()
            for robot in wanted:
                known = self._memory.standing(robot)
                if known:
                    self.add("ages", robot, ages_data(known, Moment(now_ns, offsets.get(robot))))

    def _offsets(self, robots: Sequence[str]) -> Mapping[str, int]:
        with self._database.reading() as connection:
            return clock_offsets_ns(connection, robots)

    def _accounts(self, _: Change) -> None:
        self._check.set()

    async def _checks(self) -> None:
        """Ask again who may hear what: when accounts or robots change, and every 30 s."""
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(CHECK_S):
                    await self._check.wait()
            self._check.clear()
            for listener in tuple(self.listeners):
                await self.check(listener)

    async def check(self, listener: Listener) -> None:
        """Ask again what somebody may hear; ends what is not allowed any more."""
        found = await asyncio.to_thread(
            permission, self._database, self._clock, listener.credential
        )
        if found is None:
            listener.end(ENDED, "the session or token has ended")
        elif not found.may_listen:
            listener.end(FORBIDDEN, "this is not allowed any more")
        elif found != listener.permission:
            listener.permission, listener.needs_snapshot = found, True
            listener.settle()
            listener.wake.set()
            self.live.look_again()

    async def snapshot(self, listener: Listener) -> Snapshot:
        """Return how everything is that somebody listens to; a few at a time are made."""
        async with self._making:
            return await asyncio.to_thread(self._snapshot, listener)

    def _snapshot(self, listener: Listener) -> Snapshot:
        robots, kinds = listener.robots, {kind for kind, _ in listener.filter.reach}
        return self.state.snapshot(robots, self._clock.wall_ns(), with_statuses="status" in kinds)

    def frame(self, listener: Listener, deltas: Sequence[Delta], most: int) -> str:
        """Join changes for a listener, up to a size; equal listeners share what was joined."""
        key = listener.filter, listener.number, self.ring.number
        if key in self._joined:
            listener.number, text = self._joined[key]
            return text
        if self._joined_at != self.ring.number:
            self._joined, self._joined_at = {}, self.ring.number
        texts, size, number = [], 0, listener.number
        chosen = {delta.number for delta in deltas if listener.filter.hears(delta)}
        for delta in deltas:
            if size and delta.number in chosen and size + len(delta.text) > most:
                break
            number = delta.number
            if number in chosen:
                texts.append(delta.text)
                size += len(delta.text)
        text = ",".join(texts)
        if not any(delta.kind == "job" for delta in deltas):
            self._joined[key] = number, text
        listener.number = number
        return text

    def show_live(self, listener: Listener) -> None:
        """Ask for the live values that somebody looks at, and show those that are known."""
        self.live.look_again()
        for robot, names in listener.watch.items():
            text = self.live.text(self.ring.number, robot, names)
            if text:
                listener.live[robot] = text
