"""The live feed: pushes changes and live values to listeners, each over its WebSocket.

A listener first receives a snapshot, then changes in the order of their numbers.
"""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeAlias

from sqlalchemy import Connection, select

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS, Clock
from amberbox.core.errors import UsageError
from amberbox.link import limits
from amberbox.link.frames import LinkRow
from amberbox.server.alarms.store import robots_of
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.link_server import LinkServer, RobotConnection
from amberbox.server.live.listener import (
    ChangeRing,
    Delta,
    FeedFilter,
    Kind,
    LiveListener,
    message,
    parse_subscription,
    permission,
)
from amberbox.server.live.records import (
    SILENT_NS,
    DiagnosisRecord,
    EventRecord,
    RetainedStatus,
    ServerNow,
    StatusRecord,
    clock_offsets_ns,
    decode_record,
    format_moment,
    status_data,
)
from amberbox.server.live.views import FleetSnapshot, FleetState
from amberbox.server.schema import STATUS

AGES_S = 1.0
# Ages that differ by less are sent as one
_SIMILAR_NS = NS


def ages_data(
    statuses: Mapping[tuple[str, str], RetainedStatus], when: ServerNow
) -> Mapping[str, Any]:
    """Return the age of the newest measurements, and those of components and modes that are older.

    A robot sends all statuses each second, so most ages are alike and are sent once.
    """
    ages = {key: when.age_ns(status) for key, status in statuses.items()}
    newest = min(ages.values())
    older = [
        (*key, round(age / NS, 1)) for key, age in ages.items() if age > newest + _SIMILAR_NS
    ]  # fmt: skip
    return {"age_s": round(newest / NS, 2), "older": older}


# Largest number of remembered statuses per robot
_MOST = 2000
_NUMBER = re.compile(r"\d+(?:[.,]\d+)?")


@dataclass(frozen=True, slots=True)
class _KnownStatus:
    """The last status of a component or mode, and its position in the record."""

    store_id: str
    run: int
    seq: int
    standing: RetainedStatus

    @property
    def record(self) -> StatusRecord:
        return self.standing.record


@dataclass(frozen=True, slots=True)
class StatusChange:
    """A changed status; ``is_news``: more than its values has changed."""

    record: StatusRecord
    is_news: bool


class RetainedStatuses:
    """Keeps the last status of each component and mode."""

    def __init__(self) -> None:
        self._known: dict[str, dict[tuple[str, str], _KnownStatus]] = {}
        self._seen_ns: dict[str, int] = {}

    def load(self, connection: Connection) -> None:
        """Load the statuses from the database."""
        for row in connection.execute(select(STATUS)):
            record = decode_record(row.data, StatusRecord)
            if record is not None:
                standing = RetainedStatus(record, row.log_ns, row.received_ns)
                self._enter(row.robot, _KnownStatus(row.store_id, row.run, row.seq, standing))
                self._seen_ns[row.robot] = max(self._seen_ns.get(row.robot, 0), row.received_ns)

    def silent(self, since_ns: int) -> frozenset[str]:
        """Return the robots whose watchers have sent statuses, but none since a time (ns)."""
        return frozenset(name for name, at_ns in self._seen_ns.items() if at_ns < since_ns)

    def standing(self, robot: str) -> Mapping[tuple[str, str], RetainedStatus]:
        """Return the last status of each component and mode of a robot."""
        return {key: one.standing for key, one in self._known.get(robot, {}).items()}

    def changed(
        self, robot: str, store_id: str, rows: Iterable[LinkRow], now_ns: int
    ) -> dict[tuple[str, str], StatusChange]:
        """Return the statuses that have changed; late ones that arrive after newer ones are
        ignored.
        """
        found: dict[tuple[str, str], StatusChange] = {}
        for row in rows:
            record = (
                decode_record(row.data, StatusRecord) if row.channel == channels.STATUS else None
            )
            if record is None:
                continue
            self._seen_ns[robot] = now_ns
            key = record.component, record.mode
            before = self._known.get(robot, {}).get(key)
            if before is not None and _is_late(before, store_id, row):
                continue
            standing = RetainedStatus(record, row.log_ns, now_ns)
            self._enter(robot, _KnownStatus(store_id, row.run, row.seq, standing))
            if before is None or not _is_same(before.record, record):
                is_news = before is None or not _is_similar(before.record, record)
                found[key] = StatusChange(record, is_news or (key in found and found[key].is_news))
        return found

    def _enter(self, robot: str, known: _KnownStatus) -> None:
        statuses = self._known.setdefault(robot, {})
        key = known.record.component, known.record.mode
        if key in statuses or len(statuses) < _MOST:
            statuses[key] = known


def _is_late(before: _KnownStatus, store_id: str, row: LinkRow) -> bool:
    return before.store_id == store_id and (row.run, row.seq) <= (before.run, before.seq)


def _is_same(one: StatusRecord, other: StatusRecord) -> bool:
    return (
        (one.level, one.state, one.reason) == (other.level, other.state, other.reason)
        and one.blocked_by == other.blocked_by
        and one.outputs == other.outputs
    )


def _is_similar(one: StatusRecord, other: StatusRecord) -> bool:
    """Return whether statuses differ in values only, as numbers in reasons change all the time."""
    return (
        (one.level, one.state) == (other.level, other.state)
        and one.blocked_by == other.blocked_by
        and (one.reason == other.reason or _plain(one.reason) == _plain(other.reason))
    )


def _plain(reason: str) -> str:
    return _NUMBER.sub("#", reason)


def statuses_data(
    changed: Iterable[Mapping[tuple[str, str], StatusChange]],
) -> Iterator[tuple[Literal["status", "levels"], list[Mapping[str, Any]]]]:
    """Yield the newest of each changed status of a robot, in the form of the feed."""
    newest: dict[tuple[str, str], StatusRecord] = {}
    news: set[tuple[str, str]] = set()
    for some in changed:
        newest.update((key, one.record) for key, one in some.items())
        news.update(key for key, one in some.items() if one.is_news)
    yield "status", [status_data(record) for record in newest.values()]
    if news:
        yield "levels", [level_data(newest[key]) for key in newest if key in news]


def level_data(record: StatusRecord) -> Mapping[str, Any]:
    """Return a status without its values, in the form of the feed."""
    return {"component": record.component, "mode": record.mode, "level": record.level,
            "state": record.state}  # fmt: skip


def event_data(rows: Sequence[LinkRow]) -> list[Mapping[str, Any]]:
    """Return the events among rows, in the form of the feed."""
    found: list[Mapping[str, Any]] = []
    for row in rows:
        event = decode_record(row.data, EventRecord) if row.channel == channels.EVENT else None
        if event is not None:
            at = format_moment(row.log_ns)
            found.append({"at": at, "kind": event.kind, "text": event.text, "source": event.source})
    return found


def diagnosis_data(rows: Sequence[LinkRow]) -> list[Mapping[str, Any]]:
    """Return the newest revision of each diagnosis among rows, in the form of the feed."""
    found: dict[str, Mapping[str, Any]] = {}
    for row in rows:
        diagnosis = (
            decode_record(row.data, DiagnosisRecord) if row.channel == channels.DIAGNOSIS else None
        )
        if diagnosis is not None:
            first = diagnosis.hypotheses[0] if diagnosis.hypotheses else None
            found[diagnosis.id] = {
                "id": diagnosis.id,
                "revision": diagnosis.revision,
                "state": diagnosis.state,
                "at": format_moment(diagnosis.at_ns),
                "faults": first.faults if first else [],
                "probability": first.probability if first else 0.0,
            }
    return list(found.values())


_SILENCE_S = 0.2


class SilenceMonitor:
    """Tracks which robots are silent, and yields changes."""

    def __init__(self) -> None:
        self._silent: frozenset[str] = frozenset()
        self._silent_watchers: frozenset[str] = frozenset()

    def news(
        self, robots: Mapping[str, RobotConnection]
    ) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield robots that became silent or send again, with the data of their presence change.

        Robots whose link has ended are left out: that is published separately.
        """
        before, self._silent = self._silent, frozenset(
            name for name, one in robots.items() if one.is_silent
        )  # fmt: skip
        for name in sorted(self._silent - before):
            since = format_moment(robots[name].last_seen_ns)
            yield name, {"online": True, "silent": True, "since": since}
        for name in sorted(before - self._silent):
            if name in robots:
                yield name, {"online": True}

    def watchers(
        self, robots: Mapping[str, RobotConnection], silent: frozenset[str]
    ) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield connected robots whose watchers became silent, or send again.

        Their status then changes, even if no row has arrived.
        """
        changed, self._silent_watchers = self._silent_watchers ^ silent, silent
        for name in sorted(changed & robots.keys()):
            if not robots[name].is_silent:
                yield name, {"online": True}


Value: TypeAlias = "tuple[int, float | str | None]"
Watch: TypeAlias = "Mapping[str, Sequence[str]]"
EVERY_S = 0.2
_PATIENCE_S = 5.0


class LiveValueSource(Protocol):
    """Requests live values from robots."""

    async def watch(self, robot: str, variables: Sequence[str]) -> None:
        """Request the latest values of variables from now on."""


class LiveValueRelay:
    """Latest values of the variables that listeners watch; in memory only."""

    def __init__(self, links: LiveValueSource, wanted: Callable[[], Iterable[Watch]]) -> None:
        self._links = links
        self._wanted = wanted
        self._requested: dict[str, frozenset[str]] = {}
        self._values: dict[str, dict[str, Value]] = {}
        self._news: set[str] = set()
        self._changed = asyncio.Event()

    def look_again(self) -> None:
        """Note that the watched variables may have changed."""
        self._changed.set()

    def value(self, robot: str, variable: str) -> Value | None:
        """Return the latest value of a watched variable, with its time; None before one came."""
        return self._values.get(robot, {}).get(variable)

    def take(self, robot: str, values: Mapping[str, Value]) -> bool:
        """Store received values; return whether any of them is watched."""
        asked = self._requested.get(robot)
        known = {name: value for name, value in values.items() if asked and name in asked}
        if known:
            self._values.setdefault(robot, {}).update(known)
            self._news.add(robot)
        return bool(known)

    def news(self) -> set[str]:
        """Return the robots with new values since the last call."""
        found, self._news = self._news, set()
        return found

    def text(self, number: int, robot: str, variables: Iterable[str]) -> str:
        """Return the message with a robot's latest values; empty if there are none."""
        known = self._values.get(robot, {})
        data: dict[str, Any] = {
            name: {"at": format_moment(known[name][0]), "value": known[name][1]}
            for name in variables
            if name in known
        }
        return message(number, "live", robot, data) if data else ""

    async def run(self) -> None:
        """Request the watched variables from robots, each time they change."""
        while True:
            await self._changed.wait()
            self._changed.clear()
            union = _union(self._wanted())
            different = [
                robot
                for robot in {*union, *self._requested}
                if union.get(robot, frozenset()) != self._requested.get(robot, frozenset())
            ]
            self._requested = union
            for robot in different:
                self._forget(robot)
            await asyncio.gather(*(self._request_samples(robot) for robot in different))

    def _forget(self, robot: str) -> None:
        asked = self._requested.get(robot, frozenset())
        kept = {n: v for n, v in self._values.get(robot, {}).items() if n in asked}
        self._values[robot] = kept
        if not asked:
            del self._values[robot]

    async def _request_samples(self, robot: str) -> None:
        variables = sorted(self._requested.get(robot, ()))[: limits.VARIABLES]
        with suppress(TimeoutError):  # requested again when the robot reconnects
            async with asyncio.timeout(_PATIENCE_S):
                await self._links.watch(robot, variables)


def _union(watches: Iterable[Watch]) -> dict[str, frozenset[str]]:
    found: dict[str, set[str]] = {}
    for watch in watches:
        for robot, variables in watch.items():
            found.setdefault(robot, set()).update(variables)
    return {robot: frozenset(variables) for robot, variables in found.items() if variables}


# Changes of statuses are collected for so long: those of one robot are sent as one
GATHER_S = 0.05
CHECK_S = 30.0
ENDED, FORBIDDEN = 4401, 4403
# Largest number of listeners, in all and of one person or token
MOST, MOST_EACH = 500, 8
# Largest number of snapshots made at a time
_MAKING = 2


class Feed:
    """Numbers changes, keeps the newest, and wakes listeners. Runs in the event loop."""

    def __init__(
        self,
        database: ServerDatabase,
        bus: EventBus,
        clock: Clock,
        links: LinkServer,
        state: FleetState,
    ) -> None:
        self.state = state
        self.ring = ChangeRing(clock.wall_ns())
        self._first = self.ring.number
        self.live = LiveValueRelay(links, self._watches)
        self.listeners: list[LiveListener] = []
        self.own_watch: Mapping[str, frozenset[str]] = {}
        """Variables that the server itself reads live, by robot; ``watch`` sets them."""
        self._links = links
        self._database = database
        self._bus = bus
        self._clock = clock
        self._memory = RetainedStatuses()
        self._silence = SilenceMonitor()
        self._repeated: set[str] = set()
        self._reported: set[str] = set()
        self._pending: dict[str, list[dict[tuple[str, str], StatusChange]]] = {}
        self._is_due = False
        self._last_s = 0.0
        self._check = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        self._making = asyncio.Semaphore(_MAKING)
        self._joined: dict[tuple[FeedFilter, int, int], tuple[int, str]] = {}
        self._joined_at = 0

    async def run(self) -> None:
        """Publish changes from the event bus until cancelled."""
        await asyncio.to_thread(self._load)
        ends = [self._bus.on(kind, work) for kind, work in self._subscriptions()]
        works = (self.state.run(), self.live.run(), self._checks(), self._lives(),
                 self._silences(), self._ages())  # fmt: skip
        try:
            async with asyncio.TaskGroup() as group:  # if one fails, all end
                for work in works:
                    group.create_task(work)
        finally:
            for end in ends:
                end()

    def close(self) -> None:
        """Close all connections."""
        for listener in self.listeners:
            listener.end(1001, "the server stops")

    @property
    def published(self) -> int:
        """Return how many changes were published since the start."""
        return self.ring.number - self._first

    def join(self, listener: LiveListener) -> bool:
        """Add a listener; False when there are too many."""
        own = sum(one.who == listener.who for one in self.listeners)
        if len(self.listeners) >= MOST or own >= MOST_EACH:
            return False
        self.listeners.append(listener)
        return True

    def leave(self, listener: LiveListener) -> None:
        """Remove a listener."""
        with suppress(ValueError):
            self.listeners.remove(listener)
        self.live.look_again()

    def watch(self, variables: Mapping[str, frozenset[str]]) -> None:
        """Set the variables that the server itself reads live, by robot; in the event loop."""
        if variables != self.own_watch:
            self.own_watch = dict(variables)
            self.live.look_again()

    def _watches(self) -> list[Watch]:
        own = {robot: sorted(names) for robot, names in self.own_watch.items()}
        return [own, *(one.watch for one in self.listeners)]

    def statuses(self, robot: str) -> Mapping[tuple[str, str], StatusRecord]:
        """Return the statuses of a robot's components and modes as they are now.

        There are none while it is not connected, or while its watcher is silent.
        """
        silent = self._memory.silent(self._clock.wall_ns() - SILENT_NS)
        if robot not in self._links.robots or robot in silent:
            return {}
        return {key: one.record for key, one in self._memory.standing(robot).items()}

    def add(self, kind: Kind, robot: str, data: Any, owner: str = "") -> None:
        """Store a change and wake its listeners."""
        self._wake([self.ring.add(kind, robot, data, time.monotonic(), owner)])

    def _subscriptions(self) -> Iterator[tuple[Any, Callable[[ServerChange], None]]]:
        yield "rows", self._rows
        yield "live", self._values
        yield "connected", lambda c: self.add("presence", c.robot, {"online": True})
        yield "gone", lambda c: self.add("presence", c.robot, {"online": False})
        yield from ((kind, lambda _: self._check.set()) for kind in ("account", "robot"))
        yield "alarm", self._alarm
        yield "job", lambda c: self.add("job", c.robot, dict(c.data), str(c.data.get("owner", "")))
        yield "fetch", lambda c: self.add("fetch", c.robot, {"id": c.data["id"]})
        yield "diagnosis", lambda c: self.add("diagnosis", c.robot, [dict(c.data)])
        yield from ((kind, self._command) for kind in ("command", "answered", "lease"))
        yield "run", lambda c: self.add("run", c.robot, {"id": c.data["id"]})

    def _load(self) -> None:
        with self._database.reading() as connection:
            self._memory.load(connection)

    def _rows(self, change: ServerChange) -> None:
        robot, rows = change.robot, change.data["rows"]
        for kind, data in (("event", event_data(rows)), ("diagnosis", diagnosis_data(rows))):
            if data:
                self.add(kind, robot, data)  # type: ignore[arg-type]  # one of two literals
        self._repeated.add(robot)
        if any(row.channel == channels.COMMAND for row in rows):
            self._reported.add(robot)
            self._plan()
        now_ns = self._clock.wall_ns()
        changed = self._memory.changed(robot, change.data["store_id"], rows, now_ns)
        if changed:
            self._pending.setdefault(robot, []).append(changed)
            self._plan()

    def _plan(self) -> None:
        """Schedule the sending of pending changes: at once, if nothing was sent for a while."""
        if not self._is_due:
            self._is_due = True
            wait_s = max(self._last_s + GATHER_S - time.monotonic(), 0.0)
            asyncio.get_running_loop().call_later(wait_s, self._flush)

    def _flush(self) -> None:
        self._is_due, self._last_s = False, time.monotonic()
        pending, self._pending = self._pending, {}
        reported, self._reported = self._reported, set()
        added = [
            self.ring.add(kind, robot, data, self._last_s)
            for robot, changed in pending.items()
            for kind, data in statuses_data(changed)
        ]
        added += [self.ring.add("command", one, {"ids": []}, self._last_s) for one in reported]
        self._wake(added)

    def _wake(self, deltas: Sequence[Delta]) -> None:
        """Wake the listeners of these changes; the others skip them at their next ping."""
        for listener in self.listeners:
            if any(map(listener.filter.matches, deltas)):
                listener.wake.set()

    def _alarm(self, change: ServerChange) -> None:
        """Publish an alarm; one about several robots for each of them."""
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

    def _command(self, change: ServerChange) -> None:
        """Publish that commands of a robot, or who may give them, have changed."""
        if change.robot:
            self.add("command", change.robot, {"ids": list(change.data.get("ids", ()))})

    def _values(self, change: ServerChange) -> None:
        self.live.take(change.robot, change.data["values"])

    async def _lives(self) -> None:
        """Pass live values to listeners; the message of one set of variables is built once."""
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
        """Publish robots that miss heartbeats while their link holds, and silent watchers."""
        while True:
            await asyncio.sleep(_SILENCE_S)
            silent = self._memory.silent(self._clock.wall_ns() - SILENT_NS)
            for robot, data in (
                *self._silence.news(self._links.robots),
                *self._silence.watchers(self._links.robots, silent),
            ):
                self.add("presence", robot, data)

    async def _ages(self) -> None:
        """Publish the ages of repeated statuses, as long as there are listeners."""
        while True:
            await asyncio.sleep(AGES_S)
            repeated, self._repeated = self._repeated, set()
            shown = {robot for one in self.listeners for robot in one.robots_of("ages")}
            wanted = sorted(repeated & shown)
            offsets = await asyncio.to_thread(self._offsets, wanted) if wanted else {}
            now_ns = self._clock.wall_ns()
            for robot in wanted:
                known = self._memory.standing(robot)
                if known:
                    self.add("ages", robot, ages_data(known, ServerNow(now_ns, offsets.get(robot))))

    def _offsets(self, robots: Sequence[str]) -> Mapping[str, int]:
        with self._database.reading() as connection:
            return clock_offsets_ns(connection, robots)

    async def _checks(self) -> None:
        """Check the permissions of listeners: when accounts or robots change, and every 30 s."""
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(CHECK_S):
                    await self._check.wait()
            self._check.clear()
            for listener in tuple(self.listeners):
                await self.check(listener)

    async def check(self, listener: LiveListener) -> None:
        """Update the permission of a listener; close its connection when it has none any more."""
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

    async def snapshot(self, listener: LiveListener) -> FleetSnapshot:
        """Return a snapshot for a listener; only a few are made at a time."""
        async with self._making:
            return await asyncio.to_thread(self._snapshot, listener)

    def _snapshot(self, listener: LiveListener) -> FleetSnapshot:
        robots, kinds = listener.robots, {kind for kind, _ in listener.filter.reach}
        return self.state.snapshot(robots, self._clock.wall_ns(), with_statuses="status" in kinds)

    def frame(self, listener: LiveListener, deltas: Sequence[Delta], most: int) -> str:
        """Join changes for a listener, up to a size; equal listeners share the result."""
        key = listener.filter, listener.number, self.ring.number
        if key in self._joined:
            listener.number, text = self._joined[key]
            return text
        if self._joined_at != self.ring.number:
            self._joined, self._joined_at = {}, self.ring.number
        texts, size, number = [], 0, listener.number
        chosen = {delta.number for delta in deltas if listener.filter.matches(delta)}
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

    def show_live(self, listener: LiveListener) -> None:
        """Request the live values that a listener watches, and send the known ones."""
        self.live.look_again()
        for robot, names in listener.watch.items():
            text = self.live.text(self.ring.number, robot, names)
            if text:
                listener.live[robot] = text


PING_S = 1.0
# Older changes are not sent as news
BEHIND_S = 5.0
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
        """Send a message; raises OSError when the connection has ended."""

    async def close(self, code: int, reason: str) -> None:
        """Close the connection; does nothing when it is closed."""


class FeedSession:
    """One connection of a listener; ``run`` ends when either side closes it."""

    def __init__(self, feed: Feed, listener: LiveListener, socket: TextSocket) -> None:
        self._feed = feed
        self._listener = listener
        self._socket = socket
        self._has_request = asyncio.Event()
        self._may_be_old = False
        self._sent_s = time.monotonic()

    async def run(self) -> None:
        """Read subscriptions and send changes."""
        tasks = [asyncio.create_task(self._read()), asyncio.create_task(self._write())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        code, reason = self._listener.ended or (1000, "")
        await self._socket.close(code, reason)

    async def _read(self) -> None:
        """Receive subscriptions; each replaces the one before."""
        while True:
            wait_s = None if self._has_request.is_set() else FIRST_S
            try:
                async with asyncio.timeout(wait_s):
                    text = await self._socket.receive()
                if text is None:
                    return None
                self._subscribe(text)
            except TimeoutError:
                return self._listener.end(WRONG, "say what you want to hear first")
            except UsageError as error:
                return self._listener.end(WRONG, error.what)
            await asyncio.sleep(_PAUSE_S)

    def _subscribe(self, text: str) -> None:
        listener, ring = self._listener, self._feed.ring
        listener.asked = parse_subscription(text)
        listener.settle()
        resume = listener.asked.resume
        self._may_be_old = resume is not None and ring.holds(resume)
        listener.needs_snapshot = not self._may_be_old
        listener.number = resume if resume is not None and self._may_be_old else ring.number
        listener.live.clear()
        self._feed.show_live(listener)
        self._has_request.set()
        listener.wake.set()

    async def _write(self) -> None:
        await self._has_request.wait()
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
        """Return the next frame, an array of messages; empty where it has to be called again."""
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
        """Return whether changes were lost, or the next one is too old to be news."""
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
        """Return a snapshot, with the number of the last change that it certainly includes."""
        listener = self._listener
        listener.needs_snapshot, self._may_be_old = False, True
        number = listener.number = self._feed.ring.number
        data = await self._feed.snapshot(listener)
        return f"[{message(number, 'snapshot', '', data)}]"
