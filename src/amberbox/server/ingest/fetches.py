"""Fetch requests: windows of data requested from robots, tracked until they are copied."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from sqlalchemy import Connection, Row, func, select, update

from amberbox.core.api import FetchState
from amberbox.core.clock import NS, Clock
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_duration
from amberbox.link.frames import FetchFrame
from amberbox.link.limits import FILES
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest import uploads
from amberbox.server.ingest.link_server import LinkServer
from amberbox.server.schema import FETCH, UPLOAD

OPEN: Sequence[FetchState] = ("waiting", "asked", "copying")
# Time that a robot is connected without sending, after which a window is given up
IDLE_NS = 3600 * NS
# Largest number of open windows per robot
MOST_OPEN = 100

_GONE = "gone"
_LATE = "late"
# Final states of an upload
_ENDED = ("verified", "aside", "quarantined")


class RequestedFile(msgspec.Struct, frozen=True):
    """A journal of a window; ``state`` is empty until it arrives, then that of its upload.

    ``gone``: the robot had named it and deleted it before it was copied. ``late``: it did not
    arrive although the robot was connected for long.
    """

    store_id: str
    journal: str
    bytes: int
    state: str = ""


@dataclass(frozen=True, slots=True)
class RequestedWindow:
    """A window of a robot's record that was requested on the server."""

    id: str
    robot: str
    item: str
    from_ns: int
    to_ns: int
    who: str
    state: FetchState
    files: Sequence[RequestedFile]
    asked_ns: int
    sent_ns: int | None
    ended_ns: int | None

    @property
    def reason(self) -> str:
        """Return why the data are incomplete, and what helps; empty where nothing was given up."""
        late = sum(file.state == _LATE for file in self.files)
        if not late:
            return ""
        return (
            f"{late} of {len(self.files)} journals did not come although {self.robot} was "
            f"connected for {format_duration(IDLE_NS)}. An amberbox from before servers could be "
            "restored takes them for copied: update it on the robot, and ask again. Over a metered "
            "network nothing is copied"
        )


def add(
    connection: Connection, now_ns: int, robot: str, who: str, item: str, span: tuple[int, int]
) -> RequestedWindow:
    """Request a window; raises UsageError when too many are open for this robot."""
    counted = select(func.count()).select_from(FETCH)
    count = connection.scalar(counted.where(FETCH.c.robot == robot, FETCH.c.state.in_(OPEN))) or 0
    if count >= MOST_OPEN:
        raise UsageError(f"{count} windows of {robot} are waited for", "wait, or cancel some")
    fetch_id = f"f-{secrets.token_hex(12)}"
    row = {
        "id": fetch_id, "robot": robot, "item": item, "from_ns": span[0], "to_ns": span[1],
        "who": who, "state": "waiting", "files": "[]", "asked_ns": now_ns,
    }  # fmt: skip
    connection.execute(FETCH.insert(), [row])
    found = find(connection, robot, fetch_id)
    assert found is not None
    return found


def find(connection: Connection, robot: str, fetch_id: str) -> RequestedWindow | None:
    """Return a requested window of this robot, or None."""
    chosen = select(FETCH).where(FETCH.c.id == fetch_id, FETCH.c.robot == robot)
    row = connection.execute(chosen).one_or_none()
    return None if row is None else _fetched(row)


def listed(
    connection: Connection, robot: str, after: str = "", limit: int = 100
) -> list[RequestedWindow]:
    """Return the requested windows of a robot, newest first, those after an id."""
    chosen = select(FETCH).where(FETCH.c.robot == robot)
    mark = find(connection, robot, after) if after else None
    if mark is not None:
        same = (FETCH.c.asked_ns == mark.asked_ns) & (FETCH.c.id > mark.id)
        chosen = chosen.where((FETCH.c.asked_ns < mark.asked_ns) | same)
    ordered = chosen.order_by(FETCH.c.asked_ns.desc(), FETCH.c.id).limit(limit)
    return [_fetched(row) for row in connection.execute(ordered)]


def waiting(connection: Connection, robot: str) -> list[RequestedWindow]:
    """Return the open windows of a robot, in the order of their requests."""
    chosen = select(FETCH).where(FETCH.c.robot == robot, FETCH.c.state.in_(OPEN))
    return [_fetched(r) for r in connection.execute(chosen.order_by(FETCH.c.asked_ns, FETCH.c.id))]


def robots(connection: Connection) -> list[str]:
    """Return the robots with open windows."""
    chosen = select(FETCH.c.robot).where(FETCH.c.state.in_(OPEN)).distinct()
    return list(connection.scalars(chosen))


def mark_sent(connection: Connection, now_ns: int, one: RequestedWindow) -> bool:
    """Set the window's state to ``asked``; return whether it was waiting."""
    changed = update(FETCH).where(FETCH.c.id == one.id, FETCH.c.state == "waiting")
    return connection.execute(changed.values(state="asked", sent_ns=now_ns)).rowcount > 0


def record_answer(
    connection: Connection, now_ns: int, one: RequestedWindow, named: Sequence[RequestedFile]
) -> RequestedWindow | None:
    """Update the journals that a robot named for a window; None where that changes nothing.

    A robot names all journals that hold the window: those it named before, has not sent, and does
    not name any more, will not arrive (``gone``).
    """
    known = {(file.store_id, file.journal) for file in one.files}
    more = [file for file in named if (file.store_id, file.journal) not in known]
    more = more[: FILES - len(one.files)]  # limits what a faulty robot can add
    if one.state not in OPEN:
        return None
    if not (one.files or more):
        return _change(connection, one, state="gone", ended_ns=now_ns)
    here = {(file.store_id, file.journal) for file in named}
    is_all = len(named) < FILES  # else there are more than fit in a frame
    return update_files(connection, now_ns, one, [*one.files, *more], here if is_all else None)


def update_files(
    connection: Connection, now_ns: int, one: RequestedWindow, files: Sequence[RequestedFile],
    here: Collection[tuple[str, str]] | None = None,
) -> RequestedWindow | None:  # fmt: skip
    """Update the states of a window's journals; return None if nothing changes.

    ``here`` are the journals that the robot still has (store and journal), None if unknown.
    """
    found = [_with_state(connection, one.robot, file) for file in files]
    if here is not None:
        found = [
            file
            if file.state or (file.store_id, file.journal) in here
            else msgspec.structs.replace(file, state=_GONE)
            for file in found
        ]
    done = all(file.state for file in found)
    nothing = all(file.state in (_GONE, _LATE) for file in found)
    state: FetchState = "copying" if not done else "gone" if nothing else "ready"
    if (list(one.files), one.state) == (found, state):
        return None
    text = msgspec.json.encode(found).decode()
    return _change(connection, one, state=state, files=text, ended_ns=now_ns if done else None)


def give_up(connection: Connection, now_ns: int, one: RequestedWindow) -> RequestedWindow | None:
    """Mark the journals of a window that have not arrived as late; None if all have meanwhile."""
    files = [_with_state(connection, one.robot, file) for file in one.files]
    late = [file if file.state else msgspec.structs.replace(file, state=_LATE) for file in files]
    return update_files(connection, now_ns, one, late)


def cancel(connection: Connection, now_ns: int, one: RequestedWindow) -> bool:
    """Cancel a window; return whether it was open."""
    changed = update(FETCH).where(FETCH.c.id == one.id, FETCH.c.state.in_(OPEN))
    return connection.execute(changed.values(state="cancelled", ended_ns=now_ns)).rowcount > 0


def _with_state(connection: Connection, robot: str, file: RequestedFile) -> RequestedFile:
    if file.state:
        return file
    chosen = select(UPLOAD.c.state).where(
        UPLOAD.c.robot == robot, UPLOAD.c.store_id == file.store_id,
        UPLOAD.c.journal == file.journal, UPLOAD.c.state.in_(_ENDED),
    )  # fmt: skip
    states = set(connection.scalars(chosen))
    best = next((state for state in _ENDED if state in states), "")
    return msgspec.structs.replace(file, state=best)


def _change(connection: Connection, one: RequestedWindow, **values: Any) -> RequestedWindow | None:
    connection.execute(update(FETCH).where(FETCH.c.id == one.id).values(**values))
    return find(connection, one.robot, one.id)


def _fetched(row: Row[Any]) -> RequestedWindow:
    return RequestedWindow(
        row.id,
        row.robot,
        row.item,
        row.from_ns,
        row.to_ns,
        row.who,
        row.state,
        msgspec.json.decode(row.files, type=list[RequestedFile]),
        row.asked_ns,
        row.sent_ns,
        row.ended_ns,
    )


_LOOK_S = 60.0


# Since when (ns since boot) a connected robot has sent nothing; state at that time
_Idle = tuple[int, tuple[int, int, int]]


class FetchService:
    """Sends fetch requests to robots; their state is in the database only."""

    def __init__(
        self, folder: Path, database: ServerDatabase, bus: EventBus, clock: Clock, links: LinkServer
    ) -> None:
        self._folder = folder
        self._database = database
        self._bus = bus
        self._clock = clock
        self._links = links
        self._changes: asyncio.Queue[ServerChange] = asyncio.Queue()
        self._restoring: set[str] = set()  # robots that upload again what the server lacks
        self._idle: dict[str, _Idle] = {}
        for kind in ("connected", "has", "journal", "fetch", "holdings"):
            bus.on(kind, self._on_change)

    async def run(self) -> None:
        """Work until cancelled."""
        changes = self._changes = asyncio.Queue()
        loop, next_s = asyncio.get_running_loop(), 0.0
        while True:
            if loop.time() >= next_s:
                await self._check_all()
                next_s = loop.time() + _LOOK_S
            try:
                async with asyncio.timeout_at(next_s):  # wait_for may swallow a cancellation
                    change = await changes.get()
            except TimeoutError:
                continue
            await self._do(change)

    def close(self) -> None:
        """Do nothing: no resources are held."""

    def _on_change(self, change: ServerChange) -> None:
        """Queue a change, in the event loop; of changes to fetches only requests by people."""
        if change.kind != "fetch" or change.data.get("ask"):
            self._changes.put_nowait(change)

    async def _do(self, change: ServerChange) -> None:
        if change.kind == "holdings":
            self._restoring.add(change.robot)
        elif change.kind in ("connected", "fetch"):
            if change.kind == "connected":
                self._restoring.discard(change.robot)
            await self._send(change.robot)
        elif change.kind == "has":
            data = change.data
            files = [RequestedFile(data["store_id"], name, size) for name, size in data["files"]]
            await asyncio.to_thread(self._answered, change.robot, data["id"], files)
        else:
            await asyncio.to_thread(self._arrived, change.robot)

    async def _check_all(self) -> None:
        """Check all robots: changes before the start were missed."""
        for robot in await asyncio.to_thread(self._robots):
            await asyncio.to_thread(self._arrived, robot)
            if await asyncio.to_thread(self._is_idle, robot):
                await asyncio.to_thread(self._give_up, robot)
            await self._send(robot)

    def _is_idle(self, robot: str) -> bool:
        """Return whether a robot has long sent nothing, possibly because it takes journals for
        copied.
        """
        if robot in self._restoring or robot not in self._links.robots:
            self._idle.pop(robot, None)
            return False
        now_ns, held = self._clock.boot_ns(), self._held(robot)
        known = self._idle.get(robot)
        if known is None or known[1] != held:
            self._idle[robot] = now_ns, held
            return False
        return now_ns - known[0] >= IDLE_NS

    def _held(self, robot: str) -> tuple[int, int, int]:
        """Return the counts of open windows and received files, and the bytes of partial files."""
        with self._database.reading() as connection:
            chosen = select(func.count()).select_from(UPLOAD).where(UPLOAD.c.robot == robot)
            count = connection.scalar(chosen) or 0
            open_ones = len(waiting(connection, robot))
        coming = sum(path.stat().st_size for path in uploads.part_files(self._folder, robot))
        return open_ones, count, coming

    def _give_up(self, robot: str) -> None:
        """Give up the windows for which the robot has named journals long ago."""
        self._update(robot, give_up)
        self._idle.pop(robot, None)

    def _update(
        self, robot: str, work: Callable[[Connection, int, RequestedWindow], RequestedWindow | None]
    ) -> None:
        """Update all windows whose journals are named; publish the changed ones."""
        now_ns = self._clock.wall_ns()
        with self._database.begin() as connection:
            named = [one for one in waiting(connection, robot) if one.state == "copying"]
            changed = [work(connection, now_ns, one) for one in named]
        for one in changed:
            if one is not None:
                self._publish(one)

    def _robots(self) -> Sequence[str]:
        with self._database.reading() as connection:
            return robots(connection)

    def _waiting(self, robot: str) -> Sequence[RequestedWindow]:
        with self._database.reading() as connection:
            return waiting(connection, robot)

    async def _send(self, robot: str) -> None:
        """Send all open requests to a robot, again on each connection in case it lost them."""
        if robot not in self._links.robots:
            return
        for one in await asyncio.to_thread(self._waiting, robot):
            frame = FetchFrame(one.id, one.item, one.from_ns, one.to_ns)
            if not await self._links.send(robot, frame):
                return
            await asyncio.to_thread(self._sent, one)

    def _sent(self, one: RequestedWindow) -> None:
        with self._database.begin() as connection:
            changed = mark_sent(connection, self._clock.wall_ns(), one)
        if changed:
            self._publish(one)

    def _answered(self, robot: str, fetch_id: str, files: Sequence[RequestedFile]) -> None:
        with self._database.begin() as connection:
            one = find(connection, robot, fetch_id)
            now_ns = self._clock.wall_ns()
            changed = one and record_answer(connection, now_ns, one, files)
        if changed:
            self._publish(changed)

    def _arrived(self, robot: str) -> None:
        """Update windows after an upload of a robot; usually none is open."""
        if any(one.state == "copying" for one in self._waiting(robot)):
            self._update(robot, lambda c, now_ns, one: update_files(c, now_ns, one, one.files))

    def _publish(self, one: RequestedWindow) -> None:
        self._bus.publish(ServerChange("fetch", one.robot, {"id": one.id}))
