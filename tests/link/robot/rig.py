"""A robot's store and a server of the link, for tests: real journals, sockets and databases."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
from sqlalchemy import select
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.chunk import sequences
from amberbox.blackbox.store.derived_journal import ChannelValues, DerivedJournal, event
from amberbox.blackbox.store.journal_reader import JournalFile, journals, sound_chunks
from amberbox.blackbox.store.store import Store, WriterLock, create_store, open_store
from amberbox.core.pacing import Backoff
from amberbox.link import limits
from amberbox.link.client import LinkClient
from amberbox.link.connection import LinkOptions
from amberbox.link.policy import Network
from amberbox.monitoring.current_state import read_heartbeat
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.link_server import LinkHooks, LinkServer, SocketClosedError
from amberbox.server.schema import ASIDE, ROW
from amberbox.testing.clock import PATIENCE_S

Position = tuple[str, str, int, int]
"""Store, writer, run, seq."""
Held = dict[Position, tuple[str, int, bytes]]
"""Rows at positions: channel, log time, bytes."""


class Watcher:
    """Writes statuses and events into a store's watch journal, as the watcher does.

    With the writer ``act``, reports of an action, as the command process does.
    """

    def __init__(self, path: Path, robot: str = "r1", writer: str = "watch") -> None:
        self.store = create_store(path)
        self.robot = robot
        self.lock = WriterLock(self.store, writer)
        self.journal = DerivedJournal(self.store, writer, robot=robot)
        self.count = 0

    def report(self, count: int = 1) -> None:
        """Write reports of an action, each as long as they get."""
        text = "x" * 500
        about = {"robot": self.robot, "state": "report", "id": "0" * 32}
        self.journal.write([(channels.COMMAND, {**about, "text": text})] * count)

    def status(self) -> ChannelValues:
        """Compose the next status."""
        self.count += 1
        component = f"c{self.count % 5}"
        return channels.STATUS, {
            "robot": self.robot, "component": component, "mode": "m", "level": "ok",
            "state": "", "outputs": [], "blocked_by": [], "measured_ns": self.count,
            "since_ns": 0, "reason": str(self.count), "config_hash": "", "live_only": False,
        }  # fmt: skip

    def write(self, statuses: int = 1, events: int = 0, *, sync: bool = True) -> None:
        """Write some records; without ``sync`` they are not durable yet."""
        records = [self.status() for _ in range(statuses)]
        records += [event("test", f"number {self.count}/{n}") for n in range(events)]
        if sync:
            self.journal.write(records)
        else:
            self._unsynced(records)

    def _unsynced(self, records: list[ChannelValues]) -> None:
        journal = self.journal
        messages = [(channel, msgspec.json.encode(values)) for channel, values in records]
        from amberbox.blackbox.store.derived_journal import EncodedRecord

        journal._write([EncodedRecord(channel, data) for channel, data in messages])
        assert journal._writer is not None
        journal._writer.publish_head(journal._last_ns)

    def close(self) -> None:
        """End as a clean stop does."""
        self.journal.close()
        self.lock.release()


def recorded(path: Path) -> Held:
    """Return the rows of a store's journals that are sent over the link, by position."""
    store = open_store(path)
    found: Held = {}
    for journal in journals(path):
        if journal.writer in limits.WRITERS:
            found |= conclusions_of(journal, store.id)
    return found


def conclusions_of(journal: JournalFile, store_id: str) -> Held:
    """Return the rows of a journal that are sent over the link."""
    found: Held = {}
    for chunk in sound_chunks(journal):
        seq = sequences(chunk, journal.first_seq).tolist()
        every = range(len(chunk))
        messages = chunk.messages(every)  # type: ignore[arg-type]  # any index will do
        for row, at, data in zip(every, seq, messages, strict=True):
            topic = journal.streams[int(chunk.channel[row])].topic.name
            if topic in limits.CHANNELS:
                place = store_id, journal.writer, journal.run, at
                found[place] = topic, int(chunk.log_ns[row]), data
    return found


def held(database: ServerDatabase, robot: str = "r1", table: Any = ROW) -> Held:
    """Return what the server holds of a robot; a position twice would fail the test."""
    with database.reading() as connection:
        rows = connection.execute(select(table).where(table.c.robot == robot)).all()
    found = {
        (r.store_id, r.writer, r.run, r.seq): (r.channel, r.log_ns, bytes(r.data)) for r in rows
    }
    assert len(found) == len(rows)
    return found


def put_aside(database: ServerDatabase, robot: str = "r1") -> Held:
    """Return what the server keeps beside the record."""
    return held(database, robot, ASIDE)


class WebsocketsSocket:
    """A connection of the ``websockets`` package."""

    def __init__(self, connection: ServerConnection) -> None:
        self._connection = connection

    async def receive(self) -> bytes:
        """Wait for the next message; text is none of ours."""
        try:
            data = await self._connection.recv()
        except (ConnectionClosed, OSError) as error:
            raise SocketClosedError(str(error)) from error
        return data if isinstance(data, bytes) else b""

    async def send(self, data: bytes) -> None:
        """Send a message."""
        try:
            await self._connection.send(data)
        except (ConnectionClosed, OSError) as error:
            raise SocketClosedError(str(error)) from error

    async def close(self) -> None:
        """End the connection."""
        await self._connection.close()


@asynccontextmanager
async def serving(
    database: ServerDatabase, hooks: LinkHooks | None = None, port: int = 0, silent_s: float = 5.0
) -> AsyncIterator[tuple[LinkServer, int]]:
    """Serve links on loopback; robots use the key ``key-<id>``."""
    link = LinkServer(database, hooks, silent_s=silent_s)

    async def handle(connection: ServerConnection) -> None:
        assert connection.request is not None
        robot, _, key = connection.request.headers["Authorization"][6:].partition(":")
        if key != f"key-{robot}":
            await connection.close(1008)
            return
        await link.serve(WebsocketsSocket(connection), robot)

    async with serve(
        handle, "127.0.0.1", port, ping_interval=None, close_timeout=0.2, compression=None,
        max_size=limits.FRAME_BYTES,
    ) as server:  # fmt: skip
        try:
            yield link, next(iter(server.sockets)).getsockname()[1]
        finally:
            server.close()
            await server.wait_closed()
            await asyncio.to_thread(link.close)


def client_of(store: Store, port: int, robot: str = "r1", **more: Any) -> LinkClient:
    """Make a client whose waits are short."""
    options = LinkOptions(f"http://127.0.0.1:{port}", robot, f"key-{robot}", **more)
    backoff = Backoff(least_s=0.05, most_s=0.3)
    return LinkClient(store, options, network=lambda: Network("eth0"), monitoring=read_heartbeat,
                      backoff=backoff)  # fmt: skip


@asynccontextmanager
async def linked(client: LinkClient) -> AsyncIterator[asyncio.Event]:
    """Run a client until the block is left, then let it end as it does when it is stopped."""
    stop = asyncio.Event()
    task = asyncio.create_task(client.run(stop))
    try:
        yield stop
    finally:
        stop.set()
        await asyncio.wait_for(task, PATIENCE_S)


async def until(what: Callable[[], bool]) -> None:
    """Wait until something is so."""
    end = asyncio.get_running_loop().time() + PATIENCE_S
    while not await asyncio.to_thread(what):
        assert asyncio.get_running_loop().time() < end, "it never came to be"
        await asyncio.sleep(0.02)
